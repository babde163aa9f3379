"""What the flight controller believes of its position: the truth, late and with noise.

The figures of ArduPilot are those of the twin: 1.4 cm white, 1.4 cm Gauss-Markov of 30 s, 3 cm/s
of velocity; 31 ms late, as measured on an ArduCopter SITL with default parameters (0.157 m at
5 m/s).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from sitl.stub.world import Pose, World


@dataclass(frozen=True, slots=True, kw_only=True)
class EstimatorNoise:
    """How far the estimate is from the truth; all zero is a perfect one.

    `wire_s` is how long a message is on its way over a telemetry port, less the millisecond that
    the loopback takes itself: 40 bytes at 115 200 baud and the autopilot's scheduler.
    """

    lag_s: float = 0.031
    wire_s: float = 0.004
    white_m: float = 0.014
    drift_m: float = 0.014
    drift_time_s: float = 30.0
    velocity_m_s: float = 0.03


ARDUPILOT_NOISE = EstimatorNoise()
# Measured on the PX4 SIH SITL, by its own log of the truth: 10 ms late in all (five flights to and
# fro: 6.7 to 11.9 ms), with a slow bias of 0.1 m.
PX4_NOISE = EstimatorNoise(lag_s=0.006, drift_m=0.1, drift_time_s=120.0)


class Estimator:
    """Gives the estimated pose; the drift goes on between two looks."""

    def __init__(self, world: World, noise: EstimatorNoise, *, seed: int) -> None:
        self._world = world
        self._noise = noise
        self._random = np.random.default_rng(seed)
        self._drift_m = self._random.normal(0.0, noise.drift_m, 2)
        self._drift_at_s = world.start_s

    def estimate(self, now_s: float) -> Pose:
        """Return what is believed at `now_s`."""
        noise = self._noise
        pose = self._world.pose_at(now_s - noise.lag_s - noise.wire_s)
        keep = math.exp(-max(now_s - self._drift_at_s, 0.0) / noise.drift_time_s)
        draw = self._random.normal(0.0, 1.0, 6)
        spread_m = noise.drift_m * math.sqrt(1.0 - keep * keep)
        self._drift_m = self._drift_m * keep + spread_m * draw[:2]
        self._drift_at_s = max(now_s, self._drift_at_s)
        return replace(
            pose,
            time_s=now_s,
            east_m=pose.east_m + float(self._drift_m[0] + noise.white_m * draw[2]),
            north_m=pose.north_m + float(self._drift_m[1] + noise.white_m * draw[3]),
            velocity_east_m_s=pose.velocity_east_m_s + noise.velocity_m_s * float(draw[4]),
            velocity_north_m_s=pose.velocity_north_m_s + noise.velocity_m_s * float(draw[5]),
        )

    def frozen(self, now_s: float) -> Pose:
        """Return the last estimate at rest: what is sent once there is none any more."""
        return replace(
            self.estimate(now_s),
            velocity_east_m_s=0.0,
            velocity_north_m_s=0.0,
            velocity_up_m_s=0.0,
        )
