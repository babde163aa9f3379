"""`vrspray sitl fly`: one mission over one map in the closed loop, evaluated, without a socket.

The controller is the configured one with its configured lags; the plant is a profile with its own
true ones. A second flight of the same path with perfect knowledge says how far from the best
possible the first one was; with a pump it does not, for there driven steps come nearer than the
plant's plain lags.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import shapely
from shapely import LineString

from analysis.border import off_target_ml
from analysis.evaluation import Evaluation, evaluate, limit_ratio
from analysis.strips import strips_of
from companion.assembly import deliverable, refuse_mismatch
from companion.config import Config, load
from companion.core.label import LabelLimits
from companion.core.nozzle import allowed_duty, flow_for_rate
from companion.core.prescription import Prescription
from companion.core.setup import Setup
from companion.core.types import (
    EstimatorReport,
    Fix,
    GnssReport,
    HeartbeatReport,
    Inhibit,
    Input,
    SpeedReport,
    Telemetry,
)
from companion.errors import ConfigError
from missions.maps.compiling import compiled_setup
from missions.maps.model import Problem
from sitl.airframes import DRAWN, Airframe, airframe_of
from sitl.flight import FlightOptions, FlightResult, fly, true_profile
from sitl.knowledge import perfect_setup
from sitl.motor_parts import check_motors, droplet_figures, fits, ranges_us
from sitl.outputs import SERVO_FRAME_S, WIRE_S
from sitl.own_method import MakeController, load_controller
from sitl.profile import PROFILES, PlantProfile, load_profile
from sitl.routes import SPEED_MAX_M_S, SPEED_MIN_M_S, legs_over, read_route
from sitl.scenario_file import read_scenario
from sitl.stub.faults import Fault, FaultClock, FaultKind
from sitl.stub.mission_items import MODE_NAMES
from sitl.vehicle import Corners, Leg, Route, Trajectory, Vehicle

if TYPE_CHECKING:
    from shapely import LineString

    from analysis.flight_record import Fidelity, FlightRecord
    from companion.core.options.drift import Drift
    from companion.core.types import Decision, Input
    from sitl.profile import FlowLaw
    from sitl.vehicle import Leg


DEFAULT_SPEED_M_S = 5.0
DEFAULT_ACCELERATION_M_S2 = 2.5
METER_RATE_MAX_HZ = 1000.0
SAY_EVERY_S = 300.0  # of the flight
STRETCH_STEP_M = 0.5

Say = Callable[[str], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class FlyOptions:
    """What the command line says; None leaves it to the files."""

    config: Path
    mission: Path
    overrides: tuple[str, ...] = ()
    scenario: Path | None = None
    plant: str | None = None
    fidelity: Fidelity | None = None
    output: Literal["gpio", "servo"] | None = None
    seed: int = 1
    corners: Corners | None = None
    vehicle: str = "drawn"
    speed_m_s: float | None = None
    meter_rate_hz: float = 50.0
    flow_law: FlowLaw | None = None
    controller: str | None = None
    out: Path | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """Everything that is known before the take-off."""

    config: Config
    setup: Setup
    profile: PlantProfile
    route: Route
    speed_m_s: float
    warnings: tuple[Problem, ...]
    faults: tuple[Fault, ...]
    airframe: Airframe = DRAWN
    own: MakeController | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Flown:
    """A flight with its path, its perfect twin's figures, and the time that it took.

    `perfect` is None for a pump, whose flight with perfect knowledge is no bound.
    """

    task: Task
    result: FlightResult
    evaluation: Evaluation
    perfect: Evaluation | None
    trajectory: Trajectory
    zero_rate_ml: float
    trace: tuple[Input | Decision, ...]
    wall_s: float

    def as_json(self) -> dict[str, Any]:
        """Return the results in the shape of the contract."""
        best = self.perfect
        ratio = None if best is None else limit_ratio(self.evaluation, best)
        warnings = [asdict(problem) for problem in self.task.warnings]
        flight = self.evaluation.as_json(limit_ratio=ratio) | {
            "zero_rate_ml": self.zero_rate_ml,
            "plant": self.task.profile.name,
            "steps": self.result.steps,
            "late": self.result.late,
            "unresolved": self.result.unresolved,
            "inhibits": sorted(self.result.inhibits),
            "droplets": droplet_figures(self.task.setup, self.result.drives),
        }
        return {
            "flights": [flight],
            "warnings": warnings,
            "notes": [
                *_notes(self.task.setup.drift),
                *label_notes(self.task.setup.limits.label),
            ],
            "wall_s": self.wall_s,
            "simulated_s": self.result.simulated_s,
            "times_real_time": self.result.simulated_s / self.wall_s,
        }


def fly_mission(options: FlyOptions, say: Say) -> Flown:
    """Fly one mission as `options` say, and return what came of it."""
    task = prepare(options)
    say(f"plant {task.profile.name}, {len(task.route.legs)} legs, {task.speed_m_s:g} m/s")
    for problem in task.warnings:
        say(f"warning: {problem.text}; {problem.fix}")
    trajectory = _trajectory(task, options.seed, options.corners)
    trace: list[Input | Decision] = []
    began_s = time.perf_counter()
    result = _flight(task, trajectory, options, say, trace if options.out is not None else None)
    wall_s = time.perf_counter() - began_s
    say(f"flown {result.simulated_s:.0f} s in {wall_s:.2f} s; evaluating")
    evaluation = evaluate(result.record)
    return Flown(
        task=task,
        result=result,
        evaluation=evaluation,
        perfect=_perfect(task, trajectory, options),
        trajectory=trajectory,
        zero_rate_ml=zero_rate_ml(result.record, evaluation.off_target_ml),
        trace=tuple(trace),
        wall_s=wall_s,
    )


def prepare(options: FlyOptions) -> Task:
    """Read all files and check that they go together."""
    speed = options.speed_m_s
    if speed is not None and not SPEED_MIN_M_S <= speed <= SPEED_MAX_M_S:
        raise ConfigError(f"--speed {speed:g}: give {SPEED_MIN_M_S:g} to {SPEED_MAX_M_S:g} m/s")
    if not options.seed >= 0:
        raise ConfigError(f"--seed {options.seed}: give 0 or more")
    if not 0.0 <= options.meter_rate_hz <= METER_RATE_MAX_HZ:
        raise ConfigError(
            f"--meter-rate-hz {options.meter_rate_hz:g}: give 0 (no meter) to {METER_RATE_MAX_HZ:g}"
        )
    config = load(options.config, overrides=options.overrides)
    if options.output is None and config.output.kind == "none":
        raise ConfigError(
            f"{options.config}: output.kind = 'none' moves no valve; give --output gpio or servo"
        )
    refuse_mismatch(config)
    setup = compiled_setup(config)
    if options.fidelity != "pulsed" or options.output == "servo":
        # The averaged twin has no pulses, and a board's are not ours.
        setup = replace(setup, centres_pulses=False)
    profile = _plant(options.plant, setup)
    faults: tuple[Fault, ...] = ()
    if options.scenario is not None:
        faults = read_scenario(options.scenario)
        check_on_inputs(faults, options.scenario)
    default_m_s = DEFAULT_SPEED_M_S if config.mission is None else config.mission.speed_m_s
    route = read_route(options.mission, setup.frame, speed_m_s=speed, default_speed_m_s=default_m_s)
    over = legs_over(route, setup.prescription.field, reach_m=setup.boom.reach_m)
    if not over:
        raise ConfigError(
            f"{options.mission}: the mission does not come over the map of {options.config}; "
            "give files of the same field"
        )
    speeds = sorted({leg.speed_m_s for leg, _ in over})
    if not any(delivers(setup, speed_m_s) for speed_m_s in speeds):
        raise ConfigError(f"{options.config}: {_nothing(setup, speeds[-1])}")
    return Task(
        config=config,
        setup=setup,
        profile=profile,
        route=route,
        speed_m_s=_main_speed_m_s(over),
        warnings=(
            *(p for speed_m_s in speeds for p in deliverable(setup, speed_m_s)),
            *_too_short(setup, profile, over),
        ),
        faults=faults,
        airframe=airframe_of(options.vehicle),
        own=None if options.controller is None else load_controller(options.controller),
    )


def delivers(setup: Setup, speed_m_s: float) -> bool:
    """Return whether any rate of the map opens any valve at `speed_m_s`."""
    flows = [flow_for_rate(rate, speed_m_s, setup.boom.width_m) for rate in _rates(setup)]
    return any(
        allowed_duty(nozzles.curve.duty_for(flow), setup.pwm) > 0.0
        for nozzles in setup.nozzle_sets
        for flow in flows
    )


def _too_short(
    setup: Setup, profile: PlantProfile, over: Iterable[tuple[Leg, LineString]]
) -> Iterator[Problem]:
    """Yield a warning if stretches of one rate are over before a pump's flow stands."""
    pump = profile.makes_flow
    if pump is None:
        return
    # Until an exponential is within 10 % of its step: Koo's 2.6 to 3.8 s.
    needed_s = pump.dead_s + math.log(10.0) * max(pump.up_s, pump.down_s)
    passed = [
        (rate, length_m / leg.speed_m_s, leg.speed_m_s)
        for leg, line in over
        for rate, length_m in _stretches(setup, line)
        # A shut-off valve makes a rate of 0, and the pump keeps its speed.
        if rate > 0.0 or not pump.shut_off
    ]
    short = [(time_s, speed_m_s) for _, time_s, speed_m_s in passed if time_s < needed_s]
    if short and len({rate for rate, _, _ in passed}) > 1:
        fastest_m_s = max(speed_m_s for _, speed_m_s in short)
        yield Problem(
            severity="warning",
            code="zones-too-short",
            text=f"{len(short)} of {len(passed)} stretches of one rate are passed in less than "
            f"the {needed_s:.1f} s that the pump's flow takes to follow a change",
            fix=f"fly slower, or give zones of {needed_s * fastest_m_s:.0f} m and more",
        )


def _stretches(setup: Setup, line: LineString) -> Iterator[tuple[float, float]]:
    """Yield rate and length [m] of each stretch of one rate under the middle of the boom."""
    at_m = np.arange(0.5 * STRETCH_STEP_M, line.length, STRETCH_STEP_M)
    east_m, north_m = shapely.get_coordinates(shapely.line_interpolate_point(line, at_m)).T
    rates = setup.prescription.rates_at(east_m, north_m)
    # NaN, where there is no rate, differs from itself too: it cuts, and is left out.
    cuts = np.flatnonzero(np.diff(rates, prepend=np.nan, append=np.nan) != 0.0)
    for first, end in pairwise(cuts.tolist()):
        if not math.isnan(rates[first]):
            yield float(rates[first]), (end - first) * STRETCH_STEP_M


def _notes(drift: Drift | None) -> list[str]:
    """Return what a reader of the figures has to know of an offset for the wind."""
    if drift is None:
        return []
    wind = drift.wind_m_s
    if wind is None:
        return ["[drift] moves nothing here: no wind is told; give drift.wind"]
    if not math.hypot(*wind) <= drift.wind_max_m_s:
        return ["[drift] moves nothing here: drift.wind is above safety.wind_max_m_s"]
    return [
        "[drift] moves the changes off their boundaries on purpose, for the wind; the figures are "
        "judged at the nozzle, where that counts as error"
    ]


def label_notes(label: LabelLimits | None) -> list[str]:
    """Return which limits of the label keep every valve of such a flight closed."""
    if label is None:
        return []
    found = sorted(label.broken)
    if label.wind_required and (label.wind_m_s is not None or label.wind_from_deg):
        found.append(Inhibit.LABEL_WIND)
    if label.needs_utc:
        found.append(Inhibit.LABEL_TIME)
    return [
        f"nothing is sprayed ({', '.join(found)}): no wind and no time of day are simulated here, "
        "and what the label asks for must be declared; fly it with sitl serve and run"
    ] * bool(found)


def _rates(setup: Setup) -> set[float]:
    return {rate for rate in setup.prescription.rates_l_ha if rate > 0.0}


def _nothing(setup: Setup, speed_m_s: float) -> str:
    """Return why nothing at all would be sprayed."""
    problems = deliverable(setup, speed_m_s)
    if not problems:
        return "the map has no rate above 0 L/ha; there is nothing to spray"
    return f"nothing of the map can be delivered: {problems[0].text}; {problems[0].fix}"


def _main_speed_m_s(over: Iterable[tuple[Leg, LineString]]) -> float:
    """Return the speed of most of the way over the field."""
    length_m: dict[float, float] = {}
    for leg, line in over:
        length_m[leg.speed_m_s] = length_m.get(leg.speed_m_s, 0.0) + line.length
    return max(length_m, key=lambda speed_m_s: length_m[speed_m_s])


def _plant(name: str | None, setup: Setup) -> PlantProfile:
    """Return the sprayer that is asked for, or the one whose full flow is nearest."""
    count = len(setup.boom.valves)
    if name is not None:
        profile = load_profile(name)
        if profile.valve_count != count:
            raise ConfigError(
                f"--plant {name}: it has {profile.valve_count} valves, the configuration {count}"
            )
        check_motors(profile, setup, name)
        return profile
    shipped = [load_profile(path) for path in sorted(PROFILES.glob("*.toml"))]
    fitting = [
        profile for profile in shipped if profile.valve_count == count and fits(profile, setup)
    ]
    if not fitting:
        raise ConfigError(
            f"no sprayer profile has {count} valves and these motors; give one: --plant FILE.toml, "
            "written as those in sitl/profiles"
        )
    full = math.log(setup.nozzle_sets[-1].flow_max_l_min)
    return min(fitting, key=lambda p: abs(math.log(p.nozzle_sets[-1].flow_max_l_min) - full))


def _trajectory(task: Task, seed: int, corners: Corners | None) -> Trajectory:
    """Fly the way as the configuration's autopilot does, or as is asked for."""
    mission = task.config.mission
    acceleration = DEFAULT_ACCELERATION_M_S2 if mission is None else mission.acceleration_m_s2
    flown_by: Corners = "ardupilot" if mission is None else mission.autopilot
    vehicle = Vehicle(
        task.route, start_s=0.0, seed=seed, acceleration_m_s2=acceleration,
        corners=corners or flown_by, airframe=task.airframe,
    )  # fmt: skip
    return vehicle.fly_to_end()


def _flight(
    task: Task,
    trajectory: Trajectory,
    options: FlyOptions,
    say: Say,
    trace: list[Input | Decision] | None,
) -> FlightResult:
    """Fly with what the configuration knows, and say how far it is."""
    end_s = float(trajectory.time_s[-1])
    said_s = SAY_EVERY_S

    def observe(decision: Decision) -> None:
        nonlocal said_s
        if decision.now_s >= said_s:
            say(f"{decision.now_s:.0f} of {end_s:.0f} s")
            said_s += SAY_EVERY_S
        if trace is not None:
            trace.append(decision)

    def disturb(items: Iterator[Input]) -> Iterator[Input]:
        return with_faults(items, task.faults, start_s=float(trajectory.time_s[0]))

    return fly(
        task.setup,
        trajectory,
        task.profile,
        _flight_options(task, options),
        speed_m_s=task.speed_m_s,
        observer=observe if trace is not None or end_s > SAY_EVERY_S else None,
        on_input=None if trace is None else trace.append,
        disturb=disturb if task.faults else None,
        mission=_mission(task),
        own=task.own,
    )


def _flight_options(task: Task, options: FlyOptions) -> FlightOptions:
    return FlightOptions(
        fidelity=options.fidelity or ("pulsed" if options.output == "servo" else "averaged"),
        output=_output(task, options),
        seed=options.seed,
        position_rate_hz=float(task.config.link.position_rate_hz),
        meter_rate_hz=options.meter_rate_hz,
        drive_ranges_us=ranges_us(task.config),
        flow_law=options.flow_law,
        off=task.airframe.noise,
    )


def _output(task: Task, options: FlyOptions) -> Literal["gpio", "servo"]:
    """Return the way to the valves: as told, or the configuration's own, whose lags are flown."""
    if options.output is not None:
        return options.output
    return "servo" if task.config.output.kind == "servo" else "gpio"


def _perfect(task: Task, trajectory: Trajectory, options: FlyOptions) -> Evaluation | None:
    """Fly the same path and the same sprayer with all that is true of them known.

    None where a motor makes the flow: its steps take time, whatever is known.
    """
    if task.profile.pump is not None or task.profile.drive_count:
        return None
    output_s = WIRE_S + 0.5 * SERVO_FRAME_S if _output(task, options) == "servo" else 0.0
    perfect = replace(_flight_options(task, options), knows=True, meter_rate_hz=0.0)
    profile = true_profile(task.profile, perfect)
    result = fly(
        perfect_setup(task.setup, profile, seed=options.seed, output_s=output_s),
        trajectory,
        profile,
        perfect,
        speed_m_s=task.speed_m_s,
        mission=_mission(task),
    )
    return evaluate(result.record)


def _mission(task: Task) -> Route | None:
    """Return the mission whose legs the companion hears of: it does where lines are followed."""
    return None if task.setup.lines is None else task.route


# Faults of a scenario on the inputs of a flight without sockets.
#
# The same scenario file as for the stub autopilot; here the faults that a message can carry act on
# the messages as they are decoded. Faults of the wire itself need a wire and are refused.

# The largest latitude and longitude that GLOBAL_POSITION_INT can hold.
EXTREME_DEG = 0x7FFFFFFF * 1e-7
ON_INPUTS = frozenset(
    {
        FaultKind.NO_POSITION,
        FaultKind.STALE_POSITION,
        FaultKind.ZERO_POSITION,
        FaultKind.EXTREME_POSITION,
        FaultKind.HEADING_UNKNOWN,
        FaultKind.GPS_DROP,
        FaultKind.CLOCK_BACKWARDS,
        FaultKind.SILENCE,
        FaultKind.MODE,
    }
)


def check_on_inputs(faults: tuple[Fault, ...], path: Path) -> None:
    """Refuse a scenario with faults that only a wire can have."""
    for fault in faults:
        if fault.kind not in ON_INPUTS:
            raise ConfigError(
                f"{path}: kind = '{fault.kind}' needs a wire; use `vrspray sitl serve`, or one of "
                + ", ".join(sorted(ON_INPUTS))
            )


def with_faults(
    items: Iterable[Input], faults: tuple[Fault, ...], *, start_s: float
) -> Iterator[Input]:
    """Yield the inputs as they arrive under `faults`; the flight begins at its take-off."""
    clock = FaultClock(faults, start_s=start_s)
    clock.take_off_s = start_s
    state = _State(clock)
    for item in items:
        arrived = state.pass_on(item)
        if arrived is not None:
            yield arrived


@dataclass(slots=True)
class _State:
    """The faults, and the last position that was a true one."""

    clock: FaultClock
    last: Telemetry | None = None

    def pass_on(self, item: Input) -> Input | None:
        """Return one input as it arrives; None for one that does not."""
        now_s = item.received_s
        if self.clock.active(FaultKind.SILENCE, now_s):
            return None
        if isinstance(item, Telemetry):
            return self._position(item)
        return self._report(item)

    def _report(self, item: Input) -> Input:
        """Return what is no position, as the fault has it."""
        now_s = item.received_s
        stale = self.clock.active(FaultKind.STALE_POSITION, now_s) is not None
        drop = self.clock.active(FaultKind.GPS_DROP, now_s)
        mode = self.clock.active(FaultKind.MODE, now_s)
        if stale and isinstance(item, SpeedReport):
            return replace(item, ground_speed_m_s=0.0)
        if stale and isinstance(item, EstimatorReport):
            return replace(item, healthy=False)
        if drop is not None and isinstance(item, GnssReport):
            return replace(item, fix=Fix(min(max(drop.fix, 0), 6)))
        if mode is not None and isinstance(item, HeartbeatReport):
            return replace(item, mode=MODE_NAMES.get(mode.mode, f"MODE_{mode.mode}"))
        return item

    def _position(self, item: Telemetry) -> Telemetry | None:
        now_s, active = item.received_s, self.clock.active
        if active(FaultKind.NO_POSITION, now_s):
            return None
        if active(FaultKind.STALE_POSITION, now_s):
            if self.last is None:
                return None
            return replace(
                self.last,
                received_s=now_s,
                boot_s=item.boot_s,
                velocity_north_m_s=0.0,
                velocity_east_m_s=0.0,
                velocity_down_m_s=0.0,
            )
        self.last = item
        if active(FaultKind.ZERO_POSITION, now_s):
            item = replace(item, latitude_deg=0.0, longitude_deg=0.0)
        if active(FaultKind.EXTREME_POSITION, now_s):
            item = replace(item, latitude_deg=EXTREME_DEG, longitude_deg=EXTREME_DEG)
        if active(FaultKind.HEADING_UNKNOWN, now_s):
            item = replace(item, heading_deg=None)
        back = active(FaultKind.CLOCK_BACKWARDS, now_s)
        return item if back is None else replace(item, boot_s=item.boot_s - back.delay_s)


# How much of a flight fell on ground whose rate is 0.


def zero_rate_ml(record: FlightRecord, outside_ml: float) -> float:
    """Return what fell on ground whose rate is 0, given what fell outside the field."""
    prescription = record.prescription
    bounds = shapely.total_bounds(shapely.points(record.east_m, record.north_m))
    near = shapely.box(*bounds).buffer(record.boom.reach_m + 1.0)
    dry, wet = (
        shapely.union_all(
            [
                zone.polygon
                for zone in prescription.zones
                if (zone.rate_l_ha > 0.0) == is_wet and zone.polygon.intersects(near)
            ]
        )
        for is_wet in (False, True)
    )
    dry = dry.intersection(prescription.field).difference(wet)
    if dry.is_empty:
        return 0.0
    ground = prescription.field.difference(dry)
    open_ground = Prescription(
        prescription.zones,
        boundary=shapely.MultiPolygon(
            [part for part in shapely.get_parts(ground) if isinstance(part, shapely.Polygon)]
        ),
        overlap=prescription.overlap,
        default_rate_l_ha=prescription.default_rate_l_ha,
    )
    sure = replace(record, prescription=open_ground)
    return max(off_target_ml(strips_of(sure), open_ground) - outside_ml, 0.0)
