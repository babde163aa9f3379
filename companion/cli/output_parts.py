"""From the configuration to link and executors: signing, parameters, and what carries plans out.

What drives outputs, of this computer or of the autopilot, is loaded by a configuration that has
such, when it is put together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from companion.cli.answer import note
from companion.config import Config, load
from companion.config.rules import tank_capacity_l
from companion.errors import ConfigError
from companion.link.component import ComponentOptions
from companion.link.parameters import (
    SETTINGS,
    Parameters,
    known_parameters,
    read_state,
    write_state,
)
from companion.link.transport import serial_baud
from companion.link.vehicle_link import VehicleLink
from companion.ports import PlanExecutor

if TYPE_CHECKING:
    from companion.output.autopilot_options import DriveOutput, ServoOptions
    from companion.output.engine.wire import EngineSetup
    from companion.output.gpio import GpioExecutor
    from companion.output.hardware_pwm import PwmDrive
    from companion.output.servo import ServoExecutor

# ----------------------------------------------------------------------------------------- the link

PARAMETERS_NAME, STOP_NAME = "parameters.json", "stop.json"


def load_with_kept(path: Path, overrides: Sequence[str]) -> tuple[Config, tuple[str, ...]]:
    """Return the configuration with what a station or the page set, and all overrides.

    What is given on the command line counts more than what was kept.
    """
    config = load(path, overrides=overrides)
    field: tuple[str, ...] = ()
    state = _state_file(config)
    kept = _overrides(read_state(state))
    said = f"parameters of {state}: {', '.join(kept)}"
    if config.web.enabled and config.web.choose_field:
        from companion.cli.field_choice import CHOSEN_NAME, read_choice

        name, field = read_choice(state.with_name(CHOSEN_NAME))
        if name:
            note(f"the field is {name}, chosen on the operator's page, and not the configuration's")
            state = state if kept else state.with_name(CHOSEN_NAME)
    if not kept and not field:
        return config, tuple(overrides)
    given = (*kept, *field, *overrides)
    try:
        config = load(path, overrides=given)
    except ConfigError as error:
        raise ConfigError(
            f"{state}: its values do not go with the configuration any more ({error}); delete it "
            "and set them again"
        ) from error
    if kept:
        note(said)
    return config, given


def build_link(config: Config, given: Sequence[str], options: ComponentOptions) -> VehicleLink:
    """Return the link that the configuration describes, not yet open."""
    state = _state_file(config)
    in_force = {key: value for key, (value, _) in config.settings().items()}
    settings = {key: float(in_force[key]) for key, _, _ in SETTINGS.values() if key in in_force}
    tank_l = tank_capacity_l(config)

    def save(values: Mapping[str, float]) -> bool:
        return write_state(state, values)

    def check(values: Mapping[str, float]) -> str | None:
        try:
            load(config.path, overrides=(*given, *_overrides(values)))
        except ConfigError:
            return "not with the other settings"
        return None

    parameters = Parameters(
        known_parameters(settings, tank_l=tank_l),
        kept=read_state(state),
        save=save,
        check=check,
        stop_file=state.with_name(STOP_NAME),
    )
    signing = None
    if config.link.signing_key_file is not None:
        from companion.link.signing import Signing, read_key

        key = read_key(config.resolve(config.link.signing_key_file))
        signing = Signing(key, state_folder=state.parent)
    return VehicleLink(config.link.url, options, parameters=parameters, signing=signing)


def _state_file(config: Config) -> Path:
    return config.resolve(config.link.state_folder) / PARAMETERS_NAME


def _overrides(values: Mapping[str, float]) -> list[str]:
    return [f"{SETTINGS[name][0]}={value!r}" for name, value in values.items() if name in SETTINGS]


# -------------------------------------------------------------------------------------- the outputs


def build_outputs(config: Config, link: VehicleLink) -> PlanExecutor:
    """Return the executor of all valves and motors."""
    output = config.output
    if output.kind == "none":
        from companion.output.timed import DryRunExecutor

        return DryRunExecutor(len(config.valve), has_return=output.return_channel is not None)
    options, local = servo_options(config), pwm_drives(config)
    if output.kind == "gpio" and options is None and not local:
        return build_gpio(config)
    if output.kind != "gpio" and options is not None and options.channels and not local:
        return build_servo(config, options, link)
    from companion.output.composite import CompositeExecutor, Part

    parts: list[Part] = []
    if output.kind == "gpio":
        parts.append(Part(executor=build_gpio(config), has_valves=True))
    if options is not None:
        servo = build_servo(config, options, link)
        numbers = drive_numbers(config, is_pwm=False)
        parts.append(Part(executor=servo, has_valves=bool(options.channels), drives=numbers))
    if local:
        from companion.output.hardware_pwm import HardwarePwmExecutor

        numbers = drive_numbers(config, is_pwm=True)
        parts.append(Part(executor=HardwarePwmExecutor(local), drives=numbers))
    return CompositeExecutor(parts)


def parts_of(executor: PlanExecutor) -> tuple[PlanExecutor, ...]:
    """Return the executors that an executor is made of."""
    found: tuple[PlanExecutor, ...] = getattr(executor, "executors", (executor,))
    return found


# From the configuration to what the valve engine must know.


def engine_setup(config: Config) -> EngineSetup:
    """Return the wiring and limits of a configuration with `output.kind = "gpio"`."""
    from companion.output.engine.wire import EngineSetup, Wiring

    output, gpio = config.output, config.gpio
    wiring = Wiring(
        valves=tuple(valve.channel or 0 for valve in config.valve),
        return_line=output.return_channel,
        alive_line=gpio.alive_line,
        normally_open=config.pwm.valve == "normally-open",
        return_normally_open=gpio.return_valve == "normally-open",
        active_low=gpio.active_low,
    )
    is_register = gpio.driver == "spi595"
    return EngineSetup(
        wiring=wiring,
        pwm=config.pwm_limits(),
        backend="spi595" if is_register else "gpiod",
        device=gpio.spi_device if is_register else output.chip,
        realtime=gpio.realtime,
        spi_hz=1000 * gpio.spi_khz,
    )


def build_gpio(config: Config) -> GpioExecutor:
    """Return the executor of a configuration with `output.kind = "gpio"`."""
    from companion.output.gpio import GpioExecutor

    return GpioExecutor(engine_setup(config))


# From the configuration to the outputs of the motors: pump first, then the atomisers.


@dataclass(frozen=True, slots=True, kw_only=True)
class Motor:
    """An output of a motor, on the autopilot or on a PWM chip of this computer."""

    drive: DriveOutput
    chip: int | None = None


def motors(config: Config) -> tuple[Motor, ...]:
    """Return all motors in the order of a plan's drives; none in a dry run."""
    if config.output.kind == "none" or not config.has_motors:
        return ()
    from companion.output.autopilot_options import DriveOutput

    found = []
    if config.pump is not None:
        pump = config.pump
        drive = DriveOutput(channel=pump.channel, stop_us=pump.stop_us, max_us=pump.max_us)
        found.append(Motor(drive=drive, chip=pump.chip if pump.output == "pwm" else None))
    for table in config.atomiser:
        drive = DriveOutput(channel=table.channel, stop_us=table.stop_us, max_us=table.us[-1])
        found.append(Motor(drive=drive, chip=table.chip if table.output == "pwm" else None))
    return tuple(found)


def pwm_drives(config: Config) -> tuple[PwmDrive, ...]:
    """Return the motors on this computer's hardware PWM."""
    local = [(motor.chip, motor.drive) for motor in motors(config) if motor.chip is not None]
    if not local:
        return ()
    from companion.output.hardware_pwm import PwmDrive

    return tuple(PwmDrive(chip=chip, drive=drive) for chip, drive in local)


def drive_numbers(config: Config, *, is_pwm: bool) -> tuple[int, ...]:
    """Return which of a plan's drives hang on hardware PWM, or on the autopilot."""
    return tuple(
        number for number, motor in enumerate(motors(config)) if (motor.chip is not None) == is_pwm
    )


def motor_closer_arguments(config: Config) -> list[str]:
    """Return the closer's arguments that stop what pulses on after this process."""
    drives = pwm_drives(config)
    given = [f"{each.chip}:{each.drive.channel}:{each.drive.stop_us}" for each in drives]
    return ["--pwm", *given] if given else []


# From the configuration to the valves and motors behind the autopilot's servo outputs.


def servo_options(config: Config) -> ServoOptions | None:
    """Return what hangs on the autopilot, valves or motors; None where nothing does."""
    output = config.output
    channels = tuple(valve.channel for valve in config.valve if valve.channel is not None)
    has_valves = output.kind == "servo" and bool(channels)
    drives = tuple(motor.drive for motor in motors(config) if motor.chip is None)
    if not has_valves and not drives:
        return None
    from companion.output.autopilot_options import ServoOptions

    return ServoOptions(
        channels=channels if has_valves else (),
        closed_us=output.closed_us,
        full_us=output.full_us,
        dither_us=output.dither_us,
        return_channel=output.return_channel if has_valves else None,
        drives=drives,
        needs_guard=output.guard == "auto" and output.kind == "servo",
    )


def build_servo(config: Config, options: ServoOptions, link: VehicleLink) -> ServoExecutor:
    """Return the executor of these outputs; it hears what the vehicle says of them."""
    from companion.output.guarded import NOTE_NAME, GuardedServoExecutor, GuardianSetup

    guardian = GuardianSetup(
        lease_s=config.output.lease_s,
        component=config.link.component_id,
        is_udp=config.link.url.startswith("udp"),
        key=link.signing_key,
        note=config.resolve(config.link.state_folder) / NOTE_NAME,
    )
    executor = GuardedServoExecutor(
        options,
        link.order,
        guardian,
        link.way,
        flush=link.flush_orders,
        say=link.note_outputs,
        baud=serial_baud(config.link.url),
    )
    link.on_order_ack(executor.acknowledge)
    link.follow_outputs(executor)
    return executor


def line_warnings(config: Config) -> list[str]:
    """Return what the line to the autopilot cannot carry of what is to be ordered over it."""
    if config.output.kind != "servo" or not config.output.dither_us:
        return []
    from companion.output.servo import DITHER_S, dither_too_much

    baud = serial_baud(config.link.url)
    much = dither_too_much(baud=baud, valves=len(config.valve), every_s=DITHER_S)
    return [] if much is None else [f"warning: {much}"]
