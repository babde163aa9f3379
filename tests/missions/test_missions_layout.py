"""Lines that begin anew where edges run along them; the naive plan of the table; turns."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from shapely import Polygon, box
from shapely.affinity import rotate

from missions import open_lines as lines_module
from missions.corners import Motion
from missions.coverage import measure
from missions.open_lines import edges_along, fitted_lines, needed_passes, open_lines
from missions.strips import border_passes, lengths_m
from tests.bench.missions import comb
from tests.bench.turns import model_s, twin_s

MOTION = Motion(speed_m_s=6.0, acceleration_m_s2=2.5)
WIDTH_M = 7.0


def stairs(*tops: float, wide: float = 21.0) -> Polygon:
    """Return columns of one width and many heights."""
    boxes = [box(at * wide, 0.0, (at + 1) * wide, top) for at, top in enumerate(tops)]
    whole = shapely.union_all(boxes)
    assert isinstance(whole, Polygon)
    return whole


def test_edges_along_the_lines_are_found_with_both_ends() -> None:
    turned = shapely.transform(comb(), lambda points: points[:, ::-1])
    assert isinstance(turned, Polygon)
    places = [0, 20, 60, 75, 120, 180, 220, 235, 275, 300]
    assert edges_along(turned, WIDTH_M) == pytest.approx(places)


def test_lines_fit_every_column_of_the_comb_with_fewer_lines() -> None:
    fitted, plain = fitted_lines(comb(), WIDTH_M, 0.0, MOTION), open_lines(comb(), WIDTH_M, 0.0)
    assert measure(fitted, comb(), WIDTH_M).outside_m2 == pytest.approx(0.0, abs=1e-6)
    found, other = (measure(each, comb(), WIDTH_M).percent for each in (fitted, plain))
    assert found > other + 1.0


@given(
    tops=st.lists(st.floats(30.0, 200.0), min_size=1, max_size=4), angle=st.floats(0.0, 180.0),
    odd=st.floats(0.0, 6.0),
)  # fmt: skip
def test_no_strip_leaves_the_ground_whatever_its_turn(
    tops: list[float], angle: float, odd: float
) -> None:
    ground = rotate(stairs(*tops, wide=21.0 + odd), -angle, origin=(0.0, 0.0))
    lines = fitted_lines(ground, WIDTH_M, angle, MOTION)
    assert len(lines) >= 3
    assert measure(lines, ground.buffer(0.005), WIDTH_M).outside_m2 == pytest.approx(0.0, abs=1e-3)


def test_columns_of_whole_swaths_are_covered_without_a_line_too_many() -> None:
    lines = fitted_lines(stairs(100.0, 60.0, 150.0), WIDTH_M, 0.0, MOTION)
    assert np.sort(lengths_m(lines)) == pytest.approx([60.0] * 3 + [100.0] * 3 + [150.0] * 3)


@pytest.mark.parametrize("turn", ["stop", "strafe"])
def test_turns_of_the_model_are_those_of_the_twin(turn: str) -> None:
    assert model_s(turn) == pytest.approx(twin_s(turn), rel=0.02)  # type: ignore[arg-type]


def test_ground_in_tiles_needs_the_passes_that_it_needs_as_a_whole(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ground = Polygon([(0, 0), (170, 30), (200, 160), (90, 210), (-20, 120)])
    ground = ground.difference(shapely.union_all([box(x, 80, x + 5, 90) for x in (40, 90, 140)]))
    lines, passes = open_lines(ground, 6.0, 20.0), border_passes(ground, 6.0)
    found = []
    for corners in (8, 10_000):
        monkeypatch.setattr(lines_module, "TILE_CORNERS", corners)
        found.append(needed_passes(lines, passes, ground, 6.0))
    assert len(found[0]) > 3
    assert found[0] == pytest.approx(found[1], abs=1e-6)
