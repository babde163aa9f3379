"""The path that was really flown, from all that was told of it: a fixed-interval smoother.

A Kalman filter forwards and Rauch's, Tung's and Striebel's way back, with white jerk; between two
states the most probable path is a polynomial of the fifth degree. It knows the whole flight, and
shares nothing with what it judges.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sitl.guidance import STEP_S
from sitl.trajectory import Floats, Trajectory

if TYPE_CHECKING:
    from sitl.earth import Earth
    from sitl.recorded import Recorded

# How far places and velocities that are told are off (1 sd), and how a copter changes its push and
# turns its nose: the flown logs' own.
PLACE_SD_M, VELOCITY_SD_M_S = 0.05, 0.05
JERK_M2_S5 = 20.0
HEADING_SD_DEG, YAW_JERK_DEG2_S5 = 0.2, 2e5


@dataclass(frozen=True, slots=True)
class Told:
    """Columns that were told of one derivative (0: the value), and how far they are off (1 sd)."""

    order: int
    values: Floats
    sd: float


def smoothed(time_s: Floats, told: list[Told], jerk: float) -> Floats:
    """Return value, slope and bend of each column: rows x 3 x columns.

    >>> t = np.arange(50) * 0.1
    >>> line = smoothed(t, [Told(0, 3.0 * t[:, None], 0.1)], 1.0)
    >>> [round(float(v), 3) for v in line[25, :2, 0]]
    [7.5, 3.0]
    """
    count, columns = told[0].values.shape
    pick = np.zeros((len(told), 3))
    pick[np.arange(len(told)), [each.order for each in told]] = 1.0
    noise = np.diag([each.sd**2 for each in told])
    state = np.zeros((3, columns))
    for each in told:
        state[each.order] = each.values[0]
    spread = np.diag([1e2, 1e4, 1e4])
    # What was foretold of each time, what was made of it, and the way between them.
    ahead, ahead_p = np.empty((count, 3, columns)), np.empty((count, 3, 3))
    kept, kept_p, ways = np.empty_like(ahead), np.empty_like(ahead_p), np.empty_like(ahead_p)
    for i in range(count):
        ways[i] = np.eye(3)
        if i:
            way, grown = _step(float(time_s[i] - time_s[i - 1]), jerk)
            ways[i] = way
            state, spread = way @ state, way @ spread @ way.T + grown
        ahead[i], ahead_p[i] = state, spread
        seen = np.stack([each.values[i] for each in told])
        gain = spread @ pick.T @ np.linalg.inv(pick @ spread @ pick.T + noise)
        state = state + gain @ (seen - pick @ state)
        spread = spread - gain @ pick @ spread
        kept[i], kept_p[i] = state, spread
    found = kept.copy()
    for i in range(count - 2, -1, -1):
        back = kept_p[i] @ ways[i + 1].T @ np.linalg.inv(ahead_p[i + 1])
        found[i] = kept[i] + back @ (found[i + 1] - ahead[i + 1])
    return found


def _step(dt: float, jerk: float) -> tuple[Floats, Floats]:
    way = np.array([[1.0, dt, 0.5 * dt * dt], [0.0, 1.0, dt], [0.0, 0.0, 1.0]])
    a, b, c = dt**5 / 20.0, dt**4 / 8.0, dt**3 / 6.0
    grown = np.array([[a, b, c], [b, dt**3 / 3.0, dt * dt / 2.0], [c, dt * dt / 2.0, dt]])
    return way, jerk * grown


def between(at_s: Floats, time_s: Floats, states: Floats) -> tuple[Floats, Floats]:
    """Return values and slopes between states: the polynomials that go through both ends."""
    i = np.clip(np.searchsorted(time_s, at_s, side="right") - 1, 0, len(time_s) - 2)
    span = (time_s[i + 1] - time_s[i])[:, None]
    u = (at_s - time_s[i])[:, None] / span
    p, v, a = states[i, 0], states[i, 1] * span, states[i, 2] * span**2
    d = states[i + 1, 0] - p - v - 0.5 * a
    e = states[i + 1, 1] * span - v - a
    f = states[i + 1, 2] * span**2 - a
    c3, c4, c5 = 10 * d - 4 * e + 0.5 * f, -15 * d + 7 * e - f, 6 * d - 3 * e + 0.5 * f
    value = p + u * (v + u * (0.5 * a + u * (c3 + u * (c4 + u * c5))))
    slope = (v + u * (a + u * (3 * c3 + u * (4 * c4 + 5 * u * c5)))) / span
    return value, slope


def true_path(flight: Recorded, earth: Earth) -> Trajectory:
    """Return the flight as it most probably was, every `STEP_S`."""
    time_s = flight.time_s
    place = np.column_stack(earth.to_local_all(flight.latitude_deg, flight.longitude_deg))
    speed = np.column_stack((flight.velocity_east_m_s, flight.velocity_north_m_s))
    states = smoothed(
        time_s, [Told(0, place, PLACE_SD_M), Told(1, speed, VELOCITY_SD_M_S)], JERK_M2_S5
    )
    nose = np.unwrap(flight.heading_deg, period=360.0)[:, None]
    turned = smoothed(time_s, [Told(0, nose, HEADING_SD_DEG)], YAW_JERK_DEG2_S5)
    at_s = time_s[0] + STEP_S * np.arange(int((time_s[-1] - time_s[0]) / STEP_S) + 1)
    where, moves = between(at_s, time_s, states)
    return Trajectory(
        time_s=at_s,
        east_m=where[:, 0],
        north_m=where[:, 1],
        velocity_east_m_s=moves[:, 0],
        velocity_north_m_s=moves[:, 1],
        heading_deg=between(at_s, time_s, turned)[0][:, 0],
        leg=np.zeros(len(at_s), dtype=np.int64),
        height_m=float(np.median(flight.height_m)),
    )
