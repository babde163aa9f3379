"""What a format is given: the flight and, made when first asked for, its samples and its ground."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

from analysis.exports.columns import (
    About,
    Column,
    System,
    Unit,
    about,
    point_columns,
    swath_columns,
    units_of,
)
from analysis.exports.samples import Samples, Swaths, samples_of, swaths_of
from analysis.flight_record import FlightRecord
from analysis.flown.applied_flight import AppliedFlight
from analysis.flown.applied_record import record_of
from analysis.flown.modelled_flow import metered_l

Shape = Literal["points", "swaths", "steps"]


@dataclass(frozen=True, kw_only=True)
class Source:
    """A flight and how it is wanted: `shape` is what a row is (`steps`: 10 ms).

    `rate_hz` thins points; `unread` says what of the journal could not be read.
    """

    flight: AppliedFlight
    shape: Shape
    system: System = "metric"
    rate_hz: float | None = None
    unread: tuple[str, ...] = ()

    @cached_property
    def record(self) -> FlightRecord:
        """Return path and modelled flow every 10 ms."""
        return record_of(self.flight)

    @cached_property
    def samples(self) -> Samples:
        """Return the rows of points."""
        return samples_of(self.flight, self.record, rate_hz=self.rate_hz)

    @cached_property
    def swaths(self) -> Swaths:
        """Return the polygons of what was treated."""
        return swaths_of(self.flight, self.record)

    @cached_property
    def about(self) -> About:
        """Return the facts of the flight."""
        return about(self.flight)

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
        return float(self.record.volume_ml[-1].sum()) / 1000.0

    @property
    def metered_l(self) -> float | None:
        """Return what the flow meter counted; None without one."""
        return metered_l(self.flight)

    @property
    def rows(self) -> int:
        """Return how many rows an export of this shape has."""
        if self.shape == "steps":
            return len(self.record.time_s)
        return len(self.samples) if self.shape == "points" else len(self.swaths)

    @cached_property
    def columns(self) -> tuple[Column, ...]:
        """Return the columns of a row, without its place."""
        if self.shape == "points":
            return tuple(point_columns(self.samples, self.about, self.units))
        if self.shape == "steps":
            return ()
        return tuple(swath_columns(self.swaths, self.about, self.units, self.valve_names))

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
