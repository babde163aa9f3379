"""Whether the outputs do what was ordered: SERVO_OUTPUT_RAW against the orders of the last moments.

An acknowledgement is no proof: PX4 gives one whatever becomes of an order. What the outputs read
back is. Pure: orders, readings and times in, a verdict out.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

TOLERANCE_US = 2
# An order shows within 6 to 20 ms, and a message comes every 100 ms.
FOLLOWS_WITHIN_S = 0.3
# So long after an order that does not show it is said again: it may have been lost on the way.
_AGAIN_AFTER_S = 0.12
# One reading may be the victim of a long way; two in a row are not.
_MISSES = 2
_READING_MAX_S = 1.0
_KEPT = 64

# Port of SERVO_OUTPUT_RAW and index in it.
Place = tuple[int, int]


@dataclass(frozen=True, slots=True, kw_only=True)
class Reading:
    """What an output reads, where it should read something else."""

    output: int
    pulse_us: int
    ordered_us: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """What a report says: outputs that do not follow, and those to be ordered once more."""

    stray: tuple[Reading, ...] = ()
    again: tuple[int, ...] = ()
    seen: int = 0


@dataclass(slots=True)
class _Output:
    """The last orders of one output, and how often it was found elsewhere."""

    orders: deque[tuple[float, int]] = field(default_factory=lambda: deque(maxlen=_KEPT))
    misses: int = 0

    def matches(self, pulse_us: int, since_s: float) -> bool:
        """Return whether the reading is an order that was in force at `since_s` or later."""
        until_s = math.inf
        for at_s, ordered_us in reversed(self.orders):
            if until_s < since_s:
                return False
            if abs(pulse_us - ordered_us) <= TOLERANCE_US:
                return True
            until_s = at_s
        return False


class OutputCheck:
    """Remembers the orders of each output and compares the readings with them.

    `places` says where each output may be found; with several places one that follows is enough.
    """

    def __init__(self, count: int) -> None:
        self._outputs = [_Output() for _ in range(count)]
        self._places: tuple[tuple[Place, ...], ...] = ((),) * count
        self._ports: dict[int, tuple[float, tuple[int, ...]]] = {}

    def look_at(self, places: Sequence[Sequence[Place]]) -> None:
        """Take where each output is to be found; nowhere is not looked at."""
        self._places = tuple(tuple(given) for given in places)

    @property
    def is_possible(self) -> bool:
        """Return whether a report has come that shows any of the outputs."""
        return any(place[0] in self._ports for places in self._places for place in places)

    def forget(self) -> None:
        """Forget orders and readings: what the outputs do is unknown."""
        self._ports.clear()
        for output in self._outputs:
            output.orders.clear()
            output.misses = 0

    def sent(self, output: int, pulse_us: int, at_s: float) -> None:
        """Take an order that has left."""
        orders = self._outputs[output].orders
        if not orders or orders[-1][1] != pulse_us:
            orders.append((at_s, pulse_us))

    def read(self, port: int, pulse_us: Sequence[int], at_s: float) -> Verdict:
        """Return what a report says of the outputs that it shows."""
        self._ports[port] = (at_s, tuple(pulse_us))
        strays, again, seen = [], [], 0
        for number, output in enumerate(self._outputs):
            if not output.orders or port not in (place[0] for place in self._places[number]):
                continue
            readings = self._readings(number, at_s)
            if not readings:
                continue
            seen += 1
            if at_s - output.orders[0][0] < _AGAIN_AFTER_S:
                continue
            if any(output.matches(pulse, at_s - _AGAIN_AFTER_S) for pulse in readings):
                output.misses = 0
                continue
            again.append(number)
            if any(output.matches(pulse, at_s - FOLLOWS_WITHIN_S) for pulse in readings):
                output.misses = 0
            elif at_s - output.orders[0][0] >= FOLLOWS_WITHIN_S:
                output.misses += 1
            if output.misses >= _MISSES:
                strays.append(
                    Reading(output=number, pulse_us=readings[0], ordered_us=output.orders[-1][1])
                )
        return Verdict(stray=tuple(strays), again=tuple(again), seen=seen)

    def _readings(self, number: int, now_s: float) -> list[int]:
        """Return what is read of an output wherever it may be, of late."""
        ports: Mapping[int, tuple[float, tuple[int, ...]]] = self._ports
        found = []
        for port, index in self._places[number]:
            at_s, pulses = ports.get(port, (-math.inf, ()))
            if now_s - at_s <= _READING_MAX_S and index < len(pulses):
                found.append(pulses[index])
        return found


def ardupilot_places(channels: Sequence[int]) -> tuple[tuple[Place, ...], ...]:
    """Return where ArduPilot shows its outputs: sixteen to a port.

    >>> ardupilot_places([9, 17])
    (((0, 8),), ((1, 0),))
    """
    return tuple((((channel - 1) // 16, (channel - 1) % 16),) for channel in channels)
