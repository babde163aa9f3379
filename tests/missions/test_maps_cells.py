"""Cells to zones and zones to cells: the same rate at every place, before and after."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from numpy.typing import NDArray
from pyproj import CRS, Transformer
from shapely import MultiPolygon, Polygon, box

from companion.core.frame import metres_per_degree
from companion.errors import MapError
from missions.maps.convert import cell_zones, rasterise
from missions.maps.convert.cell_zones import outline_of_rates, plain_zones, zones_of
from missions.maps.convert.rasterise import cell_rates, cells_of, north_up
from missions.maps.model import Affine, MapCells, MapFile, MapZone
from missions.maps.totals import as_sprayed, totals

Floats = NDArray[np.float64]

WGS84, UTM32 = CRS.from_epsg(4326), CRS.from_epsg(32632)
WEST, NORTH = 10.0, 50.0
NAN = math.nan
# Some 1.1 m north and 1.4 m east.
NORTH_UP: Affine = (2e-5, 0.0, WEST, 0.0, -1e-5, NORTH)


def a_grid(rates: object, transform: Affine = NORTH_UP, crs: CRS = WGS84) -> MapCells:
    return MapCells(rates_l_ha=np.array(rates, dtype=np.float64), transform=transform, crs=crs)


def a_map(
    zones: Sequence[tuple[Polygon | MultiPolygon, float | None]] = (),
    *,
    cells: MapCells | None = None,
    boundary: MultiPolygon | None = None,
    default_l_ha: float | None = None,
) -> MapFile:
    return MapFile(
        path=Path("field.shp"),
        format="",
        crs="EPSG:4326",
        unit="L/ha",
        rate_field="rate",
        zones=tuple(
            MapZone(name=f"z{index}", geometry=ground, rate_l_ha=rate)
            for index, (ground, rate) in enumerate(zones)
        ),
        sha256="",
        cells=cells,
        boundary=boundary,
        default_rate_l_ha=default_l_ha,
    )


def square(west_m: float, south_m: float, east_m: float, north_m: float) -> Polygon:
    """Return a box in metres from (WEST, NORTH), with the degrees of latitude 50."""
    across_m, along_m = metres_per_degree(NORTH)
    return box(
        WEST + west_m / across_m,
        NORTH + south_m / along_m,
        WEST + east_m / across_m,
        NORTH + north_m / along_m,
    )


# ------------------------------------------------------------------------------- cells to zones


def test_each_rate_becomes_one_zone_with_its_name() -> None:
    zones = zones_of(a_grid([[12.5, 0.0], [12.5, NAN]]))
    assert [(zone.name, zone.rate_l_ha) for zone in zones] == [("0 L/ha", 0.0), ("12.5 L/ha", 12.5)]


def test_an_outline_follows_the_corners_of_the_cells_and_has_no_others() -> None:
    (zone,) = zones_of(a_grid([[5.0, 5.0, 5.0], [5.0, NAN, NAN]]))
    a, _, c, _, e, f = NORTH_UP
    wanted = {(0, 0), (3, 0), (3, 1), (1, 1), (1, 2), (0, 2)}
    found = shapely.get_coordinates(zone.geometry)[:-1].tolist()
    assert len(found) == 6
    assert {(x, y) for x, y in found} == {(a * column + c, e * row + f) for column, row in wanted}


def test_a_hole_with_an_island_keeps_both() -> None:
    rates = np.full((7, 7), 10.0)
    rates[1:6, 1:6] = NAN
    rates[2:5, 2:5] = 10.0
    rates[3, 3] = 20.0
    ten, twenty = zones_of(a_grid(rates))
    assert (ten.part_count, ten.hole_count) == (2, 2)
    assert (twenty.part_count, twenty.hole_count) == (1, 0)


@pytest.mark.parametrize(
    ("rates", "parts", "holes"),
    [
        ([[1.0, NAN], [NAN, 1.0]], 2, 0),
        # Two holes that touch at a corner, and a shell that touches itself.
        ([[1.0] * 4, [1.0, NAN, 1.0, 1.0], [1.0, 1.0, NAN, 1.0], [1.0] * 4], 1, 2),
        ([[NAN, 1.0, 1.0], [1.0, NAN, 1.0], [1.0, 1.0, 1.0]], 1, 1),
    ],
)
def test_cells_that_meet_at_a_corner_give_valid_zones(
    rates: list[list[float]], parts: int, holes: int
) -> None:
    (zone,) = zones_of(a_grid(rates))
    assert zone.geometry.is_valid
    assert (zone.part_count, zone.hole_count) == (parts, holes)


@pytest.mark.timeout(10)
def test_a_hole_round_a_pocket_finds_the_shell_around_it() -> None:
    # Going west from inside the pocket one meets the hole itself.
    rates = np.full((7, 7), 1.0)
    rates[1:6, 1] = rates[1:6, 5] = rates[5, 1:6] = NAN
    for turned in (rates, rates[::-1], rates.T, rates.T[:, ::-1]):
        (zone,) = zones_of(a_grid(turned))
        assert (zone.part_count, zone.hole_count) == (1, 1)
        assert zone.geometry.is_valid


def test_cells_without_any_rate_are_no_zone() -> None:
    assert zones_of(a_grid([[NAN, NAN]])) == []


@st.composite
def grids(draw: st.DrawFn) -> MapCells:
    shape = draw(st.tuples(st.integers(1, 9), st.integers(1, 9)))
    rates = draw(arrays.arrays(np.float64, shape, elements=st.sampled_from([0.0, 10.0, 12.5, NAN])))
    angle = draw(st.sampled_from([0.0, 0.0, 0.4, 2.5]))
    size = 1e-5 * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    up = draw(st.sampled_from([1.0, -1.0]))
    transform = (size[0, 0], up * size[0, 1], WEST, size[1, 0], up * size[1, 1], NORTH)
    return MapCells(rates_l_ha=rates, transform=tuple(map(float, transform)), crs=WGS84)


@given(cells=grids())
@settings(max_examples=100)
def test_zones_have_the_ground_of_their_cells_and_no_other(cells: MapCells) -> None:
    rates = cells.rates_l_ha
    zones = zones_of(cells)
    assert [zone.rate_l_ha for zone in zones] == sorted(set(rates[~np.isnan(rates)].tolist()))
    row, column = np.indices(rates.shape) + 0.5
    a, b, c, d, e, f = cells.transform
    x, y = a * column + b * row + c, d * column + e * row + f
    for zone in zones:
        assert zone.geometry.is_valid
        inside = shapely.contains_xy(zone.geometry, x, y)
        assert (inside == (rates == zone.rate_l_ha)).all()
        assert zone.geometry.area == pytest.approx(1e-10 * inside.sum(), rel=1e-6)


def test_projected_cells_have_their_corners_where_the_projection_puts_them() -> None:
    transform = (500.0, 0.0, 600_000.0, 0.0, -500.0, 5_500_000.0)
    (zone,) = zones_of(a_grid([[7.0, 7.0]], transform, UTM32))
    points = shapely.get_coordinates(zone.geometry)
    x, y = Transformer.from_crs(WGS84, UTM32, always_xy=True).transform(*points.T)
    ring = shapely.LinearRing(np.column_stack([x, y]))
    # Straight in the projection is bent in degrees, so there are points between the corners.
    assert len(points) == 31
    assert ring.hausdorff_distance(box(600_000, 5_499_500, 601_000, 5_500_000).exterior) < 1e-4


def test_too_many_rates_or_corners_are_refused_with_the_way_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    many = a_grid(np.arange(20_002.0).reshape(2, -1))
    with pytest.raises(MapError, match="20002 different rates") as caught:
        zones_of(many, path=Path("field.tif"))
    assert caught.value.code == "too-large"
    assert "--round" in caught.value.fix
    monkeypatch.setattr(cell_zones, "MAX_CORNERS", 11)
    with pytest.raises(MapError, match="12 corners") as caught:
        zones_of(a_grid([[1.0, NAN, 1.0, NAN, 1.0]]))
    assert caught.value.code == "too-large"


# ------------------------------------------------------------------------------- zones to cells


@st.composite
def stars(draw: st.DrawFn) -> Polygon:
    """Polygons with corners in all directions, some with a hole, about a place near the origin."""
    count = draw(st.integers(3, 9))
    radius = draw(st.lists(st.floats(3.0, 15.0), min_size=count, max_size=count))
    east, north = draw(st.floats(-8.0, 8.0)), draw(st.floats(-8.0, 8.0))
    across_m, along_m = metres_per_degree(NORTH)
    angle = 2.0 * np.pi * np.arange(count) / count
    star = Polygon(np.column_stack([radius * np.cos(angle), radius * np.sin(angle)]))
    ground = star.difference(star.buffer(-2.5)) if draw(st.booleans()) else star
    middle, origin = np.array([east, north]), np.array([WEST, NORTH])
    return shapely.transform(ground, lambda p: (p + middle) / (across_m, along_m) + origin)


@given(ground=st.lists(stars(), min_size=1, max_size=4), cell_m=st.floats(0.5, 4.0))
@settings(max_examples=60)
def test_a_cell_has_the_rate_at_its_centre(ground: list[Polygon], cell_m: float) -> None:
    rates = [10.0 * (index + 1) for index in range(len(ground))]
    cells = cells_of(a_map(list(zip(ground, rates, strict=True))), cell_m, overlap="last")
    row, column = np.indices(cells.rates_l_ha.shape) + 0.5
    a, _, c, _, e, f = cells.transform
    x, y = a * column + c, e * row + f
    wanted = np.full(cells.rates_l_ha.shape, np.nan)
    clear = np.ones(wanted.shape, dtype=np.bool_)  # of edges, by more than rounding
    for area, rate in zip(ground, rates, strict=True):
        wanted[shapely.contains_xy(area, x, y)] = rate
        clear &= shapely.distance(area.boundary, shapely.points(x, y)) > 1e-12
    assert clear.mean() > 0.5
    assert np.array_equal(cells.rates_l_ha[clear], wanted[clear], equal_nan=True)


@given(cells=grids())
@settings(max_examples=30)
def test_cells_to_zones_to_cells_and_back_is_the_same_map(cells: MapCells) -> None:
    rated = ~np.isnan(cells.rates_l_ha)
    if not rated.any():
        return
    there = a_map([(zone.geometry, zone.rate_l_ha) for zone in zones_of(cells)])
    fine = cells_of(there, 0.25, overlap="error")
    row, column = np.indices(cells.rates_l_ha.shape) + 0.5
    a, b, c, d, e, f = cells.transform
    found = cell_rates(fine, a * column + b * row + c, d * column + e * row + f)
    assert np.array_equal(found, cells.rates_l_ha, equal_nan=True)
    # A cell of 0.25 m is inside or outside: the areas differ by some of its size along the edges.
    edge_m = 0.25 * sum(
        shapely.length(shapely.transform(zone.geometry, lambda p: p * metres_per_degree(NORTH)))
        for zone in there.zones
    )
    change_m2 = 1e4 * abs(totals(a_map(cells=fine)).area_ha - totals(there).area_ha)
    assert change_m2 <= edge_m


def test_cells_are_as_wide_as_asked_and_the_north_comes_first() -> None:
    cells = cells_of(a_map([(square(0, -6, 12, 0), 20.0)]), 2.0)
    assert cells.rates_l_ha.shape == (3, 6)
    a, b, c, d, e, f = cells.transform
    assert (b, d) == (0.0, 0.0)
    assert e < 0.0 < a
    assert (c, f) == pytest.approx((WEST, NORTH), rel=0.0, abs=1e-12)
    across_m, along_m = metres_per_degree(NORTH)
    assert (a * across_m, -e * along_m) == pytest.approx((2.0, 2.0), rel=1e-5)


def test_a_zone_that_only_touches_a_cell_does_not_get_it() -> None:
    cells = cells_of(a_map([(square(0, -4, 2.4, 0), 20.0), (square(2.4, -4, 8, 0), 30.0)]), 1.0)
    assert cells.rates_l_ha[0].tolist() == [20.0, 20.0, 30.0, 30.0, 30.0, 30.0, 30.0, 30.0]


OVERLAPPING = a_map([(square(0, -4, 6, 0), 30.0), (square(2, -4, 8, 0), 10.0)])


@pytest.mark.parametrize(
    ("overlap", "shared"), [("max", 30.0), ("min", 10.0), ("mean", 20.0), ("last", 10.0)]
)
def test_the_overlap_policy_says_what_a_shared_cell_gets(overlap: str, shared: float) -> None:
    row = cells_of(OVERLAPPING, 1.0, overlap=overlap).rates_l_ha[0].tolist()
    assert row == [30.0] * 2 + [shared] * 4 + [10.0] * 2


def test_overlapping_zones_without_a_policy_are_refused_by_name() -> None:
    with pytest.raises(MapError, match=r"z0 and z1 overlap by 16\.0 m2") as caught:
        cells_of(OVERLAPPING, 1.0)
    assert caught.value.code == "overlap"
    assert "--overlap" in caught.value.fix


def test_a_zone_without_a_rate_takes_no_cell_from_another() -> None:
    cells = cells_of(a_map([(square(0, -2, 4, 0), 30.0), (square(0, -2, 9, 0), None)]), 1.0)
    assert cells.rates_l_ha.tolist() == [[30.0] * 4] * 2


@pytest.mark.parametrize(
    ("cell_m", "code"), [(0.001, "cell-size"), (NAN, "cell-size"), (0.05, "too-large")]
)
def test_cells_that_are_too_small_are_refused(cell_m: float, code: str) -> None:
    with pytest.raises(MapError) as caught:
        cells_of(a_map([(square(0, 0, 500, 500), 1.0)]), cell_m)
    assert caught.value.code == code


def test_a_map_without_any_rate_gives_no_cells() -> None:
    with pytest.raises(MapError) as caught:
        cells_of(a_map([(square(0, 0, 5, 5), None)]), 1.0)
    assert caught.value.code == "null-rate"


def test_hostile_polygons_end_at_a_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rasterise, "MAX_CROSSINGS", 7)
    with pytest.raises(MapError, match="too many edges") as caught:
        cells_of(a_map([(square(0, -4, 4, 0), 1.0)]), 1.0)
    assert caught.value.code == "too-large"
    monkeypatch.setattr(rasterise, "MAX_CROSSINGS", 8)
    monkeypatch.setattr(rasterise, "MAX_PAINTED", 15)
    with pytest.raises(MapError, match="same ground") as caught:
        cells_of(a_map([(square(0, -4, 4, 0), 1.0)]), 1.0)
    assert caught.value.code == "too-large"


# ------------------------------------------------------------- other cells, boundary and default


def test_cells_with_the_south_first_are_turned_over() -> None:
    source = a_grid([[1.0, 2.0], [3.0, 4.0]], (1e-5, 0.0, WEST, 0.0, 1e-5, NORTH))
    turned = north_up(a_map(cells=source))
    assert turned.rates_l_ha.tolist() == [[3.0, 4.0], [1.0, 2.0]]
    wanted = (1e-5, 0.0, WEST, 0.0, -1e-5, NORTH + 2e-5)
    assert turned.transform == pytest.approx(wanted, rel=0.0, abs=1e-12)


def test_cells_of_another_projection_are_asked_at_the_new_centres() -> None:
    rates = np.add.outer(np.arange(40.0) // 8, 10.0 * (np.arange(50) // 10))
    source = a_grid(rates, (2.0, 0.0, 600_000.0, 0.0, -2.0, 5_500_000.0), UTM32)
    made = north_up(a_map(cells=source))
    row, column = np.indices(made.rates_l_ha.shape) + 0.5
    a, _, c, _, e, f = made.transform
    to_utm = Transformer.from_crs(WGS84, UTM32, always_xy=True)
    x, y = to_utm.transform(a * column + c, e * row + f)
    columns, rows = (x - 600_000.0) // 2.0, (5_500_000.0 - y) // 2.0
    inside = (columns >= 0) & (columns < 50) & (rows >= 0) & (rows < 40)
    assert inside.sum() > 1800
    assert (np.isnan(made.rates_l_ha) == ~inside).all()
    wanted = rates[rows[inside].astype(int), columns[inside].astype(int)]
    assert (made.rates_l_ha[inside] == wanted).all()
    assert made.crs.to_epsg() == 4326


def test_the_default_fills_the_boundary_and_nothing_lies_beyond_it() -> None:
    field = MultiPolygon([square(0, -4, 6, 0)])
    zones = [(square(2, -4, 9, 0), 30.0), (square(0, -1, 1, 0), None)]
    source = a_map(zones, boundary=field, default_l_ha=5.0)
    assert cells_of(source, 1.0).rates_l_ha[0, :6].tolist() == [5.0] * 2 + [30.0] * 4
    assert np.isnan(cells_of(source, 1.0).rates_l_ha[:, 6:]).all()
    kept = cells_of(source, 1.0, clip=False)
    assert kept.rates_l_ha[0].tolist() == [5.0] * 2 + [30.0] * 7

    plain = plain_zones(source, clip=True)
    assert [zone.rate_l_ha for zone in plain] == [5.0, 30.0, None]
    areas = [totals(a_map([(zone.geometry, 1.0)])).area_ha * 1e4 for zone in plain]
    assert areas == pytest.approx([8.0, 16.0, 1.0], rel=1e-3)
    found = totals(as_sprayed(source))
    assert found.rates_l_ha.tolist() == [5.0, 30.0]
    assert found.all_litres == pytest.approx((8 * 5.0 + 16 * 30.0) / 1e4, rel=1e-3)


def test_zones_inside_the_boundary_stay_what_they_are() -> None:
    ground = square(0, -4, 6, 0)
    source = a_map([(ground, 30.0)], boundary=MultiPolygon([ground]))
    (kept,) = plain_zones(source, clip=True)
    assert kept.geometry is ground


def test_the_default_reaches_ground_beyond_the_cells() -> None:
    a, _, _, _, e, _ = NORTH_UP
    field = box(WEST - 2 * a, NORTH + 3 * e, WEST + a, NORTH)
    source = a_map(cells=a_grid([[20.0, 20.0]]), boundary=MultiPolygon([field]), default_l_ha=5.0)
    filled = north_up(source)
    wanted = [[5.0, 5.0, 20.0, NAN], [5.0, 5.0, 5.0, NAN], [5.0, 5.0, 5.0, NAN]]
    assert np.array_equal(filled.rates_l_ha, wanted, equal_nan=True)
    assert filled.transform[2] == pytest.approx(WEST - 2 * a, rel=0.0, abs=1e-12)


def test_the_outline_of_rates_leaves_out_what_has_none() -> None:
    zones = [(square(0, 0, 4, 4), 1.0), (square(4, 0, 8, 4), 0.0), (square(8, 0, 9, 4), None)]
    assert outline_of_rates(a_map(zones)).area == pytest.approx(square(0, 0, 8, 4).area)
    cells = a_grid([[1.0, 0.0, NAN]])
    assert outline_of_rates(a_map(cells=cells)).area == pytest.approx(2 * 2e-10)


def test_totals_of_cells_are_those_of_their_zones() -> None:
    rates = np.add.outer(np.arange(30) // 7, np.arange(40) // 9).astype(np.float64)
    rates[4:9, 3:30] = NAN
    source = a_map(cells=a_grid(rates))
    zones = a_map([(zone.geometry, zone.rate_l_ha) for zone in zones_of(a_grid(rates))])
    by_cells, by_zones = totals(source), totals(zones)
    assert by_cells.rates_l_ha.tolist() == by_zones.rates_l_ha.tolist()
    assert by_cells.areas_ha == pytest.approx(by_zones.areas_ha, rel=1e-6)
