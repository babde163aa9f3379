"""Ways between places of a mission: inside the field where there is one, around it where not."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
import shapely
from shapely import Point
from shapely.geometry.base import BaseGeometry

from missions.errors import PlanError
from missions.field import Field
from missions.free_space import FreeSpace, free_space
from missions.plan import Sortie
from missions.strips import Floats

Place = tuple[float, float]

# How far outside the hull of field and depots a ferry may go around what blocks it.
AROUND_M = 50.0
# A depot this close to the field stands on its edge.
ON_EDGE_M = 0.05
DEPOT_FAR_M = 20_000.0
# Of so many ends at once ways around corners are looked at: the tables on the way stay small.
ENDS_TOGETHER = 512
# For each of them so many corners at first, then twice as many, up to so many at once.
CORNERS_FIRST, CORNERS_MOST = 4, 32
# A depot farther from the field than this is worth a word: each flight is mostly ferry.
DEPOT_FERRY_M = 500.0


@dataclass(frozen=True)
class Ways:
    """Inside the field, and around it."""

    field: Field
    depots: Floats
    inside: FreeSpace

    @cached_property
    def around(self) -> FreeSpace:
        """Return the space outside: the hull of field and depots, without what blocks."""
        everything = shapely.union_all(
            [self.field.outline, shapely.MultiPoint(self.depots.tolist())]
        )
        space = everything.convex_hull.buffer(AROUND_M).difference(self.field.blocked)
        return free_space(space)

    @cached_property
    def gates(self) -> Floats:
        """Return where the way from each depot enters the field: the nearest place of it."""
        return shapely.get_coordinates(
            shapely.shortest_line(self.field.fly, shapely.points(self.depots))
        )[::2]

    @cached_property
    def _to_gates(self) -> list[list[Place]]:
        """Return the way from each depot to its gate; one that stands there has none."""
        ways: list[list[Place]] = []
        for depot, gate in zip(self.depots.tolist(), self.gates.tolist(), strict=True):
            start, entry = (depot[0], depot[1]), (gate[0], gate[1])
            is_there = math.dist(start, entry) < ON_EDGE_M
            ways.append([start] if is_there else self.around.way(start, entry))
        return ways

    @cached_property
    def high(self) -> Ways | None:
        """Return the ways of ferries, which cross low obstacles; None where they cross none."""
        high = self.field.high
        if high is None:
            return None
        field = replace(self.field, fly=high.fly, blocked=high.blocked, high=None)
        return Ways(field=field, depots=self.depots, inside=free_space(high.fly))

    def between(self, start: Place, end: Place) -> tuple[list[Place], bool]:
        """Return the way between two places of the field, and whether it leaves the field."""
        if (start, end) not in self._between:
            self._between[start, end] = self._way_between(start, end)
        way, leaves = self._between[start, end]
        return list(way), leaves

    @cached_property
    def _between(self) -> dict[tuple[Place, Place], tuple[list[Place], bool]]:
        """Return the ways that `between` has found: most of them are asked for again."""
        return {}

    def _way_between(self, start: Place, end: Place) -> tuple[list[Place], bool]:
        way = self.inside.way(start, end)
        if way:
            return way, False
        if self.high is not None:
            return self.high.between(start, end)[0], True
        way = self.around.way(start, end)
        if not way:
            raise PlanError(
                "no way leads from one part of the field to another past its obstacles; "
                "plan the parts one by one"
            )
        return way, True

    def home(self, depot: int, end: Place) -> list[Place]:
        """Return the way from a depot to a place of the field: the shortest way in, then inside."""
        if self.high is not None:
            return self.high.home(depot, end)
        gate = (float(self.gates[depot][0]), float(self.gates[depot][1]))
        return [*self._to_gates[depot], *self.between(gate, end)[0][1:]]

    def home_ways_m(self, ends: Floats) -> Floats:
        """Return how long the way is from every depot to every place, shape (depots, n)."""
        if self.high is not None:
            return self.high.home_ways_m(ends)
        found: Floats = self._outside_m[:, None] + _inside_m(self.gates, ends, self.inside)
        return found

    @property
    def are_straight(self) -> bool:
        """Return whether the way from any depot to any place is straight."""
        if self.high is not None:
            return self.high.are_straight
        return self.inside.is_convex and not self._outside_m.any()

    @cached_property
    def _outside_m(self) -> Floats:
        """Return how long the way from each depot to its gate is."""
        return np.array([sum(map(math.dist, way, way[1:])) for way in self._to_gates])


def _inside_m(depots: Floats, ends: Floats, space: FreeSpace) -> Floats:
    """Return the way from every depot in a space to every end, bent where it does not see it."""
    far_m: Floats = np.hypot(
        depots[:, 0][:, None] - ends[:, 0][None, :], depots[:, 1][:, None] - ends[:, 1][None, :]
    )
    if space.is_convex:
        return far_m
    known_m = _known_ways_m(space.space)
    places = [(east_m, north_m) for east_m, north_m in ends.tolist()]
    for number, depot in enumerate(depots):
        own_m = known_m.setdefault((float(depot[0]), float(depot[1])), {})
        new = [at for at, place in enumerate(places) if place not in own_m]
        if new:
            new_m = _bent_m(depot, ends[new], far_m[number, new], space).tolist()
            own_m.update(zip((places[at] for at in new), new_m, strict=True))
        far_m[number] = [own_m[place] for place in places]
    return far_m


@lru_cache(maxsize=4)
def _known_ways_m(_space: BaseGeometry) -> dict[Place, dict[Place, float]]:
    """Return the ways that `_inside_m` has found: ends of the same lines are asked for again."""
    return {}


def _bent_m(depot: Floats, ends: Floats, far_m: Floats, space: FreeSpace) -> Floats:
    """Return the way from a depot to each end: straight where it sees it, as far as it may."""
    hidden = np.flatnonzero(~space.sees(np.tile(depot, (len(ends), 1)), ends))
    reach = space.to_corners_m(depot[None, :], nearest=None)
    if not len(hidden) or not reach.size:
        return far_m
    to_corner_m = np.min(reach[0][:, None] + space.between_m, axis=0)
    for first in range(0, len(hidden), ENDS_TOGETHER):
        some = hidden[first : first + ENDS_TOGETHER]
        bent = _over_corners_m(to_corner_m, ends[some], space)
        far_m[some] = np.where(np.isfinite(bent), bent, far_m[some])
    return far_m


def _over_corners_m(to_corner_m: Floats, ends: Floats, space: FreeSpace) -> Floats:
    """Return the shortest way to each end over a corner that it sees; infinite without one."""
    ways_m = to_corner_m + np.hypot(
        ends[:, 0][:, None] - space.corners[:, 0][None, :],
        ends[:, 1][:, None] - space.corners[:, 1][None, :],
    )
    order = np.argsort(ways_m, axis=1, kind="stable")
    found = np.full(len(ends), np.inf)
    waiting = np.arange(len(ends))
    # The first corner in sight is the best one: few are looked at, at first.
    first, many = 0, CORNERS_FIRST
    while len(waiting) and first < order.shape[1]:
        corner = order[waiting, first : first + many]
        count = corner.shape[1]
        seen = space.sees(np.repeat(ends[waiting], count, axis=0), space.corners[corner.ravel()])
        seen = seen.reshape(corner.shape)
        is_seen, at = seen.any(axis=1), seen.argmax(axis=1)
        some = waiting[is_seen]
        found[some] = ways_m[some, corner[is_seen, at[is_seen]]]
        waiting = waiting[~is_seen]
        first, many = first + many, min(2 * many, CORNERS_MOST)
    return found


def build_ways(field: Field, depots: Floats, inside: FreeSpace | None = None) -> Ways:
    """Return the ways of a field with its depots, which must be places one can stand at.

    `inside` is the free space of the field, where it is known.

    Raises:
        PlanError: for a depot in an obstacle or hole, or beyond reach.
    """
    for number, (east_m, north_m) in enumerate(depots.tolist(), start=1):
        if not (math.isfinite(east_m) and math.isfinite(north_m)):
            raise PlanError(f"depot {number} is not a place near the field (mission.depots)")
        far_m = float(field.outline.distance(Point(east_m, north_m)))
        if not far_m <= DEPOT_FAR_M:
            raise PlanError(
                f"depot {number} lies {far_m / 1000.0:.0f} km from the field; write "
                "[latitude, longitude] in mission.depots, with their signs"
            )
        if _is_in(field.blocked, east_m, north_m):
            latitude_deg, longitude_deg = field.frame.to_geographic(east_m, north_m)
            raise PlanError(
                f"depot {number} at {latitude_deg:.6f}, {longitude_deg:.6f} lies in an obstacle "
                "or its buffer; move it (mission.depots)"
            )
    return Ways(field=field, depots=depots, inside=inside or free_space(field.fly))


def _is_in(blocked: BaseGeometry, east_m: float, north_m: float) -> bool:
    return bool(shapely.contains_xy(blocked, east_m, north_m)) if not blocked.is_empty else False


def edge_places(field: Field, *, step_m: float, count_max: int) -> Floats:
    """Return places along the edge of the field, evenly apart, where one gets to from outside.

    Obstacles that reach over the edge, or cut the field in two, have edges in it: none of those.

    Raises:
        PlanError: where obstacles leave no place.
    """
    rings = [shapely.get_exterior_ring(part) for part in shapely.get_parts(field.fly)]
    step_m = max(step_m, sum(ring.length for ring in rings) / count_max)
    places = np.concatenate(
        [
            shapely.get_coordinates(
                shapely.line_interpolate_point(ring, np.arange(0.0, ring.length, step_m))
            )
            for ring in rings
        ]
    )
    edges = shapely.union_all(
        [shapely.get_exterior_ring(part) for part in shapely.get_parts(field.outline)]
    )
    far_m = shapely.distance(edges, shapely.points(places))
    # Beside an obstacle across the edge the drawn border may touch what is blocked around it.
    is_free = np.array([not _is_in(field.blocked, *place) for place in places.tolist()])
    # So far inside the border may be drawn.
    outer: Floats = places[(far_m <= max(field.tolerance_m, ON_EDGE_M)) & is_free]
    if not len(outer):
        raise PlanError(
            "obstacles stand along the whole edge of the field, and no place on it can be "
            "suggested to take off from; give one with --depot LAT,LON (mission.depots)"
        )
    return outer


def ways_m(places: Floats, points: Floats, inside: FreeSpace) -> Floats:
    """Return how long the ways from places to points are, over a few corners near to them."""
    far_m: Floats = np.hypot(*(places[:, None, :] - points[None, :, :]).transpose(2, 0, 1))
    if inside.is_convex:
        return far_m
    rows, columns = np.divmod(np.arange(far_m.size), len(points))
    is_seen = inside.sees(places[rows], points[columns]).reshape(far_m.shape)
    from_points_m = inside.to_corners_m(points)
    found_m = np.empty_like(far_m)
    for at, reach_m in enumerate(inside.to_corners_m(places)):
        seen = np.flatnonzero(np.isfinite(reach_m))
        over_m = np.min(reach_m[seen, None] + inside.between_m[seen], axis=0, initial=np.inf)
        found_m[at] = np.min(over_m + from_points_m, axis=1, initial=np.inf)
    # Where none is inside, from one part of a field to another, ferries fly around outside.
    return np.where(is_seen | ~np.isfinite(found_m), far_m, found_m)


def far_warnings(
    sorties: Sequence[Sortie], depots: Floats, field: Field, *, has_battery: bool
) -> tuple[str, ...]:
    """Return what flying from depots far from the field costs."""
    said = []
    for number, depot in enumerate(depots, start=1):
        own = [each for each in sorties if each.depot == number - 1]
        far_m = float(field.outline.distance(Point(depot)))
        if not own or far_m <= DEPOT_FERRY_M:
            continue
        most = max(own, key=lambda each: each.legs[0].seconds + each.legs[-1].seconds)
        ferry_min = (most.legs[0].seconds + most.legs[-1].seconds) / 60.0
        text = (
            f"depot {number} lies {far_m / 1000.0:.1f} km from the field: the ferries there and "
            f"back take {ferry_min:.0f} min of "
            + ("its sortie" if len(own) == 1 else f"each of its {len(own)} sorties")
        )
        if not has_battery:
            text += (
                "; give mission.battery_wh and power_hover_w: without them nothing checks that the "
                "battery lasts"
            )
        said.append(text)
    return tuple(said)
