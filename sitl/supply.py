"""What a sprayer's motors are like: a pump with an order of its own, and spinning atomisers.

A pump that modulates makes the flow, and on-off valves divide it among the sections that are open.
A constant pump stands behind PWM valves: once it has spun up the pressure is what the nozzle
sets were measured at. Orders are pulse widths, as a speed controller takes them.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal


@dataclass(frozen=True, slots=True, kw_only=True)
class Supply:
    """A pump: dead time, then an exponential, up slower than down; from a stop later still.

    `spin_up_s` is from the order to the first flow of a pump that stood. `relief` is the largest
    flow through one section over its share of the pump's full flow: beyond that the relief valve
    lets the rest back into the tank. Without `valves` nothing shuts the nozzles.
    """

    control: Literal["modulates", "constant"]
    stop_us: float
    min_us: float
    max_us: float
    dead_s: float
    spin_up_s: float
    up_s: float
    down_s: float
    relief: float = 1.25
    valves: bool = True

    def __post_init__(self) -> None:
        _check_pulses(self.stop_us, self.max_us)
        if self.control not in ("modulates", "constant"):
            raise ValueError(f"control is modulates or constant, got {self.control!r}")
        if not self.stop_us < self.min_us < self.max_us:
            raise ValueError("stop_us < min_us < max_us must hold")
        if not all(0.0 <= value <= 10.0 for value in (self.dead_s, self.spin_up_s)):
            raise ValueError("dead_s and spin_up_s must lie in [0, 10] s")
        if not all(0.0 < value <= 10.0 for value in (self.up_s, self.down_s)):
            raise ValueError("up_s and down_s must lie in (0, 10] s")
        if not (self.valves or self.control == "modulates"):
            raise ValueError("a constant pump has valves")
        if not 1.0 <= self.relief <= 10.0:
            raise ValueError(f"relief must lie in [1, 10], got {self.relief}")

    def fraction(self, pulse_us: float) -> float:
        """Return how far between stop and full a pulse is; 0 below the least that turns it."""
        if not pulse_us >= self.min_us:
            return 0.0
        return min((pulse_us - self.stop_us) / (self.max_us - self.stop_us), 1.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Atomiser:
    """A rotary atomiser and the droplets that it makes of the liquid of its valves.

    Its speed follows the pulse as a first-order lag. The volume median diameter is
    `law_um * rpm ** -law_speed * flow ** law_flow`, the flow in L/min.
    """

    name: str
    valves: tuple[int, ...]
    stop_us: float
    max_us: float
    us: tuple[float, ...]
    rpm: tuple[float, ...]
    up_s: float
    down_s: float
    law_um: float
    law_speed: float
    law_flow: float

    def __post_init__(self) -> None:
        _check_pulses(self.stop_us, self.max_us)
        if len(self.us) != len(self.rpm) or len(self.us) < 2:
            raise ValueError("an atomiser needs as many us as rpm, two at least")
        for name, values in (("us", self.us), ("rpm", self.rpm)):
            if not all(a < b for a, b in pairwise(values)):
                raise ValueError(f"{name} of an atomiser must be increasing")
        if not (self.valves and self.rpm[0] >= 0.0):
            raise ValueError("an atomiser needs valves, and no speed is below 0")
        if not all(0.0 < value <= 10.0 for value in (self.up_s, self.down_s)):
            raise ValueError("up_s and down_s must lie in (0, 10] s")
        if not (self.law_um > 0.0 and self.law_speed > 0.0 and self.law_flow >= 0.0):
            raise ValueError("law_um and law_speed must be positive, law_flow not negative")

    def speed_rpm(self, pulse_us: float) -> float:
        """Return the speed that a pulse leads to; below the curve's first pulse it stands.

        >>> disc = Atomiser(name="a", valves=(0,), stop_us=1000, max_us=2000, us=(1100, 2000),
        ...                 rpm=(2000.0, 20000.0), up_s=0.5, down_s=0.5, law_um=1e5,
        ...                 law_speed=0.7, law_flow=0.2)
        >>> disc.speed_rpm(1550), disc.speed_rpm(1050)
        (11000.0, 0.0)
        """
        if not pulse_us >= self.us[0]:
            return 0.0
        i = min(bisect_right(self.us, pulse_us), len(self.us) - 1)
        share = min((pulse_us - self.us[i - 1]) / (self.us[i] - self.us[i - 1]), 1.0)
        return self.rpm[i - 1] + share * (self.rpm[i] - self.rpm[i - 1])


def _check_pulses(stop_us: float, max_us: float) -> None:
    if not 500.0 <= stop_us < max_us <= 2500.0:
        raise ValueError(f"500 <= stop_us < max_us <= 2500 must hold, got {stop_us}, {max_us}")


def read_atomiser(table: dict[str, Any]) -> Atomiser:
    """Return an atomiser of a profile's file."""
    lists: dict[str, Any] = {name: tuple(table[name]) for name in ("valves", "us", "rpm")}
    return Atomiser(**(table | lists))
