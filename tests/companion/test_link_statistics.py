"""Counts of a link: what came, what is missing, what was broken, what went out."""

from __future__ import annotations

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.link.codec import Codec
from companion.link.component import Component, ComponentOptions
from companion.link.vehicle_link import VehicleLink
from tests.companion.component_peer import CLOSED, Peer, UpAndDown


def frames(numbers: list[int], system: int = 1) -> bytes:
    mav = mavlink.MAVLink(None, srcSystem=system, srcComponent=1)
    made = b""
    for number in numbers:
        mav.seq = number
        made += mav.heartbeat_encode(2, 3, 0, 0, 4).pack(mav)
    return bytes(made)


@pytest.mark.parametrize(
    ("numbers", "lost"),
    [
        ([0, 1, 2], 0),
        ([254, 255, 0, 1], 0),
        ([10, 12, 15], 3),
        ([250, 3], 8),
        ([5, 5], 0),  # twice
        ([5, 7, 6, 8], 1),  # overtaken: the gap stays counted, and the late one opens no other
    ],
)
def test_gaps_in_the_numbers_are_lost_frames(numbers: list[int], lost: int) -> None:
    codec = Codec()
    codec.decode(frames(numbers), 1.0)
    assert codec.lost_frames == {(1, 1): (len(numbers), lost)}


def test_senders_are_counted_apart_and_not_without_end() -> None:
    codec = Codec()
    for number in range(4):
        for system in range(1, 101):
            codec.decode(frames([number], system), 1.0)
    assert len(codec.lost_frames) == 64
    assert set(codec.lost_frames.values()) == {(4, 0)}


def test_broken_frames_are_counted_apart_from_noise() -> None:
    codec = Codec()
    broken = bytearray(frames([0]))
    broken[12] ^= 1
    codec.decode(b"noise" + bytes(broken) + frames([1]), 1.0)
    assert codec.counts.frames == 1
    assert codec.counts.bad_frames >= 1
    assert codec.counts.bytes_in == 5 + 2 * len(broken)


def test_what_goes_out_and_what_cannot_are_counted() -> None:
    peer = Peer()
    component = Component(ComponentOptions(), peer.take)
    component.receive(peer.heartbeat(), 0.0)
    sent = component.meter.frames_out
    assert sent == len(peer.sent)
    peer.is_up = False
    assert not component.order(9, 1000)
    assert component.meter.unsent_frames == 1
    assert component.meter.frames_out == sent


async def test_a_line_a_minute_and_one_at_the_end_go_into_the_record() -> None:
    peer = Peer()
    now_s = [0.0]
    link = VehicleLink("udpin:127.0.0.1:14550", ComponentOptions(), clock=lambda: now_s[0])
    link._transport = UpAndDown(peer)
    told: list[tuple[float, str]] = []
    link.on_event(lambda at_s, kind, text: told.append((at_s, text)) if "frames" in text else None)
    for turn in range(1300):
        now_s[0] = turn * 0.1
        if turn % 10 == 0:
            link._on_bytes(peer.position(now_s[0]) if turn else peer.heartbeat())
        link.receive()
        link.tell(CLOSED, now_s[0])
    assert [at_s for at_s, _ in told] == pytest.approx([60.0, 120.0])
    assert link.statistics is not None
    assert link.statistics.frames_per_s == pytest.approx(1.0, abs=0.02)
    assert link.statistics.position_hz == pytest.approx(1.0, abs=0.35)
    assert link.statistics.lost_percent is not None
    await link.close()
    await link.close()
    assert len(told) == 3
    assert told[-1][1].startswith("in 130 frames (")
