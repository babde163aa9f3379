from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from sitl.outputs import DriverBoard
from sitl.plant import BoardEdge as Edge
from sitl.profile import Pulsing

PWM = Pulsing(frequency_hz=11.0, duty_min=0.2, duty_max=0.9, min_on_s=0.01, min_off_s=0.01)
T = PWM.period_s


def board(
    kind: Literal["restarting", "free-running"] = "restarting",
    *,
    seed: int = 1,
    frame_s: float = 0.02,
) -> DriverBoard:
    return DriverBoard(PWM, 6, seed=seed, start_s=0.0, kind=kind, frame_s=frame_s)


def first_with(edges: list[Edge], duty: float) -> float:
    return next(edge.at_s for edge in edges if edge.duty == pytest.approx(duty))


def test_an_order_waits_for_the_next_servo_frame() -> None:
    waits = []
    for seed in range(200):
        one = board(seed=seed)
        one.order(1.0, 0, 2000)
        waits.append(one.advance(2.0)[0].at_s - 1.0)
    assert 0.0 <= min(waits) < 0.002 < 0.018 < max(waits) <= 0.02
    assert np.mean(waits) == pytest.approx(0.01, abs=0.0015)


def test_orders_to_one_valve_keep_their_order() -> None:
    for seed in range(50):
        one = board(seed=seed)
        one.order(1.0, 0, 2000)
        one.order(1.001, 0, 1000)
        one.advance(2.0)
        assert one.duty[0] == 0.0
        assert one.width_us[0] == 1000


def test_the_width_between_closed_and_full_is_the_duty() -> None:
    one = board(frame_s=0.0)
    one.order(0.0, 2, 1600)
    edges = one.advance(20 * T)
    opened_s = sum(b.at_s - a.at_s for a, b in zip(edges[::2], edges[1::2], strict=False))
    assert opened_s == pytest.approx(20 * 0.6 * T, rel=0.02)
    assert {edge.valve for edge in edges} == {2}


def test_a_restarting_board_begins_a_new_period_with_a_large_move() -> None:
    one = board(frame_s=0.0)
    one.order(0.0, 0, 1500)
    one.order(10.05 * T, 0, 1800)
    middle_s = 10.05 * T + 0.5 * T
    edges = one.advance(14 * T)
    assert first_with(edges, 0.8) == pytest.approx(middle_s - 0.4 * T, abs=0.2 * T)
    assert first_with(edges, 0.8) < 10.5 * T


@pytest.mark.parametrize("width_us", [1515, 1485])
def test_a_restarting_board_takes_a_small_move_as_a_trim(width_us: float) -> None:
    one = board(frame_s=0.0)
    one.order(0.0, 0, 1500)
    one.order(10.5 * T, 0, width_us)
    assert first_with(one.advance(14 * T), (width_us - 1000) / 1000) > 11 * T


def test_a_free_running_board_waits_for_its_next_period() -> None:
    one = board("free-running", frame_s=0.0)
    one.order(0.0, 0, 1500)
    one.order(10.1 * T, 0, 1800)
    one.order(20.1 * T, 0, 1000)
    edges = one.advance(30 * T)
    assert first_with(edges, 0.8) == pytest.approx(11.1 * T, abs=1e-6)
    assert edges[-1].at_s == pytest.approx(21 * T, abs=1e-6)
    assert not edges[-1].is_open


def test_a_restarting_board_closes_at_once() -> None:
    one = board(frame_s=0.0)
    one.order(0.0, 0, 2000)
    one.order(1.234, 0, 1000)
    assert one.advance(2.0)[-1] == Edge(1.234, 0, False, 0.0)


@pytest.mark.parametrize("width_us", [0, 899])
def test_without_a_valid_pulse_for_a_tenth_of_a_second_the_board_closes(width_us: float) -> None:
    one = board(frame_s=0.0)
    one.order(0.0, 0, 2000)
    one.order(1.0, 0, width_us)
    assert not any(edge.at_s > 0.0 for edge in one.advance(1.099))
    assert one.advance(2.0) == [Edge(1.1, 0, False, 0.0)]


def test_a_short_gap_between_pulses_closes_nothing() -> None:
    one = board(frame_s=0.0)
    one.order(0.0, 0, 2000)
    one.order(1.0, 0, 0)
    one.order(1.05, 0, 2000)
    # Absent again when the first gap's time is over, but not yet for long enough.
    one.order(1.07, 0, 0)
    one.order(1.15, 0, 2000)
    assert len(one.advance(3.0)) == 1


def test_before_the_first_order_all_is_closed() -> None:
    assert board().advance(5.0) == []


def test_jitter_of_a_closed_width_opens_nothing() -> None:
    one = board()
    one.order(0.0, 0, 1005)
    assert one.advance(5.0) == []


def test_wrong_orders_are_refused() -> None:
    with pytest.raises(ValueError, match="pulse"):
        board().order(0.0, 0, math.nan)
    with pytest.raises(ValueError, match="pulse"):
        board().order(math.inf, 0, 1500)
    with pytest.raises(ValueError, match="closed_us"):
        DriverBoard(PWM, 6, seed=1, start_s=0.0, closed_us=2000, full_us=1000)


# ------------------------------------------------------------------------------- alive dither

ALIVE_US = 8


def alive_board(**given: float) -> DriverBoard:
    settings = {"frame_s": 0.0, "dither_us": float(ALIVE_US), **given}
    return DriverBoard(PWM, 6, seed=1, start_s=0.0, **settings)  # type: ignore[arg-type]


def dither(
    one: DriverBoard,
    until_s: float,
    *,
    from_s: float = 0.0,
    pulse_us: float = 1500.0,
    step: int = 4,
) -> None:
    """Move the width to and fro, ten times a second."""
    for k in range(math.ceil((until_s - from_s) * 10 - 1e-9)):
        one.order(from_s + 0.1 * k, 0, pulse_us + (step if k % 2 else -step))


def closed_at(edges: list[Edge]) -> float:
    return next(edge.at_s for edge in edges if edge.duty == 0.0)


def test_a_width_that_moves_keeps_its_valve_at_work() -> None:
    one = alive_board()
    dither(one, 10.0)
    edges = one.advance(10.0)
    opened_s = sum(b.at_s - a.at_s for a, b in zip(edges[::2], edges[1::2], strict=False))
    assert opened_s == pytest.approx(5.0, rel=0.01)
    assert all(edge.duty > 0.49 for edge in edges)


@pytest.mark.parametrize("last_s", [0.0, 0.9, 4.3])
def test_a_width_that_stands_still_for_three_tenths_of_a_second_closes(last_s: float) -> None:
    one = alive_board()
    dither(one, last_s + 0.05)
    assert closed_at(one.advance(10.0)) == pytest.approx(last_s + 0.3, abs=1e-9)


def test_full_closes_as_well_when_it_stands_still() -> None:
    one = alive_board()
    one.order(1.0, 0, 2000)
    assert one.advance(5.0) == [Edge(1.0, 0, True, 1.0), Edge(1.3, 0, False, 0.0)]


def test_two_lost_moves_in_a_row_close_nothing() -> None:
    one = alive_board()
    for k in (0, 1, 2, 5, 6, 7):  # 3 and 4 are lost: 0.3 s less a moment
        one.order(0.0999 * k, 0, 1500 + (4 if k % 2 else -4))
    edges = one.advance(0.9)
    assert edges
    assert not any(edge.duty == 0.0 for edge in edges)


def test_a_refresh_of_the_same_width_is_no_life() -> None:
    one = alive_board()
    one.order(0.0, 0, 1500)
    for k in range(1, 50):
        one.order(0.02 * k, 0, 1500)
    edges = one.advance(2.0)
    assert closed_at(edges) == pytest.approx(0.3)
    assert edges[-1].duty == 0.0


@pytest.mark.parametrize("jitter_us", [1, 1.9])
def test_jitter_of_the_capture_is_no_life(jitter_us: float) -> None:
    one = alive_board()
    for k in range(100):
        one.order(0.02 * k, 0, 1500 + jitter_us * (-1) ** k)
    assert closed_at(one.advance(3.0)) == pytest.approx(0.3)


def test_jitter_does_not_hide_life() -> None:
    one = alive_board()
    rng = np.random.default_rng(5)
    for k in range(500):
        move = 4 if (k // 5) % 2 else -4
        one.order(0.02 * k, 0, 1500 + move + float(rng.uniform(-1.0, 1.0)))
    edges = one.advance(10.0)
    assert edges
    assert not any(edge.duty == 0.0 for edge in edges)


def test_it_opens_again_with_the_next_move() -> None:
    one = alive_board()
    one.order(0.0, 0, 2000)
    one.order(1.0, 0, 1992)
    edges = one.advance(1.2)
    assert edges[1].at_s == pytest.approx(0.3)
    assert edges[1].duty == 0.0
    assert edges[2].at_s >= 1.0
    assert edges[2].is_open


def test_closed_is_closed_whether_it_moves_or_not() -> None:
    one = alive_board()
    dither(one, 0.15)
    one.order(0.2, 0, 1000)
    one.order(0.7, 0, 1000)
    edges = one.advance(5.0)
    assert closed_at(edges) == 0.2
    assert edges[-1].duty == 0.0


def test_without_the_check_a_standing_width_goes_on_for_ever() -> None:
    one = board(frame_s=0.0)
    one.order(0.0, 0, 2000)
    assert one.advance(3600.0)[-1].is_open


def test_only_the_valve_that_stands_still_closes() -> None:
    one = alive_board()
    dither(one, 2.0)
    one.order(0.0, 3, 2000)
    edges = one.advance(2.0)
    assert {edge.valve for edge in edges if edge.duty == 0.0} == {3}


@pytest.mark.parametrize("dither_us", [-1.0, 51.0, math.nan])
def test_a_dither_that_makes_no_sense_is_refused(dither_us: float) -> None:
    with pytest.raises(ValueError, match="dither_us"):
        alive_board(dither_us=dither_us)


# ------------------------------------------------------------------ test vectors of the document

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "driver-board.md"
TEN_HZ = Pulsing(frequency_hz=10.0, duty_min=0.2, duty_max=0.9, min_on_s=0.01, min_off_s=0.01)
ROW = re.compile(r"^\| (\d+) \| ([^|]+) \| ([^|]+) \| ([^|]+) \|$", re.MULTILINE)


def vectors() -> dict[int, tuple[list[tuple[float, float]], str]]:
    """Return the document's rows by number: what comes in, ms and us, and the edges, ms."""
    found = {}
    for number, given, edges, _ in ROW.findall(PAGE.read_text(encoding="utf-8")):
        pairs = [pair.split(":") for pair in given.split(",")]
        found[int(number)] = ([(float(at), float(us)) for at, us in pairs], edges.strip())
    return found


def edges_text(number: int, orders: list[tuple[float, float]], until_ms: float) -> str:
    one = DriverBoard(
        TEN_HZ,
        6,
        seed=1,
        start_s=0.0,
        frame_s=0.0,
        overrun_s=0.005 if number == 28 else 0.0,
        dither_us=8.0 if number > 28 else 0.0,
    )
    valve = 1 if number == 2 else 0
    for at_ms, pulse_us in orders:
        one.order(at_ms / 1000.0, valve, pulse_us)
    text, is_open = [], False
    for edge in one.advance(until_ms / 1000.0 + 1e-9):
        if edge.is_open != is_open:
            is_open = edge.is_open
            text.append(f"{'+' if is_open else '-'}{edge.at_s * 1000:.1f}")
    return " ".join(text) or "none"


def test_the_document_has_all_its_rows() -> None:
    assert sorted(vectors()) == list(range(1, 39))


def is_begin(said: str, made: str) -> bool:
    """Return whether edges begin as they are said to, to a tenth of a millisecond."""
    wanted, found = said.split(), made.split()
    if len(found) < len(wanted) or "none" in (said, made):
        return said == made
    return all(
        a[0] == b[0] and abs(float(a[1:]) - float(b[1:])) < 0.11
        for a, b in zip(wanted, found, strict=False)
    )


@pytest.mark.parametrize("number", range(1, 39))
def test_the_board_does_what_the_document_says(number: int) -> None:
    orders, said = vectors()[number]
    made = edges_text(number, orders, 700.0)
    _, first = vectors()[1]
    for before in range(len(first.split()), 0, -1):
        # `...` stands for the edges of row 1 up to where this row goes on by itself.
        head = " ".join(edges_text(1, vectors()[1][0], 700.0).split()[:before])
        whole = said.replace("...", head)
        if is_begin(whole, made) or "..." not in said:
            break
    assert is_begin(whole, made)
