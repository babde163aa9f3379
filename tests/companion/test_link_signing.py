"""Signed links: what the key says is believed once, and nothing else is."""

from __future__ import annotations

import asyncio
import hashlib
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.errors import LinkError
from companion.link.codec import Codec
from companion.link.component import ComponentOptions
from companion.link.encode import Encoder
from companion.link.parameters import read_state
from companion.link.signing import STATE_NAME, Signing, read_key
from companion.link.vehicle_link import VehicleLink
from tests.companion.wire_peer import free_port

KEY = bytes(range(100, 132))
PHRASE_32 = b"a passphrase of 32 characters..."
NOW_S = 1_700_000_000.0
STAMP = round((NOW_S - 1_420_070_400) * 100_000)


class Station:
    """Signs by pymavlink itself: an independent view of the same format."""

    def __init__(self, key: bytes = KEY, *, system: int = 1, stamp: int = STAMP) -> None:
        self.mav = mavlink.MAVLink(None, srcSystem=system, srcComponent=1)
        self.mav.signing.secret_key = key
        self.mav.signing.sign_outgoing = True
        self.mav.signing.timestamp = stamp

    def heartbeat(self) -> bytes:
        return bytes(self.mav.heartbeat_encode(2, 3, 0, 0, 4).pack(self.mav))


def signing(folder: Path | None = None, *, at_s: float = NOW_S) -> Signing:
    return Signing(KEY, state_folder=folder, clock=lambda: at_s)


def count(guard: Signing, *frames: bytes) -> int:
    """Return how many frames are believed."""
    codec = Codec(accept=guard.accepts)
    codec.decode(b"".join(frames), 1.0)
    return codec.counts.frames


def test_frames_of_a_station_with_the_key_are_believed() -> None:
    station = Station()
    assert count(signing(), *(station.heartbeat() for _ in range(5))) == 5


def test_a_station_with_the_key_believes_ours() -> None:
    encoder = Encoder(system_id=1, component_id=191, signing=signing())
    receiver = mavlink.MAVLink(None)
    receiver.signing.secret_key = KEY
    receiver.signing.timestamp = STAMP
    for _ in range(20):
        (heard,) = receiver.parse_buffer(encoder.heartbeat(4))
        assert heard.get_signed()
    assert receiver.signing.goodsig_count == 20


def test_another_key_no_signature_and_a_repetition_are_not_believed() -> None:
    guard = signing()
    frame = Station().heartbeat()
    plain = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    unsigned = bytes(plain.heartbeat_encode(2, 3, 0, 0, 4).pack(plain))
    old = bytes(plain.heartbeat_encode(2, 3, 0, 0, 4).pack(plain, force_mavlink1=True))
    assert count(guard, Station(bytes(32)).heartbeat(), unsigned, old, frame, frame) == 1
    assert (guard.bad_count, guard.unsigned_count, guard.old_count) == (1, 2, 1)
    assert guard.refused_count == 4


def test_the_radio_s_report_needs_no_signature_and_nothing_else_of_it_is_believed() -> None:
    radio = mavlink.MAVLink(None, srcSystem=51, srcComponent=68)
    report = bytes(radio.radio_status_encode(0, 0, 0, 0, 0, 0, 0).pack(radio))
    heartbeat = bytes(radio.heartbeat_encode(6, 8, 0, 0, 4).pack(radio))
    assert count(signing(), report, heartbeat) == 1


@pytest.mark.parametrize(("behind_s", "believed"), [(50.0, 1), (70.0, 0), (-1e6, 1)])
def test_a_new_stream_may_be_a_minute_behind(behind_s: float, believed: int) -> None:
    station = Station(stamp=STAMP - round(behind_s * 100_000))
    assert count(signing(), station.heartbeat()) == believed


def test_we_follow_a_clock_that_is_ahead() -> None:
    guard = signing()
    ahead = STAMP + 3600 * 100_000
    count(guard, Station(stamp=ahead).heartbeat())
    assert guard.next_stamp() > ahead


def test_our_stamps_grow_even_if_the_clock_goes_back() -> None:
    times_s = iter([NOW_S, NOW_S, NOW_S - 1e6, NOW_S + 1.0, 0.0, -1e9])
    guard = Signing(KEY, clock=lambda: next(times_s))
    stamps = [guard.next_stamp() for _ in range(5)]
    assert all(a < b for a, b in pairwise(stamps))


@pytest.mark.parametrize("is_clean", [True, False])
def test_a_restart_with_a_clock_that_forgot_goes_on_ahead(tmp_path: Path, is_clean: bool) -> None:
    before = signing(tmp_path)
    given_ = before.next_stamp()
    for _ in range(1000):
        given_ = before.next_stamp()
        before.keep()
        before.wait_until_kept()
    if is_clean:
        before.keep(is_last=True)
    after = signing(tmp_path, at_s=0.0)
    assert given_ < after.next_stamp() < given_ + 20 * 100_000


def test_the_stamp_is_written_every_few_seconds_only(tmp_path: Path) -> None:
    now_s = [NOW_S]
    guard = Signing(KEY, state_folder=tmp_path, clock=lambda: now_s[0])
    written = set()
    for _ in range(1000):
        now_s[0] += 0.05
        guard.next_stamp()
        guard.keep()
        guard.wait_until_kept()
        written.add(read_state(tmp_path / STATE_NAME)["stamp"])
    assert 9 <= len(written) <= 12
    assert max(written) > guard.next_stamp()


def test_no_more_streams_than_a_link_can_have_are_remembered() -> None:
    guard = signing()
    frames = [Station(system=system).heartbeat() for system in range(1, 101)]
    assert count(guard, *frames) == 64
    assert count(guard, *frames) == 0  # and a replay of all of them is refused


def test_the_file_stays_small_and_what_it_drops_is_old_for_good(tmp_path: Path) -> None:
    frames: list[bytes] = []
    for start in range(10):
        guard, vehicle = signing(tmp_path), Station(system=1, stamp=STAMP + 1000 * start)
        guard.asked(7)  # answered by a stream of now: the file is to be relied on
        assert count(guard, bytes(vehicle.mav.timesync_encode(1, 7).pack(vehicle.mav))) == 1
        new = [
            Station(system=2 + 20 * start + number, stamp=STAMP + 1000 * start + 10 + number)
            for number in range(20)
        ]
        frames += [station.heartbeat() for station in new]
        assert count(guard, *frames) == 20  # and none of before
        guard.keep(is_last=True)
    assert len(read_state(tmp_path / STATE_NAME)) < 100
    assert count(signing(tmp_path), *frames) == 0


def test_two_programs_with_one_file_forget_no_stream_of_each_other(tmp_path: Path) -> None:
    run, doctor = signing(tmp_path), signing(tmp_path)
    frame = Station(system=255).heartbeat()
    assert count(run, frame) == 1
    run.keep(is_last=True)
    doctor.keep(is_last=True)
    assert count(signing(tmp_path), frame) == 0


@given(at=st.integers(0, 33), bit=st.integers(0, 7))
def test_no_changed_bit_is_believed(at: int, bit: int) -> None:
    frame = bytearray(Station().heartbeat())
    frame[at] ^= 1 << bit
    codec = Codec(accept=signing().accepts)
    codec.decode(bytes(frame), 1.0)
    assert codec.vehicle is None


# -------------------------------------------------------------------------------------- key file


def key_file(folder: Path, content: bytes, mode: int = 0o600) -> Path:
    path = folder / "signing.key"
    path.write_bytes(content)
    path.chmod(mode)
    return path


@pytest.mark.parametrize(
    ("content", "key"),
    [
        (KEY, KEY),
        (bytes(32), bytes(32)),
        (KEY.hex().encode(), KEY),
        (KEY.hex().upper().encode() + b"\n", KEY),
        (b"correct horse\n", hashlib.sha256(b"correct horse").digest()),
        (PHRASE_32, hashlib.sha256(PHRASE_32).digest()),
    ],
)
def test_a_key_is_bytes_digits_or_a_passphrase(tmp_path: Path, content: bytes, key: bytes) -> None:
    assert read_key(key_file(tmp_path, content)) == key


@pytest.mark.parametrize("mode", [0o644, 0o640, 0o604, 0o620, 0o602, 0o660])
def test_a_key_that_others_can_touch_is_refused(tmp_path: Path, mode: int) -> None:
    with pytest.raises(LinkError, match=r"^[^\n]*others may read it[^\n]*chmod 600[^\n]*$"):
        read_key(key_file(tmp_path, KEY, mode))


@pytest.mark.parametrize(
    "content",
    [b"", b"\n", b"short", KEY[:31], KEY + b"\n\xff", b"x" * 1025, b"\xff" * 33, b"\xc3\xa4" * 10],
)
def test_what_is_no_key_is_refused_and_not_shown(tmp_path: Path, content: bytes) -> None:
    with pytest.raises(LinkError, match=r"^[^\n]*are not a key; write[^\n]*$") as refused:
        read_key(key_file(tmp_path, content))
    assert "short" not in str(refused.value)


def test_a_key_that_is_not_there_is_said_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(LinkError, match="no such file"):
        read_key(tmp_path / "nothing")
    with pytest.raises(LinkError, match="is a directory"):
        read_key(tmp_path)


class _Socket(asyncio.DatagramProtocol):
    """One address that speaks to a port of this computer, and counts what it is told."""

    def __init__(self) -> None:
        self.heard = 0
        self.news = asyncio.Event()

    def datagram_received(self, _data: bytes, _addr: object) -> None:
        self.heard += 1
        self.news.set()


async def _speaks(port: int) -> tuple[asyncio.DatagramTransport, _Socket]:
    return await asyncio.get_running_loop().create_datagram_endpoint(
        _Socket, remote_addr=("127.0.0.1", port)
    )


@pytest.mark.parametrize("is_signed", [True, False])
async def test_strangers_do_not_displace_the_vehicle_on_udpin(is_signed: bool) -> None:
    port, arrived = free_port(), asyncio.Event()
    link = VehicleLink(
        f"udpin:127.0.0.1:{port}",
        ComponentOptions(),
        signing=signing() if is_signed else None,
        clock=lambda: 10.0,
    )
    await link.open(arrived.set)
    vehicle, inbox = await _speaks(port)
    station, stranger = Station(), mavlink.MAVLink(None, srcSystem=66, srcComponent=190)
    said = station.heartbeat()
    unsigned = bytes(stranger.heartbeat_encode(6, 8, 0, 0, 4).pack(stranger))
    # A radio's report is believed unsigned, and could claim to be of the vehicle's system.
    radio = mavlink.MAVLink(None, srcSystem=1, srcComponent=68)
    report = bytes(radio.radio_status_encode(200, 200, 90, 40, 40, 0, 0).pack(radio))

    async def says(socket: asyncio.DatagramTransport, frame: bytes) -> None:
        arrived.clear()
        socket.sendto(frame)
        async with asyncio.timeout(5.0):
            await arrived.wait()
        link.receive()

    await says(vehicle, said)
    others = [await _speaks(port) for _ in range(6)]
    for number, (socket, _) in enumerate(others):
        # Noise, a frame without a signature (or of another system), the vehicle's own once more.
        await says(socket, [b"noise", unsigned, said if is_signed else unsigned][number % 3])
        await says(socket, report)
    before = inbox.heard
    assert link.component.outputs.order(9, 1000)
    async with asyncio.timeout(5.0):
        while inbox.heard == before:
            inbox.news.clear()
            await inbox.news.wait()
    if is_signed:
        assert not any(other.heard for _, other in others)
    for socket, _ in [(vehicle, inbox), *others]:
        socket.close()
    await link.close()
