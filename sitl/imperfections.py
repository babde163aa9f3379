"""What real valves and supplies have and no controller here models: it has to be calibrated away.

All of it is off unless a profile has a table `[imperfections]`. The truth is this file; the
controller sees valves only through the flow meter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import numpy as np


@dataclass(frozen=True, slots=True, kw_only=True)
class Imperfections:
    """How parts depart from the profile; scatters are 1 sd between the valves of a sprayer.

    `offset_scatter_s`: a valve delivers so much longer than its pulse, at every duty.
    `curvature_scatter`: how much more of its flow a valve gives at full duty than at none.
    `interaction`: the share of its flow that a valve loses when all others open beside it.
    `ripple` at `ripple_hz`: the supply's pressure swings, as that of a hunting regulator.
    `rest_lag_s`: a valve that was shut opens so much later, a share of it after `rest_time_s`.
    `pressure_lag_s`: one that opens while no other is open has the most pressure against it.
    `warming`: how much more flows once coils and hoses are warm, after `warming_time_s`.
    """

    offset_scatter_s: float = 0.0
    curvature_scatter: float = 0.0
    interaction: float = 0.0
    ripple: float = 0.0
    ripple_hz: float = 0.5
    rest_lag_s: float = 0.0
    rest_time_s: float = 1.0
    pressure_lag_s: float = 0.0
    warming: float = 0.0
    warming_time_s: float = 300.0

    def __post_init__(self) -> None:
        for each in fields(self):
            value = getattr(self, each.name)
            if not 0.0 <= value < math.inf:
                raise ValueError(f"imperfections: {each.name} must not be negative, got {value}")
        if not (self.interaction < 0.5 and self.ripple < 0.5 and self.curvature_scatter < 0.3):
            raise ValueError("imperfections: interaction, ripple below 0.5, curvature below 0.3")
        if not (self.offset_scatter_s < 0.01 and self.ripple_hz <= 5.0):
            raise ValueError("imperfections: offset below 0.01 s, ripple_hz 5 at most")
        if not (self.rest_lag_s < 0.05 and self.pressure_lag_s < 0.05):
            raise ValueError("imperfections: lags must be below 0.05 s")
        if not (self.rest_time_s > 0.0 and self.warming_time_s > 0.0):
            raise ValueError("imperfections: times must be positive")

    @property
    def alike(self) -> Imperfections:
        """Return the same with all valves alike."""
        return replace(self, offset_scatter_s=0.0, curvature_scatter=0.0)


# After what makers and papers say of such parts. A solenoid's opening and closing times repeat
# within 0.5 to 1 ms between units; the flow of pulsed nozzles departs from a straight line in duty
# by 1 to 3 % (P1's own Table 2 by up to 4 %); nozzle pressure falls by 5 to 10 % from few open
# valves to all (Fabula et al. 2021; P1: 290 against 227 kPa), half of it in flow; a regulator hunts
# by 1 %; a valve at rest, or against more pressure, opens some ms later; water that warms by 10 K
# and an elastomer seat let 1 % more pass. Which of it a given sprayer has, nobody knows beforehand.
TYPICAL = Imperfections(
    offset_scatter_s=0.0005,
    curvature_scatter=0.02,
    interaction=0.04,
    ripple=0.01,
    rest_lag_s=0.003,
    pressure_lag_s=0.002,
    warming=0.01,
)


class Parts:
    """The parts of one sprayer, drawn by its seed."""

    def __init__(self, what: Imperfections, count: int, *, seed: int, start_s: float) -> None:
        self.what = what
        self._start_s = start_s
        rng = np.random.default_rng((seed, 22))
        draws = np.clip(rng.standard_normal((2, count)), -3.0, 3.0)
        # What all valves have alike is in the measured curve already.
        draws -= draws.mean(axis=1, keepdims=True)
        self._longer_s: list[float] = (what.offset_scatter_s * draws[0]).tolist()
        self._bend: list[float] = (what.curvature_scatter * draws[1]).tolist()
        self._phase = float(rng.uniform(0.0, 2.0 * math.pi))
        self._count = count
        self._closed_s = [-math.inf] * count

    @property
    def moves_others(self) -> bool:
        """Return whether an edge of one valve changes the flow of all that are open."""
        return self.what.interaction > 0.0 or self.what.ripple > 0.0

    def scale(self, valve: int, at_s: float, duties: list[float], are_open: list[bool]) -> float:
        """Return the flow of an open valve over that of the profile."""
        what, duty = self.what, duties[valve]
        usual = sum(duties) / self._count
        now = sum(are_open) / self._count
        since_s = at_s - self._start_s
        return (
            (1.0 + self._bend[valve] * (duty - 0.5))
            * (1.0 - what.interaction * (now - usual))
            * (1.0 + what.ripple * math.sin(2.0 * math.pi * what.ripple_hz * at_s + self._phase))
            * (1.0 + what.warming * -math.expm1(-since_s / what.warming_time_s))
        )

    def flow_over_nominal(self, valve: int, period_s: float) -> float:
        """Return the mean flow of a valve over the nominal one's, at two levels of duty."""
        shares = []
        for duty in (0.4, 0.75):
            longer = 1.0 + self._longer_s[valve] / (duty * period_s)
            shares.append(longer * (1.0 + self._bend[valve] * (duty - 0.5)))
        return sum(shares) / len(shares)

    def late_s(self, valve: int, at_s: float, are_open: list[bool], *, is_open: bool) -> float:
        """Return how much later than the profile's an edge is."""
        what = self.what
        if not is_open:
            self._closed_s[valve] = at_s
            return self._longer_s[valve]
        rest_s = at_s - self._closed_s[valve]
        others = (sum(are_open) - 1) / max(self._count - 1, 1)
        rested = -math.expm1(-rest_s / what.rest_time_s)
        return what.rest_lag_s * rested + what.pressure_lag_s * (1.0 - others)
