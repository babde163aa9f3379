"""Are the lines of this computer fit to drive valves: facts from `gpiod`, and their judgement."""

from __future__ import annotations

import grp
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from companion.doctor.check import Check, fail, not_applicable, ok, warn
from companion.errors import ActuatorError
from companion.output.engine.gpiod_lines import CONSUMER, find_chip, keeps_levels, load_gpiod
from companion.output.engine.setup import Wiring, hazards
from companion.wording import install_command

_NAMES = ("gpio-chip", "gpio-lines", "gpio-wiring")


@dataclass(frozen=True, slots=True, kw_only=True)
class Line:
    """A line that a valve hangs on; `consumer` is who holds it."""

    number: int
    is_used: bool
    consumer: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Chip:
    """The chip as it was found; `problem` and `fix` say why it was not."""

    name: str
    lines: tuple[Line, ...] = ()
    problem: str | None = None
    fix: str = ""
    keeps_levels: bool | None = None


def read_chip(name: str, numbers: tuple[int, ...]) -> Chip:
    """Return the facts of a chip and of some of its lines; holds nothing."""
    try:
        lines = _lines(load_gpiod(), name, numbers)
    except ActuatorError as error:
        text, found, _ = str(error).partition(f": {install_command('vehicle')}")
        correct = "correct output.chip; gpiodetect lists the chips"
        fix = install_command("vehicle") if found else correct
        return Chip(name=name, problem=text, fix=fix)
    except PermissionError:
        return Chip(name=name, problem=f"{name}: permission denied", fix=_group_fix("gpio"))
    except (OSError, ValueError) as error:
        return Chip(
            name=name,
            problem=f"{name}: {error}",
            fix="look up its lines with gpioinfo, and correct valve.channel",
        )
    return Chip(name=name, lines=lines, keeps_levels=keeps_levels())


def read_register(device: str) -> Chip:
    """Return the facts of the SPI device that a shift register hangs on."""
    if not Path(device).exists():
        fix = "dtparam=spi=on in config.txt, or correct gpio.spi_device"
        return Chip(name=device, problem=f"{device} does not exist", fix=fix)
    if not os.access(device, os.R_OK | os.W_OK):
        return Chip(name=device, problem=f"{device}: permission denied", fix=_group_fix("spi"))
    return Chip(name=device, keeps_levels=True)


def _lines(gpiod: Any, name: str, numbers: tuple[int, ...]) -> tuple[Line, ...]:
    with gpiod.Chip(find_chip(gpiod, name)) as chip:
        found = [chip.get_line_info(number) for number in numbers]
    return tuple(
        Line(number=number, is_used=info.used, consumer=info.consumer or "")
        for number, info in zip(numbers, found, strict=True)
    )


def _group_fix(group: str) -> str:
    """Return what to do about a device that only a group may use."""
    try:
        mine = grp.getgrnam(group).gr_gid in (*os.getgroups(), os.getegid())
    except KeyError:
        return "run as a user who can open the device"
    if mine:
        return "check the permissions of the device: ls -l /dev"
    return f"sudo usermod -aG {group} $USER, then log in again"


def gpio_checks(chip: Chip | None, wiring: Wiring | None) -> Iterator[Check]:
    """Yield the checks of chip, lines and wiring."""
    if chip is None or wiring is None:
        yield from (not_applicable(name, "no GPIO lines are used") for name in _NAMES)
        return
    if chip.problem is not None:
        yield fail("gpio-chip", chip.problem, chip.fix)
        yield not_applicable("gpio-lines", "the chip cannot be opened")
    elif not chip.lines:
        yield ok("gpio-chip", chip.name)
        yield not_applicable("gpio-lines", "a shift register has its own outputs")
    else:
        yield ok("gpio-chip", chip.name)
        yield _free(chip)
    yield _wiring(wiring, chip)


def _free(chip: Chip) -> Check:
    taken = [line for line in chip.lines if line.is_used]
    if not taken:
        return ok("gpio-lines", f"{len(chip.lines)} lines are free")
    first = taken[0]
    text = f"line {first.number} is held by {first.consumer or 'the kernel'}"
    if first.consumer == CONSUMER:
        return warn("gpio-lines", text, "stop the running vrspray so that all checks can run")
    return fail("gpio-lines", text, "stop that program, or move the valve to a free line")


def _wiring(wiring: Wiring, chip: Chip) -> Check:
    found = hazards(wiring, keeps_levels=chip.keeps_levels)
    if not found:
        return ok("gpio-wiring", "if the program is killed, the valves close")
    more = f" (and {len(found) - 1} more)" if found[1:] else ""
    return warn(
        "gpio-wiring", f"{found[0]}{more}", "see docs/howto/wire-gpio.md for wiring and settings"
    )
