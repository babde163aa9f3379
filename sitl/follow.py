"""`vrspray sitl serve --along`: the stub autopilot's vehicle follows a recorded flight.

It truly flies the smoothed path, and tells what was told along it, in the modes that it was in.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sitl.earth import Earth
from sitl.recorded import Recorded, paths_of
from sitl.stub.world import Estimator, Pose
from sitl.trajectory import Floats, Trajectory


@dataclass(slots=True)
class Along:
    """A motion along a path from `start_s` on, before it at its start.

    `fixes` are times, metres east and north that the receiver told.
    """

    path: Trajectory
    flight: Recorded
    fixes: Floats
    start_s: float = np.inf

    def log_s(self, now_s: float) -> float:
        """Return the time of the log that it is now."""
        return float(self.path.time_s[0] + max(now_s - self.start_s, 0.0))

    def advance(self, until_s: float) -> None:
        """Do nothing: the flight is over."""

    def pose_at(self, time_s: float) -> Pose:
        """Return where it was, or is said to have been."""
        at_s, states = self.log_s(time_s), self.flight.states
        truth = self.path.truth_at(at_s)
        return Pose(
            time_s=time_s,
            east_m=truth.east_m,
            north_m=truth.north_m,
            height_m=float(np.interp(at_s, states.time_s, states.height_m)),
            velocity_east_m_s=truth.velocity_east_m_s,
            velocity_north_m_s=truth.velocity_north_m_s,
            heading_deg=truth.heading_deg,
        )

    def finished(self, time_s: float) -> bool:
        """Return whether the log is at its end."""
        return self.log_s(time_s) >= float(self.path.time_s[-1])


class Told(Estimator):
    """What the autopilot believed, as it told it."""

    def __init__(self, along: Along) -> None:
        self._along = along

    def estimate(self, now_s: float) -> Pose:
        """Return what was told of a time."""
        return self._along.pose_at(now_s)

    def fix(self, now_s: float) -> Pose:
        """Return the last place of the receiver, at its stamp."""
        told, at_s = self.estimate(now_s), self._along.log_s(now_s)
        number = int(np.searchsorted(self._along.fixes[0], at_s, side="right")) - 1
        if number < 0:
            return told
        fixed_s, east_m, north_m = self._along.fixes[:, number].tolist()
        return replace(told, time_s=now_s - (at_s - fixed_s), east_m=east_m, north_m=north_m)


def along(flight: Recorded, home: Earth) -> tuple[Along, Along]:
    """Return the true motion, and the one that was told."""
    path, told = paths_of(flight, home)
    time_s, *place = flight.receiver[:, flight.receiver[1:].any(axis=0)]
    fixes = np.array([time_s, *home.to_local_all(*place)])
    return Along(path, flight, fixes), Along(told, flight, fixes)
