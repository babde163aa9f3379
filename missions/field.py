"""The field in metres: where the aircraft may fly, and which ground may be sprayed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import shapely
from shapely import MultiPolygon, Polygon
from shapely.affinity import translate
from shapely.geometry.base import BaseGeometry

from companion.core.frame import LocalFrame
from companion.core.prescription import SLIVER_M
from missions.coverage import reachable
from missions.errors import PlanError
from missions.fewer_corners import around_with_fewer_corners, inside_with_fewer_corners
from missions.maps.local import Area, as_area, make_valid, polygons_of, project
from missions.maps.local import places as places_of
from missions.reading_outline import Obstacle, around_ground
from missions.strips import Floats

# Coordinates are rounded when they are written, and a long edge is straight in degrees for one
# program and in metres for another: strips keep this far from the border.
MARGIN_M = 0.0025
# Borders are drawn anew with fewer corners so far inside, at most, and those of obstacles so far
# outside of their buffers: a circle of 5 m becomes one of ten corners. Where many obstacles would
# take more of the ground than that share, it is the next lesser distance.
OUTLINE_TOLERANCE_M = 0.1
OBSTACLE_TOLERANCES_M = (0.5, 0.35, 0.25, 0.18, 0.12, 0.085, 0.06, 0.042, 0.03)
OBSTACLE_SHARE = 0.0009
# Of round corners those are left out first that lie so close to the chord, on ground grown by it.
CLOSE_M = 0.003
# What blocks ways around the field is drawn with few corners, too, so close outside.
BLOCKED_TOLERANCE_M = 0.03
# Corners sharper than 23 degrees are cut off beyond 5 times the margin.
MITRE_LIMIT = 5.0
# Simpler borders leave out so little of what a strip can reach, what obstacles take among it; if
# not, the outline's tolerance is made less, and after so many times it stays as it was drawn. A
# plan covers 99.8 %.
LOST_MAX, TOLERANCE_LESS, TOLERANCES = 0.0017, 0.6, 6
# Where outer valves close along the border, bare ground counts, not reach: pieces of 2 m around a
# curve are flown too slowly to spray, and left ten times that bare.
LOST_CLOSING = 0.01
# A tolerance so many times the one that would lose just what may be lost is not tried.
CLEARLY = 1.5
EXTENT_MAX_M = 20_000.0
# 383 ha with a swath of 1 m have so many.
PASSES_MAX = 1_000


@dataclass(frozen=True, slots=True, kw_only=True)
class High:
    """Where ferries at their own height may fly: `fly` in the field, and nowhere in `blocked`."""

    fly: Area
    blocked: BaseGeometry


@dataclass(frozen=True, slots=True, kw_only=True)
class Holes:
    """The outline's holes: how far the aircraft's centre keeps off, and what that leaves bare."""

    count: int
    kept_m: float
    bare_m2: float


# What is not sprayed: obstacles by how they are drawn, with their buffers, and areas.
Kind = Literal["point", "line", "area", "hole", "no spray"]
DRAWN: tuple[Kind, ...] = ("point", "line", "area")


@dataclass(frozen=True, slots=True, kw_only=True)
class Field:
    """`outline` is as given; `fly` lies in it without holes and obstacles; `spray` in `fly`.

    `limit` is all that may be sprayed; `spray` keeps a margin from its edge, and has fewer
    corners: `given_up_m2` is left for that, within `tolerance_m` of the outline.
    `blocked` is what may not be flown over, not even on the way to the field. `closes` is the
    ground outside of which the companion closes its valves, where that is another than `limit`.
    `high` is the same for ferries, which cross low obstacles; None where they cross none.
    `closed` is what is not sprayed, by its kind.
    """

    frame: LocalFrame
    outline: Area
    fly: Area
    spray: Area
    limit: BaseGeometry
    blocked: BaseGeometry
    closes: BaseGeometry | None = None
    tolerance_m: float = OUTLINE_TOLERANCE_M
    given_up_m2: float = 0.0
    high: High | None = None
    closed: tuple[tuple[Kind, BaseGeometry], ...] = ()
    holes: Holes = Holes(count=0, kept_m=0.0, bare_m2=0.0)

    @property
    def kept_in(self) -> BaseGeometry:
        """Return the ground that the companion's border rule keeps the valves in."""
        return self.limit if self.closes is None else self.closes

    @property
    def area_m2(self) -> float:
        """Return the ground that is to be sprayed."""
        return float(self.limit.area)


def frame_of(boundary: MultiPolygon | Polygon) -> LocalFrame:
    """Return the frame around the middle of the field's bounds."""
    west, south, east, north = boundary.bounds
    return LocalFrame(latitude_deg=(south + north) / 2, longitude_deg=(west + east) / 2)


def build_field(
    boundary: Area,
    *,
    obstacles: Sequence[Area | Obstacle] = (),
    no_spray: Sequence[Area] = (),
    obstacle_buffer_m: float = 2.0,
    over_holes: bool = False,
    no_spray_buffer_m: float = 0.0,
    wind: WindBuffer | None = None,
    swath_width_m: float,
    frame: LocalFrame | None = None,
    offset_m: tuple[float, float] = (0.0, 0.0),
    kept_m: float = 0.0,
    tolerance_m: float = OUTLINE_TOLERANCE_M,
    ferry_over_m: float | None = None,
) -> Field:
    """Return the field of a boundary and what lies in it, all in longitude and latitude.

    `offset_m` moves all of it: the offset between map and receiver (prescription.offset_east_m).
    A `wind` widens the buffers of no-spray areas where it blows towards them. Strips keep `kept_m`
    from every border, where that leaves room for a swath. Borders are drawn simpler by
    `tolerance_m` at most, inside of the outline and outside of what is kept clear.

    Raises:
        PlanError: where nothing is left that a strip of the swath's width fits on.
    """
    frame = frame or frame_of(boundary)
    outline = _closed(both_ways(boundary, frame))
    west, south, east, north = outline.bounds
    if not max(east - west, north - south) <= EXTENT_MAX_M:
        raise PlanError(
            f"the field spans {max(east - west, north - south) / 1000.0:.0f} km; give one field, "
            "in the CRS of its coordinates"
        )
    outline = translate(outline, *offset_m)
    off_m = 0.0 if over_holes else obstacle_buffer_m
    holes, beside, kept_off = _holes_of(outline, off_m)
    given = [each if isinstance(each, Obstacle) else Obstacle(geometry=each) for each in obstacles]
    grounds = [each.ground(frame, obstacle_buffer_m, offset_m) for each in given]
    kept = shapely.union_all([*grounds, beside])
    blocked = shapely.union_all([*holes, _simply_around(kept, BLOCKED_TOLERANCE_M)])
    flown = outline.difference(kept)
    around = _around(outline, kept)
    inside, tolerance_m = _simpler(outline, kept, around, tolerance_m, swath_width_m, kept_m)
    fly, high = None, None
    if inside is not None:
        fly = as_area(polygons_of(inside.difference(around)))
        tall = [
            ground
            for ground, each in zip(grounds, given, strict=True)
            if ferry_over_m is None or each.height_m is None or each.height_m > ferry_over_m
        ]
        over = None
        if len(tall) < len(grounds):
            tall.append(beside)
            clear = _around(outline, shapely.union_all(tall))
            over = as_area(polygons_of(inside.difference(clear)))
        if over is not None:
            above = _simply_around(shapely.union_all(tall), BLOCKED_TOLERANCE_M)
            high = High(fly=over, blocked=shapely.union_all([*holes, above]))
    off = [translate(local_area(area, frame), *offset_m) for area in no_spray]
    closed = _kept_away_from(off, no_spray_buffer_m, wind)
    spray = fly
    if fly is not None and not closed.is_empty:
        apart = around_with_fewer_corners(_grown(closed, MARGIN_M), tolerance_m)
        spray = as_area(polygons_of(fly.difference(apart)))
    if spray is None or fly is None:
        what = "obstacles, holes" if off_m and holes else "obstacles"
        raise PlanError(f"{what} and no-spray areas leave nothing of the field to spray")
    limit = flown.difference(closed)
    _check_width(spray, swath_width_m)
    given_up_m2 = float(limit.area) - float(spray.area)
    spray = _inset(spray, kept_m, swath_width_m)
    return Field(
        frame=frame,
        outline=outline,
        fly=fly,
        spray=spray,
        limit=limit,
        blocked=blocked,
        tolerance_m=tolerance_m,
        given_up_m2=given_up_m2,
        high=high,
        closed=_closed_by_kind(given, grounds, [*holes, beside], closed),
        holes=kept_off,
    )


def _holes_of(outline: Area, off_m: float) -> tuple[list[Polygon], BaseGeometry, Holes]:
    """Return the holes, the ground of them and so far beside them, and what that leaves bare."""
    holes = [Polygon(ring) for part in polygons_of(outline) for ring in part.interiors]
    beside = shapely.union_all([around_ground(hole, off_m) for hole in holes if off_m])
    bare_m2 = float(outline.intersection(beside).area)
    return holes, beside, Holes(count=len(holes), kept_m=off_m, bare_m2=bare_m2)


def _closed_by_kind(
    given: Sequence[Obstacle],
    grounds: Sequence[BaseGeometry],
    holes: Sequence[BaseGeometry],
    no_spray: BaseGeometry,
) -> tuple[tuple[Kind, BaseGeometry], ...]:
    """Return what is not sprayed; what is of several kinds, as the last of them."""
    found: dict[Kind, list[BaseGeometry]] = {"no spray": [no_spray], "hole": list(holes)}
    for each, ground in zip(given, grounds, strict=True):
        kind = DRAWN[int(shapely.get_dimensions(each.geometry))]
        found.setdefault(kind, []).append(ground)
    united = {kind: shapely.union_all(some) for kind, some in found.items()}
    return tuple((kind, ground) for kind, ground in united.items() if not ground.is_empty)


def _kept_away_from(
    areas: Sequence[Area], buffer_m: float, wind: WindBuffer | None
) -> BaseGeometry:
    """Return no-spray areas with the ground around them; a wind widens it where it blows."""
    return shapely.union_all(
        [_grown(area, buffer_m) if wind is None else wind.around(area, buffer_m) for area in areas]
    )


def _around(outline: Area, kept: BaseGeometry) -> BaseGeometry:
    """Return the ground of obstacles, drawn with few corners."""
    grown = _simply_around(_grown(kept, MARGIN_M), CLOSE_M)
    if grown.is_empty:
        return grown
    free_m2 = outline.difference(grown).area
    allowed_m2, likely_m = OBSTACLE_SHARE * free_m2, math.inf
    for tolerance_m in OBSTACLE_TOLERANCES_M:
        if tolerance_m > likely_m:
            continue
        around = around_with_fewer_corners(grown, tolerance_m)
        lost_m2 = free_m2 - outline.difference(around).area
        if lost_m2 <= allowed_m2:
            return around
        # What is lost is about as much as the tolerance: those clearly too large are not drawn.
        likely_m = CLEARLY * tolerance_m * allowed_m2 / lost_m2
    return grown


def _simply_around(area: BaseGeometry, tolerance_m: float) -> BaseGeometry:
    """Return ground with all of the area in it, up to twice the tolerance beyond."""
    found: BaseGeometry = shapely.simplify(_grown(area, tolerance_m), tolerance_m)
    return found


def local_area(area: Area, frame: LocalFrame) -> Area:
    """Return an area in metres, valid."""
    local = project(area, frame)
    valid = local if local.is_valid else make_valid(local)
    if valid is None:
        raise PlanError("a part of the field has no area; draw it again")
    return valid


def _closed(area: Area) -> Area:
    """Return the ground without the cracks that digitising leaves between zones.

    Only where it then has fewer parts and holes: a narrow notch that is drawn stays.
    """
    half_m = SLIVER_M / 2.0
    closed = area.buffer(half_m, join_style="mitre").buffer(-half_m, join_style="mitre")
    found = as_area(polygons_of(closed))
    return area if found is None or not _pieces(found) < _pieces(area) else found


def _pieces(area: Area) -> int:
    return sum(1 + len(part.interiors) for part in polygons_of(area))


def _grown(area: BaseGeometry, by_m: float) -> BaseGeometry:
    """Return an area and all within a distance of it, with straight edges around its corners."""
    return area.buffer(by_m, join_style="mitre", mitre_limit=MITRE_LIMIT)


def _simpler(
    outline: Area,
    kept: BaseGeometry,
    around: BaseGeometry,
    tolerance_m: float,
    swath_width_m: float,
    kept_m: float,
) -> tuple[Area | None, float]:
    """Return the ground a margin inside the outline, few-cornered, and within which tolerance.

    It is less where a ditch would become narrower than a swath by it, or where obstacles drawn as
    `around` take of the ground beside what is `kept` clear.
    """
    inside = as_area(polygons_of(outline.buffer(-MARGIN_M, join_style="mitre")))
    if inside is None:
        return None, 0.0
    lost_max = LOST_CLOSING if kept_m else LOST_MAX
    reached_m2 = reachable(inside.difference(kept), swath_width_m).area
    spare_m2 = reachable(inside.difference(around), swath_width_m).area
    spare_m2 -= (1.0 - lost_max) * reached_m2
    likely_m = math.inf if spare_m2 > 0.0 else 0.0
    for _ in range(TOLERANCES if tolerance_m > 0.0 else 0):
        if tolerance_m <= likely_m:
            simple = inside_with_fewer_corners(inside, tolerance_m)
            left_m2 = reachable(simple.difference(around), swath_width_m).area
            short_m2 = (1.0 - lost_max) * reached_m2 - left_m2
            if short_m2 <= 0.0:
                return simple, tolerance_m
            # What is lost is about as much as the tolerance, as with obstacles.
            likely_m = CLEARLY * tolerance_m * spare_m2 / (spare_m2 + short_m2)
        tolerance_m *= TOLERANCE_LESS
    return inside, 0.0


def _inset(spray: Area, kept_m: float, swath_width_m: float) -> Area:
    """Return the ground that far inside; as it is where a swath would not fit on it any more."""
    if not kept_m > 0.0:
        return spray
    inside = as_area(polygons_of(spray.buffer(-kept_m, join_style="mitre")))
    if inside is None or inside.buffer(-swath_width_m / 2.0).is_empty:
        return spray
    return inside


def _check_width(spray: Area, swath_width_m: float) -> None:
    # No pass is longer than the diagonal of the box: they are at least that many.
    west, south, east, north = spray.bounds
    passes = spray.area / math.hypot(east - west, north - south) / swath_width_m
    if not passes <= PASSES_MAX:
        raise PlanError(
            f"a swath of {swath_width_m:g} m needs {passes:.0f} passes or more, and a plan has "
            f"{PASSES_MAX} at most; see --swath-m (mission.swath_width_m)"
        )
    if spray.buffer(-swath_width_m / 2.0).is_empty:
        raise PlanError(
            f"the field is nowhere as wide as the swath of {swath_width_m:g} m "
            "(mission.swath_width_m); spray it by hand, or with a narrower boom"
        )


def both_ways(area: Area, frame: LocalFrame) -> Area:
    """Return the ground inside edges that are straight in metres and inside those in degrees.

    Over 1 km the two part by centimetres, and nobody says which of them a boundary means.
    """
    points = shapely.get_coordinates(area)
    east_m, north_m = frame.to_local_all(points[:, 1].tolist(), points[:, 0].tolist())
    straight = shapely.set_coordinates(
        shapely.from_wkb(shapely.to_wkb(area)), np.column_stack([east_m, north_m])
    )
    local = local_area(area, frame)
    if not straight.is_valid:
        return local
    return as_area(polygons_of(local.intersection(straight))) or local


def local_points(points: Sequence[tuple[float, float]], frame: LocalFrame) -> Floats:
    """Return (latitude, longitude) points as rows of east and north."""
    return places_of(points, frame)


# Buffers of areas that must not be sprayed, wider where the wind blows towards them.
#
# At a place of the field whose way to the area has the unit vector u, with the wind blowing along
# the vector w, the buffer is
#
#     buffer = base + k * max(0, w . u)
#
# the base (what the label asks for, at least) plus `k` metres for each m/s of the wind that blows
# towards the area. Across the wind and downwind of the area the base holds.

# The reach around a point is drawn in steps of this angle, so much too wide that the corners'
# chords lie outside the curve: 1 / cos(1.5 degrees) and the curve's own bend over 3 degrees.
STEP_DEG, WIDER = 3.0, 1.0005 / math.cos(math.radians(1.5))
# Areas with more corners are simplified outwards first.
CORNERS_MAX, SIMPLER_M = 400, 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class WindBuffer:
    """Wind as it is reported, by where it comes from, and the metres for each m/s of it."""

    speed_m_s: float
    from_deg: float
    m_per_m_s: float

    def __post_init__(self) -> None:
        if not 0.0 <= self.speed_m_s <= 100.0:
            raise ValueError(f"a wind of {self.speed_m_s} m/s is not possible")
        if not -360.0 <= self.from_deg <= 360.0:
            raise ValueError(f"{self.from_deg} is not a wind direction")
        if not 0.0 <= self.m_per_m_s <= 1000.0:
            raise ValueError(f"{self.m_per_m_s} m for each m/s of wind is not a buffer")

    @property
    def extra_m(self) -> float:
        """Return what the wind adds straight upwind of an area."""
        return self.speed_m_s * self.m_per_m_s

    def width_m(self, towards_deg: float, base_m: float) -> float:
        """Return the buffer where the area lies in this direction, clockwise from north.

        >>> west = WindBuffer(speed_m_s=4.0, from_deg=270.0, m_per_m_s=2.5)
        >>> [round(west.width_m(to, 5.0), 9) for to in (90.0, 150.0, 180.0, 270.0)]
        [15.0, 10.0, 5.0, 5.0]
        """
        off_deg = towards_deg - (self.from_deg + 180.0)
        return base_m + self.extra_m * max(0.0, math.cos(math.radians(off_deg)))

    def around(self, area: BaseGeometry, base_m: float) -> BaseGeometry:
        """Return the ground that is nearer to some place of an area than its buffer there."""
        plain: BaseGeometry = area.buffer(base_m)
        if not self.extra_m > 0.0 or area.is_empty:
            return plain
        fan = self._fan(base_m)
        edges = _edges(area)
        # A convex piece carried along a straight edge sweeps the hull of its two ends.
        start, end = edges[:, None, None, :2] + fan[None], edges[:, None, None, 2:] + fan[None]
        swept = np.concatenate([start, end], axis=2).reshape(-1, 6, 2)
        hulls = np.asarray(shapely.convex_hull(shapely.linestrings(swept)), dtype=object)
        found: BaseGeometry = shapely.union_all([plain, *hulls.tolist()])
        return found

    def _fan(self, base_m: float) -> Floats:
        """Return the reach upwind of a point as triangles from it, (triangles, 3, 2)."""
        count = round(180.0 / STEP_DEG)
        off = np.radians(np.linspace(-90.0, 90.0, count + 1))
        reach = (base_m + self.extra_m * np.cos(off)) * WIDER
        angle = np.radians(self.from_deg) + off
        tips = np.column_stack([reach * np.sin(angle), reach * np.cos(angle)])
        triangles: Floats = np.stack([np.zeros((count, 2)), tips[:-1], tips[1:]], axis=1)
        return triangles


def _edges(area: BaseGeometry) -> Floats:
    """Return all edges of an area as rows of start and end."""
    if len(shapely.get_coordinates(area)) > CORNERS_MAX:
        area = area.simplify(SIMPLER_M).buffer(SIMPLER_M, join_style="mitre")
    rings = shapely.get_rings(shapely.get_parts(area))
    points = [shapely.get_coordinates(ring) for ring in rings]
    found: Floats = np.concatenate([np.column_stack([one[:-1], one[1:]]) for one in points])
    return found
