"""A well-behaved MAVLink component: answers, asks for its streams, speaks when it is due.

No I/O: bytes and times come in, bytes go out through `send`, which says whether they left.
"""

from __future__ import annotations

import math
import secrets
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeGuard, get_args

from companion.core.inputs import MISSION_MODES
from companion.core.positions import (
    AHEAD_MAX_S,
    BOOT_WRAP_S,
    Arrival,
    PositionStream,
    noted,
    sorted_in,
)
from companion.core.types import (
    AttitudeReport,
    ClockReport,
    Decision,
    DeclarationReport,
    HeartbeatReport,
    ImuReport,
    Input,
    LandedReport,
    LegReport,
    RcReport,
    Telemetry,
    WindReport,
)
from companion.link.announcer import Announcer
from companion.link.codec import Codec
from companion.link.encode import Encoder
from companion.link.intake import Source
from companion.link.messages import (
    AckReceived,
    CommandReceived,
    Message,
    MissionCurrent,
    MissionTransfer,
    ParamAsked,
    ParamSet,
    ParamValue,
    PingReceived,
    ServoOutput,
    Tank,
    TimesyncReceived,
)
from companion.link.outputs import ORDERS, Outputs
from companion.link.parameters import Parameters
from companion.link.service import (
    REQUEST_MESSAGE,
    SET_MESSAGE_INTERVAL,
    Answer,
    CommandState,
    OnEvent,
    Service,
)
from companion.link.simulation import SimulationWatch
from companion.link.streams import Meter, Stream, StreamRequest, StreamSupervisor, wanted_streams
from companion.simulated import SIMULATED

if TYPE_CHECKING:
    from companion.link.mission_reader import MissionReader
    from companion.link.signing import Signing

_POSITION = 33
# How often the time is asked for, in seconds; where answers are slow, bytes are dear.
_TIMESYNC_S, _TIMESYNC_SLOW_S, _QUICK_S = 0.2, 1.0, 0.05
_INPUTS = get_args(Input)


@dataclass(frozen=True, slots=True, kw_only=True)
class ComponentOptions:
    """Who we are on the link, what we want to know how often, and the ends of the pulses.

    `need_mission`: all stays closed where the mission is flown and its leg is not known.
    `may_enable`: a command may enable; `page_may_enable`: so may the operator's page. Both may
    always stop. `width_m` is the boom's, for the rate that is told.
    """

    system_id: int = 0
    component_id: int = 191
    position_rate_hz: float = 20.0
    version: tuple[int, int, int] = (0, 1, 0)
    closed_us: int = 1000
    full_us: int = 2000
    use_mission: bool = False
    need_mission: bool = False
    use_battery: bool = False
    use_switch: bool = True
    use_imu: bool = False
    watch_mission: bool = False
    may_enable: bool = True
    page_may_enable: bool = False
    training: str = ""
    width_m: float | None = None


class Component:
    """One component on one link to one vehicle."""

    def __init__(
        self,
        options: ComponentOptions,
        send: Callable[[bytes], bool],
        *,
        parameters: Parameters | None = None,
        signing: Signing | None = None,
    ) -> None:
        self._options = options
        self._transport_send = send
        self._signing = signing
        self._has_begun = False
        self._encoder = Encoder(
            system_id=options.system_id or 1, component_id=options.component_id, signing=signing
        )
        accept = None if signing is None else signing.accepts
        self.codec = Codec(system_id=options.system_id, accept=accept)
        self.meter = Meter()
        self.outputs = Outputs(
            self._encoder, self._send, closed_us=options.closed_us, full_us=options.full_us
        )
        self._announcer = Announcer(
            self._encoder, training=options.training, width_m=options.width_m
        )
        self._command_state = CommandState(
            parameters=parameters if parameters is not None else Parameters(),
            tank=Tank(),
            may_enable=options.may_enable,
            page_may_enable=options.page_may_enable,
            signing=signing,
        )
        self._service = Service(
            self._command_state, self._encoder, self._announcer, self._send, version=options.version
        )
        self._mission = self._mission_reader()
        self._wind = WindWatch()
        self.simulation = SimulationWatch()
        self._flies_mission = False
        self._supervisor: StreamSupervisor | None = None
        self.streams: tuple[Stream, ...] = ()
        self._order = PositionStream()
        self._news = News()
        self.clock = ClockExchanges()
        self._timesync_s = float("-inf")
        self.met_s: float | None = None
        self.is_answered = False
        self.mission_active: bool | None = None
        self.on_order_ack: Callable[[int], None] | None = None
        self.on_valid: Callable[[bool], None] | None = None

    @property
    def on_event(self) -> OnEvent | None:
        """Return who is told what happens: `on_event(at_s, kind, text)`."""
        return self._service.on_event

    @on_event.setter
    def on_event(self, take: OnEvent | None) -> None:
        self._service.on_event = take

    @property
    def on_refilled(self) -> Callable[[float], bool] | None:
        """Return who is told of a filling in litres, and says whether it can be one."""
        return self._command_state.on_refilled

    @on_refilled.setter
    def on_refilled(self, take: Callable[[float], bool] | None) -> None:
        self._command_state.on_refilled = take

    @property
    def is_vehicle_known(self) -> bool:
        """Whether an autopilot has been heard."""
        return self.codec.vehicle is not None

    @property
    def tank_l(self) -> float | None:
        """Return what is left in the tank, counted down from the last filling that was told."""
        return self._command_state.tank.level_l

    @property
    def address(self) -> tuple[int, int]:
        """Return system and component that we speak as."""
        return (self._encoder.system_id, self._encoder.component_id)

    @property
    def position_rate_hz(self) -> float | None:
        """Return the rate at which positions come; None where it is too early to say."""
        return None if self._supervisor is None else self._supervisor.rate_hz(_POSITION)

    def order(self, channel: int, pulse_us: int) -> bool:
        """PositionStream a servo output; False where nobody is there to take it."""
        return self.outputs.order(channel, pulse_us)

    def obey_page(self, name: str, value: float | None, received_s: float) -> Answer:
        """Carry out an order of the operator's page."""
        return self._service.obey_page(name, value, received_s)

    def declare(self, report: DeclarationReport) -> Answer:
        """Take what the operator declared on the page."""
        return self._service.declare(report)

    def fault(self, text: str) -> None:
        """Tell the operator once of something that does not work."""
        self._announcer.fault(text)

    def note(self, text: str) -> None:
        """Tell the operator of something that is as it should be."""
        self._announcer.note(text)

    def warn(self, text: str) -> None:
        """Tell the operator of something that should be seen to."""
        self._announcer.note(text, is_warning=True)

    def receive(self, data: bytes, received_s: float, source: Source | None = None) -> list[Input]:
        """Return the inputs in `data`, and answer what wants an answer."""
        inputs: list[Input] = []
        if not self._has_begun:
            self._has_begun = True
            inputs += self._command_state.begin(received_s)
        for message in self._heard(data, received_s, source):
            if self._supervisor is None and self.is_vehicle_known:
                self._meet(received_s)
            if self._is_ignored(message):
                continue
            if _is_input(message):
                self._look_at(message)
                inputs.append(self._wind.take(message))
            elif isinstance(message, CommandReceived):
                inputs.extend(self._service.obey(message))
            elif isinstance(message, ParamAsked | ParamSet):
                inputs.extend(self._service.serve(message))
            elif isinstance(message, MissionCurrent | MissionTransfer):
                inputs.extend(self._take_mission(message))
            else:
                self._answer(message)
        for report in self.clock.take_reports():
            self._order = noted(self._order, report)
            inputs.append(report)
        return inputs

    def _heard(self, data: bytes, received_s: float, source: Source | None) -> Iterator[Message]:
        """Yield what is news, one after the other, and say that something valid came."""
        codec = self.codec
        before = (codec.named_frame_count, codec.vehicle_frame_count)
        messages = codec.decode(data, received_s, source)
        if self.on_valid is not None and codec.named_frame_count > before[0]:
            self.on_valid(codec.vehicle_frame_count > before[1])
        for message in messages:
            if not self._news.is_old(message, self._order):
                yield message

    def tick(self, decision: Decision | None, now_s: float) -> None:
        """Send what is due; called at every step of the control loop, at least at 20 Hz."""
        self._service.look_at(decision, now_s)
        for frame in self._announcer.due(decision, now_s):
            self._send(frame)
        self._service.tick(now_s)
        self.outputs.tick(now_s)
        if self._mission is not None:
            self._mission.tick(
                now_s, is_armed=self._command_state.is_armed, flies_mission=self._flies_mission
            )
        self._ask_what_it_is(now_s)
        if self._supervisor is None:
            return
        for request in self._supervisor.due(self.codec.vehicle_counts, now_s):
            self._ask(request)
        trouble = self._supervisor.trouble()
        if trouble is not None:
            self.warn(trouble)
            self._service.tell_event(now_s, "streams", trouble)
        round_trip_s = self.clock.round_trip_s
        is_quick = round_trip_s is not None and round_trip_s <= _QUICK_S
        if now_s - self._timesync_s >= (_TIMESYNC_S if is_quick else _TIMESYNC_SLOW_S):
            self._timesync_s = now_s
            self._send(self._encoder.timesync(0, self._ask_time(now_s)))

    def starting(self, is_starting: bool) -> None:
        """Take whether nobody decides yet: then nobody can enable."""
        self._command_state.is_starting = is_starting

    def link_changed(self, now_s: float) -> None:
        """Ask for the streams anew: whoever answers now may not have heard us before."""
        if self.is_vehicle_known:
            self._meet(now_s)

    # ------------------------------------------------------------------------------- inside

    def _is_ignored(self, message: Message) -> bool:
        """Return whether it is for another station, or a switch whose edge may be of before."""
        if isinstance(message, RcReport):
            return self._signing is not None and not self._signing.is_fresh
        return isinstance(message, AttitudeReport | ImuReport) and not self._options.use_imu

    def _ask_time(self, now_s: float) -> int:
        """Return the number of a question of the time; signed, one that nobody can foresee."""
        if self._signing is None:
            return self.clock.ask(now_s)
        number = self.clock.ask(now_s, secrets.randbits(62))
        self._signing.asked(number)
        return number

    def _mission_reader(self) -> MissionReader | None:
        """Return what reads the mission; where no mission is used, nothing of it is loaded."""
        if not self._options.use_mission:
            return None
        from companion.link.mission_reader import MissionReader

        return MissionReader(
            self._encoder,
            self._send,
            self.warn,
            is_used=True,
            is_needed=self._options.need_mission,
        )

    def _ask_what_it_is(self, now_s: float) -> None:
        """Ask whether the vehicle is simulated, and have it in the record when that is known."""
        is_armed = self._command_state.is_armed
        name = None if is_armed else self.simulation.next_name(now_s)
        if name is not None:
            self._send(self._encoder.param_request_read(name))
        found = self.simulation.news(self.codec.vehicle_counts, is_armed=is_armed)
        if found is not None:
            self._service.tell_event(now_s, SIMULATED, found.text)

    def _send(self, frame: bytes) -> bool:
        has_left = self._transport_send(frame)
        self._announcer.is_reached |= has_left
        self.meter.sent(len(frame), has_left=has_left)
        return has_left

    def _meet(self, now_s: float) -> None:
        """Take the vehicle's system for ours and ask it for its streams."""
        vehicle = self.codec.vehicle
        if vehicle is None:
            return
        self._encoder.system_id = vehicle.system_id
        self.outputs.meet(vehicle)
        self.simulation.meet(vehicle)
        if self._mission is not None:
            self._mission.meet(vehicle.system_id, is_streamed=not vehicle.is_px4)
        self.met_s, self.is_answered = now_s, False
        self.mission_active = None
        if self._options.training:
            self.note(f"training: {self._options.training}")
        if self._supervisor is None:
            self._supervisor = StreamSupervisor(may_group=vehicle.is_ardupilot)
        self.streams = wanted_streams(
            position_rate_hz=self._options.position_rate_hz,
            is_px4=vehicle.is_px4,
            with_mission=self._options.use_mission or self._options.watch_mission,
            with_battery=self._options.use_battery,
            with_switch=self._options.use_switch,
            with_imu=self._options.use_imu,
        )
        for request in self._supervisor.start(self.streams, now_s):
            self._ask(request)

    def _ask(self, request: StreamRequest) -> None:
        stream = request.stream
        if request.by_group:
            self._send(self._encoder.request_data_stream(stream.group, stream.rate_hz))
        else:
            self._send(self._encoder.set_message_interval(stream.message_id, stream.rate_hz))

    def _look_at(self, item: Input) -> None:
        """Take from an input what the link itself has to know of it."""
        if isinstance(item, HeartbeatReport):
            self._command_state.is_armed = item.armed
            self._flies_mission = item.mode in MISSION_MODES
            self.outputs.armed(item.armed)
            self.simulation.heartbeat(is_hil=self.codec.is_hil)
        if isinstance(item, Telemetry):
            self._watch_boot(item)
        else:
            self._order = noted(self._order, item)

    def _watch_boot(self, item: Telemetry) -> None:
        """Notice a reboot, after which an autopilot has forgotten what was asked of it."""
        self._order, place = sorted_in(self._order, item)
        if place is Arrival.ANEW:
            self._meet(item.received_s)
            self._news.begin_anew(item.received_s)
        elif place is Arrival.AGAIN and self.meter.copied(item.received_s):
            self.warn("positions arrive twice or late")
            text = (
                f"{self.meter.copied_positions} positions came twice or too late and were dropped"
            )
            self._service.tell_event(item.received_s, "link", f"{text}: two radios, or a loop?")

    def _answer(self, message: Message) -> None:
        if isinstance(message, AckReceived):
            self._take_ack(message)
        elif isinstance(message, TimesyncReceived):
            self._take_timesync(message)
        elif isinstance(message, PingReceived):
            self._take_ping(message)
        elif isinstance(message, ServoOutput):
            self.outputs.report(message)
        elif isinstance(message, ParamValue):
            self.outputs.parameter(message)
            self.simulation.parameter(message)

    def _take_mission(self, message: MissionCurrent | MissionTransfer) -> tuple[LegReport, ...]:
        if isinstance(message, MissionCurrent):
            self.mission_active = message.is_active
        return () if self._mission is None else self._mission.take(message)

    def _take_ack(self, ack: AckReceived) -> None:
        # 0, 0 is an acknowledgement in the old form, which named nobody.
        if (ack.target_system, ack.target_component) not in (self.address, (0, 0)):
            return
        self.is_answered = True
        if ack.command in ORDERS and self.on_order_ack is not None:
            self.on_order_ack(ack.result)
        elif ack.command == SET_MESSAGE_INTERVAL and self._supervisor is not None:
            self._supervisor.answered(ack.result, ack.received_s)
        elif ack.command == REQUEST_MESSAGE and self._mission is not None:
            self._mission.answered(ack.result)

    def _take_timesync(self, message: TimesyncReceived) -> None:
        if message.tc1_ns == 0:
            now_ns = round(message.received_s * 1e9)
            self._send(self._encoder.timesync(now_ns, message.ts1_ns))
            return
        if self.codec.is_autopilot(message.sender.system_id, message.sender.component_id):
            self.clock.answer(message.tc1_ns, message.ts1_ns, message.received_s)
            self.is_answered = self.is_answered or self.clock.is_known

    def _take_ping(self, ping: PingReceived) -> None:
        if (ping.target_system, ping.target_component) == (0, 0):
            sender = ping.sender
            self._send(
                self._encoder.ping(
                    ping.time_us, ping.sequence, sender.system_id, sender.component_id
                )
            )


def _is_input(message: Message) -> TypeGuard[Input]:
    return isinstance(message, _INPUTS)


# What the vehicle says of its switches and outputs, if it is no older than what it said before.
#
# Where the autopilot's messages come twice or late (two radios, a router's loop), an old pulse of
# the pilot's switch would enable again after he has stopped, and an old output would look like a
# fault. Both carry the autopilot's time since boot; the positions tell what that is by now.

# SERVO_OUTPUT_RAW counts microseconds in 32 bits, which begin anew after 72 minutes.
_MICROS_WRAP_S = 2**32 / 1e6
# For so long after a restart something of before it may still come.
_LATE_MAX_S = 30.0


class News:
    """Remembers how new the last message of each kind was."""

    def __init__(self) -> None:
        self._newest: dict[str, float] = {}
        self._wary_until_s = -math.inf

    def begin_anew(self, now_s: float) -> None:
        """Forget it: the autopilot's clock has begun anew."""
        self._newest.clear()
        self._wary_until_s = now_s + _LATE_MAX_S

    def is_old(self, message: Message, order: PositionStream) -> bool:
        """Return whether something newer is known; what has no time is as new as it comes.

        After a restart what is ahead of the positions is of the clock before it.
        """
        if not isinstance(message, RcReport | ServoOutput) or message.boot_s is None:
            return False
        boot_s = message.boot_s
        kind, wrap_s = "rc", BOOT_WRAP_S
        if isinstance(message, ServoOutput):
            kind, wrap_s = f"port {message.port}", _MICROS_WRAP_S
        if order.boot_s is not None and message.received_s < self._wary_until_s:
            now_s = order.boot_s + message.received_s - order.received_s
            if math.remainder(boot_s - now_s, wrap_s) > AHEAD_MAX_S:
                return True
        newest_s = self._newest.get(kind)
        if newest_s is not None and math.remainder(boot_s - newest_s, wrap_s) < 0.0:
            return True
        self._newest[kind] = boot_s
        return False


# Whether a wind that the autopilot tells is an estimate; one that never moves is none.
#
# ArduCopter sends WIND with exactly 0 while it estimates no wind, whatever blows, and an estimator
# that has stopped goes on telling its last number. A real estimate changes with every message.

# Asked for twice a second; a link that is slowed to a quarter still shows five reports in this.
STILL_MAX_S = 10.0


class WindWatch:
    """Looks at all inputs; hands on each wind, as not known where it cannot be an estimate."""

    def __init__(self) -> None:
        self._in_air = False
        self._last: tuple[float | None, float | None, float | None] | None = None
        self._moved_s = -math.inf

    def take(self, item: Input) -> Input:
        """Return the input; a wind that is no estimate without its numbers."""
        if isinstance(item, LandedReport):
            self._in_air = item.in_air is True
        if not isinstance(item, WindReport) or item.speed_m_s is None:
            return item
        told = (item.speed_m_s, item.east_m_s, item.north_m_s)
        if told != self._last:
            self._last, self._moved_s = told, item.received_s
        stands_still = self._in_air and not item.received_s - self._moved_s <= STILL_MAX_S
        if item.speed_m_s == 0.0 or stands_still:
            return replace(item, speed_m_s=None, east_m_s=None, north_m_s=None)
        return item


# Questions of the time and their answers: how far the autopilot's clock is from ours.
#
# TIMESYNC (mavlink.io/en/services/timesync.html): we send our time, the answer brings it back with
# the autopilot's. An exchange is wrong by at most half of its round trip, where one direction takes
# all of the time. What follows from many of them is the core's to say (`companion/core/clock.py`).

_KEPT = 60


class ClockExchanges:
    """Matches answers with questions, and keeps how quick the last ones were."""

    def __init__(self) -> None:
        self._asked_ns: deque[tuple[int, int]] = deque(maxlen=8)
        self._round_trips_s: deque[float] = deque(maxlen=_KEPT)
        self._news: list[ClockReport] = []

    def ask(self, now_s: float, number: int | None = None) -> int:
        """Return the number that the answer will bring back; if none is given, the time."""
        asked_ns = round(now_s * 1e9)
        self._asked_ns.append((asked_ns if number is None else number, asked_ns))
        return self._asked_ns[-1][0]

    def answer(self, tc1_ns: int, number: int, received_s: float) -> None:
        """Take an answer; one to somebody else's question is ignored."""
        asked_ns = dict(self._asked_ns).get(number)
        if asked_ns is None:
            return
        self._asked_ns.remove((number, asked_ns))
        asked_s = asked_ns * 1e-9
        round_trip_s = received_s - asked_s
        if not round_trip_s >= 0.0:
            return
        offset_s = 0.5 * (asked_s + received_s) - tc1_ns * 1e-9
        self._round_trips_s.append(round_trip_s)
        self._news.append(
            ClockReport(received_s=received_s, offset_s=offset_s, round_trip_s=round_trip_s)
        )

    def take_reports(self) -> list[ClockReport]:
        """Return every exchange once: inputs of the core."""
        news, self._news = self._news, []
        return news

    @property
    def is_known(self) -> bool:
        """Whether the autopilot has answered at all."""
        return bool(self._round_trips_s)

    @property
    def round_trip_s(self) -> float | None:
        """Return the quickest round trip of late."""
        return min(self._round_trips_s, default=None)
