"""`run` against an autopilot on the wire: it sprays when it may, and closes however it ends.

On virtual time, byte by byte; over sockets in `test_run_socket.py`.
"""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise

import pytest

from companion.core.setup import Setup
from companion.core.types import Decision, Inhibit, Input, SprayPlan
from companion.link.component import ComponentOptions
from companion.link.vehicle_link import VehicleLink
from companion.output.servo import ServoExecutor, ServoOptions
from companion.runtime import STEP_MAX_S, run
from tests import builders
from tests.companion.wire_peer import WirePeer, over_wire
from tests.virtual_time import WireLink, now_s

pytestmark = [pytest.mark.sitl, pytest.mark.virtual_time]

# With the loop's own time: on a computer's, a step is due at once for as long as it is behind.
flown = partial(run, clock=now_s, boot_clock=now_s)

SETUP = builders.setup()
CHANNELS = tuple(range(9, 15))


@dataclass
class Notes:
    """A recorder that keeps everything."""

    inputs: list[Input] = field(default_factory=list)
    decisions: list[Decision] = field(default_factory=list)
    events: list[tuple[str, str]] = field(default_factory=list)
    news: asyncio.Event = field(default_factory=asyncio.Event)

    async def until(self, done: Callable[[Decision], bool]) -> None:
        async with asyncio.timeout(5.0):
            while not (self.decisions and done(self.decisions[-1])):
                self.news.clear()
                await self.news.wait()

    def record_input(self, item: Input) -> None:
        self.inputs.append(item)

    def record_decision(self, decision: Decision) -> None:
        self.decisions.append(decision)
        self.news.set()

    def record_event(self, at_s: float, kind: str, text: str) -> None:
        self.events.append((kind, text))


class Companion:
    """`run` as a task, wired as the command line wires it; without a URL in this process alone."""

    def __init__(self, url: str | None = None, setup: Setup = SETUP) -> None:
        self.link = (
            WireLink("udpin:127.0.0.1:14550", ComponentOptions(), clock=now_s)
            if url is None
            else VehicleLink(url, ComponentOptions())
        )
        self.executor = ServoExecutor(ServoOptions(channels=CHANNELS), self.link.order)
        self.link.on_order_ack(self.executor.acknowledge)
        self.notes = Notes()
        self.setup = setup
        self.task: asyncio.Task[int] | None = None

    def start(self, duration_s: float | None = None) -> asyncio.Task[int]:
        self.task = asyncio.create_task(
            run(
                self.setup,
                link=self.link,
                executor=self.executor,
                recorder=self.notes,
                duration_s=duration_s,
                clock=now_s,
                boot_clock=now_s,
            )
        )
        return self.task

    async def result(self) -> int:
        assert self.task is not None
        async with asyncio.timeout(5.0):
            return await self.task


@dataclass
class Flight:
    """A companion and the autopilot that it flies with."""

    companion: Companion
    peer: WirePeer

    async def until_spraying(self) -> None:
        await self.peer.until(lambda: bool(self.peer.outputs))
        self.peer.enable()
        await self.peer.until(lambda: len(self.peer.open_channels) == len(CHANNELS))


@pytest.fixture
async def flight() -> AsyncIterator[Flight]:
    """Yield a companion that has just begun, beside a vehicle that flies over the field."""
    companion = Companion()
    assert isinstance(companion.link, WireLink)
    companion.start()
    async with over_wire(WirePeer(SETUP.frame, east_m=2.0), companion.link) as peer:
        yield Flight(companion, peer)
        if companion.task is not None and not companion.task.done():
            companion.task.cancel()
        await asyncio.gather(companion.task, return_exceptions=True)  # type: ignore[arg-type]


async def test_it_begins_closed_and_stays_so_until_it_is_enabled(flight: Flight) -> None:
    await flight.peer.until(lambda: flight.peer.is_all_closed)
    await flight.peer.until(lambda: "Spray off: not enabled" in flight.peer.texts())
    assert not flight.peer.is_spraying
    flight.peer.enable()
    await flight.peer.until(lambda: len(flight.peer.open_channels) == 6)


async def test_it_asks_for_positions_at_twenty_hertz_and_gets_them(flight: Flight) -> None:
    await flight.until_spraying()
    begin = len(flight.companion.notes.decisions)
    before_s = now_s()
    await asyncio.sleep(1.0)
    rate_hz = (len(flight.companion.notes.decisions) - begin) / (now_s() - before_s)
    assert rate_hz >= 20.0


async def test_disabling_closes_within_five_hundredths_of_a_second(flight: Flight) -> None:
    await flight.until_spraying()
    sent_s = now_s()
    flight.peer.enable(False)
    await flight.peer.until(lambda: flight.peer.is_all_closed)
    assert flight.peer.orders[-1].at_s - sent_s < 0.05


async def test_a_change_of_mode_closes_at_once(flight: Flight) -> None:
    flight.peer.mode = 3
    flight.peer.send(0)
    await flight.until_spraying()
    flight.peer.mode = 6
    sent_s = now_s()
    flight.peer.send(0)
    await flight.peer.until(lambda: flight.peer.is_all_closed)
    assert flight.peer.orders[-1].at_s - sent_s < 0.05


async def test_silence_of_the_vehicle_closes_within_the_age_of_a_position(flight: Flight) -> None:
    await flight.until_spraying()
    flight.peer.is_silent = True
    silent_s = now_s()
    await flight.peer.until(lambda: flight.peer.is_all_closed)
    assert flight.peer.orders[-1].at_s - silent_s < SETUP.limits.position_age_max_s + 0.15


async def test_garbage_on_the_wire_changes_nothing(flight: Flight) -> None:
    await flight.until_spraying()
    for _ in range(20):
        flight.peer.garbage()
        flight.peer.send(33)
    live = len(flight.peer.of("NAMED_VALUE_FLOAT"))
    await flight.peer.until(lambda: len(flight.peer.of("NAMED_VALUE_FLOAT")) > live + 5)
    assert flight.peer.is_spraying


async def test_a_refused_order_closes_for_good_and_is_told_once(flight: Flight) -> None:
    await flight.until_spraying()
    flight.peer.servo_result = 4
    flight.peer.enable(False)
    flight.peer.enable(True)
    await flight.peer.until(lambda: any("servo order" in text for text in flight.peer.texts()))
    await flight.peer.until(lambda: any("output fault" in text for text in flight.peer.texts()))
    since = len(flight.peer.orders) - 6
    await flight.peer.until(lambda: len(flight.peer.orders) > since + 7)  # seldom refreshed
    assert all(order.pulse_us == 1000 for order in flight.peer.orders[since:])
    assert sum("servo order" in text for text in flight.peer.texts()) == 1
    assert Inhibit.OUTPUT_FAULT in flight.companion.notes.decisions[-1].inhibits


async def test_an_autopilot_that_rebooted_is_asked_for_its_streams_again(flight: Flight) -> None:
    await flight.until_spraying()
    flight.peer.forget_streams()
    flight.peer.started_s = now_s() + 55.0
    flight.peer.start_east_m = 20.0 + 55.0 * 5.0
    asked = len([m for m in flight.peer.of("COMMAND_LONG") if m.command == 511])
    flight.peer.send(33)
    await flight.peer.until(
        lambda: len([m for m in flight.peer.of("COMMAND_LONG") if m.command == 511]) > asked
    )


async def test_the_sign_of_life_goes_on_while_spraying_and_ends_with_it(flight: Flight) -> None:
    await flight.until_spraying()
    first = next(m for m in flight.peer.messages if getattr(m, "name", "") == "SPR_LIVE")
    opened = next(m for m in flight.peer.of("COMMAND_LONG") if m.command == 183 and m.param2 > 1000)
    assert flight.peer.messages.index(first) < flight.peer.messages.index(opened)
    flight.peer.enable(False)
    await flight.peer.until(lambda: flight.peer.is_all_closed)
    count = sum(getattr(m, "name", "") == "SPR_LIVE" for m in flight.peer.messages)
    await asyncio.sleep(0.3)
    assert sum(getattr(m, "name", "") == "SPR_LIVE" for m in flight.peer.messages) == count


# ------------------------------------------------------------------------------- how it ends


async def by_sigterm(flight: Flight) -> None:
    os.kill(os.getpid(), signal.SIGTERM)
    assert await flight.companion.result() == 0


async def by_sigint(flight: Flight) -> None:
    os.kill(os.getpid(), signal.SIGINT)
    assert await flight.companion.result() == 0


async def by_cancellation(flight: Flight) -> None:
    assert flight.companion.task is not None
    flight.companion.task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await flight.companion.result()


class BrokenPartError(RuntimeError):
    """What no part is expected to raise."""


async def by_an_exception_in_a_step(flight: Flight) -> None:
    def fail(decision: Decision) -> None:
        raise BrokenPartError

    flight.companion.notes.record_decision = fail  # type: ignore[method-assign]
    with pytest.raises(BrokenPartError):
        await flight.companion.result()


async def by_an_exception_in_a_callback(flight: Flight) -> None:
    def fail() -> None:
        raise BrokenPartError

    asyncio.get_running_loop().call_soon(fail)
    with pytest.raises(BrokenPartError):
        await flight.companion.result()


ENDS: Sequence[Callable[[Flight], Awaitable[None]]] = [
    by_sigterm,
    by_sigint,
    by_cancellation,
    by_an_exception_in_a_step,
    by_an_exception_in_a_callback,
]


@pytest.mark.parametrize("end", ENDS)
async def test_however_it_ends_every_valve_is_ordered_closed(
    flight: Flight, end: Callable[[Flight], Awaitable[None]]
) -> None:
    await flight.until_spraying()
    count = len(flight.peer.orders)
    await end(flight)
    # A change of its own time may come before them.
    await flight.peer.until(
        lambda: (
            len(flight.peer.orders) >= count + 12
            and [order.channel for order in flight.peer.orders[-12:]] == [*CHANNELS, *CHANNELS]
        )
    )
    last = flight.peer.orders[-12:]
    assert all(order.pulse_us == 1000 for order in last)
    assert flight.companion.notes.events[-1][0] == "stop"


async def test_it_ends_by_itself_after_its_duration() -> None:
    companion = Companion()
    companion.start(duration_s=0.1)
    assert await companion.result() == 0
    assert companion.notes.events == [("start", ""), ("stop", "duration")]


async def test_a_restart_is_disabled(flight: Flight) -> None:
    await flight.until_spraying()
    os.kill(os.getpid(), signal.SIGTERM)
    await flight.companion.result()
    again = Companion()
    assert isinstance(again.link, WireLink)
    again.start()
    flight.peer.outputs.clear()
    flight.peer.messages.clear()
    async with over_wire(flight.peer, again.link):
        await flight.peer.until(lambda: "Spray off: not enabled" in flight.peer.texts())
        assert not flight.peer.is_spraying
        os.kill(os.getpid(), signal.SIGTERM)
        await again.result()


# ----------------------------------------------------------------- the order of closing down


@dataclass
class Scribe:
    """Link and executor in one, which writes down what is called; either may fail."""

    calls: list[str] = field(default_factory=list)
    fail_on: str = ""
    fault: str | None = None
    wake: Callable[[], None] = lambda: None

    def _note(self, call: str) -> None:
        self.calls.append(call)
        if call == self.fail_on:
            raise BrokenPartError(call)

    async def open(self, wake: Callable[[], None]) -> None:
        self.wake = wake
        self._note("open")

    def receive(self) -> list[Input]:
        self._note("receive")
        return []

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
        self._note("submit")

    async def stop(self) -> None:
        self._note("stop")


@pytest.mark.parametrize("fail_on", ["start", "receive", "submit", "tell", "stop"])
async def test_whatever_fails_valves_are_stopped_before_the_link_is_closed(fail_on: str) -> None:
    scribe = Scribe(fail_on=fail_on)
    with pytest.raises(BrokenPartError, match=fail_on):
        await flown(SETUP, link=scribe, executor=scribe, duration_s=0.02)
    assert scribe.calls[-2:] == ["stop", "close"]


async def test_a_link_that_does_not_open_is_closed_and_nothing_is_started() -> None:
    scribe = Scribe(fail_on="open")
    with pytest.raises(BrokenPartError, match="open"):
        await flown(SETUP, link=scribe, executor=scribe)
    assert scribe.calls == ["open", "close"]


class Stuck(Scribe):
    """Something that takes long to open."""

    def __init__(self, at: str) -> None:
        super().__init__()
        self.at, self.is_stuck = at, asyncio.Event()

    async def _open(self, call: str) -> None:
        self._note(call)
        if call == self.at:
            self.is_stuck.set()
            await asyncio.Event().wait()

    async def open(self, wake: Callable[[], None]) -> None:
        await self._open("open")

    async def start(self) -> None:
        await self._open("start")


class StuckSensor(Stuck):
    async def open(self, wake: Callable[[], None]) -> None:
        await self._open("sensor")

    async def close(self) -> None:
        self._note("sensor closed")

    def read(self, now_s: float) -> list[Input]:
        return []


@pytest.mark.parametrize("at", ["open", "start", "sensor"])
async def test_a_signal_does_not_wait_for_what_still_opens(at: str) -> None:
    """A host that does not answer, an engine or a gauge that hangs: seconds each."""
    scribe = StuckSensor(at) if at == "sensor" else Stuck(at)
    link = Stuck(at) if at == "sensor" else scribe
    task = asyncio.create_task(
        flown(SETUP, link=link, executor=link, sensors=[scribe] if scribe is not link else [])
    )
    await scribe.is_stuck.wait()
    os.kill(os.getpid(), signal.SIGTERM)
    assert await task == 0
    assert link.calls[-2:] == (["open", "close"] if at == "open" else ["stop", "close"])
    assert scribe is link or scribe.calls == ["sensor", "sensor closed"]


async def test_an_exception_in_a_callback_is_raised_though_something_still_opens() -> None:
    scribe = Stuck("start")
    task = asyncio.create_task(flown(SETUP, link=scribe, executor=scribe))
    await scribe.is_stuck.wait()

    def fail() -> None:
        raise BrokenPartError

    asyncio.get_running_loop().call_soon(fail)
    with pytest.raises(BrokenPartError):
        await task
    assert scribe.calls[-2:] == ["stop", "close"]


def test_no_end_waits_for_a_thread() -> None:
    """A name server that does not answer, the reader of a large map."""
    program = """
import asyncio, threading
from companion.runtime import execute

async def main():
    begun = threading.Event()
    asyncio.ensure_future(asyncio.to_thread(lambda: (begun.set(), threading.Event().wait())))
    assert await asyncio.to_thread(begun.wait)
    try:
        await asyncio.to_thread(int, "x")
    except ValueError:
        return await asyncio.to_thread(int, "7")

print(execute(main))
"""
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60.0, check=True)
    assert (done.stdout, done.stderr) == ("7\n", "")


async def test_the_signals_are_given_back_afterwards() -> None:
    before = signal.getsignal(signal.SIGTERM)
    await flown(SETUP, link=Scribe(), executor=Scribe(), duration_s=0.0)
    assert signal.getsignal(signal.SIGTERM) is before


@pytest.mark.parametrize("fail_on", ["", "submit"])
async def test_no_timer_is_left_behind(fail_on: str) -> None:
    loop = asyncio.get_running_loop()
    task = asyncio.create_task(
        flown(SETUP, link=Scribe(), executor=Scribe(fail_on=fail_on), duration_s=3600.0)
    )
    await asyncio.sleep(0.01)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    assert [timer for timer in loop._scheduled if not timer.cancelled()] == []  # type: ignore[attr-defined]


async def test_without_news_a_step_follows_after_the_longest_wait() -> None:
    scribe, notes = Scribe(), Notes()
    await flown(SETUP, link=scribe, executor=scribe, recorder=notes, duration_s=1.0)
    gaps_s = [b.now_s - a.now_s for a, b in pairwise(notes.decisions)]
    assert gaps_s == pytest.approx([STEP_MAX_S] * len(gaps_s), abs=1e-6)
