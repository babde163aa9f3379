"""Where an order of passes is cut into sorties: wherever that costs least, inside passes, too.

An order of passes is split at the places between which the sorties, with their ways from and to
the depot, take the least time together (Prins 2004); or plainly, home where the tank or the
battery demands it and on from there.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple, TypeVar

import numpy as np

from missions.energy import J_WH, KG_L, Battery
from missions.passes import TOUCH_M, Part, Passes
from missions.strips import Floats

# A cut leaves no part shorter than this, which is a tenth of what a refill's ferry mostly is.
STUB_M = 10.0
# Places to cut at are tried in such parts of a tank, and behind so many tanks from each end.
SHARES, TANKS = 8, 2
ROUNDS = 30
# So many places are tried at once as ends of a sortie, each with all its beginnings.
BLOCK = 48


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """What ends a sortie: `landing_s` is what one more takes, `usable_wh` what a battery gives.

    Speeding up and braking take a ferry `reaching_s`.
    """

    usable_l: float
    reserve_l: float
    landing_s: float
    upright_s: float
    nose_s: float = 0.0
    reaching_s: float = 0.0
    battery: Battery | None = None
    usable_wh: float = math.inf


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
    stops_s = np.minimum(out_s, limits.reaching_s) + np.minimum(back_s, limits.reaching_s)
    used += battery.cruise_w * (out_s + back_s - stops_s) + battery.hover_w * stops_s
    used += battery.per_kg_w * KG_L * carried
    found: _Some = used / J_WH
    return found


class _Sum(NamedTuple):
    """Time, time at speed, and the integral of what was sprayed over time, up to some place."""

    seconds: float = 0.0
    cruise_s: float = 0.0
    weight: float = 0.0


class _Begun(NamedTuple):
    """A sortie up to the end of some part: ferries from every depot, the sums, the litres."""

    out_s: list[float]
    sums: _Sum
    load: float
    last: Part

    def flown(self, passes: Passes, limits: Limits) -> Flown:
        """Return what the sortie takes that flies home from here, to where it began."""
        homes_s = _homes_s(passes, limits, self.last[0], self.last[2])
        out_s, back_s = min(zip(self.out_s, homes_s, strict=True), key=sum)
        return _flown(
            limits, self.sums, end_l=self.load, litres=self.load, out_s=out_s, back_s=back_s
        )


def _begun(passes: Passes, limits: Limits, before: _Begun | None, part: Part) -> _Begun:
    """Return a sortie that flies one part more, or begins with it."""
    need_l = passes.need_l(part)
    if before is None:
        out_s = _homes_s(passes, limits, part[0], part[1])
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


def _homes_s(passes: Passes, limits: Limits, line: int, at_m: float) -> list[float]:
    """Return the times of the ferries from every depot, each with half of a landing."""
    half_s = limits.landing_s / 2.0
    return [half_s + passes.times.leg_s(home_m) for home_m in passes.homes_m(line, at_m)]


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


class _Run:
    """A run with the places at which it may be cut, in its order.

    What a sortie takes is a difference of sums, whichever two places it lies between: of `to`,
    time, time at speed and weight up to a place, and of `on`, from which a sortie that begins
    there counts. Behind a cut it speeds up again, and behind the end of a part it has been flown
    to the next one. A sortie flies home to the depot that it came from: ferries are by depot, from
    the start, `first_s`, from each place, `home_s`, and to where it is gone on from, `home_on_s`.
    """

    def __init__(
        self, passes: Passes, limits: Limits, run: Sequence[Part], cuts_l: Sequence[float]
    ) -> None:
        self._limits, self._run = limits, run
        many = passes.many
        lines = np.array([part[0] for part in run])
        start_m, end_m = np.array([part[1:] for part in run]).T
        needs_l = many.needs_l(lines, start_m, end_m)
        load = np.cumsum(needs_l)
        length_m = np.abs(end_m - start_m)
        part_s = many.parts_s(lines, length_m)
        join_s, gap_m = many.joins_s(lines, start_m, end_m)
        join_s += limits.nose_s
        # Parts and the ways between them, in turn.
        steps = np.zeros((3, 2 * len(run)))
        steps[0, ::2], steps[0, 1:-1:2] = part_s, join_s
        steps[1, ::2] = many.pace_s_m[lines] * length_m
        steps[1, 1:-1:2] = np.minimum(gap_m / passes.speed_m_s, np.maximum(join_s, 0.0))
        steps[2, ::2], steps[2, 1:-1:2] = (load - needs_l / 2.0) * part_s, load[:-1] * join_s
        sums = np.cumsum(steps, axis=1)
        ends, joined = sums[:, ::2], sums[:, 1::2]
        begun = np.concatenate([np.zeros((3, 1)), joined[:, :-1]], axis=1)

        # Places inside parts, those too near to their ends left out.
        cut_l = np.array(cuts_l)
        part = np.searchsorted(load, cut_l, side="right")
        cut_l, part = cut_l[part < len(run)], part[part < len(run)]
        used_l = np.maximum(cut_l - (load - needs_l)[part], 0.0)
        cut_m = many.after_m(lines[part], np.stack([start_m[part], end_m[part]]), used_l)
        is_apart = np.ones(len(part), dtype=np.bool_)
        is_apart[1:] = (np.diff(part) > 0) | (np.abs(np.diff(cut_m)) >= TOUCH_M)
        is_apart &= np.minimum(np.abs(cut_m - start_m[part]), np.abs(end_m[part] - cut_m)) >= STUB_M
        cut_l, part, used_l, cut_m = (
            cut_l[is_apart],
            part[is_apart],
            used_l[is_apart],
            cut_m[is_apart],
        )
        line, done_m = lines[part], np.abs(cut_m - start_m[part])
        done_s = many.parts_s(line, done_m)
        to = begun[:, part] + [
            done_s, many.pace_s_m[line] * done_m, (cut_l - used_l / 2.0) * done_s
        ]  # fmt: skip
        left_s = many.parts_s(line, np.abs(end_m[part] - cut_m))
        on = ends[:, part].copy()
        on[0] -= left_s
        on[1] = to[1]
        on[2] -= (cut_l + load[part]) / 2.0 * left_s

        order = np.argsort(np.concatenate([2 * part, 2 * np.arange(len(run)) + 1]), kind="stable")
        self.part = np.concatenate([part, np.arange(len(run))])[order]
        self.load = np.concatenate([cut_l, load])[order]
        self.at_m = np.concatenate([cut_m, end_m])[order]
        self.to = np.concatenate([to, ends], axis=1)[:, order]
        self.on = np.concatenate([on, joined], axis=1)[:, order]
        homes_m = many.homes_m(
            np.concatenate([lines, line, lines]), np.concatenate([start_m, cut_m, end_m])
        )
        homes_s = limits.landing_s / 2.0 + passes.times.legs_s(homes_m)
        start_s, end_s = homes_s[:, : len(run)], homes_s[:, len(run) :]
        none_s = np.zeros((len(homes_s), 1))
        self.first_s = start_s[:, 0]
        self.home_s = end_s[:, order]
        self.home_on_s = np.concatenate(
            [end_s[:, : len(part)], start_s[:, 1:], none_s], axis=1
        )[:, order]  # fmt: skip

    def _flown(self, one: int, other: int) -> Flown:
        """Return what a sortie from behind one place, -1 for the start, to another takes."""
        load, begun, out_s = 0.0, np.zeros(3), self.first_s
        if one >= 0:
            load, begun, out_s = float(self.load[one]), self.on[:, one], self.home_on_s[:, one]
        end_l, back_s = float(self.load[other]), self.home_s[:, other]
        depot = int((out_s + back_s).argmin())
        return _flown(
            self._limits, _Sum(*(self.to[:, other] - begun).tolist()),
            end_l=end_l, litres=end_l - load,
            out_s=float(out_s[depot]), back_s=float(back_s[depot]),
        )  # fmt: skip

    def by_tank(self) -> list[int] | None:
        """Return, for each place, from behind which one its sortie comes at the least time."""
        usable_l = self._limits.usable_l + 1e-9
        before = []
        # Of each depot: places from which a sortie may still come, the best of them first.
        all_waiting = [deque([(-1, 0.0, first_s)]) for first_s in self.first_s.tolist()]
        to_s = (self.to[0] + self.home_s).T.tolist()
        on_s = (self.home_on_s - self.on[0]).T.tolist()
        for at, (load, ends_s, begins_s) in enumerate(
            zip(self.load.tolist(), to_s, on_s, strict=True)
        ):
            known_s, from_at = math.inf, -1
            for waiting, end_s in zip(all_waiting, ends_s, strict=True):
                while waiting and waiting[0][1] < load - usable_l:
                    waiting.popleft()
                if waiting and waiting[0][2] + end_s < known_s:
                    known_s, from_at = waiting[0][2] + end_s, waiting[0][0]
            if not math.isfinite(known_s):
                return None
            before.append(from_at)
            for waiting, begin_s in zip(all_waiting, begins_s, strict=True):
                cost_s = known_s + begin_s
                while waiting and waiting[-1][2] >= cost_s:
                    waiting.pop()
                waiting.append((at, load, cost_s))
        return before

    def by_battery(self) -> list[int] | None:
        """Return the same where the battery must last for each sortie."""
        limits, battery = self._limits, self._limits.battery
        assert battery is not None
        count = len(self.load)
        load = np.concatenate([[0.0], self.load])
        outs_s = np.concatenate([self.first_s[:, None], self.home_on_s], axis=1)
        on_s, on_cruise_s, on_weight = np.concatenate([np.zeros((3, 1)), self.on], axis=1)
        to_s, to_cruise_s, to_weight = self.to
        longest_s = limits.usable_wh * J_WH / min(battery.hover_w, battery.cruise_w)
        # A sortie to a place begins behind one of these at the earliest; `known` begins at -1.
        first = np.maximum(
            np.searchsorted(load, load[1:] - limits.usable_l - 1e-9),
            np.searchsorted(np.maximum.accumulate(on_s), to_s - longest_s),
        )
        # The last place first: of sorties that take the same the first is the nearest one.
        known_s = np.full(count + 1, math.inf)
        known_s[count] = 0.0
        before: list[int] = []
        for block in range(0, count, BLOCK):
            end = min(block + BLOCK, count)
            low = min(int(first[block:end].min()), end - 1)
            some, rows = slice(low, end), slice(block, end)
            between_s = to_s[rows, None] - on_s[some]
            out_s, back_s = self._ferries_s(outs_s[:, some], self.home_s[:, rows])
            wh = _used_wh(
                limits, battery,
                between_s=between_s,
                cruise_s=to_cruise_s[rows, None] - on_cruise_s[some],
                gone=(load[1:][rows, None] * between_s, to_weight[rows, None] - on_weight[some]),
                litres=load[1:][rows, None] - load[some],
                out_s=out_s, back_s=back_s,
            )  # fmt: skip
            seconds = out_s + between_s + back_s
            place = np.arange(low, end)
            is_too_far = (place < first[rows, None]) | (place > np.arange(block, end)[:, None])
            seconds[is_too_far | ~(wh <= limits.usable_wh)] = math.inf
            begun_s = known_s[count - end + 1 : count - low + 1]
            for at, row in enumerate(np.ascontiguousarray(seconds[:, ::-1]), start=block):
                whole_s = begun_s + row
                best = int(whole_s.argmin())
                known_s[count - at - 1] = whole_s[best]
                before.append(end - best - 2)
        return before if math.isfinite(known_s[0]) else None

    @staticmethod
    def _ferries_s(outs_s: Floats, homes_s: Floats) -> tuple[Floats, Floats]:
        """Return the ferries from and to the best depot, of ends by beginnings of sorties."""
        out_s, back_s = outs_s[0][None, :], homes_s[0][:, None]
        for other_s, home_s in zip(outs_s[1:], homes_s[1:, :, None], strict=True):
            is_better = other_s + home_s < out_s + back_s
            out_s, back_s = np.where(is_better, other_s, out_s), np.where(is_better, home_s, back_s)
        return out_s, back_s

    def sorties(self, before: list[int]) -> tuple[float, list[list[Part]]]:
        """Return the time and the sorties that these choices lead to."""
        cuts = [len(self.load) - 1]
        while before[cuts[-1]] >= 0:
            cuts.append(before[cuts[-1]])
        cuts.reverse()
        seconds = sum(self._flown(one, other).seconds for one, other in pairwise([-1, *cuts]))
        found = []
        waiting = list(reversed(self._run))
        number = 0
        for cut in cuts:
            sortie: list[Part] = []
            part, at_m = int(self.part[cut]), float(self.at_m[cut])
            while number < part:
                sortie.append(waiting.pop())
                number += 1
            line, start_m, end_m = waiting.pop()
            sortie.append((line, start_m, at_m))
            if at_m == end_m:
                number += 1
            else:
                waiting.append((line, at_m, end_m))
            found.append(sortie)
        return seconds, found
