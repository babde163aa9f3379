"""What others ask of us: commands and parameters, each answered; for the component on one link."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from companion.core.types import Decision, DeclarationReport, Input
from companion.link import commands
from companion.link.announcer import Announcer
from companion.link.commands import Answer, Desk, rate_override
from companion.link.encode import REAL32, Encoder
from companion.link.messages import CommandReceived, ParamAsked, ParamSet, Sender
from companion.link.parameters import RATE_PERCENT, TANK_L, VALUES_HZ

OnEvent = Callable[[float, str, str], None]
Version = tuple[int, int, int]


class Service:
    """Answers by `send`; has what it did told to the operator and to the record."""

    def __init__(
        self,
        desk: Desk,
        encoder: Encoder,
        announcer: Announcer,
        send: Callable[[bytes], bool],
        *,
        version: Version,
    ) -> None:
        self._desk = desk
        self._encoder = encoder
        self._announcer = announcer
        self._send = send
        self._version = version
        self._server = ParameterServer(desk, encoder)
        self._decision: Decision | None = None
        self.on_event: OnEvent | None = None
        take_over(desk)

    def look_at(self, decision: Decision | None, now_s: float) -> None:
        """Take what was decided: what may be changed, and what is left in the tank."""
        desk, self._decision = self._desk, decision
        desk.look_at(decision, now_s)
        desk.tank.flows(0.0 if decision is None else decision.flow_l_min, now_s)
        self._announcer.tank_l = desk.tank.level_l
        self._announcer.set_values_rate(desk.values_hz)

    def tick(self, now_s: float) -> None:
        """Send the next parameter of a list, if it is its turn."""
        for frame in self._server.due(now_s):
            self._send(frame)

    def obey(self, command: CommandReceived) -> tuple[Input, ...]:
        """Answer a command addressed to us, as often as it comes; of a broadcast only a stop."""
        target = command.target_component
        if target == 0 and commands.stops(command):
            target = self._encoder.component_id
        if not self._is_ours(command.target_system, target):
            return ()
        answer, sender = self._desk.obey(command), command.sender
        self._send(
            self._encoder.ack(command.command, answer.result, sender.system_id, sender.component_id)
        )
        self._tell(answer, command.received_s)
        index = self._desk.parameters.index(RATE_PERCENT)
        if command.command == commands.USER_RATE and index is not None and answer.inputs:
            self._tell_value(index)
        return answer.inputs

    def obey_page(self, name: str, value: float | None, received_s: float) -> Answer:
        """Carry out an order of the operator's page as a command of the ground station is.

        Only the acknowledgement is missing; the ground station is told what was done.
        """
        number, param1 = commands.PAGE_ORDERS[name]
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
        answer = self._desk.obey(command)
        self._tell(answer, received_s)
        return answer

    def declare(self, report: DeclarationReport) -> Answer:
        """Take what the operator declared on the page; the ground station is told of it."""
        answer = commands.declared(self._desk, report)
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
        values_us = round(1e6 / self._desk.values_hz)
        known = {commands.HEARTBEAT: 1_000_000, commands.NAMED_VALUE_FLOAT: values_us}
        return self._encoder.message_interval(message_id, known.get(message_id, 0))

    def _send_message(self, message_id: int, index: int, at_s: float) -> None:
        """Send one of our own messages because somebody asked for it."""
        if message_id == commands.AUTOPILOT_VERSION:
            self._send(self._encoder.autopilot_version(self._version))
        elif message_id == commands.PARAM_VALUE:
            self._tell_value(index)
        elif message_id == commands.HEARTBEAT:
            self._announcer.beat_soon()
        elif message_id == commands.STATUSTEXT:
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
    """Answers for `desk`; a list that is asked for again begins anew and waits in no queue."""

    def __init__(self, desk: Desk, encoder: Encoder) -> None:
        self._desk = desk
        self._encoder = encoder
        self._next: int | None = None
        self._next_s = float("-inf")

    def ask(self, asked: ParamAsked) -> Values:
        """Take a request; a list is told by `due`."""
        parameters = self._desk.parameters
        if asked.is_all:
            self._next = 0
            return Values()
        index = parameters.index(asked.name) if asked.index < 0 else asked.index
        if index is None or parameters.at(index) is None:
            return Values()
        return Values(indices=(index,))

    def set(self, wanted: ParamSet) -> Values:
        """Take a value or keep the old one; either way the one that holds is told."""
        desk = self._desk
        index = desk.parameters.index(wanted.name)
        if index is None:
            return Values()
        told = (index,)
        if wanted.kind != REAL32:
            text = f"{wanted.name}: type REAL32 only"
            return Values(indices=told, answer=Answer(result=0, text=text))
        if wanted.name == RATE_PERCENT:
            return Values(indices=told, answer=rate_override(desk, wanted.value, wanted.received_s))
        before = desk.parameters.get(wanted.name, 0.0)
        refusal = desk.parameters.set(
            wanted.name, wanted.value, is_frozen=desk.is_armed or desk.is_open
        )
        if refusal is not None:
            return Values(indices=told, answer=Answer(result=0, text=f"{wanted.name}: {refusal}"))
        after = desk.parameters.get(wanted.name, 0.0)
        if after == before:
            return Values(indices=told)
        take_over(desk)
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
        if self._next >= len(self._desk.parameters):
            self._next = None
        if frame is not None:
            yield frame

    def value(self, index: int) -> bytes | None:
        """Return PARAM_VALUE of the parameter at `index`; None where there is none."""
        found = self._desk.parameters.at(index)
        if found is None:
            return None
        name, value = found
        return self._encoder.param_value(name, value, len(self._desk.parameters), index)


def take_over(desk: Desk) -> None:
    """Have the parameters that act at once act."""
    desk.values_hz = desk.parameters.get(VALUES_HZ, 1.0)
    desk.tank.capacity_l = desk.parameters.get(TANK_L, 0.0) or None
