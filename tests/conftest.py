"""What holds for every test: nothing is left running, and two runs of one commit agree."""

from __future__ import annotations

import asyncio
import multiprocessing.resource_tracker
import os
import signal
import threading
from collections.abc import AsyncIterator, Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

SAMPLES_VARIABLE = "VRSPRAY_SAMPLES"
GRACE_S = 2.0

# Repeatable: the same examples at every run, and no verdict that depends on how busy the machine
# is. `HYPOTHESIS_PROFILE=thorough` draws new and many more ones.
_NOT_TIMED = [HealthCheck.too_slow]
settings.register_profile(
    "repeatable", derandomize=True, deadline=None, suppress_health_check=_NOT_TIMED
)
settings.register_profile(
    "thorough", max_examples=5000, deadline=None, suppress_health_check=_NOT_TIMED
)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "repeatable"))


@pytest.fixture
def samples() -> Path:
    """Return the folder of real prescription maps, or skip where there is none."""
    folder = os.environ.get(SAMPLES_VARIABLE)
    if not folder:
        pytest.skip(f"{SAMPLES_VARIABLE} is not set")
    return Path(folder)


def _children() -> set[int]:
    """Return the ids of our child processes, dead ones that nobody waited for included."""
    try:
        os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT)
    except ChildProcessError:
        return set()  # the usual case, and the quick one
    lists = Path("/proc/self/task").glob("*/children")
    children = {int(pid) for one in lists for pid in one.read_text().split()}
    # Python's own helper of shared memory lives as long as we do.
    tracker = multiprocessing.resource_tracker._resource_tracker._pid  # type: ignore[attr-defined]
    return children - {tracker}


@pytest.fixture(autouse=True)
def no_process_left_behind() -> Iterator[None]:
    """Fail a test that leaves a child process, and end the child."""
    before = _children()
    yield
    left = _children() - before
    for pid in left:
        with suppress(ProcessLookupError, ChildProcessError):
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
    assert not left, f"child processes left behind: {sorted(left)}"


@pytest.fixture(autouse=True)
def no_thread_left_behind(no_process_left_behind: None) -> Iterator[None]:
    """Fail a test that leaves a thread running; one that is just ending is waited for."""
    before = set(threading.enumerate())
    yield
    left = set(threading.enumerate()) - before
    for thread in left:
        thread.join(GRACE_S)
    running = [thread.name for thread in left if thread.is_alive()]
    assert not running, f"threads left running: {running}"


@pytest.fixture(autouse=True)
async def no_task_left_behind(no_thread_left_behind: None) -> AsyncIterator[None]:
    """Fail a test that leaves a task running; one that was just cancelled may end."""
    before = asyncio.all_tasks()
    yield
    left = asyncio.all_tasks() - before - {asyncio.current_task()}
    for task in left:
        task.cancel()
    if left:
        await asyncio.wait(left, timeout=GRACE_S)
    assert not left, f"tasks left running: {[task.get_coro() for task in left]}"


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Say how many golden tests did not run for want of the real maps."""
    skipped = terminalreporter.stats.get("skipped", [])
    golden = sum(SAMPLES_VARIABLE in str(report.longrepr) for report in skipped)
    if golden:
        terminalreporter.section("golden tests")
        terminalreporter.line(
            f"{golden} golden tests skipped: {SAMPLES_VARIABLE} names no folder of real maps"
        )
