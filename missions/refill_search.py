"""Orders of passes by bands: cut across, so that a tank ends on the side from which it came.

A sortie that flies one pass out and the next one back, both half a tank long, is empty where it
began. So passes are cut into bands of a whole share of a tank, and each band is flown to and fro.
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from itertools import chain, pairwise

import numpy as np

from missions.blocks import Blocks
from missions.corners import NOSE_DEG, Motion
from missions.demand import Demand
from missions.passes import TOUCH_M, Part, Passes, Place, Times, joined_parts, turned
from missions.plan import Settings
from missions.refills import STUB_M, Limits, flown_by, plainly, split
from missions.searching import steps
from missions.strips import Floats
from missions.ways import Ways

# ----------------------------------------------------------------------------------------- by bands

# What lies behind an obstacle by less than this is flown around; of so many chains the nearest.
AROUND, AROUND_M, NEAREST = 1.5, 30.0, 2
# Cuts of other lines than those along the course fall where they may.
PARALLEL = math.cos(math.radians(30.0))


def cut_across(
    passes: Passes, parts: Sequence[Part], course: tuple[float, float], cuts_m: Sequence[float]
) -> dict[int, list[Part]]:
    """Return parts by the band that they lie in, cut at these places along the course."""
    found: dict[int, list[Part]] = {}
    east, north = course
    for line, start_m, end_m in parts:
        x, y = passes.starts[line]
        u, v = passes.along[line]
        rise = u * east + v * north
        base_m = x * east + y * north
        low_m, high_m = min(start_m, end_m), max(start_m, end_m)
        places = [low_m]
        if abs(rise) > PARALLEL:
            crossed = sorted((cut - base_m) / rise for cut in cuts_m)
            places += [each for each in crossed if low_m + STUB_M < each < high_m - STUB_M]
        places.append(high_m)
        for one, other in pairwise(places):
            middle = base_m + rise * (one + other) / 2.0
            band = sum(cut < middle for cut in cuts_m) if cuts_m else 0
            found.setdefault(band, []).append((line, one, other))
    return found


def to_and_fro(passes: Passes, parts: Sequence[Part], *, first: int = 0) -> list[Part]:
    """Return parts such that each begins at the nearest end, from the end `first` on.

    Ends 2 i and 2 i + 1 are those of part i.
    """
    if len(parts) < 2:
        return list(parts)
    if len(parts) < FEW:
        return _few(passes, parts, first)
    ends = np.array(
        [passes.place(line, at_m) for line, start_m, end_m in parts for at_m in (start_m, end_m)]
    )
    x, y = ends[:, 0].copy(), ends[:, 1].copy()
    run, here = [], first
    for _ in parts:
        run.append(_entered(parts, here))
        east, north = ends[here ^ 1]
        x[here >> 1 << 1 : (here >> 1 << 1) + 2] = math.inf
        here = int(np.argmin((x - east) ** 2 + (y - north) ** 2))
    return run


# With fewer parts than this no arrays are made.
FEW = 40


def _few(passes: Passes, parts: Sequence[Part], first: int) -> list[Part]:
    places = [passes.place(line, at_m) for line, *both in parts for at_m in both]
    left = list(range(len(places)))
    run, here = [], first
    while True:
        run.append(_entered(parts, here))
        x, y = places[here ^ 1]
        left = [end for end in left if end >> 1 != here >> 1]
        if not left:
            return run
        here = min(left, key=lambda end: (places[end][0] - x) ** 2 + (places[end][1] - y) ** 2)


def _entered(parts: Sequence[Part], end: int) -> Part:
    line, start_m, end_m = parts[end >> 1]
    return (line, end_m, start_m) if end & 1 else (line, start_m, end_m)


def in_sight(passes: Passes, run: Sequence[Part]) -> list[list[Part]]:
    """Return a run in chains, cut where the next part lies behind what must be flown around."""
    chains = [[run[0]]]
    for before, after in pairwise(run):
        one, other = passes.place(before[0], before[2]), passes.place(after[0], after[1])
        straight_m = math.dist(one, other)
        if passes.gap_m(one, other) > AROUND * straight_m + AROUND_M:
            chains.append([])
        chains[-1].append(after)
    return chains


def linked(passes: Passes, chains: Sequence[list[Part]]) -> list[Part]:
    """Return chains one after the other, each time the one that is nearest to fly to."""
    left = [list(chain) for chain in chains]
    run = left.pop(0)
    while left:
        here = passes.place(run[-1][0], run[-1][2])
        ends = [
            (math.dist(here, passes.place(line, at_m)), number, is_turned)
            for number, chain in enumerate(left)
            for is_turned, (line, at_m) in enumerate(
                ((chain[0][0], chain[0][1]), (chain[-1][0], chain[-1][2]))
            )
        ]
        ends.sort()
        _, number, is_turned = min(
            ends[:NEAREST],
            key=lambda each: passes.gap_m(
                here,
                passes.place(left[each[1]][-1][0], left[each[1]][-1][2])
                if each[2]
                else passes.place(left[each[1]][0][0], left[each[1]][0][1]),
            ),
        )
        chain = left.pop(number)
        run += turned(chain) if is_turned else chain
    return run


def outermost(passes: Passes, parts: Sequence[Part], across: tuple[float, float]) -> int:
    """Return the end that lies farthest to one side."""
    east, north = across

    def aside(end: int) -> float:
        x, y = passes.place(parts[end >> 1][0], parts[end >> 1][1 + (end & 1)])
        return x * east + y * north

    return min(range(2 * len(parts)), key=aside)


def main_course(lines: Floats) -> tuple[float, float]:
    """Return the direction of most metres.

    >>> main_course(np.array([[0.0, 0.0, 0.0, 9.0], [0.0, 9.0, 3.0, 9.0], [3.0, 9.0, 3.0, 0.0]]))
    (0.0, 1.0)
    """
    step = lines[:, 2:] - lines[:, :2]
    length_m = np.hypot(*step.T)
    keys = np.round(np.degrees(np.arctan2(step[:, 1], step[:, 0])) % 180.0).astype(np.int64) % 180
    most = int(np.argmax(np.bincount(keys, weights=length_m)))
    some = np.flatnonzero(keys == most)
    at = int(some[np.argmax(length_m[some])])
    east, north = (step[at] / length_m[at]).tolist()
    return east, north


# --------------------------------------------------------------------------------------- the search

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
    blocks: Blocks | None = None,
) -> list[Sorties]:
    """Return sorties that fly the parts: the best ones, and plain ones that take hardly longer.

    `known` are sorties that were made elsewhere; all are timed as they are flown in the end. With
    `before`, sorties for which the battery did not last, the search goes on from these. With
    `blocks` they are these, as far as it costs no more than they are worth.
    """
    cost = partial(_cost_s, passes, limits, blocks)
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
    if is_ragged and blocks is not None and not before:
        found += _as_blocks(passes, limits, planned, blocks)
    if not found:
        return []
    costs = [sum(map(cost, some)) for some in found]
    best = found[costs.index(min(costs))]
    if is_ragged:
        return (
            [best, plain]
            if plain and plain is not best and costs[0] <= CLEARLY * min(costs)
            else [best]
        )
    parts = max(sum(len(sortie) for sortie in best) / len(best), PARTS_MIN)
    trials = min(int(moves / (MOVES_A_PART * parts)), TRIALS_A_SORTIE * len(best))
    better = regrouped(passes, limits, best, course, trials=trials, seed=seed, blocks=blocks)
    # What takes clearly longer by the search's model is not drawn and timed as it is flown.
    longest_s = CLEARLY * sum(map(cost, better))
    is_near = plain is not None and costs[0] <= longest_s
    return [better, plain] if plain and is_near else [better]


def _as_blocks(
    passes: Passes, limits: Limits, planned: Sequence[Part], blocks: Blocks
) -> list[Sorties]:
    """Return sorties that each fly a block, to and fro or as planned; none where none lasts."""
    rank = {part[0]: (at, part[1] > part[2]) for at, part in enumerate(planned)}
    found: Sorties = []
    short = _short(passes, merged(planned), limits.usable_l / SHORT_A_TANK)
    for block in blocks.grown(short, limits.usable_l):
        some = merged(block)
        near = to_and_fro(passes, some, first=outermost(passes, some, blocks.across))
        kept = [
            (line, end_m, start_m) if rank[line][1] else (line, start_m, end_m)
            for line, start_m, end_m in sorted(some, key=lambda part: rank[part[0]])
        ]
        ways = [linked(passes, in_sight(passes, run)) for run in (near, kept)]
        flown = [each for way in ways if (each := plainly(passes, limits, way)) is not None]
        if not flown:
            return []
        found += min(
            flown, key=lambda every: sum(flown_by(passes, limits, each).seconds for each in every)
        )
    return [found]


# A block is made of so many parts or more.
SHORT_A_TANK = 8


def _short(passes: Passes, parts: Sequence[Part], most_l: float) -> list[Part]:
    """Return the parts, cut so that none needs more."""
    found = []
    for line, start_m, end_m in parts:
        count = max(1, math.ceil(passes.need_l((line, start_m, end_m)) / most_l))
        cuts_m = np.linspace(start_m, end_m, count + 1).tolist()
        found += [(line, one, other) for one, other in pairwise(cuts_m)]
    return found


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
    blocks: Blocks | None = None,
) -> list[list[Part]]:
    """Return sorties that cost no more than those given, after so many trials."""
    if len(sorties) < 2 or trials <= 0:
        return list(sorties)
    draw = random.Random(seed)
    known = [list(sortie) for sortie in sorties]
    cost = partial(_cost_s, passes, limits, blocks)
    cost_s = [cost(sortie) for sortie in known]
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
        new, before_s = found[1], sum(cost_s[each] for each in some)
        if found[0] - before_s > allowed_s - LEAST_S:
            continue
        new_s = [cost(sortie) for sortie in new]
        change_s = sum(new_s) - before_s
        if change_s > allowed_s - LEAST_S:
            continue
        now_s += change_s
        if len(new) > len(some):
            known += [[] for _ in range(len(new) - len(some))]
            cost_s += [0.0] * (len(new) - len(some))
            more = np.zeros(len(new) - len(some))
            u, v = np.append(u, more), np.append(v, more)
            some += range(len(known) - len(more), len(known))
        for place, sortie, each_s in zip(some, new, new_s, strict=False):
            known[place], cost_s[place] = sortie, each_s
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


def _cost_s(passes: Passes, limits: Limits, blocks: Blocks | None, sortie: Sequence[Part]) -> float:
    """Return the time of a sortie, and what it counts as that it is no block."""
    apart_s = 0.0 if blocks is None else blocks.apart_s(sortie)
    return flown_by(passes, limits, sortie).seconds + apart_s


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
