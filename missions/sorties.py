"""From spray lines to sorties: cut by demand, ordered, and joined by free ways."""

from __future__ import annotations

from dataclasses import dataclass, replace
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
    run_in_m = settings.speed_m_s**2 / (2.0 * settings.acceleration_m_s2)
    pieces = cut(lines, demand, piece_max_l=_piece_max_l(demand, settings), margin_m=run_in_m)
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
        out = self._ways.home(depot, runs[0].start)
        legs = [self._leg("ferry", out)]
        for number, run in enumerate(runs):
            if number:
                legs.append(self._join(runs[number - 1], run))
            legs.append(self._leg("spray", [run.start, run.end], litres=run.litres))
        legs.append(self._leg("ferry", self._ways.home(depot, runs[-1].end)[::-1]))
        return tuple(legs)

    def _runs(self, order: Order) -> list[_Run]:
        """Return spray lines; pieces that follow each other are one."""
        runs: list[_Run] = []
        for enter in order:
            run = _Run(
                start=_place(self._ends[enter]),
                end=_place(self._ends[enter ^ 1]),
                litres=float(self._pieces.litres[enter >> 1]),
                line=int(self._pieces.line[enter >> 1]),
            )
            if runs and run.line == runs[-1].line and _far_m(runs[-1].end, run.start) < TOUCH_M:
                run = replace(run, start=runs[-1].start, litres=runs[-1].litres + run.litres)
                runs.pop()
            runs.append(run)
        return runs

    def _join(self, before: _Run, after: _Run) -> Leg:
        """Return the way from one line to the next: through, where neither has to stop."""
        is_on = before.line == after.line or _far_m(before.end, after.start) < JOIN_M
        if is_on and _is_straight(before, after):
            return self._leg("transit", [before.end, after.start], through=True)
        way, leaves = self._ways.between(before.end, after.start)
        return self._leg("ferry" if leaves else "transit", way)

    def _leg(
        self, kind: Kind, points: list[Place], *, litres: float = 0.0, through: bool = False
    ) -> Leg:
        motion = self._motion
        parts_m = [_far_m(a, b) for a, b in pairwise(points)]
        seconds = float(motion.legs_s(np.array(parts_m)).sum()) if parts_m else 0.0
        if through:
            seconds = sum(parts_m) / motion.speed_m_s - motion.speed_m_s / motion.acceleration_m_s2
        elif kind == "transit" and len(points) == 2:
            seconds = motion.between_passes_s(parts_m[0])
        return Leg(
            kind=kind, points=tuple(points), speed_m_s=motion.speed_m_s, seconds=seconds,
            volume_l=litres,
        )  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class _Run:
    """A spray line, or the part of one that is flown at once; `line` is which."""

    start: Place
    end: Place
    litres: float
    line: int


def _place(point: list[float]) -> Place:
    return point[0], point[1]


def _far_m(a: Place, b: Place) -> float:
    return float(np.hypot(b[0] - a[0], b[1] - a[1]))


def _is_straight(first: _Run, second: _Run) -> bool:
    """Return whether the aircraft flies from one line into the next without a turn."""
    way = np.subtract(second.start, first.end)
    one, two = np.subtract(first.end, first.start), np.subtract(second.end, second.start)
    cosine = float(one @ two) / float(np.hypot(*one) * np.hypot(*two))
    ahead = float(way @ one) >= 0.0 or float(np.hypot(*way)) < JOIN_M
    return ahead and bool(cosine > np.cos(np.radians(JOIN_DEG)))
