"""The mutation runner: what it makes of a file, and what it says of a mutant."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

from tests.mutations import INTERLOCK, ROOT, Mutant, listed, without_finally

CODE = """def one(path):
    try:
        use(path)
    finally:
        close(path)
    return path


def two(path):
    try:
        use(path)
    except OSError:
        raise
    finally:
        # last
        close(path)
"""
OURS = ("companion", "sitl", "analysis", "missions")


@cache
def every() -> tuple[Mutant, ...]:
    """Return all mutants of the list; half a second, which not every collection of tests needs."""
    return tuple(listed(ROOT))


def mutant(old: str, new: str) -> Mutant:
    return Mutant(name="a", file="a.py", old=old, new=new, tests=("tests",))


def test_a_mutant_applies_where_its_text_is_there_exactly_once() -> None:
    assert mutant("b", "x").applied("abc") == "axc"
    assert mutant("b", "x").applied("abcb") is None
    assert mutant("d", "x").applied("abc") is None
    assert mutant("b", "b").applied("abc") is None


def test_every_finally_is_left_out_and_bound_to_success() -> None:
    made = [CODE.replace(old, new) for _, old, new in without_finally(CODE)]
    assert len(made) == 4
    assert len(set(made) - {CODE}) == 4
    for text in made:
        tree = ast.parse(text)
        finals = [node for node in ast.walk(tree) if isinstance(node, ast.Try) and node.finalbody]
        assert len(finals) == 1
    assert [text.count("close(path)") for text in made] == [1, 2, 1, 2]


def test_every_inhibit_and_every_finally_of_the_code_has_its_mutant() -> None:
    names = [found.name for found in every()]
    checks = (ROOT / INTERLOCK).read_text(encoding="utf-8").count("found.append(Inhibit.")
    assert sum(name.startswith("no check of ") for name in names) == checks
    finals = sum(
        line.strip() == "finally:"
        for package in OURS
        for path in (ROOT / package).rglob("*.py")
        for line in path.read_text(encoding="utf-8").splitlines()
    )
    assert sum("`finally`" in name for name in names) == 2 * finals


def test_every_mutant_applies_to_the_code_as_it_is() -> None:
    texts = {found.file: (ROOT / found.file).read_text("utf-8") for found in every()}
    idle = [found.name for found in every() if found.applied(texts[found.file]) is None]
    assert idle == []


def test_no_two_mutants_have_one_name() -> None:
    names = [found.name for found in every()]
    assert sorted(names) == sorted(set(names))


def test_the_tests_of_the_mutants_are_there() -> None:
    named = sorted({test for found in every() for test in found.tests})
    assert [path for path in named if not Path(ROOT, path).is_file()] == []
