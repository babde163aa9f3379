"""The rates that are left to spray: none where a flight that goes on keeps its valves closed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from shapely.affinity import translate
from shapely.geometry.base import BaseGeometry

from companion.core.options.coverage import Coverage
from companion.journal.continuing import is_journal, read_treated_ground
from companion.journal.coverage import moved
from missions.demand import Demand, Rates, demands
from missions.field import Field, local_area
from missions.maps.registry import read_area
from missions.reading_outline import told
from missions.strips import Floats, rectangles


@dataclass(frozen=True, slots=True, kw_only=True)
class UntreatedRates:
    """The rates of a map, and 0 on ground that is treated: cells of a journal, or an area.

    Asked at the middle of a valve's strip that is what a guard at half a strip's width does.
    `limit` is the border that the flight keeps to: treated ground is none.
    """

    rates: Rates
    treated: Coverage | BaseGeometry
    limit: BaseGeometry

    def rates_at(self, east_m: Floats, north_m: Floats) -> Floats:
        """Return the rate at each place [L/ha]."""
        rates = self.rates.rates_at(east_m, north_m)
        if isinstance(self.treated, Coverage):
            done = self.treated.covered_at(east_m, north_m)
        else:
            done = shapely.contains_xy(self.treated, east_m, north_m)
        return np.where(done, 0.0, rates)


def untreated_rates(
    rates: Rates,
    done: Path | None,
    field: Field,
    offset_m: tuple[float, float],
    *,
    opens: Mapping[str, str | None],
) -> Rates:
    """Return the rates without what the file says is treated; as they are without one.

    A journal's places are the receiver's, as the plan's are; an area is moved as the map.
    """
    if done is None:
        return rates
    if is_journal(done):
        found = read_treated_ground(done)
        cells = moved(found.coverage, found.frame, field.frame)
        return UntreatedRates(rates=rates, treated=cells, limit=field.kept_in)
    area = translate(local_area(told(partial(read_area, done), opens), field.frame), *offset_m)
    shapely.prepare(area)
    return UntreatedRates(rates=rates, treated=area, limit=field.kept_in)


def demands_once(
    lines: Floats, rates: UntreatedRates, *, width_m: float, **how: Any
) -> list[Demand]:
    """Return the demand along every line as `demands`, ground under two lines with the first."""
    found: list[Demand] = []
    flown: BaseGeometry = shapely.MultiPolygon()
    for row, strip in zip(lines, rectangles(lines, width_m), strict=True):
        shapely.prepare(flown)
        left = replace(rates, rates=rates, treated=flown)
        found += demands(row[None, :], left, width_m=width_m, **how)
        flown = flown.union(strip)
    return found
