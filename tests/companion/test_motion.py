"""The filters behind the state: each follows its own kind of flight, the shares follow them all."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from companion.core.estimator import Motion, begun, followed
from companion.core.motion import (
    CHANGE_TIME_S,
    CRUISE,
    JUMP_M,
    MANOEUVRE,
    SHARE_MIN,
    Axis,
    Belief,
    Model,
    Pair,
    Seen,
    agreed,
    carried,
    doubted,
    follow,
    foreseen,
    gains,
    judged,
    mixed,
)
from tests.builders import position

DT_S = 0.05
TOLD = position(0.0, 0.0, 0.0)
STILL = Belief(Axis(0.0, 0.0, 0.0), Axis(0.0, 0.0, 0.0))


def flown(speed_m_s: list[float], seed: int = 1) -> tuple[list[float], list[float], list[float]]:
    """Return the errors of the speed, of each filter, and the share, along a flight eastwards."""
    rng = np.random.default_rng(seed)
    place = 0.0
    beliefs = [Belief(Axis(0.0, speed_m_s[0], 0.0), Axis(0.0, 0.0, 0.0))] * 2
    share, shares = 0.5, []
    errors: tuple[list[float], list[float]] = ([], [])
    for speed in speed_m_s:
        place += speed * DT_S
        noise = rng.normal(0.0, [0.014, 0.03, 0.014, 0.03]).tolist()
        east = Seen(place + noise[0], speed + noise[1])
        north = Seen(noise[2], noise[3])
        likely = []
        for i, model in enumerate((CRUISE, MANOEUVRE)):
            found = follow(model, beliefs[i], DT_S, east, north)
            assert found is not None
            beliefs[i] = found[0]
            likely.append(found[1])
            errors[i].append(abs(found[0].east.velocity_m_s - speed))
        share = judged(foreseen(share, DT_S, begins_s=CHANGE_TIME_S), likely[1] - likely[0])
        shares.append(share)
    return errors[0], errors[1], shares


def test_in_cruise_the_calm_filter_is_better_and_believed() -> None:
    calm, nimble, shares = flown([5.0] * 400)
    assert np.mean(calm[50:]) < 0.8 * np.mean(nimble[50:])
    assert np.mean(shares[50:]) < 0.25


def test_while_braking_the_nimble_filter_is_better_and_believed_within_half_a_second() -> None:
    steps = round(2.0 / DT_S)
    speeds = [6.0] * 100 + [6.0 - 2.0 * DT_S * i for i in range(steps)]
    calm, nimble, shares = flown(speeds)
    assert shares[99] < 0.3
    assert np.mean(shares[110:]) > 0.9
    assert np.mean(nimble[110:]) < 0.5 * np.mean(calm[110:])


def test_a_steady_motion_is_followed_without_error() -> None:
    belief = STILL  # it learns the speed
    for i in range(400):
        seen = Seen(7.0 * DT_S * i, 7.0)
        found = follow(CRUISE, belief, DT_S, seen, Seen(0.0, 0.0))
        assert found is not None
        belief = found[0]
    assert belief.east == pytest.approx(Axis(7.0 * DT_S * 399, 7.0, 0.0), abs=1e-6)


@pytest.mark.parametrize("model", [CRUISE, MANOEUVRE])
@pytest.mark.parametrize("dt_s", [0.0, 0.02, 0.3, 2.0])
def test_carrying_twice_is_carrying_once(model: Model, dt_s: float) -> None:
    axis = Axis(3.0, -2.0, 1.5)
    assert carried(model, carried(model, axis, dt_s), 0.4) == pytest.approx(
        carried(model, axis, dt_s + 0.4), abs=1e-12
    )


@pytest.mark.parametrize("model", [CRUISE, MANOEUVRE])
def test_carrying_is_the_integral_of_a_fading_acceleration(model: Model) -> None:
    place, speed, step_s = 0.0, 1.0, 1e-4
    for i in range(10_000):
        acceleration = 2.0 * math.exp(-(i + 0.5) * step_s / model.fade_s)
        place += speed * step_s + 0.5 * acceleration * step_s**2
        speed += acceleration * step_s
    there = carried(model, Axis(0.0, 1.0, 2.0), 1.0)
    assert (there.position_m, there.velocity_m_s) == pytest.approx((place, speed), abs=1e-6)
    assert there.acceleration_m_s2 == pytest.approx(2.0 * math.exp(-1.0 / model.fade_s))


def test_the_gains_are_those_of_the_variances_that_the_filter_has() -> None:
    """Its own errors, over many messages of its own model, are as large as it expects."""
    model, rng = CRUISE, np.random.default_rng(3)
    decay = math.exp(-DT_S / model.fade_s)
    truth, belief, off = Axis(0.0, 0.0, 0.0), STILL, []
    for _ in range(20_000):
        kick = float(rng.normal(0.0, model.wander_m_s2_sqrt_s * math.sqrt(DT_S)))
        ahead = carried(model, truth, DT_S)
        truth = Axis(
            ahead.position_m + 0.5 * kick * DT_S**2,
            ahead.velocity_m_s + kick * DT_S,
            truth.acceleration_m_s2 * decay + kick,
        )
        seen = Seen(
            truth.position_m + float(rng.normal(0.0, 0.02)),
            truth.velocity_m_s + float(rng.normal(0.0, 0.03)),
        )
        ahead = carried(model, belief.east, DT_S)
        off.append((seen.position_m - ahead.position_m, (seen[1] or 0.0) - ahead.velocity_m_s))
        found = follow(model, belief, DT_S, seen, Seen(0.0, 0.0))
        assert found is not None
        belief = found[0]
    expected = gains(model, 10, True).weight
    inverse = np.linalg.inv(np.cov(np.array(off[100:]).T))
    assert [inverse[0, 0], inverse[1, 1]] == pytest.approx([expected[0], expected[2]], rel=0.05)


def test_without_velocities_the_place_alone_corrects() -> None:
    by = gains(CRUISE, 10, False)
    assert by.by_velocity == (0.0, 0.0, 0.0, 0.0)
    assert by.weight[1:] == (0.0, 0.0)
    assert by.by_position[0] > gains(CRUISE, 10, True).by_position[0]


def test_a_jump_and_what_is_no_number_are_no_motion() -> None:
    far, nan = Seen(1.01 * JUMP_M, 0.0), Seen(math.nan, 0.0)
    near = Seen(0.99 * JUMP_M, 0.0)
    for seen, is_motion in ((far, False), (nan, False), (near, True)):
        assert (follow(CRUISE, STILL, DT_S, seen, Seen(0.0, 0.0)) is not None) is is_motion
        assert (follow(CRUISE, STILL, DT_S, Seen(0.0, 0.0), seen) is not None) is is_motion


def test_no_direction_is_preferred() -> None:
    """The share depends on what was unexpected, not on the course."""
    turn = math.radians(37.0)
    one = follow(CRUISE, STILL, DT_S, Seen(0.05, 0.1), Seen(-0.02, 0.04))
    east = Seen(
        0.05 * math.cos(turn) + 0.02 * math.sin(turn), 0.1 * math.cos(turn) - 0.04 * math.sin(turn)
    )
    north = Seen(
        0.05 * math.sin(turn) - 0.02 * math.cos(turn), 0.1 * math.sin(turn) + 0.04 * math.cos(turn)
    )
    other = follow(CRUISE, STILL, DT_S, east, north)
    assert one is not None
    assert other is not None
    assert one[1] == pytest.approx(other[1], abs=1e-12)


@pytest.mark.parametrize(("cruise", "manoeuvre"), [(-1e9, 0.0), (0.0, -1e9), (0.0, 0.0)])
def test_no_filter_is_ever_given_up(cruise: float, manoeuvre: float) -> None:
    share = 0.5
    for _ in range(100):
        share = judged(foreseen(share, DT_S, begins_s=CHANGE_TIME_S), manoeuvre - cruise)
    assert SHARE_MIN <= share <= 1.0 - SHARE_MIN
    assert (share > 0.5) == (cruise < manoeuvre)


def test_a_mixture_lies_between() -> None:
    first, second = Axis(0.0, 1.0, -1.0), Axis(2.0, 5.0, 3.0)
    assert mixed(first, second, 0.0) == first
    assert mixed(first, second, 1.0) == second


# ------------------------------------------------------------- a place that outruns its velocity


def led(
    outrun_m_s: Callable[[float], float], *, position_sd_m: float, walk_m_sqrt_s: float = 0.0
) -> tuple[float, float, float]:
    """Fly eastwards at 5 m/s; the place that is told runs ahead of the velocity that is told.

    Returns how far off the told place is 0.2 s ahead, by the believing filters and by all (means
    of absolute values), and how far the velocity was doubted; the first 10 s apart.
    """
    rng = np.random.default_rng(4)
    lead, wandered_m, place_m = 4, np.zeros(2), 0.0
    motion: Motion | None = None
    told, expected, shares = [], [], []
    for i in range(round(60.0 / DT_S)):
        now_s = i * DT_S
        place_m += (5.0 + outrun_m_s(now_s)) * DT_S
        wandered_m += rng.normal(0.0, walk_m_sqrt_s * math.sqrt(DT_S), 2)
        told.append(place_m + wandered_m[0])
        noise_m = rng.normal(0.0, position_sd_m, 2)
        place = (round(told[-1] + noise_m[0], 2), round(wandered_m[1] + noise_m[1], 2))
        item = replace(
            TOLD,
            boot_s=now_s,
            velocity_east_m_s=round(5.0 + float(rng.normal(0.0, 0.03)), 2),
            velocity_north_m_s=round(float(rng.normal(0.0, 0.03)), 2),
        )
        if motion is None:
            motion = begun(item, place, now_s)
            continue
        motion = followed(motion, item, place, now_s)
        both = (motion.believing, motion.agreed)
        expected.append([ahead_m(pair, lead * DT_S) for pair in both])
        shares.append(motion.doubt_share)
    off = np.abs(np.array(expected)[:-lead] - np.array(told)[1 + lead :, None])[200:]
    return float(off[:, 0].mean()), float(off[:, 1].mean()), float(np.mean(shares[200:]))


def ahead_m(pair: Pair, dt_s: float) -> float:
    """Return the place to the east, so much later."""
    calm = carried(CRUISE, pair.cruise.east, dt_s)
    return mixed(calm, carried(MANOEUVRE, pair.manoeuvre.east, dt_s), pair.share).position_m


def test_a_smooth_place_that_outruns_its_velocity_is_followed() -> None:
    """As PX4's beside its own simulation: by 0.2 m/s (standard deviation), in 10 s."""
    swings = led(lambda at_s: 0.3 * math.sin(2.0 * math.pi * at_s / 10.0), position_sd_m=0.003)
    stays = led(lambda at_s: 0.2, position_sd_m=0.003)
    for believing, both, share in (swings, stays):
        assert believing > 0.08
        assert both < 0.25 * believing
        assert share > 0.9
    assert stays[1] < 0.015


@pytest.mark.parametrize(
    ("position_sd_m", "walk_m_sqrt_s"),
    [(0.014, 0.0), (0.3, 0.0), (1.0, 0.0), (0.014, 0.08), (0.014, 0.26)],
)
def test_places_that_scatter_or_wander_do_not_make_the_velocity_doubted(
    position_sd_m: float, walk_m_sqrt_s: float
) -> None:
    """RTK, a receiver without corrections, and one that wanders by 0.3 and 1 m in 30 s."""
    believing, both, share = led(
        lambda at_s: 0.0, position_sd_m=position_sd_m, walk_m_sqrt_s=walk_m_sqrt_s
    )
    assert share < 0.05
    assert both == pytest.approx(believing, rel=0.03)


def test_one_message_does_not_make_the_velocity_doubted() -> None:
    assert doubted(SHARE_MIN, DT_S, -1e9, 0.0) < 3.0 * SHARE_MIN
    assert doubted(1.0 - SHARE_MIN, DT_S, 0.0, -1e9) == SHARE_MIN


def test_what_both_pairs_say_is_as_far_as_each_is_believed() -> None:
    axes = [Axis(float(n), 10.0 * n, 0.5 * n, 0.1 * n) for n in range(1, 5)]
    calm, nimble, calm_doubt, nimble_doubt = (Belief(axis, axis) for axis in axes)
    found = agreed(Pair(calm, nimble, 0.2), Pair(calm_doubt, nimble_doubt, 0.7), 0.4)
    weights = (0.6 * 0.8, 0.6 * 0.2, 0.4 * 0.3, 0.4 * 0.7)
    expected = sum(weight * axis.position_m for weight, axis in zip(weights, axes, strict=True))
    assert mixed(found.cruise.east, found.manoeuvre.north, found.share).position_m == (
        pytest.approx(expected, abs=1e-12)
    )
    assert found.share == pytest.approx(weights[1] + weights[3])
