"""What an autopilot's outputs may be told how often, and whether they can be trusted."""

from __future__ import annotations

import asyncio
import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.output.autopilot_guard import dead_man, findings, wanted_parameters
from companion.output.autopilot_options import DriveOutput, OutputCheck, ardupilot_places
from companion.output.servo import (
    OrderBudget,
    ServoExecutor,
    ServoOptions,
    dither_too_much,
    order_budget,
)
from tests.builders import now, plan

CHANNELS = (1, 2, 3)
OPTIONS = ServoOptions(channels=CHANNELS)


# ------------------------------------------------------------------------------- the budget


@given(
    st.lists(st.tuples(st.floats(0.0, 0.05), st.integers(2, 30)), min_size=1, max_size=300),
    st.floats(5.0, 200.0),
)
def test_trims_never_take_more_than_their_share(
    moves: list[tuple[float, int]], per_s: float
) -> None:
    budget, burst = OrderBudget(per_s=per_s, burst=10.0), 10.0
    now_s, sent = 0.0, 0
    for pause_s, moved_us in moves:
        now_s += pause_s
        if moved_us >= budget.trim_min_us(now_s):
            budget.spend(1, now_s)
            sent += 1
    assert sent <= burst + per_s * now_s + 1e-6


def test_orders_take_half_of_a_slow_line() -> None:
    slow = order_budget(baud=57_600, is_px4=False)
    assert slow.per_s * 44 * 10 == pytest.approx(0.5 * 57_600)
    assert order_budget(baud=57_600, is_px4=False, is_signed=True).per_s < slow.per_s
    assert not order_budget(baud=None, is_px4=False).is_limited
    assert order_budget(baud=921_600, is_px4=True).per_s <= 30.0
    with pytest.raises(ValueError, match="above 0"):
        OrderBudget(per_s=math.nan)


def test_a_clock_that_goes_back_gives_nothing_away() -> None:
    budget = OrderBudget(per_s=10.0, burst=5.0)
    budget.spend(5, 100.0)
    assert budget.left(50.0) == 0.0
    assert budget.left(100.2) == pytest.approx(2.0)


def test_a_line_too_slow_for_the_dither_is_named() -> None:
    text = dither_too_much(baud=57_600, valves=12, every_s=0.1)
    assert text is not None
    assert "57600 baud" in text
    assert dither_too_much(baud=921_600, valves=12, every_s=0.1) is None
    assert dither_too_much(baud=None, valves=24, every_s=0.1) is None


async def test_on_a_slow_line_large_trims_go_first_and_closing_at_once() -> None:
    orders: list[tuple[int, int]] = []

    def order(channel: int, pulse_us: int) -> bool:
        orders.append((channel, pulse_us))
        return True

    executor = ServoExecutor(ServoOptions(channels=(9, 10)), order, baud=9_600)
    await executor.start()
    executor.met(is_px4=False)
    executor.submit(plan(1, 0.5, 0.5))
    orders.clear()
    executor.submit(plan(2, 0.503, 0.515))
    executor.submit(plan(3, 0.503, 0.515))
    assert orders == []
    executor.submit(plan(4, 0.503, 0.0))
    assert orders == [(10, 1000)]
    # Opening and closing are no trims, however little they move.
    executor.submit(plan(5, 0.503, 0.01))
    executor.submit(plan(6, 0.503, 0.0))
    assert orders[1:] == [(10, 1010), (10, 1000)]
    await executor.stop()


# -------------------------------------------------------------------- what the outputs read


def report(**pulses: int) -> tuple[int, ...]:
    row = [0] * 16
    for name, pulse_us in pulses.items():
        row[int(name[1:]) - 1] = pulse_us
    return tuple(row)


def checked(*channels: int) -> OutputCheck:
    check = OutputCheck(len(channels))
    check.look_at(ardupilot_places(channels))
    return check


def test_an_output_follows_within_two_microseconds_and_three_tenths_of_a_second() -> None:
    check = checked(9)
    check.sent(0, 1000, 0.0)
    check.sent(0, 1500, 10.0)
    assert check.read(0, report(c9=1000), 10.1).again == ()
    assert check.read(0, report(c9=1000), 10.2).again == (0,)
    assert check.read(0, report(c9=1000), 10.29).stray == ()
    assert check.read(0, report(c9=1502), 10.4).again == ()
    for at_s in (10.5, 10.6):
        verdict = check.read(0, report(c9=1503), at_s)
    (stray,) = verdict.stray
    assert (stray.pulse_us, stray.ordered_us) == (1503, 1500)


def test_one_odd_reading_is_no_fault() -> None:
    check = checked(9)
    check.sent(0, 1500, 0.0)
    readings = (1500, 1200, 1500, 1200, 1500)
    verdicts = [check.read(0, report(c9=us), 1.0 + 0.1 * k) for k, us in enumerate(readings)]
    assert all(verdict.stray == () for verdict in verdicts)


def test_a_dithered_output_may_show_either_width() -> None:
    check = checked(9)
    for k in range(40):
        check.sent(0, 1496 if k % 2 else 1504, 0.1 * k)
        verdict = check.read(0, report(c9=1504 if k % 2 else 1496), 0.1 * k + 0.01)
        assert verdict.again == ()


def test_the_seventeenth_output_is_the_first_of_the_second_port() -> None:
    check = checked(1, 17)
    check.sent(1, 1500, 0.0)
    assert not check.is_possible
    assert check.read(0, report(c1=0), 1.0).seen == 0
    assert check.read(1, report(c1=1500), 1.0).seen == 1
    assert check.read(1, report(c1=1000), 2.0).again == (1,)


def test_where_an_output_is_not_known_any_place_that_follows_will_do() -> None:
    check = OutputCheck(1)
    check.look_at([[(0, 2), (1, 2)]])
    check.sent(0, 1500, 0.0)
    check.read(0, report(c3=900), 1.0)
    assert check.read(1, report(c3=1500), 1.05).again == ()
    assert check.read(0, report(c3=900), 1.1).stray == ()


async def ardupilot_executor(said: list[str]) -> tuple[ServoExecutor, list[tuple[int, int]]]:
    orders: list[tuple[int, int]] = []

    def order(channel: int, pulse_us: int) -> bool:
        orders.append((channel, pulse_us))
        return True

    executor = ServoExecutor(ServoOptions(channels=(9, 10)), order, say=said.append)
    await executor.start()
    executor.met(is_px4=False)
    orders.clear()
    return executor, orders


async def test_outputs_that_do_not_follow_are_a_fault_until_they_do() -> None:
    executor, orders = await ardupilot_executor([])
    executor.submit(plan(1, 0.5, 0.5))
    orders.clear()
    begin_s = now() + 0.5
    for k in range(2):
        executor.reported(0, report(c9=1500, c10=1200), begin_s + 0.1 * k)
    assert executor.fault == "output 10 reads 1200 us, ordered 1500: set SERVO10_FUNCTION to 0"
    # Said again first, then everything closes.
    assert orders == [(10, 1500), (9, 1000), (10, 1000), (10, 1000)]
    await asyncio.sleep(0.02)
    for k in range(15):
        executor.reported(0, report(c9=1000, c10=1000), begin_s + 0.6 + 0.1 * k)
        assert (executor.fault is None) == (k >= 5)
    await executor.stop()


async def test_outputs_that_fail_again_and_again_stay_a_fault() -> None:
    executor, _ = await ardupilot_executor([])
    at_s = now() + 1.0
    for _ in range(4):
        for _ in range(2):
            executor.reported(0, report(c9=1300, c10=1300), at_s)
            at_s += 0.1
        assert executor.fault is not None
        for _ in range(15):
            executor.reported(0, report(c9=1000, c10=1000), at_s)
            at_s += 0.1
    assert executor.fault is not None
    await executor.stop()


async def test_no_pulse_at_all_names_the_safety_switch() -> None:
    executor, _ = await ardupilot_executor([])
    for k in range(2):
        executor.reported(0, report(), now() + 1.0 + k)
    assert executor.fault is not None
    assert "safety switch" in executor.fault
    await executor.stop()


async def test_outputs_that_nothing_tells_of_are_named_once() -> None:
    said: list[str] = []
    executor, _ = await ardupilot_executor(said)
    for _ in range(2):
        executor._guard.look(now() + 6.0)
    assert len(said) == 1
    assert said[0].startswith("SERVO_OUTPUT_RAW")
    await executor.stop()


# ------------------------------------------------------------------------------ parameters

GOOD: dict[str, float | None] = {
    "SERVO1_FUNCTION": 0.0,
    "SERVO2_FUNCTION": 0.0,
    "SERVO3_FUNCTION": 0.0,
    "SPRAY_ENABLE": 0.0,
    "BRD_SAFETY_DEFLT": 0.0,
    "BRD_SAFETY_MASK": 0.0,
}
PX4_GOOD: dict[str, float | None] = {
    f"PWM_MAIN_{kind}{8 + n}": value
    for n in CHANNELS
    for kind, value in (
        ("FUNC", 300.0 + n),
        ("MIN", 1000.0),
        ("MAX", 2000.0),
        ("DIS", 1000.0),
        ("FAIL", -1.0),
    )
}


def test_right_parameters_give_nothing_to_say() -> None:
    assert findings(OPTIONS, GOOD, is_px4=False) == []
    assert findings(OPTIONS, PX4_GOOD, is_px4=True) == []


@pytest.mark.parametrize(
    ("changed", "is_fault", "words"),
    [
        ({"SERVO2_FUNCTION": 33.0}, True, "SERVO2_FUNCTION is 33: orders are refused; set it to 0"),
        ({"SERVO2_FUNCTION": 94.0}, True, "orders are refused"),
        ({"SERVO2_FUNCTION": 56.0}, False, "the pilot's control"),
        ({"SERVO2_FUNCTION": 22.0}, False, "set it to 0"),
        ({"SERVO2_FUNCTION": 22.0, "SPRAY_ENABLE": 1.0}, True, "SPRAY_ENABLE"),
        ({"SERVO2_FUNCTION": None}, False, "SERVO2_FUNCTION cannot be read"),
        ({"SERVO2_FUNCTION": math.nan}, True, "orders are refused"),
        ({"BRD_SAFETY_DEFLT": 1.0, "BRD_SAFETY_MASK": 1.0}, False, "BRD_SAFETY_MASK is 7"),
    ],
)
def test_each_wrong_parameter_of_ardupilot_is_named(
    changed: dict[str, float | None], is_fault: bool, words: str
) -> None:
    (found,) = findings(OPTIONS, GOOD | changed, is_px4=False)
    assert found.is_fault == is_fault
    assert words in found.text


@pytest.mark.parametrize(
    ("changed", "is_fault", "words"),
    [
        ({"PWM_MAIN_FUNC10": 0.0}, True, "no output for channel 2: set its PWM_MAIN_FUNCn"),
        ({"PWM_MAIN_MIN10": 1100.0}, True, "PWM_MAIN_MIN10 is 1100: set it to 1000"),
        ({"PWM_MAIN_MAX10": 1900.0}, True, "set it to 2000 (output.full_us)"),
        ({"PWM_MAIN_DIS10": 1500.0}, True, "disarming opens"),
        ({"PWM_MAIN_DIS10": math.nan}, True, "disarming opens"),
        ({"PWM_MAIN_DIS10": 900.0}, False, "PWM_MAIN_DIS10 is 900: set it to 1000"),
        ({"PWM_MAIN_FAIL10": 1500.0}, False, "which opens"),
    ],
)
def test_each_wrong_parameter_of_px4_is_named(
    changed: dict[str, float | None], is_fault: bool, words: str
) -> None:
    (found,) = findings(OPTIONS, PX4_GOOD | changed, is_px4=True)
    assert found.is_fault == is_fault
    assert words in found.text


def test_outputs_above_sixteen_want_their_switch() -> None:
    options = ServoOptions(channels=(17,))
    assert "SERVO_32_ENABLE" in wanted_parameters(options, is_px4=False)
    known = {"SERVO17_FUNCTION": 0.0, "SERVO_32_ENABLE": 0.0}
    (found,) = findings(options, known, is_px4=False)
    assert found.is_fault


def test_what_is_wrong_with_many_outputs_is_one_line() -> None:
    wrong = PX4_GOOD | {f"PWM_MAIN_DIS{pin}": 900.0 for pin in (9, 10, 11)}
    assert [found.text for found in findings(OPTIONS, wrong, is_px4=True)] == [
        "PWM_MAIN_DIS9 is 900: set it to 1000 (and 2 more)"
    ]
    none = dict.fromkeys(PX4_GOOD) | {"PWM_MAIN_FUNC9": 301.0}
    (found,) = findings(OPTIONS, none, is_px4=True)
    assert found.text.startswith("no output for channel 2")
    assert found.text.endswith("(and 1 more)")
    refused = GOOD | {"SERVO2_FUNCTION": 33.0, "SERVO3_FUNCTION": 34.0}
    assert len(findings(OPTIONS, refused, is_px4=False)) == 2


def test_a_return_valve_wants_to_be_open_when_disarmed() -> None:
    options = ServoOptions(channels=(1, 2), return_channel=3)
    (found,) = findings(options, PX4_GOOD, is_px4=True)
    assert (found.is_fault, found.text) == (False, "PWM_MAIN_DIS11 is 1000: set it to 2000")


def test_every_line_fits_the_operators_screen() -> None:
    wrong = [
        *(findings(OPTIONS, GOOD | {"SERVO2_FUNCTION": f}, is_px4=False) for f in (22, 33, 56, 28)),
        findings(OPTIONS, GOOD | {"BRD_SAFETY_DEFLT": 1.0}, is_px4=False),
        *(findings(OPTIONS, PX4_GOOD | {f"PWM_MAIN_{k}10": 1500.0}, is_px4=True)
          for k in ("FUNC", "MIN", "MAX", "DIS", "FAIL")),
    ]  # fmt: skip
    lengths = [len(found.text) for group in wrong for found in group]
    assert len(lengths) == 10
    assert max(lengths) <= 84


async def test_no_parameter_is_blamed_that_is_known_to_be_right() -> None:
    executor, _ = await ardupilot_executor([])
    executor.learned({"SERVO9_FUNCTION": 0.0, "SERVO10_FUNCTION": 0.0, "SPRAY_ENABLE": None})
    executor.submit(plan(1, 0.5, 0.5))
    begin_s = now() + 0.5
    for k in range(2):
        executor.reported(0, report(c9=1500, c10=1200), begin_s + 0.1 * k)
    assert executor.fault == (
        "output 10 reads 1200 us, ordered 1500: slow link, or another orders it"
    )


async def test_a_refusal_is_explained_by_the_parameters() -> None:
    said: list[str] = []
    executor, _ = await ardupilot_executor(said)
    executor.acknowledge(4)
    assert executor.fault == "servo order failed: is SERVOn_FUNCTION 0?"
    executor.learned({"SERVO9_FUNCTION": 0.0, "SERVO10_FUNCTION": 33.0, "SPRAY_ENABLE": None})
    assert executor.fault == "SERVO10_FUNCTION is 33: orders are refused; set it to 0"
    assert [text for text in said if "no watchdog" not in text] == []
    await executor.stop()


@pytest.mark.parametrize("value", [None, 0.0, math.nan, 2.0])
def test_that_nothing_closes_for_a_dead_computer_is_said(value: float | None) -> None:
    with_board = ServoOptions(channels=CHANNELS, dither_us=8)
    for is_px4 in (False, True):
        found = dead_man(OPTIONS, {"SPRW_ENABLE": value}, is_px4=is_px4)
        assert found is not None
        assert not found.is_fault
        assert dead_man(with_board, {"SPRW_ENABLE": value}, is_px4=is_px4) is None
    assert "SPRW_ENABLE" in wanted_parameters(OPTIONS, is_px4=False)
    assert dead_man(OPTIONS, {"SPRW_ENABLE": 1.0}, is_px4=False) is None
    assert dead_man(OPTIONS, {"SPRW_ENABLE": 1.0}, is_px4=True) is not None


async def test_outputs_are_guarded_by_the_script_or_by_a_board() -> None:
    wired = {"SERVO9_FUNCTION": 0.0, "SERVO10_FUNCTION": 0.0}

    def made(**options: Any) -> ServoExecutor:
        given = ServoOptions(**{"channels": (9, 10), "needs_guard": True, **options})
        return ServoExecutor(given, lambda channel, pulse_us: True)

    executor = made()
    assert not executor.is_guarded  # nobody was met
    executor.met(is_px4=False)
    # Asked for again and again: the script may start later.
    assert executor.learned({**wired, "SPRW_ENABLE": None}) == ("SPRW_ENABLE",)
    assert not executor.is_guarded
    for value, is_guarded in ((0.0, False), (math.nan, False), (1.0, True)):
        executor.learned({"SPRW_ENABLE": value})
        assert executor.is_guarded is is_guarded
    assert executor.fault is None
    executor.met(is_px4=False)  # another start of the autopilot: it may run no more
    assert not executor.is_guarded
    executor.met(is_px4=True)
    executor.learned({"SPRW_ENABLE": 1.0})
    assert not executor.is_guarded
    assert made(dither_us=8).is_guarded
    assert made(needs_guard=False).is_guarded
    # A board stops no motor, and here nothing else keeps the liquid.
    assert not made(channels=(), drives=(DriveOutput(channel=5),), dither_us=8).is_guarded


def test_a_mask_that_is_no_number_has_no_bit() -> None:
    known = {"BRD_SAFETY_DEFLT": 1.0, "BRD_SAFETY_MASK": math.nan}
    texts = [found.text for found in findings(OPTIONS, known, is_px4=False)]
    assert any(text.endswith("BRD_SAFETY_MASK is 7") for text in texts)
