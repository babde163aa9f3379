"""The dialect, and frames out and in of one peer; the one file that knows pymavlink's object."""

from __future__ import annotations

from typing import Any

from pymavlink.dialects.v20 import ardupilotmega

# pymavlink has no types: names come from its dialect, and a message is what it makes of a frame.
dialect: Any = ardupilotmega
Message = Any

AUTOPILOT_SYSTEM = 1
AUTOPILOT_COMPONENT: int = dialect.MAV_COMP_ID_AUTOPILOT1
COMPANION_COMPONENT: int = dialect.MAV_COMP_ID_ONBOARD_COMPUTER
GROUND_SYSTEM = 255
GROUND_COMPONENT: int = dialect.MAV_COMP_ID_MISSIONPLANNER


class Speaker:
    """One MAVLink component that speaks: gives frames with its ids and running numbers."""

    def __init__(self, system: int, component: int) -> None:
        self._mavlink = dialect.MAVLink(None, srcSystem=system, srcComponent=component)

    def frame(self, message: Message) -> bytes:
        """Return `message` as a MAVLink 2 frame with the next sequence number."""
        frame = bytes(message.pack(self._mavlink))
        self._mavlink.seq = (self._mavlink.seq + 1) % 256
        return frame


class Listener:
    """Finds the frames in the bytes of one peer; what is no frame is counted and dropped."""

    def __init__(self) -> None:
        self._mavlink = dialect.MAVLink(None)
        self._mavlink.robust_parsing = True
        self.bad_count = 0

    def messages(self, received: bytes) -> list[Message]:
        """Return the messages that `received` completes."""
        found = self._mavlink.parse_buffer(received) or []
        good = [message for message in found if message.get_type() != "BAD_DATA"]
        self.bad_count += len(found) - len(good)
        return [message for message in good if not message.get_type().startswith("UNKNOWN")]


def sender(message: Message) -> tuple[int, int]:
    """Return the (system, component) that `message` comes from."""
    return message.get_srcSystem(), message.get_srcComponent()


def target(message: Message) -> tuple[int, int]:
    """Return the (system, component) that `message` is for; zero is everybody."""
    return getattr(message, "target_system", 0), getattr(message, "target_component", 0)


def clipped(value: float, low: int, high: int) -> int:
    """Return the whole number nearest to `value` that a field of the wire can hold."""
    return min(max(round(value), low), high)
