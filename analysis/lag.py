"""The volume-equivalent step of every change, and how far it lies from its boundary.

With V(s) the volume that a valve has dropped up to the along-track distance s, the flow before a
change is a line V = V0 + q0 (s - s0), the flow after it another one. A sharp step that delivers
the same volume stands where the lines meet. Each line goes through one point near the change and
has the slope of up to twenty periods; both are taken from smoothed volume and distance, so that
neither the pulses' phase nor the speed matters.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from analysis.changes import Change, changes_of
from analysis.holds import sides_of
from analysis.transitions import (
    Sides,
    SmoothTrack,
    Transition,
    find_transitions,
    prescribed_dose_ml_m,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from analysis.changes import Run
    from analysis.holds import Hold
    from analysis.track import Bools, Floats, Track
    from companion.core.types import TimedChange

SMALLEST_STEP = 0.08
DWELL_MIN_S = 0.5
PERIODS_MAX = 20
PERIODS_MIN = 3
MISSED_BELOW = 0.5
# Below this part of the prescribed dose a valve is closed.
DRY_BELOW = 0.02
# A valve is saturated when its clamped duty leaves the dose this far from what is asked.
SATURATED_ERROR = 0.05


class Verdict(StrEnum):
    """What became of a change; all but the first and the last count apart.

    `border`: the strip reaches over the border there, or over treated ground, which may rightly
    hold its valve closed.
    `unknown`: the record of that time is missing.
    """

    MEASURED = "measured"
    SMALL = "small"
    CLOSE = "close"
    SATURATED = "saturated"
    BORDER = "border"
    UNKNOWN = "unknown"
    MISSED = "missed"


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """A change and its volume-equivalent step; + is too late. None where it is not measured.

    Borders have one too: the switches' gaps and overlaps come from it. `dry` says that the valve
    was closed before or after, where something is prescribed.
    """

    change: Change
    verdict: Verdict
    dry: bool
    lag_distance_m: float | None = None


class _Lines(NamedTuple):
    """The volume against the distance around a point each; the slope is NaN where there is none."""

    distance_m: Floats
    volume_ml: Floats
    slope_ml_m: Floats


def measure_steps(
    track: Track,
    stretches: Sequence[Run],
    orders: Sequence[TimedChange],
    duty_limits: tuple[float, float],
    holds: Sequence[Hold] = (),
) -> list[Step]:
    """Return the step of every change of one valve; `orders` and `holds` are that valve's."""
    changes = changes_of(track, stretches)
    smooth = SmoothTrack(track)
    sides = sides_of(smooth, stretches, holds)
    transitions = find_transitions(smooth, sides, changes)
    lags_m = _lag_distances_m(smooth, changes, transitions, sides)
    steps: list[Step] = []
    for i, change in enumerate(changes):
        if change is None:
            continue
        transition, pair = transitions[i], (sides[i].before, sides[i].after)
        per_rate = prescribed_dose_ml_m(track, 1.0, change.time_s)
        asked = (per_rate * change.before_l_ha, per_rate * change.after_l_ha)
        dry = any(
            given < DRY_BELOW * dose
            for given, dose in zip(transition.levels_ml_m, asked, strict=True)
        )
        verdict = _verdict(change, sides[i], transition)
        if (
            min(asked) > 0.0
            and verdict in (Verdict.MEASURED, Verdict.MISSED)
            and any(
                _is_saturated(orders, duty_limits, stretch, doses)
                for stretch, *doses in zip(pair, asked, transition.levels_ml_m, strict=True)
            )
        ):
            verdict = Verdict.SATURATED
        lag_m = None
        if verdict is Verdict.MEASURED:
            lag_m = lags_m[i]
            verdict = Verdict.CLOSE if lag_m is None else verdict
        steps.append(Step(change=change, verdict=verdict, dry=dry, lag_distance_m=lag_m))
    return steps


def _verdict(change: Change, sides: Sides, transition: Transition) -> Verdict:
    if not change.relative >= SMALLEST_STEP:
        return Verdict.SMALL
    if sides.held:
        return Verdict.BORDER
    if not min(sides.before.dwell_s, sides.after.dwell_s) >= DWELL_MIN_S:
        return Verdict.CLOSE
    if not transition.progress >= MISSED_BELOW:
        return Verdict.MISSED
    return Verdict.MEASURED if transition.found else Verdict.CLOSE


def _lag_distances_m(
    smooth: SmoothTrack,
    changes: Sequence[Change | None],
    transitions: Sequence[Transition],
    sides: Sequence[Sides],
) -> list[float | None]:
    """Return step less boundary; None where a window would reach over a neighbouring change."""
    if not changes:
        return []
    track = smooth.track
    nan = float("nan")
    closed_before = np.array([each is not None and each.before_l_ha == 0.0 for each in changes])
    closed_after = np.array([each is not None and each.after_l_ha == 0.0 for each in changes])
    boundary_m = np.array([nan if each is None else each.distance_m for each in changes])
    begins_s = np.array([each.begin_s for each in transitions])
    settles_s = np.array([each.settled_s for each in transitions])
    floors_s = np.concatenate(([track.time_s[0]], settles_s[:-1]))
    ceilings_s = np.concatenate((begins_s[1:], [track.time_s[-1]]))
    # What the border holds bounds a line as a neighbouring change does.
    floors_s = np.maximum(floors_s, [each.floor_s for each in sides])
    ceilings_s = np.minimum(ceilings_s, [each.ceiling_s - track.period_s for each in sides])
    before = _lines(smooth, begins_s, np.minimum(floors_s, begins_s), closed_before)
    after = _lines(smooth, settles_s, np.maximum(ceilings_s, settles_s), closed_after)
    rise_ml = after.volume_ml - before.volume_ml
    rise_ml += before.slope_ml_m * before.distance_m - after.slope_ml_m * after.distance_m
    bend = before.slope_ml_m - after.slope_ml_m
    steps_m = np.divide(rise_ml, bend, out=np.full(len(bend), nan), where=bend != 0.0)
    return [None if np.isnan(lag_m) else lag_m for lag_m in (steps_m - boundary_m).tolist()]


def _lines(smooth: SmoothTrack, near_s: Floats, far_s: Floats, closed: Bools) -> _Lines:
    """Return the lines of the flow between changes (`near_s`) and their neighbours (`far_s`)."""
    track = smooth.track
    away_s = np.where(far_s > near_s, track.period_s, -track.period_s)
    # The smoothing reaches one period to each side of both points.
    periods = np.minimum(np.trunc((far_s - near_s) / away_s) - 2.0, PERIODS_MAX)
    anchors_s = near_s + away_s
    ends_s = np.sort(np.stack((anchors_s, anchors_s + periods * away_s)), axis=0)
    slopes = smooth.doses_between(ends_s[0], ends_s[1])
    slopes[periods < PERIODS_MIN] = np.nan
    return _Lines(
        distance_m=np.where(
            closed, track.at(track.distance_m, near_s), track.at(smooth.distance_m, anchors_s)
        ),
        volume_ml=np.where(
            closed, track.at(track.volume_ml, near_s), track.at(smooth.volume_ml, anchors_s)
        ),
        slope_ml_m=np.where(closed, 0.0, slopes),
    )


def _is_saturated(
    orders: Sequence[TimedChange],
    duty_limits: tuple[float, float],
    stretch: Run,
    doses_ml_m: Sequence[float],
) -> bool:
    """Return whether a stretch's duty is at a limit and its dose short of what is asked, or over.

    A valve that gives nothing is not at its limit; it does not work. A switch on or off is placed
    by the flow's own level and needs no limit.
    """
    middle_s = stretch.start_s + 0.5 * stretch.dwell_s
    number = bisect_right(orders, middle_s, key=lambda order: order.at_s)
    asked, given = doses_ml_m
    if not number:
        return False
    duty = orders[number - 1].duty
    short = duty >= duty_limits[1] and DRY_BELOW < given / asked < 1.0 - SATURATED_ERROR
    over = 0.0 < duty <= duty_limits[0] and given > asked * (1.0 + SATURATED_ERROR)
    return short or over
