"""Reading the mission: once, paced, never in anybody's way; and which leg it says is flown."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.core.types import LegReport
from companion.link.component import Component, ComponentOptions
from companion.link.encode import Encoder
from companion.link.messages import (
    MissionCurrent,
    MissionItem,
    MissionStep,
    MissionTransfer,
)
from companion.link.mission_reader import ITEMS_MAX, MissionReader, leg_report
from companion.link.streams import wanted_streams
from tests.sitl import stub_bench

WAYPOINT, LOITER_TURNS, LOITER_TIME, RTL, LAND, TAKE_OFF, SPLINE = 16, 18, 19, 20, 21, 22, 82
JUMP, SPEED, SERVO = 177, 178, 183
A, B, C, AHEAD = (36.0, 114.0), (36.001, 114.0), (36.001, 114.001), (36.002, 114.00001)
VEHICLE, OURS = (1, 1), (1, 191)


def item(command: int, place: tuple[float, float] | None = None, **more: float) -> MissionItem:
    return MissionItem(command=command, place=place, **({"param1": 0.0, "param2": 0.0} | more))


MISSION = (
    item(WAYPOINT, A),
    item(TAKE_OFF),
    item(SPEED, param1=1.0, param2=5.0),
    item(WAYPOINT, B),
    item(SERVO),
    item(WAYPOINT, C),
    item(RTL),
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


class Bench:
    """A reader, and an autopilot that answers as it is told to."""

    def __init__(
        self,
        *,
        is_used: bool = True,
        is_needed: bool = False,
        is_streamed: bool = True,
        items: Sequence[MissionItem] = MISSION,
    ) -> None:
        self.sent: list[tuple[float, Any]] = []
        self.warnings: list[str] = []
        self.legs: list[LegReport] = []  # that came with an item, and not with MISSION_CURRENT
        self.flagged: int | None = None  # the item that says it is flown to
        self.flies_mission = True
        self.items = items
        self.now_s = 100.0
        self.is_armed = False
        self.answers = True
        self._parser = mavlink.MAVLink(None)
        encoder = Encoder(system_id=1, component_id=191)
        self.reader = MissionReader(
            encoder, self._send, self.warnings.append, is_used=is_used, is_needed=is_needed
        )
        self.reader.meet(1, is_streamed=is_streamed)

    def _send(self, frame: bytes) -> bool:
        self.sent.extend((self.now_s, message) for message in self._parser.parse_buffer(frame))
        return True

    def transfer(self, step: MissionStep, number: int = 0, **more: Any) -> None:
        about = {"sender": VEHICLE, "to": OURS} | more
        item_ = self.items[number] if step is MissionStep.ITEM else None
        message = MissionTransfer(
            received_s=self.now_s,
            system_id=about["sender"][0],
            component_id=about["sender"][1],
            target_system=about["to"][0],
            target_component=about["to"][1],
            step=step,
            number=number,
            item=item_,
            is_current=step is MissionStep.ITEM and number == self.flagged,
        )
        self.legs += self.reader.take(message)

    def current(self, sequence: int = 5, **more: Any) -> tuple[LegReport, ...]:
        told = {"total": len(self.items) - 1} | more
        return self.reader.take(MissionCurrent(received_s=self.now_s, sequence=sequence, **told))

    def run(self, duration_s: float) -> None:
        for _ in range(round(duration_s / 0.02)):
            self.now_s += 0.02
            before = len(self.sent)
            self.reader.tick(self.now_s, is_armed=self.is_armed, flies_mission=self.flies_mission)
            for _, message in self.sent[before:] if self.answers else ():
                match message.get_type():
                    case "MISSION_REQUEST_LIST":
                        self.transfer(MissionStep.COUNT, len(self.items))
                    case "MISSION_REQUEST_INT":
                        self.transfer(MissionStep.ITEM, message.seq)

    def of(self, kind: str) -> list[float]:
        return [at_s for at_s, message in self.sent if message.get_type() == kind]


def known(**options: Any) -> Bench:
    bench = Bench(**options)
    bench.current()
    bench.run(5.0)
    return bench


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


# ------------------------------------------------------------- where nothing opens without a leg


def test_where_the_leg_is_needed_it_is_read_in_flight_too_and_then_left_alone() -> None:
    bench = Bench(is_needed=True)
    bench.is_armed = True
    bench.flagged = 5
    bench.run(5.0)
    assert bench.reader.items == MISSION
    assert len(bench.legs) == 1
    bench.run(120.0)
    assert len(bench.of("MISSION_REQUEST_LIST")) == 1
    bench.items = MISSION[:6]
    bench.current(sequence=3)
    bench.run(5.0)
    assert bench.reader.items == MISSION[:6]


def test_who_does_not_fly_the_mission_is_not_asked_in_flight() -> None:
    bench = Bench(is_needed=True)
    bench.is_armed, bench.flies_mission = True, False
    bench.run(10.0)
    assert not bench.sent


def test_arming_does_not_end_a_transfer_that_is_needed() -> None:
    bench = Bench(is_needed=True)
    bench.run(0.2)
    bench.is_armed = True
    bench.run(2.0)
    assert bench.reader.items == MISSION
    assert len(bench.of("MISSION_REQUEST_LIST")) == 1


def test_a_mission_written_in_flight_is_read_after_the_writer_is_done() -> None:
    bench = known(is_needed=True)
    bench.is_armed = True
    bench.items = (*MISSION[:3], item(WAYPOINT, AHEAD), *MISSION[4:])
    bench.transfer(MissionStep.UPLOAD, to=(255, 190))
    assert bench.current() == ()
    before = len(bench.sent)
    bench.run(2.9)
    assert len(bench.sent) == before
    bench.run(3.0)
    assert bench.reader.items == bench.items


def test_where_a_vehicle_was_in_the_old_mission_says_nothing_of_the_new_one() -> None:
    bench = known(is_needed=True)
    bench.is_armed = True
    bench.legs.clear()
    bench.transfer(MissionStep.UPLOAD, to=(255, 190))
    bench.flagged = 3
    bench.run(6.0)
    assert [leg_ == leg_report(MISSION, 3, leg_.received_s) for leg_ in bench.legs] == [True]


def test_what_cannot_be_read_is_tried_again_every_half_minute_and_told_once() -> None:
    bench = Bench(is_needed=True)
    bench.answers = False
    bench.is_armed = True
    bench.run(120.0)
    # Five beginnings take 7.5 s, and 30 s are waited after them.
    assert 15 <= len(bench.of("MISSION_REQUEST_LIST")) <= 20
    assert bench.warnings == ["mission cannot be read", "valves stay closed while it is flown"]
    bench.answers = True
    bench.run(40.0)
    assert bench.reader.items == MISSION
    bench.answers = False
    bench.current(total=3)
    bench.run(60.0)
    assert len(bench.warnings) == 4


def test_another_vehicle_and_another_mission_are_asked_at_once() -> None:
    bench = Bench(is_needed=True)
    bench.answers = False
    bench.run(10.0)  # given up for half a minute
    before = len(bench.sent)
    bench.run(5.0)
    assert len(bench.sent) == before
    bench.answers = True
    bench.current()
    bench.run(2.0)
    assert bench.reader.items == MISSION
    bench.reader.meet(1)
    bench.answers = False
    bench.run(10.0)
    bench.answers = True
    bench.reader.meet(1)
    bench.run(2.0)
    assert bench.reader.items == MISSION


# ------------------------------------------------------------- where the item is not streamed


def test_an_item_that_is_not_streamed_is_asked_for_and_a_refusal_ends_that() -> None:
    streamed, bench = known(), Bench(is_streamed=False)
    assert not streamed.of("COMMAND_LONG")
    bench.run(0.1)
    (asked,) = [m for _, m in bench.sent if m.get_type() == "COMMAND_LONG"]
    assert (asked.command, asked.param1) == (512, 42.0)
    bench.reader.answered(2)
    bench.run(120.0)
    assert len(bench.of("COMMAND_LONG")) == 1
    bench.reader.meet(1, is_streamed=False)
    bench.run(0.5)
    assert len(bench.of("COMMAND_LONG")) == 2


def test_requests_in_vain_are_few() -> None:
    bench = Bench(is_streamed=False)
    bench.run(29.0)
    asked = bench.of("COMMAND_LONG")
    assert len(asked) == 3
    assert all(b - a >= 0.99 for a, b in pairwise(asked))
    for _ in range(6):  # PX4 says it by itself every ten seconds: that is no answer
        bench.current()
        bench.run(10.0)
    assert 6 <= len(bench.of("COMMAND_LONG")) <= 12


def test_where_it_answers_it_is_asked_once_a_second() -> None:
    bench = Bench(is_streamed=False)
    for _ in range(30):
        before = len(bench.of("COMMAND_LONG"))
        bench.run(0.5)
        if len(bench.of("COMMAND_LONG")) > before:
            bench.current()
            bench.reader.answered(0)
    assert 10 <= len(bench.of("COMMAND_LONG")) <= 15


# -------------------------------------------------------------------------------------- on the wire


def test_only_a_component_that_uses_missions_asks_for_the_current_item() -> None:
    def has_42(**options: bool) -> bool:
        streams = wanted_streams(position_rate_hz=20.0, **options)
        return 42 in {stream.message_id for stream in streams}

    assert has_42(is_px4=False, with_mission=True)
    assert not has_42(is_px4=False)
    assert not has_42(is_px4=True, with_mission=True)


class Autopilot:
    """Answers the mission protocol as bytes."""

    def __init__(self, *, use_mission: bool) -> None:
        self._mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        self._parser = mavlink.MAVLink(None)
        self.asked: list[Any] = []
        options = ComponentOptions(use_mission=use_mission)
        self.component = Component(options, self._take)
        self.inputs: list[Any] = []

    def _take(self, frame: bytes) -> bool:
        self.asked += self._parser.parse_buffer(frame) or []
        return True

    def say(self, message: Any, now_s: float) -> None:
        frame = bytes(message.pack(self._mav))
        self.inputs += self.component.receive(frame, now_s)

    def answer(self, now_s: float) -> None:
        asked, self.asked = self.asked, []
        for one in asked:
            if one.get_type() == "MISSION_REQUEST_LIST":
                self.say(self._mav.mission_count_encode(1, 191, 3), now_s)
            elif one.get_type() == "MISSION_REQUEST_INT":
                place = (A, A, B)[one.seq]
                x, y = round(place[0] * 1e7), round(place[1] * 1e7)
                command = (WAYPOINT, TAKE_OFF, WAYPOINT)[one.seq]
                self.say(
                    self._mav.mission_item_int_encode(
                        1, 191, one.seq, 6, command, 0, 1, 0, 0, 0, 0, x, y, 3.5
                    ),
                    now_s,
                )

    def fly(self) -> list[LegReport]:
        for count in range(60):
            now_s = 10.0 + 0.05 * count
            if count % 20 == 0:
                self.say(self._mav.heartbeat_encode(2, 3, 0, 0, 3), now_s)
            if count % 10 == 0:
                self.say(self._mav.mission_current_encode(2, 2, 3, 0), now_s)
            self.component.tick(None, now_s)
            self.answer(now_s)
        return [one for one in self.inputs if isinstance(one, LegReport)]


def test_legs_come_out_of_bytes() -> None:
    legs = Autopilot(use_mission=True).fly()
    assert legs
    assert (legs[-1].from_latitude_deg, legs[-1].from_longitude_deg) == pytest.approx(A)
    assert (legs[-1].to_latitude_deg, legs[-1].to_longitude_deg) == pytest.approx(B)
    assert legs[-1].stops


def test_a_component_that_uses_no_mission_reads_none() -> None:
    autopilot = Autopilot(use_mission=False)
    assert autopilot.fly() == []
    assert not [one for one in autopilot.asked if "MISSION" in one.get_type()]


class OnStub:
    """A component on the wire to a stub autopilot; what it was told of its legs, and where to."""

    def __init__(self, autopilot: str, *, need_mission: bool = False) -> None:
        items = stub_bench.mission((60.0, 0.0), (60.0, 6.0), (0.0, 6.0))
        self.bench = stub_bench.Bench(autopilot=autopilot, items=items)
        self.options = ComponentOptions(use_mission=True, need_mission=need_mission)
        self.loses: set[str] = set()
        self.asked: list[Any] = []
        self.legs: list[LegReport] = []
        self._parser = mavlink.MAVLink(None)
        self._channel = self.bench.autopilot.attach("companion", self._take)
        self.start()

    def start(self) -> None:
        """Begin anew, as after a crash: nothing is known."""
        self.component = Component(self.options, self._send)

    def _send(self, frame: bytes) -> bool:
        self.asked += self._parser.parse_buffer(frame)
        self.bench.autopilot.receive(self._channel, frame, self.bench.now_s)
        return True

    def _take(self, frame: bytes) -> None:
        (message,) = mavlink.MAVLink(None).parse_buffer(frame)
        if message.get_type() not in self.loses:
            found = self.component.receive(frame, self.bench.now_s)
            self.legs += [one for one in found if isinstance(one, LegReport)]

    def run(self, duration_s: float) -> None:
        for _ in range(round(duration_s / 0.1)):
            self.bench.run(0.1)
            self.component.tick(None, self.bench.now_s)

    def fly(self) -> None:
        self.bench.companion.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1)
        self.run(0.2)
        self.bench.companion.command(mavlink.MAV_CMD_MISSION_START)
        self.run(0.2)
        assert self.bench.autopilot.flight.armed

    def ends(self) -> list[tuple[int, ...]]:
        """Return the legs that were told, each once: east and north of both ends in metres."""
        found: list[tuple[int, ...]] = []
        for leg_ in self.legs:
            begin = stub_bench.HOME.to_local(leg_.from_latitude_deg, leg_.from_longitude_deg)
            end = stub_bench.HOME.to_local(leg_.to_latitude_deg, leg_.to_longitude_deg)
            whole = tuple(map(round, (*begin, *end)))
            found += [whole] if not found or found[-1] != whole else []
        return found


OUT, ACROSS, BACK = (0, 0, 60, 0), (60, 0, 60, 6), (60, 6, 0, 6)


def test_the_stub_autopilots_mission_gives_the_legs_that_it_flies() -> None:
    wire = OnStub("ardupilot")
    wire.run(6.0)
    wire.fly()
    wire.run(12.0)
    assert wire.ends()[-1] == OUT
    assert wire.legs[-1].stops
    assert wire.bench.now_s - wire.legs[-1].received_s < 1.0


@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
def test_armed_as_soon_as_it_is_heard_every_leg_is_known(autopilot: str) -> None:
    wire = OnStub(autopilot, need_mission=True)
    wire.run(1.2)  # a heartbeat has come, and of PX4 no news of its mission for ten seconds
    wire.fly()
    wire.run(40.0)
    told = wire.ends()
    assert [each for each in told if each[:2] != each[2:]][-3:] == [OUT, ACROSS, BACK]


@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
def test_started_anew_in_flight_it_knows_the_leg_within_two_seconds(autopilot: str) -> None:
    wire = OnStub(autopilot, need_mission=True)
    wire.run(1.2)
    wire.fly()
    wire.run(10.0)
    assert wire.ends()[-1] == OUT
    wire.legs.clear()
    wire.start()
    wire.run(2.0)
    assert wire.ends() == [OUT]


@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
def test_where_the_leg_is_not_needed_a_vehicle_in_flight_is_not_asked(autopilot: str) -> None:
    wire = OnStub(autopilot)
    wire.run(1.2)
    wire.fly()
    wire.start()
    wire.asked.clear()
    wire.run(12.0)
    assert not [one for one in wire.asked if one.get_type().startswith("MISSION")]


def test_px4_refuses_what_is_asked_for_once() -> None:
    wire = OnStub("px4", need_mission=True)
    wire.run(1.2)
    wire.fly()
    wire.run(20.0)
    asked = [one for one in wire.asked if one.get_type() == "COMMAND_LONG" and one.command == 512]
    assert [one.param1 for one in asked] == [42.0]


def test_without_any_news_of_px4_the_items_themselves_say_which_is_flown() -> None:
    wire = OnStub("px4", need_mission=True)
    wire.run(1.2)
    wire.fly()
    wire.run(10.0)
    wire.loses = {"MISSION_CURRENT"}
    wire.legs.clear()
    wire.start()
    wire.run(2.0)
    assert wire.ends() == [OUT]
