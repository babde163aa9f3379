"""`vrspray sitl serve --along`: the stub autopilot's vehicle follows a recorded flight.

It truly flies the smoothed path, and tells what was told along it, in the modes that it was in.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sitl.earth import Earth
from sitl.recorded import Recorded, paths_of
from sitl.stub.world import Estimator, Pose
from sitl.trajectory import Trajectory


@dataclass(slots=True)
class Along:
    """A motion along a path from `start_s` on, before it at its start."""

    path: Trajectory
    flight: Recorded
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


def along(flight: Recorded, home: Earth) -> tuple[Along, Along]:
    """Return the true motion, and the one that was told."""
    path, told = paths_of(flight, home)
    return Along(path, flight), Along(told, flight)
