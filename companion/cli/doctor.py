"""`vrspray doctor`: all that must hold before a flight, each check with its fix."""

from __future__ import annotations

import asyncio
import logging
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, date, datetime
from typing import Annotated

import typer

from companion.assembly import build_setup, deliverable, flight_map_of
from companion.cli.answer import AsJson, ConfigFile, Overrides, answer, new_app
from companion.cli.doctor_click import guided_click
from companion.cli.doctor_watchdogs import watchdog_checks
from companion.cli.output_parts import build_link, engine_setup, load_with_kept, servo_options
from companion.cli.run import component_options
from companion.cli.sensor_parts import build_sensors
from companion.cli.systemd import is_ours, properties, quoted, read_unit, unit_path, watchdog_is_on
from companion.cli.terminal import Styled, visible
from companion.config import Config
from companion.config.rules import mismatches, without_effect, without_power
from companion.core.setup import Setup
from companion.doctor.check import (
    Check,
    Status,
    application_check,
    calibration_age,
    fail,
    is_ready,
    label_check,
    not_applicable,
    ok,
    split_advice,
    valve_age,
    warn,
)
from companion.doctor.computer import (
    Service,
    computer_checks,
    read_computer,
    read_device,
    serial_check,
    service_checks,
)
from companion.doctor.gpio import (
    Read,
    engine_checks,
    gpio_checks,
    read_chip,
    read_engine,
    read_register,
    read_sensors,
    sensor_check,
)
from companion.doctor.vehicle import Heard, link_checks, listen, no_link, rest_pulses
from companion.errors import ConfigError, LinkError, MapError
from companion.flight_map import FlightMap
from companion.link.signing import read_key
from companion.output.autopilot_guard import REFUSALS, Finding, findings, px4_wiring
from companion.output.autopilot_options import TOLERANCE_US, ServoOptions
from companion.wording import counted

app = new_app()


@app.command(epilog="Example: vrspray doctor --config examples/anyang/config.toml --no-link")
def doctor(
    config_file: ConfigFile,
    no_vehicle: Annotated[
        bool, typer.Option("--no-link", help="Skip the checks that need the vehicle.")
    ] = False,
    wait_s: Annotated[
        float, typer.Option(min=1.0, max=120.0, help="Longest time to listen to the vehicle.")
    ] = 10.0,
    is_click: Annotated[
        bool, typer.Option("--click", help="Click each valve, guided; check nothing else.")
    ] = False,
    is_watchdogs: Annotated[
        bool, typer.Option("--watchdogs", help="Test the watchdogs; check nothing else.")
    ] = False,
    is_wet: Annotated[
        bool, typer.Option("--wet", help="With --click: use water, and judge by the flow meter.")
    ] = False,
    overrides: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Check everything that must hold before a flight, with a fix for each problem.

    A disarmed ArduPilot is ordered to close its valves; nothing is opened without --click.
    Exit 0: no check failed; 1: one did; 2: the configuration cannot be used.
    """
    logging.basicConfig(stream=sys.stderr, level=logging.ERROR)
    code = 0
    try:
        config, given = load_with_kept(config_file, overrides or ())
    except ConfigError as error:
        checks, code = [refused_configuration(error), *_computer(None)], 2
    else:
        vehicle_s = None if no_vehicle else wait_s
        checks = []
        if is_watchdogs:
            checks += watchdog_checks(config, given, wait_s=vehicle_s)
        if is_click or is_wet:
            checks += guided_click(config, given, is_wet=is_wet)
        if not (is_click or is_wet or is_watchdogs):
            checks += _all(config, given, wait_s=vehicle_s)
        code = 0 if is_ready(checks) else 1
    answer(
        {"ok": is_ready(checks), "checks": [check.as_object() for check in checks]},
        [*_in_order(checks), _summary(checks)],
        as_json=as_json,
    )
    raise typer.Exit(code)


def _all(config: Config, given: tuple[str, ...], *, wait_s: float | None) -> Iterator[Check]:
    yield from configuration_checks(config, today=datetime.now(tz=UTC).astimezone().date())
    yield application_check(config)
    yield label_check(config, datetime.now(tz=UTC))
    found, setup = map_checks(config, given, now=datetime.now(tz=UTC))
    yield from found
    yield from _computer(config)
    yield from service_checks(read_service(config))
    yield serial_check(read_device(config.link.url))
    yield from _vehicle(config, given, setup, wait_s)
    yield from _gpio(config)
    sensors = build_sensors(config)
    found_sensors = asyncio.run(read_sensors(sensors)) if sensors else Read()
    yield sensor_check(len(sensors), found_sensors)


def _gpio(config: Config) -> Iterator[Check]:
    if config.output.kind != "gpio":
        yield from gpio_checks(None, None)
        yield from engine_checks(None)
        return
    setup = engine_setup(config)
    is_register = setup.backend == "spi595"
    chip = (
        read_register(setup.device) if is_register else read_chip(setup.device, setup.wiring.lines)
    )
    yield from gpio_checks(chip, setup.wiring)
    yield from engine_checks(read_engine(setup))


def _computer(config: Config | None) -> Iterator[Check]:
    folders = {}
    if config is not None:
        folders = {
            "journal-folder": config.resolve(config.journal.folder),
            "state-folder": config.resolve(config.link.state_folder),
        }
    needs_engine = config is not None and config.output.kind == "gpio" and config.gpio.realtime
    yield from computer_checks(read_computer(folders), needs_engine=needs_engine)


def _vehicle(
    config: Config, given: tuple[str, ...], setup: Setup | None, wait_s: float | None
) -> Iterator[Check]:
    """Yield the checks that need the vehicle."""
    options = servo_options(config)
    if wait_s is None:
        yield from no_link("skipped (--no-link)")
        yield from output_checks(None, options)
        return
    try:
        link = build_link(config, given, component_options(config))
    except LinkError as error:
        yield fail("link", *split_advice(str(error), "correct link.signing_key_file"))
        rest = no_link("the link did not open")
        yield from (check for check in rest if check.name != "link")
        yield from output_checks(None, options)
        return
    heard: Heard = asyncio.run(
        listen(
            link,
            config.link.url,
            options=options,
            wait_s=wait_s,
        )
    )
    yield from link_checks(heard, config, setup)
    yield from output_checks(heard, options)


def read_service(config: Config) -> Service:
    """Return the unit that is installed for the system, else that of this user."""
    is_user = not unit_path(is_user=False).exists() and unit_path(is_user=True).exists()
    text = read_unit(unit_path(is_user=is_user)) or ""
    start = next((line for line in text.splitlines() if line.startswith("ExecStart=")), "")
    path = str(config.path.resolve())
    return Service(
        is_installed=bool(text),
        is_user=is_user,
        is_watched=watchdog_is_on(text.splitlines()),
        config=str(config.path),
        uses_config=not is_ours(text) or start.endswith(f" {quoted(path)}"),
        state=properties(is_user=is_user),
    )


_ORDER = (Status.OK, Status.NOT_APPLICABLE, Status.WARN, Status.FAIL)
_COLOURS = {Status.WARN: typer.colors.YELLOW, Status.FAIL: typer.colors.RED}


def _in_order(checks: list[Check]) -> Iterator[str]:
    """Yield the checks, the worst last and in colour, where a terminal still shows it."""
    for check in sorted(checks, key=lambda check: _ORDER.index(check.status)):
        colour = None if "NO_COLOR" in os.environ else _COLOURS.get(check.status)
        line = check.line()
        yield line if colour is None else Styled(typer.style(visible(line), fg=colour))


def _summary(checks: list[Check]) -> str:
    counts = {status: sum(check.status is status for check in checks) for status in Status}
    return (
        f"{_verdict(checks)}: {counts[Status.OK]} ok, {counts[Status.WARN]} to check, "
        f"{counts[Status.FAIL]} failed, {counts[Status.NOT_APPLICABLE]} not applicable"
    )


def _verdict(checks: list[Check]) -> str:
    """Return the verdict; ready is nobody who has not heard the vehicle."""
    if not is_ready(checks):
        return "not ready"
    link = next((check for check in checks if check.name == "link"), None)
    if link is None:  # a test of valves or watchdogs alone
        return "passed"
    return "nothing failed, no vehicle asked" if link.status is Status.NOT_APPLICABLE else "ready"


# What can be checked at a desk: configuration, map, what was measured, what was declared.

# Lags of docs and examples, measured on simulated sprayers: on, off, up, down.
_EXAMPLE_LAGS = frozenset({(0.10, 0.08, 0.10, 0.10), (0.1028, 0.1059, 0.1033, 0.1030)})


def configuration_checks(config: Config, *, today: date) -> Iterator[Check]:
    """Yield what the configuration alone tells; it has been read, so it is valid by itself."""
    yield _agreement(config)
    yield _output(config)
    yield _guard(config)
    yield _dead_man(config)
    yield _lags(config)
    yield calibration_age(config.lag.measured_on, today)
    yield valve_age(config, today)
    yield _signing(config)


def refused_configuration(error: ConfigError) -> Check:
    """Return the check of a configuration that cannot be used; its error says what to write."""
    return fail("configuration", *split_advice(str(error), "see vrspray config check"))


def _agreement(config: Config) -> Check:
    name = "configuration"
    wrong = [*mismatches(config)]
    if wrong:
        return fail(name, f"{wrong[0].key}: {wrong[0].text}", "correct the configuration")
    idle = [*without_effect(config)]
    if idle:
        keys = ", ".join(found.key for found in idle)
        return warn(name, f"these keys have no effect in this version: {keys}", "remove them")
    return ok(name, f"{config.path}: its settings are valid")


def _output(config: Config) -> Check:
    kind = config.output.kind
    if kind == "none":
        return warn(
            "output", "dry run: no valve will open", 'write output.kind = "servo" or "gpio"'
        )
    what = "servo outputs" if kind == "servo" else f"GPIO lines of {config.output.chip}"
    channels = ", ".join(str(valve.channel) for valve in config.valve)
    return ok("output", f"{len(config.valve)} valves on {what} {channels}")


def _guard(config: Config) -> Check:
    if config.output.kind != "servo":
        return not_applicable("output-guard", "no servo outputs are used")
    text, fix = without_power(config)
    if fix:
        return warn("output-guard", text, fix)
    return (ok if config.output.dither_us else not_applicable)("output-guard", text)


def _dead_man(config: Config) -> Check:
    name = "pump-cutoff"
    if config.output.kind == "none":
        return not_applicable(name, "dry run")
    if config.safety.pump_cutoff:
        return ok(
            name,
            "configured: a relay cuts the pump when this computer fails; test it before the flight",
        )
    return warn(
        name,
        "none configured: a stuck valve or a stopped computer would keep spraying",
        "fit a relay that cuts the pump, then write safety.pump_cutoff = true",
    )


def _lags(config: Config) -> Check:
    lag = config.lag
    if (lag.on_s, lag.off_s, lag.up_s, lag.down_s) in _EXAMPLE_LAGS:
        return warn(
            "lags",
            "these are an example's lags, measured on a simulated sprayer",
            "measure your own: vrspray calibrate lag",
        )
    if config.settings()["lag.position_s"][1] == "default":
        return warn(
            "lags",
            "lag.position_s is not set: positions are treated as 0 s old",
            "measure it (vrspray calibrate lag-marks) and write it into the configuration",
        )
    return ok("lags", f"on {lag.on_s:g}, off {lag.off_s:g}, position {lag.position_s:g} s")


def _signing(config: Config) -> Check:
    name, file = "signing-key", config.link.signing_key_file
    if file is None:
        return not_applicable(name, "messages are not signed")
    try:
        read_key(config.resolve(file))
    except LinkError as error:
        return fail(name, *split_advice(str(error), "give the path of the key"))
    return ok(name, "readable by its owner only")


def map_checks(
    config: Config, overrides: Sequence[str] = (), *, now: datetime
) -> tuple[list[Check], Setup | None]:
    """Return whether map and boundary can be flown, and what was built of them."""
    table = config.prescription
    file = "FILE" if table is None else config.resolve(table.file)
    try:
        flight_map = flight_map_of(config, overrides)
        setup = build_setup(config, flight_map)
    except MapError as error:
        fix = error.fix or f"see vrspray map check {file}"
        return [fail("map", str(error).removesuffix(f"; {error.fix}"), fix), *_no_map()], None
    except ConfigError as error:
        advice = split_advice(str(error), f"see vrspray config check {config.path}")
        return [fail("map", *advice), *_no_map()], None
    rates = setup.prescription.rates_l_ha
    area_ha = setup.prescription.field.area / 1e4
    span = f"{min(rates):g} to {max(rates):g} L/ha" if rates else "no rates"
    found = [
        ok("map", f"{area_ha:.2f} ha, {span}, hash {setup.prescription.sha256[:8]}"),
        _flight_map(flight_map, now),
        _rates(config, setup),
    ]
    return found, setup


def _no_map() -> list[Check]:
    return [not_applicable(name, "no map") for name in ("flight-map", "rates")]


def _flight_map(flight_map: FlightMap, now: datetime) -> Check:
    """Say which flight map this is, how old it is, and what was found when it was compiled."""
    name = "flight-map"
    days = flight_map.age_days(now)
    age = "on an unknown day" if days is None else f"{counted(int(days), 'day')} ago"
    text = f"{flight_map.sha256[:8]} of {flight_map.source}, compiled {age}"
    if not flight_map.findings:
        return ok(name, f"{text}; no problems found in the map")
    first = flight_map.findings[0]
    return warn(
        name,
        f"{text}; {counted(len(flight_map.findings), 'finding')}, the first: {first.text}",
        first.fix or f"see vrspray map check {flight_map.source}",
    )


def _rates(config: Config, setup: Setup) -> Check:
    """Check the prescribed rates against what the nozzle sets deliver at the planned speed."""
    if config.mission is None:
        return not_applicable("rates", "mission.speed_m_s is not set")
    speed_m_s = config.mission.speed_m_s
    problems = deliverable(setup, speed_m_s)
    if problems:
        return warn("rates", problems[0].text, problems[0].fix)
    return ok("rates", f"the nozzle sets can deliver all rates at {speed_m_s:g} m/s")


# Can the autopilot's outputs be trusted: parameters, watchdog script, what the outputs read.

_NAMES = ("output-parameters", "disarmed-values", "watchdog-script", "closed-order")
_MASK_OUTPUTS = 16
_BOARD = (
    "fit a driver board that closes when its signal stops changing (output.dither_us = 8, "
    "docs/howto/build-a-driver-board.md)"
)
_RELAY = (
    "fit a relay that cuts the pump when this computer fails (docs/howto/pump-instead-of-valves.md)"
)
Known = Mapping[str, float | None]


def output_checks(heard: Heard | None, options: ServoOptions | None) -> Iterator[Check]:
    """Yield the checks of servo outputs; without any, or unheard, they say so."""
    if options is None:
        yield from (not_applicable(name, "no servo outputs are used") for name in _NAMES)
        return
    if heard is None or heard.system_id is None:
        yield from (not_applicable(name, "no vehicle heard") for name in _NAMES)
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
        yield not_applicable(rest, "the outputs cannot be read")
        return
    if heard.parameters is None:
        fix = "try again with a longer --wait-s, and check that nothing else loads the link"
        yield warn(name, "the autopilot's parameters were not read in time", fix)
        yield not_applicable(rest, "not read")
        return
    found = findings(options, heard.parameters, is_px4=heard.is_px4)
    at_rest = [one for one in found if heard.is_px4 and _is_at_rest(one)]
    yield _of([one for one in found if one not in at_rest], name, "set correctly")
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
        return warn(
            name, "its parameters were not read in time", "try again with a longer --wait-s"
        )
    trouble = watchdog_trouble(known, options)
    if trouble is None:
        return ok(name, "runs and guards these outputs")
    text, fix = trouble
    if not options.needs_guard:
        return warn(name, f"{text} (output.guard)", fix)
    # A board closes valves only: orders to motors are not dithered.
    if options.dither_us and not options.drives:
        return warn(name, f"{text}: only the driver board's alive dither closes the valves", fix)
    return fail(name, text, fix)


def _board_alone(name: str, options: ServoOptions) -> Check:
    """Check what PX4 leaves, which has no script: a board closes valves, and no motor."""
    if not options.dither_us:
        text = "if the companion fails, PX4 keeps its last order until disarmed"
        return (fail if options.needs_guard else warn)(name, text, _BOARD)
    if options.drives:
        text = f"only disarming stops the motor at output {options.drives[0].channel}"
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
            "set SCR_ENABLE to 1 and install deploy/ardupilot/vrspray_watchdog.lua "
            "(vrspray examples copy deploy)",
        )
    if enable != 1.0:
        return f"SPRW_ENABLE is {enable:g}: the script does nothing", "set SPRW_ENABLE to 1"
    guarded = (*options.channels, *(drive.channel for drive in options.drives))
    missing = [channel for channel in guarded if not _guards(known, channel)]
    if missing:
        return (
            f"the script does not close output {missing[0]}",
            "set SPRW_FIRST and SPRW_LAST to the range of valve and motor outputs, and SPRW_MASK "
            "to "
            "the others",
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
        return "SPRW_CLOSED_US does not answer", "try again with a longer --wait-s"
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
        return not_applicable(
            name, "not possible on PX4: its outputs follow orders only while armed"
        )
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
    return ok(name, f"{len(options.outputs)} outputs follow their orders")


def _reading(name: str, channel: int, read: int | None, pulse_us: int) -> Check | None:
    """Return what is wrong with what an output reads; None if it reads as ordered."""
    if read is None:
        fix = "make sure that SERVO_OUTPUT_RAW is streamed (docs/howto/links.md)"
        return warn(name, f"the autopilot does not report output {channel}", fix)
    if read == 0:
        fix = "press the safety switch, or set BRD_SAFETY_MASK"
        return fail(name, f"output {channel} gives no pulse", fix)
    if not abs(read - pulse_us) <= TOLERANCE_US:
        fix = f"set SERVO{channel}_FUNCTION to 0, and find out what else drives it"
        return fail(name, f"output {channel} reads {read} us, but {pulse_us} us were ordered", fix)
    return None
