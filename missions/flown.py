"""Sorties with their speeds, each within a tank and, as it is flown in the end, a battery."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from missions.demand import Demand, Rates
from missions.errors import PlanError
from missions.paced import Paced
from missions.plan import Leg, Settings, Sortie, nose_s, sortie_wh
from missions.sorties import Flying, SortieSearch
from missions.speeds import choices, chosen, stretches_of
from missions.strips import Floats
from missions.turns import Motion
from missions.ways import Ways

# What the search does not know, bends and turns of the nose, is so much that it needs no more.
ROUNDS = 8
LESS = 0.995
# Flights take up to 0.2 % more of a battery than they are planned with.
MARGIN = 0.9975

Pace = Callable[[Sequence[Sortie]], Paced]


def flown(
    lines: Floats,
    demand: list[Demand],
    ways: Ways,
    settings: Settings,
    *,
    motion: Motion,
    rates: Rates,
    pace: Pace,
    any_depot: bool = False,
) -> Paced:
    """Return the sorties; `pace` gives them the speeds that rates and ground need.

    With `any_depot` one sortie is to be flown from the best of the depots.

    Raises:
        PlanError: where a tank or a battery does not last for any.
    """
    battery = settings.battery
    usable_wh = math.inf if battery is None else MARGIN * battery.usable_wh
    pace_s_m = line_pace(lines, rates, settings) if math.isfinite(usable_wh) else None
    flying = Flying(motion=motion, pace_s_m=pace_s_m, any_depot=any_depot)
    search = SortieSearch(lines=lines, demand=demand, ways=ways, settings=settings, flying=flying)
    one = search.in_one()
    if one is not None:
        found = pace(one)
        if max(each_wh(found.sorties, settings)) <= usable_wh:
            return found
    share = 1.0
    parts, sorties = search.several()
    for _ in range(ROUNDS):
        found = pace(sorties)
        used_wh = each_wh(found.sorties, settings)
        worst_wh = max(used_wh)
        if worst_wh <= usable_wh:
            return found
        better = None
        # Those with more items than an autopilot has room for are flown as several.
        if len(used_wh) == len(parts):
            better = search.with_less(parts, used_wh, usable_wh)
        if better is None:
            share *= LESS * usable_wh / worst_wh
            better = search.several(share, before=parts)
        parts, sorties = better
    raise PlanError(
        f"a sortie takes {worst_wh:.4g} Wh, and may take {usable_wh:.4g} Wh of what the battery "
        "has above its reserve; see mission.battery_wh"
    )


def each_wh(sorties: Sequence[Sortie], settings: Settings) -> list[float]:
    """Return what each sortie takes; 0 where no power is given."""
    battery = settings.battery
    if battery is None:
        return [0.0] * len(sorties)
    return [
        sortie_wh(
            sortie, battery, vertical=settings.vertical, height_m=settings.height_m,
            reserve_l=settings.reserve_l,
            nose_turn_s=nose_s(
                sortie.legs, turn=settings.turn, rate_deg_s=settings.nose_rate_deg_s
            ),
        )
        for sortie in sorties
    ]  # fmt: skip


def line_pace(lines: Floats, rates: Rates, settings: Settings) -> Floats:
    """Return the time of a metre of each line, at the speeds that its rates need."""
    if settings.flow_l_min is None:
        return np.full(len(lines), 1.0 / settings.speed_m_s)
    found = []
    for row in lines.tolist():
        leg = Leg(
            kind="spray", points=((row[0], row[1]), (row[2], row[3])),
            speed_m_s=settings.speed_m_s,
        )  # fmt: skip
        parts = stretches_of(leg, rates, settings)
        taken = chosen(parts, choices(parts, settings), settings.acceleration_m_s2)
        found.append(float(np.sum(np.diff(parts.ends_m, prepend=0.0) / taken)) / leg.length_m)
    return np.array(found)
