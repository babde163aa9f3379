"""From the configuration to the valves and motors behind the autopilot's servo outputs."""

from __future__ import annotations

from companion.cli.motor_parts import motors
from companion.config import Config
from companion.link.transport import serial_baud
from companion.link.vehicle_link import VehicleLink
from companion.output.servo import ServoExecutor, ServoOptions


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
