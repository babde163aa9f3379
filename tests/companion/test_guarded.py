"""The companion's side of the guardian: it orders nothing open while that one closes."""

from __future__ import annotations

import asyncio
import os
import shutil
import signal
import threading
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.cli.app import execute
from companion.cli.guarded_parts import meanwhile
from companion.cli.output_parts import build_link, build_outputs
from companion.cli.run import component_options
from companion.config import load
from companion.core.types import HeartbeatReport, OperatorCommand, SprayPlan
from companion.errors import MapError
from companion.output.autopilot_options import ServoOptions
from companion.output.guarded import GuardedServoExecutor, GuardianSetup
from tests.companion.wire_peer import free_port, heard

LEASE_S = 0.3
EXAMPLE = Path(__file__).parents[2] / "examples" / "anyang"


class Guarded:
    """An executor with its guardian; what it orders goes nowhere but into a list."""

    def __init__(self, note: Path) -> None:
        self.orders: list[tuple[int, int]] = []
        self.said: list[str] = []
        self.fails = False
        given = GuardianSetup(lease_s=LEASE_S, component=191, is_udp=True, key=b"", note=note)
        self.executor = GuardedServoExecutor(
            ServoOptions(channels=(9, 10)),
            self.order,
            given,
            lambda: (None, {"peers": (), "system": 1, "stamp": 0}),
            flush=lambda: True,
            say=self.said.append,
        )
        self._sequence = 0

    def order(self, channel: int, pulse_us: int) -> bool:
        if self.fails:
            raise OSError("the link broke")
        self.orders.append((channel, pulse_us))
        return True

    def submit(self) -> list[tuple[int, int]]:
        """Submit a plan with both valves open; return what was ordered for it."""
        before, self._sequence = len(self.orders), self._sequence + 1
        now_s = asyncio.get_running_loop().time()
        plan = SprayPlan(
            sequence=self._sequence,
            issued_s=now_s,
            duty=(1.0, 1.0),
            changes=(),
            lease_until_s=now_s + LEASE_S,
        )
        self.executor.submit(plan)
        return self.orders[before:]

    async def opens(self) -> list[tuple[int, int]]:
        """Submit plans until one is carried out; return the orders of all until then."""
        given: list[tuple[int, int]] = []
        async with asyncio.timeout(5.0):
            while (9, 2000) not in given:
                given += self.submit()
                await asyncio.sleep(0.02)
        return given


@pytest.fixture
async def guarded(tmp_path: Path) -> AsyncIterator[Guarded]:
    async with started(tmp_path / "guardian.json") as found:
        yield found


@asynccontextmanager
async def started(note: Path) -> AsyncIterator[Guarded]:
    found = Guarded(note)
    await found.executor.start()
    try:
        yield found
    finally:
        found.fails = False
        await found.executor.stop()


async def test_nothing_opens_before_the_guardian_rests(guarded: Guarded) -> None:
    assert (9, 2000) not in guarded.submit()
    await guarded.opens()
    assert guarded.executor.fault is None
    assert guarded.said == []


async def test_what_the_guardian_closed_is_ordered_closed_and_then_anew(guarded: Guarded) -> None:
    await guarded.opens()
    await asyncio.sleep(0.02)
    time.sleep(LEASE_S + 0.15)  # noqa: ASYNC251 - the loop stands still
    first = guarded.submit()
    assert {pulse_us for _, pulse_us in first} == {1000}
    assert {channel for channel, _ in first} == {9, 10}
    again = await guarded.opens()
    assert again[-2:] == [(9, 2000), (10, 2000)]
    assert guarded.said == ["guardian closed all: companion silent"]


async def test_a_guardian_that_ended_is_a_fault_for_good(guarded: Guarded) -> None:
    await guarded.opens()
    child = guarded.executor._child
    assert child is not None
    child.kill()
    assert (9, 1000) in guarded.submit()
    assert guarded.executor.fault == "guardian ended: restart"
    assert (9, 2000) not in guarded.submit()


async def test_a_guardian_that_cannot_be_started_is_a_fault(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("companion.output.guarded.COMMAND", ("/nowhere/guardian",))
    async with started(tmp_path / "note") as found:
        fault = found.executor.fault
        assert fault is not None
        assert fault.startswith("no guardian: ")
        assert (9, 2000) not in found.submit()


async def test_the_end_takes_the_guardian_along_even_where_nothing_can_be_ordered(
    tmp_path: Path,
) -> None:
    async with started(tmp_path / "note") as found:
        await found.opens()
        child = found.executor._child
        assert child is not None
        found.fails = True
        with pytest.raises(OSError, match="the link broke"):
            await found.executor.stop()
        assert child._process.returncode == 0
        assert found.executor._child is None


async def test_word_that_an_earlier_guardian_left_is_told_once(tmp_path: Path) -> None:
    note = tmp_path / "guardian.json"
    note.write_text('{"closed_s": 1764340000.0, "rounds": 11}')
    async with started(note) as found:
        assert found.said == ["last run was killed: guardian closed all, 14:26:40 UTC"]
    assert not note.exists()
    note.write_text('{"closed_s": ')
    async with started(note) as found:
        assert found.said == []


async def test_a_guardian_that_does_not_end_holds_up_nothing_else(guarded: Guarded) -> None:
    await guarded.opens()
    child = guarded.executor._child
    assert child is not None
    os.kill(child.pid, signal.SIGSTOP)
    guarded.orders.clear()
    stopping = asyncio.create_task(guarded.executor.stop())
    await asyncio.sleep(0)
    assert guarded.orders == [(9, 1000), (10, 1000)]
    turns = 0
    while not stopping.done():
        # From the second closing on it waits for the guardian alone: for a second.
        turns += len(guarded.orders) == 4
        await asyncio.sleep(0.01)
    assert turns > 5
    assert child._process.returncode == -signal.SIGKILL


# ----------------------------------------------------------------------------- before a map is read


def made(folder: Path, **changes: str) -> tuple[Any, Any]:
    shutil.copytree(EXAMPLE, folder, ignore=shutil.ignore_patterns("flights"))
    url = f"link.url=udpin:127.0.0.1:{free_port()}"
    config = load(folder / "config.toml", overrides=[url])
    link = build_link(config, (), component_options(config))
    return link, build_outputs(config, link)


async def test_what_is_heard_while_a_map_is_read_is_kept(tmp_path: Path) -> None:
    link, executor = made(tmp_path / "anyang")
    port = int(link._url.rpartition(":")[2])
    told: list[str] = []

    def read() -> str:
        end_s = time.monotonic() + 5.0
        while not link.has_been_heard and time.monotonic() < end_s:
            time.sleep(0.01)
        return "map"

    try:
        with heard(port):
            assert await meanwhile(read, link, executor) == "map"
        assert link.component.is_vehicle_known
        assert any(isinstance(item, HeartbeatReport) for item in link.receive())
        link._event(1.0, "link", "early")
        link.on_event(lambda at_s, kind, text: told.append(text))
        assert told == ["early"]
    finally:
        await executor.stop()
        await link.close()


async def test_nobody_enables_a_companion_that_still_reads_its_map(tmp_path: Path) -> None:
    link, _ = made(tmp_path / "anyang")
    enable = mavlink.MAVLink(None, srcSystem=255, srcComponent=190).command_long_encode(
        1, 191, 216, 0, *(1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    )
    peer = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
    beat = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    data = beat.heartbeat_encode(2, 3, 0, 0, 4).pack(beat) + enable.pack(peer)
    link._on_bytes(data)
    link.attend()
    assert not any(isinstance(item, OperatorCommand) for item in link.receive())
    link._on_bytes(enable.pack(peer))
    assert any(isinstance(item, OperatorCommand) for item in link.receive())


async def test_a_map_that_cannot_be_read_leaves_nothing_open(tmp_path: Path) -> None:
    link, executor = made(tmp_path / "anyang")

    def read() -> None:
        raise MapError("no map", code="test", fix="none")

    try:
        with pytest.raises(MapError):
            await meanwhile(read, link, executor)
        assert asyncio.all_tasks() == {asyncio.current_task()}
    finally:
        await executor.stop()
        await link.close()


async def test_who_is_told_to_stop_does_not_wait_for_the_map(tmp_path: Path) -> None:
    link, executor = made(tmp_path / "anyang")
    begun, goes_on = threading.Event(), threading.Event()

    def read() -> bool:
        begun.set()
        return goes_on.wait(60.0)

    try:
        reading = asyncio.create_task(meanwhile(read, link, executor))
        await asyncio.to_thread(begun.wait)
        reading.cancel()
        with pytest.raises(asyncio.CancelledError):
            await reading
        assert not goes_on.is_set()
    finally:
        goes_on.set()
        await executor.stop()
        await link.close()


def test_a_run_that_is_refused_leaves_no_guardian(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """That no process is left is looked at after every test."""
    folder = tmp_path / "anyang"
    shutil.copytree(EXAMPLE, folder, ignore=shutil.ignore_patterns("flights"))
    (folder / "boundary.geojson").write_text("{}")
    url = f"link.url=udpin:127.0.0.1:{free_port()}"
    assert execute(["run", "--config", str(folder / "config.toml"), "--set", url]) == 2
    assert "boundary.geojson" in capsys.readouterr().err
