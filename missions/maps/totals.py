"""What a map prescribes in all: ground and litres of each rate, as it would be sprayed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import MultiPolygon, STRtree

from companion.core.frame import LocalFrame
from companion.core.outline import without_overlay
from missions.maps.build import frame_for
from missions.maps.cells import cell_areas_m2, shares_inside
from missions.maps.convert.cell_zones import plain_zones
from missions.maps.convert.rasterise import in_field
from missions.maps.crs import Objects
from missions.maps.local import Area, make_valid, polygons_of, project, project_all
from missions.maps.model import Floats, MapFile, MapZone
from missions.maps.overlaps import OVERLAP_MAX_M2

M2_PER_HA = 10_000.0
# Of ground that is covered all over, rounding leaves less than this without a rate.
SLIVER_SHARE = 1e-7


@dataclass(frozen=True, slots=True, kw_only=True)
class Totals:
    """All ground of each rate, the least rate first."""

    rates_l_ha: Floats
    areas_ha: Floats

    @property
    def litres(self) -> Floats:
        """Return what the ground of each rate takes."""
        return self.rates_l_ha * self.areas_ha

    @property
    def area_ha(self) -> float:
        """Return the ground of all rates."""
        return float(self.areas_ha.sum())

    @property
    def all_litres(self) -> float:
        """Return what all ground takes."""
        return float(self.litres.sum())


def as_sprayed(map_file: MapFile) -> MapFile:
    """Return the map without a default: it has become zones or cells, none beyond the boundary."""
    if map_file.boundary is None:
        return replace(map_file, default_rate_l_ha=None)
    if map_file.cells is None:
        zones = tuple(plain_zones(map_file, clip=True))
        return replace(map_file, zones=zones, default_rate_l_ha=None)
    cells = in_field(map_file.cells, map_file, clip=True)
    return replace(map_file, cells=cells, default_rate_l_ha=None)


def totals(
    map_file: MapFile,
    *,
    boundary: MultiPolygon | None = None,
    default_rate_l_ha: float | None = None,
    exclusions: Sequence[MultiPolygon] = (),
    overlap: str = "error",
    frame: LocalFrame | None = None,
    areas_m2: Floats | None = None,
) -> Totals:
    """Return the ground of each rate inside the boundary, and so the litres: the only such sum.

    Zones and cells are cut at the boundary, not counted by their middles. As in flight, the
    map's own boundary and default hold where none are given, a default only inside a boundary,
    and ground under several zones has one rate, by the policy `overlap`; under `error`, which
    refuses more than slivers, it counts for each. `areas_m2` are those of `inside_m2`, for whoever
    has them already.
    """
    frame, overlap = frame or frame_for(map_file), map_file.rule(overlap)
    if default_rate_l_ha is None and map_file.boundary is not None:
        default_rate_l_ha = map_file.default_rate_l_ha
    ground = Ground.of(map_file.boundary if boundary is None else boundary, exclusions)
    if map_file.cells is None:
        rates, area_m2 = _of_zones(map_file, ground, overlap, frame, areas_m2)
        covered_m2 = None
    else:
        inside = inside_m2(map_file, ground, frame) if areas_m2 is None else areas_m2
        there = ~np.isnan(map_file.cells.rates_l_ha)
        rates, area_m2 = map_file.cells.rates_l_ha[there], inside[there]
        covered_m2 = float(area_m2.sum())
    if default_rate_l_ha is not None and ground.field is not None:
        if covered_m2 is None:
            covered_m2 = _covered_m2(map_file, ground, frame)
        left_m2 = project(ground.field, frame).area - covered_m2
        if left_m2 > SLIVER_SHARE * covered_m2:
            rates = np.append(rates, default_rate_l_ha)
            area_m2 = np.append(area_m2, left_m2)
    some = area_m2 > 0.0
    different, index = np.unique(rates[some], return_inverse=True)
    sums = np.bincount(index, weights=area_m2[some], minlength=len(different))
    return Totals(rates_l_ha=different, areas_ha=sums / M2_PER_HA)


@dataclass(frozen=True, slots=True, kw_only=True)
class Ground:
    """Where a map may be sprayed, in longitude and latitude.

    `field` is the boundary without the exclusions; without a boundary it is None, and `out` is
    what is taken away.
    """

    field: MultiPolygon | None
    out: MultiPolygon | None = None

    @classmethod
    def of(cls, boundary: MultiPolygon | None, exclusions: Sequence[MultiPolygon] = ()) -> Ground:
        """Return the ground inside a boundary, where there is one, and outside exclusions."""
        if not exclusions:
            return cls(field=boundary)
        out = MultiPolygon(polygons_of(shapely.union_all(list(exclusions))))
        if boundary is None:
            return cls(field=None, out=out)
        return cls(field=MultiPolygon(polygons_of(shapely.difference(boundary, out))))


def inside_m2(map_file: MapFile, ground: Ground, frame: LocalFrame) -> Floats:
    """Return how much of every zone or cell lies where it may be sprayed [m2]."""
    if map_file.cells is None:
        found: Floats = shapely.area(_cut(map_file.zones, ground, frame))
        return found
    area_m2 = cell_areas_m2(map_file.cells, frame)
    if ground.field is not None:
        area_m2 *= shares_inside(map_file.cells, ground.field)
    elif ground.out is not None:
        area_m2 *= 1.0 - shares_inside(map_file.cells, ground.out)
    return area_m2


def _cut(zones: Sequence[MapZone], ground: Ground, frame: LocalFrame) -> Objects:
    """Return the ground of zones in metres, as far as it may be sprayed."""
    local = project_all(np.array([zone.geometry for zone in zones], dtype=object), frame)
    for index in np.flatnonzero(~shapely.is_valid(local)).tolist():
        local[index] = make_valid(local[index]) or MultiPolygon()
    limit = ground.field if ground.field is not None else ground.out
    if limit is None or not len(local):
        return local
    edge: Area = project(limit, frame)
    edge = edge if edge.is_valid else (make_valid(edge) or MultiPolygon())
    shapely.prepare(edge)
    if ground.field is not None:
        some = ~shapely.contains_properly(edge, local)
        local[some] = shapely.intersection(local[some], edge)
    else:
        some = shapely.intersects(edge, local)
        local[some] = shapely.difference(local[some], edge)
    return local


def _of_zones(
    map_file: MapFile, ground: Ground, overlap: str, frame: LocalFrame, areas_m2: Floats | None
) -> tuple[Floats, Floats]:
    """Return rates and areas [m2] of the zones that have a rate."""
    rated = map_file.rated
    rates = np.array([zone.rate_l_ha for zone in rated], dtype=np.float64)
    if areas_m2 is not None and overlap == "error":
        return rates, areas_m2[[zone.rate_l_ha is not None for zone in map_file.zones]]
    local = _cut(rated, ground, frame)
    area_m2: Floats = shapely.area(local) if rated else np.zeros(0)
    shared = _overlapping(local) if overlap != "error" and rated else np.zeros(0, dtype=np.int64)
    if not len(shared):
        return rates, area_m2
    own_rates, own_m2 = _by_policy(local[shared], rates[shared], overlap)
    alone = np.ones(len(rated), dtype=np.bool_)
    alone[shared] = False
    return np.append(rates[alone], own_rates), np.append(area_m2[alone], own_m2)


def _overlapping(local: Objects) -> NDArray[np.int64]:
    """Return the zones that share ground with another one."""
    joined = without_overlay(shapely.get_parts(local))
    if joined is not None and joined[1] <= OVERLAP_MAX_M2:
        return np.zeros(0, dtype=np.int64)
    one, two = STRtree(local).query(local, predicate="intersects")
    one, two = one[one < two], two[one < two]
    common = shapely.area(shapely.intersection(local[one], local[two])) > 0.0
    return np.unique(np.concatenate([one[common], two[common]]))


def _by_policy(local: Objects, rates: Floats, overlap: str) -> tuple[Floats, Floats]:
    """Return the pieces into which zones cut each other: the rate of each, and its area [m2]."""
    lines = shapely.union_all(shapely.boundary(local))
    pieces = shapely.get_parts(shapely.polygonize([lines]))
    points = shapely.point_on_surface(pieces)
    piece, zone = STRtree(local).query(points, predicate="within")
    order = np.lexsort((zone, piece))
    piece, zone = piece[order], zone[order]
    met, first = np.unique(piece, return_index=True)
    if overlap == "last":
        found = rates[zone[np.append(first[1:], len(zone)) - 1]]
    elif overlap == "mean":
        found = np.add.reduceat(rates[zone], first) / np.diff(np.append(first, len(zone)))
    else:
        found = (np.maximum if overlap == "max" else np.minimum).reduceat(rates[zone], first)
    return found, shapely.area(pieces[met])


def _covered_m2(map_file: MapFile, ground: Ground, frame: LocalFrame) -> float:
    """Return the ground under any zone with a rate, so that the default falls on the rest."""
    rated = map_file.rated
    return float(shapely.union_all(_cut(rated, ground, frame)).area)
