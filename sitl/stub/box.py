"""A driver box that has to be armed, as speed controllers of motors do.

It passes nothing on until it has seen the closed pulse for a while without a break; when the
pulses end it has to be armed again. An order that opens before that makes it begin anew. Some
boxes on the market are built that way; the board of this project is not.
"""

from __future__ import annotations

from sitl.stub.outputs import ServoOrder

_PULSE_MIN_US = 800.0
# Of the span: a width this near to closed is closed, as at the driver board.
_CLOSED_DUTY = 0.01


class ArmingBox:
    """One input a channel; says of each order whether it is passed on."""

    def __init__(self, *, closed_s: float, closed_us: float, full_us: float) -> None:
        self._closed_s = closed_s
        self._closed_max_us = closed_us + _CLOSED_DUTY * (full_us - closed_us)
        self._closed_since_s: dict[int, float] = {}
        self._armed: set[int] = set()

    def passes(self, order: ServoOrder) -> bool:
        """Take an order in and return whether it reaches the valve."""
        channel = order.channel
        if order.pulse_us < _PULSE_MIN_US:
            self._armed.discard(channel)
            self._closed_since_s.pop(channel, None)
            return True
        since_s = self._closed_since_s.get(channel)
        if since_s is not None and order.at_s - since_s >= self._closed_s:
            self._armed.add(channel)
        if order.pulse_us <= self._closed_max_us:
            self._closed_since_s.setdefault(channel, order.at_s)
            return True
        self._closed_since_s.pop(channel, None)
        return channel in self._armed or self._closed_s == 0.0
