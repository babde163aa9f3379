"""The tables of motors: a pump, and rotary atomisers."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, FiniteFloat

from companion.config.sprayer_tables import Lag
from companion.config.tables import Table, Text

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
Way = Literal["autopilot", "pwm"]


class PumpTable(Table):
    """A pump on an ESC; see pump.md."""

    control: Literal["modulates", "constant"] = Field(
        description="modulates: its speed makes the flow; constant: it supplies PWM valves"
    )
    output: Way = Field(default="autopilot", description="pwm: hardware PWM of this computer")
    channel: int = Field(ge=0, le=32, description="servo output or actuator, or the PWM's number")
    chip: int = Field(default=0, ge=0, le=99, description="pwm only: number of the pwmchip")
    stop_us: Pulse = Field(default=1000, description="servo pulse that stops it")
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
    output: Way = Field(default="autopilot", description="pwm: hardware PWM of this computer")
    channel: int = Field(ge=0, le=32, description="servo output or actuator, or the PWM's number")
    chip: int = Field(default=0, ge=0, le=99, description="pwm only: number of the pwmchip")
    stop_us: Pulse = Field(default=1000, description="servo pulse that stops it")
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
