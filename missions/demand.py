"""How much a spray line needs: the rate under every valve, integrated along it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from missions.strips import Extents, Floats, directions, lengths_m, no_lines

M2_PER_HA = 10_000.0
# The rate is read at the middle of steps of this length, longer where there would be too many.
STEP_M = 1.0
POINTS_MAX = 200_000


class Rates(Protocol):
    """Whatever knows the rate at places; NaN where there is none."""

    def rates_at(self, east_m: Floats, north_m: Floats) -> Floats:
        """Return the rate at each place [L/ha]."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Uniform:
    """One rate everywhere."""

    rate_l_ha: float

    def rates_at(self, east_m: Floats, north_m: Floats) -> Floats:  # noqa: ARG002
        """Return the rate at each place [L/ha]."""
        return np.full(len(east_m), self.rate_l_ha)


@dataclass(frozen=True, slots=True, kw_only=True)
class Demand:
    """What one line needs up to each of the distances `at_m` from its start."""

    at_m: Floats
    litres: Floats

    @property
    def total_l(self) -> float:
        """Return what the whole line needs."""
        return float(self.litres[-1])

    def part(self, start_m: float, end_m: float) -> Demand:
        """Return what is needed between two distances from the start."""
        if start_m <= self.at_m[0] and end_m >= self.at_m[-1]:
            return self
        inside = (self.at_m > start_m) & (self.at_m < end_m)
        at_m = np.concatenate([[start_m], self.at_m[inside], [end_m]])
        litres = np.interp(at_m, self.at_m, self.litres)
        return Demand(at_m=at_m, litres=litres - litres[0])

    def cuts_m(self, piece_max_l: float) -> tuple[Floats, Floats]:
        """Return where to cut the line, both ends among it, and what each piece needs.

        All but the last need as much as they may, so that tanks can be emptied with them.

        >>> need = Demand(at_m=np.array([0.0, 10.0]), litres=np.array([0.0, 2.5]))
        >>> [found.tolist() for found in need.cuts_m(1.0)]
        [[0.0, 4.0, 8.0, 10.0], [1.0, 1.0, 0.5]]
        """
        count = max(1, math.ceil(self.total_l / piece_max_l - 1e-9))
        litres = np.minimum(np.arange(count + 1) * min(piece_max_l, self.total_l), self.total_l)
        cuts = np.interp(litres, self.litres, self.at_m)
        cuts[0], cuts[-1] = self.at_m[0], self.at_m[-1]
        litres[-1] = self.total_l
        return cuts, np.diff(litres)


def valve_places(width_m: float, valves: tuple[tuple[float, float], ...]) -> Floats:
    """Return (right_m, width_m) of each valve's strip; one in the middle without valves.

    Strips that do not add up to the swath are scaled to it: the swath is what is sprayed.
    """
    places = np.array(valves or ((0.0, width_m),), dtype=np.float64)
    places[:, 1] *= width_m / places[:, 1].sum()
    return places


@dataclass(frozen=True, slots=True, kw_only=True)
class Steps:
    """Lines in even steps: `counts` of each line, and of each step length, direction, middle."""

    counts: np.ndarray[tuple[int, ...], np.dtype[np.int64]]
    long_m: Floats
    along: Floats
    middle: Floats

    def rates(self, rates: Rates, right_m: float) -> Floats:
        """Return the rates so far to the right of the middles [L/ha]."""
        return rates.rates_at(
            self.middle[:, 0] + self.along[:, 1] * right_m,
            self.middle[:, 1] - self.along[:, 0] * right_m,
        )


def steps_of(lines: Floats, valves: int, *, step_m: float = STEP_M) -> Steps:
    """Return lines in steps of at most `step_m`, longer where many lines are read by valve."""
    length_m = lengths_m(lines)
    step_m = max(step_m, float(length_m.sum()) * valves / POINTS_MAX)
    counts = np.maximum(np.ceil(length_m / step_m), 1).astype(np.int64)
    owner = np.repeat(np.arange(len(lines)), counts)
    number = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    long_m = (length_m / counts)[owner]
    along = directions(lines)[owner]
    middle = lines[owner, :2] + along * ((number + 0.5) * long_m)[:, None]
    return Steps(counts=counts, long_m=long_m, along=along, middle=middle)


def demands(
    lines: Floats,
    rates: Rates,
    *,
    width_m: float,
    valves: tuple[tuple[float, float], ...] = (),
    extents: Extents | None = None,
) -> list[Demand]:
    """Return the demand along every line; each valve gives the rate at the middle of its strip.

    With `extents` a valve whose strip touches the border gives nothing.
    """
    if not len(lines):
        return []
    places = valve_places(width_m, valves)
    is_even = isinstance(rates, Uniform) and extents is None
    steps = steps_of(lines, len(places), step_m=math.inf if is_even else STEP_M)
    along, middle = steps.along, steps.middle
    near = np.empty(0, dtype=np.int64)
    if extents is not None:
        near = np.flatnonzero(~extents.deep_inside(middle))
    to_right = np.column_stack([along[near, 1], -along[near, 0]])
    flow = np.zeros(len(middle))  # litres per metre, times M2_PER_HA
    for right_m, strip_m in places:
        rate = np.nan_to_num(steps.rates(rates, right_m), nan=0.0)
        if extents is not None:
            rate[near] *= extents.is_open(middle[near], to_right, (float(right_m), float(strip_m)))
        flow += rate * strip_m
    used = flow * steps.long_m / M2_PER_HA
    found, length_m = [], lengths_m(lines)
    for index, part in enumerate(np.split(used, np.cumsum(steps.counts)[:-1])):
        at_m = np.linspace(0.0, length_m[index], len(part) + 1)
        found.append(Demand(at_m=at_m, litres=np.concatenate([[0.0], np.cumsum(part)])))
    return found


@dataclass(frozen=True, slots=True, kw_only=True)
class Pieces:
    """Spray lines as they are given to sorties: `line` is which line each is cut from."""

    ends: Floats
    litres: Floats
    line: np.ndarray[tuple[int, ...], np.dtype[np.int64]]

    def __len__(self) -> int:
        return len(self.ends)


def _shorter(need: Demand, cuts_m: Floats, piece_max_m: float) -> tuple[Floats, Floats]:
    """Return more cuts, evenly between those that there are, and what each piece needs."""
    counts = np.ceil(np.diff(cuts_m) / piece_max_m - 1e-9).astype(np.int64)
    parts = [
        np.linspace(a, b, n, endpoint=False)
        for a, b, n in zip(cuts_m[:-1], cuts_m[1:], counts, strict=True)
    ]
    more: Floats = np.append(np.concatenate(parts), cuts_m[-1])
    litres: Floats = np.diff(np.interp(more, need.at_m, need.litres))
    return more, litres


def cut(
    lines: Floats,
    demand: list[Demand],
    *,
    piece_max_l: float,
    piece_max_m: float = math.inf,
    margin_m: float = 0.0,
) -> Pieces:
    """Return the lines in pieces of at most `piece_max_l` and `piece_max_m`; else whole ones.

    Long stretches on which nothing is prescribed are no piece at all, but for `margin_m`.
    """
    rows, litres, owner = [no_lines()], [np.empty(0)], [np.empty(0, dtype=np.int64)]
    for index, (row, whole) in enumerate(zip(lines, demand, strict=True)):
        length_m = whole.at_m[-1]
        for start_m, end_m in stretches(whole.at_m, whole.litres, margin_m=margin_m):
            need = whole.part(start_m, end_m)
            cuts, each_l = need.cuts_m(piece_max_l)
            if np.diff(cuts).max() > piece_max_m:
                cuts, each_l = _shorter(need, cuts, piece_max_m)
            places = row[:2] + np.outer(cuts / length_m, row[2:] - row[:2])
            if end_m == length_m:
                places[-1] = row[2:]
            rows.append(np.column_stack([places[:-1], places[1:]]))
            litres.append(each_l)
            owner.append(np.full(len(each_l), index, dtype=np.int64))
    return Pieces(
        ends=np.concatenate(rows), litres=np.concatenate(litres), line=np.concatenate(owner)
    )


# Which parts of a line are worth flying: where nothing is prescribed, nothing has to be flown.
#
# What is cut out may still be flown over: the order of the parts decides, by time.

# A shorter stretch without a rate is flown over with shut valves: going around it saves nothing.
GAP_MIN_M = 10.0


def stretches(at_m: Floats, litres: Floats, *, margin_m: float) -> list[tuple[float, float]]:
    """Return from where to where along a line something is prescribed, and `margin_m` around it.

    `litres` is what the line needs up to each of `at_m`. The margin is for speeding up, and
    looking ahead, before the first rate and braking after the last one, as far as the line is long.

    >>> at = np.array([0.0, 40.0, 60.0, 100.0])
    >>> stretches(at, np.array([0.0, 0.0, 2.0, 2.0]), margin_m=5.0)
    [(35.0, 65.0)]
    """
    needed = np.flatnonzero(np.diff(litres) > 0.0)
    if not len(needed):
        return []
    first, last = float(at_m[0]), float(at_m[-1])
    starts = np.maximum(at_m[needed] - margin_m, first)
    ends = np.minimum(at_m[needed + 1] + margin_m, last)
    apart = np.flatnonzero(starts[1:] - ends[:-1] >= GAP_MIN_M)
    begin = np.concatenate([[0], apart + 1])
    end = np.concatenate([apart, [len(needed) - 1]])
    found = list(zip(starts[begin].tolist(), ends[end].tolist(), strict=True))
    # A rest at an end that is too short to be worth a stop of its own.
    start = first if found[0][0] - first < GAP_MIN_M else found[0][0]
    stop = last if last - found[-1][1] < GAP_MIN_M else found[-1][1]
    found[0] = (start, found[0][1])
    found[-1] = (found[-1][0], stop)
    return found
