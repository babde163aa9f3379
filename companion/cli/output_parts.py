"""From the configuration to what carries plans out: one executor, or several that share.

What drives outputs, of this computer or of the autopilot, is loaded by a configuration that has
such, when it is put together.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from companion.config import Config
from companion.link.transport import serial_baud
from companion.link.vehicle_link import VehicleLink
from companion.ports import PlanExecutor

if TYPE_CHECKING:
    from companion.output.autopilot_options import DriveOutput, ServoOptions
    from companion.output.engine.setup import EngineSetup
    from companion.output.gpio import GpioExecutor
    from companion.output.hardware_pwm import PwmDrive
    from companion.output.servo import ServoExecutor


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
    from companion.output.engine.setup import EngineSetup, Wiring

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
    )


def build_servo(config: Config, options: ServoOptions, link: VehicleLink) -> ServoExecutor:
    """Return the executor of these outputs; it hears what the vehicle says of them."""
    from companion.output.servo import ServoExecutor

    executor = ServoExecutor(
        options,
        link.order,
        flush=link.flush_orders,
        say=link.note_outputs,
        baud=serial_baud(config.link.url),
        is_signed=config.link.signing_key_file is not None,
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
