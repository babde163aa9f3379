"""Rows and columns of rates in the core: look-ups, edges, outline; the journal keeps them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from pyproj import CRS

from analysis.journals.content import read_journal
from companion.core.cells import NO_RATE, CellGrid, Warp, exponents, rectangles
from companion.core.crossings import find_routes
from companion.core.prescription import FIELD, Prescription, Zone
from companion.errors import MapError
from companion.journal.journal import Journal
from missions.maps.build import build_prescription, frame_for
from missions.maps.cells import cell_areas_m2, cell_size_m
from missions.maps.model import Affine, MapCells, MapFile
from tests import builders

WGS84 = CRS.from_epsg(4326)
kinds = arrays.arrays(np.int32, st.tuples(*[st.integers(1, 7)] * 2), elements=st.integers(-1, 3))


def linear(a: float, b: float, c: float, d: float, e: float, f: float) -> Warp:
    """Return u = a x + b y + c, v = d x + e y + f."""
    return Warp(x0=0.0, y0=0.0, scale=1.0, terms=((c, f), (b, e), (a, d)))


def square_cells(classes: Sequence[Sequence[int]], size_m: float = 3.0) -> CellGrid:
    found = np.array(classes, dtype=np.int32)
    rates = [10.0 * (kind + 1) for kind in range(int(found.max()) + 1)] or [1.0]
    return CellGrid(
        found,
        rates,
        linear(size_m, 0.0, 0.0, 0.0, size_m, 0.0),
        linear(1.0 / size_m, 0.0, 0.0, 0.0, 1.0 / size_m, 0.0),
    )


def as_zones(cells: CellGrid) -> Prescription:
    """Return the same ground with one polygon a rate."""
    areas = [
        Zone(name=str(kind), polygon=area, rate_l_ha=float(cells.rates_l_ha[kind]))
        for kind, area in enumerate(cells.areas)
        if not area.is_empty
    ]
    return Prescription(areas, boundary=cells.outline)


def map_of(rates: np.ndarray, transform: Affine, crs: CRS = WGS84) -> MapFile:
    return MapFile(
        path=Path("rx.tif"),
        format="geotiff",
        crs="EPSG:4326",
        unit="L/ha",
        rate_field="band 1",
        zones=(),
        sha256="",
        cells=MapCells(rates_l_ha=rates, transform=transform, crs=crs),
    )


@given(st.integers(0, 5), st.floats(-3, 3), st.floats(-3, 3))
def test_a_warp_is_its_polynomial_at_one_point_and_at_many(degree: int, x: float, y: float) -> None:
    terms = tuple((1.0 + k, 2.0 - k) for k in range(len(exponents(degree))))
    warp = Warp(x0=0.5, y0=-0.25, scale=2.0, terms=terms)
    p, q = (x - 0.5) / 2.0, (y + 0.25) / 2.0
    wanted = [
        sum(term[k] * p**i * q**j for term, (i, j) in zip(terms, exponents(degree), strict=True))
        for k in (0, 1)
    ]
    assert warp.degree == degree
    assert warp.at(x, y) == pytest.approx(wanted, rel=1e-9, abs=1e-9)
    many = warp(np.array([9.0, x, -9.0]), np.array([1.0, y, -1.0]))
    assert [values[1] for values in many] == pytest.approx(wanted, rel=1e-9, abs=1e-9)


@given(kinds)
def test_rectangles_cover_every_cell_with_a_rate_once(classes: np.ndarray) -> None:
    painted = np.full(classes.shape, NO_RATE)
    for kind, row, row_end, column, column_end in zip(*rectangles(classes), strict=True):
        assert (painted[row:row_end, column:column_end] == NO_RATE).all()
        painted[row:row_end, column:column_end] = kind
    assert (painted == classes).all()


@given(kinds)
def test_edges_close_around_every_class(classes: np.ndarray) -> None:
    cells = square_cells(classes)
    ends, owner = cells.edges_in(-100.0, -100.0, 100.0, 100.0)
    # Gauss: the area on the left of closed edges is half the sum of their cross products.
    cross = ends[:, 0] * ends[:, 3] - ends[:, 2] * ends[:, 1]
    for kind in range(len(cells.rates_l_ha)):
        count = int((classes == kind).sum())
        assert cross[owner == kind].sum() / 2.0 == pytest.approx(9.0 * count)
        assert cells.areas[kind].area == pytest.approx(9.0 * count)
    assert cells.outline.area == pytest.approx(9.0 * (classes != NO_RATE).sum())
    assert not (owner == NO_RATE).any()


@given(kinds, st.floats(-2.0, 23.0), st.floats(-2.0, 23.0))
def test_one_point_many_points_and_polygons_agree(
    classes: np.ndarray, east_m: float, north_m: float
) -> None:
    cells = square_cells(classes)
    one = cells.class_at(east_m, north_m)
    assert one == cells.classes_at(np.array([east_m]), np.array([north_m]))[0]
    spot = shapely.Point(east_m, north_m)
    if all(area.boundary.distance(spot) > 1e-6 for area in cells.areas if not area.is_empty):
        around = [kind for kind, area in enumerate(cells.areas) if area.contains(spot)]
        assert around == ([] if one == NO_RATE else [one])


def test_nothing_is_sprayed_at_no_place() -> None:
    prescription = Prescription((), cells=square_cells([[0, 1]]))
    for east_m, north_m in ((math.nan, 1.0), (1.0, math.inf), (-math.inf, math.nan), (6.0, 1.0)):
        assert prescription.rate_at(east_m, north_m) is None
    assert prescription.rate_at(5.9, 1.0) == 20.0
    assert prescription.owners_at(np.array([1.0]), np.array([1.0])) == [{0, FIELD}]


@given(
    kinds,
    st.floats(0.0, 21.0),
    st.floats(0.0, 21.0),
    st.floats(0.0, 360.0),
    st.sampled_from(["centre", "max", "mean"]),
)
def test_a_path_over_cells_crosses_as_over_polygons(
    classes: np.ndarray, east_m: float, north_m: float, course_deg: float, across: str
) -> None:
    cells = square_cells(classes)
    if cells.outline.is_empty:
        return
    state = builders.flying(10.0, east_m, north_m, **builders.along(course_deg))
    routes = [
        find_routes(
            prescription,
            state,
            builders.boom(),
            back_s=0.2,
            ahead_s=1.0,
            border="inside",
            border_buffer_m=0.1,
            across=across,  # type: ignore[arg-type]
        )
        for prescription in (Prescription((), cells=cells), as_zones(cells))
    ]
    for ours, theirs in zip(*routes, strict=True):
        assert [c.rate_l_ha for c in ours] == [c.rate_l_ha for c in theirs]
        assert [c.at_s for c in ours] == pytest.approx([c.at_s for c in theirs], abs=1e-6)


def test_a_boundary_and_an_exclusion_take_ground_away() -> None:
    cells = square_cells([[0, 1], [0, 1]])
    field = Prescription(
        (),
        cells=cells,
        boundary=shapely.box(0.0, 0.0, 6.0, 4.5),
        exclusions=[shapely.box(4.0, 0.0, 6.0, 1.0)],
    )
    found = field.rates_at(np.array([1.0, 1.0, 5.0, 5.0]), np.array([1.0, 5.0, 0.5, 2.0]))
    assert found.tolist() == pytest.approx([10.0, math.nan, math.nan, 20.0], nan_ok=True)


def test_a_raster_lies_where_its_coordinates_say() -> None:
    rates = np.array([[1.0, 2.0, np.nan], [4.0, 5.0, 6.0]])
    # North-up, as GeoTIFF has it: the first row is the northernmost.
    found = map_of(rates, (2e-5, 0.0, 114.5, 0.0, -1e-5, 36.0))
    frame = frame_for(found)
    prescription = build_prescription(found, frame)
    centres = [
        (36.0 - (i + 0.5) * 1e-5, 114.5 + (j + 0.5) * 2e-5) for i in (0, 1) for j in range(3)
    ]
    east_m, north_m = frame.to_local_all(*zip(*centres, strict=True))
    assert prescription.rates_at(east_m, north_m) == pytest.approx(rates.ravel(), nan_ok=True)
    assert prescription.zone_name(0) == "1 L/ha"
    areas_m2 = cell_areas_m2(found.cells, frame)
    across_m, up_m = cell_size_m(found.cells, frame)
    assert areas_m2 == pytest.approx(np.full((2, 3), across_m * up_m), rel=1e-6)
    assert prescription.area_m2 == pytest.approx(5 * across_m * up_m, rel=1e-6)


@pytest.mark.parametrize("epsg", [32650, 3857, 4326])
def test_any_projection_is_straightened_to_a_micrometre(epsg: int) -> None:
    crs = CRS.from_epsg(epsg)
    rates = np.arange(40.0 * 60.0).reshape(40, 60)
    transforms: dict[int, Affine] = {
        32650: (40.0, 5.0, 280_000.0, 5.0, -40.0, 3_990_000.0),
        3857: (50.0, 0.0, 12_746_000.0, 0.0, -50.0, 4_300_000.0),
        4326: (5e-4, 0.0, 114.5, 0.0, -4e-4, 36.0),
    }
    found = map_of(rates, transforms[epsg], crs)
    prescription = build_prescription(found, frame_for(found))
    cells = prescription.cells
    assert cells is not None
    row, column = np.array([0.3, 39.7, 20.1]), np.array([59.6, 0.2, 31.9])
    east_m, north_m = cells.to_frame(column, row)
    back = cells.to_cells(east_m, north_m)
    assert back[0] == pytest.approx(column, abs=1e-7)
    assert back[1] == pytest.approx(row, abs=1e-7)
    assert cells.classes_at(east_m, north_m).tolist() == [
        (39 - int(r)) * 60 + int(c) for r, c in zip(row, column, strict=True)
    ]


def test_an_offset_moves_the_cells() -> None:
    found = map_of(np.array([[1.0, 2.0]]), (1e-4, 0.0, 114.5, 0.0, -1e-4, 36.0))
    frame = frame_for(found)
    moved = build_prescription(found, frame, offset_east_m=1.25, offset_north_m=-0.5)
    plain = build_prescription(found, frame)
    assert np.array(moved.bounds_m) - np.array(plain.bounds_m) == pytest.approx(
        [1.25, -0.5, 1.25, -0.5], abs=1e-6
    )
    # Rates too: a metre to each side of the edge between the two cells, before and after.
    west, south, east, north = plain.bounds_m
    edge_m, middle_m = (west + east) / 2, (south + north) / 2
    for side, rate in ((-1.0, 1.0), (1.0, 2.0)):
        assert plain.rate_at(edge_m + side, middle_m) == rate
        assert moved.rate_at(edge_m + 1.25 + side, middle_m - 0.5) == rate


def test_the_boundary_and_the_default_of_the_map_itself_hold() -> None:
    rates = np.array([[10.0, np.nan, 30.0]])
    plain = map_of(rates, (1e-4, 0.0, 114.5, 0.0, -1e-4, 36.0))
    left_two = shapely.MultiPolygon([shapely.box(114.5, 35.9999, 114.5002, 36.0)])
    own = replace(plain, boundary=left_two, default_rate_l_ha=5.0)
    frame = frame_for(plain)
    places = frame.to_local_all([35.99995] * 3, [114.50005, 114.50015, 114.50025])

    def found(map_file: MapFile) -> list[float]:
        return build_prescription(map_file, frame).rates_at(*places).tolist()

    assert found(plain) == pytest.approx([10.0, math.nan, 30.0], nan_ok=True)
    assert found(own) == pytest.approx([10.0, 5.0, math.nan], nan_ok=True)
    # A default means the field that the map knows, not one that somebody else drew.
    unbounded = replace(plain, default_rate_l_ha=5.0)
    drawn = build_prescription(unbounded, frame, boundary=left_two).rates_at(*places).tolist()
    assert drawn == pytest.approx([10.0, math.nan, math.nan], nan_ok=True)
    given = build_prescription(own, frame, default_rate_l_ha=7.0).rates_at(*places).tolist()
    assert given == pytest.approx([10.0, 7.0, math.nan], nan_ok=True)


def test_cells_too_fine_or_nowhere_are_refused() -> None:
    fine = map_of(np.array([[1.0]]), (1e-9, 0.0, 114.5, 0.0, -1e-9, 36.0))
    with pytest.raises(MapError) as caught:
        build_prescription(fine, frame_for(fine))
    assert caught.value.code == "too-fine"


def test_the_journal_gives_the_same_cells_back(tmp_path: Path) -> None:
    found = map_of(np.array([[1.0, 2.0], [np.nan, 4.5]]), (1e-4, 0.0, 114.5, 0.0, -1e-4, 36.0))
    frame = frame_for(found)
    setup = builders.setup(frame=frame, prescription=build_prescription(found, frame))
    with Journal.create(tmp_path, setup=setup, started_s=0.0, waits=True) as journal:
        path = journal.path
    again = read_journal(path).setup.prescription
    cells, kept = setup.prescription.cells, again.cells
    assert cells is not None
    assert kept is not None
    assert (kept.classes == cells.classes).all()
    assert kept.rates_l_ha.tolist() == cells.rates_l_ha.tolist()
    assert (kept.to_frame, kept.to_cells) == (cells.to_frame, cells.to_cells)
    assert again.field.equals(setup.prescription.field)


def test_what_is_no_grid_is_refused() -> None:
    good = linear(1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
    with pytest.raises(ValueError, match="clockwise"):
        CellGrid(np.zeros((1, 1), np.int32), [1.0], linear(1.0, 0.0, 0.0, 0.0, -1.0, 0.0), good)
    with pytest.raises(ValueError, match="no rate"):
        CellGrid(np.ones((1, 1), np.int32), [1.0], good, good)
    with pytest.raises(ValueError, match="not a rate"):
        CellGrid(np.zeros((1, 1), np.int32), [math.nan], good, good)
    with pytest.raises(ValueError, match="not both"):
        Prescription(builders.plots([[1.0]]), cells=square_cells([[0]]))
