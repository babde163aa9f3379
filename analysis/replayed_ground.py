"""Whether a replay treats the ground that its journal says was treated, cell by cell.

A flight that ended in order wrote its ground at its very end: a few hundredths of a second behind
the last decision, which matters only where a valve was still open. One that was cut wrote what was
to be half way to its next commit, as of one of its last turns. Both are made again here by the
runtime's own rules.
"""

from __future__ import annotations

from collections import deque
from itertools import chain
from typing import TYPE_CHECKING

from companion.core.controller import expected_coverage
from companion.core.coverage import Coverage
from companion.runtime import COVERAGE_EVERY_S, STEP_MAX_S

if TYPE_CHECKING:
    from companion.core.controller import Memory
    from companion.core.setup import Setup
    from companion.core.types import VehicleState

# The commit before a cut has the last told one, or the one before it.
TOLD_KEPT = 3
# From the last decision to the end: a turn that waited in vain, and its own time.
END_WITHIN_S = 4.0 * STEP_MAX_S


class ReplayedGround:
    """Takes what each step of a replay leaves, and compares at the end."""

    def __init__(self, setup: Setup) -> None:
        self._setup = setup
        self._told: deque[tuple[Memory, VehicleState | None, float]] = deque(maxlen=TOLD_KEPT)
        self._last: tuple[Memory, VehicleState | None, float] | None = None

    def take(self, memory: Memory, state: VehicleState | None, now_s: float) -> None:
        """Take what the step of `now_s` has left."""
        self._last = (memory, state, now_s)
        if not self._told or now_s >= self._told[-1][2] + COVERAGE_EVERY_S:
            self._told.append(self._last)

    def differing(self, kept: Coverage, *, is_closed: bool) -> int | None:
        """Return how many cells differ from the journal's; None where nothing can be compared."""
        if not self._setup.records_coverage or self._last is None:
            return None
        if is_closed:
            return self._at_the_end(kept, *self._last)
        counts = (
            cells_apart(kept, self._expected(*told, ahead_s=kept.ahead_s)) for told in self._told
        )
        return min(counts)

    def _at_the_end(
        self, kept: Coverage, memory: Memory, state: VehicleState | None, now_s: float
    ) -> int:
        least = Coverage() if memory.watched.swath is None else memory.watched.swath.coverage
        most = self._expected(memory, state, now_s, ahead_s=END_WITHIN_S)
        return cells_without(least, kept) + cells_without(kept, most.joined(least))

    def _expected(
        self, memory: Memory, state: VehicleState | None, now_s: float, *, ahead_s: float
    ) -> Coverage:
        return expected_coverage(self._setup, memory, state, now_s=now_s, cut_s=now_s + ahead_s)


def cells_without(one: Coverage, other: Coverage) -> int:
    """Return how many cells only the first has."""
    return sum(_only(tile, other.tiles.get(key, b"")) for key, tile in one.tiles.items())


def cells_apart(one: Coverage, other: Coverage) -> int:
    """Return how many cells only one of the two has."""
    return sum(
        _only(a.tiles.get(key, b""), b.tiles.get(key, b""))
        for key in set(chain(one.tiles, other.tiles))
        for a, b in ((one, other), (other, one))
    )


def _only(tile: bytes, other: bytes) -> int:
    return (int.from_bytes(tile, "little") & ~int.from_bytes(other, "little")).bit_count()
