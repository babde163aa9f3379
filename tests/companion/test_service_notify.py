"""What systemd is told, and when: the steps of the control loop, and nothing else."""

from __future__ import annotations

import asyncio
import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from companion.cli.systemd import CLOSING_MAX_S, Notifier
from companion.core.types import Decision, Input, SprayPlan
from companion.runtime import run
from tests.builders import setup
from tests.companion.wire_peer import free_port

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "anyang"


class Clock:
    now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def test_ready_comes_with_the_first_step_and_food_twice_in_the_watchdogs_time() -> None:
    sent: list[bytes] = []
    clock = Clock()
    notifier = Notifier(sent.append, watchdog_s=2.0, clock=clock)
    with notifier:
        assert sent == []
        for _ in range(49):
            notifier.stepped()
            clock.now_s += 0.0625
    assert sent[0] == b"READY=1\nWATCHDOG=1"
    assert sent[1:-1] == [b"WATCHDOG=1"] * 3
    assert sent[-1] == b"STOPPING=1\nWATCHDOG_USEC=%d" % round(CLOSING_MAX_S * 1e6)


def test_a_loop_that_stands_still_is_silent() -> None:
    sent: list[bytes] = []
    clock = Clock()
    notifier = Notifier(sent.append, watchdog_s=2.0, clock=clock)
    notifier.stepped()
    clock.now_s += 1000.0
    assert sent == [b"READY=1\nWATCHDOG=1"]


def test_without_a_watchdog_only_ready_is_said() -> None:
    sent: list[bytes] = []
    clock = Clock()
    notifier = Notifier(sent.append, clock=clock)
    for _ in range(5):
        notifier.stepped()
        clock.now_s += 10.0
    assert sent == [b"READY=1\nWATCHDOG=1"]


@pytest.fixture
def inbox(tmp_path: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as channel:
        channel.bind(str(tmp_path / "notify"))
        channel.setblocking(False)
        yield channel


def test_the_environment_says_where_and_is_not_for_children(
    inbox: socket.socket, tmp_path: Path
) -> None:
    environment = {"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "2000000"}
    notifier = Notifier.from_environment(environment, pid=7)
    assert environment == {}
    notifier.stepped()
    assert inbox.recv(100) == b"READY=1\nWATCHDOG=1"


def test_an_abstract_socket_is_found() -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as channel:
        channel.bind(f"\0vrspray-test-{os.getpid()}")
        channel.setblocking(False)
        given = {"NOTIFY_SOCKET": f"@vrspray-test-{os.getpid()}"}
        Notifier.from_environment(given, pid=7).stepped()
        assert channel.recv(100) == b"READY=1\nWATCHDOG=1"


def test_without_systemd_the_steps_touch_the_file_of_a_container(tmp_path: Path) -> None:
    alive = tmp_path / "alive"
    environment = {"VRSPRAY_ALIVE_FILE": str(alive)}
    notifier = Notifier.from_environment(environment, pid=7)
    assert environment == {}
    assert not alive.exists()
    notifier.stepped()
    assert alive.exists()
    os.utime(alive, (0.0, 0.0))
    notifier.stepped()
    assert alive.stat().st_mtime == 0.0  # once a second at most
    notifier._clock = lambda: time.monotonic() + 1.1
    notifier.stepped()
    assert alive.stat().st_mtime > 0.0


def test_a_file_that_cannot_be_touched_harms_nobody(tmp_path: Path) -> None:
    given = {"VRSPRAY_ALIVE_FILE": str(tmp_path / "gone" / "alive")}
    Notifier.from_environment(given, pid=7).stepped()


@pytest.mark.parametrize("address", ["", "relative", "/nowhere/notify"])
def test_a_socket_that_is_not_there_harms_nobody(address: str) -> None:
    given = {"NOTIFY_SOCKET": address, "WATCHDOG_USEC": "x"}
    with Notifier.from_environment(given, pid=7) as notifier:
        notifier.stepped()
    assert given == {}


def test_a_watchdog_that_is_another_processs_is_not_fed() -> None:
    given = {"NOTIFY_SOCKET": "/nowhere", "WATCHDOG_USEC": "2000000", "WATCHDOG_PID": "8"}
    assert Notifier.from_environment(given, pid=7)._pause_s is None


@dataclass
class Parts:
    """Link and executor in one; a plan may be refused."""

    is_broken: bool = False
    fault: str | None = None
    decisions: list[Decision] = field(default_factory=list)

    async def open(self, wake: Any) -> None: ...

    async def start(self) -> None: ...

    async def stop(self) -> None: ...

    async def close(self) -> None: ...

    def receive(self) -> list[Input]:
        return []

    def tell(self, decision: Decision | None, now_s: float) -> None: ...

    def tell_fault(self, text: str) -> None: ...

    is_guarded = True

    def submit(self, plan: SprayPlan) -> None:
        if self.is_broken:
            raise RuntimeError("broken")

    def record_input(self, item: Input) -> None: ...

    def record_decision(self, decision: Decision) -> None:
        self.decisions.append(decision)

    def record_event(self, at_s: float, kind: str, text: str) -> None: ...


async def test_each_step_that_was_carried_out_is_told_and_nothing_else() -> None:
    parts, steps = Parts(), []
    await run(
        setup(),
        link=parts,
        executor=parts,
        recorder=parts,
        duration_s=0.3,
        on_step=lambda: steps.append(len(parts.decisions)),
    )
    assert steps == list(range(1, len(parts.decisions) + 1))
    assert len(steps) >= 2


async def test_a_step_that_fails_is_not_told() -> None:
    parts, steps = Parts(is_broken=True), []
    given = run(
        setup(), link=parts, executor=parts, recorder=parts, on_step=lambda: steps.append(1)
    )
    results = await asyncio.gather(given, return_exceptions=True)
    assert isinstance(results[0], RuntimeError)
    assert steps == []


async def test_no_step_without_a_turn_is_told() -> None:
    """A wake-up without news and before its time decides nothing, and feeds nobody."""
    parts, steps = Parts(), []
    wakes: list[Any] = []

    async def opened(wake: Any) -> None:
        wakes.append(wake)

    parts.open = opened  # type: ignore[method-assign]
    task = asyncio.create_task(
        run(
            setup(),
            link=parts,
            executor=parts,
            recorder=parts,
            duration_s=0.3,
            on_step=lambda: steps.append(1),
        )
    )
    while not task.done():
        for wake in wakes:
            wake()
        await asyncio.sleep(0.001)
    assert len(steps) == len(parts.decisions)
    assert task.result() == 0


def test_the_whole_program_says_ready_and_goes_on_feeding(
    inbox: socket.socket, tmp_path: Path
) -> None:
    config = tmp_path / "field" / "config.toml"
    shutil.copytree(EXAMPLE, config.parent, ignore=shutil.ignore_patterns("flights", "state"))
    done = subprocess.run(
        [
            *(sys.executable, "-m", "companion", "run", "--config", str(config)),
            *("--set", f"link.url=udpin:127.0.0.1:{free_port()}", "--duration-s", "0.6"),
        ],
        env={
            **os.environ,
            "NOTIFY_SOCKET": str(tmp_path / "notify"),
            "WATCHDOG_USEC": "200000",
        },
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    said = []
    with pytest.raises(BlockingIOError):
        while True:
            said.append(inbox.recv(100))
    assert said[0] == b"READY=1\nWATCHDOG=1"
    assert said[1] == b"WATCHDOG=1"
    assert said[-1].startswith(b"STOPPING=1")
