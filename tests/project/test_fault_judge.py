"""The judge of the fault campaign, on flights that are written down by hand."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from sitl.stub.protocol import Speaker, dialect
from tests.bench.faults import __main__ as bench
from tests.bench.faults.__main__ import Campaign, main
from tests.bench.faults.cases import PROCESS_KINDS, Case, Draw, Kind, Output, campaign, cases
from tests.bench.faults.chip import Act, Chip, ChipLines, Row
from tests.bench.faults.flight import NotFlownError
from tests.bench.faults.judge import Verdict, judge, outside_ml
from tests.bench.faults.levels import (
    Level,
    Pulse,
    behind_monostable,
    levels_of,
    openings_of,
    openings_of_pulses,
)
from tests.bench.faults.place import ORIGIN, SPEED_M_S, Pass
from tests.bench.faults.record import Opening, Record, Struck
from tests.bench.faults.report import page, result, write_page
from tests.bench.faults.wire import COMMAND, HEARTBEAT, LANDED, POSITION, Sent, fields_of, moved

FAULT_S, UNTIL_S = 104.0, 106.0


def sent(at_s: float, message: int, *fields: float, made_s: float | None = None) -> Sent:
    return Sent(
        at_s=at_s, made_s=at_s if made_s is None else made_s, message=message, fields=fields
    )


def position(at_s: float, *, path: Pass, late_s: float = 0.0, **changes: float) -> Sent:
    pose = path.pose_at(at_s - late_s)
    latitude, longitude = ORIGIN.to_geographic(pose.east_m, 0.0)
    values = {
        "boot_s": at_s - late_s,
        "latitude": round(float(latitude), 7),
        "longitude": round(float(longitude), 7),
        "north_m_s": 0.0,
        "east_m_s": pose.velocity_east_m_s,
        **changes,
    }
    return sent(at_s, POSITION, *values.values(), made_s=at_s - late_s)


def draw(kind: Kind, output: Output = "gpio", *, leaves_s: float | None = None) -> Draw:
    return Draw(
        number=0,
        seed=1,
        case=Case(kind=kind, output=output),
        after_s=1.0,
        apart_s=0.0,
        engine_first=True,
        leaves_s=leaves_s,
        share=0.5,
        second_share=0.5,
    )


def healthy(path: Pass, until_s: float = UNTIL_S) -> list[Sent]:
    """Return what a vehicle says that has nothing wrong with it."""
    steps = range(round((until_s - 100.0) / 0.05))
    found = [position(100.0 + 0.05 * step, path=path) for step in steps]
    for second in range(100, math.ceil(until_s)):
        found.append(sent(float(second), HEARTBEAT, 1.0, 3.0))
        found.append(sent(float(second), LANDED, 2.0))
    found.append(sent(100.0, COMMAND, 216.0, 1.0))
    return sorted(found, key=lambda one: one.at_s)


def record(kind: Kind, openings: Sequence[Opening], **changes: Any) -> Record:
    """Return a flight whose fault is at 104 s; over the field since 103 s."""
    path = Pass(start_s=100.0)
    path = Pass(start_s=203.0 - path.reaches_s(0.0))
    values: dict[str, Any] = {
        "draw": draw(kind),
        "path": path,
        "enabled_s": 100.0,
        "fault_s": FAULT_S,
        "until_s": UNTIL_S,
        "sent": healthy(path),
        "struck": (),
        "openings": tuple(openings),
        "own": tuple(openings),
        "late_s": 0.001,
        "waited_s": 0.002,
        "exit_code": 0,
        "ended_s": 0.1,
        "lost_rows": 0,
        "errors": "",
        **changes,
    }
    return Record(**values)


def told(message: int, *fields: float) -> list[Sent]:
    path = record(Kind.MODE, ()).path
    return sorted([*healthy(path), sent(FAULT_S, message, *fields)], key=lambda one: one.at_s)


SPRAYS_UNTIL = [0.1, 0.16]


@pytest.mark.parametrize(
    ("kind", "message", "fields"),
    [
        (Kind.DISABLED, COMMAND, (216.0, 0.0)),
        (Kind.DISARMED, HEARTBEAT, (0.0, 3.0)),
        (Kind.MODE, HEARTBEAT, (1.0, 5.0)),
        (Kind.LANDING, LANDED, (4.0,)),
    ],
)
def test_what_is_told_closes_within_its_limit(
    kind: Kind, message: int, fields: tuple[float, ...]
) -> None:
    said = told(message, *fields)
    good = judge(record(kind, [Opening(0, 103.5, FAULT_S + 0.14)], sent=said))
    assert good.wrong == ()
    assert good.closed_s == pytest.approx(0.14)
    assert (good.was_open, good.ml) == (True, 0.0)
    bad = judge(record(kind, [Opening(0, 103.5, FAULT_S + 0.16)], sent=said))
    assert len(bad.wrong) == 1
    assert "limit 0.15 s" in bad.wrong[0]
    assert judge(record(kind, [Opening(0, 103.5, 103.9)], sent=said)).closed_s == 0.0


def test_what_closed_must_not_open_again() -> None:
    again = [Opening(0, 103.5, FAULT_S + 0.01), Opening(2, FAULT_S + 1.0, FAULT_S + 1.01)]
    assert judge(record(Kind.DISABLED, again, sent=told(COMMAND, 216.0, 0.0))).wrong


def test_a_flight_without_a_reason_and_one_open_too_early_are_wrong() -> None:
    assert "nothing that happened" in judge(record(Kind.ABSENT, ())).wrong[0]
    early = [Opening(0, 99.0, 103.9)]
    assert "open before it was enabled" in judge(record(Kind.ABSENT, early)).wrong


def without(message: int, path: Pass) -> list[Sent]:
    return [one for one in healthy(path) if one.message != message or one.at_s < FAULT_S]


@pytest.mark.parametrize(
    ("kind", "message", "at_s"),
    [
        (Kind.ABSENT, POSITION, FAULT_S - 0.05 + 0.8),
        (Kind.NO_HEARTBEAT, HEARTBEAT, FAULT_S - 1.0 + 2.5),
    ],
)
def test_what_is_missing_closes_a_tenth_after_it_is_too_old(
    kind: Kind, message: int, at_s: float
) -> None:
    path = record(kind, ()).path
    said = without(message, path)
    good = judge(record(kind, [Opening(0, 103.5, at_s + 0.09)], sent=said))
    assert good.wrong == ()
    assert good.closed_s == pytest.approx(0.09)
    assert judge(record(kind, [Opening(0, 103.5, at_s + 0.11)], sent=said)).wrong
    # Sooner is as good, and counts as nothing.
    assert judge(record(kind, [Opening(0, 103.5, FAULT_S)], sent=said)).closed_s == 0.0


def test_positions_that_come_late_are_old_though_they_come() -> None:
    path = record(Kind.STALE, ()).path
    late = [position(FAULT_S + 1.2 + 0.05 * n, path=path, late_s=1.2) for n in range(16)]
    said = [*without(POSITION, path), *late]
    closed_s = FAULT_S - 0.05 + 0.9
    assert judge(record(Kind.STALE, [Opening(0, 103.5, closed_s - 0.01)], sent=said)).wrong == ()
    again = [Opening(0, FAULT_S + 1.5, FAULT_S + 1.51)]
    assert judge(record(Kind.STALE, again, sent=said)).wrong


@pytest.mark.parametrize(
    ("kind", "changes"),
    [
        (Kind.ZERO, {"latitude": 0.0, "longitude": 0.0}),
        (Kind.FROZEN, {"east_m_s": 0.0}),
        (Kind.JUMP, {"latitude": 36.0001}),
    ],
)
def test_a_position_that_cannot_be_true_closes(kind: Kind, changes: dict[str, float]) -> None:
    path = record(kind, ()).path
    wrong = [position(FAULT_S + 0.05 * n, path=path, **changes) for n in range(1, 20)]
    said = [*without(POSITION, path), position(FAULT_S, path=path), *wrong]
    at_s = FAULT_S + 0.05
    good = judge(record(kind, [Opening(0, 103.5, at_s + 0.09)], sent=said))
    assert good.wrong == ()
    assert good.closed_s == pytest.approx(0.09)
    assert judge(record(kind, [Opening(0, 103.5, at_s + 0.12)], sent=said)).wrong


def test_a_place_that_stays_while_the_velocity_goes_on_is_frozen() -> None:
    path = record(Kind.STUCK, ()).path
    first = position(FAULT_S, path=path)
    place = {"latitude": first.fields[1], "longitude": first.fields[2]}
    stuck = [position(FAULT_S + 0.05 * n, path=path, **place) for n in range(20)]
    said = [*without(POSITION, path), *stuck]
    good = judge(record(Kind.STUCK, [Opening(0, 103.5, FAULT_S + 0.14)], sent=said))
    assert good.wrong == ()
    assert judge(record(Kind.STUCK, [Opening(0, 103.5, FAULT_S + 0.17)], sent=said)).wrong


@pytest.mark.parametrize(("output", "limit_s"), [("gpio", 0.35), ("script", 0.45)])
def test_a_signal_closes_within_the_limit_of_its_output(output: Output, limit_s: float) -> None:
    changes: dict[str, Any] = {
        "draw": draw(Kind.KILL_COMPANION, output),
        "struck": [Struck(FAULT_S, "SIGKILL"), Struck(FAULT_S + 9.0, "SIGKILL")],
        "exit_code": -9,
        "ended_s": None,
    }
    for late_s, wrong in ((-0.01, 0), (0.01, 1)):
        openings = [Opening(0, 103.5, FAULT_S + limit_s + late_s, 1.0, False)]
        verdict = judge(record(Kind.KILL_COMPANION, openings, **changes))
        assert len(verdict.wrong) == wrong
        assert verdict.limit_s == limit_s


def test_the_monostable_counts_only_where_nothing_else_can_close() -> None:
    for_ever, cut = Opening(0, 103.5, UNTIL_S, 1.0, False), Opening(0, 103.5, FAULT_S + 0.3)
    changes: dict[str, Any] = {
        "own": [for_ever],
        "openings": [cut],
        "struck": [Struck(FAULT_S, "it")],
        "exit_code": -9,
        "ended_s": None,
    }
    assert judge(replace(record(Kind.STOP_BOTH, ()), **changes)).wrong == ()
    assert judge(replace(record(Kind.STOP_COMPANION, ()), **changes)).wrong


def test_a_companion_that_ends_badly_is_wrong() -> None:
    said = told(COMMAND, 216.0, 0.0)
    for changes, words in (
        ({"exit_code": 1}, "ended with 1"),
        ({"ended_s": None}, "ended by itself"),
        ({"errors": "Traceback (most recent\nit"}, "traceback: it"),
        ({"engine_left": True}, "lives on"),
    ):
        verdict = judge(record(Kind.DISABLED, (), sent=said, **changes))
        assert words in "; ".join(verdict.wrong)


def test_a_full_disk_costs_rows_and_not_the_spraying() -> None:
    said = told(COMMAND, 216.0, 0.0)
    said = [*said[:-1], sent(FAULT_S + 1.5, COMMAND, 216.0, 0.0)]
    said = [one for one in said if one.fields != (216.0, 0.0) or one.at_s > FAULT_S + 1.0]
    sprays = [Opening(0, 103.5, FAULT_S + 1.5)]
    good = judge(record(Kind.DISK_FULL, sprays, sent=said, lost_rows=9))
    assert good.wrong == ()
    assert "no row was lost" in judge(record(Kind.DISK_FULL, sprays, sent=said)).wrong[0]
    stops = [Opening(0, 103.5, FAULT_S + 0.2)]
    assert "ended the spraying" in str(
        judge(record(Kind.DISK_FULL, stops, sent=said, lost_rows=9)).wrong
    )


def standstill(kind: Kind, stands_s: float, opens_s: float, output: Output = "gpio") -> Record:
    """Return a flight whose process stands from 104 s on; something opens `opens_s` after that."""
    until_s = FAULT_S + stands_s + 3.5
    path = record(kind, ()).path
    again = Opening(1, FAULT_S + stands_s + opens_s, FAULT_S + stands_s + opens_s + 0.05)
    what = "engine" if kind is Kind.CONT_ENGINE else "companion"
    return record(
        kind,
        [Opening(0, 103.5, FAULT_S + 0.2), again],
        draw=replace(draw(kind, output), share=math.log(stands_s) / math.log(8.0)),
        sent=healthy(path, until_s),
        until_s=until_s,
        struck=(
            Struck(FAULT_S, f"SIGSTOP {what}"),
            Struck(FAULT_S + stands_s, f"SIGCONT {what}"),
        ),
    )


def test_who_goes_on_after_a_stop_opens_with_the_fifth_fresh_position() -> None:
    kind = Kind.CONT_COMPANION
    assert judge(standstill(kind, 1.5, 0.26)).wrong == ()
    assert "SIGSTOP" in judge(standstill(kind, 1.5, 0.0)).wrong[0]
    assert judge(standstill(kind, 1.5, 0.19)).wrong
    assert judge(standstill(Kind.CONT_BOTH, 1.5, 0.19)).wrong


def test_after_a_long_stop_nothing_opens_and_nothing_after_an_engine_s() -> None:
    assert judge(standstill(Kind.CONT_COMPANION, 2.2, 3.0)).wrong
    assert judge(standstill(Kind.CONT_ENGINE, 1.5, 1.0)).wrong


def test_what_stood_open_during_a_stop_was_ordered_by_nobody() -> None:
    flight = standstill(Kind.CONT_COMPANION, 6.0, 1.0, "script")
    left = flight.draw.field_m(SPEED_M_S)
    out_s = flight.path.reaches_s(left)
    one = Opening(0, 103.5, out_s + 1.0)
    assert judge(replace(flight, own=[one], openings=[one])).ml == 0.0
    late = Opening(0, out_s + 0.2, out_s + 0.4)
    assert judge(replace(flight, own=[late], openings=[late])).ml > 1.0


@pytest.mark.parametrize("kind", [Kind.KILL_COMPANION, Kind.STOP_COMPANION])
def test_what_stood_open_until_the_guardian_closed_it_was_ordered_by_nobody(kind: Kind) -> None:
    flight = record(kind, (), draw=draw(kind, "script", leaves_s=0.3))
    out_s = flight.path.reaches_s(flight.draw.field_m(SPEED_M_S))
    one = Opening(0, out_s - 0.6, out_s + 0.2)
    flight = replace(flight, own=[one], openings=[one], struck=[Struck(out_s - 0.3, "it")])
    verdict = judge(flight)
    assert verdict.ml == 0.0
    assert verdict.held_ml > 1.0


def test_a_process_stands_one_to_eight_seconds_and_the_flight_is_watched_longer() -> None:
    flights = list(campaign(60, 1, only="SIGCONT"))
    assert {one.case.output for one in flights} == {"gpio", "script", "dither"}
    assert all(1.0 <= one.stands_s <= 8.0 for one in flights)
    assert min(one.stands_s for one in flights) < 2.0 < max(one.stands_s for one in flights)
    assert all(one.watched_s == one.stands_s + 3.5 for one in flights)
    left = [one.leaves_s - one.stands_s for one in flights if one.leaves_s is not None]
    assert min(left) < 0.0 < max(left)
    assert {one.stands_s for one in campaign(5, 1, only="SIGKILL")} == {0.0}


@pytest.mark.parametrize(("refusals", "flown"), [(0, True), (2, True), (3, False)])
async def test_a_busy_computer_s_flight_is_flown_again_twice(
    monkeypatch: pytest.MonkeyPatch, refusals: int, flown: bool
) -> None:
    tries: list[int] = []

    async def fly(each: Draw) -> Record:
        tries.append(each.number)
        if len(tries) <= refusals:
            raise NotFlownError("it did not spray (Spray: outputs: wakes up 6.8 ms late)")
        return record(Kind.DISABLED, (), sent=told(COMMAND, 216.0, 0.0))

    monkeypatch.setattr(bench, "fly", fly)
    found = Campaign(campaign(1, 1), 1)
    await found.lane()
    assert len(tries) == min(refusals, 2) + 1
    assert (len(found.verdicts), len(found.not_flown)) == ((1, 0) if flown else (0, 1))
    assert len(found.repeated) == (refusals > 0)


async def test_what_else_did_not_fly_is_not_flown_again(monkeypatch: pytest.MonkeyPatch) -> None:
    async def fly(each: Draw) -> Record:
        raise NotFlownError("it did not spray")

    monkeypatch.setattr(bench, "fly", fly)
    found = Campaign(campaign(1, 1), 1)
    await found.lane()
    assert (len(found.not_flown), found.repeated) == (1, set())


def test_what_flows_outside_is_counted_by_the_lags_and_apart_from_what_is_held() -> None:
    flight = record(Kind.KILL_ENGINE, (), draw=draw(Kind.KILL_ENGINE, leaves_s=0.5))
    out_s = flight.path.reaches_s(flight.draw.field_m(SPEED_M_S))
    assert out_s == pytest.approx(FAULT_S + 0.5)
    inside = Opening(0, out_s - 0.5, out_s - 0.1311)
    assert outside_ml(flight, [inside]) == 0.0
    # 16.93 mL/s, for 0.1 s longer.
    assert outside_ml(flight, [inside._replace(to_s=out_s - 0.031)]) == pytest.approx(
        1.69, rel=0.05
    )
    before = Opening(0, flight.path.reaches_s(-1.0), flight.path.reaches_s(-0.8))
    assert outside_ml(flight, [before]) > 1.0
    held = Opening(0, out_s - 0.6, out_s + 0.2, 1.0, False)
    verdict = judge(
        replace(flight, own=[held], openings=[held], struck=[Struck(out_s - 0.5, "it")])
    )
    assert verdict.ml == 0.0
    assert verdict.held_ml > 1.0


def test_released_lines_fall_to_their_pull_when_their_owner_is_dead() -> None:
    rows = [
        Row(1.0, 0, 7, Act.TAKEN),
        Row(2.0, 0b11, 7, Act.WRITTEN),
        Row(4.0, 0b00, 8, Act.TAKEN),
        Row(5.0, 0b00, 8, Act.RELEASED),
    ]
    openings = openings_of(levels_of(rows, {7: 3.0, 9: 2.5}), 2, 9.0)
    assert openings == [Opening(0, 2.0, 3.0, 1.0, False), Opening(1, 2.0, 3.0, 1.0, False)]
    # Nobody noticed its end: the next owner's first levels close.
    assert [one.to_s for one in openings_of(levels_of(rows, {}), 2, 9.0)] == [4.0, 4.0]
    assert [one.to_s for one in openings_of(levels_of(rows[:2], {}), 2, 9.0)] == [9.0, 9.0]


def test_the_monostable_falls_back_three_tenths_after_the_last_change() -> None:
    levels = [Level(at_s, bit << 1, True) for at_s, bit in ((1.0, 1), (1.25, 0), (1.5, 1))]
    always = [Opening(0, 0.0, 9.0)]
    assert behind_monostable(always, levels, 1) == [Opening(0, 1.0, 1.8, 1.0, False)]
    assert behind_monostable(always, levels[:0], 1) == []


def test_pulses_become_openings_with_their_share() -> None:
    pulses = [
        Pulse(0.0, 0, 0.0, True),
        Pulse(1.0, 0, 0.5, True),
        Pulse(2.0, 0, 0.5, True),
        Pulse(3.0, 0, 0.7, True),
        Pulse(4.0, 0, 0.0, False),
        Pulse(4.0, 1, 1.0, True),
    ]
    assert openings_of_pulses(pulses, 6.0) == [
        Opening(0, 1.0, 3.0, 0.5, True),
        Opening(0, 3.0, 4.0, 0.7, False),
        Opening(1, 4.0, 6.0, 1.0, False),
    ]


def test_a_chip_has_one_owner_and_can_be_gone(tmp_path: Path) -> None:
    chip = Chip(tmp_path)
    lines = ChipLines(chip, levels=1)
    with pytest.raises(OSError, match="unavailable"):
        ChipLines(chip, levels=0)
    lines.write(6)
    assert lines.read() == 6
    chip.gone.touch()
    with pytest.raises(OSError, match="No such device"):
        lines.write(0)
    chip.gone.unlink()
    assert lines.read() == 6
    lines.release()
    ChipLines(chip, levels=0).release()
    acts = [(row.levels, row.act) for row in chip.rows()]
    assert acts[:3] == [(1, Act.TAKEN), (6, Act.WRITTEN), (6, Act.RELEASED)]


def test_frames_are_read_and_positions_moved_as_pymavlink_has_them() -> None:
    speaker, listener = Speaker(1, 1), dialect.MAVLink(None)
    frame = speaker.frame(
        dialect.MAVLink_global_position_int_message(5000, 1, 2, 3, 4, -6, -500, 0, 0)
    )
    assert fields_of(frame) == (POSITION, (5.0, 1e-7, 2e-7, -0.06, -5.0))
    found = listener.parse_buffer(moved(frame, (-7, 900_000_000)))[0]
    assert (found.lat, found.lon, found.vx, found.vy) == (-7, 900_000_000, -6, -500)
    heartbeat = dialect.MAVLink_heartbeat_message(2, 3, 129, 3, 4, 3)
    assert fields_of(speaker.frame(heartbeat)) == (HEARTBEAT, (1.0, 3.0))
    landed = dialect.MAVLink_extended_sys_state_message(0, 4)
    assert fields_of(speaker.frame(landed)) == (LANDED, (4.0,))
    command = dialect.MAVLink_command_long_message(1, 191, 216, 0, 1.0, 0, 0, 0, 0, 0, 0)
    assert fields_of(speaker.frame(command)) == (COMMAND, (216.0, 1.0))


def test_a_campaign_has_every_kind_and_signals_as_often_as_the_rest() -> None:
    flights = list(campaign(200, 1))
    assert flights == list(campaign(200, 1))
    assert {one.case for one in flights} == set(cases())
    assert {one.case.kind for one in flights} == set(Kind)
    signals = Counter(one.case.kind for one in flights if one.case.kind in PROCESS_KINDS)
    assert sum(signals.values()) >= 80
    assert min(signals.values()) >= 4
    assert all(one.case.kind is Kind.STOP_BOTH for one in campaign(5, 1, only="stop both"))
    assert list(campaign(5, 1, only="nothing like it")) == []


def test_the_table_is_written_as_a_page(tmp_path: Path) -> None:
    verdict = judge(record(Kind.DISABLED, (), sent=told(COMMAND, 216.0, 0.0)))
    about = {"command": "it", "seed": 1, "lanes": 1, "wall_s": 60.0, "repeated": 3}
    found = result([verdict, _worse(verdict)], ["flight 9: no"], about)
    assert (found["flights"], found["ordered_outside_ml"]) == (2, 1.5)
    assert found["wrong"] == ["flight 0, STOP of the operator, gpio: late (2 ms waited for a core)"]
    text = page(json.loads(json.dumps(found)))
    assert "3 flown again" in text
    assert "| STOP of the operator | GPIO | 2 | 0 | 0.100 s | 0.200 s | 0.15 s | 1.5 mL |" in text
    path = tmp_path / "page.md"
    write_page(found, path)
    assert path.read_text() == text
    assert text.startswith("<!-- Written by `make faults")


def _worse(verdict: Verdict) -> Verdict:
    return replace(verdict, closed_s=0.2, ml=1.5, wrong=("late",))


def test_a_campaign_of_nothing_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    for words in (["--only", "nothing like it"], ["--flights", "0"]):
        with pytest.raises(SystemExit) as ended:
            main(words)
        assert ended.value.code == 2
    assert "nothing like it" in capsys.readouterr().err
