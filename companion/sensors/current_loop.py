"""A 4 to 20 mA transmitter read over a shunt: a broken wire is a fault, and never a zero.

Below 3.6 mA and above 21 mA is no measurement: the limits of NAMUR NE 43, by which transmitters
signal their own failure, and where a broken wire or a short ends up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

BROKEN_MA = 3.6
FAILED_MA = 21.0
LOW_MA, HIGH_MA = 4.0, 20.0


@dataclass(frozen=True, slots=True, kw_only=True)
class CurrentLoop:
    """What 4 and 20 mA stand for, and the shunt that turns them into volts."""

    name: str
    shunt_ohm: float
    at_4_ma: float
    at_20_ma: float

    def __post_init__(self) -> None:
        if not 1.0 <= self.shunt_ohm <= 1000.0:
            raise ValueError(f"shunt_ohm must lie in [1, 1000], got {self.shunt_ohm}")
        if not math.isfinite(self.at_20_ma - self.at_4_ma) or self.at_20_ma == self.at_4_ma:
            raise ValueError("4 and 20 mA must stand for two values")

    def value(self, volts: float) -> tuple[float | None, str]:
        """Return what is measured, or None and the fault in words.

        >>> loop = CurrentLoop(name="pressure", shunt_ohm=100.0, at_4_ma=0.0, at_20_ma=1000.0)
        >>> loop.value(1.2)
        (500.0, '')
        >>> loop.value(0.0)
        (None, 'pressure: 0.0 mA: wire broken, or no supply')
        """
        current_ma = 1000.0 * volts / self.shunt_ohm
        if not math.isfinite(current_ma):
            return None, f"{self.name}: no reading"
        if not current_ma >= BROKEN_MA:
            return None, f"{self.name}: {current_ma:.1f} mA: wire broken, or no supply"
        if not current_ma <= FAILED_MA:
            return None, f"{self.name}: {current_ma:.1f} mA: short circuit, or transmitter failed"
        share = (current_ma - LOW_MA) / (HIGH_MA - LOW_MA)
        return self.at_4_ma + share * (self.at_20_ma - self.at_4_ma), ""
