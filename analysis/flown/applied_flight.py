"""One flight as its journal has it, in arrays: what evaluation, report and exports take.

Nothing of it is the truth of a simulation: positions are those of the autopilot, flows are those
that the executed changes stand for, and beside them what the sensors said.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from analysis.flight_record import Spans
from companion.core.setup import Setup
from companion.journal.writer import Event
from companion.receiver import ReceiverOffset
from companion.simulated import Simulated, simulated_in

ClockSource = Literal["autopilot", "autopilot-jumped", "computer"]
Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Series:
    """What a sensor said: `value` at `time_s`, in order of time; NaN where it said nothing."""

    time_s: Floats
    value: Floats


@dataclass(frozen=True, slots=True, kw_only=True)
class ValveChanges:
    """Changes of duty as they came about, in order of time; both arrays of times in seconds.

    `actual_s` is NaN where the output does not tell when it gave the order.
    """

    planned_s: Floats
    actual_s: Floats
    valve: Ints
    duty: Floats


@dataclass(frozen=True, slots=True, kw_only=True)
class AppliedFlight:
    """A flight, sampled at its decisions (10 a second or more), and what happened between them.

    Times are seconds on the companion's monotonic clock; `utc_offset_s` added to one makes
    seconds since 1970, by the autopilot's clock where `utc_source` says so. Arrays of samples have
    one value a decision with a known position; `rate_l_ha` is samples x valves, NaN where nothing
    is prescribed. `inhibits` has the reasons not to spray, sorted, with spaces between; "" without.
    `flow_l_min` is what the ordered duties stand for, all valves together; `meter_ml` what a flow
    meter has counted since its start; `fix` the quality of the position (`core.inputs.Fix`).
    `unknown` has, for each valve, the times of which rows are missing, in order and apart, which
    may be without end; none at all in a whole journal.
    """

    path: Path
    meta: Mapping[str, str]
    setup: Setup
    is_closed: bool
    lost: int
    events: tuple[Event, ...]
    utc_offset_s: float
    utc_source: ClockSource
    time_s: Floats
    latitude_deg: Floats
    longitude_deg: Floats
    east_m: Floats
    north_m: Floats
    height_m: Floats
    speed_m_s: Floats
    course_deg: Floats
    heading_deg: Floats
    rate_l_ha: Floats
    target_flow_l_min: Floats
    flow_l_min: Floats
    inhibits: tuple[str, ...]
    changes: ValveChanges
    meter_ml: Series | None = None
    pressure_kpa: Series | None = None
    tank_l: Series | None = None
    wind_m_s: Series | None = None
    wind_from_deg: Series | None = None
    fix: Series | None = None
    receiver: ReceiverOffset | None = None
    unknown: tuple[Spans, ...] = ()

    @property
    def training(self) -> str | None:
        """What of this flight was no spraying of a product: `water`, `dry`, `no`; None: unknown."""
        return self.meta.get("training")

    @property
    def simulated(self) -> Simulated:
        """Whether the flight was simulated, and what told."""
        return simulated_in(self.meta)

    @property
    def duration_s(self) -> float:
        """Return the time between the first and the last sample; 0 without any."""
        return float(self.time_s[-1] - self.time_s[0]) if len(self.time_s) else 0.0
