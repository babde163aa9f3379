"""The ground of a job's flights, each place counted in one of them: a season's sums are true.

Sorties of one plan overlap where their blocks meet, and one treats what another missed. All of them
mark the same points of the field (`analysis.assess.ground`).
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.fleet.row import Row


def counted_once(rows: Sequence[Row]) -> Iterator[Row]:
    """Yield the evaluated flights of a job with what each adds to those before it."""
    known = [row for row in rows if row.get("ground")]
    known.sort(key=lambda row: (str(row["started_utc"]), row["flight_id"]))
    marks = [
        np.frombuffer(zlib.decompress(row["ground"]), np.uint8).reshape(3, -1) for row in known
    ]
    if len({each.size for each in marks}) != 1:
        return  # none, or of several fields
    each_m2: float = 1e4 * known[0]["field_ha"] / (8 * marks[0].shape[1])

    def area_m2(points: NDArray[np.uint8]) -> float:
        return each_m2 * float(np.unpackbits(points).sum())

    wet, twice, due = np.zeros_like(marks[0])
    every = np.bitwise_or.reduce([its[0] for its in marks])
    for row, (its_wet, its_twice, its_due) in zip(known, marks, strict=True):
        again = its_wet & wet
        gained_m2 = area_m2(again & ~its_twice & ~twice) - area_m2(its_twice & twice)
        yield {
            **row,
            "area_ha": row["own_area_ha"] - area_m2(again) / 1e4,
            "missed_m2": area_m2(its_due & ~due & ~every),
            "doubled_m2": row["own_doubled_m2"] + gained_m2,
        }
        wet, twice, due = wet | its_wet, twice | its_twice | again, due | its_due
