"""Which flights are recorded: all that the core is asked to do, in 20 s to 40 s each."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from companion.core.types import (
    BatteryReport,
    EstopReport,
    Input,
    LandedReport,
    OperatorCommand,
    OutputReport,
    RangeReport,
    RateOverride,
    RcReport,
    StandstillReport,
    TankReport,
    WindReport,
)
from sitl.liquid_faults import LiquidFault, LiquidFaultKind
from tests.golden.ground import AGAIN, BOTH, PASS, SHORT_LEGS, Places

RTK = "[position]\ndrift_m = 0.014\ndrift_time_s = 30.0\n"
METER = {"flow_meter.source": '"autopilot"'}
PULSES = {
    "flow_meter.source": '"gpio"',
    "flow_meter.line": "17",
    "flow_meter.pulses_per_l": "4600",
}
DETECTION = {"detection.enabled": "true"}
TRIM = {"flow_trim.enabled": "true", "flow_trim.tau_s": "2.0", "flow_trim.settle_s": "0.5"}
COVERED = {"coverage.record": "true"}
GUARD = {"coverage.switch_off_percent": "50.0"}
MISSION = {"prediction.use_mission": "true"}
# Lags of the lines of this computer, instead of those of an autopilot's outputs.
GPIO = {"lag.output_s": "0.001", "lag.on_s": "0.0918", "lag.off_s": "0.0949"}
EXCLUDED = {"prescription.exclusions": '["exclusion.geojson"]'}


@dataclass(frozen=True, kw_only=True)
class Flight:
    """One flight: ground, configuration and what happens; `over` says through which shell it goes.

    `wire` is the whole companion beside the stub autopilot, byte by byte, on a clock of its own;
    `twin` is the core in the closed loop without sockets, with pulses to the edge where it has
    valves. `extra` are inputs of a twin flight at their times, `held_s` is for how long vehicle
    and wire stand still at a time. `after` names the flight whose journal it goes on from, and
    `until_s` cuts one short. `small_set` is a nozzle set before that of the configuration.
    """

    over: str = "wire"
    autopilot: str = "ardupilot"
    base: str = "anyang"
    map: str = "plots"
    places: Places = PASS
    settings: Mapping[str, str] = field(default_factory=dict)
    scenario: str = ""
    seed: int = 5
    after: str | None = None
    until_s: float | None = None
    held_s: Callable[[float], float] = lambda _: 0.0
    twin: Mapping[str, Any] = field(default_factory=dict)
    extra: tuple[Input, ...] = ()
    speed_m_s: float = 5.0
    small_set: str = ""


def fault(kind: str, at_s: float, duration_s: float | None = None, **keys: object) -> str:
    """Return one fault of a scenario, counted from the take-off."""
    given = {"at_s": at_s} | ({} if duration_s is None else {"duration_s": duration_s}) | keys
    lines = "".join(f"{key} = {value}\n" for key, value in given.items())
    return f'[[fault]]\nkind = "{kind}"\nsince = "take-off"\n{lines}'


def liquid(kind: str, at_s: float, **keys: object) -> str:
    """Return one fault of the liquid, from the first spraying on, with a meter that sees it."""
    lines = "".join(f"{key} = {value}\n" for key, value in keys.items())
    return (
        "[sensors]\nmeter_battery = 1\n"
        f'[[liquid]]\nkind = "{kind}"\nsince = "spraying"\nat_s = {at_s}\n{lines}'
    )


def _gap(at_s: float) -> float:
    """Stand still for a second in the middle of a pass, and shortly every 3 s."""
    if 14.0 <= at_s < 15.0:
        return 15.0 - at_s
    return max(0.15 - at_s % 3.0, 0.0)


def _pulsed(kind: LiquidFaultKind | None = None, at_s: float = 8.0, **keys: Any) -> dict[str, Any]:
    faults = () if kind is None else (LiquidFault(kind=kind, from_s=at_s, **keys),)
    return {"meter_rate_hz": 20.0, "pressure_rate_hz": 20.0, "liquid_faults": faults}


def _levels(*levels: tuple[float, float | None]) -> tuple[Input, ...]:
    return tuple(TankReport(received_s=at_s, level_l=level_l) for at_s, level_l in levels)


PRESSURE = {
    "pressure.source": '"iio"',
    "pressure.duty": "[0.2, 0.5, 1.0]",
    "pressure.kpa": "[189.2, 227.0, 290.0]",
}
TANK = {"tank.source": '"flow"', "tank.capacity_l": "10.0"}
LIQUID = PULSES | PRESSURE | DETECTION | GPIO
# P1's eight of twelve nozzles.
EIGHT = """[[nozzle_set]]
valves = ["1", "2", "3", "4"]
duty = [0.2, 0.4, 0.5, 0.7, 0.8, 0.9, 1.0]
flow_l_min = [1.024, 1.872, 2.216, 3.144, 3.48, 4.168, 4.272]
"""
_RC_ON = (1500, 1500, 1000, 1500, 1000, 1000, 1000, 2000)
_RC_OFF = (1500, 1500, 1000, 1500, 1000, 1000, 1000, 1000)

FLIGHTS: dict[str, Flight] = {
    # The whole companion beside an ArduPilot, on its servo outputs.
    "ardupilot": Flight(scenario=RTK, settings=COVERED),
    "ardupilot-turn": Flight(scenario=RTK, settings=MISSION | COVERED | EXCLUDED, places=BOTH),
    "ardupilot-short-legs": Flight(scenario=RTK, settings=MISSION, places=SHORT_LEGS),
    "ardupilot-lines": Flight(settings={"mission.lines": '"lines.geojson"'} | COVERED),
    "ardupilot-volume": Flight(
        settings={"prescription.border": '"volume"', "prescription.across": '"mean"'}, places=BOTH
    ),
    "ardupilot-widest": Flight(
        settings={
            "prescription.across": '"max"',
            "prescription.default_rate_l_ha": "18.0",
            "prescription.border_buffer_m": "0.0",
            "boom.forward_m": "-0.8",
        }
    ),
    "ardupilot-look-ahead": Flight(settings={"lag.method": '"look-ahead"'}),
    "ardupilot-no-method": Flight(settings={"lag.method": '"none"'}),
    "ardupilot-overlapping": Flight(
        map="overlapping", settings={"prescription.overlap": '"mean"'}, places=BOTH
    ),
    "ardupilot-grid": Flight(map="grid", places=BOTH, settings=COVERED),
    "ardupilot-trim": Flight(
        scenario="[sensors]\nmeter_battery = 1\n", settings=METER | TRIM | DETECTION, places=BOTH
    ),
    "ardupilot-stuck-open": Flight(
        scenario=liquid("stuck-open", 2.0, valve=3), settings=METER | DETECTION | COVERED
    ),
    "ardupilot-leak": Flight(
        scenario=liquid("leak", 2.0, share=0.3), settings=METER | DETECTION, places=BOTH
    ),
    "ardupilot-tank": Flight(
        scenario="[sensors]\nmeter_battery = 1\ntank_battery = 2\ntank_l = 0.7\n",
        settings=METER
        | DETECTION
        | {"tank.source": '"autopilot"', "tank.battery": "2", "tank.capacity_l": "0.7"},
        places=BOTH,
    ),
    "ardupilot-late": Flight(
        scenario="[clock]\ndrift_ppm = 300.0\n"
        + fault("ack-late", 2.0, fraction=0.5, delay_s=0.8)
        + fault("corrupt", 2.0, fraction=0.05)
        + fault("ack-lost", 2.0, fraction=0.2),
        held_s=_gap,
    ),
    "ardupilot-reboot": Flight(
        scenario="[clock]\nuptime_s = 4294960.0\n" + fault("reboot", 9.0, 1.0), settings=COVERED
    ),
    "ardupilot-pilot": Flight(scenario=fault("mode", 9.0, 2.0, mode=5)),
    "ardupilot-lost-position": Flight(
        scenario=fault("stale-position", 7.0, 1.5)
        + fault("gps-drop", 11.0, 1.0)
        + fault("ekf-lost", 13.5, 0.7)
    ),
    "ardupilot-wind": Flight(
        scenario="[wind]\nspeed_m_s = 4.0\nfrom_deg = 260.0\n",
        settings={"drift.enabled": "true"} | COVERED,
        places=BOTH,
    ),
    "ardupilot-guard": Flight(settings=GUARD | COVERED, places=AGAIN),
    "ardupilot-cut": Flight(settings=GUARD | COVERED, until_s=16.0),
    "ardupilot-continued": Flight(settings=GUARD | COVERED, after="ardupilot-cut", seed=6),
    "ardupilot-dry": Flight(settings={"output.kind": '"none"'} | GPIO | COVERED),
    "ardupilot-switch": Flight(
        settings={"safety.rc_channel": "8", "safety.enable_by": '["rc"]'},
        scenario='[[fault]]\nkind = "rc"\nchannel = 8\npulse_us = 1000\n'
        + fault("rc", 1.0, 9.0, channel=8, pulse_us=2000)
        + fault("rc", 11.0, 9.0, channel=8, pulse_us=2000),
    ),
    "ardupilot-pump-sections": Flight(base="pump-sections", settings=COVERED),
    "ardupilot-atomiser": Flight(base="atomiser"),
    # The same beside a PX4.
    "px4": Flight(autopilot="px4", scenario=RTK, settings=COVERED),
    "px4-turn": Flight(autopilot="px4", settings=MISSION, places=BOTH),
    "px4-lines": Flight(
        autopilot="px4", scenario=RTK, settings={"mission.lines": '"lines.geojson"'}
    ),
    "ardupilot-clock": Flight(
        scenario=fault("clock-backwards", 4.0, 3.0, delay_s=0.3)
        + fault("clock-wrap", 9.0, 2.0, delay_s=1.0)
        + fault("slow-streams", 11.0, 2.0, factor=4.0),
        held_s=lambda at_s: max(0.3 - (at_s - 16.0) % 2.0, 0.0) if at_s > 16.0 else 0.0,
    ),
    "px4-wind": Flight(
        autopilot="px4",
        scenario="[position]\nlag_s = 0.04\n[wind]\nspeed_m_s = 4.0\nfrom_deg = 270.0\n"
        + fault("stale-position", 9.0, 1.5),
        settings={"drift.enabled": "true", "drift.wind": "[3.0, 250.0]"},
    ),
    "px4-clock": Flight(
        autopilot="px4",
        scenario="[clock]\ndrift_ppm = -500.0\n"
        + fault("clock-backwards", 8.0, 1.0, delay_s=2.0)
        + fault("heading-unknown", 11.0, 1.0),
    ),
    # Lines of this computer, pulses to the edge, the sensors of this computer.
    "gpio": Flight(over="twin", settings=GPIO | COVERED, places=BOTH),
    # And a border where valves open half a gap sooner: the setting that the other journals lack.
    "gpio-border": Flight(
        over="twin",
        settings=GPIO | COVERED | EXCLUDED | {"output.kind": '"gpio"'},
        places=BOTH,
    ),
    "gpio-trim": Flight(
        over="twin", settings=PULSES | TRIM | GPIO, places=BOTH, twin=_pulsed(), seed=3
    ),
    "gpio-healthy": Flight(over="twin", settings=LIQUID | TANK, places=BOTH, twin=_pulsed()),
    "gpio-stuck-closed": Flight(
        over="twin",
        settings=LIQUID,
        places=BOTH,
        twin=_pulsed(LiquidFaultKind.STUCK_CLOSED, valve=1),
    ),
    "gpio-clog": Flight(
        over="twin",
        settings=LIQUID | TRIM,
        places=BOTH,
        twin=_pulsed(LiquidFaultKind.CLOG, share=0.3),
    ),
    "gpio-supply": Flight(
        over="twin",
        settings=LIQUID,
        places=BOTH,
        twin=_pulsed(LiquidFaultKind.SUPPLY, share=0.4),
    ),
    "gpio-no-flow": Flight(
        over="twin", settings=LIQUID, twin=_pulsed(LiquidFaultKind.NO_FLOW, 5.0)
    ),
    "gpio-air": Flight(
        over="twin",
        settings=LIQUID | TANK,
        places=BOTH,
        twin=_pulsed(LiquidFaultKind.TANK_EMPTY),
        extra=_levels((0.5, 3.0), (7.0, 2.0), (9.0, 0.6), (10.0, 0.4), (13.0, None)),
    ),
    "gpio-dead-meter": Flight(
        over="twin",
        settings=LIQUID | {"detection.meter_required": "true"},
        twin=_pulsed(LiquidFaultKind.DEAD_METER),
        places=BOTH,
    ),
    "gpio-operator": Flight(
        over="twin",
        settings=GPIO | COVERED | {"safety.rc_channel": "8", "safety.wind_required": "true"},
        places=BOTH,
        extra=(
            *(WindReport(received_s=0.5 + second, speed_m_s=2.0) for second in range(20)),
            *(
                RcReport(received_s=0.5 + 0.2 * n, pulse_us=_RC_OFF if 90 <= n < 95 else _RC_ON)
                for n in range(200)
            ),
            *(
                RangeReport(received_s=1.0 + 0.1 * n, height_m=3.4 if n != 50 else None)
                for n in range(100)
            ),
            OperatorCommand(received_s=1.0, enable=False, source="command"),
            OperatorCommand(received_s=2.0, enable=True, source="command"),
            RateOverride(received_s=5.0, percent=120.0),
            RateOverride(received_s=8.0, percent=70.0),
            StandstillReport(received_s=9.0, gap_s=0.8),
            EstopReport(received_s=10.5, pressed=True, source="line"),
            EstopReport(received_s=11.5, pressed=False, source="line"),
            OperatorCommand(received_s=12.0, enable=False, source="command"),
            OperatorCommand(received_s=12.2, enable=True, source="command"),
            BatteryReport(received_s=12.5, battery=0, consumed=10.0, remaining_percent=90.0),
            OutputReport(received_s=14.5, healthy=False, text="line 17 is taken"),
            OutputReport(received_s=14.9, healthy=True),
            OutputReport(received_s=16.0, healthy=True, link_up=False),
            OutputReport(received_s=16.2, healthy=True),
            LandedReport(received_s=17.0, in_air=False, on_ground=True),
        ),
    ),
    "gpio-two-sets": Flight(
        over="twin",
        settings=GPIO | COVERED | PULSES | TRIM,
        small_set=EIGHT,
        places=BOTH,
        twin={"meter_rate_hz": 20.0},
    ),
    "gpio-constant-pump": Flight(
        over="twin",
        settings=GPIO | {"pump.control": '"constant"', "pump.channel": "15", "pump.run_us": "1700"},
    ),
    "gpio-many": Flight(
        over="twin", settings={"pwm.min_on_s": "0.02"}, base="orchard", places=PASS
    ),
    "pinpoint": Flight(over="twin", base="pinpoint", places=BOTH, twin={"output": "servo"}),
    "pump": Flight(over="twin", base="pump", places=BOTH, settings=COVERED),
    "pump-trim": Flight(
        over="twin",
        base="pump",
        settings=PULSES | TRIM | DETECTION,
        places=BOTH,
        twin={"meter_rate_hz": 20.0},
    ),
    "pump-sections": Flight(over="twin", base="pump-sections", places=BOTH, settings=GUARD),
    "atomiser": Flight(over="twin", base="atomiser", places=BOTH, settings=COVERED),
}
