"""Places at which a map is asked: random, the same for the same map, and away from its edges."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely
from numpy.typing import NDArray
from pyproj import Transformer
from shapely import STRtree

from companion.core.frame import LocalFrame
from missions.maps.build import frame_for
from missions.maps.cells import bounds_deg, corner, to_degrees
from missions.maps.convert.rasterise import cell_rates
from missions.maps.crs import WGS84
from missions.maps.local import project_all
from missions.maps.model import Floats, MapCells, MapFile

Bools = NDArray[np.bool_]

# Of the places that are drawn, some lie too near to an edge or outside all ground.
_DRAWN_PER_POINT = 6
# Two circles of eight points around a place, the outer of radius 1.
_ROUND = np.outer((0.5, 1.0), np.exp(2j * np.pi * np.arange(8) / 8)).ravel()


def sample_places(
    map_file: MapFile,
    *,
    count: int,
    margin_m: float,
    around: MapFile | None = None,
    seed: int = 1,
) -> tuple[Floats, Floats]:
    """Return longitude and latitude of places away from edges, most of them on ground with a rate.

    The same map gives the same places. There are fewer than `count` where little ground is away
    from edges; every sixth lies anywhere in this map or in `around`, where there may be no rate.
    """
    random = np.random.default_rng(seed)
    frame = frame_for(map_file)
    to_degrees = Transformer.from_crs(frame.crs, WGS84, always_xy=True)
    drawn = count * _DRAWN_PER_POINT
    east, north = (
        _on_zones(map_file, frame, drawn, random)
        if map_file.cells is None
        else _on_cells(map_file.cells, frame, drawn, random)
    )
    west, south, right, top = _box_m((map_file, around or map_file), frame)
    every = slice(None, None, _DRAWN_PER_POINT)
    for values, low, high in ((east, west, right), (north, south, top)):
        anywhere = values[every]
        anywhere[:] = random.uniform(low - 2 * margin_m, high + 2 * margin_m, len(anywhere))
    longitude, latitude = to_degrees.transform(east, north)
    return _away(map_file, np.asarray(longitude), np.asarray(latitude), count, margin_m)


def centres(
    map_file: MapFile, cells: MapCells, *, count: int, margin_m: float, seed: int = 1
) -> tuple[Floats, Floats]:
    """Return middles of cells that lie away from the edges of a map, most of cells with a rate."""
    random = np.random.default_rng(seed)
    rated = np.flatnonzero(~np.isnan(cells.rates_l_ha))
    drawn = random.integers(0, cells.rates_l_ha.size, 2 * count)
    if len(rated):
        inside = random.random(len(drawn)) < 0.75
        drawn[inside] = random.choice(rated, int(inside.sum()))
    row, column = np.divmod(drawn, cells.rates_l_ha.shape[1])
    longitude, latitude = to_degrees(cells, column + 0.5, row + 0.5)
    return _away(map_file, longitude, latitude, count, margin_m)


def _away(
    map_file: MapFile, longitude: Floats, latitude: Floats, count: int, margin_m: float
) -> tuple[Floats, Floats]:
    """Return the first of the places that are away from all edges."""
    frame = frame_for(map_file)
    local = Transformer.from_crs(WGS84, frame.crs, always_xy=True).transform(longitude, latitude)
    east, north = np.asarray(local[0]), np.asarray(local[1])
    away = _away_from_rings(map_file, frame, east, north, margin_m)
    if map_file.cells is not None:
        away &= _alike_around(map_file.cells, frame, east, north, margin_m)
    chosen = np.flatnonzero(away)[:count]
    return longitude[chosen], latitude[chosen]


def _on_zones(
    map_file: MapFile, frame: LocalFrame, drawn: int, random: np.random.Generator
) -> tuple[Floats, Floats]:
    """Return places in the boxes of the parts of zones, more in the larger ones."""
    rated = [zone.geometry for zone in map_file.zones if zone.rate_l_ha is not None]
    parts = shapely.get_parts(project_all(np.array(rated, dtype=object), frame))
    if not len(parts):
        return np.zeros(drawn), np.zeros(drawn)
    # The root gives small parts more than their share, so that each of a few hundred is met.
    weight = np.sqrt(shapely.area(parts)) + 1e-9
    box = shapely.bounds(parts[random.choice(len(parts), drawn, p=weight / weight.sum())])
    share = random.random((2, drawn))
    return (
        box[:, 0] + share[0] * (box[:, 2] - box[:, 0]),
        box[:, 1] + share[1] * (box[:, 3] - box[:, 1]),
    )


def _on_cells(
    cells: MapCells, frame: LocalFrame, drawn: int, random: np.random.Generator
) -> tuple[Floats, Floats]:
    """Return places in cells that have a rate."""
    rated = np.flatnonzero(~np.isnan(cells.rates_l_ha))
    if not len(rated):
        return np.zeros(drawn), np.zeros(drawn)
    row, column = np.divmod(random.choice(rated, drawn), cells.rates_l_ha.shape[1])
    x, y = corner(cells.transform, column + random.random(drawn), row + random.random(drawn))
    east, north = Transformer.from_crs(cells.crs, frame.crs, always_xy=True).transform(x, y)
    return np.asarray(east), np.asarray(north)


def _box_m(maps: Sequence[MapFile], frame: LocalFrame) -> tuple[float, float, float, float]:
    """Return the bounds of all zones and cells."""
    grounds = [zone.geometry for one in maps for zone in one.zones]
    boxes = [shapely.box(*bounds_deg(one.cells)) for one in maps if one.cells is not None]
    local = project_all(np.array([*grounds, *boxes], dtype=object), frame)
    west, south, east, north = shapely.total_bounds(local).tolist()
    return west, south, east, north


def _away_from_rings(
    map_file: MapFile, frame: LocalFrame, east: Floats, north: Floats, margin_m: float
) -> Bools:
    """Tell which places have no edge of a zone or of the boundary within the margin."""
    areas = [zone.geometry for zone in map_file.zones]
    if map_file.boundary is not None:
        areas.append(map_file.boundary)
    away = np.ones(len(east), dtype=np.bool_)
    if areas:
        local = project_all(np.array(areas, dtype=object), frame)
        rings = shapely.get_rings(shapely.get_parts(local))
        near, _ = STRtree(rings).query(
            shapely.points(east, north), predicate="dwithin", distance=margin_m
        )
        away[near] = False
    return away


def _alike_around(
    cells: MapCells, frame: LocalFrame, east: Floats, north: Floats, margin_m: float
) -> Bools:
    """Tell which places have the same rate all round them."""
    to_degrees = Transformer.from_crs(frame.crs, WGS84, always_xy=True)
    here = cell_rates(cells, *to_degrees.transform(east, north))
    alike = np.ones(len(east), dtype=np.bool_)
    for direction in margin_m * _ROUND:
        there = cell_rates(
            cells, *to_degrees.transform(east + direction.real, north + direction.imag)
        )
        alike &= (there == here) | (np.isnan(there) & np.isnan(here))
    return alike
