"""What decides over the outputs beside the orders: safety switch, transmitter, script, box."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from sitl.stub.faults import Fault, FaultKind
from sitl.stub.outputs import ServoOrder
from sitl.stub.protocol import dialect
from sitl.stub.scenario import Scenario
from sitl.stub.sprayer import ArmingBox, Sprayer, SprayerOptions
from tests.sitl.stub_bench import Bench

SET_SERVO = dialect.MAV_CMD_DO_SET_SERVO


def servo(bench: Bench, channel: int) -> int:
    bench.run(0.02)
    raw = bench.companion.request(dialect.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW)
    return int(getattr(raw, f"servo{channel}_raw"))


def with_function(function: int, *faults: Fault) -> Bench:
    return Bench(scenario=Scenario(parameters={"SERVO9_FUNCTION": function}, faults=faults))


# --------------------------------------------------------------------------------- safety switch


def test_the_safety_switch_ends_all_pulses_and_what_was_ordered_comes_back() -> None:
    bench = Bench(faults=(Fault(kind=FaultKind.SAFETY_SWITCH, at_s=1.0, duration_s=1.0),))
    bench.companion.command(SET_SERVO, 9, 1500)
    assert servo(bench, 9) == 1500
    bench.run(1.1)
    assert (servo(bench, 9), servo(bench, 1)) == (0, 0)
    assert bench.companion.command(SET_SERVO, 9, 1700) == 0
    assert servo(bench, 9) == 0
    bench.run(1.0)
    assert servo(bench, 9) == 1700
    assert [order.pulse_us for order in bench.orders] == [1500, 0, 0, 1700]


# ----------------------------------------------------------------------------------- transmitter


def control(pulse_us: int, *, channel: int = 6) -> Fault:
    return Fault(kind=FaultKind.RC, at_s=5.0, duration_s=5.0, channel=channel, pulse_us=pulse_us)


@pytest.mark.parametrize(("function", "channel"), [(56, 6), (1, 9)])
def test_an_output_of_the_transmitter_is_taken_back_by_a_move(function: int, channel: int) -> None:
    bench = with_function(function, control(1900, channel=channel))
    bench.run(1.0)
    assert servo(bench, 9) == 1000
    assert bench.companion.command(SET_SERVO, 9, 1500) == 0
    bench.run(2.0)
    assert servo(bench, 9) == 1500
    bench.run(2.0)
    assert servo(bench, 9) == 1900
    bench.run(5.0)
    assert servo(bench, 9) == 1000


def test_a_move_within_the_dead_zone_leaves_it_alone() -> None:
    bench = with_function(56, control(1020))
    bench.companion.command(SET_SERVO, 9, 1500)
    bench.run(6.0)
    assert servo(bench, 9) == 1500


def test_an_output_without_function_is_never_taken_back() -> None:
    bench = with_function(0, control(1900))
    bench.companion.command(SET_SERVO, 9, 1500)
    bench.run(6.0)
    assert servo(bench, 9) == 1500


def test_the_switches_are_told_in_rc_channels() -> None:
    bench = with_function(0, control(1900))
    bench.run(6.0)
    message = bench.companion.request(dialect.MAVLINK_MSG_ID_RC_CHANNELS)
    assert (message.chan6_raw, message.chan7_raw, message.chan1_raw) == (1900, 1000, 1500)


@pytest.mark.parametrize("function", [94, 109, 33, 70])
def test_scripts_and_motors_outputs_are_refused(function: int) -> None:
    bench = with_function(function)
    result = bench.companion.command(SET_SERVO, 9, 1500)
    assert result == dialect.MAV_RESULT_FAILED


def test_an_older_order_reads_back_while_newer_ones_are_on_their_way() -> None:
    bench = Bench()
    bench.companion.command(SET_SERVO, 9, 1100)
    bench.run(0.1)
    for pulse_us in (1200, 1300, 1400):
        bench.companion.command(SET_SERVO, 9, pulse_us)
    raw = bench.companion.request(dialect.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW)
    assert raw.servo9_raw == 1100


# ---------------------------------------------------------------------------------------- script


class Watchdog:
    """Closes output 9 for as long as nothing was heard for 0.3 s."""

    def __init__(self, set_output: Callable[[int, float], None]) -> None:
        self.updates: list[float] = []
        self.frames: list[bytes] = []
        self._set_output = set_output
        self._heard_s = 0.0

    def on_message(self, raw: bytes, now_s: float) -> None:
        self.frames.append(raw)
        if raw[7] == dialect.MAVLINK_MSG_ID_NAMED_VALUE_FLOAT:
            self._heard_s = now_s

    def update(self, now_s: float) -> None:
        self.updates.append(now_s)
        if now_s - self._heard_s > 0.3:
            self._set_output(9, 1000)


def live(bench: Bench) -> None:
    bench.companion.say(dialect.MAVLink_named_value_float_message(0, b"SPR_LIVE", 1.0))


@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
def test_a_script_hears_runs_every_20_ms_and_writes(autopilot: str) -> None:
    bench = Bench(autopilot=autopilot)
    script = Watchdog(bench.autopilot.set_output)
    bench.autopilot.script = script
    for _ in range(10):
        live(bench)
        bench.run(0.1)
    assert not [order for order in bench.orders if order.pulse_us == 1000]
    assert len(script.updates) == pytest.approx(50, abs=2)
    died_s = bench.now_s
    bench.run(1.0)
    closed = [order for order in bench.orders if order.channel == 9 and order.pulse_us == 1000]
    assert 0.19 <= closed[0].at_s - died_s < 0.26
    assert script.frames[0][0] == 0xFD


# ------------------------------------------------------------------------------------------- box


def passed(*orders: tuple[float, int], closed_s: float = 2.0) -> list[int]:
    """Return the pulses of the orders that get through."""
    box = ArmingBox(closed_s=closed_s, closed_us=1000.0, full_us=2000.0)
    made = [ServoOrder(at_s=at_s, channel=9, pulse_us=pulse_us) for at_s, pulse_us in orders]
    return [order.pulse_us for order in made if box.passes(order)]


@pytest.mark.parametrize(
    ("orders", "opens"),
    [
        (((0.0, 1500),), False),
        (((0.0, 1000), (1.9, 1500)), False),
        (((0.0, 1000), (2.0, 1500)), True),
        (((0.0, 900), (1.0, 1000), (2.1, 1500)), True),
        (((0.0, 1000), (1.5, 1500), (1.6, 1000), (3.0, 1500)), False),
        (((0.0, 1000), (2.5, 1500), (2.6, 0), (2.7, 1500)), False),
        (((0.0, 1000), (2.5, 1500), (2.6, 1000), (2.7, 1500)), True),
    ],
)
def test_a_box_opens_only_after_a_closed_pulse_of_its_time(
    orders: tuple[tuple[float, int], ...], opens: bool
) -> None:
    assert (passed(*orders)[-1:] == [orders[-1][1]]) is opens


def test_without_a_box_every_order_gets_through() -> None:
    assert passed((0.0, 1500), (0.1, 1000), closed_s=0.0) == [1500, 1000]


@pytest.mark.parametrize(("first_us", "sprays"), [(1500, False), (1000, True)])
def test_the_sprayer_behind_a_box_sprays_only_when_it_was_armed(
    first_us: int, sprays: bool
) -> None:
    sprayer = Sprayer(SprayerOptions(box_closed_s=2.0), start_s=0.0)
    for at_s, pulse_us in ((0.0, first_us), (2.5, 1500)):
        for channel in range(9, 15):
            sprayer.take(ServoOrder(at_s=at_s, channel=channel, pulse_us=pulse_us))
    sprayer.advance(4.0)
    assert (sprayer.volume_l(4.0) > 0.0) is sprays
    assert len(sprayer.orders) == 12
