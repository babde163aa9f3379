"""A well-behaved component: heartbeat, answers, streams, a link that returns, orders."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.core.types import ClockReport, OperatorCommand, Telemetry
from companion.link.codec import FROM_ANYONE, FROM_VEHICLE
from companion.link.component import Component, ComponentOptions
from companion.link.vehicle_link import VehicleLink
from tests.companion import component_peer
from tests.companion.component_peer import CLOSED, VEHICLE, Peer, UpAndDown

peer, component, met = component_peer.peer, component_peer.component, component_peer.met


def test_the_heartbeat_is_there_from_the_first_step(peer: Peer, component: Component) -> None:
    component.tick(None, 100.0)
    (heartbeat,) = peer.of("HEARTBEAT")
    assert (heartbeat.type, heartbeat.autopilot) == (18, 8)
    assert (heartbeat.get_srcSystem(), heartbeat.get_srcComponent()) == (1, 191)


def test_the_heartbeat_goes_on_once_a_second_however_often_the_loop_turns(
    peer: Peer, component: Component
) -> None:
    for turn in range(301):
        component.tick(CLOSED, 100.0 + turn * 0.033)
    assert len(peer.of("HEARTBEAT")) == 10


def test_what_is_said_before_anybody_hears_it_is_told_to_the_first_who_does(
    peer: Peer, component: Component
) -> None:
    peer.is_up = False
    component.warn("last run was killed")
    component.fault("no guardian")
    for turn in range(20):
        component.tick(CLOSED, 100.0 + turn * 0.06)
    peer.is_up = True
    component.receive(peer.heartbeat(), 101.2)
    for turn in range(20):
        component.tick(CLOSED, 101.2 + turn * 0.06)
    told = peer.texts()
    assert told[:2] == ["Spray: last run was killed", "Spray: no guardian"]
    assert [text[:9] for text in told[2:]] == ["Spray off"]


def test_without_the_loop_there_is_no_heartbeat(peer: Peer, component: Component) -> None:
    component.tick(CLOSED, 0.0)
    peer.sent.clear()
    component.receive(peer.heartbeat(), 5.0)
    assert not peer.of("HEARTBEAT")


def test_we_speak_as_the_vehicles_system_once_it_is_known(peer: Peer, met: Component) -> None:
    met.tick(None, 0.0)
    assert peer.of("HEARTBEAT")[0].get_srcSystem() == VEHICLE


def test_a_configured_system_is_kept(peer: Peer) -> None:
    component = Component(ComponentOptions(system_id=3), peer.take)
    component.receive(peer.heartbeat(), 0.0)
    component.tick(None, 0.0)
    assert peer.of("HEARTBEAT")[0].get_srcSystem() == 3
    assert not component.is_vehicle_known


def test_an_unknown_command_is_unsupported(peer: Peer, met: Component) -> None:
    assert met.receive(peer.command(400, 1.0), 1.0) == []
    (ack,) = peer.of("COMMAND_ACK")
    assert (ack.command, ack.result) == (400, 3)
    assert (ack.target_system, ack.target_component) == (255, 190)


@pytest.mark.parametrize("value", [1.0, 0.0])
def test_do_sprayer_is_the_operators_wish(peer: Peer, met: Component, value: float) -> None:
    inputs = met.receive(peer.command(216, value), 1.0)
    assert inputs == [OperatorCommand(received_s=1.0, enable=value == 1.0, source="command")]
    assert peer.of("COMMAND_ACK")[0].result == 0


@pytest.mark.parametrize("value", [0.5, 2.0, -1.0, float("nan"), float("inf")])
def test_do_sprayer_with_anything_else_is_denied(peer: Peer, met: Component, value: float) -> None:
    assert met.receive(peer.command(216, value), 1.0) == []
    assert peer.of("COMMAND_ACK")[0].result == 2


@pytest.mark.parametrize("target", [{"to": 1}, {"to": 0}, {"to": 190}, {"system": 8}])
def test_what_is_not_addressed_to_us_is_neither_obeyed_nor_answered(
    peer: Peer, met: Component, target: dict[str, int]
) -> None:
    assert met.receive(peer.command(216, 1.0, **target), 1.0) == []
    assert not peer.sent


def test_every_command_is_answered_even_when_repeated(peer: Peer, met: Component) -> None:
    for _ in range(3):
        met.receive(peer.command(216, 1.0), 1.0)
    assert len(peer.of("COMMAND_ACK")) == 3


def test_commands_in_integers_are_answered_too(peer: Peer, met: Component) -> None:
    command = peer.ground("command_int", VEHICLE, 191, 0, 216, 0, 0, 1.0, 0, 0, 0, 0, 0, 0.0)
    assert len(met.receive(command, 1.0)) == 1
    assert peer.of("COMMAND_ACK")[0].result == 0


def test_our_version_can_be_asked_for(peer: Peer, met: Component) -> None:
    met.receive(peer.command(512, 148.0), 1.0)
    assert peer.of("COMMAND_ACK")[0].result == 0
    (version,) = peer.of("AUTOPILOT_VERSION")
    assert version.flight_sw_version >> 8 == 0x000100
    met.receive(peer.command(512, 33.0), 1.0)
    assert peer.of("COMMAND_ACK")[1].result == 3


def test_time_questions_are_answered_with_our_time(peer: Peer, met: Component) -> None:
    met.receive(peer.autopilot("timesync", 0, 123_456), 2.0)
    (answer,) = peer.of("TIMESYNC")
    assert (answer.tc1, answer.ts1) == (2_000_000_000, 123_456)


def test_pings_to_all_are_echoed_to_their_sender(peer: Peer, met: Component) -> None:
    met.receive(peer.ground("ping", 99, 5, 0, 0), 1.0)
    met.receive(peer.ground("ping", 99, 6, VEHICLE, 191), 1.0)
    (echo,) = peer.of("PING")
    assert (echo.time_usec, echo.seq) == (99, 5)
    assert (echo.target_system, echo.target_component) == (255, 190)


def test_the_clocks_are_compared_and_every_exchange_is_told(peer: Peer, met: Component) -> None:
    told: list[Any] = []
    for now_s, round_trip_s in [(10.0, 0.2), (11.0, 0.004), (12.0, 0.3)]:
        peer.sent.clear()
        met.tick(None, now_s)
        (question,) = peer.of("TIMESYNC")
        there_ns = round((now_s + 0.5 * round_trip_s - 5.0) * 1e9)  # 5 s between the clocks
        answered = peer.autopilot("timesync", there_ns, question.ts1)
        told += met.receive(answered, now_s + round_trip_s)
    assert met.clock.round_trip_s == pytest.approx(0.004)
    assert [report.round_trip_s for report in told] == pytest.approx([0.2, 0.004, 0.3])
    assert [report.offset_s for report in told] == pytest.approx([5.0] * 3)


def test_answers_to_other_peoples_questions_are_ignored(peer: Peer, met: Component) -> None:
    met.tick(None, 10.0)
    met.receive(peer.autopilot("timesync", 77, 88), 10.1)
    assert not met.clock.is_known


def said_by(
    component_id: int, name: str, *fields: Any, system: int = VEHICLE, **more: Any
) -> bytes:
    """Return a frame of a component of the vehicle that is not its autopilot."""
    sender = mavlink.MAVLink(None, srcSystem=system, srcComponent=component_id)
    message = getattr(sender, f"{name}_encode")(*fields, **more)
    return bytes(message.pack(sender))


@pytest.mark.parametrize("component_id", [2, 100, 154, 190, 191, 240])
def test_only_the_autopilot_tells_the_time(peer: Peer, met: Component, component_id: int) -> None:
    met.tick(None, 10.0)
    (question,) = peer.of("TIMESYNC")
    first = said_by(component_id, "timesync", 5_450_000_000, question.ts1)
    assert met.receive(first, 10.002) == []
    assert not met.clock.is_known
    (report,) = met.receive(peer.autopilot("timesync", 5_000_000_000, question.ts1), 10.004)
    assert isinstance(report, ClockReport)
    assert report.offset_s == pytest.approx(5.002)


# What counts from anyone: questions to us and commands, each judged by whom it is addressed to;
# TIMESYNC and the transfers of missions look at their sender themselves.
FROM_ANYONE_TOO = {4, 20, 21, 23, 38, 40, 43, 44, 45, 47, 51, 73, 75, 76, 111}


@pytest.mark.parametrize("message_id", sorted(FROM_VEHICLE))
def test_nobody_but_the_autopilot_describes_the_vehicle(
    peer: Peer, met: Component, message_id: int
) -> None:
    heard: list[Any] = []
    met.outputs.report = heard.append  # type: ignore[method-assign,assignment]
    met.outputs.parameter = heard.append  # type: ignore[method-assign,assignment]
    met.on_order_ack = heard.append
    kind = mavlink.mavlink_map[message_id]
    for system, component_id in ((VEHICLE, 100), (VEHICLE, 191), (VEHICLE, 0), (8, 1)):
        size = kind.unpacker.size
        frame = bytes((0xFD, size, 0, 0, 1, system, component_id))
        frame += message_id.to_bytes(3, "little") + b"\x01" * size
        check = mavlink.x25crc(frame[1:] + bytes([kind.crc_extra])).crc
        assert met.receive(frame + check.to_bytes(2, "little"), 1.0) == []
    assert met.codec.counts.frames == 5
    assert not heard
    assert met.mission_active is None
    assert set(FROM_ANYONE) == FROM_ANYONE_TOO


# ------------------------------------------------------------------------------------- streams


WANTED = {33: 20.0, 74: 10.0, 24: 5.0, 193: 2.0, 245: 2.0, 65: 5.0, 36: 10.0, 132: 10.0}


def test_streams_are_asked_for_when_the_vehicle_is_first_heard(
    peer: Peer, component: Component
) -> None:
    component.tick(None, 0.0)
    assert not peer.of("COMMAND_LONG")
    component.receive(peer.heartbeat(), 0.5)
    assert WANTED.items() <= peer.asked().items()
    commands = peer.of("COMMAND_LONG")
    assert all((m.target_system, m.target_component) == (VEHICLE, 1) for m in commands)
    assert all(m.param3 == 0.0 for m in commands)


def test_px4_is_asked_for_its_own_estimator(peer: Peer, component: Component) -> None:
    component.receive(peer.heartbeat(autopilot=12), 0.0)
    assert 230 in peer.asked()
    assert 193 not in peer.asked()


def fly(
    component: Component, peer: Peer, *, from_s: float, to_s: float, rate_hz: float = 20.0
) -> None:
    """Feed every wanted stream at its rate, the positions at `rate_hz`, and turn the loop."""
    steps = round((to_s - from_s) * 20)
    empty = {
        74: peer.autopilot("vfr_hud", 0.0, 0.0, 0, 0, 0.0, 0.0),
        24: peer.autopilot("gps_raw_int", 0, 6, 0, 0, 0, 0, 0, 0, 0, 0),
        193: peer.autopilot("ekf_status_report", 0, 0.0, 0.0, 0.0, 0.0, 0.0),
        245: peer.autopilot("extended_sys_state", 0, 0),
        65: peer.autopilot("rc_channels", 0, 0, *([0] * 18), 0),
        36: peer.autopilot("servo_output_raw", 0, 0, *([0] * 8)),
    }
    for number in range(steps):
        now_s = from_s + number / 20
        if int(number * rate_hz / 20) != int((number - 1) * rate_hz / 20):
            component.receive(peer.position(now_s), now_s)
        for message_id, frame in empty.items():
            if number % round(20 / WANTED[message_id]) == 0:
                component.receive(frame, now_s)
        component.tick(CLOSED, now_s)


def test_streams_that_come_are_left_alone(peer: Peer, met: Component) -> None:
    fly(met, peer, from_s=0.0, to_s=20.0)
    assert not peer.asked()


def test_a_slow_stream_is_asked_for_again_but_not_more_often_than_every_five_seconds(
    peer: Peer, met: Component
) -> None:
    fly(met, peer, from_s=0.0, to_s=20.0, rate_hz=10.0)
    assert set(peer.asked()) == {33}
    assert len(peer.of("COMMAND_LONG")) == 2


def test_after_two_failures_the_older_way_is_tried(peer: Peer, met: Component) -> None:
    fly(met, peer, from_s=0.0, to_s=18.0, rate_hz=10.0)
    (request,) = peer.of("REQUEST_DATA_STREAM")
    assert (request.req_stream_id, request.req_message_rate, request.start_stop) == (6, 20, 1)


def test_px4_is_never_asked_the_older_way(peer: Peer, component: Component) -> None:
    component.receive(peer.heartbeat(autopilot=12), 0.0)
    fly(component, peer, from_s=0.0, to_s=40.0, rate_hz=5.0)
    assert not peer.of("REQUEST_DATA_STREAM")


def test_after_a_reboot_every_stream_is_asked_for_anew(peer: Peer, met: Component) -> None:
    met.receive(peer.position(500.0), 1.0)
    met.receive(peer.position(499.5), 1.1)  # a message that was overtaken
    assert not peer.asked()
    for number in range(10):
        met.receive(peer.position(490.0 + number), 2.0 + number / 20)  # as old as a router's loop
    assert not peer.asked()
    for number in range(3):
        assert not peer.asked()
        met.receive(peer.position(3.0 + number / 20), 6.0 + number / 20)
    assert WANTED.items() <= peer.asked().items()


def test_positions_that_come_twice_are_counted_and_told_once(peer: Peer, met: Component) -> None:
    told: list[str] = []
    met.on_event = lambda _at_s, kind, text: told.append(text) if kind == "link" else None
    for number in range(100):
        for _ in range(3):
            met.receive(peer.position(500.0 + number / 20), 1.0 + number / 20)
        met.tick(None, 1.0 + number / 20)
    assert met.meter.copied_positions == 200
    assert [text for text in peer.texts() if "twice" in text] == [
        "Spray: positions arrive twice or late"
    ]
    assert len(told) == 1
    assert "positions twice or too late 200" in met.meter.read(met.codec, 6.0).line()


def test_after_the_link_was_away_every_stream_is_asked_for_anew(peer: Peer, met: Component) -> None:
    met.link_changed(3.0)
    assert WANTED.items() <= peer.asked().items()


# ------------------------------------------------------------------------------ link that returns


@pytest.mark.parametrize("heard_first", [True, False])
def test_a_link_that_returns_counts_once_a_step_was_taken_and_the_vehicle_was_heard(
    peer: Peer, heard_first: bool
) -> None:
    link = VehicleLink("udpin:127.0.0.1:14550", ComponentOptions())
    transport = link._transport = UpAndDown(peer)
    link._on_bytes(peer.heartbeat())
    link.receive()
    assert fault_of(link) is None
    transport.is_up = False
    link._on_change(False)
    assert fault_of(link) == "link is down"
    transport.is_up = True
    link._on_change(True)
    if heard_first:
        link._on_bytes(peer.position(1.0))
        link.receive()
        assert fault_of(link) is not None
        link.tell(CLOSED, 1.0)
    else:
        link.receive()
        link.tell(CLOSED, 1.0)
        assert fault_of(link) is not None
        link._on_bytes(peer.position(1.0))
        link.receive()
    assert fault_of(link) is None


def test_what_came_before_the_loss_is_neither_used_nor_taken_for_the_vehicle_s_return(
    peer: Peer,
) -> None:
    link = VehicleLink("udpin:127.0.0.1:14550", ComponentOptions())
    link._transport = UpAndDown(peer)
    link._on_bytes(peer.heartbeat())
    link._on_bytes(peer.position(1.0))
    link._on_change(False)
    link._on_change(True)
    assert link.receive() == []
    link.tell(CLOSED, 1.0)
    assert fault_of(link) is not None


def fault_of(link: VehicleLink) -> str | None:
    return link.fault


# --------------------------------------------------------------------------------------- orders


def test_no_order_leaves_before_the_vehicle_is_known(peer: Peer, component: Component) -> None:
    assert not component.order(9, 1000)
    component.receive(peer.heartbeat(), 0.0)
    peer.sent.clear()
    assert component.order(9, 1000)
    (order,) = peer.of("COMMAND_LONG")
    assert (order.target_system, order.target_component) == (VEHICLE, 1)


def test_an_order_that_cannot_leave_is_said_not_to_have_left(peer: Peer, met: Component) -> None:
    peer.is_up = False
    assert not met.order(9, 1000)


def test_answers_to_our_orders_reach_the_executor_and_no_others(peer: Peer, met: Component) -> None:
    results: list[int] = []
    met.on_order_ack = results.append
    met.receive(peer.autopilot("command_ack", 183, 4, 0, 0, VEHICLE, 191), 1.0)
    met.receive(peer.autopilot("command_ack", 183, 0, 0, 0, 0, 0), 1.0)
    met.receive(peer.autopilot("command_ack", 183, 4, 0, 0, 255, 190), 1.0)
    met.receive(peer.autopilot("command_ack", 511, 4, 0, 0, VEHICLE, 191), 1.0)
    assert results == [4, 0]


def test_positions_pass_through_as_inputs(peer: Peer, met: Component) -> None:
    (item,) = met.receive(peer.position(1.5), 3.0)
    assert isinstance(item, Telemetry)
    assert item.received_s == 3.0


async def test_the_component_needs_no_event_loop_of_its_own() -> None:
    assert len(asyncio.all_tasks()) == 1
