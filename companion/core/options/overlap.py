"""Not spraying twice: a valve's route is cut where its strip comes over treated ground.

As a section controller does it: a valve is closed while at least a percentage of its strip's width
is treated. The cut lies on the boundary of the treated ground, and the schedule orders it as any
boundary inside the field, each change ahead of it by its own lag. Ground that was treated a moment
ago, or on the last metres of the boom's way, is not looked at: no valve sees its own wake, nor that
of one that sits ahead of it. The guard only ever closes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from companion.core.boom import Boom, Paths, predict
from companion.core.crossings import Crossing, Route
from companion.core.frame import Bools, Floats
from companion.core.options.coverage import CELL_M, Coverage
from companion.core.options.treated_area import TreatedArea, wake_m
from companion.core.types import VehicleState

# From when until when a strip is over treated ground.
Spans = list[tuple[float, float]]

# Places along a way and across a strip: half a cell, a cell.
ALONG_M = CELL_M / 2.0
ACROSS_MIN = 5
# Treated or bare stretches of a way that are shorter are the raster's own noise, or slivers: half
# of a strip of 1 m.
STRETCH_MIN_M = 0.5
# Below this nothing is sprayed: a way that hardly leads anywhere has no stretches.
WAY_MIN_M = 0.05
WAY_MAX_M = 500.0
# Of a chord on which an acceleration fades so many times are worked out, straight between them.
FADING_KNOTS = 33


@dataclass(frozen=True, slots=True, kw_only=True)
class OverlapGuard:
    """A valve is closed where this much of its strip was treated more than `fresh_s` ago.

    And farther back on the way than the boom's own wake: see `wake_m`.
    """

    switch_off_percent: float
    fresh_s: float = 2.0

    def __post_init__(self) -> None:
        if not 0.0 < self.switch_off_percent <= 100.0:
            raise ValueError(
                f"switch_off_percent must lie in (0, 100], got {self.switch_off_percent}"
            )
        # Longer than a swath under the widest boom takes, shorter than its snapshots are kept.
        if not 0.5 <= self.fresh_s <= 5.0:
            raise ValueError(f"fresh_s must lie in [0.5, 5] s, got {self.fresh_s}")


def guarded(
    guard: OverlapGuard,
    routes: tuple[Route, ...],
    treated: Coverage | None,
    state: VehicleState,
    boom: Boom,
    *,
    back_s: float,
    ahead_s: float,
) -> tuple[Route, ...]:
    """Return the routes, closed over ground that is `treated`; `state` is where liquid lands."""
    if all(each.rate_l_ha is None for route in routes for each in route):
        return routes
    if treated is None or _is_far(treated, state, boom, ahead_s):
        return routes
    paths = predict(state, boom.right_m, boom.forward_m, back_s=back_s, ahead_s=ahead_s)
    spans = treated_spans(treated, paths, boom, share=guard.switch_off_percent / 100.0)
    return tuple(
        cut(route, own) if own else route for route, own in zip(routes, spans, strict=True)
    )


def treated_before(
    guard: OverlapGuard,
    area: TreatedArea | None,
    state: VehicleState,
    boom: Boom,
    *,
    back_s: float,
    now_s: float,
) -> Coverage | None:
    """Return the ground that counts as treated: none of what was sprayed a moment ago."""
    if area is None:
        return None
    # The paths begin behind the boom, and their beginning is looked at too.
    speed_m_s = math.hypot(state.velocity_east_m_s, state.velocity_north_m_s)
    behind_m = wake_m(boom) + speed_m_s * back_s
    here = (state.east_m, state.north_m)
    return area.before(now_s - guard.fresh_s, here=here, behind_m=behind_m)


def _is_far(treated: Coverage, state: VehicleState, boom: Boom, ahead_s: float) -> bool:
    """Return whether nothing is treated anywhere near the way of the boom."""
    speed = math.hypot(state.velocity_east_m_s, state.velocity_north_m_s)
    reach_m = boom.reach_m + speed * ahead_s + 12.0  # a wind's offset, a gain of speed
    return treated.is_bare(
        state.east_m - reach_m,
        state.north_m - reach_m,
        state.east_m + reach_m,
        state.north_m + reach_m,
    )


def treated_spans(treated: Coverage, paths: Paths, boom: Boom, *, share: float) -> list[Spans]:
    """Return, for each valve, when at least `share` of its strip is over treated ground.

    A span that begins before the path or ends after it is open at that end.
    """
    found: list[Spans] = [[] for _ in boom.valves]
    longest_m = float(paths.length_m.sum(axis=1).max())
    if not WAY_MIN_M <= longest_m <= WAY_MAX_M:
        return found
    times, is_treated = _along(treated, paths, boom, share, longest_m)
    if not is_treated.any():
        return found
    step_m = paths.length_m.sum(axis=1) / is_treated.shape[1]
    for valve, own in enumerate(is_treated):
        if own.any():
            shortest_m = min(STRETCH_MIN_M, float(boom.half_width_m[valve]))
            least = max(1, round(shortest_m / max(float(step_m[valve]), 1e-3)))
            found[valve] = _spans(_smooth(own, least), times[valve])
    return found


def _along(
    treated: Coverage, paths: Paths, boom: Boom, share: float, longest_m: float
) -> tuple[Floats, Bools]:
    """Return, for each valve, times along its path and whether its strip is treated then."""
    chords = paths.length_m.shape[1]
    count = max(2, math.ceil(longest_m / chords / ALONG_M))
    across = max(ACROSS_MIN, math.ceil(2.0 * float(boom.half_width_m.max()) / CELL_M))
    places = (np.arange(across) + 0.5) / across * 2.0 - 1.0
    aside_m = boom.half_width_m[:, None] * places
    shares = (np.arange(count) + 0.5) / count
    times, east, north = [], [], []
    for chord in range(chords):
        times.append(_times(paths, chord, shares))
        right_east, right_north = paths.right[chord]
        x = paths.east_m[:, chord, None] + shares * paths.step_east_m[:, chord, None]
        y = paths.north_m[:, chord, None] + shares * paths.step_north_m[:, chord, None]
        east.append(x[:, :, None] + (aside_m * right_east)[:, None, :])
        north.append(y[:, :, None] + (aside_m * right_north)[:, None, :])
    covered = treated.covered_at(np.concatenate(east, axis=1), np.concatenate(north, axis=1))
    return np.concatenate(times, axis=1), covered.sum(axis=2) >= share * across - 1e-9


def _times(paths: Paths, chord: int, shares: Floats) -> Floats:
    """Return when each point is at shares of a chord."""
    if paths.fading is not None and not chord:  # the same of all points
        flown = paths.chord_of(0, 0)
        knots = np.linspace(0.0, 1.0, FADING_KNOTS)
        at_s = [flown.at(share)[0] for share in knots.tolist()]
        return np.tile(np.interp(shares, knots, at_s), (len(paths.length_m), 1))
    t0, t1 = paths.time_s[chord], paths.time_s[chord + 1]
    v0, v1 = paths.speed_m_s[:, chord, None], paths.speed_m_s[:, chord + 1, None]
    # Speed changes evenly, as in `boom.Chord`.
    pace = np.sqrt(np.maximum(v0 * v0 + (v1 * v1 - v0 * v0) * shares, 0.0))
    found: Floats = t0 + shares * (v0 + v1) / np.maximum(v0 + pace, 1e-9) * (t1 - t0)
    return found


def _smooth(own: Bools, least: int) -> Bools:
    """Return the stretches without bare gaps, and then treated ones, shorter than `least`.

    Those at the ends of the path are as long as they like: the rest of them is not seen.
    """
    for value in (False, True):
        edges = np.flatnonzero(np.diff(own)) + 1
        for first, end in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
            if own[first] == value and end - first < least:
                own = own.copy()
                own[first:end] = not value
    return own


def _spans(own: Bools, times: Floats) -> Spans:
    edges = (np.flatnonzero(np.diff(own)) + 1).tolist()
    at_s = [0.5 * float(times[edge - 1] + times[edge]) for edge in edges]
    if own[0]:
        at_s.insert(0, -math.inf)
    if own[-1]:
        at_s.append(math.inf)
    return list(zip(at_s[::2], at_s[1::2], strict=True))


def cut(route: Route, spans: Spans) -> Route:
    """Return the route closed within the spans, and between them where it is hardly open.

    What lies outside stays marked as such: the border's rule holds whatever is treated at the edge.

    >>> route = (Crossing(0.0, 20.0, False, 5.0), Crossing(4.0, None, True, 5.0))
    >>> [(step.at_s, step.rate_l_ha) for step in cut(route, [(1.0, 2.0)])]
    [(0.0, 20.0), (1.0, None), (2.0, 20.0), (4.0, None)]
    """
    times = {step.at_s for step in route}
    times |= {at_s for span in spans for at_s in span if route[0].at_s < at_s < math.inf}
    made: list[Crossing] = []
    number = -1
    for at_s in sorted(times):
        while number + 1 < len(route) and route[number + 1].at_s <= at_s:
            number += 1
        own = route[number]
        is_shut = any(begin_s <= at_s < end_s for begin_s, end_s in spans)
        rate = None if is_shut else own.rate_l_ha
        here = own._replace(at_s=at_s, rate_l_ha=rate)
        if not (made and here.is_as(made[-1])):
            made.append(here)
    return _without_slivers(made, spans)


def _without_slivers(made: list[Crossing], spans: Spans) -> Route:
    """Return the route without openings too short to be wanted beside treated ground."""
    edges = {at_s for span in spans for at_s in span}
    kept: list[Crossing] = made[:1]
    for number in range(1, len(made)):
        step = made[number]
        ahead = made[number + 1] if number + 1 < len(made) else None
        if (
            step.rate_l_ha is not None
            and kept[-1].rate_l_ha is None
            and ahead is not None
            and ahead.rate_l_ha is None
            and (step.at_s in edges or ahead.at_s in edges)
            and (ahead.at_s - step.at_s) * step.speed_m_s < STRETCH_MIN_M
        ):
            continue
        if not step.is_as(kept[-1]):
            kept.append(step)
    return tuple(kept)
