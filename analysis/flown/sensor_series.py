"""What a journal's sensors said, as series: of its inputs only these are decoded."""

from __future__ import annotations

import json
import math
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from analysis.flown.applied_flight import Floats, Series
from analysis.journals.content import read_entries
from companion.core.label import from_deg
from companion.receiver import offset_of

if TYPE_CHECKING:
    from analysis.journals.unpacking import Entry
    from companion.journal.codec import FieldNames
    from companion.journal.reader import OpenJournal
    from companion.receiver import ReceiverOffset

WIND_FROM, TOLD, FIXED = "wind from", "Telemetry", "GnssReport"
PARSED_AT_ONCE = 1000
# Which value of which sensor's message becomes a series, and which field tells a fault.
_SENSORS = {
    "FlowReport": ("volume_ml", "fault"),
    "PressureReport": ("pressure_kpa", None),
    "TankReport": ("level_l", None),
    "WindReport": ("speed_m_s", None),
    FIXED: ("fix", None),
}
# What else is read of a message: where a wind blows to; place and velocity, whose receiver's delay
# is found beside the estimator's.
_MORE = {
    "WindReport": ("east_m_s", "north_m_s"),
    FIXED: ("boot_s", "latitude_deg", "longitude_deg"),
    TOLD: (
        "boot_s", "latitude_deg", "longitude_deg", "velocity_north_m_s", "velocity_east_m_s"
    ),
}  # fmt: skip


def sensors_of(
    journal: OpenJournal, names: FieldNames, unread: list[str] | None
) -> tuple[dict[str, Series | None], ReceiverOffset | None]:
    """Return the series of each kind of sensor's message, and of where the wind comes from.

    None where there is no message; and what the receiver differs by.
    """
    parts: dict[str, list[Floats]] = {kind: [] for kind in (*_SENSORS, WIND_FROM)}
    heard: dict[str, list[Floats]] = {TOLD: [], FIXED: []}
    wanted = {kind: _wanted(kind, names) for kind in (*_SENSORS, TOLD) if kind in names}
    try:
        for kind, rows in _numbers(journal, wanted, unread):
            if kind in heard:
                heard[kind].append(rows[:, :-1])
            if kind == TOLD:
                continue
            told = rows[:, 1].copy()
            told[rows[:, -1] != 0.0] = np.nan
            parts[kind].append(np.column_stack((rows[:, 0], told)))
            if kind == "WindReport" and _more_in(kind, names):
                from_deg_s = [from_deg(*each) for each in rows[:, 2:4].tolist()]
                parts[WIND_FROM].append(
                    np.column_stack((rows[:, 0], np.array(from_deg_s, dtype=np.float64)))
                )
    except sqlite3.DatabaseError as error:
        if unread is None or "locked" in str(error):
            raise
        unread.append(f"what sensors said behind a damaged place: {' '.join(str(error).split())}")
    positions, fixes = (
        [row for rows in heard[kind] for row in rows.tolist()] if _more_in(FIXED, names) else []
        for kind in (TOLD, FIXED)
    )
    return {kind: _series(rows) for kind, rows in parts.items()}, offset_of(positions, fixes)


def _wanted(kind: str, names: FieldNames) -> Wanted:
    """Return the places of a sensor's time, value and fault, and of what else is read of it."""
    value, fault = _SENSORS.get(kind, (None, None))
    numbers = ["received_s", *filter(None, [value]), *_more_in(kind, names)]
    return Wanted(
        numbers=tuple(names[kind].index(name) for name in numbers),
        flag=names[kind].index(fault) if fault else -1,
    )


def _numbers(
    journal: OpenJournal, wanted: Mapping[str, Wanted], unread: list[str] | None
) -> Iterator[tuple[str, Floats]]:
    """Yield the numbers of the sensors' messages in pieces, each of one kind and in order."""
    entries = read_entries(journal.connection, journal.version, kinds=wanted.keys(), unread=unread)
    for several in _several(entries):
        yield from numbers_of([entry.body for entry in several], wanted).items()


def _more_in(kind: str, names: FieldNames) -> tuple[str, ...]:
    """Return what else is read of a message; nothing in journals from before it was kept."""
    wanted = _MORE.get(kind, ())
    return wanted if set(wanted) <= set(names.get(kind, ())) else ()


def _several(entries: Iterator[Entry]) -> Iterator[list[Entry]]:
    """Yield entries many at once: what was read before damage, too."""
    several: list[Entry] = []
    try:
        for entry in entries:
            several.append(entry)
            if len(several) == PARSED_AT_ONCE:
                yield several
                several = []
    except sqlite3.DatabaseError:
        yield several
        raise
    yield several


def _series(parts: list[Floats]) -> Series | None:
    rows = np.concatenate(parts) if parts else np.empty((0, 2))
    if not len(rows):
        return None
    order = np.argsort(rows[:, 0], kind="stable")
    return Series(time_s=rows[order, 0], value=rows[order, 1])


class Wanted(NamedTuple):
    """Which of a message's values: numbers by their places, and one that says yes or no, or -1."""

    numbers: tuple[int, ...]
    flag: int = -1


def numbers_of(lines: Sequence[str], wanted: Mapping[str, Wanted]) -> Mapping[str, Floats]:
    """Return the numbers from the lines themselves."""
    rows: dict[str, list[list[float]]] = {kind: [] for kind in wanted}
    # All at once is quicker.
    for message in json.loads(f"[{','.join(lines)}]"):
        ((kind, values),) = message.items()
        if kind in wanted:
            numbers, flag = wanted[kind]
            row = [_number(values[place]) for place in numbers]
            rows[kind].append([*row, float(flag >= 0 and bool(values[flag]))])
    return {
        kind: np.array(each, dtype=np.float64).reshape(len(each), len(wanted[kind].numbers) + 1)
        for kind, each in rows.items()
    }


def _number(value: Any) -> float:
    told = value["Fix"] if isinstance(value, dict) else value
    return math.nan if told is None else float(told)
