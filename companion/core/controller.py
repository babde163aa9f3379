"""The whole application as a function: from a vehicle state to a plan."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from companion.core.boom import Boom
    from companion.core.frame import LocalFrame
    from companion.core.interlock import Limits
    from companion.core.nozzle import NozzleSet, PwmLimits
    from companion.core.prescription import Prescription
    from companion.core.schedule import LagModel
    from companion.core.types import Method

Border = Literal["inside", "volume"]
Across = Literal["centre", "mean", "max"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Setup:
    """All that is constant in a flight."""

    frame: LocalFrame
    prescription: Prescription
    boom: Boom
    nozzle_sets: tuple[NozzleSet, ...]
    pwm: PwmLimits
    lag: LagModel
    method: Method
    look_ahead_s: float
    limits: Limits
    border: Border = "inside"
    border_buffer_m: float = 0.1
    across: Across = "centre"
    lease_s: float = 0.3
    horizon_s: float = 1.5
