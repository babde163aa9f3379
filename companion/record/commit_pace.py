"""How often a flight is committed: once a second, sooner where that is too much of the field."""

from __future__ import annotations

from companion.core.setup import Setup
from companion.ports import COMMIT_EVERY_S

COMMIT_LEAST_S = 0.1
# Of the field: the swath of half the time between two commits, which is how far what is known
# after a cut of power may be from what was treated (`companion.runtime.coverage_ahead_s`). On
# 0.3 ha, at 5 m/s with 6 m, that is a commit each 0.2 s; from 1.5 ha on it is one a second.
UNKNOWN_SHARE = 0.001


def commit_every_s(setup: Setup, speed_m_s: float | None) -> float:
    """Return the time between two commits; `speed_m_s` None: the most that is sprayed at."""
    if not setup.records_coverage:
        return COMMIT_EVERY_S
    fastest_m_s = setup.limits.speed_max_m_s if speed_m_s is None else speed_m_s
    half_s = UNKNOWN_SHARE * setup.prescription.field.area / (setup.boom.width_m * fastest_m_s)
    return min(max(2.0 * half_s, COMMIT_LEAST_S), COMMIT_EVERY_S)
