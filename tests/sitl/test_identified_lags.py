"""Lags that a calibration flight finds over GPIO have no gap between pulses in them.

`lag.on_start_s` is that of a valve ordered fully open. At the border the core adds half the gap of
the duty in question (`Timing.rest_s`); a lag that had the gap in it would count it twice.
"""

from __future__ import annotations

from statistics import fmean

import numpy as np
import pytest

from analysis.calibrate_cli import settings
from analysis.calibration.identify import Identified
from sitl.anyang import PLANT
from sitl.profile import draw_scatter, load_profile
from tests.bench.identification import Task, fly_once

SEEDS = (1, 5)
# Of 16 sprayers the mean is 0.1 ms off and the worst 6.5 ms.
NEAR_S = 0.003


def fastest_s(seed: int) -> float:
    """Return when the first liquid of a seed's sprayer comes: that of its fastest valve."""
    profile = load_profile(PLANT)
    shifts_s = draw_scatter(profile, np.random.default_rng(seed)).shift_s
    return profile.dead_open_s + min(shifts_s)


@pytest.fixture(scope="module")
def found() -> dict[int, Identified]:
    return {seed: fly_once(Task(seed=seed, output="gpio"))[0] for seed in SEEDS}


def test_the_gap_before_the_first_pulse_is_in_no_identified_lag(
    found: dict[int, Identified],
) -> None:
    # Openings at duties from 0.3 to 0.86: gaps of 6 to 32 ms before the first pulse.
    errors_s = []
    for seed, each in found.items():
        assert each.on_start is not None
        errors_s.append(each.on_start.value - fastest_s(seed))
    assert abs(fmean(errors_s)) < NEAR_S


def test_what_is_flown_with_opens_no_sooner_than_the_fastest_valve(
    found: dict[int, Identified],
) -> None:
    for seed, each in found.items():
        assert settings(each)["on_start_s"] < fastest_s(seed)
