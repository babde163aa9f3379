"""Whether the autopilot's outputs can be trusted, and in words why not.

It hears what the autopilot answers, what its parameters are and what its outputs read. A refusal is
a fault for good; outputs that do not follow are one until they do, and for good when it happens
again and again.

What of the autopilot's parameters keeps the outputs from doing as ordered: one line each. Pure:
parameters in, findings out. Each names the parameter and what to set it to. A parameter that is
None did not answer or does not exist, which differs between boards and versions.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from companion.output.autopilot_options import OutputCheck, Reading, ServoOptions, ardupilot_places

if TYPE_CHECKING:
    from companion.output.autopilot_options import DriveOutput

Known = Mapping[str, float | None]

ACTUATOR_COUNT = 6
_GROUPS = {"MAIN": 16, "AUX": 8}  # outputs of a PX4 board, at most
_FIRST_FUNCTION = 300  # Peripheral via Actuator Set 1 is 301
# The functions on which DO_SET_SERVO is taken besides 0 (AP_ServoRelayEvents.cpp).
_SPRAYER = frozenset({22, 23})
_PILOT = frozenset({1, *range(51, 67), *range(140, 156)})
_GRIPPER = 28
# A parameter of the watchdog script; it exists only while the script is loaded.
_WATCHDOG = "SPRW_ENABLE"
# Of the span: nearer to closed than this is closed for a driver board.
_CLOSED_SHARE = 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """One line; with a fault the outputs cannot be trusted, and all stays closed."""

    text: str
    is_fault: bool


def wanted_parameters(options: ServoOptions, *, is_px4: bool) -> tuple[str, ...]:
    """Return what has to be read first."""
    if is_px4:
        return tuple(
            f"PWM_{group}_FUNC{number}"
            for group, count in _GROUPS.items()
            for number in range(1, count + 1)
        )
    functions = tuple(f"SERVO{channel}_FUNCTION" for channel in options.outputs)
    more = ("SERVO_32_ENABLE",) if max(options.outputs) > 16 else ()
    safety = ("BRD_SAFETY_DEFLT", "BRD_SAFETY_MASK", _WATCHDOG)
    return (*functions, "SPRAY_ENABLE", *safety, *more)


def more_parameters(options: ServoOptions, known: Known, *, is_px4: bool) -> tuple[str, ...]:
    """Return what has to be read besides, now that it is known which outputs carry actuators."""
    if not is_px4:
        return ()
    return tuple(
        f"PWM_{group}_{kind}{number}"
        for channel in options.outputs
        for group, number in px4_pins(channel, known)
        for kind in ("MIN", "MAX", "DIS", "FAIL")
        if f"PWM_{group}_{kind}{number}" not in known
    )


def px4_pins(channel: int, known: Known) -> list[tuple[str, int]]:
    """Return which outputs show an actuator: group and number.

    >>> px4_pins(2, {"PWM_MAIN_FUNC9": 301.0, "PWM_AUX_FUNC1": 302.0})
    [('AUX', 1)]
    """
    return [
        (group, number)
        for group, count in _GROUPS.items()
        for number in range(1, count + 1)
        if known.get(f"PWM_{group}_FUNC{number}") == _FIRST_FUNCTION + channel
    ]


def px4_wiring(options: ServoOptions) -> str | None:
    """Return why PX4 cannot have these outputs at all: it has six actuators, numbered from 1."""
    if len(options.outputs) > ACTUATOR_COUNT:
        return (
            f"{len(options.outputs)} outputs, PX4 takes orders for {ACTUATOR_COUNT}: "
            "fewer valves, or ArduPilot"
        )
    wrong = [channel for channel in options.outputs if channel > ACTUATOR_COUNT]
    if wrong:
        return f"channel {wrong[0]} on PX4: write the number of its actuator, 1 to 6"
    return None


def findings(options: ServoOptions, known: Known, *, is_px4: bool) -> list[Finding]:
    """Return everything that is wrong, faults first."""
    found = [*(_px4(options, known) if is_px4 else _ardupilot(options, known))]
    return sorted(_merged(found), key=lambda finding: not finding.is_fault)


def dead_man(options: ServoOptions, known: Known, *, is_px4: bool) -> Finding | None:
    """Return what is missing for the valves to close when this computer dies.

    Either a script on ArduPilot, or a board that wants its widths to move; PX4 has only the board,
    and a board stops no motor.
    """
    has_board = options.dither_us > 0 and bool(options.channels)
    if has_board or (not is_px4 and known.get(_WATCHDOG) == 1.0):
        return None
    what = "output.dither_us is 0" if is_px4 else "no watchdog on autopilot"
    return _warning(f"WARNING {what}: valves stay open without power")


def _merged(found: Sequence[Finding]) -> Iterator[Finding]:
    """Yield each finding once: those that differ in the number of the output only are counted."""
    alike: dict[tuple[bool, str], list[Finding]] = {}
    for finding in found:
        key = re.sub(r"(?<=[A-Z])\d+|channel \d+|30[1-6]", "", finding.text)
        alike.setdefault((finding.is_fault, key), []).append(finding)
    for group in alike.values():
        more = f" (and {len(group) - 1} more)" if len(group) > 1 else ""
        yield Finding(text=group[0].text + more, is_fault=group[0].is_fault)


def _ardupilot(options: ServoOptions, known: Known) -> Iterator[Finding]:
    functions = {channel: known.get(f"SERVO{channel}_FUNCTION") for channel in options.outputs}
    unread = [channel for channel, value in functions.items() if value is None]
    if unread:
        names = ", ".join(f"SERVO{channel}_FUNCTION" for channel in unread[:2])
        yield _warning(f"{names} cannot be read: see that it is 0")
    for channel, value in functions.items():
        if value is not None and value != 0.0:
            yield _function(channel, value, is_sprayer_on=known.get("SPRAY_ENABLE") == 1.0)
    if max(options.outputs) > 16 and known.get("SERVO_32_ENABLE") == 0.0:
        yield _fault("SERVO_32_ENABLE is 0: no outputs above 16; set it to 1 and reboot")
    mask = _whole(known.get("BRD_SAFETY_MASK"))
    missing = sum(
        1 << channel - 1
        for channel in options.outputs
        if channel <= 16 and not mask >> channel - 1 & 1
    )
    if known.get("BRD_SAFETY_DEFLT") == 1.0 and missing:
        yield _warning(
            "safety switch: no pulses before it is pressed, unless BRD_SAFETY_MASK is "
            f"{mask + missing}"
        )


def _whole(value: float | None) -> int:
    """Return a mask of bits; what is no such number has none set."""
    return int(value) if value is not None and 0.0 <= value < 2**32 else 0


def _function(channel: int, value: float, *, is_sprayer_on: bool) -> Finding:
    name = f"SERVO{channel}_FUNCTION is {value:g}"
    if value in _SPRAYER and is_sprayer_on:
        return _fault(f"{name} and SPRAY_ENABLE 1: both would order it; set it to 0")
    if value in _PILOT:
        return _warning(f"{name}: the pilot's control can take it over; set it to 0")
    if value in _SPRAYER or value == _GRIPPER:
        return _warning(f"{name}: set it to 0, or others may order it")
    return _fault(f"{name}: orders are refused; set it to 0")


def _px4(options: ServoOptions, known: Known) -> Iterator[Finding]:
    functions = wanted_parameters(options, is_px4=True)
    if all(known.get(name) is None for name in functions):
        yield _warning("PWM_MAIN_FUNC1 to 16 cannot be read: outputs are not checked")
        return
    for channel in options.outputs:
        pins = px4_pins(channel, known)
        if not pins:
            function = _FIRST_FUNCTION + channel
            yield _fault(
                f"no output for channel {channel}: set its PWM_MAIN_FUNCn or PWM_AUX_FUNCn "
                f"to {function}"
            )
        for group, number in pins:
            yield from _pin(options, known, channel, f"PWM_{group}_{{}}{number}")


def _pin(options: ServoOptions, known: Known, channel: int, name: str) -> Iterator[Finding]:
    """Yield what is wrong with one output: its ends, and what it shows when disarmed or failed."""
    ends = sorted((options.closed_us, options.full_us))
    for kind, wanted in zip(("MIN", "MAX"), ends, strict=True):
        value = known.get(name.format(kind))
        if value is not None and value != wanted:
            key = "closed_us" if wanted == options.closed_us else "full_us"
            yield _fault(f"{name.format(kind)} is {value:g}: set it to {wanted} (output.{key})")
    is_return = channel == options.return_channel
    drive = options.drive_at(channel)
    rest_us = options.full_us if is_return else options.closed_us
    if drive is not None:
        rest_us = drive.stop_us
        if not (ends[0] <= drive.stop_us and drive.max_us <= ends[1]):
            yield _fault(f"drive at {channel}: keep its pulses within {ends[0]} to {ends[1]} us")
    disarmed = known.get(name.format("DIS"))
    if disarmed is not None and disarmed != rest_us:
        text = f"{name.format('DIS')} is {disarmed:g}: set it to {rest_us}"
        if not is_return and is_open(options, disarmed, drive):
            yield _fault(f"{text}, else disarming opens")
        else:
            yield _warning(text)
    failed = known.get(name.format("FAIL"))
    is_active = failed is not None and not is_return and is_open(options, failed, drive)
    if failed is not None and failed >= 0.0 and is_active:
        yield _warning(f"{name.format('FAIL')} is {failed:g}, which opens: set it to {rest_us}")


def is_open(options: ServoOptions, pulse_us: float, drive: DriveOutput | None) -> bool:
    """Return whether a pulse opens a valve: it lies on the side of `full_us`, or is none."""
    if drive is not None:
        return not pulse_us <= drive.stop_us
    share = (pulse_us - options.closed_us) / (options.full_us - options.closed_us)
    return not share <= _CLOSED_SHARE


def _fault(text: str) -> Finding:
    return Finding(text=text, is_fault=True)


def _warning(text: str) -> Finding:
    return Finding(text=text, is_fault=False)


def px4_places(channels: Sequence[int], known: Known) -> tuple[tuple[tuple[int, int], ...], ...]:
    """Return where PX4 may show its actuators.

    Which group is which port differs between boards, so each output is looked for at both.

    >>> px4_places([1], {"PWM_AUX_FUNC3": 301.0})
    (((0, 2), (1, 2)),)
    """
    return tuple(
        tuple((port, number - 1) for _, number in px4_pins(channel, known) for port in (0, 1))
        for channel in channels
    )


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
    def is_guarded(self) -> bool:
        """Return whether something beside the companion closes, where that is asked for."""
        missing = dead_man(self._options, self._known, is_px4=self._is_px4)
        return missing is None or not self._options.needs_guard

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
        # The script may have answered too late, or start later than we.
        return () if self.is_guarded or self._is_px4 else (_WATCHDOG,)

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
