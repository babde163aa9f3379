"""Valves open on planned lines only, from their exact start to their exact end."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import shapely

from companion.core.controller import Memory, step
from companion.core.estimator import Track, observe
from companion.core.options.lines import Lines, Polyline
from companion.core.prescription import Prescription, Zone
from companion.core.setup import Setup
from companion.core.types import LegReport, MissionLeg, TimedChange, VehicleState
from tests import builders
from tests.builders import LAG, along, boom, setup
from tests.companion.test_controller import SPEED, crossing_s

GROUND = shapely.box(-100.0, -100.0, 200.0, 100.0)
FIELD = Prescription([Zone(name="all", polygon=GROUND, rate_l_ha=20.0)])
LINE: Polyline = ((12.0, 3.0), (36.0, 3.0))
LIMITS = replace(setup().limits, modes=frozenset({"AUTO", "GUIDED"}))


def on_lines(*polylines: Polyline, aside_m: float = 1.0, **change: object) -> Setup:
    lines = Lines(polylines=polylines or (LINE,), aside_m=aside_m)
    return setup(prescription=FIELD, lines=lines, limits=LIMITS, **change)


def flying(now_s: float, east_m: float, north_m: float = 3.0, **change: object) -> VehicleState:
    """Return a vehicle on a leg of its mission where one is given, else flown by hand."""
    mode = "AUTO" if "mission_leg" in change else "GUIDED"
    return builders.flying(now_s, east_m, north_m, **({"mode": mode} | change))


def switches(
    given: Setup, start_m: float, end_m: float, *, hz: float = 20.0, **change: object
) -> list[TimedChange]:
    """Return when valve 3 is switched on the way east at 5 m/s."""
    memory, done, pending = Memory(), [], []
    for i in range(int((end_m - start_m) / SPEED * hz)):
        now_s = 10.0 + i / hz
        done += [change_ for change_ in pending if change_.at_s <= now_s]
        state = flying(now_s, start_m + SPEED * i / hz, **change)
        decision, memory = step(given, state, memory, now_s)
        pending = list(decision.plan.changes)
    return [change_ for change_ in done if change_.valve == 2 and change_.restart]


def opens(given: Setup, state: VehicleState, memory: Memory | None = None) -> bool:
    """Return whether a valve is open, or about to be, after two steps at a place."""
    _, memory = step(given, state, memory or Memory(), state.time_s)
    decision, _ = step(given, state, memory, state.time_s)
    return decision.plan.opens


def way(
    begin: tuple[float, float], end: tuple[float, float], received_s: float = 9.5
) -> MissionLeg:
    return MissionLeg(
        received_s=received_s, from_east_m=begin[0], from_north_m=begin[1],
        to_east_m=end[0], to_north_m=end[1],
    )  # fmt: skip


# --------------------------------------------------------------------------------- start and end


@pytest.mark.parametrize("hz", [20.0, 50.0])
def test_nothing_falls_before_the_start_or_after_the_end(hz: float) -> None:
    on, off = switches(on_lines(), 0.0, 48.0, hz=hz)
    assert on.duty > 0.0
    assert off.duty == 0.0
    assert on.at_s == pytest.approx(crossing_s(12.0, 0.0) - LAG.on_start_s - 0.01, abs=1e-6)
    assert off.at_s == pytest.approx(crossing_s(36.0, 0.0) - LAG.off_end_s - 0.01, abs=1e-6)


def test_where_volume_counts_the_ends_are_as_of_any_zone() -> None:
    on, off = switches(on_lines(border="volume"), 0.0, 48.0)
    assert on.at_s == pytest.approx(crossing_s(12.0, 0.0) - LAG.on_s - 0.01, abs=1e-6)
    assert off.at_s == pytest.approx(crossing_s(36.0, 0.0) - LAG.off_s - 0.01, abs=1e-6)


def test_a_boom_ahead_of_the_receiver_begins_and_ends_sooner() -> None:
    on, off = switches(on_lines(boom=boom(forward_m=2.0)), 0.0, 48.0)
    assert on.at_s == pytest.approx(crossing_s(10.0, 0.0) - LAG.on_start_s - 0.01, abs=1e-6)
    assert off.at_s == pytest.approx(crossing_s(34.0, 0.0) - LAG.off_end_s - 0.01, abs=1e-6)


def test_a_line_may_be_flown_either_way() -> None:
    forth = switches(on_lines(((36.0, 3.0), (12.0, 3.0))), 0.0, 48.0)
    assert [c.at_s for c in forth] == pytest.approx(
        [c.at_s for c in switches(on_lines(), 0.0, 48.0)], abs=1e-9
    )


def test_a_skewed_boom_is_wholly_on_the_line_before_it_opens() -> None:
    state = flying(10.0, 10.0, **along(90.0) | {"heading_deg": 70.0})
    given = on_lines()
    _, memory = step(given, state, Memory(), 10.0)
    lines = given.lines
    assert lines is not None
    sine = math.sin(math.radians(20.0))
    for valve, route in zip(given.boom.valves, memory.routes.routes, strict=True):
        place = 10.0 + valve.right_m * sine  # the right end is ahead
        begins = 10.0 + (12.0 + 0.5 * valve.width_m * sine - place) / 5.0
        assert route[1].at_s == pytest.approx(begins, abs=1e-6)


def test_between_two_lines_in_a_row_it_is_closed() -> None:
    found = switches(on_lines(((0.0, 3.0), (20.0, 3.0)), ((23.0, 3.0), (60.0, 3.0))), 5.0, 45.0)
    assert [change.duty > 0.0 for change in found] == [True, False, True]


def test_two_lines_without_a_gap_are_sprayed_through() -> None:
    found = switches(on_lines(((0.0, 3.0), (20.0, 3.0)), ((20.0, 3.0), (60.0, 3.0))), 5.0, 45.0)
    assert len(found) == 1


def test_a_gentle_bend_does_not_close_and_a_sharp_one_ends_the_line() -> None:
    gentle, sharp = Lines(polylines=((*LINE, (60.0, 6.0)),)), Lines(polylines=((*LINE, (36, 60)),))
    assert [piece.line for piece in gentle.pieces] == [0, 0]
    assert gentle.pieces[0].after_m == pytest.approx(math.hypot(24.0, 3.0))
    assert [piece.line for piece in sharp.pieces] == [0, 1]
    assert len(switches(on_lines((*LINE, (60.0, 6.0)), aside_m=1.0), 15.0, 39.0)) == 1


# ------------------------------------------------------------------------------- on a line or not


def test_aside_of_a_line_nothing_opens() -> None:
    assert opens(on_lines(), flying(10.0, 20.0, 3.85))
    assert not opens(on_lines(), flying(10.0, 20.0, 4.05))
    assert not opens(on_lines(), flying(10.0, 20.0, 1.95))


def test_what_closed_at_the_tolerance_opens_a_tenth_inside_it() -> None:
    given = on_lines()
    _, spraying = step(given, flying(10.0, 20.0, 3.0), Memory(), 10.0)
    assert not opens(given, flying(10.3, 21.5, 3.95))
    decision, _ = step(given, flying(10.3, 21.5, 3.95), spraying, 10.3)
    assert decision.plan.opens


@pytest.mark.parametrize("course", [90.0, 270.0])
def test_courses_of_the_line_are_sprayed_and_others_not(course: float) -> None:
    assert opens(on_lines(), flying(10.0, 24.0, **along(course)))
    for off in (-21.0, 21.0, 90.0):
        assert not opens(on_lines(), flying(10.0, 24.0, **along(course + off)))


def test_who_drifts_across_a_line_is_not_on_it() -> None:
    """One at 12 degrees to the line is within 1 m of it for 10 m: most of that stays closed."""
    places = [3.0 + aside / 10.0 for aside in range(-9, 10)]
    assert all(opens(on_lines(), flying(10.0, 20.0, place)) for place in places)
    assert sum(opens(on_lines(), flying(10.0, 20.0, place, **along(78.0))) for place in places) <= 3
    assert not any(opens(on_lines(), flying(10.0, 20.0, at, **along(72.0))) for at in places)


def test_who_comes_back_to_a_line_is_not_on_it_yet() -> None:
    assert not opens(on_lines(), flying(10.0, 20.0, 4.3, **along(95.0)))
    assert opens(on_lines(), flying(10.0, 20.0, 3.7, **along(95.0)))


def test_just_before_the_end_the_course_counts_all_the_same() -> None:
    assert opens(on_lines(), flying(10.0, 35.0, 3.0, **along(75.0)))
    assert not opens(on_lines(), flying(10.0, 35.0, 3.0, **along(50.0)))


def test_near_the_end_a_gust_does_not_close() -> None:
    assert opens(on_lines(), flying(10.0, 34.0, 3.3, **along(80.0)))


@pytest.mark.parametrize("name", ["east_m", "north_m", "velocity_east_m_s", "velocity_north_m_s"])
@pytest.mark.parametrize("value", [math.nan, math.inf, 1e300])
def test_what_is_no_number_is_on_no_line(name: str, value: float) -> None:
    lines = Lines(polylines=(LINE,))
    good = flying(10.0, 20.0)
    assert lines.flown(good, back_s=0.1, ahead_s=1.0, reach_m=3.0)
    bad = replace(good, **{name: value})
    assert not lines.flown(bad, back_s=0.1, ahead_s=1.0, reach_m=3.0)


def test_off_all_lines_the_plan_says_closed_and_gives_no_reason_to_worry() -> None:
    decision, _ = step(on_lines(), flying(10.0, 20.0, 10.0), Memory(), 10.0)
    assert not decision.plan.opens
    assert not decision.inhibits
    assert set(decision.rate_l_ha) == {None}


def test_what_is_open_closes_at_once_where_the_line_is_left() -> None:
    given = on_lines()
    _, memory = step(given, flying(10.0, 20.0), Memory(), 10.0)
    decision, _ = step(given, flying(10.05, 20.2, 3.0, **along(60.0)), memory, 10.05)
    assert decision.plan.duty_at(10.05) == (0.0,) * 6


# ---------------------------------------------------------------------------- the mission's leg


@pytest.mark.parametrize(
    ("leg", "sprayed"),
    [
        (way((12.0, 3.0), (36.0, 3.0)), True),
        (way((36.0, 3.0), (12.0, 3.0)), False),  # told before the ferry to its far end is over
        (way((18.0, 3.0), (26.0, 3.0)), True),  # a piece of it, at a speed of its own
        (way((0.0, 3.0), (48.0, 3.0)), True),  # with run-in and run-out
        (way((12.0, 3.0), (12.0, 60.0)), False),
        (way((-60.0, 3.0), (60.0, 3.0)), False),  # a ferry over all of it
        (way((-60.0, 3.0), (12.0, 3.0)), True),  # from the line before; the next is not yet told
        (way((-20.0, 2.0), (60.0, 4.5)), False),  # a ferry, nearly along it
        (way((36.0, 3.0), (-90.0, 8.0)), False),  # back from its end
        (way((20.0, 3.0), (20.0, 3.0)), False),
        (way((math.nan, 3.0), (36.0, 3.0)), False),
    ],
)
def test_the_leg_that_is_flown_has_to_lie_along_the_line(leg: MissionLeg, *, sprayed: bool) -> None:
    assert opens(on_lines(), flying(10.0, 20.0, mission_leg=leg)) is sprayed


def test_a_run_in_opens_the_line_at_its_start() -> None:
    run_in = way((0.0, 3.0), (12.0, 3.0))
    assert opens(on_lines(), flying(10.0, 10.5, mission_leg=run_in))


def test_a_leg_that_was_left_counts_to_its_last_metres_but_not_on_the_way_back() -> None:
    line, ferry = way((12.0, 3.0), (36.0, 3.0)), way((36.0, 3.0), (12.0, 12.0))
    assert opens(on_lines(), flying(10.0, 30.0, mission_leg=ferry, mission_leg_before=line))
    assert not opens(on_lines(), flying(10.0, 30.0, mission_leg=ferry))
    back = {"velocity_east_m_s": -5.0, "heading_deg": 270.0}
    assert not opens(
        on_lines(), flying(10.0, 30.0, mission_leg=ferry, mission_leg_before=line, **back)
    )
    assert opens(
        on_lines(),
        flying(10.0, 30.0, mission_leg=ferry, mission_leg_before=replace(line, received_s=-22.9)),
    )
    old = replace(line, received_s=-23.1)
    assert not opens(on_lines(), flying(10.0, 30.0, mission_leg=ferry, mission_leg_before=old))


def test_a_way_on_a_line_that_a_longer_leg_flies_is_not_sprayed() -> None:
    given, side_step = on_lines(), way((18.0, 3.0), (30.0, 3.0))
    assert opens(given, flying(10.0, 20.0, mission_leg=side_step))
    for ends in (((12.0, 3.0), (36.0, 3.0)), ((36.0, 3.0), (12.0, 3.0))):
        known = replace(side_step, longer=way(*ends))
        assert not opens(given, flying(10.0, 20.0, mission_leg=known))
    # One that leads far beyond the line is a ferry: it sprays nothing, so that this one has to.
    ferry = replace(side_step, longer=way((12.0, 3.0), (90.0, 3.0)))
    assert opens(given, flying(10.0, 20.0, mission_leg=ferry))


def test_a_leg_without_length_is_along_no_line() -> None:
    assert not opens(on_lines(), flying(10.0, 20.0, mission_leg=way((40.0, 3.0), (40.0, 3.0))))


@pytest.mark.parametrize("mode", ["AUTO", "MISSION"])
def test_while_no_leg_is_known_the_mission_sprays_nothing(mode: str) -> None:
    given = on_lines()
    assert opens(given, flying(10.0, 20.0, mission_leg=way(*LINE), mode=mode))
    assert not opens(given, flying(10.0, 20.0, mission_leg=None, mode=mode))
    assert not opens(
        given, flying(10.0, 20.0, mission_leg=None, mission_leg_before=way(*LINE), mode=mode)
    )


@pytest.mark.parametrize(
    ("received_s", "sprayed"),
    [(10.0, True), (-20.9, True), (-21.1, False), (10.1, False), (math.nan, False)],
)
def test_a_leg_counts_until_three_of_px4s_ten_seconds_are_over(
    received_s: float, *, sprayed: bool
) -> None:
    told = way(*LINE, received_s=received_s)
    assert opens(on_lines(), flying(10.0, 20.0, mission_leg=told)) is sprayed


def test_a_leg_whose_change_was_lost_opens_its_own_line_only() -> None:
    """It is told again ten seconds later: until then ferries are closed all the same."""
    given = on_lines(LINE, ((36.0, 9.0), (12.0, 9.0)))
    old = way(*LINE, received_s=1.0)
    assert not opens(given, flying(10.0, 20.0, 9.0, **along(270.0), mission_leg=old))
    assert not opens(given, flying(10.0, 20.0, 3.0, **along(270.0), mission_leg=old))
    assert not opens(given, flying(10.0, 45.0, 3.0, mission_leg=old))


def test_a_leg_says_nothing_of_who_does_not_fly_the_mission() -> None:
    ferry = way((-20.0, 2.0), (60.0, 4.5))
    given = on_lines()
    assert opens(given, flying(10.0, 20.0, mission_leg=ferry, mode="GUIDED"))
    assert not opens(given, flying(10.0, 20.0, mission_leg=ferry))


def test_legs_that_come_every_ten_seconds_close_nothing_on_the_line() -> None:
    far = ((0.0, 3.0), (190.0, 3.0))
    given = on_lines(far)
    found = switches(given, 5.0, 105.0, mission_leg=way(*far, received_s=9.9))  # told once in 20 s
    assert [change.duty > 0.0 for change in found] == [True]


def test_the_leg_is_heard_only_where_lines_are_followed() -> None:
    given = on_lines()
    (a, b), (c, d) = (given.frame.to_geographic(*place) for place in LINE)
    report = LegReport(
        received_s=9.5, from_latitude_deg=a, from_longitude_deg=b,
        to_latitude_deg=c, to_longitude_deg=d, stops=False,
    )  # fmt: skip
    heard = observe(Track(), report, given).mission_leg
    assert heard is not None
    assert (heard.to_east_m, heard.to_north_m) == pytest.approx(LINE[1], abs=1e-3)
    assert observe(Track(), report, setup()).mission_leg is None
    bad = replace(report, to_latitude_deg=math.nan)
    assert observe(Track(), bad, given).mission_leg is None


# ------------------------------------------------------------------------------------- the type


@pytest.mark.parametrize(
    "change",
    [
        {"aside_m": 0.0}, {"aside_m": math.nan}, {"course_deg": 91.0}, {"polylines": ()},
        {"polylines": (((0.0, 0.0), (0.0, 0.0)),)}, {"polylines": (((0.0, math.nan), (1.0, 0.0)),)},
    ],
)  # fmt: skip
def test_lines_that_are_none_are_refused(change: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=r"aside_m|course_deg|line"):
        Lines(**({"polylines": (LINE,)} | change))  # type: ignore[arg-type]
