"""The tables of what measures the liquid, and of what is made of it: see sensors.md."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, FiniteFloat

from companion.config.tables import Duty, Table, Text

Points = Annotated[
    tuple[Annotated[FiniteFloat, Field(gt=0.0, le=10_000.0)], ...],
    Field(strict=False, max_length=100),
]


class FlowMeterTable(Table):
    """The flow meter before all valves."""

    source: Literal["none", "gpio", "autopilot"] = Field(
        default="none", description="gpio: pulses on a line of this computer; see sensors.md"
    )
    pulses_per_l: float | None = Field(
        default=None, gt=0, le=1_000_000, description="measured with a bucket; gpio only"
    )
    chip: Text = Field(default="gpiochip0", description="gpio only")
    line: int | None = Field(default=None, ge=0, le=1023, description="GPIO line of the pulses")
    pull: Literal["as-is", "up", "down"] = Field(
        default="up", description="resistor of the line; most meters have an open collector"
    )
    flow_max_l_min: float | None = Field(
        default=None,
        gt=0,
        le=10_000,
        description="more cannot be; else twice the largest flow of the nozzle sets",
    )
    battery: int = Field(
        default=1, ge=0, le=15, description="autopilot only: its battery monitor, counted from 0"
    )

    @property
    def is_read_here(self) -> bool:
        """Whether this computer reads it."""
        return self.source == "gpio"


class ConverterTable(Table):
    """A 4 to 20 mA transmitter on a channel of an ADS1115."""

    device: str = Field(
        default="", max_length=500, description="iio: driver's name or folder; else any ADS1115"
    )
    channel: int = Field(default=0, ge=0, le=3, description="of the converter")
    i2c_bus: int = Field(default=1, ge=0, le=99, description="i2c only")
    i2c_address: int = Field(default=0x48, ge=0x48, le=0x4B, description="i2c only: 72 to 75")
    shunt_ohm: float = Field(default=100.0, ge=1, le=1000, description="the current's resistor")


class PressureTable(ConverterTable):
    """Pressure before the valves."""

    source: Literal["none", "iio", "i2c"] = Field(
        default="none", description="iio: the kernel's driver; i2c: the bus, by smbus2"
    )
    at_4_ma_kpa: FiniteFloat = Field(default=0.0, ge=-100, le=10_000, description="transmitter")
    at_20_ma_kpa: FiniteFloat = Field(default=1000.0, ge=0, le=10_000, description="transmitter")
    rate_hz: float = Field(default=40.0, ge=4, le=200, description="samples a second")
    duty: Annotated[tuple[Duty, ...], Field(strict=False, max_length=100)] = Field(
        default=(), description="measured points of the healthy sprayer, increasing"
    )
    kpa: Points = Field(default=(), description="pressure at these duties")

    @property
    def is_read_here(self) -> bool:
        """Whether this computer reads it."""
        return self.source != "none"


class TankTable(ConverterTable):
    """What is left in the tank."""

    source: Literal["none", "flow", "iio", "i2c", "autopilot"] = Field(
        default="none", description="flow: counted down by the meter; else a level beside it"
    )
    capacity_l: float | None = Field(
        default=None, gt=0, le=10_000, description="full tank; else mission.tank_l"
    )
    filled_l: float | None = Field(
        default=None, ge=0, le=10_000, description="in the tank when `run` starts"
    )
    battery: int = Field(
        default=2, ge=0, le=15, description="autopilot only: its battery monitor, counted from 0"
    )
    reserve_l: float = Field(default=0.5, ge=0, le=1000, description="at it the valves close")
    at_4_ma_l: FiniteFloat = Field(default=0.0, ge=-100, le=10_000, description="level")
    at_20_ma_l: FiniteFloat = Field(default=40.0, ge=0, le=10_000, description="level")
    tolerance_l: float = Field(
        default=2.0, gt=0, le=1000, description="between level and count; more is a fault"
    )

    @property
    def is_read_here(self) -> bool:
        """Whether this computer works it out, by a level or from its flow meter."""
        return self.source not in ("none", "autopilot")


class DetectionTable(Table):
    """Faults of the liquid, from flow, pressure and tank."""

    enabled: bool = Field(default=False, description="true: needs a flow meter")
    spread: float = Field(
        default=0.0125,
        ge=0.002,
        le=0.05,
        description="one standard deviation of metered over expected flow, as calibrated",
    )
    closed_share: float = Field(
        default=0.02,
        ge=0.005,
        le=0.5,
        description="of the full flow; more with all valves closed is a leak",
    )
    closed_check: bool = Field(
        default=True, description="false: the meter also counts what returns to the tank"
    )
    meter_required: bool = Field(
        default=False, description="true: no spraying while the meter is at fault"
    )
