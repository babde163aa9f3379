"""The log of the truth: path, volumes and orders of one flight, as arrays and a summary.

`truth.npz` holds time_s, east_m, north_m, height_m, heading_deg (unwrapped), velocity_east_m_s,
velocity_north_m_s (n), volume_ml (n, valves; cumulative), and of the servo orders order_time_s,
order_valve, order_pulse_us (m). Times are seconds on the machine's monotonic clock, metres are
in the frame whose origin `truth.json` names.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from companion.errors import ConfigError
from sitl.earth import Earth
from sitl.stub.sprayer import Sprayer
from sitl.stub.world import Pose, World

Floats = NDArray[np.float64]

SPACING_S = 0.002
_PATH_S = 0.01  # the vehicle's own step; between two of them the path is as good as straight


class TruthLog:
    """Notes from when to when was flown; everything else is worked out at the end."""

    def __init__(self, world: World, sprayer: Sprayer, home: Earth) -> None:
        self.from_s: float | None = None
        self.until_s = 0.0
        self.distance_m = 0.0
        self._world = world
        self._sprayer = sprayer
        self._home = home
        self._last: Pose | None = None

    def tick(self, now_s: float, *, flying: bool) -> None:
        """Note that the flight goes on."""
        if not flying:
            return
        if self.from_s is None:
            self.from_s = now_s
        self.until_s = now_s
        pose, last = self._world.pose_at(now_s), self._last
        if last is not None:
            self.distance_m += math.hypot(pose.east_m - last.east_m, pose.north_m - last.north_m)
        self._last = pose

    def summary(self) -> dict[str, Any]:
        """Return the figures of the flight so far."""
        volume_ml = self._volume_ml(np.array([self.until_s]))[0] if self.from_s else np.zeros(0)
        return {
            "flight_s": round(self.until_s - self.from_s, 3) if self.from_s else 0.0,
            "distance_m": round(self.distance_m, 2),
            "volume_l": round(float(volume_ml.sum()) / 1000.0, 6),
            "volume_ml": [round(float(value), 3) for value in volume_ml],
            "orders": len(self._sprayer.orders),
            "origin": {
                "latitude_deg": self._home.latitude_deg,
                "longitude_deg": self._home.longitude_deg,
            },
            "channels": list(self._sprayer.options.channels),
            "profile": self._sprayer.options.profile,
            "board": self._sprayer.options.board,
        }

    def write(self, folder: Path, summary: dict[str, Any]) -> None:
        """Write `truth.npz` and `truth.json`."""
        try:
            folder.mkdir(parents=True, exist_ok=True)
            np.savez_compressed(folder / "truth.npz", **self._arrays())
            text = json.dumps(summary, indent=1) + "\n"
            (folder / "truth.json").write_text(text, encoding="utf-8")
        except OSError as error:
            reason = error.strerror or str(error)
            raise ConfigError(f"{folder}: the truth cannot be written ({reason})") from error

    def _arrays(self) -> dict[str, Any]:
        from_s = self.from_s if self.from_s is not None else 0.0
        time_s = np.arange(from_s, max(self.until_s, from_s), SPACING_S)
        arrays: dict[str, Any] = {"time_s": time_s, "volume_ml": self._volume_ml(time_s)}
        arrays.update(self._path(time_s))
        orders = self._sprayer.orders
        valves = {channel: i for i, channel in enumerate(self._sprayer.options.channels)}
        arrays["order_time_s"] = np.array([order.at_s for order in orders], dtype=np.float64)
        arrays["order_valve"] = np.array([valves[order.channel] for order in orders], dtype=int)
        arrays["order_pulse_us"] = np.array([order.pulse_us for order in orders], dtype=int)
        return arrays

    def _path(self, time_s: Floats) -> dict[str, Floats]:
        """Return the path at `time_s`, straight between steps of the vehicle."""
        if len(time_s) == 0:
            return {}
        knots_s = np.arange(time_s[0], self.until_s, _PATH_S)
        poses = [self._world.pose_at(float(knot_s)) for knot_s in knots_s]

        def along(name: str) -> Floats:
            values = np.array([getattr(pose, name) for pose in poses], dtype=np.float64)
            if name == "heading_deg":
                values = np.degrees(np.unwrap(np.radians(values)))
            return np.interp(time_s, knots_s, values)

        names = ("east_m", "north_m", "height_m", "velocity_east_m_s", "velocity_north_m_s")
        path = {name: along(name) for name in names}
        path["heading_deg"] = along("heading_deg")
        return path

    def _volume_ml(self, time_s: Floats) -> Floats:
        return self._sprayer.volume_ml(time_s)
