"""From spray lines to sorties: cut by demand, ordered, and joined by free ways."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely

from missions.budget import Budget, build_budget
from missions.demand import Demand, Pieces, cut
from missions.energy import J_WH, KG_L
from missions.errors import PlanError
from missions.network import (
    ACROSS_M,
    JOIN_DEG,
    JOIN_M,
    STRAIGHT_M,
    Network,
    build_network,
)
from missions.plan import Kind, Leg, Place, Settings, Sortie
from missions.savings import Sortie as Order
from missions.savings import by_savings, one_chain
from missions.search import improve
from missions.strips import Floats, lengths_m
from missions.tour import shortest_tour
from missions.turns import Motion
from missions.ways import Ways

# A tank is flown in so many pieces or more, so that cuts need not fall where a line ends.
PIECES_A_TANK = 6
PIECES_MAX = 600
TANKS_MAX = 1500
TOUCH_M = 1e-3
# What one kick of a tour takes, counted in moves of the search over many sorties.
MOVES_A_KICK = 100


@dataclass(frozen=True, slots=True, kw_only=True)
class Flying:
    """How lines are flown: `pace_s_m` is the time of a metre of each line, where rates slow it.

    `battery_share` is how much of what the battery may give a sortie is planned with: the search
    knows turns and speeds only nearly. With `any_depot` the depots are a choice, of which one is
    taken when the sortie is known.
    """

    motion: Motion
    pace_s_m: Floats | None = None
    battery_share: float = 1.0
    any_depot: bool = False


def plan_sorties(
    lines: Floats, demand: list[Demand], ways: Ways, settings: Settings, flying: Flying
) -> tuple[Sortie, ...]:
    """Return all sorties, each within a tank and a battery."""
    motion = flying.motion
    run_in_m = settings.speed_m_s**2 / (2.0 * settings.acceleration_m_s2)
    pieces = cut(
        lines, demand, piece_max_l=_piece_max_l(demand, settings),
        piece_max_m=_piece_max_m(demand, settings, flying), margin_m=run_in_m,
    )  # fmt: skip
    heaviest = float(pieces.litres.max(initial=0.0))
    if not heaviest <= settings.usable_l * (1.0 + 1e-9):
        raise PlanError(
            f"one piece of a line needs {heaviest:.3g} L and the tank has {settings.usable_l:.3g} "
            "L above its reserve; see mission.tank_l"
        )
    network = build_network(pieces, ways.depots, ways.inside, motion, refill_s=settings.refill_s)
    if flying.any_depot:
        network.put_depot_anywhere()
    budget = _budget(network, pieces, settings, flying)
    lasts = None if budget is None else budget.lasts
    if budget is not None:
        _check_reach(budget, pieces, ways, settings)
    orders = by_savings(network, settings.usable_l, lasts=lasts)
    if lasts is None and float(pieces.litres.sum()) <= settings.usable_l:
        order = one_chain(network, orders)
        kicks = settings.moves // MOVES_A_KICK
        orders = [shortest_tour(network, order, kicks=kicks, seed=settings.seed)]
    else:
        orders = improve(
            network, orders, settings.usable_l, moves=settings.moves, seed=settings.seed,
            lasts=lasts,
        )  # fmt: skip
    homes = [_home(network, order) for order in orders]
    ranked = sorted(range(len(orders)), key=lambda at: (homes[at], min(orders[at])))
    drawn = _Drawn(pieces=pieces, ways=ways, speed_m_s=motion.speed_m_s)
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


def _piece_max_m(demand: Sequence[Demand], settings: Settings, flying: Flying) -> float:
    """Return how long one piece may be, so that some fit into what a battery gives."""
    battery = settings.battery
    if battery is None or battery.capacity_wh is None:
        return math.inf
    length_m = sum(float(need.at_m[-1]) for need in demand)
    drawn_w = battery.cruise_w + battery.per_kg_w * settings.tank_l * KG_L
    run_m = battery.usable_wh * J_WH / drawn_w * flying.motion.speed_m_s
    least_m = length_m / PIECES_MAX
    return max(run_m / PIECES_A_TANK, least_m, settings.speed_m_s**2 / settings.acceleration_m_s2)


def _budget(network: Network, pieces: Pieces, settings: Settings, flying: Flying) -> Budget | None:
    """Return what a battery lasts for; None without one."""
    battery = settings.battery
    if battery is None or battery.capacity_wh is None:
        return None
    pace_s_m: Floats | float = 1.0 / flying.motion.speed_m_s
    if flying.pace_s_m is not None:
        pace_s_m = flying.pace_s_m[pieces.line]
    return build_budget(
        network, battery, flying.motion, length_m=lengths_m(pieces.ends), pace_s_m=pace_s_m,
        vertical=settings.vertical, height_m=settings.height_m,
        ferry_height_m=settings.ferry_height_m, reserve_l=settings.reserve_l,
        nose_rate_deg_s=settings.nose_rate_deg_s, refill_s=settings.refill_s,
        limit_wh=battery.usable_wh * flying.battery_share,
    )  # fmt: skip


def _check_reach(budget: Budget, pieces: Pieces, ways: Ways, settings: Settings) -> None:
    """Refuse a field with a place to which the battery does not last, there and back."""
    needed = [budget.wh([2 * piece]) for piece in range(len(pieces))]
    worst = int(np.argmax(needed))
    if needed[worst] <= budget.limit_wh or settings.battery is None:
        return
    place = ways.field.frame.to_geographic(*pieces.ends[worst, :2].tolist())
    raise PlanError(
        f"one piece of a line near {place[0]:.6f}, {place[1]:.6f} and the ferry there and back "
        f"take {needed[worst]:.4g} Wh, and the battery has {settings.battery.usable_wh:.4g} Wh "
        "above its reserve; put a depot nearer, or see mission.battery_wh"
    )


def _home(network: Network, order: Order) -> int:
    """Return the depot from which a sortie is nearest, there and back."""
    return int(np.argmin(network.home_s[:, order[0]] + network.home_s[:, order[-1] ^ 1]))


class _Drawn:
    """Legs of an order of pieces."""

    def __init__(self, *, pieces: Pieces, ways: Ways, speed_m_s: float) -> None:
        self._ends = pieces.ends.reshape(-1, 2).tolist()
        self._pieces = pieces
        self._ways = ways
        self._speed_m_s = speed_m_s

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
        if len(way) == 2 and not leaves and _is_across(before, after):
            return self._leg("transit", way, through=True)
        return self._leg("ferry" if leaves else "transit", way)

    def _leg(
        self, kind: Kind, points: list[Place], *, litres: float = 0.0, through: bool = False
    ) -> Leg:
        return Leg(
            kind=kind, points=tuple(points), speed_m_s=self._speed_m_s, volume_l=litres,
            through=through,
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


def _is_across(first: _Run, second: _Run) -> bool:
    """Return whether one line goes on in the other, behind ground that is not sprayed."""
    gap = shapely.LineString([first.start, second.end])
    ends = shapely.points([first.end, second.start])
    apart_m = _far_m(first.end, second.start)
    return (
        _is_straight(first, second)
        and apart_m <= ACROSS_M
        and float(shapely.distance(gap, ends).max()) <= STRAIGHT_M
    )


def _is_straight(first: _Run, second: _Run) -> bool:
    """Return whether the aircraft flies from one line into the next without a turn."""
    way = np.subtract(second.start, first.end)
    one, two = np.subtract(first.end, first.start), np.subtract(second.end, second.start)
    cosine = float(one @ two) / float(np.hypot(*one) * np.hypot(*two))
    ahead = float(way @ one) >= 0.0 or float(np.hypot(*way)) < JOIN_M
    return ahead and bool(cosine > np.cos(np.radians(JOIN_DEG)))
