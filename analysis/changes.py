"""Where the prescription changes under a strip: runs of one zone, stretches of one rate, changes.

Found on the true path, not on what the controller believed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from analysis.track import Bools, Floats, Places, Track, in_field
from analysis.zone_lookup import PIECE, lookup_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from companion.core.prescription import Prescription

Ints = NDArray[np.int64]

# The state outside the field; zones there are nobody's business.
OUTSIDE = -1
# From 0.1 m to 0.01 mm.
BISECTIONS = 14
# Below this speed nothing is a change: the aircraft turns or hovers.
SPEED_MIN_M_S = 0.5
# What is shorter is a digitising error between two zones, not a zone.
SLIVER_M = 0.05
SLIVER_S = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """A part of the track with one state under the strip's centre.

    `rate_l_ha` is 0 where nothing is prescribed. `inside` says whether the field is there.
    """

    start_s: float
    end_s: float
    start_m: float
    end_m: float
    inside: bool
    rate_l_ha: float
    zones: frozenset[int]

    @property
    def dwell_s(self) -> float:
        """Return how long the strip is over it."""
        return self.end_s - self.start_s


@dataclass(frozen=True, slots=True, kw_only=True)
class Change:
    """One change of rate under one valve's strip; `border` where the field begins or ends."""

    valve: int
    time_s: float
    distance_m: float
    before_l_ha: float
    after_l_ha: float
    speed_m_s: float
    border: bool

    @property
    def relative(self) -> float:
        """Return |new - old| / old; infinite from 0."""
        if not self.before_l_ha > 0.0:
            return float("inf")
        return abs(self.after_l_ha - self.before_l_ha) / self.before_l_ha


def bisect(holds: Callable[[Floats], Bools], low_s: Floats, high_s: Floats) -> Floats:
    """Return when `holds`, true at `low_s` and false at `high_s`, ends; `low_s` may be later."""
    low, high = low_s.copy(), high_s.copy()
    if not len(low):
        return low
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        still = holds(middle)
        low, high = np.where(still, middle, low), np.where(still, high, middle)
    return 0.5 * (low + high)


class _States:
    """Numbers for what is under a track: in the field or not, and which zones."""

    def __init__(self, track: Track, prescription: Prescription) -> None:
        self.track = track
        self.prescription = prescription
        self.lookup = lookup_of(prescription)

    def at(self, places: Places) -> Ints:
        """Return the number of the state under the strip's centre."""
        inside = in_field(self.prescription, places.east_m, places.north_m)
        index = np.flatnonzero(inside & self.track.on_line(places))
        states = np.full(len(inside), OUTSIDE)
        states[index] = self.lookup.keys(places.east_m[index], places.north_m[index])
        return states

    def along(self, marked: Places) -> Ints:
        """Return the states at all marks; where no edge is near, one of a piece says all."""
        if self.track.planned is not None:
            return self.at(marked)
        count = len(marked.time_s)
        asked = np.ones(count, dtype=np.bool_)
        clear = np.flatnonzero(self.lookup.constant(marked.east_m, marked.north_m)) * PIECE
        asked[(clear[:, np.newaxis] + np.arange(1, PIECE)).ravel()] = False
        which = np.maximum.accumulate(np.where(asked, np.arange(count), 0))
        numbers = np.cumsum(asked) - 1
        found: Ints = self.at(marked.some(np.flatnonzero(asked)))[numbers[which]]
        return found

    def run(self, state: int, start_s: float, end_s: float) -> Run:
        """Return the run of a state between two times."""
        inside = state != OUTSIDE
        zones = self.lookup.zones(state) if inside else frozenset()
        rate = self.prescription.rate_of(zones) if inside else None
        return Run(
            start_s=start_s,
            end_s=end_s,
            start_m=self.track.value(self.track.distance_m, start_s),
            end_m=self.track.value(self.track.distance_m, end_s),
            inside=inside,
            rate_l_ha=0.0 if rate is None else rate,
            zones=zones,
        )


def find_runs(track: Track, prescription: Prescription) -> list[Run]:
    """Return the runs along a track, without gaps between them."""
    states = _States(track, prescription)
    marked = track.marked()
    marks_s = marked.time_s
    found = states.along(marked)
    turns = np.flatnonzero(found[1:] != found[:-1])
    before = found[turns]
    edges_s = bisect(
        lambda t: states.at(track.places(t)) == before, marks_s[turns], marks_s[turns + 1]
    )
    ends_s = [float(marks_s[0]), *edges_s.tolist(), float(marks_s[-1])]
    numbers = [*before.tolist(), int(found[-1])]
    runs = [
        states.run(number, start_s, end_s)
        for number, (start_s, end_s) in zip(numbers, pairwise(ends_s), strict=True)
    ]
    return _merged(_without_slivers(runs), key=lambda run: (run.inside, run.zones))


def stretches_of(runs: Sequence[Run]) -> list[Run]:
    """Return the runs with neighbours of one rate made one."""
    return _merged(runs, key=lambda run: (run.inside, run.rate_l_ha))


def changes_of(track: Track, stretches: Sequence[Run]) -> list[Change | None]:
    """Return the change at the end of each stretch but the last; None where there is none.

    None stands for a border without a rate on its inner side, and for a standing aircraft.
    """
    return [_change(track, before, after) for before, after in pairwise(stretches)]


def _change(track: Track, before: Run, after: Run) -> Change | None:
    speed_m_s = track.value(track.speed_m_s, after.start_s)
    if before.rate_l_ha == after.rate_l_ha or not speed_m_s > SPEED_MIN_M_S:
        return None
    return Change(
        valve=track.valve,
        time_s=after.start_s,
        distance_m=after.start_m,
        before_l_ha=before.rate_l_ha,
        after_l_ha=after.rate_l_ha,
        speed_m_s=speed_m_s,
        border=before.inside != after.inside,
    )


def _without_slivers(runs: Sequence[Run]) -> list[Run]:
    """Return the runs with those too short for a zone given to the run before them."""
    kept: list[Run] = []
    for i, run in enumerate(runs):
        short = run.end_m - run.start_m < SLIVER_M and run.dwell_s < SLIVER_S
        if short and kept and i < len(runs) - 1:
            kept[-1] = replace(kept[-1], end_s=run.end_s, end_m=run.end_m)
        else:
            kept.append(run)
    return kept


def _merged(runs: Iterable[Run], *, key: Callable[[Run], object]) -> list[Run]:
    """Return the runs with neighbours of one key made one."""
    merged: list[Run] = []
    for run in runs:
        if merged and key(merged[-1]) == key(run):
            merged[-1] = replace(merged[-1], end_s=run.end_s, end_m=run.end_m)
        else:
            merged.append(run)
    return merged
