"""What others ask of us: commands and parameters, each answered; for the component on one link."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from companion.core.types import (
    Decision,
    DeclarationReport,
    EstopReport,
    Input,
    OperatorCommand,
    RateOverride,
)
from companion.link.announcer import Announcer
from companion.link.encode import REAL32, Encoder
from companion.link.messages import CommandReceived, ParamAsked, ParamSet, Sender, Tank
from companion.link.parameters import RATE_PERCENT, TANK_L, VALUES_HZ, Parameters

if TYPE_CHECKING:
    from companion.link.signing import Signing

# ----------------------------------------------------------------------------------------- commands

DO_SPRAYER = 216
PREFLIGHT_REBOOT_SHUTDOWN = 246
GET_MESSAGE_INTERVAL = 510
SET_MESSAGE_INTERVAL = 511
REQUEST_MESSAGE = 512
REQUEST_CAPABILITIES = 520
USER_RATE, USER_REFILLED, USER_NEXT_MAP = 31010, 31011, 31012
USER_ESTOP = 31014
# The orders of the operator's page, as commands and their first parameter.
PAGE_ORDERS: dict[str, tuple[int, float | None]] = {
    "stop": (USER_ESTOP, None),
    "enable": (DO_SPRAYER, 1.0),
    "disable": (DO_SPRAYER, 0.0),
    "refilled": (USER_REFILLED, None),
}
# MAV_RESULT
ACCEPTED, REJECTED_FOR_NOW, DENIED, UNSUPPORTED = 0, 1, 2, 3

HEARTBEAT, PARAM_VALUE, AUTOPILOT_VERSION, NAMED_VALUE_FLOAT, STATUSTEXT = 0, 22, 148, 251, 253
OWN_MESSAGES = frozenset({HEARTBEAT, PARAM_VALUE, AUTOPILOT_VERSION, NAMED_VALUE_FLOAT, STATUSTEXT})
VALUES_HZ_MIN, VALUES_HZ_MAX = 0.2, 5.0
# An ENABLE that was sent before a stop must not enable after it. Stations retransmit a command for
# some seconds (QGroundControl 3 times, 3 s apart); a second radio or a router is some seconds late.
REPEATED_MAX_S = 30.0
LATE_MAX_S = 5.0
# A COMMAND_INT that is repeated does not say so: for so long after a stop none enables.
UNTOLD_MAX_S = 10.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """What comes of a command: its result, inputs for the core, a text, messages to send."""

    result: int
    inputs: tuple[Input, ...] = ()
    text: str | None = None
    event: str | None = None
    send: int | None = None
    send_index: int = 0
    interval_of: int | None = None


@dataclass(slots=True, kw_only=True)
class CommandState:
    """What commands look at and change."""

    parameters: Parameters
    tank: Tank
    values_hz: float = 1.0
    is_armed: bool = False
    is_open: bool = False
    is_starting: bool = False
    may_enable: bool = True  # a command may; below, the page may
    page_may_enable: bool = False
    is_enabled: bool = False
    # How often a stop was commanded since the last release; only the first changes anything.
    stops: int = 0
    # When the consent last went, by whatever took it; None: it was given anew since.
    stopped_s: float | None = None
    # Whether a stop was commanded, in this run or before, and not ended by a DISABLE.
    is_stopped: bool = False
    # Who gave the last ENABLE, and its frame's number.
    enabled_by: tuple[Sender, int] | None = None
    # The sensor that counts the tank, where there is one; whether it takes this many litres.
    on_refilled: Callable[[float], bool] | None = None
    # Of a signed link: what says whether an order to open may be one of before this start.
    signing: Signing | None = None

    def look_at(self, decision: Decision | None, now_s: float) -> None:
        """Take what was decided: whether a valve is open, and whether the operator's consent went.

        The pilot, a switch or a disarming take it as a stop does.
        """
        self.is_open = decision is not None and not decision.plan.is_off
        state = None if decision is None else decision.state
        is_enabled = state is not None and state.enabled
        if self.is_enabled and not is_enabled:
            self.stopped_s = now_s
        self.is_enabled = is_enabled
        if state is None or state.estop is not True:
            self.stops = 0
        if not self.is_open:  # the disk is not waited for before all is closed
            self.parameters.keep_stop(self.is_stopped)

    def begin(self, now_s: float) -> list[Input]:
        """Take that a run begins; return the stop that was commanded before it and not ended."""
        self.is_stopped = self.parameters.is_stopped
        stop = EstopReport(received_s=now_s, pressed=True, source="command")
        return [stop] if self.is_stopped else []

    def is_old(self, command: CommandReceived) -> bool:
        """Return whether an ENABLE may have been sent before the last stop."""
        if self.stopped_s is None:
            return False
        since_s = command.received_s - self.stopped_s
        if command.confirmation is None and since_s < UNTOLD_MAX_S:
            return True
        if (command.confirmation or 0) > 0 and since_s < REPEATED_MAX_S:
            return True
        is_copy = (command.sender, command.sequence) == self.enabled_by
        return command.is_late and since_s < (REPEATED_MAX_S if is_copy else LATE_MAX_S)

    def obey(self, command: CommandReceived) -> Answer:
        """Return the answer; whatever we do not know is unsupported."""
        handler = _HANDLERS.get(command.command)
        return Answer(result=UNSUPPORTED) if handler is None else handler(self, command)


def stops(command: CommandReceived) -> bool:
    """Return whether a command only closes: such a one may be said to everyone."""
    return command.command == USER_ESTOP or (command.command == DO_SPRAYER and command.param1 == 0)


def _sprayer(command_state: CommandState, command: CommandReceived) -> Answer:
    """Take the operator's wish: exactly 1 enables, exactly 0 disables."""
    if command.param1 not in (0.0, 1.0):
        return Answer(result=DENIED, text="DO_SPRAYER takes 0 or 1")
    enable = command.param1 == 1.0
    answer = _without_enabling(command_state, command) if enable else None
    if answer is not None:
        return answer
    command_state.stopped_s = None if enable else command.received_s
    command_state.is_stopped = enable and command_state.is_stopped
    if enable:
        command_state.enabled_by = (command.sender, command.sequence)
    wish = OperatorCommand(received_s=command.received_s, enable=enable, source=command.source)
    event = None
    if not enable:
        event, command_state.stops = _repeated(command_state), 0
    return Answer(result=ACCEPTED, inputs=(wish,), event=event)


def _without_enabling(command_state: CommandState, command: CommandReceived) -> Answer | None:
    """Return the answer to an ENABLE that enables nothing; None for one to obey."""
    if command.source == "web" and not command_state.page_may_enable:
        return Answer(result=DENIED, text="enable by page: see safety.enable_by")
    if command.source == "command" and not command_state.may_enable:
        return Answer(result=DENIED, text="enable by command: see safety.enable_by")
    if command.target_system == 0:
        return Answer(result=DENIED, text="enable: name this vehicle's system, not 0")
    if command_state.is_starting or command_state.is_old(command):
        when = "starting:" if command_state.is_starting else "late"
        return Answer(result=REJECTED_FOR_NOW, text=f"{when} enable not taken: enable again")
    if command_state.signing is None or command.source != "command":
        return None
    return _unless_admitted(command_state, command_state.signing)


def _unless_admitted(command_state: CommandState, signing: Signing) -> Answer | None:
    """Return the answer to a signed ENABLE that changes nothing, or must not; None to obey it.

    The disk is not waited for while a valve may be open: consent that is there stays, and one that
    was just taken back is given anew once all is closed.
    """
    if command_state.is_enabled and command_state.stopped_s is None:
        signing.keep_soon()
        return Answer(result=ACCEPTED)
    refusal = "closing: enable again" if command_state.is_open else signing.admit()
    return None if refusal is None else Answer(result=REJECTED_FOR_NOW, text=refusal)


def _estop(command_state: CommandState, command: CommandReceived) -> Answer:
    """Take an emergency stop, whatever its parameters: DO_SPRAYER 0 ends it.

    Anybody may stop, as often as he likes: what is stopped already is only counted.
    """
    command_state.stopped_s, command_state.is_stopped = command.received_s, True
    command_state.stops += 1
    if command_state.stops > 1:
        is_told = str(command_state.stops).strip("0") == "1"
        return Answer(result=ACCEPTED, event=_repeated(command_state) if is_told else None)
    stop = EstopReport(received_s=command.received_s, pressed=True, source="command")
    return Answer(result=ACCEPTED, inputs=(stop,), text="emergency stop", event="emergency stop")


def _repeated(command_state: CommandState) -> str | None:
    times = command_state.stops
    return f"emergency stop, {times} times" if times > 1 else None


def rate_override(command_state: CommandState, percent: float | None, received_s: float) -> Answer:
    """Take another percentage of the prescribed rates, by command or by parameter."""
    refusal = command_state.parameters.set(RATE_PERCENT, percent, is_frozen=False)
    if refusal is not None:
        return Answer(result=DENIED, text=f"rate override: {refusal}")
    taken = command_state.parameters.get(RATE_PERCENT, 100.0)
    return Answer(
        result=ACCEPTED,
        inputs=(RateOverride(received_s=received_s, percent=taken),),
        text=f"rate {taken:g} %",
        event=f"rate override {taken:g} %",
    )


def _user_rate(command_state: CommandState, command: CommandReceived) -> Answer:
    if command_state.parameters.index(RATE_PERCENT) is None:
        return Answer(result=UNSUPPORTED)
    return rate_override(command_state, command.param1, command.received_s)


def _refilled(command_state: CommandState, command: CommandReceived) -> Answer:
    if command_state.is_open:
        return Answer(result=REJECTED_FOR_NOW, text="refilled: stop spraying first")
    before_l = command_state.tank.level_l
    if not command_state.tank.filled(command.param1):
        most_l = command_state.tank.capacity_l
        advice = "give litres" if most_l is None else f"0 to {most_l:g} L"
        return Answer(result=DENIED, text=f"refilled: {advice}")
    level_l = command_state.tank.level_l
    if (
        level_l is not None
        and command_state.on_refilled is not None
        and not command_state.on_refilled(level_l)
    ):
        command_state.tank.level_l = before_l
        return Answer(result=DENIED, text="refilled: more than tank.capacity_l")
    text = f"tank {command_state.tank.level_l:g} L"
    return Answer(result=ACCEPTED, text=text, event=f"refilled, {text}")


def declared(command_state: CommandState, report: DeclarationReport) -> Answer:
    """Take what the operator observed: on the ground only, where somebody can look again."""
    if command_state.is_armed or command_state.is_open:
        return Answer(result=REJECTED_FOR_NOW, text="declare: land and disarm first")
    # Where nothing is limited nothing is kept either: it is for the record.
    text = f"declared, not kept: {len(report.broken)}" if report.broken else "declared"
    return Answer(
        result=ACCEPTED, inputs=(report,), text=text, event=f"declared by page: {report.said}"
    )


def _next_map(command_state: CommandState, _command: CommandReceived) -> Answer:
    if command_state.is_armed or command_state.is_open:
        return Answer(result=DENIED, text="next map: disarm first")
    return Answer(result=DENIED, text="next map: there is only one")


def _reboot(_command_state: CommandState, _command: CommandReceived) -> Answer:
    return Answer(result=DENIED, text="no reboot by MAVLink")


def _request_message(command_state: CommandState, command: CommandReceived) -> Answer:
    if command.param1 is None or command.param1 not in OWN_MESSAGES:
        return Answer(result=UNSUPPORTED)
    number = command.param2
    index = int(number) if number is not None and 0 <= number < 1e4 else -1
    if command.param1 == PARAM_VALUE and command_state.parameters.at(index) is None:
        return Answer(result=DENIED)
    return Answer(result=ACCEPTED, send=int(command.param1), send_index=index)


def _version(_command_state: CommandState, _command: CommandReceived) -> Answer:
    return Answer(result=ACCEPTED, send=AUTOPILOT_VERSION)


def _set_interval(command_state: CommandState, command: CommandReceived) -> Answer:
    """Set how often our values are told; the signs of life are nobody's to change."""
    if command.param1 == HEARTBEAT:
        return Answer(result=DENIED, text="our heartbeat is 1 Hz")
    if command.param1 != NAMED_VALUE_FLOAT:
        return Answer(result=UNSUPPORTED)
    interval_us = command.param2
    if interval_us == 0.0:
        command_state.values_hz = command_state.parameters.get(VALUES_HZ, 1.0)
        return Answer(result=ACCEPTED)
    # -1, which switches a message off, is refused: another station may be looking.
    if interval_us is None or not 1e6 / VALUES_HZ_MAX <= interval_us <= 1e6 / VALUES_HZ_MIN:
        return Answer(result=DENIED, text=f"values: {VALUES_HZ_MIN:g} to {VALUES_HZ_MAX:g} Hz")
    command_state.values_hz = 1e6 / interval_us
    return Answer(result=ACCEPTED)


def _get_interval(_command_state: CommandState, command: CommandReceived) -> Answer:
    number = command.param1
    is_id = number is not None and 0 <= number < 65536
    return Answer(result=ACCEPTED, interval_of=int(number or 0.0) if is_id else 65535)


_HANDLERS: dict[int, Callable[[CommandState, CommandReceived], Answer]] = {
    DO_SPRAYER: _sprayer,
    PREFLIGHT_REBOOT_SHUTDOWN: _reboot,
    GET_MESSAGE_INTERVAL: _get_interval,
    SET_MESSAGE_INTERVAL: _set_interval,
    REQUEST_MESSAGE: _request_message,
    REQUEST_CAPABILITIES: _version,
    USER_RATE: _user_rate,
    USER_REFILLED: _refilled,
    USER_NEXT_MAP: _next_map,
    USER_ESTOP: _estop,
}


# -------------------------------------------------------------------------------------- on one link

OnEvent = Callable[[float, str, str], None]
Version = tuple[int, int, int]


class Service:
    """Answers by `send`; has what it did told to the operator and to the record."""

    def __init__(
        self,
        command_state: CommandState,
        encoder: Encoder,
        announcer: Announcer,
        send: Callable[[bytes], bool],
        *,
        version: Version,
    ) -> None:
        self._command_state = command_state
        self._encoder = encoder
        self._announcer = announcer
        self._send = send
        self._version = version
        self._server = ParameterServer(command_state, encoder)
        self._decision: Decision | None = None
        # Who commanded something since the last decision, and whether a stop was pressed then.
        self._who, self._is_pressed = "", False
        self.on_event: OnEvent | None = None
        take_over(command_state)

    def look_at(self, decision: Decision | None, now_s: float) -> None:
        """Take what was decided: what may be changed, and what is left in the tank."""
        command_state, self._decision = self._command_state, decision
        was_enabled = command_state.is_enabled
        command_state.look_at(decision, now_s)
        self._tell_consent(decision, now_s, was_enabled=was_enabled)
        command_state.tank.flows(0.0 if decision is None else decision.flow_l_min, now_s)
        self._announcer.tank_l = command_state.tank.level_l
        self._announcer.set_values_rate(command_state.values_hz)

    def tick(self, now_s: float) -> None:
        """Send the next parameter of a list, if it is its turn."""
        for frame in self._server.due(now_s):
            self._send(frame)

    def obey(self, command: CommandReceived) -> tuple[Input, ...]:
        """Answer a command addressed to us, as often as it comes; of a broadcast only a stop."""
        target = command.target_component
        if target == 0 and stops(command):
            target = self._encoder.component_id
        if not self._is_ours(command.target_system, target):
            return ()
        answer, sender = self._command_state.obey(command), command.sender
        self._who = f"ground station {sender.system_id}/{sender.component_id}"
        self._send(
            self._encoder.ack(command.command, answer.result, sender.system_id, sender.component_id)
        )
        self._tell(answer, command.received_s)
        index = self._command_state.parameters.index(RATE_PERCENT)
        if command.command == USER_RATE and index is not None and answer.inputs:
            self._tell_value(index)
        return answer.inputs

    def obey_page(self, name: str, value: float | None, received_s: float) -> Answer:
        """Carry out an order of the operator's page as a command of the ground station is.

        Only the acknowledgement is missing; the ground station is told what was done.
        """
        number, param1 = PAGE_ORDERS[name]
        command = CommandReceived(
            received_s=received_s,
            sender=Sender(system_id=self._encoder.system_id, component_id=0),
            target_system=self._encoder.system_id,
            target_component=self._encoder.component_id,
            command=number,
            param1=value if param1 is None else param1,
            param2=None,
            source="web",
        )
        answer = self._command_state.obey(command)
        self._who = "the operator's page"
        self._tell(answer, received_s)
        return answer

    def declare(self, report: DeclarationReport) -> Answer:
        """Take what the operator declared on the page; the ground station is told of it."""
        answer = declared(self._command_state, report)
        self._tell(answer, report.received_s)
        return answer

    def serve(self, message: ParamAsked | ParamSet) -> tuple[Input, ...]:
        """Answer the parameter protocol; only a list may be asked of everyone."""
        target = message.target_component
        if isinstance(message, ParamAsked) and message.is_all and target == 0:
            target = self._encoder.component_id
        if not self._is_ours(message.target_system, target):
            return ()
        server = self._server
        values = server.ask(message) if isinstance(message, ParamAsked) else server.set(message)
        for index in values.indices:
            self._tell_value(index)
        if values.answer is None:
            return ()
        self._tell(values.answer, message.received_s)
        return values.answer.inputs

    def tell_event(self, at_s: float, kind: str, text: str) -> None:
        """Have something taken down in the record of the flight."""
        if self.on_event is not None:
            self.on_event(at_s, kind, text)

    # ------------------------------------------------------------------------------- inside

    def _tell_consent(self, decision: Decision | None, now_s: float, *, was_enabled: bool) -> None:
        """Have taken down who enabled, disabled and released a stop: it comes by several ways."""
        enabled = self._command_state.is_enabled
        state = None if decision is None else decision.state
        was_pressed, self._is_pressed = self._is_pressed, state is not None and bool(state.estop)
        who = self._who or ("the RC switch" if enabled else "switch, mode or disarming")
        if was_pressed and not self._is_pressed:
            self.tell_event(now_s, "consent", f"STOP released by {who}")
        if enabled != was_enabled:
            self.tell_event(now_s, "consent", f"{'en' if enabled else 'dis'}abled by {who}")
        self._who = ""

    def _is_ours(self, system_id: int, component_id: int) -> bool:
        encoder = self._encoder
        return component_id == encoder.component_id and system_id in (0, encoder.system_id)

    def _tell_value(self, index: int) -> None:
        frame = self._server.value(index)
        if frame is not None:
            self._send(frame)

    def _tell(self, answer: Answer, at_s: float) -> None:
        """Do what an answer consists of besides its result."""
        if answer.text is not None:
            self._announcer.note(answer.text)
        if answer.event is not None:
            self.tell_event(at_s, "command", answer.event)
        if answer.interval_of is not None:
            self._send(self._interval(answer.interval_of))
        if answer.send is not None:
            self._send_message(answer.send, answer.send_index, at_s)

    def _interval(self, message_id: int) -> bytes:
        values_us = round(1e6 / self._command_state.values_hz)
        known = {HEARTBEAT: 1_000_000, NAMED_VALUE_FLOAT: values_us}
        return self._encoder.message_interval(message_id, known.get(message_id, 0))

    def _send_message(self, message_id: int, index: int, at_s: float) -> None:
        """Send one of our own messages because somebody asked for it."""
        if message_id == AUTOPILOT_VERSION:
            self._send(self._encoder.autopilot_version(self._version))
        elif message_id == PARAM_VALUE:
            self._tell_value(index)
        elif message_id == HEARTBEAT:
            self._announcer.beat_soon()
        elif message_id == STATUSTEXT:
            self._announcer.repeat()
        elif self._decision is not None:
            for frame in self._announcer.named_values(self._decision, at_s):
                self._send(frame)


# The parameter protocol's answers, one after the other and slowly enough for a slow wire.

# A PARAM_VALUE is 37 bytes: this is 740 bytes a second, an eighth of 57600 baud.
PACE_S = 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class Values:
    """Places of parameters whose values are to be told at once, and what was said besides."""

    indices: tuple[int, ...] = ()
    answer: Answer | None = None


class ParameterServer:
    """Answers; a list that is asked for again begins anew and waits in no queue."""

    def __init__(self, command_state: CommandState, encoder: Encoder) -> None:
        self._command_state = command_state
        self._encoder = encoder
        self._next: int | None = None
        self._next_s = float("-inf")

    def ask(self, asked: ParamAsked) -> Values:
        """Take a request; a list is told by `due`."""
        parameters = self._command_state.parameters
        if asked.is_all:
            self._next = 0
            return Values()
        index = parameters.index(asked.name) if asked.index < 0 else asked.index
        if index is None or parameters.at(index) is None:
            return Values()
        return Values(indices=(index,))

    def set(self, wanted: ParamSet) -> Values:
        """Take a value or keep the old one; either way the one that holds is told."""
        command_state = self._command_state
        index = command_state.parameters.index(wanted.name)
        if index is None:
            return Values()
        told = (index,)
        if wanted.kind != REAL32:
            text = f"{wanted.name}: type REAL32 only"
            return Values(indices=told, answer=Answer(result=0, text=text))
        if wanted.name == RATE_PERCENT:
            return Values(
                indices=told, answer=rate_override(command_state, wanted.value, wanted.received_s)
            )
        before = command_state.parameters.get(wanted.name, 0.0)
        refusal = command_state.parameters.set(
            wanted.name, wanted.value, is_frozen=command_state.is_armed or command_state.is_open
        )
        if refusal is not None:
            return Values(indices=told, answer=Answer(result=0, text=f"{wanted.name}: {refusal}"))
        after = command_state.parameters.get(wanted.name, 0.0)
        if after == before:
            return Values(indices=told)
        take_over(command_state)
        when = ", at next start" if wanted.name not in (VALUES_HZ, TANK_L) else ""
        text = f"{wanted.name} {after:g}{when}"
        return Values(indices=told, answer=Answer(result=0, text=text, event=text))

    def due(self, now_s: float) -> Iterator[bytes]:
        """Yield the next value of a list, if it is its turn."""
        if self._next is None or now_s < self._next_s:
            return
        self._next_s = now_s + PACE_S
        frame = self.value(self._next)
        self._next += 1
        if self._next >= len(self._command_state.parameters):
            self._next = None
        if frame is not None:
            yield frame

    def value(self, index: int) -> bytes | None:
        """Return PARAM_VALUE of the parameter at `index`; None where there is none."""
        found = self._command_state.parameters.at(index)
        if found is None:
            return None
        name, value = found
        return self._encoder.param_value(name, value, len(self._command_state.parameters), index)


def take_over(command_state: CommandState) -> None:
    """Have the parameters that act at once act."""
    command_state.values_hz = command_state.parameters.get(VALUES_HZ, 1.0)
    command_state.tank.capacity_l = command_state.parameters.get(TANK_L, 0.0) or None
