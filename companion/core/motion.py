"""The vehicle's motion from its positions: two filters side by side, each as far as it is believed.

A multirotor in cruise only shivers in gusts, which is best told from the noise of its velocity by
a filter that believes in small, short accelerations. One that brakes or follows a swinging speed
needs the opposite. Neither serves both: the calm filter lags by centimetres while braking, the
nimble one doses the noise in cruise. So both run, and their share follows how well each foretold
what came (interacting multiple models, Blom and Bar-Shalom, IEEE Trans. Automatic Control 1988,
without the mixing of states, which changed nothing).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

# Noise of what is heard, as assumed: RTK position, fused velocity (accuracy.md section 4).
POSITION_SD_M = 0.02
VELOCITY_SD_M_S = 0.03
# A position that disagrees with its prediction by more than this is a jump, not motion.
JUMP_M = 2.0
# A vehicle changes between cruise and manoeuvre about this often (2.5 to 50 s serve alike).
CHANGE_TIME_S = 10.0
# No filter is ever given up: it must come back within a few messages.
SHARE_MIN = 1e-4
# The longest time between messages that the filters bridge, and the finest step of their gains.
BRIDGED_MAX_S = 2.0
GAIN_STEP_S = 0.005
# So many rounds stand for thousands of messages.
DOUBLINGS = 14
Matrix = NDArray[np.float64]


def gained_s(dt_s: float, fade_s: float) -> float:
    """Return the velocity gained over `dt_s` by an acceleration of 1 m/s2 that fades."""
    return fade_s * (1.0 - math.exp(-dt_s / fade_s))


def carried_s2(dt_s: float, fade_s: float) -> float:
    """Return the way gained over `dt_s` by an acceleration of 1 m/s2 that fades."""
    return fade_s * (dt_s - gained_s(dt_s, fade_s))


class Model(NamedTuple):
    """An acceleration driven by white noise that fades (Singer, IEEE Trans. AES 1970)."""

    wander_m_s2_sqrt_s: float
    fade_s: float


# Tried on simulated flights: cruise in gusts of 1 m/s at 2 and 5 m/s, a speed that swings by
# 1 m/s, braking from 6 to 2 m/s; each alone is up to half worse in the other's flights.
CRUISE = Model(0.4, 0.5)
MANOEUVRE = Model(1.0, 3.0)


class Axis(NamedTuple):
    """One direction of the motion, in one filter."""

    position_m: float
    velocity_m_s: float
    acceleration_m_s2: float


@dataclass(frozen=True, slots=True)
class Belief:
    """One filter's state in both directions."""

    east: Axis
    north: Axis


class Gains(NamedTuple):
    """A filter in its steady state: corrections, and how far off a message is expected to be."""

    by_position: tuple[float, float, float]
    by_velocity: tuple[float, float, float]
    # The inverse of the covariance of what is unexpected, and half its logarithm.
    weight: tuple[float, float, float]
    half_log: float


class Seen(NamedTuple):
    """What a message says of one direction; the velocity is None where it is not known."""

    position_m: float
    velocity_m_s: float | None


@lru_cache(maxsize=512)
def gains(model: Model, steps: int, velocity_known: bool) -> Gains:
    """Return the steady-state Kalman filter of messages every `steps` times `GAIN_STEP_S`."""
    dt_s = steps * GAIN_STEP_S
    carry = np.array(
        [
            [1.0, dt_s, carried_s2(dt_s, model.fade_s)],
            [0.0, 1.0, gained_s(dt_s, model.fade_s)],
            [0.0, 0.0, math.exp(-dt_s / model.fade_s)],
        ]
    )
    push = np.array([[dt_s**2 / 2], [dt_s], [1.0]])
    wander = push @ push.T * model.wander_m_s2_sqrt_s**2 * dt_s
    count = 2 if velocity_known else 1
    seen = np.eye(3)[:count]
    noise = np.diag([POSITION_SD_M**2, VELOCITY_SD_M_S**2])[:count, :count]
    spread = _steady(carry, wander, seen, noise)
    unexpected = seen @ spread @ seen.T + noise
    gain = spread @ seen.T @ np.linalg.inv(unexpected)
    inverse, padded = np.zeros((2, 2)), np.zeros((3, 2))
    inverse[:count, :count] = np.linalg.inv(unexpected)
    padded[:, :count] = gain
    return Gains(
        by_position=_three(padded[:, 0]),
        by_velocity=_three(padded[:, 1]),
        weight=(float(inverse[0, 0]), float(inverse[0, 1]), float(inverse[1, 1])),
        half_log=0.5 * math.log(float(np.linalg.det(unexpected))),
    )


def _steady(carry: Matrix, wander: Matrix, seen: Matrix, noise: Matrix) -> Matrix:
    """Return the covariance before a message once many have come: the Riccati equation's solution.

    By doubling (Anderson, Int. J. Control 1978): each round stands for twice as many messages as
    the one before it. A filter for a new interval must not cost the control loop a millisecond.
    """
    a, g, spread = carry.T, seen.T @ np.linalg.inv(noise) @ seen, wander
    for _ in range(DOUBLINGS):
        w = np.linalg.inv(np.eye(3) + g @ spread)
        a, g, spread = a @ w @ a, g + a @ w @ g @ a.T, spread + a.T @ spread @ w @ a
    return spread


def _three(column: Matrix) -> tuple[float, float, float]:
    return float(column[0]), float(column[1]), float(column[2])


def follow(
    model: Model, before: Belief, dt_s: float, east: Seen, north: Seen
) -> tuple[Belief, float] | None:
    """Return a filter after one message, and how likely it found it (a logarithm); None: a jump."""
    steps = round(min(max(dt_s, GAIN_STEP_S), 0.5) / GAIN_STEP_S)
    by = gains(model, steps, east.velocity_m_s is not None)
    found_east = _correct(model, by, before.east, dt_s, east)
    found_north = _correct(model, by, before.north, dt_s, north)
    if found_east is None or found_north is None:
        return None
    likely = found_east[1] + found_north[1]
    return Belief(found_east[0], found_north[0]), likely


def _correct(
    model: Model, by: Gains, axis: Axis, dt_s: float, seen: Seen
) -> tuple[Axis, float] | None:
    ahead = carried(model, axis, dt_s)
    off_m = seen.position_m - ahead.position_m
    if not abs(off_m) <= JUMP_M:
        return None
    off_m_s = 0.0 if seen.velocity_m_s is None else seen.velocity_m_s - ahead.velocity_m_s
    first, both, second = by.weight
    unlikely = first * off_m * off_m + 2.0 * both * off_m * off_m_s + second * off_m_s * off_m_s
    p, v = by.by_position, by.by_velocity
    corrected = Axis(
        ahead.position_m + p[0] * off_m + v[0] * off_m_s,
        ahead.velocity_m_s + p[1] * off_m + v[1] * off_m_s,
        ahead.acceleration_m_s2 + p[2] * off_m + v[2] * off_m_s,
    )
    return corrected, -0.5 * unlikely - by.half_log


def carried(model: Model, axis: Axis, dt_s: float) -> Axis:
    """Return one direction `dt_s` later; into the past, at constant velocity."""
    if dt_s <= 0.0:
        position_m = axis.position_m + axis.velocity_m_s * dt_s
        return Axis(position_m, axis.velocity_m_s, axis.acceleration_m_s2)
    position_m, velocity_m_s, acceleration = axis
    fade_s = model.fade_s
    gained = gained_s(dt_s, fade_s)
    return Axis(
        position_m + velocity_m_s * dt_s + acceleration * (fade_s * (dt_s - gained)),
        velocity_m_s + acceleration * gained,
        acceleration * (1.0 - gained / fade_s),
    )


def manoeuvre_share(
    share: float, dt_s: float, cruise_likely: float, manoeuvre_likely: float
) -> float:
    """Return how far the vehicle is believed to manoeuvre, after what both filters foretold."""
    changes = 1.0 - math.exp(-dt_s / CHANGE_TIME_S)
    prior = share * (1.0 - changes) + (1.0 - share) * changes
    odds = prior / (1.0 - prior) * math.exp(min(max(manoeuvre_likely - cruise_likely, -50.0), 50.0))
    return min(max(odds / (1.0 + odds), SHARE_MIN), 1.0 - SHARE_MIN)


def mixed(first: Axis, second: Axis, share: float) -> Axis:
    """Return `share` of the second and the rest of the first.

    >>> mixed(Axis(0.0, 1.0, 0.0), Axis(0.0, 3.0, 4.0), 0.25)
    Axis(position_m=0.0, velocity_m_s=1.5, acceleration_m_s2=1.0)
    """
    return Axis(
        first.position_m + share * (second.position_m - first.position_m),
        first.velocity_m_s + share * (second.velocity_m_s - first.velocity_m_s),
        first.acceleration_m_s2 + share * (second.acceleration_m_s2 - first.acceleration_m_s2),
    )
