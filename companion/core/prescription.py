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
from typing import Literal

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import Geometry, MultiPolygon, Polygon, STRtree

from companion.core.cells import NO_RATE, CellGrid
from companion.core.frame import Floats, Ints

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
            raise ValueError(f"rate of zone {self.name} is no rate: {self.rate_l_ha}")
        if self.polygon.is_empty or not self.polygon.is_valid:
            raise ValueError(f"zone {self.name} is empty or not a valid polygon")


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
            ground = closed(dissolved(zone_parts)) if cells is None else cells.outline
        self.field = _field(ground, exclusions)
        # Without a boundary or an exclusion, inside is where a cell has a rate: no need to ask.
        self._is_all_cells = cells is not None and boundary is None and not exclusions
        field_parts, _ = _parts([self.field])
        self._parts = np.concatenate([zone_parts, field_parts])
        self._owner = np.concatenate([owner, np.full(len(field_parts), FIELD, dtype=np.int64)])
        self._tree = STRtree(self._parts)
        shapely.prepare(self._parts)
        self.edges = _edges(self._parts, self._owner)
        self.bounds_m: tuple[float, float, float, float] = (
            self.field.bounds if not self.field.is_empty else (0.0, 0.0, 0.0, 0.0)
        )
        self._rate_of: dict[frozenset[int], float | None] = {}

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


# Polygons that share their borders, joined into one ground.
#
# A map of 22 000 polygons has a quarter of a million edges, and most of them stand twice: once with
# each of two neighbours, in opposite directions. What stands once is the outline. An overlay finds
# that out anew for every pair, and takes ten times as long.

Objects = NDArray[np.object_]

# A corner this near to a neighbour's edge stands on it: maps are written with so many decimals.
CORNER_OFF_M = 0.001
# Corners that stand on edges, for every edge; a border has one or two.
_CORNERS_MAX = 20
_BITE = 5_000
# A polygon with more corners is not made smaller: that could take longer than all the rest.
_SIMPLE_MAX = 1_000


def dissolved(parts: Objects) -> Geometry:
    """Return the ground of all single, valid polygons (in metres) together.

    Corners may move by a millimetre onto the edge of a neighbour. Polygons that overlap by more
    are joined to the others by an overlay.
    """
    found = without_overlay(parts)
    if found is not None:
        return found[0]
    inner = shrunk(parts)
    one, two = STRtree(inner).query(inner, "intersects")
    alone = np.ones(len(parts), dtype=np.bool_)
    alone[one[one != two]] = False
    found = without_overlay(parts[alone])
    if found is None:
        return shapely.union_all(parts)
    return shapely.union(found[0], shapely.union_all(parts[~alone]))


def shrunk(parts: Objects) -> Objects:
    """Return the polygons without the half millimetre along their borders that neighbours share."""
    inner = parts.copy()
    simple = shapely.get_num_coordinates(parts) <= _SIMPLE_MAX
    inner[simple] = shapely.buffer(parts[simple], -CORNER_OFF_M / 2, join_style="mitre")
    return inner


def without_overlay(parts: Objects) -> tuple[Geometry, float] | None:
    """Return the ground of polygons that do not overlap, and how much could; None if they may.

    How many polygons lie over a point follows from their edges alone, each with its polygon on the
    left, and two opposite edges cancel out. Where what is left over is the outline of some ground,
    one polygon lies over each of its points and none over others: no pair overlaps. That it is
    the outline is checked. Only the area [m2] between an edge and the corners that were put on it
    is hidden from that, and no two polygons share more than all of it.
    """
    if len(parts) < 2:
        return (parts[0], 0.0) if len(parts) else None
    xy, ring = shapely.get_coordinates(
        shapely.get_rings(shapely.orient_polygons(parts)), return_index=True
    )
    # As complex numbers: numpy finds equal ones much faster than equal rows.
    places, corner = np.unique(xy @ np.array([1.0, 1.0j]), return_inverse=True)
    points = np.column_stack([places.real, places.imag])
    edge = np.flatnonzero(ring[1:] == ring[:-1])
    edges = _cancelled(np.column_stack([corner[edge], corner[edge + 1]]), len(places))
    cut = None if edges is None else _cut_at_corners(edges, points)
    if cut is None:
        return None
    left = _cancelled(cut[0], len(places))
    ground = None if left is None else _ground(left, places)
    return None if ground is None else (ground, cut[1])


def lines_of(ends: Floats) -> Objects:
    """Return a line for every two ends (n, 2, 2)."""
    return np.array(shapely.linestrings(ends))


def _cancelled(edges: Ints, count: int) -> Ints | None:
    """Return the edges (from, to) without those that are opposite; None where two are the same."""
    low, high = edges.min(axis=1), edges.max(axis=1)
    way, which = np.unique(low * count + high, return_inverse=True)
    sign = np.sign(edges[:, 1] - edges[:, 0])
    left = np.bincount(which, weights=sign, minlength=len(way)).astype(np.int64)
    if not (np.abs(left) <= 1).all():
        return None
    low, high = np.divmod(way[left != 0], count)
    forward = left[left != 0, None] > 0
    return np.where(forward, np.column_stack([low, high]), np.column_stack([high, low]))


def _cut_at_corners(edges: Ints, points: Floats) -> tuple[Ints, float] | None:
    """Return the edges, cut where corners of others stand on them, and the area in between."""
    corners = np.unique(edges)
    found = _near(edges, corners, points)
    if found is None:
        return None
    edge, corner = found
    start, end = edges[edge].T
    along, to_corner = points[end] - points[start], points[corner] - points[start]
    share = (along * to_corner).sum(axis=1) / (along**2).sum(axis=1)
    on = (corner != start) & (corner != end) & (share > 0.0) & (share < 1.0)
    # Between an edge and its corners: no more than the triangles over it, each with one of them.
    cross = along[:, 0] * to_corner[:, 1] - along[:, 1] * to_corner[:, 0]
    hidden_m2 = float(np.abs(cross[on]).sum()) / 2
    order = np.lexsort((share[on], edge[on]))
    corner, edge = corner[on][order], edge[on][order]
    # Every edge as its start, its corners and its end, then from each of these to the next.
    stops = np.bincount(edge, minlength=len(edges))
    last = np.cumsum(stops + 2) - 1
    chain = np.empty(2 * len(edges) + len(corner), dtype=np.int64)
    chain[last - stops - 1], chain[last] = edges.T
    chain[np.arange(len(corner)) + 2 * edge + 1] = corner
    goes_on = np.ones(len(chain), dtype=np.bool_)
    goes_on[last] = False
    begin = np.flatnonzero(goes_on)
    return np.column_stack([chain[begin], chain[begin + 1]]), hidden_m2


def _near(edges: Ints, corners: Ints, points: Floats) -> tuple[Ints, Ints] | None:
    """Return the edges and the corners that are near each other; None where they crowd."""
    tree = STRtree(lines_of(points[edges]))
    at = np.array(shapely.points(points[corners]))
    found: list[tuple[Ints, Ints]] = []
    left = _CORNERS_MAX * len(edges)
    for first in range(0, len(corners), _BITE):
        near, edge = tree.query(at[first : first + _BITE], "dwithin", distance=CORNER_OFF_M)
        found.append((edge, corners[first + near]))
        left -= len(edge)
        if left < 0:
            return None
    if not found:
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    return np.concatenate([one for one, _ in found]), np.concatenate([two for _, two in found])


def _ground(edges: Ints, places: NDArray[np.complex128]) -> Geometry | None:
    """Return the ground whose outline these edges are, all of them and no others, or None."""
    if not len(edges):
        return None
    points = np.column_stack([places.real, places.imag])
    lines = lines_of(points[edges])
    faces = shapely.orient_polygons(shapely.get_parts(shapely.polygonize(lines)))
    if not len(faces):
        return None
    xy, ring = shapely.get_coordinates(shapely.get_rings(faces), return_index=True)
    face_of_ring = np.repeat(np.arange(len(faces)), shapely.get_num_interior_rings(faces) + 1)
    begin = np.flatnonzero(ring[1:] == ring[:-1])
    corner = np.searchsorted(places, xy @ np.array([1.0, 1.0j]))
    ways = corner[begin] * len(places) + corner[begin + 1]
    wanted = np.sort(edges[:, 0] * len(places) + edges[:, 1])
    # Of a face that is no ground, but lies in a hole of it, all edges run the other way.
    right = wanted[np.searchsorted(wanted, ways).clip(max=len(wanted) - 1)] == ways
    owner = face_of_ring[ring[begin]]
    inside = np.bincount(owner, weights=~right, minlength=len(faces)) == 0
    if not np.array_equal(np.sort(ways[inside[owner]]), wanted):
        return None
    ground = shapely.multipolygons(faces[inside])
    return ground if shapely.is_valid(ground) else None
