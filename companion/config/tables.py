"""The tables of the configuration file: keys, units, bounds and defaults.

One class a table, one line a key. Unknown keys are refused and numbers are strict, so that a slip
of the pen is never a setting. What must be measured on the sprayer has no default. How a file is
read, and what is said of a wrong one, is in `load.py`.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

Text = Annotated[str, Field(min_length=1, max_length=500)]
Texts = Annotated[tuple[Text, ...], Field(strict=False, max_length=1000)]
Lag = Annotated[FiniteFloat, Field(ge=0.0, le=30.0)]
Rate = Annotated[FiniteFloat, Field(ge=0.0, le=100_000.0)]
Offset = Annotated[FiniteFloat, Field(ge=-50.0, le=50.0)]
Width = Annotated[FiniteFloat, Field(gt=0.0, le=100.0)]
Duty = Annotated[FiniteFloat, Field(ge=0.0, le=1.0)]
Latitude = Annotated[FiniteFloat, Field(ge=-90.0, le=90.0)]
Longitude = Annotated[FiniteFloat, Field(ge=-180.0, le=180.0)]

Altitude = Annotated[FiniteFloat, Field(ge=-1000.0, le=10_000.0)]
WindSpeed = Annotated[FiniteFloat, Field(ge=0.0, le=50.0)]
WindFrom = Annotated[FiniteFloat, Field(ge=0.0, le=360.0)]
Place = Annotated[tuple[Latitude, Longitude], Field(strict=False)]


class Table(BaseModel):
    """A table of the file: frozen, strict, nothing unknown."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


class LinkTable(Table):
    """How the flight controller is reached."""

    url: str = Field(
        default="udpin:127.0.0.1:14550",
        pattern=r"^((udpin|udpout|tcp):\S+:\d{1,5}|serial:\S+:\d{2,8})$",
        description="udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or serial:DEVICE:BAUD",
    )
    system_id: int = Field(
        default=0, ge=0, le=255, description="of this component; 0: the vehicle's"
    )
    component_id: int = Field(default=191, ge=1, le=255, description="of this component")
    position_rate_hz: float = Field(
        default=20, ge=1, le=100, description="positions asked for a second"
    )
    signing_key_file: Text | None = Field(
        default=None, description="MAVLink 2 signing: file of the key, readable by its owner only"
    )
    state_folder: Text = Field(
        default="state", description="what outlives a run: parameters set by a station, signing"
    )


class PrescriptionTable(Table):
    """The map, and how it is read."""

    file: Text = Field(description="the map, relative to this file")
    rate_field: Text | None = Field(
        default=None, description="where the map has several candidates"
    )
    unit: Text | None = Field(
        default=None, description="where the map does not say: L/ha, gal/ac, mL/m2"
    )
    crs: Text | None = Field(
        default=None, description="where the map does not say, such as EPSG:4326"
    )
    layer: Text | None = Field(
        default=None, description="where the map has several layers or tasks"
    )
    density_kg_l: float | None = Field(
        default=None,
        gt=0.0,
        le=30.0,
        description="of the product, where the map's rates are weights",
    )
    flow_width_m: Width | None = Field(
        default=None, description="working width for which a map in L/min was made"
    )
    flow_speed_m_s: float | None = Field(
        default=None, gt=0.0, le=100.0, description="speed for which a map in L/min was made"
    )
    merge: Literal["max", "average", "mean"] | None = Field(
        default=None, description="text map: of several points in a cell; max unless set"
    )
    origin: Annotated[tuple[Latitude, Longitude, Altitude], Field(strict=False)] | None = Field(
        default=None,
        description="text map: [latitude, longitude, altitude] of its plane; else its first point",
    )
    overlap: Literal["error", "max", "min", "mean", "last"] = Field(
        default="error", description="which rate holds where zones overlap; error refuses the map"
    )
    across: Literal["centre", "mean", "max"] = Field(
        default="centre", description="rate of a strip that lies over several zones"
    )
    border: Literal["inside", "volume"] = Field(
        default="inside", description="inside: nothing falls outside; volume: as any other boundary"
    )
    border_buffer_m: float = Field(
        default=0.10,
        ge=0,
        le=10,
        description="strips keep this far from the border (border = inside)",
    )
    default_rate_l_ha: Rate | None = Field(
        default=None,
        description="rate inside the boundary where there is no zone; without it: closed",
    )
    offset_east_m: float = Field(
        default=0.0, ge=-1000, le=1000, description="added to the map's east"
    )
    offset_north_m: float = Field(
        default=0.0, ge=-1000, le=1000, description="added to the map's north"
    )
    check_map: Place | None = Field(
        default=None, description="[latitude, longitude] of a mark, as the map has it"
    )
    check_surveyed: Place | None = Field(
        default=None, description="[latitude, longitude] of the same mark by this receiver"
    )
    check_tolerance_m: float = Field(
        default=0.1, gt=0, le=100, description="how far the two may lie apart after the offset"
    )
    boundary: Text | None = Field(
        default=None, description="file with the outline of the field; without it that of all zones"
    )
    exclusions: Texts = Field(default=(), description="files with polygons that are never sprayed")


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
        default=None, ge=1, le=1000, description="how many it feeds; information"
    )
    width_m: Width | None = Field(
        default=None,
        description="of its strip; else boom.width_m over the valves of the largest set",
    )
    forward_m: Offset | None = Field(default=None, description="instead of boom.forward_m")


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
    """Valves that spray together, and what they deliver; all of it measured."""

    valves: Annotated[tuple[Text, ...], Field(strict=False, min_length=1, max_length=1000)] = Field(
        description="names of the valves"
    )
    duty: Annotated[tuple[Duty, ...], Field(strict=False, min_length=2, max_length=1000)] = Field(
        description="measured points, increasing"
    )
    flow_l_min: Annotated[
        tuple[Annotated[FiniteFloat, Field(ge=0, le=10_000)], ...],
        Field(strict=False, min_length=2, max_length=1000),
    ] = Field(description="flow of the whole set at these duties, increasing")


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
    on_start_s: Lag = Field(description="measured: order to first flow; at most on_s")
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
    measured_on: str | None = Field(
        default=None,
        pattern=r"^\d{4}-(0[1-9]|1[0-2])-(0[1-9]|[12]\d|3[01])$",
        description="day on which flows and lags were measured, YYYY-MM-DD; `doctor` tells its age",
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
    lease_s: float = Field(
        default=0.3,
        ge=0.1,
        le=2,
        description="valves close by themselves this long after the last plan",
    )
    return_channel: int | None = Field(default=None, ge=0, le=1023, description="of a return valve")
    chip: Text = Field(default="gpiochip0", description="gpio only")


class GpioTable(Table):
    """Lines of this computer, for `output.kind = "gpio"`; see gpio.md."""

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


class SafetyTable(Table):
    """What must hold before a valve may open."""

    enable_by: Annotated[
        tuple[Literal["command", "rc", "web"], ...],
        Field(strict=False, min_length=1, max_length=3),
    ] = Field(
        default=("command", "rc", "web"),
        description="who may enable: MAV_CMD_DO_SPRAYER, an RC switch, the page",
    )
    rc_channel: int | None = Field(
        default=None, ge=1, le=18, description="the RC switch, if there is one: off closes"
    )
    modes: Annotated[tuple[Text, ...], Field(strict=False, min_length=1, max_length=20)] = Field(
        default=("AUTO",), description="flight modes in which spraying is allowed"
    )
    wind_max_m_s: float = Field(default=6.0, gt=0, le=50, description="no spraying above")
    wind_required: bool = Field(
        default=False, description="true: no spraying without a wind report"
    )
    position_age_max_s: float = Field(
        default=0.8, ge=0.05, le=5, description="oldest usable position"
    )
    heartbeat_age_max_s: float = Field(
        default=2.5, ge=1.0, le=10, description="oldest usable heartbeat"
    )
    speed_min_m_s: float = Field(default=1.0, ge=0.1, le=50, description="no spraying below")
    speed_max_m_s: float = Field(default=12.0, gt=0.1, le=100, description="no spraying above")
    speed_disagreement_max_m_s: float = Field(
        default=1.0, gt=0, le=20, description="between the two speeds that the autopilot reports"
    )
    speed_check_required: bool = Field(
        default=True, description="true: no spraying without the second speed (VFR_HUD)"
    )
    wind_age_max_s: float = Field(
        default=5.0, ge=1, le=60, description="oldest wind report that wind_required takes"
    )
    height_min_m: float = Field(
        default=1.0,
        ge=-100,
        le=500,
        description="above the crop, else above home; no spraying below",
    )
    height_max_m: float = Field(
        default=10.0, ge=-100, le=500, description="above the crop, else above home; none above"
    )
    fix: Literal["3d", "dgps", "rtk-float", "rtk-fixed"] = Field(
        default="rtk-float", description="least acceptable GNSS fix"
    )
    pump_cutoff: bool = Field(
        default=False, description="true: a relay cuts the pump when this computer fails"
    )


class MissionTable(Table):
    """What planning needs."""

    swath_width_m: Width = Field(description="spacing of passes; within 2 % of boom.width_m")
    speed_m_s: float = Field(ge=0.5, le=50, description="in the passes")
    height_m: float = Field(default=3.5, ge=0.5, le=120, description="in the passes")
    acceleration_m_s2: float = Field(default=2.5, gt=0, le=20, description="of the vehicle")
    turn: Literal["stop", "strafe", "rounded"] = Field(default="stop", description="between passes")
    angle_deg: Annotated[float, Field(ge=-360, le=360)] | Literal["auto"] = Field(
        default="auto", description="of the passes, clockwise from north"
    )
    tank_l: float = Field(default=40.0, gt=0, le=10_000, description="full tank")
    reserve_l: float = Field(
        default=1.0, ge=0, le=1_000, description="left in the tank at its refill"
    )
    rate_l_ha: Rate = Field(default=20.0, description="where no prescription is given")
    depots: Annotated[
        tuple[Annotated[tuple[Latitude, Longitude], Field(strict=False)], ...],
        Field(strict=False, max_length=100),
    ] = Field(default=(), description="[[latitude, longitude], ...]; empty: best place on the edge")
    obstacle_buffer_m: float = Field(default=2.0, ge=0, le=100, description="kept from obstacles")


class ProductTable(Table):
    """What is sprayed, and what its label allows."""

    name: Text | None = Field(default=None, description="for the record")
    registration: Text | None = Field(default=None, description="for the record")
    rate_max_l_ha: Rate | None = Field(default=None, description="a map above it is refused")
    droplet_class: Text | None = Field(default=None, description="for the record")


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


class JournalTable(Table):
    """The record of each flight."""

    folder: Text = Field(default="flights", description="relative to this file")


class WebTable(Table):
    """The operator's page."""

    enabled: bool = Field(default=False, description="not part of this version")
    host: Text = Field(default="127.0.0.1", description="address to listen on")
    port: int = Field(default=8880, ge=1, le=65535, description="port to listen on")
