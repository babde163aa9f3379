"""Better sorties by laying a few neighbours out anew, again and again.

Large neighbourhood search (Shaw 1998): the parts of two to five neighbouring sorties are joined,
cut across elsewhere, flown to and fro, and split into sorties as it costs least. What takes no
longer is kept. All randomness comes from the seed, and the length is counted in trials.
"""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from itertools import chain

import numpy as np

from missions.bands import cut_across, outermost, to_and_fro
from missions.refills import TOUCH_M, Limits, Part, Passes, Place, flown_by, split
from missions.searching import steps

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
