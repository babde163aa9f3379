"""An autopilot ramps its acceleration on a mission: the speed that is foretold knows it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from companion.core.estimator import Track, estimate, observe
from companion.core.motion import RAMP_MAX_M_S3, Axis, Ramp, Told
from companion.core.types import HeartbeatReport
from tests.builders import position, setup

STEP_S, JERK_M_S3, AHEAD_S = 0.1, 1.0, 0.2
SETUP = setup()


def speeds(time_s: np.ndarray) -> np.ndarray:
    """Return a speed that swings as by a jerk of one: up and down within two seconds each."""
    turns = np.pi * time_s / 2.0
    return 4.0 - (2.0 / np.pi) ** 2 * JERK_M_S3 * np.cos(turns)


def errors(mode: str, *, noise_m_s: float = 0.0, ramp: bool = True) -> float:
    """Return the error (rms) of the speed foretold, of a stream that an estimator has smoothed."""
    rng, track = np.random.default_rng(1), Track()
    time_s = np.arange(0.0, 40.0, STEP_S)
    ways_m = np.cumsum(speeds(time_s)) * STEP_S
    off = []
    for at_s, way_m in zip(time_s.tolist(), ways_m.tolist(), strict=True):
        if at_s % 1.0 < STEP_S / 2:
            beat = HeartbeatReport(received_s=at_s, autopilot="ardupilot", armed=True, mode=mode)
            track = observe(track, beat, SETUP)
        told = float(speeds(np.array([at_s]))[0] + noise_m_s * rng.standard_normal())
        item = position(at_s, 0.0, way_m)
        item = replace(item, velocity_north_m_s=round(told, 2), velocity_east_m_s=0.0)
        track = observe(track, item, SETUP)
        assert track.motion is not None
        if not ramp:
            track = track._replace(motion=track.motion._replace(ramp=(Ramp(), Ramp())))
        state = estimate(track, at_s + AHEAD_S)
        assert state is not None
        if at_s > 10.0:
            off.append(state.velocity_north_m_s - speeds(np.array([at_s + AHEAD_S]))[0])
    return float(np.sqrt(np.mean(np.square(off))))


def test_on_a_mission_a_speed_that_ramps_is_foretold_better() -> None:
    assert errors("AUTO") < 0.7 * errors("AUTO", ramp=False)


def test_by_hand_nothing_is_made_of_a_ramp() -> None:
    """A stick does not ramp."""
    assert errors("POSHOLD") == errors("POSHOLD", ramp=False)


def test_a_noisy_velocity_has_no_ramp() -> None:
    """Only a stream that an estimator has smoothed is believed to tell how it goes on."""
    assert errors("AUTO", noise_m_s=0.1) == errors("AUTO", noise_m_s=0.1, ramp=False)


@pytest.mark.parametrize("now_m_s2", [50.0, -50.0])
def test_a_ramp_is_bounded(now_m_s2: float) -> None:
    """No autopilot ramps its acceleration faster; a jump of the velocity is none."""
    axis = Axis(0.0, 5.0, now_m_s2)
    found = Ramp().followed(STEP_S, axis, axis, 0.5)
    assert abs(found.gain_m_s3) == RAMP_MAX_M_S3


def test_into_the_past_and_in_doubt_a_motion_stays_as_it_is() -> None:
    told = Told(0.0, 5.0, 1.0, 0.0)
    assert Ramp(0.0, 1.0).after(told, -0.1, 1.0) is told
    assert Ramp(0.0, 1.0).after(told, 0.9, 1.0) == Ramp(0.0, 1.0).after(told, 0.5, 1.0)
    assert Ramp(0.0, 1.0).after(told, 0.1, 0.5) is told
    assert Ramp(0.0, 1.0).after(told, float("nan"), 1.0) is told
