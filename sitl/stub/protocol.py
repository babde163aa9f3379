"""The dialect, and frames out and in of one peer; the one file that knows pymavlink's object."""

from __future__ import annotations

from dataclasses import dataclass
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


# Of the frames that are signed with a key that nobody knows.
_STRANGE_KEY = bytes(range(32))


# Payloads of version 1, of the messages that got longer in version 2 (common.xml).
_LENGTHS_1 = {
    dialect.MAVLINK_MSG_ID_SYS_STATUS: 31,
    dialect.MAVLINK_MSG_ID_GPS_RAW_INT: 30,
    dialect.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW: 21,
    dialect.MAVLINK_MSG_ID_MISSION_CURRENT: 2,
    dialect.MAVLINK_MSG_ID_MISSION_COUNT: 4,
    dialect.MAVLINK_MSG_ID_MISSION_ACK: 3,
    dialect.MAVLINK_MSG_ID_MISSION_REQUEST_INT: 4,
    dialect.MAVLINK_MSG_ID_MISSION_ITEM_INT: 37,
    dialect.MAVLINK_MSG_ID_COMMAND_ACK: 3,
    dialect.MAVLINK_MSG_ID_TIMESYNC: 16,
    dialect.MAVLINK_MSG_ID_AUTOPILOT_VERSION: 60,
    dialect.MAVLINK_MSG_ID_EKF_STATUS_REPORT: 22,
    dialect.MAVLINK_MSG_ID_HOME_POSITION: 52,
    dialect.MAVLINK_MSG_ID_STATUSTEXT: 51,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class SigningKey:
    """The key of a link that is signed; time stamps count 10 us from the start of 2015."""

    secret: bytes
    timestamp: int

    def __post_init__(self) -> None:
        if len(self.secret) != 32:
            raise ValueError(f"a signing key has 32 bytes, got {len(self.secret)}")


class Speaker:
    """One MAVLink component that speaks: gives frames with its ids and running numbers."""

    def __init__(self, system: int, component: int, *, key: SigningKey | None = None) -> None:
        self._mavlink = dialect.MAVLink(None, srcSystem=system, srcComponent=component)
        self._always_signs = key is not None
        signing = self._mavlink.signing
        signing.secret_key = _STRANGE_KEY if key is None else key.secret
        signing.timestamp = 1 if key is None else key.timestamp
        self._first_stamp: int = signing.timestamp

    def keep_time(self, passed_s: float) -> None:
        """Stamp what is signed from now on so long after the first: late ones are not heard."""
        signing = self._mavlink.signing
        signing.timestamp = max(signing.timestamp, self._first_stamp + round(passed_s * 1e5))

    def frame(
        self, message: Message, *, mavlink1: bool = False, signed: bool | None = None
    ) -> bytes:
        """Return `message` as a frame with the next sequence number.

        It is of version 2 unless told otherwise; a message that version 1 cannot carry stays one
        of version 2.
        """
        old = mavlink1 and message.get_msgId() < 256
        signs = self._always_signs if signed is None else signed
        self._mavlink.signing.sign_outgoing = signs and not old
        frame = bytes(message.pack(self._mavlink, force_mavlink1=old))
        self._mavlink.seq = (self._mavlink.seq + 1) % 256
        return _without_extensions(message, frame) if old else frame


def _without_extensions(message: Message, frame: bytes) -> bytes:
    """Return a frame of version 1 as a firmware makes it; pymavlink leaves the extensions in."""
    length = min(_LENGTHS_1.get(message.get_msgId(), frame[1]), frame[1])
    head = bytes((frame[0], length)) + frame[2 : 6 + length]
    crc = dialect.x25crc(head[1:])
    crc.accumulate(bytes((message.crc_extra,)))
    return head + int(crc.crc).to_bytes(2, "little")


class Listener:
    """Finds the frames in the bytes of one peer; what is no frame is counted and dropped."""

    def __init__(self, key: SigningKey | None = None) -> None:
        self._mavlink = dialect.MAVLink(None)
        self._mavlink.robust_parsing = True
        if key is not None:
            # As GCS_Signing.cpp: with a key set, what is not signed is not heard.
            self._mavlink.signing.secret_key = key.secret
            self._mavlink.signing.timestamp = key.timestamp
            self._mavlink.signing.allow_unsigned_callback = lambda *_: False
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
