"""The stub as a whole: bytes of peers in, bytes out, at times that the caller gives.

No sockets and no clock in here; `server.py` brings both. What one firmware does otherwise than
the other stands in its `Firmware`.
"""

from __future__ import annotations

import heapq
import random
from collections.abc import Callable, Sequence
from itertools import count
from typing import Protocol

from sitl.stub import commands
from sitl.stub.ardupilot import write_servo
from sitl.stub.faults import Fault, FaultClock, FaultKind, rc_pulses_us
from sitl.stub.firmware import Parts, Upload
from sitl.stub.mission_items import AUTO, INFO, MissionItem
from sitl.stub.outputs import OutputState
from sitl.stub.protocol import (
    AUTOPILOT_COMPONENT,
    AUTOPILOT_SYSTEM,
    Channel,
    Message,
    Speaker,
    dialect,
    sender,
    target,
)
from sitl.stub.px4 import set_actuators
from sitl.stub.sprayer import Battery
from sitl.stub.streams import Strangers
from sitl.stub.world import Pose
from sitl.vehicle import MEAN_S, Leaning, leaning

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
        self.upload: Upload | None = None
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
                forward(self, channel, message)
            handler = self.firmware.messages.get(message.get_type())
            if handler is not None and is_for_us(self, message):
                handler(self, channel, message, now_s)
        self._tell_events(now_s)

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

    def received(self, now_s: float) -> Pose:
        """Return the receiver's last place, at its stamp."""
        is_lost = self.faults.active(FaultKind.STALE_POSITION, now_s) is not None
        return self.believed(now_s) if is_lost else self._estimator.fix(now_s)

    def leaning(self, now_s: float) -> Leaning:
        """Return how the copter truly leans, as its sensors have it."""
        world = self.flight.world
        return leaning(world.pose_at(now_s - MEAN_S), world.pose_at(now_s), MEAN_S)

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
        self._tell_events(now_s)
        self._update_outputs(now_s)
        self._run_script(now_s)
        commands.tick(self, now_s)
        self._beats.tick(self, now_s)
        self._acknowledgements.tick(self, now_s)
        for channel in list(self.channels):
            commands.send_parameters(self, channel, now_s)
            self._stream(channel, now_s)

    def next_due_s(self) -> float:
        """Return when `tick` has something to send."""
        due_s = [self._beats.heartbeat_due_s, self._acknowledgements.next_due_s()]
        if self.queue is not None:
            due_s.append(self.queue.next_due_s())
        if self.script is not None:
            due_s.append(self._script_due_s)
        return min(due_s + [channel.next_due_s() for channel in self.channels])

    def _tell_events(self, now_s: float) -> None:
        """Send what has happened since the last call, and do the mission's actions."""
        for event in self.flight.events:
            if event.text and (event.action is None or self.firmware.tells_of_actions):
                self.tell(event.text, severity=event.severity)
            if event.reached is not None:
                number = self.wire_sequence(event.reached)
                self.broadcast(dialect.MAVLink_mission_item_reached_message(number))
            if event.action is not None:
                self._do(event.action, now_s)
        self.flight.events.clear()

    def _do(self, item: MissionItem, now_s: float) -> None:
        if item.command == dialect.MAV_CMD_DO_SET_SERVO:
            write_servo(self, item.param1, item.param2, now_s)
        if item.command == dialect.MAV_CMD_DO_SET_ACTUATOR:
            # The fifth and sixth are whole numbers on the wire, for degrees of 1e-7 (PX4 #28723).
            last = (item.x_e7 * 1e-7, item.y_e7 * 1e-7, item.z_m)
            params = (item.param1, item.param2, item.param3, item.param4, *last)
            set_actuators(self, params, now_s)

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


# What comes by itself: heartbeats, requests of the clock, MISSION_CURRENT, strangers.

_HEARTBEAT_S = 1.0
_CURRENT_S = 10.0


class Beats:
    """Keeps what is due when."""

    def __init__(self, strangers: Strangers, *, timesync_s: float, start_s: float) -> None:
        self.heartbeat_due_s = start_s
        self._strangers = strangers
        self._timesync_s = timesync_s
        self._timesync_due_s = start_s + timesync_s
        # The last MISSION_CURRENT: of how many items which one, and when.
        self._current: tuple[int, int, float] = (0, -1, start_s)

    def tick(self, autopilot: Autopilot, now_s: float) -> None:
        """Send what is due."""
        if self.heartbeat_due_s <= now_s:
            self.heartbeat_due_s = max(self.heartbeat_due_s + _HEARTBEAT_S, now_s)
            autopilot.broadcast(autopilot.firmware.heartbeat(autopilot, now_s))
            for frame in self._strangers.heartbeats(now_s):
                autopilot.relay(frame)
        for frame in self._strangers.positions(now_s):
            autopilot.relay(frame)
        if self._timesync_due_s <= now_s:
            self._timesync_due_s = max(self._timesync_due_s + self._timesync_s, now_s)
            autopilot.broadcast(commands.timesync_request(autopilot, now_s))
        if dialect.MAVLINK_MSG_ID_MISSION_CURRENT not in autopilot.firmware.builders:
            self._tell_current(autopilot, now_s)

    def _tell_current(self, autopilot: Autopilot, now_s: float) -> None:
        """Send MISSION_CURRENT on a change and every ten seconds: here it is no stream."""
        count, sequence = len(autopilot.flight.items), autopilot.flight.sequence
        if (count, sequence) != self._current[:2] or now_s - self._current[2] >= _CURRENT_S:
            self._current = (count, sequence, now_s)
            autopilot.broadcast(commands.current(autopilot))


# COMMAND_ACK: once, late, twice, in two steps or not at all, as the faults will have it.


class Acknowledgements:
    """Sends them, and keeps those that come late."""

    def __init__(self) -> None:
        self._late: list[tuple[float, int, Channel, Message]] = []
        self._number = count()

    def send(
        self,
        autopilot: Autopilot,
        channel: Channel,
        answer: tuple[int, int],
        *,
        to: tuple[int, int],
        now_s: float,
    ) -> None:
        """Answer a command; `answer` is its number and the result."""
        command, result = answer
        message = dialect.MAVLink_command_ack_message(command, result, 0, 0, *to)
        if autopilot.strikes(FaultKind.ACK_LOST, now_s, command=command):
            return
        late = autopilot.strikes(FaultKind.ACK_LATE, now_s, command=command)
        if late is None:
            late = autopilot.strikes(FaultKind.ACK_IN_PROGRESS, now_s, command=command)
            if late is not None:
                begun = (command, dialect.MAV_RESULT_IN_PROGRESS, 0, 0, *to)
                autopilot.send(channel, dialect.MAVLink_command_ack_message(*begun))
        if late is not None:
            due_s = now_s + late.delay_s
            heapq.heappush(self._late, (due_s, next(self._number), channel, message))
            return
        autopilot.send(channel, message)
        if autopilot.strikes(FaultKind.ACK_DOUBLED, now_s, command=command):
            autopilot.send(channel, message)

    def tick(self, autopilot: Autopilot, now_s: float) -> None:
        """Send the late ones that are due."""
        while self._late and self._late[0][0] <= now_s:
            _, _, channel, message = heapq.heappop(self._late)
            autopilot.send(channel, message)

    def next_due_s(self) -> float:
        """Return when the next late one is due; infinite without one."""
        return self._late[0][0] if self._late else float("inf")


# What faults do to bytes, acknowledgements and the clock, with a seeded hand.

_WRAP_MS = 2**32

# The start bytes of MAVLink 2 and 1, so that garbage looks like frames that begin.
_STARTS = b"\xfd\xfe"
_UNKNOWN_IDS = (60_000, 2**24)


class Impairment:
    """Damages what the autopilot sends, as far as a fault is in force."""

    def __init__(self, faults: FaultClock, *, seed: int) -> None:
        self._faults = faults
        # Not for secrets: the same seed must give the same damage.
        self._random = random.Random(seed)

    def strikes(self, kind: FaultKind, now_s: float, *, command: int = 0) -> Fault | None:
        """Return the fault of a kind that is in force and strikes this time."""
        fault = self._faults.active(kind, now_s, command=command)
        if fault is None or self._random.random() >= fault.fraction:
            return None
        return fault

    def apply(self, frame: bytes, now_s: float) -> bytes:
        """Return what goes out in place of a frame; nothing while the link is silent."""
        if self._faults.active(FaultKind.SILENCE, now_s):
            return b""
        if self.strikes(FaultKind.CORRUPT, now_s):
            place = self._random.randrange(len(frame))
            changed = frame[place] ^ self._random.randrange(1, 256)
            frame = frame[:place] + bytes((changed,)) + frame[place + 1 :]
        if self.strikes(FaultKind.TRUNCATED, now_s):
            frame = frame[: self._random.randrange(1, len(frame))]
        if self.strikes(FaultKind.UNKNOWN_ID, now_s):
            frame = self._unknown() + frame
        if self.strikes(FaultKind.GARBAGE, now_s):
            burst = bytearray(self._random.randbytes(self._random.randrange(1, 280)))
            burst[self._random.randrange(len(burst))] = self._random.choice(_STARTS)
            frame = bytes(burst) + frame
        return frame

    def clock_s(self, uptime_s: float, now_s: float) -> float:
        """Return the time since boot, about to wrap or set back by a fault; TIMESYNC tells it."""
        wrap = self._faults.active(FaultKind.CLOCK_WRAP, now_s)
        if wrap is not None:
            uptime_s = _WRAP_MS / 1000.0 + self._faults.elapsed_s(wrap, now_s) - wrap.delay_s
        back = self._faults.active(FaultKind.CLOCK_BACKWARDS, now_s)
        return uptime_s if back is None else max(uptime_s - back.delay_s, 0.0)

    def boot_ms(self, uptime_s: float, now_s: float) -> int:
        """Return the 32 bits of milliseconds since boot that messages have."""
        return round(self.clock_s(uptime_s, now_s) * 1000.0) % _WRAP_MS

    def _unknown(self) -> bytes:
        """Return a frame with an id that no dialect has; nobody can check it."""
        payload = self._random.randbytes(self._random.randrange(1, 60))
        identifier = self._random.randrange(_UNKNOWN_IDS[0], _UNKNOWN_IDS[1]).to_bytes(3, "little")
        head = bytes((_STARTS[0], len(payload), 0, 0, self._random.randrange(256), 1, 1))
        return head + identifier + payload + self._random.randbytes(2)


# What happens once when a fault begins or ends, and what another ground station does meanwhile.


class Incidents:
    """Looks at each tick what has begun and what is over."""

    def __init__(self) -> None:
        self._in_force: set[FaultKind] = set()
        self._station_due_s = 0.0

    def tick(self, autopilot: Autopilot, now_s: float) -> None:
        """Do what is due."""
        if self._begins(autopilot, FaultKind.REBOOT, now_s):
            autopilot.reboot(now_s)
        if self._begins(autopilot, FaultKind.MODE, now_s):
            mode = autopilot.faults.active(FaultKind.MODE, now_s)
            if mode is not None:
                autopilot.flight.set_mode(mode.mode, now_s)
        if self._ends(autopilot, FaultKind.MODE, now_s):
            autopilot.flight.set_mode(AUTO, now_s)
        self._overwrite_rates(autopilot, now_s)

    def _begins(self, autopilot: Autopilot, kind: FaultKind, now_s: float) -> bool:
        if kind in self._in_force or autopilot.faults.active(kind, now_s) is None:
            return False
        self._in_force.add(kind)
        return True

    def _ends(self, autopilot: Autopilot, kind: FaultKind, now_s: float) -> bool:
        if kind not in self._in_force or autopilot.faults.active(kind, now_s) is not None:
            return False
        self._in_force.discard(kind)
        return True

    def _overwrite_rates(self, autopilot: Autopilot, now_s: float) -> None:
        """Set all rates again and again, as ground stations do on a link they share.

        On ArduPilot by REQUEST_DATA_STREAM for all groups; on PX4, which has none, message by
        message.
        """
        fault = autopilot.faults.active(FaultKind.STATION_RATES, now_s)
        if fault is None or now_s < self._station_due_s:
            return
        self._station_due_s = now_s + max(fault.delay_s, 0.1)
        grouped = {number for group in autopilot.firmware.groups.values() for number in group}
        interval_s = 1.0 / fault.rate_hz if fault.rate_hz > 0.0 else None
        for channel in autopilot.channels:
            for message_id in grouped | set(channel.streams):
                channel.ask(message_id, interval_s, now_s=now_s)


# Which messages are for the autopilot, and which it passes on to other peers.


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


# A script that runs in the flight controller, such as a watchdog of the valves in Lua.
#
# The stub calls it as ArduPilot's scheduler would; what the script orders goes to the outputs past
# every rule of DO_SET_SERVO, as `SRV_Channels:set_output_pwm_chan` does.

SCRIPT_PERIOD_S = 0.02


class Script(Protocol):
    """What a script has to offer; it gets `Autopilot.set_output` from whoever makes it."""

    def on_message(self, raw: bytes, now_s: float) -> None:
        """Take a frame in that arrived from a peer, as it was on the wire."""

    def update(self, now_s: float) -> None:
        """Do what is due; called every 20 ms."""
