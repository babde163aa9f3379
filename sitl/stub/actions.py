"""What the flight has to tell goes out, and what the mission orders is done."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sitl.stub.ardupilot import write_servo
from sitl.stub.protocol import dialect
from sitl.stub.px4 import set_actuators

if TYPE_CHECKING:
    from sitl.stub.firmware import Autopilot
    from sitl.stub.mission_items import MissionItem


def tell(autopilot: Autopilot, now_s: float) -> None:
    """Send what has happened since the last call, and do the mission's actions."""
    for event in autopilot.flight.events:
        if event.text and (event.action is None or autopilot.firmware.tells_of_actions):
            autopilot.tell(event.text, severity=event.severity)
        if event.reached is not None:
            number = autopilot.wire_sequence(event.reached)
            autopilot.broadcast(dialect.MAVLink_mission_item_reached_message(number))
        if event.action is not None:
            _do(autopilot, event.action, now_s)
    autopilot.flight.events.clear()


def _do(autopilot: Autopilot, item: MissionItem, now_s: float) -> None:
    if item.command == dialect.MAV_CMD_DO_SET_SERVO:
        write_servo(autopilot, item.param1, item.param2, now_s)
    if item.command == dialect.MAV_CMD_DO_SET_ACTUATOR:
        # The fifth and sixth are whole numbers on the wire, taken for degrees of 1e-7 (PX4 #28723).
        last = (item.x_e7 * 1e-7, item.y_e7 * 1e-7, item.z_m)
        params = (item.param1, item.param2, item.param3, item.param4, *last)
        set_actuators(autopilot, params, now_s)
