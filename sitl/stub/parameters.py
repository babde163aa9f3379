"""The stub's parameters: a small table with the firmware's names, and the parameter protocol.

ArduPilot sends every value as a float by C cast, with the type beside it. PX4 puts the four bytes
of a whole number where the float would be, and refuses a value of another type.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping

from sitl.stub.protocol import Message, dialect

INT8: int = dialect.MAV_PARAM_TYPE_INT8
INT16: int = dialect.MAV_PARAM_TYPE_INT16
INT32: int = dialect.MAV_PARAM_TYPE_INT32
REAL32: int = dialect.MAV_PARAM_TYPE_REAL32

Table = Mapping[str, tuple[float, int]]

OUTPUT_COUNT = 16
OUTPUT_COUNT_MAX = 32  # with SERVO_32_ENABLE
SPEED_MIN_M_S, SPEED_MAX_M_S = 0.1, 35.0
MOTOR_FUNCTIONS = (33, 34, 35, 36)

# AUTO_OPTIONS bit 0: may be armed in AUTO; bit 1: takes off without a raised throttle. A real
# ArduCopter has 0 here, and its AUTO waits for the pilot's throttle.
AUTO_ARMING = 1
AUTO_TAKE_OFF = 2


def ardupilot_table() -> dict[str, tuple[float, int]]:
    """Return name to (value, type) as after a fresh start of ArduCopter."""
    table: dict[str, tuple[float, int]] = {
        "SYSID_THISMAV": (1, INT16),
        "AUTO_OPTIONS": (AUTO_ARMING | AUTO_TAKE_OFF, INT16),
        "WPNAV_SPEED": (500, REAL32),
        "LAND_SPEED": (50, INT16),
        "PILOT_SPEED_UP": (250, INT16),
        "SPRAY_ENABLE": (0, INT8),
        "SERVO_RATE": (50, INT16),
        "SERIAL2_BAUD": (921, INT16),
        "RTL_ALT": (1500, INT16),
        "SCR_ENABLE": (0, INT8),
        "BRD_SAFETY_MASK": (0, INT32),
        "EK3_DRAG_BCOEF_X": (0, REAL32),
        "SERVO_32_ENABLE": (0, INT8),
        # What ArduCopter's own simulation says of itself (measured, 4.7-dev): the stub announces
        # in the same way that its sensors are simulated.
        "INS_ACC_ID": (2_753_028, INT32),
        "INS_GYR_ID": (2_752_772, INT32),
        "SIM_SPEEDUP": (1, REAL32),
    }
    for number in range(1, OUTPUT_COUNT_MAX + 1):
        motor = number <= len(MOTOR_FUNCTIONS)
        table[f"SERVO{number}_FUNCTION"] = (MOTOR_FUNCTIONS[number - 1] if motor else 0, INT16)
        table[f"SERVO{number}_MIN"] = (1000, INT16)
        table[f"SERVO{number}_MAX"] = (2000, INT16)
    return table


class Parameters:
    """Names and values; unknown names are not there, as on a real vehicle.

    `speeds` says which names hold the speeds of the flight, and how many of its unit are 1 m/s.
    """

    def __init__(
        self,
        table: Table | None = None,
        *,
        speeds: Mapping[str, tuple[str, float]] | None = None,
        bytewise: bool = False,
    ) -> None:
        self._table = dict(ardupilot_table() if table is None else table)
        self._names = list(self._table)
        self._speeds = speeds or {
            "cruise": ("WPNAV_SPEED", 100.0),
            "climb": ("PILOT_SPEED_UP", 100.0),
            "land": ("LAND_SPEED", 100.0),
        }
        self.bytewise = bytewise
        self.revision = 0  # counts every change

    def __getitem__(self, name: str) -> float:
        return self._table[name][0]

    def __contains__(self, name: str) -> bool:
        return name in self._table

    def __len__(self) -> int:
        return len(self._names)

    @property
    def auto_options(self) -> int:
        """Return what may be done in AUTO without the pilot; PX4 knows no such choice."""
        return int(self["AUTO_OPTIONS"]) if "AUTO_OPTIONS" in self else AUTO_ARMING | AUTO_TAKE_OFF

    def speed_m_s(self, role: str) -> float:
        """Return the speed of `cruise`, `climb` or `land`, kept to what can be flown."""
        name, per_m_s = self._speeds[role]
        return min(max(self[name] / per_m_s, SPEED_MIN_M_S), SPEED_MAX_M_S)

    def put_speed(self, role: str, speed_m_s: float) -> None:
        """Set one of the speeds."""
        name, per_m_s = self._speeds[role]
        self.put(name, speed_m_s * per_m_s)

    def put(self, name: str, value: float) -> None:
        """Set a parameter that exists, cut to its type."""
        kind = self._table[name][1]
        self.revision += 1
        self._table[name] = (value if kind == REAL32 else float(int(value)), kind)

    def name_at(self, index: int) -> str | None:
        """Return the name with that index."""
        return self._names[index] if 0 <= index < len(self._names) else None

    def kind(self, name: str) -> int:
        """Return the MAV_PARAM_TYPE of a parameter."""
        return self._table[name][1]

    def message(self, name: str) -> Message:
        """Return PARAM_VALUE for one parameter."""
        value, kind = self._table[name]
        if self.bytewise and kind != REAL32:
            value = struct.unpack("<f", struct.pack("<i", int(value)))[0]
        index = self._names.index(name)
        return dialect.MAVLink_param_value_message(
            name.encode("ascii"), value, kind, len(self._names), index
        )

    def decoded(self, name: str, message: Message) -> float | None:
        """Return the value that a PARAM_SET carries; None if it is of the wrong type."""
        value = float(message.param_value)
        if not self.bytewise or self.kind(name) == REAL32:
            right = not self.bytewise or message.param_type == REAL32
            return value if right and abs(value) < float("inf") else None
        if message.param_type != self.kind(name):
            return None
        return float(struct.unpack("<i", struct.pack("<f", value))[0])
