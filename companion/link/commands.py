"""Commands that are addressed to us, each answered: what is done, and what is said of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from companion.core.types import (
    Decision,
    DeclarationReport,
    EstopReport,
    Input,
    OperatorCommand,
    RateOverride,
)
from companion.link.messages import CommandReceived, Sender, Tank
from companion.link.parameters import RATE_PERCENT, VALUES_HZ, Parameters

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
class Desk:
    """What commands look at and change."""

    parameters: Parameters
    tank: Tank
    values_hz: float = 1.0
    is_armed: bool = False
    is_open: bool = False
    may_enable: bool = True  # a command may; below, the page may
    page_may_enable: bool = False
    is_enabled: bool = False
    # When the consent last went, by whatever took it; None: it was given anew since.
    stopped_s: float | None = None
    # Who gave the last ENABLE, and its frame's number.
    enabled_by: tuple[Sender, int] | None = None
    # The sensor that counts the tank, where there is one; whether it takes this many litres.
    on_refilled: Callable[[float], bool] | None = None

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


def _sprayer(desk: Desk, command: CommandReceived) -> Answer:
    """Take the operator's wish: exactly 1 enables, exactly 0 disables."""
    if command.param1 not in (0.0, 1.0):
        return Answer(result=DENIED, text="DO_SPRAYER takes 0 or 1")
    enable = command.param1 == 1.0
    if enable and command.source == "web" and not desk.page_may_enable:
        return Answer(result=DENIED, text="enable by page: see safety.enable_by")
    if enable and command.source == "command" and not desk.may_enable:
        return Answer(result=DENIED, text="enable by command: see safety.enable_by")
    if enable and command.target_system == 0:
        return Answer(result=DENIED, text="enable: name this vehicle's system, not 0")
    if enable and desk.is_old(command):
        return Answer(result=REJECTED_FOR_NOW, text="late enable not taken: enable again")
    desk.stopped_s = None if enable else command.received_s
    if enable:
        desk.enabled_by = (command.sender, command.sequence)
    wish = OperatorCommand(received_s=command.received_s, enable=enable, source=command.source)
    return Answer(result=ACCEPTED, inputs=(wish,))


def _estop(desk: Desk, command: CommandReceived) -> Answer:
    """Take an emergency stop, whatever its parameters: DO_SPRAYER 0 ends it."""
    desk.stopped_s = command.received_s
    stop = EstopReport(received_s=command.received_s, pressed=True, source="command")
    return Answer(result=ACCEPTED, inputs=(stop,), text="emergency stop", event="emergency stop")


def rate_override(desk: Desk, percent: float | None, received_s: float) -> Answer:
    """Take another percentage of the prescribed rates, by command or by parameter."""
    refusal = desk.parameters.set(RATE_PERCENT, percent, is_frozen=False)
    if refusal is not None:
        return Answer(result=DENIED, text=f"rate override: {refusal}")
    taken = desk.parameters.get(RATE_PERCENT, 100.0)
    return Answer(
        result=ACCEPTED,
        inputs=(RateOverride(received_s=received_s, percent=taken),),
        text=f"rate {taken:g} %",
        event=f"rate override {taken:g} %",
    )


def _user_rate(desk: Desk, command: CommandReceived) -> Answer:
    if desk.parameters.index(RATE_PERCENT) is None:
        return Answer(result=UNSUPPORTED)
    return rate_override(desk, command.param1, command.received_s)


def _refilled(desk: Desk, command: CommandReceived) -> Answer:
    if desk.is_open:
        return Answer(result=REJECTED_FOR_NOW, text="refilled: stop spraying first")
    before_l = desk.tank.level_l
    if not desk.tank.filled(command.param1):
        most_l = desk.tank.capacity_l
        advice = "give litres" if most_l is None else f"0 to {most_l:g} L"
        return Answer(result=DENIED, text=f"refilled: {advice}")
    level_l = desk.tank.level_l
    if level_l is not None and desk.on_refilled is not None and not desk.on_refilled(level_l):
        desk.tank.level_l = before_l
        return Answer(result=DENIED, text="refilled: more than tank.capacity_l")
    text = f"tank {desk.tank.level_l:g} L"
    return Answer(result=ACCEPTED, text=text, event=f"refilled, {text}")


def declared(desk: Desk, report: DeclarationReport) -> Answer:
    """Take what the operator observed: on the ground only, where somebody can look again."""
    if desk.is_armed or desk.is_open:
        return Answer(result=REJECTED_FOR_NOW, text="declare: land and disarm first")
    # Where nothing is limited nothing is kept either: it is for the record.
    text = f"declared, not kept: {len(report.broken)}" if report.broken else "declared"
    return Answer(
        result=ACCEPTED, inputs=(report,), text=text, event=f"declared by page: {report.said}"
    )


def _next_map(desk: Desk, _command: CommandReceived) -> Answer:
    if desk.is_armed or desk.is_open:
        return Answer(result=DENIED, text="next map: disarm first")
    return Answer(result=DENIED, text="next map: there is only one")


def _reboot(_desk: Desk, _command: CommandReceived) -> Answer:
    return Answer(result=DENIED, text="no reboot by MAVLink")


def _request_message(desk: Desk, command: CommandReceived) -> Answer:
    if command.param1 is None or command.param1 not in OWN_MESSAGES:
        return Answer(result=UNSUPPORTED)
    number = command.param2
    index = int(number) if number is not None and 0 <= number < 1e4 else -1
    if command.param1 == PARAM_VALUE and desk.parameters.at(index) is None:
        return Answer(result=DENIED)
    return Answer(result=ACCEPTED, send=int(command.param1), send_index=index)


def _version(_desk: Desk, _command: CommandReceived) -> Answer:
    return Answer(result=ACCEPTED, send=AUTOPILOT_VERSION)


def _set_interval(desk: Desk, command: CommandReceived) -> Answer:
    """Set how often our values are told; the signs of life are nobody's to change."""
    if command.param1 == HEARTBEAT:
        return Answer(result=DENIED, text="our heartbeat is 1 Hz")
    if command.param1 != NAMED_VALUE_FLOAT:
        return Answer(result=UNSUPPORTED)
    interval_us = command.param2
    if interval_us == 0.0:
        desk.values_hz = desk.parameters.get(VALUES_HZ, 1.0)
        return Answer(result=ACCEPTED)
    # -1, which switches a message off, is refused: another station may be looking.
    if interval_us is None or not 1e6 / VALUES_HZ_MAX <= interval_us <= 1e6 / VALUES_HZ_MIN:
        return Answer(result=DENIED, text=f"values: {VALUES_HZ_MIN:g} to {VALUES_HZ_MAX:g} Hz")
    desk.values_hz = 1e6 / interval_us
    return Answer(result=ACCEPTED)


def _get_interval(_desk: Desk, command: CommandReceived) -> Answer:
    number = command.param1
    is_id = number is not None and 0 <= number < 65536
    return Answer(result=ACCEPTED, interval_of=int(number or 0.0) if is_id else 65535)


_HANDLERS: dict[int, Callable[[Desk, CommandReceived], Answer]] = {
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
