"""SIGKILL while it sprays: each layer beside the companion closes by itself."""

from __future__ import annotations

import pytest

from tests.bench.dead_man import frames_of, kill_once
from tests.quickest import quickest

pytestmark = pytest.mark.sitl


async def test_a_killed_companion_is_closed_by_the_script_and_by_the_board() -> None:
    async def slowest_s() -> float:
        closing = await kill_once(seed=3)
        # 0.3 s, one run of the script, and a millisecond: on the clock of the script.
        assert closing.script_after_life_s <= 0.322
        assert closing.board_s > 0.0
        # To the board 0.3 s, one servo frame, and the order that was under way.
        return max(closing.script_s, closing.board_s)

    # The required time from the kill. Where this computer stood still just then, what had been
    # sent before was read late.
    assert await quickest(slowest_s, within_s=0.45, tries=3) <= 0.45


def test_a_datagram_is_taken_apart_into_its_frames() -> None:
    plain = bytes([0xFD, 3, 0, 0, 1, 1, 191, 0, 0, 0]) + b"abc" + b"cc"
    signed = bytes([0xFD, 1, 1, 0, 1, 1, 191, 0, 0, 0]) + b"a" + b"cc" + bytes(13)
    assert list(frames_of(plain + signed + plain)) == [plain, signed, plain]
    assert list(frames_of(b"noise")) == []
