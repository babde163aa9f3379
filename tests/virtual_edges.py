"""A flow meter's line whose edges are put in by hand."""

from __future__ import annotations

from collections.abc import Sequence

from companion.sensors import Edge


class VirtualEdges:
    """Edges that are put in by hand: there is no meter."""

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
