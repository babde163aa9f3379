"""One flight of a campaign: its settings and its seed in, its figures out, and nothing else.

The same arguments give the same row, in any process and in any order. Without `flight.config` and
`flight.mission` it is P1's field that is flown, as `vrspray demo` does, or a hard condition.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from time import process_time
from typing import TYPE_CHECKING, Any, Literal, cast

from analysis.dose import accuracy_by_rate
from analysis.evaluation import Distances, Evaluation, evaluate_strips, limit_ratio, whole_boom
from analysis.strips import strips_of
from companion.config import load
from companion.errors import ConfigError
from missions.maps.compiling import compiled_setup
from sitl.airframes import Airframe, airframe_of
from sitl.anyang import (
    ACCELERATION_M_S2,
    EXAMPLE,
    LAGS,
    MAP_SPEED_M_S,
    PLANT,
    START_S,
    at_speed,
    demo_lags,
    demo_route,
    scaled,
)
from sitl.campaign.settings import P1S_FIELD, Settings, Value, overrides_of, with_plant
from sitl.conditions import (
    RATE_HZ,
    Condition,
    Disturbance,
    condition_of,
    displaced,
    drifted,
    laid_out,
    shortened,
)
from sitl.flight import FlightOptions, FlightResult, fly, true_profile
from sitl.fly import DEFAULT_ACCELERATION_M_S2, FlyOptions, Task, prepare, with_faults
from sitl.knowledge import perfect_setup, with_sprayer
from sitl.motor_parts import ranges_us
from sitl.outputs import SERVO_FRAME_S, WIRE_S
from sitl.own_method import MakeController, load_controller
from sitl.profile import load_profile
from sitl.valve_calibration import (
    calibrate_curves,
    calibrate_valves,
    with_curves,
    with_figures,
)
from sitl.vehicle import Vehicle
from sitl.wang import (
    LOOK_AHEAD_S,
    LOOK_AHEAD_STATED_S,
    WangController,
    curve_duties,
    eq_2_duties,
    table_2_sets,
)

if TYPE_CHECKING:
    from companion.core.setup import Setup
    from companion.core.types import Input
    from sitl.trajectory import Trajectory

# P1's controller by its look-ahead, as the demo flies it.
LOOK_AHEADS_S = {
    "none": 0.0,
    "look-ahead": LOOK_AHEAD_S,
    "look-ahead-stated": LOOK_AHEAD_STATED_S,
}
# What is kept between the flights of one process.
SCENES, PATHS = 8, 16

DISTANCES = ("lag_distance", "settled_lag_distance", "border_margin")
OF_DISTANCES = ("mean", "mean_abs", "max_abs", "min", "max")
NUMBERS = (
    "spraying_accuracy_percent", "settled_accuracy_percent", "starting_accuracy_percent",
    "misapplied_percent", "limit_ratio", "off_target_ml", "gap_m2", "overlap_m2",
    "volume_error_percent", "applied_ml", "border_bound_m", "simulated_s",
)  # fmt: skip
COUNTS = ("apart", "missed", "settled_apart", "settled_missed", "steps", "late", "unresolved")
BY_RATE = ("rate_l_ha", "rate_accuracy_percent", "rate_settled_lag_mean_m")
BY_RATE_COUNTS = ("rate_samples", "rate_settled_lag_count")


def figure_types() -> dict[str, type]:
    """Return every figure of a row by its name: a fraction, a count, or a list of one by rate."""
    found: dict[str, type] = {}
    for name in DISTANCES:
        found |= {f"{name}_{each}_m": float for each in OF_DISTANCES} | {f"{name}_count": int}
    found |= dict.fromkeys(NUMBERS, float) | dict.fromkeys(COUNTS, int)
    return found


@dataclass(frozen=True, slots=True)
class Row:
    """What a flight gives: its figures, and the processor time of the closed loop alone."""

    figures: dict[str, Any]
    loop_cpu_s: float


@dataclass(frozen=True, slots=True)
class _Scene:
    """What flights of the same files, configuration and speed share."""

    task: Task
    output: Literal["gpio", "servo"]
    # The example's configuration, sprayer and board; `condition`: over a field of its own.
    on_p1s_field: bool
    condition: Condition | None = None


def fly_flight(settings: Settings, seed: int, folder: Path) -> Row:
    """Fly one flight and judge it; the files that settings name lie in `folder`.

    Raises:
        VrsprayError, ValueError: what cannot be flown.
    """
    given = dict(settings)
    scene, path = _placed(settings, seed, folder)
    what = _error(given)
    options = _options(scene, given, seed)
    began_s = process_time()
    own = _controller(given, folder)
    result = _flown(scene, path, given, options, what, own)
    loop_cpu_s = process_time() - began_s
    record = result.record
    if what.is_drift:
        record = drifted(record, what, scene.task.setup.frame)
    if _look_ahead_s(given) is not None:
        # P1's nozzle sets change: what single valves share says nothing then.
        record = whole_boom(record)
    strips = strips_of(record)
    found = evaluate_strips(record, strips)
    best = _perfect(scene, path, options) if given.get("flight.perfect") else None
    ratio = None if best is None else limit_ratio(found, best)
    figures = {
        **figures_of(found),
        "limit_ratio": ratio,
        "simulated_s": result.simulated_s,
        "steps": result.steps,
        "late": result.late,
        "unresolved": result.unresolved,
        "method": found.meta.method,
        "speed_m_s": found.meta.speed_m_s,
        "plant": scene.task.profile.name,
        "fidelity": found.meta.fidelity,
        "output": found.meta.output,
        "inhibits": ", ".join(sorted(each.value for each in result.inhibits)),
    }
    return Row(figures | _by_rate(found, accuracy_by_rate(strips)), loop_cpu_s)


def _only(settings: Settings, starts: tuple[str, ...]) -> Settings:
    return tuple(each for each in settings if each[0].startswith(starts))


def figures_of(found: Evaluation) -> dict[str, Any]:
    """Return the figures of a flight as a row has them."""
    row: dict[str, Any] = {name: getattr(found, name, None) for name in (*NUMBERS, *COUNTS)}
    for name in DISTANCES:
        lags: Distances = getattr(found, f"{name}_m")
        row |= {f"{name}_{each}_m": getattr(lags, each) for each in OF_DISTANCES}
        row[f"{name}_count"] = lags.count
    return row


def _by_rate(found: Evaluation, accuracy: Any) -> dict[str, Any]:
    """Return lists with an entry for each rate of the map, lowest first; None is over several."""
    lags: dict[float, list[float]] = {}
    for step in found.settled_steps:
        if step.lag_distance_m is not None:
            lags.setdefault(step.change.after_l_ha, []).append(step.lag_distance_m)
    of_rate = [lags.get(each.rate_l_ha, []) for each in accuracy]
    return {
        "rate_l_ha": [each.rate_l_ha for each in accuracy],
        "rate_accuracy_percent": [each.percent for each in accuracy],
        "rate_samples": [each.samples for each in accuracy],
        "rate_settled_lag_mean_m": [sum(e) / len(e) if e else None for e in of_rate],
        "rate_settled_lag_count": [len(each) for each in of_rate],
    }


# What is flown over, and what with.


def _placed(settings: Settings, seed: int, folder: Path) -> tuple[_Scene, Trajectory]:
    """Return the field with the sprayer over it, and the true path; a hard one is a seed's own."""
    scene = _scene(
        _only(settings, ("config.", "flight.", "map.", "plant.", "vehicle.speed")), folder
    )
    if scene.condition is None:
        names = ("config.", "flight.", "map.", "plant.", "vehicle.")
        return scene, _path(_only(settings, names), seed, folder)
    setup, path = laid_out(scene.condition, seed, scene.task.setup)
    return replace(scene, task=replace(scene.task, setup=setup)), path


@lru_cache(maxsize=SCENES)
def _scene(settings: Settings, folder: Path) -> _Scene:
    given = dict(settings)
    task = _task_of_files(given, folder) if "flight.config" in given else _task_of_p1(given)
    factor = cast(float, given.get("map.rate_factor", 1.0))
    setup = task.setup
    if factor != 1.0:
        setup = replace(setup, prescription=scaled(setup.prescription, factor))
    profile = with_plant(task.profile, given)
    servo = task.config.output.kind == "servo" and "flight.config" in given
    output = given.get("flight.output", "servo" if servo else "gpio")
    is_pulsed = given.get("flight.fidelity", "averaged") == "pulsed"
    setup = replace(setup, centres_pulses=output == "gpio" and is_pulsed)
    return _Scene(
        task=replace(task, setup=setup, profile=profile),
        output=cast(Literal["gpio", "servo"], output),
        on_p1s_field="flight.config" not in given,
        condition=_condition(given),
    )


def _condition(given: Mapping[str, Value]) -> Condition | None:
    name = str(given.get("flight.field", P1S_FIELD))
    return None if name == P1S_FIELD else condition_of(name)


def _task_of_p1(given: Mapping[str, Value]) -> Task:
    """Return P1's field with the lags of the output path, measured beforehand."""
    speed_m_s = cast(float, given.get("vehicle.speed_m_s", MAP_SPEED_M_S))
    profile = load_profile(str(given.get("plant.profile", PLANT)))
    is_known = bool(given.get("plant.known")) and profile.name != PLANT
    if is_known and not (LAGS / f"{profile.name}-gpio.toml").is_file():
        raise ConfigError(
            f"plant.known: no lags were measured of {profile.name}; leave it out, or give "
            "flight.config and flight.mission of this sprayer"
        )
    lag = demo_lags(str(given.get("flight.output", "gpio")), profile.name if is_known else PLANT)
    names = ("on_s", "off_s", "up_s", "down_s", "on_start_s", "off_end_s", "output_s", "position_s")
    measured = tuple(f"lag.{name}={getattr(lag, name)!r}" for name in names)
    config = load(EXAMPLE / "config.toml", overrides=(*measured, *overrides_of(given)))
    setup = at_speed(
        compiled_setup(config), speed_m_s, scale=given.get("map.rates", "by-speed") == "by-speed"
    )
    condition = _condition(given)
    acceleration = cast(float, given.get("vehicle.acceleration_m_s2", ACCELERATION_M_S2))
    return Task(
        config=config,
        setup=with_sprayer(setup, profile) if is_known else setup,
        profile=profile,
        route=demo_route(speed_m_s, setup.frame, acceleration_m_s2=acceleration),
        speed_m_s=speed_m_s if condition is None else condition.speed_m_s,
        warnings=(),
        faults=(),
    )


def _task_of_files(given: Mapping[str, Value], folder: Path) -> Task:
    """Return what `vrspray sitl fly` would fly of the same files."""
    scenario, speed = given.get("flight.scenario"), given.get("vehicle.speed_m_s")
    return prepare(
        FlyOptions(
            config=folder / str(given["flight.config"]),
            mission=folder / str(given["flight.mission"]),
            overrides=overrides_of(given),
            scenario=None if scenario is None else folder / str(scenario),
            plant=_plant_of(given, folder),
            speed_m_s=None if speed is None else cast(float, speed),
        )
    )


def _plant_of(given: Mapping[str, Value], folder: Path) -> str | None:
    name = given.get("plant.profile")
    if name is None:
        return None
    return str(folder / str(name)) if str(name).endswith(".toml") else str(name)


@lru_cache(maxsize=PATHS)
def _path(settings: Settings, seed: int, folder: Path) -> Trajectory:
    """Return the path of a seed, the same for all methods."""
    given = dict(settings)
    scene = _scene(
        _only(settings, ("config.", "flight.", "map.", "plant.", "vehicle.speed")), folder
    )
    task, mission = scene.task, scene.task.config.mission
    if scene.on_p1s_field:
        acceleration, corners, start_s = ACCELERATION_M_S2, "stop", START_S
    else:
        acceleration, corners, start_s = DEFAULT_ACCELERATION_M_S2, "ardupilot", 0.0
        if mission is not None:
            acceleration, corners = mission.acceleration_m_s2, mission.autopilot
    return Vehicle(
        task.route,
        start_s=start_s,
        seed=seed,
        acceleration_m_s2=cast(float, given.get("vehicle.acceleration_m_s2", acceleration)),
        gust_m_s=cast(Any, given.get("vehicle.gust_m_s")),
        gust_time_s=cast(Any, given.get("vehicle.gust_time_s")),
        airframe=_airframe(given),
        corners=cast(Any, given.get("vehicle.corners", corners)),
    ).fly_to_end()


def _airframe(given: Mapping[str, Value]) -> Airframe:
    return airframe_of(str(given.get("vehicle.kind", "drawn")))


def _error(given: Mapping[str, Value]) -> Disturbance:
    values: dict[str, Any] = {
        name.removeprefix("error."): value
        for name, value in given.items()
        if name.startswith("error.") and name != "error.lags"
    }
    if "error.lags" in given:
        values["kinds"] = given["error.lags"]
    return Disturbance(**values)


def _options(scene: _Scene, given: Mapping[str, Value], seed: int) -> FlightOptions:
    rate_hz = RATE_HZ if scene.on_p1s_field else float(scene.task.config.link.position_rate_hz)
    values: dict[str, Any] = {
        "fidelity": given.get("flight.fidelity", "averaged"),
        "board": given.get("flight.board", "restarting"),
        "position_rate_hz": given.get("vehicle.position_rate_hz", rate_hz),
        "estimator_lag_s": given.get("vehicle.estimator_lag_s", 0.031),
        "noise": given.get("vehicle.noise", True),
        "off": _airframe(given).noise,
        "scatter": given.get("plant.scatter", True),
        "flow_law": given.get("plant.flow_law"),
        "meter_rate_hz": given.get("flight.meter_rate_hz", 0.0 if scene.on_p1s_field else 50.0),
    }
    if scene.output == "servo" and values["fidelity"] == "averaged" and scene.on_p1s_field:
        raise ConfigError(
            "flight.output = 'servo': the averaged twin has no driver board; "
            "set flight.fidelity = 'pulsed'"
        )
    return FlightOptions(
        output=scene.output, seed=seed, drive_ranges_us=ranges_us(scene.task.config), **values
    )


# The flight itself.


def _look_ahead_s(given: Mapping[str, Value]) -> float | None:
    """Return the look-ahead of P1's controller; None where another one flies."""
    if "method.look_ahead_s" in given:
        return cast(float, given["method.look_ahead_s"])
    return LOOK_AHEADS_S.get(str(given.get("method.name", "scheduled")))


def _controller(given: Mapping[str, Value], folder: Path) -> MakeController | None:
    """Return one's own method; a file of it came along with the campaign."""
    if "method.controller" not in given:
        return None
    name = str(given["method.controller"])
    is_file = name.rpartition(":")[0].endswith(".py")
    return load_controller(str(folder / name) if is_file else name)


def _flown(
    scene: _Scene,
    path: Trajectory,
    given: Mapping[str, Value],
    options: FlightOptions,
    what: Disturbance,
    own: MakeController | None,
) -> FlightResult:
    task = scene.task
    setup = replace(task.setup, lag=shortened(task.setup.lag, what))
    name = given.get("method.name")
    look_ahead_s, wang = _look_ahead_s(given), None
    method: str | None = None
    if name == "perfect":
        return _knowing(scene, path, options)
    if name == "calibrated":  # each valve measured by itself beforehand, and the set's curve
        by_pulses = replace(options, fidelity="pulsed", output="gpio")
        profile = true_profile(task.profile, options)
        found = calibrate_valves(setup, profile, by_pulses).found
        curves, _ = calibrate_curves(setup, profile, by_pulses)
        setup, method = with_figures(with_curves(setup, curves), found), "calibrated"
    if look_ahead_s is not None:
        wang, setup = _wang(setup, look_ahead_s, given, task)
        method = str(name or "look-ahead")
    return fly(
        setup,
        path,
        task.profile,
        options,
        speed_m_s=task.speed_m_s,
        wang=wang,
        method=method,
        disturb=partial(_disturbed, what=what, task=task, start_s=float(path.time_s[0])),
        mission=None if setup.lines is None else task.route,
        own=own,
    )


def _wang(
    setup: Setup, look_ahead_s: float, given: Mapping[str, Value], task: Task
) -> tuple[WangController, Setup]:
    """Return P1's controller, and the set-up by which its flight is judged."""
    is_p1s = task.profile.name == PLANT
    dose = given.get("method.dose", "eq-2" if is_p1s else "curve")
    wang = WangController(
        setup=setup,
        look_ahead_s=look_ahead_s,
        dose=eq_2_duties if dose == "eq-2" else curve_duties(setup),
    )
    return wang, replace(setup, nozzle_sets=table_2_sets()) if is_p1s else setup


def _disturbed(
    items: Iterator[Input], *, what: Disturbance, task: Task, start_s: float
) -> Iterator[Input]:
    if task.faults:
        items = with_faults(items, task.faults, start_s=start_s)
    return displaced(items, what=what, frame=task.setup.frame)


def _knowing(scene: _Scene, path: Trajectory, options: FlightOptions) -> FlightResult:
    """Fly the same path and the same sprayer with all that is true of them known."""
    task = scene.task
    if task.profile.pump is not None or task.profile.drive_count:
        raise ConfigError("method.name = 'perfect': not for a pump, whose lags are not its bound")
    known = replace(options, knows=True, meter_rate_hz=0.0)
    profile = true_profile(task.profile, known)
    output_s = task.setup.lag.output_s
    if not scene.on_p1s_field:
        output_s = WIRE_S + 0.5 * SERVO_FRAME_S if scene.output == "servo" else 0.0
    return fly(
        perfect_setup(task.setup, profile, seed=options.seed, output_s=output_s),
        path,
        profile,
        known,
        speed_m_s=task.speed_m_s,
        method="perfect",
        mission=None if task.setup.lines is None else task.route,
    )


def _perfect(scene: _Scene, path: Trajectory, options: FlightOptions) -> Evaluation:
    record = _knowing(scene, path, options).record
    return evaluate_strips(record, strips_of(record))
