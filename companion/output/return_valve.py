"""The return valve: when it is to lead the pump's flow back to the tank, as a function of plans.

It opens a moment before the last valve closes and shuts a moment after the first one opens, so
that the pump never works against closed valves. A valve that pulses counts as open. Where nothing
is known (no plan, the end of a lease) it is open: that is its safe state.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from companion.core.types import SprayPlan

# Ahead of the valves' closing: what the valve needs to open, 20 to 30 ms.
RETURN_LEAD_S = 0.025
# After their opening: nozzles first, so that there is a way out at every moment.
RETURN_TRAIL_S = 0.020
# An end of spraying that a new plan moves back by less than this does not shut the valve again.
RETURN_KEPT_S = 0.1


class Span(NamedTuple):
    """Some valve sprays from `start_s` until `end_s`."""

    start_s: float
    end_s: float


def spray_spans(plan: SprayPlan, from_s: float) -> list[Span]:
    """Return when some valve is to be open, from a time until the end of the lease.

    >>> from companion.core.types import SprayPlan, TimedChange
    >>> on, off = (TimedChange(at_s=t, valve=0, duty=d) for t, d in ((1.1, 0.5), (1.2, 0.0)))
    >>> spray_spans(SprayPlan(sequence=1, issued_s=1.0, duty=(0.0,), changes=(on, off),
    ...                       lease_until_s=1.3), 1.0)
    [Span(start_s=1.1, end_s=1.2)]
    """
    spans: list[Span] = []
    since_s: float | None = None
    for begins_s, duty in plan.duties_until(plan.lease_until_s):
        at_s = max(begins_s, from_s)
        if since_s is None and any(duty):
            since_s = at_s
        elif since_s is not None and not any(duty):
            if at_s > since_s:
                spans.append(Span(since_s, at_s))
            since_s = None
    return spans


class ReturnValve:
    """Follows the plans that the valves follow; whoever owns the clock asks for its moves.

    It holds nothing up: valves that a plan closes without notice close at once, and the return
    valve opens with them.
    """

    def __init__(self) -> None:
        self.is_open = True
        self._spans: list[Span] = []
        self._moves: deque[tuple[float, bool]] = deque()

    @property
    def next_s(self) -> float | None:
        """Return when it is to move next; None if never."""
        return self._moves[0][0] if self._moves else None

    def opens_by(self, until_s: float) -> bool:
        """Return whether it is to open by then."""
        return any(is_open and at_s <= until_s for at_s, is_open in self._moves)

    def submit(self, plan: SprayPlan | None, now_s: float) -> list[tuple[float, bool]]:
        """Replace what has not happened by a plan, or by none; return the moves up to now."""
        done = self.run(now_s)
        since_s = next((a for a, b in self._spans if a <= now_s < b), now_s)
        spans = [] if plan is None else spray_spans(plan, now_s)
        if spans and spans[0].start_s <= now_s:
            spans[0] = Span(since_s, spans[0].end_s)
        self._spans = spans
        self._moves.clear()
        for start_s, end_s in spans:
            kept_s = RETURN_KEPT_S if self._is_ending(start_s, end_s, now_s) else 0.0
            shuts_s, opens_s = max(start_s + RETURN_TRAIL_S, now_s), end_s - RETURN_LEAD_S
            if shuts_s < opens_s - kept_s:
                self._moves += ((shuts_s, False), (opens_s, True))
        if not (self._moves and self._moves[0][0] <= now_s) and not self.is_open:
            self._moves.appendleft((now_s, True))
        return done + self.run(now_s)

    def run(self, until_s: float) -> list[tuple[float, bool]]:
        """Return the moves up to and with `until_s`: when, and whether it opens."""
        done = []
        while self._moves and self._moves[0][0] <= until_s:
            at_s, is_open = self._moves.popleft()
            if is_open != self.is_open:
                self.is_open = is_open
                done.append((at_s, is_open))
        return done

    def _is_ending(self, start_s: float, end_s: float, now_s: float) -> bool:
        """Tell whether it has opened already for the end of what sprays now."""
        return self.is_open and start_s + RETURN_TRAIL_S <= now_s < end_s
