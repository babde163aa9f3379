"""Every reason not to spray: what must hold, where it comes from, and what ends it."""

from __future__ import annotations

import re

from companion.config.tables import SafetyTable
from companion.core.types import Inhibit
from companion.link.announcer import reasons

INTRODUCTION = """# Reasons not to spray

A valve can open only while none of these reasons holds. A value that is missing, too old, from the
future or NaN closes the valves. Messages about the vehicle count only from its own autopilot.

The journal names a reason as in the first column; the ground station shows the words below it after
`Spray off:`. *Inside* means that a value has to be that far inside its limit again, so that noise does
not open and close the valves.
"""
_POSITION = "`safety.position_age_max_s` (0.8 s)"
_BEAT = "`safety.heartbeat_age_max_s` (2.5 s)"
_LIQUID = ("flow meter, pressure, tank", "-", "as a latch")
_DECLARED = ("the operator", "-", "declared anew on the ground")
# Condition to spray; source; maximum age; when the valves may open again.
CONDITIONS: dict[Inhibit, tuple[str, str, str, str]] = {
    Inhibit.ESTOP: (
        "no emergency stop is pressed; with `safety.estop_line` the switch has reported",
        "its line, command 31014", "-", "as a latch: disable, then enable",
    ),
    Inhibit.REARM_NEEDED: (
        "no fault or emergency stop waits for the operator", "the companion", "-",
        "disable, then enable",
    ),
    Inhibit.NOT_ENABLED: (
        "the operator has enabled spraying since the start; disarming, leaving the mode, an emergency "
        "stop or 10 s without heartbeats takes that back",
        "`MAV_CMD_DO_SPRAYER`, or the RC switch being turned on", "-", "after enabling",
    ),
    Inhibit.NO_POSITION: ("a position has arrived", "GLOBAL_POSITION_INT", _POSITION, "at once"),
    Inhibit.STALE_POSITION: (
        "the newest position is recent, counted from its sending where that is known",
        "GLOBAL_POSITION_INT", _POSITION, "at once",
    ),
    Inhibit.INVALID_POSITION: (
        "latitude and longitude are valid and not 0, 0, and the position has not jumped by more than 2 m",
        "GLOBAL_POSITION_INT", _POSITION, "after five positions",
    ),
    Inhibit.POSITION_FROZEN: (
        "position and motion are consistent", "GLOBAL_POSITION_INT, VFR_HUD", _POSITION,
        "after five positions",
    ),
    Inhibit.CLOCK_DISAGREES: (
        "it is known when positions were measured: TIMESYNC exchanges agree with each other and with "
        "the arrival of positions", "TIMESYNC, GLOBAL_POSITION_INT", "5 s",
        "after three exchanges that agree (0.6 to 3 s)",
    ),
    Inhibit.FAR_FROM_FIELD: (
        "less than 20 km from the map", "GLOBAL_POSITION_INT", _POSITION, "at once",
    ),
    Inhibit.NO_HEARTBEAT: ("a heartbeat has arrived", "HEARTBEAT", _BEAT, "at once"),
    Inhibit.STALE_HEARTBEAT: ("the newest heartbeat is recent", "HEARTBEAT", _BEAT, "at once"),
    Inhibit.NOT_ARMED: ("the vehicle is armed", "HEARTBEAT", _BEAT, "after enabling"),
    Inhibit.NOT_ACTIVE: (
        "the vehicle reports MAV_STATE_ACTIVE, not standby, critical (a failsafe) or emergency",
        "HEARTBEAT", _BEAT, "at once",
    ),
    Inhibit.WRONG_MODE: (
        "the flight mode is one of `safety.modes`; `AUTO` includes PX4's `MISSION`", "HEARTBEAT", _BEAT,
        "after enabling",
    ),
    Inhibit.NOT_IN_AIR: (
        "`landed_state` is IN_AIR, not taking off, landing or unknown", "EXTENDED_SYS_STATE", "5 s",
        "at once",
    ),
    Inhibit.FIX_TOO_LOW: (
        "the fix is at least `safety.fix`; static and PPP count as 3D", "GPS_RAW_INT", "5 s",
        "1 s later",
    ),
    Inhibit.ACCURACY_TOO_LOW: (
        "the receiver's own horizontal accuracy is `safety.accuracy_max_m` or better (0.3 m where "
        "`safety.fix` asks for RTK, else unchecked)", "GPS_RAW_INT", "5 s", "1 s later",
    ),
    Inhibit.ESTIMATOR_UNHEALTHY: (
        "the estimator has a velocity and a position and reports no glitch; its ratios are below 0.8 "
        "(ArduPilot) or 1 (PX4)", "EKF_STATUS_REPORT, ESTIMATOR_STATUS", "5 s", "1 s later",
    ),
    Inhibit.HEADING_UNKNOWN: (
        "the heading is 0 to 360 degrees", "GLOBAL_POSITION_INT", _POSITION, "at once",
    ),
    Inhibit.SPEED_UNKNOWN: (
        "there is a velocity, or VFR_HUD's speed", "GLOBAL_POSITION_INT, VFR_HUD",
        f"{_POSITION}; 1 s", "at once",
    ),
    Inhibit.SPEED_BELOW_MIN: (
        "the filtered speed is at least `safety.speed_min_m_s` (1)", "GLOBAL_POSITION_INT", _POSITION,
        "0.1 m/s inside",
    ),
    Inhibit.SPEED_ABOVE_MAX: (
        "the filtered speed is at most `safety.speed_max_m_s` (12)", "GLOBAL_POSITION_INT", _POSITION,
        "0.1 m/s inside",
    ),
    Inhibit.SPEED_DISAGREES: (
        "two measured speeds differ by at most `safety.speed_disagreement_max_m_s` (1)", "VFR_HUD",
        "1 s", "0.1 m/s inside",
    ),
    Inhibit.SPEED_UNCHECKED: (
        "the second speed arrives; `safety.speed_check_required = false` turns this off", "VFR_HUD",
        "1 s", "at once",
    ),
    Inhibit.HEIGHT_BELOW_MIN: (
        "the height is at least `safety.height_min_m` (1): by a sensor that looks down, else above home",
        "DISTANCE_SENSOR, GLOBAL_POSITION_INT", f"1 s; {_POSITION}", "0.3 m inside",
    ),
    Inhibit.HEIGHT_ABOVE_MAX: (
        "the height is at most `safety.height_max_m` (10)", "DISTANCE_SENSOR, GLOBAL_POSITION_INT",
        f"1 s; {_POSITION}", "0.3 m inside",
    ),
    Inhibit.WIND_ABOVE_MAX: (
        "the last reported wind is at most `safety.wind_max_m_s` (6)", "WIND, WIND_COV", "-",
        "0.5 m/s inside",
    ),
    Inhibit.WIND_UNKNOWN: (
        "with `safety.wind_required`: the wind is known; exactly 0, and a wind that never changes, do "
        "not count", "WIND, WIND_COV", "`safety.wind_age_max_s` (5 s)", "at once",
    ),
    Inhibit.LABEL_SPEED: (
        "with `[limits]`: the speed lies within the file's", "GLOBAL_POSITION_INT", _POSITION,
        "0.1 m/s inside",
    ),
    Inhibit.LABEL_HEIGHT: (
        "with `[limits]`: the height lies within the file's", "DISTANCE_SENSOR, GLOBAL_POSITION_INT",
        f"1 s; {_POSITION}", "0.3 m inside",
    ),
    Inhibit.LABEL_WIND: (
        "with `[limits]`: the wind lies within the file's; unknown is not within, unless "
        '`wind_by = "operator"`', "WIND, WIND_COV", "`safety.wind_age_max_s`", "0.5 m/s inside",
    ),
    Inhibit.LABEL_WIND_DIRECTION: (
        "with `[limits]`: the wind comes from one of the file's sectors", "WIND, WIND_COV",
        "`safety.wind_age_max_s`", "at once",
    ),
    Inhibit.LABEL_TIME: (
        "with `[limits]`: it is one of the file's days and hours", "SYSTEM_TIME", "60 s", "at once",
    ),
    Inhibit.LABEL_WEATHER_AGE: (
        "with `[limits]`: what the operator declares of the weather is not older than the file's "
        "`observed_max_h`", "`application.observed_at`, SYSTEM_TIME", "60 s",
        "observed anew, and declared",
    ),
    Inhibit.LABEL_TEMPERATURE: ("with `[limits]`: `application.temperature_c` is within", *_DECLARED),
    Inhibit.LABEL_HUMIDITY: ("with `[limits]`: `application.humidity_percent` is within", *_DECLARED),
    Inhibit.LABEL_INVERSION: (
        'with `[limits]`: `application.inversion = "no"` where the file forbids one', *_DECLARED,
    ),
    Inhibit.LABEL_DROPLETS: ("with `[limits]`: `product.droplet_class` is one of the file's", *_DECLARED),
    Inhibit.RC_SWITCH: (
        "with `safety.rc_channel`: the channel is at 1300 to 2300 µs, whoever enabled", "RC_CHANNELS",
        "2 s", "switch on, then enable",
    ),
    Inhibit.OUTPUT_FAULT: (
        "the outputs work; the journal can be written", "the companion", "-",
        "as a latch; restart after a rejected order or a fault of the valve engine",
    ),
    Inhibit.LINK_LOST: (
        "the link is up and belongs to one vehicle", "the companion", "-",
        "when the vehicle is heard again",
    ),
    Inhibit.UNGUARDED: (
        'with `output.guard = "auto"`: something closes servo outputs when the companion loses power or its link: '
        "`SPRW_ENABLE` is 1, or `output.dither_us` is set", "PARAM_VALUE", "-", "at once",
    ),
    Inhibit.LEAK: ("no flow while all valves are closed", *_LIQUID),
    Inhibit.VALVE_STUCK_OPEN: ("no more flow than was ordered", *_LIQUID),
    Inhibit.NO_FLOW: ("liquid flows when it is ordered", *_LIQUID),
    Inhibit.TANK_EMPTY: ("there is liquid in the tank", *_LIQUID),
    Inhibit.FLOW_FAULT: ("flow and pressure go together with the orders", *_LIQUID),
}  # fmt: skip


def page() -> str:
    """Return the page; KeyError for a reason that is not described."""
    rows = [
        INTRODUCTION,
        "| Reason | Condition to spray | Source | Maximum age | Opens again |\n|---|---|---|---|---|",
    ]
    for one in Inhibit:
        words = reasons(frozenset({one}))[0].removeprefix("Spray off: ")
        cells = (f"`{one.value}`<br>{words}", *CONDITIONS[one])
        rows.append(f"| {' | '.join(cells)} |")
    return re.sub(r"`safety\.(\w+)` \((\d[\d.]*)", _with_default, "\n".join(rows))


def _with_default(found: re.Match[str]) -> str:
    """Return the key with the default that the configuration has now."""
    default = SafetyTable.model_fields[found[1]].default
    return f"`safety.{found[1]}` ({default:g}"
