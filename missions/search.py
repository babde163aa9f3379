"""Better sorties by local search: annealing over moves that bring near ends together.

All randomness comes from the seed, and the length is counted in moves, not in seconds: the same
field gives the same plan on any machine.
"""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from dataclasses import dataclass, field

from missions.network import Network
from missions.searching import below, steps
from missions.tour import Lasts, Sortie, turned

# The first moves may cost some twenty seconds of flight, the last ones next to nothing.
HOT_S, COLD_S = 20.0, 0.3
NEAREST = 12


@dataclass(slots=True)
class _State:
    """The sorties while they are changed; `of` says in which one each piece is.

    `end_litres` are those of the piece of each end.
    """

    between: list[Sequence[float]]
    near: list[list[int]]
    litres: list[float]
    capacity_l: float
    depot: int
    sorties: list[Sortie]
    lasts: Lasts | None = None
    end_litres: list[float] = field(default_factory=list)
    of: list[int] = field(default_factory=list)
    load: list[float] = field(default_factory=list)

    def fill(self) -> None:
        """Note where every piece is and how full every sortie."""
        self.end_litres = [litres for litres in self.litres for _ in range(2)]
        self.of = [0] * len(self.litres)
        self.load = [0.0] * len(self.sorties)
        for number in range(len(self.sorties)):
            self.note(number)

    def note(self, number: int) -> None:
        """Note one sortie anew."""
        sortie = self.sorties[number]
        of = self.of
        for enter in sortie:
            of[enter >> 1] = number
        self.load[number] = sum(map(self.end_litres.__getitem__, sortie))

    def fits(self, load_l: float) -> bool:
        """Return whether a tank holds this."""
        return load_l <= self.capacity_l + 1e-9

    def flies(self, *sorties: Sortie) -> bool:
        """Return whether a battery lasts for each of these."""
        return self.lasts is None or all(map(self.lasts, sorties))


def improve(
    network: Network,
    sorties: list[Sortie],
    capacity_l: float,
    *,
    moves: int,
    seed: int = 1,
    lasts: Lasts | None = None,
) -> list[Sortie]:
    """Return sorties that take no longer than those given, after so many attempted moves.

    With `lasts`, for each of which a battery lasts.
    """
    if moves <= 0 or len(network.litres) < 2:
        return sorties
    state = _State(
        between=network.rows,
        near=network.near[:, :NEAREST].tolist(),
        litres=network.litres.tolist(),
        capacity_l=capacity_l,
        depot=network.depot,
        sorties=[list(sortie) for sortie in sorties],
        lasts=lasts,
    )
    state.fill()
    draw = random.Random(seed)
    best, best_gain, gain = [list(sortie) for sortie in state.sorties], 0.0, 0.0
    cooling = (COLD_S / HOT_S) ** (1.0 / moves)
    heat = HOT_S
    for _ in steps("sorties", moves):
        heat *= cooling
        # A move is taken if it costs less than this: exponentially rare for a large cost.
        allowed = -heat * math.log(1.0 - draw.random())
        gain -= _attempt(state, draw, allowed)
        if gain > best_gain + 1e-6:
            best_gain, best = gain, [list(sortie) for sortie in state.sorties]
    return [sortie for sortie in best if sortie]


def _attempt(state: _State, draw: random.Random, allowed: float) -> float:
    """Try to bring an end and a near one together; return what it cost, 0 where it was left."""
    end = below(draw, state.depot)
    near = state.near[end]
    other = near[below(draw, len(near))]
    if end >> 1 == other >> 1:
        return 0.0
    kind = draw.random()
    if kind < 0.4:
        return _insert(state, draw, end, other, allowed)
    if state.of[end >> 1] == state.of[other >> 1]:
        return _turn_part(state, end, other, allowed)
    if kind < 0.75:
        return _link(state, end, other, allowed)
    return _exchange(state, end, other, allowed)


def _insert(state: _State, draw: random.Random, end: int, other: int, allowed: float) -> float:
    """Take a run of pieces out and put it beside another, so that `end` meets `other`.

    The run begins or ends with `end`, and has one to three pieces.
    """
    piece, target = end >> 1, other >> 1
    source, goal = state.of[piece], state.of[target]
    old = state.sorties[source]
    at = _index(old, piece)
    more = int(3.0 * draw.random() ** 2)
    start, stop = (at, at + 1 + more) if old[at] == end else (at - more, at + 1)
    start, stop = max(start, 0), min(stop, len(old))
    run = old[start:stop]
    if source == goal:
        if other in run or other ^ 1 in run:
            return 0.0
    elif not state.fits(state.load[goal] + sum(state.litres[enter >> 1] for enter in run)):
        return 0.0
    between, depot = state.between, state.depot
    before = old[start - 1] ^ 1 if start else depot
    after = old[stop] if stop < len(old) else depot
    cost = between[before][after] - between[before][run[0]] - between[run[-1] ^ 1][after]
    rest = old[:start] + old[stop:]
    into = rest if source == goal else state.sorties[goal]
    place = _index(into, target)
    if into[place] == other:  # the target is entered there: the run comes before it
        left, right = (into[place - 1] ^ 1 if place else depot), other
        new = run if run[-1] ^ 1 == end else turned(run)
    else:
        left = other
        new = run if run[0] == end else turned(run)
        place += 1
        right = into[place] if place < len(into) else depot
    cost += between[left][new[0]] + between[new[-1] ^ 1][right] - between[left][right]
    if cost >= allowed:
        return 0.0
    longer = [*into[:place], *new, *into[place:]]
    if not state.flies(longer):
        return 0.0
    state.sorties[source] = rest
    state.sorties[goal] = longer
    state.note(source)
    state.note(goal)
    return cost


def _turn_part(state: _State, end: int, other: int, allowed: float) -> float:
    """Turn round a part of one sortie, so that `end` meets `other`."""
    number = state.of[end >> 1]
    sortie = state.sorties[number]
    first, last = _index(sortie, end >> 1), _index(sortie, other >> 1)
    if first > last:
        first, last, end, other = last, first, other, end
    between, depot = state.between, state.depot
    if sortie[first] ^ 1 == end and sortie[last] ^ 1 == other:
        start, stop = first + 1, last + 1
    elif sortie[first] == end and sortie[last] == other:
        start, stop = first, last
    else:
        return 0.0
    left = sortie[start - 1] ^ 1 if start else depot
    right = sortie[stop] if stop < len(sortie) else depot
    into, out = sortie[start], sortie[stop - 1] ^ 1
    cost = between[left][out] + between[into][right] - between[left][into] - between[out][right]
    if cost >= allowed:
        return 0.0
    changed = sortie[:start] + turned(sortie[start:stop]) + sortie[stop:]
    if not state.flies(changed):
        return 0.0
    state.sorties[number] = changed
    return cost


def _link(state: _State, end: int, other: int, allowed: float) -> float:
    """Exchange the rests of two sorties, so that one goes on from `end` at `other`."""
    one, two = state.of[end >> 1], state.of[other >> 1]
    first, second = state.sorties[one], state.sorties[two]
    if first[_index(first, end >> 1)] == end:
        first = turned(first)
    if second[_index(second, other >> 1)] != other:
        second = turned(second)
    cut, join = _index(first, end >> 1) + 1, _index(second, other >> 1)
    litres = state.litres
    moved = sum(litres[enter >> 1] for enter in first[cut:])
    taken = sum(litres[enter >> 1] for enter in second[join:])
    if not (
        state.fits(state.load[one] - moved + taken) and state.fits(state.load[two] - taken + moved)
    ):
        return 0.0
    between, depot = state.between, state.depot
    onward = first[cut] if cut < len(first) else depot
    back = second[join - 1] ^ 1 if join else depot
    cost = between[end][other] + between[back][onward]
    cost -= between[end][onward] + between[back][other]
    if cost >= allowed:
        return 0.0
    joint, rest = first[:cut] + second[join:], second[:join] + first[cut:]
    if not state.flies(joint, rest):
        return 0.0
    state.sorties[one], state.sorties[two] = joint, rest
    state.note(one)
    state.note(two)
    return cost


def _exchange(state: _State, end: int, other: int, allowed: float) -> float:
    """Exchange a piece with the neighbour of another, so that `end` meets `other`."""
    one, two = state.of[end >> 1], state.of[other >> 1]
    first, second = state.sorties[one], state.sorties[two]
    at, target = _index(first, end >> 1), _index(second, other >> 1)
    if second[target] == other:
        place, new = target - 1, end ^ 1
    else:
        place, new = target + 1, end
    if not 0 <= place < len(second):
        return 0.0
    mine, theirs = first[at], second[place]
    more = state.litres[theirs >> 1] - state.litres[mine >> 1]
    if not (state.fits(state.load[one] + more) and state.fits(state.load[two] - more)):
        return 0.0
    turn = min((theirs, theirs ^ 1), key=lambda enter: _around(state, first, at, enter))
    cost = _around(state, first, at, turn) - _around(state, first, at, mine)
    cost += _around(state, second, place, new) - _around(state, second, place, theirs)
    if cost >= allowed:
        return 0.0
    first[at], second[place] = turn, new
    if not state.flies(first, second):
        first[at], second[place] = mine, theirs
        return 0.0
    state.note(one)
    state.note(two)
    return cost


def _around(state: _State, sortie: Sortie, at: int, enter: int) -> float:
    """Return the time to and from a piece at this place of a sortie."""
    before = sortie[at - 1] ^ 1 if at else state.depot
    after = sortie[at + 1] if at + 1 < len(sortie) else state.depot
    return state.between[before][enter] + state.between[enter ^ 1][after]


def _index(sortie: Sortie, piece: int) -> int:
    """Return where in a sortie a piece is flown."""
    try:
        return sortie.index(2 * piece)
    except ValueError:
        return sortie.index(2 * piece + 1)
