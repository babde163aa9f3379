from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj import CRS, Transformer
from shapely import MultiPolygon, box

from companion.core.frame import LocalFrame
from companion.errors import MapError
from missions.maps.assemble import map_of
from missions.maps.cli.new import Plots, Points, make_plots, make_points
from missions.maps.fields import Given
from missions.maps.model import Grid, MapCells, MapFile, MapZone
from missions.maps.text_lattice import MERGES, cell_numbers, cell_size, layout_for, merged
from missions.maps.text_map import (
    grid_of_points,
    read_text_map,
    text_map_of,
    write_text_map,
)
from missions.maps.text_points import TextMap, parse_text_map, text_of

ORIGIN = (39.5, -0.4, 50.0)
WIDTH_M, SPEED_M_S = 5.0, 4.0
# The example of P2's figure 1, but for its count, of which only the first seven rows are shown.
FIGURE_1 = """7
39.4829175\t-0.337570611\t5.007\t10
39.4829515\t-0.337544528\t5.644\t15
39.48298286\t-0.337520667\t5.523\t20
39.48302314\t-0.337485611\t5.477\t25
39.48305181\t-0.337461\t5.401\t30
39.48308036\t-0.3374305\t5.332\t35
39.48312553\t-0.337397944\t5.226\t40
"""


@pytest.fixture(scope="module")
def folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as name:
        yield Path(name)


def text_at(
    east: list[float], north: list[float], rates: list[float], altitude: float = 0.0
) -> TextMap:
    """Return points at metres in the tangent plane of `ORIGIN`, by PROJ and not by us."""
    proj = Transformer.from_pipeline(
        "+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 "
        f"+lat_0={ORIGIN[0]} +lon_0={ORIGIN[1]} +h_0={altitude} +step +inv +proj=cart "
        "+ellps=WGS84 +step +proj=unitconvert +xy_in=rad +xy_out=deg"
    )
    longitude, latitude, height = proj.transform(east, north, [0.0] * len(east))
    return TextMap(
        latitude_deg=np.array(latitude),
        longitude_deg=np.array(longitude),
        altitude_m=np.array(height),
        rate_l_min=np.array(rates),
    )


def as_map(grid: Grid, path: Path) -> MapFile:
    asked = Given(flow_width_m=WIDTH_M, flow_speed_m_s=SPEED_M_S)
    return map_of(grid, path, rate_field=None, crs=None, given=asked)


# ------------------------------------------------------------------------------ equations 1 to 3


@pytest.mark.parametrize(
    ("points", "east_m", "north_m", "cell_m", "columns", "rows", "area_ha", "density"),
    [
        (11243, (-167.0, 147.2), (-181.1, 111.9), 3, 105, 98, 9.2, 1221),
        (2302, (-2.2, 478.1), (-28.2, 567.1), 12, 41, 50, 28.59, 80),
    ],
    ids=["vineyard", "olives"],
)
def test_published_tables_come_out(
    points: int,
    east_m: tuple[float, float],
    north_m: tuple[float, float],
    cell_m: int,
    columns: int,
    rows: int,
    area_ha: float,
    density: int,
) -> None:
    layout = layout_for(points, east_m=east_m, north_m=north_m)
    assert (layout.cell_m, layout.columns, layout.rows) == (cell_m, columns, rows)
    assert layout.table_area_ha == area_ha
    assert layout.table_points_per_ha == density
    assert layout.area_ha == pytest.approx(area_ha, abs=0.01)
    assert layout.points_per_ha == pytest.approx(density, abs=1.0)


def test_cell_is_a_whole_metre_at_least() -> None:
    assert cell_size(10.0, 10.0, 1000) == 1
    assert cell_size(0.0, 500.0, 3) == 1
    assert cell_size(30.0, 30.0, 100) == 3
    assert cell_size(30.1, 30.0, 100) == 4


def test_points_on_one_line_make_one_row() -> None:
    layout = layout_for(5, east_m=(0.0, 8.0), north_m=(3.0, 3.0))
    assert (layout.columns, layout.rows) == (8, 1)
    assert layout.table_points_per_ha is None


def test_user_cell_size_overrules_the_number_of_points() -> None:
    layout = layout_for(2302, east_m=(-2.2, 478.1), north_m=(-28.2, 567.1), cell_m=8)
    assert (layout.cell_m, layout.columns, layout.rows) == (8, 61, 75)
    with pytest.raises(ValueError, match="1 m"):
        layout_for(5, east_m=(0.0, 1.0), north_m=(0.0, 1.0), cell_m=0)


@given(
    places=st.lists(
        st.tuples(st.floats(-500.0, 500.0), st.floats(-500.0, 500.0)), min_size=1, max_size=40
    )
)
def test_every_point_lies_in_its_cell(places: list[tuple[float, float]]) -> None:
    east, north = np.array(places).T
    layout = layout_for(
        len(places),
        east_m=(float(east.min()), float(east.max())),
        north_m=(float(north.min()), float(north.max())),
    )
    for number, count, start in zip(
        cell_numbers(layout, east, north),
        (layout.columns, layout.rows),
        (east - layout.east_min_m, north - layout.north_min_m),
        strict=True,
    ):
        assert (number >= 1).all()
        assert (number <= count).all()
        assert (start <= layout.cell_m * number * (1 + 2e-6) + 1e-5).all()
        assert (start >= layout.cell_m * (number - 1) - 1e-5).all()
        # A point on an edge belongs to the west or south; one on the very first to the first.
        inner = start > 1e-5
        assert (start[inner] > layout.cell_m * (number[inner] - 1)).all()
    # Never more cells than the points call for: they fill the rectangle once.
    area_m2 = float(np.ptp(east) * np.ptp(north))
    assert layout.cell_m == 1 or area_m2 / (layout.cell_m - 1) ** 2 > len(places) * (1 - 1e-5)


def test_merges_of_points_in_one_cell() -> None:
    layout = layout_for(6, east_m=(0.0, 2.0), north_m=(0.0, 1.0))
    cells = np.array([1, 1, 1, 2, 2]), np.ones(5, dtype=np.int64)
    values = np.array([10.0, 20.0, 40.0, 0.0, 8.0])
    found = {how: merged(layout, cells, values, merge=how).tolist() for how in MERGES}
    # (10 + 20) / 2 = 15, (15 + 40) / 2 = 27.5; a cell that holds 0 counts as empty.
    assert found == {
        "max": [[40.0, 8.0]],
        "average": [[27.5, 8.0]],
        "mean": [[70.0 / 3.0, 4.0]],
    }


def test_running_average_hangs_on_the_order_and_the_mean_does_not() -> None:
    layout = layout_for(3, east_m=(0.0, 1.0), north_m=(0.0, 1.0))
    cells = np.ones(3, dtype=np.int64), np.ones(3, dtype=np.int64)
    values = np.array([10.0, 20.0, 40.0])
    for how, differs in (("average", True), ("mean", False), ("max", False)):
        forwards = merged(layout, cells, values, merge=how).item()
        backwards = merged(layout, cells, values[::-1], merge=how).item()
        assert (forwards != backwards) is differs


def test_mean_of_one_rate_is_that_rate_to_the_last_bit() -> None:
    layout = layout_for(3, east_m=(0.0, 1.0), north_m=(0.0, 1.0))
    cells = np.ones(3, dtype=np.int64), np.ones(3, dtype=np.int64)
    assert merged(layout, cells, np.full(3, 0.1), merge="mean").item() == 0.1


def test_cells_without_a_point_have_no_rate() -> None:
    points = text_at([0.5, 2.5, 2.4, 0.4], [0.5, 0.4, 2.5, 0.6], [1.0, 2.0, 3.0, 4.0])
    grid = grid_of_points(points, Path("x.txt"), cell_m=1)
    assert np.isnan(grid.rates_l_min).sum() == grid.rates_l_min.size - 3


# ------------------------------------------------------------------------------------ the reader


def test_figure_1_is_read(folder: Path) -> None:
    path = folder / "figure.txt"
    path.write_text(FIGURE_1, "utf-8")
    grid = read_text_map(path)
    (band,) = grid.bands
    assert (grid.format, band.name, band.unit, band.is_rate) == ("text-map", "rate", "L/min", True)
    # 14.86 m east, 23.10 m north: c = ceil(sqrt(343.1 / 7)) = 8, 2 columns, 3 rows, the southern
    # first; the third point, 4.29 m east and 7.25 m north, is the last in the first cell.
    np.testing.assert_array_equal(band.values, [[20.0, math.nan], [25.0, 30.0], [math.nan, 40.0]])


@pytest.mark.parametrize(
    "text",
    [
        FIGURE_1.replace("\n", "\r\n"),
        FIGURE_1.replace("\t", "  "),
        FIGURE_1 + "\n\n \t\n",
        "\ufeff" + FIGURE_1,
        FIGURE_1.replace("7\n", "7\t\t\t\n", 1),
        FIGURE_1.rstrip("\n") + "\t",
        FIGURE_1.replace("\n", "\r"),
    ],
    ids=["crlf", "spaces", "blank-end", "bom", "tabs-after-count", "tab-at-the-end", "cr"],
)
def test_writing_of_lines_does_not_matter(text: str) -> None:
    found = parse_text_map(text.encode(), Path("x.txt"))
    assert found.rate_l_min.tolist() == [10.0, 15.0, 20.0, 25.0, 30.0, 35.0, 40.0]
    assert found.latitude_deg[2] == 39.48298286
    assert found.longitude_deg[2] == -0.337520667


def row(latitude: str = "39.5000000", longitude: str = "-0.4", rest: str = "5.0\t10") -> str:
    return f"1\n{latitude}\t{longitude}\t{rest}\n"


@pytest.mark.parametrize(
    ("text", "code", "says"),
    [
        (FIGURE_1.replace("7\n", "9\n", 1), "wrong-count", "says 9 points, but 7 follow"),
        (FIGURE_1.replace("7\n", "6\n", 1), "wrong-count", "says 6 points, but 7 follow"),
        (FIGURE_1.split("\n", 1)[1], "wrong-count", "line 1 is not the number of points"),
        ("0\n", "wrong-count", "0 points"),
        ("1000001\n", "too-large", "1000001 points"),
        (row(latitude="39,5000000"), "decimal-comma", "line 2 holds a comma"),
        (row(rest="5.0\t10,5"), "decimal-comma", "line 2"),
        ("11,243\n", "decimal-comma", "line 1"),
        ("2\n39.5,-0.4,5,10\n39.6,-0.4,5,10\n", "bad-number", "line 2"),
        (row(rest="5.0\tten"), "bad-number", "line 2: 'ten' is not a number"),
        (row(rest="5.0\tnan"), "bad-number", "line 2: 'nan'"),
        (row(rest="5.0\tinf"), "bad-number", "line 2: 'inf'"),
        (row(rest="5.0\t1e999"), "bad-number", "line 2"),
        (row(rest="5.0\t1_0"), "bad-number", "line 2"),
        ("2\n1 2 3 4\n1 2 3 4 5\n", "bad-line", "line 3 has 5 numbers"),
        ("2\n1 2 3\n1 2 3 4\n", "bad-line", "line 2 has 3 numbers"),
        ("2\n1 2 3 4\n1 2 3\n", "truncated", "line 3 has 3 numbers"),
        ("7\n1 2 3 4\n1 2\n", "truncated", "the file is cut short"),
        (FIGURE_1.rstrip("\n"), "truncated", "line 8 is the last and has no line end"),
        ("", "truncated", "empty"),
        (" \n\n", "truncated", "empty"),
        (row("-104.5", "39.9"), "swapped-axes", "look exchanged"),
        (row("-104.5", "139.9"), "out-of-range", "no latitude"),
        (row("45.0", "190.0"), "out-of-range", "no longitude"),
        (row(rest="-9999\t10"), "out-of-range", "altitude"),
        (row(rest="5.0\t-1"), "bad-rate", "the rate is none"),
        ("lat lon alt rate\n1 2 3 4\n", "unknown-format", "not an open text map"),
        ("Dear grower,\n", "unknown-format", "not an open text map"),
    ],
)
def test_refused_with_its_line(text: str, code: str, says: str) -> None:
    with pytest.raises(MapError, match=r"x\.txt") as caught:
        parse_text_map(text.encode(), Path("x.txt"))
    assert caught.value.code == code
    assert says in str(caught.value)
    assert caught.value.fix


@pytest.mark.parametrize("content", ["7\n".encode("utf-16"), b"\xff\xfe\x00", b"1\n\0\n"])
def test_other_encodings_are_refused(content: bytes) -> None:
    with pytest.raises(MapError) as caught:
        parse_text_map(content, Path("x.txt"))
    assert caught.value.code == "encoding"


def test_layer_is_refused(folder: Path) -> None:
    path = folder / "layer.txt"
    path.write_text(FIGURE_1, "utf-8")
    with pytest.raises(MapError) as caught:
        read_text_map(path, "one")
    assert caught.value.code == "no-layer"


def test_stray_point_and_foreign_origin_are_refused() -> None:
    points = text_at([0.0, 150_000.0], [0.0, 0.0], [1.0, 2.0])
    with pytest.raises(MapError) as caught:
        grid_of_points(points, Path("x.txt"))
    assert caught.value.code == "too-large"
    points = text_at([0.0, 50.0], [0.0, 10.0], [1.0, 2.0])
    with pytest.raises(MapError) as caught:
        grid_of_points(points, Path("x.txt"), origin=(41.0, -0.4, 0.0))
    assert caught.value.code == "wrong-origin"
    with pytest.raises(MapError) as caught:
        grid_of_points(points, Path("x.txt"), merge="sum")
    assert caught.value.code == "merge-policy"


def test_small_cells_over_much_ground_are_refused() -> None:
    points = text_at([0.0, 5_000.0], [0.0, 5_000.0], [1.0, 2.0])
    with pytest.raises(MapError) as caught:
        grid_of_points(points, Path("x.txt"), cell_m=1)
    assert caught.value.code == "too-large"


def test_warnings_say_what_a_grower_should_know(folder: Path) -> None:
    path = folder / "warned.txt"
    path.write_text("3\n39.5 -0.4 5 12\n39.5 -0.3995 5 12\n39.504 -0.398 5 12\n", "utf-8")
    codes = {problem.code: problem for problem in read_text_map(path).problems}
    assert codes.keys() == {"few-points", "coarse-position"}
    # -0.4 may have lost its zeros; 39.504 and -0.398 show how fine the degrees are at least.
    assert "3 decimals, steps of 110 m" in codes["coarse-position"].text
    assert "points/ha" in codes["few-points"].text
    write_text_map(
        text_at([0.0, 0.2, 2.5, 2.9, 0.1], [0.0, 0.1, 0.5, 2.9, 2.5], [1.0, 2.0, 3.0, 4.0, 5.0]),
        path,
    )
    codes = {problem.code: problem for problem in read_text_map(path, cell_m=1).problems}
    assert codes.keys() == {"merged-points", "empty-cells"}
    assert "1 cells hold points of different rates; the largest" in codes["merged-points"].text
    assert "4 cells of 1 m" in codes["empty-cells"].text
    codes = {p.code: p for p in read_text_map(path, cell_m=1, merge="average").problems}
    assert "the running average" in codes["merged-points"].text


@pytest.mark.parametrize("altitude", [0.0, 640.0, 3000.0])
@pytest.mark.parametrize("origin", [None, ORIGIN, (39.6, -0.3, 0.0)])
def test_cells_lie_where_their_points_are(
    folder: Path, altitude: float, origin: tuple[float, float, float] | None
) -> None:
    """Every point's own latitude and longitude, in the grid's CRS, falls into its cell."""
    east, north = np.meshgrid(np.arange(40) * 25.0 + 3.0, np.arange(40) * 25.0 + 7.0)
    rates = np.arange(1600) % 97 + 1.0
    points = text_at(east.ravel().tolist(), north.ravel().tolist(), rates.tolist(), altitude)
    path = folder / "placed.txt"
    write_text_map(points, path)
    grid = read_text_map(path, origin=origin)
    plain = grid_of_points(points, path, origin=origin)
    a, b, c, d, e, f = grid.transform
    to_cells = np.linalg.inv(np.array([[a, b], [d, e]]))
    transformer = Transformer.from_crs(CRS.from_epsg(4326), grid.crs, always_xy=True)
    x, y = transformer.transform(points.longitude_deg, points.latitude_deg)
    column, row = to_cells @ np.array([x - c, y - f])
    plane_east, plane_north, _ = plain.plane.to_local(
        points.latitude_deg, points.longitude_deg, points.altitude_m
    )
    size = plain.layout.cell_m
    assert np.abs(column * size - (plane_east - plain.layout.east_min_m)).max() < 1e-3
    assert np.abs(row * size - (plane_north - plain.layout.north_min_m)).max() < 1e-3


def test_rates_become_litres_per_hectare_by_width_and_speed(folder: Path) -> None:
    path = folder / "rates.txt"
    path.write_text(FIGURE_1, "utf-8")
    found = as_map(read_text_map(path), path)
    # 30 L/min over 5 m at 4 m/s: 30 / (5 * 4 * 0.006) L/ha.
    assert found.rates_l_ha == pytest.approx((500 / 3, 625 / 3, 250.0, 1000 / 3))
    assert found.unit == "L/min"


# ------------------------------------------------------------------------------------ the writer


def test_file_is_the_same_bytes_every_time_and_reads_back() -> None:
    points = text_at([0.0, 30.0], [0.0, 20.0], [10.5, 0.123456789])
    text = text_of(points)
    assert text == text_of(points)
    assert text.startswith("2\n39.5000000000\t-0.4000000000\t0.000\t10.5\n")
    back = parse_text_map(text.encode(), Path("x.txt"))
    np.testing.assert_allclose(back.latitude_deg, points.latitude_deg, atol=5.1e-11)
    assert back.rate_l_min.tolist() == [10.5, 0.123456789]


def test_half_a_file_is_never_left(tmp_path: Path) -> None:
    points = text_at([0.0, 30.0], [0.0, 20.0], [1.0, 2.0])
    with pytest.raises(MapError) as caught:
        write_text_map(points, tmp_path / "none" / "x.txt")
    assert caught.value.code == "not-written"
    write_text_map(points, tmp_path / "x.txt")
    assert [file.name for file in tmp_path.iterdir()] == ["x.txt"]


def cells_map(rates: list[list[float]], cell_m: float, crs: CRS, x: float, y: float) -> MapFile:
    """Return a map in cells, the northern row first, as rasters have it."""
    values = np.array(rates)
    return MapFile(
        path=Path("cells.tif"),
        format="geotiff",
        crs="local",
        unit="L/ha",
        rate_field="rate",
        zones=(),
        sha256="",
        cells=MapCells(
            rates_l_ha=values,
            transform=(cell_m, 0.0, x, 0.0, -cell_m, y + cell_m * len(values)),
            crs=crs,
        ),
    )


@st.composite
def grids(draw: st.DrawFn) -> list[list[float]]:
    rows, columns = draw(st.integers(1, 7)), draw(st.integers(1, 7))
    rate = st.sampled_from([math.nan, 0.0, 12.34, 20.0])
    found = draw(
        st.lists(st.lists(rate, min_size=columns, max_size=columns), min_size=rows, max_size=rows)
    )
    if all(math.isnan(value) for line in found for value in line):
        found[draw(st.integers(0, rows - 1))][draw(st.integers(0, columns - 1))] = 15.0
    return found


@settings(max_examples=20)
@given(rates=grids(), cell_m=st.integers(1, 12), place=st.tuples(*[st.floats(-2e3, 2e3)] * 2))
def test_cells_of_whole_metres_come_back_as_they_were(
    folder: Path, rates: list[list[float]], cell_m: int, place: tuple[float, float]
) -> None:
    frame = LocalFrame(latitude_deg=39.5, longitude_deg=-0.4)
    source = cells_map(rates, float(cell_m), frame.crs, *place)
    path = folder / "back.txt"
    write_text_map(text_map_of(source, width_m=WIDTH_M, speed_m_s=SPEED_M_S), path)
    cells = read_text_map(path)
    litres = cells.bands[0].values / (WIDTH_M * SPEED_M_S * 0.006)
    # Looked up by PROJ in the middle of every cell of the source.
    values = np.array(rates)
    column, row = np.meshgrid(np.arange(values.shape[1]), np.arange(values.shape[0]))
    x = place[0] + cell_m * (column + 0.5)
    y = place[1] + cell_m * (len(values) - row - 0.5)
    across = Transformer.from_crs(frame.crs, cells.crs, always_xy=True)
    there = np.array(across.transform(x.ravel(), y.ravel()))
    a, b, c, d, e, f = cells.transform
    found_column, found_row = np.floor(
        np.linalg.inv(np.array([[a, b], [d, e]])) @ (there - np.array([[c], [f]]))
    ).astype(int)
    inside = (
        (found_column >= 0)
        & (found_column < litres.shape[1])
        & (found_row >= 0)
        & (found_row < litres.shape[0])
    )
    found = np.full(values.size, np.nan)
    found[inside] = litres[found_row[inside], found_column[inside]]
    np.testing.assert_allclose(found, values.ravel(), atol=1e-6)
    # Nor is there ground that had no rate, and each edge lies where it was.
    size = math.sqrt(abs(a * e - b * d))
    assert cell_m % round(size) == 0
    rated = (~np.isnan(litres)).sum() * size**2
    assert rated == pytest.approx((~np.isnan(values)).sum() * cell_m**2, rel=1e-4)


def test_own_map_written_again_is_the_same_grid(folder: Path) -> None:
    wanted = Points(
        origin=ORIGIN, count=11243, east_range_m=314.2, north_range_m=293.0,
        rate_min_l_min=10.0, rate_max_l_min=13.0, seed=1,
    )  # fmt: skip
    first, second = folder / "first.txt", folder / "second.txt"
    write_text_map(make_points(wanted), first)
    grid = read_text_map(first)
    again = text_map_of(as_map(grid, first), width_m=WIDTH_M, speed_m_s=SPEED_M_S)
    write_text_map(again, second)
    back = read_text_map(second)
    np.testing.assert_array_equal(back.bands[0].values, grid.bands[0].values)
    assert again.altitude_m[0] == pytest.approx(50.0, abs=1.0)
    for cells, other in ((grid, back), (back, grid)):
        corner = Transformer.from_crs(cells.crs, other.crs, always_xy=True).transform(
            cells.transform[2], cells.transform[5]
        )
        assert np.abs(np.array(corner) - [other.transform[2], other.transform[5]]).max() < 2e-3


def zones_map(
    zones: list[MapZone], boundary: MultiPolygon | None = None, default: float | None = None
) -> MapFile:
    return MapFile(
        path=Path("zones.geojson"), format="geojson", crs="EPSG:4326", unit="L/ha",
        rate_field="rate", zones=tuple(zones), sha256="", boundary=boundary,
        default_rate_l_ha=default,
    )  # fmt: skip


def plots() -> list[MapZone]:
    wanted = Plots(
        origin=(35.996, 114.543), rows=4, columns=10, length_m=12.0, width_m=6.0,
        rates_l_ha=(15.0, 18.5, 0.0, 21.25), angle_deg=20.0,
    )  # fmt: skip
    return list(make_plots(wanted, Path("p.geojson"), map_format="geojson").zones)


@pytest.mark.parametrize("spacing_m", [1, 2])
def test_zones_keep_their_rates_but_for_a_cell_along_their_edges(
    folder: Path, spacing_m: int
) -> None:
    source = zones_map(plots())
    path = folder / "zones.txt"
    points = text_map_of(source, width_m=WIDTH_M, speed_m_s=SPEED_M_S, spacing_m=spacing_m)
    write_text_map(points, path)
    cells = as_map(read_text_map(path), path).cells
    assert cells is not None
    a, b, c, d, e, f = cells.transform
    assert round(math.hypot(a, d)) == spacing_m
    frame = LocalFrame(latitude_deg=35.996, longitude_deg=114.543)
    into = Transformer.from_crs(CRS.from_epsg(4326), cells.crs, always_xy=True)
    checked = 0
    for zone in source.zones:
        there = np.array(into.transform(*shapely.get_coordinates(zone.geometry.centroid)[0]))
        column, row = np.floor(np.linalg.inv(np.array([[a, b], [d, e]])) @ (there - [c, f]))
        assert cells.rates_l_ha[int(row), int(column)] == pytest.approx(zone.rate_l_ha, abs=0.01)
        checked += 1
    assert checked == 40
    area = (~np.isnan(cells.rates_l_ha)).sum() * spacing_m**2
    assert area == pytest.approx(40 * 72.0, rel=0.03)
    assert frame.to_local(points.latitude_deg[0], points.longitude_deg[0])[0] > 0.0


def test_boundary_and_default_rate_are_kept(folder: Path) -> None:
    frame = LocalFrame(latitude_deg=35.996, longitude_deg=114.543)

    def ground(west: float, south: float, east: float, north: float) -> shapely.Polygon:
        corners = shapely.get_coordinates(box(west, south, east, north))
        return shapely.Polygon([frame.to_geographic(*corner)[::-1] for corner in corners])

    zone = MapZone(name="1", geometry=ground(0, 0, 10, 10), rate_l_ha=20.0)
    source = zones_map([zone], MultiPolygon([ground(5, 0, 25, 10)]), default=8.0)
    points = text_map_of(source, width_m=WIDTH_M, speed_m_s=SPEED_M_S, spacing_m=1)
    path = folder / "default.txt"
    write_text_map(points, path)
    cells = as_map(read_text_map(path), path).cells
    assert cells is not None
    values, counts = np.unique(cells.rates_l_ha[~np.isnan(cells.rates_l_ha)], return_counts=True)
    np.testing.assert_allclose(values, [8.0, 20.0], atol=1e-6)
    np.testing.assert_allclose(counts, [150, 50], atol=10)


def test_what_a_text_map_cannot_hold_is_refused() -> None:
    frame = LocalFrame(latitude_deg=39.5, longitude_deg=-0.4)
    narrow = zones_map(plots()[:1])
    with pytest.raises(MapError) as caught:
        text_map_of(narrow, width_m=WIDTH_M, speed_m_s=SPEED_M_S, spacing_m=500)
    assert caught.value.code == "null-rate"
    wide = cells_map([[1.0, 2.0]], 2000.5, frame.crs, 0.0, 0.0)
    with pytest.raises(MapError) as caught:
        text_map_of(wide, width_m=WIDTH_M, speed_m_s=SPEED_M_S, spacing_m=1)
    assert caught.value.code == "too-large"
    for wrong in ({"width_m": 0.0}, {"speed_m_s": math.nan}, {"spacing_m": 0}):
        with pytest.raises(ValueError, match=r"width|spacing"):
            text_map_of(narrow, **({"width_m": 5.0, "speed_m_s": 5.0} | wrong))  # type: ignore[arg-type]


# --------------------------------------------------------------------------------- any bytes


@given(
    changed=st.lists(st.tuples(st.floats(0.0, 1.0, exclude_max=True), st.integers(0, 255))),
    keep=st.just(1.0) | st.floats(0.0, 1.0),
    text=st.text(st.sampled_from("0123456789.,-+eE \t\r\nnaif"), max_size=20),
)
def test_any_bytes_are_read_or_refused(
    folder: Path, changed: list[tuple[float, int]], keep: float, text: str
) -> None:
    content = bytearray(FIGURE_1.encode())
    for place, byte in changed:
        content[int(place * len(content))] = byte
    place = int(keep * len(content))
    path = folder / "any.txt"
    path.write_bytes(bytes(content[:place]) + text.encode())
    try:
        as_map(read_text_map(path), path)
    except MapError as error:
        assert "\n" not in str(error)
        assert error.code != "unusable"
