"""Spraying on planned lines only: on which one the vehicle flies, and from where to where.

A line is a polyline on which the whole boom may be open: its strip has square ends. Where a
vehicle is off all of them, or on its way across, nothing is sprayed. It takes no item of the
mission. While the autopilot flies its mission, the leg of it that is flown has to lie along the
line too, as a ferry nearly along one is none; while no leg is known, nothing is sprayed. Each
check is written so that NaN closes.
"""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from companion.core.boom import Boom, Intervals, Paths, velocity_at
from companion.core.frame import Floats, Place
from companion.core.inputs import MISSION_MODES
from companion.core.types import MissionLeg, VehicleState

Polyline = tuple[Place, ...]

# Lines are looked up in squares of this size: a few swaths and the way of a second or two.
CELL_M = 25.0
STEP_M = CELL_M / 2.0
# Whoever flies on a line stays on it for so long, or to its end. A ferry that crosses one at 10
# degrees and 6 m/s drifts aside by 1 m/s: it is not, but for a moment. Gusts make some 0.3 m/s.
STAYS_S = 1.5
# Who turns off a line has left it when the last flow ends. The course is foretold for so long at
# most, and may turn farther by a jerk as an autopilot's (ArduCopter's default; its simulated
# vehicle had 5 to 9), which the filters see so much later.
COURSE_AHEAD_S, JERK_M_S3, JERK_SEEN_S = 0.25, 5.0, 0.12
# Of that only a share below this speed: else a sway of 0.06 m/s has valves of 0.25 s closed at up
# to 1.2 m/s, and who is slow sprays on for a few centimetres only.
SWERVES_M_S = 2.0
# What closed at the tolerance opens again a tenth inside, so that noise does not make it chatter.
ENTRY_SHARE = 0.9
# Lines that begin where another ends lie within this of it, seen across.
BESIDE_M = 0.3
# Shorter pieces have no direction.
PIECE_MIN_M = 1e-3
MOVING_M_S = 0.3
# As fast as any configuration allows; beyond, the way ahead would be looked up for ever.
SPEED_MAX_M_S = 100.0
# Places of a mission are exact to some centimetres; two that are nearer than 0.6 m may be one.
WAY_ASIDE_M = 0.5
# ArduPilot says twice a second which leg is flown, PX4 at a change and every ten seconds: two in a
# row may be lost on the way. If it was a change that was lost, a leg that is over lies along its
# own line only, and a ferry that is over closes.
WAY_AGE_MAX_S = 31.0
# So long after it was last told a leg that was left for the next one may still be on its last
# metres: they brake.
WAY_ENDS_S = WAY_AGE_MAX_S + 2.0
# A leg over a line begins and ends so near to its ends: the longest run-in (12 m/s, 2.5 m/s2).
WAY_BEYOND_M = 30.0


class Piece(NamedTuple):
    """A straight piece of a line: where it begins, its direction, its length.

    `before_m` and `after_m` are how far the line goes on, by gentle bends, beyond its two ends.
    """

    line: int
    east_m: float
    north_m: float
    unit_east: float
    unit_north: float
    length_m: float
    before_m: float
    after_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Lines:
    """All planned lines in the flight's frame, and how near to one a vehicle flies on it."""

    polylines: tuple[Polyline, ...]
    aside_m: float = 1.0
    course_deg: float = 20.0
    pieces: tuple[Piece, ...] = field(init=False, repr=False, compare=False)
    cells: dict[tuple[int, int], tuple[Piece, ...]] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not 0.0 < self.aside_m <= 100.0:
            raise ValueError(f"aside_m must lie in (0, 100] m, got {self.aside_m}")
        if not 0.0 < self.course_deg <= 90.0:
            raise ValueError(f"course_deg must lie in (0, 90], got {self.course_deg}")
        if not all(math.isfinite(x) for line in self.polylines for place in line for x in place):
            raise ValueError("a line with a place that is not a number")
        pieces = _pieces(self.polylines, math.cos(math.radians(self.course_deg)))
        if not pieces:
            raise ValueError("no line of any length")
        object.__setattr__(self, "pieces", pieces)
        object.__setattr__(self, "cells", _cells(pieces, self.aside_m))

    def flown(
        self,
        state: VehicleState,
        *,
        back_s: float,
        ahead_s: float,
        reach_m: float,
        ends_s: float = 0.0,
        entering: bool = False,
    ) -> tuple[Piece, ...]:
        """Return the pieces of lines that `state` flies on from `back_s` ago to `ahead_s` on.

        One piece a line, the nearest; of several lines those in a row with the nearest. `reach_m`
        is how far any nozzle is from the position reference. `entering` has a margin. A line that
        is left within `ends_s` is none: until then flows what is ordered closed now.
        """
        ve, vn = state.velocity_east_m_s, state.velocity_north_m_s
        soon_s = min(ends_s, COURSE_AHEAD_S)
        then_e, then_n = velocity_at(state, soon_s)
        speed = math.hypot(ve, vn)
        swerves = JERK_M_S3 * soon_s * (0.5 * soon_s + JERK_SEEN_S)
        swerves *= min(speed / SWERVES_M_S, 1.0)
        if not MOVING_M_S < speed <= SPEED_MAX_M_S:
            return ()
        aside = self.aside_m * (ENTRY_SHARE if entering else 1.0)
        course = math.cos(math.radians(self.course_deg))
        least, bend = speed * course, math.tan(math.radians(self.course_deg))
        ways = _ways(state)
        behind, beyond = speed * back_s + reach_m, speed * ahead_s + reach_m
        nearest: dict[int, tuple[float, float, Piece]] = {}
        for piece in self._around(state, behind, beyond):
            x, y = state.east_m - piece.east_m, state.north_m - piece.north_m
            ux, uy, length = piece.unit_east, piece.unit_north, piece.length_m
            across = ux * y - uy * x
            pace = ux * ve + uy * vn
            if not (abs(across) <= aside and abs(pace) >= least):
                continue
            then = math.copysign(1.0, pace) * (ux * then_e + uy * then_n)
            if not abs(ux * then_n - uy * then_e) + swerves <= bend * then:
                continue
            along = ux * x + uy * y
            is_forth = pace > 0.0
            low, high = (behind, beyond) if is_forth else (beyond, behind)
            if not -high <= along <= length + low:
                continue
            left = length - along if is_forth else along
            later = across + (ux * vn - uy * ve) * min(STAYS_S, max(left, 0.0) / abs(pace))
            if not (abs(later) <= aside and _is_told(piece, ways, course)):
                continue
            gap = math.hypot(max(-along, along - length, 0.0), across)
            if piece.line not in nearest or gap < nearest[piece.line][0]:
                nearest[piece.line] = (gap, abs(across), piece)
        if not nearest:
            return ()
        limit = min(nearest.values())[1] + BESIDE_M
        return tuple(piece for _, across, piece in nearest.values() if across <= limit)

    def _around(self, state: VehicleState, behind_m: float, beyond_m: float) -> set[Piece]:
        """Return the pieces in the squares that the way comes into, or nearly."""
        speed = math.hypot(state.velocity_east_m_s, state.velocity_north_m_s)
        ue, un = state.velocity_east_m_s / speed, state.velocity_north_m_s / speed
        found: set[Piece] = set()
        if not (math.isfinite(state.east_m) and math.isfinite(state.north_m)):
            return found
        count = math.ceil((behind_m + beyond_m) / STEP_M)
        for number in range(count + 1):
            way_m = (behind_m + beyond_m) * number / count - behind_m
            east_m, north_m = state.east_m + ue * way_m, state.north_m + un * way_m
            cell = (math.floor(east_m / CELL_M), math.floor(north_m / CELL_M))
            found.update(self.cells.get(cell, ()))
        return found


def _ways(state: VehicleState) -> tuple[MissionLeg, ...] | None:
    """Return the leg that is flown, and the one before while the vehicle still flies its way.

    Autopilots go on to the next item some metres before the end of a leg: a leg that the vehicle
    flies against is not flown yet, and a ferry that ends at the far end of a line is none. None
    of the legs where it is not known which; None where it is not the mission that is flown.
    """
    way, before = state.mission_leg, state.mission_leg_before
    if state.mode not in MISSION_MODES:
        return None
    if way is None or not 0.0 <= state.time_s - way.received_s <= WAY_AGE_MAX_S:
        return ()
    known = [way]
    if before is not None and 0.0 <= state.time_s - before.received_s <= WAY_ENDS_S:
        known.append(before)
    return tuple(each for each in known if _is_onwards(state, each))


def _is_onwards(state: VehicleState, way: MissionLeg) -> bool:
    east, north = way.to_east_m - way.from_east_m, way.to_north_m - way.from_north_m
    return state.velocity_east_m_s * east + state.velocity_north_m_s * north > 0.0


def _is_told(piece: Piece, ways: tuple[MissionLeg, ...] | None, course: float) -> bool:
    """Return whether a leg that is flown lies along a piece; off the mission any piece will do."""
    return ways is None or any(_sprays(piece, way, course) for way in ways)


def _sprays(piece: Piece, way: MissionLeg, course: float) -> bool:
    """Return whether a leg is one that sprays a piece.

    A way to the next line may lie on one that a longer leg flies whole, before or afterwards: that
    leg sprays it, or its ground would be sprayed twice.
    """
    is_other = way.longer is not None and _is_along(piece, way.longer, course)
    return _is_along(piece, way, course) and not is_other


def _is_along(piece: Piece, way: MissionLeg, course: float) -> bool:
    """Return whether a leg has the direction of a piece, and lies on it as far as it is beside it.

    One that ends where the piece begins is along it too: a run-in, or the way over bare ground
    from the line before. One that leads over the line and far beyond is a ferry.
    """
    ux, uy = piece.unit_east, piece.unit_north
    x0, y0 = way.from_east_m - piece.east_m, way.from_north_m - piece.north_m
    x1, y1 = way.to_east_m - piece.east_m, way.to_north_m - piece.north_m
    begin, end = ux * x0 + uy * y0, ux * x1 + uy * y1
    across, later = ux * y0 - uy * x0, ux * y1 - uy * x1
    length = math.hypot(x1 - x0, y1 - y0)
    if not (length > PIECE_MIN_M and abs(end - begin) >= course * length):
        return False
    slope = (later - across) / (end - begin)
    low, high = min(begin, end), max(begin, end)
    first, last = -piece.before_m, piece.length_m + piece.after_m
    is_near = first - WAY_BEYOND_M <= low and high <= last + WAY_BEYOND_M
    if not (is_near or min(high, last) - max(low, first) <= WAY_ASIDE_M):
        return False
    first, last = (min(max(at, low), high) for at in (0.0, piece.length_m))
    return all(abs(across + slope * (at - begin)) <= WAY_ASIDE_M for at in (first, last))


def add_off_lines(
    paths: Paths, closed: list[Intervals], *, flown: tuple[Piece, ...], boom: Boom, strict: bool
) -> None:
    """Add to `closed` when a valve is beyond the ends of all lines that are flown.

    With `strict` its whole strip has to be within, however the boom lies; else its middle.
    """
    if not flown:
        for intervals in closed:
            intervals.append((paths.time_s[0], math.inf))
        return
    spans: list[list[tuple[float, float]]] = [[] for _ in closed]
    for piece in flown:
        along = (paths.east_m - piece.east_m) * piece.unit_east
        along += (paths.north_m - piece.north_m) * piece.unit_north
        low_m, high_m = -piece.before_m, piece.length_m + piece.after_m
        margin_m = np.zeros(len(closed))
        if strict:
            skew = max(abs(rx * piece.unit_east + ry * piece.unit_north) for rx, ry in paths.right)
            margin_m = boom.half_width_m * skew
        most_m = float(margin_m.max())
        if along.min() >= low_m + most_m and along.max() <= high_m - most_m:
            return  # in the middle of a line
        for valve, margin in enumerate(margin_m.tolist()):
            spans[valve] += _within(paths, valve, along[valve], low_m + margin, high_m - margin)
    for intervals, inside in zip(closed, spans, strict=True):
        intervals += _without(inside, paths.time_s[0], paths.time_s[-1])


def _within(
    paths: Paths, valve: int, along_m: Floats, low_m: float, high_m: float
) -> list[tuple[float, float]]:
    """Return from when until when each chord of a path is between two places along a line."""
    found = []
    for chord, (begin, end) in enumerate(pairwise(along_m.tolist())):
        way = end - begin
        if way == 0.0:
            first, last = (0.0, 1.0) if low_m <= begin <= high_m else (1.0, 0.0)
        else:
            first, last = sorted(((low_m - begin) / way, (high_m - begin) / way))
        first, last = max(first, 0.0), min(last, 1.0)
        if not first < last or not low_m < high_m:
            continue
        # A chord's own ends are its times, to the last bit: the next one goes on there.
        flown = paths.chord_of(valve, chord)
        since_s, until_s = flown.times_s
        if first > 0.0:
            since_s = flown.at(first)[0]
        if last < 1.0:
            until_s = flown.at(last)[0]
        found.append((since_s, until_s))
    return found


def _without(inside: list[tuple[float, float]], start_s: float, end_s: float) -> Intervals:
    """Return the times that are in none of the spans; beyond the path nothing is known.

    >>> _without([(1.0, 2.0), (2.0, 3.0)], 0.0, 4.0)
    [(0.0, 1.0), (3.0, inf)]
    """
    found: Intervals = []
    at_s = start_s
    for since_s, until_s in sorted(inside):
        if since_s > at_s:
            found.append((at_s, since_s))
        at_s = max(at_s, until_s)
    if at_s < end_s:
        found.append((at_s, math.inf))
    return found


def _pieces(polylines: tuple[Polyline, ...], gentle: float) -> tuple[Piece, ...]:
    """Return the pieces of all lines; a bend that is not `gentle` (its cosine) ends a line."""
    found: list[Piece] = []
    count = 0
    for polyline in polylines:
        run: list[Piece] = []
        for (x0, y0), (x1, y1) in pairwise(_apart(polyline)):
            length = math.hypot(x1 - x0, y1 - y0)
            ux, uy = (x1 - x0) / length, (y1 - y0) / length
            if run and not run[-1].unit_east * ux + run[-1].unit_north * uy >= gentle:
                found += _joined(run)
                run, count = [], count + 1
            run.append(Piece(count, x0, y0, ux, uy, length, 0.0, 0.0))
        found += _joined(run)
        count += 1
    return tuple(found)


def _apart(polyline: Polyline) -> list[Place]:
    kept: list[Place] = []
    for place in polyline:
        if not kept or math.dist(kept[-1], place) > PIECE_MIN_M:
            kept.append(place)
    return kept


def _joined(run: list[Piece]) -> list[Piece]:
    """Return the pieces of one line, each with how far the line goes on beyond it."""
    whole_m = sum(piece.length_m for piece in run)
    before_m = 0.0
    found = []
    for piece in run:
        after_m = max(whole_m - before_m - piece.length_m, 0.0) if piece is not run[-1] else 0.0
        found.append(piece._replace(before_m=before_m, after_m=after_m))
        before_m += piece.length_m
    return found


def _cells(pieces: tuple[Piece, ...], aside_m: float) -> dict[tuple[int, int], tuple[Piece, ...]]:
    """Return for each square the pieces that come into it, or nearly."""
    # Half a step from a place of the piece to its middle one, and half a step on the way.
    near_m = STEP_M + aside_m
    found: dict[tuple[int, int], list[Piece]] = defaultdict(list)
    for piece in pieces:
        count = math.ceil(piece.length_m / STEP_M)
        touched: set[tuple[int, int]] = set()
        for number in range(count):
            along_m = piece.length_m * (number + 0.5) / count
            east_m = piece.east_m + piece.unit_east * along_m
            north_m = piece.north_m + piece.unit_north * along_m
            first_e, last_e = (math.floor((east_m + d) / CELL_M) for d in (-near_m, near_m))
            first_n, last_n = (math.floor((north_m + d) / CELL_M) for d in (-near_m, near_m))
            for column in range(first_e, last_e + 1):
                touched.update((column, row) for row in range(first_n, last_n + 1))
        for cell in touched:
            found[cell].append(piece)
    return {cell: tuple(each) for cell, each in found.items()}
