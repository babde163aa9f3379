"""Where and when each valve's footprint crosses the next boundary: exactly, on the geometry.

The predicted path of every footprint is a short chain of chords (one, on a straight pass). Edges
near the swept box come from one tree query; one vectorised side test finds those that a chord
cuts. A side is half-open, so that a path through a vertex crosses once. Edges have their polygon
on the left, so that each cut says which zone is entered or left, and nothing is sampled.

At the border the whole strip counts, not its centre: it is closed while any part of it is
outside, seen in the skewed frame of path and boom.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from companion.core.boom import Boom
from companion.core.drift import Contact, Offset, joined, landed, swept
from companion.core.leg import CREEP_M_S, braking_begins_s
from companion.core.prescription import FIELD, SLIVER_M, Prescription
from companion.core.types import VehicleState

Across = Literal["centre", "mean", "max"]
Border = Literal["inside", "volume"]
Merge = Callable[[list[Contact]], list[Contact]]
Floats = NDArray[np.float64]

# Below these, the tenth of a second that an order looks ahead deviates from a straight line by
# less than a centimetre, and the estimate of an acceleration is mostly noise.
STRAIGHT_YAW_RATE_DEG_S = 3.0
STRAIGHT_LATERAL_M_S2 = 1.0
CURVE_CHORDS = 6
# A boom that lies nearly along its own motion covers no strip that could be judged.
ACROSS_MIN = 0.2
# A strip over several zones is judged at points no farther apart than this, its ends included.
SAMPLE_ACROSS_M = 0.1
SAMPLES_ACROSS = (5, 40)
START_NUDGE_M = 1e-6
# Knots of a path nearer than this are one.
KNOTS_APART_S = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class Paths:
    """Predicted paths of points of the boom: (points, knots) arrays, knots at `time_s`."""

    time_s: tuple[float, ...]
    east_m: Floats
    north_m: Floats
    speed_m_s: Floats
    middle: tuple[tuple[float, float], ...]
    right: tuple[tuple[float, float], ...]
    step_east_m: Floats
    step_north_m: Floats
    length_m: Floats

    def box(self, reach_m: float) -> tuple[float, float, float, float]:
        """Return west, south, east, north of all within `reach_m` of the middle's path."""
        east, north = zip(*self.middle, strict=True)
        return (
            min(east) - reach_m,
            min(north) - reach_m,
            max(east) + reach_m,
            max(north) + reach_m,
        )


class Crossing(NamedTuple):
    """From `at_s` on the footprint is prescribed `rate_l_ha`; None is closed.

    `border` marks a change that the border rule makes (nothing may fall outside), `speed_m_s` is
    the footprint's own speed there.
    """

    at_s: float
    rate_l_ha: float | None
    border: bool
    speed_m_s: float


# A valve's future: the first entry holds at the start of the path, the others are crossings.
Route = tuple[Crossing, ...]


def predict(
    state: VehicleState, right_m: Floats, forward_m: Floats, *, back_s: float, ahead_s: float
) -> Paths:
    """Return the paths of points of the boom from `back_s` ago to `ahead_s` from now.

    The same motion as `estimator.estimate`: constant velocity plus a fading acceleration, and a
    constant yaw rate; on a straight path that ends in a stop, the braking before it.
    """
    heading_deg = state.heading_deg if state.heading_deg is not None else 0.0
    speed = math.hypot(state.velocity_east_m_s, state.velocity_north_m_s)
    lateral = 0.0
    if speed > 0.0:
        lateral = (
            state.velocity_east_m_s * state.acceleration_north_m_s2
            - state.velocity_north_m_s * state.acceleration_east_m_s2
        ) / speed
    turning = not (
        abs(state.yaw_rate_deg_s) < STRAIGHT_YAW_RATE_DEG_S and abs(lateral) < STRAIGHT_LATERAL_M_S2
    )
    chords = CURVE_CHORDS if turning else 1
    knots = [-back_s + (back_s + ahead_s) * i / chords for i in range(chords + 1)]
    if turning:
        shape = (len(right_m), chords + 1)
        east, north, pace = np.empty(shape), np.empty(shape), np.empty(shape)
        middle = [
            _knot(state, dt_s, heading_deg, right_m, forward_m, (east, north, pace), i)
            for i, dt_s in enumerate(knots)
        ]
    else:
        motions = _braked(state, back_s, ahead_s)
        if motions is None:
            motions = [(dt_s, *_carried(state, dt_s, *_along(state))) for dt_s in knots]
        knots = [motion[0] for motion in motions]
        east, north, pace, middle = _straight(motions, heading_deg, right_m, forward_m)
    rights = []
    for a, b in pairwise(knots):
        turned_deg = state.yaw_rate_deg_s * (a + b) / 2 if turning else 0.0
        angle = math.radians(heading_deg + turned_deg)
        rights.append((math.cos(angle), -math.sin(angle)))
    dx = east[:, 1:] - east[:, :-1]
    dy = north[:, 1:] - north[:, :-1]
    return Paths(
        time_s=tuple([state.time_s + dt_s for dt_s in knots]),
        east_m=east,
        north_m=north,
        speed_m_s=pace,
        middle=tuple(middle),
        right=tuple(rights),
        step_east_m=dx,
        step_north_m=dy,
        length_m=np.hypot(dx, dy),
    )


def _carried(
    state: VehicleState, dt_s: float, ae: float, an: float
) -> tuple[float, float, float, float]:
    """Return velocity (east, north) and place (east, north) of the reference at `dt_s` from now."""
    ahead_s = max(dt_s, 0.0)
    fade_s = state.acceleration_fade_s
    gained = fade_s * (1.0 - math.exp(-ahead_s / fade_s))
    carried = fade_s * (ahead_s - gained)
    return (
        state.velocity_east_m_s + ae * gained,
        state.velocity_north_m_s + an * gained,
        state.east_m + state.velocity_east_m_s * dt_s + ae * carried,
        state.north_m + state.velocity_north_m_s * dt_s + an * carried,
    )


# dt_s, velocity (east, north) and place (east, north) of the reference then.
_Motion = tuple[float, float, float, float, float]


def _along(state: VehicleState) -> tuple[float, float]:
    """Return the acceleration along the course, all that counts on a straight path.

    One chord to where the other leads would miss the near end of the path by more than leaving it
    out.
    """
    ve, vn = state.velocity_east_m_s, state.velocity_north_m_s
    gain = ve * state.acceleration_east_m_s2 + vn * state.acceleration_north_m_s2
    gain /= max(ve * ve + vn * vn, 1e-9)
    return gain * ve, gain * vn


def _braked(state: VehicleState, back_s: float, ahead_s: float) -> list[_Motion] | None:
    """Return the motion at the knots of a path that brakes for a stop; None if none does.

    Its chords are those before the braking, of the braking and, at the stop, a creeping on.
    """
    stop = state.stop_ahead
    speed = math.hypot(state.velocity_east_m_s, state.velocity_north_m_s)
    if stop is None or not speed > CREEP_M_S:
        return None
    ae, an = _along(state)
    along = (ae * state.velocity_east_m_s + an * state.velocity_north_m_s) / speed
    begins_s = braking_begins_s(stop, speed, along, state.acceleration_fade_s, ahead_s)
    if begins_s is None:
        return None
    motions = [(dt_s, *_carried(state, dt_s, ae, an)) for dt_s in (-back_s, begins_s)]
    _, ve, vn, east_m, north_m = motions[-1]
    pace = math.hypot(ve, vn)
    unit_east, unit_north = ve / pace, vn / pace
    creeps_s = max(pace - CREEP_M_S, 0.0) / stop.braking_m_s2
    for dt_s in (min(begins_s + creeps_s, ahead_s), ahead_s):
        braked_s = dt_s - motions[-1][0]
        if braked_s < KNOTS_APART_S:
            continue
        after = max(pace - stop.braking_m_s2 * braked_s, min(pace, CREEP_M_S))
        way_m = 0.5 * (pace + after) * braked_s
        east_m, north_m, pace = east_m + unit_east * way_m, north_m + unit_north * way_m, after
        motions.append((dt_s, unit_east * after, unit_north * after, east_m, north_m))
    return motions


def _straight(
    motions: list[_Motion], heading_deg: float, right_m: Floats, forward_m: Floats
) -> tuple[Floats, Floats, Floats, list[tuple[float, float]]]:
    """Return east, north and speed of all points at all knots, and the reference's places."""
    angle = math.radians(heading_deg)
    sin, cos = math.sin(angle), math.cos(angle)
    middle_east, middle_north = [m[3] for m in motions], [m[4] for m in motions]
    east = (right_m * cos + forward_m * sin)[:, None] + np.array(middle_east)
    north = (forward_m * cos - right_m * sin)[:, None] + np.array(middle_north)
    pace = np.empty(east.shape)
    pace[:] = [math.hypot(m[1], m[2]) for m in motions]
    return east, north, pace, list(zip(middle_east, middle_north, strict=True))


def _knot(
    state: VehicleState,
    dt_s: float,
    heading_deg: float,
    right_m: Floats,
    forward_m: Floats,
    into: tuple[Floats, Floats, Floats],
    column: int,
) -> tuple[float, float]:
    """Write east, north and speed of all points at `dt_s` from now into a column, in a turn.

    Returns the position reference itself.
    """
    ae, an = state.acceleration_east_m_s2, state.acceleration_north_m_s2
    velocity_east, velocity_north, middle_east, middle_north = _carried(state, dt_s, ae, an)
    angle = math.radians(heading_deg + state.yaw_rate_deg_s * dt_s)
    sin, cos = math.sin(angle), math.cos(angle)
    offset_east = right_m * cos + forward_m * sin
    offset_north = forward_m * cos - right_m * sin
    east, north, pace = into
    east[:, column] = middle_east + offset_east
    north[:, column] = middle_north + offset_north
    yaw_rate = math.radians(state.yaw_rate_deg_s)
    pace[:, column] = np.hypot(
        velocity_east + yaw_rate * offset_north, velocity_north - yaw_rate * offset_east
    )
    return middle_east, middle_north


class _Cut(NamedTuple):
    """A path cuts an edge: which polygon (`owner`), and whether it is entered."""

    at_s: float
    along_m: float
    speed_m_s: float
    owner: int
    enters: bool


def _cuts(paths: Paths, ends: Floats, owner: NDArray[np.int64]) -> list[list[_Cut]]:
    """Return, for each point, where its path cuts the edges, in order of time.

    All chords of all points at once: row = chord * points + point.
    """
    count, chords = paths.length_m.shape
    found: list[list[_Cut]] = [[] for _ in range(count)]
    if not len(ends):
        return found
    px, py = paths.east_m[:, :-1].T.ravel(), paths.north_m[:, :-1].T.ravel()
    dx, dy = paths.step_east_m.T.ravel(), paths.step_north_m.T.ravel()
    corners = ends.reshape(-1, 2)
    left = dx[:, None] * corners[:, 1] - dy[:, None] * corners[:, 0]
    own = dx * py - dy * px
    is_left = left >= own[:, None]
    rows, hits = (is_left[:, 0::2] != is_left[:, 1::2]).nonzero()
    if not len(rows):
        return found
    l0, l1 = left[rows, 2 * hits].tolist(), left[rows, 2 * hits + 1].tolist()
    own_, reach_ = own.tolist(), paths.length_m.T.ravel().tolist()
    px_, py_, dx_, dy_ = px.tolist(), py.tolist(), dx.tolist(), dy.tolist()
    pace = paths.speed_m_s.tolist()
    kept = []
    for row, a, b, (x0, y0, x1, y1), who in zip(
        rows.tolist(), l0, l1, ends[hits].tolist(), owner[hits].tolist(), strict=True
    ):
        share = (a - own_[row]) / (a - b)
        reach = reach_[row]
        s = (x0 + share * (x1 - x0) - px_[row]) * dx_[row]
        s += (y0 + share * (y1 - y0) - py_[row]) * dy_[row]
        s /= max(reach, 1e-12)
        if (START_NUDGE_M if row < count else 0.0) < s <= reach:
            # In order of the path; leaving before entering, where both are at one place.
            kept.append((row // count, round(s * 1e6), a > b, row, s, reach, who))
    kept.sort()
    along = np.cumsum(paths.length_m, axis=1).tolist() if chords > 1 else []
    for chord, _, enters, row, s, reach, who in kept:
        point = row - chord * count
        share = s / reach
        v0, v1 = pace[point][chord : chord + 2]
        v0_2 = v0 * v0
        speed = math.sqrt(v0_2 + (v1 * v1 - v0_2) * share)
        t0, t1 = paths.time_s[chord], paths.time_s[chord + 1]
        at_s = t0 + share * (v0 + v1) / max(v0 + speed, 1e-9) * (t1 - t0)
        gone = along[point][chord - 1] if chord else 0.0
        found[point].append(_Cut(at_s, gone + s, speed, who, enters))
    return found


def _time_on_chord(
    paths: Paths, chord: int, point: int, s: float, reach: float
) -> tuple[float, float]:
    """Return when the path is `s` metres along the chord, and its speed there.

    Speed changes evenly along a chord: s = v0 t + (v1 - v0) t^2 / 2T, scaled to the chord's end
    (as in `_chord_cuts`, where it is solved for all cuts at once).
    """
    t0, t1 = paths.time_s[chord], paths.time_s[chord + 1]
    v0, v1 = paths.speed_m_s.item(point, chord), paths.speed_m_s.item(point, chord + 1)
    if not v0 + v1 > 1e-9:
        return t0, 0.0
    share = s / reach
    spread = (v1 * v1 - v0 * v0) * share + v0 * v0
    speed = math.sqrt(max(spread, 0.0))
    tau = share * (v0 + v1) / (v0 + speed) if v0 + speed > 0.0 else 0.0
    return t0 + tau * (t1 - t0), speed


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
) -> tuple[Route, ...]:
    """Return what each valve is prescribed along its predicted path, left to right.

    With `drift_m` it is what the ground prescribes where the liquid lands; see `drift.py`.
    """
    reach_m = boom.reach_m + border_buffer_m + SLIVER_M
    if drift_m is not None:
        state = landed(state, drift_m)
        reach_m += math.hypot(*drift_m)
    paths = predict(state, boom.right_m, boom.forward_m, back_s=back_s, ahead_s=ahead_s)
    ends, owner = prescription.edges_near(*paths.box(reach_m))
    bases = prescription.owners_at(*_starts(paths))
    cuts = _cuts(paths, ends, owner)
    if across == "centre":
        rates = _rates(prescription, paths, bases, cuts)
    else:
        rates = _rates_across(prescription, state, boom, (ends, owner), across, back_s, ahead_s)
    closed = [
        _centre_outside(FIELD in base, found, paths.time_s[0])
        for base, found in zip(bases, cuts, strict=True)
    ]
    if border == "inside":
        edges = ends[owner == FIELD]
        if drift_m is not None:
            edges = swept(edges, drift_m)
        merge = None if drift_m is None else joined
        _add_contacts(paths, edges, boom, border_buffer_m, closed, merge)
    speeds = paths.speed_m_s[:, (0, -1)].tolist()
    return tuple(
        _combine(rates[valve], closed[valve], paths, speeds[valve], border)
        for valve in range(len(boom.valves))
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
        zone_cuts = [cut for cut in cuts if cut.owner != FIELD]
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
        timelines.append(steps)
    return timelines


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


def _rates_across(
    prescription: Prescription,
    state: VehicleState,
    boom: Boom,
    edges: tuple[Floats, NDArray[np.int64]],
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


_Intervals = list[tuple[float, float]]


def _centre_outside(inside: bool, cuts: list[_Cut], start_s: float) -> _Intervals:
    """Return when the strip's centre is outside the field."""
    intervals: _Intervals = []
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


def _add_contacts(
    paths: Paths,
    ends: Floats,
    boom: Boom,
    buffer_m: float,
    closed: list[_Intervals],
    merge: Merge | None,
) -> None:
    """Add to `closed` when an edge of the border lies within a strip."""
    if len(ends):
        for chord in range(len(paths.time_s) - 1):
            _add_chord_contacts(paths, chord, ends, boom, buffer_m, closed, merge)


def _add_chord_contacts(
    paths: Paths,
    chord: int,
    ends: Floats,
    boom: Boom,
    buffer_m: float,
    closed: list[_Intervals],
    merge: Merge | None,
) -> None:
    """Add the contacts of one chord, in the skewed frame of path and boom."""
    px, py = paths.east_m[:, chord], paths.north_m[:, chord]
    dx, dy = paths.step_east_m[:, chord], paths.step_north_m[:, chord]
    length = paths.length_m[:, chord]
    rx, ry = paths.right[chord]
    safe = np.maximum(length, 1e-12)
    turn = (dx * ry - dy * rx) / safe  # sine of the angle from path to boom
    if not np.abs(turn).min() >= ACROSS_MIN:
        for intervals in closed:
            intervals.append((paths.time_s[chord], paths.time_s[chord + 1]))
        return
    ux, uy, t2 = (dx / safe)[:, None], (dy / safe)[:, None], turn[:, None]
    x, y = ends[:, 0::2].ravel() - px[:, None], ends[:, 1::2].ravel() - py[:, None]
    across = (ux * y - uy * x) / t2
    across_0, across_1 = across[:, 0::2], across[:, 1::2]
    half = (boom.half_width_m + buffer_m)[:, None]
    touching = (np.minimum(across_0, across_1) <= half) & (np.maximum(across_0, across_1) >= -half)
    valves, hits = touching.nonzero()
    if not len(valves):
        return
    along = (x * ry - y * rx) / t2
    along_0, along_1 = along[:, 0::2], along[:, 1::2]
    contacts = [
        (valve, hit, _clip(
            (float(across_0[valve, hit]), float(along_0[valve, hit])),
            (float(across_1[valve, hit]), float(along_1[valve, hit])),
            float(half[valve, 0]),
        ))
        for valve, hit in zip(valves.tolist(), hits.tolist(), strict=True)
    ]  # fmt: skip
    for valve, _, limits in contacts if merge is None else merge(contacts):
        first, last = limits[0] - buffer_m, limits[1] + buffer_m
        reach = float(length[valve])
        if last < 0.0 or first > reach:
            continue
        begin = _time_on_chord(paths, chord, valve, max(first, 0.0), reach)[0]
        end = _time_on_chord(paths, chord, valve, min(last, reach), reach)[0]
        beyond = last > reach and chord == len(paths.time_s) - 2
        closed[valve].append((begin, math.inf if beyond else end))


def _clip(a: tuple[float, float], b: tuple[float, float], half_m: float) -> tuple[float, float]:
    """Return the least and greatest `along` of the edge a-b within the strip's width."""
    (u0, s0), (u1, s1) = a, b
    if u0 == u1:
        return min(s0, s1), max(s0, s1)
    ends = []
    for u, s in (a, b):
        held = min(max(u, -half_m), half_m)
        ends.append(s if held == u else s0 + (s1 - s0) * (held - u0) / (u1 - u0))
    return min(ends), max(ends)


def _combine(
    rates: _Steps,
    closed: _Intervals,
    paths: Paths,
    speeds: list[float],
    border: Border,
) -> Route:
    """Return one timeline of rates, closed where the border rule says so."""
    if not closed:
        return tuple(Crossing(at_s, rate, False, speed) for at_s, rate, speed in rates)
    strict = border == "inside"
    ends = {t for interval in closed for t in interval if t < math.inf}
    start_s, end_s = paths.time_s[0], paths.time_s[-1]
    pace = {at_s: speed for at_s, _, speed in rates}
    route: list[Crossing] = []
    shut_before = False
    for at_s in sorted(ends | set(pace) | {start_s}):
        shut = any(begin <= at_s < end for begin, end in closed)
        rate = None if shut else _value_at(rates, at_s)
        if not route or rate != route[-1].rate_l_ha:
            share = (at_s - start_s) / (end_s - start_s)
            speed = pace.get(at_s, speeds[0] + share * (speeds[1] - speeds[0]))
            route.append(Crossing(at_s, rate, strict and shut != shut_before, speed))
        shut_before = shut
    return tuple(route)
