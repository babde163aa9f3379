"""From spray lines to sorties: cut by demand, ordered, and joined by free ways."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from missions.demand import Demand, Pieces, cut
from missions.errors import PlanError
from missions.network import JOIN_DEG, JOIN_M, Network, build_network
from missions.plan import Kind, Leg, Place, Settings, Sortie
from missions.savings import Sortie as Order
from missions.savings import by_savings
from missions.search import improve
from missions.strips import Floats
from missions.turns import Motion
from missions.ways import Ways

# A tank is flown in so many pieces or more, so that cuts need not fall where a line ends.
PIECES_A_TANK = 6
PIECES_MAX = 600
TANKS_MAX = 1500
TOUCH_M = 1e-3


def plan_sorties(
    lines: Floats, demand: list[Demand], ways: Ways, settings: Settings, motion: Motion
) -> tuple[Sortie, ...]:
    """Return all sorties, each within a tank."""
    pieces = cut(lines, demand, piece_max_l=_piece_max_l(demand, settings))
    heaviest = float(pieces.litres.max(initial=0.0))
    if not heaviest <= settings.usable_l * (1.0 + 1e-9):
        raise PlanError(
            f"one piece of a line needs {heaviest:.3g} L and the tank has {settings.usable_l:.3g} "
            "L above its reserve; see mission.tank_l"
        )
    network = build_network(pieces, ways.depots, ways.inside, motion)
    orders = by_savings(network, settings.usable_l)
    orders = improve(network, orders, settings.usable_l, moves=settings.moves, seed=settings.seed)
    homes = [_home(network, order) for order in orders]
    ranked = sorted(range(len(orders)), key=lambda at: (homes[at], min(orders[at])))
    drawn = _Drawn(pieces=pieces, ways=ways, motion=motion)
    return tuple(
        Sortie(number=number, depot=homes[at], legs=drawn.legs(orders[at], homes[at]))
        for number, at in enumerate(ranked, start=1)
    )


def _piece_max_l(demand: list[Demand], settings: Settings) -> float:
    """Return how much one piece may need: everything where one tank is enough for all."""
    total_l = sum(need.total_l for need in demand)
    usable_l = settings.usable_l
    if total_l <= usable_l:
        return usable_l
    if not total_l / usable_l <= TANKS_MAX:
        raise PlanError(
            f"the field needs {total_l:.4g} L, which are {total_l / usable_l:.0f} tanks of "
            f"{usable_l:.4g} L above the reserve; see mission.tank_l and the unit of the rates"
        )
    length_m = sum(float(need.at_m[-1]) for need in demand)
    run_m = length_m * usable_l / total_l
    if not run_m >= settings.speed_m_s**2 / settings.acceleration_m_s2:
        raise PlanError(
            f"a tank of {usable_l:.3g} L above the reserve lasts {run_m:.3g} m of line, less than "
            "speeding up and braking take; see mission.tank_l and the unit of the rates"
        )
    for pieces_a_tank in range(PIECES_A_TANK, 0, -1):
        if total_l / usable_l * pieces_a_tank <= PIECES_MAX:
            return usable_l / pieces_a_tank
    return usable_l


def _home(network: Network, order: Order) -> int:
    """Return the depot from which a sortie is nearest, there and back."""
    return int(np.argmin(network.home_s[:, order[0]] + network.home_s[:, order[-1] ^ 1]))


class _Drawn:
    """Legs of an order of pieces."""

    def __init__(self, *, pieces: Pieces, ways: Ways, motion: Motion) -> None:
        self._ends = pieces.ends.reshape(-1, 2).tolist()
        self._pieces = pieces
        self._ways = ways
        self._motion = motion

    def legs(self, order: Order, depot: int) -> tuple[Leg, ...]:
        """Return the legs from the depot along all pieces and back."""
        runs = self._runs(order)
        out = self._ways.home(depot, runs[0][0])
        legs = [self._leg("ferry", out)]
        for number, (start, end, litres) in enumerate(runs):
            if number:
                previous = runs[number - 1]
                way, leaves = self._ways.between(previous[1], start)
                through = _is_through(previous, (start, end, litres))
                legs.append(self._leg("ferry" if leaves else "transit", way, through=through))
            legs.append(self._leg("spray", [start, end], litres=litres))
        legs.append(self._leg("ferry", self._ways.home(depot, runs[-1][1])[::-1]))
        return tuple(legs)

    def _runs(self, order: Order) -> list[tuple[Place, Place, float]]:
        """Return start, end and litres of spray lines; pieces that follow each other are one."""
        runs: list[tuple[Place, Place, float]] = []
        line_before = -1
        for enter in order:
            start, end = (_place(self._ends[enter]), _place(self._ends[enter ^ 1]))
            litres = float(self._pieces.litres[enter >> 1])
            line = int(self._pieces.line[enter >> 1])
            if runs and line == line_before and _far_m(runs[-1][1], start) < TOUCH_M:
                runs[-1] = (runs[-1][0], end, runs[-1][2] + litres)
            else:
                runs.append((start, end, litres))
            line_before = line
        return runs

    def _leg(
        self, kind: Kind, points: list[Place], *, litres: float = 0.0, through: bool = False
    ) -> Leg:
        motion = self._motion
        parts_m = [_far_m(a, b) for a, b in pairwise(points)]
        seconds = float(motion.legs_s(np.array(parts_m)).sum()) if parts_m else 0.0
        if through:
            seconds = -motion.speed_m_s / motion.acceleration_m_s2
        elif kind == "transit" and len(points) == 2:
            seconds = motion.between_passes_s(parts_m[0])
        return Leg(
            kind=kind, points=tuple(points), speed_m_s=motion.speed_m_s, seconds=seconds,
            volume_l=litres,
        )  # fmt: skip


def _place(point: list[float]) -> Place:
    return point[0], point[1]


def _far_m(a: Place, b: Place) -> float:
    return float(np.hypot(b[0] - a[0], b[1] - a[1]))


def _is_through(first: tuple[Place, Place, float], second: tuple[Place, Place, float]) -> bool:
    """Return whether the aircraft flies from one line into the next without a stop."""
    if not _far_m(first[1], second[0]) < JOIN_M:
        return False
    one = np.subtract(first[1], first[0])
    two = np.subtract(second[1], second[0])
    cosine = float(one @ two) / float(np.hypot(*one) * np.hypot(*two))
    return bool(cosine > np.cos(np.radians(JOIN_DEG)))
