"""What no controller can do better on this twin: how well a speed can be foretold at all.

    python -m tools.studies.physical_limit

A trim acts a lag and half a period after its order. Until then gusts change the speed, and the
velocity that is heard has noise. The best that any linear filter can do follows from the gusts'
own statistics (`sitl/vehicle.py`) by a Riccati equation; what ours does is measured on flights.
"""

from __future__ import annotations

import math
import sys

import numpy as np
from numpy.typing import NDArray

from companion.core.estimator import Track, estimate, observe
from companion.core.types import Telemetry
from sitl.anyang import demo_setup, demo_trajectory
from sitl.earth import Earth
from sitl.navigation import Navigation
from sitl.vehicle import DRAG_1_S, SPEED_GAIN_1_S

GUST_M_S, GUST_TIME_S = 1.0, 1.5
POSITION_SD_M, VELOCITY_SD_M_S = 0.014, 0.03
RATE_HZ = 20.0
ESTIMATOR_LAG_S, MESSAGE_DELAY_S, JITTER_S = 0.031, 0.005, 0.003
# From an order to where its trim acts on average: a valve's lag and half a period of 11 Hz.
ACTS_S = 0.145
# The mean of absolute values of a normal error, over its standard deviation.
MEAN_ABS = math.sqrt(2.0 / math.pi)
SEEDS = range(1, 5)
# Cruise: the speed is within this of the leg's, over the last and the next moments too.
CRUISE_M_S = 0.5
Floats = NDArray[np.float64]


def best_error_m_s(acts_s: float = ACTS_S) -> float:
    """Return the least mean absolute error of the speed foretold, gusts' statistics known."""
    model = np.array(
        [[0.0, 1.0, 0.0], [0.0, -SPEED_GAIN_1_S, DRAG_1_S], [0.0, 0.0, -1.0 / GUST_TIME_S]]
    )
    strength = 2.0 * GUST_M_S**2 / GUST_TIME_S
    step, kick = _over(model, 1.0 / RATE_HZ, strength)
    seen = np.eye(3)[:2]
    noise = np.diag([POSITION_SD_M**2, VELOCITY_SD_M_S**2])
    spread = np.eye(3)
    for _ in range(3000):
        spread = step @ spread @ step.T + kick
        gain = spread @ seen.T @ np.linalg.inv(seen @ spread @ seen.T + noise)
        spread = (np.eye(3) - gain @ seen) @ spread
    step, kick = _over(model, acts_s + ESTIMATOR_LAG_S + MESSAGE_DELAY_S, strength)
    return MEAN_ABS * math.sqrt(float((step @ spread @ step.T + kick)[1, 1]))


def _over(model: Floats, dt_s: float, strength: float) -> tuple[Floats, Floats]:
    """Return the transition over `dt_s` and the covariance that noise adds meanwhile."""
    slices = 200
    kick = np.zeros((3, 3))
    for i in range(slices):
        reach = _exponential(model * ((i + 0.5) / slices * dt_s))[:, 2:3]
        kick += reach @ reach.T * strength * dt_s / slices
    return _exponential(model * dt_s), kick


def _exponential(matrix: Floats) -> Floats:
    total, term = np.eye(len(matrix)), np.eye(len(matrix))
    for k in range(1, 30):
        term = term @ matrix / k
        total = total + term
    return total


def our_error_m_s(speed_m_s: float, seed: int, acts_s: float = ACTS_S) -> float:
    """Return the mean absolute error of the speed that the core foretells, in cruise."""
    setup, path = demo_setup(speed_m_s), demo_trajectory(speed_m_s, seed)
    start_s, end_s = float(path.time_s[0]), float(path.time_s[-1])
    earth = Earth(setup.frame.latitude_deg, setup.frame.longitude_deg)
    navigation = Navigation(
        path, earth, seed=seed, start_s=start_s, position_rate_hz=RATE_HZ,
        estimator_lag_s=ESTIMATOR_LAG_S, message_delay_s=MESSAGE_DELAY_S, jitter_s=JITTER_S,
    )  # fmt: skip

    def true_m_s(at_s: float) -> float:
        ends = path.at(np.array([at_s - 0.005, at_s + 0.005]))
        return float(np.hypot(np.diff(ends.east_m), np.diff(ends.north_m))[0]) / 0.010

    track, errors = Track(), []
    for item in navigation.advance(end_s):
        track = observe(track, item, setup)
        state = estimate(track, item.received_s + acts_s)
        if not isinstance(item, Telemetry) or state is None:
            continue
        at_s = item.received_s + acts_s
        around = [true_m_s(at_s + shift_s) for shift_s in (0.0, -0.4, 0.4)]
        if all(abs(speed - speed_m_s) < CRUISE_M_S for speed in around):
            found = math.hypot(state.velocity_east_m_s, state.velocity_north_m_s)
            errors.append(abs(found - around[0]))
    return float(np.mean(errors))


def main() -> int:
    """Print the table."""
    best = best_error_m_s()
    out = sys.stdout.write
    out("Error of the speed at which a trim acts, mean of absolute values\n\n")
    out("| Speed | Best possible | Ours | Costs of the rate |\n|---|---|---|---|\n")
    for speed in (2.0, 3.0, 5.0):
        ours = float(np.mean([our_error_m_s(speed, seed) for seed in SEEDS]))
        out(f"| {speed:g} m/s | {best:.4f} m/s | {ours:.4f} m/s | {ours / speed:.2%} |\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
