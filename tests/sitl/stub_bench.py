"""A stub autopilot on a bench: no sockets, time as the test wants it, peers as byte buffers."""

from __future__ import annotations

from typing import Any

from sitl.earth import Earth
from sitl.stub.mission_items import MissionItem, waypoint
from sitl.stub.outputs import ServoOrder
from sitl.stub.protocol import Listener, Speaker, dialect
from sitl.stub.server import StubOptions, build_autopilot

HOME = Earth(latitude_deg=36.0, longitude_deg=114.5)
STEP_S = 0.02


def place(command: int, east_m: float, north_m: float, height_m: float = 3.5) -> MissionItem:
    return waypoint(command, *HOME.to_geographic(east_m, north_m), height_m=height_m)


def mission(*legs: tuple[float, float], land: bool = True) -> tuple[MissionItem, ...]:
    """Home, take-off, the legs, and a landing where the last one ends."""
    end = legs[-1] if legs else (0.0, 0.0)
    return (
        place(dialect.MAV_CMD_NAV_WAYPOINT, 0.0, 0.0, 0.0),
        place(dialect.MAV_CMD_NAV_TAKEOFF, 0.0, 0.0),
        *(place(dialect.MAV_CMD_NAV_WAYPOINT, east, north) for east, north in legs),
        *((place(dialect.MAV_CMD_NAV_LAND, *end, 0.0),) if land else ()),
    )


def of_firmware(autopilot: str, items: tuple[MissionItem, ...]) -> tuple[MissionItem, ...]:
    """Return a mission as a firmware wants it: ArduPilot's begins with home."""
    return items if autopilot == "ardupilot" else items[1:]


class Peer:
    """Somebody on the link: a companion or a ground station."""

    def __init__(self, bench: Bench, system: int, component: int) -> None:
        self.messages: list[Any] = []
        self._bench = bench
        self._speaker = Speaker(system, component)
        self._listener = Listener()
        self.channel = bench.autopilot.attach(f"{system}/{component}", self._take)

    @property
    def bad_count(self) -> int:
        return self._listener.bad_count

    def _take(self, frame: bytes) -> None:
        for message in self._listener.messages(frame):
            message.at_s = self._bench.now_s
            self.messages.append(message)

    def say(self, message: Any) -> None:
        self._bench.autopilot.receive(self.channel, self._speaker.frame(message), self._bench.now_s)

    def command(self, command: int, *params: float, component: int = 1) -> int | None:
        """Send a COMMAND_LONG and return its result, if an acknowledgement came at once."""
        before = len(self.of("COMMAND_ACK"))
        padded = [*params, *([0.0] * (7 - len(params)))]
        self.say(dialect.MAVLink_command_long_message(1, component, command, 0, *padded))
        acks = self.of("COMMAND_ACK")[before:]
        return acks[-1].result if acks else None

    def of(self, kind: str) -> list[Any]:
        return [message for message in self.messages if message.get_type() == kind]

    def last(self, kind: str) -> Any:
        return self.of(kind)[-1]

    def request(self, message_id: int) -> Any:
        """Ask for one message and return it."""
        result = self.command(dialect.MAV_CMD_REQUEST_MESSAGE, message_id)
        assert result == dialect.MAV_RESULT_ACCEPTED, result
        return next(m for m in reversed(self.messages) if m.get_msgId() == message_id)


class Bench:
    """The stub, its clock and its peers."""

    def __init__(self, **options: Any) -> None:
        self.now_s = 1000.0
        self.orders: list[ServoOrder] = []
        self.autopilot = build_autopilot(
            StubOptions(**{"home": HOME, "gust_m_s": 0.0, **options}),
            start_s=self.now_s,
            written=self.orders.append,
        )
        self.companion = Peer(self, 1, 191)

    def peer(self, system: int, component: int) -> Peer:
        return Peer(self, system, component)

    def run(self, duration_s: float) -> None:
        end_s = self.now_s + duration_s
        while self.now_s < end_s - 1e-9:
            self.now_s = min(self.now_s + STEP_S, end_s)
            self.autopilot.tick(self.now_s)

    def run_until(self, done: Any, *, within_s: float) -> None:
        end_s = self.now_s + within_s
        while not done():
            assert self.now_s < end_s, "did not happen in time"
            self.run(STEP_S)

    def fly(self) -> None:
        """Arm and start the mission."""
        assert self.companion.command(dialect.MAV_CMD_COMPONENT_ARM_DISARM, 1) == 0
        assert self.companion.command(dialect.MAV_CMD_MISSION_START) == 0
