"""Where an order of passes is cut into sorties: wherever that costs least, inside passes, too.

An order of passes is split at the places between which the sorties, with their ways from and to
the depot, take the least time together (Prins 2004); or plainly, home where the tank or the
battery demands it and on from there.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple, TypeVar

import numpy as np
import shapely

from missions.demand import Demand
from missions.energy import J_WH, KG_L, Battery
from missions.free_space import FreeSpace
from missions.network import ACROSS_M, JOIN_DEG, JOIN_M, STRAIGHT_M
from missions.strips import Floats, directions, lengths_m
from missions.turns import Motion

# A line, and from where to where along it [m]; the second is the lesser where it is flown back.
Part = tuple[int, float, float]
Place = tuple[float, float]

# A cut leaves no part shorter than this, which is a tenth of what a refill's ferry mostly is.
STUB_M = 10.0
# Places to cut at are tried in such parts of a tank, and behind so many tanks from each end.
SHARES, TANKS = 8, 2
# Times by the root of the way, to this length; longer ways are flown at speed.
TABLED_M, KNOTS = 400.0, 1600
NOSE_DEG = 180.0
TOUCH_M = 1e-3
ROUNDS = 30
# So many places are tried at once as ends of a sortie, each with all its beginnings.
BLOCK = 128
# Neighbouring passes see each other. No way through: far apart, whatever the ferry around costs.
SEEN_M = 9.0
HIDDEN, HIDDEN_M = 3.0, 1000.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """What ends a sortie: `landing_s` is what one more takes, `usable_wh` what a battery gives."""

    usable_l: float
    reserve_l: float
    landing_s: float
    upright_s: float
    nose_s: float = 0.0
    battery: Battery | None = None
    usable_wh: float = math.inf


class Times:
    """How long ways take, as `missions.turns` has it, fast for one way at a time."""

    def __init__(self, motion: Motion) -> None:
        self._scale: float = KNOTS / math.sqrt(TABLED_M)
        knots_m = (np.arange(KNOTS + 2) / self._scale) ** 2
        self._legs: list[float] = motion.legs_s(knots_m).tolist()
        self._ways: list[float] = motion.ways_s(knots_m).tolist()
        self._speed_m_s: float = motion.speed_m_s
        self._leg_more_s: float = self._legs[KNOTS] - float(knots_m[KNOTS]) / motion.speed_m_s
        self._way_more_s: float = self._ways[KNOTS] - float(knots_m[KNOTS]) / motion.speed_m_s
        self._reaching_s = float(motion.legs_s(np.array([1e5]))[0]) - 1e5 / motion.speed_m_s
        self._begins_early = motion.corners == "ardupilot"

    def leg_s(self, length_m: float) -> float:
        """Return the time of a straight leg from rest to rest."""
        if length_m >= TABLED_M:
            return length_m / self._speed_m_s + self._leg_more_s
        at = math.sqrt(length_m) * self._scale
        low = int(at)
        one_s, other_s = self._legs[low], self._legs[low + 1]
        return one_s + (at - low) * (other_s - one_s)

    def way_s(self, length_m: float) -> float:
        """Return what a way between two passes adds."""
        if length_m >= TABLED_M:
            return length_m / self._speed_m_s + self._way_more_s
        at = math.sqrt(length_m) * self._scale
        low = int(at)
        one_s, other_s = self._ways[low], self._ways[low + 1]
        return one_s + (at - low) * (other_s - one_s)

    def on_s(self, before_m: float, gap_m: float, after_m: float) -> float:
        """Return what a gap adds between two parts of a line that is flown straight on."""
        if gap_m < JOIN_M:
            return -self._spared_s(before_m, after_m)
        spared_s = self._spared_s(before_m, gap_m) + self._spared_s(gap_m, after_m)
        return self.leg_s(gap_m) - spared_s

    def _spared_s(self, one_m: float, other_m: float) -> float:
        """Return what `Motion.spared_straight_s` says."""
        one_s, other_s = self.leg_s(one_m), self.leg_s(other_m)
        if self._begins_early:
            return min(one_s / 2.0, other_s / 2.0, self._reaching_s)
        return (one_s + other_s - (one_m + other_m) / self._speed_m_s) / 2.0


@dataclass(slots=True, kw_only=True)
class Passes:
    """Lines that are flown in any parts: where they lie, what they need, how far home is.

    `pace_s_m` is the time of a metre of each. `bent_m` has, for lines that a depot does not see,
    the way home from places evenly apart.
    """

    lines: Floats
    demand: Sequence[Demand]
    times: Times
    depots: Sequence[Place]
    pace_s_m: Sequence[float]
    speed_m_s: float
    space: FreeSpace
    bent_m: dict[int, list[float]] = field(default_factory=dict)
    known_m: dict[tuple[Place, Place], float] = field(default_factory=dict)
    length_m: list[float] = field(init=False)
    along: list[tuple[float, float]] = field(init=False)
    starts: list[Place] = field(init=False)
    at_m: list[list[float]] = field(init=False)
    litres: list[list[float]] = field(init=False)
    even_l_m: list[float] = field(init=False)

    def __post_init__(self) -> None:
        self.length_m = lengths_m(self.lines).tolist()
        self.along = [(x, y) for x, y in directions(self.lines).tolist()]
        self.starts = [(row[0], row[1]) for row in self.lines.tolist()]
        self.at_m = [need.at_m.tolist() for need in self.demand]
        self.litres = [need.litres.tolist() for need in self.demand]
        self.even_l_m = [
            litres[1] / at_m[1] if len(at_m) == 2 and at_m[0] == 0.0 else 0.0
            for at_m, litres in zip(self.at_m, self.litres, strict=True)
        ]

    def place(self, line: int, at_m: float) -> Place:
        """Return where a place of a line lies."""
        (x, y), (east, north) = self.starts[line], self.along[line]
        return x + at_m * east, y + at_m * north

    def home_m(self, line: int, at_m: float, place: Place) -> float:
        """Return the way from a place of a line to the nearest depot."""
        bent = self.bent_m.get(line)
        if bent is not None:
            at = at_m / self.length_m[line] * (len(bent) - 1)
            low = min(max(int(at), 0), len(bent) - 2)
            return bent[low] + (at - low) * (bent[low + 1] - bent[low])
        x, y = place
        if len(self.depots) == 1:
            ((east, north),) = self.depots
            return math.hypot(x - east, y - north)
        return min(math.hypot(x - east, y - north) for east, north in self.depots)

    def used_l(self, line: int, at_m: float) -> float:
        """Return what a line needs up to a place."""
        if self.even_l_m[line]:
            return self.even_l_m[line] * at_m
        known, litres = self.at_m[line], self.litres[line]
        high = min(max(bisect_right(known, at_m), 1), len(known) - 1)
        one, other = known[high - 1], known[high]
        share = (at_m - one) / (other - one) if other > one else 0.0
        return litres[high - 1] + share * (litres[high] - litres[high - 1])

    def need_l(self, part: Part) -> float:
        """Return what a part needs."""
        line, start_m, end_m = part
        return abs(self.used_l(line, end_m) - self.used_l(line, start_m))

    def after_m(self, part: Part, litres: float) -> float:
        """Return where on its line a part has used so much."""
        line, start_m, end_m = part
        if self.even_l_m[line]:
            done_m = litres / self.even_l_m[line]
            return min(start_m + done_m, end_m) if end_m > start_m else max(start_m - done_m, end_m)
        begun = self.used_l(line, start_m)
        wanted = begun + litres if end_m > start_m else begun - litres
        known, used = self.at_m[line], self.litres[line]
        high = min(max(bisect_left(used, wanted), 1), len(used) - 1)
        one, other = used[high - 1], used[high]
        share = (wanted - one) / (other - one) if other > one else 0.0
        found = known[high - 1] + share * (known[high] - known[high - 1])
        low_m, high_m = min(start_m, end_m), max(start_m, end_m)
        return min(max(found, low_m), high_m)

    def join_s(self, before: Part, after: Part) -> tuple[float, float]:
        """Return what the way from one part to the next adds, and its length."""
        one, other = self.place(before[0], before[2]), self.place(after[0], after[1])
        gap_m = math.hypot(other[0] - one[0], other[1] - one[1])
        if gap_m < ACROSS_M and self._goes_on(before, after, one, other, gap_m):
            one_m, other_m = abs(before[2] - before[1]), abs(after[2] - after[1])
            return self.times.on_s(one_m, gap_m, other_m), gap_m
        gap_m = self.gap_m(one, other)
        return self.times.way_s(gap_m), gap_m

    def gap_m(self, one: Place, other: Place) -> float:
        """Return the way between two places, over the best corners where one hides the other."""
        gap_m = math.hypot(other[0] - one[0], other[1] - one[1])
        if gap_m <= SEEN_M or self.space.is_convex:
            return gap_m
        known = self.known_m.get((one, other))
        if known is None:
            known = gap_m
            if not shapely.contains_properly(self.space.space, shapely.LineString([one, other])):
                known = self.space.around_m(one, other)
                known = known if math.isfinite(known) else HIDDEN * gap_m + HIDDEN_M
            self.known_m[one, other] = self.known_m[other, one] = known
        return known

    def _goes_on(self, before: Part, after: Part, one: Place, other: Place, gap_m: float) -> bool:
        (east, north), (x, y) = self.along[before[0]], self.along[after[0]]
        if before[2] < before[1]:
            east, north = -east, -north
        if after[2] < after[1]:
            x, y = -x, -y
        if not east * x + north * y > COSINE:
            return False
        if gap_m < JOIN_M:
            return True
        way = other[0] - one[0], other[1] - one[1]
        return (
            abs(way[0] * north - way[1] * east) <= STRAIGHT_M
            and way[0] * east + way[1] * north > 0.0
            and abs(east * y - north * x) < STRAIGHT_M / gap_m
        )


COSINE = math.cos(math.radians(JOIN_DEG))


def turned(run: Sequence[Part]) -> list[Part]:
    """Return parts flown the other way.

    >>> turned([(0, 0.0, 5.0), (3, 8.0, 2.0)])
    [(3, 2.0, 8.0), (0, 5.0, 0.0)]
    """
    return [(line, end_m, start_m) for line, start_m, end_m in reversed(run)]


def joined_parts(run: Sequence[Part]) -> list[Part]:
    """Return a run without the cuts that it flies straight over.

    >>> joined_parts([(0, 9.0, 5.0), (0, 5.0, 2.0), (1, 0.0, 4.0)])
    [(0, 9.0, 2.0), (1, 0.0, 4.0)]
    """
    found: list[Part] = []
    for line, start_m, end_m in run:
        last = found[-1] if found else None
        if (
            last is not None
            and last[0] == line
            and abs(last[2] - start_m) < TOUCH_M
            and (last[2] > last[1]) == (end_m > start_m)
        ):
            found[-1] = (line, last[1], end_m)
        else:
            found.append((line, start_m, end_m))
    return found


@dataclass(frozen=True, slots=True, kw_only=True)
class Flown:
    """What a sortie takes: its time with its landing, its litres and its watt-hours."""

    seconds: float
    litres: float
    wh: float


def flown_by(passes: Passes, limits: Limits, run: Sequence[Part]) -> Flown:
    """Return what a sortie along these parts takes."""
    begun = None
    for part in run:
        begun = _begun(passes, limits, begun, part)
    assert begun is not None
    return begun.flown(passes, limits)


def plainly(passes: Passes, limits: Limits, run: Sequence[Part]) -> list[list[Part]] | None:
    """Return the run in sorties: home where the tank or the battery demands, and on from there."""
    sorties: list[list[Part]] = []
    sortie: list[Part] = []
    begun = None
    left_l = limits.usable_l
    waiting = list(reversed(run))
    while waiting:
        part = waiting.pop()
        line, start_m, end_m = part
        to_m = end_m if passes.need_l(part) <= left_l else passes.after_m(part, left_l)
        to_m = _lasts(passes, limits, begun, (line, start_m, to_m))
        if abs(to_m - start_m) > TOUCH_M:
            sortie.append((line, start_m, to_m))
            begun = _begun(passes, limits, begun, sortie[-1])
            left_l -= passes.need_l(sortie[-1])
        elif not sortie:
            return None
        if abs(end_m - to_m) <= TOUCH_M:
            continue
        sorties.append(sortie)
        sortie, begun, left_l = [], None, limits.usable_l
        waiting.append((line, to_m, end_m))
    return [*sorties, sortie] if sortie else sorties


def _lasts(passes: Passes, limits: Limits, begun: _Begun | None, part: Part) -> float:
    """Return up to where on a part the battery lasts, the way home with it."""
    line, low, high = part
    if limits.battery is None or abs(high - low) <= TOUCH_M:
        return high

    def lasts(at_m: float) -> bool:
        if abs(at_m - part[1]) <= TOUCH_M:
            return True
        whole = _begun(passes, limits, begun, (line, part[1], at_m))
        return whole.flown(passes, limits).wh <= limits.usable_wh

    if lasts(high):
        return high
    for _ in range(ROUNDS):
        middle = (low + high) / 2.0
        low, high = (middle, high) if lasts(middle) else (low, middle)
    return low if abs(low - part[1]) > 1.0 else part[1]


def split(
    passes: Passes,
    limits: Limits,
    run: Sequence[Part],
    *,
    shares: int = SHARES,
    tanks: int = TANKS,
) -> tuple[float, list[list[Part]]] | None:
    """Return the time of the best sorties that fly the run in its order, and these; None if none.

    Places to cut at are the ends of parts, whole tanks from each of them, evenly spaced ones, and
    those nearest to a depot.
    """
    cut = _Run(passes, limits, run, _litres_to_cut_at(passes, limits, run, shares, tanks))
    before = cut.by_tank() if limits.battery is None else cut.by_battery()
    if before is not None:
        return cut.sorties(before)
    # The places that were tried lie farther apart than the battery lasts.
    plain = plainly(passes, limits, run)
    if plain is None:
        return None
    return sum(flown_by(passes, limits, sortie).seconds for sortie in plain), plain


def _litres_to_cut_at(
    passes: Passes, limits: Limits, run: Sequence[Part], shares: int, tanks: int
) -> list[float]:
    tank_l, total_l, ends = limits.usable_l, 0.0, [0.0]
    feet = []
    for part in run:
        feet += [total_l + litres for litres in _nearest_l(passes, part)]
        total_l += passes.need_l(part)
        ends.append(total_l)
    if limits.battery is not None and math.isfinite(limits.usable_wh):
        metres = sum(abs(end_m - start_m) for _, start_m, end_m in run)
        lasts_s = limits.usable_wh * J_WH / limits.battery.cruise_w
        tank_l = min(tank_l, total_l / metres * lasts_s * passes.speed_m_s)
    if not tank_l > 0.0:
        return []
    found = feet
    found += [end + many * tank_l for end in ends for many in range(-tanks, tanks + 1) if many]
    found += (np.arange(1, int(total_l / tank_l * shares) + 1) * tank_l / shares).tolist()
    return sorted(each for each in found if 0.0 < each < total_l)


def _nearest_l(passes: Passes, part: Part) -> list[float]:
    """Return the litres at the places of a part that are nearest to a depot."""
    line, start_m, end_m = part
    (x, y), (east, north) = passes.starts[line], passes.along[line]
    low, high = min(start_m, end_m) + STUB_M, max(start_m, end_m) - STUB_M
    feet = [(u - x) * east + (v - y) * north for u, v in passes.depots]
    return [passes.need_l((line, start_m, foot)) for foot in feet if low < foot < high]


# One number, or many beside each other.
_Some = TypeVar("_Some", float, Floats)


def _used_wh(
    limits: Limits, battery: Battery, *,
    between_s: _Some, cruise_s: _Some, gone: tuple[_Some, _Some], litres: _Some,
    out_s: _Some, back_s: _Some,
) -> _Some:  # fmt: skip
    """Return what sorties take that are away from first to last place for `between_s`.

    `gone` is the load at the end over that time, and the integral of what was sprayed by then; the
    ferries' times have half of a landing in them.
    """
    half_s, reserve_l = limits.landing_s / 2.0, limits.reserve_l
    out_s, back_s = out_s - half_s, back_s - half_s
    carried = reserve_l * between_s + gone[0] - gone[1]
    carried += (litres + reserve_l) * (out_s + limits.upright_s) + reserve_l * back_s
    hover_s = between_s - cruise_s + (limits.upright_s + limits.nose_s)
    used = battery.hover_w * hover_s + battery.cruise_w * cruise_s
    # Ferries count as the costlier of both: how far they are at speed is not known here.
    used += max(battery.cruise_w, battery.hover_w) * (out_s + back_s)
    used += battery.per_kg_w * KG_L * carried
    return used / J_WH


class _Sum(NamedTuple):
    """Time, time at speed, and the integral of what was sprayed over time, up to some place."""

    seconds: float = 0.0
    cruise_s: float = 0.0
    weight: float = 0.0


class _Begun(NamedTuple):
    """A sortie up to the end of some part: the ferry to its first, the sums, the litres."""

    out_s: float
    sums: _Sum
    load: float
    last: Part

    def flown(self, passes: Passes, limits: Limits) -> Flown:
        """Return what the sortie takes that flies home from here."""
        back_s = _home_s(passes, limits, self.last[0], self.last[2])
        return _flown(
            limits, self.sums, end_l=self.load, litres=self.load, out_s=self.out_s, back_s=back_s
        )


def _begun(passes: Passes, limits: Limits, before: _Begun | None, part: Part) -> _Begun:
    """Return a sortie that flies one part more, or begins with it."""
    need_l = passes.need_l(part)
    if before is None:
        out_s = _home_s(passes, limits, part[0], part[1])
        return _Begun(out_s, _flown_on(passes, _Sum(), part, 0.0, need_l), need_l, part)
    here = _joined(passes, limits, before.sums, (before.last, part), before.load)
    sums = _flown_on(passes, here, part, before.load, need_l)
    return _Begun(before.out_s, sums, before.load + need_l, part)


def _flown(
    limits: Limits, between: _Sum, *, end_l: float, litres: float, out_s: float, back_s: float
) -> Flown:
    """Return what a sortie takes between the sums of its ends; its last place is at `end_l`."""
    wh = 0.0
    if limits.battery is not None:
        wh = _used_wh(
            limits, limits.battery,
            between_s=between.seconds, cruise_s=between.cruise_s,
            gone=(end_l * between.seconds, between.weight),
            litres=litres, out_s=out_s, back_s=back_s,
        )  # fmt: skip
    return Flown(seconds=out_s + between.seconds + back_s, litres=litres, wh=wh)


def _home_s(passes: Passes, limits: Limits, line: int, at_m: float) -> float:
    """Return the time of a ferry, with half of a landing."""
    home_m = passes.home_m(line, at_m, passes.place(line, at_m))
    return limits.landing_s / 2.0 + passes.times.leg_s(home_m)


def _part_s(passes: Passes, line: int, length_m: float) -> float:
    slow_s_m = passes.pace_s_m[line] - 1.0 / passes.speed_m_s
    return passes.times.leg_s(length_m) + slow_s_m * length_m


def _flown_on(passes: Passes, here: _Sum, part: Part, load: float, need_l: float) -> _Sum:
    line, start_m, end_m = part
    length_m = abs(end_m - start_m)
    seconds = _part_s(passes, line, length_m)
    return _Sum(
        here.seconds + seconds,
        here.cruise_s + passes.pace_s_m[line] * length_m,
        here.weight + (load + need_l / 2.0) * seconds,
    )


def _joined(
    passes: Passes, limits: Limits, here: _Sum, parts: tuple[Part, Part], load: float
) -> _Sum:
    seconds, gap_m = passes.join_s(*parts)
    seconds += limits.nose_s
    moving_s = min(gap_m / passes.speed_m_s, max(seconds, 0.0))
    return _Sum(here.seconds + seconds, here.cruise_s + moving_s, here.weight + load * seconds)


class _Stop(NamedTuple):
    """A place at which a run may be cut, behind so many litres.

    `to` are the sums up to it, `on` those from which a sortie that begins here counts: behind a
    cut it speeds up again, and behind the end of a part it has been flown to the next one.
    """

    load: float
    part: int
    at_m: float
    to: _Sum
    on: _Sum
    home_s: float
    home_on_s: float


class _Run:
    """A run with the places at which it may be cut, in its order.

    What a sortie takes is a difference of sums, whichever two places it lies between.
    """

    def __init__(
        self, passes: Passes, limits: Limits, run: Sequence[Part], cuts_l: Sequence[float]
    ) -> None:
        self._passes, self._limits, self._run = passes, limits, run
        self.stops: list[_Stop] = []
        line, start_m, _ = run[0]
        self._first_home_s = _home_s(passes, limits, line, start_m)
        load, here, cut = 0.0, _Sum(), 0
        for number, part in enumerate(run):
            line, start_m, end_m = part
            need_l = passes.need_l(part)
            end = _flown_on(passes, here, part, load, need_l)
            until = bisect_left(cuts_l, load + need_l, cut)
            self._cut(number, here, end, (load, need_l), cuts_l[cut:until])
            cut = until
            load += need_l
            here, home_on_s = end, 0.0
            if number < len(run) - 1:
                following = run[number + 1]
                here = _joined(passes, limits, end, (part, following), load)
                home_on_s = _home_s(passes, limits, following[0], following[1])
            home_s = _home_s(passes, limits, line, end_m)
            self.stops.append(_Stop(load, number, end_m, end, here, home_s, home_on_s))

    def _cut(
        self, number: int, here: _Sum, end: _Sum, loads: tuple[float, float],
        cuts_l: Sequence[float],
    ) -> None:  # fmt: skip
        """Add the places inside a part, those too near to its ends left out."""
        passes, limits = self._passes, self._limits
        (load, need_l), part = loads, self._run[number]
        line, start_m, end_m = part
        last_m = start_m
        for cut_l in cuts_l:
            used_l = cut_l - load
            cut_m = passes.after_m(part, used_l) if used_l > 0.0 else start_m
            done_m, left_m = abs(cut_m - start_m), abs(end_m - cut_m)
            if done_m < STUB_M or left_m < STUB_M or abs(cut_m - last_m) < TOUCH_M:
                continue
            last_m = cut_m
            to = _flown_on(passes, here, (line, start_m, cut_m), load, used_l)
            left_s = _part_s(passes, line, left_m)
            left_weight = (load + (used_l + need_l) / 2.0) * left_s
            on = _Sum(end.seconds - left_s, to.cruise_s, end.weight - left_weight)
            home_s = _home_s(passes, limits, line, cut_m)
            self.stops.append(_Stop(cut_l, number, cut_m, to, on, home_s, home_s))

    def flown(self, one: int, other: int) -> Flown:
        """Return what a sortie from behind one place, -1 for the start, to another takes."""
        stop = self.stops[other]
        load, begun, out_s = 0.0, _Sum(), self._first_home_s
        if one >= 0:
            start = self.stops[one]
            load, begun, out_s = start.load, start.on, start.home_on_s
        between = _Sum(*(end - start for end, start in zip(stop.to, begun, strict=True)))
        return _flown(
            self._limits, between,
            end_l=stop.load, litres=stop.load - load, out_s=out_s, back_s=stop.home_s,
        )  # fmt: skip

    def by_tank(self) -> list[int] | None:
        """Return, for each place, from behind which one its sortie comes at the least time."""
        usable_l = self._limits.usable_l + 1e-9
        before = []
        # Places from which a sortie may still come, the best of them first.
        waiting: deque[tuple[int, float, float]] = deque([(-1, 0.0, self._first_home_s)])
        for at, stop in enumerate(self.stops):
            while waiting and waiting[0][1] < stop.load - usable_l:
                waiting.popleft()
            if not waiting:
                return None
            from_at, _, cost_s = waiting[0]
            before.append(from_at)
            cost_s += stop.to.seconds + stop.home_s + stop.home_on_s - stop.on.seconds
            while waiting and waiting[-1][2] >= cost_s:
                waiting.pop()
            waiting.append((at, stop.load, cost_s))
        return before

    def by_battery(self) -> list[int] | None:
        """Return the same where the battery must last for each sortie."""
        limits, battery = self._limits, self._limits.battery
        assert battery is not None
        stops = self.stops
        begun = [_Sum(), *(stop.on for stop in stops)]
        load = np.array([0.0, *(stop.load for stop in stops)])
        out_s = np.array([self._first_home_s, *(stop.home_on_s for stop in stops)])
        on_s, on_cruise_s, on_weight = np.array(begun).T
        to_s, to_cruise_s, to_weight = np.array([stop.to for stop in stops]).T
        home_s = np.array([stop.home_s for stop in stops])
        longest_s = limits.usable_wh * J_WH / min(battery.hover_w, battery.cruise_w)
        # A sortie to a place begins behind one of these at the earliest; `known` begins at -1.
        first = np.maximum(
            np.searchsorted(load, load[1:] - limits.usable_l - 1e-9),
            np.searchsorted(np.maximum.accumulate(on_s), to_s - longest_s),
        )
        known_s = np.full(len(stops) + 1, math.inf)
        known_s[0] = 0.0
        before: list[int] = []
        for block in range(0, len(stops), BLOCK):
            end = min(block + BLOCK, len(stops))
            low = min(int(first[block:end].min()), end - 1)
            some, rows = slice(low, end), slice(block, end)
            between_s = to_s[rows, None] - on_s[some]
            wh = _used_wh(
                limits, battery,
                between_s=between_s,
                cruise_s=to_cruise_s[rows, None] - on_cruise_s[some],
                gone=(load[1:][rows, None] * between_s, to_weight[rows, None] - on_weight[some]),
                litres=load[1:][rows, None] - load[some],
                out_s=np.broadcast_to(out_s[some], between_s.shape),
                back_s=np.broadcast_to(home_s[rows, None], between_s.shape),
            )  # fmt: skip
            seconds = out_s[some] + between_s + home_s[rows, None]
            place = np.arange(low, end)
            is_too_far = (place < first[rows, None]) | (place > np.arange(block, end)[:, None])
            seconds[is_too_far | ~(wh <= limits.usable_wh)] = math.inf
            for at, row in enumerate(seconds, start=block):
                whole_s = known_s[some] + row
                # The nearest of those that take the same.
                best = len(whole_s) - 1 - int(whole_s[::-1].argmin())
                known_s[at + 1] = whole_s[best]
                before.append(low + best - 1)
        return before if math.isfinite(known_s[-1]) else None

    def sorties(self, before: list[int]) -> tuple[float, list[list[Part]]]:
        """Return the time and the sorties that these choices lead to."""
        cuts = [len(self.stops) - 1]
        while before[cuts[-1]] >= 0:
            cuts.append(before[cuts[-1]])
        cuts.reverse()
        seconds = sum(self.flown(one, other).seconds for one, other in pairwise([-1, *cuts]))
        found = []
        waiting = list(reversed(self._run))
        number = 0
        for cut in cuts:
            stop, sortie = self.stops[cut], []
            while number < stop.part:
                sortie.append(waiting.pop())
                number += 1
            line, start_m, end_m = waiting.pop()
            sortie.append((line, start_m, stop.at_m))
            if stop.at_m == end_m:
                number += 1
            else:
                waiting.append((line, stop.at_m, end_m))
            found.append(sortie)
        return seconds, found
