"""How often a flight is committed, by its field."""

from __future__ import annotations

from dataclasses import replace

import pytest
from shapely.geometry import box

from companion.cli.run import COMMIT_LEAST_S, UNKNOWN_SHARE, commit_every_s
from companion.core.prescription import Prescription, Zone
from companion.core.setup import Setup
from companion.ports import COMMIT_EVERY_S
from tests.builders import setup

SPEED_M_S = 5.0


def of_field(side_m: float) -> Setup:
    zone = Zone(name="all", polygon=box(0.0, 0.0, side_m, side_m), rate_l_ha=20.0)
    return replace(setup(), prescription=Prescription([zone]), record_coverage=True)


@pytest.mark.parametrize("side_m", [50.0, 55.0, 70.0])
def test_half_the_time_is_the_stated_share_of_a_small_field(side_m: float) -> None:
    over = of_field(side_m)
    swath_m2_s = over.boom.width_m * SPEED_M_S
    lost_m2 = 0.5 * commit_every_s(over, SPEED_M_S) * swath_m2_s
    assert lost_m2 / side_m**2 == pytest.approx(UNKNOWN_SHARE)


def test_a_field_of_hectares_is_committed_once_a_second_and_a_garden_ten_times() -> None:
    assert commit_every_s(of_field(150.0), SPEED_M_S) == COMMIT_EVERY_S == 1.0
    assert commit_every_s(of_field(20.0), SPEED_M_S) == COMMIT_LEAST_S == 0.1


def test_without_a_planned_speed_the_fastest_that_sprays_counts() -> None:
    over = of_field(100.0)
    fastest_m_s = over.limits.speed_max_m_s
    assert commit_every_s(over, None) == commit_every_s(over, fastest_m_s)
    assert commit_every_s(over, None) < commit_every_s(over, SPEED_M_S)


def test_without_treated_ground_there_is_nothing_to_lose() -> None:
    over = replace(of_field(20.0), record_coverage=False)
    assert commit_every_s(over, SPEED_M_S) == COMMIT_EVERY_S
