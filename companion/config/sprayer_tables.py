"""The tables of the sprayer: boom and valves, what they deliver, how late, and by which way.

What measures the liquid belongs to it, and what is made of its figures.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Annotated, Literal

from pydantic import Field, FiniteFloat

from companion.config.tables import Duty, Table, Text, Width
from companion.core.nozzle import FLOW_LAWS

Lag = Annotated[FiniteFloat, Field(ge=0.0, le=30.0)]
Offset = Annotated[FiniteFloat, Field(ge=-50.0, le=50.0)]
Day = Annotated[str, Field(pattern=r"^\d{4}-(0[1-9]|1[0-2])-(0[1-9]|[12]\d|3[01])$")]
OwnLag = Annotated[FiniteFloat, Field(ge=-0.1, le=0.1)]


class BoomTable(Table):
    """The boom."""

    width_m: Width = Field(description="measured: effective width of every flow law")
    height_m: float = Field(default=3.5, ge=0.1, le=100, description="above the crop when spraying")
    forward_m: Offset = Field(
        default=0.0, description="of the boom, ahead of the autopilot's position reference"
    )


class ValveTable(Table):
    """One valve; the tables run from left to right."""

    name: Text = Field(description="as nozzle_set.valves calls it")
    right_m: Offset = Field(
        description="measured: centre of its strip, right of the position reference; left is < 0"
    )
    channel: int | None = Field(
        default=None, ge=0, le=1023, description="servo output 1 to 32, or GPIO line"
    )
    nozzles: int | None = Field(
        default=None,
        ge=1,
        le=1000,
        description="how many it feeds; information, but with nozzle_set.preset",
    )
    width_m: Width | None = Field(
        default=None,
        description="of its strip; else boom.width_m over the valves of the largest set",
    )
    forward_m: Offset | None = Field(default=None, description="instead of boom.forward_m")
    flow_factor: Annotated[FiniteFloat, Field(ge=0.5, le=1.5)] = Field(
        default=1.0,
        description="measured: its flow over that of the mean valve, at the same duty",
    )
    lag_on_s: OwnLag = Field(default=0.0, description="measured: how much later than lag.on_s")
    lag_off_s: OwnLag = Field(default=0.0, description="measured: how much later than lag.off_s")
    lag_up_s: OwnLag = Field(default=0.0, description="measured: how much later than lag.up_s")
    lag_down_s: OwnLag = Field(default=0.0, description="measured: how much later than lag.down_s")
    measured_on: Day | None = Field(
        default=None, description="day on which factor and lags were measured, YYYY-MM-DD"
    )
    measured_with: Literal["water", "product"] | None = Field(
        default=None, description="what was sprayed then"
    )

    @property
    def has_own_figures(self) -> bool:
        """Whether anything was measured of this valve by itself."""
        lags_s = (self.lag_on_s, self.lag_off_s, self.lag_up_s, self.lag_down_s)
        return self.flow_factor != 1.0 or any(lags_s)


class PwmTable(Table):
    """What the valves and their drivers can follow."""

    frequency_hz: float = Field(default=11.0, ge=0.1, le=1000, description="of the pulses")
    duty_min: Duty = Field(default=0.2, description="smallest duty that gives an even flow")
    duty_max: Duty = Field(default=0.9, description="largest duty below fully open")
    min_on_s: float = Field(default=0.010, ge=0, le=10, description="shortest pulse that opens")
    min_off_s: float = Field(default=0.010, ge=0, le=10, description="shortest gap that closes")
    valve: Literal["normally-closed", "normally-open"] = Field(
        default="normally-closed", description="normally-open needs safety.pump_cutoff = true"
    )


class NozzleSetTable(Table):
    """Valves that spray together, and what they deliver: measured, or a published law."""

    valves: Annotated[tuple[Text, ...], Field(strict=False, min_length=1, max_length=1000)] = Field(
        description="names of the valves"
    )
    duty: Annotated[tuple[Duty, ...], Field(strict=False, min_length=2, max_length=1000)] = Field(
        default=(), description="measured points, increasing; none with a pump that makes the flow"
    )
    flow_l_min: Annotated[
        tuple[Annotated[FiniteFloat, Field(ge=0, le=10_000)], ...],
        Field(strict=False, min_length=2, max_length=1000),
    ] = Field(default=(), description="flow of the whole set at these duties, increasing")
    weighed_duty: Annotated[tuple[Duty, ...], Field(strict=False, max_length=1000)] = Field(
        default=(),
        description="which of these were weighed, where `calibrate curve` added others; none: all",
    )
    preset: Literal["wang-2024-eq2"] | None = Field(
        default=None,
        description="a published law instead of measured points; needs `valve.nozzles`",
    )

    def nozzles(self, valves: Sequence[ValveTable]) -> int | None:
        """Return how many nozzles the set has; None where a valve does not say."""
        counts = [valve.nozzles for valve in valves if valve.name in self.valves]
        known = [count for count in counts if count is not None]
        return sum(known) if len(known) == len(counts) else None

    def points(self, valves: Sequence[ValveTable]) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return duties and flows, as written or the preset's; empty where there are none."""
        if self.preset is None:
            return self.duty, self.flow_l_min
        count = self.nozzles(valves)
        for law in FLOW_LAWS[self.preset]:
            if law.nozzles == count:
                return law.curve.duty, law.curve.flow_l_min
        return (), ()

    def weighed(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return the duties and flows that a bucket test found: only these carry the dose."""
        if not self.weighed_duty:
            return self.duty, self.flow_l_min
        kept = [
            (duty, flow)
            for duty, flow in zip(self.duty, self.flow_l_min, strict=True)
            if duty in self.weighed_duty
        ]
        return tuple(duty for duty, _ in kept), tuple(flow for _, flow in kept)


class LagTable(Table):
    """How late the spray is; measured (`vrspray calibrate`)."""

    method: Literal["scheduled", "look-ahead", "none"] = Field(
        default="scheduled", description="how changes are placed"
    )
    look_ahead_s: Annotated[
        tuple[Annotated[FiniteFloat, Field(ge=0.0, le=10.0)], ...],
        Field(strict=False, min_length=1, max_length=3),
    ] = Field(
        default=(0.10, 0.42, 0.45), description="T1, T2, T3 of Wang et al. 2024; look-ahead only"
    )
    on_s: Lag = Field(description="measured: order to volume-equivalent step, closed to open")
    off_s: Lag = Field(description="measured: the same, open to closed")
    up_s: Lag = Field(description="measured: the same, to a larger flow")
    down_s: Lag = Field(description="measured: the same, to a smaller flow")
    on_start_s: Lag = Field(description="measured: order to first flow at full duty; at most on_s")
    off_end_s: Lag = Field(description="measured: order to less than 2 % of flow; at least off_s")
    output_s: Lag = Field(description="measured: order to the pulse, the output path's delay")
    position_s: float = Field(
        default=0.0,
        ge=-0.5,
        le=0.5,
        description="how old the position is when the autopilot sends it",
    )
    reference: Literal["volume", "settled"] = Field(
        default="volume",
        description="what lies on the boundary: volume-equivalent step or settled end",
    )
    up_time_s: Lag = Field(
        default=0.0,
        description="of a slow flow (a pump's): its time constant, a part of up_s; 0: not driven",
    )
    down_time_s: Lag = Field(default=0.0, description="the same, a part of down_s")
    measured_on: Day | None = Field(
        default=None,
        description="day on which flows and lags were measured, YYYY-MM-DD; `doctor` tells its age",
    )


# Factors are ratios: a mean farther from 1 would move the dose.
FACTOR_MEAN_TOLERANCE = 0.005


def own_figures(
    valves: Sequence[ValveTable], lag: LagTable, sets: Sequence[NozzleSetTable]
) -> Iterator[tuple[str, str]]:
    """Yield (key, what is wrong) of what was measured of single valves, or weighed of a set."""
    for number, table in enumerate(sets):
        strange = [duty for duty in table.weighed_duty if duty not in table.duty]
        if strange or len(table.weighed_duty) == 1:
            what = f"{strange[0]:g} is not in nozzle_set[{number}].duty" if strange else "one duty"
            yield (
                f"nozzle_set[{number}].weighed_duty",
                f"{what}; name the duties of the bucket test, two at least, or remove the key",
            )
    factors = [valve.flow_factor for valve in valves]
    mean = sum(factors) / len(factors)
    if not abs(mean - 1.0) <= FACTOR_MEAN_TOLERANCE:
        yield (
            "valve[0].flow_factor",
            f"the factors of all valves have the mean {mean:.4g} and not 1; divide each by it",
        )
    for number, valve in enumerate(valves):
        for kind in ("on", "off", "up", "down"):
            own_s, set_s = getattr(valve, f"lag_{kind}_s"), getattr(lag, f"{kind}_s")
            if own_s < 0.0 and not own_s + set_s >= 0.0:
                yield (
                    f"valve[{number}].lag_{kind}_s",
                    f"{own_s:g} with lag.{kind}_s = {set_s:g} is before the order; it is how much "
                    "later than the mean valve this one is, in seconds",
                )


class OutputTable(Table):
    """How the orders reach the valves."""

    kind: Literal["servo", "gpio", "none"] = Field(default="servo", description="none: a dry run")
    closed_us: int = Field(default=1000, ge=500, le=2500, description="servo pulse of duty 0")
    full_us: int = Field(default=2000, ge=500, le=2500, description="servo pulse of duty 1")
    dither_us: int = Field(
        default=0,
        ge=0,
        le=50,
        description="alive dither of open valves, for a driver board that closes without it: 8",
    )
    guard: Literal["auto", "none-on-power-loss"] = Field(
        default="auto",
        description="what closes servo outputs when the whole computer fails; auto: the watchdog "
        "script, or a driver board by dither_us, else nothing is sprayed",
    )
    lease_s: float = Field(
        default=0.3,
        ge=0.1,
        le=2,
        description="valves close by themselves this long after the last plan",
    )
    return_channel: int | None = Field(default=None, ge=0, le=1023, description="of a return valve")
    chip: Text = Field(default="gpiochip0", description="gpio only")


class GpioTable(Table):
    """Lines of this computer, for `output.kind = "gpio"`; see howto/wire-gpio.md."""

    driver: Literal["lines", "spi595"] = Field(
        default="lines", description="spi595: a chain of shift registers; channels are its outputs"
    )
    active_low: bool = Field(
        default=False, description="true: the driver sends current while its line is low"
    )
    return_valve: Literal["normally-open", "normally-closed"] = Field(
        default="normally-open", description="kind of the return valve: open without current"
    )
    alive_line: int | None = Field(
        default=None,
        ge=0,
        le=1023,
        description="toggles while all is well, for a hardware dead-man",
    )
    realtime: bool = Field(default=True, description="ask for real-time priority")
    spi_device: Text = Field(default="/dev/spidev0.0", description="spi595 only")
    spi_khz: int = Field(default=1000, ge=10, le=20_000, description="clock, spi595 only")


# The tables of motors: a pump, and rotary atomisers.

Pulse = Annotated[int, Field(ge=500, le=2500)]
Pulses = Annotated[tuple[Pulse, ...], Field(strict=False, min_length=2, max_length=1000)]
Flows = Annotated[
    tuple[Annotated[FiniteFloat, Field(ge=0, le=10_000)], ...],
    Field(strict=False, min_length=2, max_length=1000),
]
Speeds = Annotated[
    tuple[Annotated[FiniteFloat, Field(ge=0, le=200_000)], ...],
    Field(strict=False, min_length=2, max_length=1000),
]
Diameter = Annotated[FiniteFloat, Field(ge=5, le=5000)]
MotorOutput = Annotated[
    Literal["autopilot", "pwm"], Field(description="pwm: hardware PWM of this computer")
]
MotorChannel = Annotated[
    int, Field(ge=0, le=32, description="servo output or actuator, or the PWM's number")
]
MotorChip = Annotated[int, Field(ge=0, le=99, description="pwm only: number of the pwmchip")]
StopPulse = Annotated[Pulse, Field(description="servo pulse that stops it")]


class PumpTable(Table):
    """A pump on an ESC; see howto/pump-instead-of-valves.md."""

    control: Literal["modulates", "constant"] = Field(
        description="modulates: its speed makes the flow; constant: it supplies PWM valves"
    )
    output: MotorOutput = "autopilot"
    channel: MotorChannel
    chip: MotorChip = 0
    stop_us: StopPulse = 1000
    max_us: Pulse = Field(default=2000, description="largest servo pulse")
    min_us: Pulse | None = Field(
        default=None, description="smallest pulse at which it runs evenly; else the curve's first"
    )
    run_us: Pulse | None = Field(default=None, description="constant only: where it runs")
    us: Pulses = Field(default=(), description="modulates, measured: pulses, increasing")
    flow_l_min: Flows = Field(
        default=(), description="measured: flow of the whole boom at these pulses, increasing"
    )
    spin_up_s: Lag | None = Field(
        default=None, description="modulates, measured: order to first flow, from standing still"
    )
    up_s: Lag | None = Field(
        default=None, description="modulates, measured: order to volume-equivalent step, more flow"
    )
    down_s: Lag | None = Field(default=None, description="modulates, measured: the same, less flow")
    stop_end_s: Lag | None = Field(
        default=None, description="modulates, measured: order to stop until nothing comes any more"
    )
    up_time_s: Lag = Field(
        default=0.0, description="its time constant, a part of up_s; 0: changes are not driven"
    )
    down_time_s: Lag = Field(default=0.0, description="the same, a part of down_s")
    prime_s: float = Field(
        default=5.0, ge=0, le=300, description="time to fill hoses and nozzles on the ground"
    )


class AtomiserTable(Table):
    """One rotary atomiser."""

    name: Text = Field(description="for messages")
    output: MotorOutput = "autopilot"
    channel: MotorChannel
    chip: MotorChip = 0
    stop_us: StopPulse = 1000
    us: Pulses = Field(description="measured: pulses, increasing")
    rpm: Speeds = Field(description="measured: speed with liquid at these pulses, increasing")
    droplet_um: Diameter | None = Field(
        default=None, description="wanted median diameter (VMD); else that of product.droplet_class"
    )
    vmd_um: Diameter = Field(description="measured: VMD at one speed and flow")
    vmd_rpm: float = Field(gt=0, le=200_000, description="that speed")
    vmd_flow_l_min: float = Field(gt=0, le=1000, description="that flow, of one atomiser")
    rpm_exponent: float = Field(
        default=1.0, ge=0.1, le=3, description="VMD falls with this power of the speed"
    )
    flow_exponent: float = Field(
        default=0.2, ge=0, le=2, description="VMD grows with this power of the flow"
    )
    spin_up_s: Lag = Field(description="measured: from standing still to its speed")
    run_on_s: Lag = Field(default=1.0, description="spins on for this long after the liquid ended")


Points = Annotated[
    tuple[Annotated[FiniteFloat, Field(gt=0.0, le=10_000.0)], ...],
    Field(strict=False, max_length=100),
]


class FlowMeterTable(Table):
    """The flow meter before all valves."""

    source: Literal["none", "gpio", "autopilot"] = Field(
        default="none",
        description="gpio: pulses on a line of this computer (howto/wire-flow-meter.md)",
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
    reserve_l: float = Field(
        default=0.5, ge=0, le=1000, description="level at which the valves close"
    )
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
