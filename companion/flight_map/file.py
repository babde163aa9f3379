"""What a flight map holds, and its file: a GeoPackage with a journal's tables of the ground.

Here it is read; the office writes it (`missions/maps/compiling.py`).
Whoever reads one does not know who made it: a hash is no signature. So it is read as a stranger's
database is (`journal/read_only.py`), and everything in it is looked at before it is used.
"""

from __future__ import annotations

import hashlib
import json
import math
import sqlite3
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path, PurePosixPath
from typing import Any, get_args

import numpy as np
import shapely
from shapely import Geometry, LineString, MultiPolygon, Polygon

from companion.config import Config
from companion.config.tables import Buffer, PrescriptionTable
from companion.core.cells import CellGrid, Warp
from companion.core.frame import LocalFrame
from companion.core.options.lines import Polyline
from companion.core.prescription import Overlap, Prescription, Zone
from companion.errors import MapError, Problem
from companion.journal.geopackage import (
    APPLICATION_ID,
    GROUND_TABLES,
    META_TABLE,
    REGISTERS,
    Ground,
    read_ground,
    wkb_of,
)
from companion.journal.read_only import DAMAGE, check_programs, distrust, one_line

# ------------------------------------------------------------------------------------ what it holds

Area = Polygon | MultiPolygon
SUFFIX = ".flightmap.gpkg"


@dataclass(frozen=True, slots=True, kw_only=True)
class SourceFile:
    """A file that the flight map was compiled from; `key` is the setting that named it."""

    key: str
    name: str
    sha256: str


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightMap:
    """A compiled map. All geometry is in metres of `frame`, without the offset of a flight.

    `is_bounded` is false for cells that may be sprayed wherever they have a rate. `source` is
    the name of the map's own file, `source_rates_l_ha` its rates as they stand there, and
    `frozen` the settings that it was compiled with. `sha256` is the hash of all of this, without
    who compiled it and when.
    """

    path: Path
    frame: LocalFrame
    prescription: Prescription
    is_bounded: bool
    source: str
    source_rates_l_ha: tuple[float, ...]
    exclusions: tuple[Area, ...] = ()
    polylines: tuple[Polyline, ...] = ()
    frozen: Mapping[str, object] = field(default_factory=dict)
    sources: tuple[SourceFile, ...] = ()
    findings: tuple[Problem, ...] = ()
    compiled_utc: str = ""
    compiled_by: str = ""
    compiled_with: str = ""
    sha256: str = ""

    def moved(self, east_m: float, north_m: float) -> Prescription:
        """Return the prescription, moved by the offset between map and receiver."""
        if not np.isfinite((east_m, north_m)).all():
            raise ValueError(f"offset is not a distance: {(east_m, north_m)}")
        if east_m == 0.0 and north_m == 0.0:
            return self.prescription
        return moved(self.prescription, east_m=east_m, north_m=north_m, is_bounded=self.is_bounded)

    def age_days(self, now: datetime) -> float | None:
        """Return how old the flight map is; None where it does not say."""
        try:
            return (now - datetime.fromisoformat(self.compiled_utc)).total_seconds() / 86_400.0
        except (ValueError, TypeError):
            return None

    def as_object(self) -> dict[str, object]:
        """Return what the journal and the doctor say of it."""
        return {
            "file": self.path.name,
            "sha256": self.sha256,
            "source": self.source,
            "sources": [[each.key, each.name, each.sha256] for each in self.sources],
            "frozen": dict(self.frozen),
            "findings": [
                {
                    "severity": found.severity,
                    "code": found.code,
                    "text": found.text,
                    "where": found.where,
                    "fix": found.fix,
                }
                for found in self.findings
            ],
            "compiled_utc": self.compiled_utc,
            "compiled_by": self.compiled_by,
            "compiled_with": self.compiled_with,
        }


def is_flight_map(path: Path) -> bool:
    """Tell a flight map from any other map by its name.

    >>> is_flight_map(Path("field.flightmap.gpkg")), is_flight_map(Path("field.gpkg"))
    (True, False)
    """
    return path.name.casefold().endswith(SUFFIX)


def moved(
    prescription: Prescription, *, east_m: float, north_m: float, is_bounded: bool
) -> Prescription:
    """Return a prescription whose ground lies elsewhere by an offset."""
    offset_m = np.array([east_m, north_m])

    def shifted(areas: list[Area]) -> list[Area]:
        array = np.array(areas, dtype=object)
        found = shapely.transform(array, lambda points: points + offset_m)
        for index in np.flatnonzero(~shapely.is_valid(found)).tolist():
            # The last bits of a place can make rings cross that touch.
            found[index] = _ground_of(
                shapely.make_valid(found[index], method="structure", keep_collapsed=False)
            )
        return list(found)

    cells = prescription.cells
    zones = [] if cells is not None else list(prescription.zones)
    areas = shifted([zone.polygon for zone in zones]) if zones else []
    boundary = shifted([prescription.field])[0] if is_bounded else None
    return Prescription(
        [
            Zone(name=zone.name, polygon=area, rate_l_ha=zone.rate_l_ha)
            for zone, area in zip(zones, areas, strict=True)
            if not area.is_empty
        ],
        boundary=boundary,
        overlap=prescription.overlap,
        default_rate_l_ha=prescription.default_rate_l_ha,
        cells=None if cells is None else _moved_cells(cells, east_m, north_m),
        sha256=prescription.sha256,
    )


def _ground_of(geometry: Geometry) -> Area:
    parts = shapely.get_parts(shapely.get_parts(np.array([geometry], dtype=object)))
    polygons = [part for part in parts if isinstance(part, Polygon) and part.area > 0.0]
    return polygons[0] if len(polygons) == 1 else MultiPolygon(polygons)


def _moved_cells(cells: CellGrid, east_m: float, north_m: float) -> CellGrid:
    """Return the same cells with polynomials that lead to and from the other place."""
    there, back = cells.to_frame, cells.to_cells
    (u, v), *rest = there.terms
    return CellGrid(
        cells.classes,
        cells.rates_l_ha,
        Warp(
            x0=there.x0,
            y0=there.y0,
            scale=there.scale,
            terms=((u + east_m, v + north_m), *rest),
        ),
        Warp(x0=back.x0 + east_m, y0=back.y0 + north_m, scale=back.scale, terms=back.terms),
    )


# Settings that are compiled into a flight map, and a configuration that says something else.
#
# Where a flight goes on with other settings than those that the map was checked with, the map that
# was checked is not the map that is flown: such a flight is refused, and the key is named.

# What the ground and its rates depend on.
_FROZEN = ("overlap", "default_rate_l_ha", "unit", "density_kg_l", "boundary", "exclusions")
# How the source was read: a configuration that says nothing of it does not object.
_READING = ("rate_field", "crs", "layer", "flow_width_m", "flow_speed_m_s", "merge", "origin")
# Factors on all rates, frozen like those above.
_FACTORS = ("mix_rate", "scale")
_LINES = "mission.lines"
# No setting of a configuration: the id of the plan, by which journals are sorties of one job.
JOB_KEY = "mission.job"
_BUFFERS = "limits.buffer"


def frozen_settings(
    table: PrescriptionTable, lines: str | None, buffers: Sequence[Buffer] = ()
) -> dict[str, object]:
    """Return the settings that are frozen in a flight map, as JSON has them.

    Buffers and factors stand in it where there are any: a map without them is the same as ever.
    """
    found = table.model_dump(mode="json", include={*_FROZEN, *_READING})
    named = {f"prescription.{name}": found[name] for name in (*_FROZEN, *_READING)}
    factors = {
        f"prescription.{name}": value
        for name, value in table.model_dump(include=set(_FACTORS)).items()
        if value is not None
    }
    kept = [[each.kind, each.distance_m, list(each.files)] for each in buffers]
    return {**named, **factors, _LINES: lines, **({_BUFFERS: kept} if kept else {})}


def difference(flight_map: FlightMap, config: Config) -> tuple[str, object, object] | None:
    """Return the first frozen key in which flight map and configuration differ, and both values.

    The configuration's value comes first. Files are compared by their names here: those of the
    office lie in other folders.
    """
    if config.prescription is None:
        return None
    said = dict.fromkeys(f"prescription.{name}" for name in _FACTORS) | frozen_settings(
        config.prescription, config.planned_lines, config.buffers
    )
    for key, wanted in said.items():
        compiled = flight_map.frozen.get(key)
        is_hint = key.removeprefix("prescription.") in _READING
        if is_hint and wanted is None:
            continue
        if _comparable(key, wanted) != _comparable(key, compiled):
            return key, wanted, compiled
    return None


def _comparable(key: str, value: object) -> object:
    if key in ("prescription.boundary", _LINES) and isinstance(value, str):
        return PurePosixPath(value).name
    if key == "prescription.exclusions" and isinstance(value, list):
        return [PurePosixPath(str(name)).name for name in value]
    if key == _BUFFERS and isinstance(value, list):
        return [
            [kind, distance_m, [PurePosixPath(str(name)).name for name in files]]
            for kind, distance_m, files in value
        ]
    return value


def named_files(
    table: PrescriptionTable, lines: str | None, folder: Path, buffers: Sequence[Buffer] = ()
) -> dict[str, Path]:
    """Return every file that a flight map is compiled from, by the setting that names it."""
    named: dict[str, str | None] = {
        "prescription.file": table.file,
        "prescription.boundary": table.boundary,
        **{
            f"prescription.exclusions[{number}]": name
            for number, name in enumerate(table.exclusions)
        },
        "mission.lines": lines,
        **{
            f"{_BUFFERS}[{number}].files[{at}]": name
            for number, each in enumerate(buffers)
            for at, name in enumerate(each.files)
        },
    }
    return {key: folder / name for key, name in named.items() if name is not None}


# ----------------------------------------------------------------------------------------- its file

VERSION = "1"
# Bounds on what a stranger may hand over; those of any map file (missions/maps/model.py).
FILE_BYTES_MAX = 256 * 1024 * 1024
VERTICES_MAX = 5_000_000
ZONES_MAX = 1_000_000
# A field is some kilometres; beyond this the frame's scale is off by centimetres.
EXTENT_MAX_M = 200_000.0
_TEXT_MAX = 10_000
_ROWS_MAX = 100_000
SCHEMA = f"""{REGISTERS}{GROUND_TABLES}
CREATE TABLE exclusions (id INTEGER PRIMARY KEY NOT NULL, geom GEOMETRY);
CREATE TABLE lines (id INTEGER PRIMARY KEY NOT NULL, geom LINESTRING);
CREATE TABLE source_rates (id INTEGER PRIMARY KEY NOT NULL, rate_l_ha DOUBLE NOT NULL);
CREATE TABLE sources (
    id INTEGER PRIMARY KEY NOT NULL, key TEXT NOT NULL, name TEXT NOT NULL, sha256 TEXT NOT NULL
);
CREATE TABLE findings (
    id INTEGER PRIMARY KEY NOT NULL, severity TEXT NOT NULL, code TEXT NOT NULL, text TEXT NOT NULL,
    place TEXT NOT NULL, fix TEXT NOT NULL
);
{META_TABLE}
INSERT INTO gpkg_contents (table_name, data_type, identifier, description) VALUES
    ('source_rates', 'attributes', 'source_rates', 'all rates of the source'),
    ('sources', 'attributes', 'sources', 'what the flight map was compiled from'),
    ('findings', 'attributes', 'findings', 'what the check of the map found'),
    ('meta', 'attributes', 'meta', 'settings, versions, hash');
"""
# What the hash is of, and in which order; `cells` is there for maps in rows and columns.
_HASHED = (
    "zones", "field", "exclusions", "lines", "source_rates", "sources", "findings", "cells", "meta",
)  # fmt: skip
_REGISTERS = ("gpkg_contents", "gpkg_geometry_columns", "gpkg_spatial_ref_sys")
_TABLES = frozenset({*_HASHED, *_REGISTERS})
# Who and when, and the hash itself.
_UNHASHED = frozenset({"sha256", "compiled_utc", "compiled_by", "compiled_with"})


def content_sha256(connection: sqlite3.Connection) -> str:
    """Return the hash of all rows, each value with its kind and its length."""
    found = hashlib.sha256()
    there = {row[0] for row in connection.execute("SELECT name FROM sqlite_master")}
    for table in _HASHED:
        if table not in there:
            continue
        found.update(f"table {table}\n".encode())
        for row in connection.execute(f"SELECT * FROM {table} ORDER BY 1"):
            if table == "meta" and row[1] in _UNHASHED:
                continue
            # Numbers of rows say nothing but the order.
            for value in row[1:]:
                content = _bytes_of(value)
                found.update(struct.pack("<cq", type(value).__name__[:1].encode(), len(content)))
                found.update(content)
    return found.hexdigest()


def _bytes_of(value: object) -> bytes:
    if isinstance(value, bytes):
        return value
    if isinstance(value, float):
        return struct.pack("<d", value)
    return str(value).encode("utf-8", "surrogatepass")


def read_flight_map(path: Path) -> FlightMap:
    """Return a flight map, with everything in it looked at.

    Raises:
        MapError: in one line, where the file is none, or is damaged.
    """
    try:
        if not path.is_file():
            raise _refused(path, "there is no such file", fix="check the path", code="no-file")
        if path.stat().st_size > FILE_BYTES_MAX:
            raise ValueError(f"it is larger than {FILE_BYTES_MAX // 1024**2} MB")
        # Without locks, and without a look at the files that SQLite may find beside it.
        uri = f"{path.resolve().as_uri()}?mode=ro&immutable=1"
        # What is not a number is refused, not warned of.
        with (
            closing(sqlite3.connect(uri, uri=True)) as connection,
            np.errstate(all="ignore"),
        ):
            distrust(connection, path.stat().st_size, tables=_TABLES)
            return _read(path, connection)
    except (*DAMAGE, shapely.errors.ShapelyError, MemoryError) as error:
        raise _refused(path, f"this is not a sound flight map: {one_line(error)[:200]}") from error


def _refused(
    path: Path,
    text: str,
    *,
    fix: str = "compile it again: vrspray map compile MAP --config FILE --out NAME.flightmap.gpkg",
    code: str = "flight-map",
) -> MapError:
    return MapError(" ".join(f"{path}: {text}; {fix}".split()), code=code, fix=fix)


def _read(path: Path, connection: sqlite3.Connection) -> FlightMap:
    (application_id,) = connection.execute("PRAGMA application_id").fetchone()
    if application_id != APPLICATION_ID:
        raise ValueError("it is not a GeoPackage")
    check_programs(connection, tables=_TABLES)
    meta = dict(_rows(connection, "key, value", "meta", (str, str)))
    if meta.get("flight_map_version") != VERSION:
        raise ValueError(
            f"its version is {meta.get('flight_map_version', 'not told')[:20]}, not {VERSION}"
        )
    if content_sha256(connection) != meta["sha256"]:
        raise ValueError("its content is not what its hash says: it was changed or damaged")
    frame = LocalFrame(
        latitude_deg=float(meta["origin_latitude_deg"]),
        longitude_deg=float(meta["origin_longitude_deg"]),
    )
    is_bounded = json.loads(meta["is_bounded"]) is True
    return FlightMap(
        path=path,
        frame=frame,
        prescription=_prescription(connection, meta, is_bounded=is_bounded),
        is_bounded=is_bounded,
        source=meta["source"],
        source_rates_l_ha=tuple(_source_rates(connection)),
        exclusions=tuple(_exclusions(connection)),
        polylines=tuple(_polylines(connection)),
        frozen=_frozen(meta["frozen"]),
        sources=tuple(
            SourceFile(key=key, name=name, sha256=sha256)
            for key, name, sha256 in _rows(
                connection, "key, name, sha256", "sources", (str, str, str)
            )
        ),
        findings=tuple(_findings(connection)),
        compiled_utc=meta["compiled_utc"],
        compiled_by=meta["compiled_by"],
        compiled_with=meta["compiled_with"],
        sha256=meta["sha256"],
    )


def _rows(
    connection: sqlite3.Connection, columns: str, table: str, kinds: tuple[type, ...]
) -> Iterator[tuple[Any, ...]]:
    """Yield the rows of a table; ValueError where they are not what a flight map has."""
    for count, row in enumerate(connection.execute(f"SELECT {columns} FROM {table} ORDER BY id")):
        if count >= _ROWS_MAX and table != "source_rates":
            raise ValueError(f"its {table} have more than {_ROWS_MAX} rows")
        for value, kind in zip(row, kinds, strict=True):
            if type(value) is not kind:
                raise ValueError(f"a value of its {table} is of another kind")
            if isinstance(value, str) and len(value) > 100 * _TEXT_MAX:
                raise ValueError(f"a text of its {table} has no end")
        yield row


def _prescription(
    connection: sqlite3.Connection, meta: dict[str, str], *, is_bounded: bool
) -> Prescription:
    ground = read_ground(connection)
    _check_ground(ground)
    default = json.loads(meta["default_rate_l_ha"])
    if default is not None and not (type(default) in (int, float) and 0.0 <= default < 100_000.0):
        raise ValueError("its default rate is not a rate")
    if ground.cells is None and not is_bounded:
        raise ValueError("its zones have no border")
    return Prescription(
        [
            Zone(name=str(name), polygon=polygon, rate_l_ha=rate_l_ha)
            for name, rate_l_ha, polygon in ground.zones
        ],
        boundary=ground.field if is_bounded else None,
        overlap=_overlap(meta["overlap"]),
        default_rate_l_ha=None if default is None else float(default),
        cells=ground.cells,
        sha256=meta["map_sha256"],
    )


def _overlap(text: str) -> Overlap:
    for policy in get_args(Overlap):
        if policy == text:
            return policy  # type: ignore[no-any-return]
    raise ValueError("its overlap rule is unknown")


def _check_ground(ground: Ground) -> None:
    if len(ground.zones) > ZONES_MAX:
        raise ValueError(f"it has more than {ZONES_MAX} zones")
    for name, rate_l_ha, _ in ground.zones:
        if type(rate_l_ha) is not float or type(name) is not str:
            raise ValueError("a zone has no name or no rate")
    _check_shapes([*(area for _, _, area in ground.zones), ground.field])
    if ground.field.is_empty and ground.cells is None:
        raise ValueError("its field is empty")
    if ground.cells is not None:
        _check_cells(ground.cells)


def _check_cells(cells: CellGrid) -> None:
    """Check the polynomials: finite, of a degree, each the inverse of the other."""
    for warp in (cells.to_frame, cells.to_cells):
        numbers = [warp.x0, warp.y0, warp.scale, *(value for term in warp.terms for value in term)]
        if not all(map(math.isfinite, numbers)) or not warp.scale > 0.0 or warp.degree < 1:
            raise ValueError("its cells lie nowhere")
    rows, columns = cells.shape
    column, row = np.meshgrid(np.linspace(0.0, columns, 5), np.linspace(0.0, rows, 5))
    east, north = cells.to_frame(column.ravel(), row.ravel())
    if not bool((np.hypot(east, north) <= EXTENT_MAX_M).all()):
        raise ValueError("its cells lie farther off than any field reaches")
    again = np.array(cells.to_cells(east, north))
    if not bool((np.abs(again - (column.ravel(), row.ravel())) <= 0.1).all()):
        raise ValueError("its cells lie nowhere")


def _check_shapes(shapes: Sequence[Geometry], *, are_areas: bool = True) -> None:
    """Refuse what is not finite, reaches too far, is invalid, or is too much."""
    array = np.array(shapes, dtype=object)
    places = shapely.get_coordinates(array)
    if len(places) > VERTICES_MAX:
        raise ValueError(f"it has more than {VERTICES_MAX} vertices")
    if not bool((np.abs(places) <= EXTENT_MAX_M).all()):  # NaN is not
        raise ValueError("a place in it is not a number, or farther off than any field reaches")
    if are_areas and not bool(shapely.is_valid(array).all()):
        raise ValueError("a polygon crosses itself")


def _shapes(connection: sqlite3.Connection, table: str) -> list[Geometry]:
    blobs = [row[0] for row in _rows(connection, "geom", table, (bytes,))]
    return list(shapely.from_wkb([wkb_of(blob) for blob in blobs])) if blobs else []


def _exclusions(connection: sqlite3.Connection) -> Iterable[Area]:
    found = _shapes(connection, "exclusions")
    _check_shapes(found)
    areas = [area for area in found if isinstance(area, Polygon | MultiPolygon)]
    if len(areas) != len(found):
        raise ValueError("an exclusion is not a polygon")
    return areas


def _polylines(connection: sqlite3.Connection) -> Iterator[Polyline]:
    found = _shapes(connection, "lines")
    _check_shapes(found, are_areas=False)
    for line in found:
        if not isinstance(line, LineString) or line.is_empty:
            raise ValueError("a planned line is not a line")
        yield tuple((float(x), float(y)) for x, y in shapely.get_coordinates(line))


def _source_rates(connection: sqlite3.Connection) -> Iterator[float]:
    for (rate,) in _rows(connection, "rate_l_ha", "source_rates", (float,)):
        if not 0.0 <= rate < 100_000.0:
            raise ValueError("a rate of its source is not a rate")
        yield rate


def _findings(connection: sqlite3.Connection) -> Iterator[Problem]:
    columns = "severity, code, text, place, fix"
    for severity, code, text, where, fix in _rows(connection, columns, "findings", (str,) * 5):
        yield Problem(severity=severity, code=code, text=text, where=where, fix=fix)


def _frozen(text: str) -> dict[str, object]:
    found = json.loads(text)
    if not isinstance(found, dict):
        raise ValueError("its settings are none")
    return found
