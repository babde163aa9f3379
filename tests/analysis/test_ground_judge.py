"""The judge of ground on drawn flights whose figures can be told by hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely

from companion.core.frame import LocalFrame
from tests.ground_judge import Field, Truth, doses_of, judge, to_local

RATE_L_HA, SPEED_M_S, STEP_S = 20.0, 5.0, 0.01
GROUND = Field(
    zones=[(shapely.box(0, 0, 20, 40), 20.0), (shapely.box(20, 0, 40, 40), 0.0)],
    outline=shapely.box(0, 0, 40, 40),
)


def north(
    middle_m: float, *, opens_m: float = 0.0, closes_m: float = 40.0, rate_l_ha: float = RATE_L_HA
) -> Truth:
    """Return a pass to the north with three strips of 2 m, open between two places."""
    time_s = np.arange(0.0, 60.0 / SPEED_M_S, STEP_S)
    north_m = -10.0 + SPEED_M_S * time_s
    wet_m = np.clip(north_m, opens_m, closes_m) - opens_m
    volume_ml = np.repeat((wet_m * 2.0 * rate_l_ha / 10.0)[:, None], 3, axis=1)
    return Truth(
        time_s=time_s, east_m=np.full(len(time_s), middle_m), north_m=north_m,
        heading_deg=np.zeros(len(time_s)), volume_ml=volume_ml,
        right_m=np.array([-2.0, 0.0, 2.0]), forward_m=np.zeros(3), width_m=np.full(3, 2.0),
        origin_deg=(36.0, 114.5),
    )  # fmt: skip


def test_one_pass_is_litres_and_ground() -> None:
    found = judge([north(5.0)], GROUND)
    assert found.applied_l == pytest.approx(0.48)
    assert found.treated_m2 == pytest.approx(240.0, abs=3.0)
    assert (found.field_m2, found.twice_m2) == pytest.approx((800.0, 0.0), abs=0.1)
    assert found.bare_m2 == pytest.approx(560.0, abs=3.0)
    assert found.missed_m2 == pytest.approx(0.0, abs=3.0)
    assert (found.outside_ml, found.off_line_ml) == (0.0, 0.0)
    assert found.asked_rate_l_ha == pytest.approx(20.0)


def test_two_passes_share_a_strip_in_one_flight_or_in_two() -> None:
    one, other = north(5.0), north(10.0)
    together = judge([one, other], GROUND)
    assert together.twice_m2 == pytest.approx(40.0, abs=1.0)
    assert together.treated_m2 == pytest.approx(440.0, abs=5.0)
    assert together.applied_l == pytest.approx(0.96)


def test_what_leaves_the_field_is_not_what_is_off_a_line() -> None:
    line = [shapely.LineString([(5, 0), (5, 30)])]
    beyond = judge([north(5.0, closes_m=43.0)], replace(GROUND, lines=line))
    # The judge leaves a strip half a metre aside of a line, none beyond its end.
    assert beyond.outside_ml == pytest.approx(3.0 * 6.0 * 2.0, rel=0.02)
    assert beyond.off_line_ml == pytest.approx(10.0 * 6.0 * 2.0, rel=0.02)


def test_a_closed_valve_leaves_ground_bare_that_was_passed() -> None:
    lines = [shapely.LineString([(each, 0), (each, 40)]) for each in (5, 15)]
    flown = judge([north(5.0, opens_m=10.0)], replace(GROUND, lines=lines))
    assert flown.missed_m2 == pytest.approx(60.0, abs=3.0)
    assert flown.bare_m2 == pytest.approx(800.0 - 180.0, abs=3.0)


def test_a_dose_is_the_sum_of_all_that_fell_on_a_cell_in_the_field() -> None:
    # The western strip lies half outside: what falls there is no dose of the field.
    flights = [north(2.0), north(2.0, rate_l_ha=10.0)]
    found = doses_of(flights, GROUND, -2.0, 0.0, 4.0, (10, 3))
    assert found.dose_l_ha[4] == pytest.approx([30.0, 30.0, np.nan], rel=0.02, nan_ok=True)
    assert found.ground_m2[4] == pytest.approx([8.0, 12.0, 0.0], abs=0.5)
    assert found.asked_l_ha[4, 0] == pytest.approx(20.0)


def test_places_are_where_the_product_has_them() -> None:
    there = np.array([[114.503, 36.002], [114.49, 35.99]])
    frame = LocalFrame(36.0, 114.5)
    expected = [frame.to_local(lat, lon) for lon, lat in there]
    assert to_local(there, (36.0, 114.5)) == pytest.approx(np.array(expected), abs=0.01)


def test_the_file_of_a_flight_is_read_as_it_was_written(tmp_path: Path) -> None:
    flown = north(5.0)
    arrays = {name: np.asarray(getattr(flown, name)) for name in Truth.__annotations__}
    np.savez(tmp_path / "truth.npz", **arrays)
    read = Truth.read(tmp_path / "truth.npz")
    assert judge([read], GROUND).applied_l == judge([flown], GROUND).applied_l
