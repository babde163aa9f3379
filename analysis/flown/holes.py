"""Where rows of a flight are missing, and what counts there: closed valves, and a mark.

What nobody can read must not become spray: without a hole's rows the last duty would stand until
the end of the flight. So valves count as closed from the last row before a hole; behind one in the
changes each of them until its first change, behind one in the samples as the changes say.

Of which times nobody can tell what a valve did: where rows of its flight are missing. There a valve
counts as closed, so that what nobody can read becomes no spray. But it must not become
a change that was missed or came metres late either.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from analysis.flight_record import Spans, joined
from analysis.flown.applied_flight import Floats, Ints, ValveChanges
from analysis.flown.modelled_flow import ordered_s

UNREAD = "unread"
# `applied` has ten rows a second; a journal has at least ten entries a second, mostly fifty. Fewer
# mean that the computer stood still, and not that rows are gone.
ROWS_GAP_S = 0.5
ENTRIES_PER_S = 10.0
# What the changes and the samples say may differ for so long: a plan's changes lie ahead of it.
DIFFERENT_S = 1.0
# Duties are whole thousandths in the file: flows of the samples differ by less than this.
FLOW_SHARE = 0.02
# A file with more holes is not mended: the flight ends at the first.
HOLES_MAX = 100
_INF = float("inf")


class Hole(NamedTuple):
    """A time of which rows are missing, seconds of the companion's clock; may be without end."""

    from_s: float
    until_s: float
    rows: int

    def text(self, what: str) -> str:
        """Return it for a person."""
        begin = "the start" if self.from_s == -_INF else f"{self.from_s:.1f} s"
        end = "the end" if self.until_s == _INF else f"{self.until_s:.1f} s"
        return f"{what} are missing from {begin} to {end}: no spray is counted there"


def change_holes(number: Ints, at_s: Floats, count: int, *, reaches_end: bool) -> list[Hole]:
    """Return the holes in changes of the numbers 1, 2, ...; `count` is how many there must be."""
    if not len(number):
        return [Hole(-_INF, _INF, count)] if count or not reaches_end else []
    missing = np.diff(number, prepend=0) - 1
    holes = [
        Hole(float(at_s[i - 1]) if i else -_INF, float(at_s[i]), int(missing[i]))
        for i in np.flatnonzero(missing > 0).tolist()
    ]
    behind = max(count - int(number[-1]), 0)
    if behind or not reaches_end:
        holes.append(Hole(float(at_s[-1]), _INF, behind))
    return _few(holes)


def sample_holes(
    sequence: Ints, time_s: Floats, ends: Sequence[tuple[float, float]] = ()
) -> list[Hole]:
    """Return the holes in rows of `applied`; `ends` are first and last (number, time) of all."""
    if not len(sequence):
        return []
    numbers = np.concatenate((sequence, [each[0] for each in ends])).astype(np.float64)
    times_s = np.concatenate((time_s, [each[1] for each in ends]))
    order = np.argsort(numbers, kind="stable")
    numbers, times_s = numbers[order], times_s[order]
    lasted_s, entries = np.diff(times_s), np.diff(numbers)
    gone = np.flatnonzero((lasted_s > ROWS_GAP_S) & (entries >= ENTRIES_PER_S * lasted_s))
    holes = [Hole(float(times_s[i]), float(times_s[i + 1]), 0) for i in gone.tolist()]
    first_s, last_s = float(time_s[0]), float(time_s[-1])
    return _few(
        [
            Hole(
                -_INF if hole.until_s <= first_s else hole.from_s,
                _INF if hole.from_s >= last_s else hole.until_s,
                0,
            )
            for hole in holes
        ]
    )


def doubtful_holes(changes: ValveChanges, time_s: Floats, flow_l_min: Floats) -> list[Hole]:
    """Return where valves stay open by the changes and the samples say that none flows.

    And from the last change on, where valves stay open and the flow of the samples still varies.
    """
    at_s = ordered_s(changes)
    if not len(at_s):
        flowing = time_s[flow_l_min > 0.0]
        return [Hole(-_INF, _INF, 0)] if len(flowing) and np.ptp(flowing) > DIFFERENT_S else []
    open_count = np.concatenate(([0], _open_counts(changes)))
    index = np.searchsorted(at_s, time_s, "right")
    doubt = (open_count[index] > 0) & ~(flow_l_min > 0.0)
    edges = np.flatnonzero(np.diff(doubt, prepend=False, append=False))
    holes = [
        Hole(float(at_s[index[begin] - 1]), _next_s(at_s, float(time_s[end - 1])), 0)
        for begin, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
        if time_s[end - 1] - time_s[begin] > DIFFERENT_S
    ]
    later = flow_l_min[time_s > at_s[-1] + DIFFERENT_S]
    if open_count[-1] and len(later) and not _is_same(later):
        holes.append(Hole(float(at_s[-1]), _INF, 0))
    return _few(holes)


def closed_over(
    changes: ValveChanges, samples: Sequence[Hole], missing: Sequence[Hole]
) -> ValveChanges:
    """Return changes with closed valves over holes in the samples, and in the changes."""
    for hole in samples:
        changes = _closed(changes, hole, is_known_after=True)
    for hole in missing:
        changes = _closed(changes, hole, is_known_after=False)
    return changes


def marked(inhibits: tuple[str, ...], its: NDArray[np.bool_]) -> tuple[str, ...]:
    """Return the reasons not to spray with one more where rows are missing."""
    return tuple(
        " ".join(sorted({*reasons.split(), UNREAD})) if is_in else reasons
        for reasons, is_in in zip(inhibits, its.tolist(), strict=True)
    )


def within(time_s: Floats, holes: Sequence[Hole]) -> NDArray[np.bool_]:
    """Return which times lie in a hole, or at its beginning."""
    its = np.zeros(len(time_s), dtype=np.bool_)
    for hole in holes:
        its |= (time_s >= hole.from_s) & (time_s < hole.until_s)
    return its


def _closed(changes: ValveChanges, hole: Hole, *, is_known_after: bool) -> ValveChanges:
    at_s = ordered_s(changes)
    before = at_s <= hole.from_s
    after = (at_s >= hole.until_s) & ~before
    added: list[tuple[float, int, float]] = []
    if before.any():
        added += [
            (hole.from_s, valve, 0.0) for valve, duty in _duties(changes, before).items() if duty
        ]
    if is_known_after and hole.until_s < _INF:
        found = _duties(changes, at_s < hole.until_s)
        added += [(hole.until_s, valve, duty) for valve, duty in found.items() if duty]
    table = np.array(added, dtype=np.float64).reshape(-1, 3)
    return ValveChanges(
        planned_s=np.concatenate(
            (changes.planned_s[before], table[:, 0], changes.planned_s[after])
        ),
        actual_s=np.concatenate(
            (changes.actual_s[before], np.full(len(table), np.nan), changes.actual_s[after])
        ),
        valve=np.concatenate(
            (changes.valve[before], table[:, 1].astype(np.int64), changes.valve[after])
        ),
        duty=np.concatenate((changes.duty[before], table[:, 2], changes.duty[after])),
    )


def _duties(changes: ValveChanges, its: NDArray[np.bool_]) -> dict[int, float]:
    """Return the last duty of each valve."""
    return dict(zip(changes.valve[its].tolist(), changes.duty[its].tolist(), strict=True))


def _open_counts(changes: ValveChanges) -> Ints:
    """Return how many valves are open after each change."""
    opens = np.zeros(len(changes.duty), dtype=np.int64)
    for valve in np.unique(changes.valve).tolist():
        its = np.flatnonzero(changes.valve == valve)
        opens[its] = np.diff((changes.duty[its] > 0.0).astype(np.int64), prepend=0)
    counts: Ints = np.cumsum(opens)
    return counts


def _next_s(at_s: Floats, after_s: float) -> float:
    index = int(np.searchsorted(at_s, after_s, "right"))
    return float(at_s[index]) if index < len(at_s) else _INF


def _is_same(flow_l_min: Floats) -> bool:
    known = flow_l_min[np.isfinite(flow_l_min)]
    return not len(known) or bool(np.ptp(known) <= FLOW_SHARE * float(known.max()))


def _few(holes: list[Hole]) -> list[Hole]:
    if len(holes) <= HOLES_MAX:
        return holes
    return [Hole(holes[0].from_s, _INF, sum(hole.rows for hole in holes))]


# Longer than this between two samples nobody knows what the sprayer did.
GAP_S = 1.0


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
    at_s = ordered_s(changes)
    found = []
    for valve in range(valves):
        own_s = np.sort(at_s[changes.valve == valve])
        spans = [(hole.from_s, hole.until_s) for hole in samples]
        spans += [(hole.from_s, _first_from_s(own_s, hole.until_s)) for hole in missing]
        found.append(joined(spans))
    return tuple(found)


def with_gaps(unknown: Sequence[Spans], time_s: Floats, *, valves: int) -> tuple[Spans, ...]:
    """Return the times of each valve with those over which no sample was taken."""
    gaps = np.flatnonzero(np.diff(time_s) > GAP_S).tolist()
    if not gaps:
        return tuple(unknown)
    spans = [(float(time_s[i]), float(time_s[i + 1])) for i in gaps]
    return tuple(joined([*own, *spans]) for own in unknown or ((),) * valves)


def _first_from_s(at_s: Floats, from_s: float) -> float:
    index = int(np.searchsorted(at_s, from_s))
    return float(at_s[index]) if index < len(at_s) else _INF
