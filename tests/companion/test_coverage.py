"""The raster of treated ground: cells by their centres, tiles shared, bounded whatever comes."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from companion.core.options import coverage as raster
from companion.core.options.coverage import CELL_M, TILE_CELLS, Coverage, Quad

HALF = CELL_M / 2


def box(west: float, south: float, east: float, north: float) -> Quad:
    return ((west, south), (east, south), (east, north), (west, north))


def centres(west: float, south: float, east: float, north: float) -> tuple[np.ndarray, np.ndarray]:
    x, y = np.meshgrid(
        np.arange(math.floor(west / CELL_M), math.ceil(east / CELL_M)) * CELL_M + HALF,
        np.arange(math.floor(south / CELL_M), math.ceil(north / CELL_M)) * CELL_M + HALF,
    )
    return x, y


def test_a_rectangle_treats_the_cells_whose_centres_it_holds() -> None:
    made = Coverage().stamped([box(-3.0, -2.0, 11.0, 5.0)])
    assert made.area_m2 == pytest.approx(14.0 * 7.0)
    assert made.covered_at(np.array([-2.95, 10.95, -3.05, 11.05]), np.zeros(4)).tolist() == [
        True, True, False, False,
    ]  # fmt: skip


def test_either_way_round_is_the_same() -> None:
    quad = box(0.0, 0.0, 7.0, 3.0)
    assert Coverage().stamped([quad]) == Coverage().stamped([quad[::-1]])


@given(
    corners=st.lists(st.tuples(st.floats(-8.0, 8.0), st.floats(-8.0, 8.0)), min_size=4, max_size=4)
)
def test_a_convex_quadrilateral_is_what_shapely_says(corners: list[tuple[float, float]]) -> None:
    hull = shapely.MultiPoint(corners).convex_hull
    if not isinstance(hull, shapely.Polygon) or len(hull.exterior.coords) != 5:
        return
    quad = tuple(hull.exterior.coords[:4])
    x, y = centres(*hull.bounds)
    shapely.prepare(hull)
    differs = Coverage().stamped([quad]).covered_at(x, y) != shapely.contains_xy(hull, x, y)
    # A centre on a side itself lies inside, and shapely says it does not.
    assert (shapely.distance(hull.exterior, shapely.points(x[differs], y[differs])) < 1e-6).all()


@given(
    angle_deg=st.floats(0.0, 360.0),
    at=st.floats(0.05, 0.95),
    east_m=st.floats(-500.0, 500.0),
)
def test_two_parts_of_a_swath_leave_no_cell_between_them(
    angle_deg: float, at: float, east_m: float
) -> None:
    angle = math.radians(angle_deg)
    ux, uy = math.sin(angle), math.cos(angle)

    def corner(along: float, aside: float) -> tuple[float, float]:
        return east_m + along * ux + aside * uy, along * uy - aside * ux

    def piece(first: float, last: float) -> Quad:
        return corner(first, -3.0), corner(first, 3.0), corner(last, 3.0), corner(last, -3.0)

    parts = Coverage().stamped([piece(0.0, 9.0 * at), piece(9.0 * at, 9.0)])
    whole = Coverage().stamped([piece(0.0, 9.0)])
    missing = whole.cell_count - parts.cell_count
    # A corner on the long sides may fall to either by rounding.
    assert abs(missing) <= 2


def test_a_quadrilateral_that_crosses_itself_treats_what_its_triangles_hold() -> None:
    bow = ((0.0, 0.0), (6.0, 4.0), (6.0, 0.0), (0.0, 4.0))
    made = Coverage().stamped([bow])
    assert made.covered_at(np.array([5.5]), np.array([2.05])).all()
    assert 0.0 < made.area_m2 <= 24.0


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e12])
def test_what_is_no_place_is_left_out(bad: float) -> None:
    base = Coverage().stamped([box(0.0, 0.0, 2.0, 2.0)])
    assert base.stamped([((bad, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0))]) is base
    assert not base.covered_at(np.array([bad]), np.array([1.0])).any()
    assert base.covered_at(np.array([bad, 1.0]), np.array([1.0, 1.0])).tolist() == [False, True]
    assert base.is_bare(bad, 0.0, 1.0, 1.0)


def test_a_jump_of_the_position_makes_no_tiles() -> None:
    assert Coverage().stamped([box(0.0, 0.0, 5000.0, 6.0)]).tiles == {}


def test_there_are_never_more_tiles_than_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(raster, "TILES_MAX", 3)
    made = Coverage()
    for number in range(10):
        made = made.stamped([box(100.0 * number, 0.0, 100.0 * number + 1.0, 1.0)])
    assert len(made.tiles) == 3
    # Those that are there still take what comes.
    assert made.stamped([box(2.0, 2.0, 3.0, 3.0)]).area_m2 == pytest.approx(made.area_m2 + 1.0)


def test_tiles_that_nothing_fell_on_are_the_same_objects() -> None:
    first = Coverage().stamped([box(0.0, 0.0, 60.0, 6.0)])
    second = first.stamped([box(0.0, 0.0, 2.0, 7.0)])
    same = [key for key in first.tiles if second.tiles[key] is first.tiles[key]]
    assert len(same) == len(first.tiles) - 1
    again = second.stamped([box(0.0, 0.0, 2.0, 7.0)])
    assert all(again.tiles[key] is tile for key, tile in second.tiles.items())


def test_both_together_are_what_either_has() -> None:
    one = Coverage().stamped([box(0.0, 0.0, 4.0, 4.0), box(40.0, 0.0, 41.0, 1.0)])
    other = Coverage().stamped([box(2.0, 2.0, 6.0, 6.0)])
    both = one.joined(other)
    assert both.area_m2 == pytest.approx(16.0 + 16.0 - 4.0 + 1.0)
    assert other.joined(one).tiles == both.tiles
    assert one.joined(Coverage()).tiles == one.tiles


def test_near_and_far_places_are_looked_up_alike() -> None:
    made = Coverage().stamped([box(-5.0, -5.0, 5.0, 5.0)])
    near = made.covered_at(np.array([0.0, 7.0]), np.array([0.0, 0.0]))
    far = made.covered_at(np.array([0.0, 7.0, 9e4]), np.array([0.0, 0.0, -9e4]))
    assert near.tolist() == far[:2].tolist() == [True, False]
    assert not far[2]


def test_a_box_is_bare_where_no_tile_is() -> None:
    tile_m = CELL_M * TILE_CELLS
    made = Coverage().stamped([box(1.0, 1.0, 2.0, 2.0)])
    assert not made.is_bare(0.5, 0.5, 1.5, 1.5)
    assert made.is_bare(tile_m + 0.1, 0.1, tile_m + 9.0, 9.0)
    assert not made.is_bare(-1e6, -1e6, 1e6, 1e6)
    assert Coverage().is_bare(0.0, 0.0, 1.0, 1.0)
