"""The fence of a sortie: where it must stay, off which obstacles, in the room an autopilot has.

Autopilots store few corners. The border is drawn with the fewest that keep it near the field, and
round obstacles as circles where there is no room for all. What cannot hold the whole way is no
fence: the plan is refused. Where nothing else has room, border and obstacles are drawn simpler;
obstacles for which there is none are left out, those far from the way and the smallest first, and
counted.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any, Protocol

import numpy as np
import shapely
from shapely import LineString, Polygon
from shapely.geometry.base import BaseGeometry
from shapely.geometry.polygon import orient

from companion.wording import counted
from missions.errors import FenceError, PlanError
from missions.fewer_corners import (
    FewerAndFewer,
    around_with_fewer_corners,
    each_inside,
    with_corners,
)
from missions.field import Field
from missions.files.items import FENCE_CORNERS_MAX, NAMES
from missions.maps.local import polygons_of
from missions.plan import Place, Plan, Settings, Sortie
from missions.strips import Objects, border_edges

# The fence lies so far outside the field, at least; drawn with fewer corners, so much farther.
# Lines end on the field's edge: PX4 in simulation went 1.24 m beyond one, and a fence at 1.2 m
# held it there for good.
OUT_M, QUICK_M, SIMPLER_M = 2.0, 0.2, (0.5, 1.0, 2.0, 4.0, 6.0, 8.0)
# Where the whole field has too many corners, the ground so far beside the way of a sortie, drawn
# with as few corners as the field leaves room for.
ASIDE_M, PART_SIMPLER_M = (20.0, 6.0), (*SIMPLER_M, 12.0, 18.0)
# No fence lies farther outside of field and ways.
OUTSIDE_MAX_M, STEP_M = 10.0, 2.0
# A fence that lies farther outside than this is worth a word.
NEAR_M = 6.0
# On each side of a way outside the field.
FERRY_M = 2.0
# Obstacles are fenced so much smaller than their buffers: no rounding puts a pass into them.
OBSTACLE_LESS_M, OBSTACLE_SIMPLE_M = 0.5, 0.4
# Where there is no room for them, they are drawn simpler, but keep so much of their ground.
OBSTACLE_SIMPLER_M, OBSTACLE_SHARE = (OBSTACLE_SIMPLE_M, 2.0, 4.0, 8.0), 0.6
# A circle stands for an obstacle of which it is so much.
ROUND_SHARE = 0.6
# ArduPilot keeps a fence in 560 bytes, 8 for a corner: beside the corners it notes where the fence
# begins and ends (5 bytes), kind and number of corners of each polygon (2), and circles (13).
CORNER_BYTES, ENDS_BYTES, POLYGON_BYTES, CIRCLE_BYTES = 8, 5, 2, 13
DIGITS = 9
# Ground that may be added to a fence keeps so much from the limit: it is drawn with arcs.
ROUNDED_M = 0.1
# A border with so many times the corners that have room is not tried.
TIMES_MAX = 3
# A place is crowded with corners by so many to both sides.
CROWD = 4
MITRE_LIMIT = 2.0


# A polygon, and the circle (east, north, radius) that may stand for it.
Shape = tuple[Polygon, tuple[float, float, float] | None]
Way = tuple[tuple[Place, ...], ...]
# How far beside the way ground is held, None for all of the field; the border.
Tried = tuple[float | None, BaseGeometry]


@dataclass(frozen=True, slots=True, kw_only=True)
class Fence:
    """Shapes in metres; `left_out` are the obstacles that found no room.

    `aside_m` is how far beside its way the ground is held, None where the whole field is.
    """

    border: Polygon
    polygons: tuple[Polygon, ...] = ()
    circles: tuple[tuple[float, float, float], ...] = ()
    left_out: int = 0
    aside_m: float | None = None
    crossed: int = 0
    outside_m: float = 0.0


class Fenced(Protocol):
    """What fences are drawn for: a plan, or the field of one that is made."""

    @property
    def field(self) -> Field:
        """Return the field."""
        ...

    @property
    def settings(self) -> Settings:
        """Return what the plan is made for."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Ground:
    """A field for which a plan is made."""

    field: Field
    settings: Settings


@dataclass(frozen=True)
class Border:
    """A border around some ground of a field."""

    parts: BaseGeometry
    ground: BaseGeometry
    field: BaseGeometry

    @cached_property
    def outside_m(self) -> float:
        """Return how far outside the field it lies at most."""
        return _outside_m(self.parts, self.field)

    @cached_property
    def is_near(self) -> bool:
        """Return whether it keeps near the field and holds its ground: asked for of few."""
        return self.outside_m <= OUTSIDE_MAX_M and bool(self.parts.covers(self.ground))


class Borders:
    """Borders around some ground, the nearest first.

    Each is drawn when it is first asked for: most fences need one or two of them.
    """

    def __init__(self, ground: BaseGeometry, field: BaseGeometry, simpler: Sequence[float]) -> None:
        self._drawn: list[Border] = []
        self._more = _borders(ground, field, simpler)

    def __iter__(self) -> Iterator[Border]:
        yield from self._drawn
        for each in self._more:
            self._drawn.append(each)
            yield each


def _borders(
    ground: BaseGeometry, field: BaseGeometry, simpler: Sequence[float]
) -> Iterator[Border]:
    shapely.prepare(ground)
    shapely.prepare(field)
    for simpler_m in simpler:
        # Bays in which it would be no farther from the field are closed, and a first, quick
        # simplification is made up for by a wider buffer.
        wide_m = OUT_M + QUICK_M + simpler_m
        wider = ground.buffer(wide_m, join_style="mitre", mitre_limit=MITRE_LIMIT)
        closed = wider.buffer(-simpler_m, join_style="mitre", mitre_limit=MITRE_LIMIT)
        yield Border(around_with_fewer_corners(closed.simplify(QUICK_M), simpler_m), ground, field)


@dataclass(frozen=True)
class Fences:
    """The fences of all sorties of a plan."""

    plan: Fenced
    drawn: dict[Way, Fence] = field(default_factory=dict, repr=False)
    lacking: set[Way] = field(default_factory=set, repr=False)
    _simpler: dict[tuple[int, float], Shape] = field(default_factory=dict, repr=False)
    _fewer: dict[
        tuple[Polygon, BaseGeometry, float], tuple[FewerAndFewer, dict[int, tuple[Polygon, float]]]
    ] = field(default_factory=dict, repr=False)

    @property
    def room_bytes(self) -> int:
        """Return what the autopilot keeps a fence in, as if all counted corners as ArduPilot."""
        return FENCE_CORNERS_MAX[self.plan.settings.autopilot] * CORNER_BYTES - ENDS_BYTES

    @property
    def room(self) -> int:
        """Return how many corners a fence without obstacles may have."""
        return (self.room_bytes - POLYGON_BYTES) // CORNER_BYTES

    @cached_property
    def obstacles(self) -> list[Shape]:
        """Return the obstacles, the largest first, each with the circle that may stand for it."""
        return self._fenced(self.plan.field.blocked)

    @cached_property
    def tall_and_low(self) -> tuple[list[Shape], list[Shape]]:
        """Return the obstacles that no ferry crosses, and those that some may."""
        blocked, high = self.plan.field.blocked, self.plan.field.high
        if high is None:
            return self.obstacles, []
        return self._fenced(high.blocked), self._fenced(blocked.difference(high.blocked))

    def obstacles_of(self, way: BaseGeometry) -> list[Shape]:
        """Return the obstacles that a way does not cross, those beside it first, then the largest.

        Fences know no height.
        """
        found = self.obstacles
        if any(part.intersects(way) for part, _ in found):
            tall, low = self.tall_and_low
            found = [*tall, *(each for each in low if not each[0].intersects(way))]
        far_m = shapely.distance(way, [part for part, _ in found]).tolist()
        ranked = [
            (beside_m > ASIDE_M[0], -each[0].area, number)
            for number, (beside_m, each) in enumerate(zip(far_m, found, strict=True))
        ]
        return [found[number] for *_, number in sorted(ranked)]

    @staticmethod
    def _fenced(blocked: BaseGeometry) -> list[Shape]:
        inner = blocked.buffer(-OBSTACLE_LESS_M, join_style="mitre")
        parts = sorted(polygons_of(inner), key=lambda part: -part.area)
        return [(_smaller(part), _circle(part)) for part in parts]

    @cached_property
    def borders(self) -> Borders:
        """Return the borders of the field with its ways outside, which most sorties share."""
        outline = self.plan.field.outline
        return Borders(outline, outline, SIMPLER_M)

    def of(self, sortie: Sortie) -> Fence:
        """Return the fence of one sortie, drawn once.

        Raises:
            PlanError: where none has room that keeps near the field and holds the way.
        """
        way = _points(sortie)
        if way not in self.drawn:
            self.drawn[way] = self._of(sortie)
        return self.drawn[way]

    def has_room(self, sortie: Sortie) -> bool:
        """Return whether there is a fence for a sortie."""
        way = _points(sortie)
        if way in self.lacking:
            return False
        try:
            self.of(sortie)
        except FenceError:
            self.lacking.add(way)
            return False
        return True

    def _of(self, sortie: Sortie) -> Fence:
        """Return the fence of one sortie.

        Raises:
            PlanError: where none has room that keeps near the field and holds the way.
        """
        way = shapely.union_all([LineString(leg.points) for leg in sortie.legs])
        outline = self.plan.field.outline
        beyond = way.difference(outline.buffer(OUT_M / 2.0))
        borders, obstacles = self.borders, self.obstacles_of(way)
        whole: BaseGeometry = outline
        if not beyond.is_empty:
            whole = outline.union(beyond.buffer(FERRY_M, quad_segs=2))
            borders = Borders(whole, whole, SIMPLER_M)
        looked_at: list[tuple[float | None, Borders]] = [(None, borders)]
        fence = self._fitting(borders, way, obstacles, aside_m=None)
        for aside_m in ASIDE_M:
            if fence is not None:
                break
            part = whole.intersection(_beside(way, aside_m))
            near = shapely.union_all([Polygon(each.exterior) for each in polygons_of(part)])
            borders = Borders(near, whole, PART_SIMPLER_M)
            looked_at.append((aside_m, borders))
            fence = self._fitting(borders, way, obstacles, aside_m=aside_m)
        if fence is None:
            tried = [
                (far_m, each.parts) for far_m, some in looked_at for each in some if each.is_near
            ]
            fence = self._with_few_corners(tried, whole, way, obstacles)
            if fence is None:
                raise self._refusal(sortie, tried, way)
        if fence.left_out:
            fence = self._with_more_obstacles(fence, whole, obstacles)
        self._check(fence, way, sortie)
        return fence

    def _with_few_corners(
        self, borders: list[Tried], whole: BaseGeometry, way: BaseGeometry, obstacles: list[Shape]
    ) -> Fence | None:
        """Return a fence of one of these borders that need not keep near inside the field, if any.

        Outside of the field it keeps within `OUTSIDE_MAX_M`, as all do.
        """
        allowed = whole.buffer(OUTSIDE_MAX_M - ROUNDED_M)
        for aside_m in (None, *ASIDE_M):
            drawn = [
                border
                for far_m, parts in borders
                for border in polygons_of(parts)
                if far_m == aside_m and border.covers(way)
            ]
            simplest = min(drawn, key=_corners, default=None)
            if simplest is None or _corners(simplest) > TIMES_MAX * self.room:
                continue
            fewer = with_corners(simplest, allowed, self.room)
            found = self._with_obstacles(fewer, _outside_m(fewer, whole), obstacles)
            if found is not None:
                return replace(found, aside_m=aside_m)
        return None

    def _with_more_obstacles(
        self, fence: Fence, whole: BaseGeometry, obstacles: list[Shape]
    ) -> Fence:
        """Return a fence with more obstacles: its border, then they, have fewer corners."""
        is_near = shapely.intersects(fence.border, [part for part, _ in obstacles]).tolist()
        near = [each for each, inside in zip(obstacles, is_near, strict=True) if inside]
        best = fence
        for simpler_m in OBSTACLE_SIMPLER_M:
            drawn = self._simpler_obstacles(obstacles, simpler_m)
            wanted = sum(_bytes_of([part for part, _ in self._simpler_obstacles(near, simpler_m)]))
            most = (self.room_bytes - wanted - POLYGON_BYTES) // CORNER_BYTES
            border, outside_m = self._with_corners(fence, whole, most)
            found = self._with_obstacles(border, outside_m, drawn)
            if found is not None and found.left_out < best.left_out:
                best = replace(found, aside_m=fence.aside_m)
            if not best.left_out:
                break
        return best

    def _with_corners(self, fence: Fence, whole: BaseGeometry, most: int) -> tuple[Polygon, float]:
        """Return a fence's border with so few corners, and how far outside it lies.

        Most sorties share it.
        """
        key = (fence.border, whole, fence.outside_m)
        if key not in self._fewer:
            allowed = whole.buffer(max(NEAR_M, fence.outside_m) - ROUNDED_M)
            self._fewer[key] = FewerAndFewer(fence.border, allowed), {}
        drawn, known = self._fewer[key]
        if most not in known:
            border = drawn.with_corners(most)
            known[most] = border, _outside_m(border, whole)
        return known[most]

    def _simpler_obstacles(self, shapes: Sequence[Shape], simpler_m: float) -> list[Shape]:
        """Return obstacles with fewer corners, within themselves; most of their ground stays."""
        keys = [(id(shape), simpler_m) for shape in shapes]  # they are those of this plan, and stay
        new = {
            key: each for key, each in zip(keys, shapes, strict=True) if key not in self._simpler
        }
        drawn = each_inside([part for part, _ in new.values()], simpler_m)
        for (key, shape), found in zip(new.items(), drawn, strict=True):
            inside = max(polygons_of(found), key=lambda part: part.area)
            kept = inside.area >= OBSTACLE_SHARE * shape[0].area
            self._simpler[key] = (inside, shape[1]) if kept else shape
        return [self._simpler[key] for key in keys]

    def _fitting(
        self,
        borders: Borders,
        way: BaseGeometry,
        obstacles: list[Shape],
        *,
        aside_m: float | None,
    ) -> Fence | None:
        """Return a fence of these borders that holds the way, with as many obstacles as any.

        The first one with all of them: no more borders are drawn than that takes.
        """
        best: Fence | None = None
        for drawn in borders:
            for border in polygons_of(drawn.parts):
                found = None
                if _corners(border) <= self.room and drawn.is_near and border.covers(way):
                    found = self._with_obstacles(border, drawn.outside_m, obstacles)
                if found is not None and (best is None or found.left_out < best.left_out):
                    best = replace(found, aside_m=aside_m)
                    if not best.left_out:
                        return best
        return best

    def _with_obstacles(
        self, border: Polygon, outside_m: float, obstacles: list[Shape]
    ) -> Fence | None:
        """Return a fence of this border with as many obstacles as there is room for."""
        left = self.room_bytes - _bytes_of([border])[0]
        if left < 0:
            return None
        polygons, circles = [], []
        shapely.prepare(border)
        parts = np.array([part for part, _ in obstacles], dtype=object)
        is_near = shapely.intersects(border, parts)
        near = [each for each, inside in zip(obstacles, is_near.tolist(), strict=True) if inside]
        bytes_of = _bytes_of(parts[is_near])
        have_room = sum(bytes_of) <= left
        # A circle lies within its obstacle: it stands for one only where not all have room.
        for (polygon, round_one), polygon_bytes in zip(near, bytes_of, strict=True):
            circle = None if have_room else round_one
            taken = polygon_bytes if circle is None else CIRCLE_BYTES
            if taken > left:
                continue
            left -= taken
            if circle is None:
                polygons.append(polygon)
            else:
                circles.append(circle)
        return Fence(
            border=border, polygons=tuple(polygons), circles=tuple(circles),
            left_out=len(near) - len(polygons) - len(circles),
            crossed=len(self.obstacles) - len(obstacles), outside_m=outside_m,
        )  # fmt: skip

    def _refusal(self, sortie: Sortie, borders: list[Tried], way: BaseGeometry) -> FenceError:
        drawn = [part for *_, border in borders for part in polygons_of(border) if part.covers(way)]
        allowed = self.plan.field.outline.union(way).buffer(OUTSIDE_MAX_M - ROUNDED_M)
        fewest = [with_corners(part, allowed, self.room) for part in drawn]
        best = min(fewest, key=_corners, default=None)
        name = NAMES[self.plan.settings.autopilot]
        if best is None:
            place = self._place(sortie.legs[0].points[-1])
            why = (
                f"no fence within {OUTSIDE_MAX_M:.0f} m of field and ways holds it from {place} on"
            )
        else:
            why = (
                f"a fence within {OUTSIDE_MAX_M:.0f} m of the field has {_corners(best)} corners "
                f"or more, most of them near {self._place(_crowded(best))}, and {name} has room "
                f"for {self.room} ({self.room_bytes + ENDS_BYTES} bytes, {CORNER_BYTES} for each "
                f"and {ENDS_BYTES + POLYGON_BYTES} beside them)"
            )
        return FenceError(
            f"sortie {sortie.number}: {why}; make the sorties shorter (mission.tank_l), draw the "
            "outline with fewer corners, or write .waypoints, which has no fence"
        )

    def _place(self, point: tuple[float, float]) -> str:
        latitude_deg, longitude_deg = self.plan.field.frame.to_geographic(*point)
        return f"{latitude_deg:.6f}, {longitude_deg:.6f}"

    def _check(self, fence: Fence, way: BaseGeometry, sortie: Sortie) -> None:
        """Refuse a fence that the sortie itself would break."""
        kept = [*fence.polygons, *(_disc(*circle) for circle in fence.circles)]
        if fence.border.covers(way) and not bool(shapely.intersects(way, kept).any()):
            return
        raise PlanError(
            f"sortie {sortie.number} leads out of its fence; write .waypoints, which has none, and "
            "report this field"
        )


def fence_content(plan: Plan, fence: Fence) -> dict[str, Any]:
    """Return a fence as `.plan` files have it."""
    polygons = [_polygon(plan, fence.border, inclusion=True)]
    polygons += [_polygon(plan, part, inclusion=False) for part in fence.polygons]
    circles = [
        {
            "circle": {"center": _rounded(plan.frame.to_geographic(x, y)), "radius": round(r, 2)},
            "inclusion": False,
            "version": 1,
        }
        for x, y, r in fence.circles
    ]
    return {"circles": circles, "polygons": polygons, "version": 2}


def fence_warnings(plan: Plan, fences: Fences) -> tuple[str, ...]:
    """Return what the fences of a plan lack: room for obstacles, and nearness to the field."""
    found = [fences.of(sortie) for sortie in plan.sorties]
    most = max((fence.left_out for fence in found), default=0)
    outside_m = max((fence.outside_m for fence in found), default=0.0)
    name = NAMES[plan.settings.autopilot]
    said = []
    if outside_m > NEAR_M:
        said.append(
            f"the fence lies up to {outside_m:.0f} m outside the field: {name} has no room for "
            "the corners of a nearer one"
        )
    narrow = [fence.aside_m for fence in found if fence.aside_m is not None]
    if narrow:
        said.append(
            f"the fence of {counted(len(narrow), 'sortie')} holds only the ground "
            f"{min(narrow):g} m beside the way: {name} has no room for the corners of the whole "
            "field, and a return in a straight line may cross it"
        )
    crossed = max((fence.crossed for fence in found), default=0)
    if crossed:
        said.append(
            f"the fence leaves out {crossed} obstacle{'' if crossed == 1 else 's'} that ferries "
            f"cross at {plan.settings.ferry_height_m:g} m: a fence has no heights"
        )
    if not most:
        return tuple(said)
    return (
        *said,
        f"the fence has no room for {most} of {len(fences.obstacles)} obstacles, those far from "
        f"the way and the smallest: the passes keep clear of them, but {name} would not stop the "
        "aircraft there",
    )


def _points(sortie: Sortie) -> Way:
    return tuple(leg.points for leg in sortie.legs)


@lru_cache(maxsize=1024)
def _disc(east_m: float, north_m: float, radius_m: float) -> Polygon:
    """Return the ground of a circle: those around the same obstacle are asked for by many sorties.

    >>> round(_disc(0.0, 0.0, 1.0).area, 2)
    3.14
    """
    found: Polygon = shapely.Point(east_m, north_m).buffer(radius_m)
    return found


def _beside(way: BaseGeometry, aside_m: float) -> BaseGeometry:
    """Return the ground within a distance of a way.

    A swept way crosses its own buffer everywhere: leg by leg it takes a tenth of the time.
    """
    return shapely.union_all(shapely.buffer(shapely.get_parts(way), aside_m, quad_segs=2))


def _outside_m(border: BaseGeometry, field: BaseGeometry) -> float:
    """Return how far outside the field a border lies at most."""
    places = shapely.get_coordinates(shapely.segmentize(border, STEP_M))
    places = places[~shapely.contains_xy(field, places)]
    _, edges = border_edges(field)
    _, far_m = edges.query_nearest(shapely.points(places), return_distance=True, all_matches=False)
    return float(far_m.max(initial=0.0))


def _corners(part: Polygon) -> int:
    return int(shapely.get_num_points(shapely.get_exterior_ring(part))) - 1


def _crowded(part: Polygon) -> tuple[float, float]:
    """Return the corner of a polygon where the corners around it are nearest."""
    points = shapely.get_coordinates(part.exterior)[:-1]
    shifts = range(-CROWD, CROWD + 1)
    far_m = sum(np.hypot(*(points - np.roll(points, shift, axis=0)).T) for shift in shifts)
    east_m, north_m = points[int(np.argmin(far_m))].tolist()
    return east_m, north_m


def _bytes_of(parts: Sequence[Polygon] | Objects) -> list[int]:
    """Return what an autopilot keeps each polygon in."""
    corners = shapely.get_num_points(shapely.get_exterior_ring(parts)) - 1
    found: list[int] = (POLYGON_BYTES + CORNER_BYTES * corners).tolist()
    return found


def _smaller(part: Polygon) -> Polygon:
    """Return an obstacle with few corners, within itself."""
    found = Polygon(part.exterior).simplify(OBSTACLE_SIMPLE_M)
    return found if isinstance(found, Polygon) and not found.is_empty else part


def _circle(part: Polygon) -> tuple[float, float, float] | None:
    """Return the circle (east, north, radius) in a round obstacle."""
    middle = part.centroid
    radius_m = float(part.exterior.distance(middle))
    if not part.contains(middle) or math.pi * radius_m**2 < ROUND_SHARE * part.area:
        return None
    return float(middle.x), float(middle.y), radius_m


def _rounded(place: tuple[float, float]) -> list[float]:
    return [round(place[0], DIGITS), round(place[1], DIGITS)]


def _polygon(plan: Plan, part: Polygon, *, inclusion: bool) -> dict[str, Any]:
    ring = shapely.get_coordinates(orient(part, sign=-1.0).exterior)[:-1]
    places = [_rounded(plan.frame.to_geographic(*point)) for point in ring.tolist()]
    return {"inclusion": inclusion, "polygon": places, "version": 1}
