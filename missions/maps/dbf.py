"""The attribute table of a shapefile, as columns of text and numbers.

Read by hand, since three things matter here that a general reader decides otherwise: a fraction
in a column declared without decimals is kept, what is no number is not taken for blank, and the
encoding of texts is never guessed. Layout: dBASE III file header and field descriptors.
"""

from __future__ import annotations

import codecs
import re
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from companion.wording import counted
from missions.maps.bundle import Bundle, files_beside, one_of, open_bundle
from missions.maps.model import Column, Problem, Value, check_counts, digest, map_error

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
) -> tuple[tuple[Column, ...], list[int], tuple[Problem, ...]]:
    """Return the columns of all records that stand, which they are, and what to tell.

    There have to be as many records as shapes. A program that deletes one marks it and leaves its
    shape lying: it is no ground any more, to GDAL neither.
    """
    if dbf is None:
        return (), list(range(count)), ()
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
    stands = np.flatnonzero(rows[:, 0] != _DELETED).tolist()
    rows = rows[stands]
    cells = [_cells(rows, field) for field in fields]
    texts = Texts(dbf[29], cpg)
    columns = tuple(_column(field, raw, texts) for field, raw in zip(fields, cells, strict=True))
    behind = _behind(dbf[header_bytes + records * record_bytes :], record_bytes)
    rows_of = "behind the last one that the header of the attribute table counts"
    deleted = records - len(stands)
    strays = _stray(behind, f"{counted(behind, 'row')} {rows_of}", table)
    strays += _stray(deleted, counted(deleted, "deleted record"), table)
    return columns, stands, (*strays, *texts.problems(table))


def _behind(rest: bytes, record_bytes: int) -> int:
    """Return how many whole rows follow the last that the header counts."""
    count = len(rest) // record_bytes
    flags = rest[: count * record_bytes : record_bytes]
    # What follows the last row is a mark, and zeros of the file system; a row begins with a flag.
    return next((number for number, flag in enumerate(flags) if flag not in _FLAGS[:2]), count)


def _stray(count: int, what: str, table: Path) -> tuple[Problem, ...]:
    if not count:
        return ()
    problem = Problem(
        severity="warning",
        code="stray-records",
        text=f"{what} {'is' if count == 1 else 'are'} left out",
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
    """Return one column's bytes."""
    if not field.width or not len(rows):
        return [b""] * len(rows)
    block = np.ascontiguousarray(rows[:, field.at : field.at + field.width])
    raw: list[bytes] = block.view(f"S{field.width}").ravel().tolist()
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


# In which encoding the texts of an attribute table are.
#
# The `.cpg` beside it says so, else a byte of the header; else the texts have to be UTF-8, or stay
# unread letter for letter. No number depends on it, and nothing is guessed from how a text looks.

# Language driver, byte 29 of the header, where there is no .cpg (dBASE and Esri code pages).
_DRIVERS = {
    0x01: "cp437", 0x02: "cp850", 0x03: "cp1252", 0x13: "cp932", 0x26: "cp866", 0x4D: "gbk",
    0x4E: "cp949", 0x4F: "cp950", 0x57: "cp1252", 0x58: "cp1252", 0x59: "cp1252", 0x64: "cp852",
    0x65: "cp866", 0x6A: "cp737", 0x6B: "cp857", 0x78: "cp950", 0x79: "cp949", 0x7A: "gbk",
    0x7B: "cp932", 0x7C: "cp874", 0x7D: "cp1255", 0x7E: "cp1256", 0xC8: "cp1250", 0xC9: "cp1251",
    0xCA: "cp1254", 0xCB: "cp1253", 0xCC: "cp1257",
}  # fmt: skip
# Encodings of text, each byte below 128 as in ASCII; Python knows others of the same shape of
# name which are compressions, or read escapes.
_FAMILIES = (
    "ascii", "utf-8", "cp", "iso8859", "gb", "big5", "euc_", "johab", "shift_jis", "koi8", "mac-",
)  # fmt: skip
_NUMBERS = {"65001": "utf-8", "20127": "ascii", "936": "gbk", "54936": "gb18030"}
_NAME_BYTES = 10
# Columns are so many bytes wide, not letters, and the last letter may be cut in two: what
# Python's codecs call that.
_CUT = ("unexpected end of data", "incomplete multibyte sequence")


def encoding_of(driver: int, cpg: bytes | None) -> str | None:
    """Return the encoding that a table declares, by its .cpg or its header, or None.

    >>> [encoding_of(0, cpg) for cpg in (b"GBK", b"65001", b"ANSI 1252", b"88591", b"Big5")]
    ['gbk', 'utf-8', 'cp1252', 'iso8859-1', 'big5']
    >>> encoding_of(0x4E, None), encoding_of(0, None), encoding_of(0, b"rot13")
    ('cp949', None, None)
    """
    return _named((cpg or b"")[:40]) or _DRIVERS.get(driver)


def _named(cpg: bytes) -> str | None:
    """Return Python's name of an encoding that is known; `OEM 866` and `ISO 88591` are usual."""
    said = cpg.decode("ascii", errors="ignore").strip().casefold()
    digits = said.removeprefix("ansi").removeprefix("oem").removeprefix("iso").strip(" -_")
    latin = digits.removeprefix("8859").strip("-_ ")
    for name in (
        _NUMBERS.get(digits),
        f"iso8859-{latin}" if digits.startswith("8859") and latin.isdigit() else None,
        f"cp{digits}" if digits.isdigit() else None,
        said,
    ):
        try:
            found = codecs.lookup(name).name if name else ""
            if found.startswith(_FAMILIES) and b"A1".decode(found) == "A1":
                return found
        except (LookupError, ValueError):
            continue
    return None


class Texts:
    """Reads the texts of one table, and keeps in which columns that failed."""

    def __init__(self, driver: int, cpg: bytes | None) -> None:
        self._declared = encoding_of(driver, cpg)
        self._unknown_cpg = (cpg or b"").strip() if _named((cpg or b"")[:40]) is None else b""
        self._wrong: dict[str, None] = {}

    def name_of(self, raw: bytes) -> str:
        """Return a column's name."""
        name, right = self._read(raw.strip(), full=len(raw) >= _NAME_BYTES)
        if not right:
            self._wrong[name] = None
        return name

    def text_of(self, raw: bytes, column: str, *, full: bool) -> str:
        """Return a cell's text; `full`: it fills the width of its column."""
        text, right = self._read(raw, full=full)
        if not right:
            self._wrong[column] = None
        return text

    def _read(self, raw: bytes, *, full: bool) -> tuple[str, bool]:
        """Return a text, and whether its bytes are as declared (as UTF-8, if nothing is)."""
        encoding = self._declared or "utf-8"
        try:
            return raw.decode(encoding), True
        except UnicodeDecodeError as error:
            if full and error.reason in _CUT:
                whole = raw[: error.start]
                right = self._declared is not None or not whole.isascii()
                return whole.decode(encoding).rstrip(), right
        if self._declared is None:
            return raw.decode("latin-1"), False
        return raw.decode(encoding, "replace"), False

    def problems(self, table: Path) -> tuple[Problem, ...]:
        """Return what to tell about the encoding, at most one thing."""
        if not self._wrong:
            return ()
        if self._declared is None:
            unknown = self._unknown_cpg.decode("ascii", "replace")[:40]
            text = (
                f"its .cpg says {unknown!r}, which is not a known encoding"
                if unknown
                else "no .cpg and no code page says in which encoding its texts are"
            )
        else:
            text = f"its texts are not all in {self._declared}, which the file declares"
        columns = list(self._wrong)
        return (
            Problem(
                severity="warning",
                code="encoding",
                text=f"{text}; letters of {len(columns)} columns are not read right "
                "(numbers do not depend on it)",
                where=f"{table.name}: {', '.join(columns[:5])}"
                + (" …" if len(columns) > 5 else ""),
                fix="put a .cpg file beside it that names the encoding, such as UTF-8, GBK, "
                "CP949, CP932 or 1252",
            ),
        )


# Which files make up the shapefile that is meant, beside a `.shp`, in a folder or in a zip.

_SUFFIXES = (".cpg", ".dbf", ".prj", ".shp", ".shx")
# John Deere puts prescriptions into this folder, whatever else the archive holds.
_RX = "rx"
# What John Deere, and others after them, call the file that says the units of the columns.
_METADATA = ("-deere-metadata.json", "-metadata.json")


@dataclass(frozen=True, slots=True, kw_only=True)
class ShapeFiles:
    """The files of one shapefile; `main` is the `.shp`, inside the zip where it is in one."""

    main: Path
    content: dict[str, bytes]
    metadata: bytes | None = None

    @property
    def sha256(self) -> str:
        """Return the digest of all files: in the order of their suffixes, the metadata last."""
        content = [self.content[suffix] for suffix in sorted(self.content)]
        return digest([*content, self.metadata or b""])


def find_shapefile(path: Path, layer: str | None) -> ShapeFiles:
    """Return the files of the shapefile that `path`, and `layer` among several, mean."""
    if path.suffix.casefold() == ".shp" and not path.is_dir():
        if layer not in (None, path.stem):
            raise map_error(
                path, f"it is not the layer {layer!r}", fix="leave out --layer", code="no-layer"
            )
        bundle, main = files_beside(path), path.name
    else:
        bundle = open_bundle(path)
        main = _meant(bundle, layer)
    names = _names_of_set(bundle, main)
    metadata = names.pop("metadata", None)
    content = {suffix: bundle.read(name) for suffix, name in names.items()}
    return ShapeFiles(
        main=bundle.path / main,
        content=content,
        metadata=bundle.read(metadata) if metadata is not None else None,
    )


def _meant(bundle: Bundle, layer: str | None) -> str:
    """Return the name of the `.shp` that is meant.

    Several are never chosen from. Those in folders deeper than others are not in the way (a
    boundary beside the map, in a folder of its own), but for the folder `Rx`, which is named
    after prescriptions.
    """
    found = bundle.with_suffix(".shp")
    if layer is None and found:
        least = min(map(_depth, found))
        found = [name for name in found if _depth(name) == least or _in_rx(name)]
    return one_of(bundle, found, layer, kind=".shp")


def _depth(name: str) -> int:
    return len(PurePosixPath(name).parts)


def _in_rx(name: str) -> bool:
    return any(part.casefold() == _RX for part in PurePosixPath(name).parts[:-1])


def _names_of_set(bundle: Bundle, main: str) -> dict[str, str]:
    """Return the names of the shapefile's files by suffix, in any case, and of its metadata."""
    place = PurePosixPath(main)
    beside = [name for name in bundle.files if PurePosixPath(name).parent == place.parent]
    found = {".shp": main}
    for suffix in _SUFFIXES:
        name = _one(bundle, place.stem, suffix, beside)
        if name is not None and suffix != ".shp":
            found[suffix] = name
    for ending in reversed(_METADATA):
        name = _one(bundle, place.stem, ending, beside)
        if name is not None:
            found["metadata"] = name
    return found


def _one(bundle: Bundle, stem: str, ending: str, beside: Iterable[str]) -> str | None:
    """Return the file with this stem and ending; the stem in another case if there is no other."""
    wanted = f"{stem}{ending}"
    alike = [name for name in beside if PurePosixPath(name).name.casefold() == wanted.casefold()]
    own = [name for name in alike if PurePosixPath(name).name[: len(stem)] == stem]
    found = own or alike
    if len(found) > 1 and ending != ".shp":
        raise map_error(
            bundle.path,
            f"{found[0]} and {found[1]} could both belong to {stem}.shp",
            fix="remove the one that does not",
            code="several-files",
        )
    return found[0] if found else None
