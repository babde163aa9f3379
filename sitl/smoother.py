"""The path that was really flown, from all that was told of it: a fixed-interval smoother.

A Kalman filter forwards and Rauch's, Tung's and Striebel's way back, with white jerk. It knows the
whole flight, and shares nothing with what it judges.
"""

from __future__ import annotations

import numpy as np

from sitl.trajectory import Floats, Trajectory

# How far places and velocities that are told are off (1 sd), and how a copter changes its push and
# turns its nose: the flown logs' own.
PLACE_SD_M, VELOCITY_SD_M_S, JERK_M2_S5 = 0.05, 0.05, 20.0
HEADING_SD_DEG, YAW_JERK_DEG2_S5 = 0.2, 2e5
# The path is worked out so often: between two a straight line is off by a millimetre.
STEP_S = 0.05
# Of the spread by a white jerk: the powers of the time, and what divides them.
_POWERS, _TIMES = np.add.outer([2, 1, 0], [3, 2, 1]), np.array([2.0, 1.0, 1.0])


def smoothed(time_s: Floats, told: Floats, sd: list[float], jerk: float, at_s: Floats) -> Floats:
    """Return values and slopes at some times: times x 2 x columns.

    `told` are values, then slopes as far as they are told: times x orders x columns, each order
    off by its `sd`.

    >>> t = np.arange(50) * 0.1
    >>> smoothed(t, 3.0 * t[:, None, None], [0.1], 1.0, np.array([2.52])).ravel().round(2).tolist()
    [7.56, 3.0]
    """
    pick, noise = np.eye(len(sd), 3), np.diag(np.square(sd))
    state, spread = np.zeros((3, told.shape[2])), np.diag([1e2, 1e4, 1e4])
    state[: len(sd)] = told[0]
    times = np.union1d(time_s, at_s)
    rows = np.where(np.isin(times, time_s), np.searchsorted(time_s, times), -1)
    # Of each time: the way to it, what was foretold of it, what was made of that.
    steps = []
    for row, gap_s in zip(rows.tolist(), np.diff(times, prepend=times[0]).tolist(), strict=True):
        way, grown = _step(gap_s)
        state, spread = way @ state, way @ spread @ way.T + jerk * grown
        ahead = state, spread
        if row >= 0:
            gain = spread @ pick.T @ np.linalg.inv(pick @ spread @ pick.T + noise)
            state = state + gain @ (told[row] - pick @ state)
            spread = spread - gain @ pick @ spread
        steps.append((way, *ahead, state, spread))
    found = [state]
    for (way, ahead_of, ahead_p, *_), (*_, kept, kept_p) in zip(
        steps[:0:-1], steps[-2::-1], strict=True
    ):
        back = kept_p @ way.T @ np.linalg.inv(ahead_p)
        found.append(kept + back @ (found[-1] - ahead_of))
    path: Floats = np.array(found[::-1])[np.searchsorted(times, at_s), :2]
    return path


def _step(gap_s: float) -> tuple[Floats, Floats]:
    """Return how a state goes on, and what a white jerk of one adds to its spread."""
    way = np.array([[1.0, gap_s, 0.5 * gap_s**2], [0.0, 1.0, gap_s], [0.0, 0.0, 1.0]])
    return way, gap_s**_POWERS / (_POWERS * np.outer(_TIMES, _TIMES))


def true_path(
    time_s: Floats, place_m: Floats, velocity_m_s: Floats, heading_deg: Floats, height_m: float
) -> Trajectory:
    """Return the flight as it most probably was; places and velocities are (east, north) rows."""
    at_s = np.arange(time_s[0], time_s[-1], STEP_S)
    told = np.stack((place_m, velocity_m_s), axis=1)
    path = smoothed(time_s, told, [PLACE_SD_M, VELOCITY_SD_M_S], JERK_M2_S5, at_s)
    nose = np.unwrap(heading_deg, period=360.0)[:, None, None]
    return Trajectory(
        time_s=at_s,
        east_m=path[:, 0, 0],
        north_m=path[:, 0, 1],
        velocity_east_m_s=path[:, 1, 0],
        velocity_north_m_s=path[:, 1, 1],
        heading_deg=smoothed(time_s, nose, [HEADING_SD_DEG], YAW_JERK_DEG2_S5, at_s)[:, 0, 0],
        leg=np.zeros(len(at_s), dtype=np.int64),
        height_m=height_m,
    )
