"""One sortie for everything: the shortest tour, by local search with small kicks.

A tour is a ring of pieces, each entered at one of its two ends, with the depot as one of them. The
ring is improved until no part turned round and no run of up to three pieces moved elsewhere makes
it shorter (2-opt and Or-opt over near ends); then two neighbouring parts are exchanged, and what
that touched is improved again (Martin, Otto and Felten 1991). Only what is no longer is kept.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from itertools import chain, pairwise

import numpy as np

from missions.network import Ints, Network, rows_of
from missions.searching import steps
from missions.strips import Bools

NEAREST = 12
# Parts that a kick exchanges have so many pieces at most.
KICK_MAX = 30
RUN_MAX = 3
LEAST_S = 1e-7
# At first a kick may cost so much, at last nothing.
HOT_S = 3.0


def shortest_tour(network: Network, order: Sortie, *, kicks: int, seed: int = 1) -> Sortie:
    """Return the pieces in an order that takes no longer than the one given."""
    if len(order) < 3:
        return order
    ring = Ring(network, order)
    draw = random.Random(seed)
    best, now_s, best_s = ring.order(), 0.0, 0.0
    for number in steps("ways between lines", kicks):
        before = ring.ends.copy()
        touched, change_s = ring.kick(draw)
        change_s += ring.improve(touched)
        if change_s > HOT_S * (1.0 - number / kicks) * draw.random():
            ring.set(before)
            continue
        now_s += change_s
        if now_s < best_s - LEAST_S:
            best, best_s = ring.order(), now_s
    return best


class Ring:
    """The ends at which pieces are entered, one after the other; the depot is the last piece."""

    def __init__(self, network: Network, order: Sortie) -> None:
        depot = network.depot
        # The depot is a piece without length, both of whose ends are the same place.
        self._between = rows_of(network.ring_s)
        near = network.near[:, :NEAREST].tolist()
        home = np.argsort(network.between_s[depot, :depot], kind="stable")[:NEAREST].tolist()
        self._near: list[list[int]] = [*near, home, home]
        for row, some in zip(self._between, self._near, strict=True):
            some.sort(key=row.__getitem__)
        self._depot = depot
        self._at = [-1] * (depot // 2 + 1)
        self.ends: list[int] = []
        self.set([*order, depot])
        self.improve([end for enter in self.ends for end in (enter, enter ^ 1)])

    def leave_out(self, piece: int) -> float:
        """Take a piece out and improve what is left; return the change [s]."""
        place = self._at[piece]
        enter = self.ends[place]
        before, after = self.mate(enter), self.mate(enter ^ 1)
        between = self._between
        change_s = between[before][after] - between[before][enter] - between[enter ^ 1][after]
        self.set(self.ends[:place] + self.ends[place + 1 :])
        self._at[piece] = -1
        return change_s + self.improve([before, after])

    def set(self, ends: list[int]) -> None:
        """Take these ends; a piece of which there is none is nowhere."""
        self.ends = ends
        at = np.full(len(self._at), -1)
        at[np.array(ends) >> 1] = np.arange(len(ends))
        self._at = at.tolist()

    def order(self) -> Sortie:
        """Return the pieces from the depot on."""
        place = self._at[self._depot >> 1]
        return self.ends[place + 1 :] + self.ends[:place]

    def mate(self, end: int) -> int:
        """Return the end from or to which the way at this one leads."""
        ends, place = self.ends, self._at[end >> 1]
        if ends[place] == end:
            return ends[place - 1] ^ 1
        return ends[place + 1 - len(ends)]

    def improve(self, touched: list[int]) -> float:
        """Shorten the ring around these ends until nothing more is found; return the change."""
        total_s = 0.0
        waiting = set(touched)
        while touched:
            end = touched.pop()
            waiting.discard(end)
            found = self._better(end)
            if found is None:
                continue
            change_s, changed = found
            total_s += change_s
            for each in (end, *changed):
                if each not in waiting:
                    waiting.add(each)
                    touched.append(each)
        return total_s

    def _better(self, end: int) -> tuple[float, tuple[int, ...]] | None:
        """Make the first change that brings `end` and a near one together and shortens."""
        between, ends, places = self._between, self.ends, self._at
        mate, piece, count = self.mate(end), end >> 1, len(ends)
        is_entered = ends[places[piece]] == end
        row, from_mate = between[end], between[mate]
        old_s = row[mate]
        for other in self._near[end]:
            gain_s = old_s - row[other]
            if gain_s <= LEAST_S:
                break
            place = places[other >> 1]
            if other >> 1 == piece or other == mate or place < 0:
                continue
            # As `mate`, which this is called for far more often than for all else.
            is_other_entered = ends[place] == other
            beyond = ends[place - 1] ^ 1 if is_other_entered else ends[place + 1 - count]
            gain_s += between[other][beyond]
            if is_entered == is_other_entered:
                change_s = from_mate[beyond] - gain_s
                if change_s < -LEAST_S:
                    self._turn(end, other)
                    return change_s, (mate, other, beyond)
            found = self._moved(end, other, mate, beyond, gain_s)
            if found is not None:
                return found
        return None

    def _is_entered(self, end: int) -> bool:
        return self.ends[self._at[end >> 1]] == end

    def _turn(self, end: int, other: int) -> None:
        """Turn the pieces between two ends, both entered or both left, round."""
        first, last = sorted((self._at[end >> 1], self._at[other >> 1]))
        if self._is_entered(end):
            last -= 1
        else:
            first += 1
        ends = self.ends
        part = [enter ^ 1 for enter in reversed(ends[first : last + 1])]
        ends[first : last + 1] = part
        for place, enter in enumerate(part, first):
            self._at[enter >> 1] = place

    def _moved(
        self, end: int, other: int, mate: int, beyond: int, gain_s: float
    ) -> tuple[float, tuple[int, ...]] | None:
        """Move a run that begins with `end` between `other` and what is beyond."""
        between, ends = self._between, self.ends
        count, at = len(ends), self._at[end >> 1]
        step = 1 if ends[at] == end else -1
        place, one, two, from_mate = at, other >> 1, beyond >> 1, between[mate]
        for more in range(min(RUN_MAX, count - 3)):
            last = ends[place]
            if last >> 1 == one or last >> 1 == two:
                return None
            if step > 0:
                tail, place = last ^ 1, place + 1 if place + 1 < count else 0
                follows = ends[place]
            else:
                tail, place = last, place - 1 if place else count - 1
                follows = ends[place] ^ 1
            row = between[tail]
            change_s = row[beyond] + from_mate[follows]
            change_s -= row[follows] + gain_s
            if change_s < -LEAST_S:
                self._move(at, step, more, other, end)
                return change_s, (mate, other, beyond, tail, follows)
        return None

    def _move(self, at: int, step: int, more: int, other: int, end: int) -> None:
        count = len(self.ends)
        start = at if step > 0 else (at - more) % count
        ring = self.ends[start:] + self.ends[:start]
        run, rest = ring[: more + 1], ring[more + 1 :]
        try:
            place, entered = rest.index(other), True
        except ValueError:
            place, entered = rest.index(other ^ 1) + 1, False
        # `other` entered: the run comes before it, and is left at `end`; else it is entered there.
        if (run[-1] ^ 1 == end) != entered or (run[0] == end) == entered:
            run = [enter ^ 1 for enter in reversed(run)]
        self.set(rest[:place] + run + rest[place:])

    def kick(self, draw: random.Random) -> tuple[list[int], float]:
        """Exchange two parts that follow each other; return the ends touched, and the change."""
        count = len(self.ends)
        longest = max(1, min(KICK_MAX, (count - 1) // 2))
        one, two = draw.randint(1, longest), draw.randint(1, longest)
        if one + two > count - 1:
            two = count - 1 - one
        start = draw.randrange(count)
        ring = self.ends[start:] + self.ends[:start]
        parts = ring[:one], ring[one : one + two], ring[one + two :]
        first, second, rest = parts
        between = self._between
        old = ((rest[-1] ^ 1, first[0]), (first[-1] ^ 1, second[0]), (second[-1] ^ 1, rest[0]))
        new = ((rest[-1] ^ 1, second[0]), (second[-1] ^ 1, first[0]), (first[-1] ^ 1, rest[0]))
        change_s = sum(between[a][b] for a, b in new) - sum(between[a][b] for a, b in old)
        self.set(second + first + rest)
        return list(chain.from_iterable(old)), change_s


# Sorties by savings: join the two that gain most, again and again (Clarke and Wright 1964).
#
# A sortie is a list of ends at which its pieces are entered: 2 i flies piece i as it is drawn,
# 2 i + 1 against it; it is left at the other end, `enter ^ 1`.

Sortie = list[int]
Lasts = Callable[[Sortie], bool]


def by_savings(
    network: Network,
    capacity_l: float,
    *,
    lasts: Lasts | None = None,
    every_pair_max: int = 400,
) -> list[Sortie]:
    """Return sorties of at most `capacity_l` each, made of pieces that are joined end to end.

    With `lasts` no two are joined for which the battery would not last.
    """
    litres = network.litres.tolist()
    sorties: dict[int, Sortie] = {piece: [2 * piece] for piece in range(len(litres))}
    load = dict(enumerate(litres))
    sortie_of = list(range(len(litres)))
    # Ends between two pieces of a sortie are joined to no other: most pairs have such an end.
    is_outer = np.ones(network.depot, dtype=np.bool_)
    for one, other in _pairs(network, every_pair_max, is_outer):
        first, second = sortie_of[one >> 1], sortie_of[other >> 1]
        if len(sorties) == 1:
            break
        if first == second or load[first] + load[second] > capacity_l + 1e-9:
            continue
        head = _leaving(sorties[first], one)
        tail = _leaving(sorties[second], other)
        if head is None or tail is None:
            continue
        whole = head + turned(tail)
        if lasts is not None and not lasts(whole):
            continue
        sorties[first] = whole
        load[first] += load.pop(second)
        is_outer[[one, other]] = False
        for enter in sorties.pop(second):
            sortie_of[enter >> 1] = first
    return list(sorties.values())


# So many pairs at once are looked at for ends that are still outer ones.
PAIRS = 1024


def _pairs(network: Network, every_pair_max: int, is_outer: Bools) -> Iterator[tuple[int, int]]:
    """Yield the pairs of `_best_first`, without most of those that have no two outer ends."""
    rows, columns = _best_first(network, every_pair_max)
    for first in range(0, len(rows), PAIRS):
        some = slice(first, first + PAIRS)
        left = is_outer[rows[some]] & is_outer[columns[some]]
        yield from zip(rows[some][left].tolist(), columns[some][left].tolist(), strict=True)


def one_chain(network: Network, sorties: list[Sortie]) -> Sortie:
    """Return all sorties as one: each time the nearest one, either way round, comes next.

    Where there are many pieces only near ends are joined by savings, and some chains are left.
    """
    left = [list(sortie) for sortie in sorties]
    whole = left.pop(0)
    while left:
        row = network.between_s[whole[-1] ^ 1]
        nearest = min(left, key=lambda each: min(row[each[0]], row[each[-1] ^ 1]))
        left.remove(nearest)
        is_turned = row[nearest[-1] ^ 1] < row[nearest[0]]
        whole += turned(nearest) if is_turned else nearest
    return whole


def _best_first(network: Network, every_pair_max: int) -> tuple[Ints, Ints]:
    """Return pairs of ends of different pieces, those that save most when joined first."""
    count = network.depot
    if count <= every_pair_max:
        rows, columns = np.triu_indices(count, 1)
    else:
        rows = np.repeat(np.arange(count), network.near.shape[1])
        columns = network.near.ravel()
        keep = rows < columns
        rows, columns = rows[keep], columns[keep]
    other = (rows >> 1) != (columns >> 1)
    rows, columns = rows[other], columns[other]
    home, between = network.between_s[count], network.between_s
    saved = home[rows] + home[columns] - between[rows, columns]
    order = np.argsort(-saved, kind="stable")
    return rows[order], columns[order]


def _leaving(sortie: Sortie, end: int) -> Sortie | None:
    """Return the sortie in the direction in which it is left at this end; None if it is not."""
    if sortie[-1] ^ 1 == end:
        return sortie
    if sortie[0] == end:
        return turned(sortie)
    return None


def turned(sortie: Sortie) -> Sortie:
    """Return the sortie flown the other way.

    >>> turned([0, 5])
    [4, 1]
    """
    return [enter ^ 1 for enter in reversed(sortie)]


def cost_s(network: Network, sorties: list[Sortie]) -> float:
    """Return the time between the pieces of all sorties, ferries among it."""
    between, depot = network.between_s, network.depot
    total = 0.0
    for sortie in sorties:
        if sortie:
            total += between[depot, sortie[0]] + between[sortie[-1] ^ 1, depot]
            total += sum(between[a ^ 1, b] for a, b in pairwise(sortie))
    return float(total)
