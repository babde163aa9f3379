"""Arming, modes and the flown mission behave as ArduCopter's."""

from __future__ import annotations

import pytest

from sitl.stub.mission_items import AUTO, GUIDED, LAND, LOITER, RTL, MissionItem, Phase
from sitl.stub.protocol import dialect
from tests.sitl.stub_bench import Bench, mission, place

ARM = dialect.MAV_CMD_COMPONENT_ARM_DISARM
ACCEPTED, FAILED = dialect.MAV_RESULT_ACCEPTED, dialect.MAV_RESULT_FAILED


def landed_state(bench: Bench) -> int:
    state = bench.companion.request(dialect.MAVLINK_MSG_ID_EXTENDED_SYS_STATE)
    return int(state.landed_state)


def test_a_mission_is_flown_to_its_end_and_ends_disarmed_on_the_ground() -> None:
    bench = Bench(items=mission((0.0, 30.0), (6.0, 30.0), (6.0, 0.0)))
    bench.fly()
    bench.run_until(lambda: not bench.autopilot.flight.armed, within_s=90.0)
    pose = bench.autopilot.flight.world.pose_at(bench.now_s)
    assert (pose.east_m, pose.north_m) == pytest.approx((6.0, 0.0), abs=0.5)
    assert pose.height_m == 0.0
    reached = [message.seq for message in bench.companion.of("MISSION_ITEM_REACHED")]
    assert reached == [2, 3, 4]


def test_the_landed_state_goes_through_all_of_its_values_in_order() -> None:
    bench = Bench(items=mission((0.0, 20.0)))
    states = [landed_state(bench)]
    bench.fly()
    while bench.autopilot.flight.armed:
        bench.run(0.1)
        if landed_state(bench) != states[-1]:
            states.append(landed_state(bench))
    assert states == [
        dialect.MAV_LANDED_STATE_ON_GROUND,
        dialect.MAV_LANDED_STATE_TAKEOFF,
        dialect.MAV_LANDED_STATE_IN_AIR,
        dialect.MAV_LANDED_STATE_LANDING,
        dialect.MAV_LANDED_STATE_ON_GROUND,
    ]


def test_the_path_has_no_jumps() -> None:
    bench = Bench(items=mission((0.0, 20.0), (6.0, 20.0)), gust_m_s=1.0)
    bench.fly()
    last = bench.autopilot.flight.world.pose_at(bench.now_s)
    while bench.autopilot.flight.armed:
        bench.run(0.02)
        pose = bench.autopilot.flight.world.pose_at(bench.now_s)
        moved = (pose.east_m - last.east_m, pose.north_m - last.north_m)
        assert abs(moved[0]) < 0.15 and abs(moved[1]) < 0.15
        assert abs(pose.height_m - last.height_m) < 0.06
        last = pose


def test_the_speed_of_the_mission_is_flown() -> None:
    items = list(mission((0.0, 100.0)))
    items.insert(2, MissionItem(command=dialect.MAV_CMD_DO_CHANGE_SPEED, param2=8.0))
    bench = Bench(items=tuple(items))
    bench.fly()
    bench.run(10.0)
    assert bench.autopilot.flight.world.pose_at(bench.now_s).speed_m_s == pytest.approx(
        8.0, abs=0.1
    )


def test_a_waypoint_at_another_height_is_climbed_to_first() -> None:
    items = (*mission(land=False), place(dialect.MAV_CMD_NAV_WAYPOINT, 0.0, 30.0, height_m=8.0))
    bench = Bench(items=items)
    bench.fly()
    bench.run_until(lambda: bench.autopilot.flight.phase is Phase.ROUTE, within_s=20.0)
    assert bench.autopilot.flight.world.pose_at(bench.now_s).height_m == pytest.approx(8.0)


def test_auto_needs_a_mission() -> None:
    bench = Bench()
    result = bench.companion.command(dialect.MAV_CMD_DO_SET_MODE, 1, AUTO)
    assert result == FAILED
    assert bench.autopilot.flight.mode == LOITER


def test_auto_on_the_ground_needs_a_take_off_first() -> None:
    items = (mission()[0], place(dialect.MAV_CMD_NAV_WAYPOINT, 0.0, 10.0))
    bench = Bench(items=items)
    bench.companion.command(ARM, 1)
    assert bench.companion.command(dialect.MAV_CMD_MISSION_START) == FAILED
    texts = [message.text for message in bench.companion.of("STATUSTEXT")]
    assert "Auto: Missing Takeoff Cmd" in texts


def test_auto_waits_for_the_throttle_without_the_option() -> None:
    bench = Bench(items=mission((0.0, 20.0)))
    bench.autopilot.parameters.put("AUTO_OPTIONS", 0)
    bench.companion.command(ARM, 1)
    assert bench.companion.command(dialect.MAV_CMD_DO_SET_MODE, 1, AUTO) == ACCEPTED
    bench.run(2.0)
    assert bench.autopilot.flight.phase is Phase.GROUND
    assert bench.companion.command(dialect.MAV_CMD_MISSION_START) == ACCEPTED
    assert bench.autopilot.flight.phase is Phase.CLIMB


def test_landing_modes_cannot_be_armed_in() -> None:
    bench = Bench()
    bench.companion.command(dialect.MAV_CMD_DO_SET_MODE, 1, RTL)
    assert bench.companion.command(ARM, 1) == FAILED
    assert not bench.autopilot.flight.armed


def test_disarming_in_the_air_needs_force() -> None:
    bench = Bench(items=mission((0.0, 50.0)))
    bench.fly()
    bench.run(5.0)
    assert bench.companion.command(ARM, 0) == FAILED
    assert bench.companion.command(ARM, 0, 21196) == ACCEPTED
    assert not bench.autopilot.flight.armed


def test_a_guided_take_off_climbs_and_hovers() -> None:
    bench = Bench()
    bench.companion.command(dialect.MAV_CMD_DO_SET_MODE, 1, GUIDED)
    bench.companion.command(ARM, 1)
    take_off = bench.companion.command(dialect.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 5.0)
    assert take_off == ACCEPTED
    bench.run(5.0)
    assert bench.autopilot.flight.world.pose_at(bench.now_s).height_m == pytest.approx(5.0)
    assert landed_state(bench) == dialect.MAV_LANDED_STATE_IN_AIR


def test_leaving_auto_stops_and_coming_back_goes_on() -> None:
    bench = Bench(items=mission((0.0, 60.0), (6.0, 60.0)))
    bench.fly()
    bench.run(7.0)
    bench.companion.say(dialect.MAVLink_set_mode_message(1, 1, LOITER))
    bench.run(4.0)
    stopped = bench.autopilot.flight.world.pose_at(bench.now_s)
    assert stopped.speed_m_s == 0.0
    assert 10.0 < stopped.north_m < 40.0
    bench.companion.command(dialect.MAV_CMD_DO_SET_MODE, 1, AUTO)
    bench.run_until(lambda: bench.companion.of("MISSION_ITEM_REACHED"), within_s=30.0)
    assert bench.companion.of("MISSION_ITEM_REACHED")[0].seq == 2


def test_land_mode_comes_down_where_it_is() -> None:
    bench = Bench(items=mission((0.0, 60.0)))
    bench.fly()
    bench.run(7.0)
    bench.companion.command(dialect.MAV_CMD_NAV_LAND)
    assert bench.autopilot.flight.mode == LAND
    bench.run_until(lambda: not bench.autopilot.flight.armed, within_s=20.0)
    assert bench.autopilot.flight.world.pose_at(bench.now_s).north_m < 45.0


def test_return_to_launch_lands_at_home() -> None:
    bench = Bench(items=mission((0.0, 40.0)))
    bench.fly()
    bench.run(8.0)
    bench.companion.command(dialect.MAV_CMD_NAV_RETURN_TO_LAUNCH)
    bench.run_until(lambda: not bench.autopilot.flight.armed, within_s=60.0)
    pose = bench.autopilot.flight.world.pose_at(bench.now_s)
    assert (pose.east_m, pose.north_m) == pytest.approx((0.0, 0.0), abs=0.6)


def test_a_mission_without_landing_ends_in_the_air_in_auto() -> None:
    bench = Bench(items=mission((0.0, 15.0), land=False))
    bench.fly()
    bench.run_until(lambda: bench.autopilot.flight.mission_complete, within_s=30.0)
    bench.run(5.0)
    assert bench.autopilot.flight.phase is Phase.HOVER
    assert bench.autopilot.flight.mode == AUTO
    current = bench.companion.request(dialect.MAVLINK_MSG_ID_MISSION_CURRENT)
    assert current.mission_state == dialect.MISSION_STATE_COMPLETE


def test_the_heartbeat_tells_mode_and_arming() -> None:
    bench = Bench(items=mission((0.0, 15.0)))
    bench.fly()
    bench.run(1.5)
    beat = bench.companion.last("HEARTBEAT")
    assert (beat.autopilot, beat.custom_mode) == (dialect.MAV_AUTOPILOT_ARDUPILOTMEGA, AUTO)
    assert beat.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED
