"""Commands that compute for long give way to a companion on the same computer."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from companion.cli.app import find_command, main
from companion.cli.beside import NICENESS, running, shown

# Waits for a line, so that the test says when it ends.
RUN = "from companion.cli.beside import shown\nwith shown():\n print('up', flush=True)\n input()"
ASKED = (
    "import atexit, os, sys\n"
    "from companion.cli.app import main\n"
    "atexit.register(lambda: print('nice', os.nice(0)))\n"
    "main()"
)


def niceness(*arguments: str) -> tuple[int, str]:
    """Return how nice a command was, beyond this process, and what it said on stderr."""
    done = subprocess.run(
        [sys.executable, "-c", ASKED, *arguments], capture_output=True, text=True, check=False
    )
    return int(done.stdout.rpartition("nice ")[2]), done.stderr


def test_a_run_is_seen_while_it_lives_and_never_after_it() -> None:
    with subprocess.Popen(
        [sys.executable, "-c", RUN], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "up\n"
        assert process.pid in running()
        at, said = niceness("map", "check", "nowhere.shp")
        assert at == max(os.nice(0), NICENESS)
        assert f"{process.pid}" in said
        assert "gives way" in said
        process.kill()
        process.wait()
        assert process.pid not in running()


def test_what_is_done_at_once_says_nothing() -> None:
    expected = {
        "map rate": "quick",
        "map check": "patient",
        "map compile": "at-once",
        "demo": "patient",
        "sitl fly": "patient",
        "sitl serve": "at-once",
        "run": "at-once",
    }
    for name, haste in expected.items():
        command = find_command(name.partition(" ")[0])
        assert command is not None
        assert command.haste_of(name.partition(" ")[2]) == haste


def test_this_process_is_not_another() -> None:
    with shown(), shown():
        assert os.getpid() not in running()


@pytest.mark.parametrize("command", ["doctor", "run"])
def test_what_flies_or_tries_hardware_keeps_its_priority(command: str) -> None:
    assert niceness(command, "--help")[0] == os.nice(0)


def test_a_caller_within_a_process_keeps_its_priority() -> None:
    before = os.nice(0)
    with pytest.raises(SystemExit):
        main(["map", "--help"])
    assert os.nice(0) == before


def test_what_cannot_be_read_is_nobody(tmp_path: Path) -> None:
    assert running(tmp_path / "none") == ()
    odd = tmp_path / "unix"
    odd.write_text("Num RefCount\n0: 2 @vrspray-run-x\n0: 2 @other-12\n0: 2 @vrspray-run-77\n")
    assert running(odd) == (77,)
