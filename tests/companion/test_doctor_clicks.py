"""The guided click's checks: what an answer, and what a metered flow, makes of a valve."""

from __future__ import annotations

import math

import pytest

from companion.cli.doctor_click import (
    Readings,
    ShortHand,
    answer_of,
    dry_check,
    wet_checks,
    wet_click,
)
from companion.core.inputs import AutopilotLiquid
from companion.core.types import BatteryReport, FaultKind, FlowReport
from companion.doctor.check import Check, Status
from companion.ground.clicks import ClickFinding, ClickJudgement
from companion.ground.work import Hold

NAMES = ("left", "right")


def judged(
    kind: FaultKind | None = None,
    *,
    share: float | None = 1.0,
    common: float | None = 1.0,
    fault: FaultKind | None = None,
    idle_ml_s: float = 0.0,
) -> tuple[Check, Check]:
    """Return the check of one valve, and the one of all."""
    found = ClickFinding(valve=1, kind=kind, share=share, limit=0.1)
    judgement = ClickJudgement(valves=(found,), common=common, fault=fault, idle_ml_s=idle_ml_s)
    valve, everything = wet_checks(judgement, NAMES)
    assert (valve.name, everything.name) == ("click-right", "click-flow")
    return valve, everything


@pytest.mark.parametrize(
    ("kind", "share", "status"),
    [
        (None, 0.98, Status.OK),
        (FaultKind.CLOG, 0.85, Status.WARN),
        (FaultKind.CLOG, 0.6, Status.FAIL),
        (FaultKind.LEAK, 1.2, Status.WARN),
        (FaultKind.LEAK, 1.5, Status.FAIL),
        (FaultKind.STUCK_CLOSED, 0.0, Status.FAIL),
        (FaultKind.STUCK_OPEN, 0.0, Status.FAIL),
        (FaultKind.METER_FAULT, None, Status.FAIL),
        (None, None, Status.FAIL),
    ],
)
def test_a_valve_is_as_good_as_its_flow(
    kind: FaultKind | None, share: float | None, status: Status
) -> None:
    assert judged(kind, share=share)[0].status is status


@pytest.mark.parametrize(
    ("fault", "common", "status"),
    [
        (None, 1.02, Status.OK),
        (FaultKind.SUPPLY, 0.6, Status.WARN),
        (FaultKind.NO_FLOW, 0.0, Status.FAIL),
        (FaultKind.LEAK, 1.0, Status.FAIL),
        (FaultKind.STUCK_OPEN, 1.0, Status.FAIL),
        (FaultKind.METER_FAULT, None, Status.FAIL),
        (None, None, Status.FAIL),
    ],
)
def test_what_all_valves_share_has_a_check_of_its_own(
    fault: FaultKind | None, common: float | None, status: Status
) -> None:
    assert judged(common=common, fault=fault)[1].status is status


@pytest.mark.parametrize(
    ("said", "meant"),
    [("Y", "y"), ("no", "n"), ("a", "again"), ("q", "q"), ("left", "left"), ("x", None)],
)
def test_answers_are_understood(said: str, meant: str | None) -> None:
    assert answer_of(said, NAMES, "right") == meant


def test_a_dry_click_is_what_the_operator_heard() -> None:
    assert dry_check("left", "y", channel=9).status is Status.OK
    assert "output 9" in dry_check("left", "n", channel=9).fix
    assert dry_check("left", "right", channel=None).status is Status.FAIL


def test_a_wet_click_opens_one_valve_twice_and_waits_for_the_flow_to_end() -> None:
    task = wet_click(3, 1)
    assert [phase.duty[1] for phase in task.phases] == [1.0, 0.0, 1.0, 0.0]
    assert not any(phase.duty[0] or phase.duty[2] for phase in task.phases)
    assert task.seconds == pytest.approx(3.6)
    assert task.is_whole


def heard(*counts: tuple[float, float], fault: str = "") -> Readings:
    readings = Readings(ready_s=2.0)
    readings.take(
        [
            FlowReport(received_s=at_s, volume_ml=volume_ml, fault=fault)
            for at_s, volume_ml in counts
        ]
    )
    return readings


def test_the_flow_is_counted_from_before_the_opening_to_the_end() -> None:
    readings = heard((0.5, 10.0), (1.9, 10.0), (3.0, 30.0), (6.0, 44.0))
    flow = readings.flow(1, 2.0)
    assert (flow.metered_ml, flow.window_s) == (34.0, pytest.approx(4.1))
    assert readings.idle() == (0.0, pytest.approx(1.4))


@pytest.mark.parametrize(
    "readings",
    [
        heard(),
        heard((0.5, 1.0), (1.0, 1.0)),
        heard((3.0, 1.0), (6.0, 9.0)),
        heard((1.0, math.nan), (6.0, 9.0)),
        heard((1.0, 1.0), (6.0, 9.0), fault="lost pulses"),
    ],
)
def test_without_sound_counts_on_both_sides_there_is_no_flow(readings: Readings) -> None:
    assert math.isnan(readings.flow(1, 2.0).metered_ml)


@pytest.mark.parametrize("readings", [heard(), heard((1.0, 1.0)), heard((3.0, 1.0), (4.0, 1.0))])
def test_without_two_counts_before_there_is_no_idle_flow(readings: Readings) -> None:
    assert all(math.isnan(value) for value in readings.idle())


def test_the_autopilot_s_monitor_counts_only_if_it_is_the_meter() -> None:
    readings = Readings()
    reports = [
        BatteryReport(received_s=1.0, battery=number, consumed=5.0, remaining_percent=None)
        for number in (0, 1)
    ]
    readings.take(reports, AutopilotLiquid(flow_battery=1))
    assert [report.volume_ml for report in readings.counts] == [5.0]


class Key:
    """A hand that does nothing by itself."""

    def __init__(self) -> None:
        self.stopped: str | None = None
        self.hold = Hold()
        self.has_begun = False

    def begin(self) -> None:
        self.has_begun = True


def test_a_short_hand_holds_for_its_time_and_no_longer() -> None:
    key, now_s = Key(), 10.0
    hand = ShortHand(key, seconds=0.8, clock=lambda: now_s)
    assert not hand.hold.is_held(now_s)
    hand.begin()
    assert key.has_begun
    held = []
    for _ in range(40):
        now_s += 0.05
        held.append(hand.hold.is_held(now_s))
    # After three tenths; it is held as long as the click takes, and half a second after.
    assert not any(held[:6])
    assert held[7:23] == [True] * 16
    assert not any(held[36:])
    key.stopped = "another-key"
    assert hand.stopped == "another-key"


@pytest.mark.parametrize("seconds", [0.0, 2.1, math.nan])
def test_what_takes_long_wants_a_key_that_is_held(seconds: float) -> None:
    with pytest.raises(ValueError, match="short click"):
        ShortHand(Key(), seconds=seconds)
