"""A flight that was really flown, as its log has it: what the autopilot told, and when.

ArduPilot's dataflash: the place is POS, which is what GLOBAL_POSITION_INT tells; velocity is that
of the EKF's core that flew (XKF4.PI); the nose is ATT's. Telemetry logs hold the messages
themselves, PX4's ULog the topics that they are made of. Stamps and gaps stay as they are.
"""

from __future__ import annotations

import os
from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass, field, replace
from operator import itemgetter
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from companion.errors import ConfigError
from companion.flight_modes import COPTER
from companion.receiver import ReceiverOffset, offset_of
from companion.wording import counted, missing
from sitl.earth import Earth
from sitl.smoother import true_path
from sitl.stub.protocol import AUTOPILOT_COMPONENT, Listener, sender
from sitl.trajectory import Trajectory

Floats = NDArray[np.float64]
Held = list[tuple[float, Any]]

COLUMNS = (
    "time_s", "latitude_deg", "longitude_deg", "height_m", "north_m_s", "east_m_s", "down_m_s",
    "heading_deg",
)  # fmt: skip
# A log that pauses for longer is two flights. What is slower flies nowhere; so much is told before
# it moves and after it stands.
# No clock has run for so long since its start: what is more is a time of day.
EPOCH_US = 1e14
PAUSE_S, MOVING_M_S, BEFORE_S, AFTER_S, LEAST_S = 1.0, 1.0, 5.0, 3.0, 5.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Recorded:
    """What was told along a flight: `states` have `COLUMNS`, a row a state.

    `modes`, `armed` and `fixes` are (time, value), from which on they hold; a fix is as MAVLink
    numbers it. `receiver` are the receiver's own time, latitude, longitude.
    """

    name: str
    states: Any
    modes: Held = field(default_factory=list)
    armed: Held = field(default_factory=list)
    fixes: Held = field(default_factory=list)
    receiver: Floats
    notes: tuple[str, ...] = ()

    @property
    def speed_m_s(self) -> Floats:
        """Return the speed over the ground."""
        found: Floats = np.hypot(self.states.east_m_s, self.states.north_m_s)
        return found

    @property
    def rate_hz(self) -> float:
        """Return how often a state was recorded."""
        return float(1.0 / np.median(np.diff(self.states.time_s)))


def paths_of(flight: Recorded, earth: Earth) -> tuple[Trajectory, Trajectory]:
    """Return the smoothed path, and what was told all along it: as far off it as it was around."""
    states = flight.states
    place_m = np.column_stack(earth.to_local_all(states.latitude_deg, states.longitude_deg))
    moves = np.column_stack((states.east_m_s, states.north_m_s))
    height_m = float(np.median(states.height_m))
    path = true_path(states.time_s, place_m, moves, states.heading_deg, height_m)
    then = path.at(states.time_s)
    off_m = place_m - np.column_stack((then.east_m, then.north_m))

    def told(values: Floats) -> Floats:
        found: Floats = np.interp(path.time_s, states.time_s, values)
        return found

    return path, replace(
        path,
        east_m=path.east_m + told(off_m[:, 0]),
        north_m=path.north_m + told(off_m[:, 1]),
        velocity_east_m_s=told(states.east_m_s),
        velocity_north_m_s=told(states.north_m_s),
        heading_deg=told(_turn(states.heading_deg)),
    )


def receiver_of(flight: Recorded) -> ReceiverOffset | None:
    """Return how late and how far off the receiver's own positions are; None: not known."""
    states, place = flight.states, flight.receiver[1:].any(axis=0)
    fixed_s, latitude_deg, longitude_deg = flight.receiver[:, place].tolist()
    told = (states[COLUMNS[i]].tolist() for i in (0, 0, 1, 2, 4, 5))
    fixes = (held(flight.fixes, at_s, 0) for at_s in fixed_s)
    return offset_of(
        zip(*told, strict=True),
        zip(fixed_s, fixes, fixed_s, latitude_deg, longitude_deg, strict=True),
    )


def held(told: Held, now_s: float, default: Any) -> Any:
    """Return what holds at a time, of what was told in order of time.

    >>> held([(1.0, "AUTO"), (2.0, "LAND")], 1.5, "UNKNOWN"), held([], 1.5, "UNKNOWN")
    ('AUTO', 'UNKNOWN')
    """
    number = bisect_right(told, now_s, key=itemgetter(0))
    return told[number - 1][1] if number else default


def rows_of(columns: Iterable[Floats]) -> Any:
    """Return columns as states."""
    return np.rec.fromarrays(list(columns), dtype=[(name, "f8") for name in COLUMNS])


def table_of(columns: Iterable[Floats]) -> Any:
    """Return states in order of time, each time once, without those of no place."""
    table = np.array(list(columns), dtype=np.float64)
    table = table[:, np.isfinite(table).all(axis=0) & table[1:3].any(axis=0)]
    _, first = np.unique(table[0], return_index=True)
    return rows_of(table[:, first])


def read_flight(path: Path, allows: Callable[[str], bool] = bool) -> Recorded:
    """Return the longest flight of a log in modes that are allowed, or else in any.

    Raises:
        ConfigError: it cannot be read, or holds no flight; in one line.
    """
    kind = path.suffix.lower()
    if kind not in _READERS:
        raise ConfigError(f"{path}: not a log of a flight; give one of {', '.join(_READERS)}")
    _look_at(path, *_HEADS[kind])
    try:
        with _silence():
            flight = _READERS[kind](path)
        return _longest(flight, allows) or _longest(flight, bool) or _refuse(path)
    except ConfigError:
        raise
    except Exception as error:
        # And they raise whatever they like.
        raise ConfigError(
            f"{path}: damaged, or without position, velocity or heading; copy it again, or give "
            "the log of another flight"
        ) from error


@contextmanager
def _silence() -> Iterator[None]:
    """Let nothing be printed: readers say a line for each byte that they do not know, in C too."""
    kept = os.dup(2)
    try:
        with Path(os.devnull).open("w") as nowhere, redirect_stdout(None), redirect_stderr(None):
            os.dup2(nowhere.fileno(), 2)
            yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def _look_at(path: Path, at: int, heads: tuple[bytes, ...], origin: str) -> None:
    """Refuse what is no file with something in it, or begins as no such log does."""
    try:
        with path.open("rb") as file:
            begin = file.read(16)
    except OSError as error:
        reason = (error.strerror or "cannot be read").lower()
        raise ConfigError(f"{path}: {reason}; give a log from {origin}") from error
    if not begin:
        raise ConfigError(f"{path}: empty; copy it again from {origin}")
    if not begin.startswith(heads, at):
        raise ConfigError(f"{path}: not a {path.suffix} log; give one from {origin}")


def _refuse(path: Path) -> NoReturn:
    raise ConfigError(f"{path}: no flight in it: nothing armed moves for {LEAST_S:g} s")


def _longest(flight: Recorded, allows: Callable[[str], bool]) -> Recorded | None:
    """Return the longest stretch of moving flight, armed, in such modes, and without a pause."""
    flown = [
        # A log begins with the arming: of that itself it may say nothing.
        held(flight.armed, at_s, default=True) and allows(held(flight.modes, at_s, "UNKNOWN"))
        for at_s in flight.states.time_s.tolist()
    ]
    states, found = flight.states[np.array(flown, dtype=np.bool_)], []
    if not len(states):
        return None
    gaps_s = np.diff(states.time_s)
    pauses = gaps_s > max(PAUSE_S, 3.0 * float(np.median(gaps_s)))
    stretches: list[Any] = np.split(states, np.flatnonzero(pauses) + 1)
    for rows in stretches:
        moving = rows.time_s[np.hypot(rows.east_m_s, rows.north_m_s) > MOVING_M_S]
        if len(moving):
            first_s, last_s = moving[0] - BEFORE_S, moving[-1] + AFTER_S
            found.append(rows[(rows.time_s >= first_s) & (rows.time_s <= last_s)])
    rows = max(found, key=lambda each: np.ptp(each.time_s), default=states[:1])
    if not np.ptp(rows.time_s) >= LEAST_S:
        return None
    notes, gaps_s = [], np.diff(rows.time_s)
    missing = int((gaps_s > 1.5 * np.median(gaps_s)).sum())
    if len(found) > 1:
        notes.append(f"the log holds {len(found)} flights; the longest one is used")
    if missing:
        notes.append(
            f"{counted(missing, 'gap')} between positions, up to {gaps_s.max():.2f} s, kept as "
            "recorded"
        )
    return replace(flight, states=rows, notes=tuple(notes))


def _columns(rows: Iterable[Any], *names: str) -> Floats:
    """Return times and values of rows, a row a name."""
    found = [[getattr(row, name) for name in ("TimeUS", *names)] for row in rows]
    table = np.array(found, dtype=np.float64).reshape(-1, len(names) + 1).T
    table[0] *= 1e-6
    return table


def _at(time_s: Floats, table: Floats) -> Iterator[Floats]:
    """Yield the values of rows at other times."""
    for values in table[1:]:
        yield np.interp(time_s, table[0], values)


def _turn(degrees: Floats) -> Floats:
    return np.unwrap(degrees, period=360.0)


# ------------------------------------------------------------------------------------ dataflash

_KINDS = ["POS", "XKF1", "XKF4", "NKF1", "NKF4", "ATT", "GPS", "MODE", "ARM", "EV"]
# EV.Id of arming and disarming, for logs without ARM.
_EV_ARMED = {10: True, 11: False}


def _dataflash(path: Path) -> Recorded:
    from pymavlink import DFReader

    rows: dict[str, list[Any]] = {kind: [] for kind in _KINDS}
    log: Any = object.__new__(DFReader.DFReader_binary)
    try:
        log.__init__(str(path))
        while (row := log.recv_match(type=_KINDS)) is not None:
            rows[row.get_type()].append(row)
    finally:
        # It leaves its file open, and where it fails too.
        if hasattr(log, "filehandle"):
            log.filehandle.close()
    place = _columns(rows["POS"], "Lat", "Lng", "RelHomeAlt")
    nose = _columns(rows["ATT"], "Yaw")
    nose[1] = _turn(nose[1])
    moves = _flown(rows["XKF1"] or rows["NKF1"], rows["XKF4"] or rows["NKF4"])
    gps = [row for row in rows["GPS"] if not getattr(row, "I", 0)]
    armed = [(row.TimeUS * 1e-6, _EV_ARMED[row.Id]) for row in rows["EV"] if row.Id in _EV_ARMED]
    armed += [(row.TimeUS * 1e-6, bool(row.ArmState)) for row in rows["ARM"]]
    return Recorded(
        name=path.name,
        states=table_of([*place, *_at(place[0], moves), *_at(place[0], nose)]),
        modes=[(row.TimeUS * 1e-6, _copter(row.ModeNum)) for row in rows["MODE"]],
        armed=sorted(armed),
        fixes=[(row.TimeUS * 1e-6, row.Status) for row in gps],
        receiver=_columns(gps, "Lat", "Lng"),
    )


def _flown(states: list[Any], cores: list[Any]) -> Floats:
    """Return time and velocity north, east, down of the core that is used at each time."""
    used = _columns([row for row in cores if hasattr(row, "PI")], "PI")
    if not used.size:
        return _columns([row for row in states if not getattr(row, "C", 0)], "VN", "VE", "VD")
    table = _columns(states, "VN", "VE", "VD", "C")
    now = used[1][np.searchsorted(used[0], table[0], side="right").clip(1) - 1]
    return table[:4, table[4] == now]


def _copter(number: int) -> str:
    return COPTER.get(int(number), f"MODE {number}")


# ------------------------------------------------------------------------------------ telemetry


def _telemetry(path: Path) -> Recorded:
    """Return what the first autopilot told, by its own stamps."""
    told: dict[str, list[tuple[float, Any]]] = {
        "GLOBAL_POSITION_INT": [], "HEARTBEAT": [], "GPS_RAW_INT": []
    }  # fmt: skip
    now_s, boot_s, listener, autopilot = 0.0, 0.0, Listener(), None
    fixed: list[tuple[float, float, float]] = []
    for frame in _frames(path.read_bytes()):
        for message in listener.messages(frame):
            kind, who = message.get_type(), sender(message)
            if kind not in told or who[1] != AUTOPILOT_COMPONENT or autopilot not in (None, who):
                continue
            at_s = boot_s + getattr(message, "time_boot_ms", (now_s - boot_s) * 1e3) * 1e-3
            if at_s < now_s - PAUSE_S:
                # It has begun anew: what follows is another flight.
                boot_s += now_s + 2.0 * AFTER_S - at_s
                continue
            autopilot, now_s = who, max(at_s, now_s)
            told[kind].append((now_s, message))
            # ArduPilot and PX4 stamp a fix by their own clock; a time of day says nothing here.
            if kind == "GPS_RAW_INT" and message.time_usec < EPOCH_US:
                fixed_s = boot_s + message.time_usec * 1e-6
                fixed.append((fixed_s, message.lat * 1e-7, message.lon * 1e-7))
    rows = [
        (
            at_s, m.lat * 1e-7, m.lon * 1e-7, m.relative_alt * 1e-3, m.vx * 0.01, m.vy * 0.01,
            m.vz * 0.01, m.hdg * 0.01,
        )
        for at_s, m in told["GLOBAL_POSITION_INT"]
    ]  # fmt: skip
    return Recorded(
        name=path.name,
        states=table_of(np.array(rows).reshape(-1, len(COLUMNS)).T),
        modes=[(at_s, _copter(m.custom_mode)) for at_s, m in told["HEARTBEAT"]],
        armed=[(at_s, bool(m.base_mode & 128)) for at_s, m in told["HEARTBEAT"]],
        fixes=[(at_s, m.fix_type) for at_s, m in told["GPS_RAW_INT"]],
        receiver=np.array(fixed).reshape(-1, 3).T,
    )


def _frames(raw: bytes) -> Iterator[bytes]:
    """Yield the frames of a telemetry log: before each stand eight bytes of time."""
    at = 8
    while at + 8 < len(raw):
        more = 8 if raw[at] == 0xFE else 12 + 13 * (raw[at + 2] & 1)
        yield raw[at : at + raw[at + 1] + more]
        at += raw[at + 1] + more + 8


# ----------------------------------------------------------------------------------------- ULog

_NAV_STATES = {
    0: "MANUAL", 1: "ALTCTL", 2: "POSCTL", 3: "MISSION", 4: "LOITER", 5: "RTL", 14: "OFFBOARD",
    17: "TAKEOFF", 18: "LAND",
}  # fmt: skip


def _ulog(path: Path) -> Recorded:
    try:
        from pyulog import ULog
    except ImportError:
        raise ConfigError(f"{path}: {missing('pyulog')}") from None
    topics = ["vehicle_local_position", "vehicle_status", "vehicle_gps_position"]
    with path.open("rb") as file:
        found = ULog(file, topics).data_list
    data = {each.name: each.data for each in found if not each.multi_id}
    local, status = (data[topic] for topic in topics[:2])
    # Without its topic nothing is known of the receiver.
    gps = data.get(topics[2], dict.fromkeys(("timestamp", "lat", "lon", "fix_type"), np.empty(0)))
    known = local["xy_global"] > 0
    local = {name: values[known] for name, values in local.items()}
    earth = Earth(float(local["ref_lat"][0]), float(local["ref_lon"][0]))
    place = earth.to_geographic_all(local["y"], local["x"])
    time_s, changed_s, fixed_s = (each["timestamp"] * 1e-6 for each in (local, status, gps))
    nose = np.degrees(local["heading"]) % 360.0
    moves = local["vx"], local["vy"], local["vz"]
    here = (
        (gps["latitude_deg"], gps["longitude_deg"])
        if "latitude_deg" in gps
        else (gps["lat"] * 1e-7, gps["lon"] * 1e-7)
    )
    modes = [_NAV_STATES.get(int(state), f"MODE {state}") for state in status["nav_state"]]
    return Recorded(
        name=path.name,
        states=table_of([time_s, *place, -local["z"], *moves, nose]),
        modes=list(zip(changed_s, modes, strict=True)),
        armed=list(zip(changed_s, status["arming_state"] == 2, strict=True)),
        fixes=list(zip(fixed_s, gps["fix_type"], strict=True)),
        receiver=np.array([fixed_s, *here]),
    )


# Where the first bytes stand that every such log has, which these are, and where it comes from.
_HEADS = {
    ".bin": (0, (b"\xa3\x95",), "ArduPilot's SD card"),
    ".tlog": (8, (b"\xfe", b"\xfd"), "a ground station"),
    ".ulg": (0, (b"ULog",), "PX4's SD card"),
}
_READERS: dict[str, Callable[[Path], Recorded]] = {
    ".bin": _dataflash, ".tlog": _telemetry, ".ulg": _ulog
}  # fmt: skip
