"""From a configuration and its files to the flight map: all that a flight needs of them."""

from __future__ import annotations

import getpass
import json
import math
import platform
import re
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import shapely
from shapely import Geometry, LineString, MultiPolygon

from companion.assembly import build_setup, check_mark
from companion.atomic_write import write_atomically
from companion.config import Config
from companion.config.tables import Buffer, PrescriptionTable
from companion.core.frame import LocalFrame, Place
from companion.core.options.lines import Polyline
from companion.core.prescription import FIELD, Prescription
from companion.core.setup import Setup
from companion.errors import ConfigError, MapError, Problem
from companion.flight_map import (
    JOB_KEY,
    FlightMap,
    frozen_settings,
    is_flight_map,
    read_flight_map,
)
from companion.flight_map.child import sources_of
from companion.flight_map.file import SCHEMA, VERSION, content_sha256, named_files
from companion.journal.geopackage import (
    LOCAL_ID,
    geometry_blob,
    layer_sql,
    register_frame,
    write_ground,
)
from companion.wording import show_value
from missions.maps.build import build_prescription, frame_for
from missions.maps.local import grown, make_valid, project
from missions.maps.model import MapFile, map_error, read_bytes
from missions.maps.registry import read_area, read_map, read_records


@dataclass(frozen=True, slots=True, kw_only=True)
class MapOrder:
    """What is to be compiled: the settings of the map, and where their files are.

    `config` is the file that says so; None where nobody wrote one.
    """

    table: PrescriptionTable
    lines: str | None = None
    buffers: tuple[Buffer, ...] = ()
    folder: Path = Path()
    config: Path | None = None

    @classmethod
    def of(cls, config: Config) -> MapOrder:
        """Return what a configuration wants to be compiled."""
        if config.prescription is None:
            raise ConfigError(
                f"{config.path}: prescription.file: missing; write the path of the map under "
                "[prescription]"
            )
        return cls(
            table=config.prescription,
            lines=None if config.mission is None else config.mission.lines,
            buffers=config.buffers,
            folder=config.path.parent,
            config=config.path,
        )

    def resolve(self, name: str) -> Path:
        """Return the path of a file that a setting names."""
        return self.folder / name

    def files(self) -> dict[str, Path]:
        """Return every file, by the setting that names it."""
        return named_files(self.table, self.lines, self.folder, self.buffers)

    def refused(self, text: str) -> ConfigError:
        """Return the refusal of a setting."""
        return ConfigError(text if self.config is None else f"{self.config}: {text}")

    @contextmanager
    def naming(self, key: str, value: str) -> Iterator[None]:
        """Have an error of a map file say which key of the configuration named it."""
        try:
            yield
        except MapError as error:
            if self.config is None:
                raise
            text = f"{self.config}: {key} = {show_value(value)}: {error}"
            raise MapError(text, code=error.code, fix=error.fix) from error


def compiled_setup(config: Config, *, frame: LocalFrame | None = None) -> Setup:
    """Return the set-up of a flight as `vrspray run` has it, compiled in this very process.

    For the office, where reading maps is no risk to anybody's valves.
    """
    order = MapOrder.of(config)
    path = order.resolve(order.table.file)
    if is_flight_map(path):
        return build_setup(config, read_flight_map(path))
    return build_setup(config, compile_map(order, frame=frame))


def read_configured_map(config: Config) -> MapFile:
    """Return the map that the configuration names, read as it says."""
    return read_ordered_map(MapOrder.of(config))


def read_ordered_map(order: MapOrder) -> MapFile:
    """Return the map, read as its settings say."""
    table = order.table
    with order.naming("prescription.file", table.file):
        found = read_map(
            order.resolve(table.file),
            rate_field=table.rate_field,
            unit=table.unit,
            crs=table.crs,
            layer=table.layer,
            density_kg_l=table.density_kg_l,
            flow_width_m=table.flow_width_m,
            flow_speed_m_s=table.flow_speed_m_s,
            mix_rate=table.mix_rate,
            scale=table.scale,
            merge=table.merge,
            origin=table.origin,
        )
    is_source = not is_flight_map(found.path)
    if is_source and table.sha256 is not None and not found.sha256.startswith(table.sha256):
        raise order.refused(
            f"prescription.sha256 = {show_value(table.sha256)}: {table.file} is another map, its "
            f"hash begins with {found.sha256[:8]}; look at it with `vrspray map check`, then write "
            "these digits"
        )
    return found


def compile_map(
    order: MapOrder,
    *,
    map_file: MapFile | None = None,
    frame: LocalFrame | None = None,
    findings: Sequence[Problem] = (),
) -> FlightMap:
    """Return the flight map; its frame is that of the map unless one is given.

    Raises:
        ConfigError: where settings and files do not go together.
        MapError: where a file cannot be used.
    """
    map_file = read_ordered_map(order) if map_file is None else map_file
    frame = frame_for(map_file) if frame is None else frame
    table = order.table
    boundary = None
    if table.boundary is not None:
        boundary = _area(order, "prescription.boundary", table.boundary)
    exclusions = [
        _area(order, f"prescription.exclusions[{number}]", name, nested=True)
        for number, name in enumerate(table.exclusions)
    ]
    exclusions += [
        grown(_kept_from(order, f"limits.buffer[{number}].files", name), each.distance_m, frame)
        for number, each in enumerate(order.buffers)
        for name in each.files
    ]
    prescription = build_prescription(
        map_file,
        frame,
        overlap=table.overlap,
        boundary=boundary,
        exclusions=exclusions,
        default_rate_l_ha=table.default_rate_l_ha,
    )
    if not _meets(prescription):
        raise order.refused(
            f"prescription.boundary and prescription.exclusions leave nothing of {map_file.path} "
            "to spray; give files of the same field"
        )
    local = [project(area, frame) for area in exclusions]
    return FlightMap(
        path=map_file.path,
        frame=frame,
        prescription=prescription,
        is_bounded=map_file.cells is None
        or boundary is not None
        or map_file.boundary is not None
        or bool(exclusions),
        source=map_file.path.name,
        source_rates_l_ha=map_file.rates_l_ha,
        exclusions=tuple(
            area if area.is_valid else (make_valid(area) or MultiPolygon()) for area in local
        ),
        polylines=_polylines(order, frame, prescription),
        frozen=frozen_settings(table, order.lines, order.buffers) | job_of(order),
        sources=sources_of(order.files()),
        findings=tuple(findings),
    )


def flown_at(
    config: Config, map_file: MapFile, points: Sequence[tuple[float, float]]
) -> list[dict[str, object]]:
    """Return rate and zone at each (latitude, longitude) as a flight with this configuration has.

    Boundary, exclusions, default rate and offset are applied; `inside` says whether the place may
    be sprayed at all.
    """
    compiled = compile_map(replace(MapOrder.of(config), lines=None), map_file=map_file)
    table = config.prescription or PrescriptionTable(file=str(map_file.path))
    check_mark(config, table)
    flown = compiled.moved(table.offset_east_m, table.offset_north_m)
    latitudes, longitudes = zip(*points, strict=True)
    east_m, north_m = compiled.frame.to_local_all(latitudes, longitudes)
    rows: list[dict[str, object]] = []
    for point, owners in zip(points, flown.owners_at(east_m, north_m), strict=True):
        inside, zones = FIELD in owners, sorted(owners - {FIELD})
        rate_l_ha = flown.rate_of(frozenset(zones)) if inside else None
        names = [flown.zone_name(zone) for zone in zones]
        if not names and rate_l_ha is not None:
            names = ["default"]
        rows.append(
            {
                "lat": point[0],
                "lon": point[1],
                "rate_l_ha": rate_l_ha,
                "zone": ", ".join(names) or None,
                "inside": inside,
            }
        )
    return rows


def _area(order: MapOrder, key: str, name: str, *, nested: bool = False) -> MultiPolygon:
    """Return the ground that a file of the configuration covers."""
    with order.naming(key, name):
        return read_area(order.resolve(name), nested=nested)


def _kept_from(order: MapOrder, key: str, name: str) -> list[Geometry]:
    """Return the areas, lines and points of a file that a buffer is kept from."""
    with order.naming(key, name):
        return [record.geometry for record in read_records(order.resolve(name))]


def _polylines(order: MapOrder, frame: LocalFrame, ground: Prescription) -> tuple[Polyline, ...]:
    """Return the lines of a plan that alone are sprayed, if there are any."""
    if order.lines is None:
        return ()
    with order.naming("mission.lines", order.lines):
        polylines = read_plan_lines(order.resolve(order.lines), frame)
    if not any(LineString(line).intersects(ground.field) for line in polylines):
        raise order.refused(
            f"mission.lines = {show_value(order.lines)}: no line comes over the map; give files of "
            "the same field"
        )
    return polylines


def job_of(order: MapOrder) -> dict[str, str]:
    """Return the id of the job that the lines were planned for, as a setting of the flight map."""
    found = None if order.lines is None else _document(order.resolve(order.lines)).get("job")
    return {JOB_KEY: found} if isinstance(found, str) and _JOB.fullmatch(found) else {}


def _meets(built: Prescription) -> bool:
    """Tell whether anything of the map lies on ground that may be sprayed."""
    if built.cells is not None:
        return bool(built.cells.outline.intersects(built.field))
    return any(zone.polygon.intersects(built.field) for zone in built.zones)


# The spray lines of a plan: the GeoJSON that `vrspray plan` writes, as polylines.
#
# Pieces of one line follow each other in the file (a new speed, a bend of the border) and are
# joined; what another sortie goes on with is not.

# As in the files for autopilots, where such ends are one waypoint.
JOINED_M = 0.6
# At a sharper bend the vehicle stops, and both lines keep their own ends.
BEND_MAX_DEG = 30.0
POINTS_MAX = 1_000_000
_JOB = re.compile(r"[0-9a-f]{12}")
_FIX = "name the .geojson, or the .lines.geojson, that `vrspray plan` wrote"


class _Line(NamedTuple):
    places: list[Place]
    sortie: object


def read_plan_lines(path: Path, frame: LocalFrame) -> tuple[Polyline, ...]:
    """Return the spray lines of a plan in `frame`, joined where they go on in each other."""
    document = _document(path)
    features = document.get("features")
    if document.get("type") != "FeatureCollection" or not isinstance(features, list):
        raise _refused(path, "this is not GeoJSON with features")
    lines = [line for feature in features if (line := _line(path, feature, frame)) is not None]
    if not lines:
        raise _refused(path, 'no LineString has kind = "spray"')
    if sum(len(line.places) for line in lines) > POINTS_MAX:
        raise _refused(path, f"more than {POINTS_MAX} points")
    return tuple(tuple(places) for places in _joined(lines))


def _document(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(read_bytes(path).decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise _refused(path, f"this is not readable JSON ({str(error)[:120]})") from None
    return found if isinstance(found, dict) else {}


def _line(path: Path, feature: Any, frame: LocalFrame) -> _Line | None:
    """Return a spray line; None for any other feature."""
    about = feature.get("properties") if isinstance(feature, dict) else None
    if not isinstance(about, dict) or about.get("kind") != "spray":
        return None
    shape = feature.get("geometry")
    if not isinstance(shape, dict) or shape.get("type") != "LineString":
        raise _refused(path, "a spray line is not a LineString")
    places = shape.get("coordinates")
    if not isinstance(places, list) or len(places) < 2:
        raise _refused(path, "a spray line has less than two points")
    return _Line([_place(path, place, frame) for place in places], about.get("sortie"))


def _place(path: Path, place: Any, frame: LocalFrame) -> Place:
    if (
        not isinstance(place, list)
        or len(place) < 2
        or not all(type(number) in (int, float) for number in place[:2])
    ):
        raise _refused(path, f"{str(place)[:60]} is not a longitude and latitude")
    longitude_deg, latitude_deg = float(place[0]), float(place[1])
    if not (abs(longitude_deg) <= 180.0 and abs(latitude_deg) <= 90.0):
        raise _refused(path, f"{str(place)[:60]} is not a longitude and latitude")
    return frame.to_local(latitude_deg, longitude_deg)


def _joined(lines: list[_Line]) -> list[list[Place]]:
    """Return the lines, one that goes on in the next with it; their two ends are one place."""
    found: list[list[Place]] = []
    before: _Line | None = None
    for line in lines:
        is_next = before is not None and before.sortie == line.sortie
        if is_next and _goes_on(found[-1], line.places):
            (x0, y0), (x1, y1) = found[-1][-1], line.places[0]
            found[-1][-1] = ((x0 + x1) / 2.0, (y0 + y1) / 2.0)
            found[-1] += line.places[1:]
        else:
            found.append(list(line.places))
        before = line
    return found


def _goes_on(before: list[Place], after: list[Place]) -> bool:
    """Return whether a line goes on in another: from the same place, by no more than a bend."""
    if not math.dist(before[-1], after[0]) < JOINED_M:
        return False
    (x0, y0), (x1, y1) = before[-2:]
    (x2, y2), (x3, y3) = after[:2]
    dot = (x1 - x0) * (x3 - x2) + (y1 - y0) * (y3 - y2)
    both = math.dist(before[-2], before[-1]) * math.dist(after[0], after[1])
    return dot >= math.cos(math.radians(BEND_MAX_DEG)) * both


def _refused(path: Path, text: str) -> MapError:
    return map_error(path, text, fix=_FIX, code="no-lines")


# The flight map as a file, written whole or not at all.


def write_flight_map(path: Path, flight_map: FlightMap) -> FlightMap:
    """Write a flight map, whole or not at all, and return it with its hash and who made it.

    Raises:
        OSError: where it cannot be written; what was there before stays.
    """
    stamped = replace(
        flight_map,
        path=path,
        compiled_utc=datetime.now(tz=UTC).isoformat(timespec="seconds"),
        compiled_by=_compiled_by(),
        compiled_with=f"vrspray {version('vrspray')}",
    )
    with closing(sqlite3.connect(":memory:", isolation_level=None)) as connection:
        _fill(connection, stamped)
        sha256 = content_sha256(connection)
        _insert_meta(connection, {"sha256": sha256})
        write_atomically(path, connection.serialize())
    return replace(stamped, sha256=sha256)


def _compiled_by() -> str:
    try:
        user = getpass.getuser()
    except (OSError, KeyError):  # a user without a name, as in some containers
        user = "unknown"
    return f"{user}@{platform.node()}"


def _fill(connection: sqlite3.Connection, flight_map: FlightMap) -> None:
    connection.executescript(SCHEMA)
    register_frame(connection, flight_map.frame)
    for table, what, kind in (
        ("exclusions", "where nothing is sprayed; the field is without them", "GEOMETRY"),
        ("lines", "planned lines: alone these are sprayed", "LINESTRING"),
    ):
        connection.executescript(layer_sql(table, what, geometry=kind, srs_id=LOCAL_ID))
    write_ground(connection, flight_map.prescription)
    lines = [LineString(line) for line in flight_map.polylines]
    for table, shapes in (("exclusions", list(flight_map.exclusions)), ("lines", lines)):
        connection.executemany(f"INSERT INTO {table} (geom) VALUES (?)", _blobs(shapes))
    connection.executemany(
        "INSERT INTO source_rates (rate_l_ha) VALUES (?)",
        [(rate,) for rate in flight_map.source_rates_l_ha],
    )
    connection.executemany(
        "INSERT INTO sources (key, name, sha256) VALUES (?, ?, ?)",
        [(each.key, each.name, each.sha256) for each in flight_map.sources],
    )
    connection.executemany(
        "INSERT INTO findings (severity, code, text, place, fix) VALUES (?, ?, ?, ?, ?)",
        [
            (found.severity, found.code, found.text, found.where, found.fix)
            for found in flight_map.findings
        ],
    )
    _insert_meta(connection, _meta_of(flight_map))


def _meta_of(flight_map: FlightMap) -> dict[str, str]:
    prescription = flight_map.prescription
    return {
        "flight_map_version": VERSION,
        "origin_latitude_deg": repr(flight_map.frame.latitude_deg),
        "origin_longitude_deg": repr(flight_map.frame.longitude_deg),
        "overlap": prescription.overlap,
        "default_rate_l_ha": json.dumps(prescription.default_rate_l_ha),
        "is_bounded": json.dumps(flight_map.is_bounded),
        "map_sha256": prescription.sha256,
        "source": flight_map.source,
        "frozen": json.dumps(dict(flight_map.frozen), sort_keys=True),
        "compiled_utc": flight_map.compiled_utc,
        "compiled_by": flight_map.compiled_by,
        "compiled_with": flight_map.compiled_with,
    }


def _insert_meta(connection: sqlite3.Connection, meta: dict[str, str]) -> None:
    connection.executemany("INSERT INTO meta (key, value) VALUES (?, ?)", meta.items())


def _blobs(shapes: Sequence[Geometry]) -> list[tuple[bytes]]:
    array = np.array(shapes, dtype=object)
    binaries = shapely.to_wkb(array, byte_order=1, flavor="iso", output_dimension=2)
    return [
        (geometry_blob(wkb, srs_id=LOCAL_ID, is_empty=bool(shapely.is_empty(shape))),)
        for wkb, shape in zip(binaries, shapes, strict=True)
    ]
