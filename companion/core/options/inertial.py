"""Between two positions: what attitude and accelerometer say of the motion.

The accelerometer feels all but gravity, and the attitude says which way is down. Together they give
the acceleration over the ground twenty times a second, with an error that changes slowly: half a
degree of tilt is 0.09 m/s2. So the motion is summed from them, and the positions tell how far that
has gone astray: a filter of `motion.py` whose acceleration is the error. It is believed as far as
it foretells the positions better than the filters that know nothing else.

Without these messages nothing here changes anything.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

from companion.core.motion import (
    SHARE_MIN,
    Axis,
    Belief,
    Model,
    Seen,
    Told,
    follow,
    foreseen,
    judged,
    mixed,
    moved,
    stretch,
)

if TYPE_CHECKING:
    from companion.core.inputs import AttitudeReport, ImuReport
    from companion.core.motion import Stretch

GRAVITY_M_S2 = 9.80665
# The attitude is carried to the time of the accelerometer by the rates that it tells, no farther.
ATTITUDE_AGE_MAX_S = 0.15
# Slower than seven times a second says too little of what happens in between.
GAP_MAX_S = 0.15
KEPT_S = 1.5
SAMPLES_MAX = 200
# Anything else is no multirotor in flight, but a fault or a fall.
ACCELERATION_MAX_M_S2 = 15.0
RATE_MAX_DEG_S = 720.0
# So much of them makes the acceleration of what follows, and so far the line through them is
# followed. Tried on simulated flights at 2 and 5 m/s, in gusts, braking and swinging, vibration
# 0.3 m/s2 (1 sd): 0.1 s without the line is as good but at 2 m/s, 0.45 s is worse in gusts.
RECENT_S, NEWEST_MAX, FOLLOWED = 0.3, 16, 0.6
# The error of the acceleration over the ground, as assumed: 0.25 m/s2 that lasts for 10 s.
ASTRAY = Model(0.11, 10.0, shaken_m_s_sqrt_s=0.1)
# It is believed where nothing speaks against it, but not after it has been wrong lately: a mean of
# what the positions say for it (logarithms; a sound one has 0.0 to 1.1, one mounted back to front
# -3.5 to -18).
BEGINS_S, ENDS_S = 5.0, 60.0
TRUST_TIME_S = 20.0
TRUSTED, UNPROVEN = -0.3, -0.4
SPEAKS_FOR_MAX, SPEAKS_AGAINST_MAX = 3.0, 20.0


class Sample(NamedTuple):
    """The acceleration over the ground at a time of the positions' clock."""

    at_s: float
    east_m_s2: float
    north_m_s2: float


class Gained(NamedTuple):
    """Velocity and way that an acceleration adds, to the east and to the north."""

    east_m_s: float
    north_m_s: float
    east_m: float
    north_m: float


class Inertia(NamedTuple):
    """What was heard of attitude and accelerometer, and the motion by it at the last position."""

    attitude: AttitudeReport | None = None
    samples: tuple[Sample, ...] = ()
    at_s: float = -math.inf
    belief: Belief | None = None
    recent: tuple[float, float] = (0.0, 0.0)
    share: float = SHARE_MIN
    trust: float = UNPROVEN

    def with_imu(self, item: ImuReport, position_s: float) -> Inertia:
        """Return it with one more acceleration; `position_s` is how late a position is."""
        sample = _sample(item, self.attitude, position_s)
        if sample is None:
            return self
        last = self.samples[-1] if self.samples else None
        if last is not None and not 0.0 < sample.at_s - last.at_s <= GAP_MAX_S:
            # An older one is a copy of what is known; after a gap all begins anew.
            begun = (sample,) if abs(sample.at_s - last.at_s) > GAP_MAX_S else self.samples
            return self._replace(samples=begun, recent=recent_of(begun))
        kept = self.samples
        if len(kept) >= SAMPLES_MAX or (kept and sample.at_s - kept[0].at_s > 2.0 * KEPT_S):
            kept = tuple(each for each in kept if sample.at_s - each.at_s <= KEPT_S)
            kept = kept[-SAMPLES_MAX // 2 :]
        samples = (*kept, sample)
        return self._replace(samples=samples, recent=recent_of(samples))

    def after_position(
        self, at_s: float, seen: tuple[Seen, Seen], agreed: Belief, likely: float | None
    ) -> Inertia:
        """Return it after a position, true at `at_s` and as likely (a logarithm) to the others.

        `likely` is None where the filters of the positions began anew.
        """
        if not self.samples:
            return self
        dt_s = at_s - self.at_s
        gained = None if likely is None else gained_over(self.samples, self.at_s, at_s)
        if gained is None or self.belief is None or likely is None:
            return self._replace(at_s=at_s, belief=_begun(agreed), share=SHARE_MIN)
        east, north = seen
        found = follow(
            ASTRAY,
            self.belief,
            dt_s,
            _less(east, gained.east_m, gained.east_m_s),
            _less(north, gained.north_m, gained.north_m_s),
        )
        if found is None:
            return self._replace(at_s=at_s, belief=_begun(agreed), share=SHARE_MIN)
        belief, own = found
        evidence = own - likely
        said = min(max(evidence, -SPEAKS_AGAINST_MAX), SPEAKS_FOR_MAX)
        trust = self.trust + (1.0 - math.exp(-dt_s / TRUST_TIME_S)) * (said - self.trust)
        share = SHARE_MIN
        if trust > TRUSTED:
            prior = foreseen(self.share, dt_s, begins_s=BEGINS_S, ends_s=ENDS_S)
            share = judged(prior, evidence)
        moved_on = Belief(
            _more(belief.east, gained.east_m, gained.east_m_s),
            _more(belief.north, gained.north_m, gained.north_m_s),
        )
        return self._replace(at_s=at_s, belief=moved_on, share=share, trust=trust)

    def after(self, dt_s: float, fade_s: float) -> tuple[Axis, Axis] | None:
        """Return the motion `dt_s` after the last position; None where nothing is known of it.

        What comes after the last sample fades as an acceleration of the filters does.
        """
        if self.belief is None or not self.samples or not self.share > 2.0 * SHARE_MIN:
            return None
        until_s = self.at_s + dt_s
        known_s = min(max(self.samples[-1].at_s, self.at_s), until_s)
        if not until_s - known_s <= GAP_MAX_S * 4.0:
            return None
        gained = gained_over(self.samples, self.at_s, known_s)
        if gained is None:
            return None
        over = stretch(ASTRAY.fade_s, known_s - self.at_s)
        rest = stretch(fade_s, until_s - known_s)
        east = _more(moved(self.belief.east, over), gained.east_m, gained.east_m_s)
        north = _more(moved(self.belief.north, over), gained.north_m, gained.north_m_s)
        return _rest(east, self.recent[0], rest), _rest(north, self.recent[1], rest)


NO_INERTIA = Inertia()


def blended(by_positions: Told, by_inertia: Axis, share: float) -> Told:
    """Return one direction as both say, the inertia as far as it is believed."""
    mine = mixed(Axis(*by_positions), by_inertia, share)
    return Told(*mine)


def _begun(agreed: Belief) -> Belief:
    return Belief(
        agreed.east._replace(acceleration_m_s2=0.0), agreed.north._replace(acceleration_m_s2=0.0)
    )


def _less(seen: Seen, way_m: float, velocity_m_s: float) -> Seen:
    told_m_s = seen.velocity_m_s
    return Seen(seen.position_m - way_m, None if told_m_s is None else told_m_s - velocity_m_s)


def _more(axis: Axis, way_m: float, velocity_m_s: float) -> Axis:
    return axis._replace(
        position_m=axis.position_m + way_m, velocity_m_s=axis.velocity_m_s + velocity_m_s
    )


def _rest(axis: Axis, measured_m_s2: float, rest: Stretch) -> Axis:
    """Return one direction after the time that no sample tells of."""
    now = axis._replace(acceleration_m_s2=axis.acceleration_m_s2 + measured_m_s2)
    return moved(now, rest)


def _sample(item: ImuReport, attitude: AttitudeReport | None, position_s: float) -> Sample | None:
    """Return the acceleration over the ground; None where it is not known or cannot be."""
    if attitude is None or not abs(item.boot_s - attitude.boot_s) <= ATTITUDE_AGE_MAX_S:
        return None
    late_s = item.boot_s - attitude.boot_s
    rates = (attitude.roll_rate_deg_s, attitude.pitch_rate_deg_s, attitude.yaw_rate_deg_s)
    if not all(abs(rate) <= RATE_MAX_DEG_S for rate in rates):
        return None
    roll, pitch, yaw = (
        math.radians(angle + rate * late_s)
        for angle, rate in zip(
            (attitude.roll_deg, attitude.pitch_deg, attitude.yaw_deg), rates, strict=True
        )
    )
    if not abs(roll) + abs(pitch) + abs(yaw) < math.inf:
        return None
    east, north, up = turned((item.forward_m_s2, item.right_m_s2, item.down_m_s2), roll, pitch, yaw)
    if not max(abs(east), abs(north), abs(up - GRAVITY_M_S2)) <= ACCELERATION_MAX_M_S2:
        return None
    return Sample(item.boot_s + position_s, east, north)


def turned(
    body: tuple[float, float, float], roll: float, pitch: float, yaw: float
) -> tuple[float, float, float]:
    """Return a vector of the body (forward, right, down) as east, north and up; angles in rad.

    By yaw, then pitch, then roll, as MAVLink's ATTITUDE has them.

    >>> [round(each, 3) + 0.0 for each in turned((1.0, 0.0, 0.0), 0.0, 0.0, math.pi / 2)]
    [1.0, 0.0, 0.0]
    """
    forward, right, down = body
    sin_roll, cos_roll = math.sin(roll), math.cos(roll)
    sin_pitch, cos_pitch = math.sin(pitch), math.cos(pitch)
    sin_yaw, cos_yaw = math.sin(yaw), math.cos(yaw)
    below = sin_roll * right + cos_roll * down
    ahead = cos_pitch * forward + sin_pitch * below
    aside = cos_roll * right - sin_roll * down
    return (
        sin_yaw * ahead + cos_yaw * aside,
        cos_yaw * ahead - sin_yaw * aside,
        sin_pitch * forward - cos_pitch * below,
    )


def gained_over(samples: tuple[Sample, ...], from_s: float, to_s: float) -> Gained | None:
    """Return what the samples add from one time to another; None where they do not cover it.

    Straight lines between samples; before the first and after the last, held.

    >>> gained_over((Sample(0.0, 2.0, 0.0), Sample(0.5, 2.0, 1.0)), 0.0, 0.5)
    Gained(east_m_s=1.0, north_m_s=0.25, east_m=0.25, north_m=0.041666666666666664)
    """
    if to_s <= from_s:
        return Gained(0.0, 0.0, 0.0, 0.0)
    if not samples:
        return None
    first, last = samples[0], samples[-1]
    if not (first.at_s - from_s <= GAP_MAX_S / 2 and to_s - last.at_s <= GAP_MAX_S):
        return None
    begin = next((i for i in range(len(samples) - 1, -1, -1) if samples[i].at_s <= from_s), None)
    line = list(samples if begin is None else samples[begin:])
    if begin is None:
        line.insert(0, first._replace(at_s=from_s))
    if last.at_s < to_s:
        line.append(last._replace(at_s=to_s))
    east_m_s = north_m_s = east_m = north_m = 0.0
    for a, b in pairwise(line):
        if a.at_s >= to_s:
            break
        span_s = b.at_s - a.at_s
        low_s, high_s = max(a.at_s, from_s), min(b.at_s, to_s)
        dt_s = high_s - low_s
        if not dt_s > 0.0:
            continue
        one, two = (low_s - a.at_s) / span_s, (high_s - a.at_s) / span_s
        e0, e1 = (a.east_m_s2 + s * (b.east_m_s2 - a.east_m_s2) for s in (one, two))
        n0, n1 = (a.north_m_s2 + s * (b.north_m_s2 - a.north_m_s2) for s in (one, two))
        east_m += east_m_s * dt_s + (2.0 * e0 + e1) * dt_s * dt_s / 6.0
        north_m += north_m_s * dt_s + (2.0 * n0 + n1) * dt_s * dt_s / 6.0
        east_m_s += 0.5 * (e0 + e1) * dt_s
        north_m_s += 0.5 * (n0 + n1) * dt_s
    return Gained(east_m_s, north_m_s, east_m, north_m)


def recent_of(samples: tuple[Sample, ...]) -> tuple[float, float]:
    """Return the acceleration just now: where a line through the newest samples leads to.

    Not all the way to the last one, as vibration leads the line too.
    """
    last_s = samples[-1].at_s
    newest = [s for s in samples[-NEWEST_MAX:] if last_s - s.at_s <= RECENT_S]
    late = [s.at_s - last_s for s in newest]
    middle_s = sum(late) / len(late)
    spread_s2 = sum((each - middle_s) ** 2 for each in late)
    found = []
    for axis in (1, 2):
        values = [s[axis] for s in newest]
        mean = sum(values) / len(values)
        slope = 0.0
        if spread_s2 > 0.0:
            pairs = zip(late, values, strict=True)
            slope = sum((each - middle_s) * value for each, value in pairs) / spread_s2
        found.append(mean - FOLLOWED * slope * middle_s)
    return found[0], found[1]
