"""A flight in real time that fails has failed, and is told how long it was held up."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

from tests.held_up import watched

ROOT = Path(__file__).parents[2]
HELD_UP_S = 0.05

# A call that keeps the interpreter's lock holds up whoever watches.
FLIGHTS = """
import ctypes
from pathlib import Path
def test_late():
    with Path("flown").open("a") as flown:
        flown.write("late ")
    ctypes.PyDLL(None).usleep(400_000)
    raise AssertionError("late")
def test_in_time():
    with Path("flown").open("a") as flown:
        flown.write("in-time ")
    ctypes.PyDLL(None).usleep(400_000)
"""


def test_a_late_flight_fails_is_flown_once_and_told_how_long_it_was_held_up(tmp_path: Path) -> None:
    tests = tmp_path / "tests"
    (tests / "realtime").mkdir(parents=True)
    shutil.copy(ROOT / "tests/conftest.py", tests)
    shutil.copy(ROOT / "tests/held_up.py", tests)
    (tests / "pytest.ini").write_text(
        "[pytest]\nasyncio_mode = auto\nfilterwarnings = error\n"
        "asyncio_default_fixture_loop_scope = function\n"
    )
    (tests / "realtime" / "test_flights.py").write_text(FLIGHTS)
    command = [sys.executable, "-m", "pytest", "-q", "-rA", "-p", "no:cacheprovider", str(tests)]
    environment = {key: text for key, text in os.environ.items() if key != "VRSPRAY_LEFT_OPEN"}
    result = subprocess.run(
        command, check=False, capture_output=True, text=True, cwd=tmp_path, env=environment
    )
    assert result.returncode == 1
    assert re.findall(r"^FAILED .*::test_(\w+)", result.stdout, re.MULTILINE) == ["late"]
    assert (tmp_path / "flown").read_text().split() == ["late", "in-time"]
    (told,) = re.findall(r"Held up by this computer -+\n(\d\.\d\d) s at most", result.stdout)
    assert float(told) >= 0.2


def test_a_child_that_waits_for_its_processor_was_held_up() -> None:
    one = str(min(os.sched_getaffinity(0)))
    busy = "import os, sys, time\nos.sched_setaffinity(0, {int(sys.argv[1])})\nwhile True: pass\n"
    with watched() as watch:
        children = [subprocess.Popen([sys.executable, "-c", busy, one]) for _ in range(5)]
        until_s = time.monotonic() + 30.0
        try:
            while watch.longest_s < HELD_UP_S and time.monotonic() < until_s:
                with suppress(subprocess.TimeoutExpired):
                    children[0].wait(0.1)
        finally:
            for child in children:
                child.kill()
                child.wait()
    assert watch.longest_s >= HELD_UP_S
