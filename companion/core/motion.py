"""The vehicle's motion from its positions: filters side by side, each as far as it is believed.

A multirotor in cruise only shivers in gusts, which is best told from the noise of its velocity by
a filter that believes in small, short accelerations. One that brakes or follows a swinging speed
needs the opposite. Neither serves both: the calm filter lags by centimetres while braking, the
nimble one doses the noise in cruise. So both run, and their share follows how well each foretold
what came (interacting multiple models, Blom and Bar-Shalom, IEEE Trans. Automatic Control 1988,
without the mixing of states, which changed nothing).

Both believe the velocity that is told, and follow a place that disagrees with it 0.8 s late. An
autopilot tells such a place while its estimator draws it after GNSS: PX4 by 0.05 to 0.5 m/s, for
seconds. So both run a second time, doubting: how far the told velocity is from that of the place
is a state of theirs (a bias that fades slowly, as of an inertial sensor; Friedland, IEEE Trans.
Automatic Control 1969), and the place they hear is smooth, as a fused one is. A receiver that is
noisy, or that wanders from message to message, speaks against them, and nobody doubts.

What doubters hear is an estimator's, smooth in its velocity too: they smooth that less, for its
last change says how it goes on.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

from companion.core.arithmetic import (
    Matrix,
    Row,
    added,
    exp,
    identity,
    inverse,
    log,
    product,
    transposed,
)

if TYPE_CHECKING:
    from companion.core.inputs import Telemetry

# Noise of what is heard, as assumed: RTK position, fused velocity (accuracy.md section 4).
POSITION_SD_M = 0.02
VELOCITY_SD_M_S = 0.03
# A place as an autopilot's estimator tells it goes on from message to message to within this:
# rounded to 1e-7 degrees and 1 ms, 1 cm and 5 mm.
SMOOTH_SD_M = 0.01
# Its velocity likewise, rounded to 1 cm/s. Both filters follow it equally
# quickly and differ only in how long an acceleration lasts: of a slow and a quick one the quick one
# was never believed, not even while a vehicle braked by 2 m/s2. Fitted on 2026-11-28 to logs of
# flown ArduCopters and to flights beside both firmwares. What is foretold of the speed for 0.15 s
# ahead errs by 0.037 m/s (rms; 0.064 with a slow and a quick one), beside ArduCopter by 0.015
# (0.028), PX4 0.036 (0.040). 0.5 to 1.0 m/s2 in a second serve alike, but above 0.7 doubters are
# too quick for positions at 5 Hz, and are no longer believed.
SMOOTH_VELOCITY_SD_M_S = 0.015
SMOOTH_WANDER_M_S2_SQRT_S = 0.7
# How far the told velocity is from that of the place where it is doubted, and for how long: PX4's,
# in simulation, by 0.2 m/s (standard deviation). 0.1 to 0.3 m/s and 10 to 30 s serve alike.
ASTRAY_SD_M_S = 0.2
ASTRAY_TIME_S = 30.0
# A position that disagrees with its prediction by more than this is a jump, not motion.
JUMP_M = 2.0
# A vehicle changes between cruise and manoeuvre about this often (2.5 to 50 s serve alike).
CHANGE_TIME_S = 10.0
# An estimator that told one motion begins to tell two about this seldom.
DOUBT_TIME_S = 1000.0
# One message speaks no louder than this for doubt (a logarithm): of places that scatter, some fall
# where a doubting filter has them by chance. Against it, it may.
DOUBT_MAX = 0.5
# No filter is ever given up: it must come back within a few messages.
SHARE_MIN = 1e-4
EVIDENCE_MAX = 50.0
# The longest time between messages that the filters bridge, and the finest step of their gains.
BRIDGED_MAX_S = 2.0
GAIN_STEP_S = 0.005
# The nose: how fast a heading that was not foretold is believed, and how long an acceleration of
# the turn lasts. Fitted to headings of ArduCopter where a pass begins and ends, 10 and 20 a second:
# of the rate 0.3 s ahead 11 deg/s are wrong (rms), 19 without the acceleration.
YAW_TIME_S = 0.07
YAW_FADE_S = 0.3
# No multicopter turns faster, nor begins to from one message to the next: on a flown log an
# estimator set its heading anew by 73 and 27 degrees in 0.1 s.
YAW_RATE_MAX_DEG_S, YAW_STEP_MAX_DEG_S = 360.0, 300.0
# So many rounds stand for thousands of messages; most are there sooner.
DOUBLINGS = 14
SETTLED = 1e-12


def gained_s(dt_s: float, fade_s: float) -> float:
    """Return the velocity gained over `dt_s` by an acceleration of 1 m/s2 that fades."""
    return fade_s * (1.0 - exp(-dt_s / fade_s))


def carried_s2(dt_s: float, fade_s: float) -> float:
    """Return the way gained over `dt_s` by an acceleration of 1 m/s2 that fades."""
    return fade_s * (dt_s - gained_s(dt_s, fade_s))


class Model(NamedTuple):
    """An acceleration driven by white noise that fades (Singer, IEEE Trans. AES 1970).

    `astray_m_s` is how far the told velocity may be from that of the place; 0 believes it.
    `shaken_m_s_sqrt_s` is white noise of the acceleration itself, as an accelerometer has.
    """

    wander_m_s2_sqrt_s: float
    fade_s: float
    position_sd_m: float = POSITION_SD_M
    astray_m_s: float = 0.0
    velocity_sd_m_s: float = VELOCITY_SD_M_S
    shaken_m_s_sqrt_s: float = 0.0


class Models(NamedTuple):
    """A calm and a nimble filter."""

    cruise: Model
    manoeuvre: Model


# Tried on simulated flights: cruise in gusts of 1 m/s at 2 and 5 m/s, a speed that swings by
# 1 m/s, braking from 6 to 2 m/s; each alone is up to half worse in the other's flights.
CRUISE = Model(0.4, 0.5)
MANOEUVRE = Model(1.0, 3.0)
BELIEVING = Models(CRUISE, MANOEUVRE)
DOUBTING = Models(
    *(
        Model(
            SMOOTH_WANDER_M_S2_SQRT_S,
            one.fade_s,
            SMOOTH_SD_M,
            ASTRAY_SD_M_S,
            SMOOTH_VELOCITY_SD_M_S,
        )
        for one in BELIEVING
    )
)


class Axis(NamedTuple):
    """One direction of the motion, in one filter; the velocity is that of the place."""

    position_m: float
    velocity_m_s: float
    acceleration_m_s2: float
    # How much more the told velocity is.
    astray_m_s: float = 0.0


class Belief(NamedTuple):
    """One filter's state in both directions."""

    east: Axis
    north: Axis


class Pair(NamedTuple):
    """A calm and a nimble filter, and how far the vehicle is believed to manoeuvre."""

    cruise: Belief
    manoeuvre: Belief
    share: float


class Gains(NamedTuple):
    """A filter in its steady state: corrections, and how far off a message is expected to be."""

    by_position: Row
    by_velocity: Row
    # The inverse of the covariance of what is unexpected, and half its logarithm.
    weight: tuple[float, float, float]
    half_log: float


class Seen(NamedTuple):
    """What a message says of one direction; the velocity is None where it is not known."""

    position_m: float
    velocity_m_s: float | None


def seen_of(item: Telemetry, place: tuple[float, float]) -> tuple[Seen, Seen]:
    """Return what a message says to the east and to the north; half a velocity is none."""
    east_m_s, north_m_s = item.velocity_east_m_s, item.velocity_north_m_s
    if east_m_s is None or north_m_s is None:
        return Seen(place[0], None), Seen(place[1], None)
    return Seen(place[0], east_m_s), Seen(place[1], north_m_s)


@lru_cache(maxsize=1024)
def gains(model: Model, steps: int, velocity_known: bool) -> Gains:
    """Return the steady-state Kalman filter of messages every `steps` times `GAIN_STEP_S`."""
    dt_s = steps * GAIN_STEP_S
    kept = exp(-dt_s / ASTRAY_TIME_S)
    size = 4 if model.astray_m_s > 0.0 else 3
    carry = _cut(
        (
            (1.0, dt_s, carried_s2(dt_s, model.fade_s), 0.0),
            (0.0, 1.0, gained_s(dt_s, model.fade_s), 0.0),
            (0.0, 0.0, exp(-dt_s / model.fade_s), 0.0),
            (0.0, 0.0, 0.0, kept),
        ),
        size,
    )
    push = (0.5 * dt_s * dt_s, dt_s, 1.0, 0.0)
    power = model.wander_m_s2_sqrt_s * model.wander_m_s2_sqrt_s * dt_s
    strays = model.astray_m_s * model.astray_m_s * (1.0 - kept * kept)
    wander = _cut(
        tuple(
            tuple(a * b * power + (strays if i == j == 3 else 0.0) for j, b in enumerate(push))
            for i, a in enumerate(push)
        ),
        size,
    )
    if model.shaken_m_s_sqrt_s > 0.0:
        wander = added(wander, _cut(_shaken(model.shaken_m_s_sqrt_s, dt_s), size))
    seen = _cut(((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 1.0)), size)[: 2 if velocity_known else 1]
    place2 = model.position_sd_m * model.position_sd_m
    pace2 = model.velocity_sd_m_s * model.velocity_sd_m_s
    noise = ((place2, 0.0), (0.0, pace2)) if velocity_known else ((place2,),)
    spread = _steady(carry, wander, seen, noise)
    across = product(spread, transposed(seen))
    unexpected = added(product(seen, across), noise)
    weight = inverse(unexpected)
    gain = transposed(product(across, weight))
    none = (0.0,) * (4 - size)
    if not velocity_known:
        return Gains(
            by_position=gain[0] + none,
            by_velocity=(0.0,) * 4,
            weight=(weight[0][0], 0.0, 0.0),
            half_log=0.5 * log(unexpected[0][0]),
        )
    (first, both), (_, second) = unexpected
    return Gains(
        by_position=gain[0] + none,
        by_velocity=gain[1] + none,
        weight=(weight[0][0], weight[0][1], weight[1][1]),
        half_log=0.5 * log(first * second - both * both),
    )


def _shaken(noise_m_s_sqrt_s: float, dt_s: float) -> Matrix:
    """Return what white noise of the acceleration makes of place and velocity."""
    power = noise_m_s_sqrt_s * noise_m_s_sqrt_s
    place, both, pace = power * dt_s**3 / 3.0, power * dt_s**2 / 2.0, power * dt_s
    none = (0.0,) * 4
    return ((place, both, 0.0, 0.0), (both, pace, 0.0, 0.0), none, none)


def _cut(matrix: Matrix, size: int) -> Matrix:
    """Return as many columns, and at most as many rows."""
    return tuple(row[:size] for row in matrix[:size])


def _steady(carry: Matrix, wander: Matrix, seen: Matrix, noise: Matrix) -> Matrix:
    """Return the covariance before a message once many have come: the Riccati equation's solution.

    By doubling (Anderson, Int. J. Control 1978): each round stands for twice as many messages as
    the one before it. A filter for a new interval must not cost the control loop many milliseconds.
    """
    a, spread = transposed(carry), wander
    g = product(product(transposed(seen), inverse(noise)), seen)
    one = identity(len(a))
    for _ in range(DOUBLINGS):
        w = inverse(added(one, product(g, spread)))
        wa = product(w, a)
        back = transposed(a)
        more = product(back, product(spread, wa))
        g = added(g, product(product(product(a, w), g), back))
        a = product(a, wa)
        spread = added(spread, more)
        if all(row[i] <= SETTLED * spread[i][i] for i, row in enumerate(more)):
            break
    return spread


class Stretch(NamedTuple):
    """What a time does to a motion; into the past it goes at constant velocity."""

    dt_s: float
    carried_s2: float
    gained_s: float
    kept: float
    astray_kept: float


@lru_cache(maxsize=64)
def stretch(fade_s: float, dt_s: float) -> Stretch:
    """Return what `dt_s` does to the motion of a filter; several ask for the same."""
    if dt_s <= 0.0:
        return Stretch(dt_s, 0.0, 0.0, 1.0, 1.0)
    kept = exp(-dt_s / fade_s)
    gained = fade_s * (1.0 - kept)
    return Stretch(dt_s, fade_s * (dt_s - gained), gained, kept, exp(-dt_s / ASTRAY_TIME_S))


def follow(
    model: Model, before: Belief, dt_s: float, east: Seen, north: Seen
) -> tuple[Belief, float] | None:
    """Return a filter after one message, and how likely it found it (a logarithm); None: a jump."""
    steps = round(min(max(dt_s, GAIN_STEP_S), 0.5) / GAIN_STEP_S)
    by = gains(model, steps, east.velocity_m_s is not None)
    over = stretch(model.fade_s, dt_s)
    found_east = _correct(by, before.east, over, east)
    found_north = _correct(by, before.north, over, north)
    if found_east is None or found_north is None:
        return None
    likely = found_east[1] + found_north[1]
    return Belief(found_east[0], found_north[0]), likely


def _correct(by: Gains, before: Axis, over: Stretch, seen: Seen) -> tuple[Axis, float] | None:
    # As `moved` has it: what it makes is only taken apart again here, eight times a message.
    position_m, velocity_m_s, acceleration, astray_m_s = before
    dt_s, carried_s2, gained_s, kept, astray_kept = over
    position_m = position_m + velocity_m_s * dt_s + acceleration * carried_s2
    velocity_m_s = velocity_m_s + acceleration * gained_s
    acceleration, astray_m_s = acceleration * kept, astray_m_s * astray_kept
    off_m = seen.position_m - position_m
    if not abs(off_m) <= JUMP_M:
        return None
    off_m_s = 0.0
    if seen.velocity_m_s is not None:
        off_m_s = seen.velocity_m_s - velocity_m_s - astray_m_s
    first, both, second = by.weight
    unlikely = first * off_m * off_m + 2.0 * both * off_m * off_m_s + second * off_m_s * off_m_s
    p, v = by.by_position, by.by_velocity
    corrected = Axis(
        position_m + p[0] * off_m + v[0] * off_m_s,
        velocity_m_s + p[1] * off_m + v[1] * off_m_s,
        acceleration + p[2] * off_m + v[2] * off_m_s,
        astray_m_s + p[3] * off_m + v[3] * off_m_s,
    )
    return corrected, -0.5 * unlikely - by.half_log


def moved(axis: Axis, over: Stretch) -> Axis:
    """Return one direction after a stretch of time."""
    position_m, velocity_m_s, acceleration, astray_m_s = axis
    return Axis(
        position_m + velocity_m_s * over.dt_s + acceleration * over.carried_s2,
        velocity_m_s + acceleration * over.gained_s,
        acceleration * over.kept,
        astray_m_s * over.astray_kept,
    )


def follow_pair(
    models: Models, before: Pair, dt_s: float, east: Seen, north: Seen
) -> tuple[Pair, float] | None:
    """Return both filters after one message, and how likely they found it; None: a jump."""
    cruise = follow(models.cruise, before.cruise, dt_s, east, north)
    manoeuvre = follow(models.manoeuvre, before.manoeuvre, dt_s, east, north)
    if cruise is None or manoeuvre is None:
        return None
    calm, nimble = cruise[1], manoeuvre[1]
    prior = foreseen(before.share, dt_s, begins_s=CHANGE_TIME_S)
    # (1 - prior) e^calm + prior e^nimble = (1 - prior) e^calm (1 + odds)
    odds = _odds(prior, nimble - calm)
    likely = calm + log((1.0 - prior) * (1.0 + odds))
    return Pair(cruise[0], manoeuvre[0], _share(odds)), likely


def doubted(share: float, dt_s: float, believing_likely: float, doubting_likely: float) -> float:
    """Return how far the velocity is doubted, after what both pairs foretold."""
    prior = foreseen(share, dt_s, begins_s=DOUBT_TIME_S)
    return judged(prior, min(doubting_likely - believing_likely, DOUBT_MAX))


def together(share: float, likely: float, other_likely: float) -> float:
    """Return how likely two found a message together, the other with a share (logarithms)."""
    return likely + log((1.0 - share) + share * exp(min(other_likely - likely, EVIDENCE_MAX)))


def foreseen(share: float, dt_s: float, *, begins_s: float, ends_s: float = CHANGE_TIME_S) -> float:
    """Return a share before a message; it comes and goes about once in these times."""
    return share * ends_s / (ends_s + dt_s) + (1.0 - share) * dt_s / (begins_s + dt_s)


def judged(share: float, evidence: float) -> float:
    """Return a share after a message that says so much for it (a difference of logarithms)."""
    return _share(_odds(share, evidence))


def _odds(share: float, evidence: float) -> float:
    return share / (1.0 - share) * exp(min(max(evidence, -EVIDENCE_MAX), EVIDENCE_MAX))


def _share(odds: float) -> float:
    return min(max(odds / (1.0 + odds), SHARE_MIN), 1.0 - SHARE_MIN)


def agreed(believing: Pair, doubting: Pair, doubt_share: float) -> Pair:
    """Return one pair that is as both are, each as far as it is believed."""
    nimble, nimble_doubting = (1.0 - doubt_share) * believing.share, doubt_share * doubting.share
    share = nimble + nimble_doubting
    calm = (doubt_share - nimble_doubting) / (1.0 - share)
    return Pair(
        _mixed_belief(believing.cruise, doubting.cruise, calm),
        _mixed_belief(believing.manoeuvre, doubting.manoeuvre, nimble_doubting / share),
        share,
    )


def _mixed_belief(first: Belief, second: Belief, share: float) -> Belief:
    return Belief(mixed(first.east, second.east, share), mixed(first.north, second.north, share))


def carried(model: Model, axis: Axis, dt_s: float) -> Axis:
    """Return one direction `dt_s` later; into the past, at constant velocity."""
    return moved(axis, stretch(model.fade_s, dt_s))


def mixed(first: Axis, second: Axis, share: float) -> Axis:
    """Return `share` of the second and the rest of the first.

    >>> mixed(Axis(0.0, 1.0, 0.0), Axis(0.0, 3.0, 4.0), 0.25)
    Axis(position_m=0.0, velocity_m_s=1.5, acceleration_m_s2=1.0, astray_m_s=0.0)
    """
    return Axis(
        first.position_m + share * (second.position_m - first.position_m),
        first.velocity_m_s + share * (second.velocity_m_s - first.velocity_m_s),
        first.acceleration_m_s2 + share * (second.acceleration_m_s2 - first.acceleration_m_s2),
        first.astray_m_s + share * (second.astray_m_s - first.astray_m_s),
    )


class Told(NamedTuple):
    """One direction of a motion with the velocity that is told.

    The place goes faster by `outrun_m_s`, where the told velocity is doubted.
    """

    position_m: float
    velocity_m_s: float
    acceleration_m_s2: float
    outrun_m_s: float


def later(
    first: Axis,
    second: Axis,
    first_over: Stretch,
    second_over: Stretch,
    share: float,
    by_m_s: float,
) -> Told:
    """Return `share` of the second direction and the rest of the first, as told, some time later.

    Each goes by its own stretch of time, as by `moved` and `mixed`; `by_m_s` is added to the told
    velocity, which stands in place of the place's own.

    >>> axis, now = Axis(7.0, 5.0, 0.0, astray_m_s=-0.25), stretch(0.5, 0.0)
    >>> later(axis, axis, now, now, 0.5, 0.0)
    Told(position_m=7.0, velocity_m_s=4.75, acceleration_m_s2=0.0, outrun_m_s=0.25)
    """
    place, pace, gain, astray = first
    dt_s, carried_s2, gained, kept, astray_kept = first_over
    place, pace = place + pace * dt_s + gain * carried_s2, pace + gain * gained
    gain, astray = gain * kept, astray * astray_kept
    place_2, pace_2, gain_2, astray_2 = second
    dt_s, carried_s2, gained, kept, astray_kept = second_over
    place_2, pace_2 = place_2 + pace_2 * dt_s + gain_2 * carried_s2, pace_2 + gain_2 * gained
    gain_2, astray_2 = gain_2 * kept, astray_2 * astray_kept
    astray += share * (astray_2 - astray)
    return Told(
        place + share * (place_2 - place),
        pace + share * (pace_2 - pace) + astray + by_m_s,
        gain + share * (gain_2 - gain),
        -astray,
    )


# How fast an estimator is just drawing its place after GNSS, beside the velocity that it tells.
#
# After each fix an autopilot draws the place that it tells within a quarter of a second to where
# its estimator now has it (PX4: EKF2_TAU_POS, ArduPilot: EK3_TAU_OUTPUT), and not by its
# velocity. What a valve gives on a metre of ground that is told so follows the speed of the
# place. What has begun lately goes on for the 0.1 to 0.2 s that an order takes; what has gone on
# for long is the velocity's own error, and a dose by it wavers more than it gains.
# So the one is taken less the other: two means of how much faster the place goes than its
# velocity, a quick and a slow one.
#
# The quick one is half rounding, 1 cm in 50 ms. So nothing is taken of it until place and velocity
# have been seen to disagree by more than rounding makes them: PX4's do in simulation, ArduCopter's
# do not.

# Tried on recorded flights of PX4, positions at 20 Hz: half and twice as long serve nearly as well,
# and no linear filter that is fitted to other flights does better.
QUICK_TIME_S = 0.08
SLOW_TIME_S = 0.25
# How long a disagreement is remembered, and how large one is that says nothing. The slow mean
# (root of its mean square) was 0.08 to 0.18 m/s beside PX4, 0.02 m/s beside ArduCopter.
MEMORY_S = 10.0
AGREES_M_S = 0.04
# More is no drawing: a place that is set anew is not driven to. Places are rounded to 1 cm.
DRAWN_MAX_M_S, ROUNDED_M = 0.5, 0.03


class Drawn(NamedTuple):
    """Both means, in one direction, and the mean square of the slow one."""

    quick_m_s: float = 0.0
    slow_m_s: float = 0.0
    square_m2_s2: float = 0.0

    def after(self, dt_s: float) -> float:
        """Return how much faster than its velocity the place goes `dt_s` later, as far as new.

        >>> round(Drawn(0.25, 0.05, 0.016).after(0.0), 3)
        0.18
        >>> Drawn(0.25, 0.05, 0.001).after(0.0)
        0.0
        """
        if not self.square_m2_s2 > AGREES_M_S * AGREES_M_S:
            return 0.0
        share = 1.0 - AGREES_M_S * AGREES_M_S / self.square_m2_s2
        return share * (self.quick_m_s - self.slow_m_s) * exp(-max(dt_s, 0.0) / SLOW_TIME_S)


NOT_DRAWN = Drawn()


def followed(before: Drawn, dt_s: float, gone_m: float, told_m_s: float) -> Drawn:
    """Return the means after a message: the way since the one before, and the velocity over it."""
    outrun_m = gone_m - told_m_s * dt_s
    if not abs(outrun_m) <= DRAWN_MAX_M_S * dt_s + ROUNDED_M:
        # A jump, or no number.
        return Drawn(square_m2_s2=before.square_m2_s2)
    outrun_m_s = outrun_m / dt_s
    quick, slow, square = _shares(dt_s)
    slow_m_s = before.slow_m_s + slow * (outrun_m_s - before.slow_m_s)
    return Drawn(
        before.quick_m_s + quick * (outrun_m_s - before.quick_m_s),
        slow_m_s,
        before.square_m2_s2 + square * (slow_m_s * slow_m_s - before.square_m2_s2),
    )


@lru_cache(maxsize=8)
def _shares(dt_s: float) -> tuple[float, float, float]:
    """Return how much a message counts in the means after `dt_s`; both directions ask for it."""
    return (
        1.0 - exp(-(dt_s / QUICK_TIME_S)),
        1.0 - exp(-(dt_s / SLOW_TIME_S)),
        1.0 - exp(-(dt_s / MEMORY_S)),
    )


def drawn_after(by: Drawn, dt_s: float, before: Seen, now: Seen) -> Drawn:
    """Return the means after a message; none where one of the two velocities is not known."""
    if before.velocity_m_s is None or now.velocity_m_s is None:
        return NOT_DRAWN
    told_m_s = 0.5 * (before.velocity_m_s + now.velocity_m_s)
    return followed(by, dt_s, now.position_m - before.position_m, told_m_s)


# How fast an acceleration changes where an autopilot flies a mission: it ramps it (ArduCopter by
# 1 m/s3, PX4 by 4), and the filters, which expect it to fade, tell it RAMP_LATE_S late. Fitted to
# the told speeds of one flown ArduCopter and checked on another, at 5 and 10 Hz: of the speed 0.2 s
# ahead 0.041 m/s are wrong (rms), 0.055 without.
RAMP_TIME_S, RAMP_LATE_S, RAMP_MAX_M_S3 = 0.5, 0.18, 2.0


class Ramp(NamedTuple):
    """A slow mean of the acceleration in one direction, and how fast that changes."""

    slow_m_s2: float = 0.0
    gain_m_s3: float = 0.0

    def followed(self, dt_s: float, first: Axis, second: Axis, share: float) -> Ramp:
        """Return it after a message: `share` of the second and the rest of the first are true."""
        now = first.acceleration_m_s2
        now += share * (second.acceleration_m_s2 - now)
        slow = self.slow_m_s2 + (1.0 - exp(-dt_s / RAMP_TIME_S)) * (now - self.slow_m_s2)
        gain = (now - slow) / RAMP_TIME_S
        return Ramp(slow, min(max(gain, -RAMP_MAX_M_S3), RAMP_MAX_M_S3))

    def after(self, told: Told, dt_s: float, share: float) -> Told:
        """Return a motion `dt_s` after the message with the ramp in it; `share` doubt the velocity.

        Only a stream that an estimator has smoothed says how an acceleration changes: none is
        believed before half of the doubt is there.

        >>> Ramp(0.0, 1.0).after(Told(0.0, 5.0, 1.0, 0.0), 0.1, 1.0).velocity_m_s.__round__(3)
        5.023
        """
        share = 2.0 * share - 1.0
        if not (share > 0.0 and dt_s > 0.0):
            return told
        gain, dt_s = share * self.gain_m_s3, min(dt_s, RAMP_TIME_S)
        return told._replace(
            velocity_m_s=told.velocity_m_s + gain * dt_s * (RAMP_LATE_S + 0.5 * dt_s),
            acceleration_m_s2=told.acceleration_m_s2 + gain * (RAMP_LATE_S + dt_s),
        )


NOT_RAMPED = Ramp()


class Turning(NamedTuple):
    """How the nose turns: its rate, and how fast that changes; the change fades."""

    rate_deg_s: float
    gain_deg_s2: float

    def after(self, dt_s: float) -> tuple[float, Turning]:
        """Return how far the nose has turned `dt_s` later [deg], and how it turns then."""
        over = stretch(YAW_FADE_S, dt_s)
        turned_deg = self.rate_deg_s * dt_s + self.gain_deg_s2 * over.carried_s2
        rate_deg_s = self.rate_deg_s + self.gain_deg_s2 * over.gained_s
        return turned_deg, Turning(rate_deg_s, self.gain_deg_s2 * over.kept)

    @property
    def ending(self) -> Turning:
        """Return the turn as it is foretold: one that slows down ends, and does not turn back."""
        if not self.rate_deg_s * self.gain_deg_s2 < 0.0:
            return self
        most = abs(self.rate_deg_s) / YAW_FADE_S
        return Turning(self.rate_deg_s, min(max(self.gain_deg_s2, -most), most))

    @property
    def fastest_deg_s(self) -> float:
        """Return the fastest of now and later, without sign."""
        return max(abs(self.rate_deg_s), abs(self.rate_deg_s + self.gain_deg_s2 * YAW_FADE_S))


STEADY = Turning(0.0, 0.0)


def turning(
    before: Turning, before_deg: float | None, heading_deg: float | None, dt_s: float
) -> Turning:
    """Return how the nose turns after one more heading."""
    if heading_deg is None or before_deg is None or not abs(heading_deg - before_deg) <= 720.0:
        return STEADY  # of what is not a number the rate would never be one again
    turned_deg = (heading_deg - before_deg + 180.0) % 360.0 - 180.0
    # What is divided by it twice must not know what our clock shows.
    dt_s = max(round(dt_s, 6), 1e-6)
    foretold_deg, now = before.after(dt_s)
    # Both are means over the time between the two headings.
    off_deg_s = (turned_deg - foretold_deg) / dt_s
    kept = exp(-dt_s / YAW_TIME_S)
    rate_deg_s = now.rate_deg_s + (1.0 - kept * kept) * off_deg_s
    gain_deg_s2 = now.gain_deg_s2 + (1.0 - kept) ** 2 / dt_s * off_deg_s
    if not (abs(off_deg_s) <= YAW_STEP_MAX_DEG_S and abs(rate_deg_s) <= YAW_RATE_MAX_DEG_S):
        return STEADY  # no turn: the estimator has set its heading anew
    return Turning(rate_deg_s, gain_deg_s2)
