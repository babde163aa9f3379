"""Path and modelled flow every 10 ms as CSV, so that anybody can recompute every figure.

A row has the place of the autopilot's position reference in the flight's own frame (metres east
and north of its origin) and, for each valve, what is prescribed under its strip's centre (0 where
nothing is), whether the whole strip lies in the field, and its mean flow since the row before. The
file beside has the frame's origin and the strips' places on the aircraft.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from analysis.exports.columns import Column, Unit, plain_names
from analysis.exports.csv_points import described
from analysis.strips import strips_of

if TYPE_CHECKING:
    from analysis.exports.output import Content
    from analysis.exports.source import Source

Floats = NDArray[np.float64]

_BLOCK = 5_000


def make(source: Source, out: Path) -> Content:
    """Return the table and what is to say about it."""
    columns = _columns(source)
    frame, boom = source.flight.setup.frame, source.flight.setup.boom
    facts = source.facts() | {
        "step_s": source.record.step_s,
        "pwm_period_s": source.record.pwm_period_s,
        "utc_offset_s": source.flight.utc_offset_s,
        "origin_latitude_deg": frame.latitude_deg,
        "origin_longitude_deg": frame.longitude_deg,
        "units": {each.name: each.unit.label for each in columns if each.unit is not None},
        "valves": [
            {
                "name": valve.name,
                "column": name,
                "right_m": valve.right_m,
                "forward_m": valve.forward_m,
                "width_m": valve.width_m,
            }
            for valve, name in zip(boom.valves, plain_names(source.valve_names), strict=True)
        ],
    }
    about = described(out.name, columns, facts)
    return {f"{out.name}-metadata.json": about, out.name: _table(columns)}


def _columns(source: Source) -> list[Column]:
    record = source.record
    columns = [
        _column("time_s", "monotonic clock of the companion", "s", 4, record.time_s),
        _column("east_m", "of the position reference", "m", 4, record.east_m),
        _column("north_m", "of the position reference", "m", 4, record.north_m),
        _column("heading_deg", "of the nose, from north", "deg", 3, record.heading_deg),
    ]
    l_min = 0.06 / record.step_s
    for strip, name in zip(strips_of(record), plain_names(source.valve_names), strict=True):
        flow = np.concatenate(([0.0], np.diff(strip.track.volume_ml) * l_min))
        inside = strip.inside_at(record.time_s).astype(np.float64)
        rate = strip.rates_at(record.time_s)
        columns += [
            _column(f"rate_l_ha_{name}", "prescribed under its centre", "L/ha", 4, rate),
            _column(f"inside_{name}", "whether the strip lies in the field", "0 or 1", 0, inside),
            _column(f"flow_l_min_{name}", "mean since the row before", "L/min", 6, flow),
        ]
    return columns


def _column(name: str, description: str, label: str, decimals: int, values: Floats) -> Column:
    unit = Unit(suffix="", label=label, code="", decimals=decimals)
    return Column(name=name, short="", description=description, unit=unit, values=values)


def _table(columns: list[Column]) -> Iterator[bytes]:
    yield (",".join(each.name for each in columns) + "\n").encode()
    form = ",".join(f"%.{each.unit.decimals}f" for each in columns if each.unit is not None) + "\n"
    rows = np.stack([np.asarray(each.values) for each in columns], axis=1)
    for start in range(0, len(rows), _BLOCK):
        yield "".join(form % tuple(row) for row in rows[start : start + _BLOCK].tolist()).encode()
