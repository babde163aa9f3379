"""What the flights have in common: ready, armed, enabled, flown, landed, judged."""

from __future__ import annotations

import json
import math
import pickle
import socket
import struct
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from operator import attrgetter
from pathlib import Path
from typing import Any

import pytest
import shapely
from pymavlink.dialects.v20 import ardupilotmega as dialect

from analysis.report.build import ReportOptions, build_report
from analysis.report.legal_fields import REAL_FLIGHT
from companion.config.application_table import PROFILES
from tests.analysis.report_flight import EU_TOLD
from tests.firmware import firmware
from tests.firmware.fields import HOME_DEG, copy_example
from tests.firmware.judge import Zone, geojson_area, geojson_lines, shapefile_zones
from tests.firmware.station import (
    AUTOPILOT,
    COMPANION,
    Log,
    MissionItem,
    NoAnswerError,
    Station,
)

SIMSTATE, SERVO_OUTPUT_RAW, GLOBAL_POSITION_INT, RC_CHANNELS = 164, 36, 33, 65
DO_SPRAYER, DO_SET_MODE, ARM, MISSION_START = 216, 176, 400, 300
HIL_STATE_QUATERNION, INT32 = 115, 6
ACCEPTED = 0
TRUTH_HZ, OUTPUTS_HZ, POSITION_HZ = 100.0, 100.0, 20.0
# Until the estimator has its position the simulation may run as fast as it can: nobody watches.
HURRIED = 10.0
OPEN_US = 1010
RADIO_PORT, RADIO_CHANNELS = 5501, 16
# A receiver's frames come more often; PX4 says after 0.5 s without that the pilot is gone.
RADIO_EVERY_S = 0.05
SWITCH = 7  # the channel of the pilot's switch, where a flight has one
READY_WITHIN_S = 90.0
PLACELESS_FRAME = 2
# At the ends of four lines, on sprayable ground, all six valves at 50 mL/s: the order is early by
# the lag, so that what is left is the half of the fall (0.070 s) behind its middle, the wait for a
# servo frame, and 0.05 m of place at 5 m/s.
OFF_LINES_MAX_ML = 4 * 50.0 * (0.070 / 8.0 + 0.020 + 0.010)
DEPOT_DEG = (35.9972, 114.5439)  # README's, beside the example's field


@dataclass(frozen=True, slots=True, kw_only=True)
class Kind:
    """What differs between the firmwares for those who fly beside them."""

    name: str
    config: str  # the example's configuration for it
    link: str  # where a companion hears it
    options: tuple[str, ...] = ()  # of `run` and `doctor`, beside the configuration
    # What DO_SET_MODE takes, and what a heartbeat then has.
    modes: Mapping[str, tuple[tuple[float, ...], int]]

    @property
    def port(self) -> int:
        """The port of that link."""
        return int(self.link.rpartition(":")[2])


COPTER = Kind(
    name="ardupilot",
    config="config.toml",
    link="udpin:127.0.0.1:14550",
    # AUTO, BRAKE, LAND.
    modes={
        name: ((1.0, mode), int(mode))
        for name, mode in (("mission", 3.0), ("hold", 17.0), ("land", 9.0))
    },
)
_PX4_LINK = "udpin:127.0.0.1:14540"
PX4 = Kind(
    name="px4",
    config="px4.toml",
    link=_PX4_LINK,
    options=("--set", f"link.url={_PX4_LINK}", "--set", "safety.fix=3d"),
    # Main and sub-mode: AUTO with MISSION, HOLD, LAND.
    modes={
        name: ((1.0, 4.0, sub), 4 << 16 | int(sub) << 24)
        for name, sub in (("mission", 4.0), ("hold", 3.0), ("land", 6.0))
    },
)
both = pytest.mark.parametrize("kind", [COPTER, PX4], ids=attrgetter("name"))


@dataclass(slots=True)
class Vehicle:
    """A vehicle that may be armed, and the folder of its flight."""

    station: Station
    folder: Path
    kind: Kind


def ready(
    kind: Kind, folder: Path, where: Path, home_deg: tuple[float, float] = HOME_DEG
) -> AbstractContextManager[Vehicle]:
    """Either firmware with six outputs for valves, waiting until it may be armed."""
    if kind is PX4:
        return ready_px4(folder, where, home_deg)
    # The switch of the flights that have one does nothing to ArduCopter itself.
    home = f"{home_deg[0]},{home_deg[1]},60,12"
    return ready_copter(folder, where, home, parameters={f"RC{SWITCH}_OPTION": 0.0})


@contextmanager
def ready_copter(
    folder: Path, where: Path, home: str, *, parameters: dict[str, float] | None = None
) -> Iterator[Vehicle]:
    """ArduCopter with the watchdog script set up, waiting until it may be armed."""
    with firmware.arducopter(where, folder, home, parameters=parameters) as station:
        vehicle = Vehicle(station, folder, COPTER)
        station.until(lambda: station.said("watchdog: started"), "watchdog script", READY_WITHIN_S)
        station.set_parameter("SIM_SPEEDUP", HURRIED)
        station.set_parameter("SPRW_FIRST", 9.0)
        station.set_parameter("SPRW_LAST", 14.0)
        for message, rate_hz in (
            (SIMSTATE, TRUTH_HZ),
            (SERVO_OUTPUT_RAW, OUTPUTS_HZ),
            (GLOBAL_POSITION_INT, POSITION_HZ),
            (RC_CHANNELS, 5.0),
        ):
            station.ask_for(message, rate_hz)
        station.until(lambda: station.said("is using GPS"), "position", READY_WITHIN_S)
        station.set_parameter("SIM_SPEEDUP", 1.0)
        yield vehicle


@contextmanager
def ready_px4(
    folder: Path, where: Path, home_deg: tuple[float, float] = HOME_DEG
) -> Iterator[Vehicle]:
    """PX4 with six actuators on its outputs 9 to 14, waiting until it may be armed."""
    place = (*map(str, home_deg), "60")
    with firmware.px4(where, folder, *place) as station:
        vehicle = Vehicle(station, folder, PX4)
        told = folder / "px4.txt"  # on its console only
        station.until(
            lambda: b"Ready for takeoff" in told.read_bytes(), "readiness", READY_WITHIN_S
        )
        for number in range(6):
            (raw,) = struct.unpack("<f", struct.pack("<i", 301 + number))
            station.set_parameter(f"PWM_MAIN_FUNC{9 + number}", raw, kind=INT32)
        for message, rate_hz in (
            (HIL_STATE_QUATERNION, TRUTH_HZ),
            (SERVO_OUTPUT_RAW, OUTPUTS_HZ),
            (GLOBAL_POSITION_INT, OUTPUTS_HZ),
            (RC_CHANNELS, 5.0),
        ):
            station.ask_for(message, rate_hz)
        yield vehicle


@dataclass(frozen=True, slots=True, kw_only=True)
class FlownField:
    """The example's field as README plans, uploads and flies it."""

    log: Log
    zones: list[Zone]
    inside: shapely.Geometry
    lines: list[shapely.LineString]
    planned_l: float


def fly_field(kind: Kind, where: Path, folder: Path, *settings: str) -> FlownField:
    """Plan the example's field, upload it and fly it on its lines; the log is kept too."""
    field = copy_example(folder / "field")
    config, plan, lines = field / kind.config, field / "field.plan", field / "field.lines.geojson"
    zones = field / "prescription.shp"
    options = ("--prescription", f"{zones}", "--config", f"{config}", "--out", f"{plan}")
    depot = ("--depot", "{},{}".format(*DEPOT_DEG))
    planned = _done("plan", f"{zones}", *options, *depot)
    with ready(kind, folder / "vehicle", where, DEPOT_DEG) as vehicle:
        uploaded = _done("upload", f"{plan}", "--link", kind.link)
        assert (uploaded["ok"], uploaded["firmware"]) == (True, kind.name)
        more = ("--config", f"{config}", *kind.options, "--set", f"mission.lines={lines}")
        with firmware.companion(folder, *more, *settings) as started:
            until_heard(vehicle.station, started, folder / "companion.txt")
            vehicle.station.log.clear_flight()
            start(vehicle, None)
            until_landed(vehicle, 230.0)
        log = vehicle.station.log
    (folder / "log.pkl").write_bytes(pickle.dumps((log.places, log.pulses, log.told)))
    return FlownField(
        log=log,
        zones=shapefile_zones(zones),
        inside=geojson_area(field / "boundary.geojson"),
        lines=geojson_lines(lines),
        planned_l=float(planned["volume_l"]),
    )


def _done(*command: str) -> dict[str, Any]:
    """Run a command of the program to its end and return its one object."""
    found = firmware.vrspray(*command, "--json")
    assert found.returncode == 0, found.stderr
    values: dict[str, Any] = json.loads(found.stdout)
    return values


def until_heard(station: Station, started: subprocess.Popen[bytes], log: Path) -> None:
    """Wait until the companion is heard, and for its first look at the vehicle."""

    def is_heard() -> bool:
        if started.poll() is not None:
            raise NoAnswerError(f"the companion has ended: {log.read_text(errors='replace')}")
        return station.heard("HEARTBEAT", COMPANION) is not None

    station.until(is_heard, "companion", 30.0)


def start(
    vehicle: Vehicle, items: Sequence[MissionItem] | None, *, is_enabled: bool = True
) -> None:
    """Upload the mission, if there is one; arm in it, start it, enable spraying."""
    station = vehicle.station
    if items is not None:
        station.upload(px4_items(items) if vehicle.kind is PX4 else items)
    if vehicle.kind is PX4:
        # It goes on where it left the same mission, though that was uploaded anew.
        station.go_on_with(0)
    set_mode(vehicle, "mission")
    assert station.command(ARM, 1.0) == ACCEPTED
    if vehicle.kind is COPTER:
        assert station.command(MISSION_START) == ACCEPTED
    station.until(lambda: station.is_armed, "arming")
    if is_enabled:
        enable(station)


def px4_items(items: Sequence[MissionItem]) -> list[MissionItem]:
    """Return a mission as PX4 takes it: home is no item of it, a yaw of 0 would be the north."""
    values = (0.0, 0.0, 0.0, math.nan)
    return [
        item if item.frame == PLACELESS_FRAME else replace(item, values=values)
        for item in items[1:]
    ]


def set_mode(vehicle: Vehicle, name: str) -> None:
    """Change the mode, and wait until the vehicle is in it."""
    station = vehicle.station
    values, shown = vehicle.kind.modes[name]
    assert station.command(DO_SET_MODE, *values) == ACCEPTED
    station.until(lambda: station.heard("HEARTBEAT").custom_mode == shown, f"mode {name}")


def enable(station: Station, *, is_on: bool = True) -> None:
    """Give the operator's consent to spray, or take it back."""
    assert station.command(DO_SPRAYER, float(is_on), to=COMPANION) == ACCEPTED


def until_landed(vehicle: Vehicle, within_s: float) -> None:
    """Wait until the motors stand still."""
    vehicle.station.until(lambda: not vehicle.station.is_armed, "landing", within_s)


def open_outputs(us: Sequence[int]) -> list[int]:
    """Return the outputs 9 to 14 whose pulse opens a valve."""
    return [number for number in range(9, 15) if us[number - 1] > OPEN_US]


def until_spraying(vehicle: Vehicle, within_s: float = 60.0) -> None:
    """Wait until all six valves are ordered open."""
    pulses = vehicle.station.log.pulses
    vehicle.station.until(
        lambda: bool(pulses) and len(open_outputs(pulses[-1].us)) == 6, "spraying", within_s
    )


def closing_s(vehicle: Vehicle, since_s: float, within_s: float = 3.0) -> float:
    """Wait until no valve is ordered open; return how long after a moment that was."""
    pulses = vehicle.station.log.pulses
    vehicle.station.until(
        lambda: pulses[-1].came_s > since_s and not open_outputs(pulses[-1].us),
        "closing",
        within_s,
    )
    return pulses[-1].came_s - since_s


class Radio:
    """The pilot's transmitter, all channels but those that are put as they were.

    ArduPilot's simulation takes frames by UDP and keeps the last. PX4 takes RC_CHANNELS_OVERRIDE
    for a receiver's frames (MANUAL_CONTROL makes no RC_CHANNELS of it), as long as they come.
    """

    def __init__(self, vehicle: Vehicle) -> None:
        self._station, self._is_px4 = vehicle.station, vehicle.kind is PX4
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        if self._is_px4:
            self._us = [1500] * RADIO_CHANNELS
        else:
            heard = self._station.heard("RC_CHANNELS")
            channels = range(1, RADIO_CHANNELS + 1)
            self._us = [getattr(heard, f"chan{number}_raw") for number in channels]

    def close(self) -> None:
        """Switch it off; give the socket back."""
        self.silence()
        self._socket.close()

    def silence(self) -> None:
        """Send no more frames until a switch is moved."""
        self._station.no_more(self._send)

    def put(self, channel: int, us: int) -> None:
        """Move a switch."""
        self._us[channel - 1] = us
        self.silence()
        self._send()
        if self._is_px4:
            self._station.every(RADIO_EVERY_S, self._send)

    def _send(self) -> None:
        if self._is_px4:
            self._station.send(
                dialect.MAVLink_rc_channels_override_message(1, AUTOPILOT, *self._us)
            )
        else:
            frame = struct.pack(f"<{RADIO_CHANNELS}H", *self._us)
            self._socket.sendto(frame, ("127.0.0.1", RADIO_PORT))


def check_simulated(field: Path) -> None:
    """Hold the journals of a flight to it: a simulation, and no record of it is complete."""
    journals = sorted((field / "flights").glob("flight-*.gpkg"))
    assert journals
    for journal in journals:
        told = [f"{key}={value}" for key, value in {**EU_TOLD, REAL_FLIGHT: "yes"}.items()]
        options = ReportOptions(profiles=PROFILES, with_figures=False, changes=tuple(told))
        contents = build_report(journal, options).contents
        assert contents["flight"]["simulated"] == "yes", contents["flight"]["simulated_because"]
        for record in contents["application"].values():
            assert not record["complete"]
            assert any("SIMULATED" in each for each in record["missing"])
