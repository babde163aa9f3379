"""As-applied points, and path and modelled flow every 10 ms, as CSV with metadata beside.

Points are a row a sample. The file beside them is metadata for tabular data on the web (W3C,
`<name>-metadata.json`), which programs look for under this name.

From path and flow anybody can recompute every figure. A row has the place of the autopilot's
position reference in the flight's own frame (metres east and north of its origin) and, for each
valve, what is prescribed under its strip's centre (0 where nothing is), whether the whole strip
lies in the field, and its mean flow since the row before. The file beside has the frame's origin
and the strips' places on the aircraft.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from analysis.exports.columns import Column, Unit, plain_names, valve_columns
from analysis.strips import strips_of
from companion.csv_table import cell

if TYPE_CHECKING:
    from analysis.exports.output import Content
    from analysis.exports.source import Source

Floats = NDArray[np.float64]

# Nine decimals are a tenth of a millimetre on the ground.
_DEGREES = Unit(suffix="deg", label="deg", code="arcdeg", decimals=9)
# Many rows at a time: calls cost more than memory.
_POINTS_BLOCK = 10_000


def make_points(source: Source, out: Path) -> Content:
    """Return the table and what is to say about it."""
    samples = source.samples
    columns = list(source.columns)
    columns[1:1] = [
        _degrees("latitude_deg", samples.latitude_deg),
        _degrees("longitude_deg", samples.longitude_deg),
    ]
    columns += valve_columns(samples, source.valve_names, source.units)
    about = described(out.name, columns, source.facts())
    return {f"{out.name}-metadata.json": about, out.name: csv_of(columns)}


def csv_of(columns: Sequence[Column]) -> Iterator[bytes]:
    """Yield a table by RFC 4180, but for its line ends, which are those of every other tool."""
    yield (",".join(quoted(each.name) for each in columns) + "\n").encode()
    texts = [
        each.texts() if each.unit is not None else [quoted(text) for text in each.texts()]
        for each in columns
    ]
    rows = [",".join(row) for row in zip(*texts, strict=True)]
    for start in range(0, len(rows), _POINTS_BLOCK):
        yield ("\n".join(rows[start : start + _POINTS_BLOCK]) + "\n").encode()


def quoted(text: str) -> str:
    """Return a text as a field of a table.

    >>> quoted('a "b", c'), quoted("plain"), quoted("=1+1")
    ('"a ""b"", c"', 'plain', "'=1+1")
    """
    text = str(cell(text))
    if any(sign in text for sign in ',"\r\n'):
        return '"' + text.replace('"', '""') + '"'
    return text


def described(name: str, columns: Iterable[Column], facts: dict[str, object]) -> Iterable[bytes]:
    """Return the metadata of a table."""
    document = {
        "@context": "http://www.w3.org/ns/csvw",
        "url": name,
        "notes": [facts],
        "tableSchema": {
            "columns": [
                {
                    "name": each.name,
                    "titles": each.name,
                    "datatype": "string" if each.unit is None else "number",
                    "dc:description": each.description,
                    "schema:unitText": "" if each.unit is None else each.unit.label,
                }
                for each in columns
            ]
        },
    }
    return [json.dumps(document, indent=2, allow_nan=False).encode() + b"\n"]


def _degrees(name: str, values: Floats) -> Column:
    return Column(name=name, short="", description="WGS84", unit=_DEGREES, values=values)


_SAMPLES_BLOCK = 5_000


def make_samples(source: Source, out: Path) -> Content:
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
    for start in range(0, len(rows), _SAMPLES_BLOCK):
        yield "".join(
            form % tuple(row) for row in rows[start : start + _SAMPLES_BLOCK].tolist()
        ).encode()
