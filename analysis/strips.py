"""Everything about one strip that more than one metric needs, computed once.

Where a valve was rightly closed because its strip was treated before. A guard
(`coverage.switch_off_percent`) closes valves over treated ground. What it spares was not to be
sprayed: nothing is asked for there, and no change is missed. As everything here it is found from
the truth, the liquid that fell, and not from what the controller took for treated. A valve that is
closed where nothing fell before has no such excuse.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from analysis.changes import Run, find_all_runs, stretches_of
from analysis.flight_record import Orders
from analysis.track import Bools, Floats, Ints, Track, tracks_of
from analysis.transitions import ML_M_PER_L_HA_M

if TYPE_CHECKING:
    from collections.abc import Sequence

    from analysis.flight_record import FlightRecord
    from companion.core.prescription import Prescription

# Ground is treated in squares of this, looked at in so many metres across a strip, and a valve that
# gives less than this part of its usual dose treats none.
SQUARE_M, ACROSS_M, TREATS_FROM = 0.2, 0.14, 0.2
# The guard's own squares are as large: of a strip's width so much may be bare and count as treated.
SLACK_M = 0.2
_OFFSET = 2**31


def closed_by_order(orders: Orders, at_s: Floats) -> Bools:
    """Return at which times a valve is closed by its orders; before the first it is."""
    return _are_closed(orders, np.searchsorted(orders.at_s, at_s, "right"))


def given_by(orders: Orders, marks_s: Floats) -> tuple[Ints, Bools]:
    """Return how many orders were given by each of times in order, and where they close a valve."""
    # Fewer orders are sought among the marks than marks among the orders.
    first = np.searchsorted(marks_s, orders.at_s)
    given: Ints = np.bincount(first, minlength=len(marks_s) + 1)[:-1].cumsum()
    return given, _are_closed(orders, given)


def _are_closed(orders: Orders, given: Ints) -> Bools:
    duty = np.concatenate(([0.0], orders.duty))
    closed: Bools = ~(duty > 0.0)[given]
    return closed


def spared_of(
    record: FlightRecord, tracks: Sequence[Track], orders: Sequence[Orders]
) -> list[Bools]:
    """Return for each track, at its marks, whether its valve is spared; nowhere without a guard."""
    guard = record.guard
    if guard is None:
        return [np.zeros(len(track.marks), dtype=np.bool_) for track in tracks]
    ground = _Treated(record, tracks)
    found = []
    for track, own in zip(tracks, orders, strict=True):
        least = guard.switch_off_percent / 100.0 - SLACK_M / track.width_m
        treated = ground.share(track, guard.fresh_s) >= max(least, 0.05)
        closed = closed_by_order(own, track.time_s[track.marks])
        found.append(_mostly(treated, closed))
    return found


def _mostly(treated: Bools, closed: Bools) -> Bools:
    """Return the treated stretches on most of which the valve is closed: lags are at their ends."""
    found = treated.copy()
    edges = np.flatnonzero(np.diff(treated, prepend=False, append=False))
    for first, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        found[first:end] = bool(closed[first:end].mean() > 0.5)
    return found


class _Treated:
    """When each square of the ground was treated for the first time."""

    def __init__(self, record: FlightRecord, tracks: Sequence[Track]) -> None:
        self._before = record.treated
        keys, times_s = [np.empty(0, dtype=np.int64)], [np.empty(0)]
        for track in tracks:
            marks = track.marks[_treats(track)]
            east_m, north_m = _across(track, marks)
            keys.append(_keys(east_m, north_m).ravel())
            times_s.append(np.repeat(track.time_s[marks], east_m.shape[1]))
        every, at_s = np.concatenate(keys), np.concatenate(times_s)
        order = np.argsort(at_s, kind="stable")
        self._keys, first = np.unique(every[order], return_index=True)
        self._first_s = at_s[order][first]

    def share(self, track: Track, fresh_s: float) -> Floats:
        """Return which part of a strip was treated more than `fresh_s` ago, at its marks."""
        east_m, north_m = _across(track, track.marks)
        keys = _keys(east_m, north_m)
        at = np.minimum(np.searchsorted(self._keys, keys), max(len(self._keys) - 1, 0))
        old_s = track.time_s[track.marks][:, None] - fresh_s
        done = np.zeros(keys.shape, dtype=np.bool_)
        if len(self._keys):
            done = (self._keys[at] == keys) & (self._first_s[at] < old_s)
        if self._before is not None:
            done |= self._before.covered_at(east_m, north_m)
        share: Floats = done.mean(axis=1)
        return share


def _treats(track: Track) -> Bools:
    """Return at which marks the valve gives what it usually gives, or a good part of it."""
    metres = np.gradient(track.distance_m[track.marks])
    dose = np.gradient(track.volume_ml[track.marks]) / np.maximum(metres, 1e-6)
    some = dose[(dose > 1e-6) & (metres > 1e-3)]
    usual = float(np.median(some)) if len(some) else np.inf
    treats: Bools = dose > TREATS_FROM * usual
    return treats


def _across(track: Track, marks: Ints) -> tuple[Floats, Floats]:
    """Return places across the strip, a row a mark."""
    count = max(int(np.ceil(track.width_m / ACROSS_M)), 3)
    aside_m = ((np.arange(count) + 0.5) / count - 0.5) * track.width_m
    heading = track.heading_rad[marks][:, None]
    east_m = track.east_m[marks][:, None] + np.cos(heading) * aside_m
    north_m = track.north_m[marks][:, None] - np.sin(heading) * aside_m
    return east_m, north_m


def _keys(east_m: Floats, north_m: Floats) -> Ints:
    """Return one number for the square of each place."""
    column, row = (np.floor(each / SQUARE_M).astype(np.int64) for each in (east_m, north_m))
    keys: Ints = (column + _OFFSET) * 2**32 + (row + _OFFSET)
    return keys


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
    orders: Orders
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
        found[self.spared_at(time_s)] = 0.0
        return found

    def spared_at(self, time_s: Floats) -> Bools:
        """Return where nothing is asked for, as the ground was treated before, at any times."""
        if not self.spared.any():
            return np.zeros(len(time_s), dtype=np.bool_)
        before, after = self._marks_around(time_s)
        return self.spared[before] & self.spared[after]

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
    every = Orders.of(record.orders)
    orders = [every.of_valve(valve) for valve in range(len(record.boom.valves))]
    tracks = tracks_of(record)
    spared = spared_of(record, tracks, orders)
    runs = find_all_runs(tracks, record.prescription)
    return [
        _strip(track, record, each, its, own)
        for track, each, its, own in zip(tracks, runs, orders, spared, strict=True)
    ]


def _strip(
    track: Track, record: FlightRecord, runs: list[Run], orders: Orders, spared: Bools
) -> Strip:
    stretches = stretches_of(runs)
    whole, grazing = _inside(track, record.prescription)
    return Strip(
        track=track,
        runs=tuple(runs),
        stretches=tuple(stretches),
        orders=orders,
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
