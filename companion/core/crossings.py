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
from collections.abc import Callable
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np

from companion.core.boom import (
    STRAIGHT_YAW_RATE_DEG_S,
    Boom,
    Intervals,
    Paths,
    add_contacts,
    joined,
    place_velocity,
    predict,
    swept,
    turning_of,
)
from companion.core.frame import Floats, Ints, Offset
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


class _Cut(NamedTuple):
    """A path cuts an edge: which polygon (`owner`), and whether it is entered."""

    at_s: float
    along_m: float
    speed_m_s: float
    owner: int
    enters: bool


# Where a path meets an edge: chord, rounded way along it, whether its polygon is entered, point,
# way, the chord's length, and the polygon. In order of the path; leaving before entering, where
# both are at one place.
_Met = tuple[int, int, bool, int, float, float, int]


def _cuts(paths: Paths, ends: Floats, owner: Ints) -> list[list[_Cut]]:
    """Return, for each point, where its path cuts the edges, in order of time."""
    count, chords = paths.length_m.shape
    found: list[list[_Cut]] = [[] for _ in range(count)]
    if not len(ends):
        return found
    met = _met_on_one_chord(paths, ends, owner) if chords == 1 else _met(paths, ends, owner)
    if not met:
        return found
    met.sort()
    pace = paths.speed_m_s.tolist()
    along = np.cumsum(paths.length_m, axis=1).tolist() if chords > 1 else []
    for chord, _, enters, point, s, reach_m, who in met:
        share = s / reach_m
        v0, v1 = pace[point][chord : chord + 2]
        v0_2 = v0 * v0
        speed = math.sqrt(v0_2 + (v1 * v1 - v0_2) * share)
        t0, t1 = paths.time_s[chord], paths.time_s[chord + 1]
        at_s = t0 + share * (v0 + v1) / max(v0 + speed, 1e-9) * (t1 - t0)
        gone = along[point][chord - 1] if chord else 0.0
        found[point].append(_Cut(at_s, gone + s, speed, who, enters))
    return found


def _met_on_one_chord(paths: Paths, ends: Floats, owner: Ints) -> list[_Met]:
    """Return what is met on a straight pass, where all points go the same way.

    There only points between the ends of an edge, seen along the way, can meet it. In plain
    numbers: few edges are near.
    """
    east, north = paths.east_m[:, 0].tolist(), paths.north_m[:, 0].tolist()
    steps_e, steps_n = paths.step_east_m[:, 0].tolist(), paths.step_north_m[:, 0].tolist()
    lengths = paths.length_m[:, 0].tolist()
    way_e, way_n = steps_e[0], steps_n[0]
    in_order = sorted(
        [(way_e * y - way_n * x, i) for i, (x, y) in enumerate(zip(east, north, strict=True))]
    )
    sides = [side for side, _ in in_order]
    met: list[_Met] = []
    for (x0, y0, x1, y1), who in zip(ends.tolist(), owner.tolist(), strict=True):
        low, high = sorted((way_e * y0 - way_n * x0, way_e * y1 - way_n * x1))
        first = bisect_left(sides, low - SAME_SIDE_M2)
        for _, point in in_order[first : bisect_left(sides, high + SAME_SIDE_M2, first)]:
            px, py, dx, dy = east[point], north[point], steps_e[point], steps_n[point]
            a, b, own = dx * y0 - dy * x0, dx * y1 - dy * x1, dx * py - dy * px
            if (a >= own) == (b >= own):
                continue
            share = (a - own) / (a - b)
            s = (x0 + share * (x1 - x0) - px) * dx
            s += (y0 + share * (y1 - y0) - py) * dy
            reach_m = lengths[point]
            s /= max(reach_m, 1e-12)
            if START_NUDGE_M < s <= reach_m:
                met.append((0, round(s * 1e6), a > b, point, s, reach_m, who))
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
) -> tuple[Route, ...]:
    """Return what each valve is prescribed along its predicted path, left to right.

    `state` is where the liquid lands, `drift_m` how far that is from the nozzles (`drift.py`).
    `close_more` adds when valves are closed for a reason that is not in the map (`lines.py`).
    """
    reach_m = boom.reach_m + border_buffer_m + SLIVER_M
    if drift_m is not None:
        reach_m += math.hypot(*drift_m)
    paths = predict(state, boom.right_m, boom.forward_m, back_s=back_s, ahead_s=ahead_s)
    ends, owner = prescription.edges_near(*paths.box(reach_m))
    bases = prescription.owners_at(*_starts(paths))
    cuts = _cuts(paths, ends, owner)
    if across == "centre":
        rates = _rates(prescription, paths, bases, cuts)
    else:
        rates = _rates_across(prescription, state, boom, (ends, owner), across, back_s, ahead_s)
    start_s = paths.time_s[0]
    closed = [
        _centre_outside(FIELD in base, found, start_s)
        for base, found in zip(bases, cuts, strict=True)
    ]
    if border == "inside":
        edges = ends[owner == FIELD]
        if drift_m is not None:
            edges = swept(edges, drift_m)
        merge = None if drift_m is None else joined
        add_contacts(paths, edges, boom, border_buffer_m, closed, merge)
    if close_more is not None:
        close_more(paths, closed)
    return tuple(
        [_combine(rates[valve], closed[valve], paths, valve, border) for valve in range(len(rates))]
    )


# A timeline: (at_s, rate, speed_m_s), the first entry at the start of the path.
_Steps = list[tuple[float, float | None, float]]


def _rates(
    prescription: Prescription, paths: Paths, bases: list[set[int]], found: list[list[_Cut]]
) -> list[_Steps]:
    """Return the rate along each point's path."""
    start_s = paths.time_s[0]
    paces = paths.speed_m_s[:, 0].tolist()
    timelines = []
    for base, cuts, pace in zip(bases, found, paces, strict=True):
        inside = base - {FIELD}
        rate = prescription.rate_of(frozenset(inside))
        steps: _Steps = [(start_s, rate, pace)]
        timelines.append(steps)
        zone_cuts = [cut for cut in cuts if cut.owner != FIELD] if cuts else cuts
        for i, cut in enumerate(zone_cuts):
            if cut.enters:
                inside.add(cut.owner)
            else:
                inside.discard(cut.owner)
            if i + 1 < len(zone_cuts) and zone_cuts[i + 1].along_m - cut.along_m < SLIVER_M:
                continue  # the next zone begins here: a gap this narrow is none
            new = prescription.rate_of(frozenset(inside))
            if new != rate:
                steps.append((cut.at_s, new, cut.speed_m_s))
                rate = new
    return timelines


def _starts(paths: Paths) -> tuple[Floats, Floats]:
    """Return the starts of the paths, a hair ahead and to the right.

    Ahead, so that none lies on an edge it just cut; to the right, as the side test has an edge
    that is flown along on the left: on the edge itself a point is in neither of its zones.
    """
    east, north = paths.east_m[:, 0], paths.north_m[:, 0]
    if len(paths.time_s) == 2:  # a straight pass: all go the same way
        east_m, north_m = paths.step_east_m.item(0, 0), paths.step_north_m.item(0, 0)
        nudge = START_NUDGE_M / max(paths.length_m.item(0, 0), START_NUDGE_M)
        return east + nudge * (east_m + 0.1 * north_m), north + nudge * (north_m - 0.1 * east_m)
    dx, dy = paths.step_east_m[:, 0], paths.step_north_m[:, 0]
    ahead = START_NUDGE_M / np.maximum(paths.length_m[:, 0], START_NUDGE_M)
    aside = 0.1 * ahead
    return east + dx * ahead + dy * aside, north + dy * ahead - dx * aside


def _rates_across(
    prescription: Prescription,
    state: VehicleState,
    boom: Boom,
    edges: tuple[Floats, Ints],
    across: Across,
    back_s: float,
    ahead_s: float,
) -> list[_Steps]:
    """Return the mean or the maximum over each strip, from points across it."""
    shares, weights = _across(2.0 * float(boom.half_width_m.max()))
    count = len(shares)
    right = (boom.right_m[:, None] + boom.half_width_m[:, None] * shares).ravel()
    forward = np.repeat(boom.forward_m, count)
    paths = predict(state, right, forward, back_s=back_s, ahead_s=ahead_s)
    every = _rates(
        prescription, paths, prescription.owners_at(*_starts(paths)), _cuts(paths, *edges)
    )
    timelines = []
    for valve in range(len(boom.valves)):
        parts = every[valve * count : (valve + 1) * count]
        events = sorted({(at_s, speed) for part in parts for at_s, _, speed in part})
        steps: _Steps = []
        for i, (at_s, speed) in enumerate(events):
            next_s = events[i + 1][0] if steps and i + 1 < len(events) else math.inf
            if (next_s - at_s) * speed < SLIVER_M:
                continue  # the points of a strip reach one boundary at one time
            now = [_value_at(part, at_s) for part in parts]
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
            if not steps or steps[-1][1] != value:
                steps.append((at_s, value, speed))
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


def _value_at(steps: _Steps, at_s: float) -> float | None:
    value = steps[0][1]
    for start_s, rate, _ in steps:
        if start_s > at_s:
            break
        value = rate
    return value


def _centre_outside(inside: bool, cuts: list[_Cut], start_s: float) -> Intervals:
    """Return when the strip's centre is outside the field."""
    intervals: Intervals = []
    since_s = start_s
    for cut in cuts:
        if cut.owner != FIELD:
            continue
        if inside and not cut.enters:
            inside, since_s = False, cut.at_s
        elif not inside and cut.enters:
            inside = True
            intervals.append((since_s, cut.at_s))
    if not inside:
        intervals.append((since_s, math.inf))
    return intervals


def _combine(
    rates: _Steps,
    closed: Intervals,
    paths: Paths,
    valve: int,
    border: Border,
) -> Route:
    """Return one timeline of rates, closed where the border rule says so.

    Which ground is outside is told by the intervals alone: where a zone ends at the border, the
    times of the two differ by rounding, and the one that comes first says nothing.
    """
    if not closed:
        return tuple([Crossing(at_s, rate, False, speed) for at_s, rate, speed in rates])
    strict = border == "inside"
    ends = {t for interval in closed for t in interval if t < math.inf}
    start_s, end_s = paths.time_s[0], paths.time_s[-1]
    pace = {at_s: speed for at_s, _, speed in rates}
    route: list[Crossing] = []
    for at_s in sorted(ends | set(pace) | {start_s}):
        shut = any(begin <= at_s < end for begin, end in closed)
        rate = None if shut else _value_at(rates, at_s)
        outside = strict and shut
        if not route or rate != route[-1].rate_l_ha or outside != route[-1].outside:
            speed = pace.get(at_s)
            if speed is None:
                share = (at_s - start_s) / (end_s - start_s)
                begun, ended = paths.speed_m_s.item(valve, 0), paths.speed_m_s.item(valve, -1)
                speed = begun + share * (ended - begun)
            route.append(Crossing(at_s, rate, outside, speed))
    return tuple(route)


# The routes of all valves as one: what the boom as a whole is prescribed along its way.
#
# A pump makes the flow of all sections together, and an atomiser's speed follows that flow. The
# rate of the whole is the mean of the strips' rates by their widths; closed strips count as 0.


def boom_route(
    routes: tuple[Route, ...], boom: Boom, *, merge_s: float = 0.0, shuts_outside: bool = False
) -> Route:
    """Return the mean rate over the boom; None where every strip is closed.

    Sections cross a slanting boundary one after the other. Steps between two flows that are nearer
    to each other than `merge_s` become one, at the moment at which it carries the same volume.
    Where every strip is closed, the boom is outside as soon as one of them is; with
    `shuts_outside` it is closed there.

    >>> from companion.core.boom import Valve
    >>> boom = Boom(width_m=4.0, valves=tuple(
    ...     Valve(name=name, right_m=0.0, forward_m=0.0, width_m=w) for name, w in (("1", 1.0),
    ...                                                                             ("2", 3.0))))
    >>> left = (Crossing(0.0, None, True, 5.0), Crossing(1.0, 20.0, False, 5.0))
    >>> right = (Crossing(0.0, None, True, 5.0), Crossing(1.5, 20.0, False, 5.0))
    >>> [(step.at_s, step.rate_l_ha) for step in boom_route((left, right), boom)]
    [(0.0, None), (1.0, 5.0), (1.5, 20.0)]
    """
    widths = (2.0 * boom.half_width_m).tolist()
    whole_m = sum(widths)
    crossings: dict[float, list[tuple[int, Crossing]]] = {}
    for valve, route in enumerate(routes):
        for crossing in route[1:]:
            crossings.setdefault(crossing.at_s, []).append((valve, crossing))
    rates = [route[0].rate_l_ha or 0.0 for route in routes]
    is_outside = [route[0].outside for route in routes]

    def whole(at_s: float, speed_m_s: float) -> Crossing:
        rate = sum(rate * width for rate, width in zip(rates, widths, strict=True)) / whole_m
        outside = any(is_outside)
        if rate > 0.0 and not (outside and shuts_outside):
            return Crossing(at_s, rate, False, speed_m_s)
        return Crossing(at_s, None, outside, speed_m_s)

    first = routes[len(routes) // 2][0]
    made = [whole(first.at_s, first.speed_m_s)]
    for at_s in sorted(crossings):
        here = crossings[at_s]
        for valve, crossing in here:
            rates[valve] = crossing.rate_l_ha or 0.0
            is_outside[valve] = crossing.outside
        now = whole(at_s, sum(crossing.speed_m_s for _, crossing in here) / len(here))
        if not now.is_as(made[-1]):
            made.append(now)
    return _merged(tuple(made), merge_s) if merge_s > 0.0 else tuple(made)


def _merged(route: Route, merge_s: float) -> Route:
    made = [route[0]]
    i = 1
    while i < len(route):
        last = i
        while (
            last + 1 < len(route)
            and route[last + 1].at_s - route[i].at_s < merge_s
            and all(step.rate_l_ha is not None for step in route[i - 1 : last + 2])
        ):
            last += 1
        made.append(_as_one(route[i - 1 : last + 1]))
        i = last + 1
    return tuple(made)


def _as_one(steps: Route) -> Crossing:
    """Return the steps behind the first as one, where a sharp one would carry their volume."""
    end = steps[-1]
    if len(steps) == 2:
        return end
    rises = [(step.at_s, (step.rate_l_ha or 0.0) - (ahead.rate_l_ha or 0.0))
             for ahead, step in pairwise(steps)]  # fmt: skip
    rise = sum(each for _, each in rises)
    if rise == 0.0:
        return end
    at_s = sum(at_s * each for at_s, each in rises) / rise
    return end._replace(at_s=min(max(at_s, steps[1].at_s), end.at_s))


def bridged(route: Route, gap_s: float) -> Route:
    """Return the route with closed stretches shorter than `gap_s` at the rate before them.

    What cannot stop and start again in the time goes on; whether anything comes out is the
    valves' affair.
    """
    made: list[Crossing] = [route[0]]
    for i in range(1, len(route)):
        step = route[i]
        if step.rate_l_ha is None and made[-1].rate_l_ha is not None:
            again = (each.at_s for each in route[i:] if each.rate_l_ha is not None)
            follows_s = next(again, float("inf"))
            if follows_s - step.at_s < gap_s:
                continue
        if not step.is_as(made[-1]):
            made.append(step)
    return tuple(made)


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
