"""Our messages to bytes, with one running sequence number."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.link.census import AUTOPILOT_COMPONENT

if TYPE_CHECKING:
    from companion.link.signing import Signing

_ONBOARD_CONTROLLER = 18
_AUTOPILOT_INVALID = 8
_TEXT_MAX = 50
_NAME_MAX = 10
# MAV_PROTOCOL_CAPABILITY: PARAM_FLOAT, COMMAND_INT, MAVLINK2.
_CAPABILITIES = 2 | 8 | 8192
REAL32 = 9  # MAV_PARAM_TYPE; integers are encoded differently by the two firmwares
_LINK_NUMBER = 0

# MAV_STATE
STATE_BOOT, STATE_STANDBY, STATE_ACTIVE, STATE_CRITICAL, STATE_EMERGENCY = 1, 3, 4, 5, 6


class Encoder:
    """Encodes as one component; `system_id` follows the vehicle's once that is known."""

    def __init__(
        self, *, system_id: int, component_id: int, signing: Signing | None = None
    ) -> None:
        self._mav = mavlink.MAVLink(None, srcSystem=system_id, srcComponent=component_id)
        self._signing = signing
        if signing is not None:
            self._mav.signing.secret_key = signing.key
            self._mav.signing.link_id = _LINK_NUMBER
            self._mav.signing.sign_outgoing = True

    @property
    def system_id(self) -> int:
        """Return the system that we speak as."""
        return int(self._mav.srcSystem)

    @system_id.setter
    def system_id(self, system_id: int) -> None:
        self._mav.srcSystem = system_id

    @property
    def component_id(self) -> int:
        """Return the component that we speak as."""
        return int(self._mav.srcComponent)

    def _pack(self, message: Any) -> bytes:
        if self._signing is not None:
            self._mav.signing.timestamp = self._signing.next_stamp()
        frame = bytes(message.pack(self._mav))
        self._mav.seq = (self._mav.seq + 1) % 256
        return frame

    def heartbeat(self, state: int) -> bytes:
        """Return a HEARTBEAT of an onboard controller that is no autopilot."""
        return self._pack(
            self._mav.heartbeat_encode(_ONBOARD_CONTROLLER, _AUTOPILOT_INVALID, 0, 0, state)
        )

    def command(self, command: int, *params: float) -> bytes:
        """Return a COMMAND_LONG to the vehicle's autopilot; what is not given is 0.

        0 and not NaN: ArduPilot denies SET_MESSAGE_INTERVAL with a NaN in parameter 3.
        """
        filled = (*params, *([0.0] * (7 - len(params))))
        return self._pack(
            self._mav.command_long_encode(self.system_id, AUTOPILOT_COMPONENT, command, 0, *filled)
        )

    def set_servo(self, channel: int, pulse_us: int) -> bytes:
        """Return MAV_CMD_DO_SET_SERVO."""
        return self.command(mavlink.MAV_CMD_DO_SET_SERVO, float(channel), float(pulse_us))

    def set_actuators(self, values: Sequence[float]) -> bytes:
        """Return MAV_CMD_DO_SET_ACTUATOR for the first set of six, -1 to 1 each.

        As COMMAND_LONG: in the form with integers PX4 takes the fifth and sixth wrongly scaled.
        """
        first_set = 0.0
        return self.command(mavlink.MAV_CMD_DO_SET_ACTUATOR, *values, first_set)

    def set_message_interval(self, message_id: int, rate_hz: float) -> bytes:
        """Return MAV_CMD_SET_MESSAGE_INTERVAL."""
        interval_us = round(1e6 / rate_hz)
        return self.command(
            mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, float(message_id), float(interval_us)
        )

    def request_data_stream(self, stream: int, rate_hz: float) -> bytes:
        """Return REQUEST_DATA_STREAM, the older way to ask, which ArduPilot still obeys."""
        return self._pack(
            self._mav.request_data_stream_encode(
                self.system_id, AUTOPILOT_COMPONENT, stream, max(1, round(rate_hz)), 1
            )
        )

    def ack(self, command: int, result: int, system_id: int, component_id: int) -> bytes:
        """Return the COMMAND_ACK for `system_id`, `component_id`."""
        return self._pack(
            self._mav.command_ack_encode(command, result, 0, 0, system_id, component_id)
        )

    def timesync(self, tc1_ns: int, ts1_ns: int) -> bytes:
        """Return a TIMESYNC."""
        return self._pack(self._mav.timesync_encode(tc1_ns, ts1_ns))

    def ping(self, time_us: int, sequence: int, system_id: int, component_id: int) -> bytes:
        """Return the answer to a PING."""
        return self._pack(self._mav.ping_encode(time_us, sequence, system_id, component_id))

    def text(self, severity: int, text: str) -> bytes:
        """Return a STATUSTEXT, cut to its 50 bytes."""
        return self._pack(
            self._mav.statustext_encode(severity, text.encode("ascii", "replace")[:_TEXT_MAX])
        )

    def named_value(self, name: str, value: float, now_s: float) -> bytes:
        """Return a NAMED_VALUE_FLOAT; ArduPilot writes it into its own log."""
        boot_ms = round(now_s * 1000.0) & 0xFFFFFFFF
        return self._pack(
            self._mav.named_value_float_encode(boot_ms, name.encode("ascii")[:_NAME_MAX], value)
        )

    def param_value(self, name: str, value: float, count: int, index: int) -> bytes:
        """Return PARAM_VALUE."""
        return self._pack(
            self._mav.param_value_encode(name.encode("ascii"), value, REAL32, count, index)
        )

    def param_request_read(self, name: str) -> bytes:
        """Return PARAM_REQUEST_READ for one parameter of the autopilot, by its name."""
        return self._pack(
            self._mav.param_request_read_encode(
                self.system_id, AUTOPILOT_COMPONENT, name.encode("ascii"), -1
            )
        )

    def mission_request_list(self) -> bytes:
        """Return MISSION_REQUEST_LIST: how many items has the autopilot's mission."""
        return self._pack(
            self._mav.mission_request_list_encode(self.system_id, AUTOPILOT_COMPONENT, 0)
        )

    def mission_request(self, sequence: int) -> bytes:
        """Return MISSION_REQUEST_INT for one item."""
        return self._pack(
            self._mav.mission_request_int_encode(self.system_id, AUTOPILOT_COMPONENT, sequence, 0)
        )

    def mission_ack(self, result: int) -> bytes:
        """Return the MISSION_ACK that ends a transfer."""
        return self._pack(
            self._mav.mission_ack_encode(self.system_id, AUTOPILOT_COMPONENT, result, 0)
        )

    def message_interval(self, message_id: int, interval_us: int) -> bytes:
        """Return MESSAGE_INTERVAL: -1 is switched off, 0 is never sent."""
        return self._pack(self._mav.message_interval_encode(message_id, interval_us))

    def autopilot_version(self, version: tuple[int, int, int]) -> bytes:
        """Return AUTOPILOT_VERSION with the program's version, release type official."""
        major, minor, patch = version
        packed = major << 24 | minor << 16 | patch << 8 | 255
        nothing = [0] * 8
        return self._pack(
            self._mav.autopilot_version_encode(
                _CAPABILITIES, packed, 0, 0, 0, nothing, nothing, nothing, 0, 0, 0
            )
        )
