"""Drop sizes of a card: volume and number diameters, deposits, volume an area."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.wsp.spread import Spread

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
