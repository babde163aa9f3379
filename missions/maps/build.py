"""From a map file to the core's `Prescription`, in metres of one frame; and rates at points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import get_args

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import MultiPolygon, STRtree
from shapely.errors import ShapelyError

from companion.core.cells import NO_RATE
from companion.core.frame import LocalFrame
from companion.core.outline import dissolved
from companion.core.prescription import Overlap, Prescription, Zone, closed
from companion.flight_map import moved
from missions.maps.cells import bounds_deg, grid_of, turns_clockwise
from missions.maps.local import (
    Area,
    as_area,
    frame_around,
    make_valid,
    places,
    polygons_of,
    project,
    project_all,
)
from missions.maps.model import Floats, MapCells, MapFile, MapZone, map_error, unusable_polygons
from missions.maps.overlaps import PAIRS_MAX, check_outline, overlaps

__all__ = ["build_prescription", "frame_for", "project"]


def frame_for(map_file: MapFile) -> LocalFrame:
    """Return the frame whose origin is the centre of the map's bounds."""
    if map_file.cells is None:
        return frame_around(zone.geometry for zone in map_file.zones)
    west, south, east, north = bounds_deg(map_file.cells)
    return LocalFrame(latitude_deg=(south + north) / 2, longitude_deg=(west + east) / 2)


def build_prescription(
    map_file: MapFile,
    frame: LocalFrame,
    *,
    overlap: str = "error",
    boundary: MultiPolygon | None = None,
    exclusions: Sequence[MultiPolygon] = (),
    default_rate_l_ha: float | None = None,
    offset_east_m: float = 0.0,
    offset_north_m: float = 0.0,
) -> Prescription:
    """Return the prescription of a map, moved by the offset between map and receiver.

    Boundary and exclusions, in longitude and latitude, move with it: the offset is between two
    sets of coordinates, not between two files. Without `boundary` and `default_rate_l_ha` those
    of the map itself hold, where it has any; the map's default only inside the map's boundary.
    Zones without a rate are left out; under `error` zones that share more than a square metre are
    refused.
    """
    policy = _policy(map_file, map_file.rule(overlap))
    offset_m = (offset_east_m, offset_north_m)
    if not np.isfinite(offset_m).all():
        raise ValueError(f"offset is not a distance: {offset_m}")
    if boundary is None:
        boundary = map_file.boundary
    if default_rate_l_ha is None and map_file.boundary is not None:
        default_rate_l_ha = map_file.default_rate_l_ha
    if not map_file.rates_l_ha:
        raise map_error(
            map_file.path,
            f"nothing has a rate in {map_file.rate_field}",
            fix="name another column with --rate-field (prescription.rate_field)",
            code="null-rate",
        )
    try:
        zones = _zones(map_file, frame)
        if policy == "error":
            _check_overlaps(map_file, zones)
        cells = map_file.cells
        border: Area | None
        if boundary is not None:
            border = _projected(boundary, frame)
        else:
            border = _outline(map_file, zones) if cells is None else None
        built = Prescription(
            zones,
            boundary=border,
            exclusions=[_projected(area, frame) for area in exclusions],
            overlap=policy,
            default_rate_l_ha=default_rate_l_ha,
            cells=None if cells is None else grid_of(cells, frame, map_file.path),
            sha256=map_file.sha256,
        )
        if offset_m == (0.0, 0.0):
            return built
        # As a flight moves what is in its flight map.
        is_bounded = border is not None or bool(exclusions)
        return moved(built, east_m=offset_east_m, north_m=offset_north_m, is_bounded=is_bounded)
    except ShapelyError as error:
        raise unusable_polygons(map_file.path, error) from None


def _policy(map_file: MapFile, overlap: str) -> Overlap:
    for policy in get_args(Overlap):
        if policy == overlap:
            return policy  # type: ignore[no-any-return]
    raise map_error(
        map_file.path,
        f"prescription.overlap is {overlap!r}",
        fix=f"take one of {', '.join(get_args(Overlap))}",
        code="overlap-policy",
    )


def _zones(map_file: MapFile, frame: LocalFrame) -> list[Zone]:
    """Return all zones that have a rate, in metres."""
    rated = map_file.rated
    if not rated:
        return []
    degrees = np.array([zone.geometry for zone in rated], dtype=object)
    local = project_all(degrees, frame)
    zones = []
    for area, source, valid in zip(local, rated, shapely.is_valid(local), strict=True):
        polygon = area if valid else make_valid(area)
        if polygon is not None and source.rate_l_ha is not None:
            zones.append(Zone(name=source.name, polygon=polygon, rate_l_ha=source.rate_l_ha))
    return zones


def _outline(map_file: MapFile, zones: Sequence[Zone]) -> Area:
    """Return the outline of all zones, which is the border where there is no boundary."""
    parts = shapely.get_parts(np.array([zone.polygon for zone in zones], dtype=object))
    ground = dissolved(parts)
    check_outline(ground, map_file.path)
    return as_area(polygons_of(closed(ground))) or MultiPolygon()


def _projected(area: Area, frame: LocalFrame) -> Area:
    """Return a boundary or exclusion in metres; rounding can make touching rings cross."""
    local = project(area, frame)
    return local if local.is_valid else (make_valid(local) or MultiPolygon())


def _check_overlaps(map_file: MapFile, zones: Sequence[Zone]) -> None:
    found = overlaps([zone.polygon for zone in zones])
    if not found:
        return
    worst = found[0]
    least = "at least " if len(found) > PAIRS_MAX else ""
    more = f" (and {least}{len(found) - 1} more pairs)" if len(found) > 1 else ""
    raise map_error(
        map_file.path,
        f"zones {zones[worst.first].name} and {zones[worst.second].name} overlap by "
        f"{worst.area_m2:.1f} m2{more}",
        fix="correct the map, or set prescription.overlap to max, min, mean or last",
        code="overlap",
    )


Point = tuple[float, float]
Answer = tuple[float | None, list[str]]


def point_rates(
    map_file: MapFile, points: Sequence[Point], *, overlap: str = "error"
) -> list[dict[str, object]]:
    """Return rate and zone at each (latitude, longitude), in the order of the points.

    A point exactly on an edge takes the smallest rate of the zones that meet there. Ground that
    only a zone without a rate covers has that zone's name and no rate. A boundary in the map
    itself takes no rate away here; `inside` tells whether the point lies within it, None where
    the map has none.
    """
    frame = frame_for(map_file)
    # Everywhere, so that only the zones decide: the map's boundary is answered for apart.
    prescription = build_prescription(replace(map_file, boundary=None), frame, overlap=overlap)
    east_m, north_m = places(points, frame).T
    real = np.isfinite(east_m) & np.isfinite(north_m)
    east_m, north_m = np.where(real, east_m, np.inf), np.where(real, north_m, np.inf)
    if map_file.cells is None:
        answers = _in_zones(prescription, east_m, north_m)
        answers |= _touched(
            map_file, points, [i for i in range(len(points)) if real[i] and i not in answers]
        )
    else:
        answers = _in_cells(prescription, map_file.cells, east_m, north_m)
    inside = _inside(map_file, points)
    default = map_file.default_rate_l_ha
    if default is not None and inside is not None:
        answers = {
            index: (default, ["default"]) for index in np.flatnonzero(inside).tolist()
        } | answers
    return [
        _row(point, *answers.get(index, (None, [])))
        | ({} if inside is None else {"inside": bool(inside[index])})
        for index, point in enumerate(points)
    ]


def _in_zones(prescription: Prescription, east_m: Floats, north_m: Floats) -> dict[int, Answer]:
    """Return rate and names at the points that lie in a zone with a rate."""
    return {
        index: (
            prescription.rate_of(zones),
            [prescription.zone_name(zone) for zone in sorted(zones)],
        )
        for index, zones in enumerate(prescription.zones_at(east_m, north_m))
        if zones
    }


def _in_cells(
    prescription: Prescription, cells: MapCells, east_m: Floats, north_m: Floats
) -> dict[int, Answer]:
    """Return rate and cell at the points that lie in a cell with a rate.

    Rows are counted as in the file, from 1.
    """
    grid = prescription.cells
    if grid is None:
        raise ValueError("a prescription without cells")
    rows = grid.shape[0]
    backwards = turns_clockwise(cells)
    found: dict[int, Answer] = {}
    for index, kind in enumerate(grid.classes_at(east_m, north_m).tolist()):
        if kind == NO_RATE:
            continue
        column, row = grid.to_cells.at(float(east_m[index]), float(north_m[index]))
        number = rows - int(row) if backwards else int(row) + 1
        found[index] = prescription.zone_rate(kind), [f"row {number}, column {int(column) + 1}"]
    return found


def _inside(map_file: MapFile, points: Sequence[Point]) -> NDArray[np.bool_] | None:
    """Return whether each point lies inside the map's own boundary."""
    if map_file.boundary is None:
        return None
    degrees = np.array(points, dtype=np.float64).reshape(-1, 2)
    inside: NDArray[np.bool_] = shapely.contains_xy(map_file.boundary, degrees[:, 1], degrees[:, 0])
    return inside


def _row(point: Point, rate_l_ha: float | None, names: list[str]) -> dict[str, object]:
    latitude_deg, longitude_deg = point
    zone = ", ".join(names) if names else None
    return {"lat": latitude_deg, "lon": longitude_deg, "rate_l_ha": rate_l_ha, "zone": zone}


def _touched(map_file: MapFile, points: Sequence[Point], which: list[int]) -> dict[int, Answer]:
    """Return, for points inside no zone with a rate, the smallest rate and the zones touched."""
    if not which:
        return {}
    zones = map_file.zones
    parts, owner = shapely.get_parts(
        np.array([zone.geometry for zone in zones], dtype=object), return_index=True
    )
    spots = shapely.points([(points[index][1], points[index][0]) for index in which])
    around: dict[int, list[MapZone]] = {index: [] for index in which}
    for place, part in STRtree(parts).query(spots, predicate="intersects").T.tolist():
        around[which[place]].append(zones[owner[part]])
    return {index: _smallest(met) for index, met in around.items()}


def _smallest(met: list[MapZone]) -> Answer:
    rates = [zone.rate_l_ha for zone in met if zone.rate_l_ha is not None]
    if not rates:
        return None, [zone.name for zone in met]
    return min(rates), [zone.name for zone in met if zone.rate_l_ha == min(rates)]
