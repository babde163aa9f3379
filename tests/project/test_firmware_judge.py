"""The judge of the flights beside real firmwares, on flights whose truth is known."""

from __future__ import annotations

import math
from collections.abc import Sequence

import pytest
import shapely

from tests.firmware.judge import (
    Change,
    Verdict,
    Zone,
    apart_m,
    judge,
    judge_perfect,
    obeyed,
)
from tests.firmware.judge_ground import sprayed_before, treated_ground
from tests.firmware.station import Place, Pulses

# The valve's mean lag: dead time, half the rise, half a servo frame.
LAG_S = 0.069 + 0.035 + 0.010
EQUATOR_M = 111_319.49
NORTH_M = 110_574.3
RATES_L_HA = (15.0, 24.0, 20.0)
ENDS_M = (20.0, 35.0, 50.0, 65.0)
CLOCK_S = 7.0  # the vehicle's clock against ours


def pulse_us(rate_l_ha: float, speed_m_s: float) -> int:
    """Return the pulse for a rate; 100 % of duty are 6.096 L/min, 20 % 1.476 L/min."""
    flow_l_min = 60.0 * 6.0 * speed_m_s * rate_l_ha / 10_000.0
    duty, flow = (0.2, 0.4, 0.5, 0.7), (1.476, 3.024, 3.276, 4.62)
    for number in range(3):
        if flow_l_min <= flow[number + 1]:
            part = (flow_l_min - flow[number]) / (flow[number + 1] - flow[number])
            return round(1000 + 1000 * (duty[number] + part * (duty[number + 1] - duty[number])))
    raise ValueError(f"no such flow here: {flow_l_min}")


def flown(
    speed_m_s: float,
    *,
    lag_m: float = 0.0,
    has_changes: bool = True,
    is_closed_outside: bool = True,
    is_told: bool = False,
    east_m: float = 0.0,
    grazing_m: float = 0.0,
) -> Verdict:
    """Fly north over three zones, every change ordered so that it falls `lag_m` too late.

    The third ends 2.9 m to the right of the line, which is what the fourth begins with.
    """
    places, pulses = [], []
    ordered_m = [end - LAG_S * speed_m_s + lag_m for end in ENDS_M]
    for number in range(int(85.0 / speed_m_s / 0.01)):
        at_s = number * 0.01
        north_m = at_s * speed_m_s
        # On our side, as after a stall: the judge must not mind.
        late_s = 0.003 * (number % 2) + (0.1 if 500 <= number < 510 else 0.0)
        came_s = at_s + CLOCK_S + late_s
        told_s = at_s if is_told else None
        places.append(Place(came_s, told_s, number, north_m / NORTH_M, east_m / EQUATOR_M, 0.0))
        number_of_zone = sum(north_m >= ordered for ordered in ordered_m)
        if number_of_zone in (0, len(ENDS_M)):
            us = 1000 if is_closed_outside else pulse_us(15.0, speed_m_s)
        else:
            us = pulse_us(RATES_L_HA[number_of_zone - 1 if has_changes else 0], speed_m_s)
        pulses.append(Pulses(came_s, at_s, (1500,) * 8 + (us,) * 6 + (0, 0)))
    zones = [
        zone(start, end, rate, to_m=2.9 if start == ENDS_M[2] else 4.0)
        for start, end, rate in zip(ENDS_M, ENDS_M[1:], RATES_L_HA, strict=False)
    ]
    zones.append(zone(*ENDS_M[2:], RATES_L_HA[1], from_m=2.9))
    return judge(places, pulses, zones, grazing_m=grazing_m)


def zone(
    start_m: float, end_m: float, rate: float, *, from_m: float = -4.0, to_m: float = 4.0
) -> Zone:
    """Return a rectangle, `from_m` to `to_m` being metres to the east."""
    box = (from_m / EQUATOR_M, start_m / NORTH_M, to_m / EQUATOR_M, end_m / NORTH_M)
    return Zone(shapely.box(*box), rate)


@pytest.mark.parametrize(("speed_m_s", "lag_m"), [(4.0, 0.0), (5.0, -0.3), (5.0, 0.5)])
def test_a_lag_is_found_as_it_was_made(speed_m_s: float, lag_m: float) -> None:
    verdict = flown(speed_m_s, lag_m=lag_m)
    assert len(verdict.changes) == 2 * 6
    assert not verdict.missed
    assert not verdict.apart
    # Servo frames are drawn for each output: half a frame to each side, and half a sample.
    assert verdict.lags_m == pytest.approx(lag_m, abs=0.016 * speed_m_s)
    assert math.isclose(verdict.lags_m.mean(), lag_m, abs_tol=0.005 * speed_m_s)


def test_a_place_with_a_time_of_its_own_is_judged_alike() -> None:
    assert flown(5.0, is_told=True).lags_m == pytest.approx(flown(5.0).lags_m, abs=0.01)


def told_speed(speed_m_s: float, *, wiggle_m_s: float = 0.0) -> list[Place]:
    """Return places at a steady speed, told with one that swings about it once a second."""
    return [
        Place(at_s, at_s, 0, at_s * speed_m_s / NORTH_M, 0.0, 0.0, told_m_s)
        for at_s in (number * 0.01 for number in range(int(8500.0 / speed_m_s)))
        for told_m_s in (speed_m_s + wiggle_m_s * math.sin(2.0 * math.pi * at_s),)
    ]


THREE_ZONES = [
    (start, end, rate) for start, end, rate in zip(ENDS_M, ENDS_M[1:], RATES_L_HA, strict=False)
]


def test_a_perfect_sprayer_is_off_by_what_place_and_speed_disagree_by() -> None:
    zones = [zone(*one) for one in THREE_ZONES]
    steady = judge_perfect(told_speed(5.0), zones)
    assert len(steady.changes) == 2 * 6
    assert steady.worst_m < 0.015
    assert steady.sprayed_l == pytest.approx(steady.prescribed_l, rel=0.005)
    # 3 % for half a second each way, with changes of 17 and 60 %.
    swinging = judge_perfect(told_speed(5.0, wiggle_m_s=0.15), zones)
    assert 0.02 < swinging.mean_abs_m < 0.3
    off_m, dose_m = apart_m(swinging, steady)
    assert off_m == pytest.approx(swinging.lags_m - steady.lags_m)
    for one, apart, dose in zip(steady.changes, off_m, dose_m, strict=True):
        greater, lesser = sorted((one.from_l_ha, one.to_l_ha), reverse=True)
        assert dose == pytest.approx(abs(apart) * (1.0 - lesser / greater))
    assert apart_m(steady, judge_perfect(told_speed(5.0), zones[:2]))[0].shape == (6,)


def test_a_change_that_never_came_is_missed() -> None:
    verdict = flown(5.0, has_changes=False)
    assert len(verdict.missed) == 2 * 6


def test_what_falls_outside_is_counted() -> None:
    inside, outside = flown(5.0), flown(5.0, is_closed_outside=False)
    # 20 m before and 20 m behind the field at 15 L/ha on 6 m, less 0.3 s at both ends.
    assert outside.off_target_ml == pytest.approx(
        2 * 20.0 * 6.0 * 15.0 * 0.1 - 2 * 0.3 * 5.0 * 9.0, rel=0.02
    )
    # The valves are open and closed on the border by their mean: half of the rise is outside.
    assert 0.0 < inside.off_target_ml < 20.0
    assert inside.sprayed_l == pytest.approx(inside.prescribed_l, rel=0.01)


def test_a_valve_along_a_boundary_counts_apart() -> None:
    # Half a metre to the right the sixth valve is 0.1 m beyond the end of the third zone.
    beside = flown(5.0, east_m=0.5)
    assert len(beside.changes) + len(beside.apart) == 2 * 6 - 1
    near = flown(5.0, east_m=0.3, grazing_m=0.2)
    assert (len(near.changes), len(near.apart)) == (2 * 6 - 1, 1)
    assert len(flown(5.0, grazing_m=0.2).changes) == 2 * 6


def pulsed(us: Sequence[int]) -> list[Pulses]:
    """Return output 9 every 20 ms, the others closed."""
    return [
        Pulses(CLOCK_S + 0.02 * number, 0.02 * number, (1000,) * 8 + (one,) + (1000,) * 7)
        for number, one in enumerate(us)
    ]


def test_a_board_closes_what_stands_still_and_opens_with_the_next_move() -> None:
    moving = [1500 + 8 * (number // 5 % 2) for number in range(50)]
    obeys, closings = obeyed(pulsed([*moving, *[moving[-1]] * 30, 1500, 1500]))
    open_at = [one.us[8] > 1000 for one in obeys]
    # The last move was at number 45; after 0.3 s, from number 61 on, it is closed.
    assert open_at == [number <= 60 or number >= 80 for number in range(82)]
    assert [(one.output, round(one.came_s - CLOCK_S, 2)) for one in closings] == [(9, 1.22)]
    # Less than half the dither is no move, and a closed output need not move.
    _, still = obeyed(pulsed([1500 + number % 4 for number in range(40)]))
    assert len(still) == 1
    assert obeyed(pulsed([1000] * 40))[1] == []


def flown_north(
    start_s: float, open_m: tuple[float, float], east_m: float
) -> tuple[list[Place], list[Pulses]]:
    """Fly 50 m north at 5 m/s, all valves open from one place to another."""
    places, pulses = [], []
    for number in range(1000):
        at_s = number * 0.01
        place = (5.0 * at_s / NORTH_M, east_m / EQUATOR_M)
        places.append(Place(start_s + at_s, start_s + at_s, number, *place, 0.0))
        is_open = open_m[0] <= 5.0 * at_s < open_m[1]
        us = pulse_us(20.0, 5.0) if is_open else 1000
        pulses.append(Pulses(start_s + at_s, start_s + at_s, (1500,) * 8 + (us,) * 6 + (0, 0)))
    return places, pulses


def test_ground_that_one_flight_left_is_found_and_what_two_treated_too() -> None:
    one = flown_north(0.0, (0.0, 20.0), 0.0)
    other = flown_north(20.0, (15.0, 30.0), 0.7)
    # Judged from 0.6 m to 40.6 m: treated once to 15, twice to 20, once to 30, left from there.
    ends = (0.6 / NORTH_M, 0.0), (40.6 / NORTH_M, 0.0)
    ground = treated_ground(
        one[0] + other[0], one[1] + other[1], [zone(-1.0, 60.0, 20.0)], ends=ends, by_valve=True
    )
    assert ground.whole_m2 == pytest.approx(40.0 * 6.0, abs=3.0)
    assert ground.left_m2 == pytest.approx(10.6 * 6.0, abs=3.0)
    assert ground.twice_m2 == pytest.approx(5.0 * 6.0, abs=3.0)


def test_a_change_on_ground_that_was_sprayed_before_is_told() -> None:
    one = flown_north(0.0, (0.0, 20.0), 0.0)
    other = flown_north(20.0, (2.0, 50.0), 0.7)

    def is_again(valve: int, north_m: float, start_s: float = 20.0) -> bool:
        change = Change(valve, start_s + north_m / 5.0, north_m, 20.0, 30.0, 5.0, 0.0)
        places, pulses = one[0] + other[0], one[1] + other[1]
        return sprayed_before(places, pulses, [zone(-1.0, 60.0, 20.0)], [change])[0]

    assert is_again(1, 10.0)
    assert is_again(5, 22.0)  # what is measured begins 4 m before
    assert not is_again(5, 26.0)
    assert not is_again(6, 10.0)  # three tenths of its strip
    assert not is_again(1, 10.0, 0.0)  # its own spray
