"""Whether a written map prescribes what its source does: both asked at the same random places."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import shapely
from shapely import STRtree

from missions.maps.build import frame_for
from missions.maps.cells import cell_size_m
from missions.maps.convert.rasterise import cell_rates
from missions.maps.convert.sample_places import Bools, centres, sample_places
from missions.maps.model import Floats, MapFile

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
