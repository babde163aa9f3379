"""The clock of flights stands where the computer holds one of them up, and only there."""

from __future__ import annotations

import os
import pickle
import re
import select
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.child_python.fair_clock import FairClock, computer_s
from tests.fair_time import _Thread

ROOT = Path(__file__).parents[2]
CHILD_PYTHON = ROOT / "tests/child_python"
PATIENCE_S = 30.0

# A call that keeps the interpreter's lock holds up whoever looks.
FLIGHTS = """
import ctypes, subprocess, sys, time
from pathlib import Path
from tests.child_python.fair_clock import computer_s
def held_up(name):
    with Path("flown").open("a") as flown:
        flown.write(f"{name} ")
    before_s, by_computer_s = time.monotonic(), computer_s()
    ctypes.PyDLL(None).usleep(400_000)
    assert computer_s() - by_computer_s >= 0.4
    assert time.monotonic() - before_s < 0.1
def test_late():
    held_up("late")
    raise AssertionError("late")
def test_in_time():
    held_up("in-time")
def test_children_go_by_the_same_clock():
    held_up("children")
    said = subprocess.run(
        [sys.executable, "-c", "import time; print(time.monotonic())"], capture_output=True
    ).stdout
    after_s = time.monotonic()
    assert after_s - 30.0 < float(said) <= after_s < computer_s() - 0.3
"""
ASKED = ["late", "in-time", "children"]


def test_a_flight_goes_by_a_clock_that_stands_is_flown_once_and_told_so(tmp_path: Path) -> None:
    tests = tmp_path / "tests"
    (tests / "realtime").mkdir(parents=True)
    shutil.copy(ROOT / "tests/conftest.py", tests)
    shutil.copy(ROOT / "tests/fair_time.py", tests)
    shutil.copytree(CHILD_PYTHON, tests / "child_python")
    (tests / "pytest.ini").write_text(
        "[pytest]\nasyncio_mode = auto\nfilterwarnings = error\n"
        "asyncio_default_fixture_loop_scope = function\n"
    )
    (tests / "realtime" / "test_flights.py").write_text(FLIGHTS)
    command = [sys.executable, "-m", "pytest", "-q", "-rA", "-m", "not firmware", str(tests)]
    ours = {"VRSPRAY_LEFT_OPEN", "VRSPRAY_FAIR_CLOCK", "PYTHONPATH"}
    environment = {key: text for key, text in os.environ.items() if key not in ours}
    result = subprocess.run(
        command, check=False, capture_output=True, text=True, cwd=tmp_path, env=environment
    )
    failed = re.findall(r"^FAILED .*::test_(\w+)", result.stdout, re.MULTILINE)
    assert (result.returncode, failed) == (1, ["late"]), result.stdout
    assert (tmp_path / "flown").read_text().split() == ASKED
    (told,) = re.findall(r"Held up by this computer -+\n(\d\.\d\d) s for", result.stdout)
    assert float(told) >= 0.3


@contextmanager
def child(code: str, *words: str) -> Iterator[subprocess.Popen[bytes]]:
    command = [sys.executable, "-S", "-c", code, *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        try:
            yield process
        finally:
            process.kill()


def looks(process: subprocess.Popen[bytes], *, for_s: float) -> Iterator[bool]:
    """Yield what is seen of its first thread every 8 ms."""
    thread = _Thread(Path(f"/proc/{process.pid}/task/{process.pid}"))
    try:
        until_s = computer_s() + for_s
        while computer_s() < until_s:
            yield thread.is_held_up()
            select.select([], [], [], 0.008)
    finally:
        thread.close()


def test_who_waits_for_its_processor_is_held_up() -> None:
    one = str(min(os.sched_getaffinity(0)))
    busy = "import os, sys\nos.sched_setaffinity(0, {int(sys.argv[1])})\nwhile True: pass\n"
    with child(busy, one), child(busy, one), child(busy, one), child(busy, one) as last:
        assert any(looks(last, for_s=PATIENCE_S))


@pytest.mark.parametrize("is_stopped", [False, True], ids=["blocks", "stopped"])
def test_who_keeps_itself_or_is_stopped_is_late_by_itself(*, is_stopped: bool) -> None:
    code = "print(flush=True)\nimport time\ntime.sleep(60)\n"
    if is_stopped:
        code = "print(flush=True)\nwhile True: pass\n"
    with child(code) as process:
        assert process.stdout is not None
        process.stdout.readline()
        if is_stopped:
            process.send_signal(signal.SIGSTOP)
            os.waitid(os.P_PID, process.pid, os.WSTOPPED)
        # How it comes to its call is seen, too.
        seen = list(looks(process, for_s=0.5))
    assert len(seen) > 10
    assert not any(seen[-10:])


def test_a_clock_goes_no_further_than_it_may_and_never_back(tmp_path: Path) -> None:
    clock = FairClock(tmp_path, is_ours=True)
    other = FairClock(tmp_path)
    now_s = computer_s()
    clock.move(100.0, now_s, 0.02)
    first_s = other.now_s()
    while computer_s() < now_s + 0.05:
        time.sleep(0.001)
    assert 100.0 <= first_s <= 100.02
    assert other.now_s() == clock.now_s() == 100.02
    clock.move(100.02, computer_s(), 0.0)
    assert other.now_s() == 100.02


def test_what_asks_for_time_can_be_handed_to_another_process() -> None:
    for each in (time.monotonic, time.sleep, time.clock_gettime):
        assert pickle.loads(pickle.dumps(each)) is each


def test_sleep_is_by_the_clock(tmp_path: Path) -> None:
    clock = FairClock(tmp_path, is_ours=True)
    begun_s = computer_s()
    clock.move(100.0, begun_s + 0.2, float("inf"))
    clock.sleep(0.05)
    assert clock.now_s() >= 100.05
    assert computer_s() - begun_s >= 0.25
