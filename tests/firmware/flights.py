"""What the flights have in common: ready, armed, enabled, flown, landed, judged."""

from __future__ import annotations

import socket
import struct
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from tests.firmware import firmware
from tests.firmware.fields import HOME_DEG
from tests.firmware.station import COMPANION, MissionItem, NoAnswerError, Station

SIMSTATE, SERVO_OUTPUT_RAW, GLOBAL_POSITION_INT, RC_CHANNELS = 164, 36, 33, 65
DO_SPRAYER, DO_SET_MODE, ARM, MISSION_START = 216, 176, 400, 300
AUTO, GUIDED, LAND = 3.0, 4.0, 9.0
PX4_MISSION = (1.0, 4.0, 4.0)
HIL_STATE_QUATERNION, INT32 = 115, 6
ACCEPTED = 0
TRUTH_HZ, OUTPUTS_HZ, POSITION_HZ = 100.0, 100.0, 20.0
# Until the estimator has its position the simulation may run as fast as it can: nobody watches.
HURRIED = 10.0
OPEN_US = 1010
RADIO_PORT, RADIO_CHANNELS = 5501, 16
READY_WITHIN_S = 90.0


@dataclass(slots=True)
class Vehicle:
    """ArduCopter, ready to be armed, and the folder of its flight."""

    station: Station
    folder: Path

    @property
    def journal(self) -> Path:
        """The only journal of the flight."""
        (found,) = self.folder.rglob("flight-*.gpkg")
        return found


@contextmanager
def ready_copter(
    folder: Path, where: Path, home: str, *, parameters: dict[str, float] | None = None
) -> Iterator[Vehicle]:
    """ArduCopter with the watchdog script set up, waiting until it may be armed."""
    with firmware.arducopter(where, folder, home, parameters=parameters) as station:
        vehicle = Vehicle(station, folder)
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
def ready_px4(folder: Path, where: Path) -> Iterator[Vehicle]:
    """PX4 with six actuators on its outputs 9 to 14, waiting until it may be armed."""
    place = (*map(str, HOME_DEG), "60")
    with firmware.px4(where, folder, *place) as station:
        vehicle = Vehicle(station, folder)
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
        ):
            station.ask_for(message, rate_hz)
        yield vehicle


def start_px4(vehicle: Vehicle, items: Sequence[MissionItem] | None) -> None:
    """Upload the mission, if there is one (home is no item of PX4's); arm in it, enable."""
    station = vehicle.station
    if items is not None:
        station.upload(items)
    assert station.command(DO_SET_MODE, *PX4_MISSION) == ACCEPTED
    assert station.command(ARM, 1.0) == ACCEPTED
    station.until(lambda: station.is_armed, "arming")
    enable(station)


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
    """Upload the mission, if there is one; arm in AUTO, start it, enable spraying."""
    station = vehicle.station
    if items is not None:
        station.upload(items)
    set_mode(station, AUTO)
    assert station.command(ARM, 1.0) == ACCEPTED
    assert station.command(MISSION_START) == ACCEPTED
    station.until(lambda: station.is_armed, "arming")
    if is_enabled:
        enable(station)


def set_mode(station: Station, mode: float) -> None:
    """Change the mode, and wait until the vehicle is in it."""
    assert station.command(DO_SET_MODE, 1.0, mode) == ACCEPTED
    station.until(lambda: station.heard("HEARTBEAT").custom_mode == mode, f"mode {mode:g}")


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
    """The pilot's transmitter, as ArduPilot's simulation takes it; all else as it was."""

    def __init__(self, station: Station) -> None:
        heard = station.heard("RC_CHANNELS")
        self._us = [getattr(heard, f"chan{number}_raw") for number in range(1, RADIO_CHANNELS + 1)]
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def close(self) -> None:
        """Give the socket back."""
        self._socket.close()

    def put(self, channel: int, us: int) -> None:
        """Move a switch."""
        self._us[channel - 1] = us
        frame = struct.pack(f"<{RADIO_CHANNELS}H", *self._us)
        self._socket.sendto(frame, ("127.0.0.1", RADIO_PORT))
