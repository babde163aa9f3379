"""How the valves hang on the autopilot's outputs: channels, and the two ends of the pulse."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

# An alive dither moves each open valve's width this often, so 5 Hz to and fro. A board that closes
# after 0.3 s of standstill then outlives two lost orders in a row.
DITHER_S = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class DriveOutput:
    """A motor's output: where it stops, and the end of its range."""

    channel: int
    stop_us: int = 1000
    max_us: int = 2000

    def __post_init__(self) -> None:
        if not 500 <= self.stop_us < self.max_us <= 2500:
            raise ValueError(
                f"stop_us and max_us must rise from 500 to 2500, got {self.stop_us}, {self.max_us}"
            )

    def pulse_us(self, fraction: float) -> int:
        """Return the pulse for a fraction of the range.

        >>> DriveOutput(channel=5, stop_us=1100, max_us=1900).pulse_us(0.5)
        1500
        """
        return round(self.stop_us + fraction * (self.max_us - self.stop_us))


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoOptions:
    """The outputs: one channel a valve, left to right, and the two ends of the pulse.

    Drives have ends of their own; without valves they are all there is.

    With `needs_guard` nothing opens unless something beside the companion closes.

    At `return_channel`, if there is one, `full_us` opens a return valve and `closed_us` shuts it.
    With `dither_us` the pulse of an open valve moves to and fro by that much, around its own width,
    every `DITHER_S`: a board that wants to see it closes when the autopilot goes on with a pulse
    of the past. The valves take turns, to keep the wire free; with `dithers_together` they move at
    once, for an autopilot whose one order carries all outputs.
    """

    channels: tuple[int, ...]
    closed_us: int = 1000
    full_us: int = 2000
    refresh_s: float = 1.0
    dither_us: int = 0
    dithers_together: bool = False
    return_channel: int | None = None
    drives: tuple[DriveOutput, ...] = ()
    needs_guard: bool = False

    def __post_init__(self) -> None:
        if not self.outputs or len(set(self.outputs)) != len(self.outputs):
            raise ValueError(f"each valve needs a channel of its own, got {self.channels}")
        if not all(1 <= channel <= 32 for channel in self.outputs):
            raise ValueError(f"servo channels are 1 to 32, got {self.outputs}")
        for name, pulse_us in (("closed_us", self.closed_us), ("full_us", self.full_us)):
            # The autopilot clamps nothing; what is outside is no servo pulse.
            if not 500 <= pulse_us <= 2500:
                raise ValueError(f"{name} must lie in [500, 2500], got {pulse_us}")
        if not abs(self.full_us - self.closed_us) >= 100:
            raise ValueError(f"closed_us and full_us are too near: {self.closed_us}")
        if not 0 <= self.dither_us <= 50:
            raise ValueError(f"dither_us must lie in [0, 50], got {self.dither_us}")
        if not 0.05 <= self.refresh_s <= 10.0:
            raise ValueError(f"refresh_s must lie in [0.05, 10], got {self.refresh_s}")

    @property
    def outputs(self) -> tuple[int, ...]:
        """Return all channels: of the valves, of the return valve, of the drives."""
        more = () if self.return_channel is None else (self.return_channel,)
        return self.channels + more + tuple(drive.channel for drive in self.drives)

    def drive_at(self, channel: int) -> DriveOutput | None:
        """Return the drive on a channel, if it is one."""
        return next((drive for drive in self.drives if drive.channel == channel), None)

    def ends_us(self, output: int) -> tuple[int, int]:
        """Return the pulses of 0 and of 1 at an output, counted as in `outputs`."""
        number = output - (len(self.outputs) - len(self.drives))
        if number < 0:
            return self.closed_us, self.full_us
        return self.drives[number].stop_us, self.drives[number].max_us

    def pulse_at(self, output: int, value: float) -> int:
        """Return the pulse for a duty, or for a drive's fraction, at an output.

        >>> pump = DriveOutput(channel=5, stop_us=1100)
        >>> ServoOptions(channels=(9,), drives=(pump,)).pulse_at(1, 0.0)
        1100
        """
        low_us, high_us = self.ends_us(output)
        return round(low_us + value * (high_us - low_us))

    def pulse_us(self, duty: float) -> int:
        """Return the pulse for `duty`.

        >>> ServoOptions(channels=(9,)).pulse_us(0.25)
        1250
        """
        return round(self.closed_us + duty * (self.full_us - self.closed_us))

    def dithered_us(self, pulse_us: int, *, is_up: bool) -> int:
        """Return what is sent for `pulse_us`: half the dither to either side, but never past full.

        >>> options = ServoOptions(channels=(9,), dither_us=8)
        >>> [options.dithered_us(1500, is_up=is_up) for is_up in (False, True)]
        [1496, 1504]
        >>> [options.dithered_us(2000, is_up=is_up) for is_up in (False, True)]
        [1992, 2000]
        >>> options.dithered_us(1000, is_up=True)
        1000
        """
        if pulse_us == self.closed_us or not self.dither_us:
            return pulse_us
        sign = 1 if self.full_us > self.closed_us else -1
        open_us = sign * (pulse_us - self.closed_us)
        full_us = sign * (self.full_us - self.closed_us)
        low_us = min(open_us - self.dither_us // 2, full_us - self.dither_us)
        return self.closed_us + sign * (low_us + (self.dither_us if is_up else 0))

    def is_move(self, from_us: int, to_us: int) -> bool:
        """Return whether a board that wants to see its width move counts this: half the dither.

        >>> options = ServoOptions(channels=(9,), dither_us=8)
        >>> options.is_move(1500, 1496), options.is_move(1500, 1503)
        (True, False)
        """
        return 2 * abs(to_us - from_us) >= self.dither_us


# Whether the outputs do what was ordered: SERVO_OUTPUT_RAW against the orders of the last moments.
#
# An acknowledgement is no proof: PX4 gives one whatever becomes of an order. What the outputs read
# back is. Pure: orders, readings and times in, a verdict out.

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
