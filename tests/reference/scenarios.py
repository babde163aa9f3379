"""What a scenario file of `vrspray sitl serve` can hold: tables, keys, and every fault."""

from __future__ import annotations

from companion.config.wording import _schema_at
from sitl.liquid_faults import LiquidFaultKind
from sitl.scenario_file import ScenarioFile
from sitl.stub.faults import KEYS, FaultKind

INTRODUCTION = """# Scenario files

`vrspray sitl serve --scenario FILE` reads a TOML file that changes the simulated vehicle and lets
things go wrong at a given time. What is not known is refused with exit code 2. Ready ones are in
`examples/anyang/scenarios`; those that begin with `px4-` need `--autopilot px4`.
"""
MEANINGS: dict[str, str] = {
    "firmware.version": 'such as `"1.14.1"`: PX4 from 1.14.0 on; ArduPilot only reports it',
    "firmware.commands_per_s": "PX4: commands that its queue takes in the long run",
    "position.lag_s": "how old a position is when it is sent",
    "position.wire_s": "how long it is on its way",
    "position.white_m": "white noise",
    "position.drift_m": "slow noise",
    "position.drift_time_s": "time constant of the slow noise",
    "position.velocity_m_s": "noise of the velocity",
    "position.velocity_drift_m_s": "a velocity error that drifts (1 sd); 0",
    "position.velocity_drift_time_s": "and its time constant; 30",
    "clock.drift_ppm": "how fast the vehicle's clock drifts",
    "clock.uptime_s": "for how long it has run; it wraps at 4294967.296",
    "wind.speed_m_s": "the wind that the vehicle reports; nothing is blown away",
    "wind.from_deg": "where it comes from",
    "box.closed_s": "a driver box that ignores its input until it has seen the closed pulse for so long",
    "sensors.meter_battery": "ArduPilot: number of the battery monitor that is the flow meter",
    "sensors.tank_battery": "ArduPilot: number of the battery monitor that is the tank",
    "sensors.tank_l": "what is in the tank",
    "signing.key": "64 hexadecimal digits: everything is signed, and nothing unsigned is heard",
}
FAULTS: dict[FaultKind, str] = {
    FaultKind.ACK_LOST: "acknowledgements are lost: a `fraction` of them, of one `command` or of all",
    FaultKind.ACK_LATE: "acknowledgements come late",
    FaultKind.ACK_DOUBLED: "acknowledgements come twice",
    FaultKind.ACK_IN_PROGRESS: "IN_PROGRESS comes first, the result later",
    FaultKind.COMMAND_BLOCKED: "a script has taken the command: nothing is done or acknowledged",
    FaultKind.SERVO_REFUSED: "DO_SET_SERVO fails, as for a channel in use",
    FaultKind.NO_POSITION: "GLOBAL_POSITION_INT stops",
    FaultKind.STALE_POSITION: "the last position goes on with zero velocity, as ArduPilot does without "
    "an estimate; on PX4 the stream stops",
    FaultKind.EKF_LOST: "the estimator reports no position, while positions go on",
    FaultKind.ZERO_POSITION: "latitude and longitude are 0",
    FaultKind.EXTREME_POSITION: "latitude and longitude are the largest numbers of their fields",
    FaultKind.HEADING_UNKNOWN: "the heading is 65535",
    FaultKind.GPS_DROP: "the receiver has no fix, or the worse one given",
    FaultKind.CLOCK_WRAP: "`time_boot_ms` wraps after `delay_s`",
    FaultKind.CLOCK_BACKWARDS: "the clock, and TIMESYNC with it, goes back by `delay_s`",
    FaultKind.REBOOT: "clock, streams and outputs start again",
    FaultKind.GARBAGE: "bursts of random bytes between frames",
    FaultKind.CORRUPT: "one wrong byte in a frame",
    FaultKind.TRUNCATED: "frames are cut short",
    FaultKind.MAVLINK1: "frames come in MAVLink 1",
    FaultKind.UNKNOWN_ID: "frames of unknown ids come before the others",
    FaultKind.SIGNED: "frames are signed with a key that nobody knows",
    FaultKind.PARAM_LOST: "PARAM_VALUE and PARAM_SET are lost",
    FaultKind.SECOND_COMPANION: "another component with the companion's number sends heartbeats",
    FaultKind.SECOND_VEHICLE: "a second vehicle flies 33 m from home, armed, with positions at 10 Hz",
    FaultKind.STATION_RATES: "a ground station on the same link sets all rates again and again",
    FaultKind.SAFETY_SWITCH: "ArduPilot's safety switch is on: no pulses",
    FaultKind.RC: "the pilot moves a control",
    FaultKind.KILL: "PX4: the outputs show `PWM_MAIN_DISn`",
    FaultKind.TERMINATE: "PX4: the outputs show `PWM_MAIN_FAILn`",
    FaultKind.FOREIGN: "heartbeats of a gimbal, a transponder, a ground station and a second vehicle",
    FaultKind.SLOW_STREAMS: "every stream is slower by `factor`",
    FaultKind.SILENCE: "nothing goes out and nothing comes in",
    FaultKind.MODE: "the pilot changes to that mode number, and back to AUTO at the end",
}
LIQUID: dict[LiquidFaultKind, str] = {
    LiquidFaultKind.CLOG: "one `valve`, or all, let less through, by `share`",
    LiquidFaultKind.STUCK_CLOSED: "a `valve` does not open",
    LiquidFaultKind.STUCK_OPEN: "a `valve` does not close",
    LiquidFaultKind.LEAK: "a `share` of the full flow leaks",
    LiquidFaultKind.SUPPLY: "the supply delivers less, by `share`",
    LiquidFaultKind.AIR: "air in the line",
    LiquidFaultKind.PUMP_OFF: "the pump is off",
    LiquidFaultKind.TANK_EMPTY: "the tank is empty",
    LiquidFaultKind.NO_FLOW: "nothing flows",
    LiquidFaultKind.DEAD_METER: "the flow meter is silent",
}


def page() -> str:
    """Return the page; KeyError for a key or a fault that is not described."""
    parts = [INTRODUCTION, "## Tables\n\n| Key | Meaning | Range |\n|---|---|---|"]
    schema = ScenarioFile.model_json_schema()
    for table in schema["properties"]:
        for key in _schema_at([table], schema).get("properties", {}):
            node = _schema_at([table, key], schema)
            low_high = node.get("minimum"), node.get("maximum")
            limits = "" if None in low_high else "{:g} to {:g}".format(*low_high)
            parts.append(f"| `{table}.{key}` | {MEANINGS[f'{table}.{key}']} | {limits} |")
    parts.append(
        "| `parameters.NAME` | an autopilot's parameter at the start, such as `SERVO9_FUNCTION = 94` | |"
    )
    parts.append(
        "\n## Faults\n\nA `[[fault]]` table has a `kind`, `at_s`, and if wanted `duration_s` (without it: "
        'to the end) and `since` (`"start"` of the stub, or `"take-off"`).\n\n'
        "| Kind | Further keys | What happens |\n|---|---|---|"
    )
    for kind, meaning in FAULTS.items():
        keys = ", ".join(f"`{key}`" for key in KEYS.get(kind, ()))
        parts.append(f"| `{kind.value}` | {keys} | {meaning} |")
    parts.append(
        "\n## Faults of the liquid\n\nA `[[liquid]]` table acts on the sprayer, its sensors and its truth from "
        '`at_s` on, counted from `since`: `"start"` (the default), `"take-off"` or `"spraying"`, the first '
        "open valve. Valves are counted from the left, from 1.\n\n| Kind | What happens |\n|---|---|"
    )
    parts += [f"| `{kind.value}` | {LIQUID[kind]} |" for kind in LiquidFaultKind]
    missing = set(FaultKind) - set(FAULTS)
    if missing:
        raise KeyError(f"faults without a description: {missing}")
    return "\n".join(parts)
