"""Text in columns with a header: what the delimiter is, which lines are whole, what is a number.

A decimal comma is refused, never read: `1,500` is fifteen hundred to one program and one and a
half to another.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from missions.maps.fields import NONE, score
from missions.maps.layer import MAX_FILE_BYTES, MAX_RECORDS, Column, cut_off
from missions.maps.model import Floats, map_error

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

DELIMITERS = (",", ";", "\t")
MAX_COLUMNS = 255
MAX_FIELDS = 10_000_000
_TURNED_ROWS = 10_000
_BLANK = frozenset(("", "na", "n/a", "nan", "null", "none"))
_PLAIN = re.compile(r"[0-9eE+.\s-]*", re.ASCII)
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d{1,3})?", re.ASCII)
_COMMA = re.compile(r"[+-]?\d+,\d+", re.ASCII)
_AS_CSV = "save it as CSV in UTF-8, with a point in its numbers"


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """The columns of a file in its order, as text, and the line that each row ends on."""

    path: Path
    columns: dict[str, tuple[str, ...]]
    lines: tuple[int, ...]

    def numbers(self, name: str) -> Floats | None:
        """Return a column of numbers, NaN for blanks; None for text and for nothing at all.

        A column that is called like a rate may not have a single cell of text among its numbers:
        it would be left aside as a whole.
        """
        found = self._numbers(name)
        if found is None and score(Column(name=name, values=(), numeric=True)) != NONE:
            self.refuse_bad_cell(name)
        if found is not None and np.isinf(found).any():
            index = int(np.argmax(np.isinf(found)))
            raise map_error(
                self.path,
                f"line {self.lines[index]}: {name} is {self.columns[name][index][:40]!r}, "
                "beyond all numbers",
                fix="correct it, or leave it blank",
                code="bad-number",
            )
        return found

    def first_text(self, name: str) -> int:
        """Return the row of the first cell that is no number, 0 where all are."""
        values = self.columns[name]
        return next((i for i, one in enumerate(values) if not _NUMBER.fullmatch(one.strip())), 0)

    def refuse_bad_cell(self, name: str) -> None:
        """Refuse a column most of whose cells are numbers, and name the first that is none."""
        tidy = [value.strip() for value in self.columns[name]]
        full = [index for index, value in enumerate(tidy) if value.casefold() not in _BLANK]
        bad = [index for index in full if _NUMBER.fullmatch(tidy[index]) is None]
        if not bad or 2 * len(bad) >= len(full):
            return
        raise map_error(
            self.path,
            f"line {self.lines[bad[0]]}: {name} is {tidy[bad[0]][:40]!r}, which is no number",
            fix="write a number like 12.5, or leave it blank",
            code="bad-number",
        )

    def _numbers(self, name: str) -> Floats | None:
        values = self.columns[name]
        if _PLAIN.fullmatch("".join(values)) is not None:
            try:
                # Not an array of text: one long cell would make all of them as wide as itself.
                return np.fromiter(map(float, values), dtype=np.float64, count=len(values))
            except ValueError:
                pass  # a blank, or no number after all
        tidy = [value.strip() for value in values]
        full = [value for value in tidy if value.casefold() not in _BLANK]
        if not full:
            return None
        if all(_NUMBER.fullmatch(value) for value in full):
            return np.array(
                [np.nan if value.casefold() in _BLANK else float(value) for value in tidy]
            )
        self._refuse_commas(name, tidy, full)
        return None

    def _refuse_commas(self, name: str, tidy: Sequence[str], full: Sequence[str]) -> None:
        if not all(_NUMBER.fullmatch(value) or _COMMA.fullmatch(value) for value in full):
            return
        index = next(index for index, value in enumerate(tidy) if _COMMA.fullmatch(value))
        raise map_error(
            self.path,
            f"line {self.lines[index]}: {name} is {tidy[index][:40]!r}, with a decimal comma",
            fix=_AS_CSV,
            code="decimal-comma",
        )


def read_table(content: bytes, path: Path, *, wanted: Callable[[Sequence[str]], bool]) -> Table:
    """Return the table in a file, whose delimiter is the one that gives the columns `wanted`."""
    text = _text(content, path)
    with _large_fields():
        try:
            table = _table(text, path, _delimiter(text, path, wanted))
        except csv.Error as error:
            raise map_error(
                path,
                f"this is no whole CSV file ({str(error)[:80]})",
                fix=_AS_CSV,
                code="truncated",
            ) from None
    _check_end(text, table)
    return table


def _check_end(text: str, table: Table) -> None:
    """Refuse a last line without an end, unless its last field shows that it is whole.

    A quotation mark closes a field, and a text is no rate. A number and a blank may be what is
    left of a longer number.
    """
    last = [values[-1] for values in table.columns.values()][-1].strip()
    if text.endswith('"') or not (last.casefold() in _BLANK or _NUMBER.fullmatch(last)):
        return
    if not text.endswith(("\n", "\r")):
        raise cut_off(table.path, table.lines[-1], last)


@contextmanager
def _large_fields() -> Iterator[None]:
    """Let a field be as long as a file: the text of a polygon can have thousands of corners."""
    before = csv.field_size_limit(MAX_FILE_BYTES)
    try:
        yield
    finally:
        csv.field_size_limit(before)


def _text(content: bytes, path: Path) -> str:
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = "\0"
    if "\0" in text:
        raise map_error(path, "this is no text in UTF-8", fix=_AS_CSV, code="encoding")
    return text


def _delimiter(text: str, path: Path, wanted: Callable[[Sequence[str]], bool]) -> str:
    headers = {delimiter: _header(text, delimiter) for delimiter in DELIMITERS}
    found = [delimiter for delimiter, names in headers.items() if wanted(names)]
    if found:
        return max(found, key=lambda delimiter: len(headers[delimiter]))
    names = max(headers.values(), key=len)
    shown = ", ".join(names)[:80]
    headless = bool(names) and all(_NUMBER.fullmatch(name) for name in names)
    raise map_error(
        path,
        "the file is empty"
        if not any(names)
        else f"its first line ({shown}) is no header"
        if headless
        else f"no columns say where the rates belong; its columns are {shown}",
        fix="name the columns in the first line: lat and lon, or easting and northing, or wkt",
        code="no-coordinates",
    )


def _header(text: str, delimiter: str) -> list[str]:
    try:
        return tidy_names(next(csv.reader(StringIO(text, newline=""), delimiter=delimiter), []))
    except csv.Error:
        return []


def tidy_names(names: Sequence[str]) -> list[str]:
    """Return the names of columns without the blanks around them."""
    return [" ".join(name.split()) for name in names]


def _table(text: str, path: Path, delimiter: str) -> Table:
    reader = csv.reader(StringIO(text, newline=""), delimiter=delimiter, strict=True)
    names = tidy_names(next(reader))
    names = [name or f"column {number}" for number, name in enumerate(names, 1)]
    _check_names(names, path)
    columns: list[list[str]] = [[] for _ in names]
    rows: list[list[str]] = []
    lines: list[int] = []
    for row in reader:
        if not any(row):
            continue
        if len(row) != len(names):
            raise map_error(
                path,
                f"line {reader.line_num} has {len(row)} fields, the header {len(names)}",
                fix=_AS_CSV,
                code="bad-line",
            )
        if not (len(lines) < MAX_RECORDS and len(lines) * len(names) < MAX_FIELDS):
            raise map_error(
                path,
                f"more than {min(MAX_RECORDS, MAX_FIELDS // len(names))} rows",
                fix="cut the map to one field, and keep the rate and its place",
                code="too-large",
            )
        rows.append(row)
        lines.append(reader.line_num)
        if len(rows) == _TURNED_ROWS:
            _turn(rows, columns)
    if not lines:
        raise map_error(path, "there are no rows", fix="export the map again", code="truncated")
    _turn(rows, columns)
    return Table(
        path=path, columns=dict(zip(names, map(tuple, columns), strict=True)), lines=tuple(lines)
    )


def _turn(rows: list[list[str]], columns: list[list[str]]) -> None:
    """Move rows to the columns; a million lists at once would keep the collector busy."""
    for column, values in zip(columns, zip(*rows, strict=True), strict=False):
        column.extend(values)
    rows.clear()


def _check_names(names: Sequence[str], path: Path) -> None:
    if not len(names) <= MAX_COLUMNS:
        text = f"{len(names)} columns are more than {MAX_COLUMNS}"
        raise map_error(path, text, fix="keep the rate and its place", code="too-large")
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise map_error(
            path,
            f"the column {twice[:40]} is there {names.count(twice)} times",
            fix="give every column a name of its own",
            code="duplicate-column",
        )
