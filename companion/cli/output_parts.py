"""From the configuration to what carries plans out: one executor, or several that share.

What drives lines of this computer is loaded by a configuration that has such, when it is put
together.
"""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from companion.config import Config
from companion.core.types import SprayPlan
from companion.link.transport import serial_baud
from companion.link.vehicle_link import VehicleLink
from companion.output.autopilot_options import DriveOutput
from companion.output.servo import ServoExecutor, ServoOptions
from companion.output.timed import DryRunExecutor
from companion.ports import PlanExecutor

if TYPE_CHECKING:
    from companion.output.engine.setup import EngineSetup
    from companion.output.gpio import GpioExecutor
    from companion.output.hardware_pwm import PwmDrive


def build_outputs(config: Config, link: VehicleLink) -> PlanExecutor:
    """Return the executor of all valves and motors."""
    output = config.output
    if output.kind == "none":
        return DryRunExecutor(len(config.valve), has_return=output.return_channel is not None)
    parts: list[Part] = []
    if output.kind == "gpio":
        parts.append(Part(executor=build_gpio(config), has_valves=True))
    options = servo_options(config)
    if options is not None:
        servo = build_servo(config, options, link)
        numbers = drive_numbers(config, is_pwm=False)
        parts.append(Part(executor=servo, has_valves=bool(options.channels), drives=numbers))
    local = pwm_drives(config)
    if local:
        from companion.output.hardware_pwm import HardwarePwmExecutor

        numbers = drive_numbers(config, is_pwm=True)
        parts.append(Part(executor=HardwarePwmExecutor(local), drives=numbers))
    if len(parts) == 1 and parts[0].has_valves:
        return parts[0].executor
    return CompositeExecutor(parts)


def parts_of(executor: PlanExecutor) -> tuple[PlanExecutor, ...]:
    """Return the executors that an executor is made of."""
    return executor.executors if isinstance(executor, CompositeExecutor) else (executor,)


# Several executors as one: for a pump that hangs elsewhere than its valves.
#
# A fault of one stops all: a pump without its valves has no way out, valves without their pump
# spray what nobody ordered.


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """An executor, and what of each plan is its: the valves, drives by their numbers."""

    executor: PlanExecutor
    has_valves: bool = False
    drives: tuple[int, ...] = ()

    def submit(self, plan: SprayPlan) -> None:
        """Hand it its part of a plan; a plan without drives has them stopped."""
        own = tuple(plan.drives[number] for number in self.drives) if plan.drives else ()
        if self.has_valves:
            self.executor.submit(replace(plan, drives=own))
        else:
            self.executor.submit(replace(plan, duty=(), changes=(), drives=own))


class CompositeExecutor:
    """Hands each part of a plan to the executor whose it is.

    At one moment a pump starts behind its valves and stops ahead of them, so that there is always
    a way out.
    """

    def __init__(self, parts: Sequence[Part]) -> None:
        if not parts or sum(part.has_valves for part in parts) > 1:
            raise ValueError("parts are needed, of which one at most has the valves")
        self._drives_first = sorted(parts, key=lambda part: part.has_valves)

    @property
    def executors(self) -> tuple[PlanExecutor, ...]:
        """Return the executors, that of the valves last."""
        return tuple(part.executor for part in self._drives_first)

    @property
    def fault(self) -> str | None:
        """Why the outputs cannot be trusted; the first that is known."""
        faults = (executor.fault for executor in self.executors)
        return next((fault for fault in faults if fault is not None), None)

    async def start(self) -> None:
        """Take all outputs; where one cannot be had, the others are let go again."""
        for number, executor in enumerate(self.executors):
            try:
                await executor.start()
            except BaseException:
                for started in self.executors[:number]:
                    await started.stop()
                raise

    def submit(self, plan: SprayPlan) -> None:
        """Replace what has not happened; with a fault of any, everything stops."""
        if self.fault is not None:
            plan = replace(plan, duty=(0.0,) * len(plan.duty), changes=(), drives=())
        starts = any(drive.fraction for drive in plan.drives)
        for part in reversed(self._drives_first) if starts else self._drives_first:
            part.submit(plan)

    async def stop(self) -> None:
        """Stop the drives, close the valves; none waits for another."""
        ended = await asyncio.gather(
            *(executor.stop() for executor in self.executors), return_exceptions=True
        )
        for error in ended:
            if isinstance(error, BaseException):
                raise error


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
    if config.output.kind == "none":
        return ()
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
