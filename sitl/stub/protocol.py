"""The dialect, and frames out and in of one peer; the one file that knows pymavlink's object."""

from __future__ import annotations

from collections.abc import Callable
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


# One peer on the wire: what was heard of it, what it asked for, and how it is reached.


@dataclass(slots=True)
class Stream:
    """One message that a peer asked for, and when it is next due."""

    interval_s: float
    due_s: float


class Channel:
    """A peer's side of the link.

    Rates are kept by peer because a firmware keeps them by port: whoever speaks last on a port
    sets the rates for everybody on it.
    """

    def __init__(
        self, name: str, send: Callable[[bytes], None], *, key: SigningKey | None = None
    ) -> None:
        self.name = name
        self.send = send
        self.listener = Listener(key)
        self.heard: set[tuple[int, int]] = set()
        self.streams: dict[int, Stream] = {}
        self.busy_until_s = 0.0
        self.parameters_left: list[int] = []
        self.parameters_due_s = 0.0

    def ask(
        self,
        message_id: int,
        interval_s: float | None,
        *,
        now_s: float,
        kinds_max: int | None = None,
    ) -> None:
        """Set the interval of a stream; none ends it.

        ArduPilot keeps ten different intervals a port and takes the nearest of them for any more.
        """
        self.streams.pop(message_id, None)
        if interval_s is None:
            return
        kept = {stream.interval_s for stream in self.streams.values()}
        if kinds_max is not None and len(kept) >= kinds_max:
            wanted_s = interval_s
            interval_s = min(kept, key=lambda kept_s: abs(kept_s - wanted_s))
        self.streams[message_id] = Stream(interval_s=interval_s, due_s=now_s)

    def due(self, now_s: float, *, slow_factor: float) -> list[int]:
        """Return the ids of the messages that are due, and count them as sent.

        A stream that fell behind by more than its interval goes on from now: a firmware skips,
        it does not catch up.
        """
        due = []
        for message_id, stream in self.streams.items():
            if stream.due_s <= now_s:
                due.append(message_id)
                interval_s = stream.interval_s * slow_factor
                stream.due_s += interval_s
                if stream.due_s <= now_s:
                    stream.due_s = now_s + interval_s
        return due

    def next_due_s(self) -> float:
        """Return when the next message is due; infinite without streams."""
        return min((stream.due_s for stream in self.streams.values()), default=float("inf"))
