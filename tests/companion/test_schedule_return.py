"""The return valve: open 20 to 30 ms before the valves close, until after they open."""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.core.types import PwmLimits, SprayPlan, TimedChange
from companion.output.pwm import PulseEngine
from companion.output.return_valve import ReturnValve, spray_spans
from companion.output.servo import ServoExecutor, ServoOptions

PWM = PwmLimits(frequency_hz=11.0, duty_min=0.2, duty_max=0.9, min_on_s=0.01, min_off_s=0.01)
RETURN = 2  # behind two valves


def change(at_s: float, duty: float, valve: int = 0) -> TimedChange:
    return TimedChange(at_s=at_s, valve=valve, duty=duty)


def plan(
    *changes: TimedChange,
    duty: tuple[float, float] = (0.0, 0.0),
    at_s: float = 0.0,
    lease_s: float = 10.0,
) -> SprayPlan:
    return SprayPlan(
        sequence=round(at_s * 1000.0) + 1,
        issued_s=at_s,
        duty=duty,
        changes=changes,
        lease_until_s=at_s + lease_s,
    )


def test_it_opens_20_to_30_ms_before_the_last_valve_closes_and_shuts_after_the_first_opens() -> (
    None
):
    ahead = plan(change(1.0, 0.5), change(1.5, 0.6, 1), change(2.0, 0.0), change(3.0, 0.0, 1))
    valve = ReturnValve()
    (shut_s, is_open), (open_s, opens) = [*valve.submit(ahead, 0.0), *valve.run(9.0)]
    assert (is_open, opens) == (False, True)
    assert 1.0 < shut_s <= 1.05
    assert 0.020 <= 3.0 - open_s <= 0.030


def test_before_any_plan_and_without_one_it_is_open() -> None:
    valve = ReturnValve()
    assert valve.is_open
    assert valve.submit(plan(duty=(0.5, 0.5)), 0.0) == []
    assert [is_open for _, is_open in valve.run(1.0)] == [False]
    assert valve.submit(None, 1.0) == [(1.0, True)]
    assert valve.next_s is None


def test_a_lease_that_nobody_renews_ends_behind_an_open_return_valve() -> None:
    valve = ReturnValve()
    valve.submit(plan(duty=(0.5, 0.5), lease_s=0.3), 0.0)
    moves = valve.run(1.0)
    assert [is_open for _, is_open in moves] == [False, True]
    assert moves[1][0] == pytest.approx(0.275)


def test_leases_that_are_renewed_never_open_it() -> None:
    valve = ReturnValve()
    moves = [
        move
        for i in range(100)
        for move in valve.submit(plan(duty=(0.5, 0.5), at_s=0.05 * i, lease_s=0.3), 0.05 * i)
    ]
    assert [is_open for _, is_open in moves] == [False]


def test_an_end_that_moves_back_a_little_does_not_shut_it_again() -> None:
    valve = ReturnValve()
    valve.submit(plan(change(1.0, 0.0), duty=(0.5, 0.0)), 0.0)
    assert [is_open for _, is_open in valve.run(0.98)] == [False, True]
    assert valve.submit(plan(change(1.06, 0.0), duty=(0.5, 0.0), at_s=0.98), 0.98) == []
    assert valve.run(9.0) == []
    # Taken back for good, it shuts.
    valve = ReturnValve()
    valve.submit(plan(change(1.0, 0.0), duty=(0.5, 0.0)), 0.0)
    valve.run(0.98)
    assert valve.submit(plan(duty=(0.5, 0.0), at_s=0.98), 0.98) == [(0.98, False)]


def test_valves_that_close_without_notice_close_at_once_and_the_return_valve_opens_first() -> None:
    engine = PulseEngine(PWM, RETURN, start_s=0.0, has_return=True)
    engine.submit(plan(duty=(1.0, 1.0)), now_s=0.0)
    engine.advance(1.0)
    engine.submit(plan(at_s=1.0), now_s=1.0)
    edges = [(edge.at_s, edge.valve, edge.is_open) for edge in engine.advance(1.0)]
    assert edges == [(1.0, RETURN, True), (1.0, 0, False), (1.0, 1, False)]


@given(
    times=st.lists(st.floats(0.05, 4.0), max_size=12),
    duties=st.lists(st.sampled_from([0.0, 0.0, 0.5, 1.0]), min_size=12, max_size=12),
    lease_s=st.floats(0.2, 5.0),
)
def test_it_is_never_shut_while_no_valve_is_to_spray(
    times: list[float], duties: list[float], lease_s: float
) -> None:
    changes = [
        change(at_s, duty, number % 2)
        for number, (at_s, duty) in enumerate(zip(sorted(times), duties, strict=False))
    ]
    ahead = plan(*changes, duty=(duties[0], duties[-1]), lease_s=lease_s)
    valve = ReturnValve()
    moves = [*valve.submit(ahead, 0.0), *valve.run(10.0)]
    shut = [
        (a, b) for (a, is_open), (b, _) in itertools.pairwise([*moves, (10.0, True)]) if not is_open
    ]
    spans = spray_spans(ahead, 0.0)
    for shuts_s, opens_s in shut:
        (inside,) = [(a, b) for a, b in spans if a <= shuts_s and opens_s <= b]
        assert shuts_s >= inside[0] + 0.02 - 1e-9
        assert 0.020 - 1e-9 <= inside[1] - opens_s <= 0.030
    long_enough = [span for span in spans if span.end_s - span.start_s > 0.2]
    assert len(shut) >= len(long_enough)


@given(cuts=st.lists(st.floats(0.0, 4.0), max_size=10))
def test_the_engines_return_edges_do_not_depend_on_when_they_are_asked_for(
    cuts: list[float],
) -> None:
    ahead = plan(change(0.5, 0.6), change(2.0, 0.0), change(2.5, 0.6), change(3.0, 0.0))
    whole, pieces = (PulseEngine(PWM, RETURN, start_s=0.0, has_return=True) for _ in range(2))
    for engine in (whole, pieces):
        engine.submit(ahead, now_s=0.0)
    found = [edge for until_s in [*sorted(cuts), 5.0] for edge in pieces.advance(until_s)]
    edges = whole.advance(5.0)
    assert found == edges
    moves = [(round(e.at_s, 6), e.is_open) for e in edges if e.valve == RETURN]
    assert moves == [(0.52, False), (1.975, True), (2.52, False), (2.975, True)]


def test_the_engine_wakes_its_owner_for_the_return_valve() -> None:
    engine = PulseEngine(PWM, RETURN, start_s=0.0, has_return=True)
    engine.submit(plan(change(1.0, 1.0), change(3.0, 0.0)), now_s=0.0)
    woken_s = []
    while engine.next_event_s() < 2.99:
        at_s = engine.next_event_s()
        woken_s += [at_s for edge in engine.advance(at_s) if edge.valve == RETURN]
    assert woken_s == pytest.approx([1.02, 2.975])


# ------------------------------------------------------------------------------- servo outputs

OPTIONS = ServoOptions(channels=(9, 10), return_channel=15)


class Wire:
    def __init__(self) -> None:
        self.orders: list[tuple[int, int]] = []
        self.times_s: list[float] = []
        self._news = asyncio.Event()

    async def until(self, done: Callable[[], bool]) -> None:
        async with asyncio.timeout(5.0):
            while not done():
                self._news.clear()
                await self._news.wait()

    def order(self, channel: int, pulse_us: int) -> bool:
        self.orders.append((channel, pulse_us))
        self.times_s.append(asyncio.get_running_loop().time())
        self._news.set()
        return True


async def test_servo_outputs_have_the_return_valve_on_a_channel_of_its_own() -> None:
    wire = Wire()
    executor = ServoExecutor(OPTIONS, wire.order)
    await executor.start()
    assert wire.orders == [(15, 2000), (9, 1000), (10, 1000)]  # safe: a way out, then closed
    wire.orders.clear()
    wire.times_s.clear()
    now_s = asyncio.get_running_loop().time()
    closing = (change(now_s + 0.15, 0.0), change(now_s + 0.15, 0.0, 1))
    executor.submit(plan(*closing, duty=(0.5, 0.5), at_s=now_s))
    await wire.until(lambda: len(wire.orders) == 6)
    assert wire.orders == [(9, 1500), (10, 1500), (15, 1000), (15, 2000), (9, 1000), (10, 1000)]
    assert wire.times_s[2] >= now_s + 0.02 - 1e-4
    assert wire.times_s[3] >= now_s + 0.125 - 1e-4
    assert wire.times_s[4] >= now_s + 0.15 - 1e-4
    await executor.stop()


async def test_a_refused_order_opens_the_return_valve_ahead_of_the_closing() -> None:
    wire = Wire()
    executor = ServoExecutor(OPTIONS, wire.order)
    await executor.start()
    now_s = asyncio.get_running_loop().time()
    executor.submit(plan(duty=(0.5, 0.5), at_s=now_s))
    await wire.until(lambda: wire.orders[-1] == (15, 1000))
    wire.orders.clear()
    executor.acknowledge(2)
    assert wire.orders == [(15, 2000), (9, 1000), (10, 1000)]
    await executor.stop()


def test_the_return_valve_needs_a_channel_of_its_own() -> None:
    with pytest.raises(ValueError, match="channel of its own"):
        ServoOptions(channels=(9, 10), return_channel=10)
