"""Any bytes into the codec: no exception. Any split of a valid stream: the same messages."""

from __future__ import annotations

import itertools

from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.link.codec import Codec
from companion.link.component import Component, ComponentOptions
from companion.link.messages import Message


def _frames() -> list[bytes]:
    sender = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    messages = [
        sender.heartbeat_encode(2, 3, 128, 3, 4),
        sender.global_position_int_encode(1000, 1, 2, 3, 4, 5, 6, 7, 8),
        sender.vfr_hud_encode(0.0, 5.0, 0, 0, 0.0, 0.0),
        sender.command_long_encode(1, 191, 216, 0, 1, 0, 0, 0, 0, 0, 0),
        sender.command_ack_encode(183, 0),
        sender.statustext_encode(6, b"hello"),
        sender.servo_output_raw_encode(0, 0, *range(1000, 1016)),
    ]
    return [bytes(message.pack(sender)) for message in messages]


FRAMES = _frames()
streams = st.lists(st.sampled_from(FRAMES), max_size=12).map(
    lambda list_: FRAMES[0] + b"".join(list_)
)


@st.composite
def mangled(draw: st.DrawFn) -> bytes:
    """Return a stream that begins well and then has bytes cut, changed and thrown in."""
    stream = bytearray(draw(streams))
    for _ in range(draw(st.integers(0, 6))):
        at = draw(st.integers(0, len(stream)))
        match draw(st.sampled_from(["insert", "cut", "change"])):
            case "insert":
                stream[at:at] = draw(st.binary(max_size=20))
            case "cut":
                del stream[at : at + draw(st.integers(1, 10))]
            case _:
                stream[at : at + 1] = draw(st.binary(min_size=1, max_size=1))
    return bytes(stream)


def messages_of(chunks: list[bytes]) -> list[Message]:
    codec = Codec()
    return [message for chunk in chunks for message in codec.decode(chunk, 1.0)]


@given(data=st.lists(st.binary(max_size=300), max_size=10))
def test_any_bytes_are_survived(data: list[bytes]) -> None:
    messages_of(data)


@given(data=mangled())
def test_mangled_streams_are_survived_by_the_whole_component(data: bytes) -> None:
    component = Component(ComponentOptions(), lambda frame: len(frame) > 0)
    component.receive(data, 1.0)
    component.tick(None, 1.0)


@given(stream=streams, cuts=st.lists(st.integers(0, 600), max_size=8))
def test_any_split_of_a_valid_stream_gives_the_same_messages(
    stream: bytes, cuts: list[int]
) -> None:
    ends = [0, *sorted(min(cut, len(stream)) for cut in cuts), len(stream)]
    chunks = [stream[a:b] for a, b in itertools.pairwise(ends)]
    assert messages_of(chunks) == messages_of([stream])
    assert len(messages_of([stream])) >= 1


@given(garbage=st.binary(max_size=64), stream=streams)
def test_what_follows_garbage_is_understood_after_at_most_one_quarter_of_a_second(
    garbage: bytes, stream: bytes
) -> None:
    codec = Codec()
    found = list(codec.decode(garbage + stream, 0.0))
    # Each start in the garbage that has no end is given up after its time.
    for turn in range(1, len(garbage) + 2):
        found += codec.decode(b"", float(turn))
    assert found[-len(messages_of([stream])) :] != []
    assert len(found) >= len(messages_of([stream]))


@given(data=st.binary(min_size=2000, max_size=4000))
def test_the_buffer_stays_bounded(data: bytes) -> None:
    codec = Codec()
    for _ in range(5):
        codec.decode(data, 0.0)
    assert len(codec._source.framer._held) < 300
