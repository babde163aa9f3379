"""Some lines as one tour: what they take in all, turns, detours and joins among it.

Layouts are compared by it. A count of turns would do for parallel lines, but not for borders whose
passes are flown one into the next, nor for holes and bays.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from missions.demand import Pieces
from missions.free_space import FreeSpace
from missions.network import Network, build_network
from missions.savings import Sortie, by_savings, cost_s, one_chain
from missions.strips import Floats, lengths_m
from missions.tour import shortest_tour
from missions.turns import Motion

# With more lines a plan has so many turns that one more or less does not count.
LINES_MAX = 500
# Few lines are searched for longer: 300 kicks for 40 of them, 20 for 155.
KICKS, KICKS_MIN, KICKS_MAX = 480_000, 20, 300


@dataclass(frozen=True, slots=True, kw_only=True)
class Tour:
    """Lines in the order `order`; the ways to the first and from the last are left out."""

    lines: Floats
    network: Network
    order: Sortie
    motion: Motion

    @property
    def seconds(self) -> float:
        """Return the time of all lines and of the ways between them."""
        flown_s = float(self.motion.legs_s(lengths_m(self.lines)).sum())
        return flown_s + cost_s(self.network, [self.order])


def tour_of(lines: Floats, space: FreeSpace, motion: Motion) -> Tour:
    """Return a good tour of some lines."""
    count = len(lines)
    pieces = Pieces(ends=lines, litres=np.zeros(count), line=np.arange(count))
    network = build_network(pieces, space, motion)
    order = one_chain(network, by_savings(network, 1.0))
    kicks = min(max(KICKS_MIN, KICKS // count**2), KICKS_MAX)
    order = shortest_tour(network, order, kicks=kicks)
    return Tour(lines=lines, network=network, order=order, motion=motion)
