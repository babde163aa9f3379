"""What flows through the core: state and decisions; inputs and plans have files of their own.

Everything is frozen; units are in names; missing is `None`, never 0. All times are seconds on
the companion's monotonic clock, unless a name says otherwise (`boot_s`: the autopilot's clock).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise

from companion.core.inputs import (
    AttitudeReport,
    BatteryReport,
    ClockReport,
    DeclarationReport,
    EstimatorReport,
    EstopReport,
    Fix,
    FlowReport,
    GnssReport,
    HeartbeatReport,
    ImuReport,
    Input,
    LandedReport,
    LegReport,
    OperatorCommand,
    OutputReport,
    PressureReport,
    RangeReport,
    RateOverride,
    RcReport,
    SpeedReport,
    StandstillReport,
    TankReport,
    Telemetry,
    UtcReport,
    WindReport,
)

__all__ = [
    "AttitudeReport", "BatteryReport", "ClockReport", "Decision", "DeclarationReport",
    "DriveChange", "DrivePlan", "EstimatorReport", "EstopReport", "FaultKind", "Finding", "Fix",
    "FlowReport", "FlowTrimState", "GnssReport", "HeartbeatReport", "ImuReport", "Inhibit",
    "Input", "LandedReport", "LegReport", "Method", "MissionLeg", "OperatorCommand",
    "OutputReport", "PressureReport", "RangeReport", "RateOverride", "RcReport", "SpeedReport",
    "SprayPlan", "SprayerState", "StandstillReport", "StopAhead", "TankReport", "Telemetry",
    "TimedChange", "UtcReport", "VehicleState", "WindReport",
]  # fmt: skip


# What goes out: the future of all valves and drives until a lease ends.


@dataclass(frozen=True, slots=True, kw_only=True)
class PwmLimits:
    """What the valves can follow; `duty_max` is the last duty below fully open."""

    frequency_hz: float
    duty_min: float
    duty_max: float
    min_on_s: float
    min_off_s: float

    def __post_init__(self) -> None:
        if not 0.1 <= self.frequency_hz <= 1000.0:
            raise ValueError(f"frequency_hz must lie in [0.1, 1000], got {self.frequency_hz}")
        if not 0.0 <= self.duty_min < self.duty_max <= 1.0:
            raise ValueError(
                f"0 <= duty_min < duty_max <= 1 must hold, got {self.duty_min}, {self.duty_max}"
            )
        if not (self.min_on_s >= 0.0 and self.min_off_s >= 0.0):
            raise ValueError("min_on_s and min_off_s must not be negative")
        if not self.min_on_s + self.min_off_s < self.period_s:
            raise ValueError("min_on_s and min_off_s together must be shorter than a period")

    @property
    def period_s(self) -> float:
        """Return the length of a PWM period."""
        return 1.0 / self.frequency_hz


def _wrong_in_change(at_s: float, valve: int, duty: float) -> str:
    if not 0.0 <= duty <= 1.0:
        return f"duty outside [0, 1]: {duty}"
    if not abs(at_s) < math.inf:
        return f"time of a change is not finite: {at_s}"
    return f"valve index is negative: {valve}"


@dataclass(frozen=True, slots=True, kw_only=True, init=False)
class TimedChange:
    """Valve number `valve` (index from the left) takes `duty` at `at_s`.

    `restart` marks a change of zone: the executor begins a new PWM period there. Without it (a
    trim for the speed) the next period is early enough.
    """

    at_s: float
    valve: int
    duty: float
    restart: bool = True

    def __init__(self, *, at_s: float, valve: int, duty: float, restart: bool = True) -> None:
        # Written out: each step makes several for every valve, and checks before it stores.
        if not (0.0 <= duty <= 1.0 and -math.inf < at_s < math.inf and valve >= 0):
            raise ValueError(_wrong_in_change(at_s, valve, duty))
        put = object.__setattr__
        put(self, "at_s", at_s)
        put(self, "valve", valve)
        put(self, "duty", duty)
        put(self, "restart", restart)

    def of_valve(self, valve: int) -> TimedChange:
        """Return the same change of another valve: what was checked is not checked again.

        In mid-zone each step makes two for every valve, and this takes less than half the time.
        """
        made = object.__new__(TimedChange)
        put = object.__setattr__
        put(made, "at_s", self.at_s)
        put(made, "valve", valve)
        put(made, "duty", self.duty)
        put(made, "restart", self.restart)
        return made


@dataclass(frozen=True, slots=True, kw_only=True)
class DriveChange:
    """A motor takes `fraction` of its range at `at_s`."""

    at_s: float
    fraction: float

    def __post_init__(self) -> None:
        if not 0.0 <= self.fraction <= 1.0:
            raise ValueError(f"fraction outside [0, 1]: {self.fraction}")
        if not abs(self.at_s) < float("inf"):
            raise ValueError(f"time of a change is not finite: {self.at_s}")


@dataclass(frozen=True, slots=True, kw_only=True)
class DrivePlan:
    """What a motor (a pump, an atomiser) does: 0 is stopped, 1 the end of its range.

    `fraction` holds from the plan's `issued_s`; `changes` follow in order of time.
    """

    fraction: float
    changes: tuple[DriveChange, ...] = ()

    def __post_init__(self) -> None:
        if not 0.0 <= self.fraction <= 1.0:
            raise ValueError(f"fraction outside [0, 1]: {self.fraction}")
        if not all(a.at_s <= b.at_s for a, b in pairwise(self.changes)):
            raise ValueError("changes of a drive are not in order of time")

    @property
    def is_off(self) -> bool:
        """Whether it stands still, now and later."""
        return not self.fraction and not any(change.fraction for change in self.changes)

    def at(self, now_s: float) -> float:
        """Return the fraction at `now_s`; the lease is the plan's to mind.

        >>> DrivePlan(fraction=0.0, changes=(DriveChange(at_s=1.0, fraction=0.4),)).at(1.0)
        0.4
        """
        fraction = self.fraction
        for change in self.changes:
            if not change.at_s <= now_s:
                break
            fraction = change.fraction
        return fraction


@dataclass(frozen=True, slots=True, kw_only=True)
class SprayPlan:
    """The whole future of all valves and drives, until the lease ends; closed after that.

    `duty` holds from `issued_s`, one value a valve; `changes` follow in order of time. A newer
    plan (by `sequence`) replaces what has not happened yet. An executor that is given the same
    duty again does nothing. `drives` are the pump, where there is one, and the atomisers in the
    order of their tables; a plan without any has them all stopped.
    """

    sequence: int
    issued_s: float
    duty: tuple[float, ...]
    changes: tuple[TimedChange, ...]
    lease_until_s: float
    drives: tuple[DrivePlan, ...] = ()

    def __post_init__(self) -> None:
        # Plain loops: twenty times a second, half the time of generators.
        for duty in self.duty:
            if not 0.0 <= duty <= 1.0:
                raise ValueError(f"duty outside [0, 1]: {self.duty}")
        if not self.issued_s < self.lease_until_s < math.inf:
            raise ValueError(f"lease ends at {self.lease_until_s}, issued at {self.issued_s}")
        count, before_s = len(self.duty), -math.inf
        for change in self.changes:
            if change.valve >= count:
                raise ValueError("a change names a valve that the plan does not have")
            if not before_s <= change.at_s:
                raise ValueError("changes are not in order of time")
            before_s = change.at_s

    @property
    def is_off(self) -> bool:
        """Whether every valve is closed and every drive stopped, now and later."""
        return not self.opens and all(drive.is_off for drive in self.drives)

    def duty_at(self, at_s: float) -> tuple[float, ...]:
        """Return what the plan has brought about by a time: its changes so far; closed after it.

        >>> off = TimedChange(at_s=0.2, valve=0, duty=0.0)
        >>> plan = SprayPlan(
        ...     sequence=1, issued_s=0.0, duty=(0.5, 0.5), changes=(off,), lease_until_s=0.3)
        >>> plan.duty_at(0.1), plan.duty_at(0.2), plan.duty_at(0.3)
        ((0.5, 0.5), (0.0, 0.5), (0.0, 0.0))
        """
        if not at_s < self.lease_until_s:
            return (0.0,) * len(self.duty)
        changes = self.changes
        if not changes or changes[0].at_s > at_s:
            return self.duty
        duty = list(self.duty)
        for change in changes:
            if change.at_s > at_s:
                break
            duty[change.valve] = change.duty
        return tuple(duty)

    def duties_until(self, until_s: float) -> Iterator[tuple[float, tuple[float, ...]]]:
        """Yield (time, duty of each valve) of all that the plan brings about by a time, in order.

        The first is that of its issue, the last, where the lease has ended by then, is closed.
        """
        duty = list(self.duty)
        yield self.issued_s, self.duty
        for change in self.changes:
            if change.at_s > until_s or change.at_s >= self.lease_until_s:
                break
            duty[change.valve] = change.duty
            yield max(change.at_s, self.issued_s), tuple(duty)
        if self.lease_until_s <= until_s:
            yield self.lease_until_s, (0.0,) * len(duty)

    def fraction_at(self, drive: int, at_s: float) -> float:
        """Return what the plan has brought a drive to by a time; 0 after it, or without it."""
        if not at_s < self.lease_until_s or drive >= len(self.drives):
            return 0.0
        return self.drives[drive].at(at_s)

    @property
    def opens(self) -> bool:
        """Whether a valve is open, now or later."""
        return any(self.duty) or any(change.duty for change in self.changes)


class Method(StrEnum):
    """How a change of rate is placed; see `schedule.py`."""

    NONE = "none"
    LOOK_AHEAD = "look-ahead"
    SCHEDULED = "scheduled"


class Inhibit(StrEnum):
    """Every reason not to spray: in the journal, on the page, in STATUSTEXT."""

    ESTOP = "estop"
    REARM_NEEDED = "rearm-needed"  # the cause of a fault or a stop is gone, nobody has said so
    NOT_ENABLED = "not-enabled"
    NO_POSITION = "no-position"
    STALE_POSITION = "stale-position"
    INVALID_POSITION = "invalid-position"
    POSITION_FROZEN = "position-frozen"
    CLOCK_DISAGREES = "clock-disagrees"  # when the positions are from is not known
    FAR_FROM_FIELD = "far-from-field"
    NO_HEARTBEAT = "no-heartbeat"
    STALE_HEARTBEAT = "stale-heartbeat"
    NOT_ARMED = "not-armed"
    NOT_ACTIVE = "not-active"
    WRONG_MODE = "wrong-mode"
    NOT_IN_AIR = "not-in-air"
    FIX_TOO_LOW = "fix-too-low"
    ACCURACY_TOO_LOW = "accuracy-too-low"
    ESTIMATOR_UNHEALTHY = "estimator-unhealthy"
    HEADING_UNKNOWN = "heading-unknown"
    SPEED_UNKNOWN = "speed-unknown"
    SPEED_BELOW_MIN = "speed-below-min"
    SPEED_ABOVE_MAX = "speed-above-max"
    SPEED_DISAGREES = "speed-disagrees"
    SPEED_UNCHECKED = "speed-unchecked"
    HEIGHT_BELOW_MIN = "height-below-min"
    HEIGHT_ABOVE_MAX = "height-above-max"
    WIND_ABOVE_MAX = "wind-above-max"
    WIND_UNKNOWN = "wind-unknown"
    LABEL_SPEED = "label-speed"
    LABEL_HEIGHT = "label-height"
    LABEL_WIND = "label-wind"
    LABEL_WIND_DIRECTION = "label-wind-direction"
    LABEL_TIME = "label-time"
    LABEL_WEATHER_AGE = "label-weather-age"
    LABEL_TEMPERATURE = "label-temperature"
    LABEL_HUMIDITY = "label-humidity"
    LABEL_INVERSION = "label-inversion"
    LABEL_DROPLETS = "label-droplets"
    RC_SWITCH = "rc-switch"
    OUTPUT_FAULT = "output-fault"
    LINK_LOST = "link-lost"
    UNGUARDED = "unguarded"  # nothing would close when this computer fails
    LEAK = "leak"
    VALVE_STUCK_OPEN = "valve-stuck-open"
    NO_FLOW = "no-flow"
    TANK_EMPTY = "tank-empty"
    FLOW_FAULT = "flow-fault"

    @property
    def words(self) -> str:
        """Return what it is called on every screen.

        >>> Inhibit.NOT_ARMED.words, Inhibit.SPEED_BELOW_MIN.words
        ('not armed', 'too slow')
        """
        return _WORDS.get(self, self.value.replace("-", " "))


# What a reason is called on the operator's screen, where its own name does not say it.
_WORDS = {
    Inhibit.ESTOP: "emergency stop",
    Inhibit.REARM_NEEDED: "disable, then enable again",
    Inhibit.STALE_POSITION: "position too old",
    Inhibit.INVALID_POSITION: "position not confirmed",
    Inhibit.STALE_HEARTBEAT: "heartbeat lost",
    Inhibit.NOT_ACTIVE: "vehicle not active",
    Inhibit.WRONG_MODE: "wrong flight mode",
    Inhibit.NOT_IN_AIR: "not flying",
    Inhibit.FIX_TOO_LOW: "GNSS fix too poor",
    Inhibit.ACCURACY_TOO_LOW: "GNSS accuracy too poor",
    Inhibit.ESTIMATOR_UNHEALTHY: "EKF unhealthy",
    Inhibit.SPEED_BELOW_MIN: "too slow",
    Inhibit.SPEED_ABOVE_MAX: "too fast",
    Inhibit.SPEED_DISAGREES: "speeds disagree",
    Inhibit.SPEED_UNCHECKED: "speed not checked",
    Inhibit.HEIGHT_BELOW_MIN: "too low",
    Inhibit.HEIGHT_ABOVE_MAX: "too high",
    Inhibit.WIND_ABOVE_MAX: "too much wind",
    Inhibit.LABEL_SPEED: "speed outside label",
    Inhibit.LABEL_HEIGHT: "height outside label",
    Inhibit.LABEL_WIND: "wind outside label",
    Inhibit.LABEL_WIND_DIRECTION: "wind direction outside label",
    Inhibit.LABEL_TIME: "outside label hours",
    Inhibit.LABEL_WEATHER_AGE: "weather report too old",
    Inhibit.LABEL_TEMPERATURE: "temperature outside label",
    Inhibit.LABEL_HUMIDITY: "humidity outside label",
    Inhibit.LABEL_INVERSION: "inversion not ruled out",
    Inhibit.LABEL_DROPLETS: "droplets outside label",
    Inhibit.RC_SWITCH: "RC switch off",
    Inhibit.UNGUARDED: "no watchdog script or board",
}


class SprayerState(StrEnum):
    """What the sprayer may do; see `safety.py`. Their order is that of `SPR_STATE`."""

    BOOT = "boot"  # vehicle and position were not heard yet
    SAFE = "safe"  # closed, something is missing
    READY = "ready"  # closed, only the operator, the take-off or the mission is missing
    ARMED = "armed"  # may open; closed because nothing is prescribed here, or too slow or high
    SPRAYING = "spraying"
    FAULT = "fault"  # latched
    ESTOP = "estop"  # latched


class FlowTrimState(StrEnum):
    """What the slow trim of the flow does and has to say; see `options/flow_trim.py`."""

    TRACKING = "tracking"
    FROZEN = "frozen"  # as it has to be: closed, a change, an end of the range, too little flow
    NO_METER = "no-meter"  # no count, or none that is young and sound
    AT_LIMIT = "at-limit"  # for too long: it cannot correct what is wrong
    SUDDEN_CHANGE = "sudden-change"  # held: a clog or a leak, not a drift
    IMPLAUSIBLE = "implausible"  # the meter is too far from the table


class FaultKind(StrEnum):
    """What is wrong between the tank and the nozzles; see `liquid_faults.py`."""

    CLOG = "clog"  # nozzles or the way to them let less through
    STUCK_CLOSED = "stuck-closed"  # the flow of one valve is missing
    LEAK = "leak"
    STUCK_OPEN = "stuck-open"
    SUPPLY = "supply"  # pump, regulator or suction: flow and pressure agree with each other
    AIR = "air"
    PUMP_OFF = "pump-off"
    TANK_EMPTY = "tank-empty"
    TANK_LOW = "tank-low"  # at its reserve
    NO_FLOW = "no-flow"  # nothing of what is ordered comes, and no more is known
    DEAD_METER = "dead-meter"
    METER_FAULT = "meter-fault"  # the meter says so itself, or is silent
    PRESSURE_FAULT = "pressure-fault"
    TANK_FAULT = "tank-fault"
    VALVE_DRIFT = "valve-drift"  # in older journals only


@dataclass(frozen=True, slots=True, kw_only=True)
class MissionLeg:
    """The leg of its mission that the vehicle now flies, in the flight's frame.

    `longer` is another leg of the mission, on which this one lies whole.
    """

    received_s: float
    from_east_m: float
    from_north_m: float
    to_east_m: float
    to_north_m: float
    longer: MissionLeg | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class StopAhead:
    """The vehicle will stop so far ahead along its course, braking so hard; see `braking.py`."""

    distance_m: float
    braking_m_s2: float


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleState:
    """Where the autopilot's position reference is and how it moves, true at `time_s`.

    East and north are metres in the flight's `LocalFrame`. Heading (the nose) is not course (the
    motion). What follows `position_received_s` says how far the rest may be trusted.
    """

    time_s: float
    east_m: float
    north_m: float
    velocity_east_m_s: float
    velocity_north_m_s: float
    acceleration_east_m_s2: float
    acceleration_north_m_s2: float
    heading_deg: float | None
    yaw_rate_deg_s: float
    height_m: float
    velocity_known: bool
    position_received_s: float
    position_valid: bool
    checked_speed_m_s: float | None
    fix: Fix | None
    estimator_healthy: bool | None
    heartbeat_received_s: float | None
    armed: bool
    mode: str | None
    in_air: bool | None
    wind_m_s: float | None
    output_healthy: bool
    enabled: bool
    flow: FlowReport | None = None
    pressure: PressureReport | None = None
    tank: TankReport | None = None
    wind: WindReport | None = None  # where its direction is known
    rate_percent: float = 100.0
    wind_received_s: float | None = None
    output_guarded: bool = True
    position_frozen: bool = False  # the place stands still, the vehicle does not
    rc_switch_on: bool | None = None  # None: no switch, or nothing young is known of it
    acceleration_fade_s: float = 0.5  # the acceleration's time constant in every prediction
    # How much faster the place goes than the velocity by which it is dosed (`motion.py`).
    outrun_east_m_s: float = 0.0
    outrun_north_m_s: float = 0.0
    yaw_gain_deg_s2: float = 0.0  # how fast the turn itself changes; it fades (`motion.py`)
    stop_ahead: StopAhead | None = None  # None: no mission is used, or it says of no stop
    horizontal_accuracy_m: float | None = None  # None: the receiver does not tell
    link_up: bool = True
    estop: bool | None = None  # None: no switch has been heard of
    active: bool = True
    operator_wishes: int = 0  # how often the operator has enabled anew, or disabled
    mission_leg: MissionLeg | None = None  # None: it is not used, or nothing was heard of it
    mission_leg_before: MissionLeg | None = None  # the one that it was before, last heard of then
    clock_agrees: bool = True  # what is known of the autopilot's clock goes together
    # Seconds since 1970 less our clock; None: not known, or nothing is limited to hours.
    utc_offset_s: float | None = None
    declared: DeclarationReport | None = None  # None: only what was declared before the start


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """A fault between the tank and the nozzles, in words; `valve` where it can be told."""

    kind: FaultKind
    at_s: float
    text: str
    valve: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Decision:
    """One step of the core: one row of the journal. Replay must give the same again.

    `rate_l_ha` is what each valve's footprint is prescribed now (`None`: nothing, closed).
    `flow_l_min` is the flow that the duties now in force stand for, all valves together; with a
    trim its best estimate, the table's flow times the trim. `flow_trim` is that of the nozzle set
    in use, `None` where none is configured.
    """

    now_s: float
    state: VehicleState | None
    inhibits: frozenset[Inhibit]
    plan: SprayPlan
    rate_l_ha: tuple[float | None, ...]
    target_flow_l_min: float
    flow_l_min: float
    late_count: int = 0
    unresolved_count: int = 0
    flow_trim: float | None = None
    flow_trim_state: FlowTrimState | None = None
    findings: tuple[Finding, ...] = ()
    sprayer: SprayerState = SprayerState.BOOT
    out_of_range_count: int = 0  # valves whose prescribed rate they cannot deliver at this speed
