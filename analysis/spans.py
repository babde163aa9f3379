"""Spans of time: (from, until) in seconds."""

from __future__ import annotations

from collections.abc import Iterable

Spans = tuple[tuple[float, float], ...]


def joined(spans: Iterable[tuple[float, float]]) -> Spans:
    """Return the spans in order and apart.

    >>> joined([(5.0, 6.0), (1.0, 2.0), (2.0, 3.0)])
    ((1.0, 3.0), (5.0, 6.0))
    """
    found: list[tuple[float, float]] = []
    for begin_s, end_s in sorted(spans):
        if found and begin_s <= found[-1][1]:
            found[-1] = (found[-1][0], max(found[-1][1], end_s))
        else:
            found.append((begin_s, end_s))
    return tuple(found)
