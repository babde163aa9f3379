"""Of which times nobody can tell what a valve did: where rows of its flight are missing.

There a valve counts as closed (`holes.py`), so that what nobody can read becomes no spray. But it
must not become a change that was missed or came metres late either.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from analysis.flight_record import Spans, joined
from analysis.flown.applied_flight import Floats, ValveChanges
from analysis.flown.holes import Hole

# Longer than this between two samples nobody knows what the sprayer did.
GAP_S = 1.0
_INF = float("inf")


def unknown_times(
    changes: ValveChanges,
    samples: Sequence[Hole],
    missing: Sequence[Hole],
    *,
    valves: int,
) -> tuple[Spans, ...]:
    """Return the times of each valve; none at all where no rows are missing.

    Of a hole in the samples the changes tell how it ended. Behind one in the changes (`missing`)
    nothing is known of a valve until its next change.
    """
    if not samples and not missing:
        return ()
    at_s = np.where(np.isfinite(changes.actual_s), changes.actual_s, changes.planned_s)
    found = []
    for valve in range(valves):
        own_s = np.sort(at_s[changes.valve == valve])
        spans = [(hole.from_s, hole.until_s) for hole in samples]
        spans += [(hole.from_s, _next_s(own_s, hole.until_s)) for hole in missing]
        found.append(joined(spans))
    return tuple(found)


def with_gaps(unknown: Sequence[Spans], time_s: Floats, *, valves: int) -> tuple[Spans, ...]:
    """Return the times of each valve with those over which no sample was taken."""
    gaps = np.flatnonzero(np.diff(time_s) > GAP_S).tolist()
    if not gaps:
        return tuple(unknown)
    spans = [(float(time_s[i]), float(time_s[i + 1])) for i in gaps]
    return tuple(joined([*own, *spans]) for own in unknown or ((),) * valves)


def _next_s(at_s: Floats, from_s: float) -> float:
    index = int(np.searchsorted(at_s, from_s))
    return float(at_s[index]) if index < len(at_s) else _INF
