"""What the pictures show of one flight: the rate on the ground, and the flow along one pass."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import shapely
from numpy.typing import NDArray

from analysis.settled import ordered_ml_s
from analysis.smoothing import boxed, rise_over
from companion.core.nozzle import flow_for_rate
from sitl.anyang import anyang_passes
from sitl.deposit import L_HA_PER_ML_M2

if TYPE_CHECKING:
    from analysis.flight_record import FlightRecord
    from companion.core.frame import LocalFrame
    from companion.core.setup import Setup

Floats = NDArray[np.float64]

# Of the first pass, this much before and behind the field; around it, this much of the ground.
RUN_M = 8.0
MARGIN_X_M = 6.0
MARGIN_Y_M = 1.5
CELL_M = 0.1
L_MIN_PER_ML_S = 0.06


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldAxes:
    """The plots laid on their side: x along the first pass from the edge, y to the left of it."""

    east_m: float
    north_m: float
    along_east: float
    along_north: float
    length_m: float
    width_m: float

    def place(self, east_m: Floats, north_m: Floats) -> tuple[Floats, Floats]:
        """Return x and y of points in the flight's frame."""
        east, north = east_m - self.east_m, north_m - self.north_m
        x_m = east * self.along_east + north * self.along_north
        return x_m, north * self.along_east - east * self.along_north

    @property
    def course_deg(self) -> float:
        """Return the course of the first pass."""
        return float(np.degrees(np.arctan2(self.along_east, self.along_north)))


def field_axes(setup: Setup) -> FieldAxes:
    """Return the axes whose origin is a corner of the plots: x and y begin at 0 there."""
    along_east, along_north = _along(setup.frame)
    corners = shapely.get_coordinates([zone.polygon for zone in setup.prescription.zones])
    raw = FieldAxes(
        east_m=0.0,
        north_m=0.0,
        along_east=along_east,
        along_north=along_north,
        length_m=0.0,
        width_m=0.0,
    )
    x_m, y_m = raw.place(corners[:, 0], corners[:, 1])
    x_0, y_0 = float(x_m.min()), float(y_m.min())
    return FieldAxes(
        east_m=x_0 * along_east - y_0 * along_north,
        north_m=x_0 * along_north + y_0 * along_east,
        along_east=along_east,
        along_north=along_north,
        length_m=float(x_m.max()) - x_0,
        width_m=float(y_m.max()) - y_0,
    )


def _along(frame: LocalFrame) -> tuple[float, float]:
    line = anyang_passes(frame)[0]
    east, north = line.end_east_m - line.start_east_m, line.end_north_m - line.start_north_m
    length = float(np.hypot(east, north))
    return east / length, north / length


@dataclass(frozen=True, slots=True, kw_only=True)
class Traces:
    """Flows [L/min] of the whole boom along the first pass, and the rate on a raster [L/ha].

    `applied` is the mean over one PWM period. The raster's cells are `CELL_M` wide, its corner
    lies `MARGIN_X_M` and `MARGIN_Y_M` outside the plots'; rows along y, columns along x.
    """

    along_m: Floats
    prescribed_l_min: Floats
    ordered_l_min: Floats
    applied_l_min: Floats
    applied_l_ha: Floats


def traces_of(record: FlightRecord, setup: Setup) -> Traces:
    """Return what the pictures need of a flight."""
    axes = field_axes(setup)
    along_m, _ = axes.place(record.east_m, record.north_m)
    inside = (along_m > -RUN_M) & (along_m < axes.length_m + RUN_M)
    first = int(np.argmax(inside))
    chosen = slice(first, first + int(np.argmin(inside[first:])))
    period = record.pwm_period_s / record.step_s
    total_ml = record.volume_ml.sum(axis=1)
    path_m = np.concatenate(
        ([0.0], np.cumsum(np.hypot(np.diff(record.east_m), np.diff(record.north_m))))
    )
    speed_m_s = (rise_over(path_m, period) / record.pwm_period_s)[chosen]
    applied = (rise_over(total_ml, period) / record.pwm_period_s)[chosen]
    rates = record.prescription.rates_at(record.east_m[chosen], record.north_m[chosen])
    return Traces(
        along_m=along_m[chosen],
        prescribed_l_min=np.nan_to_num(rates)
        * flow_for_rate(1.0, 1.0, setup.boom.width_m)
        * speed_m_s,
        ordered_l_min=_ordered_l_min(record, record.time_s[chosen]),
        applied_l_min=L_MIN_PER_ML_S * applied,
        applied_l_ha=_raster(record, axes),
    )


def _ordered_l_min(record: FlightRecord, time_s: Floats) -> Floats:
    """Return the flow that the orders stand for, by the measured curve of the set in use."""
    at_s, total_ml_s = ordered_ml_s(record.orders, record.nozzle_sets)
    found: Floats = L_MIN_PER_ML_S * total_ml_s[np.searchsorted(at_s, time_s, side="right")]
    return found


def _raster(record: FlightRecord, axes: FieldAxes) -> Floats:
    """Return the rate on the ground, the volume of each valve spread over one PWM period.

    Exact along the track, pass by pass: a raster that single drops fall into would show the beat
    of its cells with the samples.
    """
    x_m, y_m = axes.place(record.east_m, record.north_m)
    period = record.pwm_period_s / record.step_s
    volume_ml = np.column_stack([boxed(column, period) for column in record.volume_ml.T])
    columns = round((axes.length_m + 2.0 * MARGIN_X_M) / CELL_M)
    rows = round((axes.width_m + 2.0 * MARGIN_Y_M) / CELL_M)
    edges_m = CELL_M * np.arange(columns + 1) - MARGIN_X_M
    middles_m = 0.5 * (edges_m[1:] + edges_m[:-1])
    row_m = (CELL_M * (np.arange(rows) + 0.5) - MARGIN_Y_M)[:, None]
    raster = np.zeros((rows, columns))
    for one in _passes(x_m, edges_m[0] - CELL_M, edges_m[-1] + CELL_M):
        back = x_m[one][-1] < x_m[one][0]
        order = slice(None, None, -1 if back else 1)
        along_m, side_m = x_m[one][order], y_m[one][order]
        for valve, total_ml in zip(record.boom.valves, volume_ml[one][order].T, strict=True):
            dropped_ml = np.abs(np.diff(np.interp(edges_m, along_m, total_ml)))
            right_m = -valve.right_m if back else valve.right_m
            off_m = row_m - (np.interp(middles_m, along_m, side_m) - right_m)
            rate = dropped_ml * (L_HA_PER_ML_M2 / (CELL_M * valve.width_m))
            raster += np.where(np.abs(off_m) <= 0.5 * valve.width_m, rate, 0.0)
    return raster


def _passes(x_m: Floats, first_m: float, last_m: float) -> list[slice]:
    """Return the pieces of the path that lie between two x: the passes."""
    inside = ((x_m > first_m) & (x_m < last_m)).astype(np.int8)
    turns = np.flatnonzero(np.diff(np.concatenate(([0], inside, [0]))))
    pieces = zip(turns[::2].tolist(), turns[1::2].tolist(), strict=True)
    whole_m = 0.9 * (last_m - first_m)
    return [slice(a, b) for a, b in pieces if abs(x_m[b - 1] - x_m[a]) > whole_m]
