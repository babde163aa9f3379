"""What the operator is told: STATUSTEXT on change, values once a second, signs of life."""

from __future__ import annotations

from collections.abc import Iterator

from companion.core.types import Decision, Inhibit
from companion.link.encode import STATE_ACTIVE, STATE_CRITICAL, STATE_STANDBY, Encoder

HEARTBEAT_S = 1.0
LIVE_S = 0.1
VALUES_S = 1.0
TEXT_S = 1.0

_INFO, _NOTICE, _WARNING, _ERROR = 6, 5, 4, 3  # MAV_SEVERITY
_LOUD = frozenset({Inhibit.OUTPUT_FAULT, Inhibit.ESTIMATOR_UNHEALTHY, Inhibit.SPEED_DISAGREES})

STATE_OFF, STATE_HELD, STATE_READY = 0.0, 1.0, 2.0


class _Beat:
    """Is due every `period_s` in the mean, however unevenly it is asked."""

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._next_s = float("-inf")

    def is_due(self, now_s: float) -> bool:
        if now_s < self._next_s:
            return False
        late_s = now_s - self._next_s
        on_time = late_s < self._period_s
        self._next_s = (self._next_s if on_time else now_s) + self._period_s
        return True


class Announcer:
    """Turns decisions into messages; called from the control loop only.

    So the heartbeat and SPR_LIVE prove that decisions are being made, not that a process exists.
    """

    def __init__(self, encoder: Encoder) -> None:
        self._encoder = encoder
        self._heartbeat, self._live = _Beat(HEARTBEAT_S), _Beat(LIVE_S)
        self._values = _Beat(VALUES_S)
        self._said: frozenset[Inhibit] | None = None
        self._said_s = float("-inf")
        self._faults: list[str] = []

    def fault(self, text: str) -> None:
        """Have `text` said at the next turn, once."""
        self._faults.append(text)

    def due(self, decision: Decision | None, now_s: float) -> Iterator[bytes]:
        """Yield the messages that are due."""
        if decision is not None and not decision.plan.is_off and self._live.is_due(now_s):
            yield self._encoder.named_value("SPR_LIVE", 1.0, now_s)
        if self._heartbeat.is_due(now_s):
            yield self._encoder.heartbeat(_mav_state(decision))
        while self._faults:
            yield self._encoder.text(_ERROR, f"Spray: {self._faults.pop(0)}")
        if decision is None:
            return
        yield from self._text(decision, now_s)
        if self._values.is_due(now_s):
            yield from self._named_values(decision, now_s)

    def _text(self, decision: Decision, now_s: float) -> Iterator[bytes]:
        if decision.inhibits == self._said or now_s - self._said_s < TEXT_S:
            return
        self._said, self._said_s = decision.inhibits, now_s
        severity = _WARNING if decision.inhibits & _LOUD else _INFO
        yield self._encoder.text(severity, f"Spray: {reasons(decision.inhibits)}")

    def _named_values(self, decision: Decision, now_s: float) -> Iterator[bytes]:
        rates = [rate for rate in decision.rate_l_ha if rate is not None]
        duty = decision.plan.duty
        values = {
            "SPR_RATE": sum(rates) / len(rates) if rates else 0.0,
            "SPR_FLOW": decision.flow_l_min,
            "SPR_DUTY": sum(duty) / len(duty) if duty else 0.0,
            "SPR_STATE": _state(decision),
        }
        for name, value in values.items():
            yield self._encoder.named_value(name, value, now_s)


def reasons(inhibits: frozenset[Inhibit]) -> str:
    """Return why it does not spray, in the order of the enumeration.

    >>> reasons(frozenset({Inhibit.NOT_ARMED, Inhibit.NOT_ENABLED}))
    'closed: not-enabled, not-armed'
    """
    if not inhibits:
        return "ready"
    return "closed: " + ", ".join(inhibit for inhibit in Inhibit if inhibit in inhibits)


def _state(decision: Decision) -> float:
    if not decision.inhibits:
        return STATE_READY
    return STATE_OFF if Inhibit.NOT_ENABLED in decision.inhibits else STATE_HELD


def _mav_state(decision: Decision | None) -> int:
    if decision is None or Inhibit.NOT_ENABLED in decision.inhibits:
        faulty = decision is not None and Inhibit.OUTPUT_FAULT in decision.inhibits
        return STATE_CRITICAL if faulty else STATE_STANDBY
    return STATE_CRITICAL if Inhibit.OUTPUT_FAULT in decision.inhibits else STATE_ACTIVE
