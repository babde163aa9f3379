"""What PX4 wants of an order and means by a parameter; ArduPilot's side is in `ardupilot.py`."""

from __future__ import annotations

import struct
from collections.abc import Callable

from companion.link.encode import Encoder

DO_SET_ACTUATOR = 187
ACTUATOR_COUNT = 6
# MAV_PARAM_TYPE: unsigned and signed whole numbers of 8, 16 and 32 bits.
_FORMATS = {1: "B3x", 2: "b3x", 3: "H2x", 4: "h2x", 5: "I", 6: "i"}


class ActuatorOrders:
    """One DO_SET_ACTUATOR for all six; orders are gathered and leave together.

    Every value is always known: before 1.14.2 a NaN switched an actuator to its disarmed value, and
    0 is the middle of the way. An actuator without a valve has the closed value.
    """

    def __init__(
        self, encoder: Encoder, send: Callable[[bytes], bool], *, closed_us: int, full_us: int
    ) -> None:
        self._encoder = encoder
        self._send = send
        self._low_us, self._high_us = sorted((closed_us, full_us))
        self._values = [self.value(closed_us)] * ACTUATOR_COUNT
        self._is_staged = False

    def value(self, pulse_us: int) -> float:
        """Return the order for a pulse: PX4 maps -1 to 1 onto PWM_*_MINn to PWM_*_MAXn."""
        share = (pulse_us - self._low_us) / (self._high_us - self._low_us)
        return min(max(2.0 * share - 1.0, -1.0), 1.0)

    def order(self, channel: int, pulse_us: int) -> bool:
        """Take the order of an actuator, 1 to 6; False for any other."""
        if not 1 <= channel <= ACTUATOR_COUNT:
            return False
        self._values[channel - 1] = self.value(pulse_us)
        self._is_staged = True
        return True

    def flush(self) -> bool:
        """Send what was gathered, if anything was; False where it could not leave."""
        if not self._is_staged:
            return True
        self._is_staged = False
        return self._send(self._encoder.set_actuators(self._values))


def parameter_value(value: float, kind: int) -> float:
    """Return the value of a parameter: PX4 puts a whole number's bytes where the float would be.

    >>> parameter_value(struct.unpack("<f", struct.pack("<i", 301))[0], 6)
    301.0
    """
    layout = _FORMATS.get(kind)
    if layout is None:
        return value
    (number,) = struct.unpack(f"<{layout}", struct.pack("<f", value))
    return float(number)
