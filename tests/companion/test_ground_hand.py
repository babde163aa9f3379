"""The hand on ground work: keys of a terminal, lines of a script, signals."""

from __future__ import annotations

import asyncio
import os
import signal
import termios
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, suppress

import pytest

from companion.cli.ground import Hand, read_line


async def until(done: Callable[[], bool]) -> None:
    """Let the event loop turn until something that was written has been heard."""
    for _ in range(100_000):
        if done():
            return
        await asyncio.sleep(0)
    raise AssertionError("it was not heard")


class Clock:
    """A time that only the test moves."""

    def __init__(self) -> None:
        self.now_s = 50.0

    def __call__(self) -> float:
        return self.now_s


@asynccontextmanager
async def terminal() -> AsyncIterator[tuple[Hand, int, int, Clock]]:
    far, near = os.openpty()
    clock = Clock()
    hand = Hand(near, is_lines=False, clock=clock)
    try:
        yield hand, far, near, clock
    finally:
        for descriptor in (far, near):
            with suppress(OSError):
                os.close(descriptor)


async def strokes(hand: Hand, far: int, clock: Clock, *times_s: float) -> None:
    for at_s in times_s:
        clock.now_s = at_s
        os.write(far, b" ")
        await until(lambda at_s=at_s: hand.hold.last_s == at_s)  # type: ignore[misc]


async def test_a_repeating_space_bar_is_held_and_one_stroke_is_not() -> None:
    async with terminal() as (hand, far, _, clock):
        with hand.attending():
            hand.begin()
            await strokes(hand, far, clock, 50.0)
            assert not hand.hold.is_held(50.0)
            await strokes(hand, far, clock, 50.1, 50.2)
            assert not hand.hold.is_held(50.2)
            await strokes(hand, far, clock, 50.3)
            assert hand.hold.is_held(50.7)
            assert not hand.hold.is_held(50.8)


async def test_what_a_stalled_connection_hands_over_at_once_holds_nothing() -> None:
    async with terminal() as (hand, far, _, clock):
        with hand.attending():
            hand.begin()
            for number in range(8):
                clock.now_s = 50.0 + 0.003 * number
                os.write(far, b" " * 30)
                for _ in range(200):
                    await asyncio.sleep(0)
                assert not hand.hold.is_held(clock.now_s)
    assert hand.hold.strokes <= 3
    assert hand.hold.last_s >= 50.0


@pytest.mark.parametrize("key", [b"x", b"\n", b"\x13", b" x", b"\x04", b"\x1b[A"])
async def test_any_other_key_ends_it_ctrl_s_and_ctrl_d_too(key: bytes) -> None:
    async with terminal() as (hand, far, _, _):
        with hand.attending():
            hand.begin()
            os.write(far, key)
            await until(lambda: hand.stopped is not None)
    assert hand.stopped == "another-key"


async def test_keys_of_before_the_start_do_not_count() -> None:
    async with terminal() as (hand, far, near, clock):
        with hand.attending():
            os.write(far, b"      ")
            echoed = b""
            while len(echoed) < 6:  # by then the terminal has them
                echoed += os.read(far, 16)
            hand.begin()
            for _ in range(10):
                await asyncio.sleep(0)
            await strokes(hand, far, clock, 50.1)
            assert hand.hold.first_s == 50.1
            assert os.get_blocking(near)


async def test_the_terminal_is_given_back_as_it_was() -> None:
    async with terminal() as (hand, _, near, _):
        before = termios.tcgetattr(near)
        with hand.attending():
            hand.begin()
            taken = termios.tcgetattr(near)
            assert not taken[3] & (termios.ICANON | termios.ECHO)
            assert not taken[0] & termios.IXON
            assert taken[3] & termios.ISIG
        assert termios.tcgetattr(near) == before


async def test_a_terminal_that_goes_away_ends_it() -> None:
    async with terminal() as (hand, far, _, _):
        with hand.attending():
            hand.begin()
            os.close(far)
            await until(lambda: hand.stopped is not None)
    assert hand.stopped == "stdin-ended"


@pytest.mark.parametrize(
    ("number", "reason"),
    [
        (signal.SIGINT, "interrupted"),
        (signal.SIGQUIT, "interrupted"),
        (signal.SIGTERM, "terminated"),
        (signal.SIGHUP, "terminal-gone"),
        (signal.SIGTSTP, "another-key"),
    ],
)
async def test_signals_end_it_and_none_stops_or_kills_the_process(
    number: signal.Signals, reason: str
) -> None:
    async with terminal() as (hand, _, _, _):
        with hand.attending():
            os.kill(os.getpid(), number)
            await until(lambda: hand.stopped is not None)
            os.kill(os.getpid(), signal.SIGTERM)
            await asyncio.sleep(0)
    assert hand.stopped == reason


# ---------------------------------------------------------------------------------------- lines


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    near, far = os.pipe()
    yield near, far
    for descriptor in (near, far):
        with suppress(OSError):
            os.close(descriptor)


async def test_lines_hold_and_their_end_ends(pipe: tuple[int, int]) -> None:
    near, far = pipe
    clock = Clock()
    hand = Hand(near, is_lines=True, clock=clock)
    os.write(far, b"spray\nhold\nhold\n")
    assert read_line(near) == "spray"
    with hand.attending():
        hand.begin()
        await until(lambda: hand.hold.last_s == 50.0)
        assert not hand.hold.is_held(50.0), "what came at once is one stroke"
        for at_s in (50.2, 50.4, 50.6):
            clock.now_s = at_s
            os.write(far, b"hold\n")
            await until(lambda at_s=at_s: hand.hold.last_s == at_s)  # type: ignore[misc]
        assert hand.hold.is_held(50.7)
        os.close(far)
        await until(lambda: hand.stopped == "stdin-ended")


async def test_a_line_that_says_stop_ends_it(pipe: tuple[int, int]) -> None:
    hand = Hand(pipe[0], is_lines=True)
    with hand.attending():
        hand.begin()
        os.write(pipe[1], b"stop\n")
        await until(lambda: hand.stopped == "another-key")
    assert not hand.hold.is_held(hand.hold.last_s)


async def test_a_stop_in_two_pieces_stops_and_a_piece_holds_nothing(pipe: tuple[int, int]) -> None:
    clock = Clock()
    hand = Hand(pipe[0], is_lines=True, clock=clock)
    with hand.attending():
        hand.begin()
        os.write(pipe[1], b"ho")
        for _ in range(200):
            await asyncio.sleep(0)
        assert hand.hold.strokes == 0, "half a line is none"
        clock.now_s = 50.2
        os.write(pipe[1], b"ld\nst")
        await until(lambda: hand.hold.last_s == 50.2)
        assert hand.stopped is None
        os.write(pipe[1], b"op")
        await until(lambda: hand.stopped == "another-key")


async def test_a_line_without_an_end_stops(pipe: tuple[int, int]) -> None:
    hand = Hand(pipe[0], is_lines=True)
    with hand.attending():
        hand.begin()
        os.write(pipe[1], b"x" * 5000)
        await until(lambda: hand.stopped == "another-key")


def test_everybody_is_told_what_holds(pipe: tuple[int, int]) -> None:
    assert "space bar" in Hand(pipe[0], is_lines=False).invitation
    lines = Hand(pipe[0], is_lines=True).invitation
    assert "Lines hold" in lines
    assert "space" not in lines


def test_a_word_without_an_end_is_the_word(pipe: tuple[int, int]) -> None:
    os.write(pipe[1], b" click ")
    os.close(pipe[1])
    assert read_line(pipe[0]) == "click"
    assert read_line(pipe[0]) is None


def test_ctrl_c_just_before_the_waiting_ends_it(pipe: tuple[int, int]) -> None:
    """The signal is taken in by another thread, so that it interrupts no system call of ours.

    That is what becomes of a signal between the question and the call that waits for the answer.
    """
    is_over, keys = threading.Event(), []

    def interrupt() -> None:
        time.sleep(0.1)
        signal.pthread_kill(threading.get_ident(), signal.SIGINT)
        if not is_over.wait(10.0):
            keys.append(os.write(pipe[1], b"\n"))

    other = threading.Thread(target=interrupt)
    other.start()
    try:
        with pytest.raises(KeyboardInterrupt):
            read_line(pipe[0])
    finally:
        is_over.set()
        other.join()
    assert not keys, "it waited for a key"


async def test_signals_are_given_back_after_an_error_too(pipe: tuple[int, int]) -> None:
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(ValueError, match="broken"), Hand(pipe[0], is_lines=True).attending():
        assert signal.getsignal(signal.SIGTERM) != before
        raise ValueError("broken")
    assert signal.getsignal(signal.SIGTERM) == before
