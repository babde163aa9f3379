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
from companion.link.mission_legs import leg_report
from companion.link.mission_messages import (
    MissionCurrent,
    MissionItem,
    MissionStep,
    MissionTransfer,
)
from companion.link.mission_reader import ITEMS_MAX, MissionReader
from companion.link.streams import wanted_streams
from tests.unit import stub_bench

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

    def __init__(self, *, is_used: bool = True, items: Sequence[MissionItem] = MISSION) -> None:
        self.sent: list[tuple[float, Any]] = []
        self.warnings: list[str] = []
        self.items = items
        self.now_s = 100.0
        self.is_armed = False
        self.answers = True
        self._parser = mavlink.MAVLink(None)
        encoder = Encoder(system_id=1, component_id=191)
        self.reader = MissionReader(encoder, self._send, self.warnings.append, is_used=is_used)
        self.reader.meet(1)

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
        )
        assert self.reader.take(message) == ()

    def current(self, sequence: int = 5, **more: Any) -> tuple[LegReport, ...]:
        told = {"total": len(self.items) - 1} | more
        return self.reader.take(MissionCurrent(received_s=self.now_s, sequence=sequence, **told))

    def run(self, duration_s: float) -> None:
        for _ in range(round(duration_s / 0.02)):
            self.now_s += 0.02
            before = len(self.sent)
            self.reader.tick(self.now_s, is_armed=self.is_armed)
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


def test_nothing_is_asked_before_a_mission_is_heard_of_or_unless_it_is_used() -> None:
    bench, unused = Bench(), Bench(is_used=False)
    unused.current()
    for one in (bench, unused):
        one.run(5.0)
        assert not one.sent


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


def test_what_is_being_written_is_not_what_was_read() -> None:
    bench = known()
    bench.is_armed = True
    bench.transfer(MissionStep.DOWNLOAD, sender=(255, 190), to=VEHICLE)
    assert bench.current() != ()
    bench.transfer(MissionStep.UPLOAD, to=(255, 190))
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


def test_the_stub_autopilots_mission_gives_the_legs_that_it_flies() -> None:
    bench = stub_bench.Bench(items=stub_bench.mission((60.0, 0.0), (60.0, 6.0), (0.0, 6.0)))
    channels: list[Any] = []
    options = ComponentOptions(use_mission=True)
    component = Component(
        options, lambda frame: bench.autopilot.receive(channels[0], frame, bench.now_s) is None
    )
    legs: list[LegReport] = []

    def take(frame: bytes) -> None:
        found = component.receive(frame, bench.now_s)
        legs.extend(one for one in found if isinstance(one, LegReport))

    channels.append(bench.autopilot.attach("companion", take))

    def run(duration_s: float) -> None:
        for _ in range(round(duration_s / 0.1)):
            bench.run(0.1)
            component.tick(None, bench.now_s)

    run(6.0)
    bench.fly()
    run(12.0)
    frame = stub_bench.HOME
    ends = [
        (*frame.to_local(leg.from_latitude_deg, leg.from_longitude_deg),
         *frame.to_local(leg.to_latitude_deg, leg.to_longitude_deg))
        for leg in legs
    ]  # fmt: skip
    assert ends
    assert ends[-1] == pytest.approx((0.0, 0.0, 60.0, 0.0), abs=0.05)
    assert legs[-1].stops
    assert bench.now_s - legs[-1].received_s < 1.0
