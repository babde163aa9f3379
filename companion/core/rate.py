"""From application rate to flow: the speed-and-width law of every rate controller."""

from __future__ import annotations

# 1 L/ha over 1 m of width at 1 m/s is 1e-4 L/s. In the trade's own form this is
# flow [L/min] = rate [L/ha] * speed [km/h] * width [m] / 600.
L_MIN_PER_L_HA_M2_S = 60.0 / 10_000.0


def flow_for_rate(rate_l_ha: float, speed_m_s: float, width_m: float) -> float:
    """Return the flow in L/min that puts `rate_l_ha` on a strip `width_m` wide (P1 Eq. 1).

    >>> round(flow_for_rate(rate_l_ha=15.0, speed_m_s=6.0, width_m=5.0), 3)
    2.7
    """
    return rate_l_ha * speed_m_s * width_m * L_MIN_PER_L_HA_M2_S


def rate_for_flow(flow_l_min: float, speed_m_s: float, width_m: float) -> float:
    """Return the rate in L/ha that `flow_l_min` puts down; the inverse of `flow_for_rate`.

    >>> round(rate_for_flow(flow_l_min=2.7, speed_m_s=6.0, width_m=5.0), 6)
    15.0
    """
    return flow_l_min / (speed_m_s * width_m * L_MIN_PER_L_HA_M2_S)


# Beyond these it is another prescription, not a correction by the operator in the field.
OVERRIDE_MIN_PERCENT, OVERRIDE_MAX_PERCENT = 80.0, 110.0


def is_override(percent: float) -> bool:
    """Whether the operator may ask for this percentage of what is prescribed."""
    return OVERRIDE_MIN_PERCENT <= percent <= OVERRIDE_MAX_PERCENT


def overridden(rate_l_ha: float, percent: float, limit_l_ha: float | None = None) -> float:
    """Return the rate to spray: a percentage of the prescribed one, at most what the label allows.

    At 100 %, and at what is no percentage that may be asked for, it is the prescribed one.

    >>> overridden(20.0, 110.0), overridden(38.0, 110.0, 40.0), overridden(20.0, float("nan"))
    (22.0, 40.0, 20.0)
    """
    if percent == 100.0 or not is_override(percent):
        return rate_l_ha
    rate = rate_l_ha * percent / 100.0
    return rate if limit_l_ha is None else min(rate, max(limit_l_ha, 0.0))
