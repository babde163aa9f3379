"""Valves that the companion closes at the border have no litres in the plan."""

from __future__ import annotations

import numpy as np
import pytest
from shapely import box

from missions.demand import Uniform, demands
from missions.strips import extents_of

VALVES = tuple((right_m, 1.0) for right_m in (-2.5, -1.5, -0.5, 0.5, 1.5, 2.5))
FIELD = box(0, 0, 50, 200)


def litres(east_m: float, *, buffer_m: float, south_m: float = 20.0) -> float:
    lines = np.array([[east_m, south_m, east_m, 180.0]])
    extents = extents_of(FIELD, width_m=6.0, buffer_m=buffer_m)
    (need,) = demands(lines, Uniform(rate_l_ha=20.0), width_m=6.0, valves=VALVES, extents=extents)
    return need.total_l


def test_inside_nothing_is_closed() -> None:
    assert litres(25.0, buffer_m=0.1) == pytest.approx(6.0 * 160.0 * 20.0 / 1e4)


@pytest.mark.parametrize(("east_m", "valves"), [(3.0025, 5), (3.2, 6), (2.0, 4), (46.8, 6)])
def test_along_the_border_the_outer_valves_are_closed(east_m: float, valves: int) -> None:
    open_l = litres(east_m, buffer_m=0.1)
    assert open_l == pytest.approx(valves * 160.0 * 20.0 / 1e4)


def test_a_line_beyond_the_border_has_litres_up_to_it() -> None:
    found = litres(25.0, buffer_m=0.1, south_m=-10.0)
    assert found == pytest.approx(6.0 * 179.9 * 20.0 / 1e4, abs=0.013)
