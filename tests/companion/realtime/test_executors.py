"""One suite for every executor of plans: what the runtime may rely on whichever it has."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Iterator
from dataclasses import dataclass
from itertools import count

import pytest

from companion.core.types import PwmLimits, TimedChange
from companion.output.autopilot_options import DriveOutput
from companion.output.composite import CompositeExecutor, Part
from companion.output.engine.wire import EngineSetup, Wiring
from companion.output.gpio import GpioExecutor
from companion.output.servo import ServoExecutor, ServoOptions
from companion.output.timed import DryRunExecutor
from companion.ports import PlanExecutor
from tests.builders import now, plan
from tests.quickest import quickest

VALVES = 3


@dataclass
class Bench:
    """An executor and how to see what its valves do: (time, valve, duty).

    An executor of this process is seen at once, one of another by its reports.
    """

    executor: PlanExecutor
    seen: Callable[[], list[tuple[float, int, float]]]
    reports_s: float = 0.0

    def duty(self, valve: int) -> float | None:
        """Return what the valve was last told."""
        told = [duty for _, number, duty in self.seen() if number == valve]
        return told[-1] if told else None

    @property
    def duties(self) -> list[float | None]:
        return [self.duty(valve) for valve in range(VALVES)]

    async def shows(self, *duties: float) -> None:
        """Fail if the valves do not have these duties, now or with the reports under way."""
        until_s = now() + 20 * self.reports_s
        while self.duties != [*duties] and now() < until_s:  # noqa: ASYNC110, no event tells
            await asyncio.sleep(0.005)
        assert self.duties == [*duties]


def servo_bench() -> Bench:
    told: list[tuple[float, int, float]] = []

    def order(channel: int, pulse_us: int) -> bool:
        told.append((now(), channel - 9, (pulse_us - 1000) / 1000))
        return True

    options = ServoOptions(channels=tuple(range(9, 9 + VALVES)))
    return Bench(executor=ServoExecutor(options, order), seen=lambda: told)


class _Joint(ServoExecutor):
    """Meets PX4 at its start, as it does when the vehicle is heard."""

    async def start(self) -> None:
        await super().start()
        self.met(is_px4=True)


def px4_bench() -> Bench:
    told: list[tuple[float, int, float]] = []
    values: dict[int, float] = {}
    staged: dict[int, float] = {}

    def order(channel: int, pulse_us: int) -> bool:
        staged[channel - 1] = (pulse_us - 1000) / 1000
        return True

    def flush() -> bool:
        told.extend(
            (now(), valve, duty) for valve, duty in staged.items() if values.get(valve) != duty
        )
        values.update(staged)
        return True

    options = ServoOptions(channels=tuple(range(1, 1 + VALVES)))
    return Bench(executor=_Joint(options, order, flush=flush), seen=lambda: told)


def dry_bench() -> Bench:
    executor = DryRunExecutor(VALVES)
    return Bench(
        executor=executor,
        seen=lambda: [(change.at_s, change.valve, change.duty) for change in executor.changes],
    )


def gpio_bench() -> Bench:
    # At 100 Hz a pulse begins soon after its order.
    pwm = PwmLimits(frequency_hz=100, duty_min=0.1, duty_max=0.9, min_on_s=0.001, min_off_s=0.001)
    wiring = Wiring(valves=tuple(range(VALVES)))
    executor = GpioExecutor(EngineSetup(wiring=wiring, pwm=pwm, backend="memory"))

    def seen() -> list[tuple[float, int, float]]:
        changes: list[tuple[float, int, float]] = []
        last: dict[int, float] = {}
        for edge in executor.issued:
            if last.get(edge.output) != edge.duty:
                last[edge.output] = edge.duty
                changes.append((edge.actual_s, edge.output, edge.duty))
        return changes

    return Bench(executor=executor, seen=seen, reports_s=0.1)


def composite_bench() -> Bench:
    """Valves behind the autopilot, a pump behind something else."""
    valves = servo_bench()
    pump = ServoExecutor(
        ServoOptions(channels=(), drives=(DriveOutput(channel=5),)), lambda channel, pulse_us: True
    )
    parts = [Part(executor=pump, drives=(0,)), Part(executor=valves.executor, has_valves=True)]
    return Bench(executor=CompositeExecutor(parts), seen=valves.seen)


BENCHES: dict[str, Callable[[], Bench]] = {
    "servo": servo_bench,
    "px4": px4_bench,
    "none": dry_bench,
    "gpio": gpio_bench,
    "composite": composite_bench,
}


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


async def test_stop_before_start_is_allowed(idle: Bench) -> None:
    await idle.executor.stop()
    await idle.executor.stop()


async def test_the_start_closes(bench: Bench) -> None:
    await bench.shows(0.0, 0.0, 0.0)


async def test_the_duty_of_the_plan_arrives(bench: Bench) -> None:
    bench.executor.submit(plan(1, 0.2, 0.5, 1.0))
    await bench.shows(0.2, 0.5, 1.0)


async def test_changes_arrive_at_their_times(bench: Bench) -> None:
    numbers = count(1)

    async def late_s() -> float:
        """Let the valves open one after the other; return how late the latest was."""
        bench.executor.submit(plan(next(numbers), 0.0, 0.0, 0.0))
        await bench.shows(0.0, 0.0, 0.0)
        begin_s = now()
        changes = tuple(
            TimedChange(at_s=begin_s + 0.02 * (k + 1), valve=k, duty=0.5) for k in range(VALVES)
        )
        before = len(bench.seen())
        bench.executor.submit(plan(next(numbers), 0.0, 0.0, 0.0, changes=changes))
        await asyncio.sleep(0.1)
        await bench.shows(0.5, 0.5, 0.5)
        arrived = bench.seen()[before:]
        assert [(valve, duty) for _, valve, duty in arrived] == [(0, 0.5), (1, 0.5), (2, 0.5)]
        late = [at_s - changes[valve].at_s for at_s, valve, _ in arrived]
        assert min(late) >= -1e-4
        return max(late)

    assert await quickest(late_s, within_s=0.02) <= 0.02


async def test_the_end_of_the_lease_closes(bench: Bench) -> None:
    bench.executor.submit(plan(1, 0.2, 0.5, 1.0, lease_s=0.03))
    await asyncio.sleep(0.08)
    await bench.shows(0.0, 0.0, 0.0)


async def test_a_renewed_lease_goes_on(bench: Bench) -> None:
    await bench.shows(0.0, 0.0, 0.0)
    before = len(bench.seen())
    for number in range(1, 6):
        bench.executor.submit(plan(number, 0.2, 0.5, 1.0, lease_s=0.1))
        await asyncio.sleep(0.02)
    end_s = now()
    await asyncio.sleep(bench.reports_s)
    held = [duty for at_s, _, duty in bench.seen()[before:] if at_s < end_s]
    assert sorted(held) == [0.2, 0.5, 1.0]


async def test_late_and_older_plans_leave_the_last_one_until_its_lease_ends(bench: Bench) -> None:
    bench.executor.submit(plan(5, 0.2, 0.5, 1.0, lease_s=0.5))
    await bench.shows(0.2, 0.5, 1.0)
    late = plan(6, 1.0, 1.0, 0.2, lease_s=0.001)
    await asyncio.sleep(0.01)
    bench.executor.submit(late)
    bench.executor.submit(plan(4, 1.0, 1.0, 0.2))
    await asyncio.sleep(0.05 + bench.reports_s)
    await bench.shows(0.2, 0.5, 1.0)
    await asyncio.sleep(0.45)
    await bench.shows(0.0, 0.0, 0.0)


async def test_a_closed_plan_closes_at_once(bench: Bench) -> None:
    late = TimedChange(at_s=now() + 0.02, valve=0, duty=1.0)
    bench.executor.submit(plan(1, 0.2, 0.5, 1.0, changes=(late,)))
    bench.executor.submit(plan(2, 0.0, 0.0, 0.0))
    await bench.shows(0.0, 0.0, 0.0)
    await asyncio.sleep(0.04)
    await bench.shows(0.0, 0.0, 0.0)


async def test_the_stop_closes_and_ends_everything(bench: Bench) -> None:
    late = TimedChange(at_s=now() + 0.02, valve=0, duty=1.0)
    bench.executor.submit(plan(1, 0.2, 0.5, 1.0, changes=(late,)))
    await bench.executor.stop()
    await bench.shows(0.0, 0.0, 0.0)
    await asyncio.sleep(0.04)
    bench.executor.submit(plan(2, 1.0, 1.0, 1.0))
    await bench.executor.stop()
    await bench.shows(0.0, 0.0, 0.0)


async def test_a_healthy_executor_has_no_fault(bench: Bench) -> None:
    assert bench.executor.fault is None
