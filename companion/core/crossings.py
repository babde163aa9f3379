"""Where and when each valve's footprint crosses the next boundary: exactly, on the geometry.

The predicted path of every footprint is a short chain of chords (one, on a straight pass). Edges
near the swept box come from one tree query; one vectorised side test finds those that a chord
cuts. A side is half-open, so that a path through a vertex crosses once. Edges have their polygon
on the left, so that each cut says which zone is entered or left, and nothing is sampled.

At the border the whole strip counts, not its centre: it is closed while any part of it is
outside (`boom.py`).
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Sequence, Set
from functools import partial
from typing import Literal, NamedTuple

import numpy as np

from companion.core.boom import (
    STRAIGHT_YAW_RATE_DEG_S,
    Boom,
    Chord,
    Intervals,
    Pass,
    Paths,
    add_contacts,
    add_contacts_of_pass,
    box_of,
    joined,
    place_velocity,
    predict,
    straight_pass,
    swept,
    turning_of,
)
from companion.core.frame import Floats, Ints, Offset, PlainEdge
from companion.core.prescription import FIELD, SLIVER_M, Prescription
from companion.core.types import VehicleState

Across = Literal["centre", "mean", "max"]
Border = Literal["inside", "volume"]

# A strip over several zones is judged at points no farther apart than this, its ends included.
SAMPLE_ACROSS_M = 0.1
SAMPLES_ACROSS = (5, 40)
START_NUDGE_M = 1e-6
# The ways of points that go alike differ by rounding: by less than this, as an area.
SAME_SIDE_M2 = 1e-6


class Crossing(NamedTuple):
    """From `at_s` on the footprint is prescribed `rate_l_ha`; None is closed.

    `outside` says that nothing may fall from here on: part of the strip is beyond the border. Its
    rate is None then; ground that is closed for another reason may lie on either side of it.
    `speed_m_s` is the footprint's own speed there.
    """

    at_s: float
    rate_l_ha: float | None
    outside: bool
    speed_m_s: float

    def is_as(self, other: Crossing) -> bool:
        """Return whether the same holds as from another crossing on."""
        if self.rate_l_ha != other.rate_l_ha:
            return False
        return self.rate_l_ha is not None or self.outside == other.outside


# A valve's future: the first entry holds at the start of the path, the others are crossings.
Route = tuple[Crossing, ...]


def rate_at(route: Sequence[Crossing], now_s: float) -> float | None:
    """Return what a route prescribes at a time."""
    rate = route[0].rate_l_ha
    for crossing in route:
        if crossing.at_s <= now_s:
            rate = crossing.rate_l_ha
    return rate


# A path cuts an edge: its way until there (rounded to um), whether the edge's polygon is entered,
# the way, whose polygon that is, on which chord, and at which share of it. As they are sorted,
# leaving comes before entering, where both are at one place.
_Cut = tuple[int, bool, float, int, int, float]
# How a chord is flown, of a point's number and the chord's.
_ChordOf = Callable[[int, int], Chord]


# Where a path meets an edge: chord, rounded way along it, whether its polygon is entered, point,
# way, the chord's length, and the polygon. In order of the path; leaving before entering, where
# both are at one place.
_Met = tuple[int, int, bool, int, float, float, int]


def _cuts(paths: Paths, ends: Floats, owner: Ints) -> list[list[_Cut]]:
    """Return, for each point, where its path cuts the edges, in order of time."""
    count = len(paths.length_m)
    found: list[list[_Cut]] = [[] for _ in range(count)]
    if not len(ends):
        return found
    met = _met(paths, ends, owner)
    if not met:
        return found
    met.sort()
    along = np.cumsum(paths.length_m, axis=1).tolist()
    for chord, place, enters, point, s, reach_m, who in met:
        gone = along[point][chord - 1] if chord else 0.0
        found[point].append((place, enters, gone + s, who, chord, s / reach_m))
    return found


def _cuts_of_pass(way: Pass, edges: list[PlainEdge]) -> list[list[_Cut]]:
    """Return, for each point of a straight pass, where its path cuts the edges, in order of time.

    Only points between the ends of an edge, seen along the way, can meet it.
    """
    points = way.points
    _, _, way_e, way_n, _, _ = points[0]
    in_order = sorted([(way_e * p[1] - way_n * p[0], i) for i, p in enumerate(points)])
    sides = [side for side, _ in in_order]
    least, most = sides[0] - SAME_SIDE_M2, sides[-1] + SAME_SIDE_M2
    met: list[list[_Cut]] = [[] for _ in points]
    for x0, y0, x1, y1, who in edges:
        low, high = way_e * y0 - way_n * x0, way_e * y1 - way_n * x1
        if low > high:
            low, high = high, low
        if low > most or high < least:
            continue
        first = bisect_left(sides, low - SAME_SIDE_M2)
        for _, point in in_order[first : bisect_left(sides, high + SAME_SIDE_M2, first)]:
            px, py, dx, dy, reach_m, own = points[point]
            a, b = dx * y0 - dy * x0, dx * y1 - dy * x1
            if (a >= own) == (b >= own):
                continue
            share = (a - own) / (a - b)
            s = (x0 + share * (x1 - x0) - px) * dx
            s += (y0 + share * (y1 - y0) - py) * dy
            s /= max(reach_m, 1e-12)
            if START_NUDGE_M < s <= reach_m:
                met[point].append((round(s * 1e6), a > b, s, who, 0, s / reach_m))
    for each in met:
        if len(each) > 1:
            each.sort()
    return met


def _met(paths: Paths, ends: Floats, owner: Ints) -> list[_Met]:
    """Return what is met on chords of any directions: row = chord * points + point."""
    count = len(paths.length_m)
    px, py = paths.east_m[:, :-1].T.ravel(), paths.north_m[:, :-1].T.ravel()
    dx, dy = paths.step_east_m.T.ravel(), paths.step_north_m.T.ravel()
    corners = ends.reshape(-1, 2)
    left = dx[:, None] * corners[:, 1] - dy[:, None] * corners[:, 0]
    own = dx * py - dy * px
    is_left = left >= own[:, None]
    rows, hits = (is_left[:, 0::2] != is_left[:, 1::2]).nonzero()
    if not len(rows):
        return []
    l0, l1 = left[rows, 2 * hits].tolist(), left[rows, 2 * hits + 1].tolist()
    own_, reach_ = own.tolist(), paths.length_m.T.ravel().tolist()
    px_, py_, dx_, dy_ = px.tolist(), py.tolist(), dx.tolist(), dy.tolist()
    met: list[_Met] = []
    for row, a, b, (x0, y0, x1, y1), who in zip(
        rows.tolist(), l0, l1, ends[hits].tolist(), owner[hits].tolist(), strict=True
    ):
        share = (a - own_[row]) / (a - b)
        reach_m = reach_[row]
        s = (x0 + share * (x1 - x0) - px_[row]) * dx_[row]
        s += (y0 + share * (y1 - y0) - py_[row]) * dy_[row]
        s /= max(reach_m, 1e-12)
        if (START_NUDGE_M if row < count else 0.0) < s <= reach_m:
            chord, point = divmod(row, count)
            met.append((chord, round(s * 1e6), a > b, point, s, reach_m, who))
    return met


def find_routes(
    prescription: Prescription,
    state: VehicleState,
    boom: Boom,
    *,
    back_s: float,
    ahead_s: float,
    border: Border,
    border_buffer_m: float,
    across: Across,
    drift_m: Offset | None = None,
    close_more: Callable[[Paths, list[Intervals]], None] | None = None,
    leads_s: tuple[float, ...] = (),
) -> tuple[Route, ...]:
    """Return what each valve is prescribed along its predicted path, left to right.

    `state` is where the liquid lands, `drift_m` how far that is from the nozzles (`drift.py`).
    `close_more` adds when valves are closed for a reason that is not in the map (`lines.py`).
    """
    reach_m = boom.reach_m + border_buffer_m + SLIVER_M
    if drift_m is not None:
        reach_m += math.hypot(*drift_m)
    way = None
    if across == "centre" and close_more is None and drift_m is None:
        way = straight_pass(state, boom, back_s=back_s, ahead_s=ahead_s)
    if way is not None:
        return _routes_of_pass(prescription, way, boom, reach_m, border, border_buffer_m)
    paths = predict(
        state, boom.right_m, boom.forward_m, back_s=back_s, ahead_s=ahead_s, leads_s=leads_s
    )
    ends, owner = prescription.edges_near(*box_of(paths.middle, reach_m))
    bases = prescription.owners_at(*_starts(paths))
    cuts, chord_of = _cuts(paths, ends, owner), paths.chord_of
    if across == "centre":
        rates = _rates(prescription, chord_of, bases, cuts)
    else:
        rates = _rates_across(
            prescription, boom, (ends, owner), across,
            partial(predict, state, back_s=back_s, ahead_s=ahead_s, leads_s=leads_s),
        )  # fmt: skip
    closed = _centres_outside(chord_of, bases, cuts)
    if border == "inside":
        edges = ends[owner == FIELD]
        if drift_m is not None:
            edges = swept(edges, drift_m)
        merge = None if drift_m is None else joined
        add_contacts(paths, edges, boom, border_buffer_m, closed, merge)
    if close_more is not None:
        close_more(paths, closed)
    each = enumerate(zip(rates, closed, strict=True))
    return tuple([_combine(*one, partial(paths.speed_at, point), border) for point, one in each])


def _routes_of_pass(
    prescription: Prescription,
    way: Pass,
    boom: Boom,
    reach_m: float,
    border: Border,
    border_buffer_m: float,
) -> tuple[Route, ...]:
    """Return the routes along a straight pass: the same as of any path, in plain numbers."""
    box = box_of(way.middle, reach_m)
    near = prescription.near(box)
    edges = near.edges_in(box)
    bases = prescription.owners_near(near, *_starts_of_pass(way))
    cuts = _cuts_of_pass(way, edges)

    def chord_of(_point: int, _chord: int) -> Chord:
        return way.chord

    rates = _rates_of_pass(prescription, way, chord_of, bases, cuts)
    closed = _centres_outside(chord_of, bases, cuts)
    if border == "inside":
        edges = [edge for edge in edges if edge[4] == FIELD]
        add_contacts_of_pass(way, edges, boom, border_buffer_m, closed)
    each = zip(rates, closed, strict=True)
    return tuple(
        [
            _combine(steps, shut, way.chord.speed_at, border) if shut else tuple(steps)
            for steps, shut in each
        ]
    )


# A timeline: as a route without any closed ground, the first entry at the start of the path.
_Steps = list[Crossing]


def _rates(
    prescription: Prescription,
    chord_of: _ChordOf,
    bases: Sequence[Set[int]],
    found: list[list[_Cut]],
) -> list[_Steps]:
    """Return the rate along each point's path."""
    timelines = []
    for point, (base, cuts) in enumerate(zip(bases, found, strict=True)):
        zones = _NO_FIELD.union(base) - _ONLY_FIELD
        first = chord_of(point, 0)
        rate = prescription.rate_of(zones)
        begun = [Crossing(first.times_s[0], rate, False, first.speeds_m_s[0])]
        steps = _walked(prescription, chord_of, point, zones, begun, cuts) if cuts else begun
        timelines.append(steps)
    return timelines


_NO_FIELD, _ONLY_FIELD = frozenset[int](), frozenset({FIELD})


def _rates_of_pass(
    prescription: Prescription,
    way: Pass,
    chord_of: _ChordOf,
    bases: Sequence[frozenset[int]],
    found: list[list[_Cut]],
) -> list[_Steps]:
    """Return the rate along each point's path; points that begin in the same zones begin alike."""
    timelines, chord = [], way.chord
    alike: dict[frozenset[int], tuple[frozenset[int], _Steps]] = {}
    for point, (base, cuts) in enumerate(zip(bases, found, strict=True)):
        start = alike.get(base)
        if start is None:
            zones = base - _ONLY_FIELD
            rate = prescription.rate_of(zones)
            start = zones, [Crossing(chord.times_s[0], rate, False, chord.speeds_m_s[0])]
            alike[base] = start
        steps = _walked(prescription, chord_of, point, *start, cuts) if cuts else start[1]
        timelines.append(steps)
    return timelines


def _walked(
    prescription: Prescription,
    chord_of: _ChordOf,
    point: int,
    zones: frozenset[int],
    begun: _Steps,
    cuts: list[_Cut],
) -> _Steps:
    """Return the timeline of a point that begins in these zones and goes through the cuts."""
    inside, rate, steps = set(zones), begun[0].rate_l_ha, begun.copy()
    zone_cuts = [cut for cut in cuts if cut[3] != FIELD]
    for i, (_, enters, along_m, owner, chord, share) in enumerate(zone_cuts):
        if enters:
            inside.add(owner)
        else:
            inside.discard(owner)
        if i + 1 < len(zone_cuts) and zone_cuts[i + 1][2] - along_m < SLIVER_M:
            continue  # the next zone begins here: a gap this narrow is none
        new = prescription.rate_of(frozenset(inside))
        if new != rate:
            at_s, speed = chord_of(point, chord).at(share)
            steps.append(Crossing(at_s, new, False, speed))
            rate = new
    return steps


def _starts(paths: Paths) -> tuple[Floats, Floats]:
    """Return the starts of the paths, a hair ahead and to the right.

    Ahead, so that none lies on an edge it just cut; to the right, as the side test has an edge
    that is flown along on the left: on the edge itself a point is in neither of its zones.
    """
    dx, dy = paths.step_east_m[:, 0], paths.step_north_m[:, 0]
    ahead = START_NUDGE_M / np.maximum(paths.length_m[:, 0], START_NUDGE_M)
    aside = 0.1 * ahead
    return (
        paths.east_m[:, 0] + dx * ahead + dy * aside,
        paths.north_m[:, 0] + dy * ahead - dx * aside,
    )


def _starts_of_pass(way: Pass) -> tuple[list[float], list[float]]:
    """Return the starts of a straight pass, likewise: all go the same way."""
    _, _, dx, dy, length, _ = way.points[0]
    nudge = START_NUDGE_M / max(length, START_NUDGE_M)
    ahead_e, ahead_n = nudge * (dx + 0.1 * dy), nudge * (dy - 0.1 * dx)
    return [p[0] + ahead_e for p in way.points], [p[1] + ahead_n for p in way.points]


def _rates_across(
    prescription: Prescription,
    boom: Boom,
    edges: tuple[Floats, Ints],
    across: Across,
    paths_of: Callable[[Floats, Floats], Paths],
) -> list[_Steps]:
    """Return the mean or the maximum over each strip, from points across it."""
    shares, weights = _across(2.0 * float(boom.half_width_m.max()))
    count = len(shares)
    right = (boom.right_m[:, None] + boom.half_width_m[:, None] * shares).ravel()
    forward = np.repeat(boom.forward_m, count)
    paths = paths_of(right, forward)
    bases = prescription.owners_at(*_starts(paths))
    every = _rates(prescription, paths.chord_of, bases, _cuts(paths, *edges))
    timelines = []
    for valve in range(len(boom.valves)):
        parts = every[valve * count : (valve + 1) * count]
        events = sorted({(step.at_s, step.speed_m_s) for part in parts for step in part})
        steps: _Steps = []
        for i, (at_s, speed) in enumerate(events):
            next_s = events[i + 1][0] if steps and i + 1 < len(events) else math.inf
            if (next_s - at_s) * speed < SLIVER_M:
                continue  # the points of a strip reach one boundary at one time
            now = [rate_at(part, at_s) for part in parts]
            given = [
                (rate, weight)
                for rate, weight in zip(now, weights, strict=True)
                if rate is not None
            ]
            if not given:
                value = None
            elif across == "max":
                value = max(rate for rate, _ in given)
            else:
                value = sum(rate * weight for rate, weight in given)
            if not steps or steps[-1].rate_l_ha != value:
                steps.append(Crossing(at_s, value, False, speed))
        timelines.append(steps)
    return timelines


def _across(width_m: float) -> tuple[Floats, list[float]]:
    """Return places across a strip, -1 at its left end to 1 at its right, and their weights.

    The weights are those of the trapezoidal rule, so that a mean is over the width.
    """
    least, most = SAMPLES_ACROSS
    spans = min(max(math.ceil(width_m / SAMPLE_ACROSS_M), least), most)
    weights = np.full(spans + 1, 1.0 / spans)
    weights[[0, -1]] /= 2.0
    return np.linspace(-1.0, 1.0, spans + 1), weights.tolist()


def _centres_outside(
    chord_of: _ChordOf, bases: Sequence[Set[int]], found: list[list[_Cut]]
) -> list[Intervals]:
    """Return when the centre of each strip is outside the field."""
    closed = []
    for point, (base, cuts) in enumerate(zip(bases, found, strict=True)):
        intervals: Intervals = []
        closed.append(intervals)
        inside = FIELD in base
        if inside and not cuts:
            continue
        since_s = chord_of(point, 0).times_s[0]
        for _, enters, _, owner, chord, share in cuts:
            if owner != FIELD or enters is inside:
                continue
            at_s, _ = chord_of(point, chord).at(share)
            if enters:
                intervals.append((since_s, at_s))
            inside, since_s = enters, at_s
        if not inside:
            intervals.append((since_s, math.inf))
    return closed


def _combine(
    rates: _Steps, closed: Intervals, speed_at: Callable[[float], float], border: Border
) -> Route:
    """Return one timeline of rates, closed where the border rule says so.

    Which ground is outside is told by the intervals alone: where a zone ends at the border, the
    times of the two differ by rounding, and the one that comes first says nothing.
    """
    if not closed:
        return tuple(rates)
    strict = border == "inside"
    ends = {t for interval in closed for t in interval if t < math.inf}
    pace = {step.at_s: step.speed_m_s for step in rates}
    route: list[Crossing] = []
    for at_s in sorted(ends | set(pace)):
        shut = any(begin <= at_s < end for begin, end in closed)
        rate = None if shut else rate_at(rates, at_s)
        outside = strict and shut
        if not route or rate != route[-1].rate_l_ha or outside != route[-1].outside:
            speed = pace.get(at_s)
            if speed is None:
                speed = speed_at(at_s)
            route.append(Crossing(at_s, rate, outside, speed))
    return tuple(route)


# Routes found in one step serve the next ones too, as long as the prediction holds.

# Crossings found in one step are carried on for this long, if the path does not leave its
# prediction by more than these and none of them is to be ordered within this time.
ROUTES_KEPT_S = 0.21
ROUTES_ASIDE_M = 0.05
ROUTES_ALONG_M = 0.2
ROUTES_EXACT_S = 0.15


class KnownRoutes(NamedTuple):
    """The routes in view, the state that they were found from, and the wind's offset then."""

    routes: tuple[Route, ...] = ()
    found_from: VehicleState | None = None
    drift_m: Offset | None = None


NO_ROUTES = KnownRoutes()


def carried_on(
    known: KnownRoutes, state: VehicleState, *, longest_s: float, reach_m: float, now_s: float
) -> KnownRoutes | None:
    """Return the routes of before at the times that the new position gives; None if they are over.

    On a straight pass the same edges are crossed at every step: as long as the prediction holds
    and no crossing is due within `longest_s`, the longest lead, the last ones are carried on.
    """
    if known.found_from is None:
        return None
    exact_s = longest_s + ROUTES_EXACT_S
    shift = _shift(known.found_from, state, exact_s=exact_s, reach_m=reach_m, now_s=now_s)
    if shift is None:
        return None
    routes = _shifted(known.routes, shift, now_s, now_s + exact_s)
    return None if routes is None else KnownRoutes(routes, known.found_from, known.drift_m)


def _shift(
    before: VehicleState, state: VehicleState, *, exact_s: float, reach_m: float, now_s: float
) -> tuple[float, float, float] | None:
    """Return how far along, how fast then and how fast now; None where the prediction fails."""
    age_s = now_s - before.time_s
    turning = max(turning_of(before).fastest_deg_s, turning_of(state).fastest_deg_s)
    if not (0.0 <= age_s <= ROUTES_KEPT_S and turning < STRAIGHT_YAW_RATE_DEG_S):
        return None
    went_east, went_north = place_velocity(before)
    then_east = went_east + before.acceleration_east_m_s2 * age_s
    then_north = went_north + before.acceleration_north_m_s2 * age_s
    east, north = place_velocity(state)
    speed, then = math.hypot(east, north), math.hypot(then_east, then_north)
    if not (speed > 0.5 and then > 0.5):
        return None
    half = 0.5 * age_s * age_s
    off_east = state.east_m - before.east_m - went_east * age_s
    off_east -= before.acceleration_east_m_s2 * half
    off_north = state.north_m - before.north_m - went_north * age_s
    off_north -= before.acceleration_north_m_s2 * half
    aside = abs(off_north * east - off_east * north) / speed
    bend = abs(then_east * north - then_north * east) / (speed * then)
    turned_deg = ((state.heading_deg or 0.0) - (before.heading_deg or 0.0) + 180.0) % 360.0 - 180.0
    aside += bend * speed * exact_s
    aside += math.radians(abs(turned_deg)) * reach_m
    along = (off_east * east + off_north * north) / speed
    if not (aside <= ROUTES_ASIDE_M and abs(along) <= ROUTES_ALONG_M):
        return None
    return along, then, speed


def _shifted(
    routes: tuple[Route, ...], shift: tuple[float, float, float], now_s: float, soon_s: float
) -> tuple[Route, ...] | None:
    """Return the routes with their crossings at the times that the new position gives.

    None where one of them is due by `soon_s`.
    """
    along_m, then, speed = shift
    moved: list[Route] = []
    for route in routes:
        if len(route) == 1:
            moved.append(route)
            continue
        later = [route[0]]
        for was_s, rate, outside, pace in route[1:]:
            at_s = now_s + ((was_s - now_s) * then - along_m) / speed
            later.append(Crossing(at_s, rate, outside, pace))
        if not later[1].at_s > soon_s:
            return None
        moved.append(tuple(later))
    return tuple(moved)
