"""Frames to types: scale factors, sentinels, flags, and whose messages count."""

from __future__ import annotations

import math
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.core.types import (
    EstimatorReport,
    Fix,
    GnssReport,
    HeartbeatReport,
    LandedReport,
    RcReport,
    SpeedReport,
    Telemetry,
    WindReport,
)
from companion.link.codec import Codec
from companion.link.encode import Encoder
from companion.link.messages import (
    AckReceived,
    CommandReceived,
    Message,
    PingReceived,
    ServoOutput,
    TimesyncReceived,
)

# The head of a signed FILE_TRANSFER_PROTOCOL, as long as frames get: 280 bytes.
CLAIM = bytes([0xFD, 255, 1, 0, 9, 1, 1, 110, 0, 0])
QUADROTOR, ARDUPILOT, PX4, INVALID = 2, 3, 12, 8
ARMED_AUTO = (QUADROTOR, ARDUPILOT, 128 | 1, 3, 4)


def frame(name: str, *fields: Any, system: int = 1, component: int = 1, **more: Any) -> bytes:
    sender = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
    message = getattr(sender, f"{name}_encode")(*fields, **more)
    return bytes(message.pack(sender))


HEARTBEAT = frame("heartbeat", *ARMED_AUTO)


def decoded(data: bytes, *, first: bytes = HEARTBEAT) -> list[Message]:
    codec = Codec()
    codec.decode(first, 1.0)
    return codec.decode(data, 2.5)


def one(data: bytes, **kwargs: bytes) -> Message:
    messages = decoded(data, **kwargs)
    assert len(messages) == 1
    return messages[0]


def position(**change: int) -> bytes:
    given = {
        "time_boot_ms": 123_456,
        "lat": 359_960_890,
        "lon": 1_145_434_870,
        "alt": 60_000,
        "relative_alt": 3_500,
        "vx": 500,
        "vy": -250,
        "vz": 10,
        "hdg": 1_234,
    }
    return frame("global_position_int", **(given | change))


def test_a_position_comes_in_degrees_metres_and_seconds() -> None:
    assert one(position()) == Telemetry(
        received_s=2.5,
        boot_s=123.456,
        latitude_deg=35.996089,
        longitude_deg=114.543487,
        relative_altitude_m=3.5,
        velocity_north_m_s=5.0,
        velocity_east_m_s=-2.5,
        velocity_down_m_s=0.1,
        heading_deg=12.34,
    )


def test_an_unknown_heading_is_none() -> None:
    message = one(position(hdg=65535))
    assert isinstance(message, Telemetry)
    assert message.heading_deg is None


@pytest.mark.parametrize("raw", [32767, -32768, -32767])
def test_a_velocity_at_the_end_of_its_range_is_unknown(raw: int) -> None:
    message = one(position(vx=raw))
    assert isinstance(message, Telemetry)
    assert message.velocity_north_m_s is None
    assert message.velocity_east_m_s == -2.5


def test_a_heartbeat_tells_mode_and_arming() -> None:
    assert one(HEARTBEAT) == HeartbeatReport(
        received_s=2.5, autopilot="ardupilot", armed=True, mode="AUTO"
    )
    disarmed = one(frame("heartbeat", QUADROTOR, ARDUPILOT, 1, 6, 4))
    assert disarmed == HeartbeatReport(
        received_s=2.5, autopilot="ardupilot", armed=False, mode="RTL"
    )


def test_a_px4_mission_is_named_as_px4_names_it() -> None:
    mission = frame("heartbeat", QUADROTOR, PX4, 128, (4 << 16) | (4 << 24), 4)
    assert one(mission, first=mission) == HeartbeatReport(
        received_s=2.5, autopilot="px4", armed=True, mode="MISSION"
    )


def test_mode_three_of_a_rover_is_not_auto() -> None:
    rover = frame("heartbeat", 10, ARDUPILOT, 128, 3, 4)
    message = one(rover, first=rover)
    assert isinstance(message, HeartbeatReport)
    assert message.mode == "STEERING"


def test_reports_keep_their_meaning() -> None:
    assert one(frame("vfr_hud", 0.0, 4.75, 0, 0, 0.0, 0.0)) == SpeedReport(
        received_s=2.5, ground_speed_m_s=4.75
    )
    assert one(frame("extended_sys_state", 0, 2)) == LandedReport(received_s=2.5, in_air=True)
    assert one(frame("extended_sys_state", 0, 3)) == LandedReport(received_s=2.5, in_air=False)
    assert one(frame("extended_sys_state", 0, 0)) == LandedReport(received_s=2.5, in_air=None)
    # From the east, so to the west; the other message has north and east of where it blows to.
    assert one(frame("wind", 90.0, 3.5, 0.0)) == WindReport(
        received_s=2.5, speed_m_s=3.5, east_m_s=-3.5, north_m_s=pytest.approx(0.0)
    )
    covariance = frame("wind_cov", 0, 3.0, 4.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    assert one(covariance) == WindReport(received_s=2.5, speed_m_s=5.0, east_m_s=4.0, north_m_s=3.0)


@pytest.mark.parametrize(
    ("fix_type", "fix"), [(0, Fix.NONE), (3, Fix.FIX_3D), (6, Fix.RTK_FIXED), (8, Fix.FIX_3D)]
)
def test_a_fix_keeps_its_rank(fix_type: int, fix: Fix) -> None:
    gps = frame("gps_raw_int", 0, fix_type, 0, 0, 0, 0, 0, 0, 0, 12, h_acc=14)
    assert one(gps) == GnssReport(
        received_s=2.5, fix=fix, horizontal_accuracy_m=0.014, satellites=12
    )


def test_accuracy_and_satellites_that_were_not_sent_are_none() -> None:
    message = one(frame("gps_raw_int", 0, 6, 0, 0, 0, 0, 0, 0, 0, 255))
    assert isinstance(message, GnssReport)
    assert message.horizontal_accuracy_m is None
    assert message.satellites is None


def test_a_receivers_place_has_the_autopilots_stamp_or_none() -> None:
    def told(time_us: int, fix_type: int, *place_e7: int) -> GnssReport:
        found = one(frame("gps_raw_int", time_us, fix_type, *place_e7, 0, 0, 0, 0, 0, 12))
        assert isinstance(found, GnssReport)
        return found

    placed = told(7_250_000, 6, 361_000_000, 1_145_000_000)
    assert (placed.boot_s, placed.latitude_deg, placed.longitude_deg) == (7.25, 36.1, 114.5)
    # A time of day, or none; a receiver without a fix, and one that stands at zero.
    assert told(1_764_000_000_000_000, 6, 361_000_000, 0).boot_s is None
    assert told(0, 6, 361_000_000, 0).boot_s is None
    assert told(7_250_000, 1, 361_000_000, 0).latitude_deg is None
    assert told(7_250_000, 6, 0, 0).longitude_deg is None


HEALTHY = 1 | 2 | 4 | 16 | 32


@pytest.mark.parametrize(
    ("flags", "velocity", "horizontal", "healthy"),
    [
        (HEALTHY, 0.1, 0.1, True),
        (HEALTHY & ~16, 0.1, 0.1, False),
        (HEALTHY & ~2, 0.1, 0.1, False),
        (HEALTHY | 128, 0.1, 0.1, False),
        (HEALTHY | 1024, 0.1, 0.1, False),
        (HEALTHY | 32768, 0.1, 0.1, False),
        (HEALTHY, 0.9, 0.1, False),
        (HEALTHY, 0.1, 0.9, False),
        (HEALTHY, math.nan, 0.1, False),
    ],
)
def test_an_estimator_in_doubt_is_unhealthy(
    flags: int, velocity: float, horizontal: float, healthy: bool
) -> None:
    ekf = frame("ekf_status_report", flags, velocity, horizontal, 0.1, 0.1, 0.0)
    assert one(ekf) == EstimatorReport(received_s=2.5, healthy=healthy)


@pytest.mark.parametrize(
    ("flags", "ratio", "healthy"),
    [
        (HEALTHY, 0.2, True),
        (HEALTHY | 1024, 0.2, False),
        (1, 0.2, False),
        (HEALTHY, 1.1, False),
        # PX4 1.16 at rest, its satellites in use (measured); and without them.
        (1023, 0.03, True),
        (1023 & ~512, 0.03, False),
    ],
)
def test_the_estimator_of_px4_counts_too(flags: int, ratio: float, healthy: bool) -> None:
    status = frame("estimator_status", 0, flags, ratio, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1)
    assert one(status) == EstimatorReport(received_s=2.5, healthy=healthy)


def test_channels_without_signal_are_zero() -> None:
    message = one(frame("rc_channels", 500, 8, *([1500] * 8), *([65535] * 10), 255))
    channels = (1500,) * 8 + (0,) * 10
    assert message == RcReport(received_s=2.5, pulse_us=channels, boot_s=0.5)


def test_outputs_are_read_back_first_channel_first() -> None:
    message = one(frame("servo_output_raw", 0, 0, *range(1001, 1009), *range(1009, 1017)))
    assert message == ServoOutput(received_s=2.5, port=0, pulse_us=tuple(range(1001, 1017)))


def test_what_is_addressed_to_us_may_come_from_anyone() -> None:
    ground = {"system": 255, "component": 190}
    command = one(frame("command_long", 1, 191, 216, 0, 1, 0, 0, 0, 0, 0, 0, **ground))
    assert isinstance(command, CommandReceived)
    assert (command.sender.system_id, command.command, command.param1) == (255, 216, 1.0)
    assert isinstance(one(frame("timesync", 0, 77, **ground)), TimesyncReceived)
    assert isinstance(one(frame("ping", 5, 6, 0, 0, **ground)), PingReceived)


@pytest.mark.parametrize(
    "stranger",
    [
        {"system": 1, "component": 154},  # a gimbal of the same vehicle
        {"system": 255, "component": 190},  # a ground station
        {"system": 2, "component": 1},  # another vehicle
    ],
)
def test_only_the_autopilot_describes_the_vehicle(stranger: dict[str, int]) -> None:
    assert not decoded(frame("vfr_hud", 0.0, 4.75, 0, 0, 0.0, 0.0, **stranger))
    assert not decoded(frame("heartbeat", *ARMED_AUTO, **stranger))
    assert not decoded(frame("command_ack", 183, 4, **stranger))
    assert isinstance(one(frame("command_ack", 183, 4)), AckReceived)


@pytest.mark.parametrize(
    "heartbeat",
    [
        frame("heartbeat", 6, INVALID, 0, 0, 4, system=255, component=190),
        frame("heartbeat", 26, INVALID, 0, 0, 4, component=154),
        frame("heartbeat", 27, INVALID, 0, 0, 4, component=156),
        frame("heartbeat", 6, ARDUPILOT, 0, 0, 4, system=255),
        frame("heartbeat", *ARMED_AUTO, component=2),
        frame("heartbeat", *ARMED_AUTO, system=0),
    ],
)
def test_no_other_heartbeat_is_taken_for_the_vehicle(heartbeat: bytes) -> None:
    codec = Codec()
    assert not codec.decode(heartbeat, 0.0)
    assert codec.vehicle is None


def test_nothing_counts_before_the_vehicle_is_known() -> None:
    assert not Codec().decode(position(), 0.0)


def test_the_configured_vehicle_is_waited_for() -> None:
    codec = Codec(system_id=7)
    assert not codec.decode(HEARTBEAT, 0.0)
    assert len(codec.decode(frame("heartbeat", *ARMED_AUTO, system=7), 1.0)) == 1
    assert codec.vehicle is not None
    assert codec.vehicle.system_id == 7


def test_a_stray_start_costs_no_message_behind_it() -> None:
    codec = Codec()
    stray = bytes([0xFD, 200, 0, 0, 1, 1, 1, 0, 0, 0])  # claims 200 bytes of a HEARTBEAT
    messages = codec.decode(stray + HEARTBEAT * 12, 0.0)
    assert len(messages) == 12
    assert codec.counts.dropped_bytes == len(stray)


def test_a_start_without_an_end_holds_nothing_up_for_long() -> None:
    codec = Codec()
    stray = bytes([0xFD, 255, 0, 0, 1, 1, 1, 0, 0, 0])
    assert not codec.decode(stray + HEARTBEAT + b"\x00\x01", 0.0)
    assert len(codec.decode(b"\x02", 1.0)) == 1


def test_a_broken_checksum_drops_the_frame_only() -> None:
    broken = bytearray(HEARTBEAT)
    broken[12] ^= 0x10
    assert len(decoded(bytes(broken) + HEARTBEAT)) == 1


def test_mavlink_1_frames_are_understood() -> None:
    sender = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    old = sender.heartbeat_encode(*ARMED_AUTO).pack(sender, force_mavlink1=True)
    assert old[0] == 0xFE
    assert isinstance(one(bytes(old)), HeartbeatReport)


def test_orders_say_what_an_independent_parser_reads() -> None:
    encoder = Encoder(system_id=3, component_id=191)
    parser = mavlink.MAVLink(None)
    (order,) = parser.parse_buffer(encoder.set_servo(9, 1450))
    assert (order.get_srcSystem(), order.get_srcComponent()) == (3, 191)
    assert (order.target_system, order.target_component) == (3, 1)
    assert (order.command, order.param1, order.param2) == (183, 9.0, 1450.0)
    (ask,) = parser.parse_buffer(encoder.set_message_interval(33, 20.0))
    assert (ask.command, ask.param1, ask.param2, ask.param3) == (511, 33.0, 50_000.0, 0.0)


def test_frames_are_numbered_in_one_sequence() -> None:
    encoder = Encoder(system_id=1, component_id=191)
    assert [encoder.heartbeat(4)[4] for _ in range(257)][-2:] == [255, 0]


def test_a_long_text_is_cut_to_fifty_bytes() -> None:
    encoder = Encoder(system_id=1, component_id=191)
    (text,) = mavlink.MAVLink(None).parse_buffer(encoder.text(6, "x" * 80))
    assert text.text == "x" * 50


@pytest.mark.parametrize(
    "noise", [CLAIM, CLAIM * 5, CLAIM + b"\xfe\x09", b"\xfe\xff\x00\x01\x01\x4c"]
)
def test_a_claimed_length_holds_nothing_back_that_came_with_it(noise: bytes) -> None:
    codec = Codec()
    assert len(codec.decode(noise + HEARTBEAT + position(), 1.0)) == 2


@pytest.mark.parametrize(
    "noise", [CLAIM, CLAIM * 5, CLAIM + b"\xfe\x09", b"\xfe\xff\x00\x01\x01\x4c"]
)
def test_a_claimed_length_holds_nothing_back_that_follows_it(noise: bytes) -> None:
    codec = Codec()
    codec.decode(HEARTBEAT, 1.0)
    assert codec.decode(noise, 1.1) == []
    assert len(codec.decode(position(), 1.11)) == 1
    assert len(codec.decode(position(), 1.12)) == 1


def test_a_claimed_length_holds_nothing_back_behind_which_a_frame_is_cut() -> None:
    codec = Codec()
    codec.decode(HEARTBEAT, 1.0)
    whole = position()
    assert codec.decode(CLAIM, 1.1) == []
    assert len(codec.decode(whole + whole[:9], 1.11)) == 1
    assert len(codec.decode(whole[9:], 1.12)) == 1


def test_a_long_frame_in_pieces_is_still_one() -> None:
    codec = Codec()
    codec.decode(HEARTBEAT, 1.0)
    stream = frame("rc_channels", 0, 8, *([1500] * 8), *([65535] * 10), 255) + position()
    for size in range(1, len(stream)):
        found = [
            message
            for at in range(0, len(stream), size)
            for message in codec.decode(stream[at : at + size], 2.0)
        ]
        assert [type(message) for message in found] == [RcReport, Telemetry], size


def test_a_long_frame_that_carries_others_is_not_cut_short_by_them() -> None:
    codec = Codec()
    codec.decode(HEARTBEAT, 1.0)
    inside = (position() * 5)[:200]
    carrier = frame("file_transfer_protocol", 0, 1, 191, list(inside.ljust(251, b"\x01")))
    for cut in range(15, len(carrier) - 1):
        if (cut - 13) % len(position()) != 0:  # cut exactly between two of them: not told apart
            assert codec.decode(carrier[:cut], 2.0) == [], cut
            assert codec.decode(carrier[cut:], 2.0) == [], cut


@pytest.mark.parametrize(("status", "active"), [(3, False), (4, True), (5, False), (6, False)])
def test_only_a_vehicle_in_its_active_state_is_active(status: int, active: bool) -> None:
    """5 is critical and 6 an emergency: a failsafe is under way."""
    message = one(frame("heartbeat", QUADROTOR, ARDUPILOT, 129, 3, status))
    assert isinstance(message, HeartbeatReport)
    assert message.active is active
