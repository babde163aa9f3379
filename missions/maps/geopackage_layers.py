"""Which layers a GeoPackage has, and which one is the map."""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from itertools import accumulate, chain
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import GeometryType
from shapely.errors import ShapelyError
from shapely.geometry.base import BaseGeometry

from companion.wording import typed
from missions.maps.fields import column_of
from missions.maps.local import Area, as_area
from missions.maps.model import Value, check_coordinates, check_counts, map_error
from missions.maps.outlines import BOUNDARY_NAME

# Declared types that can hold no polygon; GEOMETRY and the others can.
_NO_GROUND = frozenset({"POINT", "MULTIPOINT", "LINESTRING", "MULTILINESTRING"})
_NUMERIC = frozenset(
    {
        "TINYINT", "SMALLINT", "MEDIUMINT", "INT", "INTEGER", "BIGINT", "FLOAT", "DOUBLE",
        "DOUBLE PRECISION", "REAL", "NUMERIC", "DECIMAL",
    }
)  # fmt: skip
_LAYERS_MAX = 200
_COLUMNS_MAX = 255  # as many as a shapefile can have
# A million records of ten columns, or 40 000 of 250.
_CELLS_MAX = 10_000_000
_EXPORT_AGAIN = "export the map again"


@dataclass(frozen=True, slots=True, kw_only=True)
class LayerTable:
    """A layer as the GeoPackage's own tables describe it; `columns` without the geometry."""

    name: str
    geometry: str
    kind: str
    srs_id: int
    is_view: bool
    columns: tuple[tuple[str, str, bool], ...] = ()


def layers_of(database: Database) -> list[LayerTable]:
    """Return the layers of polygons that the GeoPackage lists, views among them."""
    path = database.path
    for needed in ("gpkg_contents", "gpkg_geometry_columns", "gpkg_spatial_ref_sys"):
        if needed in database.tables:
            database.check(needed)
        elif needed == "gpkg_contents":
            raise map_error(
                path,
                "this is an SQLite database, but no GeoPackage",
                fix=_EXPORT_AGAIN,
                code="unknown-format",
            )
    listed = [
        str(name)
        for name, kind in database.rows("SELECT table_name, data_type FROM gpkg_contents")
        if str(kind).casefold() == "features"
    ]
    if not listed or "gpkg_geometry_columns" not in database.tables:
        raise map_error(
            path,
            "the GeoPackage holds no layer of polygons (pictures and plain tables at most)",
            fix="export the zones as polygons",
            code="no-polygon",
        )
    if len(listed) > _LAYERS_MAX:
        raise map_error(
            path,
            f"{len(listed)} layers are more than {_LAYERS_MAX}",
            fix="export the map alone",
            code="too-large",
        )
    return [_described(database, name) for name in listed]


def _described(database: Database, name: str) -> LayerTable:
    found = [
        (str(geometry), str(kind).upper(), srs_id if isinstance(srs_id, int) else None)
        for table, geometry, kind, srs_id in database.rows(
            "SELECT table_name, column_name, geometry_type_name, srs_id FROM gpkg_geometry_columns"
        )
        if str(table).casefold() == name.casefold()
    ]
    geometry, kind, srs_id = found[0] if len(found) == 1 else ("", "", None)
    if srs_id is None:
        raise _damaged(database, f"it does not say where the geometry of the layer {name} is")
    real = database.tables.get(name.casefold())
    table = LayerTable(
        name=real or name, geometry=geometry, kind=kind, srs_id=srs_id, is_view=real is None
    )
    if real is None:
        return table
    columns = database.columns(real)
    if len(columns) > _COLUMNS_MAX:
        raise map_error(
            database.path,
            f"{len(columns)} columns of the layer {real} are more than {_COLUMNS_MAX}",
            fix="keep the rate and its unit",
            code="too-large",
        )
    own = next((one for one, _, _ in columns if one.casefold() == geometry.casefold()), None)
    if own is None:
        raise _damaged(database, f"the layer {real} has no column {geometry}")
    rest = tuple(column for column in columns if column[0] != own)
    return replace(table, geometry=own, columns=rest)


def chosen_layer(database: Database, tables: Sequence[LayerTable], layer: str | None) -> LayerTable:
    """Return the layer that is meant: asked for, the only one, or the only one with numbers."""
    if layer is not None:
        candidates = [one for one in tables if one.name.casefold() == layer.casefold()]
    else:
        candidates = [one for one in tables if one.kind not in _NO_GROUND] or list(tables)
        if len(candidates) > 1:
            candidates = [one for one in candidates if _may_hold_rates(database, one)] or candidates
    if len(candidates) != 1:
        names = typed(one.name for one in (candidates or tables)[:20])
        raise map_error(
            database.path,
            f"there is no layer {layer!r}; the layers are {names}"
            if layer is not None
            else f"it holds several layers: {names}",
            fix="name one of them with --layer",
            code="several-layers" if layer is None else "no-layer",
        )
    if candidates[0].is_view:
        raise not_a_table(
            database.path,
            f"the layer {candidates[0].name} is a view or missing, not a table of its own",
        )
    return candidates[0]


def _may_hold_rates(database: Database, table: LayerTable) -> bool:
    """Tell whether a layer has numbers beside its key; of a view nobody knows."""
    if table.is_view or any(is_numeric(kind) and not key for _, kind, key in table.columns):
        return True
    return any(
        column_of(name, values).numeric
        for name, kind, key in table.columns
        if not key and kind.upper() != "BOOLEAN"
        for values in [_column_values(database, table, name)]
    )


def _column_values(database: Database, table: LayerTable, name: str) -> list[Value]:
    check_size(database, table)
    sql = f"SELECT {quoted(name)} FROM {quoted(table.name)}"
    return [value_of(cell, "") for (cell,) in database.rows(sql)]


def is_numeric(kind: str) -> bool:
    """Tell whether a declared type is one of numbers.

    >>> is_numeric("double"), is_numeric("DECIMAL(8, 2)"), is_numeric("TEXT(20)")
    (True, True, False)
    """
    return kind.split("(")[0].strip().upper() in _NUMERIC


def value_of(cell: Cell, kind: str) -> Value:
    """Return a cell of a column of the declared type `kind`; true and false are no numbers."""
    if cell is None or isinstance(cell, str):
        return cell
    if isinstance(cell, bytes):
        return "(blob)"
    if kind.upper() == "BOOLEAN":
        return "true" if cell else "false"
    return float(cell)


def is_outline(database: Database, table: LayerTable, chosen: LayerTable) -> bool:
    """Tell whether a layer is the outline of the field: called so, and without numbers."""
    return (
        table is not chosen
        and not table.is_view
        and table.name.casefold() == BOUNDARY_NAME
        and not _may_hold_rates(database, table)
    )


def check_size(database: Database, table: LayerTable) -> None:
    """Refuse a damaged table, and one that would take the vehicle's memory."""
    database.check(table.name)
    sql = f"SELECT count(*) FROM {quoted(table.name)}"
    count = int(next(database.rows(sql))[0] or 0)
    check_counts(database.path, records=count, vertices=0)
    if count * (len(table.columns) + 1) > _CELLS_MAX:
        raise map_error(
            database.path,
            f"{count} records of {len(table.columns)} columns are too many",
            fix="keep the rate and its unit",
            code="too-large",
        )


def _damaged(database: Database, text: str) -> Exception:
    return map_error(database.path, text, fix=_EXPORT_AGAIN, code="truncated")


# Well-known binary: the polygons in it, heights and measures left behind.
#
# Taken apart here and not in GEOS, which follows nested collections as deep as the stack goes, and
# checks neither counts against what is there nor that a ring closes. Types and byte order are those
# of OGC 06-103r4, section 8.2; the flags of the older extended form (bits 29 to 31) are known too.

Floats = NDArray[np.float64]
# Outside first, then the holes.
Rings = list[Floats]

_DEPTH_MAX = 8
_POINT, _LINE, _POLYGON, _CIRCULAR, _CURVE_POLYGON = 1, 2, 3, 8, 10
_MULTI_POLYGON, _MULTI_SURFACE = 6, 12
_NAMES = {
    1: "Point", 2: "LineString", 3: "Polygon", 4: "MultiPoint", 5: "MultiLineString",
    6: "MultiPolygon", 7: "GeometryCollection", 8: "CircularString", 9: "CompoundCurve",
    10: "CurvePolygon", 11: "MultiCurve", 12: "MultiSurface",
}  # fmt: skip
_MARKS = (_POINT, _LINE, 4, 5)
# What the parts of these have to be.
_PARTS = {
    _MULTI_POLYGON: (_POLYGON,),
    _MULTI_SURFACE: (_POLYGON, _CURVE_POLYGON),
    _CURVE_POLYGON: (_LINE,),
}


class CurvedError(ValueError):
    """Ground whose edge is an arc of a circle."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Found:
    """The polygons of one geometry, and what it calls itself."""

    kind: str
    polygons: list[Rings] = field(default_factory=list)
    mark: BaseGeometry | None = None

    @property
    def vertex_count(self) -> int:
        """Return the number of vertices of all rings."""
        return sum(len(ring) for rings in self.polygons for ring in rings)

    @property
    def reason(self) -> str:
        """Return why there is no ground, empty where there is."""
        if self.polygons:
            return ""
        return "no-area" if "Polygon" in self.kind else f"not-a-polygon:{self.kind}"


def polygons_in(blob: bytes, start: int = 0) -> Found:
    """Return the polygons of the geometry that begins at byte `start` and ends with the blob.

    Raises `ValueError` for bytes that are no geometry, `CurvedError` for arcs.
    """
    polygons: list[Rings] = []
    try:
        kind, _, _, _ = _head(blob, start)
        end = _walk(blob, start, polygons, depth=0)
    except (struct.error, IndexError):
        raise ValueError("it ends too early") from None
    if end != len(blob):
        raise ValueError(f"{len(blob) - end} bytes are left over at its end")
    mark = _mark(blob[start:]) if kind in _MARKS else None
    return Found(kind=_NAMES[kind], polygons=polygons, mark=mark)


def _mark(blob: bytes) -> BaseGeometry | None:
    """Return points or lines, whose nesting and lengths were looked at; None for broken ones."""
    try:
        found = shapely.force_2d(shapely.from_wkb(blob))
        check_coordinates(shapely.get_coordinates(found))
    except (ShapelyError, ValueError):
        return None
    return None if found.is_empty else found


def areas_of(records: Sequence[Sequence[Rings]]) -> list[Area | None]:
    """Return the polygon or multipolygon of every record, None for one without polygons."""
    polygons = list(chain.from_iterable(records))
    if not polygons:
        return [None] * len(records)
    rings = list(chain.from_iterable(polygons))
    points = np.ascontiguousarray(np.concatenate(rings), dtype=np.float64)
    built = shapely.from_ragged_array(
        GeometryType.POLYGON, points, (_offsets(rings), _offsets(polygons))
    ).tolist()
    ends = list(accumulate(len(record) for record in records))
    return [
        as_area(built[end - len(record) : end]) for end, record in zip(ends, records, strict=True)
    ]


def _offsets(groups: Iterable[Sequence[object] | Floats]) -> NDArray[np.int64]:
    return np.array([0, *accumulate(len(group) for group in groups)], dtype=np.int64)


def _head(blob: bytes, at: int) -> tuple[int, int, str, int]:
    """Return kind, numbers per point, byte order, and where the content begins."""
    if blob[at] > 1:
        raise ValueError(f"its byte order is {blob[at]}")
    order = "<" if blob[at] else ">"
    code = struct.unpack_from(f"{order}I", blob, at + 1)[0]
    at += 9 if code & 0x20000000 else 5
    thousands, kind = divmod(code & 0x1FFFFFFF, 1000)
    if kind not in _NAMES or thousands > 3:
        raise ValueError(f"its type {code} is not known")
    heights = bool(code & 0x80000000) or thousands in (1, 3)
    measures = bool(code & 0x40000000) or thousands in (2, 3)
    return kind, 2 + heights + measures, order, at


def _walk(blob: bytes, at: int, polygons: list[Rings], *, depth: int) -> int:
    """Append the polygons of the geometry at `at`, and return where it ends."""
    if depth > _DEPTH_MAX:
        raise ValueError("it nests too deep")
    kind, width, order, at = _head(blob, at)
    if kind == _POINT:
        return _skipped(blob, at, 8 * width)
    count = struct.unpack_from(f"{order}I", blob, at)[0]
    at += 4
    if kind in (_LINE, _CIRCULAR):
        return _skipped(blob, at, 8 * width * count)
    if kind == _POLYGON:
        return _polygon(blob, at, count, (width, order), polygons)
    if kind == _CURVE_POLYGON:
        return _straight(blob, at, count, polygons)
    for _ in range(count):
        if _head(blob, at)[0] not in _PARTS.get(kind, _NAMES):
            raise ValueError(f"a part of its {_NAMES[kind]} is of another type")
        at = _walk(blob, at, polygons, depth=depth + 1)
    return at


def _skipped(blob: bytes, at: int, size_bytes: int) -> int:
    if at + size_bytes > len(blob):
        raise ValueError("it ends too early")
    return at + size_bytes


def _polygon(blob: bytes, at: int, count: int, form: tuple[int, str], polygons: list[Rings]) -> int:
    rings: Rings = []
    for _ in range(count):
        at = _ring(blob, at, form, rings)
    _add(rings, polygons)
    return at


def _straight(blob: bytes, at: int, count: int, polygons: list[Rings]) -> int:
    """Read a curve polygon, which is as good as a polygon where its rings are straight."""
    rings: Rings = []
    for _ in range(count):
        kind, width, order, at = _head(blob, at)
        if kind not in _PARTS[_CURVE_POLYGON]:
            raise CurvedError(f"its edge is a {_NAMES[kind]}")
        at = _ring(blob, at, (width, order), rings)
    _add(rings, polygons)
    return at


def _add(rings: Rings, polygons: list[Rings]) -> None:
    if not rings or not len(rings[0]):
        if any(len(ring) for ring in rings):
            raise ValueError("it has a hole, but no outside")
        return
    polygons.append([ring for ring in rings if len(ring)])


def _ring(blob: bytes, at: int, form: tuple[int, str], rings: Rings) -> int:
    width, order = form
    count = int(struct.unpack_from(f"{order}I", blob, at)[0])
    start, end = at + 4, at + 4 + 8 * width * count
    if end > len(blob):
        raise ValueError("it ends too early")
    points = np.frombuffer(blob, dtype=f"{order}f8", count=width * count, offset=start)
    ring = points.reshape(count, width)[:, :2]
    if count and not (count >= 4 and ring[0, 0] == ring[-1, 0] and ring[0, 1] == ring[-1, 1]):
        raise ValueError("a ring does not close")
    check_coordinates(ring)
    rings.append(ring)
    return end


# SQLite files that nobody vouches for: from memory, plain tables only, with a bounded effort.
#
# A database is more than data: views, triggers and constraints are programs, a journal beside it
# is a part of it, and opening one can write. Nothing here touches the disk or runs what the file
# defines; what is read has been checked for damage first, since SQLite passes over some of it.

Cell = str | int | float | bytes | None
Row = tuple[Cell, ...]

_MAGIC = b"SQLite format 3\0"
_HEADER_BYTES = 100
# The versions for reading and writing: 2 is write-ahead logging, which a database in memory
# cannot have (https://www.sqlite.org/fileformat.html, section 1.3).
_VERSIONS = slice(18, 20)
_JOURNAL_MAGIC = bytes.fromhex("d9d505f920a163d7")
# Steps of SQLite's machine; it takes some 50 million a second on a small computer. A table of a
# million records and ten columns needs 20 million.
_STEPS_PER_CALL = 100_000
_STEPS_MAX = 500_000_000
# One value: as many as all vertices that a map may have, and their heights.
_VALUE_BYTES_MAX = 128 * 1024 * 1024
_ALLOWED = (sqlite3.SQLITE_SELECT, sqlite3.SQLITE_READ)
_PRAGMAS = ("table_xinfo", "quick_check")
_FIX = "copy it again, or export the map again"


@dataclass(frozen=True, slots=True)
class Database:
    """The plain tables of a file, by their names in lower case."""

    path: Path
    tables: dict[str, str]
    _connection: sqlite3.Connection

    def rows(self, sql: str) -> Iterator[Row]:
        """Return the rows of a query; names of the file go through `quoted` first."""
        return self._connection.execute(sql)

    def columns(self, table: str) -> list[tuple[str, str, bool]]:
        """Return name, declared type, and whether it is part of the key, of every column."""
        found = self.rows(f"PRAGMA table_xinfo({quoted(table)})")
        columns = []
        for _, name, kind, _, _, key, hidden in found:
            if hidden:
                raise not_a_table(self.path, f"{table} has a computed column ({str(name)[:40]})")
            columns.append((str(name), str(kind), bool(key)))
        return columns

    def check(self, table: str) -> None:
        """Refuse a table with damaged pages, which could lose records without a word.

        Computed columns are refused before, since the check would compute them.
        """
        self.columns(table)
        for (text,) in self.rows(f"PRAGMA quick_check({quoted(table)})"):
            if text != "ok":
                raise _sqlite_damaged(
                    self.path, f"its table {table} is damaged ({str(text)[:120]})"
                )


def quoted(name: str) -> str:
    """Return a name as SQL can hold it.

    In backquotes: what stands in double quotes and is no name counts as text.

    >>> quoted("rate"), quoted("a`b")
    ('`rate`', '`a``b`')
    """
    return "`" + name.replace("`", "``") + "`"


@contextmanager
def open_database(content: bytes, path: Path) -> Iterator[Database]:
    """Yield the database in `content`; all that SQLite says inside becomes a `MapError`."""
    if len(content) < _HEADER_BYTES:
        raise _sqlite_damaged(path, f"the file ends after {len(content)} bytes")
    if not content.startswith(_MAGIC):
        raise map_error(
            path,
            "this is not an SQLite database, or it is encrypted",
            fix="export the map again",
            code="unknown-format",
        )
    steps = iter(range(_STEPS_MAX // _STEPS_PER_CALL))
    try:
        with closing(sqlite3.connect(":memory:", isolation_level=None)) as connection:
            connection.text_factory = _text
            connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _VALUE_BYTES_MAX)
            connection.execute("PRAGMA trusted_schema = OFF")
            connection.execute("PRAGMA ignore_check_constraints = ON")
            connection.execute("PRAGMA cell_size_check = ON")
            connection.deserialize(_without_log(content))
            connection.execute("PRAGMA query_only = ON")
            connection.set_authorizer(_authorized)
            connection.set_progress_handler(lambda: next(steps, None) is None, _STEPS_PER_CALL)
            yield Database(path, _tables(connection), connection)
    except (sqlite3.Error, OverflowError, UnicodeError) as error:
        if getattr(error, "sqlite_errorname", "") == "SQLITE_INTERRUPT":
            raise map_error(
                path,
                "reading it takes too long",
                fix="cut the map to one field",
                code="too-large",
            ) from None
        raise _sqlite_damaged(path, f"the database cannot be read ({str(error)[:120]})") from None


def not_a_table(path: Path, text: str) -> Exception:
    """Return the error for what SQLite would have to compute by the file's own program."""
    return map_error(path, text, fix="export the layer to a file of its own", code="not-a-table")


def check_closed(path: Path) -> None:
    """Refuse a database beside which another program keeps changes that are not in it yet."""
    for suffix, magic in (("-wal", b""), ("-journal", _JOURNAL_MAGIC)):
        beside = path.with_name(path.name + suffix)
        try:
            with beside.open("rb") as file:
                head = file.read(len(_JOURNAL_MAGIC))
        except FileNotFoundError:
            continue
        except (OSError, ValueError) as error:
            raise map_error(
                beside, f"cannot be read ({error})", fix="check path and rights"
            ) from None
        # An empty or wiped file is what a program leaves that has done its work.
        if head and head.startswith(magic):
            raise map_error(
                path,
                f"there are changes in {beside.name} that are not in the file yet",
                fix="close the program that has it open, and try again",
                code="file-in-use",
            )


def _tables(connection: sqlite3.Connection) -> dict[str, str]:
    """Return the tables that are nothing else: a virtual one has no page of its own."""
    listed = connection.execute("SELECT name, type, rootpage FROM sqlite_master")
    return {
        str(name).casefold(): str(name) for name, kind, page in listed if kind == "table" and page
    }


def _authorized(action: int, name: str | None, function: str | None, *_: str | None) -> int:
    allowed = (
        action in _ALLOWED
        or (action == sqlite3.SQLITE_PRAGMA and name in _PRAGMAS)
        or (action == sqlite3.SQLITE_FUNCTION and function == "count")
    )
    return sqlite3.SQLITE_OK if allowed else sqlite3.SQLITE_DENY


def _without_log(content: bytes) -> bytes:
    if content[_VERSIONS] != b"\2\2":
        return content
    return content[: _VERSIONS.start] + b"\1\1" + content[_VERSIONS.stop :]


def _text(content: bytes) -> str:
    return content.decode("utf-8", errors="replace")


def _sqlite_damaged(path: Path, text: str) -> Exception:
    return map_error(path, text, fix=_FIX, code="truncated")
