"""`vrspray top`: a companion beside a stub, seen from the stub's second link alone."""

from __future__ import annotations

import json
import os
import pty
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from companion.cli.top import Overheard
from companion.core.types import SprayerState
from companion.link.encode import Encoder

CONFIG = Path(__file__).resolve().parents[3] / "examples" / "anyang" / "config.toml"
PROGRAM = [sys.executable, "-m", "companion"]


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


@contextmanager
def started(*words: str) -> Iterator[None]:
    process = subprocess.Popen(
        [*PROGRAM, *words], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        yield
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(30)


def test_top_sees_a_companion_and_ends_with_ctrl_c(tmp_path: Path) -> None:
    ours, theirs = free_port(), free_port()
    link, station = f"127.0.0.1:{ours}", f"127.0.0.1:{theirs}"
    settings = ["--set", f"link.url=udpin:{link}", "--set", f"journal.folder={tmp_path}"]
    with (
        started("run", "--config", str(CONFIG), *settings),
        started("sitl", "serve", "--link", f"udpout:{link}", "--station", f"udpout:{station}"),
    ):
        top = [*PROGRAM, "top", "--link", f"udpin:{station}"]
        told = subprocess.run(
            [*top, "--json", "--wait-s", "60"], capture_output=True, check=False, timeout=90
        )
        assert told.returncode == 0, told.stderr
        found = json.loads(told.stdout)
        assert found["state"] in [state.value for state in SprayerState]
        assert found["volume_l"] is not None
        assert found["ages_s"]["companion"] < 3.0
        screen, terminal = pty.openpty()
        with subprocess.Popen(top, stdout=terminal, stderr=terminal) as process:
            os.close(terminal)
            drawn = b""
            while b"L/ha wanted" not in drawn:
                drawn += os.read(screen, 4096)
            process.send_signal(signal.SIGINT)
            assert process.wait(30) == 0
        os.close(screen)


def test_nobody_there_is_said_and_exit_1() -> None:
    words = ["top", "--link", f"udpin:127.0.0.1:{free_port()}", "--json", "--wait-s", "0.1"]
    done = subprocess.run([*PROGRAM, *words], capture_output=True, check=False, timeout=60)
    assert done.returncode == 1
    assert json.loads(done.stdout)["ok"] is False
    assert b"no companion was heard" in done.stderr


def test_reasons_and_errors_are_those_that_were_told_last() -> None:
    encoder, heard = Encoder(system_id=1, component_id=191), Overheard()
    heard.take(encoder.text(6, "Spray off: not enabled"), 0.0)  # nobody knows yet who that is
    heard.take(encoder.named_value("SPR_STATE", 1.0, 1.0), 1.0)
    heard.take(encoder.text(6, "Spray off: not enabled"), 1.1)
    heard.take(encoder.text(6, "Spray off: too slow"), 1.2)
    heard.take(encoder.text(3, "Spray: link lost"), 2.0)
    assert (heard.companion, heard.state(2.0)) == ((1, 191), SprayerState.SAFE)
    assert heard.why == "not enabled, too slow"
    assert heard.faults(30.0) == ["link lost"]
    assert heard.faults(90.0) == []
    assert heard.state(60.0) is None
    heard.take(encoder.named_value("SPR_STATE", float("nan"), 61.0), 61.0)
    assert heard.state(61.0) is None


def test_a_port_that_the_companion_has_is_said_with_what_to_do() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        link = f"udpin:127.0.0.1:{taken.getsockname()[1]}"
        done = subprocess.run(
            [*PROGRAM, "top", "--link", link],
            capture_output=True,
            check=False,
            timeout=60,
            text=True,
        )
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert f"--link '{link}'" in line
    assert "`vrspray run`" in line
    assert "a second port" in line
