"""As-applied points as CSV: a row a sample, and what its columns mean in a file beside.

The file beside is metadata for tabular data on the web (W3C, `<name>-metadata.json`), which
programs look for under this name.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from analysis.exports.columns import Column, Unit, valve_columns

if TYPE_CHECKING:
    from analysis.exports.output import Content
    from analysis.exports.source import Source

Floats = NDArray[np.float64]

# Nine decimals are a tenth of a millimetre on the ground.
_DEGREES = Unit(suffix="deg", label="deg", code="arcdeg", decimals=9)
# Many rows at a time: calls cost more than memory.
_BLOCK = 10_000


def make(source: Source, out: Path) -> Content:
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
    for start in range(0, len(rows), _BLOCK):
        yield ("\n".join(rows[start : start + _BLOCK]) + "\n").encode()


def quoted(text: str) -> str:
    """Return a text as a field of a table.

    >>> quoted('a "b", c'), quoted("plain")
    ('"a ""b"", c"', 'plain')
    """
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
