"""A speed for each leg, such that every rate on it lies within the valves' range.

A rate r on a strip w wide takes a flow of r v w: too much of it is flown slower, too little
faster, as far as allowed. Of all ways to choose, the one that takes the least time: a table over
the stretches of a line and the speeds that any of them asks for (Viterbi 1967).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from companion.core.frame import LocalFrame
from companion.core.nozzle import flow_for_rate
from companion.wording import counted
from missions.demand import M2_PER_HA, Rates, Uniform, valve_places
from missions.plan import Leg, Place, Settings, Sortie
from missions.strips import Floats

# Rates are looked at this often along a line.
STEP_M = 1.0
SPEEDS_MAX = 24
# Speeds are round numbers, and a change of speed costs the pilot's attention: so many seconds.
ROUND_M_S, CHANGE_S = 0.1, 1.0
# A metre outside the range weighs more than any time saved, and one far outside more still.
OUTSIDE_S_M, FARTHER_S_M = 10.0, 100.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Miss:
    """A stretch on which no allowed speed brings the rate into the valves' range."""

    rate_l_ha: float
    flow_l_min: float
    speed_m_s: float
    length_m: float
    place: Place


@dataclass(frozen=True, slots=True, kw_only=True)
class Stretches:
    """Parts of a line with one range of speeds each: `low` and `high` are 0 and inf without."""

    ends_m: Floats
    low: Floats
    high: Floats
    litres: Floats
    least_l_ha: Floats
    most_l_ha: Floats


def speed_range(rate_l_ha: Floats, settings: Settings) -> tuple[Floats, Floats]:
    """Return the least and the highest speed at which the valves deliver rates above zero."""
    if settings.flow_l_min is None:
        return np.zeros_like(rate_l_ha), np.full_like(rate_l_ha, np.inf)
    per_m_s = flow_for_rate(1.0, 1.0, settings.swath_width_m) * rate_l_ha
    low, high = settings.flow_l_min
    return low / per_m_s, high / per_m_s


def stretches_of(leg: Leg, rates: Rates, settings: Settings) -> Stretches:
    """Return the stretches of a spray line along which the range of speeds is the same."""
    if isinstance(rates, Uniform):
        return _one_stretch(leg, rates.rate_l_ha, settings)
    start, end = np.array(leg.points[0]), np.array(leg.points[-1])
    length_m = leg.length_m
    count = max(1, math.ceil(length_m / STEP_M))
    along = (end - start) / length_m
    middle = start + np.outer((np.arange(count) + 0.5) * length_m / count, along)
    least, most, used = np.full(count, np.inf), np.zeros(count), np.zeros(count)
    for right_m, strip_m in valve_places(settings.swath_width_m, settings.valves):
        found = rates.rates_at(middle[:, 0] + along[1] * right_m, middle[:, 1] - along[0] * right_m)
        rate = np.nan_to_num(found, nan=0.0)
        least = np.where(rate > 0.0, np.minimum(least, rate), least)
        most = np.maximum(most, rate)
        used += rate * strip_m * (length_m / count) / M2_PER_HA
    bare = ~(most > 0.0)
    low, _ = speed_range(np.where(bare, 1.0, least), settings)
    _, high = speed_range(np.where(bare, 1.0, most), settings)
    low, high = np.where(bare, 0.0, low), np.where(bare, np.inf, high)
    new = np.flatnonzero((low[1:] != low[:-1]) | (high[1:] != high[:-1])) + 1
    first = np.concatenate([[0], new])
    total = float(used.sum())
    share = leg.volume_l / total if total > 0.0 else 0.0
    return Stretches(
        ends_m=np.append(new, count) * (length_m / count),
        low=low[first],
        high=high[first],
        litres=np.add.reduceat(used, first) * share,
        least_l_ha=np.where(bare, 0.0, least)[first],
        most_l_ha=most[first],
    )


def _one_stretch(leg: Leg, rate_l_ha: float, settings: Settings) -> Stretches:
    """Return what one rate everywhere comes to."""
    is_bare = not rate_l_ha > 0.0
    rate = np.zeros(1) if is_bare else np.array([rate_l_ha])
    low, high = speed_range(np.ones(1) if is_bare else rate, settings)
    return Stretches(
        ends_m=np.array([leg.length_m]),
        low=np.zeros(1) if is_bare else low,
        high=np.full(1, np.inf) if is_bare else high,
        litres=np.array([0.0 if is_bare else leg.volume_l]),
        least_l_ha=rate,
        most_l_ha=rate,
    )


def choices(found: Stretches, settings: Settings) -> Floats:
    """Return the speeds worth trying: the planned one, and what the stretches ask for."""
    least, most = settings.speeds_m_s
    least, most = min(least, settings.speed_m_s), max(most, settings.speed_m_s)
    slower = np.floor(found.high[np.isfinite(found.high)] / ROUND_M_S + 1e-9) * ROUND_M_S
    faster = np.ceil(found.low / ROUND_M_S - 1e-9) * ROUND_M_S
    asked = np.concatenate(
        [slower[slower < settings.speed_m_s], faster[faster > settings.speed_m_s]]
    )
    asked = np.unique(np.round(np.clip(asked, max(least, ROUND_M_S), most), 6))
    if len(asked) > SPEEDS_MAX:
        asked = asked[np.linspace(0, len(asked) - 1, SPEEDS_MAX).astype(int)]
    speeds: Floats = np.unique(np.append(asked, settings.speed_m_s))
    return speeds


def chosen(found: Stretches, speeds: Floats, acceleration_m_s2: float) -> Floats:
    """Return the speed of each stretch that takes the least time in all."""
    length_m = np.diff(found.ends_m, prepend=0.0)[:, None]
    over = speeds / found.high[:, None] - 1.0
    under = found.low[:, None] / speeds - 1.0
    outside = np.maximum(np.maximum(over, under), 0.0)
    beyond = np.where(outside > 1e-6, OUTSIDE_S_M + FARTHER_S_M * outside, 0.0)
    cost = length_m * (1.0 / speeds + beyond)
    if len(cost) == 1:
        alone: Floats = speeds[cost.argmin(axis=1)]
        return alone
    step = speeds[None, :] - speeds[:, None]
    change = np.where(step == 0.0, 0.0, CHANGE_S + step**2 / (2.0 * acceleration_m_s2 * speeds))
    best, came_from = cost[0], []
    for row in cost[1:]:
        ways = best[:, None] + change
        came_from.append(ways.argmin(axis=0))
        best = ways.min(axis=0) + row
    at = int(best.argmin())
    order = [at]
    for row in reversed(came_from):
        at = int(row[at])
        order.append(at)
    taken: Floats = speeds[order[::-1]]
    return taken


def misses_of(leg: Leg, found: Stretches, taken: Floats, settings: Settings) -> list[Miss]:
    """Return the stretches that stay outside the valves' range, with the place of each middle."""
    starts_m = np.concatenate([[0.0], found.ends_m[:-1]])
    missed = []
    for number in np.flatnonzero((taken > found.high + 1e-6) | (taken < found.low - 1e-6)).tolist():
        speed = float(taken[number])
        too_fast = speed > found.high[number]
        rate = float((found.most_l_ha if too_fast else found.least_l_ha)[number])
        share = (starts_m[number] + found.ends_m[number]) / 2.0 / leg.length_m
        missed.append(
            Miss(
                rate_l_ha=rate,
                flow_l_min=flow_for_rate(rate, speed, settings.swath_width_m),
                speed_m_s=speed,
                length_m=float(found.ends_m[number] - starts_m[number]),
                place=between(leg, share),
            )
        )
    return missed


def between(leg: Leg, share: float) -> Place:
    """Return the place at a share of a straight leg's length."""
    (x0, y0), (x1, y1) = leg.points[0], leg.points[-1]
    return x0 + share * (x1 - x0), y0 + share * (y1 - y0)


# Cells that are flown through faster than the sprayer follows: their rate is never there.

# The rate is read so often within the length that it takes to settle.
READS = 4
# On fields so large that this would be more places, nothing is said of short cells.
PLACES_MAX = 2_000_000
# A line with less than this part of the least flow is flown too slowly; worth a word from this part
# of all lines on.
CRAWLS, CRAWLED_SHARE = 0.9, 0.05
# A pass has the plan's course but for rounding.
ALONG_DEG = 1.0
# Under every valve while that is a second's work; else under the valve nearest to the middle.
EVERY_VALVE_MAX = 250_000


def short_warnings(
    sorties: Sequence[Sortie], rates: Rates, frame: LocalFrame, settings: Settings,
    *, course_deg: float,
) -> tuple[str, ...]:  # fmt: skip
    """Return how many cells under a valve are shorter than the lag, and where.

    Of the passes along the course: those along the border cross even zones that were made for this
    sprayer. Not under the middle of the boom: such maps have their edges there, between two
    valves. Of a leg, the valve with the most of them counts.
    """
    legs = [(sortie.number, leg) for sortie in sorties for leg in sortie.legs
            if leg.kind == "spray" and _is_along(leg, course_deg)]  # fmt: skip
    steps = sum(leg.length_m / max(leg.speed_m_s, 0.1) for _, leg in legs)
    if isinstance(rates, Uniform) or not settings.settle_s > 0.0:
        return ()
    places = steps / settings.settle_s * READS
    if not places <= PLACES_MAX:
        return ()
    valves = valve_places(settings.swath_width_m, settings.valves)[:, 0].tolist()
    if places * len(valves) > EVERY_VALVE_MAX:
        valves = [min(valves, key=abs)]
    found = [
        (length_m, number, leg, at_m)
        for number, leg in legs
        for length_m, at_m in max(
            (_short(leg, rates, settings.settle_s * leg.speed_m_s, valve) for valve in valves),
            key=len,
        )
    ]
    if not found:
        return ()
    length_m, number, leg, at_m = min(found, key=lambda each: each[0] / each[2].speed_m_s)
    place = frame.to_geographic(*between(leg, at_m / leg.length_m))
    enough_m_s = math.floor(10.0 * length_m / settings.settle_s) / 10.0
    slower = f"plan with --speed-m-s {enough_m_s:g}, or "
    slower = slower if enough_m_s >= max(settings.speeds_m_s[0], 0.5) else ""
    return (
        f"{counted(len(found), 'cell')} {'is' if len(found) == 1 else 'are'} flown through in less "
        f"than {settings.settle_s:.2f} s, which a change of rate takes: the shortest is "
        f"{length_m:.1f} m at {leg.speed_m_s:g} m/s, sortie {number} near {place[0]:.6f}, "
        f"{place[1]:.6f}; {slower}make zones of the map that this sprayer follows (vrspray make "
        "zones)",
    )


def _is_along(leg: Leg, course_deg: float) -> bool:
    """Return whether a line has the course of the passes, to or fro."""
    (x0, y0), (x1, y1) = leg.points[0], leg.points[-1]
    off_deg = math.degrees(math.atan2(x1 - x0, y1 - y0)) - course_deg
    return abs((off_deg + 90.0) % 180.0 - 90.0) <= ALONG_DEG


def crawl_warnings(
    sorties: Sequence[Sortie], frame: LocalFrame, settings: Settings
) -> tuple[str, ...]:
    """Return how much is flown more slowly than the valves can follow, corner after corner.

    An autopilot that plans each leg from rest to rest flies a row of short ones at walking pace,
    whatever their speed. What a line takes on average counts, so that the slow ends of a long one
    do not.
    """
    if settings.flow_l_min is None:
        return ()
    lines = [
        leg for sortie in sorties for leg in sortie.legs
        if leg.kind == "spray" and leg.seconds > 0.0 and leg.volume_l > 0.0
    ]  # fmt: skip
    low = settings.flow_l_min[0]
    # What is too little at its own speed is told by `misses_of`.
    slow = [
        leg for leg in lines
        if leg.volume_l / leg.seconds * 60.0 < CRAWLS * low
        and leg.volume_l / leg.length_m * leg.speed_m_s * 60.0 >= low
    ]  # fmt: skip
    slow_m, all_m = (sum(leg.length_m for leg in some) for some in (slow, lines))
    if not slow_m > CRAWLED_SHARE * all_m:
        return ()
    seconds, litres = sum(leg.seconds for leg in slow), sum(leg.volume_l for leg in slow)
    worst = min(slow, key=lambda leg: (leg.length_m / leg.seconds, leg.points[0]))
    latitude_deg, longitude_deg = frame.to_geographic(*worst.points[0])
    over = 100.0 * (low * seconds / 60.0 / litres - 1.0)
    # Rows of legs of 3 to 6 m: 186 m in 127 s at 1 m/s3, 180 m in 100 s at 2.
    faster = (
        "; twice the WPNAV_JERK (mission.jerk_m_s3), where the aircraft bears it, flies them a "
        "quarter faster"
        if settings.autopilot == "ardupilot"
        else ""
    )
    return (
        f"{math.ceil(slow_m)} m of passes are short and turn into each other: flown at "
        f"{slow_m / seconds:.1f} m/s on average, where the nozzle sets give {over:.0f} % too much "
        f"({low:.2f} L/min at least), or nothing below safety.speed_min_m_s; slowest near "
        f"{latitude_deg:.6f}, {longitude_deg:.6f}; draw border or obstacle with fewer corners, or "
        f"try --leave-max 5{faster}",
    )


def _short(leg: Leg, rates: Rates, settle_m: float, right_m: float) -> list[tuple[float, float]]:
    """Return length and middle of the cells beside a line that are shorter than `settle_m`.

    The first and the last one are cut by the line itself, and no cells.
    """
    count = max(1, math.ceil(leg.length_m / settle_m * READS))
    start, end = np.array(leg.points[0]), np.array(leg.points[-1])
    middle = start + np.outer((np.arange(count) + 0.5) / count, end - start)
    middle += right_m / leg.length_m * np.array([end[1] - start[1], start[0] - end[0]])
    rate: Floats = np.nan_to_num(rates.rates_at(middle[:, 0], middle[:, 1]), nan=0.0)
    changes = np.flatnonzero(np.diff(rate) != 0.0) + 1
    each_m = leg.length_m / count
    length_m, at_m = np.diff(changes) * each_m, (changes[1:] + changes[:-1]) / 2.0 * each_m
    # Lengths are known to one step.
    some = np.flatnonzero(length_m + each_m < settle_m)
    return [(float(length_m[index]), float(at_m[index])) for index in some]
