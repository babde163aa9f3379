"""Every code that a problem of a map can have is explained in docs/reference/map-problems.md."""

from __future__ import annotations

import ast
import re
from pathlib import Path
from typing import Any

from tests.reference.map_problems import problems

ROOT = Path(__file__).resolve().parents[2]
SOURCES = [
    *sorted((ROOT / "missions" / "maps").rglob("*.py")),
    *sorted((ROOT / "companion" / "flight_map").rglob("*.py")),
    ROOT / "companion" / "assembly.py",
    ROOT / "companion" / "errors.py",
    ROOT / "companion" / "wording.py",
]
CODE = re.compile(r"[a-z]+(-[a-z0-9]+)*")
# `not-a-polygon:Point` is the code and what was found instead.
WITH_HYPHEN = re.compile(r"([a-z]+(?:-[a-z0-9]+)+)(?::.*)?")
# Words with a hyphen that are no codes: encodings of text and names of formats.
NO_CODES = re.compile(r"(utf|euc|windows|latin|iso|cp|shift)-.*|text-map|normally-.*|look-ahead")


def codes_in(source: str) -> set[str]:
    """Return what is given as `code`, and every other string that looks like one."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.keyword) and node.arg == "code":
            texts = [one.value for one in ast.walk(node.value) if isinstance(one, ast.Constant)]
            found |= {text for text in texts if isinstance(text, str) and CODE.fullmatch(text)}
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            match = WITH_HYPHEN.fullmatch(node.value)
            if match and not NO_CODES.fullmatch(match[1]):
                found.add(match[1])
    return found


def documented() -> dict[str, dict[str, Any]]:
    """Return the entry of every code."""
    entries: dict[str, dict[str, Any]] = {}
    for entry in problems():
        for code in entry["codes"]:
            assert code not in entries, f"{code} is explained twice"
            entries[code] = entry
    return entries


def test_codes_are_found_however_they_are_given() -> None:
    source = (
        'f(code="a-b"); g("c-d" if x else "e"); h[1] = "not-it:Point"; k(code="gap" if y else z)'
    )
    assert codes_in(source) == {"a-b", "c-d", "not-it", "gap"}


def test_every_code_is_explained_with_meaning_example_and_fix() -> None:
    used = {code: path.name for path in SOURCES for code in codes_in(path.read_text("utf-8"))}
    assert len(used) > 50
    assert {code: name for code, name in used.items() if code not in documented()} == {}


def test_nothing_is_explained_that_no_longer_exists() -> None:
    text = "".join(path.read_text(encoding="utf-8") for path in SOURCES)
    assert [code for code in documented() if f'"{code}' not in text] == []
    assert all(entry["meaning"] and entry["severity"] for entry in documented().values())


ANYTHING = "\0"


def texts_in(source: str) -> set[str]:
    """Return every text of a source; what is worked out in it is one sign."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.JoinedStr):
            parts = [
                one.value if isinstance(one, ast.Constant) else ANYTHING for one in node.values
            ]
            found.add(re.sub(f"{ANYTHING}+", ANYTHING, "".join(map(str, parts))))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            found.add(node.value)
    return found


def unsaid(example: str, texts: set[str]) -> list[str]:
    """Return what of an example no text says."""
    said = [re.sub(r"\{.*?\}", ANYTHING, one) for one in re.findall(r'"(.+?)"(?:, |$)', example)]
    return [one for one in said or [example] if not any(one in text for text in texts)]


def test_an_example_is_what_the_program_says_to_the_letter() -> None:
    texts = texts_in('f(f"no {kind}{more} in {path}; " "take another", code="a-b")')
    assert unsaid('"no {map} in {a.zip}; take another"', texts) == []
    assert unsaid('"no map in {a.zip}"', texts) == ["no map in \0"]
    every = set().union(*(texts_in(path.read_text(encoding="utf-8")) for path in SOURCES))
    found = {
        code: left
        for code, entry in documented().items()
        if (left := unsaid(entry["example"], every))
    }
    assert found == {}
