"""Cells that are flown through faster than the sprayer follows: their rate is never there."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from companion.core.frame import LocalFrame
from missions.demand import Rates, Uniform
from missions.plan import Leg, Settings, Sortie
from missions.speeds import between
from missions.strips import Floats

# The rate is read so often within the length that it takes to settle.
READS = 4
# On fields so large that this would be more places, nothing is said of short cells.
PLACES_MAX = 2_000_000


def short_warnings(
    sorties: Sequence[Sortie], rates: Rates, frame: LocalFrame, settings: Settings
) -> tuple[str, ...]:
    """Return how many cells under the middle of the boom are shorter than the lag, and where."""
    legs = [(sortie.number, leg) for sortie in sorties for leg in sortie.legs
            if leg.kind == "spray"]  # fmt: skip
    steps = sum(leg.length_m / max(leg.speed_m_s, 0.1) for _, leg in legs)
    if isinstance(rates, Uniform) or not settings.settle_s > 0.0:
        return ()
    if not steps / settings.settle_s * READS <= PLACES_MAX:
        return ()
    found = [
        (length_m, number, leg, at_m)
        for number, leg in legs
        for length_m, at_m in _short(leg, rates, settings.settle_s * leg.speed_m_s)
    ]
    if not found:
        return ()
    length_m, number, leg, at_m = min(found, key=lambda each: each[0] / each[2].speed_m_s)
    place = frame.to_geographic(*between(leg, at_m / leg.length_m))
    return (
        f"{len(found)} cells are flown through in less than {settings.settle_s:.2f} s, which a "
        f"change of rate takes: the shortest is {length_m:.1f} m at {leg.speed_m_s:g} m/s, sortie "
        f"{number} near {place[0]:.6f}, {place[1]:.6f}; fly slower, or make the cells longer",
    )


def _short(leg: Leg, rates: Rates, settle_m: float) -> list[tuple[float, float]]:
    """Return length and middle of the cells inside a line that are shorter than `settle_m`.

    The first and the last one are cut by the line itself, and no cells.
    """
    count = max(1, math.ceil(leg.length_m / settle_m * READS))
    start, end = np.array(leg.points[0]), np.array(leg.points[-1])
    middle = start + np.outer((np.arange(count) + 0.5) / count, end - start)
    rate: Floats = np.nan_to_num(rates.rates_at(middle[:, 0], middle[:, 1]), nan=0.0)
    changes = np.flatnonzero(np.diff(rate) != 0.0) + 1
    each_m = leg.length_m / count
    length_m, at_m = np.diff(changes) * each_m, (changes[1:] + changes[:-1]) / 2.0 * each_m
    # Lengths are known to one step.
    some = np.flatnonzero(length_m + each_m < settle_m)
    return [(float(length_m[index]), float(at_m[index])) for index in some]
