"""The closed loop without sockets: vehicle, navigation, core, output, plant; a plain loop.

Faster than real time and the same to the bit for the same seed. The controller sees messages and
nothing else; the truth goes into a `FlightRecord`.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Literal

import numpy as np
import shapely

from analysis.flight_record import Fidelity, FlightMeta, FlightRecord, Floats
from companion.core.controller import Memory, expected_coverage, step
from companion.core.estimator import Track, estimate, observe
from companion.core.frame import LocalFrame
from companion.core.options.coverage import Coverage
from companion.core.setup import Setup
from companion.core.types import (
    Decision,
    EstimatorReport,
    Fix,
    GnssReport,
    HeartbeatReport,
    Inhibit,
    Input,
    LandedReport,
    LegReport,
    OperatorCommand,
    SprayPlan,
    Telemetry,
    TimedChange,
    VehicleState,
)
from companion.output.pwm import PulseEngine
from sitl.airframes import DRAWN, EstimatorNoise
from sitl.drives import DrivenOutput, DriveTruth, Motors, Ranges
from sitl.earth import Earth
from sitl.knowledge import KnowingOutput, WaitingForDuties, WaitingForEdges, pwm_limits
from sitl.liquid_faults import LiquidFault, LiquidSensors
from sitl.navigation import SPEED_REPORT_RATE_HZ, Navigation
from sitl.outputs import (
    SERVO_FRAME_S,
    WIRE_S,
    AveragedOutput,
    DriverBoard,
    Output,
    PlanFollower,
    ServoOutput,
    TakesEdges,
)
from sitl.own_method import MakeController, OwnFlight, Sprayer, made
from sitl.plants import duty_plant, edge_plant
from sitl.trajectory import Route
from sitl.vehicle import STRAIGHT_DEG
from sitl.wang import POLL_S, WangController

if TYPE_CHECKING:
    from sitl.plant import Plant
    from sitl.profile import FlowLaw, PlantProfile
    from sitl.trajectory import Route, Trajectory


# Without a position a step follows after this, as in the runtime.
STEP_S = 0.06
SAMPLE_S: dict[Fidelity, float] = {"pulsed": 0.002, "averaged": 0.010}
TAIL_S = 1.0
# A position message is on its way this long: autopilot, wire, reader.
MESSAGE_DELAY_S = 0.005


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightOptions:
    """How a flight is simulated.

    `knows` is perfect knowledge: the true position, and each valve's own lag and flow, for a set-up
    of `knowledge.perfect_setup`; the sprayer is the same, scattered one. `scatter` off makes all
    valves alike. `flow_law` says how the flow runs between measured points; None: as the profile.
    `meter_rate_hz` above 0 has the flow meter report that often, `pressure_rate_hz` the pressure
    sensor; `liquid_faults` act on sprayers with valves. `drive_ranges_us` are stop and full pulse
    of each motor as the program has them; without them they are the plant's own. Positions are
    `position_rounded` as GLOBAL_POSITION_INT has them, or told in floats as LOCAL_POSITION_NED.
    """

    fidelity: Fidelity = "pulsed"
    output: Literal["gpio", "servo"] = "gpio"
    board: Literal["restarting", "free-running"] = "restarting"
    seed: int = 1
    position_rate_hz: float = 20.0
    position_rounded: bool = True
    imu_rate_hz: float = 0.0
    speed_rate_hz: float = SPEED_REPORT_RATE_HZ
    estimator_lag_s: float = 0.031
    noise: bool = True
    off: EstimatorNoise = DRAWN.noise
    scatter: bool = True
    knows: bool = False
    flow_law: FlowLaw | None = None
    meter_rate_hz: float = 0.0
    pressure_rate_hz: float = 0.0
    liquid_faults: tuple[LiquidFault, ...] = ()
    drive_ranges_us: Ranges = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightResult:
    """The truth of a flight and what the controller said of it; `drives` where there are motors."""

    record: FlightRecord
    steps: int
    late: int
    unresolved: int
    inhibits: frozenset[Inhibit]
    simulated_s: float
    drives: DriveTruth | None = None
    coverage: Coverage | None = None


Progress = Callable[[float], None]
OnStep = Callable[[Memory, VehicleState | None, float], None]


def fly(
    setup: Setup,
    trajectory: Trajectory,
    profile: PlantProfile,
    options: FlightOptions,
    *,
    speed_m_s: float,
    wang: WangController | None = None,
    method: str | None = None,
    observer: Callable[[Decision], None] | None = None,
    on_input: Callable[[Input], None] | None = None,
    disturb: Callable[[Iterator[Input]], Iterator[Input]] | None = None,
    mission: Route | None = None,
    on_step: OnStep | None = None,
    own: MakeController | None = None,
    heard: Iterable[Input] | None = None,
    plans: Iterable[SprayPlan] | None = None,
) -> FlightResult:
    """Fly `trajectory` with our controller, with P1's where `wang` is given, or with one's `own`.

    With `mission`, the route that the trajectory flies, the controller hears which leg it is.
    `heard` is all that it hears, in place of what a simulated autopilot would tell; `plans` are of
    whoever needs to hear nothing.
    `on_step` gets what each step has left, the state that it was given, and its time.
    """
    profile = true_profile(profile, options)
    start_s, end_s = float(trajectory.time_s[0]), float(trajectory.time_s[-1])
    plant, output = sprayer(profile, options, start_s)
    inputs = _inputs(setup, trajectory, options) if heard is None else iter(heard)
    if mission is not None:
        said_legs = leg_reports(mission, trajectory, setup.frame)
        inputs = heapq.merge(inputs, said_legs, key=lambda item: item.received_s)
    if disturb is not None:
        inputs = disturb(inputs)
    if plans is not None:
        said = _follow(plans, output)
    elif own is not None:
        said = _fly_own(own, method or own.__name__, setup, inputs, output, start_s)
    elif wang is not None:
        said = _fly_wang(wang, inputs, output, start_s)
    else:
        meter = _liquid_sensors(plant, options, start_s)
        said = _fly_ours(setup, inputs, output, meter, start_s, observer, on_input, on_step)
    output.finish(end_s + TAIL_S / 2)
    times = _sampled(start_s, end_s, options)
    path = trajectory.at(times)
    volume_ml = plant.volume_ml(times)
    record = FlightRecord(
        time_s=times,
        east_m=path.east_m,
        north_m=path.north_m,
        heading_deg=path.heading_deg,
        volume_ml=volume_ml,
        boom=setup.boom,
        prescription=setup.prescription,
        lines=setup.lines,
        guard=setup.overlap,
        treated=setup.treated,
        pwm_period_s=profile.pwm.period_s,
        duty_limits=_duty_limits(profile),
        nozzle_sets=() if profile.has_sections else setup.nozzle_sets,
        orders=tuple(output.orders),
        # White noise averages out over some messages; what wanders does not.
        position_sd_m=options.off.drift_m if options.noise and not options.knows else 0.0,
        meta=FlightMeta(
            speed_m_s=speed_m_s,
            method=method or (setup.method.value if own is None else own.__name__),
            fidelity=options.fidelity,
            output=options.output,
            seed=options.seed,
        ),
    )
    return FlightResult(
        record=record,
        steps=said.steps,
        late=said.late,
        unresolved=said.unresolved,
        inhibits=frozenset(said.inhibits),
        simulated_s=end_s - start_s,
        drives=(
            output.motors.truth(times, volume_ml) if isinstance(output, DrivenOutput) else None
        ),
        coverage=said.coverage,
    )


def _liquid_sensors(plant: Plant, options: FlightOptions, start_s: float) -> LiquidSensors:
    """Return what measures the liquid of a flight."""
    return LiquidSensors(
        plant,
        meter_rate_hz=options.meter_rate_hz,
        pressure_rate_hz=options.pressure_rate_hz,
        start_s=start_s,
        faults=options.liquid_faults,
        seed=options.seed,
    )


def _duty_limits(profile: PlantProfile) -> tuple[float, float]:
    """Return the duties at which a valve can do no more, or no less."""
    # Where a pump makes the flow an open valve says nothing of being at its limit.
    if profile.has_sections:
        return (0.0, math.inf)
    return (profile.pwm.duty_min, profile.pwm.duty_max)


def _sampled(start_s: float, end_s: float, options: FlightOptions) -> Floats:
    """Return the times that are recorded, until the last drop is out."""
    sample_s = SAMPLE_S[options.fidelity]
    samples = math.floor((end_s + TAIL_S - start_s) / sample_s) + 1
    times: Floats = start_s + sample_s * np.arange(samples, dtype=np.float64)
    return times


def true_profile(profile: PlantProfile, options: FlightOptions) -> PlantProfile:
    """Return the sprayer as the options have it."""
    if not options.scatter:
        profile = replace(
            profile,
            lag_scatter=0.0,
            flow_scatter=0.0,
            imperfections=None if profile.imperfections is None else profile.imperfections.alike,
        )
    if options.flow_law is not None:
        profile = replace(profile, flow_law=options.flow_law)
    return profile


def sprayer(profile: PlantProfile, options: FlightOptions, start_s: float) -> tuple[Plant, Output]:
    """Return a plant and the output path that drives it; a pump has no pulses."""
    plant, output = _valves(profile, options, start_s)
    if not profile.drive_count:
        return plant, output
    motors = Motors(profile, plant, start_s=start_s, ranges_us=options.drive_ranges_us)
    # A motor's pulse waits for its frame of 50 Hz, on the autopilot or on this computer.
    return plant, DrivenOutput(output, motors, delay_s=WIRE_S + 0.5 * SERVO_FRAME_S)


def _valves(profile: PlantProfile, options: FlightOptions, start_s: float) -> tuple[Plant, Output]:
    """Return a plant and the output path of its valves."""
    if options.fidelity == "averaged" or profile.pump is not None:
        averaged = duty_plant(profile, seed=options.seed, start_s=start_s)
        delay_s = WIRE_S + 0.5 * SERVO_FRAME_S if options.output == "servo" else 0.0
        if not options.knows:
            return averaged, AveragedOutput(averaged, delay_s=delay_s)
        duties = WaitingForDuties(averaged, seed=options.seed)
        return averaged, KnowingOutput(
            AveragedOutput(duties, delay_s=delay_s), duties, seed=options.seed
        )
    pulsed = edge_plant(profile, seed=options.seed, start_s=start_s)
    if not options.knows:
        return pulsed, _edge_output(pulsed, profile, options, start_s)
    edges = WaitingForEdges(pulsed, seed=options.seed)
    output = _edge_output(edges, profile, options, start_s)
    return pulsed, KnowingOutput(output, edges, seed=options.seed)


def _edge_output(
    pulsed: TakesEdges, profile: PlantProfile, options: FlightOptions, start_s: float
) -> Output:
    """Return the output path that makes edges."""
    if options.output == "gpio":
        return GpioOutput(pulsed, start_s=start_s)
    board = DriverBoard(
        profile.pwm,
        profile.valve_count,
        seed=options.seed,
        start_s=start_s,
        kind=options.board,
        overrun_s=profile.overrun_s if options.board == "restarting" else 0.0,
    )
    return ServoOutput(pulsed, board)


def _inputs(setup: Setup, trajectory: Trajectory, options: FlightOptions) -> Iterator[Input]:
    """Return all that the companion receives, in the order of arrival."""
    is_noisy = options.noise and not options.knows
    navigation = Navigation(
        trajectory,
        Earth(setup.frame.latitude_deg, setup.frame.longitude_deg),
        seed=options.seed,
        start_s=float(trajectory.time_s[0]),
        position_rate_hz=options.position_rate_hz,
        imu_rate_hz=options.imu_rate_hz if is_noisy else 0.0,
        speed_rate_hz=options.speed_rate_hz,
        rounded=options.position_rounded,
        estimator_lag_s=options.estimator_lag_s if is_noisy else 0.0,
        message_delay_s=MESSAGE_DELAY_S if is_noisy else 0.0,
        jitter_s=0.003 if is_noisy else 0.0,
        noise=is_noisy,
        off=options.off,
    )
    start_s, end_s = float(trajectory.time_s[0]), float(trajectory.time_s[-1])
    return heapq.merge(
        _statuses(start_s, end_s), navigation.advance(end_s), key=lambda item: item.received_s
    )


def _statuses(start_s: float, end_s: float) -> Iterator[Input]:
    """Yield what a healthy vehicle in a mission says besides its position."""
    yield HeartbeatReport(received_s=start_s, autopilot="ardupilot", armed=True, mode="AUTO")
    yield OperatorCommand(received_s=start_s, enable=True, source="command")
    for i in range(math.ceil((end_s - start_s) / 0.5) + 1):
        now_s = start_s + 0.5 * i
        yield HeartbeatReport(received_s=now_s, autopilot="ardupilot", armed=True, mode="AUTO")
        yield GnssReport(received_s=now_s, fix=Fix.RTK_FIXED)
        yield EstimatorReport(received_s=now_s, healthy=True)
        yield LandedReport(received_s=now_s, in_air=True)


class GpioOutput:
    """The product's pulse engine, to the edge: judged like the rest of the product."""

    def __init__(self, plant: TakesEdges, *, start_s: float) -> None:
        profile = plant.profile
        self._plant = plant
        self._engine = PulseEngine(
            pwm_limits(profile),
            profile.valve_count,
            start_s=start_s,
            overrun_s=profile.overrun_s,
        )
        self._follower = PlanFollower(profile.valve_count)

    @property
    def orders(self) -> list[TimedChange]:
        """Return the changes carried out so far."""
        return self._follower.orders

    def submit(self, plan: SprayPlan, *, now_s: float) -> None:
        """Carry out what was due, then replace the future."""
        self._follower.submit(plan, now_s=now_s)
        self._engine.submit(plan, now_s=now_s)
        self._plant.record(self._engine.advance(now_s))

    def finish(self, end_s: float) -> None:
        """Carry out all until `end_s`."""
        self._follower.advance(end_s)
        self._plant.record(self._engine.advance(end_s))


@dataclass(slots=True)
class _Said:
    """Counts of what the controller said."""

    inhibits: set[Inhibit]
    steps: int = 0
    late: int = 0
    unresolved: int = 0
    coverage: Coverage | None = None


def _follow(plans: Iterable[SprayPlan], output: Output) -> _Said:
    """Carry out plans that were made beforehand."""
    said = _Said(set())
    for plan in plans:
        output.submit(plan, now_s=plan.issued_s)
    return said


def _fly_ours(
    setup: Setup,
    inputs: Iterator[Input],
    output: Output,
    meter: LiquidSensors,
    start_s: float,
    observer: Callable[[Decision], None] | None,
    on_input: Callable[[Input], None] | None,
    on_step: OnStep | None,
) -> _Said:
    """Run the core as the runtime does: at every position, and 20 times a second at least."""
    track, memory, said = Track(), Memory(), _Said(set())
    next_s = start_s

    def decide(now_s: float) -> None:
        nonlocal memory, next_s
        state = estimate(track, now_s)
        decision, memory = step(setup, state, memory, now_s)
        output.submit(decision.plan, now_s=now_s)
        next_s = now_s + STEP_S
        said.steps += 1
        said.late += decision.late_count
        said.unresolved += decision.unresolved_count
        said.inhibits |= decision.inhibits
        if observer is not None:
            observer(decision)
        if on_step is not None:
            on_step(memory, state, now_s)
        for report in meter.read(now_s):
            hear(report)

    def hear(item: Input) -> None:
        nonlocal track
        if on_input is not None:
            on_input(item)
        track = observe(track, item, setup)

    for item in inputs:
        while next_s <= item.received_s:
            decide(next_s)
        hear(item)
        if isinstance(item, Telemetry):
            decide(item.received_s)
    said.coverage = _treated(setup, memory, estimate(track, next_s), next_s)
    return said


def _treated(
    setup: Setup, memory: Memory, state: VehicleState | None, now_s: float
) -> Coverage | None:
    """Return what a flight that ends now has treated; None where it is not kept."""
    if not setup.records_coverage:
        return None
    return expected_coverage(setup, memory, state, now_s=now_s, cut_s=now_s)


def _fly_wang(
    wang: WangController, inputs: Iterator[Input], output: Output, start_s: float
) -> _Said:
    """Run P1's controller: poll, compute, order; the plans come out in order of time."""
    said = _Said(set())
    next_s = start_s + POLL_S
    pending = []
    for item in inputs:
        while next_s <= item.received_s:
            plan = wang.poll(next_s)
            if plan is not None:
                pending.append(plan)
            while pending and pending[0].issued_s <= next_s:
                output.submit(pending[0], now_s=pending[0].issued_s)
                pending.pop(0)
            said.steps += 1
            next_s += POLL_S
        if isinstance(item, Telemetry):
            wang.hear(item)
    for plan in pending:
        output.submit(plan, now_s=plan.issued_s)
    return said


def _fly_own(
    own: MakeController,
    name: str,
    setup: Setup,
    inputs: Iterator[Input],
    output: Output,
    start_s: float,
) -> _Said:
    """Run a method of one's own inside the companion's interlock."""
    flight = OwnFlight(
        controller=made(own, name, Sprayer(setup)), name=name, setup=setup, output=output
    )
    flight.fly(inputs, start_s=start_s)
    return _Said(flight.inhibits, steps=flight.steps)


# What is read from an autopilot of the legs of a simulated flight, without the wire.

EVERY_S = 0.5  # MISSION_CURRENT is asked for at 2 Hz
# A leg lies on another where both of its ends are so near to it, and it is so much shorter.
ON_M, LONGER_M = 0.5, 1.0


def leg_reports(route: Route, trajectory: Trajectory, frame: LocalFrame) -> Iterator[LegReport]:
    """Yield the leg that is flown, twice a second, in the order of time."""
    start_s, end_s = float(trajectory.time_s[0]), float(trajectory.time_s[-1])
    ends = [(route.start_east_m, route.start_north_m)]
    ends += [(leg.east_m, leg.north_m) for leg in route.legs]
    places = [frame.to_geographic(*end) for end in ends]
    step_s = float(trajectory.time_s[1]) - start_s
    longer = [_longer(ends, number) for number in range(len(route.legs))]
    for count in range(math.floor((end_s - start_s) / EVERY_S) + 1):
        now_s = start_s + EVERY_S * count
        number = int(trajectory.leg[min(int((now_s - start_s) / step_s), len(trajectory.leg) - 1)])
        yield LegReport(
            received_s=now_s,
            from_latitude_deg=places[number][0],
            from_longitude_deg=places[number][1],
            to_latitude_deg=places[number + 1][0],
            to_longitude_deg=places[number + 1][1],
            stops=_bend_deg(ends, number) >= STRAIGHT_DEG,
            speed_m_s=route.legs[number].speed_m_s,
            longer=None if (on := longer[number]) is None else (places[on], places[on + 1]),
        )


def _longer(ends: list[tuple[float, float]], number: int) -> int | None:
    """Return the shortest other leg on which a leg lies whole; None where it lies on none."""
    legs = shapely.linestrings(list(pairwise(ends)))
    length_m = shapely.length(legs)
    near = [shapely.distance(legs, shapely.Point(end)) <= ON_M for end in ends[number : number + 2]]
    found = np.flatnonzero(near[0] & near[1] & (length_m >= length_m[number] + LONGER_M))
    return None if found.size == 0 else int(found[length_m[found].argmin()])


def _bend_deg(ends: list[tuple[float, float]], number: int) -> float:
    """Return the change of course at the end of a leg; 180 at the end of the route."""
    if number + 2 >= len(ends):
        return 180.0
    (e0, n0), (e1, n1), (e2, n2) = ends[number : number + 3]
    turn = math.atan2(e2 - e1, n2 - n1) - math.atan2(e1 - e0, n1 - n0)
    return abs((math.degrees(turn) + 180.0) % 360.0 - 180.0)
