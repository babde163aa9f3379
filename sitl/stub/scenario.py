"""A scenario file: the faults by the clock, and how the vehicle is from the start.

Every table and key is known; what is not is refused, so that a slip of the pen is no silent
success of a test.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from companion.errors import ConfigError
from sitl.airframes import EstimatorNoise
from sitl.stub.faults import Fault, FaultKind, read_faults, read_table
from sitl.stub.firmware import Version
from sitl.stub.sprayer import LiquidEntry, read_liquid

_KNOWN: dict[str, tuple[str, ...]] = {
    "firmware": ("version", "commands_per_s"),
    "position": tuple(one.name for one in fields(EstimatorNoise)),
    "clock": ("drift_ppm", "uptime_s"),
    "wind": ("speed_m_s", "from_deg"),
    "box": ("closed_s",),
    "signing": ("key",),
    "sensors": ("meter_battery", "tank_battery", "tank_l"),
}
_LIMITS: dict[str, tuple[float, float]] = {
    "commands_per_s": (1.0, 1000.0),
    "drift_ppm": (-30_000.0, 30_000.0),
    "uptime_s": (0.0, 1e8),
    "speed_m_s": (0.0, 30.0),
    "from_deg": (0.0, 360.0),
    "closed_s": (0.0, 60.0),
    "meter_battery": (0.0, 15.0),
    "tank_battery": (0.0, 15.0),
    "tank_l": (0.1, 1000.0),
    "lag_s": (0.0, 2.0),
    "wire_s": (0.0, 2.0),
    "white_m": (0.0, 10.0),
    "drift_m": (0.0, 10.0),
    "drift_time_s": (1.0, 10_000.0),
    "velocity_m_s": (0.0, 10.0),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Scenario:
    """What a scenario file says; what it leaves out is as the firmware is.

    `source` names the file in messages.
    """

    source: str = field(default="scenario", compare=False)
    faults: tuple[Fault, ...] = ()
    version: Version | None = None
    commands_per_s: float | None = None
    parameters: Mapping[str, float] = field(default_factory=dict)
    position: Mapping[str, float] = field(default_factory=dict)
    drift_ppm: float = 0.0
    uptime_s: float = 0.0
    wind_towards_m_s: tuple[float, float] = (0.0, 0.0)
    box_closed_s: float = 0.0
    signing_key: bytes | None = None
    liquid: tuple[LiquidEntry, ...] = ()
    meter_battery: int | None = None
    tank_battery: int | None = None
    tank_l: float = 10.0


def load_scenario(path: Path) -> Scenario:
    """Return what a scenario file says."""
    check_scenario(path)
    table = read_table(path)
    known = ("fault", "parameters", *_KNOWN, "liquid")
    for name, entry in table.items():
        if name not in known:
            raise ConfigError(f"{path}: {name}: unknown; known: {', '.join(known)}")
        if name not in ("fault", "liquid") and not isinstance(entry, dict):
            raise ConfigError(f"{path}: {name}: write it as [{name}]")
        for key in entry if name in _KNOWN else ():
            if key not in _KNOWN[name]:
                raise ConfigError(
                    f"{path}: {name}.{key}: unknown key; known: {', '.join(_KNOWN[name])}"
                )
    reader = _Reader(path, table)
    firmware, wind = table.get("firmware", {}), table.get("wind", {})
    return Scenario(
        source=str(path),
        faults=read_faults(path, table),
        version=reader.version() if "version" in firmware else None,
        commands_per_s=(
            reader.number("firmware", "commands_per_s", 0.0)
            if "commands_per_s" in firmware
            else None
        ),
        parameters=reader.numbers("parameters"),
        position={key: reader.number("position", key, 0.0) for key in table.get("position", {})},
        drift_ppm=reader.number("clock", "drift_ppm", 0.0),
        uptime_s=reader.number("clock", "uptime_s", 0.0),
        wind_towards_m_s=reader.wind() if wind else (0.0, 0.0),
        box_closed_s=reader.number("box", "closed_s", 0.0),
        signing_key=reader.key() if "signing" in table else None,
        liquid=read_liquid(path, table),
        meter_battery=reader.battery("meter_battery"),
        tank_battery=reader.battery("tank_battery"),
        tank_l=reader.number("sensors", "tank_l", 10.0),
    )


def check_scenario(path: Path) -> None:
    """Refuse a file that is not there, and a fault of no known kind, saying what to give."""
    if not path.exists():
        raise ConfigError(f"--scenario {path}: no such file")
    entries = read_table(path).get("fault")
    kinds = tuple(kind.value for kind in FaultKind)
    for number, entry in enumerate(entries if isinstance(entries, list) else ()):
        if not isinstance(entry, dict) or entry.get("kind") in kinds:
            continue
        wrong = f"kind = {entry['kind']!r}: unknown" if "kind" in entry else "kind: missing"
        raise ConfigError(f"{path}: fault[{number}].{wrong}; known kinds: {', '.join(kinds)}")


class _Reader:
    """Takes values out of a scenario, with messages that name file, key and value."""

    def __init__(self, path: Path, table: dict[str, Any]) -> None:
        self._path = path
        self._table = table

    def number(self, name: str, key: str, default: float) -> float:
        """Return one number inside its limits."""
        value = self._checked(name, key, self._table.get(name, {}).get(key, default))
        low, high = _LIMITS[key]
        if not low <= value <= high:
            raise ConfigError(f"{self._path}: {name}.{key} = {value:g}: give {low:g} to {high:g}")
        return value

    def numbers(self, name: str) -> dict[str, float]:
        """Return a table of numbers, whatever their names are."""
        entries = self._table.get(name, {})
        return {key: self._checked(name, key, value) for key, value in entries.items()}

    def battery(self, key: str) -> int | None:
        """Return the number of a battery monitor, counted from 0; None where there is none."""
        if key not in self._table.get("sensors", {}):
            return None
        value = self.number("sensors", key, 0.0)
        if value != int(value):
            raise ConfigError(f"{self._path}: sensors.{key} = {value:g}: give a whole number")
        return int(value)

    def version(self) -> Version:
        """Return the firmware's version."""
        value = self._table["firmware"]["version"]
        parts = value.split(".") if isinstance(value, str) else []
        if len(parts) != 3 or not all(part.isdigit() and int(part) < 256 for part in parts):
            raise ConfigError(f'{self._path}: firmware.version = {value!r}: write it as "1.16.0"')
        return int(parts[0]), int(parts[1]), int(parts[2])

    def wind(self) -> tuple[float, float]:
        """Return where the wind blows to, east and north."""
        speed_m_s = self.number("wind", "speed_m_s", 0.0)
        from_rad = math.radians(self.number("wind", "from_deg", 0.0))
        return -speed_m_s * math.sin(from_rad), -speed_m_s * math.cos(from_rad)

    def key(self) -> bytes:
        """Return the key of a signed link."""
        value = self._table["signing"].get("key")
        try:
            key = bytes.fromhex(value) if isinstance(value, str) else b""
        except ValueError:
            key = b""
        if len(key) != 32:
            raise ConfigError(f"{self._path}: signing.key: give 64 hexadecimal digits")
        return key

    def _checked(self, name: str, key: str, value: object) -> float:
        right = isinstance(value, int | float) and not isinstance(value, bool)
        if not right or not math.isfinite(float(value)):  # type: ignore[arg-type]
            raise ConfigError(f"{self._path}: {name}.{key} = {value!r}: give a number")
        return float(value)  # type: ignore[arg-type]
