"""The engine's process on a simulated chip: it sprays, and whatever ends it closes.

What happens is looked at, not how soon: the kernel that this runs on has a coarse clock.
"""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import AsyncIterator, Callable
from itertools import pairwise

import pytest

from companion.core.types import PwmLimits, SprayPlan, TimedChange
from companion.output.child import Child
from companion.output.engine.lines import GpiodLines, load_gpiod
from companion.output.engine.wire import PACKET_MAX, EngineSetup, Kind, Wiring, pack, unpack
from companion.output.gpio import COMMAND, GpioExecutor
from tests.gpio.sim import SimChip

pytestmark = pytest.mark.needs_gpiosim

PWM = PwmLimits(frequency_hz=11.0, duty_min=0.2, duty_max=0.9, min_on_s=0.01, min_off_s=0.01)
VALVES = 24
RETURN, ALIVE = VALVES, VALVES + 1
PATIENCE_S = 30.0
DUTIES = (0.3, 0.5, 0.65, 0.8)


def setup(label: str, *, normally_open: bool = False) -> EngineSetup:
    wiring = Wiring(
        valves=tuple(range(VALVES)),
        return_line=RETURN,
        alive_line=ALIVE,
        normally_open=normally_open,
    )
    # How late wake-ups and edges are is measured elsewhere: here it is no fault.
    return EngineSetup(wiring=wiring, pwm=PWM, device=label, wake_late_max_s=60.0)


class Bench:
    """The real executor and its engine; its plans are renewed as those of a flight are."""

    def __init__(self, label: str, chip: SimChip | None = None) -> None:
        self.chip = chip
        self.executor = GpioExecutor(setup(label), late_max_s=60.0)
        self.sequence = 0

    def submit(self, duty: tuple[float, ...], changes: tuple[TimedChange, ...] = ()) -> None:
        self.sequence += 1
        now_s = time.monotonic()
        self.executor.submit(
            SprayPlan(
                sequence=self.sequence,
                issued_s=now_s,
                duty=duty,
                changes=changes,
                lease_until_s=now_s + 2.0,
            )
        )

    async def until(self, condition: Callable[[], bool], duty: float | None = None) -> None:
        """Wait, and renew a plan of one duty while waiting."""
        end_s = time.monotonic() + PATIENCE_S
        while not condition() and time.monotonic() < end_s:
            if duty is not None:
                self.submit((duty,) * VALVES)
            await asyncio.sleep(0.02)
        assert condition(), self.executor.fault

    def valves(self) -> list[int]:
        assert self.chip is not None
        return self.chip.levels(*range(VALVES))

    async def is_open(self) -> None:
        await self.until(lambda: self.valves() == [1] * VALVES, duty=1.0)

    async def is_closed(self) -> None:
        await self.until(lambda: not any(self.valves()))

    def signal(self, number: int) -> None:
        assert self.executor.engine_pid is not None
        os.kill(self.executor.engine_pid, number)


@pytest.fixture
async def bench(chip: SimChip) -> AsyncIterator[Bench]:
    bench = Bench(chip.label, chip)
    await bench.executor.start()
    yield bench
    await bench.executor.stop()


async def test_24_valves_pulse_change_their_duty_and_close(bench: Bench) -> None:
    assert bench.chip is not None
    seen: list[set[int]] = [set() for _ in range(VALVES)]
    alive, returns = set(), set()
    for number in range(40):
        at_s = time.monotonic() + 0.05 * (20 - number % 20)
        zone = number // 20
        duty = tuple(DUTIES[(zone + valve) % 4] for valve in range(VALVES))
        changes = tuple(
            TimedChange(at_s=at_s, valve=valve, duty=DUTIES[(zone + 1 + valve) % 4])
            for valve in range(VALVES)
        )
        bench.submit(duty, changes)
        await asyncio.sleep(0.05)
        for valve, level in enumerate(bench.valves()):
            seen[valve].add(level)
        alive.add(bench.chip.level(ALIVE))
        returns.add(bench.chip.level(RETURN))
    test = bench.executor.self_test
    assert test is not None
    assert (test.outputs, test.levels_read_back, test.alive_toggles) == (VALVES + 2, True, True)
    assert seen == [{0, 1}] * VALVES
    assert alive == {0, 1}
    # The return valve draws current, and is shut, while valves spray.
    assert 1 in returns
    await bench.until(lambda: bench.executor.status.rejected == 0, duty=0.0)
    await bench.is_closed()
    await bench.executor.stop()
    assert bench.executor.fault is None
    status = bench.executor.status
    assert status.accepted > 20
    assert (status.rejected, status.dropped_reports) == (0, 0)
    for valve in range(VALVES):
        mine = [edge for edge in bench.executor.issued if edge.output == valve]
        assert len(mine) > 10
        assert all(a.actual_s <= b.actual_s for a, b in pairwise(mine))
        assert not mine[-1].is_open


async def test_no_valve_opens_without_a_plan(bench: Bench) -> None:
    await bench.until(lambda: bench.executor.status.at_s > 0.0)
    assert bench.valves() == [0] * VALVES
    assert bench.chip is not None
    alive = set()
    for _ in range(50):
        await asyncio.sleep(0.01)
        alive.add(bench.chip.level(ALIVE))
    assert alive == {0}


async def test_the_end_of_the_lease_closes(bench: Bench) -> None:
    await bench.is_open()
    # No plan more.
    await bench.until(lambda: bench.executor.lease_end_count > 0)
    await bench.is_closed()
    assert bench.executor.fault is None


async def test_normally_open_valves_are_held_shut_until_the_end(chip: SimChip) -> None:
    executor = GpioExecutor(setup(chip.label, normally_open=True), late_max_s=60.0)
    await executor.start()
    assert chip.levels(*range(VALVES)) == [1] * VALVES
    await executor.stop()
    # This kernel gives the lines back to their pull: which is why such valves need a cut-off.
    assert chip.levels(*range(VALVES)) == [0] * VALVES
    assert any("remove strict_gpiod" in text or "cut-off" in text for text in executor.warnings)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGSTOP])
async def test_an_engine_that_ends_or_stands_still_leaves_closed_lines(
    bench: Bench, number: signal.Signals
) -> None:
    await bench.is_open()
    bench.signal(number)
    await bench.until(lambda: bench.executor.fault is not None)
    await bench.is_closed()
    assert bench.chip is not None
    # The companion holds them now.
    await bench.until(lambda: bench.chip is not None and is_held(bench.chip))
    assert bench.chip.level(RETURN) == 0


def test_a_killed_engine_gives_its_lines_back_to_their_pull(chip: SimChip) -> None:
    chip.pull(3, up=True)
    # An engine with nobody to take its lines over: what the kernel alone does.
    child = Child(COMMAND)
    child.send(pack(Kind.SETUP, setup(chip.label, normally_open=True).as_bytes()))
    child.socket.settimeout(PATIENCE_S)
    assert unpack(child.socket.recv(PACKET_MAX))[0] is Kind.READY
    # Its valves are held shut by current, its return valve is open without.
    assert chip.levels(*range(VALVES), RETURN) == [1] * VALVES + [0]
    child.kill()
    asyncio.run(child.ended(60.0))
    child.disconnect()
    assert chip.levels(*range(VALVES), RETURN) == [int(line == 3) for line in range(VALVES + 1)]


def test_the_death_of_the_companion_closes_and_frees_the_lines(chip: SimChip) -> None:
    program = f"""
        import asyncio, os, signal
        from tests.gpio.sim import SimChip
        from tests.gpio.test_engine import Bench

        async def main():
            bench = Bench({chip.label!r})
            await bench.executor.start()
            await bench.until(lambda: bench.executor.status.accepted > 3, duty=1.0)
            os.kill(os.getpid(), signal.SIGKILL)

        asyncio.run(main())
    """
    run = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(program)],
        capture_output=True,
        text=True,
        check=False,
        timeout=100,
    )
    assert run.returncode == -signal.SIGKILL, run.stderr
    end_s = time.monotonic() + PATIENCE_S
    while True:
        try:
            held = GpiodLines(load_gpiod(), chip.label, range(VALVES + 2), levels=0)
            break
        except OSError:
            assert time.monotonic() < end_s
            time.sleep(0.02)
    assert chip.levels(*range(VALVES)) == [0] * VALVES
    held.release()


async def test_lines_that_another_holds_are_a_fault_that_stays(chip: SimChip) -> None:
    held = GpiodLines(load_gpiod(), chip.label, (3,), levels=1)
    bench = Bench(chip.label, chip)
    await bench.executor.start()
    fault = f"valve engine: {chip.label}: Device or resource busy; is it free"
    assert str(bench.executor.fault).startswith(fault)
    bench.submit((1.0,) * VALVES)
    await asyncio.sleep(0.2)
    assert bench.valves() == [int(line == 3) for line in range(VALVES)]
    # As soon as they are free they are taken, and held closed.
    held.release()
    await bench.until(lambda: is_held(chip))
    bench.submit((1.0,) * VALVES)
    assert bench.valves() == [0] * VALVES
    await bench.executor.stop()
    assert not is_held(chip)


def is_held(chip: SimChip) -> bool:
    """Return whether somebody has the lines."""
    try:
        GpiodLines(load_gpiod(), chip.name, (0,), levels=0).release()
    except OSError:
        return True
    return False


async def test_a_chip_that_is_taken_out_is_a_fault(bench: Bench) -> None:
    await bench.is_open()
    assert bench.chip is not None
    bench.chip.remove()
    await bench.until(lambda: bench.executor.fault is not None)
    assert "No such device" in str(bench.executor.fault)
