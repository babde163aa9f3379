"""The attribute table of a shapefile, as columns of text and numbers."""

from __future__ import annotations

import codecs
import struct
import warnings
from io import BytesIO
from pathlib import Path

import shapefile

from companion.maps.layer import Column, Value, as_number, check_counts
from companion.maps.model import map_error

# What `pyshp` raises on bytes that are not what they claim (found by mutating real files).
BROKEN = (
    shapefile.ShapefileException,
    struct.error,
    ValueError,
    KeyError,
    IndexError,
    TypeError,
    OverflowError,
    AssertionError,
    OSError,
)
_HEADER_BYTES = 32
# Language driver, byte 29 of the header, where there is no .cpg (dBASE and Esri code pages).
_DRIVERS = {
    0x03: "cp1252", 0x57: "cp1252", 0x02: "cp850", 0x64: "cp852", 0xC8: "cp1250", 0xC9: "cp1251",
    0x13: "cp932", 0x7B: "cp932", 0x4D: "gbk", 0x7A: "gbk", 0x4E: "cp949", 0x79: "cp949",
    0x4F: "cp950", 0x78: "cp950",
}  # fmt: skip


def read_columns(
    dbf: bytes | None, cpg: bytes | None, *, path: Path, count: int
) -> tuple[Column, ...]:
    """Return the columns of all records, of which there have to be as many as shapes.

    Deleted records keep their place and are all blank.
    """
    if dbf is None:
        return ()
    try:
        rows, fields = _rows(dbf, cpg, path)
    except BROKEN as error:
        raise map_error(
            path.with_suffix(".dbf"),
            f"the attribute table is broken ({str(error)[:120]})",
            fix="export the map again",
        ) from None
    if len(rows) != count:
        raise map_error(
            path.with_suffix(".dbf"),
            f"the attribute table has {len(rows)} records for {count} shapes",
            fix="copy the whole set of files, or export the map again",
        )
    return tuple(
        _column(field, [None if row is None else row[index] for row in rows])
        for index, field in enumerate(fields)
    )


def encoding_of(dbf: bytes, cpg: bytes | None) -> str:
    """Return the encoding of the texts: by the .cpg, by the header, else UTF-8.

    >>> [encoding_of(bytes(32), cpg) for cpg in (b"GBK", b"65001", b"ANSI 1252", None)]
    ['gbk', 'utf-8', 'cp1252', 'utf-8']
    """
    said = (cpg or b"").decode("ascii", errors="ignore").strip().casefold().replace("ansi ", "cp")
    names = {"65001": "utf-8", "utf8": "utf-8", "88591": "latin-1", "936": "gbk"}
    for name in (names.get(said, said), f"cp{said}", _DRIVERS.get(dbf[29], "")):
        try:
            if name:
                return codecs.lookup(name).name
        except (LookupError, ValueError):
            continue
    return "utf-8"


def _rows(
    dbf: bytes, cpg: bytes | None, path: Path
) -> tuple[list[list[str] | None], list[shapefile.Field]]:
    """Return all records as text, None for a deleted one, and the columns' descriptions."""
    if len(dbf) < _HEADER_BYTES:
        raise ValueError("it is cut off in its header")
    records, header_bytes, record_bytes = struct.unpack("<xxxxLHH20x", dbf[:_HEADER_BYTES])
    check_counts(path, records=records, vertices=0)
    if not header_bytes + records * record_bytes <= len(dbf):
        raise ValueError(f"it is cut off: {records} records do not fit into {len(dbf)} bytes")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", shapefile.PossibleDataLoss)
        table = shapefile.Reader(
            dbf=BytesIO(dbf), encoding=encoding_of(dbf, cpg), encodingErrors="replace"
        ).dbf_reader
        fields = list(table.fields)
        if sum(field.size for field in fields) > record_bytes:
            raise ValueError("its columns are wider than its records")
        # Every cell as text: numbers are parsed here, so that a fraction in a column declared
        # without decimals is kept, and what is no number is not silently taken for blank.
        table.fields[:] = [field._replace(field_type=shapefile.FieldType.C) for field in fields]
        rows = [
            None if row is None else list(row)
            for row in (table.iterRecords(deleted_as_None=True) if records else ())
        ]
    return rows, fields[1:]


def _column(field: shapefile.Field, cells: list[str | None]) -> Column:
    numeric = field.field_type in (shapefile.FieldType.N, shapefile.FieldType.F)
    values = [_value(cell, numeric=numeric) for cell in cells]
    return Column(name=field.name.strip(), values=tuple(values), numeric=numeric)


def _value(cell: str | None, *, numeric: bool) -> Value:
    text = (cell or "").split("\0", 1)[0].strip()
    if not text or (numeric and not text.strip("*")):  # a number of stars is no number
        return None
    if not numeric:
        return text
    try:
        return as_number(text)
    except ValueError:
        return text
