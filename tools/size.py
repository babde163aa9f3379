"""Weigh the project: `python -m tools.size [ROOT] [--check] [--ceilings]`.

Sizes that formatting cannot change. Of Python: **code tokens** (names, numbers, operators and
keywords; a string, and an f-string with all that is in it, counts one and one more for every
8 words; brackets, commas, colons, dots, layout, comments and docstrings count nothing) and **words
of prose** in comments and docstrings, a row a package. JavaScript, C, Lua and templates count the
same way as far as their comments can be told; data files count their words.

`weight.toml` holds a ceiling for each package of the product; `--check`, a part of `make lint`,
fails above one, and `--ceilings` prints today's figures in its form. Whoever raises a ceiling says
why in that commit.
"""

from __future__ import annotations

import argparse
import ast
import io
import re
import subprocess
import sys
import token
import tokenize
import tomllib
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
PRODUCT = ("companion", "missions", "analysis", "sitl")
# Folders of the product are weighed one by one down to this depth.
DEPTH = 2
WORDS_A_TOKEN = 8
SILENT = frozenset("()[]{},:;.")
LAYOUT = frozenset(
    {token.NL, token.NEWLINE, token.INDENT, token.DEDENT, token.ENDMARKER, token.ENCODING}
)
OTHER = {
    ".js": "JavaScript",
    ".c": "C",
    ".h": "C",
    ".lua": "Lua",
    ".html": "templates",
    ".j2": "templates",
    ".css": "templates",
    ".toml": "data",
    ".csv": "data",
    ".json": "data",
}
# A comment, a string, a word or number, or a sign.
PIECE = re.compile(
    r"(?P<comment>/\*.*?\*/|<!--.*?-->|\{#.*?#\}|--\[\[.*?\]\]|(?<![:\w])//[^\n]*|(?<!-)--(?=\s)[^\n]*)"
    r"|(?P<string>\"(?:\\.|[^\"\\\n])*\"|'(?:\\.|[^'\\\n])*'|`(?:\\.|[^`\\])*`)"
    r"|(?P<word>\w+)|(?P<sign>[^\s\w()\[\]{},:;.])",
    re.DOTALL,
)


class Size(NamedTuple):
    """How many files, code tokens and words of prose."""

    files: int = 0
    tokens: int = 0
    words: int = 0

    def plus(self, other: Size) -> Size:
        """Return both together."""
        return Size(*(mine + its for mine, its in zip(self, other, strict=True)))


def python_size(source: str) -> Size:
    r"""Return the size of a Python source.

    >>> python_size("def double(x):\n    'Return twice x.'\n    return 2 * x  # exact\n")
    Size(files=1, tokens=7, words=4)
    """
    first_lines, words = set(), 0
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            docstring = ast.get_docstring(node, clean=False)
            if docstring is not None:
                first_lines.add(node.body[0].lineno)
                words += len(docstring.split())
    tokens = 0
    for kind, text, line in _pieces(source):
        if kind == token.COMMENT:
            words += len(text.split()) - 1
        elif kind == token.STRING:
            tokens += 0 if line in first_lines else 1 + len(text.split()) // WORDS_A_TOKEN
        elif text not in SILENT:
            tokens += 1
    return Size(1, tokens, words)


def _pieces(source: str) -> Iterator[tuple[int, str, int]]:
    """Yield kind, text and line of each token; an f-string is one string on every Python."""
    starts, ends = getattr(token, "FSTRING_START", -1), getattr(token, "FSTRING_END", -1)
    lines = source.splitlines(keepends=True)
    depth, begins = 0, (0, 0)
    for kind, text, start, end, _ in tokenize.generate_tokens(io.StringIO(source).readline):
        if kind == starts:
            begins = begins if depth else start
            depth += 1
        elif kind == ends:
            depth -= 1
            if not depth:
                (row, column), (last, stop) = begins, end
                whole = [*lines[row - 1 : last - 1], lines[last - 1][:stop]]
                whole[0] = whole[0][column:]
                yield token.STRING, "".join(whole), begins[0]
        elif not depth and kind not in LAYOUT:
            yield kind, text, start[0]


def other_size(text: str, *, is_data: bool) -> Size:
    """Return the size of a file in another language; of data, its words.

    >>> other_size("let x = 'two words'; // not why", is_data=False)
    Size(files=1, tokens=4, words=2)
    """
    if is_data:
        return Size(1, len(text.split()), 0)
    tokens = words = 0
    for piece in PIECE.finditer(text):
        if piece["comment"]:
            words += len(re.findall(r"\w+", piece["comment"]))
        else:
            tokens += 1
            if piece["string"]:
                tokens += len(piece["string"].split()) // WORDS_A_TOKEN
    return Size(1, tokens, words)


def weigh(root: Path) -> dict[str, Size]:
    """Return the size of each package, then of each other language of the product."""
    sizes: dict[str, Size] = defaultdict(Size)
    for path in _files(root):
        top, kind = path.parts[0], OTHER.get(path.suffix)
        if path.suffix == ".py":
            depth = DEPTH if top in PRODUCT else 1
            name = "/".join(path.parts[:-1][:depth]) or "."
            size = python_size((root / path).read_text(encoding="utf-8"))
        elif kind is not None and top in (*PRODUCT, "deploy") and "vendor" not in path.parts:
            name = kind
            text = (root / path).read_text(encoding="utf-8")
            size = other_size(text, is_data=kind == "data")
        else:
            continue
        sizes[name] = sizes[name].plus(size)
    return dict(sorted(sizes.items()))


def _files(root: Path) -> Iterator[Path]:
    listed = subprocess.run(
        ["git", "-C", str(root), "ls-files"], capture_output=True, text=True, check=False
    )
    names = listed.stdout.splitlines() or [
        str(path.relative_to(root))
        for top in (*PRODUCT, "deploy")
        for path in root.glob(top + "/**/*")
    ]
    for name in names:
        path = root / name
        # A link stands for files that are counted where they lie.
        if path.is_file() and not path.is_symlink():
            yield Path(name)


def is_bounded(name: str) -> bool:
    """Return whether a package or language has a ceiling: all but tests and tools."""
    return name.split("/")[0] in (*PRODUCT, *OTHER.values())


def findings(sizes: dict[str, Size], ceilings: dict[str, dict[str, int]]) -> list[str]:
    """Return what is above its ceiling, has none, or is gone; a line each.

    >>> findings({"sitl": Size(1, 12, 3)}, {"sitl": {"tokens": 10, "words": 5}})
    ['sitl: 12 tokens, more than its 10 in weight.toml: remove 2, or raise it and say why']
    """
    found = [f"{name}: in weight.toml, and not there" for name in ceilings if name not in sizes]
    for name, size in sizes.items():
        if not is_bounded(name):
            continue
        if name not in ceilings:
            found.append(f"{name}: has no ceiling in weight.toml")
            continue
        for what in ("tokens", "words"):
            is_now, most = getattr(size, what), ceilings[name][what]
            if is_now > most:
                found.append(
                    f"{name}: {is_now} {what}, more than its {most} in weight.toml:"
                    f" remove {is_now - most}, or raise it and say why"
                )
    return found


def main(arguments: list[str] | None = None) -> int:
    """Print the table, or check it against the ceilings: 1 where it is above one."""
    parser = argparse.ArgumentParser(description="Weigh the project.")
    parser.add_argument("root", nargs="?", type=Path, default=ROOT)
    how = parser.add_mutually_exclusive_group()
    how.add_argument("--check", action="store_true", help="against weight.toml; exit 1 above it")
    how.add_argument(
        "--ceilings", action="store_true", help="print today's as weight.toml has them"
    )
    asked = parser.parse_args(arguments)
    sizes = weigh(asked.root)
    bounded = {name: size for name, size in sizes.items() if is_bounded(name)}
    if asked.check:
        text = (asked.root / "weight.toml").read_text(encoding="utf-8")
        found = findings(sizes, tomllib.loads(text))
        sys.stdout.write("".join(line + "\n" for line in found))
        sys.stdout.write(f"{len(bounded)} packages weighed, {len(found)} above their ceiling\n")
        return 1 if found else 0
    if asked.ceilings:
        for name, size in bounded.items():
            sys.stdout.write(f'"{name}" = {{ tokens = {size.tokens}, words = {size.words} }}\n')
        return 0
    python = Size()
    sys.stdout.write(f"{'package':28}{'files':>7}{'tokens':>10}{'words':>9}\n")
    for name, size in sizes.items():
        sys.stdout.write(f"{name:28}{size.files:7}{size.tokens:10}{size.words:9}\n")
        if name.split("/")[0] in PRODUCT:
            python = python.plus(size)
    sys.stdout.write(f"{'product, Python':28}{python.files:7}{python.tokens:10}{python.words:9}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
