"""The servo path: from an order to the autopilot to the edges at the valves.

The board of docs/driver-board.md: widths here (rules 9 to 11), pulses in `board_pulses.py`.
"""

from __future__ import annotations

import heapq
import math
from typing import TYPE_CHECKING, Literal

import numpy as np

from sitl.board_pulses import ValvePulses, is_change, phase_of

if TYPE_CHECKING:
    from sitl.edges import BoardEdge
    from sitl.profile import Pulsing

# A servo output repeats its pulse at 50 Hz: an order waits for the next frame.
SERVO_FRAME_S = 0.020
# Narrower than this is no valid servo pulse. After this long without one the board closes.
PULSE_MIN_US = 900.0
PULSE_ABSENT_S = 0.100
# With the alive check an open valve closes when its width has not moved for this long.
STANDSTILL_S = 0.300
# A width this near to closed is closed: the board must not pulse on a timer's jitter.
CLOSED_DUTY = 0.01

# Widths are never negative; these stand for a look at the clock.
_LOOK_ABSENT = -1.0
_LOOK_STANDSTILL = -2.0


class DriverBoard:
    """The servo outputs and the board behind them that makes valve pulses of servo pulses.

    `restarting` boards begin a new period when the width moves by 2 % of its span or to or from
    closed, and carry the debt of the old one; `free-running` boards never do: every change waits
    for the next period. Before the first order there are no pulses, and all valves are closed.

    With `dither_us` above 0 the board checks that an open valve's order is alive: a width that has
    moved by less than half of that for `STANDSTILL_S` closes the valve until it moves again. Half,
    so that a capture's jitter of a microsecond neither feigns life nor hides it.
    """

    def __init__(
        self,
        pwm: Pulsing,
        valve_count: int,
        *,
        seed: int,
        start_s: float,
        kind: Literal["restarting", "free-running"] = "restarting",
        closed_us: float = 1000.0,
        full_us: float = 2000.0,
        frame_s: float = SERVO_FRAME_S,
        overrun_s: float = 0.0,
        dither_us: float = 0.0,
    ) -> None:
        if not 0.0 <= dither_us <= 50.0:
            raise ValueError(f"dither_us must lie in [0, 50], got {dither_us}")
        if not closed_us < full_us:
            raise ValueError(f"closed_us must be below full_us, got {closed_us}, {full_us}")
        if not (valve_count > 0 and math.isfinite(start_s)):
            raise ValueError(f"no board for {valve_count} valves from {start_s} s")
        if not 0.0 <= overrun_s <= pwm.min_off_s:
            raise ValueError(f"overrun_s must lie in [0, min_off_s], got {overrun_s}")
        self._pulses = tuple(
            ValvePulses(
                valve,
                pwm,
                phase_s=start_s + phase_of(valve, valve_count) * pwm.period_s,
                overrun_s=overrun_s,
            )
            for valve in range(valve_count)
        )
        self._made: list[BoardEdge] = []
        self._restarts = kind == "restarting"
        self._closed_us, self._span_us = closed_us, full_us - closed_us
        self._frame_s = frame_s
        self._rng = np.random.default_rng(seed)
        self._alive_us = 0.5 * dither_us
        # (time, order of arrival, valve, width or look).
        self._due: list[tuple[float, int, int, float]] = []
        self._count = 0
        self._last_s = [-math.inf] * valve_count
        self._width_us = [0.0] * valve_count
        self._absent_since_s = [-math.inf] * valve_count
        # Where and when the width last moved far enough to be a sign of life.
        self._moved_us = [-math.inf] * valve_count
        self._moved_s = [-math.inf] * valve_count

    @property
    def width_us(self) -> tuple[float, ...]:
        """Return the pulse width at each input of the board; 0 is no pulse."""
        return tuple(self._width_us)

    @property
    def duty(self) -> tuple[float, ...]:
        """Return the duty of each valve that is in force or will be with its next period."""
        return tuple(pulses.ordered for pulses in self._pulses)

    def order(self, at_s: float, valve: int, pulse_us: float) -> None:
        """Take an order of the autopilot; it shows at the board with the next servo frame."""
        if not (math.isfinite(at_s) and 0.0 <= pulse_us <= 65535.0):
            raise ValueError(f"no pulse width and time: {pulse_us} us at {at_s} s")
        arrives_s = at_s + float(self._rng.uniform(0.0, self._frame_s))
        self._last_s[valve] = arrives_s = max(arrives_s, self._last_s[valve])
        self._push(arrives_s, valve, pulse_us)

    def _push(self, at_s: float, valve: int, pulse_us: float) -> None:
        self._count += 1
        heapq.heappush(self._due, (at_s, self._count, valve, pulse_us))

    def advance(self, until_s: float) -> list[BoardEdge]:
        """Return the edges at the valves since the last call up to `until_s`."""
        while self._due and self._due[0][0] <= until_s:
            at_s, _, valve, pulse_us = heapq.heappop(self._due)
            if pulse_us == _LOOK_ABSENT:
                self._look_absent(at_s, valve)
            elif pulse_us == _LOOK_STANDSTILL:
                self._look_standstill(at_s, valve)
            else:
                self._see(at_s, valve, pulse_us)
        for pulses in self._pulses:
            pulses.advance(until_s, self._made)
        made, self._made = self._made, []
        made.sort(key=lambda edge: edge.at_s)
        return made

    def _see(self, at_s: float, valve: int, pulse_us: float) -> None:
        was_valid = self._width_us[valve] >= PULSE_MIN_US
        self._width_us[valve] = pulse_us
        if pulse_us >= PULSE_MIN_US:
            if self._is_alive(at_s, valve, pulse_us):
                self._take(at_s, valve, self._duty(pulse_us))
        elif was_valid:
            self._absent_since_s[valve] = at_s
            self._push(at_s + PULSE_ABSENT_S, valve, _LOOK_ABSENT)

    def _duty(self, pulse_us: float) -> float:
        duty = min(max((pulse_us - self._closed_us) / self._span_us, 0.0), 1.0)
        return duty if duty >= CLOSED_DUTY else 0.0

    def _is_alive(self, at_s: float, valve: int, pulse_us: float) -> bool:
        """Return whether a width may act: it moved, or moved lately, or closes."""
        if not self._alive_us:
            return True
        if abs(pulse_us - self._moved_us[valve]) >= self._alive_us:
            self._moved_us[valve], self._moved_s[valve] = pulse_us, at_s
            self._push(at_s + STANDSTILL_S, valve, _LOOK_STANDSTILL)
            return True
        return self._duty(pulse_us) == 0.0 or not self._stands_still(at_s, valve)

    def _stands_still(self, at_s: float, valve: int) -> bool:
        return not at_s - self._moved_s[valve] < STANDSTILL_S - 1e-9

    def _look_standstill(self, at_s: float, valve: int) -> None:
        if self._stands_still(at_s, valve):
            self._take(at_s, valve, 0.0)

    def _look_absent(self, at_s: float, valve: int) -> None:
        absent = self._width_us[valve] < PULSE_MIN_US
        if absent and at_s - self._absent_since_s[valve] >= PULSE_ABSENT_S - 1e-9:
            self._take(at_s, valve, 0.0)

    def _take(self, at_s: float, valve: int, duty: float) -> None:
        pulses = self._pulses[valve]
        pulses.advance(at_s, self._made)
        old = pulses.ordered
        if duty != old:
            is_new = self._restarts and is_change(old, duty)
            pulses.order(at_s, duty, is_new_period=is_new, out=self._made)
