"""Plans to servo orders: when, which pulse, how often, and what happens when plans stop."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from dataclasses import replace

import pytest

from companion.core.types import SprayPlan, TimedChange
from companion.output.servo import ServoExecutor, ServoOptions
from companion.output.timed import next_event_s
from tests.builders import now, plan

CHANNELS = (9, 10)
OPTIONS = ServoOptions(channels=CHANNELS)
CLOSED = [(9, 1000), (10, 1000)]


class Wire:
    """Takes orders with their times; may be down."""

    def __init__(self) -> None:
        self.orders: list[tuple[int, int]] = []
        self.times_s: list[float] = []
        self.is_up = True
        self._news = asyncio.Event()

    def order(self, channel: int, pulse_us: int) -> bool:
        if not self.is_up:
            return False
        self.orders.append((channel, pulse_us))
        self.times_s.append(now())
        self._news.set()
        return True

    async def until(self, done: Callable[[], bool]) -> None:
        async with asyncio.timeout(5.0):
            while not done():
                self._news.clear()
                await self._news.wait()

    def forget(self) -> None:
        self.orders.clear()
        self.times_s.clear()


@pytest.fixture
def wire() -> Wire:
    return Wire()


@pytest.fixture
async def executor(wire: Wire) -> AsyncIterator[ServoExecutor]:
    """Yield a running executor whose first orders are forgotten."""
    executor = ServoExecutor(OPTIONS, wire.order)
    await executor.start()
    wire.forget()
    yield executor
    await executor.stop()


async def test_the_start_orders_every_valve_closed(wire: Wire) -> None:
    executor = ServoExecutor(OPTIONS, wire.order)
    await executor.start()
    assert wire.orders == CLOSED
    await executor.stop()


async def test_duty_becomes_pulse_width_in_proportion(executor: ServoExecutor, wire: Wire) -> None:
    executor.submit(plan(1, 0.25, 1.0))
    assert wire.orders == [(9, 1250), (10, 2000)]


async def test_an_output_may_be_reversed(wire: Wire) -> None:
    options = ServoOptions(channels=(9,), closed_us=1900, full_us=1100)
    assert (options.pulse_us(0.0), options.pulse_us(1.0)) == (1900, 1100)


async def test_a_change_leaves_at_its_time(executor: ServoExecutor, wire: Wire) -> None:
    at_s = now() + 0.05
    executor.submit(plan(1, 0.0, 0.0, changes=(TimedChange(at_s=at_s, valve=1, duty=0.5),)))
    assert wire.orders == []
    await wire.until(lambda: bool(wire.orders))
    assert wire.orders == [(10, 1500)]
    assert wire.times_s[0] >= at_s - 1e-5
    assert executor.lateness.count == 1
    assert executor.lateness.worst_s == pytest.approx(wire.times_s[0] - at_s, abs=2e-3)


async def test_a_change_that_is_due_already_leaves_at_once(
    executor: ServoExecutor, wire: Wire
) -> None:
    late = TimedChange(at_s=now() - 0.01, valve=0, duty=0.4)
    executor.submit(plan(1, 0.0, 0.0, changes=(late,)))
    assert wire.orders == [(9, 1400)]


async def test_the_same_duty_again_is_not_ordered_again(
    executor: ServoExecutor, wire: Wire
) -> None:
    executor.submit(plan(1, 0.5, 0.5))
    wire.forget()
    executor.submit(plan(2, 0.5, 0.5005))
    assert wire.orders == []
    executor.submit(plan(3, 0.5, 0.502))
    assert wire.orders == [(10, 1502)]


async def test_closing_by_one_microsecond_is_ordered(executor: ServoExecutor, wire: Wire) -> None:
    executor.submit(plan(1, 0.001, 0.0))
    executor.submit(plan(2, 0.002, 0.0))
    executor.submit(plan(3, 0.001, 0.0))
    wire.forget()
    executor.submit(plan(4, 0.0, 0.0))
    assert wire.orders == [(9, 1000)]


async def test_a_newer_plan_replaces_what_has_not_happened(
    executor: ServoExecutor, wire: Wire
) -> None:
    opening = TimedChange(at_s=now() + 0.03, valve=0, duty=1.0)
    executor.submit(plan(1, 0.0, 0.0, changes=(opening,)))
    executor.submit(plan(2, 0.0, 0.0, changes=(TimedChange(at_s=now() + 0.06, valve=1, duty=0.3),)))
    await wire.until(lambda: bool(wire.orders))
    assert wire.orders == [(10, 1300)]


async def test_an_older_plan_changes_nothing(executor: ServoExecutor, wire: Wire) -> None:
    executor.submit(plan(2, 0.0, 0.0))
    executor.submit(plan(1, 1.0, 1.0))
    executor.submit(plan(2, 1.0, 1.0))
    assert wire.orders == []


async def test_the_end_of_the_lease_closes_every_valve(executor: ServoExecutor, wire: Wire) -> None:
    opening = TimedChange(at_s=now() + 10.0, valve=0, duty=1.0)
    executor.submit(plan(1, 0.5, 0.7, changes=(opening,), lease_s=0.05))
    ends_s = now() + 0.05
    wire.forget()
    await wire.until(lambda: len(wire.orders) == 2)
    assert wire.orders == CLOSED
    assert wire.times_s[0] >= ends_s - 0.005
    assert executor.lease_end_count == 1


async def test_a_plan_that_comes_too_late_is_refused_and_counted(
    executor: ServoExecutor, wire: Wire
) -> None:
    executor.submit(plan(1, 0.5, 0.5))
    wire.forget()
    past = SprayPlan(
        sequence=2, issued_s=now() - 2, duty=(0.7, 0.7), changes=(), lease_until_s=now() - 1
    )
    executor.submit(past)
    assert wire.orders == []
    assert executor.rejected_count == 1
    executor.submit(replace(past, duty=(0.0, 0.0)))
    assert wire.orders == CLOSED
    assert executor.rejected_count == 1


async def test_orders_are_refreshed_in_turns(wire: Wire) -> None:
    executor = ServoExecutor(ServoOptions(channels=CHANNELS, refresh_s=0.08), wire.order)
    await executor.start()
    executor.submit(plan(1, 0.5, 0.7))
    wire.forget()
    await wire.until(lambda: len(wire.orders) >= 4)
    await executor.stop()
    assert wire.orders[:4] == [(9, 1500), (10, 1700), (9, 1500), (10, 1700)]
    assert wire.times_s[2] - wire.times_s[0] >= 0.075


async def test_a_dithered_pulse_moves_to_and_fro_while_its_valve_is_open(wire: Wire) -> None:
    options = ServoOptions(channels=CHANNELS, refresh_s=0.3, dither_us=8)
    executor = ServoExecutor(options, wire.order)
    await executor.start()
    executor.submit(plan(1, 0.5, 0.0))
    wire.forget()
    await wire.until(lambda: len(wire.orders) >= 8)
    await executor.stop()
    moved = [pulse for channel, pulse in wire.orders if channel == 9]
    assert moved[:5] == [1504, 1496, 1504, 1496, 1504]
    times_s = [at for at, order in zip(wire.times_s, wire.orders, strict=True) if order[0] == 9]
    # Four times 0.1 s, of which the first may have left late.
    assert times_s[4] - times_s[0] >= 0.35
    # The closed one is only refreshed, and stands still.
    assert set(wire.orders) == {(9, 1504), (9, 1496), (10, 1000), (9, 1000)}


async def test_what_dithers_is_not_refreshed_besides(wire: Wire) -> None:
    options = ServoOptions(channels=(9,), refresh_s=0.05, dither_us=8)
    executor = ServoExecutor(options, wire.order)
    await executor.start()
    executor.submit(plan(1, 0.5))
    wire.forget()
    await wire.until(lambda: len(wire.orders) >= 4)
    await executor.stop()
    assert wire.times_s[3] - wire.times_s[0] >= 0.29
    assert [pulse for _, pulse in wire.orders[:4]] == [1504, 1496, 1504, 1496]


async def test_all_outputs_dither_at_once_where_one_order_carries_them(wire: Wire) -> None:
    options = ServoOptions(channels=CHANNELS, dither_us=8, dithers_together=True)
    executor = ServoExecutor(options, wire.order)
    await executor.start()
    executor.submit(plan(1, 0.5, 1.0))
    wire.forget()
    await wire.until(lambda: len(wire.orders) >= 4)
    await executor.stop()
    assert wire.orders[:4] == [(9, 1504), (10, 2000), (9, 1496), (10, 1992)]
    assert wire.times_s[1] - wire.times_s[0] < wire.times_s[2] - wire.times_s[1]


@pytest.mark.parametrize("after_s", [0.0, 0.005, 0.05])
async def test_no_trim_makes_a_valve_look_dead(wire: Wire, after_s: float) -> None:
    """A board closes a valve whose width has moved by less than half the dither for 0.3 s.

    Each trim here comes so long after a dither and puts the width back to where it had been.
    """
    options = ServoOptions(channels=(9,), dither_us=8)
    executor = ServoExecutor(options, wire.order)
    await executor.start()
    executor.submit(plan(1, 0.5))
    seen = [(now(), 1496)]  # what stood for a servo frame
    for number in range(2, 12):
        count = len(wire.orders)
        await wire.until(lambda count=count: len(wire.orders) > count)  # type: ignore[misc]
        if after_s > 0.0:
            await asyncio.sleep(after_s)
        back_us = seen[-1][1] - wire.orders[-1][1]
        pulse_us = 1500 if number % 2 else 1500 + back_us
        executor.submit(plan(number, (pulse_us - 1000) / 1000.0))
        seen.append((now(), wire.orders[-1][1]))
    await executor.stop()
    widths = [
        (at_s, pulse)
        for at_s, (_, pulse), next_s in zip(
            wire.times_s, wire.orders, [*wire.times_s[1:], now()], strict=True
        )
        if pulse > 1000 and next_s - at_s >= 0.02
    ]
    moved_s, moved_us = widths[0]
    for at_s, pulse in widths:
        assert at_s - moved_s < 0.25
        if abs(pulse - moved_us) >= 4:
            moved_s, moved_us = at_s, pulse


async def test_the_end_of_the_lease_ends_the_dither(wire: Wire) -> None:
    executor = ServoExecutor(ServoOptions(channels=(9,), dither_us=8), wire.order)
    await executor.start()
    executor.submit(plan(1, 0.5, lease_s=0.15))
    wire.forget()
    await wire.until(lambda: (9, 1000) in wire.orders)
    wire.forget()
    await asyncio.sleep(0.25)
    assert wire.orders == [(9, 1000)]  # once more, for it may have been overtaken
    await executor.stop()


async def test_a_return_valve_stands_still(wire: Wire) -> None:
    options = ServoOptions(channels=(9,), return_channel=15, dither_us=8, refresh_s=0.05)
    executor = ServoExecutor(options, wire.order)
    await executor.start()
    await wire.until(lambda: len(wire.orders) >= 8)
    await executor.stop()
    assert {pulse for channel, pulse in wire.orders if channel == 15} <= {1000, 2000}


@pytest.mark.parametrize("dither_us", [1, 3, 8, 50])
@pytest.mark.parametrize("ends", [(1000, 2000), (1900, 1100)])
def test_a_dither_moves_by_its_width_between_closed_and_full(
    dither_us: int, ends: tuple[int, int]
) -> None:
    closed_us, full_us = ends
    options = ServoOptions(channels=(9,), closed_us=closed_us, full_us=full_us, dither_us=dither_us)
    for duty in (0.2, 0.5, 0.9, 0.999, 1.0):
        down, up = (
            options.dithered_us(options.pulse_us(duty), is_up=is_up) for is_up in (False, True)
        )
        assert abs(up - down) == dither_us
        assert abs(up - closed_us) > abs(down - closed_us)
        assert abs(up - closed_us) <= abs(full_us - closed_us)
        if duty < 0.95:
            assert abs((up + down) / 2 - options.pulse_us(duty)) <= 0.5


async def test_what_could_not_leave_is_ordered_by_the_next_plan(
    executor: ServoExecutor, wire: Wire
) -> None:
    executor.submit(plan(1, 0.5, 0.5))
    wire.forget()
    wire.is_up = False
    executor.submit(plan(2, 0.0, 0.0))
    wire.is_up = True
    executor.submit(plan(3, 0.0, 0.0))
    assert wire.orders == CLOSED


@pytest.mark.parametrize("result", [2, 3, 4])
async def test_a_refused_order_closes_everything_for_good(
    executor: ServoExecutor, wire: Wire, result: int
) -> None:
    executor.submit(plan(1, 0.5, 0.7))
    wire.forget()
    executor.acknowledge(result)
    assert wire.orders == CLOSED
    assert executor.fault is not None
    wire.forget()
    executor.submit(plan(2, 0.5, 0.7))
    executor.acknowledge(0)
    assert wire.orders == []
    assert executor.fault is not None


async def test_an_accepted_order_is_no_fault(executor: ServoExecutor) -> None:
    executor.acknowledge(0)
    executor.acknowledge(5)  # in progress
    assert executor.fault is None


async def test_the_stop_orders_closed_twice_and_then_nothing(wire: Wire) -> None:
    executor = ServoExecutor(OPTIONS, wire.order)
    await executor.start()
    executor.submit(plan(1, 0.5, 0.7, lease_s=0.02))
    wire.forget()
    await executor.stop()
    assert wire.orders == CLOSED * 2
    assert wire.times_s[2] - wire.times_s[1] >= 0.04
    wire.forget()
    await executor.stop()
    executor.submit(plan(2, 1.0, 1.0))
    assert wire.orders == []


async def test_the_stop_orders_closed_twice_even_what_is_closed_already(wire: Wire) -> None:
    executor = ServoExecutor(OPTIONS, wire.order)
    await executor.start()
    wire.forget()
    await executor.stop()
    assert wire.orders == CLOSED * 2


async def test_the_stop_closes_at_once_even_if_it_is_cancelled(wire: Wire) -> None:
    executor = ServoExecutor(OPTIONS, wire.order)
    await executor.start()
    executor.submit(plan(1, 0.5, 0.7))
    wire.forget()
    stopping = asyncio.create_task(executor.stop())
    await asyncio.sleep(0)
    stopping.cancel()
    await asyncio.gather(stopping, return_exceptions=True)
    assert wire.orders[:2] == CLOSED


async def test_nothing_is_ordered_before_the_start(wire: Wire) -> None:
    executor = ServoExecutor(OPTIONS, wire.order)
    executor.submit(plan(1, 1.0, 1.0))
    await executor.stop()
    assert wire.orders == []


async def test_a_plan_for_other_valves_is_a_bug(executor: ServoExecutor) -> None:
    with pytest.raises(ValueError, match="plan for 3 valves"):
        executor.submit(plan(1, 0.0, 0.0, 0.0))


@pytest.mark.parametrize(
    "wrong",
    [
        {"channels": ()},
        {"channels": (9, 9)},
        {"channels": (0,)},
        {"channels": (9,), "closed_us": 0},
        {"channels": (9,), "full_us": 3000},
        {"channels": (9,), "closed_us": 1500, "full_us": 1500},
        {"channels": (9,), "dither_us": -1},
        {"channels": (9,), "refresh_s": float("nan")},
    ],
)
def test_outputs_that_cannot_work_are_refused(wrong: dict[str, object]) -> None:
    assert ServoOptions(channels=(9,)).full_us == 2000
    with pytest.raises(ValueError, match=r"channel|us|refresh_s"):
        ServoOptions(**wrong)  # type: ignore[arg-type]


def test_changes_happen_in_their_order_until_the_lease_ends() -> None:
    changes = (
        TimedChange(at_s=1.0, valve=0, duty=0.5),
        TimedChange(at_s=1.5, valve=0, duty=0.7),
        TimedChange(at_s=9.0, valve=0, duty=0.9),
    )
    given = SprayPlan(sequence=1, issued_s=0.0, duty=(0.2,), changes=changes, lease_until_s=2.0)
    assert [given.duty_at(t)[0] for t in (0.5, 1.0, 1.4, 1.5, 1.99, 2.0, 9.5)] == [
        0.2,
        0.5,
        0.5,
        0.7,
        0.7,
        0.0,
        0.0,
    ]
    assert [next_event_s(given, t) for t in (0.5, 1.0, 1.5, 2.0)] == [1.0, 1.5, 2.0, None]
