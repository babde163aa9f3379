"""DO_SET_SERVO follows ArduPilot's rules."""

from __future__ import annotations

import pytest

from sitl.stub.faults import Fault, FaultKind
from sitl.stub.mission_items import MissionItem
from sitl.stub.protocol import dialect
from tests.sitl.stub_bench import Bench, mission

SET_SERVO = dialect.MAV_CMD_DO_SET_SERVO
ACCEPTED, UNSUPPORTED, FAILED = (
    dialect.MAV_RESULT_ACCEPTED,
    dialect.MAV_RESULT_UNSUPPORTED,
    dialect.MAV_RESULT_FAILED,
)


def servo(bench: Bench, channel: int) -> int:
    raw = bench.companion.request(dialect.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW)
    return int(getattr(raw, f"servo{channel}_raw"))


def test_an_output_is_without_pulse_before_the_first_order() -> None:
    bench = Bench()
    bench.run(0.1)
    assert servo(bench, 9) == 0


def test_an_order_is_written_and_read_back_disarmed_too() -> None:
    bench = Bench()
    assert bench.companion.command(SET_SERVO, 9, 1500) == ACCEPTED
    bench.run(0.1)
    assert servo(bench, 9) == 1500


def test_an_order_shows_only_after_the_outputs_were_written() -> None:
    bench = Bench()
    bench.companion.command(SET_SERVO, 9, 1500)
    assert servo(bench, 9) == 0


def test_an_order_holds_for_ever() -> None:
    bench = Bench()
    bench.companion.command(SET_SERVO, 9, 1700)
    bench.autopilot.detach(bench.companion.channel)
    bench.run(120.0)
    assert servo(bench, 9) == 1700


def test_a_pulse_is_not_clamped() -> None:
    bench = Bench()
    bench.companion.command(SET_SERVO, 9, 40_000)
    bench.run(0.1)
    assert servo(bench, 9) == 40_000


def test_a_motor_output_is_refused_with_a_text() -> None:
    bench = Bench()
    assert bench.companion.command(SET_SERVO, 1, 1500) == FAILED
    assert bench.companion.last("STATUSTEXT").text == "ServoRelayEvent: Channel 1 is already in use"
    assert not bench.orders


@pytest.mark.parametrize("channel", [0, 17, -1, float("nan")])
def test_a_channel_that_is_not_there_fails_without_a_text(channel: float) -> None:
    bench = Bench()
    assert bench.companion.command(SET_SERVO, channel, 1500) == FAILED
    assert not bench.companion.of("STATUSTEXT")


@pytest.mark.parametrize(("function", "result"), [(0, ACCEPTED), (22, ACCEPTED), (33, FAILED)])
def test_the_function_decides(function: int, result: int) -> None:
    bench = Bench()
    name = b"SERVO9_FUNCTION"
    bench.companion.say(dialect.MAVLink_param_set_message(1, 1, name, function, 4))
    assert bench.companion.last("PARAM_VALUE").param_value == function
    assert bench.companion.command(SET_SERVO, 9, 1500) == result


def test_orders_carry_the_time_at_which_they_came() -> None:
    bench = Bench()
    bench.run(1.0)
    bench.companion.command(SET_SERVO, 10, 1234)
    [order] = bench.orders
    assert (order.at_s, order.channel, order.pulse_us) == (bench.now_s, 10, 1234)


def test_a_mission_writes_to_an_output_and_says_so() -> None:
    items = list(mission((0.0, 20.0), (10.0, 20.0)))
    items.insert(3, MissionItem(command=SET_SERVO, param1=9, param2=1600))
    bench = Bench(items=tuple(items))
    bench.fly()
    bench.run_until(lambda: bench.orders, within_s=30.0)
    texts = [message.text for message in bench.companion.of("STATUSTEXT")]
    assert "Mission: 3 SetServo" in texts
    assert bench.orders[0].pulse_us == 1600


def test_the_other_firmwares_command_is_unsupported() -> None:
    bench = Bench()
    result = bench.companion.command(dialect.MAV_CMD_DO_SET_ACTUATOR, 0.5)
    assert result == UNSUPPORTED


def test_the_autopilots_own_sprayer_is_not_there_by_default() -> None:
    bench = Bench()
    assert bench.companion.command(dialect.MAV_CMD_DO_SPRAYER, 1) == FAILED


def test_a_refusing_output_can_be_made_to_happen() -> None:
    bench = Bench(faults=(Fault(kind=FaultKind.SERVO_REFUSED, at_s=1.0, duration_s=1.0),))
    assert bench.companion.command(SET_SERVO, 9, 1500) == ACCEPTED
    bench.run(1.5)
    assert bench.companion.command(SET_SERVO, 9, 1500) == FAILED


def test_a_reboot_leaves_the_outputs_without_pulse() -> None:
    bench = Bench()
    bench.companion.command(SET_SERVO, 9, 1500)
    bench.run(1.0)
    assert bench.companion.command(dialect.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1) == ACCEPTED
    bench.run(0.1)
    assert servo(bench, 9) == 0
