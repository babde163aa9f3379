"""Hard conditions, one name each: edges at any angle, arcs, gusts, braking; and unknown errors.

Their fields are bands or plots whose edges lie askew to the path, along any line. Places are given
along and across the centre line of a `CentreLine`, so that one map serves a straight pass and an
arc.

Unknown errors of lags act on the configuration, of position on the messages, wind on where the
liquid lands. A campaign sets them as `error.`; what they cost is in `tools/studies/sensitivity.py`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import shapely
from shapely import Polygon

from analysis.published import P1_RATES_L_HA
from companion.core.frame import LocalFrame
from companion.core.nozzle import flow_for_rate
from companion.core.prescription import Prescription, Zone
from companion.core.schedule import LagModel
from companion.core.setup import Setup
from companion.core.types import Input, Telemetry
from sitl.anyang import anyang_passes
from sitl.trajectory import Floats, Leg, Route, Trajectory
from sitl.vehicle import STEP_S, Vehicle

if TYPE_CHECKING:
    from analysis.flight_record import FlightRecord

# The field reaches farther to both sides than a boom of 6 m, so that no strip meets the border
# sideways: an edge there would shut its valve, whatever the zone.
HALF_M = 5.0
OUTERMOST_M = 2.5  # the outermost valves' centres
LEAD_M = 10.0  # from the field's ends to the first and the last edge, under every valve
ACROSS = np.linspace(-HALF_M, HALF_M, 11)
# Changes smaller than 8 % are counted apart; these are not to be mistaken for them.
STEP_MIN = 0.10
TRIES = 50


def edges_of(
    count: int, *, spacing_m: float, slants_deg: Sequence[float]
) -> tuple[list[Floats], float]:
    """Return `count` edges between the field's two ends, those among them, and its length.

    An edge is its place along the line at every one of `ACROSS`. Edge k is `spacing_m` behind the
    one before it and turned by `slants_deg[k]`, in turn, out of the square to the path; clockwise
    is positive.
    """
    slopes = [
        -math.tan(math.radians(slants_deg[number % len(slants_deg)])) for number in range(count)
    ]
    lead_m = LEAD_M + OUTERMOST_M * max(map(abs, slopes))
    length_m = 2.0 * lead_m + (count - 1) * spacing_m
    edges = [np.zeros_like(ACROSS)]
    edges += [
        np.clip(lead_m + number * spacing_m + slope * ACROSS, 0.0, length_m)
        for number, slope in enumerate(slopes)
    ]
    edges.append(np.full_like(ACROSS, length_m))
    return edges, length_m


def bands(line: CentreLine, edges: Sequence[Floats], rates_l_ha: Sequence[float]) -> Prescription:
    """Return the bands between the edges with one rate each."""
    return _field(
        [
            Zone(name=str(number), polygon=_band(line, *pair), rate_l_ha=rate)
            for number, (pair, rate) in enumerate(zip(pairwise(edges), rates_l_ha, strict=True))
        ]
    )


def _band(line: CentreLine, begin_m: Floats, end_m: Floats) -> Polygon:
    """Return the ground between two edges."""
    left = np.linspace(begin_m[0], end_m[0], 15)[1:-1]
    right = np.linspace(begin_m[-1], end_m[-1], 15)[1:-1]
    along_m = np.concatenate((begin_m, right, end_m[::-1], left[::-1]))
    aside = (ACROSS, np.full(len(right), HALF_M), ACROSS[::-1], np.full(len(left), -HALF_M))
    east_m, north_m = line.place(along_m, np.concatenate(aside))
    return Polygon(np.stack((east_m, north_m), axis=1))


def plots(
    line: CentreLine,
    rates_l_ha: Sequence[float],
    *,
    side_m: float,
    turn_deg: float,
    length_m: float,
) -> Prescription:
    """Return square plots in rows and columns, turned, on straight ground; neighbours differ."""
    corners = [(0.0, -HALF_M), (0.0, HALF_M), (length_m, HALF_M), (length_m, -HALF_M)]
    ring = [np.array(part) for part in zip(*corners, strict=True)]
    ground = Polygon(np.stack(line.place(*ring), axis=1))
    middle = ground.centroid
    reach = math.ceil(length_m / side_m / math.sqrt(2.0)) + 1
    zones = []
    for row in range(-reach, reach):
        for column in range(-reach, reach):
            box = shapely.box(
                column * side_m, row * side_m, (column + 1) * side_m, (row + 1) * side_m
            )
            turned = shapely.affinity.rotate(box, -turn_deg, origin=(0.0, 0.0))
            part = shapely.affinity.translate(turned, middle.x, middle.y).intersection(ground)
            if isinstance(part, Polygon) and part.area > 1.0:
                # Two apart in the list along a row, three across: no neighbours are alike.
                rate = rates_l_ha[(2 * column + 3 * row) % len(rates_l_ha)]
                zones.append(Zone(name=f"{row},{column}", polygon=part, rate_l_ha=rate))
    return _field(zones)


def _field(zones: Sequence[Zone]) -> Prescription:
    """Return the map: spraying is allowed where there is a zone."""
    return Prescription(zones)


def drawn_rates(choice: Sequence[float], count: int, *, seed: int) -> list[float]:
    """Return `count` rates at random, each at least a tenth off the one before it."""
    rng = np.random.default_rng(seed)
    rates: list[float] = []
    while len(rates) < count:
        rate = float(rng.choice(choice))
        if not rates or _differ(rate, rates[-1]):
            rates.append(rate)
    return rates


def deliverable_rates(
    edges: Sequence[Floats],
    along_m: Floats,
    speed_m_s: Floats,
    within: tuple[float, float],
    *,
    seed: int,
) -> list[float]:
    """Return rates at random that the speeds over each band leave within the sprayer's range.

    `within` is the least and the greatest rate times speed, L/ha times m/s. Where nothing within
    it is a tenth off the rate before, the end of the range that is farther off is taken.
    """
    rng = np.random.default_rng(seed)
    rates: list[float] = []
    for begin, end in pairwise(edges):
        over = (along_m >= begin.min()) & (along_m <= end.max())
        low = within[0] / float(speed_m_s[over].min())
        high = max(within[1] / float(speed_m_s[over].max()), low)
        drawn = rng.uniform(low, high, size=TRIES).tolist()
        ends = sorted((low, high), key=lambda rate: -abs(rate - rates[-1]) if rates else 0.0)
        rates.append(
            next((rate for rate in drawn if not rates or _differ(rate, rates[-1])), ends[0])
        )
    return rates


def _differ(rate: float, other: float) -> bool:
    return abs(rate - other) >= STEP_MIN * min(rate, other)


# Flights that are hard to predict: along arcs, with a speed that sways, braking over the field.
#
# All of them are the copter of `vehicle.py` on a straight line, whose way along and across the line
# is then laid on another centre line.

HEIGHT_M = 3.5
RUN_M = 25.0  # before and behind the field, so that the speed is steady there
START_S = 100.0


@dataclass(frozen=True, slots=True, kw_only=True)
class CentreLine:
    """A straight line (curvature 0) or an arc, to the right where the curvature is positive."""

    curvature_1_m: float = 0.0
    course_deg: float = 0.0

    def course_rad(self, along_m: Floats) -> Floats:
        """Return the course after `along_m`."""
        return math.radians(self.course_deg) + self.curvature_1_m * along_m

    def place(self, along_m: Floats, right_m: Floats) -> tuple[Floats, Floats]:
        """Return east and north of places beside the line."""
        course = self.course_rad(along_m)
        sin, cos = np.sin(course), np.cos(course)
        if self.curvature_1_m == 0.0:
            return along_m * sin + right_m * cos, along_m * cos - right_m * sin
        begin = math.radians(self.course_deg)
        radius_m = 1.0 / self.curvature_1_m
        east_m = radius_m * math.cos(begin) - (radius_m - right_m) * cos
        north_m = -radius_m * math.sin(begin) + (radius_m - right_m) * sin
        return east_m, north_m


@dataclass(frozen=True, slots=True, kw_only=True)
class Pace:
    """How fast the field is flown over.

    `slow_m_s` is braked to at the end of every `fast_m`, held for `slow_m`, and left again. Speed
    sways by `sway_m_s` in `sway_period_s`, as a sine of any phase, on top of gusts.
    """

    speed_m_s: float = 5.0
    acceleration_m_s2: float = 2.5
    gust_m_s: float = 1.0
    sway_m_s: float = 0.0
    sway_period_s: float = 6.0
    slow_m_s: float | None = None
    fast_m: float = 50.0
    slow_m: float = 8.0


def hard_trajectory(line: CentreLine, pace: Pace, length_m: float, *, seed: int) -> Trajectory:
    """Return a flight along `line` from before its start to beyond `length_m`."""
    route = _straight(pace, length_m)
    flown = Vehicle(
        route,
        start_s=START_S,
        seed=seed,
        acceleration_m_s2=pace.acceleration_m_s2,
        gust_m_s=pace.gust_m_s,
    ).fly_to_end()
    if pace.gust_m_s > 1.0:
        # The strong gusts are those of the speed: across, the line is held as in gusts of 1 m/s.
        flown = replace(
            flown,
            east_m=flown.east_m / pace.gust_m_s,
            velocity_east_m_s=flown.velocity_east_m_s / pace.gust_m_s,
        )
    if pace.sway_m_s > 0.0:
        phase = float(np.random.default_rng(seed).uniform(0.0, 2.0 * math.pi))
        flown = _swaying(flown, pace, phase)
    return laid_on(flown, line)


def _straight(pace: Pace, length_m: float) -> Route:
    """Return the way northwards: one leg, or legs of two speeds in turn."""
    end_m = length_m + RUN_M
    ends = [(end_m, pace.speed_m_s)]
    if pace.slow_m_s is not None:
        ends, at_m = [], 0.0
        while at_m + pace.fast_m + pace.slow_m < length_m:
            ends.append((at_m + pace.fast_m, pace.speed_m_s))
            at_m += pace.fast_m + pace.slow_m
            ends.append((at_m, pace.slow_m_s))
        ends.append((end_m, pace.speed_m_s))
    legs = tuple(Leg(east_m=0.0, north_m=north_m, speed_m_s=speed) for north_m, speed in ends)
    return Route(start_east_m=0.0, start_north_m=-RUN_M, legs=legs, height_m=HEIGHT_M)


def _swaying(flown: Trajectory, pace: Pace, phase: float) -> Trajectory:
    """Return the flight with its speed raised and lowered in proportion to itself."""
    turns = 2.0 * math.pi / pace.sway_period_s * (flown.time_s - flown.time_s[0]) + phase
    speed = flown.velocity_north_m_s * (1.0 + pace.sway_m_s / pace.speed_m_s * np.sin(turns))
    gone_m = np.cumsum(0.5 * (speed[1:] + speed[:-1])) * STEP_S
    north_m = flown.north_m[0] + np.concatenate(([0.0], gone_m))
    return replace(flown, north_m=north_m, velocity_north_m_s=speed)


def laid_on(flown: Trajectory, line: CentreLine) -> Trajectory:
    """Return a flight northwards along north 0 laid on `line`: the nose follows its course."""
    along_m, right_m = flown.north_m, flown.east_m
    east_m, north_m = line.place(along_m, right_m)
    course = line.course_rad(along_m)
    sin, cos = np.sin(course), np.cos(course)
    ahead = flown.velocity_north_m_s * (1.0 - line.curvature_1_m * right_m)
    aside = flown.velocity_east_m_s
    return replace(
        flown,
        east_m=east_m,
        north_m=north_m,
        velocity_east_m_s=ahead * sin + aside * cos,
        velocity_north_m_s=ahead * cos - aside * sin,
        heading_deg=np.degrees(course),
    )


# The conditions.

EDGES = 20
SPACING_M = 14.0
SPEED_M_S = 5.0
COURSE_DEG = 12.0  # the example field's
# What is asked of a valve at a changing speed stays within its range by these factors: 5 % of
# trim is left; a valve at its end would say nothing of the schedule.
MARGINS = (1.06, 0.97)
BRAKE_M_S2 = (1.0, 2.5)


@dataclass(frozen=True, slots=True, kw_only=True)
class Condition:
    """A kind of field and of flight, drawn by seed; `is_bound` says whether targets hold."""

    name: str
    what: str
    make: Callable[[int], tuple[Course, Pace]]
    speed_m_s: float = SPEED_M_S
    is_bound: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class Course:
    """A map and the line over it; without rates they are drawn for the speeds that are flown."""

    line: CentreLine
    rates_l_ha: tuple[float, ...] = ()
    slants_deg: tuple[float, ...] = (0.0,)
    spacing_m: float = SPACING_M
    edges: int = EDGES
    plots_m: float | None = None


def _sign(seed: int) -> float:
    """Return the side that edges lean to, or the path bends to: both in turn."""
    return 1.0 if seed % 2 else -1.0


def _oblique(angle_deg: float) -> Callable[[int], tuple[Course, Pace]]:
    def make(seed: int) -> tuple[Course, Pace]:
        slants = (_sign(seed) * angle_deg,)
        return Course(line=_STRAIGHT, rates_l_ha=P1_RATES_L_HA, slants_deg=slants), Pace()

    return make


def _plots(turn_deg: float) -> Callable[[int], tuple[Course, Pace]]:
    def make(seed: int) -> tuple[Course, Pace]:
        slants = (_sign(seed) * turn_deg,)
        rates = tuple(P1_RATES_L_HA[k] for k in (0, 4, 8, 1, 5, 9, 2, 6, 3, 7))
        course = Course(line=_STRAIGHT, rates_l_ha=rates, slants_deg=slants, plots_m=24.0)
        return course, Pace()

    return make


def _arc(radius_m: float) -> Callable[[int], tuple[Course, Pace]]:
    # The path must not meet itself: of 40 m there are 250 m of circle.
    edges = min(EDGES, int((5.5 * radius_m - 50.0 - 24.0) / SPACING_M))

    def make(seed: int) -> tuple[Course, Pace]:
        line = CentreLine(curvature_1_m=_sign(seed) / radius_m, course_deg=COURSE_DEG)
        slants = (20.0, -20.0, 0.0)
        course = Course(line=line, rates_l_ha=P1_RATES_L_HA, slants_deg=slants, edges=edges)
        return course, Pace()

    return make


def _paced(pace: Pace) -> Callable[[int], tuple[Course, Pace]]:
    def make(_: int) -> tuple[Course, Pace]:
        return Course(line=_STRAIGHT), pace

    return make


def _braking(seed: int) -> tuple[Course, Pace]:
    """Between 6 and 2 m/s again and again, edges anywhere in it, harder from seed to seed."""
    low, high = BRAKE_M_S2
    share = (seed * 0.618034) % 1.0
    pace = Pace(speed_m_s=6.0, slow_m_s=2.0, acceleration_m_s2=low + (high - low) * share)
    course = Course(line=_STRAIGHT, spacing_m=9.5, edges=30)
    return course, pace


_STRAIGHT = CentreLine(course_deg=COURSE_DEG)

CONDITIONS: tuple[Condition, ...] = (
    *(
        Condition(
            name=f"edges-{angle}",
            what=f"edges {angle} degrees out of the square",
            make=_oblique(float(angle)),
        )
        for angle in (15, 30, 45, 75)
    ),
    # Corners are cut shorter than any plant can follow: what is apart is the map's doing.
    Condition(
        name="plots-30",
        what="plots of 24 m turned by 30 degrees",
        make=_plots(30.0),
        is_bound=False,
    ),
    *(
        Condition(name=f"arc-{radius}", what=f"arc of {radius} m", make=_arc(float(radius)))
        for radius in (40, 100)
    ),
    Condition(
        name="sway",
        what="speed sways by 1 m/s in 6 s",
        make=_paced(Pace(sway_m_s=1.0)),
    ),
    Condition(
        name="gusts",
        what="gusts that move the speed by 0.75 m/s (1 sd)",
        make=_paced(Pace(gust_m_s=5.0)),
    ),
    Condition(
        name="braking", what="braking from 6 to 2 m/s and back", make=_braking, speed_m_s=6.0
    ),
)
_BY_NAME = {condition.name: condition for condition in CONDITIONS}


def condition_of(name: str) -> Condition:
    """Return a condition by its name."""
    return _BY_NAME[name]


def laid_out(condition: Condition, seed: int, base: Setup) -> tuple[Setup, Trajectory]:
    """Return the controller's set-up over the condition's field, and the true path."""
    course, pace = condition.make(seed)
    edges, length_m = edges_of(
        course.edges, spacing_m=course.spacing_m, slants_deg=course.slants_deg
    )
    straight = hard_trajectory(CentreLine(), pace, length_m, seed=seed)
    if course.plots_m is not None:
        field = plots(
            course.line,
            course.rates_l_ha,
            side_m=course.plots_m,
            turn_deg=course.slants_deg[0],
            length_m=length_m,
        )
    else:
        rates = _rates(course, edges, straight, base, seed)
        field = bands(course.line, edges, rates)
    limits = replace(base.limits, speed_min_m_s=0.5, speed_max_m_s=12.0)
    return replace(base, prescription=field, limits=limits), laid_on(straight, course.line)


def _rates(
    course: Course, edges: Sequence[Floats], straight: Trajectory, base: Setup, seed: int
) -> list[float]:
    """Return P1's rates at a steady speed, and otherwise such as the valves can follow."""
    if course.rates_l_ha:
        return drawn_rates(course.rates_l_ha, len(edges) - 1, seed=seed)
    curve, pwm = base.nozzle_sets[-1].curve, base.pwm
    per_l_min = 1.0 / flow_for_rate(1.0, 1.0, base.boom.width_m)
    within = (
        MARGINS[0] * curve.flow_for(pwm.duty_min) * per_l_min,
        MARGINS[1] * curve.flow_for(pwm.duty_max) * per_l_min,
    )
    return deliverable_rates(
        edges, straight.north_m, straight.velocity_north_m_s, within, seed=seed
    )


# ---------------------------------------------------------------------- errors that nobody knows of

RATE_HZ = 20.0
# Slower than this there is no course to be told.
MOVING_M_S = 0.5

INSIDE = ("up_s", "down_s")
BORDER = ("on_s", "off_s", "on_start_s", "off_end_s")


@dataclass(frozen=True, slots=True, kw_only=True)
class Disturbance:
    """One error of one flight; without any of its values there is none.

    `lag_short_s` is how much too short the lags in `kinds` are in the configuration. `behind_m`
    is how far behind the vehicle its position is told, along its course; `along_m` and `across_m`
    are how far off it is told on the ground: towards the end of the first pass, and to its right.
    `drift_along_m` and `drift_across_m` are how far wind carries the droplets, the same two ways.
    """

    lag_short_s: float = 0.0
    kinds: tuple[str, ...] = (*INSIDE, *BORDER)
    behind_m: float = 0.0
    along_m: float = 0.0
    across_m: float = 0.0
    drift_along_m: float = 0.0
    drift_across_m: float = 0.0

    @property
    def is_drift(self) -> bool:
        """Return whether it acts on the falling droplets only."""
        return self.drift_along_m != 0.0 or self.drift_across_m != 0.0


def shortened(lag: LagModel, what: Disturbance) -> LagModel:
    """Return the lags with the error in them."""
    wrong = {name: getattr(lag, name) - what.lag_short_s for name in what.kinds}
    return replace(lag, **wrong)


def displaced(items: Iterator[Input], *, what: Disturbance, frame: LocalFrame) -> Iterator[Input]:
    """Yield the inputs with every position in the wrong place."""
    east_m, north_m = on_ground(frame, what.along_m, what.across_m)
    if (what.behind_m, east_m, north_m) == (0.0, 0.0, 0.0):
        yield from items
        return
    for item in items:
        yield (
            _moved(item, frame, what.behind_m, east_m, north_m)
            if isinstance(item, Telemetry)
            else item
        )


def _moved(
    told: Telemetry, frame: LocalFrame, behind_m: float, east_m: float, north_m: float
) -> Telemetry:
    velocity_east, velocity_north = told.velocity_east_m_s or 0.0, told.velocity_north_m_s or 0.0
    speed_m_s = math.hypot(velocity_east, velocity_north)
    if speed_m_s > MOVING_M_S:
        east_m -= behind_m * velocity_east / speed_m_s
        north_m -= behind_m * velocity_north / speed_m_s
    at_east_m, at_north_m = frame.to_local(told.latitude_deg, told.longitude_deg)
    latitude_deg, longitude_deg = frame.to_geographic(at_east_m + east_m, at_north_m + north_m)
    return replace(told, latitude_deg=latitude_deg, longitude_deg=longitude_deg)


def drifted(record: FlightRecord, what: Disturbance, frame: LocalFrame) -> FlightRecord:
    """Return the flight with the path that would have put its liquid where the wind puts it."""
    east_m, north_m = on_ground(frame, what.drift_along_m, what.drift_across_m)
    return replace(record, east_m=record.east_m + east_m, north_m=record.north_m + north_m)


def on_ground(frame: LocalFrame, along_m: float, across_m: float) -> tuple[float, float]:
    """Return (east, north) of a way along the first pass and to the right of it."""
    line = anyang_passes(frame)[0]
    east_m, north_m = line.end_east_m - line.start_east_m, line.end_north_m - line.start_north_m
    length_m = math.hypot(east_m, north_m)
    east, north = east_m / length_m, north_m / length_m
    return along_m * east + across_m * north, along_m * north - across_m * east
