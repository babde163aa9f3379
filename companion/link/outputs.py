"""The vehicle's outputs as one link has them: orders out, answers, parameters and readings in."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

from companion.link.census import Vehicle
from companion.link.encode import Encoder
from companion.link.messages import ParamValue, ServoOutput

# What PX4 wants of an order and means by a parameter; ArduPilot's side is in `ardupilot.py`.

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


def px4_parameter_value(value: float, kind: int) -> float:
    """Return the value of a parameter: PX4 puts a whole number's bytes where the float would be.

    >>> px4_parameter_value(struct.unpack("<f", struct.pack("<i", 301))[0], 6)
    301.0
    """
    layout = _FORMATS.get(kind)
    if layout is None:
        return value
    (number,) = struct.unpack(f"<{layout}", struct.pack("<f", value))
    return float(number)


# What ArduPilot wants of an order and means by a parameter; PX4's side is in `px4.py`.

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


ORDERS = frozenset({DO_SET_SERVO, DO_SET_ACTUATOR})


class OutputListener(Protocol):
    """Who gives the orders and wants to know what becomes of them."""

    def met(self, is_px4: bool) -> Sequence[str]:
        """Take that the vehicle was met, also again; return the parameters to read of it."""

    def armed(self, is_armed: bool) -> None:
        """Take that the vehicle was armed or disarmed."""

    def learned(self, known: dict[str, float | None]) -> Sequence[str]:
        """Take parameters of the autopilot; return those to read besides."""

    def reported(self, port: int, pulse_us: Sequence[int], at_s: float) -> None:
        """Take what the outputs of a port read."""


class Outputs:
    """Orders by the rules of the vehicle's firmware; nothing leaves before it is known."""

    def __init__(
        self, encoder: Encoder, send: Callable[[bytes], bool], *, closed_us: int, full_us: int
    ) -> None:
        self._encoder = encoder
        self._send = send
        self._ends = {"closed_us": closed_us, "full_us": full_us}
        self._orders: ServoOrders | ActuatorOrders | None = None
        self._reader = ParameterReader()
        self._is_px4 = False
        self._is_armed: bool | None = None
        self.listener: OutputListener | None = None

    def meet(self, vehicle: Vehicle) -> None:
        """Take the vehicle: at the start, after a reboot, and when the link has come back."""
        self._is_px4 = vehicle.is_px4
        if vehicle.is_px4:
            self._orders = ActuatorOrders(self._encoder, self._send, **self._ends)
        else:
            self._orders = ServoOrders(self._encoder, self._send)
        self._reader.clear()
        if self.listener is not None:
            self._reader.want(self.listener.met(vehicle.is_px4))

    def order(self, channel: int, pulse_us: int) -> bool:
        """Order an output, at once or with `flush`; False where nobody is there to take it."""
        return self._orders is not None and self._orders.order(channel, pulse_us)

    def flush(self) -> bool:
        """Send what was gathered; False where it could not leave."""
        return self._orders is not None and self._orders.flush()

    def armed(self, is_armed: bool) -> None:
        """Take what the heartbeat says."""
        if is_armed != self._is_armed:
            self._is_armed = is_armed
            if self.listener is not None:
                self.listener.armed(is_armed)

    def report(self, report: ServoOutput) -> None:
        """Take what the outputs read."""
        if self.listener is not None:
            self.listener.reported(report.port, report.pulse_us, report.received_s)

    def parameter(self, found: ParamValue) -> None:
        """Take a parameter of the autopilot."""
        meant = px4_parameter_value if self._is_px4 else parameter_value
        self._reader.take(found.name, meant(found.value, found.kind))

    def tick(self, now_s: float) -> None:
        """Ask for the next parameter; hand them on when all are there."""
        name = self._reader.next_name(now_s)
        if name is not None:
            self._send(self._encoder.param_request_read(name))
        known = self._reader.finished()
        if known is not None and self.listener is not None:
            self._reader.want(self.listener.learned(known))


# Reads parameters of the autopilot one by one: paced, asked again, given up in the end.
#
# Pure but for what it remembers; time is an argument. Single reads and no list: a list slows all
# streams of ArduPilot down to a quarter while it runs.

_PAUSE_S = 0.04
_AGAIN_S = 0.7
# An unknown parameter gets no answer, so the number of questions decides.
_TRIES = 4


@dataclass(slots=True)
class _Asked:
    """A parameter that is not known yet."""

    tries: int = 0
    at_s: float = float("-inf")


class ParameterReader:
    """Says which parameter to ask for next, and gives all once the last has come or is given up."""

    def __init__(self) -> None:
        self._open: dict[str, _Asked] = {}
        self._known: dict[str, float | None] = {}
        self._asked_s = float("-inf")

    def want(self, names: Iterable[str]) -> None:
        """Begin to read parameters; what was being read before is read to its end."""
        for name in names:
            self._known.pop(name, None)
            self._open.setdefault(name, _Asked())

    def clear(self) -> None:
        """Forget everything."""
        self._open.clear()
        self._known.clear()

    def next_name(self, now_s: float) -> str | None:
        """Return the parameter to ask for now; None while none is due."""
        if now_s - self._asked_s < _PAUSE_S:
            return None
        for name, asked in list(self._open.items()):
            if now_s - asked.at_s < _AGAIN_S:
                continue
            if asked.tries >= _TRIES:
                del self._open[name]
                self._known[name] = None
                continue
            asked.tries += 1
            asked.at_s = self._asked_s = now_s
            return name
        return None

    def take(self, name: str, value: float) -> None:
        """Take the value of a parameter; those that nobody asked for are ignored."""
        if self._open.pop(name, None) is not None:
            self._known[name] = value

    def finished(self) -> dict[str, float | None] | None:
        """Return once what is known of all that was wanted; None where that did not answer."""
        if self._open or not self._known:
            return None
        known, self._known = self._known, {}
        return known
