"""Reading the mission: once, paced, never in anybody's way; and which leg it says is flown."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import pytest

from companion.core.types import LegReport
from companion.link.messages import (
    MissionItem,
    MissionStep,
)
from companion.link.mission_reader import ITEMS_MAX, leg_report
from tests.companion.mission_bench import (
    AHEAD,
    JUMP,
    LAND,
    LOITER_TIME,
    LOITER_TURNS,
    MISSION,
    RTL,
    SERVO,
    SPLINE,
    VEHICLE,
    WAYPOINT,
    A,
    B,
    Bench,
    C,
    item,
    known,
)

# ---------------------------------------------------------------------------------------- legs


def leg(items: Sequence[MissionItem], sequence: int) -> LegReport | None:
    return leg_report(items, sequence, 10.0)


def stops(*items: MissionItem) -> bool:
    found = leg((item(WAYPOINT, A), *items), 1)
    assert found is not None
    return found.stops


def north(metres: float, east_m: float = 0.0) -> tuple[float, float]:
    return (36.0 + metres / 110_958.0, 114.0 + east_m / 90_164.0)


LINE, FAR = (north(0.0), north(100.0)), (north(-300.0), north(500.0))


@pytest.mark.parametrize(
    ("ends", "longer"),
    [
        (((0.0, 0.0), (60.0, 0.0)), LINE),
        (((80.0, 0.0), (20.0, 0.0)), LINE),
        (((20.0, 0.4), (60.0, -0.4)), LINE),
        (((20.0, 0.0), (102.0, 0.0)), FAR),  # beyond its end
        (((0.3, 0.0), (99.8, 0.0)), FAR),  # there and back: the same
        (((20.0, 0.7), (60.0, 0.7)), None),  # beside it
        (((50.0, 0.0), (50.0, 30.0)), None),  # from it
    ],
)
def test_a_leg_that_lies_on_a_longer_one_is_told_with_it(
    ends: tuple[tuple[float, float], tuple[float, float]],
    longer: tuple[tuple[float, float], tuple[float, float]] | None,
) -> None:
    places = (*FAR, north(0.0, 90.0), *LINE, north(0.0, 50.0), *(north(*end) for end in ends))
    items = [item(WAYPOINT, place) for place in places]
    found = leg(items, len(items) - 1)
    assert found is not None
    assert found.longer == longer
    # A leg that begins at a turn or a take-off without a place is none that could be flown again.
    alone = leg([items[3], item(LOITER_TURNS, LINE[1]), *items[-2:]], 3)
    assert alone is not None
    assert alone.longer is None


def test_a_leg_leads_from_the_waypoint_before_to_the_one_flown_to() -> None:
    assert leg(MISSION, 5) == LegReport(
        received_s=10.0,
        from_latitude_deg=B[0],
        from_longitude_deg=B[1],
        to_latitude_deg=C[0],
        to_longitude_deg=C[1],
        stops=True,
        speed_m_s=5.0,
    )


def test_a_take_off_without_a_place_is_at_home() -> None:
    found = leg(MISSION, 3)
    assert found is not None
    assert (found.from_latitude_deg, found.from_longitude_deg) == A


def test_what_is_done_on_the_way_is_not_flown_to() -> None:
    assert leg(MISSION, 4) == leg(MISSION, 5)


def test_the_way_home_is_a_leg_without_length_where_it_begins() -> None:
    found = leg((item(WAYPOINT, A), item(RTL)), 1)
    assert found is not None
    assert (found.from_latitude_deg, found.from_longitude_deg) == A
    assert (found.to_latitude_deg, found.to_longitude_deg) == A
    assert not found.stops


@pytest.mark.parametrize(
    "items",
    [
        (item(WAYPOINT, A), item(SPLINE, B)),
        (item(SPLINE, A), item(WAYPOINT, B)),
        (item(LOITER_TURNS, A), item(WAYPOINT, B)),
        (item(RTL), item(WAYPOINT, B)),
        (item(WAYPOINT, A), item(LAND)),
        (item(WAYPOINT, A), item(SERVO)),
        (item(SERVO), item(WAYPOINT, B)),
        (item(WAYPOINT, A),),
        (),
    ],
)
def test_what_is_no_straight_line_between_known_places_is_no_leg(
    items: tuple[MissionItem, ...],
) -> None:
    assert leg(items, 1) is None


def test_a_leg_stops_where_the_vehicle_waits_turns_back_or_has_nothing_to_do() -> None:
    to_b = item(WAYPOINT, B)
    assert stops(to_b)
    assert stops(to_b, item(RTL))
    assert stops(to_b, item(LAND))
    assert stops(to_b, item(WAYPOINT, C))
    assert stops(to_b, item(WAYPOINT, A))
    assert stops(to_b, item(WAYPOINT, B))
    assert stops(item(LOITER_TIME, B, param1=5.0), item(WAYPOINT, AHEAD))
    assert stops(item(WAYPOINT, B, param1=1.0), item(WAYPOINT, AHEAD))


def test_a_leg_that_is_flown_through_or_that_nobody_knows_the_next_of_does_not_stop() -> None:
    to_b = item(WAYPOINT, B)
    assert not stops(to_b, item(WAYPOINT, AHEAD))
    assert not stops(to_b, item(SERVO), item(WAYPOINT, AHEAD))
    assert not stops(to_b, item(SPLINE, C))
    assert not stops(to_b, item(JUMP), item(WAYPOINT, C))
    assert not stops(to_b, item(WAYPOINT))


# -------------------------------------------------------------------------------------- reader


def test_the_mission_is_read_once_paced_and_acknowledged() -> None:
    bench = known()
    assert bench.reader.items == MISSION
    assert len(bench.of("MISSION_REQUEST_LIST")) == len(bench.of("MISSION_ACK")) == 1
    asked = bench.of("MISSION_REQUEST_INT")
    assert len(asked) == len(MISSION)
    assert all(b - a >= 0.05 for a, b in pairwise(asked))


def test_each_current_item_gives_its_leg() -> None:
    bench = known()
    assert bench.current() == (leg_report(MISSION, 5, bench.now_s),)
    (homewards,) = bench.current(sequence=6)
    start = (homewards.from_latitude_deg, homewards.from_longitude_deg)
    assert start == (homewards.to_latitude_deg, homewards.to_longitude_deg)
    assert bench.current(is_flown=False) == ()


def test_nothing_is_asked_before_a_vehicle_is_met_or_unless_the_mission_is_used() -> None:
    bench, unused = Bench(is_streamed=False), Bench(is_used=False, is_streamed=False)
    bench.reader.meet(0)
    unused.current()
    for one in (bench, unused):
        one.run(5.0)
        assert not one.sent


def test_the_mission_is_read_before_anything_is_heard_of_it() -> None:
    bench = Bench()
    bench.run(5.0)
    assert bench.reader.items == MISSION
    assert bench.legs == []
    assert bench.current() == (leg_report(MISSION, 5, bench.now_s),)
    bench.run(5.0)
    assert len(bench.of("MISSION_REQUEST_LIST")) == 1


@pytest.mark.parametrize("total", [0, 6, 7])  # not told, as ArduPilot counts, as PX4 does
def test_a_first_total_that_fits_what_was_read_is_no_other_mission(total: int) -> None:
    bench = Bench()
    bench.run(5.0)
    assert bench.current(total=total) != ()
    during = Bench()
    during.run(0.2)
    during.current(total=total)
    during.run(4.0)
    assert during.reader.items == MISSION
    assert len(during.of("MISSION_REQUEST_LIST")) == 1


@pytest.mark.parametrize("total", [5, 8, 65535])
def test_a_first_total_that_does_not_fit_is_another_mission(total: int) -> None:
    bench = Bench()
    bench.run(5.0)
    assert bench.current(total=total) == ()
    assert bench.reader.items is None


def test_the_item_that_says_it_is_flown_to_gives_the_leg_until_news_come() -> None:
    bench = Bench()
    bench.flagged = 5
    bench.run(5.0)
    (leg_,) = bench.legs
    assert leg_ == leg_report(MISSION, 5, leg_.received_s)
    assert 100.0 < leg_.received_s < 102.0
    assert bench.current(sequence=6) == (leg_report(MISSION, 6, bench.now_s),)


def test_what_was_heard_in_the_meantime_counts_more_than_an_item_read_before() -> None:
    bench = Bench()
    bench.flagged = 3
    bench.run(0.3)
    assert bench.current(sequence=5) == ()
    bench.run(5.0)
    assert [leg_ == leg_report(MISSION, 5, leg_.received_s) for leg_ in bench.legs] == [True]
    told = Bench()
    told.flagged = 5
    told.current(is_flown=False)
    told.run(5.0)
    assert told.legs == []


def test_a_mission_that_is_read_again_tells_no_old_leg_anew() -> None:
    bench = known()
    heard = len(bench.legs)
    bench.run(40.0)
    assert len(bench.of("MISSION_REQUEST_LIST")) == 2
    assert len(bench.legs) == heard


@pytest.mark.parametrize("total", [65535])
def test_a_vehicle_without_missions_is_not_asked(total: int) -> None:
    bench = Bench()
    bench.current(total=total)
    bench.run(5.0)
    assert not bench.sent


def test_an_armed_vehicle_is_not_asked_and_what_is_known_stays() -> None:
    bench = Bench()
    bench.is_armed = True
    bench.current()
    bench.run(5.0)
    assert not bench.sent
    bench.is_armed = False
    bench.run(5.0)
    bench.is_armed = True
    bench.run(60.0)
    assert bench.current() != ()
    assert len(bench.of("MISSION_REQUEST_LIST")) == 1


def test_arming_ends_a_transfer() -> None:
    bench = Bench()
    bench.current()
    bench.run(0.2)
    before = len(bench.sent)
    bench.is_armed = True
    bench.run(5.0)
    assert len(bench.sent) == before
    assert bench.reader.items is None


def test_a_mission_of_another_length_is_read_again_and_the_old_one_not_used() -> None:
    bench = known()
    bench.items = MISSION[:4]
    assert bench.current(sequence=3) == ()
    bench.run(5.0)
    assert bench.reader.items == MISSION[:4]


def test_a_mission_of_the_same_length_is_noticed_in_time() -> None:
    bench = known()
    bench.items = (*MISSION[:3], item(WAYPOINT, AHEAD), *MISSION[4:])
    bench.run(35.0)
    assert bench.reader.items == bench.items


def test_somebody_elses_transfer_is_waited_for() -> None:
    bench = Bench()
    bench.current()
    for _ in range(10):
        bench.transfer(MissionStep.ITEM, 1, to=(255, 190))
        bench.run(1.0)
    assert not bench.sent
    bench.run(5.0)
    assert bench.reader.items == MISSION


def test_a_mission_comes_from_the_autopilot_alone() -> None:
    bench = Bench()
    bench.current()
    while bench.reader.items is None:
        # A camera of the same system is always first, with another mission.
        bench.transfer(MissionStep.COUNT, 1, sender=(1, 100))
        bench.transfer(MissionStep.ITEM, 0, sender=(1, 100))
        bench.transfer(MissionStep.ENDED, sender=(1, 100))
        bench.run(0.05)
        assert bench.now_s < 160.0
    assert bench.reader.items == MISSION


def test_what_is_being_written_is_not_what_was_read() -> None:
    bench = known()
    bench.is_armed = True
    bench.transfer(MissionStep.DOWNLOAD, sender=(255, 190), to=VEHICLE)
    assert bench.current() != ()
    bench.transfer(MissionStep.UPLOAD, to=(255, 190))
    assert bench.current() == ()


@pytest.mark.parametrize(
    ("sender", "to"),
    [((7, 1), (255, 190)), ((255, 190), (7, 1)), ((7, 100), (7, 1)), ((255, 190), (1, 100))],
)
def test_what_is_written_to_or_read_from_somebody_else_is_not_this_mission(
    sender: tuple[int, int], to: tuple[int, int]
) -> None:
    # Two vehicles on one network: the other one's transfers are heard too.
    bench = known()
    for step in (MissionStep.UPLOAD, MissionStep.COUNT, MissionStep.DOWNLOAD):
        bench.transfer(step, sender=sender, to=to)
    assert bench.current() != ()
    bench = Bench(is_needed=True)
    bench.current()
    for _ in range(40):
        bench.transfer(MissionStep.UPLOAD, sender=sender, to=to)
        bench.run(0.1)
    assert bench.reader.items == MISSION


@pytest.mark.parametrize("to", [(1, 1), (1, 0), (0, 0), (0, 1)])
def test_what_is_written_to_everyone_is_written_to_the_vehicle(to: tuple[int, int]) -> None:
    bench = known()
    bench.transfer(MissionStep.UPLOAD, sender=(255, 190), to=to)
    assert bench.current() == ()


def test_silence_is_asked_again_and_given_up_with_one_warning() -> None:
    bench = Bench()
    bench.answers = False
    bench.current()
    bench.run(60.0)
    assert len(bench.of("MISSION_REQUEST_LIST")) == 5
    assert len(bench.warnings) == 1


def test_an_item_that_never_comes_ends_in_giving_up_too() -> None:
    bench = Bench()
    bench.answers = False
    bench.current()
    for _ in range(3000):
        before = len(bench.sent)
        bench.run(0.02)
        if any(m.get_type() == "MISSION_REQUEST_LIST" for _, m in bench.sent[before:]):
            bench.transfer(MissionStep.COUNT, 7)
    assert len(bench.of("MISSION_REQUEST_INT")) == 25
    assert len(bench.warnings) == 1


def test_a_refusal_is_followed_by_a_pause() -> None:
    bench = Bench()
    bench.answers = False
    bench.current()
    bench.run(0.1)
    bench.transfer(MissionStep.ENDED, 13)
    bench.run(2.0)
    assert len(bench.of("MISSION_REQUEST_LIST")) == 1
    bench.answers = True
    bench.run(5.0)
    assert bench.reader.items == MISSION


def test_items_out_of_turn_and_of_nobodys_asking_are_ignored() -> None:
    bench = Bench()
    bench.answers = False
    bench.transfer(MissionStep.ITEM, 0)
    bench.transfer(MissionStep.COUNT, 2)
    bench.current()
    bench.run(0.1)
    bench.transfer(MissionStep.ITEM, 0)
    bench.transfer(MissionStep.COUNT, 2)
    bench.run(0.1)
    bench.transfer(MissionStep.ITEM, 1)
    bench.transfer(MissionStep.ITEM, 0)
    bench.transfer(MissionStep.ITEM, 0)
    bench.run(0.1)
    bench.transfer(MissionStep.ITEM, 1)
    assert bench.reader.items == MISSION[:2]


def test_a_mission_beyond_the_bound_is_refused_with_a_warning() -> None:
    bench = Bench()
    bench.answers = False
    bench.current()
    bench.run(0.1)
    bench.transfer(MissionStep.COUNT, ITEMS_MAX + 1)
    bench.run(60.0)
    assert len(bench.of("MISSION_REQUEST_INT")) == 0
    assert [message.type for _, message in bench.sent[1:]] == [15]
    assert bench.warnings == ["mission of 2001 items is not used"]


def test_an_empty_mission_is_known_and_has_no_legs() -> None:
    bench = known(items=())
    assert bench.reader.items == ()
    assert bench.current() == ()


def test_another_vehicle_has_another_mission() -> None:
    bench = known()
    bench.reader.meet(1)
    assert bench.reader.items is None
