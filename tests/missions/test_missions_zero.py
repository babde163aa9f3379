"""Ground on which nothing is prescribed: skipped, or flown over where that is quicker."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from shapely import box

from missions.coverage import measure, of_rated_ground
from missions.demand import GAP_MIN_M, stretches
from missions.field import build_field
from missions.plan import Leg, Plan, Settings, flown_lines
from missions.planner import plan_mission
from missions.strips import Floats, rectangles
from tests.bench.missions import FRAME, to_degrees

pytestmark = pytest.mark.usefixtures("laid_out_once")


@dataclass(frozen=True)
class Bare:
    """20 L/ha, and nothing between two heights of the map."""

    south_m: float
    north_m: float

    def rates_at(self, east_m: Floats, north_m: Floats) -> Floats:
        return np.where((north_m > self.south_m) & (north_m < self.north_m), 0.0, 20.0)


def planned(bare: Bare) -> Plan:
    field = build_field(to_degrees(box(0, 0, 48, 400)), swath_width_m=6.0, frame=FRAME)
    settings = Settings(swath_width_m=6.0, speed_m_s=6.0, angle_deg=0.0, moves=3_000)
    return plan_mission(field, settings, bare)


def norths(leg: Leg) -> tuple[float, float]:
    low, high = sorted((leg.points[0][1], leg.points[-1][1]))
    return low, high


def test_a_bare_end_is_not_flown_and_nothing_is_lost() -> None:
    plan = planned(Bare(-1.0, 250.0))
    assert plan.volume_l == pytest.approx(150.0 * 48.0 * 20.0 / 1e4, rel=0.02)
    # 10.8 m: 2.4 s to speed up from rest to 6 m/s, 0.6 s more until the nose is ahead after a turn
    # back at 60 deg/s; and the step in which the rate begins.
    for leg in (leg for each in plan.sorties for leg in each.legs if leg.kind == "spray"):
        assert norths(leg)[0] >= 250.0 - 10.8 - 1.0
        assert norths(leg)[1] > 390.0


def test_a_narrow_bare_strip_is_flown_over_without_a_stop() -> None:
    plan = planned(Bare(160.0, 240.0))
    assert plan.volume_l == pytest.approx(320.0 * 48.0 * 20.0 / 1e4, rel=0.02)
    through = [leg for each in plan.sorties for leg in each.legs
               if leg.kind == "transit" and leg.length_m > 40.0]  # fmt: skip
    assert through
    # A leg of its own between two lines: hardly slower than at full speed.
    for leg in through:
        assert leg.through
        assert leg.length_m / 6.0 - 1e-6 < leg.seconds < leg.length_m / 6.0 + 1.0
    assert plan.flight_s <= planned(Bare(0.0, 0.0)).flight_s + 1.0


def test_a_wide_bare_strip_is_crossed_less_often_than_the_lines_are() -> None:
    plan = planned(Bare(40.0, 360.0))
    crossings = [leg for each in plan.sorties for leg in each.legs if leg.length_m > 200.0]
    assert 0 < len(crossings) < 4
    assert plan.flight_s < 0.55 * planned(Bare(0.0, 0.0)).flight_s


steps = st.lists(st.sampled_from([0.0, 0.0, 1.0]), min_size=1, max_size=60)


@given(steps=steps, step_m=st.floats(0.5, 20.0), margin_m=st.floats(0.0, 30.0))
def test_every_place_with_a_rate_lies_in_a_stretch_with_its_margin(
    steps: list[float], step_m: float, margin_m: float
) -> None:
    at_m = np.arange(len(steps) + 1) * step_m
    found = stretches(at_m, np.concatenate([[0.0], np.cumsum(steps)]), margin_m=margin_m)
    assert bool(found) == (sum(steps) > 0.0)
    for (_, end), (start, _) in pairwise(found):
        assert start - end >= GAP_MIN_M - 1e-9
    for number, need in enumerate(steps):
        if need:
            low, high = max(number * step_m - margin_m, 0), min((number + 1) * step_m + margin_m,
                                                                at_m[-1])  # fmt: skip
            assert any(start <= low + 1e-9 and high - 1e-9 <= end for start, end in found)


def test_what_is_covered_is_ground_with_a_rate() -> None:
    plan = planned(Bare(-1.0, 250.0))
    assert plan.coverage.without_rate_m2 == pytest.approx(250.0 * 48.0, rel=0.005)
    assert plan.coverage.percent > 99.8
    # The whole field has lines, and those over bare ground are not flown.
    strips = shapely.union_all(rectangles(flown_lines(plan.sorties), 6.0))
    assert strips.intersection(plan.field.limit).area < 0.45 * plan.field.limit.area


def test_a_missed_corner_counts_as_a_share_of_the_ground_with_a_rate() -> None:
    lines = np.array([[3.0, 300.0, 3.0, 390.0]])
    whole = measure(lines, box(0, 0, 48, 400), 6.0)
    strips = rectangles(lines, 6.0)
    found = of_rated_ground(whole, strips, box(0, 0, 48, 400), rates=Bare(-1.0, 250.0))
    assert found.percent == pytest.approx(100.0 * 90.0 * 6.0 / (150.0 * 48.0), rel=0.01)
    assert whole.percent == pytest.approx(100.0 * 90.0 * 6.0 / (400.0 * 48.0), rel=0.01)
