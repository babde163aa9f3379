"""The vehicle's outputs as one link has them: orders out, answers, parameters and readings in."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

from companion.link import ardupilot, px4
from companion.link.census import Vehicle
from companion.link.encode import Encoder
from companion.link.messages import ParamValue, ServoOutput
from companion.link.parameter_reader import ParameterReader

ORDERS = frozenset({ardupilot.DO_SET_SERVO, px4.DO_SET_ACTUATOR})


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
        self._orders: ardupilot.ServoOrders | px4.ActuatorOrders | None = None
        self._reader = ParameterReader()
        self._is_px4 = False
        self._is_armed: bool | None = None
        self.listener: OutputListener | None = None

    def meet(self, vehicle: Vehicle) -> None:
        """Take the vehicle: at the start, after a reboot, and when the link has come back."""
        self._is_px4 = vehicle.is_px4
        if vehicle.is_px4:
            self._orders = px4.ActuatorOrders(self._encoder, self._send, **self._ends)
        else:
            self._orders = ardupilot.ServoOrders(self._encoder, self._send)
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
        meant = px4.parameter_value if self._is_px4 else ardupilot.parameter_value
        self._reader.take(found.name, meant(found.value, found.kind))

    def tick(self, now_s: float) -> None:
        """Ask for the next parameter; hand them on when all are there."""
        name = self._reader.next_name(now_s)
        if name is not None:
            self._send(self._encoder.param_request_read(name))
        known = self._reader.finished()
        if known is not None and self.listener is not None:
            self._reader.want(self.listener.learned(known))
