"""The servo outputs with PX4's rules for MAV_CMD_DO_SET_ACTUATOR.

One command sets all six actuators, -1 to 1; an output shows one of them if its function says so
(PWM_MAIN_FUNCn = 301 to 306). An output is active only while armed, or with COM_PREARM_MODE 2;
otherwise, and as long as its actuator was never set, it shows PWM_MAIN_DISn. What was ordered
before arming is kept and shows at the moment of arming; it holds for ever (measured on a PX4 1.16
SITL). NaN leaves an actuator alone from 1.14.2 on; before, it switched it to disarmed.
"""

from __future__ import annotations

import math

from sitl.stub.outputs import OutputState, PulseRegister, Written
from sitl.stub.parameters import OUTPUT_COUNT, Parameters

ACTUATOR_COUNT = 6
ACTUATOR_FUNCTIONS = range(301, 301 + ACTUATOR_COUNT)
MOTOR_FUNCTIONS = range(101, 113)
_PREARMED_ALWAYS = 2
# From order to message PX4 takes 0.3 to 12 ms where it sends 83 of them a second.
_READ_BACK_S = 0.006


class ActuatorOutputs:
    """What was last ordered of each actuator, and what the outputs make of it."""

    def __init__(self, parameters: Parameters, written: Written, *, nan_keeps: bool) -> None:
        self._parameters = parameters
        self._nan_keeps = nan_keeps
        self._pins = PulseRegister(written, read_back_s=_READ_BACK_S)
        self._values = [math.nan] * ACTUATOR_COUNT
        self._state = OutputState()
        self._seen: tuple[int, OutputState] | None = None

    def order(self, values: tuple[float, ...], *, index: float, now_s: float) -> None:
        """Set the actuators; only the first set of six (index 0) is there."""
        if index != 0.0:
            return
        for number, value in enumerate(values[:ACTUATOR_COUNT]):
            if not math.isnan(value):
                self._values[number] = min(max(value, -1.0), 1.0)
            elif not self._nan_keeps:
                self._values[number] = math.nan
        self._show(now_s)

    def write(self, channel: int, pulse_us: float, *, now_s: float) -> None:
        """Write to a pin directly; the next order or change of state overwrites it."""
        self._pins.put(channel, int(pulse_us) & 0xFFFF, now_s=now_s)

    def reset(self, now_s: float) -> None:
        """Forget all orders; the outputs show what they show disarmed."""
        self._values = [math.nan] * ACTUATOR_COUNT
        self._show(now_s)

    def update(self, now_s: float, state: OutputState) -> None:
        """Follow arming, the kill switch and the parameters."""
        if self._seen == (self._parameters.revision, state):
            return
        self._seen = (self._parameters.revision, state)
        self._state = state
        self._show(now_s)

    def pulses_us(self, now_s: float) -> tuple[int, ...]:
        """Return what SERVO_OUTPUT_RAW reads back."""
        return tuple(
            self._pins.read_back_us(channel, now_s) for channel in range(1, OUTPUT_COUNT + 1)
        )

    def _show(self, now_s: float) -> None:
        for channel in range(1, OUTPUT_COUNT + 1):
            # Whatever the parameters say: the register has 16 bits.
            pulse_us = min(max(self._pulse_us(channel), 0), 0xFFFF)
            if pulse_us != self._pins.now_us(channel):
                self._pins.put(channel, pulse_us, now_s=now_s)

    def _pulse_us(self, channel: int) -> int:
        function = int(self._parameters[f"PWM_MAIN_FUNC{channel}"])
        if function == 0:
            return 0
        disarmed_us = int(self._parameters[f"PWM_MAIN_DIS{channel}"])
        if self._state.terminated:
            fail_us = int(self._parameters[f"PWM_MAIN_FAIL{channel}"])
            return disarmed_us if fail_us < 0 else fail_us
        value = self._value(function)
        if not self._is_active(function) or math.isnan(value):
            return disarmed_us
        low_us = self._parameters[f"PWM_MAIN_MIN{channel}"]
        high_us = self._parameters[f"PWM_MAIN_MAX{channel}"]
        return round(low_us + (high_us - low_us) * 0.5 * (value + 1.0))

    def _is_active(self, function: int) -> bool:
        prearmed = int(self._parameters["COM_PREARM_MODE"]) == _PREARMED_ALWAYS
        moves = self._state.armed or (prearmed and function not in MOTOR_FUNCTIONS)
        return moves and not self._state.killed

    def _value(self, function: int) -> float:
        if function in ACTUATOR_FUNCTIONS:
            return self._values[function - ACTUATOR_FUNCTIONS.start]
        if function in MOTOR_FUNCTIONS:
            return 0.0 if self._state.in_air else -1.0
        return math.nan
