"""Everything about one strip that more than one metric needs, computed once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from analysis.changes import Run, find_runs, stretches_of
from analysis.spared import spared_of
from analysis.track import Bools, Floats, Ints, Track, tracks_of
from analysis.transitions import ML_M_PER_L_HA_M

if TYPE_CHECKING:
    from analysis.flight_record import FlightRecord
    from companion.core.prescription import Prescription
    from companion.core.types import TimedChange

# Sideways over the border by less than this is no border crossing: aircraft hold a line to some
# centimetres, and the outer strip of a field often ends on its border. What it drops there is
# counted all the same, as off target.
GRAZE_M = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class Strip:
    """A track, its runs by zone and by rate, and where it is wholly in the field.

    `whole` and `grazing` are at the track's marks: the strip lies in the field; it does so but
    for `GRAZE_M` at either end. `spared` is there, too: nothing is asked for, as the ground was
    treated before. `asked_ml` is the cumulative prescribed volume at every sample.
    """

    track: Track
    runs: tuple[Run, ...]
    stretches: tuple[Run, ...]
    orders: tuple[TimedChange, ...]
    whole: Bools
    grazing: Bools
    spared: Bools
    asked_ml: Floats

    def rates_at(self, time_s: Floats) -> Floats:
        """Return the prescribed rate under the strip's centre at times that increase.

        0 where the ground is spared.
        """
        starts_s = np.array([run.start_s for run in self.stretches[1:]])
        rates = np.array([run.rate_l_ha for run in self.stretches])
        # Few stretches are sought among many times, not each time among the stretches.
        edges = np.concatenate(([0], np.searchsorted(time_s, starts_s), [len(time_s)]))
        found: Floats = np.repeat(rates, np.diff(edges))
        if self.spared.any():
            before, after = self._marks_around(time_s)
            found[self.spared[before] & self.spared[after]] = 0.0
        return found

    def inside_at(self, time_s: Floats) -> Bools:
        """Return where the strip lies in the field, but for `GRAZE_M`, at any times."""
        before, after = self._marks_around(time_s)
        return self.grazing[before] & self.grazing[after]

    def _marks_around(self, time_s: Floats) -> tuple[Ints, Ints]:
        marks_s = self.track.time_s[self.track.marks]
        after = np.clip(np.searchsorted(marks_s, time_s), 1, len(marks_s) - 1)
        return after - 1, after


def strips_of(record: FlightRecord) -> list[Strip]:
    """Return the strips of all valves, left to right."""
    orders: list[list[TimedChange]] = [[] for _ in record.boom.valves]
    for order in record.orders:
        if order.valve < len(orders):
            orders[order.valve].append(order)
    tracks = tracks_of(record)
    spared = spared_of(record, tracks, orders)
    return [
        _strip(track, record, its, own)
        for track, its, own in zip(tracks, orders, spared, strict=True)
    ]


def _strip(track: Track, record: FlightRecord, orders: list[TimedChange], spared: Bools) -> Strip:
    runs = find_runs(track, record.prescription)
    stretches = stretches_of(runs)
    whole, grazing = _inside(track, record.prescription)
    return Strip(
        track=track,
        runs=tuple(runs),
        stretches=tuple(stretches),
        orders=tuple(orders),
        whole=whole,
        grazing=grazing,
        spared=spared,
        asked_ml=_asked_ml(track, stretches, spared),
    )


def _inside(track: Track, prescription: Prescription) -> tuple[Bools, Bools]:
    marked = track.marked()
    whole = track.wholly_inside(prescription, marked)
    grazing = whole.copy()
    index = np.flatnonzero(~whole)
    grazing[index] = track.wholly_inside(prescription, marked.some(index), widen_m=-GRAZE_M)
    return whole, grazing


def _asked_ml(track: Track, stretches: list[Run], spared: Bools) -> Floats:
    """Return the cumulative prescribed volume at every sample; exact across boundaries."""
    starts_s = np.array([run.start_s for run in stretches])
    rates = np.array([run.rate_l_ha for run in stretches])
    # All samples and all starts in one order; where each is in it is known, not to be sought.
    places = np.searchsorted(track.time_s, starts_s, "right")
    knots_s = np.insert(track.time_s, places, starts_s)
    distance_m = np.insert(track.distance_m, places, track.at(track.distance_m, starts_s))
    is_start = np.insert(np.zeros(len(track.time_s), dtype=np.bool_), places, values=True)
    rate = rates[np.clip(np.cumsum(is_start)[:-1] - 1, 0, None)]
    middle_s = 0.5 * (knots_s[1:] + knots_s[:-1])
    drops = rate * ML_M_PER_L_HA_M * track.at(track.across_m, middle_s) * np.diff(distance_m)
    if spared.any():
        after = np.searchsorted(track.time_s[track.marks], middle_s)
        after = np.clip(after, 1, len(track.marks) - 1)
        drops[spared[after - 1] & spared[after]] = 0.0
    asked: Floats = np.concatenate(([0.0], np.cumsum(drops)))[~is_start]
    return asked
