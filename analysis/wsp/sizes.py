"""Drop sizes of a card: volume and number diameters, deposits, volume an area."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from companion.errors import VrsprayError

Floats = NDArray[np.float64]

# DepositScan leaves out what a smaller drop than this would have made: dust and noise.
LEAST_DROP_UM = 50.0
UM2_PER_CM2 = 1e8
# 1 um of liquid on 1 cm2 is 0.1 uL; 1 uL/cm2 is 100 L/ha.
UL_CM2_PER_UM = 0.1
L_HA_PER_UL_CM2 = 100.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Sizes:
    """What the stains of a card say by one spread factor; diameters are None without a deposit."""

    spread: str
    deposits: int
    deposits_per_cm2: float
    coverage_percent: float
    dv01_um: float | None
    dv05_um: float | None
    dv09_um: float | None
    relative_span: float | None
    nmd_um: float | None
    ul_per_cm2: float
    l_ha: float


def stain_um(area_px: Floats, dpi: float) -> Floats:
    """Return the diameters of the discs of these areas, sqrt(4 A / pi)."""
    return np.asarray(np.sqrt(4.0 / math.pi * area_px) * (25_400.0 / dpi))


def sizes(area_px: Floats, *, dpi: float, roi_px: int, spread: Spread) -> Sizes:
    """Return the figures of stains of these areas, on `roi_px` pixels of paper.

    DepositScan's chain: drops of more than 50 um are kept; coverage and count are those of them.
    """
    drop_um = spread.drop_um(stain_um(area_px, dpi))
    kept = drop_um > LEAST_DROP_UM
    drop_um = drop_um[kept]
    roi_um2 = roi_px * (25_400.0 / dpi) ** 2
    volume_um3 = math.pi / 6.0 * drop_um**3
    ul_per_cm2 = float(volume_um3.sum()) * UL_CM2_PER_UM / roi_um2
    dv01, dv05, dv09 = (fraction_um(drop_um, volume_um3, part) for part in (0.1, 0.5, 0.9))
    return Sizes(
        spread=spread.name,
        deposits=len(drop_um),
        deposits_per_cm2=len(drop_um) / roi_um2 * UM2_PER_CM2,
        coverage_percent=100.0 * float(area_px[kept].sum()) / roi_px,
        dv01_um=dv01,
        dv05_um=dv05,
        dv09_um=dv09,
        relative_span=(
            None if dv01 is None or dv05 is None or dv09 is None else (dv09 - dv01) / dv05
        ),
        nmd_um=fraction_um(drop_um, np.ones(len(drop_um)), 0.5),
        ul_per_cm2=ul_per_cm2,
        l_ha=ul_per_cm2 * L_HA_PER_UL_CM2,
    )


def fraction_um(drop_um: Floats, weight: Floats, part: float) -> float | None:
    """Return the diameter below which `part` of the weight lies; None without a drop.

    Straight between the drops in the order of their sizes, and from the origin to the smallest.

    >>> fraction_um(np.array([100.0, 200.0]), np.array([1.0, 3.0]), 0.5)
    133.33333333333334
    >>> fraction_um(np.array([100.0]), np.array([1.0]), 0.5)
    50.0
    """
    if not len(drop_um):
        return None
    order = np.argsort(drop_um)
    share = np.concatenate([[0.0], np.cumsum(weight[order])])
    return float(np.interp(part, share / share[-1], np.concatenate([[0.0], drop_um[order]])))


# From the stain on the paper to the drop that made it: spread factors by name.
#
# A drop spreads on the paper by a factor that grows with its size, and every source has another
# law; the laws are 10 to 15 % apart, so whoever gives a drop size has to say which was used.

# Stain and drop diameter [um]: the table of the paper's maker.
_TABLE_STAIN_UM = np.array([0.0, 100.0, 200.0, 300.0, 400.0, 500.0, 600.0])
_TABLE_DROP_UM = np.array([0.0, 59.0, 109.0, 155.0, 200.0, 243.0, 285.0])
# D = a d - b d^2, which turns back at a / (2 b): larger stains get the drop of that one.
_USDA_A, _USDA_B = 0.53549306, 8.4839e-5


class SpreadError(VrsprayError):
    """There is no spread factor of that name."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Spread:
    """A law from the stain's to the drop's diameter, both in um, never falling."""

    name: str
    formula: str
    drop_um: Callable[[Floats], Floats]


def _usda(stain_um: Floats) -> Floats:
    stain_um = np.minimum(stain_um, _USDA_A / (2.0 * _USDA_B))
    return np.asarray(_USDA_A * stain_um - _USDA_B * stain_um**2)


def _table(stain_um: Floats) -> Floats:
    within = np.interp(stain_um, _TABLE_STAIN_UM, _TABLE_DROP_UM)
    # Beyond the table its last ratio.
    beyond = stain_um * (_TABLE_DROP_UM[-1] / _TABLE_STAIN_UM[-1])
    return np.asarray(np.where(stain_um > _TABLE_STAIN_UM[-1], beyond, within))


def _power(name: str, factor: float, exponent: float) -> Spread:
    return Spread(
        name=name,
        formula=f"D = {factor:g} d^{exponent:g}",
        drop_um=lambda stain_um: np.asarray(factor * stain_um**exponent),
    )


DEPOSITSCAN = _power("depositscan", 0.95, 0.91)
SPREADS = {
    spread.name: spread
    for spread in (
        DEPOSITSCAN,
        Spread(name="usda", formula="D = 0.53549306 d - 8.4839e-5 d^2", drop_um=_usda),
        Spread(
            name="adaptive",
            formula="D = d / (0.0009 d + 1.6333)",
            drop_um=lambda stain_um: np.asarray(stain_um / (0.0009 * stain_um + 1.6333)),
        ),
        Spread(name="table", formula="100:59, 200:109, 300:155 ... 600:285 um", drop_um=_table),
        Spread(name="none", formula="D = d", drop_um=lambda stain_um: stain_um),
    )
}


def spread_of(name: str) -> Spread:
    """Return the law of a name, or D = A d^B of `user:A,B`.

    >>> float(spread_of("depositscan").drop_um(np.array([300.0]))[0].round(1))
    170.6
    >>> float(spread_of("user:1,1").drop_um(np.array([300.0]))[0])
    300.0
    """
    if name in SPREADS:
        return SPREADS[name]
    kind, _, numbers = name.partition(":")
    try:
        factor, exponent = (float(number) for number in numbers.split(","))
    except ValueError:
        factor = exponent = 0.0
    if kind == "user" and 0.0 < factor < 100.0 and 0.1 <= exponent <= 2.0:
        return _power(name, factor, exponent)
    raise SpreadError(
        f"--spread {name[:40]}: give one of {', '.join(SPREADS)}, or user:A,B for D = A d^B [um]"
    )


def second_of(spread: Spread) -> Spread:
    """Return the law whose figures stand in the second column."""
    return SPREADS["usda"] if spread.name == DEPOSITSCAN.name else DEPOSITSCAN
