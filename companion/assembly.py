"""From a configuration to all that is constant in a flight: map, field, boom, lags, limits.

What cannot be flown is refused here, before the take-off: a map above the product's label, a
boundary that has nothing in common with the map. What can only be delivered at another speed is
named by `deliverable`, with that speed.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

from companion.config import Config
from companion.config.rules import mismatches, tank_capacity_l
from companion.config.tables import PrescriptionTable
from companion.core.frame import LocalFrame
from companion.core.inputs import AutopilotLiquid
from companion.core.nozzle import NozzleSet, flow_for_rate
from companion.core.options.atomisers import Atomiser
from companion.core.options.flow_meter import BIN_S, UNSTEADY_SHARE, Detection
from companion.core.options.flow_trim import FlowTrim
from companion.core.options.lines import Lines
from companion.core.options.overlap import OverlapGuard
from companion.core.options.pump import Pump
from companion.core.setup import Setup
from companion.core.standing import MOST_M_S2
from companion.core.types import PwmLimits
from companion.errors import ConfigError, MapError, Problem
from companion.flight_map import (
    FlightMap,
    difference,
    is_flight_map,
    named_files,
    read_flight_map,
)
from companion.wording import show_value

# The autopilot tells whole millilitres ten times a second, up to a tenth of a second old: over half
# a second that is a quarter of the flow, from one bin to the next.
AUTOPILOT_BIN_S = 0.55
AUTOPILOT_UNSTEADY_SHARE = 0.25
# How close places on planned lines are looked at, for a rate.
LINE_STEP_M = 1.0
# More rates than these are named by their range: the line must stay readable.
RATES_NAMED_MAX = 6


def flight_map_of(config: Config, overrides: Sequence[str] = (), *, keep: bool = True) -> FlightMap:
    """Return the flight map that the configuration names, or that of the map that it names.

    `overrides` are those that the configuration was read with; `keep` for the next start.

    Raises:
        ConfigError: where it names none, or files that are not those of the flight map.
        MapError: where a file cannot be used.
    """
    table = config.prescription
    if table is None:
        raise ConfigError(
            f"{config.path}: prescription.file: missing; write the path of the map under "
            "[prescription]"
        )
    path = config.resolve(table.file)
    if not is_flight_map(path):
        from companion.flight_map.child import compiled

        return compiled(config, table, overrides, keep=keep)
    try:
        found = read_flight_map(path)
    except MapError as error:
        reason = str(error).removeprefix(f"{path}: ")
        text = f"{config.path}: prescription.file = {show_value(table.file)}: {reason}"
        raise MapError(text, code=error.code, fix=error.fix) from error
    _refuse_changed(config, table, found)
    return found


def _refuse_changed(config: Config, table: PrescriptionTable, flight_map: FlightMap) -> None:
    """Refuse a boundary, an exclusion or a plan that lies here and is not the compiled one."""
    for key, path in named_files(
        table, config.planned_lines, config.path.parent, config.buffers
    ).items():
        if key == "prescription.file" or not path.exists():
            continue
        from companion.flight_map.child import sources_of

        here = {each.sha256 for each in sources_of({key: path})}
        if not here & {each.sha256 for each in flight_map.sources if each.key == key}:
            raise ConfigError(
                f"{config.path}: {key}: {path.name} was changed after {flight_map.path.name} was "
                f"compiled; compile the map again: vrspray map compile {flight_map.source} "
                f"--config {config.path} --out {flight_map.path.name}"
            )


def build_setup(config: Config, flight_map: FlightMap) -> Setup:
    """Return the set-up of a flight, over the ground of its flight map and in that frame.

    Raises:
        ConfigError: where the configuration and the flight map do not go together.
    """
    table = config.prescription
    if table is None:
        raise ConfigError(
            f"{config.path}: prescription.file: missing; write the path of the map under "
            "[prescription]"
        )
    _refuse_other_map(config, table, flight_map)
    label = above_label(
        config,
        flight_map.source,
        rates_l_ha=flight_map.source_rates_l_ha,
        default_rate_l_ha=flight_map.prescription.default_rate_l_ha,
    )
    if label is not None:
        raise ConfigError(f"{config.path}: {label.text}; {label.fix}")
    check_mark(config, table)
    prescription = flight_map.moved(table.offset_east_m, table.offset_north_m)
    pump, atomisers = _motors(config)
    setup = Setup(
        frame=flight_map.frame,
        prescription=prescription,
        boom=config.boom(),
        nozzle_sets=config.nozzle_sets(),
        pwm=config.pwm_limits(),
        lag=config.lag_model(),
        method=config.method(),
        look_ahead_s=config.look_ahead_s(),
        limits=config.limits(),
        border=table.border,
        border_buffer_m=table.border_buffer_m,
        across=table.across,
        lease_s=config.output.lease_s,
        flow_trim=_flow_trim(config),
        detection=_detection(config),
        centres_pulses=config.output.kind == "gpio",
        autopilot_liquid=_autopilot_liquid(config),
        drift=config.drift_law(),
        rate_max_l_ha=config.rate_max_l_ha(),
        mission_braking_m_s2=(
            config.prediction.braking_m_s2 if config.prediction.use_mission else None
        ),
        pump=pump,
        atomisers=atomisers,
        lines=_lines(config, flight_map),
        # Without an output nothing is sprayed, whatever the plans say.
        record_coverage=config.coverage.record and config.output.kind != "none",
        overlap=_overlap(config),
        most_m_s2=MOST_M_S2 if config.mission is None else config.mission.acceleration_m_s2,
    )
    why = sprays_nothing(setup)
    if why is not None:
        raise ConfigError(
            f"{config.path}: can open no valve on this map, because {why[0]}; {why[1]}"
        )
    return setup


def sprays_nothing(setup: Setup) -> tuple[str, str] | None:
    """Return why no flight over the map can open a valve, and what to do; None where one can."""
    prescription, lines = setup.prescription, setup.lines
    rates = [*prescription.rates_l_ha, prescription.default_rate_l_ha or 0.0]
    if not max(rates) > 0.0:
        return "every rate is 0", "check the rate column (vrspray map check)"
    if lines is None:
        return None
    # Where the middles of the strips come by; a zone smaller than a step is not worth a flight.
    for piece in lines.pieces:
        along = np.arange(0.0, piece.length_m + LINE_STEP_M, LINE_STEP_M)[:, None]
        right = np.array([valve.right_m for valve in setup.boom.valves])
        for side in (right, -right):  # flown either way
            east = piece.east_m + along * piece.unit_east + side * piece.unit_north
            north = piece.north_m + along * piece.unit_north - side * piece.unit_east
            if (prescription.rates_at(east.ravel(), north.ravel()) > 0.0).any():
                return None
    return (
        "no line of mission.lines lies over ground with a rate",
        "plan this map's field again, or leave mission.lines out",
    )


def _motors(config: Config) -> tuple[Pump | None, tuple[Atomiser, ...]]:
    """Return the pump and the atomisers; without any, nothing of theirs is loaded."""
    if not config.has_motors:
        return None, ()
    from companion.config.motor_rules import atomisers_of, pump_of

    return pump_of(config), atomisers_of(config)


def refuse_mismatch(config: Config) -> None:
    """Refuse widths that do not agree, as `config check` does: sprayed so, every dose is wrong.

    Raises:
        ConfigError: with the key and what is wrong.
    """
    for found in mismatches(config):
        raise ConfigError(f"{config.path}: {found.key}: {found.text}")


def _overlap(config: Config) -> OverlapGuard | None:
    """Return what closes valves over treated ground, if anything is to."""
    mission = config.mission
    on_lines = mission is not None and mission.lines is not None
    percent = config.switch_off_percent(on_lines=on_lines)
    if percent is None or config.output.kind == "none":
        return None
    return OverlapGuard(switch_off_percent=percent)


def _refuse_other_map(config: Config, table: PrescriptionTable, flight_map: FlightMap) -> None:
    """Refuse a flight map that was compiled of something else than the configuration says."""
    if table.sha256 is not None and not any(
        sha256.startswith(table.sha256)
        for sha256 in (flight_map.prescription.sha256, flight_map.sha256)
    ):
        raise ConfigError(
            f"{config.path}: prescription.sha256 = {show_value(table.sha256)}: "
            f"{table.file} is another map, its hash begins with {flight_map.sha256[:8]}, that of "
            f"its source with {flight_map.prescription.sha256[:8]}; look at it by `vrspray map "
            "check`, then write these digits"
        )
    found = difference(flight_map, config)
    if found is not None:
        key, wanted, compiled = found
        raise ConfigError(
            f"{config.path}: {key} = {_shown(wanted)}, and {flight_map.path.name} was compiled "
            f"with {_shown(compiled)}; correct the configuration, or compile the map again: "
            f"vrspray map compile {flight_map.source} --config {config.path} "
            f"--out {flight_map.path.name}"
        )


def _shown(value: object) -> str:
    return "nothing" if value is None else show_value(value)


def _lines(config: Config, flight_map: FlightMap) -> Lines | None:
    """Return the lines of a plan that alone are sprayed, if there are any."""
    mission = config.mission
    if mission is None or mission.lines is None:
        return None
    try:
        return Lines(
            polylines=flight_map.polylines,
            aside_m=mission.lines_aside_m,
            course_deg=mission.lines_course_deg,
        )
    except ValueError as error:
        raise ConfigError(
            f"{config.path}: mission.lines = {show_value(mission.lines)}: {error}; plan again"
        ) from error


def _flow_trim(config: Config) -> FlowTrim | None:
    """Return the slow correction of the flow, if there is to be one."""
    table = config.flow_trim
    if not table.enabled:
        return None
    return FlowTrim(
        tau_s=table.tau_s,
        limit=table.limit,
        meter_minimum_l_min=table.meter_minimum_l_min,
        settle_s=table.settle_s,
    )


def _autopilot_liquid(config: Config) -> AutopilotLiquid | None:
    """Return which of the autopilot's battery monitors measure the liquid, if any does."""
    meter, tank = config.flow_meter, config.tank
    if "autopilot" not in (meter.source, tank.source):
        return None
    return AutopilotLiquid(
        flow_battery=meter.battery if meter.source == "autopilot" else None,
        tank_battery=tank.battery if tank.source == "autopilot" else None,
        tank_l=tank_capacity_l(config) or 0.0,
    )


def _detection(config: Config) -> Detection | None:
    """Return what is known of the healthy sprayer, if faults are to be detected."""
    table, pressure = config.detection, config.pressure
    if not table.enabled:
        return None
    has_pressure = pressure.source != "none"
    by_autopilot = config.flow_meter.source == "autopilot"
    return Detection(
        spread=table.spread,
        closed_share=table.closed_share,
        meter_minimum_l_min=config.flow_trim.meter_minimum_l_min,
        pressure_duty=pressure.duty if has_pressure else (),
        pressure_kpa=pressure.kpa if has_pressure else (),
        reserve_l=None if config.tank.source == "none" else config.tank.reserve_l,
        meter_required=table.meter_required,
        closed_check=table.closed_check,
        bin_s=AUTOPILOT_BIN_S if by_autopilot else BIN_S,
        unsteady_share=AUTOPILOT_UNSTEADY_SHARE if by_autopilot else UNSTEADY_SHARE,
    )


def check_mark(config: Config, table: PrescriptionTable) -> None:
    """Refuse an offset that does not bring a mark of the map to where the receiver finds it."""
    if table.check_map is None or table.check_surveyed is None:
        return
    latitude_deg, longitude_deg = table.check_map
    mark = LocalFrame(latitude_deg=latitude_deg, longitude_deg=longitude_deg)
    east_m, north_m = mark.to_local(*table.check_surveyed)
    error_m = math.hypot(east_m - table.offset_east_m, north_m - table.offset_north_m)
    if not error_m <= table.check_tolerance_m:
        raise ConfigError(
            f"{config.path}: prescription.check_surveyed lies {error_m:.2f} m from where the map "
            f"and its offset put the mark; set prescription.offset_east_m = {east_m:.3f} and "
            f"offset_north_m = {north_m:.3f}, or correct the mark"
        )


def above_label(
    config: Config,
    name: object,
    *,
    rates_l_ha: Sequence[float],
    default_rate_l_ha: float | None,
) -> Problem | None:
    """Return what is wrong when a rate of a map is above what the product's label allows.

    `rates_l_ha` are those of the map called `name`, and `default_rate_l_ha` what holds elsewhere.
    """
    rates = [*rates_l_ha, *([] if default_rate_l_ha is None else [default_rate_l_ha])]
    limit_l_ha = config.rate_max_l_ha()
    if limit_l_ha is not None and rates and not max(rates) <= limit_l_ha:
        return Problem(
            severity="error",
            code="above-label",
            text=f"{name} asks for up to {max(rates):g} L/ha, above "
            f"{_rate_key(config, limit_l_ha)} = {limit_l_ha:g}",
            fix="lower the map's rates or correct the limit to what the label says",
        )
    least_l_ha = None if config.label is None else config.label.rate_min_l_ha
    low = min((rate for rate in rates if rate > 0.0), default=math.inf)
    if least_l_ha is not None and low < least_l_ha:
        return Problem(
            severity="error",
            code="below-label",
            text=f"{name} asks for {low:g} L/ha, below rate_min_l_ha = {least_l_ha:g} of "
            f"{config.limits_table.file}",
            fix="raise the map's low rates, or set them to 0: not sprayed",
        )
    return None


def beyond_label(config: Config) -> list[Problem]:
    """Return where the configuration itself goes beyond label and permit, before any flight."""
    label, mission, file = config.label, config.mission, config.limits_table.file
    if label is None:
        return []
    found = []
    for code, key, unit in (("label-speed", "speed_m_s", "m/s"), ("label-height", "height_m", "m")):
        value, span = getattr(mission, key, None), label.span(key)
        if value is not None and span is not None and not span[0] <= value <= span[1]:
            found.append(Problem(
                severity="error",
                code=code,
                text=f"mission.{key} = {value:g}, and {file} allows {label.words(key, unit)}",
                where=f"mission.{key}",
                fix=f"change mission.{key}, and plan again",
            ))  # fmt: skip
    droplets = config.product.droplet_class
    if droplets is not None and not label.is_droplet_class(droplets):
        found.append(Problem(
            severity="error",
            code="label-droplets",
            text=f"product.droplet_class = {droplets}, and {file} allows "
            + " or ".join(label.droplet_classes),
            where="product.droplet_class",
            fix="fit nozzles of that class at the pressure that is flown",
        ))  # fmt: skip
    own, other = config.product.rate_max_l_ha, label.rate_max_l_ha
    if own is not None and other is not None and own != other:
        found.append(Problem(
            severity="warning",
            code="label-rates-differ",
            text=f"product.rate_max_l_ha = {own:g}, and {file} says {other:g}; the lower applies",
            where="product.rate_max_l_ha",
            fix="look at the label, and write its rate in one of the two",
        ))  # fmt: skip
    return found


def _rate_key(config: Config, limit_l_ha: float) -> str:
    own = config.product.rate_max_l_ha
    if own is not None and own <= limit_l_ha:
        return "product.rate_max_l_ha"
    return f"{config.limits_table.file}: rate_max_l_ha"


def deliverable(setup: Setup, speed_m_s: float) -> list[Problem]:
    """Return what the nozzle sets cannot deliver at `speed_m_s`, and at which speed they could."""
    return undelivered(
        setup.prescription.rates_l_ha,
        sets=setup.nozzle_sets,
        pwm=setup.pwm,
        width_m=setup.boom.width_m,
        speed_m_s=speed_m_s,
        speeds_m_s=(setup.limits.speed_min_m_s, setup.limits.speed_max_m_s),
    )


def undelivered(
    rates_l_ha: Iterable[float],
    *,
    sets: tuple[NozzleSet, ...],
    pwm: PwmLimits,
    width_m: float,
    speed_m_s: float,
    speeds_m_s: tuple[float, float] = (0.0, math.inf),
) -> list[Problem]:
    """Return which rates are out of the sets' range at a speed; a rate of 0 never is.

    `speeds_m_s` are the least and the highest that may be sprayed at; none beyond is advised.
    """
    low, high = flow_range(sets, pwm)
    flow = {
        rate: flow_for_rate(rate, speed_m_s, width_m) for rate in sorted(rates_l_ha) if rate > 0.0
    }
    given = f"the nozzle sets deliver {low:.2f} to {high:.2f} L/min"
    too_much = [rate for rate, flow_l_min in flow.items() if not flow_l_min <= high]
    too_little = [rate for rate, flow_l_min in flow.items() if not flow_l_min >= low]
    problems = []
    if too_much:
        # Cut down, so that the speed named is one that does.
        speed = math.floor(100.0 * speed_m_s * high / flow[too_much[-1]]) / 100.0
        problems.append(
            Problem(
                severity="warning",
                code="rate-too-high",
                text=f"{_need(too_much, flow, speed_m_s)}; {given}",
                fix=f"fly at {speed:g} m/s or slower, or fit larger nozzles"
                if speed >= speeds_m_s[0]
                else f"fit larger nozzles: only below {speeds_m_s[0]:g} m/s, which the "
                f"configuration refuses, would these do ({speed:g} m/s)",
            )
        )
    if too_little:
        speed = math.ceil(100.0 * speed_m_s * low / flow[too_little[0]]) / 100.0
        problems.append(
            Problem(
                severity="warning",
                code="rate-too-low",
                text=f"{_need(too_little, flow, speed_m_s)}; {given}",
                fix=f"fly at {speed:g} m/s or faster, or fit smaller nozzles"
                if speed <= speeds_m_s[1]
                else f"fit smaller nozzles: only above {speeds_m_s[1]:g} m/s, which the "
                f"configuration refuses, would these do ({speed:g} m/s)",
            )
        )
    return problems


def flow_range(sets: tuple[NozzleSet, ...], pwm: PwmLimits) -> tuple[float, float]:
    """Return the least and the largest flow [L/min] that the sets deliver evenly."""
    low = min(max(nozzles.flow_min_l_min, nozzles.curve.flow_for(pwm.duty_min)) for nozzles in sets)
    return low, max(nozzles.flow_max_l_min for nozzles in sets)


def _need(rates: list[float], flow: dict[float, float], speed_m_s: float) -> str:
    """Return in words which flows some rates need; many rates are named by their range."""
    if len(rates) > RATES_NAMED_MAX:
        names = f"{len(rates)} rates from {rates[0]:g} to {rates[-1]:g}"
    else:
        names = ", ".join(f"{rate:g}" for rate in rates)
    least, most = flow[rates[0]], flow[rates[-1]]
    needs = f"{least:.2f}" if len(rates) == 1 else f"{least:.2f} to {most:.2f}"
    return f"{names} L/ha at {speed_m_s:g} m/s need {needs} L/min"
