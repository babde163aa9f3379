"""The stub as a whole: bytes of peers in, bytes out, at times that the caller gives.

No sockets and no clock in here; `server.py` brings both.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable
from itertools import count

from sitl.stub import commands, mission, parameters, services
from sitl.stub.channel import Channel
from sitl.stub.estimator import Estimator
from sitl.stub.faults import FaultClock, FaultKind
from sitl.stub.flight import Flight
from sitl.stub.impairment import Impairment
from sitl.stub.mission_items import MissionItem
from sitl.stub.modes import AUTO, INFO
from sitl.stub.outputs import ServoOutputs
from sitl.stub.parameters import Parameters
from sitl.stub.protocol import (
    AUTOPILOT_COMPONENT,
    AUTOPILOT_SYSTEM,
    Message,
    Speaker,
    dialect,
    sender,
    target,
)
from sitl.stub.streams import BUILDERS, heartbeat
from sitl.stub.world import Pose

Handler = Callable[["Autopilot", Channel, Message, float], None]

HANDLERS: dict[str, Handler] = {
    "COMMAND_LONG": commands.handle_long,
    "COMMAND_INT": commands.handle_int,
    "SET_MODE": commands.handle_set_mode,
    "REQUEST_DATA_STREAM": commands.handle_data_stream,
    "MISSION_COUNT": mission.handle_count,
    "MISSION_ITEM_INT": mission.handle_item,
    "MISSION_ITEM": mission.handle_item,
    "MISSION_REQUEST_LIST": mission.handle_list,
    "MISSION_REQUEST_INT": mission.handle_request,
    "MISSION_REQUEST": mission.handle_request,
    "MISSION_CLEAR_ALL": mission.handle_clear,
    "MISSION_SET_CURRENT": mission.handle_set_current,
    "PARAM_REQUEST_LIST": parameters.handle_list,
    "PARAM_REQUEST_READ": parameters.handle_read,
    "PARAM_SET": parameters.handle_set,
    "TIMESYNC": services.handle_timesync,
    "PING": services.handle_ping,
    "FILE_TRANSFER_PROTOCOL": services.handle_file_transfer,
}

_HEARTBEAT_S = 1.0
_TIMESYNC_S = 10.0
_BUSY_FACTOR = 4.0  # ArduPilot slows a port down while parameters or a mission run on it


class Autopilot:
    """A flight controller with any number of peers."""

    def __init__(
        self,
        flight: Flight,
        estimator: Estimator,
        outputs: ServoOutputs,
        params: Parameters,
        *,
        faults: FaultClock,
        start_s: float,
        seed: int = 0,
    ) -> None:
        self.flight = flight
        self.outputs = outputs
        self.parameters = params
        self.faults = faults
        self.channels: list[Channel] = []
        self.upload: mission.Upload | None = None
        self.hears: Callable[[Message, float], None] = lambda _message, _now_s: None
        self.says: Callable[[str], None] = lambda _text: None
        self._estimator = estimator
        self._speaker = Speaker(AUTOPILOT_SYSTEM, AUTOPILOT_COMPONENT)
        self._impairment = Impairment(faults, seed=seed)
        self._boot_s = start_s
        self._now_s = start_s
        self._heartbeat_due_s = start_s
        self._timesync_due_s = start_s + _TIMESYNC_S
        self._late: list[tuple[float, int, Channel, Message]] = []
        self._late_number = count()
        self._frozen: Pose | None = None
        self._in_force: set[FaultKind] = set()

    # ------------------------------------------------------------------------------- peers

    def attach(self, name: str, send: Callable[[bytes], None]) -> Channel:
        """Take a new peer on."""
        channel = Channel(name, send)
        self.channels.append(channel)
        return channel

    def detach(self, channel: Channel) -> None:
        """Let a peer go, with what it had asked for."""
        if channel in self.channels:
            self.channels.remove(channel)
        if self.upload is not None and self.upload.channel is channel:
            self.upload = None

    def receive(self, channel: Channel, received: bytes, now_s: float) -> None:
        """Take bytes of a peer in and carry out what is for this vehicle."""
        self._now_s = now_s
        if self.faults.active(FaultKind.SILENCE, now_s):
            return
        for message in channel.listener.messages(received):
            channel.heard.add(sender(message))
            self.hears(message, now_s)
            self._forward(channel, message)
            handler = HANDLERS.get(message.get_type())
            if handler is not None and self._is_for_us(message):
                handler(self, channel, message, now_s)
        self._tell_flight()

    def _is_for_us(self, message: Message) -> bool:
        """Return whether to act; a component that was never heard is ours to answer for.

        That is MAVLink_routing.cpp, rule 1e.
        """
        system, component = target(message)
        if system not in (0, AUTOPILOT_SYSTEM):
            return False
        known = any((system, component) in channel.heard for channel in self.channels)
        return component in (0, AUTOPILOT_COMPONENT) or not known

    def _forward(self, origin: Channel, message: Message) -> None:
        """Pass on what is for everybody, or for a component that was heard elsewhere."""
        system, component = target(message)
        if (system, component) == (AUTOPILOT_SYSTEM, AUTOPILOT_COMPONENT):
            return
        for channel in self.channels:
            if channel is not origin and (
                system == 0
                or any(system == heard[0] and component in (0, heard[1]) for heard in channel.heard)
            ):
                self.emit(channel, bytes(message.get_msgbuf()))

    # ------------------------------------------------------------------------------ speech

    def send(self, channel: Channel, message: Message) -> None:
        """Send a message of the autopilot to one peer."""
        self.emit(channel, self._speaker.frame(message))

    def emit(self, channel: Channel, frame: bytes) -> None:
        """Send a frame to one peer, as far as the faults let it through."""
        damaged = self._impairment.apply(frame, self._now_s)
        if damaged:
            channel.send(damaged)

    def broadcast(self, message: Message) -> None:
        """Send a message of the autopilot to all peers."""
        for channel in self.channels:
            self.send(channel, message)

    def relay(self, frame: bytes) -> None:
        """Pass a frame of another component on to all peers."""
        for channel in self.channels:
            self.emit(channel, frame)

    def tell(self, text: str, *, severity: int = INFO) -> None:
        """Send a STATUSTEXT to all peers."""
        self.says(text)
        self.broadcast(dialect.MAVLink_statustext_message(severity, text[:50].encode("ascii")))

    def acknowledge(
        self, channel: Channel, command: int, result: int, *, to: tuple[int, int], now_s: float
    ) -> None:
        """Send a COMMAND_ACK: once, late, twice or not at all, as the faults will have it."""
        message = dialect.MAVLink_command_ack_message(command, result, 0, 0, to[0], to[1])
        if self._impairment.strikes(FaultKind.ACK_LOST, now_s):
            return
        late = self._impairment.strikes(FaultKind.ACK_LATE, now_s)
        if late is not None:
            due_s = now_s + late.delay_s
            heapq.heappush(self._late, (due_s, next(self._late_number), channel, message))
            return
        self.send(channel, message)
        if self._impairment.strikes(FaultKind.ACK_DOUBLED, now_s):
            self.send(channel, message)

    # ------------------------------------------------------------------------------- state

    def build(self, message_id: int, now_s: float) -> Message:
        """Return a message that can be asked for."""
        return BUILDERS[message_id](self, now_s)

    def boot_ms(self, now_s: float) -> int:
        """Return milliseconds since boot, 32 bits."""
        return self._impairment.boot_ms(now_s - self._boot_s, now_s)

    def boot_ns(self, now_s: float) -> int:
        """Return nanoseconds since boot, the time of TIMESYNC."""
        return round((now_s - self._boot_s) * 1e9)

    def believed(self, now_s: float) -> Pose:
        """Return the estimated pose; frozen and at rest while the estimator is lost."""
        if self.faults.active(FaultKind.STALE_POSITION, now_s) is None:
            self._frozen = None
            return self._estimator.estimate(now_s)
        if self._frozen is None:
            self._frozen = self._estimator.frozen(now_s)
        return self._frozen

    def home_item(self) -> MissionItem:
        """Return home as item 0 of the mission."""
        frame = self.flight.frame
        return MissionItem(
            command=dialect.MAV_CMD_NAV_WAYPOINT,
            frame=dialect.MAV_FRAME_GLOBAL,
            x_e7=round(frame.latitude_deg * 1e7),
            y_e7=round(frame.longitude_deg * 1e7),
            z_m=self.flight.home_altitude_m,
        )

    def reboot(self, now_s: float) -> None:
        """Start the clock again and forget streams and outputs; the twin flies on."""
        self._boot_s = now_s
        self.upload = None
        self.outputs.reset(now_s)
        for channel in self.channels:
            channel.streams.clear()

    # -------------------------------------------------------------------------------- time

    def tick(self, now_s: float) -> None:
        """Do everything that is due at `now_s`."""
        self._now_s = now_s
        self.flight.tick(now_s)
        if self.flight.in_air and self.faults.take_off_s is None:
            self.faults.take_off_s = now_s
        self._begin_faults(now_s)
        self._tell_flight()
        mission.tick(self, now_s)
        if self._heartbeat_due_s <= now_s:
            self._heartbeat_due_s = max(self._heartbeat_due_s + _HEARTBEAT_S, now_s)
            self.broadcast(heartbeat(self, now_s))
            for frame in self._impairment.foreign(now_s):
                self.relay(frame)
        if self._timesync_due_s <= now_s:
            self._timesync_due_s = now_s + _TIMESYNC_S
            self.broadcast(services.timesync_request(self, now_s))
        while self._late and self._late[0][0] <= now_s:
            _, _, channel, message = heapq.heappop(self._late)
            self.send(channel, message)
        for channel in list(self.channels):
            self._stream(channel, now_s)

    def next_due_s(self) -> float:
        """Return when `tick` has something to send."""
        due_s = [self._heartbeat_due_s, *(entry[0] for entry in self._late[:1])]
        return min(due_s + [channel.next_due_s() for channel in self.channels])

    def _stream(self, channel: Channel, now_s: float) -> None:
        slow = self.faults.active(FaultKind.SLOW_STREAMS, now_s)
        factor = slow.factor if slow is not None else 1.0
        if now_s < channel.busy_until_s:
            factor *= _BUSY_FACTOR
        for message_id in channel.due(now_s, slow_factor=factor):
            position = message_id == dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT
            if position and self.faults.active(FaultKind.NO_POSITION, now_s):
                continue
            self.send(channel, self.build(message_id, now_s))

    def _begin_faults(self, now_s: float) -> None:
        """Do what happens once at the begin or end of a fault."""
        reboot = self.faults.active(FaultKind.REBOOT, now_s)
        if reboot is not None and FaultKind.REBOOT not in self._in_force:
            self._in_force.add(FaultKind.REBOOT)
            self.reboot(now_s)
        mode = self.faults.active(FaultKind.MODE, now_s)
        if mode is not None and FaultKind.MODE not in self._in_force:
            self._in_force.add(FaultKind.MODE)
            self.flight.set_mode(mode.mode, now_s)
        if mode is None and FaultKind.MODE in self._in_force:
            self._in_force.discard(FaultKind.MODE)
            self.flight.set_mode(AUTO, now_s)

    def _tell_flight(self) -> None:
        """Send what the flight has to tell, and do the mission's actions."""
        for event in self.flight.events:
            if event.text:
                self.tell(event.text, severity=event.severity)
            if event.reached is not None:
                self.broadcast(dialect.MAVLink_mission_item_reached_message(event.reached))
            action = event.action
            if action is not None and action.command == dialect.MAV_CMD_DO_SET_SERVO:
                commands.write_servo(self, action.param1, action.param2, self._now_s)
        self.flight.events.clear()
