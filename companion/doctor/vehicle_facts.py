"""What was heard of the vehicle in some seconds of listening; judged in `vehicle.py`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from companion.core.types import Fix
from companion.link.streams import ENOUGH


@dataclass(frozen=True, slots=True, kw_only=True)
class Rate:
    """A stream: its rate as wanted and as it came."""

    name: str
    wanted_hz: float
    rate_hz: float

    @property
    def is_enough(self) -> bool:
        """Return whether it comes as wanted; NaN does not."""
        return self.rate_hz >= ENOUGH * self.wanted_hz


@dataclass(frozen=True, slots=True, kw_only=True)
class Position:
    """Where the vehicle says it is."""

    latitude_deg: float
    longitude_deg: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Heard:
    """All that `vehicle.py` judges. What was not heard is None, or empty.

    `refused` is why the link cannot be opened; `troubles` what the link itself said of it.
    """

    url: str
    waited_s: float = 0.0
    refused: str | None = None
    troubles: tuple[str, ...] = ()
    system_id: int | None = None
    autopilot: str = "unknown"
    is_px4: bool = False
    is_armed: bool | None = None
    mode: str | None = None
    rates: tuple[Rate, ...] = ()
    fix: Fix | None = None
    accuracy_m: float | None = None
    is_estimator_healthy: bool | None = None
    position: Position | None = None
    rc_pulse_us: tuple[int, ...] = ()
    has_wind: bool = False
    is_clock_known: bool = False
    parameters: Mapping[str, float | None] | None = None
    # By channel: what the outputs read after closed was ordered; None where nothing is known.
    outputs_us: Mapping[int, int] = field(default_factory=dict)
    is_closed_ordered: bool = False
    order_results: tuple[int, ...] = ()
