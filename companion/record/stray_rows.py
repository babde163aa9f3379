"""Rows of a damaged journal in pages that nothing leads to any more.

A table is a tree; with a page of it that leads to others these are out of SQLite's reach, whole as
they are. A leaf does not say which table it is of: here the number and the types of its columns
do, and where more than one table fits, it is left out. Rows that are known come not again, and
none whose values no flight has.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence

from companion.record.kept_pages import KeptPages
from companion.record.leaf_page import Cell, Value, cells_of, values_of

# A letter a column: k the row's number (which is not in the record), i integer, r number, t text,
# b bytes; a capital: never empty. As in `geopackage.SCHEMA`; other versions have other columns.
COLUMNS = {
    "applied": "kbtrrrrrrrrrtt",
    "zones": "kBtr",
    "field": "kB",
    "cells": "kIIBBT",
    "blocks": "kIIrriIBIB",
    "block_dictionaries": "kB",
    "valve_changes": "kiiII",
    "link_stats": "kRiiiiiiirrrrrr",
    "events": "ktrTT",
    "coverage_tiles": "kTIIB",
    "meta": "kTt",
}
# Columns with a time of the companion's clock, in seconds; in microseconds.
_TIMES_S = {"applied": (3,), "blocks": (3, 4), "link_stats": (1,), "events": (2,)}
_TIMES_US = {"valve_changes": (1, 2)}
# All of a flight is nearer than this to its middle.
_LONGEST_S = 86_400.0
_NUMBER_MAX = 2**53
_GEOMETRY = b"GP"
_TYPES: dict[str, tuple[type, ...]] = {"i": (int,), "r": (int, float), "t": (str,), "b": (bytes,)}

Row = tuple[Value, ...]
Found = tuple[str, Row]


def stray_rows(pages: KeptPages, known: Mapping[str, set[int]]) -> list[Found]:
    """Return table and row of what is not in `known`, the numbers of rows; it grows by these.

    Only of the tables in `known`, and none whose time is far from that of the others.
    """
    found = list(_found(pages, known))
    times_s = sorted(at_s for table, row in found for at_s in _times_s(table, row))
    middle_s = times_s[len(times_s) // 2] if times_s else 0.0
    return [
        (table, row)
        for table, row in found
        if all(abs(at_s - middle_s) <= _LONGEST_S for at_s in _times_s(table, row))
    ]


def torn_rows(pages: KeptPages) -> set[tuple[object, object]]:
    """Return the tables and numbers of rows that a cut of the file went through."""
    page, kept_bytes = pages.torn()
    try:
        cells = cells_of(page, pages.usable)
    except ValueError:
        return set()
    torn = [cell for cell in cells if cell.end > kept_bytes]
    return {(table, cell.rowid) for table in tables_of(cells) for cell in torn}


def _found(pages: KeptPages, known: Mapping[str, set[int]]) -> Iterator[Found]:
    once = _once(pages)
    for page in pages.used():
        try:
            cells = cells_of(page, pages.usable)
        except ValueError:
            continue
        fitting = tables_of(cells)
        for cell in cells if fitting & known.keys() else ():
            if len(fitting) == 1 and cell.rowid in known[min(fitting)]:
                continue
            try:
                row = (cell.rowid, *values_of(cell, once, pages.usable)[1:])
            except ValueError:
                continue
            tables = [table for table in fitting if is_of(table, row)]
            if len(tables) == 1 and cell.rowid not in known.get(tables[0], {cell.rowid}):
                known[tables[0]].add(cell.rowid)
                yield tables[0], row


def _once(pages: KeptPages) -> Callable[[int], bytes | None]:
    """Return a way to the pages that gives each once.

    A page belongs to one row: so chains that bite their own tails, or that thousands of rows claim,
    cost no more than the file has pages.
    """
    given: set[int] = set()

    def page(number: int) -> bytes | None:
        if number in given:
            return None
        given.add(number)
        return pages.page(number)

    return page


def tables_of(cells: Sequence[Cell]) -> set[str]:
    """Return the tables that a leaf may be of: those that all rows fit that fit any at all."""
    fitting: set[str] | None = None
    for cell in cells:
        tables = {table for table, columns in COLUMNS.items() if fits(cell.types, columns)}
        if tables:
            fitting = tables if fitting is None else fitting & tables
    return fitting or set()


def fits(types: Sequence[int], columns: str) -> bool:
    """Return whether values of these serial types can stand in such columns.

    >>> fits((0, 6, 0, 8, 2), "kiiII"), fits((0, 6, 0, 8, 0), "kiiII"), fits((0, 19, 7), "kTt")
    (True, False, False)
    """
    return len(types) == len(columns) and all(map(_fits, types, columns))


def _fits(kind: int, column: str) -> bool:
    if kind == 0:
        return column.islower()
    letter = column.lower()
    if kind >= 12:
        return letter == ("t" if kind % 2 else "b")
    # A number without a fraction is kept as an integer.
    return letter == "r" or (letter == "i" and kind != 7)


def is_of(table: str, row: Row) -> bool:
    """Return whether a row may be of this table: columns, types, values that no other row has."""
    columns = COLUMNS[table]
    if len(row) != len(columns) or not all(map(_is_value, row, columns)):
        return False
    check = _CHECKS.get(table)
    return check is None or check(row)


def _is_value(value: Value, column: str) -> bool:
    if value is None:
        return column.islower() and column != "k"
    letter = column.lower()
    if letter == "k":
        return _in(value, 1, _NUMBER_MAX)
    return isinstance(value, _TYPES[letter])


def _times_s(table: str, row: Row) -> Iterator[float]:
    """Yield the times of a row, in seconds of the companion's clock."""
    for columns, per_second in ((_TIMES_S, 1.0), (_TIMES_US, 1e6)):
        for column in columns.get(table, ()):
            value = row[column]
            if isinstance(value, int | float):
                yield value / per_second


def _is_change(values: Row) -> bool:
    return _in(values[3], 0, 255) and _in(values[4], 0, 1000)


def _is_block(values: Row) -> bool:
    return _in(values[1], values[0], _NUMBER_MAX) and _in(values[2], 1, _NUMBER_MAX)


def _is_tile(values: Row) -> bool:
    return values[1] in ("before", "flight")


def _is_geometry(values: Row) -> bool:
    return isinstance(values[1], bytes) and values[1].startswith(_GEOMETRY)


def _is_dictionary(values: Row) -> bool:
    return not _is_geometry(values)


def _is_place(values: Row) -> bool:
    return values[1] is None or _is_geometry(values)


def _in(value: Value, least: Value, most: Value) -> bool:
    whole = [each for each in (least, value, most) if isinstance(each, int)]
    return len(whole) == 3 and whole == sorted(whole)


_CHECKS: dict[str, Callable[[Row], bool]] = {
    "applied": _is_place,
    "zones": _is_geometry,
    "field": _is_geometry,
    "blocks": _is_block,
    "block_dictionaries": _is_dictionary,
    "valve_changes": _is_change,
    "coverage_tiles": _is_tile,
}
