"""Whether the autopilot's outputs can be trusted, and in words why not.

It hears what the autopilot answers, what its parameters are and what its outputs read. A refusal is
a fault for good; outputs that do not follow are one until they do, and for good when it happens
again and again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from companion.output.autopilot_findings import (
    dead_man,
    findings,
    is_open,
    more_parameters,
    px4_pins,
    px4_places,
    px4_wiring,
    wanted_parameters,
)
from companion.output.autopilot_options import OutputCheck, Reading, ServoOptions, ardupilot_places

# MAV_RESULT, and what most likely lies behind it; PX4 only ever accepts.
REFUSALS = {2: "denied", 3: "not supported", 4: "failed"}
_CAUSES = {2: "", 3: ": firmware built without it?", 4: ": is SERVOn_FUNCTION 0?"}
# Outputs count as following again when they have done so for this long.
_RECOVERED_S = 1.0
_EPISODES_MAX = 3
# PX4 shows an order of before only some time after arming.
_LIVE_AFTER_S = 0.3
# Disarming shows at PX4's outputs at once and in its heartbeat up to a second later.
_REST_MAX_S = 1.5
_REPORT_WAIT_S = 5.0


@dataclass(slots=True)
class _Stray:
    """Outputs that do not follow: what is said of it, and since when they do again."""

    text: str | None = None
    at_s: float = 0.0
    episodes: int = 0


class OutputGuard:
    """One vehicle's outputs; `say` is told once of everything that should be seen to."""

    def __init__(self, options: ServoOptions, say: Callable[[str], None]) -> None:
        self._options = options
        self._say = say
        self._check = OutputCheck(len(options.outputs))
        self._said: set[str] = set()
        self._known: dict[str, float | None] = {}
        self._is_px4 = False
        self._met_s: float | None = None
        self._live_s: float | None = None
        self._judged_s: float | None = None  # None: the parameters are still being read
        self._is_judged = False
        self._rest_since_s: float | None = None
        self._wiring: str | None = None
        self._refused: str | None = None
        self._finding: str | None = None
        self._stray = _Stray()

    @property
    def fault(self) -> str | None:
        """Return why nothing may open; None while the outputs can be trusted."""
        return self._wiring or self._finding or self._refused or self._stray.text

    @property
    def is_refused(self) -> bool:
        """Return whether the autopilot refuses orders; each more costs a text on a screen."""
        return self._refused is not None

    def met(self, *, is_px4: bool, now_s: float) -> tuple[str, ...]:
        """Take that a vehicle was met, or met again; return the parameters to read."""
        self._is_px4, self._met_s = is_px4, now_s
        self._is_judged, self._judged_s = False, None
        self._known.clear()
        self._check.forget()
        self._wiring = px4_wiring(self._options) if is_px4 else None
        channels = self._options.outputs
        self._check.look_at(((),) * len(channels) if is_px4 else ardupilot_places(channels))
        return wanted_parameters(self._options, is_px4=is_px4)

    def learned(self, known: Mapping[str, float | None]) -> tuple[str, ...]:
        """Take parameters; return those to read besides, after which all is judged."""
        self._known.update(known)
        more = more_parameters(self._options, self._known, is_px4=self._is_px4)
        if more:
            return more
        if self._is_px4:
            self._check.look_at(px4_places(self._options.outputs, self._known))
        self._is_judged = True
        found = findings(self._options, self._known, is_px4=self._is_px4)
        missing = dead_man(self._options, self._known, is_px4=self._is_px4)
        found += [] if missing is None else [missing]
        faults = [finding.text for finding in found if finding.is_fault]
        self._finding = faults[0] if faults else None
        for text in [*faults[1:], *(finding.text for finding in found if not finding.is_fault)]:
            self._tell(text)
        return ()

    def acknowledge(self, result: int) -> None:
        """Take the answer to an order. It does not say to which one."""
        if result in REFUSALS and self._refused is None:
            cause = "" if self._is_px4 else _CAUSES[result]
            self._refused = f"servo order {REFUSALS[result]}{cause}"

    def armed(self, is_armed: bool, now_s: float) -> None:
        """Take whether the vehicle is armed: PX4's outputs follow no order while it is not."""
        self._live_s = now_s + _LIVE_AFTER_S if is_armed else None
        self._rest_since_s = None
        if self._is_px4:
            self._check.forget()

    def forget(self) -> None:
        """Take that it is unknown which orders have arrived."""
        self._check.forget()

    def sent(self, output: int, pulse_us: int, at_s: float) -> None:
        """Take an order that has left."""
        self._check.sent(output, pulse_us, at_s)

    def reported(self, port: int, pulse_us: Sequence[int], at_s: float) -> tuple[int, ...]:
        """Take what the outputs read; return those whose order should be said again."""
        if self._is_px4 and (self._live_s is None or not at_s >= self._live_s):
            return ()
        verdict = self._check.read(port, pulse_us, at_s)
        stray = self._stray
        if self._may_be_disarmed(verdict.stray, at_s):
            return verdict.again
        if verdict.stray:
            if stray.text is None:
                stray.episodes += 1
            stray.text, stray.at_s = self._words(verdict.stray[0]), at_s
        elif stray.text is not None and verdict.seen and not verdict.again:
            is_over = at_s - stray.at_s >= _RECOVERED_S and stray.episodes <= _EPISODES_MAX
            stray.text = None if is_over else stray.text
        return verdict.again

    def look(self, now_s: float) -> None:
        """Say once that nothing tells what the outputs do.

        Which report shows an actuator of PX4 is known once the parameters have been read.
        """
        if self._is_judged and self._judged_s is None:
            self._judged_s = now_s
        since_s = self._live_s if self._is_px4 else self._met_s
        if since_s is not None and self._is_px4:
            since_s = None if self._judged_s is None else max(since_s, self._judged_s)
        if since_s is None or now_s - since_s < _REPORT_WAIT_S or self._check.is_possible:
            return
        self._tell("SERVO_OUTPUT_RAW of these outputs does not come: they are not checked")

    # ------------------------------------------------------------------------------- inside

    def _tell(self, text: str) -> None:
        if text not in self._said:
            self._said.add(text)
            self._say(text)

    def _may_be_disarmed(self, strays: Sequence[Reading], at_s: float) -> bool:
        """Return whether PX4's outputs show their disarmed values, and not yet for too long."""
        if not strays or not all(self._is_at_rest(reading) for reading in strays):
            self._rest_since_s = None
            return False
        if self._rest_since_s is None:
            self._rest_since_s = at_s
        return at_s - self._rest_since_s < _REST_MAX_S

    def _is_at_rest(self, reading: Reading) -> bool:
        """Return whether an output of PX4 shows its disarmed value; unknown, one that closes."""
        if not self._is_px4:
            return False
        channel = self._options.outputs[reading.output]
        pins = px4_pins(channel, self._known)
        told = [self._known.get(f"PWM_{group}_DIS{number}") for group, number in pins]
        known = [value for value in told if value is not None]
        if known:
            return reading.pulse_us in known
        is_valve = channel in self._options.channels
        return is_valve and not is_open(self._options, reading.pulse_us, None)

    def _words(self, reading: Reading) -> str:
        """Return what is seen and what to do about it."""
        channel = self._options.outputs[reading.output]
        if self._is_px4:
            return (
                f"actuator {channel} reads {reading.pulse_us} us, ordered {reading.ordered_us}: "
                "kill switch? else its PWM_ parameters"
            )
        if reading.pulse_us == 0:
            return (
                f"output {channel} gives no pulse: press the safety switch, or set BRD_SAFETY_MASK"
            )
        seen = f"output {channel} reads {reading.pulse_us} us, ordered {reading.ordered_us}"
        if self._known.get(f"SERVO{channel}_FUNCTION") == 0.0:
            return f"{seen}: slow link, or another orders it"
        return f"{seen}: set SERVO{channel}_FUNCTION to 0"
