"""Changes of the valves, time of day, link statistics: what lies beside the packed rows."""

from __future__ import annotations

import asyncio
import math
from itertools import pairwise
from pathlib import Path

import pytest

from analysis.journals.content import read_journal
from companion.core.types import SprayPlan, TimedChange, UtcReport
from companion.journal.folder import look_at
from companion.journal.journal import Journal
from companion.journal.rows import ValveOrder, ValveRows
from companion.journal.writer import TIMES_MAX, FlightClock
from companion.link.codec import FROM_VEHICLE
from companion.output.engine.wire import Issued
from companion.output.gpio import GpioExecutor
from companion.output.timed import DryRunExecutor
from tests.analysis.test_replay import fly
from tests.builders import setup
from tests.companion.test_journal import decisions, query

UTC_S = 1_774_080_000.0


def plan(
    issued_s: float, duty: tuple[float, ...], *changes: tuple[float, int, float], number: int = 1
) -> SprayPlan:
    return SprayPlan(
        sequence=number,
        issued_s=issued_s,
        duty=duty,
        changes=tuple(TimedChange(at_s=at, valve=valve, duty=d) for at, valve, d in changes),
        lease_until_s=issued_s + 0.3,
    )


# ------------------------------------------------------------------------------- planned changes


def test_a_change_counts_when_its_time_has_come() -> None:
    rows = ValveRows()
    assert rows.take_plan(plan(1.0, (0.0, 0.0), (1.02, 1, 0.5), (1.08, 0, 0.4))) == []
    assert rows.take_plan(plan(1.05, (0.0, 0.5))) == [(1_020_000, None, 1, 500)]


def test_a_change_that_a_newer_plan_has_taken_back_never_happened() -> None:
    rows = ValveRows()
    rows.take_plan(plan(1.0, (0.0,), (1.1, 0, 0.5)))
    assert rows.take_plan(plan(1.05, (0.0,))) == []
    assert rows.end() == []


def test_the_end_of_a_lease_closes() -> None:
    rows = ValveRows()
    assert rows.take_plan(plan(1.0, (0.5,))) == [(1_000_000, None, 0, 500)]
    assert rows.take_plan(plan(2.0, (0.5,))) == [
        (1_300_000, None, 0, 0),
        (2_000_000, None, 0, 500),
    ]
    assert rows.end() == [(2_300_000, None, 0, 0)]


def test_where_orders_are_told_plans_do_not_count() -> None:
    rows = ValveRows(from_orders=True)
    assert rows.take_plan(plan(1.0, (0.5,))) == []
    given = ValveOrder(valve=0, duty=0.5, planned_s=1.0, given_s=1.0004)
    assert rows.take_order(given) == [(1_000_000, 1_000_400, 0, 500)]
    assert rows.take_order(given) == []
    closed = ValveOrder(valve=0, duty=0.0, planned_s=None, given_s=math.inf)
    assert rows.take_order(closed) == [(None, None, 0, 0)]


def test_the_journal_keeps_changes_of_plans_or_orders(tmp_path: Path) -> None:
    with Journal.create(tmp_path, setup=setup()) as journal:
        for decision in decisions(40):
            journal.record_decision(decision)
    rows = query(journal.path, "SELECT planned_us, actual_us, duty_permille FROM valve_changes")
    assert len(rows) >= 2
    assert all(actual is None for _, actual, _ in rows)
    assert rows[-1][2] == 0  # its lease ended
    assert read_journal(journal.path).meta["valve_changes"] == "plans"
    with Journal.create(tmp_path, setup=setup()) as journal:
        journal.expect_orders()
        for decision in decisions(40):
            journal.record_decision(decision)
        journal.record_order(1, 0.25, 10.0, 10.001)
    assert query(journal.path, "SELECT * FROM valve_changes") == [
        (1, 10_000_000, 10_001_000, 1, 250)
    ]
    assert read_journal(journal.path).meta["valve_changes"] == "orders"
    assert read_journal(journal.path).lost == 0


# ------------------------------------------------------------------------------- orders as given


async def test_an_executor_tells_when_it_gave_an_order_and_when_it_was_planned() -> None:
    told: list[tuple[int, float, float | None, float]] = []
    executor = DryRunExecutor(2)
    executor.on_order = lambda *order: told.append(order)
    await executor.start()
    now_s = asyncio.get_running_loop().time()
    executor.submit(plan(now_s, (0.0, 0.5), (now_s + 0.02, 0, 0.4)))
    await asyncio.sleep(0.4)
    executor.submit(plan(now_s + 0.4, (0.3, 0.0), number=2))
    await executor.stop()
    orders = [order for order in told if order[3] > now_s]
    assert [(valve, duty) for valve, duty, _, _ in orders] == [
        (1, 0.5),
        (0, 0.4),
        (0, 0.0),
        (1, 0.0),
        (0, 0.3),
        (0, 0.0),
    ]
    planned = [order[2] for order in orders]
    lease_s = now_s + 0.3
    assert planned == [now_s, now_s + 0.02, lease_s, lease_s, now_s + 0.4, None]
    assert all(given_s >= (at_s or now_s) - 1e-4 for _, _, at_s, given_s in orders)


def test_the_engine_tells_of_the_first_edge_with_another_duty() -> None:
    told: list[tuple[int, float, float | None, float]] = []
    executor = GpioExecutor.__new__(GpioExecutor)
    executor._count, executor._told_duty = 2, {}
    edges = [
        Issued(1.0, 1.0001, 0, True, 0.5),
        Issued(1.04, 1.0402, 0, False, 0.5),
        Issued(1.09, 1.0903, 0, True, 0.5),
        Issued(1.10, 1.1001, 2, True, 1.0),  # the return valve
        Issued(1.13, 1.1302, 0, False, 0.0),
    ]
    executor._tell_orders(lambda *order: told.append(order), edges)
    assert told == [(0, 0.5, 1.0, 1.0001), (0, 0.0, 1.13, 1.1302)]


# ------------------------------------------------------------------------------------ time of day


def test_the_autopilot_s_time_counts_once_it_is_known() -> None:
    clock = FlightClock(-5.0)
    assert clock.source == "computer"
    said = clock.take(UtcReport(received_s=10.0, utc_s=UTC_S))
    assert said is not None
    assert "2026-03-21T08:00:00" in said
    assert (clock.source, clock.known_s) == ("autopilot", 10.0)
    assert clock.text(12.5) == "2026-03-21T08:00:02.500Z"


def test_of_messages_on_their_way_the_fastest_counts_and_a_jump_is_told() -> None:
    clock = FlightClock(0.0)
    clock.take(UtcReport(received_s=10.0, utc_s=UTC_S))
    assert clock.take(UtcReport(received_s=11.2, utc_s=UTC_S + 1.0)) is None
    assert clock.offset_s == UTC_S - 10.0
    assert clock.take(UtcReport(received_s=11.9, utc_s=UTC_S + 2.0)) is None
    assert clock.offset_s == pytest.approx(UTC_S - 9.9, abs=1e-6)
    said = clock.take(UtcReport(received_s=13.0, utc_s=UTC_S + 103.0))
    assert said is not None
    assert "jumped by +99.9 s" in said
    assert clock.take(UtcReport(received_s=14.0, utc_s=math.nan)) is None


WEEK_S = 604_800.0


def told(clock: FlightClock, *, seconds: range, off_s: float = 0.0) -> list[str]:
    said = [clock.take(UtcReport(received_s=s, utc_s=UTC_S + s + off_s)) for s in seconds]
    return [text for text in said if text is not None]


def test_a_week_that_rolls_back_at_the_end_does_not_date_the_flight() -> None:
    clock = FlightClock(0.0)
    told(clock, seconds=range(600))
    said = told(clock, seconds=range(600, 700), off_s=-WEEK_S)
    assert said == ["the autopilot's time of day jumped by -604800.0 s"]
    assert clock.offset_s == UTC_S
    assert clock.source == "autopilot-jumped"


def test_a_time_that_is_put_right_early_dates_the_flight() -> None:
    clock = FlightClock(0.0)
    told(clock, seconds=range(5), off_s=-WEEK_S)
    assert clock.offset_s == UTC_S - WEEK_S
    said = told(clock, seconds=range(5, 100))
    assert "jumped by +604800.0 s" in said[0]
    assert said[1].startswith("most of the autopilot's reports say 2026-03-21")
    assert (clock.offset_s, clock.source, clock.known_s) == (UTC_S, "autopilot-jumped", 10)


def test_times_without_end_are_counted_within_bounds() -> None:
    clock = FlightClock(0.0)
    told(clock, seconds=range(20))
    for number in range(1, 500):
        told(clock, seconds=range(20, 22), off_s=-100.0 * number)
    assert clock.offset_s == UTC_S
    assert len(clock._times) == TIMES_MAX


@pytest.mark.parametrize("wrong", [range(3), range(8, 11)])
def test_rows_of_a_flight_whose_time_jumped_have_the_time_that_counts(
    wrong: range, tmp_path: Path
) -> None:
    with Journal.create(tmp_path, setup=setup(), started_s=9.0) as journal:
        for number, decision in enumerate(decisions(110)):
            if number % 10 == 0:
                off_s = -WEEK_S if number // 10 in wrong else 0.0
                at_s = decision.now_s
                journal.record_input(UtcReport(received_s=at_s, utc_s=UTC_S + at_s + off_s))
            journal.record_decision(decision)
    for table in ("applied", "events"):
        ((first, last),) = query(journal.path, f"SELECT min(time), max(time) FROM {table}")
        assert first.startswith("2026-03-21") and last.startswith("2026-03-21"), table
    assert look_at(journal.path).utc_source == "autopilot-jumped"


def test_what_was_written_before_gets_the_autopilot_s_time_at_the_end(tmp_path: Path) -> None:
    with Journal.create(tmp_path, setup=setup(), started_s=9.0) as journal:
        journal.record_event(9.0, "start", "")
        for decision in decisions(30):
            journal.record_decision(decision)
        journal.record_input(UtcReport(received_s=11.5, utc_s=UTC_S + 0.5))
    times = query(journal.path, "SELECT min(time), max(time) FROM applied")
    assert times == [("2026-03-21T07:59:59.000Z", "2026-03-21T08:00:00.400Z")]
    assert query(journal.path, "SELECT time, kind FROM events")[0] == (
        "2026-03-21T07:59:58.000Z",
        "start",
    )
    flight = look_at(journal.path)
    assert (flight.utc_source, flight.started_utc_s) == ("autopilot", UTC_S - 2.0)


class SystemTime:
    def __init__(self, utc_s: float) -> None:
        self.time_unix_usec = round(utc_s * 1e6)
        self.time_boot_ms = 12_500


@pytest.mark.parametrize("utc_s", [0.0, 1_500_000_000.0, 5e9])
def test_a_time_that_is_none_yet_is_no_report(utc_s: float) -> None:
    assert FROM_VEHICLE[2](SystemTime(utc_s), 1.0) is None


def test_a_time_of_satellites_is_a_report() -> None:
    assert FROM_VEHICLE[2](SystemTime(UTC_S), 1.0) == UtcReport(
        received_s=1.0, utc_s=UTC_S, boot_s=12.5
    )


# ---------------------------------------------------------------------------------- the rest


def test_how_the_link_does_is_kept(tmp_path: Path) -> None:
    with Journal.create(tmp_path, setup=setup()) as journal:
        journal.record_link(3.0, {"bytes_in": 10, "round_trip_s": 0.25, "unknown": 1.0})
    sql = "SELECT time_s, bytes_in, round_trip_s, lost_percent FROM link_stats"
    assert query(journal.path, sql) == [(3.0, 10, 0.25, None)]


def test_the_layer_applied_has_ten_rows_a_second_and_every_change_of_the_reasons(
    tmp_path: Path,
) -> None:
    path, made = fly(tmp_path, 160)
    rows = query(path, "SELECT time_s, inhibits FROM applied")
    assert 75 <= len(rows) <= 95
    changes = [
        (b.now_s, " ".join(sorted(b.inhibits)))
        for a, b in pairwise(made)
        if (a.inhibits, a.sprayer) != (b.inhibits, b.sprayer)
    ]
    assert changes
    assert set(changes) <= set(rows)
