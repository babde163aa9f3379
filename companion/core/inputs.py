"""What comes in: one value of a type of its own for everything that the core can be told.

All times are seconds on the companion's monotonic clock, unless a name says otherwise (`boot_s`:
the autopilot's clock). Missing is `None`, never 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum

# The modes that fly the mission, as ArduPilot and PX4 call them.
MISSION_MODES = frozenset({"AUTO", "MISSION"})
# SYSTEM_TIME comes at 1 Hz; over a minute our own clock is as good.
UTC_AGE_MAX_S = 60.0


class Fix(IntEnum):
    """Quality of the GNSS fix, in the order of trust (MAVLink GPS_FIX_TYPE 0 to 6)."""

    NONE = 0
    NO_FIX = 1
    FIX_2D = 2
    FIX_3D = 3
    DGPS = 4
    RTK_FLOAT = 5
    RTK_FIXED = 6


@dataclass(frozen=True, slots=True, kw_only=True)
class Telemetry:
    """One position message of the autopilot (GLOBAL_POSITION_INT), decoded.

    `received_s` is when its first byte was read. A velocity of `None` means that the autopilot
    did not know it. Course is not in it: it follows from the velocity.
    """

    received_s: float
    boot_s: float
    latitude_deg: float
    longitude_deg: float
    relative_altitude_m: float
    velocity_north_m_s: float | None
    velocity_east_m_s: float | None
    velocity_down_m_s: float | None
    heading_deg: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedReport:
    """Ground speed by a second way (VFR_HUD): the cross-check of the velocity.

    `None` is a speed that the autopilot told and that is not a number.
    """

    received_s: float
    ground_speed_m_s: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class AttitudeReport:
    """How the vehicle lies and turns (ATTITUDE): yaw, then pitch, then roll; rates of the body."""

    received_s: float
    boot_s: float
    roll_deg: float
    pitch_deg: float
    yaw_deg: float
    roll_rate_deg_s: float
    pitch_rate_deg_s: float
    yaw_rate_deg_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ImuReport:
    """What the accelerometer feels along the body (SCALED_IMU, HIGHRES_IMU): all but gravity.

    At rest and level, `down_m_s2` is -9.81.
    """

    received_s: float
    boot_s: float
    forward_m_s2: float
    right_m_s2: float
    down_m_s2: float


@dataclass(frozen=True, slots=True, kw_only=True)
class GnssReport:
    """Quality of the GNSS fix (GPS_RAW_INT).

    Its stamp by the autopilot's clock and its place are for `companion/receiver.py`: nothing is
    decided by them.
    """

    received_s: float
    fix: Fix
    horizontal_accuracy_m: float | None = None
    satellites: int | None = None
    boot_s: float | None = None
    latitude_deg: float | None = None
    longitude_deg: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class EstimatorReport:
    """Whether the autopilot trusts its own position (EKF_STATUS_REPORT, ESTIMATOR_STATUS)."""

    received_s: float
    healthy: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class HeartbeatReport:
    """A heartbeat of the vehicle's autopilot. `mode` is its name: AUTO, GUIDED, LOITER, ..."""

    received_s: float
    autopilot: str
    armed: bool
    mode: str
    active: bool = True  # MAV_STATE_ACTIVE: no failsafe, no emergency


@dataclass(frozen=True, slots=True, kw_only=True)
class LandedReport:
    """Whether the vehicle flies (EXTENDED_SYS_STATE); `None` where the autopilot cannot tell.

    Between the two, taking off or landing, it is neither in the air nor on the ground.
    """

    received_s: float
    in_air: bool | None
    on_ground: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class WindReport:
    """Wind, from the autopilot or from the operator; east and north of where it blows to.

    Without a direction the two are `None`: the speed alone still limits the spraying. Without a
    speed the report says that the wind is not known.
    """

    received_s: float
    speed_m_s: float | None
    east_m_s: float | None = None
    north_m_s: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class RangeReport:
    """Height above the crop by a sensor that looks down (DISTANCE_SENSOR); None: sees nothing."""

    received_s: float
    height_m: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class RcReport:
    """Pulse widths of the pilot's channels, channel 1 first (RC_CHANNELS); 0 is no signal."""

    received_s: float
    pulse_us: tuple[int, ...]
    boot_s: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class OperatorCommand:
    """The operator's wish to spray or to stop, and by which way it came."""

    received_s: float
    enable: bool
    source: str


@dataclass(frozen=True, slots=True, kw_only=True)
class OutputReport:
    """What the executor of plans says of itself, and whether the link to the vehicle is up."""

    received_s: float
    healthy: bool
    text: str = ""
    link_up: bool = True
    guarded: bool = True  # something closes when this computer fails, or need not


@dataclass(frozen=True, slots=True, kw_only=True)
class StandstillReport:
    """The companion itself stood still: a stopped process, a computer that slept."""

    received_s: float
    gap_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class EstopReport:
    """An emergency stop: a switch on a `line`, or a `command`; a broken wire is pressed."""

    received_s: float
    pressed: bool
    source: str


@dataclass(frozen=True, slots=True, kw_only=True)
class FlowReport:
    """What the flow meter has counted since it was started: all valves, as its calibration has it.

    A count and not a flow, so that a mean over any time can be formed from two of them. With a
    `fault` (pulses were lost, more came than can be) the volume is not a number.
    """

    received_s: float
    volume_ml: float
    fault: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class PressureReport:
    """Pressure before the valves, mean of a reading's time; None with a `fault` of the sensor."""

    received_s: float
    pressure_kpa: float | None
    fault: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class TankReport:
    """What is left in the tank; None where it is not known, with a `fault` where it should be."""

    received_s: float
    level_l: float | None
    fault: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class BatteryReport:
    """One of the autopilot's battery monitors (BATTERY_STATUS), counted from 0.

    Behind it may be ArduPilot's fuel flow meter, whose milliampere hours are millilitres, or a
    fuel level; `None` is what it does not know.
    """

    received_s: float
    battery: int
    consumed: float | None
    remaining_percent: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class RateOverride:
    """The operator's wish to spray a percentage of what is prescribed; see `nozzle.overridden`."""

    received_s: float
    percent: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockReport:
    """What TIMESYNC says of the autopilot's clock: add `offset_s` to its time to have ours.

    One exchange, wrong by half of its round trip at most.
    """

    received_s: float
    offset_s: float
    round_trip_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class UtcReport:
    """The time of day by the autopilot (SYSTEM_TIME), seconds since 1970.

    For the record; with the time since boot beside it, it shows a clock that has begun anew.
    """

    received_s: float
    utc_s: float
    boot_s: float | None = None

    def offset_s(self, now_s: float) -> float | None:
        """Return what makes a time of day of our clock; None once this is too old for that."""
        if not -0.1 <= now_s - self.received_s <= UTC_AGE_MAX_S:
            return None
        return self.utc_s - self.received_s


@dataclass(frozen=True, slots=True, kw_only=True)
class DeclarationReport:
    """What the operator declared on the ground, judged by the limits of label and permit.

    `broken` names the reasons (`Inhibit`) for which nothing may open, `observed_s` is from when to
    when the observation counts, in seconds since 1970; None where none is asked for. `said` is all
    that was declared by then, as JSON by dotted key: for the record.
    """

    received_s: float
    broken: tuple[str, ...]
    observed_s: tuple[float, float] | None
    said: str


@dataclass(frozen=True, slots=True, kw_only=True)
class LegReport:
    """The leg of its mission that the vehicle now flies: from which place to which.

    `stops` says whether the vehicle comes to a stop at its end, `speed_m_s` is the speed that the
    mission asks for on it. `received_s` is when the autopilot last said which leg it is. `longer`
    is another leg of the mission on which this one lies whole, the shortest of them: from where to
    where, latitude and longitude in degrees.
    """

    received_s: float
    from_latitude_deg: float
    from_longitude_deg: float
    to_latitude_deg: float
    to_longitude_deg: float
    stops: bool
    speed_m_s: float | None = None
    longer: tuple[tuple[float, float], tuple[float, float]] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class AutopilotLiquid:
    """Which of the autopilot's battery monitors are flow meter and tank; None: neither."""

    flow_battery: int | None = None
    tank_battery: int | None = None
    tank_l: float = 0.0

    def flow(self, item: BatteryReport) -> FlowReport | None:
        """Return the count of the flow meter; no number where the autopilot knows none."""
        if item.battery != self.flow_battery:
            return None
        consumed_ml = item.consumed
        if consumed_ml is None:
            text = "flow meter: the autopilot has no count of it"
            return FlowReport(received_s=item.received_s, volume_ml=math.nan, fault=text)
        return FlowReport(received_s=item.received_s, volume_ml=consumed_ml)

    def tank(self, item: BatteryReport) -> TankReport | None:
        """Return what is left in the tank."""
        if item.battery != self.tank_battery:
            return None
        percent = item.remaining_percent
        if percent is None:
            text = "tank: the autopilot has no level of it"
            return TankReport(received_s=item.received_s, level_l=None, fault=text)
        return TankReport(received_s=item.received_s, level_l=percent / 100.0 * self.tank_l)


Input = (
    Telemetry
    | AttitudeReport
    | ImuReport
    | SpeedReport
    | GnssReport
    | EstimatorReport
    | HeartbeatReport
    | LandedReport
    | WindReport
    | RangeReport
    | RcReport
    | OperatorCommand
    | OutputReport
    | EstopReport
    | StandstillReport
    | FlowReport
    | PressureReport
    | TankReport
    | BatteryReport
    | RateOverride
    | ClockReport
    | LegReport
    | UtcReport
    | DeclarationReport
)
