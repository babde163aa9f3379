"""Any bytes in any pieces: the frames of a slow framer that is easily read, and bounded work."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

import companion.link.framer as framer_module
from companion.link.framer import STALE_S, Framer, Head, decoded
from tests.companion.test_codec_laws import FRAMES, mangled, streams

_SENDER = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
_FIRST = [
    bytes(_SENDER.heartbeat_encode(2, 3, 128, 3, 4).pack(_SENDER, force_mavlink1=True)),
    bytes(_SENDER.gps_raw_int_encode(0, 6, 0, 0, 0, 80, 100, 500, 0, 20).pack(_SENDER, True)),
]


class SlowFramer:
    """One start after the other, each asked of pymavlink: what has to come out."""

    def __init__(self) -> None:
        self._mav = mavlink.MAVLink(None)
        self._held, self._oldest_s, self._joint = b"", 0.0, 0
        self.bad_count = 0

    def push(self, data: bytes, received_s: float) -> list[bytes]:
        if self._held and not received_s - self._oldest_s <= STALE_S:
            self._held = self._held[1:]
        self._joint = len(self._held)
        self._held += data
        frames = []
        while self._held:
            size = self._size(self._held)
            if size is not None and len(self._held) >= size and self._is_sound(self._held[:size]):
                frames.append(self._held[:size])
                self._cut(size)
            elif size is not None and size > len(self._held) and not self._is_overtaken():
                break
            else:
                self.bad_count += size is not None and size <= len(self._held)
                self._cut(1)
        if frames or not len(self._held) > len(data):
            self._oldest_s = received_s
        return frames

    def _cut(self, count: int) -> None:
        self._held = self._held[count:]
        self._joint -= count

    def _size(self, head: bytes) -> int | None:
        if head[0] not in (0xFE, 0xFD):
            return None
        is_2 = head[0] == 0xFD
        header = 10 if is_2 else 6
        if len(head) < header:
            return header + 2
        number = int.from_bytes(head[7:10], "little") if is_2 else head[5]
        if number not in mavlink.mavlink_map or (is_2 and head[2] > 1):
            return None
        if not is_2 and head[1] == 254:
            return None
        return header + head[1] + 2 + (13 if is_2 and head[2] else 0)

    def _is_sound(self, frame: bytes) -> bool:
        try:
            self._mav.decode(bytearray(frame))
        except mavlink.MAVError:
            return False
        return True

    def _is_overtaken(self) -> bool:
        for at in range(1, len(self._held)):
            size = self._size(self._held[at:])
            end = len(self._held) + 1 if size is None else at + size
            is_at_edge = at == self._joint or end == len(self._held)
            if is_at_edge and end <= len(self._held) and self._is_sound(self._held[at:end]):
                return True
        return False


_HEADS = st.sampled_from(
    [b"\xfe", b"\xfd", b"\xfe\x09", b"\xfd\x09\x00\x00", b"\xfe\x18", FRAMES[0][:9], _FIRST[1][:30]]
)
_PIECES = st.lists(
    st.one_of(
        st.sampled_from([*FRAMES, *_FIRST]),
        _HEADS,
        st.binary(max_size=12),
        mangled(),
        st.sampled_from([0xFE, 0xFD, 24]).flatmap(
            lambda byte: st.integers(1, 40).map(lambda count: bytes([byte]) * count)
        ),
    ),
    max_size=10,
).map(b"".join)


def cut(stream: bytes, cuts: list[int]) -> list[bytes]:
    ends = [0, *sorted(min(at, len(stream)) for at in cuts), len(stream)]
    return [stream[a:b] for a, b in itertools.pairwise(ends)]


@given(
    stream=_PIECES,
    cuts=st.lists(st.integers(0, 900), max_size=8),
    waits=st.lists(st.sampled_from([0.0, 0.01, 0.3]), min_size=9, max_size=9),
)
def test_whatever_comes_however_cut_the_frames_are_those_of_the_slow_framer(
    stream: bytes, cuts: list[int], waits: list[float]
) -> None:
    slow, quick, now_s = SlowFramer(), Framer(), 0.0
    for piece, wait_s in zip(cut(stream, cuts), waits, strict=False):
        now_s += wait_s
        assert quick.push(piece, now_s) == slow.push(piece, now_s)
        assert quick._held == slow._held
    assert quick.counts.bad_frames == slow.bad_count


@contextmanager
def counted() -> Iterator[dict[str, int]]:
    """Count checksums and decoded frames."""
    found = {"checksum": 0, "decode": 0}

    def counting(name: str, work: Any) -> Any:
        def wrapped(*args: Any) -> Any:
            found[name] += 1
            return work(*args)

        return wrapped

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(framer_module, "mcrf4xx", counting("checksum", framer_module.mcrf4xx))
        patch.setattr(mavlink.MAVLink, "decode", counting("decode", mavlink.MAVLink.decode))
        yield found


@pytest.mark.parametrize("byte", [0xFE, 0xFD, 0x00, 0x18])
def test_no_byte_that_is_repeated_costs_a_checksum_each(byte: int) -> None:
    with counted() as work:
        Framer().push(bytes([byte]) * 65_507, 0.0)
    assert work == {"checksum": 0, "decode": 0}


@given(stream=_PIECES, size=st.integers(1, 64))
def test_no_start_is_checked_more_than_twice_and_nothing_is_decoded(
    stream: bytes, size: int
) -> None:
    framer = Framer()
    for at in range(0, len(stream), size):
        held = framer._held
        with counted() as work:
            framer.push(stream[at : at + size], 0.0)
        seen = held + stream[at : at + size]
        starts = seen.count(0xFE) + seen.count(0xFD)
        assert work["checksum"] <= 2 * starts
        assert work["decode"] == 0


@given(stream=streams)
def test_a_frame_of_a_healthy_stream_costs_one_checksum(stream: bytes) -> None:
    with counted() as work:
        frames = Framer().push(stream, 0.0)
    assert work == {"checksum": len(frames), "decode": 0}
    assert b"".join(frames) == stream


@given(frame=st.sampled_from([*FRAMES, *_FIRST]))
def test_a_head_says_what_pymavlink_reads_there(frame: bytes) -> None:
    message = decoded(frame)
    assert message is not None
    head = Head.of(frame)
    assert head.sender == (message.get_srcSystem(), message.get_srcComponent())
    assert head.message_id == message.get_msgId()
    assert head.sequence == message.get_seq()
