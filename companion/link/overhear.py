"""What somebody who only listens learns of a companion: its values, texts and heartbeats."""

from __future__ import annotations

from collections import deque
from typing import Any

from companion.core.types import SprayerState
from companion.link.census import AUTOPILOT_COMPONENT, mode_name
from companion.link.codec import Framer

# An error that was told is shown for so long; nobody tells that it is over.
FAULT_S = 60.0
# Reasons come in two lines at most, one right after the other.
_SAME_S = 0.5
_OFF, _SAID, _ERROR = "Spray off: ", "Spray: ", 3
_FAULTS_MAX = 4
_VALUES_MAX = 32
# A value that has not come again for so long is not known any more; they come at 0.2 Hz at least.
OLD_S = 12.0


class Overheard:
    """Takes bytes of a link, and keeps what a companion on it says of itself."""

    def __init__(self) -> None:
        self._framer = Framer()
        self._values: dict[str, tuple[float, float]] = {}
        self._why: tuple[str, float] = ("", float("-inf"))
        self._faults: deque[tuple[str, float]] = deque(maxlen=_FAULTS_MAX)
        self.companion: tuple[int, int] | None = None
        self.heard_s: float | None = None
        self.heartbeat_s: float | None = None
        self.vehicle_s: float | None = None
        self.position_s: float | None = None
        self.height_m: float | None = None
        self.speed_m_s: float | None = None
        self.mode = ""
        self.armed = False

    def take(self, data: bytes, now_s: float) -> None:
        """Take bytes in; what is no message is dropped."""
        for message in self._framer.push(data, now_s):
            self._take(message, message.get_type(), now_s)

    def _take(self, message: Any, kind: str, now_s: float) -> None:
        sender = (message.get_srcSystem(), message.get_srcComponent())
        if kind == "NAMED_VALUE_FLOAT" and message.name.startswith("SPR_"):
            self.companion = self.companion or sender
        if sender == self.companion:
            self._take_companion(message, kind, now_s)
        elif sender[1] == AUTOPILOT_COMPONENT and (
            self.companion is None or sender[0] == self.companion[0]
        ):
            self._take_vehicle(message, kind, now_s)

    def _take_companion(self, message: Any, kind: str, now_s: float) -> None:
        self.heard_s = now_s
        if kind == "HEARTBEAT":
            self.heartbeat_s = now_s
        elif kind == "NAMED_VALUE_FLOAT":
            if message.name in self._values or len(self._values) < _VALUES_MAX:
                self._values[message.name] = (float(message.value), now_s)
        elif kind == "STATUSTEXT":
            self._take_text(message.text, message.severity, now_s)

    def _take_text(self, text: str, severity: int, now_s: float) -> None:
        said, said_s = self._why
        if text.startswith(_OFF):
            more = text.removeprefix(_OFF)
            self._why = (f"{said}, {more}" if now_s - said_s < _SAME_S else more, now_s)
        elif text == f"{_SAID}ready":
            self._why = ("", now_s)
        elif severity <= _ERROR:
            self._faults.append((text.removeprefix(_SAID), now_s))

    def _take_vehicle(self, message: Any, kind: str, now_s: float) -> None:
        if kind == "HEARTBEAT":
            self.vehicle_s = now_s
            self.mode = mode_name(message.autopilot, message.type, message.custom_mode)
            self.armed = bool(message.base_mode & 128)
        elif kind == "GLOBAL_POSITION_INT":
            self.position_s = now_s
            self.height_m = message.relative_alt / 1000.0
            self.speed_m_s = float((message.vx**2 + message.vy**2) ** 0.5 / 100.0)

    def value(self, name: str, now_s: float, *, old_s: float = OLD_S) -> float | None:
        """Return a value by its name on the wire; None where it has not been told of late."""
        value, told_s = self._values.get(name, (0.0, float("-inf")))
        return value if now_s - told_s <= old_s else None

    def state(self, now_s: float) -> SprayerState | None:
        """Return what the sprayer may do, as it says itself."""
        number, states = self.value("SPR_STATE", now_s), list(SprayerState)
        if number is None or not 0 <= number < len(states):
            return None
        return states[int(number)]

    @property
    def why(self) -> str:
        """Return why nothing was sprayed when that was told last."""
        return self._why[0]

    def faults(self, now_s: float) -> list[str]:
        """Return the errors that were told within the last minute."""
        return list(
            dict.fromkeys(text for text, told_s in self._faults if now_s - told_s <= FAULT_S)
        )
