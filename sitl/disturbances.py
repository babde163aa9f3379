"""Errors that a controller knows nothing of, one at a time: of lag, position, its rate, and wind.

Those of lags act on the configuration, those of position on the messages, and wind on where the
liquid lands. A campaign sets them as `error.`; what they cost is in `sitl/studies/sensitivity.py`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from companion.core.frame import LocalFrame
from companion.core.schedule import LagModel
from companion.core.types import Input, Telemetry
from sitl.anyang import anyang_passes

if TYPE_CHECKING:
    from analysis.flight_record import FlightRecord

RATE_HZ = 20.0
# Slower than this there is no course to be told.
MOVING_M_S = 0.5

INSIDE = ("up_s", "down_s")
BORDER = ("on_s", "off_s", "on_start_s", "off_end_s")


@dataclass(frozen=True, slots=True, kw_only=True)
class Disturbance:
    """One error of one flight; without any of its values there is none.

    `lag_short_s` is how much too short the lags in `kinds` are in the configuration. `behind_m`
    is how far behind the vehicle its position is told, along its course; `along_m` and `across_m`
    are how far off it is told on the ground: towards the end of the first pass, and to its right.
    `drift_along_m` and `drift_across_m` are how far wind carries the droplets, the same two ways.
    """

    lag_short_s: float = 0.0
    kinds: tuple[str, ...] = (*INSIDE, *BORDER)
    behind_m: float = 0.0
    along_m: float = 0.0
    across_m: float = 0.0
    drift_along_m: float = 0.0
    drift_across_m: float = 0.0

    @property
    def is_drift(self) -> bool:
        """Return whether it acts on the falling droplets only."""
        return self.drift_along_m != 0.0 or self.drift_across_m != 0.0


def shortened(lag: LagModel, what: Disturbance) -> LagModel:
    """Return the lags with the error in them."""
    wrong = {name: getattr(lag, name) - what.lag_short_s for name in what.kinds}
    return replace(lag, **wrong)


def displaced(items: Iterator[Input], *, what: Disturbance, frame: LocalFrame) -> Iterator[Input]:
    """Yield the inputs with every position in the wrong place."""
    east_m, north_m = on_ground(frame, what.along_m, what.across_m)
    if (what.behind_m, east_m, north_m) == (0.0, 0.0, 0.0):
        yield from items
        return
    for item in items:
        yield (
            _moved(item, frame, what.behind_m, east_m, north_m)
            if isinstance(item, Telemetry)
            else item
        )


def _moved(
    told: Telemetry, frame: LocalFrame, behind_m: float, east_m: float, north_m: float
) -> Telemetry:
    velocity_east, velocity_north = told.velocity_east_m_s or 0.0, told.velocity_north_m_s or 0.0
    speed_m_s = math.hypot(velocity_east, velocity_north)
    if speed_m_s > MOVING_M_S:
        east_m -= behind_m * velocity_east / speed_m_s
        north_m -= behind_m * velocity_north / speed_m_s
    at_east_m, at_north_m = frame.to_local(told.latitude_deg, told.longitude_deg)
    latitude_deg, longitude_deg = frame.to_geographic(at_east_m + east_m, at_north_m + north_m)
    return replace(told, latitude_deg=latitude_deg, longitude_deg=longitude_deg)


def drifted(record: FlightRecord, what: Disturbance, frame: LocalFrame) -> FlightRecord:
    """Return the flight with the path that would have put its liquid where the wind puts it."""
    east_m, north_m = on_ground(frame, what.drift_along_m, what.drift_across_m)
    return replace(record, east_m=record.east_m + east_m, north_m=record.north_m + north_m)


def on_ground(frame: LocalFrame, along_m: float, across_m: float) -> tuple[float, float]:
    """Return (east, north) of a way along the first pass and to the right of it."""
    line = anyang_passes(frame)[0]
    east_m, north_m = line.end_east_m - line.start_east_m, line.end_north_m - line.start_north_m
    length_m = math.hypot(east_m, north_m)
    east, north = east_m / length_m, north_m / length_m
    return along_m * east + across_m * north, along_m * north - across_m * east
