"""Whether a written map prescribes what its source does: both asked at the same random places."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from shapely import STRtree

from companion.maps.build import frame_for
from companion.maps.cells import cell_size_m
from companion.maps.convert.rasterise import cell_rates
from companion.maps.convert.sample_places import centres, sample_places
from companion.maps.model import Floats, MapFile

POINTS = 1000
# Nine decimals of a degree are a tenth of a millimetre, and what is straight in one projection is
# bent by less than that in another: this is ample.
EDGE_M = 0.02


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """What two maps say at the same places.

    At `rated` of the `points` the source has a rate. `change_l_ha` is the largest difference where
    both have one; `lost` counts the places where only one has; `worst` (latitude, longitude) is a
    place of the largest difference or loss.
    """

    points: int
    rated: int
    change_l_ha: float
    lost: int
    worst: tuple[float, float] | None


def compare(
    source: MapFile,
    written: MapFile,
    *,
    overlaps: Sequence[str],
    same_cells: bool = False,
    zero_is_none: bool = False,
    count: int = POINTS,
) -> Comparison:
    """Return the largest difference between two maps, away from the edges of the source.

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
    gap = np.zeros(len(longitude))
    rated = np.zeros(len(longitude), dtype=np.bool_)
    for overlap in overlaps:
        one = rates_at(source, longitude, latitude, overlap)
        two = rates_at(written, longitude, latitude, overlap)
        rated |= ~np.isnan(one)
        if zero_is_none:
            one, two = np.nan_to_num(one), np.nan_to_num(two)
        lost = np.isnan(one) != np.isnan(two)
        gap = np.maximum(gap, np.where(lost, np.inf, np.nan_to_num(np.abs(one - two))))
    both = gap[np.isfinite(gap)]
    worst = int(np.argmax(gap)) if len(gap) else 0
    return Comparison(
        points=len(gap),
        rated=int(rated.sum()),
        change_l_ha=float(both.max(initial=0.0)),
        lost=int(np.isinf(gap).sum()),
        worst=(float(latitude[worst]), float(longitude[worst])) if gap.any() else None,
    )


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
    rated = [zone for zone in map_file.zones if zone.rate_l_ha is not None]
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
