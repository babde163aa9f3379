"""What a format is given: the flight and, made when first asked for, its samples and its ground."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from analysis.exports.columns import (
    About,
    Column,
    System,
    Unit,
    about,
    point_columns,
    swath_columns,
    text_column,
    units_of,
)
from analysis.exports.samples import Samples, Swaths, joined, samples_of, swaths_of
from analysis.flight_record import FlightRecord
from analysis.flown.applied_flight import AppliedFlight
from analysis.flown.applied_record import record_of
from analysis.flown.modelled_flow import metered_l

Shape = Literal["points", "swaths", "steps"]


@dataclass(frozen=True, kw_only=True)
class Source:
    """A flight and how it is wanted: `shape` is what a row is (`steps`: 10 ms).

    `rate_hz` thins points; `unread` says what of the journal could not be read. Of a job `also` has
    the sorties after it: their rows follow, with the number of the sortie.
    """

    flight: AppliedFlight
    shape: Shape
    system: System = "metric"
    rate_hz: float | None = None
    unread: tuple[str, ...] = ()
    also: tuple[Source, ...] = ()

    @cached_property
    def record(self) -> FlightRecord:
        """Return path and modelled flow every 10 ms."""
        return record_of(self.flight)

    @cached_property
    def samples(self) -> Samples:
        """Return the rows of points."""
        own = samples_of(self.flight, self.record, rate_hz=self.rate_hz)
        return joined([own, *(each.samples for each in self.also)])

    @cached_property
    def swaths(self) -> Swaths:
        """Return the polygons of what was treated."""
        own = swaths_of(self.flight, self.record)
        return joined([own, *(each.swaths for each in self.also)])

    @property
    def parts(self) -> tuple[Source, ...]:
        """Return each sortie by itself."""
        return (replace(self, also=()), *self.also) if self.also else (self,)

    @cached_property
    def about(self) -> About:
        """Return the facts of the flight."""
        every = [about(self.flight), *(each.about for each in self.also)]
        return replace(
            every[0],
            flight=", ".join(each.flight for each in every),
            journal=", ".join(each.journal for each in every),
            ended_utc=max(each.ended_utc for each in every),
            is_closed=all(each.is_closed for each in every),
            lost_rows=sum(each.lost_rows for each in every),
        )

    @property
    def units(self) -> dict[str, Unit]:
        """Return the unit of each quantity."""
        return units_of(self.system)

    @property
    def valve_names(self) -> tuple[str, ...]:
        """Return the names of the valves, left to right."""
        return tuple(valve.name for valve in self.flight.setup.boom.valves)

    @property
    def volume_l(self) -> float:
        """Return what was sprayed in all, by the model."""
        own = float(self.record.volume_ml[-1].sum()) / 1000.0
        return own + sum(each.volume_l for each in self.also)

    @property
    def metered_l(self) -> float | None:
        """Return what the flow meter counted; None without one."""
        every = [metered_l(self.flight), *(each.metered_l for each in self.also)]
        return None if None in every else sum(each or 0.0 for each in every)

    @property
    def rows(self) -> int:
        """Return how many rows an export of this shape has."""
        if self.shape == "steps":
            return len(self.record.time_s)
        return len(self.samples) if self.shape == "points" else len(self.swaths)

    @cached_property
    def columns(self) -> tuple[Column, ...]:
        """Return the columns of a row, without its place."""
        if self.shape == "steps":
            return ()
        if self.shape == "points":
            found = point_columns(self.samples, self.about, self.units)
        else:
            found = swath_columns(self.swaths, self.about, self.units, self.valve_names)
        if not self.also:
            return tuple(found)
        return (*found, text_column("sortie", "Sortie", "in order of time", self.sorties))

    @cached_property
    def sorties(self) -> list[str]:
        """Return of each row which sortie of a job it is of."""
        others = sum(each.rows for each in self.also)
        counts = [self.rows - others, *(each.rows for each in self.also)]
        return np.repeat(np.arange(1, len(counts) + 1).astype(str), counts).tolist()

    def facts(self) -> dict[str, object]:
        """Return what is said of an export once: the flight, and the units of the columns."""
        facts = self.about.as_json() | {
            "volume_l": round(self.volume_l, 6),
            "volume_by": "model of the executed changes",
            "metered_l": None if self.metered_l is None else round(self.metered_l, 6),
            "rows": self.rows,
        }
        if self.unread:
            facts["unread"] = list(self.unread)
        if self.shape == "swaths":
            facts["unmapped_ml"] = round(self.swaths.unmapped_ml, 6)
        facts["units"] = {
            each.name: each.unit.label for each in self.columns if each.unit is not None
        }
        return facts
