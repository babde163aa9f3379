"""How many orders a way to the outputs may carry: changes of zone always, trims what is left.

A token bucket. Nothing is refused that opens or closes or changes a zone; it only leaves less for
trims. A trim is not queued either: what is withheld is asked for anew by the next plan, with the
value of then.
"""

from __future__ import annotations

import math

# A COMMAND_LONG in MAVLink 2, its signature, and the ten bits of a byte on a serial line.
ORDER_BYTES = 44
SIGNATURE_BYTES = 13
_BITS = 10
# Orders take half of a line at most: streams are asked for, answered and announced over it too.
_SHARE = 0.5
_BURST_S = 0.25
# PX4 takes 20 to 30 commands a second in the long run and eight at once (PX4 #16630, #20430).
PX4_PER_S = 20.0
PX4_BURST = 6.0
# The board sees no smaller move (0.2 % of the usual span).
CHANGE_MIN_US = 2


class OrderBudget:
    """Counts what was sent and says how far a trim has to move to be worth an order now."""

    def __init__(self, per_s: float = math.inf, burst: float = math.inf) -> None:
        if not (per_s > 0.0 and burst > 0.0):
            raise ValueError(f"a budget is above 0, got {per_s} orders/s and {burst} at once")
        self.per_s, self.burst = per_s, burst
        self._left = burst
        self._at_s = -math.inf

    @property
    def is_limited(self) -> bool:
        """Return whether there is any limit."""
        return math.isfinite(self.per_s)

    def left(self, now_s: float) -> float:
        """Return how many orders are left; below 0 after more than the way was to carry."""
        if self.is_limited and now_s > self._at_s:
            if math.isfinite(self._at_s):
                self._left = min(self._left + (now_s - self._at_s) * self.per_s, self.burst)
            self._at_s = now_s
        return self._left

    def trim_min_us(self, now_s: float) -> float:
        """Return the least move that may be sent now: the scarcer orders are, the coarser.

        >>> budget = OrderBudget(per_s=10.0, burst=10.0)
        >>> budget.trim_min_us(0.0)
        2.0
        >>> budget.spend(8, 0.0)
        >>> budget.trim_min_us(0.0)
        10.0
        """
        if not self.is_limited:
            return float(CHANGE_MIN_US)
        left = self.left(now_s)
        return CHANGE_MIN_US * self.burst / left if left >= 1.0 else math.inf

    def spend(self, count: int, now_s: float) -> None:
        """Take down that orders were sent."""
        if self.is_limited:
            self._left = self.left(now_s) - count


def order_budget(*, baud: int | None, is_px4: bool, is_signed: bool = False) -> OrderBudget:
    """Return the budget of a firmware behind a line of this baud rate; None is no serial line.

    >>> budget = order_budget(baud=57_600, is_px4=False)
    >>> round(budget.per_s), round(budget.burst)
    (65, 16)
    """
    per_s = math.inf
    if baud is not None:
        size = ORDER_BYTES + (SIGNATURE_BYTES if is_signed else 0)
        per_s = _SHARE * baud / _BITS / size
    if is_px4:
        return OrderBudget(min(per_s, PX4_PER_S), PX4_BURST)
    if math.isinf(per_s):
        return OrderBudget()
    return OrderBudget(per_s, max(per_s * _BURST_S, 1.0))


def dither_too_much(*, baud: int | None, valves: int, every_s: float) -> str | None:
    """Return in words that a line cannot carry the alive dither of so many valves by itself."""
    if baud is None:
        return None
    per_s = valves / every_s
    share = per_s * ORDER_BYTES * _BITS / baud
    if share <= _SHARE:
        return None
    return (
        f"output.dither_us takes {share:.0%} of a line of {baud} baud ({per_s:.0f} orders/s): "
        "write a higher baud rate, such as 921600, here and on the autopilot"
    )
