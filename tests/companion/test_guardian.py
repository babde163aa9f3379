"""The guardian by itself: what it sends, over which link, and when."""

from __future__ import annotations

import asyncio
import json
import os
import pty
import select
import signal
import socket
import subprocess
import time
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.guardian import AFTER_S
from companion.guardian.__main__ import LINK_NUMBER, PAD, ROUND_S, Closer, Guardian
from companion.output.autopilot_options import DriveOutput, ServoOptions
from companion.output.child import Child
from companion.output.guarded import COMMAND, GuardianSetup

KEY = bytes(range(32))
LEASE_S = 0.3
VALVES = {9: 1000, 10: 1000}


def setup(note: Path = Path(), *, key: bytes = b"", is_udp: bool = True, **options: Any) -> bytes:
    given = GuardianSetup(lease_s=LEASE_S, component=191, is_udp=is_udp, key=key, note=note)
    return given.packet(ServoOptions(**{"channels": tuple(VALVES), **options}))


def told(**changes: Any) -> dict[str, Any]:
    known = {"taken": 0, "is_px4": False, "is_up": True, "system": 1, "stamp": 0, "peers": ()}
    return {**known, **changes}


def frames(data: bytes, key: bytes = b"") -> list[Any]:
    """Return the orders in what was sent, as an autopilot's parser has them."""
    parser = mavlink.MAVLink(None)
    parser.robust_parsing = True
    if key:
        parser.signing.secret_key = key
        parser.signing.timestamp = 0
    found = parser.parse_buffer(data) or []
    return [each for each in found if each.get_type() == "COMMAND_LONG"]


def closer(packet: bytes, **changes: Any) -> Closer:
    found = Closer(json.loads(packet))
    found.hear(told(**changes), [])
    return found


# ------------------------------------------------------------------------------------ the orders


def test_ardupilot_gets_an_order_for_each_output_the_valves_last() -> None:
    pump = DriveOutput(channel=5, stop_us=1100)
    ordered = closer(setup(return_channel=15, drives=(pump,))).orders(is_px4=False)
    assert ordered == [
        (183, [15.0, 2000.0]), (183, [5.0, 1100.0]), (183, [9.0, 1000.0]), (183, [10.0, 1000.0]),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("closed_us", "full_us", "closed"), [(1000, 2000, -1.0), (2000, 1000, 1.0)]
)
def test_px4_gets_one_order_that_closes_all_six(
    closed_us: int, full_us: int, closed: float
) -> None:
    packet = setup(channels=(1, 2), return_channel=3, closed_us=closed_us, full_us=full_us)
    (order,) = closer(packet).orders(is_px4=True)
    assert order == (187, [closed, closed, -closed, closed, closed, closed])


def test_a_frame_is_that_of_the_companion_and_its_number_moves_on() -> None:
    one = closer(setup(), system=7)
    found = frames(b"".join(one.frame(183, [9.0, 1000.0]) for _ in range(300)))
    assert len(found) == 300
    first = found[0]
    assert (first.get_srcSystem(), first.get_srcComponent()) == (7, 191)
    assert (first.target_system, first.target_component, first.confirmation) == (7, 1, 0)
    assert (first.command, first.param1, first.param2, first.param7) == (183, 9.0, 1000.0, 0.0)
    assert [each.get_seq() for each in found] == [number % 256 for number in range(300)]


def test_a_signed_frame_has_a_stream_of_its_own_ahead_of_the_companions_stamp() -> None:
    stamp = 40_000_000_000_000
    one = closer(setup(key=KEY), stamp=stamp)
    sent = [one.frame(183, [9.0, 1000.0]) for _ in range(3)]
    assert len(frames(b"".join(sent), KEY)) == 3
    assert not any(each.get_signed() for each in frames(b"".join(sent), bytes(32)))
    stamps = [int.from_bytes(frame[-12:-6], "little") for frame in sent]
    # What the companion sends while it is told, a tenth of a second at most, is older too.
    assert stamp + 10_000 < stamps[0] < stamps[1] < stamps[2] < stamp + 100_000
    assert {frame[-13] for frame in sent} == {LINK_NUMBER}
    one.hear(told(stamp=stamp + 500_000), [])
    assert int.from_bytes(one.frame(183, [])[-12:-6], "little") > stamp + 500_000


# ----------------------------------------------------------------------------------- the process


class Lone:
    """A guardian without a companion; `link` is what its orders arrive at."""

    def __init__(self, packet: bytes, link: int) -> None:
        self.child = Child(COMMAND)
        self.link = link
        self.child.send(packet)

    def tell(self, file: int | None = None, **changes: Any) -> None:
        packet = json.dumps(told(**changes)).encode()
        socket.send_fds(self.child.socket, [packet], [] if file is None else [file])

    def said(self) -> tuple[int, bool]:
        """Return its newest word: how often it has closed, and whether it does now."""
        assert select.select([self.child.socket], [], [], 5.0)[0], "no sign of life"
        closings, is_closing, _ = [json.loads(each) for each in self.child.packets()][-1]
        return closings, is_closing

    def rests(self) -> None:
        """Take note of its closing until it rests; drop what it has sent."""
        while (word := self.said())[1]:
            self.tell(taken=word[0])
        self.sent(0.0)

    def sent(self, wait_s: float) -> bytes:
        """Return what arrives within a time."""
        data, end_s = b"", time.monotonic() + wait_s
        while select.select([self.link], [], [], max(end_s - time.monotonic(), 0.0))[0]:
            data += os.read(self.link, 65_536)
        return data

    def first(self) -> list[Any]:
        """Return the orders of the next round, as soon as they come."""
        data = b""
        while len(found := frames(data)) < len(VALVES):
            assert select.select([self.link], [], [], 5.0)[0], "no order"
            data += os.read(self.link, 65_536)
        return found


@contextmanager
def over(link: int, file: int, **options: Any) -> Iterator[Lone]:
    """Have a guardian that has been told of a link, and rests."""
    one = Lone(setup(**options), link)
    try:
        one.tell(file)
        one.first()
        one.rests()
        yield one
    finally:
        one.child.kill()
        one.child.disconnect()
        asyncio.run(one.child.ended(60.0))


@contextmanager
def serial(**options: Any) -> Iterator[tuple[Lone, int]]:
    """Have one on a serial line; the other value is the companion's end of the line."""
    autopilot, ours = pty.openpty()
    tty.setraw(ours)
    os.set_blocking(ours, False)
    try:
        with over(autopilot, ours, is_udp=False, **options) as one:
            yield one, ours
    finally:
        os.close(autopilot)
        os.close(ours)


def closed(orders: list[Any]) -> dict[int, int]:
    return {round(each.param1): round(each.param2) for each in orders}


def test_it_closes_from_its_start_until_the_companion_has_taken_note() -> None:
    with serial() as (one, _):
        for _ in range(8):
            one.tell(taken=1)
            time.sleep(LEASE_S / 4.0)
        assert one.said() == (1, False)
        assert frames(one.sent(0.0)) == []


def test_silence_for_a_lease_closes_again_and_again_until_it_is_noted() -> None:
    with serial() as (one, _):
        one.tell(taken=1)
        begun_s = time.monotonic()
        assert closed(one.first()) == VALVES
        assert time.monotonic() - begun_s >= LEASE_S - 0.01
        # A sign of life alone does not end it.
        for _ in range(4):
            one.tell(taken=1)
            time.sleep(ROUND_S)
        assert len(frames(one.sent(0.0))) >= 2 * len(VALVES)
        one.rests()
        one.tell(taken=2)
        assert frames(one.sent(ROUND_S / 2.0)) == []


def test_the_end_of_the_companion_closes_and_ends_it(tmp_path: Path) -> None:
    note = tmp_path / "guardian.json"
    with serial(note=note) as (one, _):
        one.tell(taken=1)
        begun_s = time.monotonic()
        one.child.disconnect()
        assert closed(one.first()) == VALVES
        asyncio.run(one.child.ended(AFTER_S + 3.0))
        assert time.monotonic() - begun_s >= AFTER_S
    assert json.loads(note.read_text())["rounds"] >= AFTER_S / ROUND_S - 1


def test_one_whose_companion_heard_nobody_holds_no_link_and_tells_no_tale(tmp_path: Path) -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    wake, waker = os.pipe()
    with ours, theirs, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        ours.send(setup(note=tmp_path / "none"))
        socket.send_fds(ours, [json.dumps(told(is_px4=None)).encode()], [link.fileno()])
        ours.shutdown(socket.SHUT_WR)
        guardian = Guardian(theirs, wake)
        guardian.serve()
    os.close(wake)
    os.close(waker)
    # A round each 0.2 s: it has not gone on for two seconds.
    assert guardian.rounds <= 2
    assert not (tmp_path / "none").exists()


def test_its_last_word_ends_it_without_an_order(tmp_path: Path) -> None:
    with serial(note=tmp_path / "none") as (one, _):
        one.tell(taken=1)
        one.child.send(b'"end"')
        asyncio.run(one.child.ended(60.0))
        assert frames(one.sent(0.0)) == []
    assert not (tmp_path / "none").exists()


def test_its_last_word_counts_though_the_companion_left_what_it_said() -> None:
    """Linux then tells of the end first (ECONNRESET), and only afterwards hands over the word."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    wake, waker = os.pipe()
    with ours, theirs:
        ours.send(setup())
        guardian = Guardian(theirs, wake)
        theirs.send(b'[1, true, "start"]')
        ours.send(b'"end"')
        ours.close()
        guardian.serve()
    os.close(wake)
    os.close(waker)
    assert guardian.rounds == 0


def test_a_start_that_died_before_its_first_word_leaves_no_traceback() -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with theirs:
        ours.close()
        done = subprocess.run(
            [*COMMAND, str(theirs.fileno())], pass_fds=[theirs.fileno()], capture_output=True,
            timeout=60.0, check=False,
        )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, b"")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGABRT])
def test_sigterm_closes_and_no_note_of_the_companion_ends_that(number: int) -> None:
    """Systemd's watchdog ends all of a service by SIGABRT, a stop by SIGTERM."""
    with serial() as (one, _):
        one.tell(taken=1)
        os.kill(one.child.pid, number)
        assert closed(one.first()) == VALVES
        assert one.said() == (2, True)
        one.tell(taken=2)
        assert closed(one.first()) == VALVES


@pytest.mark.parametrize("length", [1, 9, 10, 40, 279])
def test_a_serial_line_that_stopped_in_mid_frame_is_closed_all_the_same(length: int) -> None:
    half = (bytes((0xFD, 255, 1, 0, 0, 1, 191, 76, 0, 0)) + bytes(255 + 2 + 13))[:length]
    with serial() as (one, ours):
        os.write(ours, half)
        data = one.sent(0.05)
        assert data == half
        while len(frames(data)) < len(VALVES) and len(data) < 2 * len(PAD):
            data += one.sent(LEASE_S)
        assert closed(frames(data)[: len(VALVES)]) == VALVES
        assert data[length:].startswith(PAD)


def test_datagrams_go_to_every_peer_and_to_the_one_other_end() -> None:
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ours,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as first,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as second,
    ):
        for each in (ours, first, second):
            each.bind(("127.0.0.1", 0))
            each.setblocking(False)
        peers = [first.getsockname(), second.getsockname()]
        one = Lone(setup(), second.fileno())
        try:
            one.tell(ours.fileno(), peers=peers)
            assert closed(one.first()) == VALVES
            assert first.recv(1000)[0] == 0xFD
            ours.connect(first.getsockname())
            one.link = first.fileno()
            one.sent(0.0)
            one.tell(ours.fileno())
            assert closed(one.first()) == VALVES
        finally:
            one.child.kill()
            one.child.disconnect()
            asyncio.run(one.child.ended(60.0))


def test_a_link_that_is_down_is_let_go() -> None:
    ours, theirs = socket.socketpair()
    with ours, theirs:
        ours.setblocking(False)
        with over(theirs.fileno(), ours.fileno(), is_udp=False) as one:
            one.tell(taken=1, is_up=False)
            ours.close()
            # The end of the connection, which nobody holds any more.
            assert select.select([theirs], [], [], 5.0)[0]
            assert theirs.recv(1) == b""
