"""Whether a written map prescribes what its source does: both asked at the same random places."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from pyproj import Transformer
from shapely import STRtree

from companion.core.frame import LocalFrame
from missions.maps.build import frame_for
from missions.maps.cells import bounds_deg, cell_size_m, corner, to_degrees
from missions.maps.convert.rasterise import cell_rates
from missions.maps.crs import WGS84
from missions.maps.local import project_all
from missions.maps.model import Floats, MapCells, MapFile

POINTS = 1000
# Nine decimals of a degree are a tenth of a millimetre, and what is straight in one projection is
# bent by less than that in another: this is ample.
EDGE_M = 0.02
# What a conversion may change of a rate; files hold three decimals or more.
CHANGE_MAX_L_HA = 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """What two maps say at the same places.

    At `rated` of the `points` the source has a rate. `change_l_ha` is the largest difference where
    both have one; `lost` counts the places where only one has; `worst` (latitude, longitude) is a
    place of the largest difference or loss.

    Those places keep away from edges where the written map has cells of its own. So that nobody
    takes that for the whole map, `anywhere` counts places with a rate up to the very edges,
    `changed` those of them that have another rate or none in one of the two, and
    `changed_max_l_ha` is the most by which both rates differ there; all 0 where edges stay.
    """

    points: int
    rated: int
    change_l_ha: float
    lost: int
    worst: tuple[float, float] | None
    anywhere: int = 0
    changed: int = 0
    changed_max_l_ha: float = 0.0

    @property
    def changed_percent(self) -> float | None:
        """Return the share of ground with another rate, None where all edges stay."""
        return 100.0 * self.changed / self.anywhere if self.anywhere else None


def compare(
    source: MapFile,
    written: MapFile,
    *,
    overlaps: Sequence[str],
    same_cells: bool = False,
    zero_is_none: bool = False,
    count: int = POINTS,
) -> Comparison:
    """Return the largest difference between two maps, and how much of the ground differs.

    Each of the policies `overlaps` has to give the same on both. Where the written map has cells
    that its source has not, both are asked in the middle of its cells, and beyond that only where
    every edge is further than a cell. With `zero_is_none`, a rate of 0 may stand for no rate, as
    in formats that have a number for every cell.
    """
    places = []
    margin_m = EDGE_M
    if written.cells is not None and not same_cells:
        size_m = cell_size_m(written.cells, frame_for(written))
        middle_m = max(EDGE_M, 0.05 * min(size_m))
        places.append(centres(source, written.cells, count=count, margin_m=middle_m))
        margin_m = 1.1 * float(np.hypot(*size_m))
    places.append(sample_places(source, count=count, margin_m=margin_m, around=written))
    longitude, latitude = (np.concatenate(values) for values in zip(*places, strict=True))
    asked = _Asked(source, written, overlaps, zero_is_none)
    one, _, gap = asked.at(longitude, latitude)
    both = gap[np.isfinite(gap)]
    worst = int(np.argmax(gap)) if len(gap) else 0
    found = Comparison(
        points=len(gap),
        rated=int(one.sum()),
        change_l_ha=float(both.max(initial=0.0)),
        lost=int(np.isinf(gap).sum()),
        worst=(float(latitude[worst]), float(longitude[worst])) if gap.any() else None,
    )
    if margin_m == EDGE_M:
        return found
    one, two, gap = asked.at(
        *sample_places(source, count=count, margin_m=EDGE_M, around=written, seed=2)
    )
    there = one | two
    return replace(
        found,
        anywhere=int(there.sum()),
        changed=int((gap[there] > CHANGE_MAX_L_HA).sum()),
        changed_max_l_ha=float(gap[np.isfinite(gap)].max(initial=0.0)),
    )


class _Asked(NamedTuple):
    """Two maps that are asked for their rates at the same places."""

    source: MapFile
    written: MapFile
    overlaps: Sequence[str]
    zero_is_none: bool

    def at(self, longitude: Floats, latitude: Floats) -> tuple[Bools, Bools, Floats]:
        """Return where each of the two has a rate, and by how much they differ at most.

        The difference is infinite where only one of the two has a rate.
        """
        gap = np.zeros(len(longitude))
        rated = [np.zeros(len(longitude), dtype=np.bool_) for _ in range(2)]
        for overlap in self.overlaps:
            one = rates_at(self.source, longitude, latitude, overlap)
            two = rates_at(self.written, longitude, latitude, overlap)
            rated[0] |= ~np.isnan(one)
            rated[1] |= ~np.isnan(two)
            if self.zero_is_none:
                one, two = np.nan_to_num(one), np.nan_to_num(two)
            lost = np.isnan(one) != np.isnan(two)
            gap = np.maximum(gap, np.where(lost, np.inf, np.nan_to_num(np.abs(one - two))))
        return rated[0], rated[1], gap


def rates_at(
    map_file: MapFile, longitude_deg: Floats, latitude_deg: Floats, overlap: str
) -> Floats:
    """Return the rate that a map prescribes at each place, NaN where it prescribes none."""
    if map_file.cells is None:
        rates = _zone_rates(map_file, longitude_deg, latitude_deg, overlap)
    else:
        rates = cell_rates(map_file.cells, longitude_deg, latitude_deg)
    if map_file.boundary is None:
        return rates
    shapely.prepare(map_file.boundary)
    inside = shapely.contains_xy(map_file.boundary, longitude_deg, latitude_deg)
    if map_file.default_rate_l_ha is not None:
        rates[np.isnan(rates)] = map_file.default_rate_l_ha
    return np.where(inside, rates, np.nan)


def _zone_rates(map_file: MapFile, longitude: Floats, latitude: Floats, overlap: str) -> Floats:
    rated = map_file.rated
    rates = np.full(len(longitude), np.nan)
    if not rated:
        return rates
    areas = np.array([zone.geometry for zone in rated], dtype=object)
    parts, owner = shapely.get_parts(areas, return_index=True)
    shapely.prepare(parts)
    place, part = STRtree(parts).query(shapely.points(longitude, latitude))
    within = shapely.contains_xy(parts[part], longitude[place], latitude[place])
    place, zone = place[within], owner[part[within]]
    order = np.lexsort((zone, place))
    place, zone = place[order], zone[order]
    rate_of = np.array([one.rate_l_ha for one in rated], dtype=np.float64)
    if overlap == "last":
        rates[place] = rate_of[zone]  # of equal numbers the last one holds
    elif overlap == "mean":
        number = np.bincount(place, minlength=len(rates))
        total = np.bincount(place, weights=rate_of[zone], minlength=len(rates))
        rates[number > 0] = total[number > 0] / number[number > 0]
    else:
        (np.fmax if overlap == "max" else np.fmin).at(rates, place, rate_of[zone])
    return rates


# Places at which a map is asked: random, the same for the same map, and away from its edges.

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
    rated = [zone.geometry for zone in map_file.rated]
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
