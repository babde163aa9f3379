"""From the configuration to the valves behind the autopilot's servo outputs."""

from __future__ import annotations

from companion.config import Config
from companion.link.transport import serial_baud
from companion.link.vehicle_link import VehicleLink
from companion.output.servo import ServoExecutor, ServoOptions


def servo_options(config: Config) -> ServoOptions | None:
    """Return how the valves hang on the autopilot; None where they do not."""
    output = config.output
    if output.kind != "servo":
        return None
    return ServoOptions(
        channels=tuple(valve.channel or 0 for valve in config.valve),
        closed_us=output.closed_us,
        full_us=output.full_us,
        dither_us=output.dither_us,
        return_channel=output.return_channel,
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
