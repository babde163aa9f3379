"""However a part ends, what it took is given back: each test fails for a `finally` of its own."""

from __future__ import annotations

import asyncio
import json
import math
import os
import signal
import socket
import sqlite3
import subprocess
import threading
import time
from collections.abc import AsyncIterator, Callable
from contextlib import closing, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from fastapi import HTTPException

from companion.core.types import Decision, HeartbeatReport, Input, Method, SprayPlan
from companion.errors import JournalError
from companion.journal.journal import Journal
from companion.journal.writer import Writer
from companion.runtime import run
from companion.web import OperatorPage, Order, Outcome, listen
from companion.web.server import EventStream, Orders, _either
from sitl.serve import ServeOptions, _Run
from sitl.stub.server import _TcpServer
from sitl.workers import (
    _environment,
    _interrupt_held_back,
    process_pool,
    termination_as_interrupt,
)
from tests.builders import setup


class BrokenPartError(RuntimeError):
    """What no part is expected to raise."""


@dataclass
class Scribe:
    """Link and executor in one; `fail_on` names the call that fails."""

    fail_on: str = ""
    fault: str | None = None
    calls: list[str] = field(default_factory=list)
    inputs: list[Input] = field(default_factory=list)
    submitted: asyncio.Event = field(default_factory=asyncio.Event)

    def _note(self, call: str) -> None:
        self.calls.append(call)
        if call == self.fail_on:
            raise BrokenPartError(call)

    async def open(self, wake: Callable[[], None]) -> None:
        self._note("open")

    def receive(self) -> list[Input]:
        self._note("receive")
        return [self.inputs.pop(0)] if self.inputs else []

    def tell(self, decision: Decision | None, now_s: float) -> None:
        self._note("tell")

    def tell_fault(self, text: str) -> None:
        self._note("tell_fault")

    async def close(self) -> None:
        self._note("close")

    async def start(self) -> None:
        self._note("start")

    is_guarded = True

    def submit(self, plan: SprayPlan) -> None:
        self.submitted.set()
        self._note("submit")

    async def stop(self) -> None:
        self._note("stop")


@pytest.mark.parametrize("fail_on", ["", "open", "start", "receive", "submit", "stop", "close"])
async def test_signals_and_handler_are_given_back_whatever_fails(fail_on: str) -> None:
    loop = asyncio.get_running_loop()
    handler = loop.get_exception_handler()
    scribe = Scribe(fail_on=fail_on)
    given = run(setup(), link=scribe, executor=scribe, duration_s=0.0)
    results = await asyncio.gather(given, return_exceptions=True)
    assert [type(result) for result in results] == [BrokenPartError if fail_on else int]
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert loop.get_exception_handler() is handler
    # Valves first, while the link can still carry the order; then the link.
    assert scribe.calls[-2:] == (["open", "close"] if fail_on == "open" else ["stop", "close"])


@pytest.mark.parametrize("fail_on", ["", "submit"])
async def test_no_timer_is_left_behind_whatever_fails(fail_on: str) -> None:
    scribe = Scribe(fail_on=fail_on)
    task = asyncio.create_task(run(setup(), link=scribe, executor=scribe, duration_s=3600.0))
    async with asyncio.timeout(5.0):
        await scribe.submitted.wait()
    await asyncio.sleep(0)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    left = [timer.when() for timer in asyncio.get_running_loop()._scheduled  # type: ignore[attr-defined]
            if not timer.cancelled()]  # fmt: skip
    assert left == []
    assert scribe.calls[-2:] == ["stop", "close"]


def test_a_demo_that_fails_gives_the_signal_back() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(BrokenPartError), termination_as_interrupt():
        raise BrokenPartError
    assert signal.getsignal(signal.SIGTERM) is before


async def test_an_order_to_close_leaves_before_anything_is_told() -> None:
    scribe = Scribe()
    await run(setup(), link=scribe, executor=scribe, duration_s=0.0)
    assert scribe.calls[:5] == ["open", "start", "receive", "submit", "tell"]


@dataclass
class Notes:
    """Keeps what it is given to take down."""

    rows: list[Input | Decision] = field(default_factory=list)

    def record_input(self, item: Input) -> None:
        self.rows.append(item)

    def record_decision(self, decision: Decision) -> None:
        self.rows.append(decision)

    def record_event(self, at_s: float, kind: str, text: str) -> None:
        pass


async def test_every_input_is_taken_down_before_the_decision_that_it_led_to() -> None:
    beat = HeartbeatReport(received_s=1.0, autopilot="ardupilot", armed=False, mode="AUTO")
    scribe, notes = Scribe(inputs=[beat]), Notes()
    await run(setup(), link=scribe, executor=scribe, recorder=notes, duration_s=0.0)
    assert notes.rows[0] is beat
    assert isinstance(notes.rows[-1], Decision)


@pytest.mark.parametrize("method", list(Method))
def test_a_journal_tells_the_method_that_was_flown(method: Method, tmp_path: Path) -> None:
    with Journal.create(tmp_path, setup=setup(method=method)) as journal:
        pass
    with closing(sqlite3.connect(journal.path)) as connection:
        found = connection.execute("SELECT value FROM meta WHERE key = 'method'").fetchall()
    assert found == [(str(method),)]


def open_files(folder: Path) -> list[str]:
    links = [link for link in Path("/proc/self/fd").iterdir() if link.is_symlink()]
    return [name for name in map(str, map(Path.resolve, links)) if str(folder) in name]


def test_a_journal_that_cannot_be_begun_leaves_no_file_and_none_open(tmp_path: Path) -> None:
    text = {"config_toml": object()}
    with pytest.raises(JournalError) as raised:
        Journal.create(tmp_path, setup=setup(), setup_text=text)  # type: ignore[arg-type]
    assert list(tmp_path.iterdir()) == []
    assert open_files(tmp_path) == []
    assert raised.value.__cause__ is not None


def test_a_writer_that_fails_at_the_end_closes_its_file(tmp_path: Path) -> None:
    class Failing(sqlite3.Connection):
        def execute(self, *arguments: Any) -> sqlite3.Cursor:
            raise BrokenPartError

    connection = sqlite3.connect(tmp_path / "a.gpkg", factory=Failing)
    writer = Writer(connection, frame=setup().frame, utc_offset_s=0.0, next_sequence=lambda: 1)
    with pytest.raises(BrokenPartError):
        writer.finish(lost_before=0)
    with pytest.raises(sqlite3.ProgrammingError, match="closed"):
        connection.cursor()


def test_a_journal_whose_writer_fails_is_a_closed_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[object] = []
    monkeypatch.setattr(threading, "excepthook", lambda given: seen.append(given.exc_type))

    class Poison:
        @property
        def received_s(self) -> float:
            raise BrokenPartError

    with Journal.create(tmp_path, setup=setup()) as journal:
        journal.record_input(Poison())  # type: ignore[arg-type]
    assert seen == [BrokenPartError]
    assert [path.name for path in tmp_path.iterdir()] == [journal.path.name]
    with closing(sqlite3.connect(journal.path)) as connection:
        found = connection.execute("SELECT value FROM meta WHERE key = 'closed'").fetchall()
    assert found == [("yes",)]


@pytest.mark.parametrize("fails", [False, True])
def test_a_pool_takes_no_work_after_its_block_however_it_ended(fails: bool) -> None:
    with suppress(BrokenPartError), process_pool(1) as pool:
        if fails:
            raise BrokenPartError
    # Let go of by `shutdown` only; work is refused by a pool whose processes died as well.
    assert getattr(pool, "_executor_manager_thread", "renamed") is None
    with pytest.raises(RuntimeError):
        pool.submit(abs, -1)


def test_an_interrupt_is_let_through_again_whatever_fails() -> None:
    with suppress(BrokenPartError), _interrupt_held_back():
        raise BrokenPartError
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})


# ------------------------------------------------------------------- the stub's TCP clients


@dataclass
class Hub:
    """Counts its peers; may fail on what it receives."""

    peers: int = 0
    fails: bool = False

    def attach(self, name: str, send: Callable[[bytes], None]) -> Any:
        self.peers += 1

    def detach(self, channel: Any) -> None:
        self.peers -= 1

    def received(self, channel: Any, received: bytes) -> None:
        if self.fails:
            raise BrokenPartError


@dataclass
class Line:
    """The writing half of a connection."""

    is_closed: bool = False

    def get_extra_info(self, name: str) -> tuple[str, int]:
        return ("127.0.0.1", 1)

    def close(self) -> None:
        self.is_closed = True


def by_hanging_up(reader: asyncio.StreamReader, task: asyncio.Task[None]) -> None:
    reader.feed_eof()


def by_a_broken_line(reader: asyncio.StreamReader, task: asyncio.Task[None]) -> None:
    reader.set_exception(ConnectionResetError())


def by_a_fault_of_ours(reader: asyncio.StreamReader, task: asyncio.Task[None]) -> None:
    reader.feed_data(b"x")


def by_the_end_of_the_server(reader: asyncio.StreamReader, task: asyncio.Task[None]) -> None:
    task.cancel()


@pytest.mark.parametrize(
    "end", [by_hanging_up, by_a_broken_line, by_a_fault_of_ours, by_the_end_of_the_server]
)
async def test_a_client_that_is_gone_is_forgotten_however_it_went(
    end: Callable[[asyncio.StreamReader, asyncio.Task[None]], None],
) -> None:
    hub, line, reader = Hub(fails=end is by_a_fault_of_ours), Line(), asyncio.StreamReader()
    server = _TcpServer(hub)
    task = asyncio.create_task(server._accept(reader, line))  # type: ignore[arg-type]
    await asyncio.sleep(0)
    assert hub.peers == 1
    end(reader, task)
    await asyncio.gather(task, return_exceptions=True)
    assert (hub.peers, line.is_closed, server._tasks) == (0, True, set())


# --------------------------------------------------------------------- the flight of the stub


class Server:
    """A server of which nothing is heard."""

    async def wait(self) -> None:
        await asyncio.Event().wait()


@pytest.mark.parametrize("cancelled", [False, True])
async def test_waiting_for_the_landing_leaves_nothing_waiting(cancelled: bool) -> None:
    flight = _Run(ServeOptions(), lambda text: None)
    before = asyncio.all_tasks()
    task = asyncio.create_task(flight.finished(Server()))  # type: ignore[arg-type]
    await asyncio.sleep(0)
    if cancelled:
        task.cancel()
    else:
        flight._done.set()
    await asyncio.gather(task, return_exceptions=True)
    await asyncio.sleep(0)
    assert asyncio.all_tasks() == before


@pytest.mark.parametrize("before", [None, "", "1"])
def test_the_environment_is_as_before_when_no_process_could_be_started(
    before: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    if before is not None:
        monkeypatch.setenv("PYTHONSAFEPATH", before)
    with suppress(BrokenPartError), _environment():
        assert os.environ["PYTHONSAFEPATH"] == "1"
        raise BrokenPartError
    assert os.environ.get("PYTHONSAFEPATH") == before


async def test_a_browser_that_is_given_up_leaves_nobody_waiting_for_news() -> None:
    before = asyncio.all_tasks()
    waits = asyncio.ensure_future(
        _either(asyncio.Event(), asyncio.get_running_loop().create_future())
    )
    await asyncio.sleep(0)
    waits.cancel()
    with suppress(asyncio.CancelledError):
        await waits
    await asyncio.sleep(0)
    assert asyncio.all_tasks() == before


@pytest.mark.parametrize("answered", [True, False])
async def test_an_order_of_the_page_is_forgotten_however_it_went(answered: bool) -> None:
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with near, far:
        orders = Orders(near)
        orders.attach(lambda: None)
        if not answered:
            far.close()
        given = asyncio.ensure_future(orders.give("stop"))
        await asyncio.sleep(0)
        if answered:
            number = json.loads(far.recv(4096))["number"]
            far.send(json.dumps({"number": number, "accepted": True, "text": "done"}).encode())
        with suppress(HTTPException):
            assert (await given).accepted
        asyncio.get_running_loop().remove_reader(near)
        assert orders._waiting == {}


async def test_stops_that_come_together_are_one_and_one_after_another_order_is_another() -> None:
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with near, far:
        orders = Orders(near)
        orders.attach(lambda: None)
        names = ("stop", "stop", "enable", "stop", "stop")
        given = [asyncio.ensure_future(orders.give(name)) for name in names]
        await asyncio.sleep(0)
        for name in ("stop", "enable", "stop"):
            packet = json.loads(far.recv(4096))
            assert packet["name"] == name
            answer = {"number": packet["number"], "accepted": True, "text": name}
            far.send(json.dumps(answer).encode())
        assert [(await one).text for one in given] == list(names)
        with pytest.raises(BlockingIOError):
            far.recv(4096, socket.MSG_DONTWAIT)
        asyncio.get_running_loop().remove_reader(near)


@pytest.mark.parametrize("breaks", [True, False])
async def test_a_browser_that_went_is_no_client_any_more(breaks: bool) -> None:
    class State:
        clients = 0

        async def events(self, _since: int, _gone: object) -> AsyncIterator[bytes]:
            assert self.clients == 1
            yield b"data: 1\n\n"

    async def send(_message: object) -> None:
        if breaks:
            raise ConnectionResetError

    async def receive() -> dict[str, str]:
        await asyncio.get_running_loop().create_future()
        raise AssertionError

    state, before = State(), asyncio.all_tasks()
    with suppress(ConnectionResetError):
        await EventStream(state, 0)({}, receive, send)  # type: ignore[arg-type]
    await asyncio.sleep(0)
    assert state.clients == 0
    assert asyncio.all_tasks() == before


@pytest.mark.parametrize("starts", [True, False])
def test_a_page_that_cannot_be_started_leaves_no_file_open_and_is_tried_again(
    starts: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = OperatorPage(listen("127.0.0.1", 0), {"map": {}}, obey=never, horizon_s=0.5)

    def no_process(*_given: object, **_named: object) -> None:
        raise OSError("no process")

    before = len(list(Path("/proc/self/fd").iterdir()))
    monkeypatch.setattr(subprocess, "Popen", no_process)
    page._start()
    assert len(list(Path("/proc/self/fd").iterdir())) == before

    def start() -> None:
        if not starts:
            raise ValueError("broken")

    page._is_open, page._started_s = True, -math.inf
    monkeypatch.setattr(page, "_start", start)
    monkeypatch.setattr(threading, "excepthook", lambda _of: None)
    page._restart(time.monotonic())
    for thread in threading.enumerate():
        if thread.name == "page":
            thread.join()
    assert not page._is_starting
    asyncio.run(page.close())


def never(_order: Order, _now_s: float) -> Outcome:
    raise AssertionError
