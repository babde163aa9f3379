"""The tables of the configuration file: keys, units, bounds and defaults.

One class a table, one line a key. Unknown keys are refused and numbers are strict, so that a slip
of the pen is never a setting. What must be measured on the sprayer has no default. How a file is
read, and what is said of a wrong one, is in `model.py`. The tables of the sprayer itself, of the
corrections and of the sensors have files of their own.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Self

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    FiniteFloat,
    TypeAdapter,
    ValidationError,
    model_validator,
)
from pydantic_core import PydanticCustomError

from companion.errors import ConfigError

Text = Annotated[str, Field(min_length=1, max_length=500)]
Texts = Annotated[tuple[Text, ...], Field(strict=False, max_length=1000)]
Rate = Annotated[FiniteFloat, Field(ge=0.0, le=100_000.0)]
Width = Annotated[FiniteFloat, Field(gt=0.0, le=100.0)]
Duty = Annotated[FiniteFloat, Field(ge=0.0, le=1.0)]
Latitude = Annotated[FiniteFloat, Field(ge=-90.0, le=90.0)]
Longitude = Annotated[FiniteFloat, Field(ge=-180.0, le=180.0)]

Altitude = Annotated[FiniteFloat, Field(ge=-1000.0, le=10_000.0)]
# How products are sold, by the two letters of their labels (CropLife International's codes).
Formulation = Literal[
    "conditioner", "SG", "SP", "WG", "WP", "CS", "SC", "ZC", "SE", "OD", "EC", "EW", "ME", "SL",
    "surfactant", "oil", "fertilizer",
]  # fmt: skip
DoseUnit = Literal[
    "L/ha", "mL/ha", "kg/ha", "g/ha", "%", "L/100 L", "mL/100 L", "kg/100 L", "g/100 L"
]
Place = Annotated[tuple[Latitude, Longitude], Field(strict=False)]


class Table(BaseModel):
    """A table of the file: frozen, strict, nothing unknown."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)

    @classmethod
    def checked(cls, raw: dict[str, Any], where: Path | str) -> Self:
        """Return what a file, or a table of it, says.

        Raises:
            ConfigError: in one line: file, key, value, what to write instead.
        """
        try:
            return cls.model_validate(raw)
        except ValidationError as error:
            from companion.config.wording import findings, one_line

            found = findings(error.errors(), raw, cls)
            raise ConfigError(
                f"{where}: {one_line(found)}", problems=[each.problem() for each in found]
            ) from error


def contradiction(*found: tuple[str, str]) -> PydanticCustomError:
    """Return what refuses a table whose keys, each with what is wrong, do not go together."""
    return PydanticCustomError("contradiction", "{text}", {"text": found[0][1], "all": found})


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

    file: Text = Field(
        description="the flight map, or a map to compile first, relative to this file"
    )
    sha256: str | None = Field(
        default=None,
        pattern=r"^[0-9a-f]{8,64}$",
        description="first digits of the hash of the map or the flight map; another map is refused",
    )
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
    mix_rate: float | None = Field(
        default=None,
        ge=1.0,
        le=10_000.0,
        description="litres of spray mix with one litre of product in them, where the map's rates "
        "are of product",
    )
    scale: float | None = Field(
        default=None,
        gt=0.0,
        le=1000.0,
        description="factor on all rates, where the map was made for another sprayer",
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
    accuracy_max_m: float | None = Field(
        default=None,
        gt=0,
        le=100,
        description="worst horizontal accuracy that the receiver may report; 0.3 with an RTK fix",
    )
    estop_line: int | None = Field(
        default=None,
        ge=0,
        le=1023,
        description="GPIO line of an emergency stop that opens a contact to ground when pressed",
    )
    pump_cutoff: bool = Field(
        default=False, description="true: a relay cuts the pump when this computer fails"
    )


class SwathTable(Table):
    """One measured swath."""

    height_m: float = Field(ge=0.5, le=120, description="above the crop")
    speed_m_s: float = Field(ge=0.5, le=50, description="over ground")
    width_m: Width = Field(description="wet evenly, passes overlapped as they are flown")


class MissionTable(Table):
    """What planning needs, and which lines of a plan are sprayed."""

    swath_width_m: Width = Field(
        ge=0.3, description="spacing of passes; within 2 % of boom.width_m"
    )
    speed_m_s: float = Field(ge=0.5, le=50, description="in the passes")
    height_m: float = Field(default=3.5, ge=0.5, le=120, description="in the passes")
    acceleration_m_s2: float = Field(default=2.5, gt=0, le=20, description="of the vehicle")
    jerk_m_s3: float | None = Field(
        default=None, gt=0, le=100, description="of the vehicle; absent: 1 of ArduPilot, 4 of PX4"
    )
    return_height_m: float | None = Field(
        default=None, ge=0, le=500, description="of its return; absent: 15 of ArduPilot, 60 of PX4"
    )
    ferry_height_m: float | None = Field(
        default=None, ge=0.5, le=120, description="of ferries and long transits; absent: height_m"
    )
    ferry_clearance_m: float = Field(
        default=5.0, ge=1, le=100, description="over obstacles of known height, for ferries"
    )
    turn: Literal["stop", "strafe", "rounded"] = Field(default="stop", description="between passes")
    angle_deg: Annotated[float, Field(ge=-360, le=360)] | Literal["auto"] = Field(
        default="auto", description="of the passes, clockwise from north"
    )
    tank_l: float = Field(default=40.0, gt=0, le=10_000, description="full tank")
    reserve_l: float = Field(
        default=1.0, ge=0, le=1_000, description="left in the tank at its refill"
    )
    rinses: int = Field(default=3, ge=1, le=10, description="of the tank after the last sortie")
    rinse_l: float | None = Field(
        default=None,
        gt=0,
        le=1_000,
        description="clean water for all of them; absent: ten times reserve_l (ISO 16119)",
    )
    rate_l_ha: Rate = Field(default=20.0, description="where no prescription is given")
    depots: Annotated[
        tuple[Annotated[tuple[Latitude, Longitude], Field(strict=False)], ...],
        Field(strict=False, max_length=100),
    ] = Field(default=(), description="[[latitude, longitude], ...]; empty: best place on the edge")
    obstacle_buffer_m: float = Field(
        default=2.0, ge=0, le=100, description="kept off obstacles, holes"
    )
    outline_tolerance_m: float = Field(
        default=0.1, ge=0, le=2, description="borders are drawn simpler by it, only ever inwards"
    )
    refill_s: float = Field(default=60.0, ge=0, le=3600, description="on the ground for one refill")
    battery_wh: float | None = Field(
        default=None,
        gt=0,
        le=1e6,
        description="of one battery; absent: sorties end with the tank alone",
    )
    battery_reserve_percent: float = Field(
        default=20.0, ge=0, le=90, description="left in the battery at landing"
    )
    power_hover_w: float | None = Field(
        default=None, gt=0, le=1e6, description="with an empty tank, standing in the air"
    )
    power_cruise_w: float | None = Field(
        default=None,
        gt=0,
        le=1e6,
        description="with an empty tank at speed_m_s; absent: as hovering",
    )
    power_per_kg_w: float = Field(
        default=0.0, ge=0, le=10_000, description="more for each kilogram in the tank"
    )
    swap_s: float = Field(
        default=60.0, ge=0, le=3600, description="on the ground for one change of battery"
    )
    nose_rate_deg_s: float | None = Field(
        default=None, gt=0, le=360, description="turning the nose at a stop; absent: takes no time"
    )
    aircraft: int = Field(default=1, ge=1, le=20, description="that share the field")
    aircraft_gap_m: float = Field(
        default=20.0, ge=1, le=1000, description="between aircraft in the air"
    )
    resume_overlap_m: float = Field(
        default=3.0, ge=0, le=50, description="of a line sprayed again after a break"
    )
    no_spray_buffer_m: float = Field(
        default=0.0, ge=0, le=1000, description="kept from no-spray areas: the label's, at least"
    )
    wind: (
        tuple[
            Annotated[FiniteFloat, Field(ge=0, le=50)], Annotated[FiniteFloat, Field(ge=0, le=360)]
        ]
        | None
    ) = Field(
        default=None, strict=False, description="[m/s, degrees it comes from], for these buffers"
    )
    wind_buffer_m_per_m_s: float | None = Field(
        default=None, ge=0, le=100, description="added to them for each m/s towards the area"
    )
    swath: Annotated[tuple[SwathTable, ...], Field(strict=False, max_length=400)] = Field(
        default=(), description="measured height_m, speed_m_s, width_m: the spacing of passes"
    )
    autopilot: Literal["ardupilot", "px4"] = Field(
        default="ardupilot", description="that flies the plan: each refuses other items"
    )
    terrain: Text | None = Field(
        default=None, description="elevation model (.tif, .hgt) whose ground the plan follows"
    )
    terrain_heights: Literal["auto", "vehicle", "file"] = Field(
        default="auto", description="whose ground: vehicle on ArduPilot, the file's for PX4"
    )
    terrain_tolerance_m: float = Field(
        default=0.5, ge=0.05, le=50, description="height error that adds no point to a way"
    )
    climb_max_m_s: float = Field(default=2.5, gt=0, le=20, description="over rising ground")
    descent_max_m_s: float = Field(default=1.5, gt=0, le=20, description="over falling ground")
    run_in_m: Annotated[FiniteFloat, Field(ge=0, le=200)] | Literal["auto"] = Field(
        default=0.0, description="before and behind passes, to fly them at speed; auto: v^2 / 2a"
    )
    overrun: Literal["inside", "allowed"] = Field(
        default="inside", description="allowed: run-ins may lie outside the field"
    )
    overrun_areas: Texts = Field(
        default=(), description="files with ground outside the field on which run-ins may lie"
    )
    lines: Text | None = Field(
        default=None, description="GeoJSON that `plan` writes: sprayed on its spray lines only"
    )
    lines_aside_m: float = Field(
        default=1.0, gt=0, le=50, description="farther aside is off a line; at most half a swath"
    )
    lines_course_deg: float = Field(
        default=20.0, gt=0, le=60, description="a course that is farther from the line's is off it"
    )


class ProductTable(Table):
    """What is sprayed, and what its label allows."""

    name: Text | None = Field(default=None, description="for the record")
    registration: Text | None = Field(default=None, description="for the record")
    rate_max_l_ha: Rate | None = Field(default=None, description="a map above it is refused")
    active_constituents: Text | None = Field(
        default=None, description="of the product, with their content, for the record"
    )
    droplet_class: Text | None = Field(default=None, description="for the record")


class Buffer(NamedTuple):
    """Ground to keep away from; `files` are named as seen from the configuration's folder."""

    kind: str
    distance_m: float
    files: tuple[str, ...]


class LimitsTable(Table):
    """What label and permit ask for, as data."""

    file: Text | None = Field(
        default=None, description="TOML file of label and permit, relative to this file"
    )


class MixTable(Table):
    """One product of the tank mix, for the sheet that `vrspray plan` writes."""

    name: Text = Field(description="as its label says")
    registration: Text | None = Field(default=None, description="for the sheet")
    formulation: Formulation | None = Field(
        default=None, description="says when it is mixed in; absent: last, in the file's order"
    )
    amount: float = Field(gt=0, le=10_000, description="of the product, in unit")
    unit: DoseUnit = Field(description="for each hectare, or for so much of what is sprayed")
    at_l_ha: Annotated[FiniteFloat, Field(gt=0, le=10_000)] | None = Field(
        default=None,
        description="spray rate for which an amount per hectare is meant; absent: map's average",
    )

    @model_validator(mode="after")
    def _says_one_thing(self) -> Self:
        if self.at_l_ha is not None and not self.unit.endswith("/ha"):
            raise PydanticCustomError(
                "no_rate", "at_l_ha is for an amount for each hectare; leave it out"
            )
        return self


class JournalTable(Table):
    """The record of each flight."""

    folder: Text = Field(default="flights", description="relative to this file")
    training: bool = Field(
        default=False, description="true: flown with water; marked in every record"
    )
    required: bool = Field(default=True, description="true: nothing is sprayed without its record")
    close_after_s: float = Field(
        default=60.0,
        ge=10,
        le=900,
        description="in flight all valves close when for so long nothing reached the disk; "
        "until then the record waits in memory",
    )
    commit_s: float | None = Field(
        default=None,
        ge=0.1,
        le=1.0,
        description="between two commits, what a power cut may lose; absent: 1, "
        "less on fields below about 1.5 ha",
    )
    keep_free_percent: float = Field(
        default=10.0,
        ge=0,
        le=90,
        description="`vrspray flights prune` removes old flights while less of the disk than this "
        "is free; 0: never. `run` removes none",
    )
    keep_count: int | None = Field(
        default=None,
        ge=1,
        le=100_000,
        description="`vrspray flights prune` keeps so many flights, ten or more; absent: all",
    )
    keep_days: float | None = Field(
        default=None,
        gt=0,
        le=100_000,
        description="`vrspray flights prune` keeps flights so long; absent: for ever",
    )


class WebTable(Table):
    """The operator's page."""

    enabled: bool = Field(default=False, description="true: needs vrspray[web]")
    host: Text = Field(
        default="127.0.0.1", description="address to listen on; 0.0.0.0 for phones, with a token"
    )
    port: int = Field(default=8880, ge=1, le=65535, description="port to listen on")
    names: Annotated[tuple[Text, ...], Field(strict=False, max_length=20)] = Field(
        default=(),
        description="other host names of the page; of another port than web.port: name:port",
    )
    frame_ancestors: Annotated[tuple[Text, ...], Field(strict=False, max_length=20)] = Field(
        default=(), description="origins that may show the page in a frame, such as BlueOS"
    )
    session_hours: float = Field(
        default=12.0, ge=0.1, le=720, description="how long a phone stays logged in"
    )
    upload_link: Text | None = Field(
        default=None,
        description="second link to the autopilot, by which the page uploads missions",
    )
    choose_field: bool = Field(
        default=False,
        description="true: a field planned on the page can be flown from there, in place of "
        "prescription and mission.lines here",
    )
    tls_certificate: Text | None = Field(default=None, description="PEM file; with tls_key: https")
    tls_key: Text | None = Field(default=None, description="PEM file of its private key")


def out_of_bounds(table: type[Table], key: str, value: float) -> str | None:
    """Return what a number for a key has to be, where it is not; None for what is no key.

    >>> out_of_bounds(MissionTable, "speed_m_s", 0.1)
    'greater than or equal to 0.5'
    """
    field = table.model_fields.get(key)
    if field is None:
        return None
    adapter: TypeAdapter[Any] = TypeAdapter(Annotated[field.annotation, field])  # type: ignore[arg-type]
    try:
        adapter.validate_python(value)
    except ValidationError as error:
        return error.errors()[0]["msg"].removeprefix("Input should be ")
    return None


# The tables of what corrects the plan in flight, each off unless it is asked for.

Percent = Annotated[FiniteFloat, Field(gt=0.0, le=100.0)]
WindSpeed = Annotated[FiniteFloat, Field(ge=0.0, le=50.0)]
WindFrom = Annotated[FiniteFloat, Field(ge=0.0, le=360.0)]


class FlowTrimTable(Table):
    """Slow correction by a flow meter; see howto/correct-flow-drift.md."""

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
    """Where droplets land beside their nozzle; see howto/wind-and-drift.md."""

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
        default=0.2, ge=0, le=2, description="how far liquid travels on along the course"
    )
    limit_m: float = Field(default=2.0, ge=0, le=10, description="largest offset")


class PredictionTable(Table):
    """What the prediction of the vehicle's motion may use; see prediction.md."""

    use_imu: bool = Field(
        default=False,
        description="true: attitude and accelerometer tell the motion between two positions",
    )
    use_mission: bool = Field(
        default=False,
        description="true: the autopilot's mission is read, and braking for a stop is foreseen",
    )
    braking_m_s2: float = Field(
        default=2.5, ge=0.1, le=20, description="of the vehicle at the end of a leg"
    )


# The table of treated ground: whether it is kept, and whether a valve closes over it.


class CoverageTable(Table):
    """What was treated: kept in the journal, and not sprayed twice."""

    record: bool = Field(
        default=True, description="false: the journal does not keep which ground was treated"
    )
    switch_off_percent: Percent | Literal["never"] | None = Field(
        default=None,
        description="a valve closes where so much of its strip is treated; "
        "absent: 100 with mission.lines, else never",
    )
