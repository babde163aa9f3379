"""SIGKILL while it sprays: each layer beside the companion closes by itself."""

from __future__ import annotations

import pytest

from tests.bench.dead_man import frames_of, kill_once

pytestmark = pytest.mark.sitl


async def test_a_killed_companion_is_closed_by_the_script_and_by_the_board() -> None:
    closing = await kill_once(seed=3)
    # 0.3 s, one run of the script, and a millisecond: on the clock of the script.
    assert closing.script_after_life_s <= 0.322
    # To the board 0.3 s, one servo frame, and the order that was under way: the required time from
    # the kill.
    assert 0.0 < closing.board_s <= 0.45
    assert closing.script_s <= 0.45


def test_a_datagram_is_taken_apart_into_its_frames() -> None:
    plain = bytes([0xFD, 3, 0, 0, 1, 1, 191, 0, 0, 0]) + b"abc" + b"cc"
    signed = bytes([0xFD, 1, 1, 0, 1, 1, 191, 0, 0, 0]) + b"a" + b"cc" + bytes(13)
    assert list(frames_of(plain + signed + plain)) == [plain, signed, plain]
    assert list(frames_of(b"noise")) == []
