"""Where droplets land beside the nozzle that let them go: wind times fall, and a forward carry.

Optional and off unless it is configured. The footprint of every valve is moved by one bounded
offset before it is looked up in the prescription; the fall never becomes part of a lag, for in
the frame of the ground a droplet loses the vehicle's speed within half a metre. Without a wind
that is known, young and within its limit there is no offset: the footprint is the nozzle's.

At a strict border the offset only ever closes more: a valve is closed while the ground under its
nozzle, the ground where its droplets are expected, or any ground between the two is outside.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from companion.core.frame import Offset
from companion.core.types import VehicleState

# Routes are found anew when the offset has moved by more than this since they were.
SAME_OFFSET_M = 0.02
# As the clocks of interlock and estimator: a report from a moment ahead is jitter.
CLOCK_SLACK_S = 0.1
# Below this a vehicle has no course that liquid could be carried along.
MOVING_M_S = 0.5

GRAVITY_M_S2 = 9.81
AIR_KG_M3 = 1.2
AIR_PA_S = 1.81e-5  # dynamic viscosity at 20 degrees C
WATER_KG_M3 = 1000.0
# Of a flat fan at 2 to 3 bar, sqrt(2 p / rho) less its losses.
EXIT_M_S = 15.0
FALL_STEP_S = 0.001
FALL_MAX_S = 60.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Drift:
    """The model and its bounds; `wind_m_s` is the operator's (east, north), towards.

    It holds where it is given; otherwise the autopilot's report does.
    """

    fall_s: float
    forward_carry_m: float = 0.2
    limit_m: float = 2.0
    wind_max_m_s: float = 6.0
    wind_age_max_s: float = 5.0
    wind_m_s: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        for name, most in (
            ("fall_s", FALL_MAX_S),
            ("forward_carry_m", 2.0),
            ("limit_m", 10.0),
            ("wind_max_m_s", 50.0),
            ("wind_age_max_s", 60.0),
        ):
            value = getattr(self, name)
            if not 0.0 <= value <= most:
                raise ValueError(f"{name} must lie in [0, {most:g}], got {value}")


def offset(settings: Drift | None, state: VehicleState, now_s: float) -> Offset | None:
    """Return how far from its nozzle liquid lands; None without settings or a wind to trust."""
    if settings is None:
        return None
    wind = settings.wind_m_s if settings.wind_m_s is not None else _reported(settings, state, now_s)
    if wind is None or not math.hypot(*wind) <= settings.wind_max_m_s:
        return None
    east_m, north_m = wind[0] * settings.fall_s, wind[1] * settings.fall_s
    east, north = state.velocity_east_m_s, state.velocity_north_m_s
    speed_m_s = math.hypot(east, north)
    if speed_m_s >= MOVING_M_S:
        east_m += settings.forward_carry_m * east / speed_m_s
        north_m += settings.forward_carry_m * north / speed_m_s
    length_m = math.hypot(east_m, north_m)
    if not length_m <= settings.limit_m:
        if not length_m < math.inf:
            return None
        east_m, north_m = (
            east_m * settings.limit_m / length_m,
            north_m * settings.limit_m / length_m,
        )
    return east_m, north_m


def _reported(settings: Drift, state: VehicleState, now_s: float) -> tuple[float, float] | None:
    """Return the wind that the autopilot told, if it is young enough."""
    report = state.wind
    if report is None or report.east_m_s is None or report.north_m_s is None:
        return None
    if not -CLOCK_SLACK_S <= now_s - report.received_s <= settings.wind_age_max_s:
        return None
    return report.east_m_s, report.north_m_s


def blowing(speed_m_s: float, from_deg: float) -> tuple[float, float]:
    """Return (east, north) of a wind that comes from a direction, as weather reports tell it.

    >>> east, north = blowing(2.0, 270.0)
    >>> round(east, 6), round(north, 6)
    (2.0, 0.0)
    """
    angle = math.radians(from_deg)
    return -speed_m_s * math.sin(angle), -speed_m_s * math.cos(angle)


def landed(state: VehicleState, offset_m: Offset) -> VehicleState:
    """Return `state` with the place of its nozzles moved to that of their liquid."""
    return replace(state, east_m=state.east_m + offset_m[0], north_m=state.north_m + offset_m[1])


def is_same(one: Offset | None, other: Offset | None) -> bool:
    """Whether routes found with one offset still hold with the other."""
    if one is None or other is None:
        return one is other
    return math.hypot(one[0] - other[0], one[1] - other[1]) <= SAME_OFFSET_M


# ------------------------------------------------------------------------------------ the fall


def fall_s(
    droplet_um: float, height_m: float, *, downwash_m_s: float = 0.0, exit_m_s: float = EXIT_M_S
) -> float:
    """Return how long a droplet falls from a nozzle that points down.

    Schiller and Naumann's drag; the downwash fades evenly to nothing at the ground. It is meant
    for the set-up, not for a step: it is integrated by the midpoint rule.

    >>> round(fall_s(250.0, 3.5), 1), round(fall_s(250.0, 3.5, downwash_m_s=8.0), 1)
    (3.2, 0.8)
    """
    if not (50.0 <= droplet_um <= 5000.0 and 0.0 < height_m <= 100.0):
        raise ValueError(f"no droplet of {droplet_um} um that falls from {height_m} m")
    if not (0.0 <= downwash_m_s <= 50.0 and 0.0 <= exit_m_s <= 100.0):
        raise ValueError(f"no downwash of {downwash_m_s} m/s, no exit at {exit_m_s} m/s")
    size_m = droplet_um * 1e-6

    def gained(left_m: float, down_m_s: float) -> float:
        against = down_m_s - downwash_m_s * left_m / height_m
        reynolds = AIR_KG_M3 * abs(against) * size_m / AIR_PA_S
        stokes = 18.0 * AIR_PA_S / (WATER_KG_M3 * size_m**2)
        return GRAVITY_M_S2 - stokes * (1.0 + 0.15 * math.pow(reynolds, 0.687)) * against

    left_m, down_m_s, elapsed_s = height_m, exit_m_s, 0.0
    # Small droplets follow the air within less than a millisecond.
    step_s = min(FALL_STEP_S, 0.1 * WATER_KG_M3 * size_m**2 / (18.0 * AIR_PA_S))
    while left_m > 0.0 and elapsed_s < FALL_MAX_S:
        middle = down_m_s + 0.5 * step_s * gained(left_m, down_m_s)
        down_m_s += step_s * gained(left_m - 0.5 * step_s * down_m_s, middle)
        left_m -= step_s * middle
        elapsed_s += step_s
    return min(elapsed_s + left_m / max(down_m_s, 1e-3), FALL_MAX_S)
