"""How far a place lies from the nearest change of the prescription along the track.

With two or more cards about one change this shows where the deposit changed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from companion.core.prescription import Prescription

# Looked for so far, in such steps; a zone that is crossed in less is not noticed.
REACH_M, STEP_M = 40.0, 0.1
# The change is then halved in on to a millimetre.
_HALVINGS = 8
# Cards belong to one boundary when the boom went over it at the same time, give or take; a
# boundary that is crossed aslant lies elsewhere for each valve.
SAME_S = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class NearestChange:
    """The nearest change of rate; `distance_m` is how far behind it the place lies, < 0 before it.

    `before_l_ha` and `after_l_ha` are the rates on both sides in the direction of flight, None
    where nothing is prescribed.
    """

    distance_m: float
    before_l_ha: float | None
    after_l_ha: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class CardAtChange:
    """A card near a change: what was found on it, and when the boom passed."""

    card: int
    change: NearestChange
    time_s: float
    speed_m_s: float
    found: dict[str, Any]

    @property
    def crossed_s(self) -> float:
        """Return when the boom was over the change itself."""
        return self.time_s - self.change.distance_m / self.speed_m_s


def nearest_change(
    prescription: Prescription, east_m: float, north_m: float, *, course_deg: float
) -> NearestChange | None:
    """Return the nearest change of rate on the line of flight; None within 40 m."""
    course = math.radians(course_deg)
    sin, cos = math.sin(course), math.cos(course)
    along_m = np.arange(-REACH_M, REACH_M + STEP_M / 2, STEP_M)
    rates = prescription.rates_at(east_m + along_m * sin, north_m + along_m * cos)
    left, right = rates[:-1], rates[1:]
    changes = np.flatnonzero((left != right) & ~(np.isnan(left) & np.isnan(right)))
    if not len(changes):
        return None
    middle_m = (along_m[changes] + along_m[changes + 1]) / 2.0
    i = int(changes[np.argmin(np.abs(middle_m))])
    low, high = float(along_m[i]), float(along_m[i + 1])
    before = _rate(float(rates[i]))
    for _ in range(_HALVINGS):
        middle = (low + high) / 2.0
        rate = prescription.rate_at(east_m + middle * sin, north_m + middle * cos)
        low, high = (middle, high) if rate == before else (low, middle)
    return NearestChange(
        distance_m=-(low + high) / 2.0, before_l_ha=before, after_l_ha=_rate(float(rates[i + 1]))
    )


def tables(cards: Sequence[CardAtChange]) -> list[dict[str, Any]]:
    """Return, for each change with two cards or more, deposit against distance."""
    groups: list[list[CardAtChange]] = []
    for card in sorted(cards, key=lambda each: each.crossed_s):
        same = [group for group in groups if _is_same(group[-1], card)]
        if same:
            same[-1].append(card)
        else:
            groups.append([card])
    return [
        {
            "before_l_ha": group[0].change.before_l_ha,
            "after_l_ha": group[0].change.after_l_ha,
            "cards": [
                {"card": each.card, "distance_m": each.change.distance_m} | each.found
                for each in sorted(group, key=lambda each: each.change.distance_m)
            ],
        }
        for group in groups
        if len(group) > 1
    ]


def _is_same(a: CardAtChange, b: CardAtChange) -> bool:
    return (
        a.change.before_l_ha == b.change.before_l_ha
        and a.change.after_l_ha == b.change.after_l_ha
        and abs(a.crossed_s - b.crossed_s) <= SAME_S
    )


def _rate(rate: float) -> float | None:
    return rate if math.isfinite(rate) else None
