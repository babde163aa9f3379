"""`make test`: flights beside what computes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def fake_make(folder: Path, *, flights: str, computing: str) -> list[str]:
    """Return the command with a `make` of these two scripts."""
    os.mkfifo(folder / "pipe")
    make = folder / "make"
    make.write_text(
        f'#!/bin/sh\nflights() {{ {flights}\n}}\ncomputing() {{ {computing}\n}}\n"${{2#test-}}"\n'
    )
    make.chmod(0o755)
    return [sys.executable, "-m", "tests.whole", str(make)]


@pytest.mark.parametrize(
    ("flights", "computing", "exit_code"),
    [("true", "true", 0), ("return 2", "true", 2), ("true", "return 2", 2)],
)
def test_it_fails_when_either_half_fails_and_shows_both(
    tmp_path: Path, flights: str, computing: str, exit_code: int
) -> None:
    command = fake_make(
        tmp_path,
        # Either waits for the other: they are beside each other, or this never ends.
        flights=f"echo > {tmp_path}/pipe; echo flew; {flights}",
        computing=f"read _ < {tmp_path}/pipe; nice; {computing}",
    )
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (exit_code, "")
    assert done.stdout.split() == [str(min(os.nice(0) + 9, 19)), "flew"]


def test_ctrl_c_ends_both(tmp_path: Path) -> None:
    command = fake_make(
        tmp_path,
        flights=f"trap 'touch {tmp_path}/ended; exit 130' INT; echo > {tmp_path}/pipe; "
        f"read _ < {tmp_path}/pipe",
        computing=f"read _ < {tmp_path}/pipe; echo there; exec sleep 100",
    )
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, start_new_session=True)
    assert process.stdout is not None
    with process.stdout:
        assert process.stdout.readline() == b"there\n"
        os.killpg(process.pid, signal.SIGINT)
        assert process.wait() == 130
    assert (tmp_path / "ended").exists()
