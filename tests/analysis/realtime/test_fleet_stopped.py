"""Ctrl-C in `vrspray fleet add`, as a terminal sends it: to the command and all its processes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from analysis.fleet.adding import ALONE
from tests.analysis.fleet_flights import TOLD, copied, started
from tests.analysis.report_flight import fly

# Shells start what they put into the background with SIGINT ignored, and so may who runs the tests.
AS_AT_A_TERMINAL = (
    "import os, signal, sys; signal.signal(signal.SIGINT, signal.SIG_DFL); "
    "os.execv(sys.executable, [sys.executable, '-m', 'companion', *sys.argv[1:]])"
)


@pytest.fixture(scope="module")
def season(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of enough journals for processes of their own."""
    flown = fly(tmp_path_factory.mktemp("flown"), told=dict(TOLD))
    folder = tmp_path_factory.mktemp("season")
    for number in range(1, ALONE + 1):
        copied(flown, folder / f"flight-{number:04}.gpkg", started(number))
    return folder


def children(pid: int) -> list[int]:
    """Return the processes that read journals."""
    found = []
    for each in Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="ascii").split():
        line = Path(f"/proc/{each}/cmdline").read_bytes()
        found += [int(each)] if b"spawn_main" in line else []
    return found


def no_wait(_pid: int) -> None:
    """Interrupt at once: the command loads."""


def until_started(pid: int) -> None:
    """Wait for the processes, which load what reads journals then."""
    while not children(pid):
        time.sleep(0.01)


def until_loading(pid: int) -> None:
    """Wait until they are in the middle of that."""
    until_started(pid)
    time.sleep(0.3)


@pytest.mark.timeout(120)
@pytest.mark.parametrize("wait", [no_wait, until_started, until_loading])
def test_ctrl_c_is_one_line_from_any_process(
    season: Path, tmp_path: Path, wait: Callable[[int], None]
) -> None:
    command = [sys.executable, "-c", AS_AT_A_TERMINAL, "fleet", "add", str(season)]
    with subprocess.Popen(
        [*command, "--into", str(tmp_path / "f"), "--processes", "2"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as process:
        time.sleep(0.6)
        wait(process.pid)
        # First to those that read: the command would end them before they say anything.
        for each in children(process.pid):
            os.kill(each, signal.SIGINT)
        time.sleep(0.3)
        os.killpg(process.pid, signal.SIGINT)
        said = "".join(process.communicate(timeout=60))
    assert process.returncode == 130, said
    assert "Traceback" not in said
    assert "interrupted" in said.splitlines()[-1]
