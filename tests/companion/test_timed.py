"""The timer that all executors share, on a clock of this test's own: lease, order, lateness."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from types import SimpleNamespace

import pytest

from companion.core.types import DriveChange, DrivePlan, SprayPlan, TimedChange
from companion.output import timed
from companion.output.timed import Lateness, TimedExecutor, next_event_s


class Loop:
    """A clock and the timers set on it; one that wakes late does so by `late_s`."""

    def __init__(self) -> None:
        self.now_s, self.late_s = 10.0, 0.0
        self.timers: list[tuple[float, Callable[[], None], SimpleNamespace]] = []

    def time(self) -> float:
        return self.now_s

    def call_at(self, at_s: float, do: Callable[[], None]) -> SimpleNamespace:
        handle = SimpleNamespace(cancelled=False)
        handle.cancel = lambda: setattr(handle, "cancelled", True)
        self.timers.append((at_s, do, handle))
        return handle

    def waiting(self) -> list[float]:
        return sorted(at_s for at_s, _, handle in self.timers if not handle.cancelled)

    def run(self, until_s: float) -> None:
        while self.waiting() and self.waiting()[0] + self.late_s <= until_s:
            first = min((t for t in self.timers if not t[2].cancelled), key=lambda t: t[0])
            self.timers.remove(first)
            self.now_s = max(first[0] + self.late_s, self.now_s)
            first[1]()
        self.now_s = until_s


class Outputs(TimedExecutor):
    """Two valves that note what they are told, and when."""

    def __init__(
        self, loop: Loop, *, has_return: bool = False, gathers: bool = False, drives: int = 0
    ) -> None:
        super().__init__(2, has_return=has_return, drive_count=drives)
        self.loop, self.gathers = loop, gathers
        self.given: list[tuple[float, int, float]] = []
        self.have: dict[int, float] = {}
        self.flushed = 0
        self.trouble: str | None = None
        self.own_s: float | None = None
        self.own_done: list[float] = []

    @property
    def fault(self) -> str | None:
        return self.trouble

    def _apply(self, valve: int, duty: float) -> bool:
        is_news = self.have.get(valve) != duty
        self.have[valve] = duty
        if is_news:
            self.given.append((round(self.loop.now_s, 5), valve, duty))
        return is_news

    def _flush(self) -> bool:
        self.flushed += 1
        if self.gathers:
            self.loop.now_s += 0.5
        return self.gathers

    def _next_own_s(self) -> float | None:
        return self.own_s

    def _do_own(self, now_s: float) -> None:
        self.own_done.append(now_s)
        self.own_s = None


@pytest.fixture
def loop(monkeypatch: pytest.MonkeyPatch) -> Loop:
    loop = Loop()
    monkeypatch.setattr(timed, "asyncio", SimpleNamespace(get_running_loop=lambda: loop))
    return loop


def plan(
    sequence: int,
    duty: tuple[float, ...] = (0.0, 0.0),
    *changes: tuple[float, int, float],
    lease_s: float = 10.3,
    drives: tuple[DrivePlan, ...] = (),
) -> SprayPlan:
    return SprayPlan(
        sequence=sequence,
        issued_s=10.0,
        duty=duty,
        changes=tuple(TimedChange(at_s=a, valve=v, duty=d) for a, v, d in changes),
        lease_until_s=lease_s,
        drives=drives,
    )


def started(loop: Loop, *, has_return: bool = False, gathers: bool = False) -> Outputs:
    outputs = Outputs(loop, has_return=has_return, gathers=gathers)
    asyncio.run(outputs.start())
    return outputs


def test_duties_follow_the_changes_up_to_and_with_now_until_the_lease_ends() -> None:
    given = plan(1, (0.2, 0.3), (10.1, 0, 0.5), (10.2, 1, 0.0), (10.25, 0, 0.7))
    assert given.duty_at(10.0999) == (0.2, 0.3)
    assert given.duty_at(10.1) == (0.5, 0.3)
    assert given.duty_at(10.2) == (0.5, 0.0)
    assert given.duty_at(10.2999) == (0.7, 0.0)
    assert given.duty_at(10.3) == (0.0, 0.0)
    assert given.duty_at(float("nan")) == (0.0, 0.0)


def test_the_next_event_is_the_next_change_or_the_end_of_the_lease() -> None:
    given = plan(1, (0.2, 0.3), (10.1, 0, 0.5), (10.4, 1, 0.0))
    assert next_event_s(given, 10.0) == 10.1
    assert next_event_s(given, 10.1) == 10.3
    assert next_event_s(given, 10.2999) == 10.3
    assert next_event_s(given, 10.3) is None


def test_lateness_is_counted_and_ranked() -> None:
    lateness = Lateness()
    assert lateness.quantile_s(0.5) is None
    for late_s in (0.3, 0.1, 0.2, 0.0):
        lateness.add(late_s)
    assert (lateness.count, lateness.worst_s) == (4, 0.3)
    assert [lateness.quantile_s(q) for q in (0.0, 0.25, 0.5, 0.99, 1.0)] == [
        0.0, 0.1, 0.2, 0.3, 0.3,
    ]  # fmt: skip
    for _ in range(5000):
        lateness.add(0.05)
    assert (lateness.count, lateness.worst_s, len(lateness.recent_s)) == (5004, 0.3, 4096)
    assert lateness.quantile_s(1.0) == 0.05


def test_a_start_closes_and_a_plan_before_it_is_nothing(loop: Loop) -> None:
    outputs = Outputs(loop)
    outputs.submit(plan(1, (1.0, 1.0)))
    assert outputs.given == []
    asyncio.run(outputs.start())
    assert outputs.given == [(10.0, 0, 0.0), (10.0, 1, 0.0)]
    assert outputs.flushed == 1
    assert loop.waiting() == []
    assert outputs.lease_end_count == 0
    assert outputs.lateness.count == 0


def test_the_lease_closes_at_its_end_and_is_counted_once(loop: Loop) -> None:
    outputs = started(loop)
    outputs.submit(plan(1, (0.5, 0.0)))
    loop.run(10.2999)
    assert outputs.have == {0: 0.5, 1: 0.0}
    assert outputs.lease_end_count == 0
    loop.run(20.0)
    assert outputs.given[-1] == (10.3, 0, 0.0)
    assert outputs.lease_end_count == 1
    assert loop.waiting() == []
    outputs.submit(plan(2, (0.5, 0.0), lease_s=20.3))
    loop.run(21.0)
    assert outputs.lease_end_count == 2


def test_the_end_of_a_closed_plan_is_no_lease_that_ended(loop: Loop) -> None:
    outputs = started(loop)
    outputs.submit(plan(1))
    loop.run(20.0)
    assert outputs.lease_end_count == 0


def test_a_renewed_lease_has_one_timer_and_the_newest_end(loop: Loop) -> None:
    outputs = started(loop)
    outputs.submit(plan(1, (0.5, 0.0)))
    outputs.submit(plan(2, (0.5, 0.0), lease_s=10.6))
    assert loop.waiting() == [10.6]
    loop.run(10.5)
    assert outputs.have[0] == 0.5
    loop.run(10.7)
    assert outputs.have[0] == 0.0


def test_a_plan_that_comes_after_its_lease_is_refused_and_the_last_one_goes_on(
    loop: Loop, caplog: pytest.LogCaptureFixture
) -> None:
    outputs = started(loop)
    outputs.submit(plan(1, (0.5, 0.0), lease_s=12.0))
    for late_s in (10.3, 10.4):
        loop.now_s = late_s
        outputs.submit(plan(2, (1.0, 1.0)))
        assert outputs.have == {0: 0.5, 1: 0.0}
        assert loop.waiting() == [12.0]
    assert outputs.rejected_count == 2
    assert [record.getMessage()[:14] for record in caplog.records] == ["refused a plan"]
    # What was refused has no place in the order of plans.
    outputs.submit(plan(2, (0.6, 0.0), lease_s=12.0))
    assert outputs.have == {0: 0.6, 1: 0.0}
    loop.run(12.0)
    assert outputs.have == {0: 0.0, 1: 0.0}
    assert (outputs.rejected_count, outputs.lease_end_count) == (2, 1)


def test_a_late_plan_that_opens_later_or_moves_a_drive_is_refused_too(loop: Loop) -> None:
    outputs = Outputs(loop, drives=1)
    asyncio.run(outputs.start())
    outputs.submit(plan(1, (0.5, 0.0), lease_s=12.0))
    loop.now_s = 10.4
    outputs.submit(plan(2, (0.0, 0.0), (10.2, 1, 0.4)))
    outputs.submit(plan(2, drives=(DrivePlan(fraction=0.6),)))
    assert outputs.rejected_count == 2
    assert outputs.have == {0: 0.5, 1: 0.0, 2: 0.0}


def test_a_plan_that_closes_is_taken_however_late_and_however_old(loop: Loop) -> None:
    outputs = started(loop, has_return=True)
    outputs.submit(plan(5, (0.5, 0.0), lease_s=12.0))
    loop.run(10.4)
    assert outputs.have == {0: 0.5, 1: 0.0, 2: 0.0}
    outputs.submit(plan(6))
    assert outputs.have == {0: 0.0, 1: 0.0, 2: 1.0}
    outputs.submit(plan(7, (0.5, 0.0), lease_s=12.0))
    outputs.submit(plan(4, lease_s=12.0))
    assert outputs.have == {0: 0.0, 1: 0.0, 2: 1.0}
    assert outputs.rejected_count == 0
    # It has not set the order of plans back.
    outputs.submit(plan(7, (1.0, 0.0), lease_s=12.0))
    assert outputs.have == {0: 0.0, 1: 0.0, 2: 1.0}
    assert outputs.rejected_count == 1


def test_a_plan_for_others_is_refused(loop: Loop) -> None:
    outputs = started(loop)
    with pytest.raises(ValueError, match="plan for 1 valves, executor has 2"):
        outputs.submit(plan(1, (1.0,)))


def test_changes_come_at_their_time_and_late_ones_are_measured(loop: Loop) -> None:
    outputs = started(loop)
    outputs.submit(plan(1, (0.5, 0.0), (10.1, 1, 0.4), (10.2, 0, 0.6)))
    loop.run(10.15)
    assert outputs.given[-1] == (10.1, 1, 0.4)
    assert (outputs.lateness.count, outputs.lateness.worst_s) == (1, 0.0)
    loop.late_s = 0.01
    loop.run(10.25)
    assert outputs.given[-1] == (10.21, 0, 0.6)
    assert outputs.lateness.count == 2
    assert outputs.lateness.worst_s == pytest.approx(0.01)


def test_a_timer_that_wakes_a_hair_early_is_on_time(loop: Loop) -> None:
    outputs = started(loop)
    outputs.submit(plan(1, (0.5, 0.0), (10.1, 1, 0.4)))
    loop.late_s = -0.9e-6
    loop.run(10.29)
    assert outputs.have == {0: 0.5, 1: 0.4}
    assert loop.waiting() == [10.3]
    loop.run(10.4)
    assert outputs.have == {0: 0.0, 1: 0.0}
    assert outputs.lease_end_count == 1


def test_what_a_replaced_plan_had_ordered_is_measured_by_it(loop: Loop) -> None:
    outputs = started(loop)
    outputs.submit(plan(1, (0.5, 0.0), (10.1, 1, 0.4)))
    loop.now_s = 10.12
    outputs.submit(plan(2, (0.5, 0.4)))
    assert outputs.lateness.count == 1
    assert outputs.lateness.worst_s == pytest.approx(0.02)


def test_what_is_gathered_counts_when_it_was_sent(loop: Loop) -> None:
    outputs = started(loop, gathers=True)
    outputs.submit(plan(1, (0.5, 0.0), (loop.now_s + 0.6, 1, 0.4), lease_s=20.0))
    loop.run(11.2)
    assert outputs.lateness.worst_s == pytest.approx(0.5)


def test_a_fault_closes_whatever_the_plan_says(loop: Loop) -> None:
    outputs = started(loop, has_return=True)
    outputs.submit(plan(1, (0.5, 0.5), (10.1, 0, 0.6)))
    loop.run(10.05)
    assert outputs.have == {0: 0.5, 1: 0.5, 2: 0.0}
    outputs.trouble = "a wire is off"
    loop.run(10.15)
    assert outputs.have == {0: 0.0, 1: 0.0, 2: 1.0}
    assert [valve for at_s, valve, _ in outputs.given if at_s == 10.1] == [2, 0, 1]


def test_the_return_valve_leads_when_it_opens_and_follows_when_it_shuts(loop: Loop) -> None:
    outputs = started(loop, has_return=True)
    assert outputs.given == [(10.0, 2, 1.0), (10.0, 0, 0.0), (10.0, 1, 0.0)]
    outputs.submit(plan(1, (0.5, 0.0), (10.2, 0, 0.0)))
    loop.run(10.4)
    assert outputs.given[3:] == [
        (10.0, 0, 0.5), (10.02, 2, 0.0), (10.175, 2, 1.0), (10.2, 0, 0.0),
    ]  # fmt: skip


def test_a_stop_closes_the_return_first_and_sets_no_timer(loop: Loop) -> None:
    outputs = started(loop, has_return=True)
    outputs.submit(plan(1, (0.5, 0.5)))
    loop.run(10.1)
    flushed = outputs.flushed
    asyncio.run(outputs.stop())
    assert outputs.given[-3:] == [(10.1, 2, 1.0), (10.1, 0, 0.0), (10.1, 1, 0.0)]
    assert outputs.flushed == flushed + 1
    assert loop.waiting() == []
    outputs.submit(plan(2, (1.0, 1.0)))
    assert outputs.have == {0: 0.0, 1: 0.0, 2: 1.0}


def test_a_restart_knows_no_old_plan(loop: Loop) -> None:
    outputs = started(loop, has_return=True)
    outputs.submit(plan(7, (0.5, 0.5), lease_s=30.0))
    asyncio.run(outputs.stop())
    asyncio.run(outputs.start())
    assert loop.waiting() == []
    outputs.submit(plan(1, (0.5, 0.0), lease_s=30.0))
    assert outputs.have[0] == 0.5


def test_an_executor_is_woken_for_its_own_ends(loop: Loop) -> None:
    outputs = started(loop)
    outputs.own_s = 10.05
    outputs.submit(plan(1, (0.5, 0.0)))
    assert loop.waiting() == [10.05]
    loop.run(10.1)
    assert outputs.own_done == [10.05]
    assert outputs.have[0] == 0.5
    assert loop.waiting() == [10.3]


def test_drives_move_behind_the_valves_and_stop_ahead_of_them(loop: Loop) -> None:
    outputs = Outputs(loop, has_return=True, drives=2)
    asyncio.run(outputs.start())
    assert [valve for _, valve, _ in outputs.given] == [2, 3, 4, 0, 1]
    pump = DrivePlan(fraction=0.6, changes=(DriveChange(at_s=10.1, fraction=0.7),))
    still = DrivePlan(fraction=0.0)
    outputs.given.clear()
    outputs.submit(plan(1, (0.5, 0.0), drives=(pump, still)))
    assert outputs.given == [(10.0, 0, 0.5), (10.0, 3, 0.6)]
    loop.run(10.15)
    assert outputs.given[-1] == (10.1, 3, 0.7)
    outputs.given.clear()
    loop.run(10.4)
    assert [(valve, value) for at_s, valve, value in outputs.given if at_s == 10.3] == [
        (3, 0.0), (0, 0.0),
    ]  # fmt: skip
    with pytest.raises(ValueError, match="plan for 1 drives, executor has 2"):
        outputs.submit(plan(2, (0.5, 0.0), lease_s=11.0, drives=(pump,)))


def test_a_fault_stops_the_drives_and_a_plan_without_drives_too(loop: Loop) -> None:
    outputs = Outputs(loop, drives=1)
    asyncio.run(outputs.start())
    pump = DrivePlan(fraction=0.6)
    outputs.submit(plan(1, (0.5, 0.0), drives=(pump,), lease_s=30.0))
    assert outputs.have == {0: 0.5, 1: 0.0, 2: 0.6}
    outputs.submit(plan(2, (0.5, 0.0), lease_s=30.0))
    assert outputs.have == {0: 0.5, 1: 0.0, 2: 0.0}
    outputs.submit(plan(3, (0.5, 0.0), drives=(pump,), lease_s=30.0))
    outputs.trouble = "a wire is off"
    outputs.submit(plan(4, (0.5, 0.0), drives=(pump,), lease_s=30.0))
    assert outputs.have == {0: 0.0, 1: 0.0, 2: 0.0}
