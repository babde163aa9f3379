"""The engine as a process: what remains when it, or the companion, dies or stands still."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import subprocess
import sys
import textwrap
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import pytest

from companion.core.types import PwmLimits, SprayPlan, TimedChange
from companion.errors import ActuatorError
from companion.output.engine import process
from companion.output.engine.selftest import WAKES, SelfTest
from companion.output.engine.wire import CHANGES_MAX, EngineSetup, Kind, Wiring, pack
from companion.output.gpio import LATE_MAX_S, GpioExecutor

PWM = PwmLimits(frequency_hz=11.0, duty_min=0.2, duty_max=0.9, min_on_s=0.01, min_off_s=0.01)
# Long leases and a wide margin: what is looked for is that it happens, not how soon.
PATIENCE_S = 20.0
OPEN = 0b11


class Bench:
    """An executor whose engine writes its levels into a file."""

    def __init__(self, path: Path, *, wake_late_max_s: float | None = None) -> None:
        self.path = path
        self.executor = GpioExecutor(
            EngineSetup(
                wiring=Wiring(valves=(17, 18)),
                pwm=PWM,
                backend="file",
                device=str(path),
                wake_late_max_s=wake_late_max_s,
            )
        )
        self.sequence = 0

    @property
    def levels(self) -> int:
        return int.from_bytes(self.path.read_bytes(), "little")

    def open(self, lease_s: float = 2.0) -> None:
        self.sequence += 1
        issued_s = time.monotonic()
        self.executor.submit(
            SprayPlan(
                sequence=self.sequence,
                issued_s=issued_s,
                duty=(1.0, 1.0),
                changes=(),
                lease_until_s=issued_s + lease_s,
            )
        )

    async def is_open(self) -> None:
        """Renew the plan until it is."""
        until_s = time.monotonic() + PATIENCE_S
        while self.levels != OPEN and time.monotonic() < until_s:
            self.open()
            await asyncio.sleep(0.02)
        assert self.levels == OPEN

    def wait_until_it_stands(self) -> None:
        stat = Path(f"/proc/{self.executor.engine_pid}/stat")
        until_s = time.monotonic() + PATIENCE_S
        while stat.read_text().rpartition(")")[2].split()[0] != "T":
            assert time.monotonic() < until_s
            time.sleep(0.001)

    def signal(self, number: int) -> None:
        assert self.executor.engine_pid is not None
        os.kill(self.executor.engine_pid, number)


async def until(condition: Callable[[], bool]) -> None:
    end_s = time.monotonic() + PATIENCE_S
    while not condition() and time.monotonic() < end_s:  # noqa: ASYNC110, no event tells
        await asyncio.sleep(0.005)
    assert condition()


@pytest.fixture
async def bench(tmp_path: Path) -> AsyncIterator[Bench]:
    bench = Bench(tmp_path / "levels")
    await bench.executor.start()
    yield bench
    await bench.executor.stop()


async def test_it_opens_closes_and_ends(bench: Bench) -> None:
    await bench.is_open()
    await bench.executor.stop()
    assert bench.levels == 0
    assert bench.executor.engine_pid is None
    assert bench.executor.fault is None


async def test_a_killed_engine_is_a_fault_and_its_lines_are_closed(bench: Bench) -> None:
    await bench.is_open()
    bench.signal(signal.SIGKILL)
    await until(lambda: bench.executor.fault is not None)
    assert bench.executor.fault == "valve engine ended by itself"
    await until(lambda: bench.levels == 0)
    bench.open()
    await asyncio.sleep(0.1)
    assert bench.levels == 0


async def test_a_stopped_engine_is_killed_and_its_lines_are_closed(bench: Bench) -> None:
    await bench.is_open()
    bench.signal(signal.SIGSTOP)
    # The lease is renewed: what closes is not its end.
    bench.open()
    await until(lambda: bench.executor.fault is not None)
    assert "silent" in str(bench.executor.fault)
    await until(lambda: bench.levels == 0)


async def test_an_engine_that_goes_on_after_a_stop_closes_first(tmp_path: Path) -> None:
    bench = Bench(tmp_path / "levels")
    await bench.executor.start()
    try:
        await bench.is_open()
        bench.signal(signal.SIGSTOP)
        bench.wait_until_it_stands()  # one that is not there yet is undone by what follows
        time.sleep(0.15)  # noqa: ASYNC251, the companion is held up as well, and misses nothing
        bench.signal(signal.SIGCONT)
        await until(lambda: bench.executor.status.stops > 0)
        assert bench.executor.fault is None
        await bench.is_open()
    finally:
        await bench.executor.stop()


async def test_sigterm_closes(bench: Bench) -> None:
    await bench.is_open()
    bench.signal(signal.SIGTERM)
    await until(lambda: bench.levels == 0)
    await until(lambda: bench.executor.fault is not None)


async def test_sigint_is_left_to_the_companion(bench: Bench) -> None:
    bench.signal(signal.SIGINT)
    await asyncio.sleep(0.1)
    await bench.is_open()
    assert bench.executor.fault is None


async def test_the_stop_ends_an_engine_that_stands_still(bench: Bench) -> None:
    await bench.is_open()
    bench.signal(signal.SIGSTOP)
    await bench.executor.stop()
    assert bench.executor.engine_pid is None
    assert bench.levels == 0


def test_the_death_of_the_companion_closes(tmp_path: Path) -> None:
    program = f"""
        import asyncio, os, pathlib, signal
        from tests.companion.test_engine_process import Bench

        async def main():
            bench = Bench(pathlib.Path({str(tmp_path / "levels")!r}))
            await bench.executor.start()
            await bench.is_open()
            print(bench.executor.engine_pid, flush=True)
            bench.open(lease_s=2.4)
            os.kill(os.getpid(), signal.SIGKILL)

        asyncio.run(main())
    """
    run = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(program)],
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert run.returncode == -signal.SIGKILL, run.stderr
    pid = int(run.stdout)
    end_s = time.monotonic() + PATIENCE_S
    while _lives(pid) and time.monotonic() < end_s:
        time.sleep(0.01)
    assert not _lives(pid)
    assert not any((tmp_path / "levels").read_bytes())


def _lives(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state not in ("Z", "X")


async def test_an_engine_that_cannot_have_its_lines_says_why_and_never_opens(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    bench = Bench(tmp_path / "none" / "levels")
    told: list[tuple[str, str]] = []
    bench.executor.on_event = lambda at_s, kind, text: told.append((kind, text))
    await bench.executor.start()
    try:
        fault = f"{bench.path}: No such file or directory; is it free, and may this user open it?"
        assert bench.executor.fault == f"valve engine: {fault}"
        assert told == [("self-test", f"failed: {fault}")]
        # Once they can be had they are taken, and held closed: the fault stays.
        bench.path.parent.mkdir()
        await until(bench.path.exists)
        assert bench.executor.fault == f"valve engine: {fault}"
        bench.open()
        await asyncio.sleep(0.1)
        assert bench.levels == 0
        assert sum("taken over" in record.message for record in caplog.records) <= 1
    finally:
        await bench.executor.stop()


async def test_an_engine_that_wakes_late_is_a_fault_and_never_opens(tmp_path: Path) -> None:
    bench = Bench(tmp_path / "levels", wake_late_max_s=0.0)
    await bench.executor.start()
    try:
        assert "late; allow rtprio" in str(bench.executor.fault)
        bench.open()
        await asyncio.sleep(0.2)
        assert bench.levels == 0
        assert bench.executor.status.accepted == 0
        assert bench.executor.engine_pid is not None
        # Even a plan that reaches it opens nothing: the fault is its own as well.
        bench.executor._fault = None
        bench.open()
        await until(lambda: bench.executor.status.accepted > 0)
        await until(lambda: bench.executor.fault is not None)
        assert bench.levels == 0
    finally:
        await bench.executor.stop()


async def test_a_good_self_test_is_told(tmp_path: Path) -> None:
    bench = Bench(tmp_path / "levels")
    told: list[tuple[str, str]] = []
    bench.executor.on_event = lambda at_s, kind, text: told.append((kind, text))
    await bench.executor.start()
    await bench.executor.stop()
    assert bench.executor.fault is None
    found = bench.executor.self_test
    assert found is not None
    assert (found.outputs, found.levels_read_back, found.alive_toggles) == (2, True, None)
    assert found.wakes == WAKES
    assert 0.0 <= found.median_late_s <= found.p99_late_s <= found.worst_late_s
    assert told == [("self-test", found.text())]


async def test_an_engine_that_is_no_engine_is_a_failed_start() -> None:
    setup = EngineSetup(wiring=Wiring(valves=(1,)), pwm=PWM, backend="memory")
    executor = GpioExecutor(setup, command=(sys.executable, "-c", "pass"))
    with pytest.raises(ActuatorError, match="ended by itself"):
        await executor.start()


async def test_a_plan_too_large_is_not_sent_and_one_for_others_is_a_mistake(bench: Bench) -> None:
    issued_s = time.monotonic()
    change = TimedChange(at_s=issued_s, valve=0, duty=0.5)
    large = SprayPlan(
        sequence=1,
        issued_s=issued_s,
        duty=(0.0, 0.0),
        changes=(change,) * (CHANGES_MAX + 1),
        lease_until_s=issued_s + 1.0,
    )
    bench.executor.submit(large)
    assert bench.executor.unsent_count == 1
    with pytest.raises(ValueError, match="for 1 valves, executor has 2"):
        bench.executor.submit(
            SprayPlan(sequence=2, issued_s=1.0, duty=(0.0,), changes=(), lease_until_s=2.0)
        )


async def test_refused_plans_are_counted_by_the_engine(bench: Bench) -> None:
    bench.open(lease_s=9.0)
    await until(lambda: bench.executor.status.rejected == 1)
    assert bench.levels == 0
    assert bench.executor.fault is None


async def test_edges_that_are_late_for_long_are_a_fault(bench: Bench) -> None:
    await bench.is_open()
    for _ in range(600):
        bench.executor.lateness.add(2.0 * LATE_MAX_S)
    await until(lambda: bench.executor.fault is not None)
    assert "late" in str(bench.executor.fault)
    await until(lambda: bench.levels == 0)


def test_an_error_in_the_engine_closes_the_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[str] = []

    class Lines:
        def close(self) -> None:
            done.append("closed")

    def broken(*_given: object) -> None:
        raise ValueError("broken")

    for name, instead in {
        "die_with_parent": lambda _parent: True, "_end_wakes": lambda: None,
        "open_lines": lambda _setup: None, "be_on_time": lambda **_: [],
        "self_test": lambda *_, **__: SelfTest(), "Engine": lambda *_, **__: Lines(),
        "_run": broken,
    }.items():  # fmt: skip
        monkeypatch.setattr(process, name, instead)
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    setup = EngineSetup(wiring=Wiring(valves=(17,)), pwm=PWM, backend="memory")
    with near, far:
        near.send(pack(Kind.SETUP, setup.as_bytes()))
        with pytest.raises(ValueError, match="broken"):
            process.serve(far, parent=os.getpid())
    assert done == ["closed"]
