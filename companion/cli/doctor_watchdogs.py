"""`vrspray doctor --watchdogs`: what closes when this program does not is tried, or asked for."""

from __future__ import annotations

import asyncio
import os
import sys
import time
from collections.abc import Iterator

from companion.cli.answer import note
from companion.cli.ground_doing import in_words
from companion.cli.ground_tasks import ground_setup
from companion.cli.hand import read_line
from companion.cli.link_parts import build_link
from companion.cli.output_parts import engine_setup, servo_options
from companion.cli.run import component_options
from companion.cli.systemd import read_unit, systemctl, unit_path
from companion.config import Config
from companion.doctor.check import Check
from companion.doctor.computer import hardware_watchdog_check, read_computer
from companion.doctor.engine_trial import EngineTrial, try_engine
from companion.doctor.script_trial import try_script
from companion.doctor.watchdogs import (
    Question,
    Systemd,
    asked_check,
    engine_checks,
    questions,
    script_check,
    systemd_checks,
)

_UNIT = "LoadState,ActiveState,WatchdogUSec,WatchdogTimestampMonotonic"


def watchdog_checks(
    config: Config, given: tuple[str, ...], *, wait_s: float | None
) -> Iterator[Check]:
    """Yield a check for each watchdog; `wait_s` None: the vehicle is left out."""
    yield from engine_checks(_engine(config), lease_s=config.output.lease_s)
    yield _script(config, given, wait_s)
    yield from systemd_checks(read_systemd())
    yield hardware_watchdog_check(read_computer({}))
    for question in _questions(config):
        yield _ask(question)


def _engine(config: Config) -> EngineTrial | None:
    if config.output.kind != "gpio":
        return None
    return asyncio.run(try_engine(engine_setup(config), lease_s=config.output.lease_s))


def _script(config: Config, given: tuple[str, ...], wait_s: float | None) -> Check:
    options = servo_options(config)
    if options is None or not options.channels:
        return script_check(None, why="no servo outputs are used")
    if wait_s is None:
        return script_check(None, why="left out: --no-link")
    link = build_link(config, given, component_options(config, watch_mission=True))
    trial = asyncio.run(try_script(link, options, wait_s=wait_s, setup=ground_setup(config)))
    return script_check(trial, words=in_words(trial.reasons))


def read_systemd() -> Systemd:
    """Return what systemd says of its watchdogs: of the system's unit, else of this user's."""
    manager = systemctl("show", "--property=RuntimeWatchdogUSec", is_user=False)
    is_user = not unit_path(is_user=False).exists() and unit_path(is_user=True).exists()
    unit = systemctl("show", "vrspray.service", f"--property={_UNIT}", is_user=is_user)
    text = read_unit(unit_path(is_user=is_user)) or ""
    found = None
    if unit.code == 0:
        pairs = (word.partition("=") for word in unit.text.split())
        found = {key: value for key, _, value in pairs}
    return Systemd(
        runtime_watchdog=manager.text.partition("=")[2] if manager.code == 0 else None,
        unit=found,
        now_s=time.monotonic(),
        has_closer="\nExecStopPost=" in text,
    )


def _questions(config: Config) -> tuple[Question, ...]:
    return questions(
        is_servo=config.output.kind == "servo",
        has_dither=config.output.dither_us > 0,
        has_cutoff=config.safety.pump_cutoff,
        has_alive=config.output.kind == "gpio" and config.gpio.alive_line is not None,
        has_estop=config.safety.estop_line is not None,
    )


def _ask(question: Question) -> Check:
    """Ask at a terminal; s skips. Nobody is asked where there is none."""
    if not question.applies:
        return asked_check(question, None)
    if not _has_terminal():
        return asked_check(question, None, why="is asked at a terminal only")
    note(f"{question.text}?")
    while True:
        note("[y/n, s skips]")
        said = read_line(sys.stdin.fileno())
        word = "skip" if said is None else said.lower()
        if word in ("s", "skip"):
            return asked_check(question, None)
        if word in ("y", "yes", "n", "no"):
            return asked_check(question, word.startswith("y"))


def _has_terminal() -> bool:
    try:
        return os.isatty(sys.stdin.fileno())
    except (OSError, ValueError, AttributeError):
        return False
