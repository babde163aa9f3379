"""Sorties by savings: join the two that gain most, again and again (Clarke and Wright 1964).

A sortie is a list of ends at which its pieces are entered: 2 i flies piece i as it is drawn,
2 i + 1 against it; it is left at the other end, `enter ^ 1`.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from missions.network import Network

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
    for one, other in _best_first(network, every_pair_max):
        first, second = sortie_of[one >> 1], sortie_of[other >> 1]
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
        for enter in sorties.pop(second):
            sortie_of[enter >> 1] = first
    return list(sorties.values())


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


def _best_first(network: Network, every_pair_max: int) -> list[tuple[int, int]]:
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
    return list(zip(rows[order].tolist(), columns[order].tolist(), strict=True))


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
