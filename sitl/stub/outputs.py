"""The servo outputs with ArduPilot's rules for MAV_CMD_DO_SET_SERVO.

The rules are those of AP_ServoRelayEvents: an output must have a free function; the pulse is
written as it comes, without limits; it holds for ever; before the first order it is 0. An output
with a function of the transmitter follows that until it is written to, and again once the pilot
moves the control beyond its dead zone (SRV_Channel_aux.cpp). With the safety switch on there are
no pulses at all (RCOutput.cpp); what was ordered meanwhile shows when it is off.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from sitl.stub.parameters import OUTPUT_COUNT, OUTPUT_COUNT_MAX, Parameters

# Disabled, RCPassThru, SprayerPump, SprayerSpinner, Gripper, RCIN1 to 16, RCIN1 to 16 scaled.
FREE_FUNCTIONS = frozenset({0, 1, 22, 23, 28, *range(51, 67), *range(140, 156)})
_PASS_THROUGH = 1
_RC_INPUTS = range(51, 67)
_DEAD_ZONE_US = 30  # RCn_DZ of a fresh vehicle is 20 to 30

# An order shows in SERVO_OUTPUT_RAW about 6 ms later (measured on an ArduCopter SITL).
READ_BACK_S = 0.006


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoOrder:
    """One pulse width that was ordered for one output (channel 1 is the first)."""

    at_s: float
    channel: int
    pulse_us: int


Written = Callable[[ServoOrder], None]


class Outputs(Protocol):
    """What the rest of the stub needs of the outputs of either firmware."""

    def pulses_us(self, now_s: float) -> tuple[int, ...]:
        """Return what SERVO_OUTPUT_RAW reads back."""

    def write(self, channel: int, pulse_us: float, *, now_s: float) -> None:
        """Write a pulse width, whatever the function of the output is."""

    def reset(self, now_s: float) -> None:
        """Forget all orders, as a restart of the flight controller does."""

    def update(self, now_s: float, state: OutputState) -> None:
        """Take in what else decides over the outputs."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OutputState:
    """What decides over the outputs beside the orders."""

    armed: bool = False
    in_air: bool = False
    safety_on: bool = False
    killed: bool = False
    terminated: bool = False
    rc_us: Sequence[int] = ()


class PulseRegister:
    """The pulses at the pins, as they are and as they read back; all go on to what hangs there."""

    def __init__(self, written: Written, *, read_back_s: float = READ_BACK_S) -> None:
        self._written = written
        self._read_back_s = read_back_s
        self._orders: dict[int, list[ServoOrder]] = {}

    def put(self, channel: int, pulse_us: int, *, now_s: float) -> None:
        """Put a pulse width on a pin."""
        order = ServoOrder(at_s=now_s, channel=channel, pulse_us=pulse_us)
        kept = self._orders.setdefault(channel, [])
        while len(kept) > 1 and kept[1].at_s <= now_s - self._read_back_s:
            kept.pop(0)
        kept.append(order)
        self._written(order)

    def now_us(self, channel: int) -> int | None:
        """Return what is on a pin; None before anything was."""
        orders = self._orders.get(channel)
        return orders[-1].pulse_us if orders else None

    def read_back_us(self, channel: int, now_s: float) -> int:
        """Return what reads back of a pin."""
        for order in reversed(self._orders.get(channel, [])):
            if order.at_s <= now_s - self._read_back_s:
                return order.pulse_us
        return 0


class ServoOutputs:
    """What was last ordered of each output, and what of it reaches the pins."""

    def __init__(self, parameters: Parameters, written: Written) -> None:
        self._parameters = parameters
        self._pins = PulseRegister(written)
        self._ordered: dict[int, int] = {}
        self._sticky: dict[int, int] = {}  # channel to the control's position when it was written
        self._state = OutputState()
        self._seen: tuple[int, OutputState] | None = None

    @property
    def count(self) -> int:
        """Return how many outputs there are."""
        return OUTPUT_COUNT_MAX if self._parameters["SERVO_32_ENABLE"] == 1.0 else OUTPUT_COUNT

    def is_free(self, channel: int) -> bool:
        """Return whether DO_SET_SERVO may write to the output."""
        return self._function(channel) in FREE_FUNCTIONS

    def write(self, channel: int, pulse_us: float, *, now_s: float) -> None:
        """Write a pulse width; unclamped but for the 16 bits of the register."""
        rc_us = self._rc_us(channel)
        if rc_us is not None:
            self._sticky[channel] = rc_us
        self._order(channel, int(pulse_us) & 0xFFFF, now_s)

    def reset(self, now_s: float) -> None:
        """Forget all orders, as a restart of the flight controller does: no pulses."""
        for channel in list(self._ordered):
            self._order(channel, 0, now_s)
        self._sticky.clear()
        self._seen = None

    def update(self, now_s: float, state: OutputState) -> None:
        """Follow the safety switch and the transmitter."""
        if self._seen == (self._parameters.revision, state):
            return
        self._seen = (self._parameters.revision, state)
        switched = state.safety_on != self._state.safety_on
        self._state = state
        if switched:
            for channel, pulse_us in self._ordered.items():
                self._show(channel, pulse_us, now_s)
        for channel in range(1, self.count + 1):
            rc_us = self._rc_us(channel)
            if rc_us is not None:
                self._follow(channel, rc_us, now_s)

    def pulses_us(self, now_s: float) -> tuple[int, ...]:
        """Return what SERVO_OUTPUT_RAW reads back; the motors read what they would."""
        motor_us = 0 if self._state.safety_on else 1500 if self._state.in_air else 1000
        return tuple(
            motor_us
            if self._function(channel) in range(33, 41)
            else self._pins.read_back_us(channel, now_s)
            for channel in range(1, self.count + 1)
        )

    def _function(self, channel: int) -> int:
        return int(self._parameters[f"SERVO{channel}_FUNCTION"])

    def _rc_us(self, channel: int) -> int | None:
        """Return the position of the control that an output follows."""
        function = self._function(channel)
        index = channel - 1 if function == _PASS_THROUGH else function - _RC_INPUTS.start
        follows = function == _PASS_THROUGH or function in _RC_INPUTS
        return self._state.rc_us[index] if follows and index < len(self._state.rc_us) else None

    def _follow(self, channel: int, rc_us: int, now_s: float) -> None:
        written_at_us = self._sticky.get(channel)
        if written_at_us is not None and abs(rc_us - written_at_us) < _DEAD_ZONE_US:
            return
        self._sticky.pop(channel, None)
        if self._ordered.get(channel) != rc_us:
            self._order(channel, rc_us, now_s)

    def _order(self, channel: int, pulse_us: int, now_s: float) -> None:
        self._ordered[channel] = pulse_us
        self._show(channel, pulse_us, now_s)

    def _show(self, channel: int, pulse_us: int, now_s: float) -> None:
        self._pins.put(channel, 0 if self._state.safety_on else pulse_us, now_s=now_s)


# The servo outputs with PX4's rules for MAV_CMD_DO_SET_ACTUATOR.
#
# One command sets all six actuators, -1 to 1; an output shows one of them if its function says so
# (PWM_MAIN_FUNCn = 301 to 306). An output is active only while armed, or with COM_PREARM_MODE 2;
# otherwise, and as long as its actuator was never set, it shows PWM_MAIN_DISn. What was ordered
# before arming is kept and shows at the moment of arming; it holds for ever (measured on a PX4 1.16
# SITL). NaN leaves an actuator alone from 1.14.2 on; before, it switched it to disarmed.

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
