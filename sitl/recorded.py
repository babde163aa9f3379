"""A flight that was really flown, as its log has it: what the autopilot told, and when.

Of ArduPilot's dataflash logs: the place is POS, which is what GLOBAL_POSITION_INT tells; velocity
is that of the EKF's core that flew (XKF4.PI); the nose is ATT's. Stamps, rounding and gaps stay.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from companion.errors import ConfigError

Floats = NDArray[np.float64]

# Two rows of one loop of the autopilot are this near; a log that pauses for longer is two flights.
TOGETHER_S, PAUSE_S = 0.06, 1.0
# What is slower does not fly anywhere; so much is told before it moves and after it stands.
MOVING_M_S, BEFORE_S, AFTER_S = 1.0, 5.0, 3.0
LEAST_S = 5.0


_COLUMNS = (
    "time_s", "latitude_deg", "longitude_deg", "height_m", "velocity_north_m_s",
    "velocity_east_m_s", "velocity_down_m_s", "heading_deg",
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Recorded:
    """What was told along a flight, a row a state; velocities are [m/s], the heading [deg].

    `modes`, `armed` and `fixes` are (time, value), from which on they hold; a fix is as MAVLink
    numbers it. `receiver` are time, latitude, longitude and speed of the receiver's own solutions.
    """

    name: str
    time_s: Floats
    latitude_deg: Floats
    longitude_deg: Floats
    height_m: Floats
    velocity_north_m_s: Floats
    velocity_east_m_s: Floats
    velocity_down_m_s: Floats
    heading_deg: Floats
    modes: tuple[tuple[float, str], ...]
    armed: tuple[tuple[float, bool], ...]
    fixes: tuple[tuple[float, int], ...]
    receiver: Floats
    notes: tuple[str, ...] = ()

    @property
    def speed_m_s(self) -> Floats:
        """Return the speed over the ground."""
        return np.hypot(self.velocity_east_m_s, self.velocity_north_m_s)

    @property
    def rate_hz(self) -> float:
        """Return how often a state was recorded."""
        return float(1.0 / np.median(np.diff(self.time_s)))

    def between(self, begin_s: float, end_s: float) -> Recorded:
        """Return the rows from a time until another."""
        which = np.flatnonzero((self.time_s >= begin_s) & (self.time_s <= end_s))
        return self._rows(which)

    def _rows(self, which: NDArray[np.int64]) -> Recorded:
        return replace(self, **{name: getattr(self, name)[which] for name in _COLUMNS})

    def at_rate(self, rate_hz: float) -> Recorded:
        """Return the states at another rate: rows left out, or put between two.

        What lies between two rows is made with the later one: it knows the future.
        """
        if rate_hz <= 1.05 * self.rate_hz:
            ticks = np.floor((self.time_s - self.time_s[0]) * rate_hz + 0.25)
            return self._rows(np.flatnonzero(np.diff(ticks, prepend=-1.0) > 0.0))
        parts = max(round(rate_hz / self.rate_hz), 1)
        gaps = np.diff(self.time_s)
        # Nothing is put into a gap.
        counts = np.where(gaps < 1.5 / self.rate_hz, parts, 1)
        within = [np.arange(count) / count for count in counts]
        at_s = np.concatenate([*(t + g * w for t, g, w in zip(self.time_s, gaps, within)), []])  # noqa: B905
        at_s = np.append(at_s, self.time_s[-1])
        return self._interpolated(at_s)

    def _interpolated(self, at_s: Floats) -> Recorded:
        place = {
            name: np.interp(at_s, self.time_s, getattr(self, name))
            for name in ("height_m", "velocity_north_m_s", "velocity_east_m_s", "velocity_down_m_s")
        }
        turn = np.unwrap(self.heading_deg, period=360.0)
        place["heading_deg"] = np.interp(at_s, self.time_s, turn) % 360.0
        metres = math.radians(6_371_000.0)
        lon_m = metres * math.cos(math.radians(float(self.latitude_deg[0])))
        for name, per_deg, speed in (
            ("latitude_deg", metres, self.velocity_north_m_s),
            ("longitude_deg", lon_m, self.velocity_east_m_s),
        ):
            place[name] = np.round(
                cubic(at_s, self.time_s, getattr(self, name), speed / per_deg), 7
            )
        return replace(self, time_s=at_s, **place)


def cubic(at_s: Floats, time_s: Floats, value: Floats, slope: Floats) -> Floats:
    """Return values between others by those and their slopes.

    >>> cubic(np.array([0.5]), np.array([0.0, 1.0]), np.array([0.0, 1.0]), np.ones(2)).tolist()
    [0.5]
    """
    i = np.clip(np.searchsorted(time_s, at_s, side="right") - 1, 0, len(time_s) - 2)
    span = time_s[i + 1] - time_s[i]
    u = (at_s - time_s[i]) / span
    rise = value[i + 1] - value[i]
    a, b = slope[i] * span - rise, rise - slope[i + 1] * span
    found: Floats = value[i] + u * rise + u * (1.0 - u) * (a * (1.0 - u) + b * u)
    return found


def read_flight(path: Path) -> Recorded:
    """Return the longest flight of a log.

    Raises:
        ConfigError: it cannot be read, or holds no flight; in one line.
    """
    rows = _dataflash(path)
    return _longest(_recorded(path, rows))


Rows = dict[str, list[Any]]
_KINDS = ("POS", "XKF1", "XKF4", "NKF1", "NKF4", "EKF1", "ATT", "GPS", "MODE", "ARM", "EV")
# EV.Id of arming and disarming, for logs without ARM.
_EV_ARMED = {10: True, 11: False}


def _dataflash(path: Path) -> Rows:
    from pymavlink import DFReader

    rows: Rows = {kind: [] for kind in _KINDS}
    try:
        if path.stat().st_size < 1024:
            raise ConfigError(f"{path}: too short for a log of a flight")
        log = DFReader.DFReader_binary(str(path))
        with closing(log.filehandle), closing(log.data_map):
            while (row := log.recv_match(type=list(_KINDS))) is not None:
                rows[row.get_type()].append(row)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror or error}; give a log") from error
    except (ValueError, IndexError, KeyError, AttributeError, TypeError) as error:
        raise ConfigError(f"{path}: no dataflash log ({error!r}); give a .BIN") from error
    return rows


def _recorded(path: Path, rows: Rows) -> Recorded:
    kind = next((each for each in ("XKF1", "NKF1", "EKF1") if rows[each]), None)
    if kind is None or not rows["POS"] or not rows["ATT"]:
        raise ConfigError(
            f"{path}: no POS, ATT and XKF1 in it; log with LOG_BITMASK as ArduPilot has it"
        )
    flown = _table(rows["POS"], "Lat", "Lng", "RelHomeAlt")
    core = _core_that_flew(rows, kind)
    nose = _table(rows["ATT"], "Yaw")
    _, first = np.unique(flown[:, 0], return_index=True)
    flown = flown[first]
    near_core, near_nose = _nearest(flown[:, 0], core[:, 0]), _nearest(flown[:, 0], nose[:, 0])
    apart_s = np.maximum(
        np.abs(core[near_core, 0] - flown[:, 0]), np.abs(nose[near_nose, 0] - flown[:, 0])
    )
    keep = apart_s < TOGETHER_S
    time_s, latitude, longitude, height = flown[keep].T
    north, east, down = core[near_core[keep], 1:4].T
    return Recorded(
        name=path.name,
        time_s=time_s,
        latitude_deg=np.round(latitude, 7),
        longitude_deg=np.round(longitude, 7),
        height_m=height,
        velocity_north_m_s=north,
        velocity_east_m_s=east,
        velocity_down_m_s=down,
        heading_deg=nose[near_nose[keep], 1] % 360.0,
        modes=_modes(rows["MODE"]),
        armed=_armed(rows),
        fixes=tuple((_time(row), int(row.Status)) for row in rows["GPS"] if _instance(row) == 0),
        receiver=_table([r for r in rows["GPS"] if _instance(r) == 0], "Lat", "Lng", "Spd"),
    )


def _time(row: Any) -> float:
    return float(row.TimeUS) * 1e-6


def _instance(row: Any) -> int:
    return int(getattr(row, "I", 0))


def _table(rows: Iterable[Any], *names: str) -> Floats:
    found = [(_time(row), *(float(getattr(row, name)) for name in names)) for row in rows]
    table = np.array(found, dtype=np.float64).reshape(-1, len(names) + 1)
    good = table[np.isfinite(table).all(axis=1)]
    return good[np.argsort(good[:, 0], kind="stable")]


def _core_that_flew(rows: Rows, kind: str) -> Floats:
    """Return time and velocity north, east, down of the core in use at each time."""
    table = _table(rows[kind], "VN", "VE", "VD")
    cores = np.array([int(getattr(row, "C", 0)) for row in rows[kind]])
    if len(cores) != len(table):
        cores = np.zeros(len(table), dtype=np.int64)
    used = [(_time(row), int(row.PI)) for row in rows[kind[:3] + "4"] if hasattr(row, "PI")]
    if not used:
        first: Floats = table[cores == cores.min(initial=0)]
        return first
    at_s, primary = (np.array(each) for each in zip(*used, strict=True))
    now = primary[np.clip(np.searchsorted(at_s, table[:, 0], side="right") - 1, 0, None)]
    flew: Floats = table[cores == now]
    return flew


def _nearest(at_s: Floats, among_s: Floats) -> NDArray[np.int64]:
    after = np.clip(np.searchsorted(among_s, at_s), 1, len(among_s) - 1)
    before_is_nearer = at_s - among_s[after - 1] < among_s[after] - at_s
    found: NDArray[np.int64] = after - before_is_nearer
    return found


def _modes(rows: Iterable[Any]) -> tuple[tuple[float, str], ...]:
    from pymavlink import mavutil

    names = mavutil.mode_mapping_acm
    return tuple(
        (_time(row), str(names.get(int(row.ModeNum), f"MODE_{int(row.ModeNum)}"))) for row in rows
    )


def _armed(rows: Rows) -> tuple[tuple[float, bool], ...]:
    told = [(_time(row), _EV_ARMED[row.Id]) for row in rows["EV"] if row.Id in _EV_ARMED]
    told += [(_time(row), bool(row.ArmState)) for row in rows["ARM"]]
    told.sort()
    # A log begins with the arming: of that itself it may say nothing.
    before = not told[0][1] if told else True
    return ((-math.inf, before), *told)


def _longest(flight: Recorded) -> Recorded:
    """Return the longest stretch of moving flight without a pause in the log."""
    cuts = np.flatnonzero(np.diff(flight.time_s) > PAUSE_S) + 1
    stretches = np.split(np.arange(len(flight.time_s)), cuts)
    found: list[tuple[float, float]] = []
    for rows in stretches:
        moving = rows[flight.speed_m_s[rows] > MOVING_M_S]
        if len(moving):
            first_s, last_s = flight.time_s[rows[[0, -1]]]
            begin_s, end_s = flight.time_s[moving[[0, -1]]]
            found.append((max(begin_s - BEFORE_S, first_s), min(end_s + AFTER_S, last_s)))
    begin_s, end_s = max(found, key=lambda span: span[1] - span[0], default=(0.0, 0.0))
    if not end_s - begin_s >= LEAST_S:
        raise ConfigError(f"{flight.name}: no flight in it: nothing moves for {LEAST_S:g} s")
    part = flight.between(begin_s, end_s)
    notes = list(flight.notes)
    if len(stretches) > 1:
        notes.append(
            f"the log pauses {len(stretches) - 1} times for over {PAUSE_S:g} s: only its longest "
            f"stretch is flown, {end_s - begin_s:.0f} s"
        )
    gaps = np.diff(part.time_s)
    missing = int((gaps > 1.5 * np.median(gaps)).sum())
    if missing:
        notes.append(f"{missing} gaps in the states, {gaps.max():.2f} s at most: kept as they are")
    return replace(part, notes=tuple(notes))
