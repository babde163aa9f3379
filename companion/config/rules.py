"""What the tables must say together: rules that no single key can break.

One contradiction refuses the file: a sprayer that is half right is wrong.
"""

from __future__ import annotations

import difflib
from collections import Counter
from collections.abc import Callable, Iterator
from itertools import pairwise, starmap
from typing import TYPE_CHECKING, NamedTuple

from companion.config.sprayer_tables import own_figures
from companion.core.nozzle import FLOW_LAWS, FlowCurve
from companion.flight_modes import is_mode, known_modes

if TYPE_CHECKING:
    from companion.config.document import Document
    from companion.config.sprayer_tables import NozzleSetTable


# MAV_CMD_DO_SET_SERVO: ArduPilot has at most 32 outputs (SERVO1 to SERVO32).
SERVO_OUTPUTS = 32
# DO_SET_ACTUATOR: PX4 has six.
PX4_OUTPUTS = 6
# One request of the kernel's GPIO interface has 64 lines at most, a chain of registers as many.
LINES_MAX = 64
GPIO_LAST = {"lines": 1023, "spi595": LINES_MAX - 1}
# Less than this between closed and full leaves a servo output too few steps for a duty.
SPAN_MIN_US = 100
# Passes spaced by another width than the flow law's leave skips or overlaps in every pass.
SWATH_TOLERANCE = 0.02
# Product in the mix by the map and by the record: as far as people round.
MIX_TOLERANCE = 0.02
# Where none of these is written there is nothing of sensors that could contradict anything.
_SENSOR_TABLES = frozenset({"flow_meter", "pressure", "tank", "detection"})


class Contradiction(NamedTuple):
    """A key, what is wrong with its value, and what to write instead."""

    key: str
    text: str


Found = Iterator[tuple[str, str]]


def _named(rule: Callable[[Document], Found]) -> Callable[[Document], Iterator[Contradiction]]:
    return lambda config: starmap(Contradiction, rule(config))


def contradictions(config: Document) -> Found:
    """Yield all that makes the configuration unusable."""
    rules = (
        _link, _prescription, _valves, _channels, _nozzle_sets, _pwm, _lags, _output, _safety,
        _mission, _lines, _motors, _sensors,
    )  # fmt: skip
    found = False
    for rule in rules:
        try:
            for each in rule(config):
                found = True
                yield each
        except (ValueError, LookupError, ArithmeticError):
            # A rule works with what those before it have found wrong.
            if not found:
                raise


def _motors(config: Document) -> Found:
    if config.has_motors:
        from companion.config.motor_rules import motor_contradictions

        yield from motor_contradictions(config)


def _motor_warnings(config: Document) -> Found:
    if config.has_motors:
        from companion.config.motor_rules import motor_warnings

        yield from motor_warnings(config)


def _has_wiring(config: Document) -> bool:
    """Whether anything is written of lines or sensors of this computer."""
    return (
        config.output.kind == "gpio"
        or config.safety.estop_line is not None
        or bool(_SENSOR_TABLES & config.model_fields_set)
    )


def _lines(config: Document) -> Found:
    if _has_wiring(config):
        from companion.config.wiring_rules import line_contradictions

        yield from line_contradictions(config)


def _line_warnings(config: Document) -> Found:
    if _has_wiring(config):
        from companion.config.wiring_rules import line_warnings

        yield from line_warnings(config)


def _sensors(config: Document) -> Found:
    if _has_wiring(config):
        from companion.config.wiring_rules import sensor_contradictions

        yield from sensor_contradictions(config, tank_capacity_l(config))


def _prescription(config: Document) -> Found:
    table = config.prescription
    if table is not None and (table.check_map is None) != (table.check_surveyed is None):
        here, missing = ("check_map", "check_surveyed")
        if table.check_map is None:
            here, missing = missing, here
        yield (
            f"prescription.{here}",
            f"needs prescription.{missing} as well; write the position of the mark on the "
            "map and as surveyed",
        )
    rate = None if table is None else table.mix_rate
    per_l = config.application.product_per_l
    if rate is None or per_l is None or config.application.product_unit != "L":
        return
    if not abs(per_l * rate - 1.0) <= MIX_TOLERANCE:
        yield (
            "prescription.mix_rate",
            f"{rate:g} L of mix with 1 L of product, but application.product_per_l = "
            f"{per_l:g} L in one; write {1.0 / rate:.4g} there, or correct mix_rate",
        )


@_named
def mismatches(config: Document) -> Found:
    """Yield what `config check` refuses though the parts would run: a plan that is not sprayed."""
    width_m = config.boom_table.width_m
    mission, safety = config.mission, config.safety
    if mission is not None and not (
        safety.speed_min_m_s <= mission.speed_m_s <= safety.speed_max_m_s
    ):
        yield (
            "mission.speed_m_s",
            f"nothing is sprayed but from safety.speed_min_m_s = {safety.speed_min_m_s:g} to "
            f"safety.speed_max_m_s = {safety.speed_max_m_s:g}; make them agree",
        )
    if mission is not None and not _near(mission.swath_width_m, width_m):
        yield (
            "mission.swath_width_m",
            f"more than 2 % from boom.width_m = {width_m:g}; make the two agree",
        )
    strips_m = {valve.name: valve.width_m for valve in config.boom().valves}
    largest = max(config.nozzle_set, key=lambda table: len(table.valves))
    sum_m = sum(strips_m[name] for name in largest.valves)
    if not _near(sum_m, width_m):
        yield "boom.width_m", f"the valve widths add up to {sum_m:g} m; correct valve[...].width_m"
    else:
        yield from _untiled(config)
    yield from _no_modes(config)
    yield from _autopilot(config)


def _autopilot(config: Document) -> Found:
    """Yield what the autopilot that is named cannot do; of one that is not, nothing is known."""
    mission = config.mission
    if mission is None or "autopilot" not in mission.model_fields_set:
        return
    is_px4 = mission.autopilot == "px4"
    if not any(is_mode(mode, mission.autopilot) for mode in config.safety.modes):
        name, mode = ("PX4", "MISSION") if is_px4 else ("ArduPilot", "AUTO")
        yield (
            "safety.modes",
            f'{name} has none of these modes, so nothing would be sprayed; write "{mode}"',
        )
    if not is_px4:
        return
    channels: dict[str, int | None] = {}
    if config.output.kind == "servo":
        channels |= {f"valve[{n}].channel": each.channel for n, each in enumerate(config.valve)}
        channels["output.return_channel"] = config.output.return_channel
    if config.has_motors and config.output.kind != "none":
        from companion.config.motor_rules import on_autopilot

        channels |= on_autopilot(config)
    used = {key: channel for key, channel in channels.items() if channel is not None}
    if len(used) > PX4_OUTPUTS:
        yield (
            "valve",
            f"{len(used)} outputs, but PX4 takes orders for {PX4_OUTPUTS}; use fewer valves, "
            "GPIO lines, or ArduPilot",
        )
        return
    for key, channel in used.items():
        if not 1 <= channel <= PX4_OUTPUTS:
            yield key, "PX4 numbers its actuators from 1 to 6; write one"


def _untiled(config: Document) -> Found:
    """Yield strips that leave ground between them or lie over each other, set by set."""
    tolerance_m = SWATH_TOLERANCE * config.boom_table.width_m
    most = max(len(table.valves) for table in config.nozzle_set)
    for table in config.nozzle_set:
        if len(table.valves) < most:
            continue  # a smaller set's strips are wider than the valves' own
        strips = [
            (number, valve)
            for number, valve in enumerate(config.boom().valves)
            if valve.name in table.valves
        ]
        for (_, left), (number, right) in pairwise(strips):
            gap_m = (right.right_m - 0.5 * right.width_m) - (left.right_m + 0.5 * left.width_m)
            if abs(gap_m) <= tolerance_m + 1e-9:
                continue
            what = (
                f"leaves {gap_m:.2f} m between its strip and that"
                if gap_m > 0.0
                else f"has its strip {-gap_m:.2f} m over that"
            )
            yield (
                f"valve[{number}].right_m",
                f'{what} of valve "{left.name}"; correct valve[...].right_m, or width_m',
            )


def _no_modes(config: Document) -> Found:
    """Yield modes in which no vehicle ever is: with none but those, nothing would be sprayed."""
    for mode in config.safety.modes:
        if is_mode(mode):
            continue
        near = difflib.get_close_matches(mode.upper(), sorted(known_modes()), n=1, cutoff=0.5)
        advice = f'did you mean "{near[0]}"?' if near else 'write "AUTO", or "MISSION" for PX4'
        yield "safety.modes", f'no flight mode is named "{mode}"; {advice}'


@_named
def without_effect(config: Document) -> Found:
    """Yield settings that are not acted on, or work and are unwise: silence would deceive."""
    if config.flow_trim.enabled and config.flow_meter.source == "none":
        yield "flow_trim.enabled", "has no effect without a flow meter; set flow_meter.source"
    yield from _off_centre(config)
    for number, table in enumerate(config.nozzle_set):
        if table.preset is not None:
            yield (
                f"nozzle_set[{number}].preset",
                "a published curve: its own authors measured up to 22 % more flow; "
                "measure yours (vrspray calibrate flow)",
            )
    yield from _line_warnings(config)
    yield from _motor_warnings(config)


def _off_centre(config: Document) -> Found:
    """Yield a boom that is not under the aircraft: passes that alternate then do not adjoin."""
    valves = config.boom().valves
    left_m = min(valve.right_m - 0.5 * valve.width_m for valve in valves)
    right_m = max(valve.right_m + 0.5 * valve.width_m for valve in valves)
    aside_m = 0.5 * (left_m + right_m)
    if abs(aside_m) > SWATH_TOLERANCE * config.boom_table.width_m + 1e-9:
        side = "right" if aside_m > 0.0 else "left"
        yield (
            "valve[0].right_m",
            f"the middle of all strips is {abs(aside_m):.2f} m {side} of the aircraft, so "
            f"passes in opposite directions lie {2.0 * abs(aside_m):.2f} m too near or too far; "
            "correct valve[...].right_m",
        )


@_named
def remarks(config: Document) -> Found:
    """Yield what a reader should know of a configuration in which nothing is wrong."""
    if config.prescription is None:
        yield (
            "prescription.file",
            "not set: there is no map yet; `vrspray run` refuses to start until one is named",
        )
    yield from unbounded(config)
    if config.output.kind == "servo":
        yield "output.guard", "; ".join(filter(None, without_power(config)))
    if config.flow_meter.source == "none" and config.lag.measured_on is None:
        yield (
            "flow_meter.source",
            "not set: `vrspray calibrate lag` needs a flow meter; without one, measure the "
            "lags with marks on the ground (`vrspray calibrate lag-marks`)",
        )


def without_power(config: Document) -> tuple[str, str]:
    """Return what closes servo outputs without this computer or its link; if nothing, advice."""
    if config.output.dither_us:
        return "without power or link the driver board closes the valves (output.dither_us)", ""
    if config.output.guard != "auto":
        return (
            "nothing closes the valves when this computer loses power or its link",
            "keep a hand at the pump switch",
        )
    if config.mission is not None and config.mission.autopilot == "px4":
        return (
            "PX4 has no watchdog script, so nothing will be sprayed",
            'fit a driver board and set output.dither_us, or write "none-on-power-loss"',
        )
    return (
        "nothing sprays until ArduPilot's watchdog script is seen on the vehicle: it closes "
        "without power or link",
        "",
    )


@_named
def unbounded(config: Document) -> Found:
    """Yield that no lines are named: then the map alone says where is sprayed."""
    if config.mission is None or config.mission.lines is None:
        yield (
            "mission.lines",
            "not set: the drone sprays the whole map wherever it flies, ferries included; "
            "name the plan's .lines.geojson",
        )


def _near(value_m: float, reference_m: float) -> bool:
    return abs(value_m - reference_m) <= SWATH_TOLERANCE * reference_m + 1e-9


def _link(config: Document) -> Found:
    kind, _, rest = config.link.url.partition(":")
    port = int(rest.rpartition(":")[2])
    least = 0 if kind == "udpin" else 1  # 0 lets the system choose the port to listen on
    if kind != "serial" and not least <= port <= 65535:
        yield "link.url", "has no valid port; end it with a port from 1 to 65535"


def _valves(config: Document) -> Found:
    seen: set[str] = set()
    for number, valve in enumerate(config.valve):
        if valve.name in seen:
            yield f"valve[{number}].name", "another valve has this name; give each its own"
        seen.add(valve.name)
    yield from own_figures(config.valve, config.lag, config.nozzle_set)
    for number, (left, right) in enumerate(pairwise(config.valve), start=1):
        if not left.right_m < right.right_m:
            yield (
                f"valve[{number}].right_m",
                f"not to the right of valve[{number - 1}] ({left.right_m:g}); "
                "order the [[valve]] tables from left to right",
            )


def _channels(config: Document) -> Found:
    kind = config.output.kind
    if kind == "none":
        return
    channels = {f"valve[{n}].channel": valve.channel for n, valve in enumerate(config.valve)}
    first = 1 if kind == "servo" else 0
    last = SERVO_OUTPUTS if kind == "servo" else GPIO_LAST[config.gpio.driver]
    what = "servo output" if kind == "servo" else "GPIO line"
    for key, channel in channels.items():
        if channel is None and not config.makes_flow:
            yield key, f"missing; write the {what}, {first} to {last}"
    if config.output.return_channel is not None:
        channels["output.return_channel"] = config.output.return_channel
    if kind == "gpio":
        channels |= _alive(config)
        if len(channels) > LINES_MAX:
            yield "valve", f"too many valves; at most {LINES_MAX} lines are possible"
    counts = Counter(channels.values())
    for key, channel in channels.items():
        if channel is not None and not first <= channel <= last:
            yield key, f"not a {what}; write one from {first} to {last}"
        if channel is not None and counts[channel] > 1:
            yield key, f"used twice; give each valve its own {what}"


def _alive(config: Document) -> dict[str, int | None]:
    line = config.gpio.alive_line
    return {} if line is None else {"gpio.alive_line": line}


def _nozzle_sets(config: Document) -> Found:
    names = [valve.name for valve in config.valve]
    used: set[str] = set()
    for number, table in enumerate(config.nozzle_set):
        key = f"nozzle_set[{number}]"
        unknown = [name for name in table.valves if name not in names]
        if unknown:
            yield (
                f"{key}.valves",
                f'no valve is named "{unknown[0]}"; the valves are '
                + ", ".join(f'"{name}"' for name in names),
            )
        if len(set(table.valves)) != len(table.valves):
            yield f"{key}.valves", "names a valve twice; name each once"
        used.update(table.valves)
        if table.preset is not None and not unknown:
            yield from _preset(config, table, key)
        elif not config.makes_flow:
            yield from _curve(table.duty, table.flow_l_min, key)
    for number, name in enumerate(names):
        if name not in used:
            yield (
                f"valve[{number}].name",
                "not in any nozzle_set.valves, so it would never open; add it there, or "
                "remove the valve",
            )


def _preset(config: Document, table: NozzleSetTable, key: str) -> Found:
    if table.duty or table.flow_l_min or config.makes_flow:
        other = "the curve of the pump" if config.makes_flow else "a row of measured points"
        yield f"{key}.preset", f"{other} already gives the flow; remove one of the two"
        return
    if table.points(config.valve) == ((), ()):
        counts = " or ".join(str(law.nozzles) for law in FLOW_LAWS[table.preset or ""])
        has = table.nozzles(config.valve)
        yield (
            f"{key}.preset",
            f'"{table.preset}" is for {counts} nozzles, but this set has '
            f"{'valves without valve.nozzles' if has is None else has}; correct "
            "valve[...].nozzles, "
            "or write measured points",
        )


def _curve(duty: tuple[float, ...], flow_l_min: tuple[float, ...], key: str) -> Found:
    for name, values in (("duty", duty), ("flow_l_min", flow_l_min)):
        if not values:
            yield (
                f"{key}.{name}",
                "missing and required, unless a pump sets the flow; write the measured points",
            )
            return
    if len(duty) != len(flow_l_min):
        yield (
            f"{key}.flow_l_min",
            f"{len(flow_l_min)} flows for {len(duty)} duties; write one flow for each duty",
        )
        return
    try:
        FlowCurve(duty=duty, flow_l_min=flow_l_min)
    except ValueError as error:
        which = "duty" if str(error).startswith("duty") else "flow_l_min"
        rule = str(error).partition(", got")[0].partition(":")[0]
        yield f"{key}.{which}", f"{rule}; write the measured points in order of duty"


def _pwm(config: Document) -> Found:
    pwm = config.pwm
    if not pwm.duty_min < pwm.duty_max:
        yield "pwm.duty_min", f"not below pwm.duty_max = {pwm.duty_max:g}; write less"
    if not pwm.min_on_s + pwm.min_off_s < 1.0 / pwm.frequency_hz:
        yield (
            "pwm.min_on_s",
            "with pwm.min_off_s as long as a period of "
            f"{1.0 / pwm.frequency_hz:.4f} s; write less, or a lower pwm.frequency_hz",
        )
    if pwm.valve == "normally-open" and not config.safety.pump_cutoff:
        yield (
            "pwm.valve",
            "normally open valves spray when power fails; fit a relay that cuts the "
            "pump, then write safety.pump_cutoff = true",
        )


def _lags(config: Document) -> Found:
    lag = config.lag
    if not lag.on_start_s <= lag.on_s:
        yield (
            "lag.on_start_s",
            f"the first flow cannot come after lag.on_s = {lag.on_s:g}; write at most that",
        )
    if not lag.off_end_s >= lag.off_s:
        yield (
            "lag.off_end_s",
            f"the flow cannot end before lag.off_s = {lag.off_s:g}; write at least that",
        )
    for key, time_s, whole_s in (
        ("up", lag.up_time_s, lag.up_s),
        ("down", lag.down_time_s, lag.down_s),
    ):
        if not time_s <= whole_s:
            yield (
                f"lag.{key}_time_s",
                f"cannot be longer than lag.{key}_s = {whole_s:g}, which includes it; write "
                "at most that",
            )


def _output(config: Document) -> Found:
    output = config.output
    if not abs(output.full_us - output.closed_us) >= SPAN_MIN_US:
        yield (
            "output.full_us",
            f"less than {SPAN_MIN_US} us from output.closed_us = {output.closed_us}; "
            "write the two ends of the driver's range, such as 1000 and 2000",
        )
    # A driver board begins a new period when the width moves by 2 % of its span.
    elif not output.dither_us < 0.02 * abs(output.full_us - output.closed_us):
        yield (
            "output.dither_us",
            "2 % or more of full_us - closed_us: each change would restart the PWM period of "
            "the "
            "driver board; write 8",
        )


def _safety(config: Document) -> Found:
    safety = config.safety
    for what in ("speed", "height"):
        unit = "m_s" if what == "speed" else "m"
        low, high = (getattr(safety, f"{what}_{end}_{unit}") for end in ("min", "max"))
        if not low < high:
            yield (
                f"safety.{what}_min_{unit}",
                f"not below safety.{what}_max_{unit} = {high:g}; write less",
            )
    usable = {
        way
        for way in safety.enable_by
        if way == "command"
        or (way == "rc" and safety.rc_channel is not None)
        or (way == "web" and config.web.enabled)
    }
    if not usable:
        yield (
            "safety.enable_by",
            'leaves no way to enable spraying; add "command", or for "rc" set '
            "safety.rc_channel, "
            'or for "web" set web.enabled',
        )


def _mission(config: Document) -> Found:
    mission = config.mission
    if mission is not None and not mission.reserve_l < mission.tank_l:
        yield "mission.reserve_l", f"not below mission.tank_l = {mission.tank_l:g}; write less"
    ferry_height_m = None if mission is None else mission.ferry_height_m
    if mission is not None and ferry_height_m is not None and ferry_height_m <= mission.height_m:
        yield (
            "mission.ferry_height_m",
            f"not above mission.height_m = {mission.height_m:g}; write more, or leave it out",
        )
    if mission is not None and mission.lines is not None:
        half_m = 0.5 * mission.swath_width_m
        if not mission.lines_aside_m <= half_m:
            yield (
                "mission.lines_aside_m",
                f"reaches the next line; write at most half a swath, {half_m:g}",
            )


def tank_capacity_l(config: Document) -> float | None:
    """Return what a full tank holds."""
    if config.tank.capacity_l is not None:
        return config.tank.capacity_l
    return None if config.mission is None else config.mission.tank_l
