"""Valves behind the autopilot's servo outputs: one timed order for each change of duty.

A driver board at each output turns the pulse width into the valve's PWM: 0 at `closed_us`, fully
open at `full_us`. Orders are fire-and-forget: a lost one is not repeated late but overtaken by
the next, or by the refresh, within a second. The autopilot holds the last order for ever, so
everything that ends here ends with an order to close.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from dataclasses import dataclass

from companion.output.timed import TimedExecutor

_logger = logging.getLogger(__name__)

# Below this the driver board sees no difference (0.2 % of the usual span).
_CHANGE_MIN_US = 2
_CLOSE_AGAIN_S = 0.05
# An alive dither moves each open valve's width this often, so 5 Hz to and fro. A board that closes
# after 0.3 s of standstill then outlives two lost orders in a row.
DITHER_S = 0.1
# After a refusal the closing orders go on, but seldom: each costs a text on the pilot's screen.
_REFRESH_FAULT_S = 5.0
_REFUSALS = {2: "denied", 3: "not supported", 4: "failed: is SERVOn_FUNCTION 0?"}  # MAV_RESULT

Order = Callable[[int, int], bool]


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoOptions:
    """The outputs: one channel a valve, left to right, and the two ends of the pulse.

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

    def __post_init__(self) -> None:
        if not self.channels or len(set(self.outputs)) != len(self.outputs):
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
        """Return all channels, that of the return valve at the end."""
        more = () if self.return_channel is None else (self.return_channel,)
        return self.channels + more

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


class ServoExecutor(TimedExecutor):
    """Gives orders by `order(channel, pulse_us)`, which says whether the order left."""

    def __init__(self, options: ServoOptions, order: Order) -> None:
        super().__init__(len(options.channels), has_return=options.return_channel is not None)
        self._options = options
        self._outputs = options.outputs
        self._order = order
        self._sent_us: list[int | None] = [None] * len(self._outputs)
        self._next_refresh = self._next_dither = 0
        self._is_up = [False] * len(self._outputs)
        self._refresh_at_s: float | None = None
        self._dither_at_s: float | None = None
        self._fault: str | None = None
        self._was_started = False
        self.order_count = 0
        self.unsent_count = 0
        self.ack_count = 0

    @property
    def fault(self) -> str | None:
        """Why the outputs cannot be trusted; None while the autopilot refuses nothing."""
        return self._fault

    def acknowledge(self, result: int) -> None:
        """Take the autopilot's answer to an order; a refusal is a fault, and stays one.

        It does not say which of several orders it means, so all valves close.
        """
        self.ack_count += 1
        if result not in _REFUSALS or self._fault is not None:
            return
        self._fault = f"servo order {_REFUSALS[result]}"
        if self._is_running:
            loop = asyncio.get_running_loop()
            self._follow(loop.time())
            self._arm(loop.time())

    async def start(self) -> None:
        """Order all outputs closed and begin to refresh them."""
        self._was_started = True
        now_s = asyncio.get_running_loop().time()
        self._refresh_at_s = now_s + self._pause_s
        self._dither_at_s = now_s + self._dither_pause_s if self._options.dither_us else None
        await super().start()

    async def stop(self) -> None:
        """Order all outputs closed, and once more in case the first was lost on the way."""
        if not self._was_started:
            return
        self._was_started = False
        self._sent_us = [None] * len(self._outputs)
        await super().stop()
        await asyncio.sleep(_CLOSE_AGAIN_S)
        self._sent_us = [None] * len(self._outputs)
        self._close_all()
        _logger.info(
            "%d orders, %d not sent, latest by %.1f ms, %d leases ended",
            self.order_count,
            self.unsent_count,
            self.lateness.worst_s * 1e3,
            self.lease_end_count,
        )

    # ------------------------------------------------------------------------------- inside

    @property
    def _pause_s(self) -> float:
        """Return the time between two refreshes: the valves take turns, to keep the wire free."""
        period_s = self._options.refresh_s if self._fault is None else _REFRESH_FAULT_S
        return period_s / len(self._outputs)

    def _apply(self, valve: int, duty: float) -> bool:
        pulse_us = self._options.pulse_us(duty)
        sent_us = self._sent_us[valve]
        if sent_us is not None:
            moved_us = abs(pulse_us - sent_us)
            is_end = pulse_us in (self._options.closed_us, self._options.full_us)
            if moved_us == 0 or (moved_us < _CHANGE_MIN_US and not is_end):
                return False
        return self._give(valve, pulse_us)

    def _give(self, valve: int, pulse_us: int) -> bool:
        """Send one order; where it cannot leave, what the output does is unknown."""
        sent_us = pulse_us
        if valve < self._count:
            sent_us = self._options.dithered_us(pulse_us, is_up=self._is_up[valve])
        has_left = self._order(self._outputs[valve], sent_us)
        self._sent_us[valve] = pulse_us if has_left else None
        if has_left:
            self.order_count += 1
        else:
            self.unsent_count += 1
        return has_left

    def _next_own_s(self) -> float | None:
        times = [at_s for at_s in (self._refresh_at_s, self._dither_at_s) if at_s is not None]
        return min(times, default=None)

    def _do_own(self, now_s: float) -> None:
        """Say orders again, and move those that are to be seen alive, when their turn has come."""
        if self._refresh_at_s is not None and not now_s < self._refresh_at_s:
            self._refresh_at_s = now_s + self._pause_s
            valve = self._next_refresh
            self._next_refresh = (valve + 1) % len(self._outputs)
            sent_us = self._sent_us[valve]
            # What moves is said again by moving.
            if sent_us is not None and not self._dithers(valve):
                self._give(valve, sent_us)
        if self._dither_at_s is not None and not now_s < self._dither_at_s:
            # In the mean as often as said: a turn that came late delays no other.
            pause_s = self._dither_pause_s
            late = now_s - self._dither_at_s >= pause_s
            self._dither_at_s = (now_s if late else self._dither_at_s) + pause_s
            self._dither()

    @property
    def _dither_pause_s(self) -> float:
        return DITHER_S if self._options.dithers_together else DITHER_S / self._count

    def _dithers(self, valve: int) -> bool:
        """Return whether the valve is open and is to be seen alive; a return valve never is."""
        is_open = self._sent_us[valve] not in (None, self._options.closed_us)
        return is_open and self._options.dither_us > 0 and valve < self._count

    def _dither(self) -> None:
        """Move the valve whose turn it is, or all of them; one that is closed stands still."""
        turn = self._next_dither
        self._next_dither = (turn + 1) % self._count
        for valve in range(self._count) if self._options.dithers_together else (turn,):
            sent_us = self._sent_us[valve]
            if sent_us is not None and self._dithers(valve):
                self._is_up[valve] = not self._is_up[valve]
                self._give(valve, sent_us)
