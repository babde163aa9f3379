"""A pulse flow meter as a sensor: edges from a line, counts to the core.

Where the edges come from is behind `EdgeSource`: the kernel's GPIO (`gpiod_edges.py`), or a list.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Protocol

from companion.core.types import FlowReport, Input
from companion.sensors.pulses import Edge, Meter, PulseCounter


class EdgeSource(Protocol):
    """Rising edges of one line, in their order."""

    def open(self) -> None:
        """Take the line."""

    def read(self) -> Sequence[Edge]:
        """Return what came since the last call; never waits. OSError where the line is gone."""

    def close(self) -> None:
        """Let go of the line; may be called twice and before `open`."""


class VirtualEdges:
    """Edges that are put in by hand: for tests and for a bench without a meter."""

    def __init__(self) -> None:
        self.is_open = False
        self._edges: list[Edge] = []
        self._number = 0

    def put(self, *times_s: float, lost: int = 0) -> None:
        """Add edges at these times, `lost` of them before the first dropped by the kernel."""
        self._number += lost
        for at_s in times_s:
            self._number += 1
            self._edges.append(Edge(at_s, self._number))

    def open(self) -> None:
        """Begin."""
        self.is_open = True

    def read(self) -> Sequence[Edge]:
        """Return what was put in."""
        edges, self._edges = self._edges, []
        return edges

    def close(self) -> None:
        """End."""
        self.is_open = False


class FlowMeter:
    """Counts while it is open; read at every step."""

    def __init__(self, meter: Meter, source: EdgeSource) -> None:
        self.counter = PulseCounter(meter)
        self._source = source

    async def open(self, wake: Callable[[], None]) -> None:  # noqa: ARG002 - steps come anyway
        """Take the line: SensorError where that cannot be had."""
        self._source.open()

    def read(self, now_s: float) -> Sequence[Input]:
        """Return the count, or why there is none."""
        try:
            edges = self._source.read()
        except OSError as error:
            text = f"flow meter: its line cannot be read: {error.strerror or error}"
            return [FlowReport(received_s=now_s, volume_ml=math.nan, fault=text)]
        for edge in edges:
            self.counter.take(edge)
        return [self.counter.report(now_s)]

    def volume_ml(self) -> float:
        """Return what has been counted since the start."""
        return self.counter.volume_ml

    async def close(self) -> None:
        """Let go of the line."""
        self._source.close()
