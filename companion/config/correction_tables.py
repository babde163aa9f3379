"""The tables of what corrects the plan in flight, each off unless it is asked for."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, FiniteFloat

from companion.config.tables import Table

WindSpeed = Annotated[FiniteFloat, Field(ge=0.0, le=50.0)]
WindFrom = Annotated[FiniteFloat, Field(ge=0.0, le=360.0)]


class FlowTrimTable(Table):
    """Slow correction by a flow meter; see flow-trim.md."""

    enabled: bool = Field(
        default=False, description="true: flows are divided by metered over expected flow"
    )
    tau_s: float = Field(default=5.0, ge=1, le=600, description="time constant of the correction")
    limit: float = Field(
        default=0.15, ge=0.01, le=0.25, description="largest correction, as a share of the flow"
    )
    meter_minimum_l_min: float = Field(
        default=0.5, ge=0, le=10_000, description="the meter's smallest flow; none is taken below"
    )
    settle_s: float = Field(
        default=2.0, ge=0, le=60, description="no correction for this long after a change of rate"
    )


class DriftTable(Table):
    """Where droplets land beside their nozzle; see drift.md."""

    enabled: bool = Field(
        default=False, description="true: the map is read where the droplets are expected to land"
    )
    wind: Annotated[tuple[WindSpeed, WindFrom], Field(strict=False)] | None = Field(
        default=None,
        description="[m/s, degrees it comes from] by the operator; else the autopilot's",
    )
    wind_age_max_s: float = Field(
        default=5.0, ge=0.5, le=60, description="oldest usable report of the autopilot"
    )
    droplet_um: float = Field(
        default=250.0, ge=50, le=1000, description="volume median diameter of the droplets"
    )
    downwash_m_s: float = Field(
        default=8.0, ge=0, le=30, description="at the nozzles, fading to nothing at the ground"
    )
    fall_s: float | None = Field(
        default=None,
        ge=0,
        le=60,
        description="measured: metres of shift per m/s of wind; else from the two above and "
        "boom.height_m",
    )
    forward_carry_m: float = Field(
        default=0.2, ge=0, le=2, description="how far liquid flies on along the course"
    )
    limit_m: float = Field(default=2.0, ge=0, le=10, description="largest offset")


class PredictionTable(Table):
    """What the prediction of the vehicle's motion may use; see prediction.md."""

    use_mission: bool = Field(
        default=False,
        description="true: the autopilot's mission is read, and braking for a stop is foreseen",
    )
    braking_m_s2: float = Field(
        default=2.5, ge=0.1, le=20, description="of the vehicle at the end of a leg"
    )
