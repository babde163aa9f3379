"""A signed link over a restart: what was said before it opens nothing after it.

The vehicle's and the station's bytes are kept as they leave and sent again to the next start, by
whom does not matter: a frame is all that anybody needs who does not know the key.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.core.types import ClockReport, RcReport
from companion.link.component import Component, ComponentOptions
from companion.link.parameters import read_state
from companion.link.signing import STATE_NAME, Signing
from companion.output.servo import ServoExecutor, ServoOptions
from companion.runtime import run
from tests import builders
from tests.companion.wire_peer import WirePeer, over_wire
from tests.virtual_time import WireLink, now_s

pytestmark = [pytest.mark.sitl, pytest.mark.virtual_time]

SETUP = builders.setup()
KEY = bytes(range(100, 132))
TODAY_S = 1_764_000_000.0
YEAR_S = 365 * 86_400.0
ENABLE = 76  # COMMAND_LONG


def today_s() -> float:
    return TODAY_S + now_s()


class Wire:
    """The way to the companion, and all that went over it."""

    def __init__(self) -> None:
        self.said: list[bytes] = []
        self.send: Callable[[bytes], None] = lambda data: None

    def write(self, data: bytes) -> None:
        self.said.append(data)
        self.send(data)

    def commands(self) -> list[bytes]:
        return [frame for frame in self.said if frame[7] == ENABLE]


@contextlib.asynccontextmanager
async def companion(
    peer: WirePeer, wire: Wire, folder: Path, clock: Callable[[], float] = today_s
) -> AsyncIterator[WireLink]:
    """Yield a companion's link from its start to its sudden end: it writes nothing at the end."""
    signing = Signing(KEY, state_folder=folder, clock=clock)
    link = WireLink("udpin:127.0.0.1:14550", ComponentOptions(), clock=now_s, signing=signing)
    executor = ServoExecutor(ServoOptions(channels=tuple(range(9, 15))), link.order)
    link.on_order_ack(executor.acknowledge)
    peer.forget_streams()
    peer.outputs.clear()
    peer.messages.clear()
    task = asyncio.create_task(
        run(SETUP, link=link, executor=executor, clock=now_s, boot_clock=now_s)
    )
    try:
        async with over_wire(peer, link):
            wire.send, peer.write = peer.write, wire.write
            yield link
            await asyncio.sleep(0.1)
            signing.wait_until_kept()
            kept = (folder / STATE_NAME).read_bytes()
            wire.send = lambda data: None
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
    (folder / STATE_NAME).write_bytes(kept)


def vehicle(clock: Callable[[], float] = today_s, *, answers: bool = True) -> WirePeer:
    peer = WirePeer(SETUP.frame, east_m=2.0)
    peer.sign(KEY, clock)
    peer.answers_time = answers
    return peer


async def answered(peer: WirePeer) -> None:
    """Wait until the companion has asked for the time, and has the answer."""
    await peer.until(lambda: bool(peer.of("TIMESYNC")))
    await asyncio.sleep(0.2)


async def opens(peer: WirePeer) -> bool:
    """Tell whether it sprays within two seconds, over the field."""
    peer.place(east_m=2.0)
    with contextlib.suppress(TimeoutError):
        await peer.until(lambda: len(peer.open_channels) == 6, within_s=2.0)
    return peer.is_spraying


async def sprayed(peer: WirePeer, wire: Wire, folder: Path) -> None:
    """Spray by a signed ENABLE, and die."""
    async with companion(peer, wire, folder):
        await answered(peer)
        peer.enable()
        assert await opens(peer)


def lose(folder: Path) -> None:
    (folder / STATE_NAME).unlink()


def damage(folder: Path) -> None:
    (folder / STATE_NAME).write_bytes(b'{"stamp": 3')


def date_back(folder: Path) -> None:
    """Damage it on a board whose clock has begun in 1970."""
    damage(folder)
    os.utime(folder / STATE_NAME, (0.0, 0.0))


@pytest.mark.parametrize("off_s", [0.0, -3 * YEAR_S, 3 * YEAR_S], ids=["right", "behind", "ahead"])
@pytest.mark.parametrize("happens", [None, lose, damage, date_back])
@pytest.mark.parametrize("is_first", [True, False], ids=["before", "after"])
async def test_a_captured_enable_opens_nothing_after_a_restart_and_a_new_one_does(
    tmp_path: Path, off_s: float, happens: Callable[[Path], None] | None, is_first: bool
) -> None:
    peer, wire = vehicle(), Wire()
    await sprayed(peer, wire, tmp_path)
    captured = wire.commands()
    if happens is not None:
        happens(tmp_path)
    async with companion(peer, wire, tmp_path, lambda: today_s() + off_s):
        if is_first:  # before anybody else is heard
            for frame in captured:
                wire.send(frame)
        await answered(peer)
        for frame in captured:
            wire.send(frame)
        assert not await opens(peer)
        peer.enable()
        assert await opens(peer)


async def test_everything_that_was_said_may_be_said_again(tmp_path: Path) -> None:
    peer, wire = vehicle(), Wire()
    await sprayed(peer, wire, tmp_path)
    captured = list(wire.said)
    async with companion(peer, wire, tmp_path):
        for frame in captured:
            wire.send(frame)
        await answered(peer)
        for frame in captured:
            wire.send(frame)
        assert not await opens(peer)


async def test_an_enable_that_nobody_heard_is_old_once_the_vehicle_has_answered(
    tmp_path: Path,
) -> None:
    """It was said while a board without a clock was off, and is sent again an hour later."""
    peer, wire = vehicle(), Wire()
    await sprayed(peer, wire, tmp_path)
    stopped_s = now_s()
    peer.write = wire.write
    peer.enable()
    unheard = wire.commands()[-1]
    await asyncio.sleep(3600.0)
    async with companion(peer, wire, tmp_path, lambda: today_s() - now_s() + stopped_s):
        wire.send(unheard)
        await answered(peer)
        wire.send(unheard)
        assert not await opens(peer)


async def test_a_station_whose_clock_is_ahead_says_nothing_twice(tmp_path: Path) -> None:
    """Its stamps stay ahead of everybody's for an hour: only the file knows that they are old."""
    peer, wire = vehicle(lambda: today_s() + 3600.0), Wire()
    await sprayed(peer, wire, tmp_path)
    other, captured = vehicle(), wire.commands()
    async with companion(other, wire, tmp_path):
        await answered(other)
        for frame in captured:
            wire.send(frame)
        assert not await opens(other)


@pytest.mark.parametrize("happens", [None, lose])
async def test_an_autopilot_that_answers_no_question_needs_the_stamps_of_before(
    tmp_path: Path, happens: Callable[[Path], None] | None
) -> None:
    peer, wire = vehicle(), Wire()
    await sprayed(peer, wire, tmp_path)
    peer.answers_time = False
    captured = wire.commands()
    if happens is not None:
        happens(tmp_path)
    async with companion(peer, wire, tmp_path):
        await asyncio.sleep(6.0)
        for frame in captured:
            wire.send(frame)
        assert not await opens(peer)
        peer.enable()
        assert await opens(peer) is (happens is None)
        if happens is not None:
            assert any("signing: no answer yet" in text for text in peer.texts())


async def test_without_room_on_the_disk_nothing_opens_by_a_signed_frame(tmp_path: Path) -> None:
    peer, wire = vehicle(), Wire()
    async with companion(peer, wire, tmp_path):
        await answered(peer)
        (tmp_path / STATE_NAME).rename(tmp_path / "kept")
        (tmp_path / STATE_NAME).mkdir()
        peer.enable()
        assert not await opens(peer)
        assert any("signing stamp not stored" in text for text in peer.texts())
        (tmp_path / STATE_NAME).rmdir()
        (tmp_path / "kept").rename(tmp_path / STATE_NAME)
        peer.enable()
        assert await opens(peer)


async def test_an_enable_is_on_the_disk_when_it_is_answered(tmp_path: Path) -> None:
    peer, wire = vehicle(), Wire()
    async with companion(peer, wire, tmp_path):
        await answered(peer)
        for _ in range(3):
            before = len(peer.of("COMMAND_ACK"))
            peer.enable()
            await peer.until(lambda count=before: len(peer.of("COMMAND_ACK")) > count)
            stamp = int.from_bytes(wire.commands()[-1][-12:-6], "little")
            assert read_state(tmp_path / STATE_NAME)["255/190/0"] >= stamp
            peer.enable(False)
            await asyncio.sleep(0.2)  # until the next step has closed
            assert peer.is_all_closed


async def test_our_own_question_said_back_is_no_answer(tmp_path: Path) -> None:
    peer, wire = vehicle(answers=False), Wire()
    async with companion(peer, wire, tmp_path) as link:
        frames: list[bytes] = []
        deliver = link.deliver
        link.deliver = lambda data: (frames.append(data), deliver(data))  # type: ignore[method-assign, assign]
        await peer.until(lambda: len(peer.of("TIMESYNC")) >= 2)
        for frame in [frame for frame in frames if frame[7] == 111]:
            wire.send(frame)
        await asyncio.sleep(0.2)
        peer.enable()
        assert not await opens(peer)


def test_a_switch_counts_once_somebody_has_answered(tmp_path: Path) -> None:
    sent: list[bytes] = []
    signing = Signing(KEY, state_folder=tmp_path, clock=lambda: TODAY_S)
    component = Component(
        ComponentOptions(), lambda data: sent.append(data) is None, signing=signing
    )
    station = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    station.signing.secret_key, station.signing.sign_outgoing = KEY, True
    station.signing.timestamp = round((TODAY_S - 1_420_070_400) * 1e5)

    def hears(name: str, *fields: int) -> list[type]:
        frame = bytes(getattr(station, f"{name}_encode")(*fields).pack(station))
        return [type(item) for item in component.receive(frame, 1.0)]

    switch = (1000, 8, *([1900] * 18), 255)
    hears("heartbeat", 2, 3, 0, 0, 4)
    assert hears("rc_channels", *switch) == []
    component.tick(None, 1.0)
    (question,) = [m for frame in sent for m in station.parse_buffer(frame) if m.get_msgId() == 111]
    assert ClockReport in hears("timesync", 60_000_000_000, question.ts1)
    assert hears("rc_channels", *switch) == [RcReport]
