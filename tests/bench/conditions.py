"""The hard conditions: edges at any angle, arcs, a swaying speed, gusts, braking; one name each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from companion.core.nozzle import flow_for_rate
from companion.core.setup import Setup
from sitl.studies.hard_fields import (
    CentreLine,
    Pace,
    bands,
    deliverable_rates,
    drawn_rates,
    edges_of,
    hard_trajectory,
    laid_on,
    plots,
)
from sitl.trajectory import Floats, Trajectory
from tests.bench.fields import RATES_L_HA

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
        return Course(line=_STRAIGHT, rates_l_ha=RATES_L_HA, slants_deg=slants), Pace()

    return make


def _plots(turn_deg: float) -> Callable[[int], tuple[Course, Pace]]:
    def make(seed: int) -> tuple[Course, Pace]:
        slants = (_sign(seed) * turn_deg,)
        rates = tuple(RATES_L_HA[k] for k in (0, 4, 8, 1, 5, 9, 2, 6, 3, 7))
        course = Course(line=_STRAIGHT, rates_l_ha=rates, slants_deg=slants, plots_m=24.0)
        return course, Pace()

    return make


def _arc(radius_m: float) -> Callable[[int], tuple[Course, Pace]]:
    # The path must not meet itself: of 40 m there are 250 m of circle.
    edges = min(EDGES, int((5.5 * radius_m - 50.0 - 24.0) / SPACING_M))

    def make(seed: int) -> tuple[Course, Pace]:
        line = CentreLine(curvature_1_m=_sign(seed) / radius_m, course_deg=COURSE_DEG)
        slants = (20.0, -20.0, 0.0)
        course = Course(line=line, rates_l_ha=RATES_L_HA, slants_deg=slants, edges=edges)
        return course, Pace()

    return make


def _paced(pace: Pace) -> Callable[[int], tuple[Course, Pace]]:
    def make(seed: int) -> tuple[Course, Pace]:
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
