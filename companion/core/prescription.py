"""The prescription: which rate belongs where, and where spraying is allowed at all.

Built once, immutable. A zone is one polygon with one rate; the field is where spraying is
allowed: the boundary, or the outline of all zones, less the exclusions. Look-ups go through one
STRtree of polygons, crossings through one STRtree of edges, so their cost does not grow with the
number of zones. A map in rows and columns has its cells instead of zones (`cells.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import compress
from typing import Literal, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import Geometry, MultiPolygon, Polygon, STRtree

from companion.core.cells import NO_RATE, CellGrid
from companion.core.frame import Box, Floats, Ints, PlainEdge

Overlap = Literal["error", "max", "min", "mean", "last"]

# Gaps between neighbouring zones up to this width are digitising errors, not borders: they are
# closed when the outline of the zones is the border.
SLIVER_M = 0.02


@dataclass(frozen=True, slots=True, kw_only=True)
class Zone:
    """One polygon of the map, in the flight's frame [m], and its rate; 0 is a rate."""

    name: str
    polygon: Polygon | MultiPolygon
    rate_l_ha: float

    def __post_init__(self) -> None:
        if not 0.0 <= self.rate_l_ha < 100_000.0:
            raise ValueError(f"rate of zone {self.name} is not a rate: {self.rate_l_ha}")
        if self.polygon.is_empty or not self.polygon.is_valid:
            raise ValueError(f"zone {self.name} is empty or not a valid polygon")


# Farther from a field no vehicle is permitted to spray.
BEYOND_M = 1e5


# The owner of the polygons and edges of the field, beside the zones' 0, 1, 2, ...
FIELD = -1


@dataclass(frozen=True, slots=True)
class Edges:
    """Directed edges with their polygon on the left: (n, 4) east, north, east, north [m].

    `owner` is the index of the zone that an edge belongs to, or `FIELD`.
    """

    ends: Floats
    owner: Ints
    tree: STRtree

    def near(self, west_m: float, south_m: float, east_m: float, north_m: float) -> Ints:
        """Return the indices of the edges whose boxes meet this box."""
        return self.tree.query(shapely.box(west_m, south_m, east_m, north_m))


# What is near is looked up so much farther than was asked for: paths go on from step to step.
NEAR_M = 6.0


class Near(NamedTuple):
    """What of a map lies near a box, in plain numbers, as it is little and asked for often.

    Of each edge its own box first. `parts` is a column of polygons, each with its box and owner.
    """

    within: Box
    edges: list[tuple[float, float, float, float, PlainEdge]]
    border: list[tuple[float, float, float, float, PlainEdge]]  # those of the field alone
    parts: NDArray[np.object_]
    boxes: list[list[float]]
    owners: list[int]
    # Those of them that were looked into, and whose they are: mostly the same as the step before.
    chosen: dict[tuple[int, ...], tuple[NDArray[np.object_], list[int]]]

    def covers(self, box: Box) -> bool:
        """Return whether it has all that is near another box."""
        west, south, east, north = self.within
        return west <= box[0] and south <= box[1] and box[2] <= east and box[3] <= north

    def edges_in(self, box: Box, *, of_border: bool = False) -> list[PlainEdge]:
        """Return the edges whose boxes meet a box that it covers."""
        west, south, east, north = box
        return [
            edge
            for w, s, e, n, edge in (self.border if of_border else self.edges)
            if w <= east and s <= north and e >= west and n >= south
        ]

    def owners_at(self, east_m: list[float], north_m: list[float]) -> list[frozenset[int]]:
        """Return as `Prescription.owners_at` does, for points that it covers."""
        west, south, east, north = min(east_m), min(north_m), max(east_m), max(north_m)
        hit = tuple(
            [
                i
                for i, (w, s, e, n) in enumerate(self.boxes)
                if w <= east and s <= north and e >= west and n >= south
            ]
        )
        if hit not in self.chosen:
            self.chosen[hit] = self.parts[list(hit)], [self.owners[i] for i in hit]
        parts, owners = self.chosen[hit]
        within = shapely.contains_xy(parts, np.array(east_m), np.array(north_m)).tolist()
        inside = list(zip(*within, strict=True)) or [()] * len(east_m)
        of_each = {one: frozenset(compress(owners, one)) for one in set(inside)}
        return [of_each[one] for one in inside]


class Prescription:
    """Zones with rates and the field that they may be sprayed on.

    Args:
        zones: polygons with rates, in the flight's frame; later ones lie on top for `last`.
        boundary: where spraying is allowed; without it the outline of all zones.
        exclusions: where it is not.
        overlap: what holds where zones overlap. Whoever loads a map refuses overlaps under
            `error`; slivers that remain take the smaller rate.
        default_rate_l_ha: the rate inside the field where there is no zone; None closes.
        cells: rows and columns of rates instead of zones.
        sha256: of the file that the zones came from.

    Wherever zones are numbered, those of `cells` are its classes: all ground of one rate.
    """

    def __init__(
        self,
        zones: Sequence[Zone],
        *,
        boundary: Polygon | MultiPolygon | None = None,
        exclusions: Sequence[Polygon | MultiPolygon] = (),
        overlap: Overlap = "error",
        default_rate_l_ha: float | None = None,
        cells: CellGrid | None = None,
        sha256: str = "",
    ) -> None:
        if cells is not None and zones:
            raise ValueError("a prescription has zones or cells, not both")
        self._zones = tuple(zones)
        self.cells = cells
        self.overlap: Overlap = overlap
        self.default_rate_l_ha = default_rate_l_ha
        self.sha256 = sha256
        self._zone_rates: Sequence[float] | Floats = (
            tuple(zone.rate_l_ha for zone in zones) if cells is None else cells.rates_l_ha
        )
        zone_parts, owner = _parts([zone.polygon for zone in zones])
        ground: Geometry | None = boundary
        if ground is None:
            ground = _outline(zone_parts) if cells is None else cells.outline
        self.field = _field(ground, exclusions)
        # Without a boundary or an exclusion, inside is where a cell has a rate: no need to ask.
        self._is_all_cells = cells is not None and boundary is None and not exclusions
        field_parts, _ = _parts([self.field])
        self._parts = np.concatenate([zone_parts, field_parts])
        self._owner = np.concatenate([owner, np.full(len(field_parts), FIELD, dtype=np.int64)])
        self._tree = STRtree(self._parts)
        self._boxes: Floats = shapely.bounds(self._parts)
        shapely.prepare(self._parts)
        self.edges = _edges(self._parts, self._owner)
        self.bounds_m: tuple[float, float, float, float] = (
            self.field.bounds if not self.field.is_empty else (0.0, 0.0, 0.0, 0.0)
        )
        self._rate_of: dict[frozenset[int], float | None] = {}
        self._near: Near | None = None

    @cached_property
    def without_border(self) -> Prescription | None:
        """Return ground without an end and with this field's holes; None where it has none."""
        rings = [ring for part in shapely.get_parts(self.field) for ring in part.interiors]
        if not rings:
            return None
        west, south, east, north = self.bounds_m
        ground = shapely.box(west - BEYOND_M, south - BEYOND_M, east + BEYOND_M, north + BEYOND_M)
        return Prescription([], boundary=ground, exclusions=[Polygon(ring) for ring in rings])

    @cached_property
    def zones(self) -> tuple[Zone, ...]:
        """Return the zones; of cells, the ground of each class, joined when it is asked for."""
        if self.cells is None:
            return self._zones
        return tuple(
            Zone(name=self.zone_name(index), polygon=area, rate_l_ha=self.zone_rate(index))
            for index, area in enumerate(self.cells.areas)
        )

    @property
    def zone_count(self) -> int:
        """Return the number of zones, or of classes of cells."""
        return len(self._zone_rates)

    def zone_name(self, zone: int) -> str:
        """Return what a zone is called; a class of cells by its rate."""
        return self._zones[zone].name if self.cells is None else f"{self.zone_rate(zone):g} L/ha"

    def zone_rate(self, zone: int) -> float:
        """Return the rate of one zone [L/ha]."""
        return float(self._zone_rates[zone])

    @cached_property
    def rates_l_ha(self) -> tuple[float, ...]:
        """Return all different rates, the default among them, the least first."""
        default = () if self.default_rate_l_ha is None else (self.default_rate_l_ha,)
        rates = np.concatenate([np.asarray(self._zone_rates, dtype=np.float64), default])
        return tuple(np.unique(rates).tolist())

    @cached_property
    def area_m2(self) -> float:
        """Return the ground of all zones; where they overlap it counts for each."""
        return float(shapely.area([zone.polygon for zone in self.zones]).sum())

    def edges_near(
        self, west_m: float, south_m: float, east_m: float, north_m: float
    ) -> tuple[Floats, Ints]:
        """Return the edges whose boxes meet a box, as in `Edges`, and whose each is."""
        near = self.edges.near(west_m, south_m, east_m, north_m)
        ends, owner = self.edges.ends[near], self.edges.owner[near]
        if self.cells is None:
            return ends, owner
        cell_ends, cell_owner = self.cells.edges_in(west_m, south_m, east_m, north_m)
        return np.concatenate([ends, cell_ends]), np.concatenate([owner, cell_owner])

    def near(self, box: Box) -> Near:
        """Return what lies near a box; the last answer serves as long as it covers what is asked.

        It is of this map and its box alone, and neither changes.
        """
        found = self._near
        if found is None or not found.covers(box):
            west, south, east, north = box
            within = (west - NEAR_M, south - NEAR_M, east + NEAR_M, north + NEAR_M)
            ends, owner = self.edges_near(*within)
            low, high = np.minimum(ends[:, :2], ends[:, 2:]), np.maximum(ends[:, :2], ends[:, 2:])
            plain = zip(*ends.T.tolist(), owner.tolist(), strict=True)
            boxes = np.hstack([low, high]).tolist()
            parts = self._tree.query(shapely.box(*within))
            edges = [(w, s, e, n, edge) for (w, s, e, n), edge in zip(boxes, plain, strict=True)]
            found = self._near = Near(
                within,
                edges,
                [each for each in edges if each[4][4] == FIELD],
                self._parts[parts][:, None],
                self._boxes[parts].tolist(),
                self._owner[parts].tolist(),
                {},
            )
        return found

    def owners_near(
        self, near: Near, east_m: list[float], north_m: list[float]
    ) -> list[frozenset[int]]:
        """Return as `owners_at` does, for points near what was looked up."""
        if self.cells is None:
            return near.owners_at(east_m, north_m)
        return list(map(frozenset, self.owners_at(np.array(east_m), np.array(north_m))))

    def rate_of(self, zones: frozenset[int]) -> float | None:
        """Return the rate where exactly these zones lie, by the overlap policy."""
        try:
            return self._rate_of[zones]
        except KeyError:
            rate = self._rate_of[zones] = self._combine(zones)
            return rate

    def _combine(self, zones: frozenset[int]) -> float | None:
        rates = [self.zone_rate(zone) for zone in zones]
        if not rates:
            return self.default_rate_l_ha
        if self.overlap == "max":
            return max(rates)
        if self.overlap == "mean":
            return sum(rates) / len(rates)
        if self.overlap == "last":
            return self.zone_rate(max(zones))
        return min(rates)

    def owners_at(self, east_m: Floats, north_m: Floats) -> list[set[int]]:
        """Return, for each point, the zones that it lies in, and `FIELD` if it is inside."""
        found: list[set[int]] = [set() for _ in range(len(east_m))]
        if self.cells is not None:
            for point, kind in enumerate(self.cells.classes_at(east_m, north_m).tolist()):
                if kind != NO_RATE:
                    found[point].update((kind, FIELD) if self._is_all_cells else (kind,))
        if self._is_all_cells:
            return found
        places = np.empty((len(east_m), 2))
        places[:, 0], places[:, 1] = east_m, north_m
        points, parts = self._tree.query(shapely.points(places))
        within = shapely.contains_xy(self._parts[parts], east_m[points], north_m[points])
        owners = self._owner[parts[within]]
        for point, owner in zip(points[within].tolist(), owners.tolist(), strict=True):
            found[point].add(owner)
        return found

    def zones_at(self, east_m: Floats, north_m: Floats) -> list[frozenset[int]]:
        """Return, for each point, the indices of the zones that it lies in."""
        return [frozenset(found - {FIELD}) for found in self.owners_at(east_m, north_m)]

    def inside(self, east_m: Floats, north_m: Floats) -> NDArray[np.bool_]:
        """Return, for each point, whether spraying is allowed there."""
        if self.cells is not None and self._is_all_cells:
            found: NDArray[np.bool_] = self.cells.classes_at(east_m, north_m) != NO_RATE
            return found
        shapely.prepare(self.field)
        found = shapely.contains_xy(self.field, east_m, north_m)
        return np.asarray(found, dtype=np.bool_)

    def rates_at(self, east_m: Floats, north_m: Floats) -> Floats:
        """Return the rate at each point [L/ha]; NaN outside the field or without a rate."""
        rates = np.full(len(east_m), np.nan)
        for i, owners in enumerate(self.owners_at(east_m, north_m)):
            if FIELD in owners:
                rate = self.rate_of(frozenset(owners - {FIELD}))
                rates[i] = np.nan if rate is None else rate
        return rates

    def rate_at(self, east_m: float, north_m: float) -> float | None:
        """Return the rate at one point [L/ha]; None outside the field or without a rate."""
        if self.cells is not None and self._is_all_cells:
            kind = self.cells.class_at(east_m, north_m)
            return None if kind == NO_RATE else self.zone_rate(kind)
        # An array of one point: for a single one shapely takes three times as long.
        _, parts = self._tree.query(shapely.points(np.array([[east_m, north_m]])))
        within = shapely.contains_xy(self._parts[parts], east_m, north_m)
        owners = set(self._owner[parts[within]].tolist())
        if FIELD not in owners:
            return None
        if self.cells is not None:
            kind = self.cells.class_at(east_m, north_m)
            owners |= {kind} - {NO_RATE}
        return self.rate_of(frozenset(owners - {FIELD}))


def _parts(
    polygons: Sequence[Polygon | MultiPolygon],
) -> tuple[NDArray[np.object_], Ints]:
    """Return all single polygons, rings turned so that the inside is on the left, and whose."""
    if not polygons:
        return np.empty(0, dtype=object), np.empty(0, dtype=np.int64)
    parts, owner = shapely.get_parts(np.array(polygons, dtype=object), return_index=True)
    return shapely.orient_polygons(parts), owner.astype(np.int64)


def _edges(parts: NDArray[np.object_], owner: Ints) -> Edges:
    """Return every edge of every ring; shells run anticlockwise, holes clockwise."""
    rings, ring_part = shapely.get_rings(parts, return_index=True)
    coordinates, ring = shapely.get_coordinates(rings, return_index=True)
    same_ring = ring[1:] == ring[:-1]
    ends = np.hstack([coordinates[:-1], coordinates[1:]])[same_ring]
    owners = owner[ring_part[ring[:-1][same_ring]]]
    lines = shapely.linestrings(ends.reshape(-1, 2, 2)) if len(ends) else np.empty(0, object)
    return Edges(ends=ends, owner=owners.astype(np.int64), tree=STRtree(lines))


def _outline(parts: NDArray[np.object_]) -> Geometry:
    """Return the ground of all zones together."""
    # A flight map has its border: in flight this is never loaded.
    from companion.core.outline import dissolved

    return closed(dissolved(parts))


def closed(ground: Geometry) -> Geometry:
    """Return the ground of all zones with the slivers between them closed."""
    grown = shapely.buffer(ground, SLIVER_M / 2, join_style="mitre")
    return shapely.buffer(grown, -SLIVER_M / 2, join_style="mitre")


def _field(
    ground: Geometry, exclusions: Sequence[Polygon | MultiPolygon]
) -> Polygon | MultiPolygon:
    """Return the ground that may be sprayed."""
    field = ground
    if exclusions:
        field = shapely.difference(field, shapely.union_all(list(exclusions)))
    if isinstance(field, Polygon | MultiPolygon):
        return field
    polygons = [part for part in shapely.get_parts(field) if isinstance(part, Polygon)]
    return MultiPolygon(polygons)
