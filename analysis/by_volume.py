"""How late a change was whose neighbours are too near for lines: by the volume around it.

What fell from the middle of one stretch to the middle of the next, less what a step on its boundary
would have dropped there, over the step of the dose, is how late the step was. How much of the asked
dose falls at all (a valve gives 2 % more, a map asks for what the range does not have) is fitted
over the changes around it, with the lag that they share. The middles are late by that lag too, so
that what belongs to the neighbours stays there.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from analysis.transitions import doses_per_rate_ml_m

if TYPE_CHECKING:
    from collections.abc import Sequence

    from analysis.changes import Change
    from analysis.track import Bools, Floats
    from analysis.transitions import Sides, SmoothTrack

# Both stretches last this many periods, as smoothing reaches one to each side of a middle, and at
# most so many of each are looked at.
PERIODS_MIN, PERIODS_MAX = 2.2, 5.0
# Dose and shared lag are of so many changes before and after it, and of no fewer.
CHANGES, CHANGES_MIN = 50, 4
# A change tells the dose as badly as its own lag is scattered [m], and as its dose has noise.
SCATTER_M, NOISE = 0.2, 0.01
ROUNDS = 5
# Where less than this of both doses falls at a middle, the valve was not open there.
OPEN_FROM = 0.5
# Where the strip gets narrower than this, it turns: what it drops there says nothing of a change.
STRAIGHT_FROM = 0.9
DRY_BELOW = 0.02


def late_by_volume(
    smooth: SmoothTrack, changes: Sequence[Change | None], sides: Sequence[Sides]
) -> dict[int, tuple[float, float]]:
    """Return by its number how late each change in the field was, and the way that says so [m].

    + is too late. Not of a change next to a stretch that is too short, held, or never opened.
    """
    track = smooth.track
    told = [
        (i, each.time_s, each.distance_m, each.before_l_ha, each.after_l_ha, each.speed_m_s,
         its.before.dwell_s, its.after.dwell_s)
        for i, (each, its) in enumerate(zip(changes, sides, strict=True))
        if each is not None and not (each.border or its.held)
        and min(its.before.dwell_s, its.after.dwell_s) >= PERIODS_MIN * track.period_s
    ]  # fmt: skip
    number, at_s, at_m, *rates, speed_m_s, before_s, after_s = np.array(told).reshape(-1, 8).T
    before, after = (doses_per_rate_ml_m(track, at_s) * rate for rate in rates)
    most_s, step = PERIODS_MAX * track.period_s, before - after
    middles_s = np.stack((
        at_s - np.minimum(0.5 * before_s, most_s), at_s + np.minimum(0.5 * after_s, most_s)
    ))  # fmt: skip
    late_m, way_m = np.full((2, len(at_s)), np.nan)
    for _ in range(2):
        usual_m = np.nanmedian(late_m) if np.isfinite(late_m).any() else 0.0
        ends_s = middles_s + usual_m / speed_m_s
        from_m, to_m = track.at(smooth.distance_m, ends_s)
        given: Floats = np.diff(track.at(smooth.volume_ml, ends_s), axis=0)[0]
        asked = before * (at_m - from_m) + after * (to_m - at_m)
        least, across_m = OPEN_FROM * np.minimum(before, after), track.at(track.across_m, ends_s)
        is_open = np.all(smooth.dose_ml_m[track.samples(ends_s)] >= least, axis=0) & (asked > 0.0)
        is_open &= across_m.min(axis=0) >= STRAIGHT_FROM * across_m.max(axis=0)
        late_m, way_m = _late_m(number, is_open, np.stack((given, asked, step))), to_m - from_m
    is_told = np.isfinite(late_m)
    values = zip(late_m[is_told].tolist(), way_m[is_told].tolist(), strict=True)
    return dict(zip(number[is_told].astype(int).tolist(), values, strict=True))


def _late_m(number: Floats, is_open: Bools, volumes: Floats) -> Floats:
    """Return how late each change was; NaN where it is not told. given = k (asked + step late)."""
    found = np.full(len(number), np.nan)
    given, asked, step = volumes
    with np.errstate(divide="ignore", invalid="ignore"):
        weighted = volumes / (SCATTER_M * np.abs(step) + NOISE * asked)
    for i in np.flatnonzero(is_open).tolist():
        near = is_open & (np.abs(number - number[i]) <= CHANGES)
        if near.sum() >= CHANGES_MIN:
            share = _share(weighted[1:, near].T, weighted[0, near])
            if share > DRY_BELOW:
                found[i] = (given[i] / share - asked[i]) / step[i]
    return found


def _share(terms: Floats, given: Floats) -> float:
    """Return how much of the asked volumes fell; a few that are far off hardly count.

    Least squares, each time with less weight for what was far off (Cauchy's).
    """
    found = np.array([np.median(given / terms[:, 0]), 0.0])
    for _ in range(ROUNDS):
        off = np.abs(given - terms @ found)
        trust = 1.0 / np.sqrt(1.0 + (off / max(float(np.median(off)), 1e-9)) ** 2)
        found = np.linalg.lstsq(terms * trust[:, np.newaxis], given * trust, rcond=None)[0]
    return float(found[0])
