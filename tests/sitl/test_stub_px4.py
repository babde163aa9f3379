"""The stub is PX4 where it differs from ArduPilot, and differs by version where PX4 did."""

from __future__ import annotations

import math
import struct
from typing import Any

import pytest

from sitl.stub.faults import Fault, FaultKind
from sitl.stub.firmware import Version
from sitl.stub.mission_items import AUTO, LOITER, MissionItem, Phase, item_message
from sitl.stub.protocol import dialect
from sitl.stub.scenario import Scenario
from tests.sitl.stub_bench import Bench, mission, place

SET_ACTUATOR = dialect.MAV_CMD_DO_SET_ACTUATOR
SET_INTERVAL = dialect.MAV_CMD_SET_MESSAGE_INTERVAL
POSITION = dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT
CLOSED = (-1.0,) * 6
NAN = math.nan
OLD: Version = (1, 14, 1)


def px4(*, version: Version | None = None, **options: Any) -> Bench:
    scenario = options.pop("scenario", Scenario(version=version))
    return Bench(autopilot="px4", scenario=scenario, **options)


def result(bench: Bench, command: int, *params: float, **more: int) -> int | None:
    """Send a command and return the result, which takes the time of the queue."""
    before = len(bench.companion.of("COMMAND_ACK"))
    at_once = bench.companion.command(command, *params, **more)
    bench.run(0.06)
    acks = bench.companion.of("COMMAND_ACK")[before:]
    return at_once if at_once is not None else acks[-1].result if acks else None


def arm(bench: Bench) -> None:
    assert result(bench, dialect.MAV_CMD_COMPONENT_ARM_DISARM, 1) == 0


def servo(bench: Bench, channel: int) -> int:
    raw = bench.companion.request(dialect.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW)
    return int(getattr(raw, f"servo{channel}_raw"))


def servos(bench: Bench) -> list[int]:
    return [servo(bench, channel) for channel in range(9, 15)]


# ------------------------------------------------------------------------------ heartbeat, modes


def test_the_heartbeat_is_that_of_px4_on_hold() -> None:
    bench = px4()
    bench.run(1.1)
    beat = bench.companion.last("HEARTBEAT")
    assert (beat.autopilot, beat.type) == (dialect.MAV_AUTOPILOT_PX4, dialect.MAV_TYPE_QUADROTOR)
    assert (beat.custom_mode >> 16 & 0xFF, beat.custom_mode >> 24) == (4, 3)
    assert not beat.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED


def test_the_mission_mode_takes_off_and_flies() -> None:
    bench = px4(items=mission((0.0, 60.0)))
    arm(bench)
    assert result(bench, dialect.MAV_CMD_DO_SET_MODE, 1, 4, 4) == 0
    bench.run_until(lambda: bench.autopilot.flight.phase is Phase.ROUTE, within_s=20.0)
    bench.run(1.0)
    beat = bench.companion.last("HEARTBEAT")
    assert (beat.custom_mode >> 16 & 0xFF, beat.custom_mode >> 24) == (4, 4)
    assert beat.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED
    current = bench.companion.last("MISSION_CURRENT")
    assert (current.seq, current.total) == (1, 3)


@pytest.mark.parametrize(("main", "sub"), [(4, 4), (9, 0), (4, 99)])
def test_a_mode_that_cannot_be_is_rejected(main: int, sub: int) -> None:
    bench = px4()
    rejected = dialect.MAV_RESULT_TEMPORARILY_REJECTED
    assert result(bench, dialect.MAV_CMD_DO_SET_MODE, 1, main, sub) == rejected
    assert bench.autopilot.flight.mode == LOITER


def test_a_take_off_by_command_climbs_to_an_altitude_above_the_sea() -> None:
    bench = px4(home_altitude_m=60.0)
    arm(bench)
    params = (0, 0, 0, NAN, NAN, NAN, 65.0)
    assert result(bench, dialect.MAV_CMD_NAV_TAKEOFF, *params) == 0
    bench.run(6.0)
    pose = bench.autopilot.flight.world.pose_at(bench.now_s)
    assert pose.height_m == pytest.approx(5.0)


def test_a_take_off_without_an_altitude_takes_the_parameters() -> None:
    bench = px4()
    arm(bench)
    assert result(bench, dialect.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, NAN) == 0
    bench.run(4.0)
    assert bench.autopilot.flight.world.pose_at(bench.now_s).height_m == pytest.approx(2.5)


# ------------------------------------------------------------------------------------- streams


def test_it_streams_by_itself_as_on_an_onboard_port() -> None:
    bench = px4()
    bench.run(4.0)
    count = {kind: len(bench.companion.of(kind)) / 4.0 for kind in RATES_HZ}
    assert count == {kind: pytest.approx(rate_hz, rel=0.1) for kind, rate_hz in RATES_HZ.items()}


RATES_HZ = {"GLOBAL_POSITION_INT": 50.0, "VFR_HUD": 10.0, "ESTIMATOR_STATUS": 1.0, "TIMESYNC": 10.0}


def test_its_own_clock_request_carries_no_system_id() -> None:
    bench = px4()
    bench.run(0.2)
    assert bench.companion.of("TIMESYNC")[0].ts1 % 10_000_000 == 0


@pytest.mark.parametrize("unused", [0.0, NAN])
def test_an_interval_can_be_asked_for_with_zero_or_nan(unused: float) -> None:
    bench = px4()
    params = (POSITION, 200_000, unused, unused, 0, 0, unused)
    assert bench.companion.command(SET_INTERVAL, *params) == 0
    bench.run(2.0)
    assert len(bench.companion.of("GLOBAL_POSITION_INT")) == pytest.approx(10, abs=2)
    assert bench.companion.command(SET_INTERVAL, POSITION, 0) == 0
    assert bench.companion.channel.streams[POSITION].interval_s == pytest.approx(0.02)


@pytest.mark.parametrize(
    "params",
    [
        (dialect.MAVLINK_MSG_ID_MISSION_CURRENT, 500_000),
        (dialect.MAVLINK_MSG_ID_HEARTBEAT, 500_000),
        (dialect.MAVLINK_MSG_ID_EKF_STATUS_REPORT, 500_000),
        (POSITION, 50_000, 1.0),
        (POSITION, NAN),
    ],
)
def test_an_interval_that_px4_refuses_fails(params: tuple[float, ...]) -> None:
    assert px4().companion.command(SET_INTERVAL, *params) == dialect.MAV_RESULT_FAILED


def test_a_data_stream_cannot_be_asked_for() -> None:
    bench = px4()
    bench.companion.say(dialect.MAVLink_request_data_stream_message(1, 1, 0, 2, 1))
    bench.run(2.0)
    assert len(bench.companion.of("GLOBAL_POSITION_INT")) > 90


def test_a_reboot_brings_the_streams_back_by_itself() -> None:
    bench = px4(faults=(Fault(kind=FaultKind.REBOOT, at_s=5.0, duration_s=1.0),))
    bench.companion.command(SET_INTERVAL, POSITION, 1_000_000)
    bench.run(5.1)
    bench.companion.messages.clear()
    bench.run(1.0)
    positions = bench.companion.of("GLOBAL_POSITION_INT")
    assert len(positions) > 40
    assert positions[-1].time_boot_ms < 1500


@pytest.mark.parametrize(("version", "is_said"), [((1, 16, 0), True), ((1, 15, 4), False)])
def test_at_rest_the_estimator_says_constant_position_beside_a_good_one(
    version: Version, is_said: bool
) -> None:
    bench = px4(version=version)
    bench.run(1.1)
    flags = bench.companion.last("ESTIMATOR_STATUS").flags
    assert flags & dialect.ESTIMATOR_POS_HORIZ_ABS
    assert bool(flags & dialect.ESTIMATOR_CONST_POS_MODE) is is_said


def test_a_lost_position_ends_the_stream_and_the_estimator_says_so() -> None:
    bench = px4(faults=(Fault(kind=FaultKind.STALE_POSITION, at_s=1.0, duration_s=2.0),))
    bench.run(1.1)
    bench.companion.messages.clear()
    bench.run(1.5)
    assert not bench.companion.of("GLOBAL_POSITION_INT")
    flags = bench.companion.last("ESTIMATOR_STATUS").flags
    assert flags & dialect.ESTIMATOR_CONST_POS_MODE
    assert not flags & dialect.ESTIMATOR_POS_HORIZ_ABS
    refused = bench.companion.command(dialect.MAV_CMD_REQUEST_MESSAGE, POSITION)
    assert refused == dialect.MAV_RESULT_DENIED
    bench.run(1.5)
    assert bench.companion.of("GLOBAL_POSITION_INT")


def test_a_position_carries_the_time_of_its_estimate() -> None:
    bench = px4()
    bench.run(3.0)
    late_ms = [
        1000.0 * (message.at_s - 1000.0) - message.time_boot_ms
        for message in bench.companion.of("GLOBAL_POSITION_INT")
    ]
    assert 2.0 < max(late_ms) < 9.0
    assert min(late_ms) > -1.0


def test_the_wind_is_told_by_where_it_blows_to() -> None:
    bench = px4(scenario=Scenario(wind_towards_m_s=(1.0, -3.0)))
    bench.run(0.5)
    wind = bench.companion.last("WIND_COV")
    assert (wind.wind_x, wind.wind_y) == pytest.approx((-3.0, 1.0), abs=0.05)


# ------------------------------------------------------------------------------------ actuators


def test_disarmed_the_outputs_show_their_disarmed_value_and_no_other() -> None:
    bench = px4()
    bench.run(0.1)
    assert servos(bench) == [900] * 6
    assert servo(bench, 15) == 0
    assert result(bench, SET_ACTUATOR, *(0.0,) * 6, 0) == 0
    assert servos(bench) == [900] * 6


def test_an_order_from_before_arming_shows_at_the_moment_of_arming() -> None:
    bench = px4()
    result(bench, SET_ACTUATOR, *(0.5,) * 6, 0)
    bench.companion.channel.streams.clear()
    bench.run(30.0)
    assert servos(bench) == [900] * 6
    arm(bench)
    bench.run(0.1)
    assert servos(bench) == [1750] * 6


def test_all_six_are_set_and_held_for_ever() -> None:
    bench = px4()
    arm(bench)
    bench.run(0.1)
    assert servos(bench) == [900] * 6  # never set
    result(bench, SET_ACTUATOR, -1.0, -0.6, -0.2, 0.2, 0.6, 3.0, 0)
    bench.run(0.1)
    expected = [1000, 1200, 1400, 1600, 1800, 2000]
    assert servos(bench) == expected
    bench.companion.channel.streams.clear()
    bench.run(75.0)
    assert servos(bench) == expected


def test_another_index_is_accepted_and_ignored() -> None:
    bench = px4()
    arm(bench)
    result(bench, SET_ACTUATOR, *CLOSED, 0)
    assert result(bench, SET_ACTUATOR, *(1.0,) * 6, 1) == 0
    bench.run(0.1)
    assert servos(bench) == [1000] * 6


@pytest.mark.parametrize(("version", "left"), [(OLD, 900), ((1, 14, 2), 1000), ((1, 16, 0), 1000)])
def test_nan_leaves_alone_or_overwrites_by_version(version: Version, left: int) -> None:
    bench = px4(version=version)
    bench.run(0.1)
    bench.companion.command(dialect.MAV_CMD_COMPONENT_ARM_DISARM, 1)
    bench.run(0.1)
    result(bench, SET_ACTUATOR, *CLOSED, 0)
    result(bench, SET_ACTUATOR, 0.0, NAN, NAN, NAN, NAN, NAN, 0)
    bench.run(0.1)
    assert servos(bench) == [1500, *[left] * 5]


def test_the_outputs_follow_before_the_commander_answers() -> None:
    bench = px4()
    arm(bench)
    bench.run(0.1)
    assert bench.companion.command(SET_ACTUATOR, *(1.0,) * 6, 0) is None
    assert [order.pulse_us for order in bench.orders[-6:]] == [2000] * 6


@pytest.mark.parametrize(("version", "answer"), [(OLD, None), ((1, 14, 2), 0), (None, 0)])
def test_an_order_is_acknowledged_by_version(version: Version | None, answer: int | None) -> None:
    bench = px4(version=version)
    assert result(bench, SET_ACTUATOR, *CLOSED, 0) == answer


def test_accepted_is_no_proof_without_a_function() -> None:
    unset = {f"PWM_MAIN_FUNC{channel}": 0.0 for channel in range(9, 15)}
    bench = px4(scenario=Scenario(parameters=unset))
    arm(bench)
    assert result(bench, SET_ACTUATOR, *(1.0,) * 6, 0) == 0
    bench.run(0.1)
    assert servos(bench) == [0] * 6


def test_a_disarmed_value_and_a_pre_armed_mode_can_be_set() -> None:
    parameters = {"PWM_MAIN_DIS9": 1000.0, "COM_PREARM_MODE": 2.0}
    bench = px4(scenario=Scenario(parameters=parameters))
    bench.run(0.1)
    assert servo(bench, 9) == 1000
    result(bench, SET_ACTUATOR, *(0.0,) * 6, 0)
    bench.run(0.1)
    assert servos(bench) == [1500] * 6
    assert servo(bench, 1) == 900  # a motor stays off


@pytest.mark.parametrize(("kind", "shows"), [(FaultKind.KILL, 900), (FaultKind.TERMINATE, 1100)])
def test_kill_and_termination_close_by_their_own_values(kind: FaultKind, shows: int) -> None:
    scenario = Scenario(
        faults=(Fault(kind=kind, at_s=2.0, duration_s=2.0),),
        parameters={f"PWM_MAIN_FAIL{channel}": 1100.0 for channel in range(9, 15)},
    )
    bench = px4(scenario=scenario)
    arm(bench)
    result(bench, SET_ACTUATOR, *(1.0,) * 6, 0)
    bench.run(2.5)
    assert servos(bench) == [shows] * 6
    bench.run(2.0)
    assert servos(bench) == [2000] * 6


def test_a_reboot_forgets_the_orders() -> None:
    bench = px4()
    result(bench, SET_ACTUATOR, *(1.0,) * 6, 0)
    assert result(bench, dialect.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1) == 0
    arm(bench)
    bench.run(0.1)
    assert servos(bench) == [900] * 6


def test_the_other_firmwares_commands_are_unsupported() -> None:
    bench = px4()
    unsupported = dialect.MAV_RESULT_UNSUPPORTED
    assert result(bench, dialect.MAV_CMD_DO_SET_SERVO, 9, 1500) == unsupported
    assert result(bench, dialect.MAV_CMD_DO_SPRAYER, 1) == unsupported
    assert result(bench, dialect.MAV_CMD_DO_SET_RELAY, 0, 1) == unsupported


@pytest.mark.parametrize(("system", "component"), [(2, 1), (0, 1), (1, 191), (1, 50)])
def test_a_command_for_somebody_else_is_neither_done_nor_answered(
    system: int, component: int
) -> None:
    bench = px4()
    command = (system, component, dialect.MAV_CMD_COMPONENT_ARM_DISARM, 0, 1, 0, 0, 0, 0, 0, 0)
    bench.companion.say(dialect.MAVLink_command_long_message(*command))
    bench.run(0.2)
    assert not bench.autopilot.flight.armed
    assert not bench.companion.of("COMMAND_ACK")


def test_a_command_int_scales_the_fifth_and_sixth_value_wrongly() -> None:
    bench = px4()
    arm(bench)
    order = (1, 1, 0, SET_ACTUATOR, 0, 0, 1.0, 1.0, 1.0, 1.0, 1, 1, 0.0)
    bench.companion.say(dialect.MAVLink_command_int_message(*order))
    bench.run(0.2)
    assert servos(bench) == [2000, 2000, 2000, 2000, 1500, 1500]


# ------------------------------------------------------------------------------------ the queue


def test_a_burst_of_more_than_eight_commands_loses_the_rest() -> None:
    bench = px4()
    for _ in range(24):
        bench.companion.command(SET_ACTUATOR, *CLOSED, 0)
    bench.run(0.3)
    assert len(bench.companion.of("COMMAND_ACK")) == 8


@pytest.mark.parametrize(("rate_hz", "share"), [(20, 1.0), (25, 1.0), (50, 0.6)])
def test_more_than_thirty_commands_a_second_are_lost(rate_hz: int, share: float) -> None:
    bench = px4()
    bench.companion.channel.streams.clear()
    for _ in range(10 * rate_hz):
        bench.companion.command(SET_ACTUATOR, *CLOSED, 0)
        bench.run(1.0 / rate_hz)
    bench.run(0.1)
    answered = len(bench.companion.of("COMMAND_ACK")) / (10 * rate_hz)
    assert answered == pytest.approx(share, abs=0.02)


def test_an_answer_takes_some_milliseconds() -> None:
    bench = px4()
    sent_s = bench.now_s
    bench.companion.command(SET_ACTUATOR, *CLOSED, 0)
    while not bench.companion.of("COMMAND_ACK"):
        bench.run(0.001)
    assert 0.003 < bench.now_s - sent_s < 0.014


# ------------------------------------------------------------------------- parameters, missions


def test_whole_numbers_travel_as_their_four_bytes() -> None:
    bench = px4()
    ask = dialect.MAVLink_param_request_read_message(1, 1, b"PWM_MAIN_FUNC9", -1)
    bench.companion.say(ask)
    value = bench.companion.last("PARAM_VALUE")
    assert value.param_type == dialect.MAV_PARAM_TYPE_INT32
    assert struct.unpack("<i", struct.pack("<f", value.param_value)) == (301,)


@pytest.mark.parametrize("number", [0, 306, -1])
def test_a_whole_number_is_set_by_its_four_bytes(number: int) -> None:
    bench = px4()
    raw = struct.unpack("<f", struct.pack("<i", number))[0]
    name, kind = b"PWM_MAIN_FUNC9", dialect.MAV_PARAM_TYPE_INT32
    bench.companion.say(dialect.MAVLink_param_set_message(1, 1, name, raw, kind))
    assert bench.autopilot.parameters["PWM_MAIN_FUNC9"] == number


def test_a_value_of_the_wrong_type_is_refused_with_a_text() -> None:
    bench = px4()
    name, kind = b"PWM_MAIN_FUNC9", dialect.MAV_PARAM_TYPE_REAL32
    bench.companion.say(dialect.MAVLink_param_set_message(1, 1, name, 305.0, kind))
    assert bench.autopilot.parameters["PWM_MAIN_FUNC9"] == 301
    assert "param types mismatch" in bench.companion.last("STATUSTEXT").text


def upload(bench: Bench, items: tuple[MissionItem, ...]) -> int:
    bench.companion.say(dialect.MAVLink_mission_count_message(1, 1, len(items)))
    for number, item in enumerate(items):
        bench.companion.say(item_message(item, number, current=number == 0, to=(1, 1)))
    return int(bench.companion.last("MISSION_ACK").type)


def actuator_item(value: float) -> MissionItem:
    return MissionItem(
        command=SET_ACTUATOR,
        frame=dialect.MAV_FRAME_MISSION,
        **{f"param{number}": value for number in range(1, 5)},
    )


def test_a_mission_has_no_home_and_reads_back_the_same() -> None:
    bench = px4()
    items = mission((0.0, 40.0))[1:]
    assert upload(bench, items) == dialect.MAV_MISSION_ACCEPTED
    bench.companion.say(dialect.MAVLink_mission_request_list_message(1, 1))
    assert bench.companion.last("MISSION_COUNT").count == len(items)
    bench.companion.say(dialect.MAVLink_mission_request_int_message(1, 1, 0))
    back = bench.companion.last("MISSION_ITEM_INT")
    assert (back.command, back.x, back.current) == (items[0].command, items[0].x_e7, 1)


@pytest.mark.parametrize(
    ("item", "answer"),
    [
        (MissionItem(command=dialect.MAV_CMD_DO_SET_SERVO), dialect.MAV_MISSION_UNSUPPORTED),
        (MissionItem(command=dialect.MAV_CMD_DO_SPRAYER), dialect.MAV_MISSION_UNSUPPORTED),
        (
            MissionItem(
                command=dialect.MAV_CMD_NAV_WAYPOINT,
                frame=dialect.MAV_FRAME_LOCAL_NED,
            ),
            dialect.MAV_MISSION_UNSUPPORTED_FRAME,
        ),
        (actuator_item(-1.0), dialect.MAV_MISSION_ACCEPTED),
        (MissionItem(command=dialect.MAV_CMD_DO_CHANGE_SPEED), dialect.MAV_MISSION_ACCEPTED),
    ],
)
def test_a_mission_is_refused_as_px4_refuses_it(item: MissionItem, answer: int) -> None:
    take_off = place(dialect.MAV_CMD_NAV_TAKEOFF, 0.0, 0.0)
    assert upload(px4(), (take_off, item)) == answer


def test_a_mission_sets_actuators_without_a_text() -> None:
    bench = px4()
    first, *rest = mission((0.0, 20.0), (10.0, 20.0))[1:]
    upload(bench, (first, rest[0], actuator_item(0.0), *rest[1:]))
    arm(bench)
    result(bench, dialect.MAV_CMD_DO_SET_MODE, 1, 4, 4)
    bench.run_until(lambda: servo(bench, 9) == 1500, within_s=30.0)
    assert bench.autopilot.flight.mode == AUTO
    assert not [text for text in bench.companion.of("STATUSTEXT") if "Mission" in text.text]
    assert bench.companion.last("MISSION_ITEM_REACHED").seq == 1


def test_nothing_is_forwarded() -> None:
    bench = px4()
    other = bench.peer(255, 190)
    other.say(dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
    bench.companion.say(dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))
    bench.run(0.1)
    assert {message.get_srcComponent() for message in other.messages} == {1}
