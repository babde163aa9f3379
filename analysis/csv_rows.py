"""Measurements that a person typed into a table: rows with named columns, and numbers.

Comma, semicolon or tab; lines that begin with # are notes. A decimal comma is refused: `1,500` is
fifteen hundred to one program and one and a half to another.
"""

from __future__ import annotations

import csv
import math
import re
from dataclasses import dataclass
from io import StringIO
from typing import TYPE_CHECKING

from companion.errors import VrsprayError
from companion.wording import iconv

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

DELIMITERS = (",", ";", "\t")
# A table of measurements is some kilobytes; what is larger is another file.
MAX_BYTES = 1_000_000
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d{1,3})?", re.ASCII)
_COMMA = re.compile(r"[+-]?\d+,\d+", re.ASCII)


class TableError(VrsprayError):
    """A table of measurements cannot be used."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One line of a table; what is blank is not among its values."""

    path: Path
    line: int
    values: dict[str, str]

    def text(self, name: str) -> str | None:
        """Return what stands in a column; None where nothing does."""
        return self.values.get(name)

    def number(self, name: str, *, low: float, high: float) -> float | None:
        """Return a number of a column, within its limits; None where there is none."""
        text = self.values.get(name)
        if text is None:
            return None
        if _COMMA.fullmatch(text):
            raise self.error(f"{name} is {text!r}, with a decimal comma; write a point")
        value = float(text) if _NUMBER.fullmatch(text) else math.nan
        if not low <= value <= high:
            raise self.error(f"{name} must be a number from {low:g} to {high:g}, got {text[:40]!r}")
        return value

    def needed(self, name: str, *, low: float, high: float) -> float:
        """Return a number of a column that every row must have."""
        value = self.number(name, low=low, high=high)
        if value is None:
            raise self.error(f"{name} is blank; fill it in or take the line out")
        return value

    def error(self, text: str) -> TableError:
        """Return an error that names the file and this line."""
        return TableError(f"{self.path}: line {self.line}: {text}")


def column_names(path: Path) -> list[str]:
    """Return the names of a file's columns; none of an empty one."""
    lines = _lines(path)
    return _names(lines[0][1])[0] if lines else []


def read_rows(path: Path, needed: Sequence[str]) -> list[Row]:
    """Return the rows of a CSV file whose first line names at least the columns `needed`."""
    lines = _lines(path)
    if not lines:
        raise TableError(f"{path}: the file is empty; its first line names {', '.join(needed)}")
    names, delimiter = _names(lines[0][1])
    missing = [name for name in needed if name not in names]
    if missing:
        raise TableError(
            f"{path}: no column {', '.join(missing)}; the first line names the columns, here "
            f"{', '.join(names)[:120]}"
        )
    if len(set(names)) < len(names):
        raise TableError(f"{path}: two columns have one name; give each a name of its own")
    rows = [_row(path, number, _split(line, delimiter), names) for number, line in lines[1:]]
    if not rows:
        raise TableError(f"{path}: there are no rows below the names of the columns")
    return rows


def _lines(path: Path) -> list[tuple[int, str]]:
    """Return the lines that are neither blank nor notes, with their numbers."""
    return [
        (number, line)
        for number, line in enumerate(_text(path).splitlines(), 1)
        if line.strip(" \t,;") and not line.lstrip().startswith("#")
    ]


def _names(line: str) -> tuple[list[str], str]:
    """Return the names of the columns and what stands between them."""
    delimiter = max(DELIMITERS, key=lambda each: len(_split(line, each)))
    return [name.casefold() for name in _split(line, delimiter)], delimiter


def _row(path: Path, number: int, fields: Iterable[str], names: Sequence[str]) -> Row:
    fields = list(fields)
    if len(fields) > len(names):
        raise TableError(
            f"{path}: line {number} has {len(fields)} fields, the first line names {len(names)}"
        )
    values = {name: field for name, field in zip(names, fields, strict=False) if field}
    return Row(path=path, line=number, values=values)


def _split(line: str, delimiter: str) -> list[str]:
    try:
        fields = next(csv.reader(StringIO(line), delimiter=delimiter))
    except csv.Error:
        fields = [line]
    return [field.strip() for field in fields]


def _text(path: Path) -> str:
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise TableError(f"{path}: there is no such file; check the path") from None
    except OSError as error:
        raise TableError(f"{path}: cannot be read ({error.strerror or error})") from None
    if len(content) > MAX_BYTES:
        raise TableError(f"{path}: too large for a table of measurements ({len(content)} bytes)")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise TableError(f"{path}: this is not text in UTF-8; {iconv(content, path)}") from None
