"""Every reason not to spray, alone, closes every valve."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import given as drawn
from hypothesis import strategies as st

from companion.core.controller import Memory, step
from companion.core.label import LabelLimits
from companion.core.safety import (
    HEIGHT_MARGIN_M,
    HOLD_S,
    MARGIN_SHARE_MAX,
    SPEED_MARGIN_M_S,
    WIND_MARGIN_M_S,
    Consent,
    Limits,
    consented,
    held,
    inhibits,
)
from companion.core.types import Decision, EstopReport, Fix, Inhibit, VehicleState, WindReport
from tests.builders import SPRAYING, flying, setup

NAN = math.nan
DAY = 86_400.0
LABELS = [reason for reason in Inhibit if reason.name.startswith("LABEL_")]
CASES: dict[Inhibit, list[dict[str, object] | None]] = {
    Inhibit.NOT_ENABLED: [{"enabled": False}],
    Inhibit.NO_POSITION: [None],
    Inhibit.STALE_POSITION: [
        {"position_received_s": 9.19},
        {"position_received_s": NAN},
        {"position_received_s": 10.2},
    ],
    Inhibit.INVALID_POSITION: [{"position_valid": False}],
    Inhibit.POSITION_FROZEN: [{"position_frozen": True}, {"position_frozen": None}],
    Inhibit.CLOCK_DISAGREES: [{"clock_agrees": False}, {"clock_agrees": None}],
    Inhibit.FAR_FROM_FIELD: [
        {"east_m": 20_049.0},
        {"north_m": NAN},
        {"east_m": -math.inf},
    ],
    Inhibit.NO_HEARTBEAT: [{"heartbeat_received_s": None}],
    Inhibit.STALE_HEARTBEAT: [{"heartbeat_received_s": 7.49}, {"heartbeat_received_s": NAN}],
    Inhibit.NOT_ARMED: [{"armed": False}],
    Inhibit.NOT_ACTIVE: [{"active": False}],
    Inhibit.WRONG_MODE: [{"mode": "LOITER"}, {"mode": None}],
    Inhibit.NOT_IN_AIR: [{"in_air": False}, {"in_air": None}],
    Inhibit.FIX_TOO_LOW: [{"fix": Fix.DGPS}, {"fix": None}],
    Inhibit.ESTIMATOR_UNHEALTHY: [{"estimator_healthy": False}, {"estimator_healthy": None}],
    Inhibit.HEADING_UNKNOWN: [{"heading_deg": None}, {"heading_deg": NAN}],
    Inhibit.SPEED_UNKNOWN: [{"velocity_known": False}],
    Inhibit.SPEED_BELOW_MIN: [{"velocity_east_m_s": 0.99, "checked_speed_m_s": 1.0}],
    Inhibit.SPEED_ABOVE_MAX: [{"velocity_east_m_s": 12.01, "checked_speed_m_s": 12.0}],
    Inhibit.SPEED_DISAGREES: [{"checked_speed_m_s": 6.01}, {"checked_speed_m_s": NAN}],
    Inhibit.SPEED_UNCHECKED: [{"checked_speed_m_s": None}],
    Inhibit.HEIGHT_BELOW_MIN: [{"height_m": 0.99}],
    Inhibit.HEIGHT_ABOVE_MAX: [{"height_m": 10.01}],
    Inhibit.WIND_ABOVE_MAX: [{"wind_m_s": 6.01}, {"wind_m_s": NAN}, {"wind_m_s": math.inf}],
    Inhibit.WIND_UNKNOWN: [
        {"wind_m_s": None},
        {"wind_received_s": None},
        {"wind_received_s": 4.99},
        {"wind_received_s": 10.2},
        {"wind_received_s": NAN},
    ],
    Inhibit.LABEL_SPEED: [
        {"velocity_east_m_s": 0.99, "checked_speed_m_s": 1.0},
        {"velocity_east_m_s": 12.01, "checked_speed_m_s": 12.0},
    ],
    Inhibit.LABEL_HEIGHT: [{"height_m": 0.99}, {"height_m": 10.01}],
    Inhibit.LABEL_WIND: [{"wind_m_s": 6.01}, {"wind_m_s": NAN}],
    Inhibit.LABEL_WIND_DIRECTION: [
        {"wind": None},
        {"wind": WindReport(received_s=9.9, speed_m_s=3.0, east_m_s=0.0, north_m_s=-3.0)},
        {"wind": WindReport(received_s=9.9, speed_m_s=3.0, east_m_s=NAN, north_m_s=0.0)},
        {"wind": WindReport(received_s=9.9, speed_m_s=3.0, east_m_s=0.0, north_m_s=0.0)},
    ],
    Inhibit.LABEL_TIME: [
        {"utc_offset_s": None},
        {"utc_offset_s": NAN},
        {"utc_offset_s": math.inf},
        {"utc_offset_s": DAY + 6 * 3600.0 - 10.01},
        {"utc_offset_s": DAY + 9 * 3600.0 - 10.0},
        {"utc_offset_s": 2 * DAY + 7 * 3600.0},
    ],
    Inhibit.LABEL_WEATHER_AGE: [
        {"utc_offset_s": DAY + 6.5 * 3600.0 - 10.01},
        {"utc_offset_s": DAY + 8.5 * 3600.0 - 10.0},
    ],
    Inhibit.RC_SWITCH: [{"rc_switch_on": False}, {"rc_switch_on": None}],
    Inhibit.OUTPUT_FAULT: [{"output_healthy": False}],
    Inhibit.LINK_LOST: [{"link_up": False}],
    Inhibit.UNGUARDED: [{"output_guarded": False}, {"output_guarded": None}],
    Inhibit.ESTOP: [{"estop": True}, {"estop": None}],
    Inhibit.ACCURACY_TOO_LOW: [
        {"horizontal_accuracy_m": 0.301},
        {"horizontal_accuracy_m": NAN},
        {"horizontal_accuracy_m": -0.01},
        {"horizontal_accuracy_m": math.inf},
    ],
}


LABEL = LabelLimits(
    speed_m_s=(1.0, 12.0),
    height_m=(1.0, 10.0),
    wind_m_s=(0.0, 6.0),
    wind_from_deg=((225.0, 315.0),),
    hours_s=((6 * 3600.0, 9 * 3600.0),),
    days_s=(DAY, 2 * DAY),
    observed_s=(DAY + 6.5 * 3600.0, DAY + 8.5 * 3600.0),
)
# Everything that can be asked for is, and all of it is there.
STRICT = Limits(
    wind_required=True,
    speed_check_required=True,
    rc_channel=7,
    accuracy_max_m=0.3,
    estop_required=True,
    label=LABEL,
)
READY = replace(
    SPRAYING,
    wind_m_s=3.0,
    wind_received_s=9.9,
    wind=WindReport(received_s=9.9, speed_m_s=3.0, east_m_s=3.0, north_m_s=0.0),
    utc_offset_s=DAY + 7 * 3600.0,
    rc_switch_on=True,
    estop=False,
    horizontal_accuracy_m=0.02,
)


def decide(change: dict[str, object] | None, limits: Limits = STRICT) -> Decision:
    state: VehicleState | None = None
    if change is not None:
        state = replace(READY, **change)  # type: ignore[arg-type]
    return step(setup(limits=limits), state, Memory(), 10.0)[0]


BOTH = (
    "speed-below-min",
    "speed-above-max",
    "height-below-min",
    "height-above-max",
    "wind-above-max",
)
SAME = {reason for reason in Inhibit if reason.value in BOTH}
# What is outside of both, or unknown to both, is said twice.
ALSO = {
    Inhibit.LABEL_SPEED: SAME,
    Inhibit.LABEL_HEIGHT: SAME,
    Inhibit.LABEL_WIND: SAME,
    Inhibit.LABEL_TIME: {Inhibit.LABEL_WEATHER_AGE},
    Inhibit.SPEED_BELOW_MIN: {Inhibit.LABEL_SPEED},
    Inhibit.SPEED_ABOVE_MAX: {Inhibit.LABEL_SPEED},
    Inhibit.HEIGHT_BELOW_MIN: {Inhibit.LABEL_HEIGHT},
    Inhibit.HEIGHT_ABOVE_MAX: {Inhibit.LABEL_HEIGHT},
    Inhibit.WIND_ABOVE_MAX: {Inhibit.LABEL_WIND},
    Inhibit.WIND_UNKNOWN: {Inhibit.LABEL_WIND, Inhibit.LABEL_WIND_DIRECTION},
}


def test_nothing_inhibits_the_reference_step() -> None:
    decision = decide({})
    assert not decision.inhibits
    assert not decision.plan.is_off


# Those that flow and pressure give: their cases are in test_detection.py. The one that a latch
# gives has its own in test_sprayer_state.py.
OF_THE_LIQUID = {
    Inhibit.LEAK,
    Inhibit.VALVE_STUCK_OPEN,
    Inhibit.NO_FLOW,
    Inhibit.TANK_EMPTY,
    Inhibit.FLOW_FAULT,
}


# Those that the operator declares before the flight.
DECLARED = {
    Inhibit.LABEL_TEMPERATURE,
    Inhibit.LABEL_HUMIDITY,
    Inhibit.LABEL_INVERSION,
    Inhibit.LABEL_DROPLETS,
}


def test_every_inhibit_has_a_case() -> None:
    assert set(CASES) | OF_THE_LIQUID | DECLARED | {Inhibit.REARM_NEEDED} == set(Inhibit)


@pytest.mark.parametrize("inhibit", sorted(DECLARED))
def test_what_was_declared_against_the_label_closes_every_valve(inhibit: Inhibit) -> None:
    label = replace(LABEL, broken=frozenset({inhibit}))
    decision = decide({}, replace(STRICT, label=label))
    assert decision.inhibits == {inhibit}
    assert decision.plan.is_off


@pytest.mark.parametrize(
    ("inhibit", "change"),
    [(inhibit, change) for inhibit, changes in CASES.items() for change in changes],
)
def test_inhibit_alone_closes_every_valve(
    inhibit: Inhibit, change: dict[str, object] | None
) -> None:
    decision = decide(change)
    also = ALSO.get(inhibit, set())
    assert {inhibit} <= decision.inhibits <= {inhibit} | also
    assert decision.plan.is_off
    # Without a label all else is as it was.
    bare = decide(change, replace(STRICT, label=None)).inhibits
    assert bare <= {inhibit, *SAME} - set(LABELS)


@pytest.mark.parametrize("name", ["velocity_east_m_s", "velocity_north_m_s", "height_m"])
@pytest.mark.parametrize("value", [NAN, math.inf, -math.inf])
def test_what_is_no_number_closes_every_valve(name: str, value: float) -> None:
    decision = decide({name: value})
    assert decision.inhibits
    assert decision.plan.is_off


def test_limits_are_those_of_the_contract_unless_others_are_given() -> None:
    limits = Limits()
    assert (limits.modes, limits.enable_by) == ({"AUTO"}, {"command", "rc", "web"})
    assert (limits.position_age_max_s, limits.heartbeat_age_max_s) == (0.8, 2.5)
    assert (limits.speed_min_m_s, limits.speed_max_m_s) == (1.0, 12.0)
    assert limits.speed_disagreement_max_m_s == 1.0
    assert (limits.height_min_m, limits.height_max_m) == (1.0, 10.0)
    assert (limits.fix, limits.wind_max_m_s, limits.wind_age_max_s) == (Fix.RTK_FLOAT, 6.0, 5.0)
    assert (limits.distance_max_m, limits.consent_gap_max_s) == (20_000.0, 10.0)
    assert not (limits.wind_required or limits.speed_check_required or limits.estop_required)
    assert limits.rc_channel is limits.accuracy_max_m is None


def test_hold_and_margins_are_what_the_documents_say() -> None:
    assert set(HOLD_S.values()) == {1.0}
    margins = (SPEED_MARGIN_M_S, HEIGHT_MARGIN_M, WIND_MARGIN_M_S, MARGIN_SHARE_MAX)
    assert margins == (0.1, 0.3, 0.5, 0.1)


UNASKED = {
    "wind_m_s": None,
    "wind_received_s": None,
    "checked_speed_m_s": None,
    "rc_switch_on": None,
    "estop": None,
    "horizontal_accuracy_m": None,
}


def test_what_is_not_asked_for_may_be_missing() -> None:
    assert not decide(dict(UNASKED), Limits()).inhibits


def test_a_wind_that_was_too_strong_stays_so_however_old() -> None:
    state = {"wind_m_s": 6.01, "wind_received_s": -1000.0}
    assert decide(state, Limits()).inhibits == {Inhibit.WIND_ABOVE_MAX}


@pytest.mark.parametrize(
    ("modes", "mode", "allowed"),
    [
        ({"AUTO"}, "AUTO", True),
        ({"AUTO"}, "MISSION", True),  # what PX4 calls it
        ({"MISSION"}, "AUTO", False),
        ({"GUIDED"}, "MISSION", False),
        ({"AUTO"}, "AUTO_RTL", False),
        ({"AUTO"}, None, False),
        ({"AUTO"}, "", False),
    ],
)
def test_modes(modes: set[str], mode: str | None, allowed: bool) -> None:
    limits = replace(STRICT, modes=frozenset(modes))
    assert decide({"mode": mode}, limits).inhibits == (set() if allowed else {Inhibit.WRONG_MODE})


# name, value outside, value just inside, value inside by more than the margin
MARGINS: dict[Inhibit, tuple[str, float, float, float]] = {
    Inhibit.SPEED_BELOW_MIN: ("velocity_east_m_s", 0.99, 1.09, 1.11),
    Inhibit.SPEED_ABOVE_MAX: ("velocity_east_m_s", 12.01, 11.91, 11.89),
    Inhibit.SPEED_DISAGREES: ("checked_speed_m_s", 6.01, 5.91, 5.89),
    Inhibit.HEIGHT_BELOW_MIN: ("height_m", 0.99, 1.29, 1.31),
    Inhibit.HEIGHT_ABOVE_MAX: ("height_m", 10.01, 9.71, 9.69),
    Inhibit.WIND_ABOVE_MAX: ("wind_m_s", 6.01, 5.51, 5.49),
}


@pytest.mark.parametrize("inhibit", MARGINS)
def test_what_closed_at_a_limit_opens_a_margin_inside_it(inhibit: Inhibit) -> None:
    name, outside, near, inside = MARGINS[inhibit]
    given, memory, found = setup(), Memory(), []
    for number, value in enumerate((near, outside, near, inside, near)):
        now_s = 10.0 + 0.05 * number
        state = flying(now_s, 6.0, **{name: value})
        if name == "velocity_east_m_s":
            state = replace(state, checked_speed_m_s=value)
        decision, memory = step(given, state, memory, now_s)
        assert decision.inhibits <= {inhibit}
        assert decision.plan.is_off or not decision.inhibits
        found.append(bool(decision.inhibits))
    assert found == [False, True, True, False, False]


@drawn(
    low=st.floats(0.1, 20.0),
    room=st.floats(0.0, 20.0),
    reasons=st.frozensets(st.sampled_from(Inhibit)),
)
def test_a_margin_never_leaves_no_room_and_never_widens(
    low: float, room: float, reasons: frozenset[Inhibit]
) -> None:
    limits = Limits(
        speed_min_m_s=low, speed_max_m_s=low + room, height_min_m=low, height_max_m=low + room
    )
    after = held(limits, reasons)
    assert limits.speed_min_m_s <= after.speed_min_m_s <= after.speed_max_m_s <= low + room
    assert limits.height_min_m <= after.height_min_m <= after.height_max_m <= low + room
    assert 0.9 * limits.wind_max_m_s <= after.wind_max_m_s <= limits.wind_max_m_s
    assert 0.0 < after.speed_disagreement_max_m_s <= limits.speed_disagreement_max_m_s


def test_values_just_inside_the_limits_do_not_inhibit() -> None:
    decision = decide(
        {"position_received_s": 9.21, "heartbeat_received_s": 7.51, "checked_speed_m_s": 5.99}
    )
    assert not decision.inhibits


def test_an_inhibit_closes_a_valve_that_was_open() -> None:
    given = setup()
    first, memory = step(given, SPRAYING, Memory(), 10.0)
    assert any(change.duty > 0.0 for change in first.plan.changes)
    second, _ = step(given, replace(SPRAYING, armed=False), memory, 10.05)
    assert second.plan.is_off
    assert second.plan.sequence == first.plan.sequence + 1


AT_THE_LIMIT: list[dict[str, object]] = [
    {"heartbeat_received_s": 0.1},
    {"heartbeat_received_s": -2.5},
    {"position_received_s": 0.1},
    {"position_received_s": -0.8},
    {"wind_received_s": 0.1},
    {"wind_received_s": -5.0},
    {"wind_m_s": 0.0},
    {"wind_m_s": 0.5},
    {"wind_m_s": 6.0},
    {"east_m": -20_000.0},
    {"east_m": 20_048.0},
    {"north_m": -20_001.0},
    {"north_m": 20_007.0},
    {"fix": Fix.RTK_FLOAT},
    {"horizontal_accuracy_m": 0.0},
    {"horizontal_accuracy_m": 0.3},
    {"heading_deg": 360.0},
    {"heading_deg": -360.0},
    {"velocity_east_m_s": 1.0, "checked_speed_m_s": 1.0},
    {"velocity_east_m_s": 12.0, "checked_speed_m_s": 12.0},
    {"checked_speed_m_s": 6.0},
    {"checked_speed_m_s": 4.0},
    {"height_m": 1.0},
    {"height_m": 10.0},
]


def at_zero(change: dict[str, object]) -> frozenset[Inhibit]:
    """Return the reasons at the time 0, where differences of times are exact."""
    young = {"heartbeat_received_s": 0.0, "position_received_s": 0.0, "wind_received_s": 0.0}
    state: VehicleState = replace(READY, **(young | change))  # type: ignore[arg-type]
    return inhibits(state, STRICT, field_bounds_m=(0.0, -1.0, 48.0, 7.0), now_s=0.0)


@pytest.mark.parametrize("change", AT_THE_LIMIT)
def test_exactly_at_a_limit_closes_nothing(change: dict[str, object]) -> None:
    assert at_zero(change) == frozenset()


@pytest.mark.parametrize("heading_deg", [360.5, -360.5])
def test_no_heading_goes_round_more_than_once(heading_deg: float) -> None:
    assert at_zero({"heading_deg": heading_deg}) == {Inhibit.HEADING_UNKNOWN}


def test_a_margin_is_for_its_own_limit_only_and_a_tenth_of_the_room_at_most() -> None:
    limits = Limits(height_min_m=5.0, height_max_m=6.0)
    after = held(limits, frozenset({Inhibit.HEIGHT_BELOW_MIN}))
    assert after == replace(limits, height_min_m=5.1)
    after = held(limits, frozenset({Inhibit.SPEED_ABOVE_MAX, Inhibit.NOT_ARMED}))
    assert after == replace(limits, speed_max_m_s=11.9)


def test_a_stop_takes_the_consent_back_and_its_release_gives_none() -> None:
    given = Consent(enabled=True, wishes=1)
    for source in ("line", "command"):
        pressed, released = (
            EstopReport(received_s=1.0, pressed=is_pressed, source=source)
            for is_pressed in (True, False)
        )
        stopped = consented(given, pressed, setup().limits, heartbeat=None)
        assert (stopped.enabled, stopped.is_stopped) == (False, True)
        after = consented(stopped, released, setup().limits, heartbeat=None)
        assert (after.enabled, after.is_stopped) == (False, False)


def test_a_wind_that_the_operator_measures_need_not_be_heard_but_must_agree() -> None:
    limits = replace(STRICT, label=replace(LABEL, wind_required=False), wind_required=False)
    unheard = {"wind_m_s": None, "wind_received_s": None, "wind": None}
    assert not decide(unheard, limits).inhibits
    calm = replace(limits, label=replace(limits.label, wind_m_s=(0.0, 5.0)))  # type: ignore[type-var]
    assert decide({"wind_m_s": 5.01, "wind_received_s": 1.0}, calm).inhibits == {Inhibit.LABEL_WIND}


def test_hours_and_sectors_go_over_midnight_and_north() -> None:
    label = replace(
        LABEL,
        hours_s=((22 * 3600.0, 2 * 3600.0),),
        days_s=None,
        observed_s=None,
        wind_from_deg=((260.0, 10.0),),
    )
    limits = replace(STRICT, label=label)
    for hour, allowed in ((21.9, False), (22.1, True), (1.9, True), (2.1, False)):
        found = decide({"utc_offset_s": DAY + hour * 3600.0}, limits).inhibits
        assert found == (set() if allowed else {Inhibit.LABEL_TIME})


def test_what_the_label_closed_opens_a_margin_inside_it() -> None:
    low = replace(LABEL, height_m=(1.0, 5.0))
    given, memory, found = setup(limits=Limits(label=low)), Memory(), []
    for number, height_m in enumerate((4.8, 5.01, 4.8, 4.69, 4.8)):
        now_s = 10.0 + 0.05 * number
        wind = replace(READY.wind, received_s=now_s)  # type: ignore[type-var]
        state = flying(
            now_s, 6.0, height_m=height_m, wind=wind, wind_m_s=3.0, wind_received_s=now_s,
            utc_offset_s=READY.utc_offset_s,
        )  # fmt: skip
        decision, memory = step(given, state, memory, now_s)
        found.append(bool(decision.inhibits))
    assert found == [False, True, True, False, False]
