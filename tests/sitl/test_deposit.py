from __future__ import annotations

import math

import numpy as np
import pytest
import shapely

from companion.core.boom import Boom, Valve
from sitl.deposit import Deposit

SIX = Boom(
    width_m=6.0,
    valves=tuple(Valve(name=str(i), right_m=i - 2.5, forward_m=0.0, width_m=1.0) for i in range(6)),
)
ONE = Boom(width_m=1.0, valves=(Valve(name="1", right_m=2.0, forward_m=0.5, width_m=1.0),))


def straight(
    deposit: Deposit, boom: Boom, *, heading_deg: float = 90.0, step_s: float = 0.002
) -> np.ndarray:
    """Fly 20 m east at 5 m/s from 0, with 10 mL/s from every valve; return the volumes."""
    times_s = np.arange(0.0, 4.0 + step_s / 2, step_s)
    volume_ml = np.repeat(10.0 * times_s[:, None], len(boom.valves), axis=1)
    deposit.add(
        east_m=5.0 * times_s,
        north_m=np.zeros_like(times_s),
        heading_deg=np.full_like(times_s, heading_deg),
        volume_ml=volume_ml,
        boom=boom,
    )
    return np.array(volume_ml[-1])


def test_all_that_leaves_the_valves_is_on_the_ground() -> None:
    deposit = Deposit((-5.0, -5.0, 25.0, 5.0))
    litres_ml = straight(deposit, SIX).sum()
    assert deposit.total_ml == pytest.approx(litres_ml, rel=1e-12)
    assert deposit._cells_ml[-1] == 0.0


def test_what_falls_beside_the_raster_is_counted() -> None:
    deposit = Deposit((0.0, -5.0, 10.0, 5.0))
    litres_ml = straight(deposit, SIX).sum()
    assert deposit.total_ml == pytest.approx(litres_ml, rel=1e-12)
    assert deposit._cells_ml[-1] == pytest.approx(litres_ml / 2, rel=0.01)


def test_the_rate_on_the_ground_is_flow_over_speed_and_width() -> None:
    deposit = Deposit((-5.0, -5.0, 25.0, 5.0))
    straight(deposit, SIX)
    # 10 mL/s over 1 m at 5 m/s are 2 mL/m2, that is 20 L/ha.
    inner = deposit.applied_l_ha[20:80, 60:240]
    assert inner.mean() == pytest.approx(20.0, rel=1e-3)


def test_a_strip_lies_right_and_ahead_of_the_nose() -> None:
    for heading_deg, box in ((90.0, (0.5, -2.5, 20.5, -1.5)), (0.0, (1.5, 0.5, 22.5, 0.5))):
        deposit = Deposit((-10.0, -10.0, 30.0, 10.0))
        straight(deposit, ONE, heading_deg=heading_deg)
        assert deposit.off_target_ml(shapely.box(*box).buffer(1e-3)) == pytest.approx(0.0, abs=1e-9)


def test_what_falls_outside_a_field_is_judged_at_the_point_and_not_the_cell() -> None:
    # The field ends within a cell: a raster could not tell the 3 cm.
    deposit = Deposit((-5.0, -5.0, 25.0, 5.0))
    total_ml = straight(deposit, SIX).sum()
    outside_ml = deposit.off_target_ml(shapely.box(-1.0, -4.0, 10.03, 4.0))
    assert outside_ml == pytest.approx(total_ml * (20.0 - 10.03) / 20.0, rel=2e-3)


def test_a_hole_in_the_field_is_outside() -> None:
    deposit = Deposit((-5.0, -5.0, 25.0, 5.0))
    straight(deposit, SIX)
    field = shapely.Polygon(
        shapely.box(-1.0, -4.0, 21.0, 4.0).exterior, [shapely.box(8.0, 0.0, 9.0, 1.0).exterior]
    )
    assert deposit.off_target_ml(field) == pytest.approx(2.0, rel=0.06)


def test_steps_of_time_do_not_change_where_it_falls() -> None:
    fine, coarse = (Deposit((-5.0, -5.0, 25.0, 5.0), cell_m=1.0) for _ in range(2))
    straight(fine, SIX, step_s=0.002)
    straight(coarse, SIX, step_s=0.01)
    assert np.abs(fine.cells_ml - coarse.cells_ml).max() < 0.06 * fine.cells_ml.max()


def test_a_turn_on_the_spot_spreads_the_boom_and_not_its_middle() -> None:
    deposit = Deposit((-5.0, -5.0, 5.0, 5.0))
    times_s = np.linspace(0.0, 1.0, 400)
    deposit.add(
        east_m=np.zeros(400),
        north_m=np.zeros(400),
        heading_deg=(350.0 + 90.0 * times_s) % 360.0,
        volume_ml=100.0 * times_s[:, None],
        boom=Boom(width_m=6.0, valves=(Valve(name="1", right_m=2.5, forward_m=0.0, width_m=1.0),)),
    )
    assert deposit.total_ml == pytest.approx(100.0)
    north, east = np.nonzero(deposit.cells_ml)
    radius_m = np.hypot((east - 49.5) * 0.1, (north - 49.5) * 0.1)
    assert 1.9 < radius_m.min() < radius_m.max() < 3.1
    angle_deg = np.degrees(np.arctan2((east - 49.5), (north - 49.5)))
    assert angle_deg.max() - angle_deg.min() == pytest.approx(90.0, abs=4.0)


def test_wrong_shapes_and_rasters_are_refused() -> None:
    with pytest.raises(ValueError, match="raster"):
        Deposit((0.0, 0.0, 0.0, 1.0))
    with pytest.raises(ValueError, match="raster"):
        Deposit((0.0, 0.0, math.nan, 1.0))
    two = np.zeros(2)
    with pytest.raises(ValueError, match="1 volumes for 6 valves"):
        Deposit((0.0, 0.0, 1.0, 1.0)).add(
            east_m=two, north_m=two, heading_deg=two, volume_ml=np.zeros((2, 1)), boom=SIX
        )
