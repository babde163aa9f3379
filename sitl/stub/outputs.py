"""The servo outputs with ArduPilot's rules for MAV_CMD_DO_SET_SERVO.

The rules are those of AP_ServoRelayEvents: an output must have a free function; the pulse is
written as it comes, without limits; it holds for ever; before the first order it is 0.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from sitl.stub.parameters import OUTPUT_COUNT, Parameters

# Disabled, RCPassThru, SprayerPump, SprayerSpinner, Gripper, RCIN1 to 16, RCIN1 to 16 scaled.
FREE_FUNCTIONS = frozenset({0, 1, 22, 23, 28, *range(51, 67), *range(140, 156)})

# An order shows in SERVO_OUTPUT_RAW about 6 ms later (measured on an ArduCopter SITL).
READ_BACK_S = 0.006


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoOrder:
    """One pulse width that was ordered for one output (channel 1 is the first)."""

    at_s: float
    channel: int
    pulse_us: int


class ServoOutputs:
    """What was last ordered of each output; every order goes on to what hangs on the outputs."""

    def __init__(self, parameters: Parameters, written: Callable[[ServoOrder], None]) -> None:
        self._parameters = parameters
        self._written = written
        self._orders: dict[int, list[ServoOrder]] = {}

    def is_free(self, channel: int) -> bool:
        """Return whether DO_SET_SERVO may write to the output."""
        return int(self._parameters[f"SERVO{channel}_FUNCTION"]) in FREE_FUNCTIONS

    def write(self, channel: int, pulse_us: float, *, now_s: float) -> None:
        """Write a pulse width; unclamped but for the 16 bits of the register."""
        order = ServoOrder(at_s=now_s, channel=channel, pulse_us=int(pulse_us) & 0xFFFF)
        self._orders[channel] = [*self._orders.get(channel, [])[-1:], order]
        self._written(order)

    def reset(self, now_s: float) -> None:
        """Forget all orders, as a restart of the flight controller does: no pulses."""
        for channel in list(self._orders):
            self.write(channel, 0, now_s=now_s)

    def pulses_us(self, now_s: float) -> tuple[int, ...]:
        """Return what SERVO_OUTPUT_RAW reads back."""
        return tuple(self._pulse_us(channel, now_s) for channel in range(1, OUTPUT_COUNT + 1))

    def _pulse_us(self, channel: int, now_s: float) -> int:
        for order in reversed(self._orders.get(channel, [])):
            if order.at_s <= now_s - READ_BACK_S:
                return order.pulse_us
        return 0
