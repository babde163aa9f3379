"""The stub as a whole: bytes of peers in, bytes out, at times that the caller gives.

No sockets and no clock in here; `server.py` brings both. What one firmware does otherwise than
the other stands in its `Firmware`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from sitl.stub import actions, mission, parameters, routing
from sitl.stub.acknowledgements import Acknowledgements
from sitl.stub.beats import Beats
from sitl.stub.channel import Channel
from sitl.stub.faults import Fault, FaultKind
from sitl.stub.impairment import Impairment
from sitl.stub.incidents import Incidents
from sitl.stub.liquid import Battery
from sitl.stub.mission_items import MissionItem
from sitl.stub.modes import INFO
from sitl.stub.outputs import OutputState
from sitl.stub.parts import Parts
from sitl.stub.protocol import (
    AUTOPILOT_COMPONENT,
    AUTOPILOT_SYSTEM,
    Message,
    Speaker,
    dialect,
    sender,
)
from sitl.stub.rc import rc_pulses_us
from sitl.stub.script import SCRIPT_PERIOD_S, Script
from sitl.stub.strangers import Strangers
from sitl.stub.world import Pose

UTC_START_S = 1_774_080_000.0  # 2026-03-21 08:00


class Autopilot:
    """A flight controller with any number of peers."""

    def __init__(self, parts: Parts, *, start_s: float) -> None:
        self.firmware = parts.firmware
        self.flight = parts.flight
        self.outputs = parts.outputs
        self.parameters = parts.parameters
        self.faults = parts.faults
        self.wind_towards_m_s = parts.wind_towards_m_s
        self.channels: list[Channel] = []
        self.upload: mission.Upload | None = None
        self.fence: tuple[MissionItem, ...] = ()
        self.script: Script | None = None
        # The battery monitors: those of flow meter and tank too, where the sprayer has them.
        self.batteries: Callable[[float], Sequence[Battery]] = lambda _now_s: ()
        self.battery_turn = -1
        self.hears: Callable[[Message, float], None] = lambda _message, _now_s: None
        self.says: Callable[[str], None] = lambda _text: None
        self.queue = parts.queue()
        self._estimator = parts.estimator
        self._speaker = Speaker(AUTOPILOT_SYSTEM, AUTOPILOT_COMPONENT, key=parts.key)
        self._impairment = Impairment(parts.faults, seed=parts.seed)
        self._incidents = Incidents()
        self._acknowledgements = Acknowledgements()
        self.key = parts.key
        self._clock_rate = 1.0 + parts.drift_ppm * 1e-6
        self._boot_s = start_s - parts.uptime_s
        self._start_s = self._now_s = start_s
        # The same day in every flight; a stub in real time is given today's.
        self.utc_offset_s = UTC_START_S - start_s
        self._script_due_s = start_s
        home = self.home_item()
        kind = self.firmware.heartbeat(self, start_s).autopilot
        strangers = Strangers(parts.faults, home_e7=(home.x_e7, home.y_e7), autopilot=kind)
        self._beats = Beats(strangers, timesync_s=self.firmware.timesync_s, start_s=start_s)
        self._frozen: Pose | None = None
        self._update_outputs(start_s)

    # ------------------------------------------------------------------------------- peers

    def attach(self, name: str, send: Callable[[bytes], None]) -> Channel:
        """Take a new peer on; PX4 begins to stream at once."""
        channel = Channel(name, send, key=self.key)
        self.channels.append(channel)
        self._stream_defaults(channel, self._now_s)
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
            if self.script is not None:
                self.script.on_message(bytes(message.get_msgbuf()), now_s)
            if self.firmware.forwards:
                routing.forward(self, channel, message)
            handler = self.firmware.messages.get(message.get_type())
            if handler is not None and routing.is_for_us(self, message):
                handler(self, channel, message, now_s)
        actions.tell(self, now_s)

    # ------------------------------------------------------------------------------ speech

    def send(self, channel: Channel, message: Message) -> None:
        """Send a message of the autopilot to one peer."""
        mavlink1 = self.strikes(FaultKind.MAVLINK1, self._now_s) is not None
        signed = True if self.strikes(FaultKind.SIGNED, self._now_s) else None
        self.emit(channel, self._speaker.frame(message, mavlink1=mavlink1, signed=signed))

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

    def strikes(self, kind: FaultKind, now_s: float, *, command: int = 0) -> Fault | None:
        """Return the fault of a kind that is in force and strikes this time."""
        return self._impairment.strikes(kind, now_s, command=command)

    def acknowledge(
        self, channel: Channel, command: int, result: int, *, to: tuple[int, int], now_s: float
    ) -> None:
        """Answer a command, as far as the faults let the answer through."""
        self._acknowledgements.send(self, channel, (command, result), to=to, now_s=now_s)

    # ------------------------------------------------------------------------------- state

    def has(self, message_id: int, now_s: float) -> bool:
        """Return whether a message can be sent now."""
        known = message_id in self.firmware.builders
        return known and not self.firmware.withholds(self, message_id, now_s)

    def build(self, message_id: int, now_s: float) -> Message:
        """Return a message that can be asked for."""
        return self.firmware.builders[message_id](self, now_s)

    def boot_ms(self, now_s: float) -> int:
        """Return milliseconds since boot, 32 bits."""
        return self._impairment.boot_ms(self._uptime_s(now_s), now_s)

    def boot_ns(self, now_s: float) -> int:
        """Return nanoseconds since boot, the time of TIMESYNC."""
        return round(self._impairment.clock_s(self._uptime_s(now_s), now_s) * 1e9)

    def _uptime_s(self, now_s: float) -> float:
        return (now_s - self._boot_s) * self._clock_rate

    def sample_s(self, now_s: float) -> float:
        """Return when the estimate was made that is sent now."""
        step_s = self.firmware.position_step_s
        return now_s - (now_s - self._boot_s) % step_s if step_s > 0.0 else now_s

    def believed(self, now_s: float) -> Pose:
        """Return the estimated pose; frozen and at rest while the estimator is lost."""
        if self.faults.active(FaultKind.STALE_POSITION, now_s) is None:
            self._frozen = None
            return self._estimator.estimate(now_s)
        if self._frozen is None:
            self._frozen = self._estimator.frozen(now_s)
        return self._frozen

    def estimator_lost(self, now_s: float) -> bool:
        """Return whether the estimator says that it has no position."""
        kinds = (FaultKind.STALE_POSITION, FaultKind.EKF_LOST)
        return any(self.faults.active(kind, now_s) is not None for kind in kinds)

    def wire_sequence(self, sequence: int) -> int:
        """Return the number that an item of the flight has on the wire."""
        return max(sequence - self.firmware.first_item, 0)

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

    def set_output(self, channel: int, pulse_us: float) -> None:
        """Write to an output as a script does: past the rules of the commands."""
        self.outputs.write(channel, pulse_us, now_s=self._now_s)

    def reboot(self, now_s: float) -> None:
        """Start the clock again and forget streams and outputs; the twin flies on."""
        self._boot_s = now_s
        self.upload = None
        if self.queue is not None:
            self.queue.clear()
        self.outputs.reset(now_s)
        for channel in self.channels:
            channel.streams.clear()
            channel.parameters_left.clear()
            self._stream_defaults(channel, now_s)

    # -------------------------------------------------------------------------------- time

    def tick(self, now_s: float) -> None:
        """Do everything that is due at `now_s`."""
        self._now_s = now_s
        self._speaker.keep_time(now_s - self._start_s)
        self.flight.tick(now_s)
        if self.flight.in_air and self.faults.take_off_s is None:
            self.faults.take_off_s = now_s
        self._incidents.tick(self, now_s)
        if self.queue is not None:
            self.queue.run(now_s)
        actions.tell(self, now_s)
        self._update_outputs(now_s)
        self._run_script(now_s)
        mission.tick(self, now_s)
        self._beats.tick(self, now_s)
        self._acknowledgements.tick(self, now_s)
        for channel in list(self.channels):
            parameters.send_list(self, channel, now_s)
            self._stream(channel, now_s)

    def next_due_s(self) -> float:
        """Return when `tick` has something to send."""
        due_s = [self._beats.heartbeat_due_s, self._acknowledgements.next_due_s()]
        if self.queue is not None:
            due_s.append(self.queue.next_due_s())
        if self.script is not None:
            due_s.append(self._script_due_s)
        return min(due_s + [channel.next_due_s() for channel in self.channels])

    def _stream_defaults(self, channel: Channel, now_s: float) -> None:
        for message_id, rate_hz in self.firmware.default_rates_hz.items():
            channel.ask(message_id, 1.0 / rate_hz, now_s=now_s)

    def _stream(self, channel: Channel, now_s: float) -> None:
        slow = self.faults.active(FaultKind.SLOW_STREAMS, now_s)
        factor = slow.factor if slow is not None else 1.0
        if now_s < channel.busy_until_s:
            factor *= self.firmware.busy_factor
        for message_id in channel.due(now_s, slow_factor=factor):
            position = message_id == dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT
            if position and self.faults.active(FaultKind.NO_POSITION, now_s):
                continue
            if not self.has(message_id, now_s):
                continue
            self.send(channel, self.build(message_id, now_s))
            also = self.firmware.also.get(message_id)
            second = also(self, now_s) if also is not None else None
            if second is not None:
                self.send(channel, second)

    def _update_outputs(self, now_s: float) -> None:
        active = self.faults.active
        state = OutputState(
            armed=self.flight.armed,
            in_air=self.flight.in_air,
            safety_on=active(FaultKind.SAFETY_SWITCH, now_s) is not None,
            killed=active(FaultKind.KILL, now_s) is not None,
            terminated=active(FaultKind.TERMINATE, now_s) is not None,
            rc_us=rc_pulses_us(self.faults, now_s),
        )
        self.outputs.update(now_s, state)

    def _run_script(self, now_s: float) -> None:
        if self.script is not None and self._script_due_s <= now_s:
            self._script_due_s = max(self._script_due_s + SCRIPT_PERIOD_S, now_s)
            self.script.update(now_s)
