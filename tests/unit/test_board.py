from __future__ import annotations

import math
from typing import Literal

import numpy as np
import pytest

from companion.core.nozzle import PwmLimits
from companion.output.pwm import Edge
from sitl.board import DriverBoard

PWM = PwmLimits(frequency_hz=11.0, duty_min=0.2, duty_max=0.9, min_on_s=0.01, min_off_s=0.01)
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
