"""From spray lines to sorties: cut by demand, ordered, and joined by free ways."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import shapely

from missions.blocks import Blocks
from missions.corners import NOSE_DEG, Motion
from missions.demand import Demand, Pieces, cut
from missions.energy import J_WH, KG_L, Battery, Vertical
from missions.errors import OutOfReachError, PlanError
from missions.network import (
    ACROSS_M,
    JOIN_DEG,
    JOIN_M,
    STRAIGHT_M,
    Network,
    build_network,
    rows_of,
)
from missions.passes import Part, Passes
from missions.plan import Kind, Leg, Place, Settings, Sortie, nose_s
from missions.refill_search import beside, build_limits, build_passes, main_course, several
from missions.refills import Limits, flown_by
from missions.search import improve
from missions.stops import timed
from missions.strips import Floats, lengths_m
from missions.tour import Sortie as Order
from missions.tour import by_savings, one_chain, shortest_tour, turned
from missions.ways import Ways

# A tank is flown in so many pieces or more, so that cuts need not fall where a line ends.
PIECES_A_TANK = 6
PIECES_MAX = 600
# A quick search moves fewer pieces about for less long; a longer one was asked for.
QUICK_MOVES = 40_000
TANKS_MAX = 1500
# With more pieces the annealing finds little in its time that regrouping does not find sooner.
ANNEALED_MAX = 400
TOUCH_M = 1e-3
# The cosine of what is flown from one line into the next without a turn.
STRAIGHT_ON = math.cos(math.radians(JOIN_DEG))
# One sortie is flown the way round on which the ferry out is the shorter one: the longer one leads
# along the lines, and before the first of them the aircraft would turn back with its nose a second
# or more behind; and it carries the whole tank. So much longer it may be.
FERRY_LESS_M = 1.0
# What one kick of a tour takes, counted in moves of the search over many sorties.
MOVES_A_KICK = 100
# An order that is cut into many sorties is worth less of it.
FEWER_KICKS = 8
# A sortie that needs so much of a battery by the search's model may, as it is flown, need all.
NEARLY = 1.1
# Where no more of the sorties than that take too much, they alone are laid out anew, each with so
# many neighbours, for a little less than the battery gives.
FEW, NEIGHBOURS, LASTS = 0.3, 3, 0.995


@dataclass(frozen=True, slots=True, kw_only=True)
class Flying:
    """How lines are flown: `pace_s_m` is the time of a metre of each line, where rates slow it.

    With `any_depot` the depots are a choice, of which one is taken when the sortie is known.
    """

    motion: Motion
    pace_s_m: Floats | None = None
    any_depot: bool = False


@dataclass(frozen=True, kw_only=True)
class SortieSearch:
    """The search for the sorties of some lines, each within a tank and a battery.

    It knows turns and speeds only nearly. Where the battery does not last for what it found, it is
    asked again with a share of the battery: what does not depend on that share is known then, and
    it goes on from the sorties before.
    """

    lines: Floats
    demand: list[Demand]
    ways: Ways
    settings: Settings
    flying: Flying

    def in_one(self) -> tuple[Sortie, ...] | None:
        """Return one sortie for everything; None where tank or battery cannot last for it."""
        settings = self.settings
        whole = self._whole
        if not float(whole.litres.sum()) <= settings.usable_l:
            return None
        if _has_battery(settings):
            limits = build_limits(settings, 1.0)
            run = self._run(self._in_order(settings.moves // (MOVES_A_KICK * FEWER_KICKS)))
            if flown_by(self._passes, limits, run).wh > NEARLY * limits.usable_wh:
                return None
        order = self._in_order(settings.moves // MOVES_A_KICK)
        return _drawn(whole, [order], self.ways, self.flying.motion)[1]

    def several(
        self, battery_share: float = 1.0, *, before: Sequence[list[Part]] = ()
    ) -> tuple[list[list[Part]], tuple[Sortie, ...]]:
        """Return the parts of lines that each sortie flies, and the sorties.

        Raises:
            PlanError: where a tank or a battery does not last for any.
        """
        passes, settings = self._passes, self.settings
        limits = build_limits(settings, battery_share)
        if not before:
            self._check_reach()
        order = self._in_order(settings.moves // (MOVES_A_KICK * FEWER_KICKS))
        known: list[list[list[Part]]] = []
        # Cut lines are no fewer than whole ones: where those are too many, none is cut.
        few = len(self._whole) <= ANNEALED_MAX and len(self._pieces) <= ANNEALED_MAX
        if not before and few:
            orders = self._annealed(battery_share)
            annealed = [[_part(passes, self._pieces, enter) for enter in order] for order in orders]
            # Its budget lets each ferry take the nearest depot; a sortie ends where it began.
            if all(flown_by(passes, limits, each).wh <= limits.usable_wh for each in annealed):
                known = [annealed]
        found = several(
            passes, limits, self._run(order), known,
            before=before, moves=settings.moves, seed=settings.seed, blocks=self._blocks,
        )  # fmt: skip
        if not found:
            pieces = self._pieces
            parts = [_part(passes, pieces, 2 * at) for at in range(len(pieces))]
            raise _too_far(passes, limits, parts, self.ways, settings)
        drawn = map(self._as_flown, found)
        return min(drawn, key=self._cost_s)

    def _cost_s(self, drawn: tuple[list[list[Part]], tuple[Sortie, ...]]) -> float:
        apart_s = 0.0 if self._blocks is None else sum(map(self._blocks.apart_s, drawn[0]))
        return _total_s(self.timed(drawn[1]), self.settings) + apart_s

    @cached_property
    def _blocks(self) -> Blocks | None:
        """Return which passes lie beside each other; None where sorties may be stripes."""
        if self.settings.stripes:
            return None
        return Blocks(self._passes, self.settings.swath_width_m, main_course(self.lines))

    def with_less(
        self, parts: Sequence[list[Part]], used_wh: Sequence[float], usable_wh: float
    ) -> tuple[list[list[Part]], tuple[Sortie, ...]] | None:
        """Return sorties as `several` does: those that take too much anew with their neighbours.

        `used_wh` is what each takes as it is flown. None where they are too many for that.
        """
        passes, settings = self._passes, self.settings
        over = [at for at, wh in enumerate(used_wh) if wh > usable_wh]
        if len(over) > FEW * len(parts):
            return None
        whole = build_limits(settings, 1.0)
        # So much less than the search takes them for that they last as they are flown.
        share = min(
            flown_by(passes, whole, parts[at]).wh / used_wh[at] for at in over
        ) * LASTS * usable_wh / whole.usable_wh  # fmt: skip
        group = beside(passes, parts, over, NEIGHBOURS)
        found = several(
            passes, build_limits(settings, share), [], [], before=[parts[at] for at in group],
            moves=settings.moves, seed=settings.seed, blocks=self._blocks,
        )  # fmt: skip
        if not found:
            return None
        kept = [each for at, each in enumerate(parts) if at not in group]
        return self._as_flown([*kept, *found[0]])

    def timed(self, sorties: Sequence[Sortie]) -> tuple[Sortie, ...]:
        """Return the sorties with the seconds of each leg; they are asked for more than once."""
        new = [each for each in sorties if each not in self._timed]
        self._timed.update(zip(new, timed(new, self.settings), strict=True))
        return tuple(map(self._timed.__getitem__, sorties))

    @cached_property
    def _timed(self) -> dict[Sortie, Sortie]:
        return {}

    def _as_flown(self, parts: list[list[Part]]) -> tuple[list[list[Part]], tuple[Sortie, ...]]:
        """Return the parts in the order of their sorties, and these."""
        parts = parts if self._blocks is None else self._blocks.in_turn(parts)
        pieces, orders = _as_pieces(self._passes, parts)
        ranks, sorties = _drawn(pieces, orders, self.ways, self.flying.motion)
        return [parts[at] for at in ranks], sorties

    def _check_reach(self) -> None:
        """Raise OutOfReachError where the battery lasts for no flight to some end and back."""
        passes, settings = self._passes, self.settings
        battery = settings.battery
        if battery is None or battery.capacity_wh is None:
            return
        lines = np.arange(len(self.lines))
        ends_m = np.concatenate([np.zeros(len(lines)), np.array(passes.length_m)])
        far_m = passes.many.homes_m(np.tile(lines, 2), ends_m).min(axis=0)
        worst = int(far_m.argmax())
        away_s = 2.0 * float(passes.times.legs_s(far_m[worst : worst + 1])[0])
        # What it takes in any case: spraying may draw less on the way than a ferry is counted with.
        away_w = min(battery.cruise_w, battery.hover_w)
        needed_wh = (away_s * away_w + settings.upright_s * battery.hover_w) / J_WH
        if needed_wh > battery.usable_wh:
            place = passes.place(worst % len(lines), float(ends_m[worst]))
            raise _out_of_reach(place, float(far_m[worst]), needed_wh, self.ways, settings)

    @cached_property
    def _whole(self) -> Pieces:
        """Return the lines, none cut."""
        return cut(self.lines, self.demand, piece_max_l=math.inf, margin_m=self.settings.lead_m)

    @cached_property
    def _pieces(self) -> Pieces:
        settings = self.settings
        return cut(
            self.lines, self.demand, piece_max_l=_piece_max_l(self.demand, settings),
            piece_max_m=_piece_max_m(self.demand, settings, self.flying),
            margin_m=settings.lead_m,
        )  # fmt: skip

    @cached_property
    def _passes(self) -> Passes:
        flying = self.flying
        return build_passes(self.lines, self.demand, self.ways, flying.motion, flying.pace_s_m)

    def _run(self, order: Order) -> list[Part]:
        return [_part(self._passes, self._whole, enter) for enter in order]

    @cached_property
    def _network(self) -> Network:
        network = self._network_of(self._whole)
        if self.flying.any_depot:
            network.put_depot_anywhere()
        return network

    def _network_of(self, pieces: Pieces) -> Network:
        return build_network(
            pieces, self.ways.inside, self.flying.motion,
            home_m=self.ways.home_ways_m(pieces.ends.reshape(-1, 2)),
            refill_s=self.settings.refill_s,
        )  # fmt: skip

    def _in_order(self, kicks: int) -> Order:
        """Return the order of all lines that an endless tank would take."""
        if kicks not in self._orders:
            network = self._network
            order = one_chain(network, by_savings(network, math.inf))
            self._orders[kicks] = shortest_tour(
                network, order, kicks=kicks, seed=self.settings.seed
            )
        return self._orders[kicks]

    @cached_property
    def _orders(self) -> dict[int, Order]:
        return {}

    def _annealed(self, battery_share: float) -> list[Order]:
        """Return sorties of pieces that were joined by savings and moved about."""
        settings = self.settings
        network = self._network_of(self._pieces)
        budget = _budget(network, self._pieces, settings, self.flying, battery_share)
        lasts = None if budget is None else budget.lasts
        orders = by_savings(network, settings.usable_l, lasts=lasts)
        few = settings.moves * len(self._pieces) // PIECES_MAX
        return improve(
            network, orders, settings.usable_l, moves=max(few, settings.moves - QUICK_MOVES),
            seed=settings.seed, lasts=lasts,
        )  # fmt: skip


def _has_battery(settings: Settings) -> bool:
    return settings.battery is not None and settings.battery.capacity_wh is not None


def _part(passes: Passes, pieces: Pieces, enter: int) -> Part:
    """Return a piece as a part of its line, in the direction in which it is entered."""
    at = enter >> 1
    line = int(pieces.line[at])
    (x, y), (east, north) = passes.starts[line], passes.along[line]
    row = pieces.ends[at].tolist()
    start_m = (row[0] - x) * east + (row[1] - y) * north
    end_m = (row[2] - x) * east + (row[3] - y) * north
    return (line, end_m, start_m) if enter & 1 else (line, start_m, end_m)


def _as_pieces(passes: Passes, sorties: list[list[Part]]) -> tuple[Pieces, list[Order]]:
    """Return the parts of sorties as pieces, each flown as it is drawn."""
    parts = [part for sortie in sorties for part in sortie]
    ends = np.array(
        [
            [*passes.place(line, start_m), *passes.place(line, end_m)]
            for line, start_m, end_m in parts
        ]
    )
    pieces = Pieces(
        ends=ends,
        litres=np.array([passes.need_l(part) for part in parts]),
        line=np.array([line for line, _, _ in parts]),
    )
    numbers = iter(range(len(parts)))
    return pieces, [[2 * next(numbers) for _ in sortie] for sortie in sorties]


def _total_s(sorties: tuple[Sortie, ...], settings: Settings) -> float:
    """Return the time of timed sorties as they are flown, landings and refills among it."""
    landing_s = settings.upright_s + settings.refill_s
    return sum(
        sortie.flight_s
        + landing_s
        + nose_s(sortie.legs, turn=settings.turn, rate_deg_s=settings.nose_rate_deg_s)
        for sortie in sorties
    )


def _drawn(
    pieces: Pieces, orders: list[Order], ways: Ways, motion: Motion
) -> tuple[list[int], tuple[Sortie, ...]]:
    """Return the sorties that fly these pieces, each from its best depot, and whose order each is.

    Those of one depot follow each other.
    """
    ends = pieces.ends.reshape(-1, 2)
    outer = np.array([[ends[order[0]], ends[order[-1] ^ 1]] for order in orders])
    home_m = ways.home_ways_m(outer.reshape(-1, 2))
    both = motion.legs_s(home_m).reshape(len(ways.depots), -1, 2).sum(axis=2)
    homes = np.argmin(both, axis=0).tolist()
    out_m, back_m = home_m.reshape(len(ways.depots), -1, 2)[homes[0], 0].tolist()
    if len(orders) == 1 and out_m > back_m + FERRY_LESS_M:
        orders = [turned(orders[0])]
    ranked = sorted(range(len(orders)), key=lambda at: (homes[at], min(orders[at])))
    drawn = _Drawn(pieces=pieces, ways=ways, speed_m_s=motion.speed_m_s)
    return ranked, tuple(
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


def _budget(
    network: Network, pieces: Pieces, settings: Settings, flying: Flying, battery_share: float
) -> Budget | None:
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
        limit_wh=battery.usable_wh * battery_share,
    )  # fmt: skip


def _too_far(
    passes: Passes, limits: Limits, parts: Sequence[Part], ways: Ways, settings: Settings
) -> PlanError:
    """Return that a battery does not last to some place, there and back."""
    ends = [(line, at_m) for line, *both_m in parts for at_m in both_m]
    far_m = [min(passes.homes_m(line, at_m)) for line, at_m in ends]
    worst = int(np.argmax(far_m))
    line, at_m = ends[worst]
    bare_wh = flown_by(passes, limits, [(line, at_m, at_m)]).wh
    return _out_of_reach(passes.place(line, at_m), far_m[worst], bare_wh, ways, settings)


def _out_of_reach(
    place: Place, far_m: float, needed_wh: float, ways: Ways, settings: Settings
) -> OutOfReachError:
    latitude_deg, longitude_deg = ways.field.frame.to_geographic(*place)
    usable_wh = math.inf if settings.battery is None else settings.battery.usable_wh
    return OutOfReachError(
        f"{latitude_deg:.6f}, {longitude_deg:.6f} is {far_m:.0f} m from the nearest depot as it is "
        f"flown: there and back alone takes {needed_wh:.0f} Wh of the {usable_wh:.0f} Wh that the "
        "battery has above its reserve; put a depot nearer (--depot, as often as needed), or see "
        "mission.battery_wh"
    )


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
            if runs and run.line == runs[-1].line and math.dist(runs[-1].end, run.start) < TOUCH_M:
                run = replace(run, start=runs[-1].start, litres=runs[-1].litres + run.litres)
                runs.pop()
            runs.append(run)
        return runs

    def _join(self, before: _Run, after: _Run) -> Leg:
        """Return the way from one line to the next: through, where neither has to stop."""
        is_on = before.line == after.line or math.dist(before.end, after.start) < JOIN_M
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


def _is_across(first: _Run, second: _Run) -> bool:
    """Return whether one line goes on in the other, behind ground that is not sprayed."""
    if not _is_straight(first, second) or math.dist(first.end, second.start) > ACROSS_M:
        return False
    gap = shapely.LineString([first.start, second.end])
    ends = shapely.points([first.end, second.start])
    return float(shapely.distance(gap, ends).max()) <= STRAIGHT_M


def _is_straight(first: _Run, second: _Run) -> bool:
    """Return whether the aircraft flies from one line into the next without a turn."""
    way = _way(first.end, second.start)
    one, two = _way(first.start, first.end), _way(second.start, second.end)
    cosine = (one[0] * two[0] + one[1] * two[1]) / (math.hypot(*one) * math.hypot(*two))
    ahead = way[0] * one[0] + way[1] * one[1] >= 0.0 or math.hypot(*way) < JOIN_M
    return ahead and cosine > STRAIGHT_ON


def _way(start: Place, end: Place) -> Place:
    return end[0] - start[0], end[1] - start[1]


# Whether a battery lasts for a sortie while its pieces are still being moved about.


@dataclass(frozen=True, slots=True, kw_only=True)
class Budget:
    """Time and watt-hours without liquid, from end to end and along each piece.

    The rows and columns are those of `Network.between_s`, but without the search's extra time for
    a refill. What a piece takes is known for both of its ends. `limit_wh` is what a sortie may
    take.
    """

    between_s: list[Sequence[float]]
    between_wh: list[Sequence[float]]
    piece_s: list[float]
    piece_wh: list[float]
    litres: list[float]
    depot: int
    start_wh: float
    start_s: float
    reserve_l: float
    per_l_wh_s: float
    limit_wh: float

    def wh(self, sortie: list[int]) -> float:
        """Return what a sortie takes."""
        # Asked for with every move of the search: nothing is looked up twice.
        between_s, between_wh, per_l_wh_s = self.between_s, self.between_wh, self.per_l_wh_s
        litres, piece_s, piece_wh = self.litres, self.piece_s, self.piece_wh
        left_l = self.reserve_l + sum(map(litres.__getitem__, sortie))
        used = self.start_wh + per_l_wh_s * self.start_s * left_l
        here = self.depot
        for enter in sortie:
            own_l = litres[enter]
            seconds = between_s[here][enter] * left_l
            seconds += piece_s[enter] * (left_l - own_l / 2.0)
            used += between_wh[here][enter] + piece_wh[enter]
            used += per_l_wh_s * seconds
            left_l -= own_l
            here = enter ^ 1
        home = between_wh[here][self.depot]
        return used + home + per_l_wh_s * between_s[here][self.depot] * left_l

    def lasts(self, sortie: list[int]) -> bool:
        """Return whether the battery lasts."""
        return not sortie or self.wh(sortie) <= self.limit_wh


def build_budget(
    network: Network,
    battery: Battery,
    motion: Motion,
    *,
    length_m: Floats,
    pace_s_m: Floats | float,
    vertical: Vertical,
    height_m: float,
    ferry_height_m: float | None,
    reserve_l: float,
    nose_rate_deg_s: float | None,
    refill_s: float,
    limit_wh: float,
) -> Budget:
    """Return the budget of a network; `pace_s_m` is the time of a metre of each piece."""
    cruise_s = length_m * pace_s_m
    stops_s = motion.legs_s(length_m) - length_m / motion.speed_m_s
    stop_s = motion.at(motion.speed_m_s).reaching_s
    between_s = network.between_s.copy()
    between_s[network.depot] -= refill_s / 2.0
    between_s[:, network.depot] -= refill_s / 2.0
    moving_s = np.where(between_s > 2.0 * stop_s, between_s - stop_s, 0.0)
    nose_s = np.zeros_like(between_s)
    if nose_rate_deg_s is not None and motion.turn == "stop":
        # Pieces that follow each other without a stop have times below zero, or just above.
        nose_s[between_s > 0.0] = NOSE_DEG / nose_rate_deg_s
    other_s = between_s - moving_s + nose_s
    between_wh = (moving_s * battery.cruise_w + other_s * battery.hover_w) / J_WH
    upper_m = height_m if ferry_height_m is None else ferry_height_m
    upright_s = vertical.climb_s(upper_m) + vertical.return_s(upper_m)
    upright_s += vertical.change_s(upper_m, height_m) + vertical.change_s(height_m, upper_m)
    piece_wh = (cruise_s * battery.cruise_w + stops_s * battery.hover_w) / J_WH
    return Budget(
        between_s=rows_of(between_s + nose_s),
        between_wh=rows_of(between_wh),
        piece_s=np.repeat(cruise_s + stops_s, 2).tolist(),
        piece_wh=np.repeat(piece_wh, 2).tolist(),
        litres=np.repeat(network.litres, 2).tolist(),
        depot=network.depot,
        start_wh=upright_s * battery.hover_w / J_WH,
        start_s=upright_s,
        reserve_l=reserve_l,
        per_l_wh_s=battery.per_kg_w * KG_L / J_WH,
        limit_wh=limit_wh,
    )
