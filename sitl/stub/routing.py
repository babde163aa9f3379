"""Which messages are for the autopilot, and which it passes on to other peers."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sitl.stub.protocol import AUTOPILOT_COMPONENT, AUTOPILOT_SYSTEM, Message, target

if TYPE_CHECKING:
    from sitl.stub.autopilot import Autopilot
    from sitl.stub.channel import Channel


def is_for_us(autopilot: Autopilot, message: Message) -> bool:
    """Return whether to act.

    ArduPilot carries out what is for a component that it never heard (MAVLink_routing.cpp, rule
    1e); PX4 takes no command for every system (`evaluate_target_ok`).
    """
    system, component = target(message)
    for_unheard = autopilot.firmware.carries_out_for_unheard
    if message.get_type().startswith("COMMAND_") and not for_unheard:
        return system == AUTOPILOT_SYSTEM and component in (0, AUTOPILOT_COMPONENT)
    if system not in (0, AUTOPILOT_SYSTEM):
        return False
    if component in (0, AUTOPILOT_COMPONENT):
        return True
    known = any((system, component) in channel.heard for channel in autopilot.channels)
    return for_unheard and not known


def forward(autopilot: Autopilot, origin: Channel, message: Message) -> None:
    """Pass on what is for everybody, or for a component that was heard elsewhere."""
    system, component = target(message)
    if (system, component) == (AUTOPILOT_SYSTEM, AUTOPILOT_COMPONENT):
        return
    for channel in autopilot.channels:
        if channel is not origin and (
            system == 0
            or any(system == heard[0] and component in (0, heard[1]) for heard in channel.heard)
        ):
            autopilot.emit(channel, bytes(message.get_msgbuf()))
