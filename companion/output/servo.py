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
# After a refusal the closing orders go on, but seldom: each costs a text on the pilot's screen.
_REFRESH_FAULT_S = 5.0
_REFUSALS = {2: "denied", 3: "not supported", 4: "failed: is SERVOn_FUNCTION 0?"}  # MAV_RESULT

Order = Callable[[int, int], bool]


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoOptions:
    """The outputs: one channel a valve, left to right, and the two ends of the pulse.

    With `dither_us` each refresh of an open valve moves its pulse that far towards closed and back:
    a board that wants to see it closes when the autopilot goes on with a pulse of the past.
    """

    channels: tuple[int, ...]
    closed_us: int = 1000
    full_us: int = 2000
    refresh_s: float = 1.0
    dither_us: int = 0

    def __post_init__(self) -> None:
        if not self.channels or len(set(self.channels)) != len(self.channels):
            raise ValueError(f"each valve needs a channel of its own, got {self.channels}")
        if not all(1 <= channel <= 32 for channel in self.channels):
            raise ValueError(f"servo channels are 1 to 32, got {self.channels}")
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

    def pulse_us(self, duty: float) -> int:
        """Return the pulse for `duty`.

        >>> ServoOptions(channels=(9,)).pulse_us(0.25)
        1250
        """
        return round(self.closed_us + duty * (self.full_us - self.closed_us))


class ServoExecutor(TimedExecutor):
    """Gives orders by `order(channel, pulse_us)`, which says whether the order left."""

    def __init__(self, options: ServoOptions, order: Order) -> None:
        super().__init__(len(options.channels))
        self._options = options
        self._order = order
        self._sent_us: list[int | None] = [None] * self._count
        self._next_refresh = 0
        self._dither_us = 0
        self._refresh_at_s: float | None = None
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
        self._refresh_at_s = asyncio.get_running_loop().time() + self._pause_s
        await super().start()

    async def stop(self) -> None:
        """Order all outputs closed, and once more in case the first was lost on the way."""
        if not self._was_started:
            return
        self._was_started = False
        self._sent_us = [None] * self._count
        await super().stop()
        await asyncio.sleep(_CLOSE_AGAIN_S)
        self._sent_us = [None] * self._count
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
        return period_s / self._count

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
        has_left = self._order(self._options.channels[valve], self._dithered(pulse_us))
        self._sent_us[valve] = pulse_us if has_left else None
        if has_left:
            self.order_count += 1
        else:
            self.unsent_count += 1
        return has_left

    def _dithered(self, pulse_us: int) -> int:
        closed_us, full_us = self._options.closed_us, self._options.full_us
        if pulse_us == closed_us:
            return pulse_us
        return pulse_us - self._dither_us if full_us > closed_us else pulse_us + self._dither_us

    def _next_own_s(self) -> float | None:
        return self._refresh_at_s

    def _do_own(self, now_s: float) -> None:
        """Say the next valve's order again when its turn has come."""
        if self._refresh_at_s is None or now_s < self._refresh_at_s:
            return
        self._refresh_at_s = now_s + self._pause_s
        valve = self._next_refresh
        self._next_refresh = (valve + 1) % self._count
        if valve == 0:
            self._dither_us = self._options.dither_us - self._dither_us
        sent_us = self._sent_us[valve]
        if sent_us is not None:
            self._give(valve, sent_us)
