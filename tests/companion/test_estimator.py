"""The vehicle's state from messages: on time, filtered, and never from what is no position."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from companion.core.estimator import CONFIRM_COUNT, Track, estimate, observe
from companion.core.motion import CRUISE, MANOEUVRE, Belief, Pair, carried
from companion.core.types import (
    ClockReport,
    EstimatorReport,
    Fix,
    GnssReport,
    HeartbeatReport,
    Input,
    LandedReport,
    OperatorCommand,
    OutputReport,
    RcReport,
    SpeedReport,
    Telemetry,
    WindReport,
)
from tests import builders
from tests.builders import LAG, setup

SETUP = setup()
BOOT = 3.0  # the autopilot's clock is this much behind ours


def position(now_s: float, east_m: float, north_m: float = 0.0, **change: object) -> Telemetry:
    return builders.position(now_s, east_m, north_m, **{"boot_s": now_s - BOOT, **change})


def heard(*items: Input, track: Track | None = None) -> Track:
    track = track or Track()
    for item in items:
        track = observe(track, item, SETUP)
    return track


def eastwards(count: int = 30, hz: float = 10.0, **change: object) -> Track:
    return heard(*(position(10.0 + i / hz, 5.0 * i / hz, **change) for i in range(count)))


def test_position_is_carried_to_the_moment_asked_for() -> None:
    state = estimate(eastwards(), 13.0)
    assert state is not None
    assert state.east_m == pytest.approx(5.0 * 3.0, abs=0.01)
    assert state.velocity_east_m_s == pytest.approx(5.0, abs=1e-6)
    assert state.position_received_s == pytest.approx(12.9)
    assert state.position_valid


def test_two_predictions_in_a_row_are_one_and_none_is_identity() -> None:
    track = eastwards()
    assert track.motion is not None
    at = track.motion.time_s
    now = estimate(track, at)
    assert now is not None
    east, _ = track.motion.after(0.0)
    assert (now.east_m, now.velocity_east_m_s) == (east.position_m, east.velocity_m_s)
    motion = track.motion
    agreed = motion.agreed
    carried_on = [
        Belief(carried(model, belief.east, 0.2), carried(model, belief.north, 0.2))
        for model, belief in ((CRUISE, agreed.cruise), (MANOEUVRE, agreed.manoeuvre))
    ]
    later = motion._replace(time_s=at + 0.2, agreed=Pair(*carried_on, agreed.share))
    moved = track._replace(motion=later)
    once, twice = estimate(track, at + 0.5), estimate(moved, at + 0.5)
    assert once is not None
    assert twice is not None
    assert twice.east_m == pytest.approx(once.east_m, abs=1e-12)


def test_the_delay_of_the_autopilots_estimator_moves_the_position_ahead() -> None:
    late = setup(lag=replace(LAG, position_s=0.031))
    track = Track()
    for i in range(30):
        track = observe(track, position(10.0 + i / 10, 0.5 * i), late)
    state, plain = estimate(track, 13.0), estimate(eastwards(), 13.0)
    assert state is not None
    assert plain is not None
    assert state.east_m - plain.east_m == pytest.approx(5.0 * 0.031, abs=1e-6)


def test_jitter_of_the_link_is_not_taken_for_motion() -> None:
    rng = np.random.default_rng(1)
    track = Track()
    errors = []
    for i in range(300):
        sent = 10.0 + i / 10
        item = position(sent, 0.5 * i)
        track = observe(track, replace(item, received_s=sent + abs(rng.normal(0, 0.003))), SETUP)
        state = estimate(track, sent + 0.05)
        assert state is not None
        errors.append(state.east_m - 5.0 * (sent + 0.05 - 10.0))
    # The mean delay (2.4 ms) stays: 12 mm. Its scatter does not.
    assert np.std(errors[100:]) < 0.004


def test_a_message_that_arrives_late_does_not_move_the_vehicle_back() -> None:
    track = eastwards()
    late = replace(position(13.0, 15.0), received_s=13.2)
    state = estimate(heard(late, track=track), 13.25)
    assert state is not None
    assert state.east_m == pytest.approx(5.0 * 3.25, abs=0.02)


def test_noise_is_filtered_and_acceleration_followed() -> None:
    rng = np.random.default_rng(2)
    track = Track()
    errors, east, speed = [], 0.0, 5.0
    for i in range(200):
        speed += 0.1 * (1.0 if 80 <= i < 100 else 0.0)  # 1 m/s2 for two seconds
        east += speed * 0.1
        item = position(
            10.0 + i / 10,
            east + rng.normal(0, 0.014),
            rng.normal(0, 0.014),
            velocity_east_m_s=speed + rng.normal(0, 0.03),
            velocity_north_m_s=rng.normal(0, 0.03),
        )
        track = observe(track, item, SETUP)
        state = estimate(track, 10.0 + i / 10 + 0.1)
        assert state is not None
        if i > 20:
            errors.append(state.east_m - (east + speed * 0.1))
    assert np.std(errors) < 0.03
    assert np.max(np.abs(errors)) < 0.12


@pytest.mark.parametrize(
    "change",
    [
        {"latitude_deg": math.nan},
        {"longitude_deg": math.inf},
        {"latitude_deg": 91.0},
        {"latitude_deg": 0.0, "longitude_deg": 0.0},
        {"relative_altitude_m": math.nan},
        {"boot_s": math.nan},
        {"received_s": math.inf},
    ],
)
def test_what_is_no_position_makes_the_position_invalid_until_the_next(
    change: dict[str, object],
) -> None:
    track = heard(position(13.0, 15.0, **change), track=eastwards())
    state = estimate(track, 13.0)
    assert state is not None
    assert not state.position_valid
    assert math.isfinite(state.east_m)
    again = estimate(heard(position(13.1, 15.5), track=track), 13.1)
    assert again is not None
    assert again.position_valid


def test_a_jump_is_not_believed_until_it_is_confirmed() -> None:
    track = eastwards()
    for i in range(CONFIRM_COUNT + 1):
        track = heard(position(13.0 + i / 10, 60.0 + 0.5 * i), track=track)
        state = estimate(track, 13.0 + i / 10)
        assert state is not None
        assert state.position_valid is (i == CONFIRM_COUNT)
    assert state is not None
    assert state.east_m == pytest.approx(60.0 + 0.5 * CONFIRM_COUNT, abs=0.05)


def test_the_first_position_needs_confirmation() -> None:
    state = estimate(heard(position(10.0, 0.0)), 10.0)
    assert state is not None
    assert not state.position_valid


def test_an_autopilot_that_was_restarted_is_confirmed_anew() -> None:
    track = eastwards()
    for i in range(8):
        track = heard(position(13.0 + i / 10, 15.0 + i / 2, boot_s=0.5 + i / 10), track=track)
        state = estimate(track, 13.0 + i / 10)
        assert state is not None
        # After three it is not a copy, and five have to confirm the first of them.
        assert state.position_valid == (i < 2 or i == 7)
        assert state.east_m == pytest.approx(15.0 + i / 2, abs=0.01)


def test_repeated_messages_change_nothing() -> None:
    track = eastwards()
    repeated = position(12.9, 14.5)
    assert heard(replace(repeated, received_s=13.3), track=track) == track


@pytest.mark.parametrize("late_s", [0.2, 0.6, 2.9])
def test_a_late_copy_changes_nothing(late_s: float) -> None:
    track = eastwards()
    late = replace(position(13.0 - late_s, 5.0 * (3.0 - late_s)), received_s=13.0)
    after = heard(late, track=track)
    assert after._replace(order=track.order) == track


def test_the_reported_ground_speed_stands_in_for_an_unknown_velocity() -> None:
    track = eastwards(60, velocity_east_m_s=None, velocity_north_m_s=None)
    state = estimate(track, 15.9)
    assert state is not None
    assert not state.velocity_known
    with_speed = heard(SpeedReport(received_s=15.9, ground_speed_m_s=5.2), track=track)
    state = estimate(with_speed, 15.95)
    assert state is not None
    assert state.velocity_known
    assert math.hypot(state.velocity_east_m_s, state.velocity_north_m_s) == pytest.approx(5.2)
    assert state.velocity_east_m_s > 5.1


def test_a_ground_speed_that_is_old_is_no_cross_check() -> None:
    track = heard(SpeedReport(received_s=11.0, ground_speed_m_s=9.0), track=eastwards())
    state = estimate(track, 13.0)
    assert state is not None
    assert state.checked_speed_m_s is None


def test_heading_turns_through_north() -> None:
    items = [position(10 + i / 10, 0.5 * i, heading_deg=(350 + 2.0 * i) % 360) for i in range(20)]
    state = estimate(heard(*items), 12.0)
    assert state is not None
    assert state.yaw_rate_deg_s == pytest.approx(20.0, rel=0.02)
    assert state.heading_deg == pytest.approx(350 + 40.0 - 360, abs=0.5)


def heartbeat(now_s: float, *, armed: bool = True, mode: str = "AUTO") -> HeartbeatReport:
    return HeartbeatReport(received_s=now_s, autopilot="ardupilot", armed=armed, mode=mode)


ENABLE = OperatorCommand(received_s=11.0, enable=True, source="command")


def enabled(track: Track) -> bool:
    return track.consent.enabled


def test_the_operator_enables_and_disables() -> None:
    track = heard(heartbeat(10.0), ENABLE)
    assert enabled(track)
    assert not enabled(heard(replace(ENABLE, enable=False), track=track))


def test_a_source_that_may_not_enable_does_not() -> None:
    assert not enabled(heard(replace(ENABLE, source="stranger")))


def test_a_restart_is_disabled() -> None:
    assert not enabled(Track())


def test_disarming_takes_the_consent_back() -> None:
    track = heard(heartbeat(10.0), ENABLE, heartbeat(12.0, armed=False), heartbeat(13.0))
    assert not enabled(track)


def test_leaving_the_mode_in_mid_pass_takes_the_consent_back() -> None:
    track = heard(heartbeat(10.0), ENABLE, heartbeat(12.0, mode="LOITER"), heartbeat(13.0))
    assert not enabled(track)


def test_entering_the_mode_after_the_consent_keeps_it() -> None:
    assert enabled(heard(heartbeat(10.0, mode="GUIDED"), ENABLE, heartbeat(12.0)))


def rc(now_s: float, pulse_us: int) -> RcReport:
    return RcReport(received_s=now_s, pulse_us=(1500,) * 6 + (pulse_us,))


@pytest.mark.parametrize(
    ("pulses", "wanted"),
    [
        ((1000, 1900), True),
        ((1900, 1900), False),  # high from the start is no edge
        ((1000, 1900, 1000), False),
        ((1000, 1900, 0), False),  # signal lost
        ((0, 1900), False),  # out of a lost signal
        ((1000, 1900, 1500), True),
    ],
)
def test_the_switch_enables_by_its_edge_only(pulses: tuple[int, ...], wanted: bool) -> None:
    given = setup(limits=replace(SETUP.limits, rc_channel=7))
    track = Track()
    for i, pulse in enumerate(pulses):
        track = observe(track, rc(10.0 + i, pulse), given)
    assert track.consent.enabled is wanted


def test_reports_are_kept_and_grow_old() -> None:
    track = heard(
        GnssReport(received_s=10.0, fix=Fix.RTK_FIXED),
        EstimatorReport(received_s=10.0, healthy=True),
        LandedReport(received_s=10.0, in_air=True),
        WindReport(received_s=10.0, speed_m_s=2.0),
        OutputReport(received_s=10.0, healthy=False),
        track=eastwards(),
    )
    young, old = estimate(track, 13.0), estimate(track, 15.1)
    assert young is not None
    assert old is not None
    assert (young.fix, young.estimator_healthy, young.in_air) == (Fix.RTK_FIXED, True, True)
    assert (old.fix, old.estimator_healthy, old.in_air) == (None, None, None)
    assert young.wind_m_s == 2.0
    assert not young.output_healthy


def test_nothing_heard_is_no_state() -> None:
    assert estimate(Track(), 10.0) is None


# ------------------------------------------------------------------------------------ TIMESYNC

WAY_S = 0.06


def over_the_wire(now_s: float, east_m: float, **change: object) -> Telemetry:
    """Return a position of `now_s` that was `WAY_S` on its way."""
    return position(now_s, east_m, 0.0, **{"received_s": now_s + WAY_S, **change})


def answer(now_s: float, **change: float) -> ClockReport:
    given = {"received_s": now_s, "offset_s": BOOT, "round_trip_s": 0.01}
    return ClockReport(**(given | change))


def ahead_m(track: Track, now_s: float) -> float:
    """Return how far the estimate is from the truth: 5 m/s eastwards, 0 at 10 s."""
    state = estimate(track, now_s)
    assert state is not None
    return state.east_m - 5.0 * (now_s - 10.0)


def flown(
    count: int,
    *answers: ClockReport,
    track: Track | None = None,
    first_s: float = 10.0,
    hz: float = 10.0,
) -> tuple[Track, list[float]]:
    """Return the track after `count` delayed positions, and the error at each."""
    track = heard(*answers, track=track)
    errors = []
    for i in range(count):
        now_s = first_s + i / hz
        track = heard(over_the_wire(now_s, 5.0 * (now_s - 10.0)), track=track)
        errors.append(ahead_m(track, now_s + WAY_S))
    return track, errors


SPRAYING = heard(heartbeat(9.0), replace(ENABLE, received_s=9.0))


def test_without_timesync_the_way_of_a_message_is_in_its_age() -> None:
    _, errors = flown(30)
    assert errors[-1] == pytest.approx(-5.0 * WAY_S, abs=1e-3)


def test_timesync_takes_the_way_of_a_message_out_of_its_age() -> None:
    _, errors = flown(30, answer(10.0))
    assert np.abs(errors).max() < 1e-3


def test_a_position_counts_its_age_from_its_sending() -> None:
    track, _ = flown(10, answer(10.0))
    state = estimate(track, 11.0)
    assert state is not None
    assert state.position_received_s == pytest.approx(10.9)


def test_an_answer_while_nothing_is_sprayed_counts_at_once_and_is_no_motion() -> None:
    track, _ = flown(30)
    track, errors = flown(5, answer(13.0), track=track, first_s=13.0)
    assert np.abs(errors).max() < 1e-3
    state = estimate(track, 13.5)
    assert state is not None
    assert state.velocity_east_m_s == pytest.approx(5.0, abs=1e-6)
    assert state.position_valid


def test_an_answer_while_spraying_makes_no_jump() -> None:
    track, errors = flown(30, track=SPRAYING)
    track, after = flown(30, answer(13.0), track=track, first_s=13.0)
    steps = np.diff([errors[-1], *after])
    assert np.abs(steps).max() <= 5.0 * 0.005 * 0.1 + 1e-6
    assert after[-1] - errors[-1] == pytest.approx(5.0 * 0.005 * 3.0, rel=0.05)
    state = estimate(track, 16.0)
    assert state is not None
    assert state.velocity_east_m_s == pytest.approx(5.0, abs=1e-6)


def test_answers_that_stop_leave_the_last_delay_and_make_no_jump() -> None:
    track, errors = flown(30, answer(10.0), track=SPRAYING)
    track, old = flown(100, track=track, first_s=13.0)  # the answer is 5 s old after 2 s
    assert np.abs(np.array([*errors, *old])).max() < 1e-3
    assert track.clock is not None
    assert track.clock.delay_s == pytest.approx(WAY_S, abs=1e-3)


@pytest.mark.parametrize(
    "change",
    [
        {"offset_s": math.nan},
        {"offset_s": -math.inf},
        {"round_trip_s": math.nan},
        {"round_trip_s": -0.001},
        {"round_trip_s": 0.4},
        {"received_s": 4.0},  # too old
        {"received_s": math.nan},
        {"offset_s": BOOT + WAY_S + 0.02},  # the positions would have come before they were sent
        {"offset_s": BOOT - 0.6},
        {"offset_s": BOOT - 1.7e9},  # UTC
    ],
)
def test_an_answer_that_cannot_be_true_is_not_believed(change: dict[str, float]) -> None:
    told, _ = flown(8, answer(10.0, **change))
    plain, _ = flown(8)
    assert told.motion == plain.motion
    assert told.clock is not None
    # That it came is known, for the one after it to be judged by; nothing else is.
    assert told.clock._replace(heard_s=-math.inf, strays=None) == plain.clock


def test_a_reboot_forgets_what_was_known_of_the_clock() -> None:
    track, _ = flown(30, answer(10.0))
    track = heard(answer(13.1, offset_s=6.7), track=track)
    for i in range(3):
        now_s = 13.0 + i / 10
        late_s = 0.7  # a little less than the uptime: the old answer would look like a delay
        boot_s = 10.0 - BOOT - late_s + i / 10
        track = heard(over_the_wire(now_s, 15.0 + i / 2, boot_s=boot_s), track=track)
    assert track.clock_report is not None
    assert track.clock_report.offset_s == 6.7
    assert track.clock is not None
    assert track.clock.heard_count == 1
    assert track.clock.delay_s == pytest.approx(WAY_S)


def test_a_message_that_is_a_second_late_moves_no_clock_that_timesync_confirms() -> None:
    track, _ = flown(30, answer(10.0), track=SPRAYING)
    stuck = replace(over_the_wire(13.0, 15.0), received_s=14.5)
    track = heard(answer(14.0), stuck, track=track)
    assert ahead_m(track, 14.5) == pytest.approx(0.0, abs=0.01)
    state = estimate(track, 14.5)
    assert state is not None
    assert state.position_received_s == pytest.approx(13.0, abs=0.01)  # stale: the limit closes


@pytest.mark.parametrize("hz", [5.0, 10.0, 20.0, 50.0])
def test_the_rate_of_positions_does_not_matter_on_a_steady_line(hz: float) -> None:
    _, errors = flown(int(3 * hz), answer(10.0), track=SPRAYING, hz=hz)
    assert np.abs(errors).max() < 1e-3


def test_a_first_message_that_was_late_does_not_stay_in_the_clock() -> None:
    track = heard(replace(over_the_wire(9.9, -0.5), received_s=9.9 + WAY_S + 0.12))
    _, errors = flown(10, track=track)
    assert errors[-1] == pytest.approx(-5.0 * WAY_S, abs=0.01)


def test_a_clock_that_begins_anew_is_no_motion() -> None:
    track, _ = flown(30)  # 60 ms on the way, and then 10
    for i in range(3):
        now_s = 13.0 + i / 10
        track = heard(position(now_s, 5.0 * (now_s - 10.0), received_s=now_s + 0.01), track=track)
        state = estimate(track, now_s + 0.01)
        assert state is not None
        assert state.position_valid
        assert state.velocity_east_m_s == pytest.approx(5.0, abs=1e-6)
        assert ahead_m(track, now_s + 0.01) == pytest.approx(-0.05, abs=1e-3)
