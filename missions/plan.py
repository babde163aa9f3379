"""A planned mission: sorties of legs, and what they come to."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np
from shapely.geometry.base import BaseGeometry

from companion.core.frame import LocalFrame
from missions.corners import NOSE_DEG, NOSE_DEG_S, CornerRule, Motion, Turn
from missions.coverage import Coverage
from missions.energy import J_WH, STRAIGHT_DEG, VERTICALS, Battery, Vertical
from missions.field import Field
from missions.strips import Floats
from missions.terrain import Terrain

Place = tuple[float, float]
Kind = Literal["spray", "transit", "ferry"]

# A plan covers 99.8 % of what a strip can reach, simpler borders counted, where nothing else is
# allowed.
LEAVE_PERCENT = 0.2
# WPNAV_JERK of ArduCopter, MPC_JERK_AUTO of PX4, as they come.
JERKS_M_S3 = {"ardupilot": 1.0, "px4": 4.0}


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """What the plan is made for; `valves` are (right_m, width_m), `moves` the length of search.

    `flow_l_min` is the least and the largest flow of the whole boom, `speeds_m_s` the least and
    the highest speed that a leg may have, `settle_s` how long a rate must last to be there.
    `border_buffer_m` is what the companion keeps its valves' strips off the border, if it does.
    `refill_s` and `swap_s` (of a battery) are on the ground; several aircraft keep
    `aircraft_gap_m` between them. `nose_rate_deg_s` is how fast the nose turns at a stop.
    Ferries and long transits are flown at `ferry_height_m`, where it is given.
    `leave_max_percent` of what a strip can reach may be left, `overlap_max_percent` sprayed twice.
    Valves close where `switch_off_percent` of their strip is treated, if they do. With `ends_over`
    an end of the boom may be beyond the border, where its valves are closed.
    `in_tank_l` is the mix that is in the first aircraft's tank before its first sortie.
    Sorties are blocks from side to side; as `stripes` they may lie in between each other.
    On a line is who is no farther aside and off its course (`mission.lines_aside_m`). Valves are
    open, or closed, `opens_s` and `closes_s` after what the aircraft does, the last flow ends
    `ends_s` after the order.
    Without them, `jerk_m_s3` and `return_height_m` are those that the autopilot comes with.
    """

    swath_width_m: float
    speed_m_s: float
    height_m: float = 3.5
    ferry_height_m: float | None = None
    acceleration_m_s2: float = 2.5
    jerk_m_s3: float | None = None
    return_height_m: float | None = None
    turn: Turn = "stop"
    angle_deg: float | None = None
    tank_l: float = 40.0
    reserve_l: float = 1.0
    valves: tuple[tuple[float, float], ...] = ()
    moves: int = 40_000
    seed: int = 1
    flow_l_min: tuple[float, float] | None = None
    speeds_m_s: tuple[float, float] = (0.0, 0.0)
    settle_s: float = 0.0
    border_buffer_m: float | None = None
    battery: Battery | None = None
    refill_s: float = 60.0
    swap_s: float = 60.0
    nose_rate_deg_s: float | None = None
    aircraft: int = 1
    aircraft_gap_m: float = 20.0
    autopilot: Literal["ardupilot", "px4"] = "ardupilot"
    leave_max_percent: float = LEAVE_PERCENT
    overlap_max_percent: float | None = None
    switch_off_percent: float | None = None
    ends_over: bool = False
    in_tank_l: float = 0.0
    stripes: bool = False
    lines_aside_m: float = 1.0
    lines_course_deg: float = 20.0
    opens_s: float = 0.2
    closes_s: float = 0.2
    ends_s: float = 0.15

    def __post_init__(self) -> None:
        for name in ("swath_width_m", "speed_m_s", "height_m", "acceleration_m_s2", "tank_l"):
            if not 0.0 < getattr(self, name) < 1e5:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        if self.ferry_height_m is not None and not self.height_m < self.ferry_height_m <= 500.0:
            raise ValueError(
                f"a ferry height of {self.ferry_height_m:g} m is not above the {self.height_m:g} m "
                "of the passes (mission.ferry_height_m, mission.height_m)"
            )
        if not 0.0 <= self.reserve_l < self.tank_l:
            raise ValueError(f"a reserve of {self.reserve_l} L leaves nothing of {self.tank_l} L")
        if not 0.0 <= self.in_tank_l <= self.tank_l:
            raise ValueError(f"{self.in_tank_l} L are not in a tank of {self.tank_l} L")
        if self.ends_over and (len(self.valves) < 2 or self.border_buffer_m is None):
            raise ValueError("ends of the boom beyond the border need valves that close there")

    @property
    def motion(self) -> Motion:
        """Return how the aircraft flies, with its autopilot's rule for corners."""
        rule: CornerRule = self.autopilot
        jerk = JERKS_M_S3[self.autopilot] if self.jerk_m_s3 is None else self.jerk_m_s3
        return Motion(
            speed_m_s=self.speed_m_s, acceleration_m_s2=self.acceleration_m_s2, jerk_m_s3=jerk,
            turn=self.turn, corners=rule,
        )  # fmt: skip

    @property
    def lead_m(self) -> float:
        """Return the way after a turn back until the aircraft has its speed and its nose ahead.

        Until then the boom swings: its ends go over other ground than they do along the line.
        """
        gaining_s, turning_s = self.speed_m_s / self.acceleration_m_s2, 0.0
        if self.turn != "strafe":
            turning_s = NOSE_DEG / (self.nose_rate_deg_s or NOSE_DEG_S)
        return self.speed_m_s * (gaining_s / 2.0 + max(turning_s - gaining_s, 0.0))

    @property
    def vertical(self) -> Vertical:
        """Return how the aircraft takes off, returns and lands."""
        found = VERTICALS[self.autopilot]
        if self.return_height_m is None:
            return found
        return replace(found, return_height_m=self.return_height_m)

    @property
    def upright_s(self) -> float:
        """Return what take-off, return and landing take, and the height of ferries once each."""
        vertical, low_m = self.vertical, self.height_m
        high_m = low_m if self.ferry_height_m is None else self.ferry_height_m
        changes_s = vertical.change_s(high_m, low_m) + vertical.change_s(low_m, high_m)
        return vertical.climb_s(high_m) + vertical.return_s(high_m) + changes_s

    @property
    def reach_m(self) -> float:
        """Return how far the battery lasts there and back at speed, without liquid."""
        battery = self.battery
        if battery is None:
            return math.inf
        left_wh = battery.usable_wh - battery.wh(cruise_s=0.0, other_s=self.upright_s, litres=0.0)
        return left_wh * J_WH / battery.cruise_w * self.speed_m_s / 2.0

    @property
    def closing_share(self) -> float:
        """Return how much of ground under two passes is sprayed twice: one valve of the boom."""
        if self.switch_off_percent is None or not self.valves:
            return 1.0
        widest_m = max(width_m for _, width_m in self.valves)
        return min(1.0, widest_m / sum(width_m for _, width_m in self.valves))

    @property
    def usable_l(self) -> float:
        """Return what of a full tank is sprayed before the refill."""
        return self.tank_l - self.reserve_l


@dataclass(frozen=True, slots=True, kw_only=True)
class Leg:
    """A way at one speed: a straight spray line, or a transit or ferry that may bend.

    One flown `through` leads from a line into the next, which goes on straight. `seconds` are
    those of `missions.stops`, once the whole sortie is known. `overlap_l` of `volume_l` fall on
    treated ground though valves close there; None where none do. `height_m` is None at that of the
    lines.
    """

    kind: Kind
    points: tuple[Place, ...]
    speed_m_s: float
    seconds: float = 0.0
    volume_l: float = 0.0
    through: bool = False
    overlap_l: float | None = None
    height_m: float | None = None

    @property
    def length_m(self) -> float:
        """Return the length of the way."""
        return sum(math.dist(a, b) for a, b in pairwise(self.points))


@dataclass(frozen=True, slots=True, kw_only=True)
class Sortie:
    """What is flown with one tank, from a depot and back, by which aircraft.

    It takes off at `start_s` or later, where `swaps` with a fresh battery.
    `after` are the sorties of other aircraft that must have landed before this one takes off.
    """

    number: int
    depot: int
    legs: tuple[Leg, ...]
    aircraft: int = 1
    start_s: float = 0.0
    swaps: bool = False
    after: tuple[int, ...] = ()

    def length_m(self, kind: Kind) -> float:
        """Return the length of all legs of one kind."""
        return sum(leg.length_m for leg in self.legs if leg.kind == kind)

    @property
    def volume_l(self) -> float:
        """Return what is sprayed."""
        return sum(leg.volume_l for leg in self.legs)

    @property
    def flight_s(self) -> float:
        """Return the time of all legs."""
        return sum(leg.seconds for leg in self.legs)

    def end_heights_m(self, height_m: float) -> tuple[float, float]:
        """Return how high it begins and ends its way; `height_m` is that of the lines."""
        first, last = self.legs[0].height_m, self.legs[-1].height_m
        return height_m if first is None else first, height_m if last is None else last

    @property
    def home_m(self) -> float:
        """Return how far the return flies, from the last waypoint."""
        return math.dist(*self.legs[-1].points[-2:])

    @property
    def lines(self) -> int:
        """Return the number of spray lines; one with several speeds is several legs."""
        kinds = [leg.kind == "spray" for leg in self.legs]
        return sum(is_spray and not before for before, is_spray in pairwise([False, *kinds]))

    @property
    def speeds_m_s(self) -> tuple[float, float]:
        """Return the least and the highest speed of the spray lines."""
        speeds = [leg.speed_m_s for leg in self.legs if leg.kind == "spray"]
        return min(speeds), max(speeds)


def flown_lines(sorties: Sequence[Sortie]) -> Floats:
    """Return all spray legs of some sorties as rows of both their ends."""
    legs = [leg for sortie in sorties for leg in sortie.legs if leg.kind == "spray"]
    return np.array([(*leg.points[0], *leg.points[-1]) for leg in legs]).reshape(-1, 4)


@dataclass(frozen=True, slots=True, kw_only=True)
class Treated:
    """What the flight leaves `bare` of the ground with a rate, treats `twice`, and puts out.

    `litres` are of each sortie by its number.
    """

    ground_m2: float
    bare: BaseGeometry
    twice: BaseGeometry
    litres: dict[int, float]

    @property
    def percent(self) -> float:
        """Return how much of the ground that has a rate is treated."""
        return 100.0 * (1.0 - float(self.bare.area) / max(self.ground_m2, 1e-9))

    def summary(self) -> dict[str, float]:
        """Return the figures."""
        return {
            "treated_percent": self.percent,
            "bare_m2": float(self.bare.area),
            "twice_m2": float(self.twice.area),
            "treated_l": sum(self.litres.values()),
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """The whole mission; `lines` are all spray lines before they were cut into sorties.

    `wind` is what it is planned for, in m/s and degrees that it comes from.
    """

    field: Field
    settings: Settings
    angle_deg: float
    lines: Floats
    coverage: Coverage
    depots: tuple[Place, ...]
    suggested_depot: bool
    sorties: tuple[Sortie, ...]
    warnings: tuple[str, ...] = ()
    terrain: Terrain | None = None
    wind: tuple[float, float] | None = None
    treated: Treated | None = None

    @property
    def frame(self) -> LocalFrame:
        """Return the frame of all places."""
        return self.field.frame

    @property
    def closes(self) -> bool:
        """Return whether valves close over treated ground, as the litres count."""
        return any(leg.overlap_l is not None for each in self.sorties for leg in each.legs)

    def length_m(self, kind: Kind) -> float:
        """Return the length of all legs of one kind."""
        return sum(sortie.length_m(kind) for sortie in self.sorties)

    @property
    def volume_l(self) -> float:
        """Return what is sprayed in all."""
        return sum(sortie.volume_l for sortie in self.sorties)

    def needs_l(self, sortie: Sortie) -> float:
        """Return what a tank is filled for: what passes ask for, and no less than what falls."""
        falls_l = 0.0 if self.treated is None else self.treated.litres.get(sortie.number, 0.0)
        return max(sortie.volume_l, falls_l)

    @property
    def flight_s(self) -> float:
        """Return the time of all sorties."""
        return sum(sortie.flight_s for sortie in self.sorties)

    def nose_s(self, sortie: Sortie) -> float:
        """Return how long the nose is turned at stops; 0 where `nose_rate_deg_s` is not given."""
        settings = self.settings
        return nose_s(sortie.legs, turn=settings.turn, rate_deg_s=settings.nose_rate_deg_s)

    def airborne_s(self, sortie: Sortie) -> float:
        """Return the time from take-off to landing."""
        vertical = self.settings.vertical
        first_m, last_m = sortie.end_heights_m(self.settings.height_m)
        upright_s = vertical.climb_s(first_m) + vertical.return_s(last_m, sortie.home_m)
        return sortie.flight_s + self.nose_s(sortie) + upright_s

    def energy_wh(self, sortie: Sortie) -> float | None:
        """Return what a sortie draws from the battery; None where no power is given."""
        settings = self.settings
        if settings.battery is None:
            return None
        return sortie_wh(
            sortie, settings.battery, vertical=settings.vertical, height_m=settings.height_m,
            reserve_l=settings.reserve_l, nose_turn_s=self.nose_s(sortie),
        )  # fmt: skip

    @property
    def turns(self) -> int:
        """Return how often one spray line follows another in the same sortie."""
        return sum(max(sortie.lines - 1, 0) for sortie in self.sorties)

    @property
    def total_s(self) -> float:
        """Return the time from the first take-off to the last landing, refills among it."""
        return max(sortie.start_s + self.airborne_s(sortie) for sortie in self.sorties)

    @property
    def times(self) -> str:
        """Return how long all sorties fly, and how long that takes with refills, in words."""
        flown = f"{sum(map(self.airborne_s, self.sorties)) / 60.0:.0f} min in the air"
        if len(self.sorties) == 1:
            return flown
        return f"{flown}, {self.total_s / 60.0:.0f} min to the last landing"

    def summary(self) -> dict[str, object]:
        """Return the figures of the plan."""
        total_m = sum(self.length_m(kind) for kind in ("spray", "transit", "ferry"))
        return {
            "coverage_percent": self.coverage.percent,
            "reachable_percent": self.coverage.reachable_percent,
            "overlap_percent": self.coverage.overlap_percent,
            "outside_m2": self.coverage.outside_m2,
            "largest_skip_m2": self.coverage.largest_skip_m2,
            "simpler_border_m2": self.field.given_up_m2,
            **(
                dict.fromkeys(("treated_percent", "bare_m2", "twice_m2", "treated_l"))
                if self.treated is None
                else self.treated.summary()
            ),
            "without_rate_ha": self.coverage.without_rate_m2 / 10_000.0,
            "holes": asdict(self.field.holes),
            "area_ha": self.field.area_m2 / 10_000.0,
            "angle_deg": self.angle_deg,
            "swaths": len(self.lines),
            "turns": self.turns,
            "spray_m": self.length_m("spray"),
            "transit_m": self.length_m("transit"),
            "ferry_m": self.length_m("ferry"),
            "total_m": total_m,
            "flight_s": self.flight_s,
            "total_s": self.total_s,
            "volume_l": self.volume_l,
            "depots": [list(self.frame.to_geographic(*depot)) for depot in self.depots],
            "depot_suggested": self.suggested_depot,
            "sorties": [self._sortie(sortie) for sortie in self.sorties],
            "terrain": self._ground(),
            "warnings": list(self.warnings),
        }

    def _ground(self) -> dict[str, object] | None:
        """Return the ground under all ways, where the plan follows it."""
        if self.terrain is None:
            return None
        legs = [leg for sortie in self.sorties for leg in sortie.legs]
        return self.terrain.summary(np.array([place for leg in legs for place in leg.points]))

    def _sortie(self, sortie: Sortie) -> dict[str, object]:
        return {
            "number": sortie.number,
            "depot": list(self.frame.to_geographic(*self.depots[sortie.depot])),
            "volume_l": sortie.volume_l,
            "swaths": sortie.lines,
            "spray_m": sortie.length_m("spray"),
            "transit_m": sortie.length_m("transit"),
            "ferry_m": sortie.length_m("ferry"),
            "total_m": sum(leg.length_m for leg in sortie.legs),
            "flight_s": sortie.flight_s,
            "speeds_m_s": list(sortie.speeds_m_s),
            "airborne_s": self.airborne_s(sortie),
            "energy_wh": self.energy_wh(sortie),
            "aircraft": sortie.aircraft,
            "start_s": sortie.start_s,
            "swap": sortie.swaps,
            "after": list(sortie.after),
        }


def nose_s(legs: Sequence[Leg], *, turn: Turn, rate_deg_s: float | None) -> float:
    """Return how long the aircraft stands and turns its nose, at every corner of its way.

    Only one that stops and flies nose first does so, and only where the rate is given.
    """
    if rate_deg_s is None or turn != "stop":
        return 0.0
    points = [point for leg in legs for point in leg.points]
    courses = [
        math.degrees(math.atan2(b[0] - a[0], b[1] - a[1]))
        for a, b in pairwise(points)
        if math.dist(a, b) > 1e-3
    ]
    bends = [abs((b - a + 180.0) % 360.0 - 180.0) for a, b in pairwise(courses)]
    return sum(bend for bend in bends if bend >= STRAIGHT_DEG) / rate_deg_s


def sortie_wh(
    sortie: Sortie,
    battery: Battery,
    *,
    vertical: Vertical,
    height_m: float,
    reserve_l: float,
    nose_turn_s: float,
) -> float:
    """Return the use of a sortie: the tank empties line by line, down to its reserve.

    Turning the nose is counted with half of the sortie's litres on board.
    """
    left_l = sortie.volume_l + reserve_l
    first_m, last_m = sortie.end_heights_m(height_m)
    used = battery.wh(cruise_s=0.0, other_s=vertical.climb_s(first_m), litres=left_l)
    used += battery.wh(
        cruise_s=0.0, other_s=vertical.return_s(last_m, sortie.home_m), litres=reserve_l
    )
    middle_l = reserve_l + sortie.volume_l / 2.0
    used += battery.wh(cruise_s=0.0, other_s=nose_turn_s, litres=middle_l)
    for leg in sortie.legs:
        cruise_s = min(leg.length_m / leg.speed_m_s, leg.seconds)
        used += battery.wh(
            cruise_s=cruise_s, other_s=leg.seconds - cruise_s, litres=left_l - leg.volume_l / 2.0
        )
        left_l -= leg.volume_l
    return used


# Ferries at a height of their own: climbing where a line ends, descending where one begins.

# A way inside the field that is at least so long is flown as high as a ferry.
LONG_TRANSIT_M = 100.0
# A ferry shorter than this is the way from a depot on the line's own end.
SHORT_M = 1.0
# Cosine of what counts as straight into a line.
STRAIGHT = 1.0 - 1e-6


def at_ferry_height(
    sorties: Sequence[Sortie], settings: Settings, *, run_in_m: float = 0.0
) -> tuple[Sortie, ...]:
    """Return the sorties with ferries and long transits at their own height, if they have one.

    The runs before and behind lines, each `run_in_m` at most, stay at the height of the lines.
    """
    height_m = settings.ferry_height_m
    if height_m is None:
        return tuple(sorties)
    found = []
    for sortie in sorties:
        legs: list[Leg] = []
        for number, leg in enumerate(sortie.legs):
            if not is_high(leg):
                legs.append(leg)
                continue
            before = sortie.legs[number - 1] if number else None
            after = sortie.legs[number + 1] if number + 1 < len(sortie.legs) else None
            legs += _raised(leg, before, after, height_m, run_in_m)
        found.append(replace(sortie, legs=tuple(legs)))
    return tuple(found)


def is_high(leg: Leg) -> bool:
    """Return whether a way is one that is flown at the height of ferries, where there is one."""
    if leg.kind == "spray" or leg.through:
        return False
    return leg.length_m >= (SHORT_M if leg.kind == "ferry" else LONG_TRANSIT_M)


def _raised(
    leg: Leg, before: Leg | None, after: Leg | None, height_m: float, run_in_m: float
) -> list[Leg]:
    """Return a way at its height, and the runs of the lines beside it as ways of their own."""
    points = list(leg.points)
    runs: list[Leg | None] = [None, None]
    if before is not None and _is_run(points[:2], before, len(points), run_in_m):
        runs[0] = _low(leg, points[:2])
        points = points[1:]
    if after is not None and _is_run(points[-2:], after, len(points), run_in_m):
        runs[1] = _low(leg, points[-2:])
        points = points[:-1]
    high = replace(leg, points=tuple(points), height_m=height_m)
    return [each for each in (runs[0], high, runs[1]) if each is not None]


def _low(leg: Leg, points: Sequence[Place]) -> Leg:
    return replace(leg, kind="transit", points=tuple(points))


def _is_run(points: Sequence[Place], line: Leg, count: int, run_in_m: float) -> bool:
    """Return whether the end of a way is a run in the direction of its line."""
    (x0, y0), (x1, y1) = points
    length_m = math.dist(*points)
    if count < 3 or not 0.0 < length_m <= run_in_m + 1e-6:
        return False
    (x2, y2), (x3, y3) = line.points[0], line.points[-1]
    along = (x1 - x0) * (x3 - x2) + (y1 - y0) * (y3 - y2)
    return along > STRAIGHT * length_m * line.length_m
