"""Positions that go on being sent though nobody knows where the vehicle is.

ArduPilot sends its last location with zero velocity while its estimator has none ("we send stale
data", GCS_Common.cpp); the estimator's own report comes twice a second only. What gives it away
in the positions themselves: place and motion that no vehicle can have together.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from companion.core.types import Telemetry

# The same place to the last bit (1.1 cm) while somebody claims that the vehicle went this far.
FROZEN_M = 0.15
# A slower claim is the noise of one that stands (PX4 tells up to 0.2 m/s at rest): no way is gone.
STANDING_M_S = 0.3
# Exactly no velocity in the message after at least this much, and what brakes take off until then:
# no vehicle stops between two messages. Slower than it nothing is sprayed (`speed_min_m_s`).
STOP_M_S = 0.8
BRAKE_MAX_M_S2 = 5.0


class Stand(NamedTuple):
    """The last place to the bit and when (the autopilot's clock), and whether it is frozen.

    `way_m` is how far the vehicle claims to have gone since it was first at that place.
    """

    latitude_deg: float
    longitude_deg: float
    boot_s: float
    way_m: float
    is_frozen: bool


def look(
    before: Stand | None,
    item: Telemetry,
    *,
    expected_m_s: float | None,
    reported_m_s: float | None,
) -> Stand:
    """Return where the positions stand after one more.

    `expected_m_s` is how fast the vehicle should be by the positions so far, `reported_m_s` what
    the autopilot says in VFR_HUD; None where not known.
    """
    if before is None:
        return Stand(item.latitude_deg, item.longitude_deg, item.boot_s, 0.0, False)
    same = (item.latitude_deg, item.longitude_deg) == before[:2]
    dt_s = item.boot_s - before.boot_s
    said_m_s = _said(item)
    told = (said_m_s, reported_m_s)
    claims = [claim for claim in told if claim is not None and claim > STANDING_M_S]
    way_m = before.way_m + max(claims, default=0.0) * dt_s if same else 0.0
    most_m_s = STOP_M_S + BRAKE_MAX_M_S2 * dt_s
    is_frozen = (same and (before.is_frozen or way_m > FROZEN_M)) or (
        said_m_s == 0.0 and expected_m_s is not None and expected_m_s >= most_m_s
    )
    return Stand(item.latitude_deg, item.longitude_deg, item.boot_s, way_m, is_frozen)


def _said(item: Telemetry) -> float | None:
    if item.velocity_east_m_s is None or item.velocity_north_m_s is None:
        return None
    return math.hypot(item.velocity_east_m_s, item.velocity_north_m_s)
