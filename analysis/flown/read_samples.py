"""The table `applied` of a journal in columns, and where rows of it are missing."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from analysis.flown.applied_flight import Floats, Ints
from analysis.flown.holes import Hole, sample_holes
from analysis.flown.sound_rows import POINT_BYTES, is_sample, rates_of, sound_rows
from analysis.flown.table_rows import rows_of
from companion.record.reader import OpenJournal

_APPLIED = """geom, time_s, target_flow_l_min, flow_l_min, speed_m_s, course_deg, heading_deg,
           height_m, inhibits, valve_rates_l_ha"""
# A point as the journal writes it: 8 bytes of the GeoPackage, then WKB, little-endian.
_POINT = np.dtype(
    [("head", f"V{POINT_BYTES - 21}"), ("order", "u1"), ("kind", "<u4"), ("lon", "<f8"),
     ("lat", "<f8")]
)  # fmt: skip


class Samples(NamedTuple):
    """The rows of the table `applied`, in columns; `holes` are where rows are missing."""

    place: NDArray[np.void]
    columns: Floats
    inhibits: tuple[str, ...]
    rate_l_ha: Floats
    holes: list[Hole]
    missing: int


def read_samples(journal: OpenJournal, valves: int, unread: list[str] | None) -> Samples:
    """Return all samples with a position, in the order of their times."""
    found = rows_of(
        journal.connection, "applied", _APPLIED, key="sequence", unread=unread, what="samples"
    )
    rates: dict[object, list[float] | None] = {}
    for row in found.rows:
        # Rows of one rate for all valves are one text, and there are few rates.
        if row[-1] not in rates:
            rates[row[-1]] = rates_of(row[-1], valves)
    rows = sound_rows(
        found.rows, lambda row: is_sample(row) and rates[row[-1]] is not None, unread, "samples"
    )
    sequence: Ints = np.array([row[0] for row in rows], dtype=np.int64)
    holes = sample_holes(
        sequence, np.array([row[2] for row in rows], dtype=np.float64), _ends(journal)
    )
    count = int(journal.meta.get("rows_applied") or 0)
    placed = [row for row in rows if row[1] is not None]
    place = np.frombuffer(b"".join(row[1] for row in placed), dtype=_POINT)
    columns = np.array([row[2:9] for row in placed], dtype=np.float64).reshape(-1, 7).T
    sound = np.isfinite(place["lat"]) & np.isfinite(place["lon"])
    order = np.flatnonzero(sound)[np.argsort(columns[0, sound], kind="stable")]
    return Samples(
        place=place[order],
        columns=np.ascontiguousarray(columns[:, order]),
        inhibits=tuple(" ".join(sorted((placed[i][9] or "").split())) for i in order.tolist()),
        rate_l_ha=np.array(
            [rates[placed[i][-1]] for i in order.tolist()], dtype=np.float64
        ).reshape(-1, valves),
        holes=holes,
        missing=max(count - len(rows), 0),
    )


def _ends(journal: OpenJournal) -> Sequence[tuple[float, float]]:
    """Return number and time of the first and the last of all entries; nothing where unknown."""
    if journal.version == "1":
        return ()
    found = []
    for sql in (
        "SELECT first_sequence, from_s FROM blocks ORDER BY first_sequence LIMIT 1",
        "SELECT last_sequence, until_s FROM blocks ORDER BY first_sequence DESC LIMIT 1",
    ):
        try:
            row = journal.connection.execute(sql).fetchone()
        except sqlite3.DatabaseError:
            continue
        if row is not None and isinstance(row[0], int) and isinstance(row[1], float):
            found.append((float(row[0]), row[1]))
    return found
