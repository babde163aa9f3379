"""Is this computer fit to drive valves: its lines, the valve engine's watchdogs, and its sensors.

The engine is tried in a process of its own and on no line of this computer: it is the one that
flies, with the wiring that flies, but its levels go into a file. All valves are opened there; then
the plans stop, and in a second trial the engine is killed. What is measured is this computer's: its
load, its right to real-time priority.
"""

from __future__ import annotations

import asyncio
import grp
import os
import signal
import tempfile
import time
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from companion.core.types import FlowReport, Input, PressureReport, SprayPlan, TankReport
from companion.doctor.check import Check, fail, not_applicable, ok, split_advice, warn
from companion.errors import ActuatorError, SensorError
from companion.output.engine.lines import CONSUMER, find_chip, keeps_levels, load_gpiod
from companion.output.engine.selftest import SelfTest
from companion.output.engine.wire import WAKE_LATE_MAX_S, EngineSetup, Wiring, hazards
from companion.output.gpio import GpioExecutor
from companion.ports import Sensor
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
        text, found, _ = str(error).partition(f"; add it: {install_command('vehicle')}")
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


_STEP_S = 0.005
_PLAN_EVERY_S = 0.05
_OPEN_S = 0.5
_WAIT_S = 3.0


@dataclass(frozen=True, slots=True, kw_only=True)
class EngineTrial:
    """Seconds from the end of the lease, and from the kill, until all was closed; None: never.

    `alive_changes` is how often the ALIVE output changed while plans came; None: there is none.
    `problem` is why there is nothing to judge.
    """

    lease_s: float | None = None
    killed_s: float | None = None
    alive_changes: int | None = None
    is_alive_after: bool = False
    problem: str | None = None


async def try_engine(setup: EngineSetup, *, lease_s: float) -> EngineTrial:
    """Return how soon everything is closed when plans stop, and when the engine is killed."""
    with tempfile.TemporaryDirectory(prefix="vrspray-doctor-") as folder:
        file = Path(folder) / "levels"
        trial = replace(setup, backend="file", device=str(file))
        levels = _Levels(file, setup.wiring)
        try:
            late_s, changes = await _without_plans(trial, levels, lease_s)
            killed_s, is_alive_after = await _killed(trial, levels, lease_s)
        except ActuatorError as error:
            return EngineTrial(problem=str(error))
    return EngineTrial(
        lease_s=late_s,
        killed_s=killed_s,
        alive_changes=None if setup.wiring.alive is None else changes,
        is_alive_after=is_alive_after,
    )


class _Levels:
    """The levels in the engine's file, with the ALIVE output apart."""

    def __init__(self, file: Path, wiring: Wiring) -> None:
        self._file = file
        self._alive_bit = 0 if wiring.alive is None else 1 << wiring.alive
        self._safe = wiring.safe_levels & ~self._alive_bit

    def read(self) -> tuple[bool, bool]:
        """Return whether all is safe, and the level of ALIVE."""
        try:
            levels = int.from_bytes(self._file.read_bytes()[:8], "little")
        except OSError:
            return False, False
        return levels & ~self._alive_bit == self._safe, bool(levels & self._alive_bit)


async def _opened(
    executor: GpioExecutor, levels: _Levels, lease_s: float, count: int
) -> tuple[float, int]:
    """Send plans with all valves open for a while; return the end of the lease, and ALIVE's edges.

    ActuatorError where nothing opens.
    """
    until_s = time.monotonic() + _OPEN_S
    end_s, sent_s, changes, number = 0.0, float("-inf"), 0, 0
    was_alive, has_opened = levels.read()[1], False
    while (now_s := time.monotonic()) < until_s:
        if now_s - sent_s >= _PLAN_EVERY_S:
            sent_s, end_s, number = now_s, now_s + lease_s, number + 1
            executor.submit(
                SprayPlan(
                    sequence=number,
                    issued_s=now_s,
                    duty=(1.0,) * count,
                    changes=(),
                    lease_until_s=end_s,
                )
            )
        await asyncio.sleep(_STEP_S)
        is_safe, is_alive = levels.read()
        changes += is_alive != was_alive
        was_alive, has_opened = is_alive, has_opened or not is_safe
    if not has_opened:
        raise ActuatorError(executor.fault or "the engine opened nothing")
    return end_s, changes


@asynccontextmanager
async def _running(setup: EngineSetup) -> AsyncIterator[GpioExecutor]:
    executor = GpioExecutor(setup)
    await executor.start()
    try:
        yield executor
    finally:
        await executor.stop()


async def _without_plans(
    setup: EngineSetup, levels: _Levels, lease_s: float
) -> tuple[float | None, int]:
    async with _running(setup) as executor:
        end_s, changes = await _opened(executor, levels, lease_s, len(setup.wiring.valves))
        closed_s = await _until(lambda: levels.read()[0])
    return (None if closed_s is None else max(closed_s - end_s, 0.0)), changes


async def _killed(setup: EngineSetup, levels: _Levels, lease_s: float) -> tuple[float | None, bool]:
    async with _running(setup) as executor:
        await _opened(executor, levels, lease_s, len(setup.wiring.valves))
        killed_s = time.monotonic()
        if executor.engine_pid is not None:
            with suppress(ProcessLookupError):
                os.kill(executor.engine_pid, signal.SIGKILL)
        closed_s = await _until(lambda: levels.read()[0])
        before = levels.read()[1]
        is_alive_after = await _until(lambda: levels.read()[1] != before, for_s=0.3) is not None
    return (None if closed_s is None else closed_s - killed_s), is_alive_after


async def _until(is_so: Callable[[], bool], *, for_s: float = _WAIT_S) -> float | None:
    """Return when it was so; None if it was not in time."""
    until_s = time.monotonic() + for_s
    while not is_so():
        if not time.monotonic() < until_s:
            return None
        await asyncio.sleep(_STEP_S)
    return time.monotonic()


# Is this computer quick enough to make the valves' edges: the engine tests itself, on no lines.

NAME = "gpio-latency"
# What edges are to keep to: 6 mm at 6 m/s.
WANTED_S = 0.001
_FIX = "LimitRTPRIO=50 in the service or rtprio in /etc/security/limits.conf, or less to do"


def read_engine(setup: EngineSetup) -> SelfTest:
    """Return the self-test of a valve engine that is started for it, with outputs in memory."""
    executor = GpioExecutor(replace(setup, backend="memory", wake_late_max_s=WAKE_LATE_MAX_S))
    try:
        asyncio.run(_start_and_stop(executor))
    except ActuatorError as error:
        return SelfTest(fault=str(error))
    return executor.self_test or SelfTest(fault="no self-test")


async def _start_and_stop(executor: GpioExecutor) -> None:
    try:
        await executor.start()
    finally:
        await executor.stop()


def engine_checks(found: SelfTest | None) -> Iterator[Check]:
    """Yield the check of the engine's latency; None where no engine is used."""
    if found is None:
        yield not_applicable(NAME, "no GPIO lines are used")
        return
    late = f"wake-ups late by {found.median_late_s * 1e3:.1f} ms (median), "
    late += f"{found.p99_late_s * 1e3:.1f} ms (p99)"
    if found.fault:
        yield fail(NAME, f"the valve engine {found.fault}", _FIX)
    elif found.p99_late_s <= WANTED_S:
        yield ok(NAME, late)
    else:
        yield warn(NAME, late, _FIX)


# ------------------------------------------------------------------------------------------ sensors

_LOOK_S = 0.05
_NAME = "sensors"


@dataclass(frozen=True, slots=True, kw_only=True)
class Read:
    """What the sensors said: why one is not to be had, and the last report of each kind."""

    refused: str | None = None
    reports: tuple[Input, ...] = ()


async def read_sensors(
    sensors: Sequence[Sensor],
    *,
    for_s: float = 1.0,
    clock: Callable[[], float] = time.monotonic,
) -> Read:
    """Open all sensors, read them for a while, and let go of them however it ends."""
    last: dict[type[Input], Input] = {}
    async with AsyncExitStack() as opened:
        for sensor in sensors:
            opened.push_async_callback(sensor.close)
            try:
                await sensor.open(_nothing)
            except SensorError as error:
                return Read(refused=str(error))
        until_s = clock() + for_s
        while (now_s := clock()) < until_s:
            for sensor in sensors:
                last.update((type(item), item) for item in sensor.read(now_s))
            await asyncio.sleep(_LOOK_S)
    return Read(reports=tuple(last.values()))


def sensor_check(count: int, found: Read) -> Check:
    """Return how the sensors are; `count` of them are configured on this computer."""
    if not count:
        return not_applicable(_NAME, "none configured on this computer")
    if found.refused is not None:
        return fail(_NAME, *split_advice(found.refused, "see docs/reference/configuration.md"))
    faults = [fault for report in found.reports if (fault := _fault(report))]
    if faults:
        return fail(_NAME, faults[0], "check its wiring and supply, then try again")
    if not found.reports:
        return warn(_NAME, "no reading within a second", "check its wiring and supply")
    return ok(_NAME, ", ".join(_words(report) for report in found.reports))


def _fault(report: Input) -> str:
    return report.fault if isinstance(report, FlowReport | PressureReport | TankReport) else ""


def _words(report: Input) -> str:
    if isinstance(report, FlowReport):
        return f"meter at {report.volume_ml:.0f} mL"
    if isinstance(report, PressureReport) and report.pressure_kpa is not None:
        return f"pressure {report.pressure_kpa:.0f} kPa"
    if isinstance(report, TankReport) and report.level_l is not None:
        return f"tank {report.level_l:.1f} L"
    return "a reading is missing"


def _nothing() -> None:
    """Do nothing: the reading goes on anyway."""
