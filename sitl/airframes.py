"""The vehicles that a simulated flight has: one that was drawn, and one fitted to flown logs.

What is flown is fitted by `python -m tools.studies.flown_vehicle LOG ...`, which holds the
simulated vehicle beside the logs by the same figures.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from companion.errors import ConfigError


@dataclass(frozen=True, slots=True, kw_only=True)
class EstimatorNoise:
    """How far what an autopilot tells is from the truth (1 sd); all zero is a perfect one.

    Place and velocity are off by a white part and by one that drifts. `wire_s` is how long a
    message is on its way over a telemetry port, less the millisecond that the loopback takes
    itself: 40 bytes at 115 200 baud and the autopilot's scheduler. 31 ms late is as measured on an
    ArduCopter SITL with default parameters (0.157 m at 5 m/s); RTK's noise and drift are those that
    receivers state (1 cm + 1 ppm).
    """

    lag_s: float = 0.031
    wire_s: float = 0.004
    white_m: float = 0.014
    drift_m: float = 0.014
    drift_time_s: float = 30.0
    velocity_m_s: float = 0.03
    velocity_drift_m_s: float = 0.0
    velocity_drift_time_s: float = 30.0

    def kept(self, dt_s: float) -> tuple[float, float, float, float]:
        """Return how much of both drifts is left after a time, and how much (1 sd) is new."""
        place = math.exp(-dt_s / self.drift_time_s)
        pace = math.exp(-dt_s / self.velocity_drift_time_s)
        return (
            place,
            pace,
            self.drift_m * math.sqrt(1.0 - place * place),
            self.velocity_drift_m_s * math.sqrt(1.0 - pace * pace),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Airframe:
    """How gusts move a vehicle, how its nose turns, and what it tells of itself.

    `gust_m_s` (1 sd) acts along the way; 1 m/s of it drives the vehicle `cross_sd_m` off its line,
    on which a critically damped controller of `cross_rate_1_s` holds it. `guided` always flies as
    its autopilot leads it, and never stops and turns at once.
    """

    gust_m_s: float = 1.0
    gust_time_s: float = 1.5
    cross_sd_m: float = 0.03
    cross_rate_1_s: float = 1.5
    nose_gain_deg_s2: float = math.inf
    guided: bool = False
    noise: EstimatorNoise = field(default_factory=EstimatorNoise)


DRAWN = Airframe()
# Of q116 and q130 (ArduCopter 4.5.7, a heavy hexacopter, AUTO, calm air), by the study named above.
# What drifts for longer than some seconds shows in no log without a second receiver.
FLOWN = Airframe(
    gust_m_s=0.4,
    gust_time_s=1.5,
    cross_sd_m=0.15,
    cross_rate_1_s=0.6,
    nose_gain_deg_s2=200.0,
    guided=True,
    noise=EstimatorNoise(
        white_m=0.0,
        drift_m=0.02,
        drift_time_s=15.0,
        velocity_m_s=0.002,
        velocity_drift_m_s=0.035,
        velocity_drift_time_s=3.0,
    ),
)
AIRFRAMES = {"drawn": DRAWN, "flown": FLOWN}


def airframe_of(name: str, *, gust_m_s: float | None = None) -> Airframe:
    """Return a vehicle by its name, in other gusts where they are told."""
    if name not in AIRFRAMES:
        raise ConfigError(f"--vehicle {name}: give one of {', '.join(AIRFRAMES)}")
    found = AIRFRAMES[name]
    return found if gust_m_s is None else replace(found, gust_m_s=gust_m_s)
