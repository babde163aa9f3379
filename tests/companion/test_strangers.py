"""Anyone can send to a port: what it costs is bounded, and the vehicle loses nothing by it."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import itertools
import logging
import os
import socket
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.core.types import OperatorCommand, Telemetry
from companion.link import signing as signing_module
from companion.link.component import Component, ComponentOptions
from companion.link.framer import Counts, Framer
from companion.link.intake import (
    CHUNK_BYTES_MIN,
    KNOWN_BYTES,
    OTHER_FRAMES,
    OTHERS_MAX,
    SLICE_BYTES,
    SOURCES_MAX,
    STRANGER_BYTES,
    STRANGER_FRAMES,
    STRANGERS_BYTES,
    Intake,
)
from companion.link.signing import Signing
from tests.companion.test_framer_laws import counted
from tests.companion.test_link_findings import KEY, Bench, heartbeat
from tests.companion.wire_peer import free_port

FLOOD = b"\xfe" * 65_507
_AUTOPILOT = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)


def position(number: int) -> bytes:
    """Return a position of the vehicle, each with its own time."""
    message = _AUTOPILOT.global_position_int_encode(
        1000 + 50 * number, 520_000_000, 80_000_000 + number, 60_000, 3500, 0, 500, 0, 9000
    )
    return bytes(message.pack(_AUTOPILOT))


@contextmanager
def a_socket(port: int) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.connect(("127.0.0.1", port))
        yield one


@asynccontextmanager
async def linked(url: str) -> AsyncIterator[Bench]:
    bench = Bench(url)
    await bench.open()
    try:
        yield bench
    finally:
        await bench.link.close()


def positions(bench: Bench) -> list[Telemetry]:
    return [item for item in bench.inputs if isinstance(item, Telemetry)]


def test_the_largest_datagram_of_starts_costs_a_turn_no_checksum_a_byte() -> None:
    component = Component(ComponentOptions(), lambda frame: len(frame) > 0)
    with counted() as work:
        component.receive(FLOOD, 1.0)
    assert work == {"checksum": 0, "decode": 0}


async def test_a_strangers_flood_is_dropped_and_counted_and_no_position_is_lost() -> None:
    port = free_port()
    async with linked(f"udpin:127.0.0.1:{port}") as bench:
        codec = bench.link.component.codec
        with a_socket(port) as vehicle, a_socket(port) as stranger, counted() as work:
            vehicle.send(heartbeat())
            await bench.until(lambda: codec.counts.frames == 1)
            for number in range(20):
                bench.now_s += 0.05
                stranger.send(FLOOD)
                vehicle.send(position(number))
                await bench.until(lambda number=number: len(positions(bench)) == number + 1)
        assert codec.counts.excess_bytes == 20 * len(FLOOD)
        assert work["checksum"] == 21
        line = bench.link.component.meter.read(codec, bench.now_s).line()
        assert "not read 1310140 B, 0 frames" in line


async def test_a_flood_is_told_in_one_line_and_again_a_minute_later(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.WARNING)
    async with linked(f"udpin:127.0.0.1:{free_port()}") as bench:
        link = bench.link
        link.component.receive(heartbeat(), bench.now_s)
        link.component.is_answered = True
        for turn in range(620):
            if turn % 10 == 0:
                link.component.receive(heartbeat(), bench.now_s)
            for stranger in range(3):
                link._intake.put(FLOOD, bench.now_s, ("192.0.2.1", stranger), is_known=False)
            bench.pass_time(0.1)
        told = [text for text in bench.said(caplog) if "more than is read" in text]
        assert len(told) == 2
        assert [text for text in bench.events if "more than is read" in text] == told
        # It is over, and is no news a second later.
        bench.events.clear()
        bench.pass_time(1.0)
        assert not any("more than is read" in text for text in bench.events)


def test_behind_many_false_starts_whoever_was_heard_before_is_read() -> None:
    framer, other = Framer(), mavlink.MAVLink(None, srcSystem=9, srcComponent=190)
    new = bytes(other.heartbeat_encode(6, 8, 0, 0, 4).pack(other))
    heads = b"\xfe\x18" * 1000
    assert framer.push(position(1), 1.0) == [position(1)]
    with counted() as work:
        assert framer.push(heads + new + position(2), 2.0) == [position(2)]
    assert work["checksum"] <= 80
    assert framer.counts.excess_frames > 900
    assert framer.push(new, 3.0) == [new]
    assert framer.push(heads + new, 4.0) == [new]


async def test_what_waits_behind_the_datagrams_of_others_is_read_in_the_same_turn() -> None:
    port = free_port()
    async with linked(f"udpin:127.0.0.1:{port}") as bench:
        with a_socket(port) as vehicle, a_socket(port) as stranger:
            vehicle.send(heartbeat())
            await bench.until(lambda: bench.link.component.codec.counts.frames == 1)
            for _ in range(100):
                stranger.send(b"\xfe" * 12)
            vehicle.send(position(0))
            # One look of the event loop at the socket.
            await asyncio.sleep(0)
            await asyncio.sleep(0)
            bench.inputs += bench.link.receive()
            assert len(positions(bench)) == 1


async def test_a_peer_may_split_a_frame_over_datagrams_and_a_stranger_may_not() -> None:
    port = free_port()
    async with linked(f"udpin:127.0.0.1:{port}") as bench:
        counts = bench.link.component.codec.counts
        with a_socket(port) as bridge:
            # A stranger yet: halves are nothing, though the second one is seen to come.
            first = heartbeat()
            bridge.send(first[:9])
            bridge.send(first[9:])
            await bench.until(lambda: counts.dropped_bytes == len(first))
            # A whole frame between two halves makes it known: what is cut from then on is one.
            bridge.send(position(0)[10:] + first + position(1)[:7])
            await bench.until(lambda: counts.frames == 1)
            bridge.send(position(1)[7:] + position(2)[:20])
            bridge.send(position(2)[20:])
            await bench.until(lambda: len(positions(bench)) == 1)
            bridge.send(position(3)[:1])
            bridge.send(position(3)[1:])
            await bench.until(lambda: len(positions(bench)) == 2)


async def test_a_chunk_of_tcp_is_read_in_slices_and_the_loop_goes_on_between() -> None:
    async def serve(_reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(heartbeat() + b"\xfe\x18" * 60_000 + position(0))
        with contextlib.suppress(ConnectionError):
            await _reader.read()
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    seen, others = [0], 0
    async with linked(f"tcp:127.0.0.1:{port}") as bench:
        # Each look at the clock finds it a millisecond later.
        clock = itertools.count(100.0, 0.001)
        bench.link._clock = lambda: next(clock)
        counts = bench.link.component.codec.counts
        async with asyncio.timeout(20.0):
            while not positions(bench):
                bench.inputs += bench.link.receive()
                seen.append(counts.bytes_in)
                others += 1
                await asyncio.sleep(0)
        assert max(b - a for a, b in itertools.pairwise(seen)) <= 2 * SLICE_BYTES
        assert counts.excess_bytes == 0
    assert others > 120_000 / (2 * SLICE_BYTES)
    server.close()
    await server.wait_closed()


def position_count(inputs: list[object]) -> int:
    return sum(isinstance(item, Telemetry) for item in inputs)


def test_a_flood_of_sound_frames_of_others_costs_the_vehicle_none_of_its_own() -> None:
    component = Component(ComponentOptions(), lambda frame: len(frame) > 0)
    intake = Intake(component.codec.counts)
    sent = itertools.count()
    found: list[object] = []
    ground = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
    operator = bytes(ground.command_long_encode(1, 191, 216, 0, 0, 0, 0, 0, 0, 0, 0).pack(ground))
    flood = heartbeat(system=9, component=190, kind=6, autopilot=8) * 40

    def turn(data: bytes, now_s: float) -> None:
        intake.put(data, now_s, None, is_known=True)
        while intake.has_more():
            for piece, at_s, source in intake.take():
                found.extend(component.receive(piece, at_s, source))

    turn(heartbeat(), 0.0)
    turn(heartbeat(system=255, component=190, kind=6, autopilot=8), 0.0)
    with counted() as work:
        for number in range(200):
            # As many components as there are, and one that says it all the time.
            flood += heartbeat(system=10 + number, component=190, kind=6, autopilot=8)
            turn(flood + position(next(sent)) + flood, 0.05 * (number + 1))
        turn(operator, 10.1)
    assert position_count(found) == 200
    assert any(isinstance(item, OperatorCommand) for item in found)
    assert component.codec.counts.excess_frames > 10_000
    assert work["decode"] <= 202 + (OTHERS_MAX + 1) * (OTHER_FRAMES[1] + 10.0 * OTHER_FRAMES[0] + 1)


def test_a_strangers_signatures_are_checked_within_its_share(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked = []
    sha256 = hashlib.sha256
    monkeypatch.setattr(
        signing_module.hashlib, "sha256", lambda data: asked.append(data) or sha256(data)
    )
    component = Component(
        ComponentOptions(), lambda frame: len(frame) > 0, signing=Signing(KEY, clock=lambda: 1.7e9)
    )
    other = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    other.signing.secret_key, other.signing.sign_outgoing = os.urandom(32), True
    intake = Intake(component.codec.counts)
    asked.clear()
    for number in range(1000):
        frame = bytes(other.heartbeat_encode(2, 3, 0, 0, 4).pack(other))
        intake.put(frame, 0.01 * number, ("10.0.0.9", 5), is_known=False)
        for piece, at_s, source in intake.take():
            component.receive(piece, at_s, source)
    counts = component.codec.counts
    assert counts.frames == 0
    assert len(asked) == counts.refused_frames
    assert len(asked) <= STRANGER_FRAMES[1] + 10.0 * STRANGER_FRAMES[0] + 1
    assert counts.refused_frames + counts.excess_frames == 1000


_PUTS = st.lists(
    st.tuples(
        st.integers(0, 60),  # who
        st.integers(0, 4200),  # how much
        st.floats(0.0, 0.2),  # how much later
        st.booleans(),  # whether a turn follows
    ),
    max_size=60,
)


@given(puts=_PUTS)
def test_whoever_sends_whatever_a_turn_is_bounded_and_all_bytes_are_accounted_for(
    puts: list[tuple[int, int, float, bool]],
) -> None:
    counts, now_s = Counts(), 0.0
    intake = Intake(counts)
    sent, strange = 0, 0
    read: dict[object, bytes] = {}
    put: dict[object, bytes] = {}
    for who, size, later_s, is_turn in puts:
        now_s += later_s
        data = bytes([who]) * size
        is_known = who < 3
        had = counts.excess_bytes
        intake.put(data, now_s, who, is_known=is_known)
        if is_known:
            put[who] = put.get(who, b"") + data
            assert counts.excess_bytes == had, "what is known is within its share here"
        sent += size
        if is_turn:
            taken = intake.take()
            assert len(intake._sources) <= SOURCES_MAX
            for source in {one.speaker for _, _, one in taken}:
                pieces = [data for data, _, one in taken if one.speaker == source]
                charged = sum(max(len(piece), CHUNK_BYTES_MIN) for piece in pieces[:-1])
                assert charged < SLICE_BYTES
            ranks = [one.is_known for _, _, one in taken]
            assert ranks == sorted(ranks, reverse=True), "strangers come last"
            for data, _, one in taken:
                read[one.speaker] = read.get(one.speaker, b"") + data
                strange += 0 if one.is_known else len(data)
    while intake.has_more():
        for data, _, one in intake.take():
            read[one.speaker] = read.get(one.speaker, b"") + data
            strange += 0 if one.is_known else len(data)
    assert sum(map(len, read.values())) + counts.excess_bytes == sent
    assert strange <= STRANGERS_BYTES[1] + STRANGERS_BYTES[0] * now_s + 1
    assert all(read.get(who, b"") == data for who, data in put.items())


def test_one_stranger_leaves_room_for_the_next() -> None:
    counts = Counts()
    intake = Intake(counts)
    for number in range(1000):
        now_s = 0.001 * number
        intake.put(FLOOD[:1000], now_s, "loud", is_known=False)
        intake.take()
    assert intake.put(heartbeat(), 1.0, "new", is_known=False)
    assert counts.excess_bytes >= 1_000_000 - sum(STRANGER_BYTES)


def test_what_a_line_of_our_own_may_bring_is_ten_fast_serial_lines() -> None:
    assert KNOWN_BYTES[0] >= 10 * 92_160


def test_all_strangers_together_have_a_share_and_the_last_ones_are_remembered() -> None:
    counts = Counts()
    intake = Intake(counts)
    for number in range(500):
        intake.put(FLOOD[:300], 0.002 * number, number, is_known=False)
        assert len(intake._sources) <= SOURCES_MAX
        intake.take()
    assert 500 * 300 - counts.excess_bytes <= sum(STRANGERS_BYTES)


async def test_what_waits_after_a_turn_brings_the_next_one() -> None:
    async with linked(f"udpout:127.0.0.1:{free_port()}") as bench:
        clock = itertools.count(100.0, 0.001)
        bench.link._clock = lambda: next(clock)
        bench.link._on_bytes(bytes(5 * SLICE_BYTES))
        turns = 0
        while bench.link._intake.has_more():
            bench._news.clear()
            bench.link.receive()
            turns += 1
            if bench.link._intake.has_more():
                async with asyncio.timeout(5.0):
                    await bench._news.wait()
        assert turns == 5
