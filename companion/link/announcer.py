"""What the operator is told: STATUSTEXT on change, values once a second, signs of life."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Iterator

from companion.core.safety import ENVELOPE
from companion.core.types import Decision, Inhibit, SprayerState
from companion.link.encode import (
    STATE_ACTIVE,
    STATE_BOOT,
    STATE_CRITICAL,
    STATE_EMERGENCY,
    STATE_STANDBY,
    Encoder,
)
from companion.tally import Tally, next_change_s, wanted_l_ha

HEARTBEAT_S = 1.0
LIVE_S = 0.1
VALUES_S = 1.0
TEXT_S = 1.0
# A change is told once it has lasted: what comes and goes is none. What each turn of a flight goes
# through (too slow, too high) has to last for longer than a turn does.
SETTLED_S = 1.0
TURN_S = 10.0
# Who connects in the middle of a flight learns within this why nothing is sprayed.
REMIND_S = 30.0
# A reason that comes, goes and comes again within that time (positions once a second are too old
# once a second) is news no more. Not so what somebody does, and what turns go through.
UNSTEADY_CHANGES = 3
_STEADY = ENVELOPE | {
    Inhibit.ESTOP,
    Inhibit.NOT_ENABLED,
    Inhibit.NOT_ARMED,
    Inhibit.WRONG_MODE,
    Inhibit.RC_SWITCH,
}
# What no product is sprayed with is marked; as numbers for ground stations.
TRAINING = {"water": 1.0, "dry": 2.0, "ground": 3.0}
_LINE_MAX = 50
_LINES_MAX = 2
_PREFIX, _OFF = "Spray: ", "Spray off: "
_WAITING_MAX = 8

_INFO, _NOTICE, _WARNING, _ERROR = 6, 5, 4, 3  # MAV_SEVERITY
_LOUD = frozenset(
    {
        Inhibit.ESTOP,
        Inhibit.REARM_NEEDED,
        Inhibit.OUTPUT_FAULT,
        Inhibit.LINK_LOST,
        Inhibit.ESTIMATOR_UNHEALTHY,
        Inhibit.SPEED_DISAGREES,
    }
)

# As numbers for ground stations: 0 boot, 1 safe, 2 ready, 3 armed, 4 spraying, 5 fault, 6 estop.
_NUMBER = {state: float(number) for number, state in enumerate(SprayerState)}
_MAV_STATE = {
    SprayerState.BOOT: STATE_BOOT,
    SprayerState.SAFE: STATE_STANDBY,
    SprayerState.READY: STATE_STANDBY,
    SprayerState.ARMED: STATE_ACTIVE,
    SprayerState.SPRAYING: STATE_ACTIVE,
    SprayerState.FAULT: STATE_CRITICAL,
    SprayerState.ESTOP: STATE_EMERGENCY,
}


class _Beat:
    """Is due every `period_s` on average, however unevenly it is asked."""

    def __init__(self, period_s: float) -> None:
        self.period_s = period_s
        self._next_s = float("-inf")

    def hurry(self) -> None:
        """Be due when next asked."""
        self._next_s = float("-inf")

    def is_due(self, now_s: float) -> bool:
        if now_s < self._next_s:
            return False
        late_s = now_s - self._next_s
        on_time = late_s < self.period_s
        self._next_s = (self._next_s if on_time else now_s) + self.period_s
        return True


class Announcer:
    """Turns decisions into messages; called from the control loop only.

    So the heartbeat and SPR_LIVE prove that decisions are being made, not that a process exists.
    """

    def __init__(
        self, encoder: Encoder, *, training: str = "", width_m: float | None = None
    ) -> None:
        self._encoder = encoder
        self._tally = Tally(width_m)
        self._training = TRAINING.get(training)
        self._heartbeat, self._live = _Beat(HEARTBEAT_S), _Beat(LIVE_S)
        self._values = _Beat(VALUES_S)
        self._said: frozenset[Inhibit] | None = None
        self._seen = self._now = frozenset[Inhibit]()
        self._changed_s = defaultdict[Inhibit, deque[float]](lambda: deque(maxlen=UNSTEADY_CHANGES))
        self._said_s = self._seen_s = float("-inf")
        self._waiting: deque[tuple[int, str]] = deque(maxlen=_WAITING_MAX)
        self._noted_s = float("-inf")
        # Until something has left nobody is told anything: what is said then would be lost.
        self.is_reached = False
        self.tank_l: float | None = None

    def fault(self, text: str) -> None:
        """Have `text` said at the next turn, once."""
        self._waiting.append((_ERROR, text))

    def note(self, text: str, *, is_warning: bool = False) -> None:
        """Have `text` said, once; the same that waits already is not said twice."""
        entry = (_WARNING if is_warning else _NOTICE, text)
        if entry not in self._waiting:
            self._waiting.append(entry)

    def set_values_rate(self, rate_hz: float) -> None:
        """Tell the values this often from the next time on."""
        self._values.period_s = 1.0 / rate_hz

    def beat_soon(self) -> None:
        """Have the heartbeat sent at the next turn: it comes from the loop, however asked for."""
        self._heartbeat.hurry()

    def repeat(self) -> None:
        """Tell state and reasons at the next turn, though nothing has changed."""
        self._said = None

    def due(self, decision: Decision | None, now_s: float) -> Iterator[bytes]:
        """Yield the messages that are due."""
        if decision is not None and not decision.plan.is_off and self._live.is_due(now_s):
            yield self._encoder.named_value("SPR_LIVE", 1.0, now_s)
        if self._heartbeat.is_due(now_s):
            state = SprayerState.BOOT if decision is None else decision.sprayer
            yield self._encoder.heartbeat(_MAV_STATE[state])
        yield from self._notes(now_s)
        if decision is None:
            return
        self._tally.take(decision)
        if self.is_reached:
            yield from self._text(decision, now_s)
        if self._values.is_due(now_s):
            yield from self.named_values(decision, now_s)

    def _notes(self, now_s: float) -> Iterator[bytes]:
        """Yield faults at once, and of the rest one in every tenth of a second."""
        while (self.is_reached and self._waiting) and (
            self._waiting[0][0] == _ERROR or not now_s - self._noted_s < LIVE_S
        ):
            severity, text = self._waiting.popleft()
            if severity != _ERROR:
                self._noted_s = now_s
            for line in lines(text):
                yield self._encoder.text(severity, line)

    def _text(self, decision: Decision, now_s: float) -> Iterator[bytes]:
        unsteady = self._unsteady(decision.inhibits, now_s)
        steady = decision.inhibits - unsteady
        if steady != self._seen:
            self._seen, self._seen_s = steady, now_s
        is_news = self._is_news(decision.inhibits, unsteady, now_s)
        if not is_news or now_s - self._said_s < TEXT_S:
            return
        self._said, self._said_s = decision.inhibits, now_s
        severity = _WARNING if decision.inhibits & _LOUD else _INFO
        for line in reasons(decision.inhibits):
            yield self._encoder.text(severity, line)

    def _unsteady(self, now: frozenset[Inhibit], now_s: float) -> frozenset[Inhibit]:
        """Return the reasons that have come and gone too often of late to be news."""
        for one in (now ^ self._now) - _STEADY:
            self._changed_s[one].append(now_s)
        self._now = now
        return frozenset(
            one
            for one, changed_s in self._changed_s.items()
            if len(changed_s) == UNSTEADY_CHANGES and now_s - changed_s[0] < REMIND_S
        )

    def _is_news(self, now: frozenset[Inhibit], unsteady: frozenset[Inhibit], now_s: float) -> bool:
        """Return whether the reasons are to be told: one line for each change that is one."""
        if self._said is None:
            return True
        if unsteady and not now:
            return False  # no more than a moment between two that close
        is_old = now_s - self._said_s >= REMIND_S
        change = (now ^ self._said) - unsteady
        if not change:
            return is_old and bool(now) and Inhibit.NOT_ENABLED not in now
        if change & now & _LOUD:
            return True
        if change <= ENVELOPE:
            return now_s - self._seen_s >= TURN_S
        # What goes on coming and going is told now and then.
        return is_old or now_s - self._seen_s >= SETTLED_S

    def named_values(self, decision: Decision, now_s: float) -> Iterator[bytes]:
        """Yield what any ground station can show or plot."""
        percent = 100.0 if decision.state is None else decision.state.rate_percent
        given_l_ha, next_s = self._tally.given_l_ha(decision), next_change_s(decision)
        duty = decision.plan.duty
        values = {
            "SPR_RATE": wanted_l_ha(decision),
            "SPR_FLOW": decision.flow_l_min,
            "SPR_DUTY": sum(duty) / len(duty) if duty else 0.0,
            "SPR_STATE": _NUMBER[decision.sprayer],
            "SPR_PCT": percent,
            "SPR_LITRE": self._tally.volume_l,
        }
        if given_l_ha is not None:
            values["SPR_GIVEN"] = given_l_ha
        if next_s is not None:
            values["SPR_NEXT"] = next_s
        if self.tank_l is not None:
            values["SPR_TANK"] = self.tank_l
        if self._training is not None:
            values["SPR_TRAIN"] = self._training
        for name, value in values.items():
            yield self._encoder.named_value(name, value, now_s)


def lines(text: str) -> list[str]:
    """Return `text` in lines that a station shows whole; what does not fit two is counted.

    >>> lines("no watchdog on autopilot: valves stay open without power")
    ['Spray: no watchdog on autopilot: valves stay open', 'Spray: without power']
    """
    room = _LINE_MAX - len(_PREFIX)
    words, found = text.split(" "), [""]
    for number, word in enumerate(words):
        joined = f"{found[-1]} {word}".strip()
        if len(joined) <= room:
            found[-1] = joined
        elif len(found) < _LINES_MAX:
            found.append(word[:room])
        else:
            more = f" +{len(words) - number}"
            found[-1] = found[-1][: room - len(more)].rstrip(",") + more
            break
    return [_PREFIX + line for line in found if line]


def reasons(inhibits: frozenset[Inhibit]) -> list[str]:
    """Return why it does not spray, in the order of the enumeration; two lines at most.

    >>> reasons(frozenset({Inhibit.NOT_ENABLED, Inhibit.SPEED_BELOW_MIN}))
    ['Spray off: not enabled, too slow']
    >>> reasons(frozenset())
    ['Spray: ready']
    """
    if not inhibits:
        return [f"{_PREFIX}ready"]
    words = [one.words for one in Inhibit if one in inhibits]
    found = [f"{_OFF}{words[0]}"]
    for number, word in enumerate(words[1:], start=1):
        more = f" +{len(words) - number}"
        if len(found[-1]) + 2 + len(word) <= _LINE_MAX - (len(found) == _LINES_MAX) * len(more):
            found[-1] += f", {word}"
        elif len(found) < _LINES_MAX:
            found.append(f"{_OFF}{word}")
        else:
            found[-1] += more
            break
    return found
