"""Faults of the wire: odd frames, odd acknowledgements, others on the link, signatures."""

from __future__ import annotations

import math
from typing import Any

import pytest

from sitl.stub.faults import Fault, FaultKind
from sitl.stub.protocol import Listener, SigningKey, Speaker, dialect
from sitl.stub.scenario import Scenario
from tests.sitl.stub_bench import Bench, mission

POSITION = dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT
SERVO_RAW = dialect.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW
SET_INTERVAL = dialect.MAV_CMD_SET_MESSAGE_INTERVAL
SET_SERVO = dialect.MAV_CMD_DO_SET_SERVO
SECRET = bytes(range(1, 33))


def faulty(kind: FaultKind, **more: Any) -> Bench:
    """A stub on the ground with positions at 20 Hz and a fault from 2 s to 4 s."""
    fault = Fault(**{"kind": kind, "at_s": 2.0, "duration_s": 2.0, **more})
    bench = Bench(faults=(fault,), items=mission((0.0, 100.0)))
    bench.companion.command(SET_INTERVAL, POSITION, 50_000)
    bench.run(1.9)
    return bench


def raw_frames(bench: Bench) -> list[bytes]:
    """Return what goes out to one peer from now on."""
    frames: list[bytes] = []
    take = bench.companion.channel.send

    def send(frame: bytes) -> None:
        frames.append(frame)
        take(frame)

    bench.companion.channel.send = send
    return frames


# ------------------------------------------------------------------------------------- commands


def test_a_long_command_is_in_progress_first() -> None:
    bench = faulty(FaultKind.ACK_IN_PROGRESS, delay_s=0.5)
    bench.run(0.5)
    assert bench.companion.command(SET_SERVO, 9, 1500) == dialect.MAV_RESULT_IN_PROGRESS
    bench.run(0.6)
    assert bench.companion.last("COMMAND_ACK").result == 0


def test_a_blocked_command_is_neither_done_nor_answered() -> None:
    bench = faulty(FaultKind.COMMAND_BLOCKED, command=SET_SERVO)
    bench.run(0.5)
    assert bench.companion.command(SET_SERVO, 9, 1500) is None
    assert not bench.orders
    assert bench.companion.command(dialect.MAV_CMD_GET_HOME_POSITION) == 0
    bench.run(2.0)
    assert bench.companion.command(SET_SERVO, 9, 1500) == 0


def test_the_acknowledgements_of_one_command_alone_can_be_lost() -> None:
    bench = faulty(FaultKind.ACK_LOST, command=SET_SERVO)
    bench.run(0.5)
    assert bench.companion.command(SET_SERVO, 9, 1500) is None
    assert bench.companion.command(dialect.MAV_CMD_GET_HOME_POSITION) == 0


def test_parameters_are_lost_both_ways() -> None:
    bench = faulty(FaultKind.PARAM_LOST, fraction=0.5)
    bench.run(0.2)
    bench.companion.say(dialect.MAVLink_param_request_list_message(1, 1))
    bench.run(1.0)
    values = bench.companion.of("PARAM_VALUE")
    assert 0.3 < len(values) / len(bench.autopilot.parameters) < 0.7
    assert values[0].param_count == len(bench.autopilot.parameters)
    for value in range(20):
        set_it = dialect.MAVLink_param_set_message(1, 1, b"SERVO9_FUNCTION", value, 4)
        bench.companion.say(set_it)
    taken = bench.companion.of("PARAM_VALUE")[len(values) :]
    assert 1 <= len(taken) < 20


# --------------------------------------------------------------------------------------- frames


def test_truncated_frames_do_not_arrive_and_the_next_ones_do() -> None:
    bench = faulty(FaultKind.TRUNCATED, fraction=0.3)
    bench.run(2.2)
    assert bench.companion.bad_count > 0
    before = len(bench.companion.of("GLOBAL_POSITION_INT"))
    bench.run(1.0)
    assert len(bench.companion.of("GLOBAL_POSITION_INT")) - before == pytest.approx(20, abs=1)


def test_frames_of_version_1_have_its_lengths() -> None:
    bench = faulty(FaultKind.MAVLINK1)
    bench.companion.command(SET_SERVO, 1, 1500)
    bench.run(0.2)
    frames = raw_frames(bench)
    position = bench.companion.request(POSITION)
    bench.companion.request(SERVO_RAW)
    assert position.lat == pytest.approx(36e7, abs=100)
    by_id = {frame[5]: frame for frame in frames}
    assert {frame[0] for frame in frames} == {0xFE}
    assert (len(by_id[POSITION]), len(by_id[SERVO_RAW])) == (28 + 8, 21 + 8)
    assert by_id[dialect.MAVLINK_MSG_ID_COMMAND_ACK][1] == 3
    outputs = bench.companion.last("SERVO_OUTPUT_RAW")
    assert outputs.servo9_raw == 0  # the extension with the outputs from 9 on is not there


def test_unknown_ids_come_between_the_known() -> None:
    bench = faulty(FaultKind.UNKNOWN_ID)
    bench.run(0.3)
    before = len(bench.companion.of("GLOBAL_POSITION_INT"))
    frames = raw_frames(bench)
    bench.run(1.0)
    unknown = [int.from_bytes(frame[7:10], "little") for frame in frames]
    assert min(unknown) >= 60_000
    assert len(bench.companion.of("GLOBAL_POSITION_INT")) - before == pytest.approx(20, abs=1)


def test_signed_frames_carry_their_flag_and_13_bytes_more() -> None:
    bench = faulty(FaultKind.SIGNED, fraction=0.5)
    bench.run(0.3)
    frames = raw_frames(bench)
    bench.run(1.0)
    signed = [frame for frame in frames if frame[2] & 1]
    assert 0 < len(signed) < len(frames)
    for frame in signed:
        assert len(frame) == 10 + frame[1] + 2 + 13
    for frame in frames:
        if not frame[2] & 1:
            assert len(frame) == 10 + frame[1] + 2


def test_a_signed_link_hears_only_who_knows_the_key() -> None:
    bench = Bench(scenario=Scenario(signing_key=SECRET), signing_time=1000)
    key = SigningKey(secret=SECRET, timestamp=1000)
    knows, listener = Speaker(1, 191, key=key), Listener(key)
    frames = raw_frames(bench)
    command = dialect.MAVLink_command_long_message(1, 1, SET_SERVO, 0, 9, 1500, 0, 0, 0, 0, 0)
    receive = bench.autopilot.receive
    receive(bench.companion.channel, Speaker(1, 191).frame(command), bench.now_s)
    assert not bench.orders
    strange = SigningKey(secret=bytes(32), timestamp=1000)
    receive(bench.companion.channel, Speaker(1, 190, key=strange).frame(command), bench.now_s)
    assert not bench.orders
    receive(bench.companion.channel, knows.frame(command), bench.now_s)
    assert [order.pulse_us for order in bench.orders] == [1500]
    heard = [message.get_type() for message in listener.messages(b"".join(frames))]
    assert heard == ["COMMAND_ACK"]


def test_the_stamps_of_a_signed_link_keep_the_time() -> None:
    """Who comes later hears no stream that is a minute behind."""
    bench = Bench(scenario=Scenario(signing_key=SECRET), signing_time=1000)
    bench.run(0.1)
    began_s = bench.now_s
    for _ in range(70):
        bench.run(1.0)
    frames = raw_frames(bench)
    bench.run(1.0)
    stamp = int.from_bytes(frames[0][-12:-6], "little")
    assert stamp / 1e5 == pytest.approx(bench.now_s - began_s, abs=2.0)


# --------------------------------------------------------------------------------- other senders


def test_a_second_companion_is_heard_with_our_ids() -> None:
    bench = faulty(FaultKind.SECOND_COMPANION)
    bench.run(1.5)
    beats = [m for m in bench.companion.of("HEARTBEAT") if m.get_srcComponent() == 191]
    assert beats and {m.get_srcSystem() for m in beats} == {1}


def test_a_second_vehicle_flies_in_the_same_field() -> None:
    bench = faulty(FaultKind.SECOND_VEHICLE)
    bench.run(1.5)
    other = [m for m in bench.companion.messages if m.get_srcSystem() == 2]
    beats = [m for m in other if m.get_type() == "HEARTBEAT"]
    places = [m for m in other if m.get_type() == "GLOBAL_POSITION_INT"]
    assert beats and beats[-1].base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED
    assert beats[-1].autopilot == dialect.MAV_AUTOPILOT_ARDUPILOTMEGA
    assert len(places) == pytest.approx(14, abs=2)
    assert math.hypot((places[-1].lat - 36e7) * 0.0111, places[-1].lon / 1e9) < 50.0


@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
def test_another_station_sets_the_rates_again_and_again(autopilot: str) -> None:
    fault = Fault(kind=FaultKind.STATION_RATES, at_s=2.0, duration_s=3.0, rate_hz=2.0, delay_s=0.5)
    bench = Bench(autopilot=autopilot, faults=(fault,))
    bench.companion.command(SET_INTERVAL, POSITION, 50_000)
    bench.run(2.1)
    bench.companion.command(SET_INTERVAL, POSITION, 50_000)
    bench.run(1.0)
    before = len(bench.companion.of("GLOBAL_POSITION_INT"))
    bench.run(1.5)
    assert len(bench.companion.of("GLOBAL_POSITION_INT")) - before <= 4
    assert (255, 190) in {
        (m.get_srcSystem(), m.get_srcComponent()) for m in bench.companion.of("HEARTBEAT")
    }
    bench.run(1.0)
    bench.companion.command(SET_INTERVAL, POSITION, 50_000)
    bench.companion.messages.clear()
    bench.run(1.0)
    assert len(bench.companion.of("GLOBAL_POSITION_INT")) == pytest.approx(20, abs=1)


# ------------------------------------------------------------------------------------- estimator


def test_an_estimator_without_a_position_says_so_while_positions_go_on() -> None:
    bench = faulty(FaultKind.EKF_LOST)
    bench.run(0.5)
    report = bench.companion.request(dialect.MAVLINK_MSG_ID_EKF_STATUS_REPORT)
    assert report.flags & dialect.ESTIMATOR_CONST_POS_MODE
    first = bench.companion.last("GLOBAL_POSITION_INT")
    bench.run(0.5)
    last = bench.companion.last("GLOBAL_POSITION_INT")
    assert (first.lat, first.lon) != (last.lat, last.lon)
