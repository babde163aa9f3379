"""The stub's parameters: a small table with ArduPilot's names, and the parameter protocol.

ArduPilot sends every value as a float by C cast, with the type beside it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from sitl.stub.protocol import Message, dialect

if TYPE_CHECKING:
    from sitl.stub.autopilot import Autopilot
    from sitl.stub.channel import Channel

_INT8 = dialect.MAV_PARAM_TYPE_INT8
_INT16 = dialect.MAV_PARAM_TYPE_INT16
_REAL32 = dialect.MAV_PARAM_TYPE_REAL32

OUTPUT_COUNT = 16
SPEED_MIN_M_S, SPEED_MAX_M_S = 0.1, 35.0
MOTOR_FUNCTIONS = (33, 34, 35, 36)

# AUTO_OPTIONS bit 0: may be armed in AUTO; bit 1: takes off without a raised throttle. A real
# ArduCopter has 0 here, and its AUTO waits for the pilot's throttle.
AUTO_ARMING = 1
AUTO_TAKE_OFF = 2


def _table() -> dict[str, tuple[float, int]]:
    """Return name to (value, type) as after a fresh start."""
    table: dict[str, tuple[float, int]] = {
        "SYSID_THISMAV": (1, _INT16),
        "AUTO_OPTIONS": (AUTO_ARMING | AUTO_TAKE_OFF, _INT16),
        "WPNAV_SPEED": (500, _REAL32),
        "LAND_SPEED": (50, _INT16),
        "PILOT_SPEED_UP": (250, _INT16),
        "SPRAY_ENABLE": (0, _INT8),
        "SERVO_RATE": (50, _INT16),
        "SERIAL2_BAUD": (921, _INT16),
        "RTL_ALT": (1500, _INT16),
    }
    for number in range(1, OUTPUT_COUNT + 1):
        motor = number <= len(MOTOR_FUNCTIONS)
        table[f"SERVO{number}_FUNCTION"] = (MOTOR_FUNCTIONS[number - 1] if motor else 0, _INT16)
        table[f"SERVO{number}_MIN"] = (1000, _INT16)
        table[f"SERVO{number}_MAX"] = (2000, _INT16)
    return table


class Parameters:
    """Names and values; unknown names are not there, as on a real vehicle."""

    def __init__(self) -> None:
        self._table = _table()
        self._names = list(self._table)

    def __getitem__(self, name: str) -> float:
        return self._table[name][0]

    def __contains__(self, name: str) -> bool:
        return name in self._table

    def __len__(self) -> int:
        return len(self._names)

    def speed_m_s(self, name: str) -> float:
        """Return a speed that the table holds in cm/s, kept to what can be flown."""
        value_m_s = self[name] / 100.0
        return min(max(value_m_s, SPEED_MIN_M_S), SPEED_MAX_M_S)

    def put(self, name: str, value: float) -> None:
        """Set a parameter that exists, cut to its type."""
        kind = self._table[name][1]
        self._table[name] = (value if kind == _REAL32 else float(int(value)), kind)

    def name_at(self, index: int) -> str | None:
        """Return the name with that index."""
        return self._names[index] if 0 <= index < len(self._names) else None

    def message(self, name: str) -> Message:
        """Return PARAM_VALUE for one parameter."""
        value, kind = self._table[name]
        index = self._names.index(name)
        return dialect.MAVLink_param_value_message(
            name.encode("ascii"), value, kind, len(self._names), index
        )


def handle_list(autopilot: Autopilot, channel: Channel, _message: Message, now_s: float) -> None:
    """Send the whole table; the other streams of that peer are slowed while it goes out."""
    channel.busy_until_s = now_s + 1.0
    for index in range(len(autopilot.parameters)):
        name = autopilot.parameters.name_at(index)
        if name is not None:
            autopilot.send(channel, autopilot.parameters.message(name))


def handle_read(autopilot: Autopilot, channel: Channel, message: Message, _now_s: float) -> None:
    """Send one parameter by index or name; an unknown one gets no answer."""
    name: str | None = message.param_id
    if message.param_index >= 0:
        name = autopilot.parameters.name_at(message.param_index)
    if name is not None and name in autopilot.parameters:
        autopilot.send(channel, autopilot.parameters.message(name))


def handle_set(autopilot: Autopilot, _channel: Channel, message: Message, _now_s: float) -> None:
    """Set one parameter and tell everybody its new value."""
    if message.param_id in autopilot.parameters and abs(message.param_value) < float("inf"):
        autopilot.parameters.put(message.param_id, message.param_value)
        autopilot.broadcast(autopilot.parameters.message(message.param_id))
