"""Units of the columns: metric as recorded, or those of United States farms.

Each unit has its name as it ends a column's name, its name for people, and its code as John Deere
and ADAPT write it (`l1ha-1`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

System = Literal["metric", "us"]
SYSTEMS: tuple[System, ...] = get_args(System)

# Exact by definition: the inch of 1959, the gallon of 231 cubic inches, the international acre,
# the avoirdupois pound and standard gravity (NIST Handbook 44, appendix C).
_FT_M = 0.3048
_GAL_L = 3.785411784
_ACRE_HA = 0.40468564224
_PSI_KPA = 6.894757293168361


@dataclass(frozen=True, slots=True, kw_only=True)
class Unit:
    """A unit: `factor` times a value in the recorded unit is the value in this one."""

    suffix: str
    label: str
    code: str
    decimals: int
    factor: float = 1.0


METRIC: dict[str, Unit] = {
    "rate": Unit(suffix="l_ha", label="L/ha", code="l1ha-1", decimals=4),
    "flow": Unit(suffix="l_min", label="L/min", code="l1min-1", decimals=5),
    "volume": Unit(suffix="ml", label="mL", code="ml", decimals=4),
    "speed": Unit(suffix="m_s", label="m/s", code="m1sec-1", decimals=3),
    "length": Unit(suffix="m", label="m", code="m", decimals=3),
    "area": Unit(suffix="m2", label="m2", code="m2", decimals=3),
    "pressure": Unit(suffix="kpa", label="kPa", code="kPa", decimals=2),
    "angle": Unit(suffix="deg", label="deg", code="arcdeg", decimals=2),
    "time": Unit(suffix="s", label="s", code="sec", decimals=4),
    "duty": Unit(suffix="", label="fraction", code="ratio", decimals=4),
}
US: dict[str, Unit] = METRIC | {
    "rate": Unit(
        suffix="gal_ac", label="gal/ac", code="gal1ac-1", decimals=6, factor=_ACRE_HA / _GAL_L
    ),
    "flow": Unit(
        suffix="gal_min", label="gal/min", code="gal1min-1", decimals=6, factor=1.0 / _GAL_L
    ),
    "volume": Unit(
        suffix="fl_oz", label="fl oz", code="floz", decimals=5, factor=128.0 / (1000.0 * _GAL_L)
    ),
    "speed": Unit(
        suffix="mph", label="mph", code="mi1hr-1", decimals=3, factor=3600.0 / (5280.0 * _FT_M)
    ),
    "length": Unit(suffix="ft", label="ft", code="ft", decimals=3, factor=1.0 / _FT_M),
    "area": Unit(suffix="ft2", label="ft2", code="ft2", decimals=2, factor=1.0 / _FT_M**2),
    "pressure": Unit(suffix="psi", label="psi", code="psi", decimals=3, factor=1.0 / _PSI_KPA),
}


def units_of(system: System) -> dict[str, Unit]:
    """Return the unit of each quantity.

    >>> round(100.0 * units_of("us")["rate"].factor, 4)
    10.6907
    """
    return METRIC if system == "metric" else US
