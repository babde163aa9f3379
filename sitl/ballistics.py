"""Droplets as the twin has them: points with drag, from a moving nozzle through moving air.

Independent of the controller's model (`companion/core/options/drift.py`): three dimensions instead
of one, a spectrum instead of one size, slip of small droplets, wind that may fade to the ground.
Evaporation, turbulence and the vortices beside the rotors are left out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

GRAVITY_M_S2 = 9.80665
AIR_KG_M3 = 1.204
AIR_PA_S = 1.813e-5
AIR_FREE_PATH_M = 66e-9
WATER_KG_M3 = 998.0
# A flat fan's sheet leaves at about sqrt(2 p / rho) less its losses, at 2 to 3 bar.
EXIT_M_S = 15.0
# By volume; that of published models of flat fans.
SPECTRUM_SD = math.log(1.7)
STEP_S = 0.002
FALL_MAX_S = 120.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Air:
    """How the air moves. The wind is that at the height of the nozzle, (east, north), towards.

    With a `roughness_m` it fades to the ground as the logarithm of the height; without it is the
    same down to the ground. The downwash fades evenly to nothing there.
    """

    wind_east_m_s: float = 0.0
    wind_north_m_s: float = 0.0
    downwash_m_s: float = 8.0
    roughness_m: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Landing:
    """Where droplets land from where they were let go, one value a size, and how long it took."""

    east_m: Floats
    north_m: Floats
    time_s: Floats


def spectrum_um(median_um: float, classes: int = 9, spread: float = SPECTRUM_SD) -> Floats:
    """Return the middle sizes of classes of equal volume, log-normal about the median.

    >>> spectrum_um(250.0, classes=3).round().tolist()
    [150.0, 250.0, 418.0]
    """
    normal = NormalDist(math.log(median_um), spread)
    return np.array([math.exp(normal.inv_cdf((k + 0.5) / classes)) for k in range(classes)])


def fall(
    sizes_um: Floats, *, height_m: float, velocity_m_s: tuple[float, float], air: Air
) -> Landing:
    """Return where droplets of some sizes land, let go at `height_m` by a nozzle that moves.

    Runge and Kutta's fourth order; a step is a tenth of the relaxation time of the smallest size
    and at most `STEP_S`.
    """
    size_m = np.asarray(sizes_um, dtype=np.float64) * 1e-6
    if not (size_m.min() > 5e-6 and 0.0 < height_m <= 100.0):
        raise ValueError("droplets above 5 um and a height up to 100 m are wanted")
    relaxation_s = WATER_KG_M3 * size_m**2 / (18.0 * AIR_PA_S)
    step_s = min(STEP_S, 0.1 * float(relaxation_s.min()))
    # Rows: east, north, up; their velocities.
    now = np.zeros((6, len(size_m)))
    now[2] = height_m
    now[3], now[4], now[5] = velocity_m_s[0], velocity_m_s[1], -EXIT_M_S
    landed = np.full((3, len(size_m)), np.nan)
    for count in range(math.ceil(FALL_MAX_S / step_s)):
        before, now = now, _stepped(now, step_s, size_m, height_m, air)
        down = (now[2] <= 0.0) & np.isnan(landed[2])
        if down.any():
            share = before[2] / np.maximum(before[2] - now[2], 1e-12)
            landed[:2, down] = (before[:2] + share * (now[:2] - before[:2]))[:, down]
            landed[2, down] = ((count + share) * step_s)[down]
            if not np.isnan(landed[2]).any():
                break
    return Landing(east_m=landed[0], north_m=landed[1], time_s=landed[2])


def _stepped(now: Floats, step_s: float, size_m: Floats, height_m: float, air: Air) -> Floats:
    k1 = _change(now, size_m, height_m, air)
    k2 = _change(now + 0.5 * step_s * k1, size_m, height_m, air)
    k3 = _change(now + 0.5 * step_s * k2, size_m, height_m, air)
    k4 = _change(now + step_s * k3, size_m, height_m, air)
    after: Floats = now + step_s / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    return after


def _change(now: Floats, size_m: Floats, height_m: float, air: Air) -> Floats:
    """Return velocities and accelerations: gravity and drag against the air around a droplet."""
    share = np.clip(now[2] / height_m, 0.0, 1.0)
    blows = _wind_share(now[2], height_m, air.roughness_m)
    against = np.array(
        [
            now[3] - air.wind_east_m_s * blows,
            now[4] - air.wind_north_m_s * blows,
            now[5] + air.downwash_m_s * share,
        ]
    )
    reynolds = AIR_KG_M3 * np.sqrt((against**2).sum(axis=0)) * size_m / AIR_PA_S
    # Stokes's drag with Cunningham's slip, and Schiller and Naumann's factor up to Re = 800.
    knudsen = 2.0 * AIR_FREE_PATH_M / size_m
    slip = 1.0 + knudsen * (1.257 + 0.4 * np.exp(-1.1 / knudsen))
    rate = 18.0 * AIR_PA_S / (WATER_KG_M3 * size_m**2 * slip) * (1.0 + 0.15 * reynolds**0.687)
    change = np.empty_like(now)
    change[:3] = now[3:]
    change[3:] = -rate * against
    change[5] -= GRAVITY_M_S2
    return change


def _wind_share(up_m: Floats, height_m: float, roughness_m: float) -> Floats:
    """Return the wind at a height over that at the nozzle."""
    if not roughness_m > 0.0:
        return np.ones_like(up_m)
    up = np.clip(up_m, roughness_m, height_m)
    share: Floats = np.log(up / roughness_m) / math.log(height_m / roughness_m)
    return share
