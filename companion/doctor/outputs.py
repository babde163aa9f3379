"""Can the autopilot's outputs be trusted: parameters, watchdog script, what the outputs read."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from companion.doctor.check import Check, fail, not_applicable, ok, warn
from companion.doctor.listen import rest_pulses
from companion.doctor.vehicle import Heard
from companion.output.autopilot_check import TOLERANCE_US
from companion.output.autopilot_findings import Finding, findings, px4_wiring
from companion.output.autopilot_guard import REFUSALS
from companion.output.autopilot_options import ServoOptions

_NAMES = ("output-parameters", "disarmed-values", "watchdog-script", "closed-order")
_MASK_OUTPUTS = 16
_BOARD = (
    "fit a driver board that closes when its orders stand still (output.dither_us = 8, "
    "docs/driver-board.md)"
)
_RELAY = "fit a relay that cuts the pump when this computer fails (docs/pump.md)"
Known = Mapping[str, float | None]


def output_checks(heard: Heard | None, options: ServoOptions | None) -> Iterator[Check]:
    """Yield the checks of servo outputs; without any, or unheard, they say so."""
    if options is None:
        yield from (not_applicable(name, "no servo outputs are used") for name in _NAMES)
        return
    if heard is None or heard.system_id is None:
        yield from (not_applicable(name, "no vehicle is heard") for name in _NAMES)
        return
    yield from _parameters(heard, options)
    yield _watchdog(heard, options)
    yield _closed(heard, options)


def _parameters(heard: Heard, options: ServoOptions) -> Iterator[Check]:
    name, rest = "output-parameters", "disarmed-values"
    wiring = px4_wiring(options) if heard.is_px4 else None
    if wiring is not None:
        text, _, fix = wiring.rpartition(": ")
        yield fail(name, text, fix)
        yield not_applicable(rest, "the outputs cannot be had")
        return
    if heard.parameters is None:
        fix = "ask again with a longer --wait-s; see that nothing else loads the link"
        yield warn(name, "the autopilot's parameters were not read in time", fix)
        yield not_applicable(rest, "not read")
        return
    found = findings(options, heard.parameters, is_px4=heard.is_px4)
    at_rest = [one for one in found if heard.is_px4 and _is_at_rest(one)]
    yield _of([one for one in found if one not in at_rest], name, "as they must be")
    if heard.is_px4:
        yield _of(at_rest, rest, "closed while disarmed")
    else:
        yield not_applicable(rest, "ArduPilot has none")


def _is_at_rest(finding: Finding) -> bool:
    """Return whether it is about PX4's values while disarmed or failed."""
    return "_DIS" in finding.text.partition(" is ")[0] or "_FAIL" in finding.text


def _of(found: list[Finding], name: str, good: str) -> Check:
    """Return one check of several findings; the first is named, the others counted."""
    if not found:
        return ok(name, good)
    first = found[0]
    more = f" (and {len(found) - 1} more)" if found[1:] else ""
    text, _, fix = first.text.rpartition(": set ")
    if not text:
        text, _, fix = first.text.rpartition("; set ")
    done = f"set {fix}" if text else "correct it at the autopilot"
    return (fail if first.is_fault else warn)(name, f"{text or fix}{more}", done)


def _watchdog(heard: Heard, options: ServoOptions) -> Check:
    """Check what closes the valves when this computer falls silent."""
    name = "watchdog-script"
    if heard.is_px4:
        return _board_alone(name, options)
    known = heard.parameters
    if known is None:
        return warn(name, "its parameters were not read in time", "ask again, longer: --wait-s")
    trouble = watchdog_trouble(known, options)
    if trouble is None:
        return ok(name, "runs, and knows these outputs")
    text, fix = trouble
    # A board closes valves only: orders to motors are not dithered.
    if options.dither_us and not options.drives:
        return warn(name, f"{text}: only the driver board's alive dither closes", fix)
    return fail(name, text, fix)


def _board_alone(name: str, options: ServoOptions) -> Check:
    """Check what PX4 leaves, which has no script: a board closes valves, and no motor."""
    if not options.dither_us:
        text = "PX4 holds the last order of a dead companion until disarmed"
        return fail(name, text, _BOARD)
    if options.drives:
        text = f"nothing stops the motor at output {options.drives[0].channel} but disarming"
        return warn(name, f"PX4 has none: {text}", _RELAY)
    return not_applicable(name, "PX4 has none: the driver board is the watchdog")


def watchdog_trouble(known: Known, options: ServoOptions) -> tuple[str, str] | None:
    """Return what is wrong with the script on the autopilot, and what to do; None if nothing.

    >>> watchdog_trouble({"SPRW_ENABLE": 0.0}, ServoOptions(channels=(9,)))
    ('SPRW_ENABLE is 0: the script does nothing', 'set SPRW_ENABLE to 1')
    """
    enable = known.get("SPRW_ENABLE")
    if enable is None:
        return (
            "SPRW_ENABLE does not answer: the script does not run",
            "install deploy/ardupilot/vrspray_watchdog.lua and set SCR_ENABLE to 1",
        )
    if enable != 1.0:
        return f"SPRW_ENABLE is {enable:g}: the script does nothing", "set SPRW_ENABLE to 1"
    guarded = (*options.channels, *(drive.channel for drive in options.drives))
    missing = [channel for channel in guarded if not _guards(known, channel)]
    if missing:
        return (
            f"output {missing[0]} is not among those that it closes",
            "set SPRW_FIRST and SPRW_LAST to the outputs of valves and motors, SPRW_MASK to those "
            "besides",
        )
    wrong = _closed_pulse_trouble(known.get("SPRW_CLOSED_US"), options)
    if wrong is not None:
        return wrong
    if options.return_channel is not None and known.get("SPRW_RET_CH") != options.return_channel:
        fix = f"set SPRW_RET_CH to {options.return_channel}"
        return "SPRW_RET_CH is not output.return_channel", fix
    return None


def _closed_pulse_trouble(closed_us: float | None, options: ServoOptions) -> tuple[str, str] | None:
    """Return what is wrong with the script's one pulse: it closes valves and stops motors."""
    fix = f"set SPRW_CLOSED_US to {options.closed_us}"
    if closed_us is None:
        return "SPRW_CLOSED_US does not answer", "ask again, longer: --wait-s"
    # NaN is not equal to anything, nor at most anything.
    if closed_us != options.closed_us:
        return f"SPRW_CLOSED_US is {closed_us:g}, not output.closed_us", fix
    running = [drive for drive in options.drives if not closed_us <= drive.stop_us]
    if running:
        first = running[0]
        return (
            f"at SPRW_CLOSED_US = {closed_us:g} the motor at output {first.channel} runs",
            f"set output.closed_us and SPRW_CLOSED_US to {first.stop_us} or less",
        )
    return None


def _guards(known: Known, channel: int) -> bool:
    first, last = known.get("SPRW_FIRST"), known.get("SPRW_LAST")
    if first is not None and last is not None and 1 <= first <= channel <= last:
        return True
    mask = known.get("SPRW_MASK")
    if mask is None or not 0 <= mask < 1 << _MASK_OUTPUTS:
        return False
    return channel <= _MASK_OUTPUTS and bool(int(mask) >> channel - 1 & 1)


def _closed(heard: Heard, options: ServoOptions) -> Check:
    """Check that the outputs followed the order to close."""
    name = "closed-order"
    if heard.is_px4:
        return not_applicable(name, "not on PX4: its outputs follow orders only while armed")
    if not heard.is_closed_ordered:
        return not_applicable(name, "tried on a disarmed vehicle only")
    refused = [result for result in heard.order_results if result in REFUSALS]
    if refused:
        fix = "set SERVOn_FUNCTION of the valves to 0"
        return fail(name, f"order {REFUSALS[refused[0]]} by the autopilot", fix)
    for channel, pulse_us in rest_pulses(options).items():
        wrong = _reading(name, channel, heard.outputs_us.get(channel), pulse_us)
        if wrong is not None:
            return wrong
    return ok(name, f"{len(options.outputs)} outputs read as ordered")


def _reading(name: str, channel: int, read: int | None, pulse_us: int) -> Check | None:
    """Return what is wrong with what an output reads; None if it reads as ordered."""
    if read is None:
        fix = "see that SERVO_OUTPUT_RAW is streamed (docs/link.md)"
        return warn(name, f"nothing tells what output {channel} does", fix)
    if read == 0:
        fix = "press the safety switch, or set BRD_SAFETY_MASK"
        return fail(name, f"output {channel} gives no pulse", fix)
    if not abs(read - pulse_us) <= TOLERANCE_US:
        fix = f"set SERVO{channel}_FUNCTION to 0, and see who else orders it"
        return fail(name, f"output {channel} reads {read} us, ordered {pulse_us}", fix)
    return None
