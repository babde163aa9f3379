"""`calibrate valves` on the twin: the same ground work, read by the twin's own meter.

The plans come from the companion's ground work with a key that is held; the meter counts pulses
of what the scattered sprayer delivers, with its own gain and noise: of single valves it knows
nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from analysis.calibration.curve import Weighed, curve_course, identify_curve
from analysis.calibration.steps import CarriedOut, FlowRecord, Kind, orders_of
from analysis.calibration.valves import (
    CYCLES,
    Piece,
    counted_course,
    course_of,
    identify_valves,
)
from companion.core.boom import Boom
from companion.core.nozzle import NozzleSet
from companion.core.types import HeartbeatReport, LandedReport, OutputReport
from companion.ground.work import (
    GroundMemory,
    GroundOrder,
    GroundSetup,
    GroundState,
    Hold,
    ground_step,
    observe_ground,
)
from sitl.flight import FlightOptions, sprayer, true_profile

if TYPE_CHECKING:
    from collections.abc import Sequence

    from analysis.calibration.curve import CurveCourse, SetCurve
    from analysis.calibration.valves import Course, IdentifiedValves
    from companion.core.setup import Setup
    from companion.ground.work import GroundTask
    from sitl.outputs import Output
    from sitl.plant import Floats, Plant
    from sitl.profile import PlantProfile

STEP_S = 0.05
STROKE_S = 0.03
# Between two pieces: the key is let go, and the last drops have come.
REST_S = 2.0
# Edges of the meter's pulses are stamped by the kernel to this.
STAMP_S = 0.001
# The autopilot looks at its meter so often, tells it so often, and the link takes so long.
LOOK_S, TOLD_S, LATE_S = 0.1, 0.33, 0.04


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibrated:
    """What was found of each valve, and what it took."""

    found: IdentifiedValves
    course: Course
    minutes: float
    litres: float


def calibrate_valves(
    setup: Setup,
    profile: PlantProfile,
    options: FlightOptions,
    *,
    cycles: int = CYCLES,
    is_alone: bool = True,
    is_counted: bool = False,
) -> Calibrated:
    """Return what the twin's meter says of each valve of the very sprayer of a seed.

    `is_counted` by the autopilot, else by its pulses.
    """
    if is_counted:
        course = counted_course(setup.pwm, cycles=cycles, is_alone=is_alone)
    else:
        course = course_of(setup.pwm, setup.lag, cycles=cycles, is_alone=is_alone)
    pieces, now_s = recorded(setup, profile, options, course)
    found = identify_valves(pieces, len(setup.boom.valves))
    return Calibrated(
        found=found, course=course, minutes=now_s / 60.0, litres=found.volume_ml / 1000.0
    )


def recorded(
    setup: Setup, profile: PlantProfile, options: FlightOptions, course: Course
) -> tuple[list[Piece], float]:
    """Return the record of every piece, and how long all of it took in seconds."""
    plant, output = sprayer(true_profile(profile, options), options, 0.0)
    count = len(setup.boom.valves)
    memory, now_s, pieces = GroundMemory(), 0.0, []
    for valve, _ in course.rounds(count):
        now_s += REST_S
        began_s = now_s
        plans, memory, now_s = _perform(course.task(valve, count), output, memory, now_s)
        readings = _counts if course.is_counted else _readings
        time_s, volume_ml = readings(plant, began_s, now_s + 0.5 * REST_S)
        record = FlowRecord(
            orders=orders_of(plans, setup.nozzle_sets[-1]),
            time_s=time_s,
            volume_ml=volume_ml,
            period_s=setup.pwm.period_s,
            lag=setup.lag,
        )
        pieces.append(Piece(valve=valve, record=record, is_counted=course.is_counted))
    return pieces, now_s


def calibrate_curves(
    setup: Setup, profile: PlantProfile, options: FlightOptions
) -> tuple[tuple[SetCurve, ...], float]:
    """Return what the meter says of each set between its weighed duties, and how long it took."""
    weighed = [
        Weighed(valves=each.valves, duty=each.curve.duty, flow_l_min=each.curve.flow_l_min)
        for each in setup.nozzle_sets
    ]
    courses = [curve_course(each, setup.pwm, setup.lag) for each in weighed]
    records, now_s = recorded_curve(setup, profile, options, courses)
    found = (identify_curve(*each) for each in zip(records, weighed, strict=True))
    return tuple(found), now_s


def recorded_curve(
    setup: Setup, profile: PlantProfile, options: FlightOptions, courses: Sequence[CurveCourse]
) -> tuple[list[list[FlowRecord]], float]:
    """Return the records of each set's course, and how long all of it took in seconds."""
    plant, output = sprayer(true_profile(profile, options), options, 0.0)
    count = len(setup.boom.valves)
    sets = {each.valves: each for each in setup.nozzle_sets}
    memory, now_s, found = GroundMemory(), 0.0, []
    for course in courses:
        records = []
        for duties in course.pieces():
            now_s += REST_S
            began_s = now_s
            plans, memory, now_s = _perform(course.task(duties, count), output, memory, now_s)
            time_s, volume_ml = _readings(plant, began_s, now_s + 0.5 * REST_S)
            records.append(
                FlowRecord(
                    orders=orders_of(plans, sets[course.valves]),
                    time_s=time_s,
                    volume_ml=volume_ml,
                    period_s=setup.pwm.period_s,
                    lag=setup.lag,
                )
            )
        found.append(records)
    return found, now_s


def with_curves(setup: Setup, curves: Sequence[SetCurve]) -> Setup:
    """Return a set-up that knows the flow of its sets between the weighed duties."""
    found = {curve.valves: curve.curve for curve in curves}
    sets = tuple(replace(each, curve=found[each.valves]) for each in setup.nozzle_sets)
    return replace(setup, nozzle_sets=sets)


def with_figures(setup: Setup, found: IdentifiedValves) -> Setup:
    """Return a set-up that doses and times each valve by what was found of it."""
    valves = tuple(
        replace(
            valve,
            flow_factor=own.factor.value,
            lag_on_s=own.lags[Kind.ON].value,
            lag_off_s=own.lags[Kind.OFF].value,
            lag_up_s=own.lags[Kind.UP].value,
            lag_down_s=own.lags[Kind.DOWN].value,
        )
        for valve, own in zip(setup.boom.valves, found.valves, strict=True)
    )
    factors = [valve.flow_factor for valve in valves]
    boom = Boom(width_m=setup.boom.width_m, valves=valves, height_m=setup.boom.height_m)
    sets = tuple(
        NozzleSet.with_factors(each.valves, each.curve, factors) for each in setup.nozzle_sets
    )
    return replace(setup, boom=boom, nozzle_sets=sets)


def _perform(
    task: GroundTask, output: Output, memory: GroundMemory, now_s: float
) -> tuple[CarriedOut, GroundMemory, float]:
    """Do one piece with a key that is held; return its plans, and when all was closed."""
    plans = CarriedOut(valve_count=task.valve_count)
    hold, started_s, is_over = Hold(), now_s, False
    while not is_over:
        while hold.last_s + STROKE_S <= now_s or hold.strokes == 0:
            hold = hold.renewed(max(hold.last_s + STROKE_S, started_s))
        state = GroundState()
        for report in (
            HeartbeatReport(received_s=now_s, autopilot="ardupilot", armed=False, mode="LOITER"),
            LandedReport(received_s=now_s, in_air=False, on_ground=True),
            OutputReport(received_s=now_s, healthy=True),
        ):
            state = observe_ground(state, report)
        state = replace(state, mission_active=False)
        order = GroundOrder(task=task, started_s=started_s, hold=hold)
        decision, memory = ground_step(
            GroundSetup(), state, order, memory, now_s, valve_count=task.valve_count
        )
        plans.take(decision.plan, now_s)
        output.submit(decision.plan, now_s=now_s)
        is_over = decision.is_over
        now_s += STEP_S
    plans.finish()
    output.finish(now_s)
    return plans, memory, now_s


def _readings(plant: Plant, from_s: float, until_s: float) -> tuple[Floats, Floats]:
    """Return the meter's count at each of its pulses, and at both ends."""
    times_s = np.arange(from_s, until_s, STAMP_S)
    counts = plant.meter_count(times_s)
    pulses = np.flatnonzero(np.diff(counts) > 0) + 1
    chosen = np.unique(np.concatenate(([0], pulses, [len(times_s) - 1])))
    return times_s[chosen], counts[chosen] * (1000.0 / plant.profile.meter.pulses_per_l)


def _counts(plant: Plant, from_s: float, until_s: float) -> tuple[Floats, Floats]:
    """Return what the autopilot tells of the meter: whole millilitres, as it last looked."""
    looked_s = np.arange(from_s, until_s, LOOK_S)
    volume_ml = np.floor(plant.meter_count(looked_s) * 1000.0 / plant.profile.meter.pulses_per_l)
    told_s = np.arange(from_s, until_s, TOLD_S)
    last = np.searchsorted(looked_s, told_s, side="right") - 1
    return told_s + LATE_S, volume_ml[last]
