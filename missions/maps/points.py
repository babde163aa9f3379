"""The rate at given points, as the core sees it in flight."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import STRtree

from companion.core.cells import NO_RATE
from companion.core.prescription import Prescription
from missions.maps.build import build_prescription, frame_for
from missions.maps.cells import turns_clockwise
from missions.maps.local import places
from missions.maps.model import Floats, MapCells, MapFile, MapZone

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
