"""What of the autopilot's parameters keeps the outputs from doing as ordered: one line each.

Pure: parameters in, findings out. Each names the parameter and what to set it to. A parameter
that is None did not answer or does not exist, which differs between boards and versions.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from companion.output.autopilot_options import DriveOutput, ServoOptions

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

    Either a script on ArduPilot, or a board that wants its widths to move; PX4 has only the board.
    """
    if options.dither_us or (not is_px4 and known.get(_WATCHDOG) == 1.0):
        return None
    what = "output.dither_us is 0" if is_px4 else "no watchdog on autopilot"
    return _warning(f"WARNING {what}: valves stay open if companion stops")


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
    """Return whether a pulse opens a valve: it lies on the side of `full_us`, or is no number."""
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
