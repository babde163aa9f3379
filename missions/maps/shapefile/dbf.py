"""The attribute table of a shapefile, as columns of text and numbers.

Read by hand, since three things matter here that a general reader decides otherwise: a fraction
in a column declared without decimals is kept, what is no number is not taken for blank, and the
encoding of texts is never guessed. Layout: dBASE III file header and field descriptors.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from missions.maps.layer import Column, Value, check_counts
from missions.maps.model import Problem, map_error
from missions.maps.shapefile.dbf_text import Texts

_HEADER_BYTES = 32
_END_OF_FIELDS = 0x0D
_DELETED = ord("*")
# Standing, deleted, and what a table has that was made of zeros first.
_FLAGS = (ord(" "), _DELETED, 0)
# Cells in all: more than a million records with a few columns, or 22 000 with the most there are.
_CELLS_MAX = 10_000_000
_NUMBER = re.compile(rb"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,3})?")
_NUMERIC, _TEXT = b"NF", b"CDLV"
# An empty date and an empty logical, beside blanks.
_EMPTY = {b"D": b"00000000", b"L": b"?"}


@dataclass(frozen=True, slots=True, kw_only=True)
class _Field:
    """One column as the header describes it; its name still in bytes."""

    name: bytes
    kind: bytes
    width: int
    at: int


def read_columns(
    dbf: bytes | None, cpg: bytes | None, *, path: Path, count: int
) -> tuple[tuple[Column, ...], tuple[Problem, ...]]:
    """Return the columns of all records, of which there have to be as many as shapes.

    Deleted records keep their place and are all blank. The problems are about the encoding.
    """
    if dbf is None:
        return (), ()
    table = path.with_suffix(".dbf")
    records, header_bytes, record_bytes = _header(dbf, table)
    if records != count:
        raise map_error(
            table,
            f"the attribute table has {records} records for {count} shapes",
            fix="copy the whole set of files, or export the map again",
            code="table-mismatch",
        )
    fields = _fields(dbf[:header_bytes], table)
    if sum(field.width for field in fields) >= record_bytes:
        raise _broken(table, "its columns are wider than its records")
    if records * len(fields) > _CELLS_MAX:
        text = f"{records} records of {len(fields)} columns are more than {_CELLS_MAX} cells"
        raise map_error(table, text, fix="keep the rate and its unit", code="too-large")
    body = np.frombuffer(dbf, np.uint8, records * record_bytes, header_bytes)
    rows = body.reshape(records, record_bytes)
    if not np.isin(rows[:, 0], _FLAGS).all():
        raise _broken(table, "its records do not stand where its header says")
    cells = [_cells(rows, field) for field in fields]
    texts = Texts(dbf[29], cpg)
    columns = tuple(_column(field, raw, texts) for field, raw in zip(fields, cells, strict=True))
    strays = _strays(dbf, header_bytes + records * record_bytes, record_bytes, table)
    return columns, (*strays, *texts.problems(table))


def _strays(dbf: bytes, end: int, record_bytes: int, table: Path) -> tuple[Problem, ...]:
    """Return a warning for whole rows behind the last that the header counts."""
    rest = dbf[end:]
    count = len(rest) // record_bytes
    flags = rest[: count * record_bytes : record_bytes]
    # What follows the last row is a mark, and zeros of the file system; a row begins with a flag.
    rows = next((number for number, flag in enumerate(flags) if flag not in _FLAGS[:2]), count)
    if not rows:
        return ()
    problem = Problem(
        severity="warning",
        code="stray-records",
        text=f"{rows} {'row' if rows == 1 else 'rows'} behind the last one that the header of the "
        "attribute table counts are left out",
        where=str(table),
        fix="compare the number of zones with that of the program that made the map, or export it "
        "again",
    )
    return (problem,)


def _header(dbf: bytes, table: Path) -> tuple[int, int, int]:
    """Return the number of records, and the bytes of the header and of each record."""
    if len(dbf) < _HEADER_BYTES:
        raise _broken(table, "it is cut off in its header")
    records, header_bytes, record_bytes = struct.unpack_from("<4xLHH", dbf)
    check_counts(table, records=records, vertices=0)
    if header_bytes <= _HEADER_BYTES or not record_bytes:
        raise _broken(table, f"its header has {header_bytes} bytes, its records {record_bytes}")
    if header_bytes + records * record_bytes > len(dbf):
        raise _broken(table, f"it is cut off: {records} records do not fit into {len(dbf)} bytes")
    return records, header_bytes, record_bytes


def _fields(header: bytes, table: Path) -> list[_Field]:
    """Return the columns; the descriptors end with a mark, or with the header."""
    fields: list[_Field] = []
    offset, at = _HEADER_BYTES, 1
    while offset < len(header) and header[offset] != _END_OF_FIELDS:
        if offset + 32 > len(header):
            raise _broken(table, "the list of its columns has no end")
        name, kind, width = struct.unpack_from("<11sc4xB", header, offset)
        fields.append(_Field(name=name.split(b"\0", 1)[0], kind=kind, width=width, at=at))
        offset, at = offset + 32, at + width
    if not fields:
        raise _broken(table, "it has no columns")
    return fields


def _cells(rows: np.ndarray[tuple[int, int], np.dtype[np.uint8]], field: _Field) -> list[bytes]:
    """Return one column's bytes, empty for deleted records."""
    if not field.width or not len(rows):
        return [b""] * len(rows)
    block = np.ascontiguousarray(rows[:, field.at : field.at + field.width])
    raw: list[bytes] = block.view(f"S{field.width}").ravel().tolist()
    for index in np.flatnonzero(rows[:, 0] == _DELETED).tolist():
        raw[index] = b""
    return raw


def _column(field: _Field, raw: Sequence[bytes], texts: Texts) -> Column:
    """Return the column; each different cell is understood once, as most repeat."""
    name = texts.name_of(field.name)
    numeric = field.kind in _NUMERIC
    cells = {one: one.split(b"\0", 1)[0].strip() for one in set(raw)}
    known: dict[bytes, Value]
    if numeric:
        known = {one: _number(text) for one, text in cells.items()}
    elif field.kind in _TEXT:
        empty = _EMPTY.get(field.kind, b"")
        known = {
            one: None
            if text in (b"", empty)
            else texts.text_of(text, name, full=len(text) == field.width)
            for one, text in cells.items()
        }
    else:
        # A number in binary, or a place in another file: kept apart from a blank, never a rate.
        kind = field.kind.decode("ascii", "replace")
        known = {one: f"(field of type {kind})" if text else None for one, text in cells.items()}
    return Column(name=name, values=tuple([known[one] for one in raw]), numeric=numeric)


def _number(text: bytes) -> Value:
    """Return a number, None for a blank or a row of stars, and as text what is neither."""
    if not text.strip(b"*") or text.lower() == b"nan":
        return None
    if _NUMBER.fullmatch(text):
        return float(text)
    return text.decode("ascii", "replace")


def _broken(table: Path, text: str) -> Exception:
    return map_error(
        table,
        f"the attribute table is broken: {text}",
        fix="copy the whole set of files, or export the map again",
        code="truncated",
    )
