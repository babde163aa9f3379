"""When the flow of one valve goes from one level to the next, and when it has settled.

The levels are the flow's own, not the prescribed ones: a valve that delivers 2 % too much has not
missed a change. Everything is volume per metre of track, so that a change of speed is no change.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from analysis.track import Floats, Track, rise_over, smoothed

if TYPE_CHECKING:
    from collections.abc import Sequence

    from analysis.changes import Change, Run

# 1 L/ha on 1 m of width is 0.1 mL per metre of track.
ML_M_PER_L_HA_M = 0.1
# On-time that a truncated period owes is paid in the next one, which draws a sharp step out by up
# to this many periods more; only what is longer than that is a slow plant.
DEBT_PERIODS = 1.0
# Where in the time over a stretch its flow counts as its own: late changes have come, early ones
# of the next stretch have not.
LEVEL_FROM = 0.50
LEVEL_TO = 0.88
# A change is looked for between the usual doses of its stretches, their medians: a dip of the dose
# while the aircraft brakes moves the mean, and a step of 10 % was then found in the dip. Medians
# that differ by less than this of what is asked do not tell where it was.
USUAL_STEP_MIN = 0.25
# Up to so many periods beside a change, from so many on, say how sharp it is: a flow that drifts
# on for seconds after a sharp step makes it no slow one.
BESIDE_PERIODS = 20
BESIDE_FROM_PERIODS = 1.5
BESIDE_PERIODS_MIN = 3
# No change is looked for earlier than this before its boundary.
SEARCH_BEFORE_S = 2.0
# A sharp step, smoothed by three means over one period, passes a quarter and three quarters of
# its height this many periods from each other, and lies in the middle between.
SHARP_QUARTERS_PERIODS = 0.68
# Over less than this a strip stands, and has no dose.
MOVED_M = 0.01


class Transition(NamedTuple):
    """The flow leaves one level after `begin_s` and is at the next one before `settled_s`.

    `levels_ml_m` are the doses before and after. `progress` is how much of the prescribed step
    they differ by: 1 is all of it.
    """

    begin_s: float
    middle_s: float
    settled_s: float
    progress: float
    levels_ml_m: tuple[float, float]
    found: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Sides:
    """The stretches before and after a change, or what the border leaves of them by its holds.

    `held` says that the valve is held closed at the change itself, on one side or on both;
    `floor_s` and `ceiling_s` are the holds that no measurement of the change may reach into.
    """

    before: Run
    after: Run
    held: bool = False
    floor_s: float = -math.inf
    ceiling_s: float = math.inf


class SmoothTrack:
    """The track's volume and distance, each smoothed alike: a constant dose stays a line."""

    def __init__(self, track: Track) -> None:
        self.track = track
        self.volume_ml = smoothed(track.volume_ml, track.period_steps)
        self.distance_m = smoothed(track.distance_m, track.period_steps)
        rise_m = rise_over(self.distance_m, track.period_steps)
        rise_ml = rise_over(self.volume_ml, track.period_steps)
        moving = rise_m > 0.1 * track.period_s
        self.metres: Floats = np.diff(self.distance_m, append=self.distance_m[-1])
        self.dose_ml_m: Floats = np.divide(rise_ml, rise_m, out=np.zeros_like(rise_m), where=moving)
        self.is_sound = not np.isnan(self.dose_ml_m).any()

    def doses_between(self, start_s: Floats, end_s: Floats) -> Floats:
        """Return the mean doses between pairs of times; 0 where the strip stands."""
        ends_s = np.stack((start_s, end_s))
        metres, volumes_ml = (
            np.diff(self.track.at(values, ends_s), axis=0)[0]
            for values in (self.distance_m, self.volume_ml)
        )
        doses: Floats = np.divide(
            volumes_ml, metres, out=np.zeros(len(metres)), where=metres > MOVED_M
        )
        return doses


def levels_of(smooth: SmoothTrack, stretches: Sequence[Run]) -> list[float]:
    """Return the dose [mL/m] that the flow had in each stretch; outside the field it is 0."""
    starts_s = np.array([stretch.start_s for stretch in stretches])
    dwells_s = np.array([stretch.dwell_s for stretch in stretches])
    found = smooth.doses_between(starts_s + LEVEL_FROM * dwells_s, starts_s + LEVEL_TO * dwells_s)
    inside = np.array([stretch.inside for stretch in stretches], dtype=np.bool_)
    return [float(level) for level in np.where(inside, found, 0.0)]


def usual_doses_of(smooth: SmoothTrack, stretches: Sequence[Run]) -> list[float]:
    """Return the dose [mL/m] that the flow mostly had in each stretch; 0 outside the field."""
    starts_s = np.array([stretch.start_s for stretch in stretches])
    dwells_s = np.array([stretch.dwell_s for stretch in stretches])
    firsts = smooth.track.samples(starts_s + LEVEL_FROM * dwells_s).tolist()
    lasts = smooth.track.samples(starts_s + LEVEL_TO * dwells_s).tolist()
    # A stretch stands behind one change and before the next: its median is worked out once.
    medians: dict[tuple[int, int], float] = {}
    found = []
    for stretch, first, last in zip(stretches, firsts, lasts, strict=True):
        if not stretch.inside:
            found.append(0.0)
            continue
        level = medians.get((first, last))
        if level is None:
            level = medians[first, last] = _median(smooth, first, last + 1)
        found.append(level)
    return found


def _median(smooth: SmoothTrack, first: int, end: int) -> float:
    """Return the median dose as numpy does, in a tenth of its time for some hundred values."""
    values = smooth.dose_ml_m[first:end]
    last = len(values) // 2
    if not len(values) or not (smooth.is_sound or not np.isnan(values).any()):
        return math.nan
    values = values.copy()
    if len(values) % 2:
        values.partition(last)
        return values.item(last)
    values.partition((last - 1, last))
    return 0.5 * (values.item(last - 1) + values.item(last))


def doses_per_rate_ml_m(track: Track, time_s: Floats) -> Floats:
    """Return the volume per metre of track that 1 L/ha asks of a strip, at many times."""
    return track.each_value(track.across_m, time_s) * ML_M_PER_L_HA_M


def find_transitions(
    smooth: SmoothTrack, sides: Sequence[Sides], changes: Sequence[Change | None]
) -> list[Transition]:
    """Return the transition of each pair of neighbouring stretches."""
    both = [run for each in sides for run in (each.before, each.after)]
    levels, doses = levels_of(smooth, both), usual_doses_of(smooth, both)
    places_s = [
        side.after.start_s if change is None else change.time_s
        for side, change in zip(sides, changes, strict=True)
    ]
    per_rate = doses_per_rate_ml_m(smooth.track, np.array(places_s)).tolist()
    found: list[Transition] = []
    for i, (change, at_s) in enumerate(zip(changes, places_s, strict=True)):
        before, after = sides[i].before, sides[i].after
        early_s = max(before.start_s, before.end_s - SEARCH_BEFORE_S)
        if found:
            early_s = max(early_s, found[-1].middle_s)
        late_s = after.start_s + 0.5 * after.dwell_s if not after.inside else after.end_s
        pair = (levels[2 * i], levels[2 * i + 1])
        if change is None or sides[i].held:
            found.append(_nominal(smooth.track, at_s, 0.0, pair))
            continue
        asked = per_rate[i] * (after.rate_l_ha - before.rate_l_ha)
        progress = (pair[1] - pair[0]) / asked
        if progress > 0.0 and late_s - early_s > smooth.track.step_s:
            usual = (doses[2 * i], doses[2 * i + 1])
            is_told = (usual[1] - usual[0]) / asked >= USUAL_STEP_MIN
            times_s = _located(smooth, usual if is_told else pair, early_s, late_s)
            found.append(Transition(*times_s, progress, pair, found=True))
        else:
            found.append(_nominal(smooth.track, at_s, progress, pair))
    return found


def _nominal(track: Track, at_s: float, progress: float, levels: tuple[float, float]) -> Transition:
    """Return a stand-in around the boundary, for neighbours' windows to keep off."""
    return Transition(
        begin_s=at_s - track.period_s,
        middle_s=at_s,
        settled_s=at_s + 3.0 * track.period_s,
        progress=progress,
        levels_ml_m=levels,
        found=False,
    )


def _located(
    smooth: SmoothTrack, levels: tuple[float, float], early_s: float, late_s: float
) -> tuple[float, float, float]:
    """Return when the transition between two levels in a span of time begins, is, and has settled.

    Its middle is the change point of greatest likelihood for known levels: where the integral of
    what the flow has done of the step, less one half, is least. Clipped to the two levels, so that
    a third one, of a neighbour that comes early, does not draw it away.
    """
    track = smooth.track
    first, last = track.sample(early_s), track.sample(late_s) + 1
    doses = smooth.dose_ml_m[first:last]
    part = (doses - levels[0]) / (levels[1] - levels[0])
    # Arrays' own methods: of a few hundred values most of the time is to get to them.
    done = np.minimum(np.maximum(part, 0.0), 1.0) - 0.5
    middle = int((done * smooth.metres[first:last]).cumsum().argmin())
    middle_s = track.time_s.item(first + middle)
    span_s = track.time_s[first:last]
    low_s, high_s = _quarters_s(span_s, part, middle, early_s, late_s)
    slow_s = _slow_s(track, low_s, high_s)
    beside = _levels_beside(smooth, middle_s, early_s, late_s) if slow_s > 0.0 else None
    if beside is not None and (beside[1] - beside[0]) * (levels[1] - levels[0]) > 0.0:
        part = (doses - beside[0]) / (beside[1] - beside[0])
        sharp_s = _quarters_s(span_s, part, middle, early_s, late_s)
        if not _slow_s(track, *sharp_s) > 0.0:
            (low_s, high_s), slow_s = sharp_s, 0.0
    begin_s = low_s - 0.35 * track.period_s - slow_s
    return begin_s, middle_s, high_s + 1.35 * track.period_s + 3.0 * slow_s


def _quarters_s(
    time_s: Floats, part: Floats, middle: int, early_s: float, late_s: float
) -> tuple[float, float]:
    """Return when the flow last had a quarter of the step, and when it first had three quarters.

    `part` is how much of the step it has done at each time, `middle` the sample in between.
    """
    (below,) = (part[: middle + 1] <= 0.25).nonzero()
    (above,) = (part[middle:] >= 0.75).nonzero()
    low_s = time_s.item(below[-1]) if len(below) else early_s
    high_s = time_s.item(middle + above[0]) if len(above) else late_s
    return low_s, high_s


def _slow_s(track: Track, low_s: float, high_s: float) -> float:
    """Return by how much longer than a sharp step it took."""
    sharp_s = (SHARP_QUARTERS_PERIODS + DEBT_PERIODS) * track.period_s
    return max(high_s - low_s - sharp_s, 0.0)


def _levels_beside(
    smooth: SmoothTrack, middle_s: float, early_s: float, late_s: float
) -> tuple[float, float] | None:
    """Return the doses right before and after a change; None where there is no room for them."""
    period_s = smooth.track.period_s
    from_s, far_s = BESIDE_FROM_PERIODS * period_s, BESIDE_PERIODS * period_s
    starts_s = np.array([max(middle_s - far_s, early_s), middle_s + from_s])
    ends_s = np.array([middle_s - from_s, min(middle_s + far_s, late_s)])
    if not bool(np.all(ends_s - starts_s >= BESIDE_PERIODS_MIN * period_s)):
        return None
    before, after = smooth.doses_between(starts_s, ends_s).tolist()
    return before, after
