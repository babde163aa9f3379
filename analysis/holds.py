"""Where a valve's flow says nothing of the rate: it is held closed, or nobody knows it.

A strip that comes too near to the border or to a hole is switched off, by order, until it is clear
again; so is one over ground that was treated before. A rate that is judged by its flow is judged by
what is left of its stretch: else a rate of which a pond takes the second half counts as half a
rate, and a change that came to the centimetre as missed, or as metres late. A time of which the
record is missing is no better.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from analysis.flight_record import joined
from analysis.strips import given_by
from analysis.transitions import LEVEL_FROM, LEVEL_TO, ML_M_PER_L_HA_M, Sides

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from analysis.changes import Run
    from analysis.flight_record import Orders
    from analysis.track import Bools, Floats, Ints, Track
    from analysis.transitions import SmoothTrack
    from companion.core.prescription import Prescription

# A controller may keep a strip closed whose end comes this near to the border.
CLEAR_M = 0.2
# So much earlier and later than the strip is that near may the border be the reason.
BESIDE_S = 0.5
# The flow is back at half of what is asked within this of its order; later is no border's fault.
BACK_S = 1.0
# The smoothing of the flow reaches one period, the debt of a truncated pulse a little more.
SETTLES_PERIODS = 1.35


@dataclass(frozen=True, slots=True, kw_only=True)
class Hold:
    """A time in which a valve is closed by order and its strip reaches over the border, or nearly.

    From the order that closes it to the order that opens it, or `BESIDE_S` around the border. Or
    one of which nothing is known.
    """

    start_s: float
    end_s: float


class _Free(NamedTuple):
    """What the border leaves of a stretch: next to its start and next to its end.

    None where the valve is held at that end of the stretch.
    """

    first: Run | None
    last: Run | None


def holds_of(
    track: Track,
    prescription: Prescription,
    stretches: Sequence[Run],
    orders: Orders,
    spared: Bools,
) -> tuple[Hold, ...]:
    """Return the holds of one valve where something is prescribed; `orders` are that valve's.

    `spared` is where, at the marks, its strip was treated before.
    """
    if not orders:
        return ()
    at_s, duty = orders.at_s, orders.duty
    marks_s = track.time_s[track.marks]
    given, is_closed = given_by(orders, marks_s)
    starts_s = np.array([run.start_s for run in stretches])
    under = np.clip(np.searchsorted(starts_s, marks_s, "right") - 1, 0, None)
    inside = np.array([run.inside for run in stretches])[under]
    asks = np.array([run.inside and run.rate_l_ha > 0.0 for run in stretches])[under]
    index = np.flatnonzero(is_closed & asks)
    # Straight up to a border no end of the strip comes near it before its middle is beyond.
    by_border = ~(inside[np.maximum(index - 1, 0)] & inside[np.minimum(index + 1, len(inside) - 1)])
    clear = track.wholly_inside(prescription, track.sampled(track.marks[index]), widen_m=CLEAR_M)
    near = index[by_border | ~clear | spared[index]]
    # Orders of 0 upon orders of 0 open nothing: a closed time is known by the last that opened.
    opened = np.concatenate(([0], np.cumsum(duty > 0.0)))[given]
    return tuple(_spans(marks_s, near, opened, at_s, duty))


def _spans(marks_s: Floats, near: Ints, opened: Ints, at_s: Floats, duty: Floats) -> Iterator[Hold]:
    """Yield one span for all marks of one closed time that lie near each other."""
    if not len(near):
        return
    opens_s = at_s[duty > 0.0]
    breaks = (np.diff(marks_s[near]) > 2.0 * BESIDE_S) | (np.diff(opened[near]) > 0)
    firsts = np.concatenate(([0], np.flatnonzero(breaks) + 1))
    lasts = np.concatenate((np.flatnonzero(breaks), [len(near) - 1]))
    for first, last in zip(near[firsts].tolist(), near[lasts].tolist(), strict=True):
        number = int(opened[first])
        end_s = float(opens_s[number]) if number < len(opens_s) else np.inf
        after = int(np.searchsorted(at_s, opens_s[number - 1], "right")) if number else 0
        start_s = float(at_s[after]) if number and after < len(at_s) else -np.inf
        yield Hold(
            start_s=max(start_s, float(marks_s[first]) - BESIDE_S),
            end_s=min(end_s, float(marks_s[last]) + BESIDE_S),
        )


def with_unknown(holds: Sequence[Hold], unknown: Sequence[tuple[float, float]]) -> tuple[Hold, ...]:
    """Return the holds and the times of which nothing is known, in order and apart."""
    if not unknown:
        return tuple(holds)
    every = joined([*((hold.start_s, hold.end_s) for hold in holds), *unknown])
    return tuple(Hold(start_s=start_s, end_s=end_s) for start_s, end_s in every)


def sides_of(smooth: SmoothTrack, stretches: Sequence[Run], holds: Sequence[Hold]) -> list[Sides]:
    """Return for each pair of neighbouring stretches what of them a change is judged by."""
    free = [_Free(run, run) for run in stretches]
    if holds:
        starts_s = np.array([hold.start_s for hold in holds])
        ends_s = np.array([hold.end_s for hold in holds])
        for i, run in enumerate(stretches):
            first = int(np.searchsorted(ends_s, run.start_s, "right"))
            last = int(np.searchsorted(starts_s, run.end_s, "left"))
            if run.inside and run.rate_l_ha > 0.0 and first < last:
                free[i] = _free_of(smooth, stretches, i, holds[first:last])
    return [
        _sides((stretches[i], stretches[i + 1]), left.last, right.first)
        for i, (left, right) in enumerate(pairwise(free))
    ]


def _sides(whole: tuple[Run, Run], before: Run | None, after: Run | None) -> Sides:
    is_cut = (before is not whole[0], after is not whole[1])
    left, right = before or whole[0], after or whole[1]
    return Sides(
        before=left,
        after=right,
        held=before is None or after is None,
        floor_s=left.start_s if is_cut[0] else -np.inf,
        ceiling_s=right.end_s if is_cut[1] else np.inf,
    )


def _free_of(
    smooth: SmoothTrack, stretches: Sequence[Run], number: int, holds: Sequence[Hold]
) -> _Free:
    """Return what holds leave of a stretch.

    What is held next to a border, or to a rate of 0, is the switch that belongs there; it counts
    here only where it reaches into the time by which the stretch is judged.
    """
    run = stretches[number]
    opens = number == 0 or not stretches[number - 1].rate_l_ha > 0.0
    closes = number + 1 == len(stretches) or not stretches[number + 1].rate_l_ha > 0.0
    level_s = (run.start_s + LEVEL_FROM * run.dwell_s, run.start_s + LEVEL_TO * run.dwell_s)
    its = [hold for hold in holds if not _is_switch(hold, run, level_s, opens=opens, closes=closes)]
    if not its:
        return _Free(run, run)
    # A switch at an end of the stretch is judged by what is free next to it.
    edges_s = [run.start_s, *(s for hold in its for s in (hold.start_s, hold.end_s)), run.end_s]
    gaps = [(low_s, high_s) for low_s, high_s in zip(edges_s[::2], edges_s[1::2], strict=True)]
    parts = [_part(smooth, run, *gap) if gap[1] > gap[0] else None for gap in gaps]
    there = [part for part in parts if part is not None]
    if not there:
        return _Free(run if opens else None, run if closes else None)
    return _Free(there[0] if opens else parts[0], there[-1] if closes else parts[-1])


def _is_switch(
    hold: Hold, run: Run, level_s: tuple[float, float], *, opens: bool, closes: bool
) -> bool:
    """Return whether a hold is but the switch with which a stretch begins or ends."""
    at_start = opens and hold.start_s <= run.start_s and hold.end_s <= level_s[0]
    return at_start or (closes and hold.end_s >= run.end_s and hold.start_s >= level_s[1])


def _part(smooth: SmoothTrack, run: Run, start_s: float, end_s: float) -> Run | None:
    """Return a part of a stretch; behind a hold it begins when the flow is back."""
    track = smooth.track
    if start_s > run.start_s:
        last = track.sample(min(start_s + BACK_S, end_s)) + 1
        first = track.sample(start_s)
        half = 0.5 * run.rate_l_ha * ML_M_PER_L_HA_M * track.across_m[first:last]
        back = np.flatnonzero(smooth.dose_ml_m[first:last] >= half)
        if len(back):
            start_s = float(track.time_s[first + back[0]]) + SETTLES_PERIODS * track.period_s
    if not start_s < end_s:
        return None
    return replace(
        run,
        start_s=start_s,
        end_s=end_s,
        start_m=track.value(track.distance_m, start_s),
        end_m=track.value(track.distance_m, end_s),
    )
