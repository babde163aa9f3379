"""A speed for each leg: every rate within the valves' range, and no slower than that needs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.core.nozzle import flow_for_rate
from missions.demand import Uniform
from missions.files.items import CHANGE_SPEED, SPRAYER, items_of
from missions.paced import paced
from missions.plan import Leg, Plan, Settings, Sortie
from missions.speeds import crawl_warnings, short_warnings, stretches_of
from missions.strips import Floats
from tests.bench.missions import FRAME
from tests.missions.test_missions_zero import Bare, planned

WIDTH_M, LENGTH_M = 6.0, 100.0


@dataclass(frozen=True)
class Bands:
    """Bands of one rate each along the north."""

    rates_l_ha: tuple[float, ...]

    def rates_at(self, east_m: Floats, north_m: Floats) -> Floats:
        band_m = LENGTH_M / len(self.rates_l_ha)
        at = np.clip((north_m / band_m).astype(int), 0, len(self.rates_l_ha) - 1)
        return np.array(self.rates_l_ha)[at]


def settings(**changes: object) -> Settings:
    known = {"flow_l_min": (2.0, 8.0), "speeds_m_s": (1.0, 0.0)}
    return Settings(swath_width_m=WIDTH_M, speed_m_s=6.0, **known | changes)  # type: ignore[arg-type]


def one_line(rates: Bands, given: Settings) -> tuple[tuple[Leg, ...], int]:
    """Return the spray legs of one line over the bands, and how many misses there are."""
    litres = float(np.mean(rates.rates_l_ha)) * WIDTH_M * LENGTH_M / 1e4
    home = Leg(kind="ferry", points=((0.0, 0.0), (0.0, 0.0)), speed_m_s=6.0, seconds=0.0)
    line = Leg(
        kind="spray", points=((0.0, 0.0), (0.0, LENGTH_M)), speed_m_s=6.0,
        seconds=LENGTH_M / 6.0 + 6.0 / 2.5, volume_l=litres,
    )  # fmt: skip
    sortie = Sortie(number=1, depot=0, legs=(home, line, home))
    done = paced([sortie], rates, given)
    assert done.sorties[0].lines == 1
    return done.sorties[0].legs[1:-1], len(done.misses)


def test_a_line_within_the_range_keeps_its_speed() -> None:
    legs, misses = one_line(Bands((15.0, 20.0)), settings())
    assert [leg.speed_m_s for leg in legs] == [6.0]
    assert misses == 0


def test_a_heavy_band_is_entered_at_the_speed_that_its_rate_needs() -> None:
    legs, misses = one_line(Bands((15.0, 60.0, 15.0)), settings())
    # 60 L/ha on 6 m: 8 L/min are there up to 3.7 m/s.
    assert [leg.speed_m_s for leg in legs] == [6.0, 3.7, 6.0]
    assert misses == 0
    braking_m = (6.0**2 - 3.7**2) / (2 * 2.5)
    assert legs[0].points[1][1] == pytest.approx(100.0 / 3.0 - braking_m, abs=1.0)
    assert legs[1].points[1][1] == pytest.approx(200.0 / 3.0, abs=1.0)


def test_too_low_a_rate_is_flown_faster_only_where_allowed() -> None:
    slow = Bands((6.0,))
    legs, misses = one_line(slow, settings())
    assert ([leg.speed_m_s for leg in legs], misses) == ([6.0], 1)
    legs, misses = one_line(slow, settings(speeds_m_s=(1.0, 12.0)))
    assert ([leg.speed_m_s for leg in legs], misses) == ([9.3], 0)


def test_without_a_sprayer_nothing_is_said() -> None:
    assert one_line(Bands((900.0,)), settings(flow_l_min=None))[1] == 0


def crawling(short_s: float, *, rate_l_ha: float = 20.0, long_m: float = 100.0) -> Sortie:
    """Return a long line at its speed, and ten short ones of 3 m that take `short_s` each."""
    legs = [(long_m, long_m / 6.0), *[(3.0, short_s)] * 10]
    return Sortie(
        number=1,
        depot=0,
        legs=tuple(
            Leg(
                kind="spray", points=((0.0, 0.0), (0.0, length_m)), speed_m_s=6.0, seconds=seconds,
                volume_l=rate_l_ha * WIDTH_M * length_m / 1e4,
            )
            for length_m, seconds in legs
        ),
    )  # fmt: skip


def test_short_passes_that_are_flown_at_walking_pace_are_told_with_what_falls_there() -> None:
    # 20 L/ha on 6 m at 1.2 m/s: 0.864 L/min, where the valves give 2.
    (text,) = crawl_warnings([crawling(2.5)], FRAME, settings())
    assert "WPNAV_JERK (mission.jerk_m_s3)" in text
    assert "30 m of passes" in text
    assert "1.2 m/s" in text
    assert "131 % too much (2.00 L/min at least)" in text


@pytest.mark.parametrize(
    ("short_s", "change"),
    [
        (1.0, {}),  # 3 m/s: within the range
        (2.5, {"long_m": 900.0}),  # too few to matter
        (2.5, {"rate_l_ha": 5.0}),  # too little at full speed already: told as that
    ],
)
def test_nothing_is_told_of_passes_that_the_valves_can_follow_or_that_are_few(
    short_s: float, change: dict[str, float]
) -> None:
    assert crawl_warnings([crawling(short_s, **change)], FRAME, settings()) == ()
    assert crawl_warnings([crawling(2.5)], FRAME, settings(flow_l_min=None)) == ()


bands = st.lists(st.sampled_from([0.0, 10.0, 20.0, 40.0, 70.0]), min_size=1, max_size=8)


@given(rates=bands.map(tuple).filter(any))
def test_parts_meet_keep_the_litres_and_stay_in_range(rates: tuple[float, ...]) -> None:
    given_settings = settings(acceleration_m_s2=1e4)  # so that braking takes no way
    legs, misses = one_line(Bands(rates), given_settings)
    assert legs[0].points[0] == (0.0, 0.0)
    assert legs[-1].points[-1] == (0.0, LENGTH_M)
    for one, other in pairwise(legs):
        assert one.points[-1] == pytest.approx(other.points[0])
        assert one.speed_m_s != other.speed_m_s
    total = float(np.mean(rates)) * WIDTH_M * LENGTH_M / 1e4
    assert sum(leg.volume_l for leg in legs) == pytest.approx(total)
    assert misses == 0
    band_m = LENGTH_M / len(rates)
    for number, rate in enumerate(rates):
        middle = (number + 0.5) * band_m
        leg = next(leg for leg in legs if leg.points[0][1] <= middle <= leg.points[-1][1])
        flow = flow_for_rate(rate, leg.speed_m_s, WIDTH_M)
        assert rate == 0.0 or 2.0 - 1e-6 <= flow <= 8.0 + 1e-6


@given(
    ends=st.lists(st.sampled_from([0.0, 10.0, 20.0, 40.0, 70.0]), min_size=1, max_size=6),
    braking=st.sampled_from([2.5, 1e4]),
)
def test_no_part_of_a_line_is_shorter_than_a_leg_may_be(ends: list[float], braking: float) -> None:
    rates = (20.0,) * (100 - 2 * len(ends)) + tuple(rate for rate in ends for _ in range(2))
    for each in (rates, rates[::-1], (*rates[:-1], 70.0)):
        legs, _ = one_line(Bands(each), settings(acceleration_m_s2=braking))
        assert legs[-1].points[-1] == (0.0, LENGTH_M)
        assert min(leg.length_m for leg in legs) >= 2.0 - 1e-6


def plan_with_speeds() -> Plan:
    plan = planned(Bare(0.0, 0.0))
    done = paced(plan.sorties, Bands((15.0, 60.0)), settings())
    values = {name: getattr(plan, name) for name in plan.__slots__} | {"sorties": done.sorties}
    return Plan(**values)


def test_files_order_a_speed_wherever_it_changes_and_only_there() -> None:
    plan = plan_with_speeds()
    sortie = plan.sorties[0]
    items = items_of(plan, sortie, with_sprayer=True)
    ordered = [item.params[1] for item in items if item.command == CHANGE_SPEED]
    assert all(one != other for one, other in pairwise(ordered))
    assert {6.0, 3.7} == set(ordered)
    assert ordered[-1] == 6.0
    # Nothing closes where only the speed changes.
    switched = [item.params[0] for item in items if item.command == SPRAYER]
    assert switched == [1.0, 0.0] * sortie.lines


def test_cells_shorter_than_the_lag_are_named_with_their_place() -> None:
    legs = (Leg(kind="spray", points=((0.0, 0.0), (0.0, 100.0)), speed_m_s=6.0, seconds=20.0),)
    sortie = Sortie(number=3, depot=0, legs=legs)
    fine = Bands((10.0,) * 60 + (20.0,) + (10.0,) * 39)  # one metre of another rate
    (text,) = short_warnings([sortie], fine, FRAME, settings(settle_s=0.3), course_deg=0.0)
    assert text.startswith("1 cell is flown through in less than 0.30 s")
    assert "sortie 3 near 48.000" in text
    assert text.endswith(
        "; plan with --speed-m-s 2.9, or make zones of the map that this sprayer follows "
        "(vrspray make zones)"
    )
    # A pass along the border, across the zones that were made for the others.
    assert short_warnings([sortie], fine, FRAME, settings(settle_s=0.3), course_deg=40.0) == ()
    assert short_warnings([sortie], fine, FRAME, settings(settle_s=0.1), course_deg=0.0) == ()
    assert (
        short_warnings([sortie], Bands((10.0, 20.0)), FRAME, settings(settle_s=0.3), course_deg=0.0)
        == ()
    )


class Beside:
    """More to the right of the line from 50 to 51 m and from 60 m on; on the line it is unclear."""

    def rates_at(self, east_m: Floats, north_m: Floats) -> Floats:
        inside = ((north_m >= 50.0) & (north_m < 51.0)) | (north_m >= 60.0)
        unclear = np.floor(north_m * 10.0) % 2 == 0
        return np.where(inside & ((east_m > 0.0) | ((east_m == 0.0) & unclear)), 20.0, 10.0)


def test_short_cells_are_those_under_valves_not_under_the_edge_between_two() -> None:
    legs = (Leg(kind="spray", points=((0.0, 0.0), (0.0, 100.0)), speed_m_s=6.0, seconds=20.0),)
    sortie = Sortie(number=1, depot=0, legs=legs)
    for valves in (((-1.5, 3.0), (1.5, 3.0)), ((-2.0, 2.0), (0.5, 2.0), (2.0, 2.0))):
        (text,) = short_warnings(
            [sortie], Beside(), FRAME, settings(settle_s=0.3, valves=valves), course_deg=0.0
        )
        assert text.startswith("1 cell is flown through")
        wide = settings(settle_s=0.15, valves=valves)
        assert short_warnings([sortie], Beside(), FRAME, wide, course_deg=0.0) == ()
    back = (Leg(kind="spray", points=((0.0, 100.0), (0.0, 0.0)), speed_m_s=6.0, seconds=20.0),)
    for right_m, count in ((-1.5, 1), (1.5, 0)):
        one = settings(settle_s=0.3, valves=((right_m, 3.0), (3.0 * right_m, 1.0)))
        turned = short_warnings([replace(sortie, legs=back)], Beside(), FRAME, one, course_deg=0.0)
        assert len(turned) == count


@pytest.mark.parametrize("rate_l_ha", [0.0, 5.0, 20.0, 200.0])
def test_one_rate_everywhere_is_flown_as_a_map_of_one_rate(rate_l_ha: float) -> None:
    line = Leg(
        kind="spray", points=((0.0, 0.0), (0.0, LENGTH_M)), speed_m_s=6.0, volume_l=1.2
    )  # fmt: skip
    one, other = (
        stretches_of(line, rates, settings())
        for rates in (Uniform(rate_l_ha=rate_l_ha), Bands((rate_l_ha,)))
    )
    for name in ("ends_m", "low", "high", "least_l_ha", "most_l_ha"):
        assert getattr(one, name).tolist() == pytest.approx(getattr(other, name).tolist())
    if rate_l_ha > 0.0:
        assert one.litres.tolist() == pytest.approx(other.litres.tolist())
