"""Edges that come late are issued, never skipped: what a late machine does to the pulses.

A pulse that opens late keeps its length but for a twentieth, by which the following pulses come
back to their places; a minimum time that a delay has eaten is waited for. Closing for good
(duty 0) waits for nothing. Pure: who owns the clock asks for what is due.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable

from companion.output.pulse_train import Edge

# What the usual wake-up is late by shifts nothing: the next edge is on its time again.
LATE_S = 0.0003
# Of its length a late pulse keeps this much, or the delay would never be made up for.
KEPT = 0.95


class _Line:
    __slots__ = ("is_open", "late_s", "moved_s", "planned_s", "queue")

    def __init__(self, *, is_open: bool) -> None:
        self.is_open = is_open
        self.queue: deque[Edge] = deque()
        self.moved_s = self.planned_s = -math.inf
        self.late_s = 0.0


class LateEdges:
    """Holds each output's edges until their time, in their order."""

    def __init__(self, outputs: int, valves: int, *, min_on_s: float, min_off_s: float) -> None:
        self._lines = tuple(_Line(is_open=number >= valves) for number in range(outputs))
        self._valves = valves
        self._min_on_s, self._min_off_s = min_on_s, min_off_s
        self._waiting: set[int] = set()
        self.held_count = 0

    def add(self, edges: Iterable[Edge]) -> None:
        """Take edges in the order of their times."""
        for edge in edges:
            queue = self._lines[edge.valve].queue
            # Towards the safe state there is no pulse to keep: what it was to do before is void.
            is_return = edge.valve >= self._valves
            if edge.is_open if is_return else not edge.is_open and edge.duty == 0.0:
                queue.clear()
            queue.append(edge)
            self._waiting.add(edge.valve)

    @property
    def next_s(self) -> float:
        """Return when the next edge that was held up may be issued."""
        if not self._waiting:
            return math.inf
        lines = self._lines
        return min(self._due_s(lines[n], lines[n].queue[0]) for n in self._waiting)

    def pass_on(self, edges: list[Edge], now_s: float) -> list[Edge]:
        """Return what is to be written now, of `edges` and of what was held up before."""
        if not self._waiting and self._all_at_once(edges, now_s):
            return edges
        self.add(edges)
        return self.due(now_s)

    def due(self, now_s: float) -> list[Edge]:
        """Return what is to be written now; an output moves at most once."""
        out = []
        for number in sorted(self._waiting):
            line = self._lines[number]
            moved = False
            while line.queue and self._due_s(line, line.queue[0]) <= now_s:
                edge = line.queue[0]
                if edge.is_open != line.is_open:
                    if moved:
                        break
                    moved = True
                    self._move(line, edge, now_s)
                line.queue.popleft()
                out.append(edge)
            if not line.queue:
                self._waiting.discard(number)
            else:
                self.held_count += 1
        return out

    def _all_at_once(self, edges: list[Edge], now_s: float) -> bool:
        """Take edges of one output each if nothing holds any of them up: the usual case."""
        lines = self._lines
        if len(edges) > 1 and len({edge.valve for edge in edges}) < len(edges):
            return False
        for edge in edges:
            if self._due_s(lines[edge.valve], edge) > now_s:
                return False
        for edge in edges:
            line = lines[edge.valve]
            if edge.is_open != line.is_open:
                self._move(line, edge, now_s)
        return True

    def clear(self, now_s: float) -> None:
        """Forget everything: all valves were closed, the return valve opened, by other means."""
        for number, line in enumerate(self._lines):
            line.queue.clear()
            line.is_open = number >= self._valves
            line.moved_s, line.late_s = now_s, 0.0
        self._waiting.clear()

    def _move(self, line: _Line, edge: Edge, now_s: float) -> None:
        line.is_open = edge.is_open
        line.moved_s, line.planned_s = now_s, edge.at_s
        late_s = now_s - edge.at_s
        line.late_s = late_s if late_s > LATE_S else 0.0

    def _due_s(self, line: _Line, edge: Edge) -> float:
        at_s, valve, is_open, duty = edge
        if valve >= self._valves or is_open == line.is_open or (not is_open and duty == 0.0):
            return at_s
        if is_open:
            # A hair less than the minimum: sums of times are not exact.
            return max(at_s, line.moved_s + self._min_off_s - 1e-9)
        length_s = KEPT * (at_s - line.planned_s) if line.late_s else 0.0
        return max(at_s, line.moved_s + max(length_s, self._min_on_s - 1e-9))
