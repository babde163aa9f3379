"""Fields for hard flights: bands or plots whose edges lie askew to the path, along any line.

Places are given along and across the centre line of `hard_paths.py`, so that one map serves a
straight pass and an arc.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import shapely
from shapely import Polygon

from companion.core.prescription import Prescription, Zone
from sitl.hard_paths import CentreLine
from sitl.trajectory import Floats

# The field reaches farther to both sides than a boom of 6 m, so that no strip meets the border
# sideways: an edge there would shut its valve, whatever the zone.
HALF_M = 5.0
OUTERMOST_M = 2.5  # the outermost valves' centres
LEAD_M = 10.0  # from the field's ends to the first and the last edge, under every valve
ACROSS = np.linspace(-HALF_M, HALF_M, 11)
# Changes smaller than 8 % are counted apart; these are not to be mistaken for them.
STEP_MIN = 0.10
TRIES = 50


def edges_of(
    count: int, *, spacing_m: float, slants_deg: Sequence[float]
) -> tuple[list[Floats], float]:
    """Return `count` edges between the field's two ends, those among them, and its length.

    An edge is its place along the line at every one of `ACROSS`. Edge k is `spacing_m` behind the
    one before it and turned by `slants_deg[k]`, in turn, out of the square to the path; clockwise
    is positive.
    """
    slopes = [
        -math.tan(math.radians(slants_deg[number % len(slants_deg)])) for number in range(count)
    ]
    lead_m = LEAD_M + OUTERMOST_M * max(map(abs, slopes))
    length_m = 2.0 * lead_m + (count - 1) * spacing_m
    edges = [np.zeros_like(ACROSS)]
    edges += [
        np.clip(lead_m + number * spacing_m + slope * ACROSS, 0.0, length_m)
        for number, slope in enumerate(slopes)
    ]
    edges.append(np.full_like(ACROSS, length_m))
    return edges, length_m


def bands(line: CentreLine, edges: Sequence[Floats], rates_l_ha: Sequence[float]) -> Prescription:
    """Return the bands between the edges with one rate each."""
    return _field(
        [
            Zone(name=str(number), polygon=_band(line, *pair), rate_l_ha=rate)
            for number, (pair, rate) in enumerate(zip(pairwise(edges), rates_l_ha, strict=True))
        ]
    )


def _band(line: CentreLine, begin_m: Floats, end_m: Floats) -> Polygon:
    """Return the ground between two edges."""
    left = np.linspace(begin_m[0], end_m[0], 15)[1:-1]
    right = np.linspace(begin_m[-1], end_m[-1], 15)[1:-1]
    along_m = np.concatenate((begin_m, right, end_m[::-1], left[::-1]))
    aside = (ACROSS, np.full(len(right), HALF_M), ACROSS[::-1], np.full(len(left), -HALF_M))
    east_m, north_m = line.place(along_m, np.concatenate(aside))
    return Polygon(np.stack((east_m, north_m), axis=1))


def plots(
    line: CentreLine,
    rates_l_ha: Sequence[float],
    *,
    side_m: float,
    turn_deg: float,
    length_m: float,
) -> Prescription:
    """Return square plots in rows and columns, turned, on straight ground; neighbours differ."""
    corners = [(0.0, -HALF_M), (0.0, HALF_M), (length_m, HALF_M), (length_m, -HALF_M)]
    ring = [np.array(part) for part in zip(*corners, strict=True)]
    ground = Polygon(np.stack(line.place(*ring), axis=1))
    middle = ground.centroid
    reach = math.ceil(length_m / side_m / math.sqrt(2.0)) + 1
    zones = []
    for row in range(-reach, reach):
        for column in range(-reach, reach):
            box = shapely.box(
                column * side_m, row * side_m, (column + 1) * side_m, (row + 1) * side_m
            )
            turned = shapely.affinity.rotate(box, -turn_deg, origin=(0.0, 0.0))
            part = shapely.affinity.translate(turned, middle.x, middle.y).intersection(ground)
            if isinstance(part, Polygon) and part.area > 1.0:
                # Two apart in the list along a row, three across: no neighbours are alike.
                rate = rates_l_ha[(2 * column + 3 * row) % len(rates_l_ha)]
                zones.append(Zone(name=f"{row},{column}", polygon=part, rate_l_ha=rate))
    return _field(zones)


def _field(zones: Sequence[Zone]) -> Prescription:
    """Return the map: spraying is allowed where there is a zone."""
    return Prescription(zones)


def drawn_rates(choice: Sequence[float], count: int, *, seed: int) -> list[float]:
    """Return `count` rates at random, each at least a tenth off the one before it."""
    rng = np.random.default_rng(seed)
    rates: list[float] = []
    while len(rates) < count:
        rate = float(rng.choice(choice))
        if not rates or _differ(rate, rates[-1]):
            rates.append(rate)
    return rates


def deliverable_rates(
    edges: Sequence[Floats],
    along_m: Floats,
    speed_m_s: Floats,
    within: tuple[float, float],
    *,
    seed: int,
) -> list[float]:
    """Return rates at random that the speeds over each band leave within the sprayer's range.

    `within` is the least and the greatest rate times speed, L/ha times m/s. Where nothing within
    it is a tenth off the rate before, the end of the range that is farther off is taken.
    """
    rng = np.random.default_rng(seed)
    rates: list[float] = []
    for begin, end in pairwise(edges):
        over = (along_m >= begin.min()) & (along_m <= end.max())
        low = within[0] / float(speed_m_s[over].min())
        high = max(within[1] / float(speed_m_s[over].max()), low)
        drawn = rng.uniform(low, high, size=TRIES).tolist()
        ends = sorted((low, high), key=lambda rate: -abs(rate - rates[-1]) if rates else 0.0)
        rates.append(
            next((rate for rate in drawn if not rates or _differ(rate, rates[-1])), ends[0])
        )
    return rates


def _differ(rate: float, other: float) -> bool:
    return abs(rate - other) >= STEP_MIN * min(rate, other)
