"""One suite for every executor of plans: what the runtime may rely on whichever it has."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Iterator
from dataclasses import dataclass

import pytest

from companion.core.types import SprayPlan, TimedChange
from companion.output.none import DryRunExecutor
from companion.output.servo import ServoExecutor, ServoOptions
from companion.output.timed import TimedExecutor

VALVES = 3


@dataclass
class Bench:
    """An executor and how to see what its valves do: (time, valve, duty)."""

    executor: TimedExecutor
    seen: Callable[[], list[tuple[float, int, float]]]

    def duty(self, valve: int) -> float | None:
        """Return what the valve was last told."""
        told = [duty for _, number, duty in self.seen() if number == valve]
        return told[-1] if told else None

    @property
    def duties(self) -> list[float | None]:
        return [self.duty(valve) for valve in range(VALVES)]


def servo_bench() -> Bench:
    told: list[tuple[float, int, float]] = []

    def order(channel: int, pulse_us: int) -> bool:
        told.append((now(), channel - 9, (pulse_us - 1000) / 1000))
        return True

    options = ServoOptions(channels=tuple(range(9, 9 + VALVES)))
    return Bench(executor=ServoExecutor(options, order), seen=lambda: told)


def dry_bench() -> Bench:
    executor = DryRunExecutor(VALVES)
    return Bench(
        executor=executor,
        seen=lambda: [(change.at_s, change.valve, change.duty) for change in executor.changes],
    )


BENCHES: dict[str, Callable[[], Bench]] = {"servo": servo_bench, "none": dry_bench}


def now() -> float:
    return asyncio.get_running_loop().time()


@pytest.fixture(params=BENCHES)
def idle(request: pytest.FixtureRequest) -> Iterator[Bench]:
    """Yield each executor, not started."""
    yield BENCHES[request.param]()


@pytest.fixture
async def bench(idle: Bench) -> AsyncIterator[Bench]:
    """Yield each executor, running."""
    await idle.executor.start()
    yield idle
    await idle.executor.stop()


def plan(
    sequence: int, *duty: float, changes: tuple[TimedChange, ...] = (), lease_s: float = 5.0
) -> SprayPlan:
    issued_s = now()
    return SprayPlan(
        sequence=sequence,
        issued_s=issued_s,
        duty=duty,
        changes=changes,
        lease_until_s=issued_s + lease_s,
    )


async def test_stop_before_start_is_allowed(idle: Bench) -> None:
    await idle.executor.stop()
    await idle.executor.stop()


async def test_the_start_closes(bench: Bench) -> None:
    assert bench.duties == [0.0] * VALVES


async def test_the_duty_of_the_plan_arrives(bench: Bench) -> None:
    bench.executor.submit(plan(1, 0.2, 0.5, 1.0))
    assert bench.duties == [0.2, 0.5, 1.0]


async def test_changes_arrive_at_their_times(bench: Bench) -> None:
    begin_s = now()
    changes = tuple(
        TimedChange(at_s=begin_s + 0.02 * (k + 1), valve=k, duty=0.5) for k in range(VALVES)
    )
    before = len(bench.seen())
    bench.executor.submit(plan(1, 0.0, 0.0, 0.0, changes=changes))
    await asyncio.sleep(0.1)
    arrived = bench.seen()[before:]
    assert [(valve, duty) for _, valve, duty in arrived] == [(0, 0.5), (1, 0.5), (2, 0.5)]
    for (at_s, _, _), change in zip(arrived, changes, strict=True):
        assert -1e-4 <= at_s - change.at_s <= 0.02


async def test_the_end_of_the_lease_closes(bench: Bench) -> None:
    bench.executor.submit(plan(1, 0.2, 0.5, 1.0, lease_s=0.03))
    await asyncio.sleep(0.08)
    assert bench.duties == [0.0] * VALVES


async def test_a_renewed_lease_goes_on(bench: Bench) -> None:
    before = len(bench.seen())
    for number in range(1, 6):
        bench.executor.submit(plan(number, 0.2, 0.5, 1.0, lease_s=0.1))
        await asyncio.sleep(0.02)
    assert [duty for _, _, duty in bench.seen()[before:]] == [0.2, 0.5, 1.0]


async def test_a_closed_plan_closes_at_once(bench: Bench) -> None:
    late = TimedChange(at_s=now() + 0.02, valve=0, duty=1.0)
    bench.executor.submit(plan(1, 0.2, 0.5, 1.0, changes=(late,)))
    bench.executor.submit(plan(2, 0.0, 0.0, 0.0))
    assert bench.duties == [0.0] * VALVES
    await asyncio.sleep(0.04)
    assert bench.duties == [0.0] * VALVES


async def test_the_stop_closes_and_ends_everything(bench: Bench) -> None:
    late = TimedChange(at_s=now() + 0.02, valve=0, duty=1.0)
    bench.executor.submit(plan(1, 0.2, 0.5, 1.0, changes=(late,)))
    await bench.executor.stop()
    assert bench.duties == [0.0] * VALVES
    await asyncio.sleep(0.04)
    bench.executor.submit(plan(2, 1.0, 1.0, 1.0))
    await bench.executor.stop()
    assert bench.duties == [0.0] * VALVES


async def test_a_healthy_executor_has_no_fault(bench: Bench) -> None:
    assert bench.executor.fault is None
