"""What a scenario says: the faults by the clock, and how the vehicle is from the start."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from sitl.stub.faults import Fault
from sitl.stub.firmware import Version
from sitl.stub.sprayer import LiquidEntry


@dataclass(frozen=True, slots=True, kw_only=True)
class Scenario:
    """What a scenario file says; what it leaves out is as the firmware is.

    `source` names the file in messages.
    """

    source: str = field(default="scenario", compare=False)
    faults: tuple[Fault, ...] = ()
    version: Version | None = None
    commands_per_s: float | None = None
    parameters: Mapping[str, float] = field(default_factory=dict)
    position: Mapping[str, float] = field(default_factory=dict)
    drift_ppm: float = 0.0
    uptime_s: float = 0.0
    wind_towards_m_s: tuple[float, float] = (0.0, 0.0)
    box_closed_s: float = 0.0
    signing_key: bytes | None = None
    liquid: tuple[LiquidEntry, ...] = ()
    meter_battery: int | None = None
    tank_battery: int | None = None
    tank_l: float = 10.0
