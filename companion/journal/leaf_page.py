"""One page of an SQLite file, read without SQLite: the rows of a leaf that nothing leads to.

After https://www.sqlite.org/fileformat2.html, sections 1.6 (pages of a tree, chains of overflow
pages) and 2.1 (records). Pure. A page may hold anything: what does not hold together is a
ValueError, or a row less.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass

Value = int | float | str | bytes | None

# The first byte of a leaf of a table.
_LEAF = 0x0D
_HEADER = struct.Struct(">BHHHB")
# No record of a journal has more columns; a header is not read further.
_COLUMNS_MAX = 32
# Bytes of a value by its serial type; of longer ones the type says it.
_WIDTHS = (0, 1, 2, 3, 4, 6, 8, 8, 0, 0)
_FLOAT, _ZERO, _ONE = 7, 8, 9
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
_NUMBER_MAX = 2**53
_GEOMETRY = b"GP"
_TYPES: dict[str, tuple[type, ...]] = {"i": (int,), "r": (int, float), "t": (str,), "b": (bytes,)}
Row = tuple[Value, ...]


@dataclass(frozen=True, slots=True)
class Cell:
    """A row as it lies in its leaf: what is in the page of it, and where it goes on.

    `types` are the serial types of its columns; `size` the bytes of the whole record, of which
    `head` are those of its header; `end` is where it ends in the page.
    """

    rowid: int
    end: int
    types: tuple[int, ...]
    head: int
    size: int
    local: bytes
    overflow_page: int | None


def varint(data: bytes, at: int) -> tuple[int, int]:
    """Return an integer of one to nine bytes, and where it ends; ValueError at the data's end.

    >>> varint(bytes([0x81, 0x00]), 0)
    (128, 2)
    """
    value = 0
    for place in range(8):
        if at + place >= len(data):
            raise ValueError("cut off")
        byte = data[at + place]
        value = value << 7 | byte & 0x7F
        if byte < 0x80:
            return value, at + place + 1
    if at + 8 >= len(data):
        raise ValueError("cut off")
    value = value << 8 | data[at + 8]
    return (value - (1 << 64) if value >> 63 else value), at + 9


def cells_of(page: bytes, usable: int) -> list[Cell]:
    """Return the rows of a leaf; a ValueError where the page is none.

    What of it is damaged is left out. The numbers of the rows grow, or it is none.
    """
    if len(page) < usable or page[0] != _LEAF:
        raise ValueError("no leaf of a table")
    _, _, count, start, _ = _HEADER.unpack_from(page)
    start = start or 65536
    if not count or not _HEADER.size + 2 * count <= start < usable:
        raise ValueError("no leaf of a table")
    cells: list[Cell] = []
    for at in struct.unpack_from(f">{count}H", page, _HEADER.size):
        if not start <= at < usable:
            raise ValueError("no leaf of a table")
        try:
            cell = _cell(page, at, usable)
        except ValueError:
            continue
        if cells and cell.rowid <= cells[-1].rowid:
            raise ValueError("the rows of a leaf are in no order")
        cells.append(cell)
    return cells


def _cell(page: bytes, at: int, usable: int) -> Cell:
    size, at = varint(page, at)
    rowid, at = varint(page, at)
    here = local_bytes(size, usable)
    end = at + here
    if size < 2 or end + (4 if here < size else 0) > usable:
        raise ValueError("a row reaches beyond its page")
    local = page[at:end]
    head, place = varint(local, 0)
    types: list[int] = []
    while place < head:
        kind, place = varint(local, place)
        types.append(kind)
        if len(types) > _COLUMNS_MAX:
            raise ValueError("no row of a journal")
    if place != head or head + sum(width(kind) for kind in types) != size:
        raise ValueError("a row is damaged")
    overflow_page = int.from_bytes(page[end : end + 4], "big") if here < size else None
    return Cell(rowid, end, tuple(types), head, size, local, overflow_page)


def local_bytes(size: int, usable: int) -> int:
    """Return how much of a record of that size lies in the leaf itself.

    >>> local_bytes(989, 1024), local_bytes(990, 1024), local_bytes(5000, 1024)
    (989, 103, 920)
    """
    most = usable - 35
    if size <= most:
        return size
    least = (usable - 12) * 32 // 255 - 23
    fitting = least + (size - least) % (usable - 4)
    return fitting if fitting <= most else least


def width(kind: int) -> int:
    """Return the bytes of a value; ValueError for a serial type that there is not."""
    if 0 <= kind < len(_WIDTHS):
        return _WIDTHS[kind]
    if kind < 12:
        raise ValueError("no type of a value")
    return (kind - 12) // 2


def values_of(cell: Cell, page_of: Callable[[int], bytes | None], usable: int) -> tuple[Value, ...]:
    """Return the values of a row; ValueError where a page that it goes on in is not there."""
    record = _whole(cell, page_of, usable)
    at, values = cell.head, []
    for kind in cell.types:
        end = at + width(kind)
        values.append(_value(kind, record[at:end]))
        at = end
    return tuple(values)


def _whole(cell: Cell, page_of: Callable[[int], bytes | None], usable: int) -> bytes:
    parts, missing, number = [cell.local], cell.size - len(cell.local), cell.overflow_page
    # Each page takes from what is missing: a chain that bites its own tail ends too.
    while missing > 0:
        page = page_of(number) if number else None
        if page is None or len(page) < usable:
            raise ValueError("a row goes on in a page that is not there")
        parts.append(page[4 : 4 + min(missing, usable - 4)])
        missing -= len(parts[-1])
        number = int.from_bytes(page[:4], "big")
        if (number == 0) != (missing == 0):
            raise ValueError("a chain of pages has not the length of its row")
    return b"".join(parts)


def _value(kind: int, data: bytes) -> Value:
    if kind >= 12:
        # UnicodeDecodeError is a ValueError: such a text is damaged.
        return data.decode("utf-8") if kind % 2 else data
    if kind == _FLOAT:
        (number,) = struct.unpack(">d", data)
        if number != number:
            raise ValueError("SQLite keeps no NaN")
        return float(number)
    if kind in (_ZERO, _ONE):
        return kind - _ZERO
    return int.from_bytes(data, "big", signed=True) if data else None


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
