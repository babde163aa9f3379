"""`vrspray doctor`: all that must hold before a flight, each check with its fix."""

from __future__ import annotations

import asyncio
import logging
import sys
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from companion.cli.answer import AsJson, Overrides, answer
from companion.cli.doctor_click import guided_click
from companion.cli.doctor_watchdogs import watchdog_checks
from companion.cli.link_parts import build_link, load_with_kept
from companion.cli.output_parts import engine_setup, servo_options
from companion.cli.run import component_options
from companion.cli.sensor_parts import build_sensors
from companion.cli.systemd import is_ours, properties, quoted, read_unit, unit_path, watchdog_is_on
from companion.config import Config
from companion.core.setup import Setup
from companion.doctor.check import Check, Status, application_check, fail, is_ready, split_advice
from companion.doctor.computer import (
    Service,
    computer_checks,
    read_computer,
    read_device,
    serial_check,
    service_checks,
)
from companion.doctor.engine_trial import engine_checks, read_engine
from companion.doctor.gpio import gpio_checks, read_chip, read_register
from companion.doctor.listen import listen
from companion.doctor.outputs import output_checks
from companion.doctor.paper import configuration_checks, map_checks, refused_configuration
from companion.doctor.sensors import Read, read_sensors, sensor_check
from companion.doctor.vehicle import Heard, link_checks, no_link
from companion.errors import ConfigError, LinkError

app = typer.Typer(add_completion=False, rich_markup_mode=None)


@app.command(epilog="Example: vrspray doctor --config examples/anyang/config.toml --no-link")
def doctor(
    config_file: Annotated[
        Path, typer.Option("--config", metavar="FILE", help="Configuration, a TOML file.")
    ],
    no_vehicle: Annotated[
        bool, typer.Option("--no-link", help="Leave out what needs the vehicle.")
    ] = False,
    wait_s: Annotated[
        float, typer.Option(min=1.0, max=120.0, help="Listen to the vehicle for at most this long.")
    ] = 10.0,
    is_click: Annotated[
        bool, typer.Option("--click", help="Guided: let each valve click; nothing else is checked.")
    ] = False,
    is_watchdogs: Annotated[
        bool, typer.Option("--watchdogs", help="Try the watchdogs; nothing else is checked.")
    ] = False,
    is_wet: Annotated[
        bool, typer.Option("--wet", help="With --click: with water, judged by the flow meter.")
    ] = False,
    overrides: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Check all that must hold before a flight; say of each how it is and what to do.

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
        [*(check.line() for check in checks), _summary(checks)],
        as_json=as_json,
    )
    raise typer.Exit(code)


def _all(config: Config, given: tuple[str, ...], *, wait_s: float | None) -> Iterator[Check]:
    yield from configuration_checks(config, today=datetime.now(tz=UTC).astimezone().date())
    yield application_check(config)
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
        yield from no_link("left out: --no-link")
        yield from output_checks(None, options)
        return
    try:
        link = build_link(config, given, component_options(config))
    except LinkError as error:
        yield fail("link", *split_advice(str(error), "correct link.signing_key_file"))
        rest = no_link("the link is not open")
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


def _summary(checks: list[Check]) -> str:
    counts = {status: sum(check.status is status for check in checks) for status in Status}
    verdict = "ready" if is_ready(checks) else "not ready"
    return (
        f"{verdict}: {counts[Status.OK]} ok, {counts[Status.WARN]} to be seen to, "
        f"{counts[Status.FAIL]} failed, {counts[Status.NOT_APPLICABLE]} not applicable"
    )
