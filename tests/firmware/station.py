"""A ground station for the flights beside real firmwares: commands, and a log of what is true.

Nothing of the program is imported: pymavlink's messages, a socket, and the clock of this computer.
Whoever waits, pumps: every message is logged with the moment at which it came.
"""

from __future__ import annotations

import math
import select
import socket
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

AUTOPILOT, COMPANION = 1, 191
HEARTBEAT_EVERY_S = 1.0
ASK_AGAIN_S = 1.0
_E7, _MILLI = 1e-7, 1e-3


@dataclass(frozen=True, slots=True)
class Place:
    """Where the vehicle was.

    `at_s` is its own clock, None where the message has none; `pulses_before` counts the outputs'
    messages that had come by then, which have a time. `speed_m_s` is the one told with it.
    """

    came_s: float
    at_s: float | None
    pulses_before: int
    latitude_deg: float
    longitude_deg: float
    yaw_rad: float
    speed_m_s: float = math.nan


@dataclass(frozen=True, slots=True)
class Pulses:
    """The servo outputs, in microseconds, output 1 first; `at_s` is the vehicle's clock."""

    came_s: float
    at_s: float
    us: tuple[int, ...]


@dataclass(slots=True)
class Log:
    """What came, oldest first: truth, what the vehicle tells, outputs, texts."""

    places: list[Place] = field(default_factory=list)
    told: list[Place] = field(default_factory=list)
    pulses: list[Pulses] = field(default_factory=list)
    texts: list[tuple[float, int, str]] = field(default_factory=list)

    def clear_flight(self) -> None:
        """Forget places and pulses, as before another flight."""
        self.places.clear()
        self.told.clear()
        self.pulses.clear()


@dataclass(slots=True)
class _Repeated:
    every_s: float
    do: Callable[[], None]
    done_s: float = -math.inf


class NoAnswerError(AssertionError):
    """What was waited for did not come; the last texts are named."""


class Station:
    """System 255 on a port of the firmware: `tcp` connects, `udp` listens."""

    def __init__(self, kind: str, port: int) -> None:
        self.log = Log()
        self.latest: dict[tuple[int, str], Any] = {}
        self._address: tuple[str, int] | None = None
        self._kind = kind
        self._parser = dialect.MAVLink(None)
        self._parser.robust_parsing = True
        self._coder = dialect.MAVLink(None, srcSystem=255, srcComponent=190)
        self._socket = self._open(port)
        self._socket.setblocking(False)
        self._takers: list[Callable[[Any], None]] = []
        self._repeated: list[_Repeated] = []
        self.every(HEARTBEAT_EVERY_S, self._beat)

    def _open(self, port: int) -> socket.socket:
        if self._kind == "udp":
            made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            made.bind(("127.0.0.1", port))
            return made
        made = socket.create_connection(("127.0.0.1", port), timeout=1.0)
        made.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return made

    def close(self) -> None:
        """Give the port back."""
        self._socket.close()

    # ------------------------------------------------------------------------------- messages

    def send(self, message: Any) -> None:
        """Send one message."""
        data = message.pack(self._coder)
        self._coder.seq = (self._coder.seq + 1) % 256
        if self._kind == "tcp":
            self._socket.sendall(data)
        elif self._address is not None:
            self._socket.sendto(data, self._address)

    def _beat(self) -> None:
        self.send(dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))

    def every(self, every_s: float, do: Callable[[], None]) -> None:
        """Do something again and again, as often as that while somebody pumps."""
        self._repeated.append(_Repeated(every_s, do))

    def no_more(self, do: Callable[[], None]) -> None:
        """Do it no more."""
        self._repeated = [one for one in self._repeated if one.do != do]

    def pump(self, within_s: float) -> None:
        """Take what has come, or wait for it that long."""
        now_s = time.monotonic()
        for one in self._repeated:
            if now_s - one.done_s >= one.every_s:
                one.done_s = now_s
                one.do()
        readable, _, _ = select.select([self._socket], [], [], within_s)
        if not readable:
            return
        now_s = time.monotonic()
        data, address = self._socket.recvfrom(65536)
        if self._kind == "udp":
            self._address = address
        elif not data:
            raise NoAnswerError("the firmware has closed the connection")
        for message in self._parser.parse_buffer(data) or []:
            self._take(now_s, message)

    def _take(self, now_s: float, message: Any) -> None:
        kind, component = message.get_type(), message.get_srcComponent()
        self.latest[component, kind] = message
        if kind == "SIMSTATE":
            self._place(self.log.places, now_s, None, message.lat, message.lng, message.yaw)
        elif kind == "HIL_STATE_QUATERNION":
            w, x, y, z = message.attitude_quaternion
            yaw_rad = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
            at_s = message.time_usec * 1e-6 or None  # PX4 leaves it out
            self._place(self.log.places, now_s, at_s, message.lat, message.lon, yaw_rad)
        elif kind == "GLOBAL_POSITION_INT":
            yaw_rad = math.radians(message.hdg * 1e-2)
            at_s = message.time_boot_ms * 1e-3
            speed_m_s = math.hypot(message.vx, message.vy) * 1e-2
            self._place(self.log.told, now_s, at_s, message.lat, message.lon, yaw_rad, speed_m_s)
        elif kind == "SERVO_OUTPUT_RAW" and message.port == 0:
            us = tuple(getattr(message, f"servo{number}_raw") for number in range(1, 17))
            self.log.pulses.append(Pulses(now_s, message.time_usec * 1e-6, us))
        elif kind == "STATUSTEXT":
            self.log.texts.append((now_s, component, message.text))
        for taker in self._takers:
            taker(message)

    def _place(
        self,
        places: list[Place],
        now_s: float,
        at_s: float | None,
        lat: int,
        lon: int,
        yaw_rad: float,
        speed_m_s: float = math.nan,
    ) -> None:
        before = len(self.log.pulses)
        places.append(Place(now_s, at_s, before, lat * _E7, lon * _E7, yaw_rad, speed_m_s))

    # -------------------------------------------------------------------------------- waiting

    def until(self, done: Callable[[], bool], what: str, within_s: float = 30.0) -> float:
        """Pump until `done`; return the moment."""
        end_s = time.monotonic() + within_s
        while not done():
            if (left_s := end_s - time.monotonic()) <= 0.0:
                last = "; ".join(text for _, _, text in self.log.texts[-8:])
                raise NoAnswerError(f"no {what} within {within_s:g} s; last texts: {last}")
            self.pump(min(left_s, 0.1))
        return time.monotonic()

    def for_s(self, wanted_s: float) -> None:
        """Pump for a time: what must not come cannot be waited for."""
        end_s = time.monotonic() + wanted_s
        while (left_s := end_s - time.monotonic()) > 0.0:
            self.pump(min(left_s, 0.1))

    def said(self, part: str, *, since: int = 0) -> bool:
        """Whether a text has `part`, among those from number `since` on."""
        return any(part in text for _, _, text in self.log.texts[since:])

    def said_by(self, component: int) -> list[str]:
        """Return the texts of a component."""
        return [text for _, who, text in self.log.texts if who == component]

    def heard(self, kind: str, component: int = AUTOPILOT) -> Any:
        """Return the latest message of a kind, None without one."""
        return self.latest.get((component, kind))

    def _answered(
        self, message: Any, fits: Callable[[Any], bool], what: str, *, within_s: float
    ) -> Any:
        found: list[Any] = []

        def take(came: Any) -> None:
            if fits(came):
                found.append(came)

        self._takers.append(take)
        end_s = time.monotonic() + within_s
        try:
            while not found:
                if time.monotonic() >= end_s:
                    last = "; ".join(text for _, _, text in self.log.texts[-8:])
                    raise NoAnswerError(f"no answer to {what}; last texts: {last}")
                self.send(message)
                again_s = min(time.monotonic() + ASK_AGAIN_S, end_s)
                while not found and time.monotonic() < again_s:
                    self.pump(0.05)
        finally:
            self._takers.remove(take)
        return found[0]

    # ------------------------------------------------------------------------------- commands

    def command(
        self, number: int, *values: float, to: int = AUTOPILOT, within_s: float = 10.0
    ) -> int:
        """Send a command until it is answered; return MAV_RESULT."""
        seven = (*values, *(0.0,) * (7 - len(values)))
        answer = self._answered(
            dialect.MAVLink_command_long_message(1, to, number, 0, *seven),
            lambda came: (
                came.get_type() == "COMMAND_ACK"
                and came.command == number
                and came.get_srcComponent() == to
            ),
            f"command {number} {values}",
            within_s=within_s,
        )
        return int(answer.result)

    def ask_for(self, message_id: int, rate_hz: float) -> None:
        """Ask for a message at a rate."""
        result = self.command(511, message_id, 1e6 / rate_hz)
        assert result == 0, f"message {message_id} at {rate_hz:g} Hz: result {result}"

    def set_parameter(self, name: str, value: float, kind: int = 9) -> None:
        """Set a parameter until it reads so; `kind` is MAV_PARAM_TYPE."""
        raw = name.encode()

        def fits(came: Any) -> bool:
            return came.get_type() == "PARAM_VALUE" and came.param_id == name

        message = dialect.MAVLink_param_set_message(1, AUTOPILOT, raw, value, kind)
        answer = self._answered(message, fits, f"parameter {name}", within_s=10.0)
        assert answer.param_value == value, f"{name} is {answer.param_value}, not {value}"

    def parameter(self, name: str, *, within_s: float = 10.0) -> float:
        """Read a parameter."""
        message = dialect.MAVLink_param_request_read_message(1, AUTOPILOT, name.encode(), -1)
        answer = self._answered(
            message,
            lambda came: came.get_type() == "PARAM_VALUE" and came.param_id == name,
            f"parameter {name}",
            within_s=within_s,
        )
        return float(answer.param_value)

    def upload(self, items: Sequence[MissionItem]) -> None:
        """Put a mission on the vehicle."""
        result, last = self.try_upload(items)
        assert result == 0, f"mission refused at item {last}: MAV_MISSION_RESULT {result}"

    def try_upload(self, items: Sequence[MissionItem]) -> tuple[int, int]:
        """Offer a mission; return MAV_MISSION_RESULT and the last item that was asked for."""
        last = -1
        asked: list[int] = []
        over: list[int] = []

        def take(came: Any) -> None:
            if came.get_type() in ("MISSION_REQUEST", "MISSION_REQUEST_INT"):
                asked.append(came.seq)
            elif came.get_type() == "MISSION_ACK" and getattr(came, "mission_type", 0) == 0:
                over.append(came.type)

        self._takers.append(take)
        try:
            self.send(dialect.MAVLink_mission_count_message(1, AUTOPILOT, len(items), 0))
            while not over:
                self.until(lambda: bool(asked or over), "request of a mission item", 10.0)
                for seq in asked:
                    self.send(items[seq].message(seq))
                    last = seq
                asked.clear()
        finally:
            self._takers.remove(take)
        return over[0], last

    def go_on_with(self, seq: int) -> None:
        """Make an item of the mission the current one."""

        def fits(came: Any) -> bool:
            return came.get_type() == "MISSION_CURRENT" and came.seq == seq

        message = dialect.MAVLink_mission_set_current_message(1, AUTOPILOT, seq)
        self._answered(message, fits, f"item {seq} as the current one", within_s=10.0)

    def mission(self) -> list[MissionItem]:
        """Return the mission that is on the vehicle."""
        count = self._answered(
            dialect.MAVLink_mission_request_list_message(1, AUTOPILOT, 0),
            lambda came: came.get_type() == "MISSION_COUNT",
            "the mission",
            within_s=10.0,
        ).count
        found = []
        for seq in range(count):
            item = self._answered(
                dialect.MAVLink_mission_request_int_message(1, AUTOPILOT, seq, 0),
                lambda came, seq=seq: (  # type: ignore[misc]
                    came.get_type() == "MISSION_ITEM_INT" and came.seq == seq
                ),
                f"mission item {seq}",
                within_s=10.0,
            )
            values = (item.param1, item.param2, item.param3, item.param4)
            found.append(
                MissionItem(item.command, item.x * _E7, item.y * _E7, item.z, item.frame, values)
            )
        self.send(dialect.MAVLink_mission_ack_message(1, AUTOPILOT, 0, 0))
        return found

    @property
    def is_armed(self) -> bool:
        """As the latest heartbeat says it."""
        beat = self.heard("HEARTBEAT")
        return bool(beat is not None and beat.base_mode & 128)

    @property
    def height_m(self) -> float:
        """Above home, as the vehicle tells it; NaN before it does."""
        told = self.heard("GLOBAL_POSITION_INT")
        return told.relative_alt * _MILLI if told is not None else math.nan


@dataclass(frozen=True, slots=True)
class MissionItem:
    """One item of a mission."""

    command: int
    latitude_deg: float = 0.0
    longitude_deg: float = 0.0
    height_m: float = 0.0
    frame: int = 3
    values: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)

    def message(self, seq: int) -> Any:
        """Return it for the wire."""
        return dialect.MAVLink_mission_item_int_message(
            *(1, AUTOPILOT, seq, self.frame, self.command, 0, 1, *self.values),
            *(round(self.latitude_deg / _E7), round(self.longitude_deg / _E7), self.height_m),
        )
