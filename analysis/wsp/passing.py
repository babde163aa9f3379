"""Which pass of a flight went over a place, and what was ordered and given there.

All of it is from the journal: the place is the autopilot's, the applied rate what the executed
changes of the valve stand for, after the lags of the configuration. No drift is in it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from analysis.flown.applied_flight import AppliedFlight
from analysis.flown.applied_record import heading_deg
from analysis.flown.pumped_flow import pumped_ml
from companion.core.boom import Boom

Floats = NDArray[np.float64]

# Samples further apart than this are a gap in the record, not a piece of the path.
LONGEST_STEP_S = 1.0
# A rate of a vehicle that hardly moves is no figure.
LEAST_SPEED_M_S = 0.3
_ML_FACTOR = 60.0 / 10_000.0
# A pump's flow is followed from so long before, many of its time constants, in such steps.
PUMP_BEFORE_S, PUMP_STEP_S = 10.0, 0.01
_L_MIN_PER_ML_S = 60.0 / 1000.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Passing:
    """The boom's way over a place; `valve` is the one whose strip held it, None beside the boom.

    `beside_m` is how far the place lay beside the end of the boom, 0 under it. `passes` counts
    how often the boom went over it at all, `applied_all_passes_l_ha` what all of them gave.
    """

    time_s: float
    course_deg: float
    speed_m_s: float
    height_m: float
    right_m: float
    beside_m: float
    valve: int | None
    passes: int
    planned_l_ha: float | None
    applied_l_ha: float | None
    applied_all_passes_l_ha: float | None
    inhibits: str


def passing(flight: AppliedFlight, east_m: float, north_m: float) -> Passing | None:
    """Return the pass that counts for a place; None where the boom's line never crossed it.

    A pass is where the line of the boom goes over the place from behind to before or the other
    way; of several that covered it, one that sprayed, and of those the one with the middle of the
    boom nearest to it.
    """
    at, part, right_m = _crossings(flight, east_m, north_m)
    boom = flight.setup.boom
    if not len(at):
        return None
    beside_m = np.maximum(_beyond_m(boom, right_m), 0.0)
    order = np.lexsort((np.abs(right_m), beside_m))
    covering = [each for each in order.tolist() if beside_m[each] <= 0.0]
    if not beside_m[order[0]] <= boom.width_m:
        return None
    found = [
        _passing_at(
            flight,
            int(at[each]),
            float(part[each]),
            right_m=float(right_m[each]),
            beside_m=float(beside_m[each]),
            passes=len(covering),
        )
        for each in covering or order[:1].tolist()
    ]
    best = next((each for each in found if each.applied_l_ha), found[0])
    given = [each.applied_l_ha for each in found if each.applied_l_ha is not None]
    return replace(best, applied_all_passes_l_ha=sum(given) if given else None)


def _crossings(
    flight: AppliedFlight, east_m: float, north_m: float
) -> tuple[NDArray[np.intp], Floats, Floats]:
    """Return samples before a crossing, the share of the step to it, and the offset there."""
    heading = np.deg2rad(_nose_deg(flight))
    de, dn = east_m - flight.east_m, north_m - flight.north_m
    middle_m = float(np.mean(flight.setup.boom.forward_m))
    ahead_m = de * np.sin(heading) + dn * np.cos(heading) - middle_m
    right_m = de * np.cos(heading) - dn * np.sin(heading)
    with np.errstate(invalid="ignore"):
        is_crossing = (np.sign(ahead_m[:-1]) != np.sign(ahead_m[1:])) & (
            np.diff(flight.time_s) <= LONGEST_STEP_S
        )
    # NaN (no heading) has no sign equal to another; such steps are no crossing.
    is_crossing &= np.isfinite(ahead_m[:-1]) & np.isfinite(ahead_m[1:])
    at = np.flatnonzero(is_crossing)
    # A turn on the spot sweeps the boom over far places: the path itself must go by.
    step_m = np.hypot(np.diff(flight.east_m), np.diff(flight.north_m))[at]
    at = at[step_m >= 0.5 * np.abs(ahead_m[at + 1] - ahead_m[at])]
    part = ahead_m[at] / (ahead_m[at] - ahead_m[at + 1])
    return at, part, right_m[at] + part * (right_m[at + 1] - right_m[at])


def _nose_deg(flight: AppliedFlight) -> Floats:
    """Return the nose's direction at the samples; the course stands for a heading not known."""
    known = np.isfinite(flight.heading_deg) | np.isfinite(flight.course_deg)
    return heading_deg(flight, flight.time_s) if known.any() else flight.heading_deg


def _beyond_m(boom: Boom, right_m: Floats) -> Floats:
    """Return how far places lie beyond the ends of the boom; negative under it."""
    low = float((boom.right_m - boom.half_width_m).min())
    high = float((boom.right_m + boom.half_width_m).max())
    return np.maximum(low - right_m, right_m - high)


def _passing_at(
    flight: AppliedFlight, i: int, share: float, *, right_m: float, beside_m: float, passes: int
) -> Passing:
    def between(values: Floats) -> float:
        return float(values[i] + share * (values[i + 1] - values[i]))

    near = i if share < 0.5 else i + 1
    boom = flight.setup.boom
    off_m = np.abs(right_m - boom.right_m) - boom.half_width_m
    valve = int(np.argmin(off_m))
    is_under = bool(off_m[valve] <= 1e-9)
    time_s, speed_m_s = between(flight.time_s), between(flight.speed_m_s)
    planned = float(flight.rate_l_ha[near, valve]) if is_under else float("nan")
    return Passing(
        time_s=time_s,
        course_deg=float(flight.course_deg[near]),
        speed_m_s=speed_m_s,
        height_m=between(flight.height_m),
        right_m=right_m,
        beside_m=beside_m,
        valve=valve if is_under else None,
        passes=passes,
        planned_l_ha=planned if np.isfinite(planned) else None,
        applied_l_ha=_applied_l_ha(flight, valve, time_s, speed_m_s) if is_under else None,
        applied_all_passes_l_ha=None,
        inhibits=flight.inhibits[near],
    )


def _applied_l_ha(
    flight: AppliedFlight, valve: int, time_s: float, speed_m_s: float
) -> float | None:
    """Return the rate by the valve's duty that had taken effect, the law of rate controllers."""
    if not speed_m_s >= LEAST_SPEED_M_S:
        return None
    boom = flight.setup.boom
    if flight.setup.pumping is not None:
        steps = round(PUMP_BEFORE_S / PUMP_STEP_S) + 1
        before_s = np.linspace(time_s - PUMP_BEFORE_S, time_s, steps, dtype=np.float64)
        volume_ml = pumped_ml(flight, before_s)[:, valve]
        pumped_l_min = (volume_ml[-1] - volume_ml[-2]) / PUMP_STEP_S * _L_MIN_PER_ML_S
        return float(pumped_l_min / (_ML_FACTOR * speed_m_s * boom.valves[valve].width_m))
    duties = [duty_at(flight, each, time_s) for each in range(len(boom.valves))]
    if duties[valve] <= 0.0:
        return 0.0
    open_valves = {each for each, duty in enumerate(duties) if duty > 0.0}
    sets = [each for each in flight.setup.nozzle_sets if open_valves <= set(each.valves)]
    if not sets:
        return None
    nozzles = min(sets, key=lambda each: len(each.valves))
    flow = nozzles.curve.flow_for(duties[valve]) / len(nozzles.valves)
    return flow / (_ML_FACTOR * speed_m_s * boom.valves[valve].width_m)


def duty_at(flight: AppliedFlight, valve: int, time_s: float) -> float:
    """Return the duty that the liquid of a valve followed: each change after its lag."""
    changes, lag = flight.changes, flight.setup.lag
    own = changes.valve == valve
    planned_s, actual_s = changes.planned_s[own], changes.actual_s[own]
    ordered_s = np.where(np.isfinite(actual_s), actual_s, planned_s)
    duty = changes.duty[own]
    before = np.concatenate([[0.0], duty[:-1]])
    lag_s = np.select(
        [before <= 0.0, duty <= 0.0, duty > before], [lag.on_s, lag.off_s, lag.up_s], lag.down_s
    )
    came = np.flatnonzero(ordered_s + lag.output_s + lag_s <= time_s)
    return float(duty[came[-1]]) if len(came) else 0.0
