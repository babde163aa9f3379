"""The sprayer behind the servo outputs: driver boards and the twin's plant, and its truth.

The liquid behind the stub: its faults by the clock, and the sensors that see them. The meter and
the tank are battery monitors of the autopilot, as ArduPilot's fuel flow meter is (BATT_MONITOR 11:
milliampere hours are millilitres, percent are of the tank). The pressure sensor is a folder of two
files as the kernel's driver of an ADS1115 shows them, for the companion on this computer.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from companion.errors import ConfigError
from sitl.drives import Motors
from sitl.liquid_faults import LiquidFault, LiquidFaultKind, LiquidSensors
from sitl.outputs import SERVO_FRAME_S, DriverBoard
from sitl.plants import edge_plant
from sitl.profile import FlowLaw, load_profile
from sitl.stub.faults import Strict, contradiction
from sitl.stub.outputs import ServoOrder

if TYPE_CHECKING:
    from sitl.plant import Plant

# `[[liquid]]` of a scenario: what goes wrong with the liquid, and from which moment on.

Moment = Literal["start", "take-off", "spraying"]
START: Moment = "start"
TAKE_OFF, SPRAYING = "take-off", "spraying"
# Which share may be given, and whether a valve, by kind.
_WITH_SHARE = (LiquidFaultKind.CLOG, LiquidFaultKind.LEAK, LiquidFaultKind.SUPPLY)
_WITH_VALVE = (LiquidFaultKind.STUCK_CLOSED, LiquidFaultKind.STUCK_OPEN)


class LiquidEntry(Strict):
    """One `[[liquid]]`: a fault from `at_s` after a moment on; `valve` counts from 1 at the left.

    Nothing of the liquid mends itself in flight, so there is no end.
    """

    kind: LiquidFaultKind = Field(strict=False)
    at_s: float = Field(default=0.0, ge=0.0, lt=1e9)
    since: Moment = START
    share: float = Field(default=0.0, ge=0.0, le=1.0)
    valve: int | None = Field(default=None, ge=1, description="1 is the leftmost")

    @model_validator(mode="after")
    def _means_something(self) -> Self:
        if self.kind in _WITH_SHARE and not self.share > 0.0:
            raise contradiction("share", "no share; give more than 0, up to 1")
        if self.kind not in _WITH_SHARE and self.share != 0.0:
            raise contradiction("share", f"means nothing to kind '{self.kind}'")
        if self.kind in _WITH_VALVE and self.valve is None:
            raise contradiction("valve", "missing; 1 is the leftmost")
        if self.valve is not None and self.kind not in (*_WITH_VALVE, LiquidFaultKind.CLOG):
            raise contradiction("valve", f"means nothing to kind '{self.kind}'")
        return self

    def fault(self, moment_s: float) -> LiquidFault:
        """Return the fault once the moment that it counts from has come."""
        valve = None if self.valve is None else self.valve - 1
        return LiquidFault(
            kind=self.kind, from_s=moment_s + self.at_s, share=self.share, valve=valve
        )


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


Floats = NDArray[np.float64]
_MEMORY_S = 1.0
# A command of 44 bytes over a telemetry port, less what the loopback takes itself.
_WIRE_S = 0.001
BoardKind = Literal["restarting", "free-running"]


@dataclass(frozen=True, slots=True, kw_only=True)
class SprayerOptions:
    """Which sprayer, and how it is wired: one servo channel a valve, left to right.

    `drive_channels` are the pump's, where it has an order of its own, and the atomisers'.
    `flow_law` says how the flow runs between measured points; None: as the profile.
    """

    profile: str = "wang-2024"
    board: BoardKind = "restarting"
    channels: tuple[int, ...] = (9, 10, 11, 12, 13, 14)
    closed_us: float = 1000.0
    full_us: float = 2000.0
    box_closed_s: float = 0.0  # how long a box wants to see the closed pulse first; 0: no such box
    liquid: LiquidOptions | None = None
    seed: int = 0
    drive_channels: tuple[int, ...] = ()
    flow_law: FlowLaw | None = None


class _Both:
    """The pump's orders to both plants of one sprayer."""

    def __init__(self, *plants: object) -> None:
        self._plants = plants

    def record_pump(self, at_s: float, pulse_us: float) -> None:
        """Take down that the pump is ordered so from `at_s` on."""
        for plant in self._plants:
            plant.record_pump(at_s, pulse_us)  # type: ignore[attr-defined]


class Sprayer:
    """Takes servo orders and gives cumulative volumes; keeps every order that it took."""

    def __init__(self, options: SprayerOptions, *, start_s: float) -> None:
        profile = load_profile(options.profile)
        if options.flow_law is not None:
            profile = replace(profile, flow_law=options.flow_law)
        if len(options.channels) != profile.valve_count:
            raise ConfigError(
                f"the configuration wires {len(options.channels)} valves, the sprayer "
                f"{options.profile} has {profile.valve_count}; choose another with --profile"
            )
        if len(options.drive_channels) != profile.drive_count:
            raise ConfigError(
                f"the configuration wires {len(options.drive_channels)} motors, the sprayer "
                f"{options.profile} has {profile.drive_count}; choose another with --profile"
            )
        if not options.closed_us < options.full_us:
            raise ConfigError("output.closed_us must be below output.full_us for this board")
        self.options = options
        self.orders: list[ServoOrder] = []
        self._box = ArmingBox(
            closed_s=options.box_closed_s,
            closed_us=options.closed_us,
            full_us=options.full_us,
        )
        self._valves = {channel: valve for valve, channel in enumerate(options.channels)}
        self._drives = {channel: number for number, channel in enumerate(options.drive_channels)}
        self._plant = edge_plant(profile, seed=options.seed, start_s=start_s)
        # The same sprayer once more, with a short memory: from a whole flight of 150 s the litres
        # of now took 4 to 8 ms (measured on two x86 cores), so 1 to 2; the wire waits meanwhile.
        self._recent = edge_plant(profile, seed=options.seed, start_s=start_s)
        self.motors = Motors(profile, _Both(self._plant, self._recent), start_s=start_s)
        self.liquid: Liquid | None = None
        if options.liquid is not None:
            self.liquid = Liquid(
                options.liquid,
                self._recent,
                also=(self._plant,),
                start_s=start_s,
                seed=options.seed,
            )
        self._is_opened = False
        self._board = DriverBoard(
            profile.pwm,
            profile.valve_count,
            seed=options.seed,
            start_s=start_s,
            kind=options.board,
            closed_us=options.closed_us,
            full_us=options.full_us,
            # As in the closed loop: only the restarting board is built for its valve.
            overrun_s=profile.overrun_s if options.board == "restarting" else 0.0,
        )

    def take(self, order: ServoOrder) -> None:
        """Take an order of the autopilot; those of other outputs are none of ours."""
        drive = self._drives.get(order.channel)
        if drive is not None:
            # No pulse is a stop to a speed controller, as one that is too short is.
            at_s = order.at_s + _WIRE_S + 0.5 * SERVO_FRAME_S
            self.motors.order(at_s, drive, order.pulse_us)
        valve = self._valves.get(order.channel)
        if valve is not None:
            self.orders.append(order)
            if not self._box.passes(order):
                return
            if not self._is_opened and order.pulse_us > self.options.closed_us:
                self._is_opened = True
                self.begins(SPRAYING, order.at_s)
            self._board.order(order.at_s + _WIRE_S, valve, order.pulse_us)

    def advance(self, until_s: float) -> None:
        """Work the valves out up to a time."""
        edges = self._board.advance(until_s)
        self._plant.record(edges)
        self._recent.record(edges)
        if self.liquid is not None:
            self.liquid.advance(until_s, self.volume_l)

    def batteries(self, now_s: float) -> list[Battery]:
        """Return the battery monitors as they are now, however long ago the last tick was."""
        if self.liquid is None:
            return []
        self.advance(now_s)
        return self.liquid.batteries()

    def begins(self, moment: str, at_s: float) -> None:
        """Take that a moment has come from which faults of the liquid count."""
        if self.liquid is not None:
            self.liquid.begins(moment, at_s)

    def volume_ml(self, times_s: Floats) -> Floats:
        """Return (n, valves): what each valve has delivered up to each time."""
        return self._plant.volume_ml(times_s)

    def volume_l(self, now_s: float) -> float:
        """Return what all valves have delivered; asked for in order of time."""
        self._recent.forget(now_s - _MEMORY_S)
        return float(self._recent.volume_ml(np.array([now_s])).sum()) / 1000.0


# A driver box that has to be armed, as speed controllers of motors do.
#
# It passes nothing on until it has seen the closed pulse for a while without a break; when the
# pulses end it has to be armed again. An order that opens before that makes it begin anew. Some
# boxes on the market are built that way; the board of this project is not.

_PULSE_MIN_US = 800.0
# Of the span: a width this near to closed is closed, as at the driver board.
_CLOSED_DUTY = 0.01


class ArmingBox:
    """One input a channel; says of each order whether it is passed on."""

    def __init__(self, *, closed_s: float, closed_us: float, full_us: float) -> None:
        self._closed_s = closed_s
        self._closed_max_us = closed_us + _CLOSED_DUTY * (full_us - closed_us)
        self._closed_since_s: dict[int, float] = {}
        self._armed: set[int] = set()

    def passes(self, order: ServoOrder) -> bool:
        """Take an order in and return whether it reaches the valve."""
        channel = order.channel
        if order.pulse_us < _PULSE_MIN_US:
            self._armed.discard(channel)
            self._closed_since_s.pop(channel, None)
            return True
        since_s = self._closed_since_s.get(channel)
        if since_s is not None and order.at_s - since_s >= self._closed_s:
            self._armed.add(channel)
        if order.pulse_us <= self._closed_max_us:
            self._closed_since_s.setdefault(channel, order.at_s)
            return True
        self._closed_since_s.pop(channel, None)
        return channel in self._armed or self._closed_s == 0.0
