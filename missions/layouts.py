"""Which lines cover a field: several layouts are drawn, and the quickest tour of them is taken.

A pass along the whole border with lines inside; lines from border to border with passes only where
they are needed; such lines that begin anew at edges along them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import shapely
from shapely import Polygon
from shapely.geometry.base import BaseGeometry

from missions.boom import Boom, boom_of, lines_over, passes_over
from missions.corners import Motion
from missions.coverage import patches, reachable
from missions.field import Field
from missions.free_space import FreeSpace, free_space
from missions.maps.local import polygons_of
from missions.open_lines import (
    LEFT_SHARE,
    fitted_lines,
    has_edges_along,
    likely_passes,
    needed_passes,
    open_lines,
)
from missions.plan import LEAVE_PERCENT, Settings
from missions.searching import is_stopped, lines_are_drawn
from missions.selection import Aim, chosen, families
from missions.strips import (
    Bools,
    Floats,
    border_passes,
    directions,
    inner_ground,
    inner_lines,
    joined,
    lengths_m,
    no_lines,
    whole,
)
from missions.worth import LEFT_SHARE as WORTH_LEFT
from missions.worth import (
    LINES_MAX,
    WORTH,
    Crowded,
    Tour,
    meeting,
    tour_of,
    without_stubs,
    worthwhile,
)

# Of the best courses so many are drawn in full; of the layouts so many are gone through line by
# line, and only the best one where it has more lines than this.
ANGLES_TRIED, LAYOUTS_TRIED, MANY_LINES = 2, 2, 100
# Simpler borders and what lines leave out come to 0.2 % of the ground at most, with a little for
# how both are measured; lines alone may always leave out 0.02 %. What the passes along a ragged
# border leave beyond that counts against a layout where both come to more than 99 % of it.
LOST_SHARE, LEFT_MIN, BARELY_SHARE = 0.9, 0.0002, 0.99
# Where more may be left than that, a line must bring half of what its time brings elsewhere.
LEFT_WORTH = 0.5
# Of smaller fields, 1 ha with a swath of 6 m, lines are chosen from all that could be flown.
SMALL_SWATHS2 = 300.0
# Going through lines one by one saves less than that of a tour. So many of those chosen from all
# that are worse in a row, by no more than that, tell that there are none better.
WORSE, WORSE_MAX = 1.04, 2
# Lines as long as each other and along each other.
EQUAL_M, EQUAL_SINE = 1.0, 1e-3
# The companion takes legs for one another within half a metre; ends of lines are moved a little.
SHADOW_M = 0.6


@dataclass(frozen=True, slots=True, kw_only=True)
class _Covering:
    """A field that is to be covered, and what layouts of lines are compared by."""

    field: Field
    settings: Settings
    motion: Motion
    space: FreeSpace
    target: BaseGeometry
    left_share: float
    aim: Aim
    boom: Boom

    @property
    def width_m(self) -> float:
        return self.settings.swath_width_m

    def value_s(self, tour: Tour) -> float:
        """Return the time of a tour, with what is left out and covered twice."""
        strips = self.boom.strips(tour.lines)
        covered = whole(strips[~shadowed(tour.lines)])
        doubled_m2 = float(shapely.area(strips).sum()) - covered.area
        left_m2 = self.target.difference(covered).area
        return tour.seconds + self.aim.cost_s(left_m2=left_m2, doubled_m2=max(doubled_m2, 0.0))

    def left_m2(self, tour: Tour) -> float:
        """Return what lines leave of what a strip can reach."""
        lines = tour.lines[~shadowed(tour.lines)]
        return float(self.target.difference(self.boom.united(lines)).area)

    def is_block(self, tour: Tour) -> bool:
        """Return whether a tour is nothing but equal lines side by side, as on a rectangle."""
        along, length_m = directions(tour.lines), lengths_m(tour.lines)
        sines = along[:, 0] * along[0, 1] - along[:, 1] * along[0, 0]
        as_long = float(np.ptp(length_m)) < EQUAL_M
        return (
            not self.boom.closes
            and self.settings.leave_max_percent <= LEAVE_PERCENT
            and as_long
            and bool(np.abs(sines).max() < EQUAL_SINE)
        )

    def tour(self, lines: Floats) -> Tour:
        """Return a good tour of lines."""
        return tour_of(lines, self.space, self.motion)

    def worthwhile(self, tour: Tour) -> Tour:
        """Return a tour without the lines that are not worth their time."""
        kept = worthwhile(
            tour, self.target, self.boom, left_share=self.left_share,
            worth=LEFT_WORTH if self.settings.leave_max_percent > LEAVE_PERCENT else WORTH,
        )  # fmt: skip
        return meeting(
            self.tour(kept), self.target, self.field.spray, self.boom, left_share=self.left_share,
            overlap_s_m2=self.aim.doubled_s_m2,
        )  # fmt: skip

    def selected(
        self, drawn: list[Floats], angles_deg: list[float], *, best_s: float
    ) -> Iterator[Tour]:
        """Yield tours of lines that are chosen from all that could be flown, the best first.

        Those that are clearly worse than one of value `best_s` are not gone through line by line,
        and after some of them no others are looked at.
        """
        ground, width_m, aim = self.field.spray, self.width_m, self.aim
        passes = border_passes(ground, width_m)
        best = drawn[0]
        over = passes_over(ground, self.boom) if self.boom.closes else no_lines()
        some = families(ground, self.boom, angles_deg, with_fans=self.settings.angle_deg is None)
        if self.boom.closes:
            some = [joined([family, over]) for family in some]
        # Of each course: from the passes along the border on, and lines of the best layout.
        pools = [(joined([passes, family, best]), list(range(len(passes)))) for family in some]
        pools.append((joined([best, passes, *some, *drawn[1:]]), list(range(len(best)))))
        worse = 0
        for lines in chosen(pools, ground, self.boom, motion=self.motion, aim=aim):
            if is_stopped():
                return
            if aim.covers_first:
                more = patches(
                    lines, ground, width_m, left_share=self.left_share,
                    covered=self.boom.united(lines),
                )  # fmt: skip
                lines = joined([lines, more])
            if not len(lines):
                continue
            tour = self.tour(lines)
            worse = worse + 1 if self.value_s(tour) > WORSE * best_s else 0
            if worse >= WORSE_MAX:
                return
            if not worse:
                yield self.worthwhile(tour)


def shadowed(lines: Floats) -> Bools:
    """Return which lines lie whole on a longer one, or nearly: the companion leaves them to it.

    >>> shadowed(np.array([[0.0, 0.0, 50.0, 0.0], [1.0, 0.4, 49.0, 0.4], [1.0, 1.4, 49.0, 1.4]]))
    array([False,  True, False])
    """
    along, length_m = directions(lines), lengths_m(lines)
    ends = lines.reshape(-1, 2, 2)
    found = np.zeros(len(lines), dtype=np.bool_)
    numbers = np.arange(len(lines))
    for number, (way, start, long_m) in enumerate(zip(along, ends[:, 0], length_m, strict=True)):
        off = ends - start
        aside = np.abs(off @ np.array([-way[1], way[0]])).max(axis=1)
        at = off @ way
        beyond = np.maximum(-at.min(axis=1), at.max(axis=1) - long_m)
        is_shorter = (length_m < long_m) | ((length_m == long_m) & (numbers > number))
        found |= (aside < SHADOW_M) & (beyond < SHADOW_M) & is_shorter
    return found


def spray_lines(field: Field, settings: Settings, motion: Motion) -> tuple[Floats, float]:
    """Return the lines that cover the field, and the course of the parallel ones."""
    width_m = settings.swath_width_m
    plain = None
    if settings.ends_over:
        plain = spray_lines(field, replace(settings, ends_over=False), motion)
    inner = inner_ground(field.spray, width_m)
    angles = _courses(inner, field, settings, motion)
    spare = _spare(field, settings)
    leaves = settings.leave_max_percent > LEAVE_PERCENT
    few = spare if leaves else min(LEFT_SHARE, spare / 2.0)
    boom = boom_of(settings, field)
    drawn = _layouts(field, settings, motion, inner, angles[:ANGLES_TRIED], boom, left_share=few)
    lines_are_drawn()
    if max(len(lines) for _, lines in drawn) > LINES_MAX:
        costs = [_layout_s(lines, field, settings, motion) for _, lines in drawn]
        angle_deg, lines = drawn[costs.index(min(costs))]
        return lines, angle_deg
    target, left_share = (
        reachable(field.spray, width_m),
        spare if leaves else min(WORTH_LEFT, spare),
    )
    covering = _Covering(
        field=field, settings=settings, motion=motion, space=free_space(field.fly),
        target=target, left_share=left_share, aim=_aim(settings, target.area, left_share),
        boom=boom,
    )  # fmt: skip
    tours = [(angle_deg, covering.tour(lines)) for angle_deg, lines in drawn]
    best = sorted(tours, key=lambda each: covering.value_s(each[1]))[:LAYOUTS_TRIED]
    if len(best[0][1].lines) > MANY_LINES:
        best = best[:1]
    better = [(angle_deg, covering.worthwhile(tour)) for angle_deg, tour in best]
    if plain is not None:
        better.append((plain[1], covering.tour(plain[0])))
    barely_m2 = max(_spare(field, settings, BARELY_SHARE), left_share) * target.area
    better.sort(key=lambda each: (covering.left_m2(each[1]) > barely_m2, covering.value_s(each[1])))
    angle_deg, tour = better[0]
    is_asked = (
        settings.leave_max_percent > LEAVE_PERCENT or settings.overlap_max_percent is not None
    )
    chooses = settings.moves and is_small(field, settings)
    if chooses and (is_asked or not covering.is_block(tour)):
        if settings.angle_deg is None:
            angles = [*edge_angles(field.spray), *angles[:ANGLES_TRIED]]
        layouts = [tour.lines, *(other for _, other in drawn)]
        # The time of many short lines along a ragged border buys no ground that may not be left.
        most_m2 = max(covering.aim.left_max_m2, covering.left_m2(tour))
        found = min(
            (
                other
                for other in covering.selected(layouts, angles, best_s=covering.value_s(tour))
                if not covering.aim.covers_first or covering.left_m2(other) <= most_m2
            ),
            key=covering.value_s,
            default=tour,
        )
        if covering.value_s(found) < covering.value_s(tour):
            if settings.angle_deg is None:
                angle_deg = main_course_deg(found.lines)
            return found.lines, angle_deg
    return tour.lines, angle_deg


def flyable(lines: Floats, field: Field, settings: Settings) -> Floats:
    """Return lines without those too short for a leg, where what they cover may be left out."""
    return without_stubs(
        lines,
        field.fly,
        reachable(field.spray, settings.swath_width_m),
        boom_of(settings, field),
        left_share=_spare(field, settings),
    )


def crowded(lines: Floats, field: Field, settings: Settings, *, apart: bool) -> Crowded:
    """Return the lines, short ones of which may be left out where they crowd waypoints."""
    return Crowded(
        lines,
        reachable(field.spray, settings.swath_width_m),
        boom_of(settings, field),
        left_share=_spare(field, settings),
        apart=apart,
    )


def is_small(field: Field, settings: Settings) -> bool:
    """Return whether lines are chosen from all that could be flown."""
    return field.spray.area <= SMALL_SWATHS2 * settings.swath_width_m**2


def _spare(field: Field, settings: Settings, lost_share: float = LOST_SHARE) -> float:
    """Return what share of the ground lines may leave out, beside what simpler borders gave up."""
    lost_max = lost_share * settings.leave_max_percent / 100.0
    reached_m2 = reachable(field.limit, settings.swath_width_m).area
    return max(lost_max - field.given_up_m2 / reached_m2, LEFT_MIN)


def _aim(settings: Settings, area_m2: float, left_share: float) -> Aim:
    """Return what lines may leave out and cover twice."""
    once, cap = settings.closing_share, settings.overlap_max_percent
    # Of the litres, which fall on ground that is covered once and twice.
    twice = None if cap is None else cap / max(100.0 - cap, 1e-9)
    return Aim(
        left_max_m2=left_share * area_m2,
        doubled_s_m2=once * LAYOUT_WEIGHT / (settings.swath_width_m * settings.speed_m_s),
        doubled_max_share=None if twice is None else twice / once,
        target_m2=area_m2,
        covers_first=covers_first(settings),
    )


def covers_first(settings: Settings) -> bool:
    """Return whether ground is covered rather than a cap of overlap kept."""
    return settings.overlap_max_percent is None or settings.leave_max_percent > LEAVE_PERCENT


def _courses(inner: BaseGeometry, field: Field, settings: Settings, motion: Motion) -> list[float]:
    """Return the courses that may be flown, the best first."""
    if settings.angle_deg is not None:
        return [settings.angle_deg]
    width_m = settings.swath_width_m
    return [angle for _, angle in ranked(inner, field.spray, width_m=width_m, motion=motion)]


def _layouts(
    field: Field,
    settings: Settings,
    motion: Motion,
    inner: BaseGeometry,
    angles: list[float],
    boom: Boom,
    *,
    left_share: float,
) -> list[tuple[float, Floats]]:
    """Return (course, lines) of each layout."""
    width_m, ground = settings.swath_width_m, field.spray
    passes = border_passes(ground, width_m)
    drawn: list[tuple[float, Floats]] = []
    bare: list[_Bare] = []
    for number, angle_deg in enumerate(angles):
        if number == 0:
            lines = joined([passes, inner_lines(inner, width_m, angle_deg)])
            bare.append(_Bare(angle_deg=angle_deg, lines=lines))
        straights = [open_lines(ground, width_m, angle_deg, packed=settings.closing_share < 1.0)]
        if boom.closes:
            straights.append(lines_over(ground, boom, angle_deg))
        if number == 0 and has_edges_along(ground, width_m, angle_deg):
            straights.append(fitted_lines(ground, width_m, angle_deg, motion))
        bare += [
            _Bare(angle_deg=angle_deg, lines=straight, covered=boom.united(straight))
            for straight in straights
            if len(straight)
        ]
    is_screened = len(passes) > LINES_MAX
    if is_screened:
        bare = _likely(bare, passes, field, settings, motion)
    layouts = [_with_passes(each, passes, ground, boom, left_share) for each in bare]
    if is_screened:
        costs = [_layout_s(each.lines, field, settings, motion) for each in layouts]
        layouts = [layouts[costs.index(min(costs))]]
    for each in layouts:
        covered = boom.united(each.lines) if each.covered is None else each.covered
        more = patches(each.lines, ground, width_m, left_share=left_share, covered=covered)
        drawn.append((each.angle_deg, joined([each.lines, more])))
    return drawn


@dataclass(frozen=True, slots=True, kw_only=True)
class _Bare:
    """Lines of a layout without those that what they leave needs.

    `covered` is their ground; None where all passes along the border are among them.
    """

    angle_deg: float
    lines: Floats
    covered: BaseGeometry | None = None


def _with_passes(
    layout: _Bare, passes: Floats, ground: BaseGeometry, boom: Boom, left_share: float
) -> _Bare:
    """Return a layout with the passes along the border that it needs, and its ground."""
    if layout.covered is None:
        return layout
    more = needed_passes(
        layout.lines, passes, ground, boom.width_m, left_share=left_share, covered=layout.covered
    )
    covered = whole(np.array([layout.covered, *boom.strips(more)]))
    return replace(layout, lines=joined([more, layout.lines]), covered=covered)


def _likely(
    layouts: list[_Bare], passes: Floats, field: Field, settings: Settings, motion: Motion
) -> list[_Bare]:
    """Return the layouts with all passes, and of the others the one that will cost least.

    Where passes are so many that layouts are compared by their lines alone, looking for those
    needed takes longer than all else. It is done once, for the layout that is the best one with
    every pass over ground that it leaves.
    """
    width_m = settings.swath_width_m
    target = reachable(field.spray, width_m)
    whole_ones = [each for each in layouts if each.covered is None]
    others = [each for each in layouts if each.covered is not None]
    if len(others) < 2:
        return layouts
    costs = []
    for each in others:
        assert each.covered is not None
        likely = likely_passes(passes, target.difference(each.covered), width_m)
        costs.append(_layout_s(joined([likely, each.lines]), field, settings, motion))
    return [*whole_ones, others[costs.index(min(costs))]]


def _layout_s(lines: Floats, field: Field, settings: Settings, motion: Motion) -> float:
    """Return what the lines of a layout cost."""
    width_m, area_m2 = settings.swath_width_m, field.spray.area
    return cost_s(lines, motion, width_m, area_m2, weight=LAYOUT_WEIGHT)


# Which way the passes run: along an edge, or what a coarse and then a fine search find.
#
# What an angle costs is time: of the passes, of a turn at each, and of product sprayed twice.

COARSE_DEG = 15.0
EDGES_MAX = 8
SMALL_SWATHS = 5.0
# Angles closer than this are the same edge, drawn twice.
SAME_DEG = 0.05
# Around the best, in two rounds: a tenth of a degree is a strip more or less on a long field.
FINE_DEG = (-1.0, -0.7, -0.5, -0.3, -0.2, -0.1, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0)
FINEST_DEG = (-0.06, -0.03, 0.03, 0.06)
# Ground sprayed twice also costs product: of a course a second of flight for a second of product,
# of the layouts drawn in full, which turn seldom where they overlap, half of one.
OVERLAP_WEIGHT, LAYOUT_WEIGHT = 1.0, 0.5


def edge_angles(ground: BaseGeometry) -> list[float]:
    """Return the courses of the longest edges of the ground and of its hull, 0 to 180."""
    found: dict[float, float] = {}
    for shape in (ground, ground.convex_hull):
        for part in shapely.get_parts(shape):
            points = shapely.get_coordinates(part.exterior)
            step = np.diff(points, axis=0)
            course = np.degrees(np.arctan2(step[:, 0], step[:, 1])) % 180.0
            for angle, length_m in zip(course.tolist(), np.hypot(*step.T).tolist(), strict=True):
                near = next((a for a in found if abs(a - angle) < SAME_DEG), angle)
                found[near] = found.get(near, 0.0) + length_m
    longest = sorted(found, key=lambda angle: -found[angle])
    return longest[:EDGES_MAX]


def main_course_deg(lines: Floats) -> float:
    """Return the course, 0 to 180, that most metres of lines are flown along, to a degree."""
    step = lines[:, 2:] - lines[:, :2]
    course = np.degrees(np.arctan2(step[:, 0], step[:, 1])) % 180.0
    off = np.abs((course[:, None] - course[None, :] + 90.0) % 180.0 - 90.0)
    return float(course[int(np.argmax((off < 1.0) @ lengths_m(lines)))])


def _without_small_holes(ground: BaseGeometry, width_m: float) -> BaseGeometry:
    """Return the ground with holes of a few swaths filled: no course is better for a tree."""
    least_m2 = (SMALL_SWATHS * width_m) ** 2
    filled: BaseGeometry = shapely.union_all(
        [
            Polygon(
                part.exterior,
                [ring for ring in part.interiors if Polygon(ring).area > least_m2],
            )
            for part in polygons_of(ground)
        ]
    )
    return filled


def cost_s(
    lines: Floats,
    motion: Motion,
    width_m: float,
    inner_m2: float,
    *,
    weight: float = OVERLAP_WEIGHT,
) -> float:
    """Return the time of these passes with a turn after each, plus that of what is doubled."""
    length_m = lengths_m(lines)
    flown_s = float(motion.legs_s(length_m).sum()) + len(lines) * motion.between_passes_s(width_m)
    doubled_m2 = max(float(length_m.sum()) * width_m - inner_m2, 0.0)
    return flown_s + weight * doubled_m2 / (width_m * motion.speed_m_s)


def ranked(
    inner: BaseGeometry, ground: BaseGeometry, *, width_m: float, motion: Motion
) -> list[tuple[float, float]]:
    """Return (cost in seconds, angle) of all angles that were tried, the best first."""
    inner = _without_small_holes(inner, width_m)
    if inner.is_empty:
        return [(0.0, angle) for angle in edge_angles(ground)[:1]]
    tried: dict[float, float] = {}

    def attempt(angles: Iterator[float]) -> None:
        for angle in angles:
            key = round(angle % 180.0, 4)
            if key not in tried:
                lines = inner_lines(inner, width_m, key)
                tried[key] = cost_s(lines, motion, width_m, inner.area)

    attempt(iter(np.arange(0.0, 180.0, COARSE_DEG).tolist()))
    attempt(iter(edge_angles(ground)))
    for changes in (FINE_DEG, FINEST_DEG):
        best = min(tried, key=lambda angle: (tried[angle], angle))
        attempt(best + change for change in changes)
    return sorted((cost, angle) for angle, cost in tried.items())
