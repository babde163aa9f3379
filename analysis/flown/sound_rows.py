"""Which rows of a journal's tables can be believed, row by row: the rest is left out and counted.

A damaged file may hold anything in any column; what is used must be a number where one is due.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from typing import Any

from analysis.flown.table_rows import Row
from companion.errors import UnreadableError

# A point as the journal writes it: 8 bytes of the GeoPackage, then WKB, little-endian.
POINT_BYTES = 29
PERMILLE_MAX = 1000
# The year 2200: what lies behind it, or before 1970, no calendar of an export can write.
OFFSET_S_MAX = 7.26e9


def sound_rows(
    rows: list[Row], is_sound: Callable[[Row], bool], unread: list[str] | None, what: str
) -> list[Row]:
    """Return the rows to be believed; ValueError without `unread` where some are not."""
    found = [row for row in rows if is_sound(row)]
    bad = len(rows) - len(found)
    if bad:
        text = f"{bad} {what}: what is in them is no such thing"
        if unread is None:
            raise ValueError(text)
        unread.append(text)
    return found


def is_change(row: Row, valves: int) -> bool:
    """Whether a row (id, planned_us, actual_us, valve, duty_permille) is a change of a valve."""
    _, planned, actual, valve, duty = row
    return (
        type(valve) is int
        and 0 <= valve < valves
        and type(duty) is int
        and 0 <= duty <= PERMILLE_MAX
        and (planned is None or type(planned) is int)
        and (actual is None or type(actual) is int)
        and not (planned is None and actual is None)
    )


def is_sample(row: Row) -> bool:
    """Whether a row (sequence, geom, time_s, six numbers, inhibits, rates) is a sample."""
    _, geom, time_s, *numbers, inhibits, _ = row
    return (
        (geom is None or (isinstance(geom, bytes) and len(geom) == POINT_BYTES))
        and isinstance(time_s, float)
        and math.isfinite(time_s)
        and all(each is None or isinstance(each, (int, float)) for each in numbers)
        and (inhibits is None or isinstance(inhibits, str))
    )


def is_event(row: Row) -> bool:
    """Whether a row (sequence, time_s, kind, text) is an event."""
    _, at_s, kind, text = row
    return (
        (at_s is None or isinstance(at_s, (int, float)))
        and isinstance(kind, str)
        and isinstance(text, str)
    )


def rates_of(text: object, valves: int) -> list[float] | None:
    """Return the rate of every valve, NaN where none is prescribed; None where it is no list.

    >>> rates_of("[20.5]", 2), rates_of('["x"]', 2)
    ([20.5, 20.5], None)
    """
    if text is not None and not isinstance(text, str):
        return None
    try:
        found: Any = json.loads(text) if text else [None]
    except (ValueError, RecursionError):
        return None
    if not isinstance(found, list) or len(found) not in (1, valves):
        return None
    if not all(each is None or type(each) in (int, float) for each in found):
        return None
    values = [math.nan if each is None else float(each) for each in found]
    return values if len(values) == valves else values * valves


def clock_offset_s(
    given: object, started: Sequence[str], path: object, unread: list[str] | None
) -> float:
    """Return seconds from the companion's clock to UTC: the given one, or that of the start.

    `started` is the same by the computer's clock; UnreadableError where neither is a time.
    """
    if _is_offset(given):
        return float(str(given))
    sound = [each for each in started if _is_offset(each)]
    if sound and unread is not None:
        unread.append("the time in UTC is none: that of the start of the record stands")
        return float(sound[0])
    raise UnreadableError(f"{path}: is damaged: the time in UTC ({str(given)[:20]}) is none")


def _is_offset(value: object) -> bool:
    try:
        return 0.0 <= float(str(value)) <= OFFSET_S_MAX
    except ValueError:
        return False
