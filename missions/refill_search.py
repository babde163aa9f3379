"""Sorties for several tanks: plainly in the planned order, cut elsewhere, by bands, regrouped."""

from __future__ import annotations

import math
import random
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain

import numpy as np

from missions.bands import (
    cut_across,
    in_sight,
    linked,
    main_course,
    outermost,
    to_and_fro,
)
from missions.corners import Motion
from missions.demand import Demand
from missions.passes import NOSE_DEG, TOUCH_M, Part, Passes, Place, Times, joined_parts
from missions.plan import Settings
from missions.refills import Limits, flown_by, plainly, split
from missions.searching import steps
from missions.strips import Floats
from missions.ways import Ways

Sorties = list[list[Part]]

# A tank is flown in so many lines of one band, beginning so many shares of a band from the depot.
LINES_A_TANK = {2: 8, 4: 4, 6: 4}
# Bands are this wide or more: a turn in each must be worth it.
BAND_MIN_M = 40.0
# A part in a sortie that is regrouped takes as long as so many moves of the annealing; sorties of
# few parts have a trial's own costs. A sortie needs no more trials than some.
MOVES_A_PART, PARTS_MIN, TRIALS_A_SORTIE = 8, 3.3, 60
# A search that goes on from sorties that were found before needs fewer.
AGAIN = 4
# With so many parts and more, and more than so many in a sortie, most are short lines around what
# was left out: in their order as one tour they are flown 1 to 7 % quicker than in bands, and what
# is flown to and fro is not better after any number of trials.
RAGGED_MIN, RAGGED = 500, 20
# The search knows the time of a flight to a few percent.
CLEARLY = 1.1
# The way home is known at places so far apart along lines that the depot does not see.
BENT_STEP_M, BENT_MAX = 100.0, 2000


def build_passes(
    lines: Floats, demand: Sequence[Demand], ways: Ways, motion: Motion, pace_s_m: Floats | None
) -> Passes:
    """Return lines that may be flown in any parts."""
    pace = np.full(len(lines), 1.0 / motion.speed_m_s) if pace_s_m is None else pace_s_m
    passes = Passes(
        lines=lines, demand=demand, times=Times(motion),
        depots=[(float(x), float(y)) for x, y in ways.depots],
        pace_s_m=pace.tolist(), speed_m_s=motion.speed_m_s, space=ways.inside,
    )  # fmt: skip
    if ways.are_straight:
        return passes
    total_m = sum(passes.length_m)
    step_m = max(BENT_STEP_M, total_m / BENT_MAX)
    counts = [max(math.ceil(length_m / step_m), 1) + 1 for length_m in passes.length_m]
    places = np.concatenate(
        [
            row[:2] + np.linspace(0.0, 1.0, count)[:, None] * (row[2:] - row[:2])
            for row, count in zip(lines, counts, strict=True)
        ]
    )
    homes_m = ways.home_ways_m(places)
    straight_m = np.hypot(*(places[None, :, :] - ways.depots[:, None, :]).transpose(2, 0, 1))
    is_bent = (homes_m > straight_m + 1e-6).any(axis=0)
    begin = 0
    for line, count in enumerate(counts):
        if is_bent[begin : begin + count].any():
            passes.bent_m[line] = homes_m[:, begin : begin + count].tolist()
        begin += count
    return passes


def build_limits(settings: Settings, battery_share: float) -> Limits:
    """Return what ends a sortie; of a battery this share is planned with."""
    upright_s = settings.upright_s
    nose_s = 0.0
    if settings.nose_rate_deg_s is not None and settings.turn == "stop":
        nose_s = NOSE_DEG / settings.nose_rate_deg_s
    battery = settings.battery
    if battery is not None and battery.capacity_wh is None:
        battery = None
    return Limits(
        usable_l=settings.usable_l, reserve_l=settings.reserve_l,
        landing_s=upright_s + settings.refill_s, upright_s=upright_s, nose_s=nose_s,
        reaching_s=settings.motion.at(settings.speed_m_s).reaching_s,
        battery=battery,
        usable_wh=math.inf if battery is None else battery.usable_wh * battery_share,
    )  # fmt: skip


def several(
    passes: Passes,
    limits: Limits,
    planned: Sequence[Part],
    known: Sequence[Sorties],
    *,
    before: Sequence[list[Part]] = (),
    moves: int,
    seed: int,
) -> list[Sorties]:
    """Return sorties that fly the parts: the best ones, and plain ones that take hardly longer.

    `known` are sorties that were made elsewhere; all are timed as they are flown in the end. With
    `before`, sorties for which the battery did not last, the search goes on from these.
    """
    plain = plainly(passes, limits, planned)
    found = [each for each in (plain, *known) if each]
    course = main_course(passes.lines)
    is_ragged = _is_ragged([*chain.from_iterable(before)] or planned, before or plain or ())
    if before:
        runs: Iterable[list[Part]] = [joined_parts([*chain.from_iterable(before)])]
        moves //= AGAIN
    elif is_ragged:
        runs = [list(planned)]
    else:
        runs = chain([list(planned)], _by_bands(passes, limits, planned, course))
    for run in runs:
        halves = split(passes, limits, run)
        if halves is not None:
            found.append(halves[1])
    if not found:
        return []
    costs = [sum(flown_by(passes, limits, each).seconds for each in some) for some in found]
    best = found[costs.index(min(costs))]
    if is_ragged:
        return (
            [best, plain]
            if plain and plain is not best and costs[0] <= CLEARLY * min(costs)
            else [best]
        )
    parts = max(sum(len(sortie) for sortie in best) / len(best), PARTS_MIN)
    trials = min(int(moves / (MOVES_A_PART * parts)), TRIALS_A_SORTIE * len(best))
    better = regrouped(passes, limits, best, course, trials=trials, seed=seed)
    # What takes clearly longer by the search's model is not drawn and timed as it is flown.
    longest_s = CLEARLY * sum(flown_by(passes, limits, each).seconds for each in better)
    is_near = plain is not None and costs[0] <= longest_s
    return [better, plain] if plain and is_near else [better]


def _is_ragged(parts: Sequence[Part], sorties: Sequence[list[Part]]) -> bool:
    """Return whether parts are many and short: no band, flown to and fro, orders them as well."""
    return len(parts) > RAGGED_MIN and len(parts) > RAGGED * len(sorties)


def beside(
    passes: Passes, sorties: Sequence[list[Part]], some: Sequence[int], count: int
) -> list[int]:
    """Return which sorties are some of them, or one of so many nearest to each of these."""
    at = np.array([middle(passes, sortie) for sortie in sorties])
    found = set(some)
    for one in some:
        far_m = np.hypot(*(at - at[one]).T)
        far_m[list(some)] = np.inf
        found.update(np.argsort(far_m, kind="stable")[:count].tolist())
    return sorted(found)


def _by_bands(
    passes: Passes, limits: Limits, planned: Sequence[Part], course: tuple[float, float]
) -> Iterator[list[Part]]:
    """Yield orders of the parts by bands across the course."""
    east, north = course
    parts = merged(planned)
    litres = sum(passes.need_l(part) for part in parts)
    metres = sum(abs(end_m - start_m) for _, start_m, end_m in parts)
    tank_m = metres * limits.usable_l / litres if litres > 0.0 else metres
    if limits.battery is not None:
        tank_m = min(tank_m, _battery_m(passes, limits))
    ends = (passes.lines.reshape(-1, 2) @ np.array(course)).tolist()
    low_m, high_m = min(ends), max(ends)
    home_m = sorted(x * east + y * north for x, y in passes.depots)[len(passes.depots) // 2]
    widths = [(tank_m / lines, shifts) for lines, shifts in LINES_A_TANK.items()]
    for width_m, shifts in [(math.inf, 1), *widths]:
        if width_m < BAND_MIN_M or high_m - low_m < width_m < math.inf:
            continue
        for shift in range(shifts):
            cuts = []
            if math.isfinite(width_m):
                first = home_m + shift / shifts * width_m
                first += math.ceil((low_m - first) / width_m) * width_m
                cuts = np.arange(first, high_m, width_m).tolist()
            chains: list[list[Part]] = []
            bands = cut_across(passes, parts, course, cuts)
            for band in sorted(bands):
                start = outermost(passes, bands[band], (-north, east))
                chains += in_sight(passes, to_and_fro(passes, bands[band], first=start))
            yield linked(passes, chains)


def _battery_m(passes: Passes, limits: Limits) -> float:
    """Return how far a battery lasts for, take-off, landing and the way home left out."""
    assert limits.battery is not None
    seconds = 3600.0 * limits.usable_wh / max(limits.battery.cruise_w, 1.0) - limits.upright_s
    return max(seconds, 1.0) * passes.speed_m_s


# Better sorties by laying a few neighbours out anew, again and again.
#
# Large neighbourhood search (Shaw 1998): the parts of two to five neighbouring sorties are joined,
# cut across elsewhere, flown to and fro, and split into sorties as it costs least. What takes no
# longer is kept. All randomness comes from the seed, and the length is counted in trials.

# So many sorties are laid out together; neighbours are looked for along and across the course by
# these weights: sorties of one band, or those behind each other on the same passes.
TOGETHER = (2, 2, 3, 3, 4, 5)
WEIGHTS = (0.03, 0.15, 0.5, 1.0)
# Fewer places to cut at than for a whole field: trials are many.
SHARES, TANKS = 3, 1
LEAST_S = 1e-3
# At first a layout may cost so much more than the one before, at last nothing.
HOT_S = 6.0


def regrouped(
    passes: Passes,
    limits: Limits,
    sorties: Sequence[list[Part]],
    course: tuple[float, float],
    *,
    trials: int,
    seed: int = 1,
) -> list[list[Part]]:
    """Return sorties that take no longer than those given, after so many trials."""
    if len(sorties) < 2 or trials <= 0:
        return list(sorties)
    draw = random.Random(seed)
    known = [list(sortie) for sortie in sorties]
    cost_s = [flown_by(passes, limits, sortie).seconds for sortie in known]
    at = np.array([middle(passes, sortie) for sortie in known])
    along, across = np.array(course), np.array([-course[1], course[0]])
    u, v = at @ along, at @ across
    best, best_s, now_s = [list(each) for each in known], 0.0, 0.0
    for number in steps("neighbouring sorties", trials):
        one = draw.randrange(len(known))
        weight = draw.choice(WEIGHTS)
        count = min(draw.choice(TOGETHER), len(known))
        far = ((u - u[one]) * weight) ** 2 + (v - v[one]) ** 2
        some = np.argpartition(far, count - 1)[:count].tolist()
        some.sort()
        parts = merged(chain.from_iterable(known[each] for each in some))
        run = _laid_out(passes, limits, parts, course, draw)
        found = split(passes, limits, run, shares=SHARES, tanks=TANKS)
        if found is None:
            continue
        allowed_s = -HOT_S * (1.0 - number / trials) * math.log(1.0 - draw.random())
        change_s = found[0] - sum(cost_s[each] for each in some)
        if change_s > allowed_s - LEAST_S:
            continue
        now_s += change_s
        new = found[1]
        if len(new) > len(some):
            known += [[] for _ in range(len(new) - len(some))]
            cost_s += [0.0] * (len(new) - len(some))
            more = np.zeros(len(new) - len(some))
            u, v = np.append(u, more), np.append(v, more)
            some += range(len(known) - len(more), len(known))
        for place, sortie in zip(some, new, strict=False):
            known[place] = sortie
            cost_s[place] = flown_by(passes, limits, sortie).seconds
            at_place = middle(passes, sortie)
            u[place], v[place] = at_place @ along, at_place @ across
        for place in sorted(some[len(new) :], reverse=True):
            known[place], cost_s[place] = known[-1], cost_s[-1]
            u[place], v[place] = u[-1], v[-1]
            known.pop()
            cost_s.pop()
            u, v = u[:-1], v[:-1]
        if now_s < best_s - LEAST_S:
            best, best_s = list(known), now_s
    return best


def merged(parts: Sequence[Part] | chain[Part]) -> list[Part]:
    """Return the parts of lines, those that touch as one.

    >>> merged([(0, 9.0, 5.0), (1, 0.0, 4.0), (0, 2.0, 5.0)])
    [(0, 2.0, 9.0), (1, 0.0, 4.0)]
    """
    found: list[Part] = []
    for line, start_m, end_m in sorted((line, min(a, b), max(a, b)) for line, a, b in parts):
        if found and found[-1][0] == line and start_m - found[-1][2] < TOUCH_M:
            found[-1] = (line, found[-1][1], max(end_m, found[-1][2]))
        else:
            found.append((line, start_m, end_m))
    return found


def _laid_out(
    passes: Passes, limits: Limits, parts: list[Part], course: tuple[float, float],
    draw: random.Random,
) -> list[Part]:  # fmt: skip
    """Return the parts cut and ordered in a way that is drawn."""
    east, north = course
    ends = [
        x * east + y * north
        for line, *both in parts
        for x, y in (passes.place(line, at_m) for at_m in both)
    ]
    low, high = min(ends), max(ends)
    home = min(
        (x * east + y * north for x, y in passes.depots),
        key=lambda each: abs(each - (low + high) / 2.0),
    )
    near, far = (low, high) if home < (low + high) / 2.0 else (high, low)
    outward = 1.0 if far > near else -1.0
    tank_m = _tank_m(passes, limits, parts)
    kind = draw.random()
    cuts: list[float] = []
    if kind < 0.15:
        pass
    elif kind < 0.45:
        cuts = [draw.uniform(low, high)]
    elif kind < 0.55:
        cuts = [draw.choice(ends)]
    elif kind < 0.65:
        cuts = [draw.uniform(low, high), draw.uniform(low, high)]
    else:
        step = tank_m / draw.choice((2, 2, 2, 4, 6))
        begin = draw.choice((near, near + outward * draw.random() * step, draw.choice(ends)))
        cuts = [begin + outward * many * step for many in range(-6, 7)]
        cuts = [cut for cut in cuts if low < cut < high]
    cuts.sort()
    aside = (-north, east) if draw.random() < 0.5 else (north, -east)
    run: list[Part] = []
    bands = cut_across(passes, parts, course, cuts)
    for band in sorted(bands, reverse=draw.random() < 0.5):
        some = bands[band]
        first = outermost(passes, some, aside)
        if draw.random() < 0.5:
            first ^= 1
        run += to_and_fro(passes, some, first=first)
    return run


def _tank_m(passes: Passes, limits: Limits, parts: Sequence[Part]) -> float:
    """Return how many metres of these parts a tank sprays."""
    metres = sum(abs(end_m - start_m) for _, start_m, end_m in parts)
    litres = sum(passes.need_l(part) for part in parts)
    return metres * limits.usable_l / litres if litres > 0.0 else metres


def middle(passes: Passes, sortie: Sequence[Part]) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Return the middle of the ground that a sortie sprays."""
    weight = sum(abs(end_m - start_m) for _, start_m, end_m in sortie) or 1.0
    x = y = 0.0
    for line, start_m, end_m in sortie:
        place: Place = passes.place(line, (start_m + end_m) / 2.0)
        share = abs(end_m - start_m) / weight
        x, y = x + share * place[0], y + share * place[1]
    return np.array([x, y])
