"""The liquid behind the stub: its faults by the clock, and the sensors that see them.

The meter and the tank are battery monitors of the autopilot, as ArduPilot's fuel flow meter is
(BATT_MONITOR 11: milliampere hours are millilitres, percent are of the tank). The pressure sensor
is a folder of two files as the kernel's driver of an ADS1115 shows them, for the companion on this
computer.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from companion.errors import ConfigError
from sitl.liquid_faults import LiquidFault, LiquidSensors

if TYPE_CHECKING:
    from sitl.plant import Plant


from dataclasses import fields
from typing import Any

from sitl.liquid_faults import LiquidFaultKind

# `[[liquid]]` of a scenario: what goes wrong with the liquid, and from which moment on.

START, TAKE_OFF, SPRAYING = "start", "take-off", "spraying"
MOMENTS = (START, TAKE_OFF, SPRAYING)
# Which share may be given, and whether a valve, by kind.
_WITH_SHARE = (LiquidFaultKind.CLOG, LiquidFaultKind.LEAK, LiquidFaultKind.SUPPLY)
_WITH_VALVE = (LiquidFaultKind.STUCK_CLOSED, LiquidFaultKind.STUCK_OPEN)


@dataclass(frozen=True, slots=True, kw_only=True)
class LiquidEntry:
    """One `[[liquid]]`: a fault from `at_s` after a moment on; `valve` counts from 1 at the left.

    Nothing of the liquid mends itself in flight, so there is no end.
    """

    kind: LiquidFaultKind
    at_s: float = 0.0
    since: str = START
    share: float = 0.0
    valve: int | None = None

    def __post_init__(self) -> None:
        if not 0.0 <= self.at_s < 1e9:
            raise ValueError(f"at_s must be a time, got {self.at_s}")
        if self.since not in MOMENTS:
            raise ValueError(f"since must be one of {', '.join(MOMENTS)}, got {self.since!r}")
        if self.kind in _WITH_SHARE and not 0.0 < self.share <= 1.0:
            raise ValueError(f"share = {self.share}: give more than 0, up to 1")
        if self.kind not in _WITH_SHARE and self.share != 0.0:
            raise ValueError(f"share means nothing to kind '{self.kind}'")
        if self.kind in _WITH_VALVE and self.valve is None:
            raise ValueError("valve is missing: 1 is the leftmost")
        if self.valve is not None and self.kind not in (*_WITH_VALVE, LiquidFaultKind.CLOG):
            raise ValueError(f"valve means nothing to kind '{self.kind}'")
        if self.valve is not None and not self.valve >= 1:
            raise ValueError(f"valve = {self.valve}: 1 is the leftmost")

    def fault(self, moment_s: float) -> LiquidFault:
        """Return the fault once the moment that it counts from has come."""
        valve = None if self.valve is None else self.valve - 1
        return LiquidFault(
            kind=self.kind, from_s=moment_s + self.at_s, share=self.share, valve=valve
        )


def read_liquid(path: Path, table: dict[str, Any]) -> tuple[LiquidEntry, ...]:
    """Return the faults of the liquid of a scenario."""
    entries = table.get("liquid", [])
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise ConfigError(f"{path}: liquid: write it as [[liquid]], one table each")
    return tuple(_entry(path, number, entry) for number, entry in enumerate(entries))


def _entry(path: Path, number: int, entry: dict[str, Any]) -> LiquidEntry:
    where, names = f"{path}: liquid[{number}]", [field.name for field in fields(LiquidEntry)]
    unknown = sorted(set(entry) - set(names))
    if unknown:
        raise ConfigError(f"{where}.{unknown[0]}: unknown key; known: {', '.join(names)}")
    kinds = ", ".join(LiquidFaultKind)
    if entry.get("kind") not in list(LiquidFaultKind):
        raise ConfigError(f"{where}.kind = {entry.get('kind')!r}: known kinds: {kinds}")
    for name, wanted in (("at_s", (int, float)), ("share", (int, float)), ("valve", (int,))):
        value = entry.get(name, 0)
        if isinstance(value, bool) or not isinstance(value, wanted):
            raise ConfigError(f"{where}.{name} = {value!r}: give a number")
    try:
        return LiquidEntry(**{**entry, "kind": LiquidFaultKind(entry["kind"])})
    except ValueError as error:
        raise ConfigError(f"{where}: {error}") from error


# The converter: 125 uV a step; the transmitter: 4 mA at 0 and 20 mA at 1000 kPa through 100 ohm.
STEP_MV = 0.125
SPAN_KPA, SHUNT_OHM = 1000.0, 100.0
_PRESSURE_EVERY_S = 0.02
# To work the litres out takes a millisecond.
_LEVEL_EVERY_S = 0.5
RAW, SCALE = "in_voltage0_raw", "in_voltage_scale"


@dataclass(frozen=True, slots=True, kw_only=True)
class LiquidOptions:
    """Faults and sensors: battery monitors of meter and tank, folder of the pressure sensor."""

    entries: tuple[LiquidEntry, ...] = ()
    meter_battery: int | None = None
    tank_battery: int | None = None
    tank_l: float = 10.0
    pressure_folder: Path | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Battery:
    """What one battery monitor says; None where it does not know."""

    number: int
    consumed: int | None
    remaining_percent: int | None


FLIGHT_BATTERY = Battery(number=0, consumed=1200, remaining_percent=80)


class Liquid:
    """Lets the faults act on the plants, and tells what the sensors see."""

    def __init__(
        self,
        options: LiquidOptions,
        plant: Plant,
        *,
        also: Sequence[Plant],
        start_s: float,
        seed: int,
    ) -> None:
        count = plant.profile.valve_count
        for entry in options.entries:
            if entry.valve is not None and entry.valve > count:
                raise ConfigError(
                    f"liquid: valve = {entry.valve}: the sprayer {plant.profile.name} has {count}"
                )
        self._options = options
        # Read as it is asked for: whole millilitres come over the wire.
        self._sensors = LiquidSensors(
            plant, meter_rate_hz=1.0, start_s=start_s, also=also, seed=seed
        )
        self._waiting = list(options.entries)
        self.faults: list[LiquidFault] = []
        self._counted_ml = self._used_l = 0.0
        self._pressure_s = self._level_s = -math.inf
        if options.pressure_folder is not None:
            _begin_folder(options.pressure_folder)
        self.begins(START, start_s)

    def begins(self, moment: str, at_s: float) -> None:
        """Take that a moment has come; the faults that count from it are set."""
        for entry in [each for each in self._waiting if each.since == moment]:
            self._waiting.remove(entry)
            fault = entry.fault(at_s)
            self.faults.append(fault)
            self._sensors.add(fault)

    def begun(self, now_s: float) -> list[LiquidFault]:
        """Return the faults in force, in the order in which they began."""
        due = [fault for fault in self.faults if fault.from_s <= now_s]
        return sorted(due, key=lambda fault: fault.from_s)

    def advance(self, now_s: float, sprayed_l: Callable[[float], float]) -> None:
        """Let the faults act that are due, and read the sensors."""
        self._sensors.act(now_s)
        self._counted_ml = self._sensors.counted_ml(now_s)
        if self._options.tank_battery is not None and now_s - self._level_s >= _LEVEL_EVERY_S:
            self._level_s, self._used_l = now_s, sprayed_l(now_s)
        folder = self._options.pressure_folder
        if folder is not None and now_s - self._pressure_s >= _PRESSURE_EVERY_S:
            self._pressure_s = now_s
            _write(folder / RAW, str(round(volts_of(self._sensors.pressure_kpa()) / STEP_MV * 1e3)))

    def batteries(self) -> list[Battery]:
        """Return the battery monitors, the flight battery's first; none without sensors there."""
        options = self._options
        if options.meter_battery is None and options.tank_battery is None:
            return []
        found = [FLIGHT_BATTERY]
        if options.meter_battery is not None:
            found.append(
                Battery(
                    number=options.meter_battery,
                    consumed=math.floor(self._counted_ml),
                    remaining_percent=None,
                )
            )
        if options.tank_battery is not None:
            left = 1.0 - self._used_l / options.tank_l
            percent = round(100.0 * min(max(left, 0.0), 1.0))
            found.append(
                Battery(number=options.tank_battery, consumed=None, remaining_percent=percent)
            )
        return found


def words_of(fault: LiquidFault) -> str:
    """Return a fault in a few words, its valve counted from the left.

    >>> from sitl.liquid_faults import LiquidFaultKind
    >>> words_of(LiquidFault(kind=LiquidFaultKind.CLOG, from_s=0.0, share=0.3, valve=2))
    'clog of 30 %, valve 3'
    """
    share = f" of {100.0 * fault.share:.0f} %" if fault.share else ""
    valve = "" if fault.valve is None else f", valve {fault.valve + 1}"
    return f"{fault.kind}{share}{valve}"


def volts_of(kpa: float) -> float:
    """Return what the transmitter puts on the shunt.

    >>> volts_of(0.0), volts_of(1000.0)
    (0.4, 2.0)
    """
    share = min(max(kpa / SPAN_KPA, 0.0), 1.0)
    return SHUNT_OHM * (0.004 + 0.016 * share)


def _begin_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / SCALE).write_text(f"{STEP_MV}\n")
        _write(folder / RAW, "3200")
    except OSError as error:
        reason = error.strerror or str(error)
        raise ConfigError(f"--sensors {folder}: cannot be written ({reason})") from error


def _write(file: Path, text: str) -> None:
    """Write at once: a reader sees the old number or the new one, never half of it."""
    part = file.with_suffix(".part")
    part.write_text(f"{text}\n")
    part.replace(file)
