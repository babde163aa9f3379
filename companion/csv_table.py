"""Tables for spreadsheets: the one place where CSV is made, so that no cell is run as a formula."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Mapping, Sequence
from io import StringIO

# What spreadsheets take for the beginning of a formula; a plain number is none.
_FORMULA = re.compile(r"\s*[=+\-@＝＋－＠]|[\t\n]")  # noqa: RUF001 - the wide forms are meant
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)


def cell(value: object) -> object:
    """Return a value as it may stand in a cell: text that would be a formula begins with '.

    >>> cell("=HYPERLINK(A1)"), cell("-1.5"), cell(-1.5), cell("left - 2"), cell("@home")
    ("'=HYPERLINK(A1)", '-1.5', -1.5, 'left - 2', "'@home")
    """
    if not isinstance(value, str):
        return value
    text = value.replace("\r", "\n")  # by itself nobody quotes it, and it ends a row
    return f"'{text}" if _FORMULA.match(text) and not _NUMBER.fullmatch(text) else text


def csv_text(rows: Iterable[Sequence[object]]) -> str:
    """Return rows, the first of them the names of the columns."""
    text = StringIO()
    csv.writer(text, lineterminator="\n").writerows(map(cell, row) for row in rows)
    return text.getvalue()


def csv_of(rows: Sequence[Mapping[str, object]]) -> str:
    """Return a table with the columns of all rows; what a row does not have is blank.

    >>> csv_of([{"a": 1, "b": "x"}, {"c": "+1"}]).split()
    ['a,b,c', '1,x,', ',,+1']
    """
    names = list(dict.fromkeys(name for row in rows for name in row))
    return csv_text([names, *([row.get(name, "") for name in names] for row in rows)])
