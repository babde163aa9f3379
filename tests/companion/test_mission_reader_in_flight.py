"""The mission read in flight, where its items are not streamed, and over the wire."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.core.types import LegReport
from companion.link.component import Component, ComponentOptions
from companion.link.messages import (
    MissionStep,
)
from companion.link.mission_reader import leg_report
from companion.link.streams import wanted_streams
from tests.companion.mission_bench import (
    AHEAD,
    MISSION,
    TAKE_OFF,
    WAYPOINT,
    A,
    B,
    Bench,
    item,
    known,
)
from tests.sitl import stub_bench

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
