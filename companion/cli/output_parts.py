"""From the configuration to what carries plans out: one executor, or several that share."""

from __future__ import annotations

from companion.cli.gpio_parts import build_gpio
from companion.cli.motor_parts import drive_numbers, pwm_drives
from companion.cli.servo_parts import build_servo, servo_options
from companion.config import Config
from companion.link.vehicle_link import VehicleLink
from companion.output.composite import CompositeExecutor, Part
from companion.output.hardware_pwm import HardwarePwmExecutor
from companion.output.none import DryRunExecutor
from companion.ports import PlanExecutor


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
        numbers = drive_numbers(config, is_pwm=True)
        parts.append(Part(executor=HardwarePwmExecutor(local), drives=numbers))
    if len(parts) == 1 and parts[0].has_valves:
        return parts[0].executor
    return CompositeExecutor(parts)


def parts_of(executor: PlanExecutor) -> tuple[PlanExecutor, ...]:
    """Return the executors that an executor is made of."""
    return executor.executors if isinstance(executor, CompositeExecutor) else (executor,)
