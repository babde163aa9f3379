"""What is known about the flight for which a map is checked; all of it may be missing."""

from __future__ import annotations

from dataclasses import dataclass

from shapely import MultiPolygon


@dataclass(frozen=True, slots=True, kw_only=True)
class Sprayer:
    """What the sprayer needs of a zone, so that its rate is really there.

    Args:
        speed_m_s: planned, in the passes.
        lag_s: of the slowest kind of change, the output's delay included.
        period_s: of a PWM period, which a change may have to wait for.
        strip_m: width of the narrowest valve's strip.
        across: what a strip over several zones sprays, as `prescription.across`.
        angle_deg: of the passes, clockwise from north; None where the planner chooses.
        speed_min_m_s: below which nothing is sprayed.
    """

    speed_m_s: float
    lag_s: float
    period_s: float
    strip_m: float
    across: str = "centre"
    angle_deg: float | None = None
    speed_min_m_s: float = 0.0

    @property
    def settle_s(self) -> float:
        """Return how long a rate must last: the lag of a change and one PWM period."""
        return self.lag_s + self.period_s

    @property
    def length_min_m(self) -> float:
        """Return how long a zone must be along the passes."""
        return self.speed_m_s * self.settle_s


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """Where the field and the home are, in longitude and latitude, and what flies there.

    `boundary` and `default_rate_l_ha` stand above the map's own; homes are (latitude, longitude).
    Nothing falls on `exclusions`.
    """

    boundary: MultiPolygon | None = None
    exclusions: tuple[MultiPolygon, ...] = ()
    default_rate_l_ha: float | None = None
    homes: tuple[tuple[float, float], ...] = ()
    sprayer: Sprayer | None = None
