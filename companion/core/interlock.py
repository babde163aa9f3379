"""The last word of the core: any reason not to spray makes the all-closed plan."""

from __future__ import annotations

from dataclasses import dataclass

from companion.core.types import Fix


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """What must hold before a valve may open; the contract's `[safety]` table."""

    modes: frozenset[str] = frozenset({"AUTO"})
    position_age_max_s: float = 0.8
    heartbeat_age_max_s: float = 2.5
    speed_min_m_s: float = 1.0
    speed_max_m_s: float = 12.0
    speed_disagreement_max_m_s: float = 1.0
    height_min_m: float = 1.0
    height_max_m: float = 10.0
    fix: Fix = Fix.RTK_FLOAT
    wind_max_m_s: float = 6.0
    wind_required: bool = False
    distance_max_m: float = 20_000.0
    enable_by: frozenset[str] = frozenset({"command", "rc", "web"})
    rc_channel: int | None = None
