"""The stub streams what was asked for, at the rate that was asked for, and nothing else."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from sitl.stub.ardupilot import BUILDERS
from sitl.stub.protocol import dialect
from sitl.stub.scenario import Scenario
from tests.sitl.stub_bench import HOME, Bench, mission

POSITION = dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT
WIND = dialect.MAVLINK_MSG_ID_WIND
BATTERY = dialect.MAVLINK_MSG_ID_BATTERY_STATUS  # needs a monitor: test_stub_liquid.py
SET_INTERVAL = dialect.MAV_CMD_SET_MESSAGE_INTERVAL


def test_only_heartbeats_and_clock_requests_come_unasked() -> None:
    bench = Bench()
    bench.run(12.0)
    kinds = {message.get_type() for message in bench.companion.messages}
    assert kinds == {"HEARTBEAT", "TIMESYNC"}
    assert len(bench.companion.of("HEARTBEAT")) == 12


def test_a_stream_comes_at_the_rate_that_was_asked_for() -> None:
    bench = Bench()
    assert bench.companion.command(SET_INTERVAL, POSITION, 50_000) == 0
    bench.run(2.0)
    assert len(bench.companion.of("GLOBAL_POSITION_INT")) == pytest.approx(40, abs=1)


def test_a_stream_ends_when_it_is_switched_off() -> None:
    bench = Bench()
    bench.companion.command(SET_INTERVAL, POSITION, 50_000)
    bench.companion.command(SET_INTERVAL, POSITION, -1)
    bench.run(1.0)
    assert not bench.companion.of("GLOBAL_POSITION_INT")


@pytest.mark.parametrize(
    "params",
    [(POSITION, 50_000, math.nan), (POSITION, 50_000, 1), (9999, 50_000), (POSITION, 1000)],
)
def test_a_request_that_ardupilot_refuses_is_denied(params: tuple[float, ...]) -> None:
    bench = Bench()
    assert bench.companion.command(SET_INTERVAL, *params) == dialect.MAV_RESULT_DENIED


def test_rates_are_kept_by_peer() -> None:
    bench = Bench()
    other = bench.peer(255, 190)
    bench.companion.command(SET_INTERVAL, POSITION, 50_000)
    bench.run(1.0)
    assert not other.of("GLOBAL_POSITION_INT")


def test_a_ground_station_on_the_same_link_overwrites_rates() -> None:
    bench = Bench()
    bench.companion.command(SET_INTERVAL, POSITION, 50_000)
    bench.companion.say(dialect.MAVLink_request_data_stream_message(1, 1, 0, 2, 1))
    bench.run(2.0)
    assert len(bench.companion.of("GLOBAL_POSITION_INT")) == pytest.approx(4, abs=1)


def test_streams_slow_down_while_a_mission_is_read() -> None:
    bench = Bench(items=mission((0.0, 40.0)))
    bench.companion.command(SET_INTERVAL, POSITION, 50_000)
    bench.companion.say(dialect.MAVLink_mission_request_list_message(1, 1))
    bench.run(1.0)
    assert len(bench.companion.of("GLOBAL_POSITION_INT")) <= 7


@pytest.mark.parametrize("message_id", sorted(set(BUILDERS) - {WIND, BATTERY}))
def test_every_message_can_be_requested_once(message_id: int) -> None:
    bench = Bench()
    bench.run(0.1)
    assert bench.companion.request(message_id).get_msgId() == message_id


def test_position_at_home_has_the_units_of_the_standard() -> None:
    bench = Bench(home_altitude_m=60.0, heading_deg=90.0)
    bench.run(0.5)
    position = bench.companion.request(POSITION)
    assert position.lat == pytest.approx(HOME.latitude_deg * 1e7, abs=10)
    assert position.lon == pytest.approx(HOME.longitude_deg * 1e7, abs=10)
    assert (position.alt, position.relative_alt, position.hdg) == (60_000, 0, 9000)
    assert position.time_boot_ms == 500


def test_position_lies_behind_the_truth_by_the_estimators_lag() -> None:
    bench = Bench(items=mission((0.0, 100.0)), speed_m_s=5.0)
    bench.fly()
    bench.run(8.0)
    behind_m = []
    for _ in range(200):
        bench.run(0.02)
        pose = bench.autopilot.flight.world.pose_at(bench.now_s)
        position = bench.companion.request(POSITION)
        believed = HOME.to_local(position.lat * 1e-7, position.lon * 1e-7)
        behind_m.append(pose.north_m - believed[1])
    assert sum(behind_m) / len(behind_m) == pytest.approx(0.031 * 5.0, abs=0.04)


def test_velocity_is_north_east_down_in_centimetres() -> None:
    bench = Bench(items=mission((60.0, 0.0)), speed_m_s=5.0)
    bench.fly()
    bench.run(8.0)
    position = bench.companion.request(POSITION)
    assert position.vy == pytest.approx(500, abs=60)
    assert abs(position.vx) < 60
    speed = bench.companion.request(dialect.MAVLINK_MSG_ID_VFR_HUD)
    assert speed.groundspeed == pytest.approx(5.0, abs=0.6)


def test_timesync_request_is_answered_with_nanoseconds_since_boot() -> None:
    bench = Bench()
    bench.run(2.0)
    bench.companion.say(dialect.MAVLink_timesync_message(0, 123_456_789))
    answer = bench.companion.last("TIMESYNC")
    assert (answer.tc1, answer.ts1) == (2_000_000_000, 123_456_789)


def test_ping_to_everybody_is_answered_with_its_own_number() -> None:
    bench = Bench()
    bench.companion.say(dialect.MAVLink_ping_message(77, 5, 0, 0))
    answer = bench.companion.last("PING")
    assert (answer.time_usec, answer.seq, answer.target_system, answer.target_component) == (
        *(77, 5),
        *(1, 191),
    )


def test_file_transfer_is_refused_so_that_a_client_goes_on() -> None:
    bench = Bench()
    ask = [7, 0, 0, 4, *([0] * 247)]
    bench.companion.say(dialect.MAVLink_file_transfer_protocol_message(0, 1, 1, ask))
    answer = bench.companion.last("FILE_TRANSFER_PROTOCOL").payload
    assert (answer[0], answer[3], answer[5]) == (8, 129, 4)


def test_wind_is_exactly_0_without_an_estimate_of_the_airspeed() -> None:
    blown = Scenario(wind_towards_m_s=(0.0, -4.0))
    without = Bench(scenario=blown)
    assert without.companion.command(SET_INTERVAL, WIND, 500_000) == 0
    without.run(2.0)
    assert {wind.speed for wind in without.companion.of("WIND")} == {0.0}
    bench = Bench(scenario=replace(blown, parameters={"EK3_DRAG_BCOEF_X": 20.0}))
    assert bench.companion.command(SET_INTERVAL, WIND, 500_000) == 0
    bench.run(1.0)
    wind = bench.companion.last("WIND")
    assert wind.speed == pytest.approx(4.0, abs=0.05)
    assert math.sin(math.radians(wind.direction)) == pytest.approx(0.0, abs=0.02)
    assert len({wind.speed for wind in bench.companion.of("WIND")}) > 1  # an estimate moves


def test_a_port_keeps_ten_different_intervals() -> None:
    bench = Bench()
    asked = sorted(set(BUILDERS) - {WIND, 0, BATTERY})[:11]
    for number, message_id in enumerate(asked):
        assert bench.companion.command(SET_INTERVAL, message_id, 100_000 + 10_000 * number) == 0
    kept = {stream.interval_s for stream in bench.companion.channel.streams.values()}
    assert len(kept) == 10
    assert bench.companion.channel.streams[asked[-1]].interval_s == pytest.approx(0.19)


def test_a_list_of_parameters_takes_its_time_and_slows_the_streams() -> None:
    bench = Bench()
    bench.companion.command(SET_INTERVAL, POSITION, 50_000)
    bench.companion.say(dialect.MAVLink_param_request_list_message(1, 1))
    assert len(bench.companion.of("PARAM_VALUE")) == 10
    bench.run(1.0)
    values = bench.companion.of("PARAM_VALUE")
    assert [value.param_index for value in values] == list(range(len(values)))
    assert len(values) == values[0].param_count
    assert len(bench.companion.of("GLOBAL_POSITION_INT")) <= 7


def test_the_second_port_of_outputs_comes_when_it_is_switched_on() -> None:
    bench = Bench(scenario=Scenario(parameters={"SERVO_32_ENABLE": 1}))
    assert bench.companion.command(dialect.MAV_CMD_DO_SET_SERVO, 17, 1234) == 0
    bench.companion.command(SET_INTERVAL, dialect.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW, 100_000)
    bench.run(0.5)
    by_port = {message.port: message for message in bench.companion.of("SERVO_OUTPUT_RAW")}
    assert set(by_port) == {0, 1}
    assert by_port[1].servo1_raw == 1234


def test_a_clock_can_drift_and_can_have_run_for_long() -> None:
    bench = Bench(scenario=Scenario(drift_ppm=1000.0, uptime_s=100.0))
    bench.run(10.0)
    bench.companion.say(dialect.MAVLink_timesync_message(0, 5))
    assert bench.companion.last("TIMESYNC").tc1 == pytest.approx(110.11e9)
    assert bench.companion.request(POSITION).time_boot_ms == 110_110
