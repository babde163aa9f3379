"""Laws of the packing: whatever lines go in come out, and damage never does more than damage."""

from __future__ import annotations

import json
import struct
import tracemalloc
import zlib
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from analysis.journals.unpacking import part_of, unpack
from companion.journal.rows import ROWS_MAX, TEXT_MAX, WORD, Block, Packer, pack, put_all

NUMBERS = st.one_of(
    st.floats(),
    st.integers(),
    st.integers(-(2**63), 2**63).map(
        lambda bits: struct.unpack("<d", struct.pack("<q", bits % 2**63))[0]
    ),
    st.integers(0, 10**12).map(lambda nanos: nanos / 1e9),
    st.sampled_from([0.0, -0.0, 5e-324, 1.7976931348623157e308, 1e22, 1e16, 0.1 + 0.2, -1e-7]),
)
VALUES = st.recursive(
    NUMBERS | st.text(max_size=12) | st.booleans() | st.none(),
    lambda inner: (
        st.lists(inner, max_size=5) | st.dictionaries(st.text(max_size=4), inner, max_size=2)
    ),
    max_leaves=12,
)


@given(values=st.lists(VALUES, max_size=12))
def test_lines_of_json_come_back_to_the_last_character(values: list[object]) -> None:
    lines = [json.dumps(value, separators=(",", ":")) for value in values]
    assert unpack(pack(lines)) == lines


@given(rows=st.lists(st.tuples(*[NUMBERS] * 4), max_size=30))
def test_columns_of_any_numbers_come_back(rows: list[tuple[object, ...]]) -> None:
    lines = [json.dumps({"State": [*row, {"Plan": [row[0], row[0]]}]}) for row in rows]
    assert unpack(pack(lines)) == lines


@given(
    rows=st.lists(
        st.tuples(st.booleans(), st.integers(-3, 2**40), st.tuples(*[NUMBERS] * 3)), max_size=30
    )
)
def test_lines_that_follow_others_come_back_with_their_numbers(
    rows: list[tuple[bool, int, tuple[object, ...]]],
) -> None:
    follower = Packer()
    leader = Packer(follower=follower)
    told: dict[bool, list[tuple[int, str]]] = {False: [], True: []}
    # What follows repeats the numbers of what it follows.
    values: tuple[object, ...] = (1.5, 2.5, 3.5)
    for leads, number, own in rows:
        values = own if leads else (*values[:2], own[2])
        line = json.dumps({"A": values})
        before = told[leads][-1][0] if told[leads] else 6
        (leader if leads else follower).add(line, number - before)
        told[leads].append((number, line))
    first = part_of(leader.content())
    assert first.rows(7) == told[True]
    assert part_of(follower.content(), first).rows(7) == told[False]


@given(lines=st.lists(st.text(st.characters(min_codepoint=32, max_codepoint=126)), max_size=9))
def test_lines_of_any_text_come_back(lines: list[str]) -> None:
    assert unpack(pack(lines)) == lines


@given(junk=st.binary(max_size=80), at=st.integers(0, 200))
def test_damage_is_read_or_refused(junk: bytes, at: int) -> None:
    packed = bytearray(pack([f'{{"A":[{number / 7!r},{number}]}}' for number in range(30)]))
    packed[at : at + len(junk)] = junk
    with suppress(ValueError):
        unpack(bytes(packed))


@given(content=st.binary(max_size=120))
def test_content_that_is_none_is_read_or_refused(content: bytes) -> None:
    with suppress(ValueError):
        unpack(zlib.compress(content))


# What a stranger's file may say in a few kilobytes; each once took gigabytes or minutes.

ROWS = WORD.pack(3_000_000) + WORD.pack(0) + bytes(9_000_000)
LINES = WORD.pack(1000) + WORD.pack(60_000) + b"x" * 60_000 + b"\x02" * 1000 + bytes(2000)
NUMBERED = WORD.pack(1000) + WORD.pack(9_000) + b"\x01" * 9_000 + b"\x02" * 1000 + bytes(9_002_000)
LONG_INTEGER = WORD.pack(1) + WORD.pack(0) + b"\xff" * 9_000_000 + b"\x01\x00\x00"


@pytest.mark.parametrize("content", [ROWS, LINES, NUMBERED, LONG_INTEGER])
def test_a_few_bytes_take_no_more_than_a_block_may_hold(content: bytes) -> None:
    packed = zlib.compress(content)
    tracemalloc.start()
    try:
        with pytest.raises(ValueError):
            unpack(packed)
        assert tracemalloc.get_traced_memory()[1] < 60e6
    finally:
        tracemalloc.stop()


def test_a_block_is_full_by_its_rows_or_its_text_and_can_then_be_read() -> None:
    for body, rows in (('{"A":[1.5]}', ROWS_MAX), (json.dumps({"A": ["x" * 60_000]}), 67)):
        block, lines = Block(), []
        while not block.is_full:
            block.add(len(lines) + 1, 1.0, body)
            lines.append(body)
        assert len(lines) == rows and len(body) * (rows - 1) < TEXT_MAX
        assert unpack(pack(lines)) == lines


def test_integers_of_any_row_are_read() -> None:
    out = bytearray(WORD.pack(1) + WORD.pack(0))
    put_all(out, [2**63])
    assert part_of(bytes(out) + b"\x00\x00").gaps == [2**62]
