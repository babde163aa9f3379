"""What ArduPilot wants of an order and means by a parameter; PX4's side is in `px4.py`."""

from __future__ import annotations

from collections.abc import Callable

from companion.link.encode import Encoder

DO_SET_SERVO = 183


class ServoOrders:
    """One DO_SET_SERVO an output, sent at once; the pulse goes out as ordered, unclamped."""

    def __init__(self, encoder: Encoder, send: Callable[[bytes], bool]) -> None:
        self._encoder = encoder
        self._send = send

    def order(self, channel: int, pulse_us: int) -> bool:
        """Order one output; False where the order could not leave."""
        return self._send(self._encoder.set_servo(channel, pulse_us))

    def flush(self) -> bool:
        """Return that nothing waits to be sent."""
        return True


def parameter_value(value: float, _kind: int) -> float:
    """Return the value of a parameter: ArduPilot casts every type to a float."""
    return value
