"""Outlines from files: repaired where their rings cross, and near the field they are meant for."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TypeVar

import numpy as np
import shapely
from shapely import MultiPolygon
from shapely.errors import ShapelyError
from shapely.geometry.base import BaseGeometry

from companion.core.cells import NO_RATE
from companion.core.frame import WGS84, LocalFrame
from companion.core.prescription import Prescription
from companion.errors import MapError
from missions.errors import PlanError
from missions.maps.build import frame_for
from missions.maps.cells import grid_of
from missions.maps.local import Area, as_area, make_valid, polygons_of, project_all
from missions.maps.model import MapFile, Value, as_number
from missions.maps.registry import Record, read_area, read_map, read_records
from missions.strips import Floats

T = TypeVar("T")

# The nearest land is 1.4 degrees south and 5.6 east of 0, 0.
AT_SEA_DEG = 1.0
# 1.1 km at the equator, 0.5 km at 63 degrees of latitude: more than a fence or a turn needs.
MERIDIAN_DEG = 0.01


# What a file leaves open, by the code of its refusal, and what answers it.
NOTHING_TOLD: Mapping[str, str | None] = MappingProxyType({})
ANSWERS = {"no-crs": "crs", "wrong-crs": "crs", "several-layers": "layer"}


def told(read: Callable[..., T], asked: Mapping[str, str | None]) -> T:
    """Return what `read` makes of a file; it is told only what the file leaves open.

    One plan reads several files: what is asked for the one without a CRS must not move the others.
    """
    answers: dict[str, str] = {}
    while True:
        try:
            return read(**answers)
        except MapError as error:
            name = ANSWERS.get(error.code or "", "")
            answer = asked.get(name)
            if answer is None or name in answers:
                raise
            answers[name] = answer


def outline_of(
    path: Path,
    map_file: MapFile | None,
    said: list[str],
    asked: Mapping[str, str | None] = NOTHING_TOLD,
) -> Area:
    """Return the field's outline; of a prescription in cells, that of its cells with a rate.

    `asked` has the CRS and the layer, where they are given. Zones of the prescription itself may
    lie in each other: what then holds its rule of overlaps says.

    Rings that cross themselves are repaired, and what that changes is added to `said`.
    """
    same = map_file is not None and map_file.path.resolve() == path.resolve()
    try:
        outline = told(partial(read_area, path, repairs=said, nested=same), asked)
        check_degrees(outline, path)
        return outline
    except MapError as error:
        if error.code != "no-polygon":
            raise
        try:
            cells = map_file if same else told(partial(read_map, path), asked)
        except MapError:
            raise error from None  # no map of cells either: what is missing is an outline
        if cells is None or cells.cells is None:
            raise
        found = _of_cells(cells)
        check_degrees(found, path)
        return found


# Beyond the hull of a map's zones, so that the ground between spots counts as mapped: a share of
# the outline that a headland left out of the map does not come to (28 % of 2 ha with 10 m around);
# a share of the map that its generous border does not; a lesser share of both, as offsets make it.
BARE_SHARE, OUTSIDE_SHARE, SHIFTED_SHARE = 0.4, 0.5, 0.05
# So many cells tell a share to a few tenths of a percent.
CELLS_ASKED = 50_000


def apart_warnings(outline: BaseGeometry, prescription: Prescription) -> list[str]:
    """Warn where much of the field is not in the map or much of the map is not in the field.

    >>> from companion.core.prescription import Zone
    >>> field, zone = shapely.box(0, 0, 100, 100), shapely.box(90, 0, 190, 100)
    >>> zones = [Zone(name="a", polygon=zone, rate_l_ha=20.0)]
    >>> [line.split(":")[0] for line in apart_warnings(field, Prescription(zones))]
    ['90 % of the outline lies beyond the map, and 90 % of the map outside the outline']
    """
    if prescription.default_rate_l_ha is not None or not prescription.rates_l_ha:
        return []
    shapely.prepare(outline)
    mapped, outside = (_hull_of_cells if prescription.cells else _hull_of_zones)(
        prescription, outline
    )
    bare = float(shapely.area(shapely.difference(outline, mapped)) / outline.area)
    if bare < BARE_SHARE and outside < OUTSIDE_SHARE and min(bare, outside) < SHIFTED_SHARE:
        return []
    bare_percent, outside_percent = (round(100.0 * share, 1) for share in (bare, outside))
    return [
        f"{bare_percent:g} % of the outline lies beyond the map, and {outside_percent:g} % of the "
        "map outside the outline: ground without a rate is not sprayed; if the map should cover "
        "the field, check that both are of this field, their CRS and offset_east_m"
    ]


def _hull_of_zones(prescription: Prescription, outline: BaseGeometry) -> tuple[BaseGeometry, float]:
    """Return the hull of all zones, and which share of them is outside of a prepared outline."""
    zones = np.array([zone.polygon for zone in prescription.zones], dtype=object)
    hull: BaseGeometry = shapely.GeometryCollection(zones.tolist()).convex_hull
    parted = zones[~shapely.contains_properly(outline, zones)]
    outside_m2 = float(shapely.area(shapely.difference(parted, outline)).sum())
    return hull, outside_m2 / float(shapely.area(zones).sum())


def _hull_of_cells(prescription: Prescription, outline: BaseGeometry) -> tuple[BaseGeometry, float]:
    """Return the same of cells, by the middles of some of them: as polygons they take minutes."""
    assert prescription.cells is not None
    row, column = np.nonzero(prescription.cells.classes != NO_RATE)
    to_frame = prescription.cells.to_frame
    first = np.flatnonzero(np.diff(row, prepend=-1))
    ends = np.append(first[1:], len(row)) - 1
    rows, sides = row[first], (column[first], column[ends] + 1)
    corners = [
        np.column_stack(to_frame(side.astype(float), (rows + down).astype(float)))
        for side in sides
        for down in (0, 1)
    ]
    hull: BaseGeometry = shapely.MultiPoint(np.concatenate(corners)).convex_hull
    some = slice(None, None, max(1, len(row) // CELLS_ASKED))
    middles = (one[some].astype(np.float64) + 0.5 for one in (column, row))
    inside = shapely.contains_xy(outline, *to_frame(*middles))
    return hull, 1.0 - float(inside.mean())


def check_degrees(area: Area, path: Path) -> None:
    """Refuse metres of a local origin that were read as degrees: they begin at 0, 0.

    And what lies so near the 180th meridian that its fence or a turn could cross it: autopilots
    compare longitudes as plain numbers, and such a fence goes round the world.

    Raises:
        PlanError: for either; no field lies beside 0, 0, in the Gulf of Guinea.
    """
    west, south, east, north = area.bounds
    if max(abs(west), abs(east)) > 180.0 - MERIDIAN_DEG:
        raise PlanError(
            f"{path}: the outline lies at the 180th meridian ({west:.5f} to "
            f"{east:.5f}), over which no autopilot's fence can be drawn; plan the ground on one "
            f"side, {MERIDIAN_DEG:g} degrees from it"
        )
    beside = west <= AT_SEA_DEG and east >= -AT_SEA_DEG
    if beside and south <= AT_SEA_DEG and north >= -AT_SEA_DEG:
        raise PlanError(
            f"{path}: the outline lies at latitude 0, longitude 0, in the sea (x {west:g} to "
            f"{east:g}, y {south:g} to {north:g}); these look like metres from a local origin: "
            "give longitude and latitude in degrees, or metres with their CRS"
        )


def _of_cells(map_file: MapFile) -> MultiPolygon | Area:
    """Return the ground of all cells with a rate, in longitude and latitude."""
    if map_file.cells is None:
        raise PlanError(f"{map_file.path}: there are no cells")
    frame = frame_for(map_file)

    def back(points: Floats) -> Floats:
        lat, lon = frame.to_geographic_all(points[:, 0].tolist(), points[:, 1].tolist())
        return np.column_stack([lon, lat])

    local = grid_of(map_file.cells, frame, map_file.path).outline
    found = as_area(polygons_of(shapely.transform(local, back)))
    if found is None:
        raise PlanError(f"{map_file.path}: no cell has a rate")
    return found


def near_area(
    path: Path, frame: LocalFrame, asked: Mapping[str, str | None], *, nested: bool = True
) -> MultiPolygon:
    """Return the ground of a file, which must lie near the field to mean anything for it."""
    area = told(partial(read_area, path, nested=nested), asked)
    west, south, east, north = area.bounds
    check_near(str(path), (south + north) / 2.0, (west + east) / 2.0, frame)
    return area


def near_features(
    path: Path, frame: LocalFrame, asked: Mapping[str, str | None]
) -> list[BaseGeometry]:
    """Return areas, lines and points of a file, which must lie near the field."""
    found = [record.geometry for record in told(partial(read_records, path), asked)]
    west, south, east, north = shapely.total_bounds(np.array(found, dtype=object)).tolist()
    check_near(str(path), (south + north) / 2.0, (west + east) / 2.0, frame)
    return found


# Whether what a task names lies near its field; a forgotten sign puts it on another continent.

# Fields are refused beyond 20 km of extent, and so are depots beyond as much: this is no field's.
FAR_M = 50_000.0


def check_near(what: str, latitude_deg: float, longitude_deg: float, frame: LocalFrame) -> None:
    """Refuse what lies far from the field, and say when one sign would bring it there.

    Raises:
        PlanError: naming `what` and where it lies.
    """
    far_m = _far_m(latitude_deg, longitude_deg, frame)
    if far_m <= FAR_M:
        return
    for name, lat, lon in (
        ("latitude", -latitude_deg, longitude_deg),
        ("longitude", latitude_deg, -longitude_deg),
        ("latitude and longitude", -latitude_deg, -longitude_deg),
    ):
        if _far_m(lat, lon, frame) <= FAR_M:
            fix = f"its {name} is of the wrong hemisphere: change the sign"
            break
    else:
        swapped = abs(longitude_deg) <= 90.0 and _far_m(longitude_deg, latitude_deg, frame) <= FAR_M
        fix = "latitude and longitude are swapped" if swapped else "is it of another field?"
    raise PlanError(
        f"{what} lies at {latitude_deg:.4f}, {longitude_deg:.4f}, {far_m / 1000.0:.0f} km from the "
        f"field at {frame.latitude_deg:.4f}, {frame.longitude_deg:.4f}; {fix}"
    )


def _far_m(latitude_deg: float, longitude_deg: float, frame: LocalFrame) -> float:
    """Return the distance to the field's middle; infinite for what is no place."""
    if not (abs(latitude_deg) <= 90.0 and abs(longitude_deg) <= 180.0):
        return float("inf")
    _, _, far_m = WGS84.inv(longitude_deg, latitude_deg, frame.longitude_deg, frame.latitude_deg)
    return float(far_m)


# What stands in the way: areas, trees as points with a radius, power lines with a corridor.
#
# How far a point or a line reaches is never guessed: each has it as an attribute, or the command
# line says it for all that have none.

RADIUS_MAX_M, CORRIDOR_MAX_M, HEIGHT_MAX_M = 100.0, 500.0, 500.0
# Points grow to polygons of 16 corners around their circle, not in it; corners of areas are rounded
# more closely, 0.2 % of the buffer outside: how they are flown around is decided later.
QUARTER, AROUND = 4, 1.0 / math.cos(math.pi / 16.0)
CLOSE_QUARTER, CLOSELY_AROUND = 12, 1.0 / math.cos(math.pi / 48.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Obstacle:
    """Ground, points or lines in longitude and latitude, and how far beyond them it reaches.

    `height_m` is above the ground; None is not known, and so as high as any.
    """

    geometry: BaseGeometry
    beyond_m: float = 0.0
    height_m: float | None = None

    def ground(
        self, frame: LocalFrame, buffer_m: float, offset_m: tuple[float, float] = (0.0, 0.0)
    ) -> BaseGeometry:
        """Return its ground in metres with a buffer, all of it and with straight edges."""
        local = project_all(np.array([self.geometry], dtype=object), frame, offset_m=offset_m)[0]
        far_m = self.beyond_m + buffer_m
        dimensions = int(shapely.get_dimensions(local))
        if dimensions == 2:
            local = local if local.is_valid else make_valid(local)
        if local is None:
            raise PlanError("an obstacle has no ground; draw it again")
        found: BaseGeometry = (
            local.buffer(AROUND * far_m, quad_segs=QUARTER)
            if dimensions == 0
            else around_ground(local, far_m)
        )
        return found


def around_ground(local: BaseGeometry, far_m: float) -> BaseGeometry:
    """Return ground, or lines, and all that is so near to them."""
    found: BaseGeometry = local.buffer(
        CLOSELY_AROUND * far_m, quad_segs=CLOSE_QUARTER, cap_style="square"
    )
    return found


def read_obstacles(
    path: Path,
    frame: LocalFrame,
    *,
    radius_m: float | None = None,
    corridor_m: float | None = None,
    opens: Mapping[str, str | None] = NOTHING_TOLD,
) -> list[Obstacle]:
    """Return the obstacles in a file; what has no radius or corridor of its own takes those given.

    Raises:
        PlanError, MapError: in one line, which record lacks what, or that the file is of elsewhere.
    """
    records = told(partial(read_records, path), opens)
    west, south, east, north = shapely.total_bounds([each.geometry for each in records]).tolist()
    check_near(str(path), (south + north) / 2.0, (west + east) / 2.0, frame)
    return _together([_obstacle(path, record, radius_m, corridor_m) for record in records])


def _together(obstacles: list[Obstacle]) -> list[Obstacle]:
    """Return the obstacles, those of one kind, reach and height as one: there may be thousands."""
    alike: dict[tuple[int, float, float | None], list[BaseGeometry]] = {}
    for each in obstacles:
        kind = int(shapely.get_dimensions(each.geometry))
        alike.setdefault((kind, each.beyond_m, each.height_m), []).append(each.geometry)
    return [
        Obstacle(geometry=_united(shapes), beyond_m=beyond_m, height_m=height_m)
        for (_, beyond_m, height_m), shapes in alike.items()
    ]


def _united(shapes: list[BaseGeometry]) -> BaseGeometry:
    try:
        return shapely.union_all(np.array(shapes, dtype=object))
    except ShapelyError as error:
        raise PlanError(f"obstacles do not unite ({str(error)[:80]}); repair them") from error


def _obstacle(
    path: Path, record: Record, radius_m: float | None, corridor_m: float | None
) -> Obstacle:
    height_m = _metres(path, record, "height_m", HEIGHT_MAX_M)
    dimensions = shapely.get_dimensions(record.geometry)
    if dimensions == 2:
        return Obstacle(geometry=record.geometry, height_m=height_m)
    if dimensions == 0:
        given_m = _metres(path, record, "radius_m", RADIUS_MAX_M)
        beyond_m = radius_m if given_m is None else given_m
        what, name, option = "point", "radius_m", "--obstacle-radius-m"
        about = "its radius in metres, the crown of a tree"
    else:
        given_m = _metres(path, record, "corridor_m", CORRIDOR_MAX_M)
        width_m = corridor_m if given_m is None else given_m
        beyond_m = None if width_m is None else width_m / 2.0
        what, name, option = "line", "corridor_m", "--corridor-m"
        about = "the whole width in metres to keep free along it"
    if beyond_m is None:
        raise PlanError(
            f"{path}: record {record.name} is a {what} without {name} ({about}); add the "
            f"attribute, or give one for all with {option}"
        )
    return Obstacle(geometry=record.geometry, beyond_m=beyond_m, height_m=height_m)


def _metres(path: Path, record: Record, name: str, most_m: float) -> float | None:
    """Return an attribute; None where the record has none."""
    values: Mapping[str, Value] = record.values
    try:
        found = as_number(values.get(name))
    except ValueError:
        found = math.nan
    if found is None or 0.0 < found <= most_m:
        return found
    raise PlanError(
        f"{path}: {name} of record {record.name} is {str(values[name])[:40]!r}; write metres "
        f"above 0 and up to {most_m:g}"
    )
