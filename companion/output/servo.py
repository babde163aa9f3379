"""Valves and drives behind the autopilot's servo outputs: one timed order for each change.

A driver board at each output turns the pulse width into the valve's PWM: 0 at `closed_us`, fully
open at `full_us`. Orders are fire-and-forget: a lost one is not repeated late but overtaken by
the next, or by the refresh, within a second. The autopilot holds the last order for ever, so
everything that ends here ends with an order to close.
"""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Callable, Sequence

from companion.output.autopilot_guard import OutputGuard
from companion.output.autopilot_options import DITHER_S, ServoOptions
from companion.output.pwm import RESTART_DUTY
from companion.output.timed import TimedExecutor

__all__ = ["DITHER_S", "Order", "ServoExecutor", "ServoOptions"]


_logger = logging.getLogger(__name__)

# How much later than one that left behind it an order may arrive: Linux holds back Wi-Fi frames
# for a missing one for at most HZ / 10 (net/mac80211/rx.c, HT_RX_REORDER_BUF_TIMEOUT; mwifiex: 50
# ms). A wire keeps the order.
REORDER_S = 0.1
# After a refusal the closing orders go on, but seldom: each costs a text on the pilot's screen.
_REFRESH_FAULT_S = 5.0
# An output takes what was ordered with its next frame, of 50 a second at the least.
SERVO_FRAME_S = 0.020
# An order that may have been more than the autopilot's queue takes is said again after this.
_SAY_AGAIN_S = 0.1

Order = Callable[[int, int], bool]


class ServoExecutor(TimedExecutor):
    """Gives orders by `order(channel, pulse_us)`, which says whether the order left.

    Where one order carries all outputs (PX4), `order` only takes a value and `flush` sends. Until
    the vehicle is met it counts as one that takes an order for each output.
    """

    def __init__(
        self,
        options: ServoOptions,
        order: Order,
        *,
        flush: Callable[[], bool] = lambda: True,
        say: Callable[[str], None] = _logger.warning,
        baud: int | None = None,
        is_signed: bool = False,
    ) -> None:
        super().__init__(
            len(options.channels),
            has_return=options.return_channel is not None,
            drive_count=len(options.drives),
        )
        self._options = options
        self._outputs = options.outputs
        self._order = order
        self._send_staged = flush
        self._baud, self._is_signed = baud, is_signed
        self._reorder_s = REORDER_S if baud is None else 0.0
        self._again_at_s: dict[int, float] = {}
        self._guard = OutputGuard(options, say)
        self._is_joint = False
        self._budget = order_budget(baud=baud, is_px4=False, is_signed=is_signed)
        self._sent_us: list[int | None] = [None] * len(self._outputs)
        self._held_us: dict[int, int] = {}
        self._is_staged = False
        self._next_refresh = self._next_dither = 0
        self._is_up = [False] * len(self._outputs)
        self._given_us: list[int | None] = [None] * len(self._outputs)
        self._given_at_s = [0.0] * len(self._outputs)
        self._moved_us: list[int | None] = [None] * len(self._outputs)
        self._moved_at_s = [0.0] * len(self._outputs)
        self._refresh_at_s: float | None = None
        self._dither_at_s: float | None = None
        self._was_started = False
        self.order_count = 0
        self.unsent_count = 0

    @property
    def fault(self) -> str | None:
        """Why the outputs cannot be trusted; None while they take orders and follow them."""
        return self._guard.fault

    @property
    def is_guarded(self) -> bool:
        """Whether something closes when this computer fails, where that is asked for."""
        return self._guard.is_guarded

    # ------------------------------------------------------------- what the autopilot says

    def met(self, is_px4: bool) -> Sequence[str]:
        """Take that the vehicle was met, also again; return the parameters to read of it.

        What it was told before may be forgotten or kept: everything is ordered anew.
        """
        self._is_joint = is_px4
        self._budget = order_budget(baud=self._baud, is_px4=is_px4, is_signed=self._is_signed)
        names = self._guard.met(is_px4=is_px4, now_s=asyncio.get_running_loop().time())
        self._say_all_again()
        return names

    def armed(self, is_armed: bool) -> None:
        """Take that the vehicle was armed or disarmed: an order of before may show only now."""
        self._guard.armed(is_armed, asyncio.get_running_loop().time())
        self._say_all_again()

    def acknowledge(self, result: int) -> None:
        """Take the autopilot's answer to an order; a refusal is a fault, and stays one.

        It does not say which of several orders it means, so all valves close.
        """
        before = self.fault
        self._guard.acknowledge(result)
        self._close_if_new(before)

    def learned(self, known: dict[str, float | None]) -> Sequence[str]:
        """Take parameters of the autopilot; return those to read besides."""
        before = self.fault
        more = self._guard.learned(known)
        self._close_if_new(before)
        return more

    def reported(self, port: int, pulse_us: Sequence[int], at_s: float) -> None:
        """Take what the outputs read; what may have been lost is said again, with today's value."""
        before = self.fault
        again = self._guard.reported(port, pulse_us, at_s)
        self._close_if_new(before)
        if not (again and self._is_running) or self._guard.is_refused:
            return
        now_s = asyncio.get_running_loop().time()
        for valve in again:
            sent_us = self._sent_us[valve]
            can_wait = self._budget.left(now_s) < 1.0 or self._rests_soon(valve, now_s)
            if sent_us is not None and not can_wait:
                self._give(valve, sent_us)
        self._flush()

    def _close_if_new(self, before: str | None) -> None:
        if self.fault is not None and before is None and self._is_running:
            now_s = asyncio.get_running_loop().time()
            self._follow(now_s)
            self._arm(now_s)

    def _say_all_again(self) -> None:
        """Order everything as it is to be now, whatever was ordered before."""
        self._sent_us = [None] * len(self._outputs)
        if self._is_running:
            now_s = asyncio.get_running_loop().time()
            self._follow(now_s)
            self._arm(now_s)

    # ----------------------------------------------------------------------- start and stop

    async def start(self) -> None:
        """Order all outputs closed and begin to refresh them."""
        self._was_started = True
        now_s = asyncio.get_running_loop().time()
        self._refresh_at_s = now_s + self._pause_s
        dithers = self._options.dither_us > 0 and self._count > 0
        self._dither_at_s = now_s + self._dither_pause_s if dithers else None
        await super().start()

    async def stop(self) -> None:
        """Order all outputs closed, and once more in case the first was lost on the way."""
        if not self._was_started:
            return
        self._was_started = False
        self._sent_us = [None] * len(self._outputs)
        await super().stop()
        await asyncio.sleep(REORDER_S)
        self._sent_us = [None] * len(self._outputs)
        self._close_all()
        _logger.info(
            "%d orders, %d not sent, latest by %.1f ms, %d leases ended",
            self.order_count,
            self.unsent_count,
            self.lateness.worst_s * 1e3,
            self.lease_end_count,
        )

    # ------------------------------------------------------------------------------- orders

    def _apply(self, valve: int, duty: float) -> bool:
        pulse_us = self._options.pulse_at(valve, duty)
        sent_us = self._sent_us[valve]
        self._held_us.pop(valve, None)
        if sent_us is not None and not self._is_worth_it(valve, sent_us, pulse_us):
            return False
        return self._give(valve, pulse_us)

    def _is_worth_it(self, valve: int, sent_us: int, pulse_us: int) -> bool:
        """Return whether an order may go now; a change of zone, also to closed, always may."""
        moved_us = abs(pulse_us - sent_us)
        if moved_us == 0:
            return False
        closed_us, full_us = self._options.ends_us(valve)
        if closed_us in (pulse_us, sent_us) or moved_us >= RESTART_DUTY * abs(full_us - closed_us):
            return True
        if moved_us < CHANGE_MIN_US and pulse_us != full_us:
            return False
        now_s = asyncio.get_running_loop().time()
        least_us = self._budget.trim_min_us(now_s)
        is_dear = moved_us < least_us and not (least_us == CHANGE_MIN_US and pulse_us == full_us)
        if is_dear or self._rests_soon(valve, now_s):
            self._held_us[valve] = pulse_us
            return False
        return True

    def _give(self, valve: int, pulse_us: int, *, is_turn: bool = False) -> bool:
        """Send one order, of a dither's turn or not; where it cannot leave, nothing is known."""
        sent_us = pulse_us
        self._held_us.pop(valve, None)
        now_s = asyncio.get_running_loop().time()
        if valve < self._count:
            sent_us = self._dithered_us(valve, pulse_us, now_s, is_turn=is_turn)
        has_left, before_us = self._order(self._outputs[valve], sent_us), self._sent_us[valve]
        self._sent_us[valve] = pulse_us if has_left else None
        if not has_left:
            self.unsent_count += 1
            return False
        self._given_us[valve], self._given_at_s[valve] = sent_us, now_s
        if pulse_us != self._rest_us(valve):
            self._again_at_s.pop(valve, None)
        elif before_us not in (None, pulse_us) and self._reorder_s:
            self._again_at_s[valve] = now_s + self._reorder_s
        self._guard.sent(valve, sent_us, now_s)
        self.order_count += 1
        if self._is_joint:
            self._is_staged = True
        else:
            self._budget.spend(1, now_s)
        return True

    def _rest_us(self, output: int) -> int:
        """Return the pulse that does no harm: shut, stopped, of a return valve open."""
        return self._options.ends_us(output)[self._count <= output < self._first_drive]

    def _rests_soon(self, output: int, now_s: float) -> bool:
        """Return whether an order that can wait might arrive behind one to close.

        On PX4 an order is one to all outputs.
        """
        return any(
            self._rests_by(each, now_s, now_s + self._reorder_s)
            for each in (range(len(self._outputs)) if self._is_joint else (output,))
            if self._sent_us[each] not in (None, self._rest_us(each))
        )

    def _dithered_us(self, valve: int, pulse_us: int, now_s: float, *, is_turn: bool) -> int:
        """Return the width to send for a pulse: one that the board sees move, if it is time.

        To and fro by turns does that where the pulse stands still. A trim against the dither would
        undo it; and of two orders within a servo frame the outputs have only the second.
        """
        given_us, options = self._given_us[valve], self._options
        if given_us is not None and now_s - self._given_at_s[valve] >= SERVO_FRAME_S:
            self._stood(valve, given_us)
        sent_us = options.dithered_us(pulse_us, is_up=self._is_up[valve])
        moved_us, is_time = self._moved_us[valve], is_turn
        if moved_us is not None:
            if options.is_move(moved_us, sent_us):
                return sent_us
            is_time = is_turn or now_s - self._moved_at_s[valve] >= 0.9 * DITHER_S
        if is_time:
            self._is_up[valve] = not self._is_up[valve]
        return options.dithered_us(pulse_us, is_up=self._is_up[valve])

    def _stood(self, valve: int, width_us: int) -> None:
        """Take down that an output has had a width, as its board counts moves."""
        moved_us = self._moved_us[valve]
        if moved_us is None or self._options.is_move(moved_us, width_us):
            self._moved_us[valve], self._moved_at_s[valve] = width_us, self._given_at_s[valve]

    def _flush(self) -> bool:
        """Send what was gathered, with the trims that had to wait: they cost nothing more."""
        if not self._is_staged:
            return False
        for valve, pulse_us in list(self._held_us.items()):
            self._give(valve, pulse_us)
        self._is_staged = False
        now_s = asyncio.get_running_loop().time()
        if not self._send_staged():
            self.unsent_count += 1
            self._sent_us = [None] * len(self._outputs)
            self._guard.forget()
        self._budget.spend(1, now_s)
        if self._budget.left(now_s) < 0.0 and self._refresh_at_s is not None:
            self._refresh_at_s = min(self._refresh_at_s, now_s + _SAY_AGAIN_S)
        return True

    # ------------------------------------------------------------------- refresh and dither

    @property
    def _pause_s(self) -> float:
        """Return the time between two refreshes: the valves take turns, to keep the wire free."""
        period_s = _REFRESH_FAULT_S if self._guard.is_refused else self._options.refresh_s
        return period_s if self._is_joint else period_s / len(self._outputs)

    @property
    def _is_together(self) -> bool:
        return self._is_joint or self._options.dithers_together

    @property
    def _dither_pause_s(self) -> float:
        return DITHER_S if self._is_together else DITHER_S / self._count

    def _next_own_s(self) -> float | None:
        own = (self._refresh_at_s, self._dither_at_s, *self._again_at_s.values())
        times = [at_s for at_s in own if at_s is not None]
        return min(times, default=None)

    def _do_own(self, now_s: float) -> None:
        """Say orders again, and move those that are to be seen alive, when their turn has come."""
        for output, at_s in list(self._again_at_s.items()):
            if not now_s < at_s:
                del self._again_at_s[output]
                self._give(output, self._rest_us(output))
        if self._refresh_at_s is not None and not now_s < self._refresh_at_s:
            self._refresh_at_s = now_s + self._pause_s
            self._guard.look(now_s)
            valve = self._next_refresh
            self._next_refresh = (valve + 1) % len(self._outputs)
            sent_us = self._sent_us[valve]
            # What moves is said again by moving.
            is_said = self._dithers(valve) or self._rests_soon(valve, now_s)
            if sent_us is not None and not is_said:
                self._give(valve, self._held_us.get(valve, sent_us))
        if self._dither_at_s is not None and not now_s < self._dither_at_s:
            # In the mean as often as said: a turn that came late delays no other.
            pause_s = self._dither_pause_s
            late = now_s - self._dither_at_s >= pause_s
            self._dither_at_s = (now_s if late else self._dither_at_s) + pause_s
            self._dither()
        self._flush()

    def _dithers(self, valve: int) -> bool:
        """Return whether the valve is open and is to be seen alive; a return valve never is."""
        is_open = self._sent_us[valve] not in (None, self._options.closed_us)
        return is_open and self._options.dither_us > 0 and valve < self._count

    def _dither(self) -> None:
        """Move the valve whose turn it is, or all of them; one that is closed stands still.

        So does one that closes soon. Where an order is one to all, others could then stand too
        long for their boards.
        """
        now_s = asyncio.get_running_loop().time()
        turn = self._next_dither
        self._next_dither = (turn + 1) % self._count
        for valve in range(self._count) if self._is_together else (turn,):
            sent_us = self._sent_us[valve]
            closes = not self._is_joint and self._rests_soon(valve, now_s)
            if sent_us is not None and self._dithers(valve) and not closes:
                self._give(valve, self._held_us.get(valve, sent_us), is_turn=True)


# How many orders a way to the outputs may carry: changes of zone always, trims what is left.
#
# A token bucket. Nothing is refused that opens or closes or changes a zone; it only leaves less for
# trims. A trim is not queued either: what is withheld is asked for anew by the next plan, with the
# value of then.

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
