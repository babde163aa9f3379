from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj import CRS, Transformer
from shapely import box

from companion.errors import MapError
from missions.maps.assemble import map_of
from missions.maps.csv_points import find_lattice
from missions.maps.csvfile import read_csv
from missions.maps.fields import Given
from missions.maps.model import Grid, Layer
from missions.maps.registry import read_map

WEST, SOUTH = 114.543, 35.996


@pytest.fixture(scope="module")
def folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as name:
        yield Path(name)


def write(folder: Path, text: str, name: str = "map.csv") -> Path:
    path = folder / name
    path.write_text(text, "utf-8", newline="")
    return path


def grid_of(path: Path) -> Grid:
    found = read_csv(path)
    assert isinstance(found, Grid)
    return found


def layer_of(path: Path) -> Layer:
    found = read_csv(path)
    assert isinstance(found, Layer)
    return found


def points_text(
    latitude: np.ndarray[tuple[int], np.dtype[np.float64]],
    longitude: np.ndarray[tuple[int], np.dtype[np.float64]],
    rates: np.ndarray[tuple[int], np.dtype[np.float64]],
    decimals: int = 8,
) -> str:
    lines = [
        f"{lat:.{decimals}f},{lon:.{decimals}f},{rate:g}"
        for lat, lon, rate in zip(latitude.flat, longitude.flat, rates.flat, strict=True)
    ]
    return "\n".join(["lat,lon,rate", *lines, ""])


def value_at(grid: Grid, latitude: float, longitude: float, band: int = 0) -> float:
    """Return what a grid holds at a place, by PROJ and the inverse of its transform."""
    crs = grid.crs or CRS.from_epsg(32650)
    into = Transformer.from_crs(CRS.from_epsg(4326), crs, always_xy=True)
    x, y = into.transform(longitude, latitude)
    a, b, c, d, e, f = grid.transform
    column, row = np.linalg.inv(np.array([[a, b], [d, e]])) @ np.array([x - c, y - f])
    values = grid.bands[band].values
    assert 0.0 <= column < values.shape[1]
    assert 0.0 <= row < values.shape[0]
    # Points stand in the middles of their cells.
    assert abs(column % 1.0 - 0.5) < 0.13
    assert abs(row % 1.0 - 0.5) < 0.13
    return float(values[int(row), int(column)])


# ---------------------------------------------------------------------------------------- points


@pytest.mark.parametrize("decimals", [5, 8])
def test_points_on_a_lattice_of_degrees_are_its_cells(folder: Path, decimals: int) -> None:
    row, column = np.meshgrid(np.arange(20), np.arange(30), indexing="ij")
    latitude, longitude = SOUTH + row * 1e-4, WEST + column * 2e-4
    path = write(folder, points_text(latitude, longitude, 10.0 * row + column, decimals))
    grid = grid_of(path)
    assert grid.format == "csv"
    assert grid.crs == CRS.from_epsg(4326)
    np.testing.assert_allclose(
        grid.transform, [2e-4, 0.0, WEST - 1e-4, 0.0, 1e-4, SOUTH - 0.5e-4], atol=1e-9
    )
    np.testing.assert_array_equal(grid.bands[0].values, 10.0 * row + column)
    assert grid.problems == ()


@pytest.mark.parametrize("angle", [0.0, 17.0, 45.0, 88.0, 130.0, 250.0])
def test_turned_lattice_in_metres_with_gaps_gives_every_point_its_cell(
    folder: Path, angle: float
) -> None:
    u, v = np.meshgrid(np.arange(60) * 10.0, np.arange(40) * 6.0)
    turn = math.radians(angle)
    x = 280_000.0 + u * math.cos(turn) - v * math.sin(turn)
    y = 3_986_000.0 + u * math.sin(turn) + v * math.cos(turn)
    kept = np.random.default_rng(7).permutation(x.size)[:900]
    back = Transformer.from_crs(32650, 4326, always_xy=True)
    longitude, latitude = (values[kept] for values in back.transform(x.ravel(), y.ravel()))
    rates = np.arange(900.0)
    grid = grid_of(write(folder, points_text(latitude, longitude, rates)))
    assert grid.problems == ()
    values = grid.bands[0].values
    assert (~np.isnan(values)).sum() == 900
    assert sorted(values.shape) == [40, 60]
    for index in range(0, 900, 50):
        assert value_at(grid, latitude[index], longitude[index]) == index
    # The cells are 10 m by 6 m, but for the scale of UTM (a thousandth here).
    a, b, _, d, e, _ = grid.transform
    assert a > 0.0
    assert e > 0.0
    if not (grid.crs or CRS.from_epsg(4326)).is_geographic:
        sides = sorted((math.hypot(a, d), math.hypot(b, e)))
        assert sides == pytest.approx([6.0, 10.0], rel=2e-3)


def test_projected_coordinates_leave_the_crs_to_the_operator(folder: Path) -> None:
    text = "easting;northing;rate\n" + "".join(
        f"{280_000 + 5 * i};{3_986_000 + 5 * j};{i + 10 * j}\n" for i in range(4) for j in range(3)
    )
    path = write(folder, text)
    grid = grid_of(path)
    assert grid.crs is None
    assert grid.transform == pytest.approx((5.0, 0.0, 279_997.5, 0.0, 5.0, 3_985_997.5))
    assert grid.bands[0].values.tolist() == [[0, 1, 2, 3], [10, 11, 12, 13], [20, 21, 22, 23]]
    with pytest.raises(MapError) as caught:
        map_of(grid, path, rate_field=None, crs=None, given=Given(unit="L/ha"))
    assert caught.value.code == "no-crs"
    found = map_of(grid, path, rate_field=None, crs="EPSG:32650", given=Given(unit="L/ha"))
    assert found.cells is not None
    assert found.rates_l_ha[-1] == 23.0


def test_points_without_order_become_cells_with_a_warning(folder: Path) -> None:
    random = np.random.default_rng(3)
    latitude = SOUTH + random.random(300) * 3e-3
    longitude = WEST + random.random(300) * 3e-3
    grid = grid_of(write(folder, points_text(latitude, longitude, np.arange(300.0))))
    (problem,) = grid.problems
    assert problem.code == "irregular-points"
    a, _, _, d, _, _ = grid.transform
    assert math.hypot(a, d) == pytest.approx(18.0, abs=0.01)
    assert "300 points stand on no lattice" in problem.text
    assert "cells of 18 m" in problem.text
    values = grid.bands[0].values
    assert f"{np.isnan(values).sum()} of {values.size} cells hold none" in problem.text


def test_mean_of_points_leaves_out_blanks(folder: Path) -> None:
    random = np.random.default_rng(3)
    lines = [
        f"{SOUTH + lat * 1e-4:.9f},{WEST + lon * 1e-4:.9f},{value}"
        for lat, lon, value in zip(
            random.random(6), random.random(6), ["1", "", "3", "NA", "8", ""], strict=True
        )
    ]
    grid = grid_of(write(folder, "\n".join(["lat,lon,rate", *lines, ""])))
    assert grid.problems[0].code == "irregular-points"
    values = grid.bands[0].values
    assert np.nansum(values) == pytest.approx(12.0)


def test_irregular_projected_points_need_metres(folder: Path) -> None:
    random = np.random.default_rng(5)

    def text(offset: float) -> str:
        rows = [f"{offset + x:.2f},{offset + y:.2f},5" for x, y in random.random((40, 2)) * 90.0]
        return "\n".join(["x,y,rate", *rows, ""])

    grid = grid_of(write(folder, text(500_000.0)))
    assert grid.crs is None
    assert grid.problems[0].code == "irregular-points"
    with pytest.raises(MapError) as caught:
        read_csv(write(folder, text(0.0)))
    assert caught.value.code == "irregular-points"


def test_one_row_of_points_is_no_lattice(folder: Path) -> None:
    text = "lat,lon,rate\n" + "".join(f"{SOUTH},{WEST + i * 1e-4:.7f},5\n" for i in range(10))
    assert grid_of(write(folder, text)).problems[0].code == "irregular-points"


def test_two_points_in_one_place_are_no_lattice() -> None:
    square = np.array([(i * 1.0, j * 1.0) for i in range(4) for j in range(4)])
    assert find_lattice(square) is not None
    assert find_lattice(np.vstack([square, square[:1]])) is None
    assert find_lattice(np.vstack([square, square[:1] + 0.4])) is None


@given(
    size=st.tuples(st.integers(2, 12), st.integers(2, 12)),
    steps=st.tuples(st.floats(0.5, 30.0), st.floats(0.5, 30.0)),
    angle=st.floats(-math.pi, math.pi),
    shift=st.tuples(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6)),
    seed=st.integers(0, 10_000),
)
def test_any_lattice_is_found_and_every_point_in_the_middle_of_its_cell(
    size: tuple[int, int],
    steps: tuple[float, float],
    angle: float,
    shift: tuple[float, float],
    seed: int,
) -> None:
    u, v = np.meshgrid(np.arange(size[0]) * steps[0], np.arange(size[1]) * steps[1])
    turn = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
    points = np.column_stack([u.ravel(), v.ravel()]) @ turn + np.array(shift)
    points = np.random.default_rng(seed).permutation(points)
    found = find_lattice(points)
    assert found is not None
    assert sorted((found.rows, found.columns)) == sorted(size)
    a, b, c, d, e, f = found.transform
    x = a * (found.column + 0.5) + b * (found.row + 0.5) + c
    y = d * (found.column + 0.5) + e * (found.row + 0.5) + f
    np.testing.assert_allclose(np.column_stack([x, y]), points, atol=1e-6)
    assert a * e - b * d > 0.0


# --------------------------------------------------------------------------------------- columns


SQUARE = [(0, 0), (0, 1), (1, 0), (1, 1)]


def square(header: str, *rest: str, delimiter: str = ",") -> str:
    """Return four points on a square with the fields of `rest` after latitude and longitude."""
    rows = [
        delimiter.join([f"{SOUTH + i * 1e-4:.7f}", f"{WEST + j * 1e-4:.7f}", field])
        for (i, j), field in zip(SQUARE, rest, strict=True)
    ]
    return "\n".join([header, *rows, ""])


@pytest.mark.parametrize(
    "header",
    [
        "lat,lon,rate",
        "Latitude,Longitude,rate",
        "LAT_DEG,LNG,rate",
        '"lat","long","rate"',
        "\ufeff lat , lon , rate ",
    ],
)
def test_names_of_columns_are_understood(folder: Path, header: str) -> None:
    grid = grid_of(write(folder, square(header, "1", "2", "3", "4")))
    assert [band.name for band in grid.bands] == ["rate"]
    assert grid.bands[0].values.tolist() == [[1.0, 2.0], [3.0, 4.0]]


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_delimiter_follows_from_the_header(folder: Path, delimiter: str, end: str) -> None:
    text = square(f"lat{delimiter}lon{delimiter}rate", "1.5", "2", " 3", "4e0", delimiter=delimiter)
    grid = grid_of(write(folder, text.replace("\n", end)))
    assert grid.bands[0].values.tolist() == [[1.5, 2.0], [3.0, 4.0]]


def test_every_column_of_numbers_is_a_band_and_blanks_are_none(folder: Path) -> None:
    text = square("lat,lon,rate,zone,crop", "1,7,wheat", ",8,wheat", "NaN,9,", "4,10,oats")
    grid = grid_of(write(folder, text))
    assert [band.name for band in grid.bands] == ["rate", "zone"]
    np.testing.assert_array_equal(grid.bands[0].values, [[1.0, math.nan], [math.nan, 4.0]])
    found = map_of(grid, Path("m.csv"), rate_field=None, crs=None, given=Given(unit="L/ha"))
    assert found.rate_field == "rate"
    assert found.rates_l_ha == (1.0, 4.0)


def test_units_are_taken_from_their_columns(folder: Path) -> None:
    text = square("lat,lon,rate,unit", "1,gal/ac", "2,gal/ac", ",", "4,gal/ac")
    assert read_map(write(folder, text)).unit == "gal/ac"
    text = square("lat,lon,rate,dose,dose_unit", "1,5,L/ha", "2,5,L/ha", "3,5,L/ha", "4,5,L/ha")
    assert read_map(write(folder, text), rate_field="dose").unit == "L/ha"
    with pytest.raises(MapError) as caught:
        read_map(write(folder, text), rate_field="rate")
    assert caught.value.code == "no-unit"
    text = square("lat,lon,rate,unit", "1,gal/ac", "2,L/ha", "3,L/ha", "4,L/ha")
    with pytest.raises(MapError) as caught:
        read_map(write(folder, text))
    assert caught.value.code == "unit-conflict"


@pytest.mark.parametrize(
    ("text", "code", "says"),
    [
        (
            square("lat;lon;rate", "1,5", "2", "3", "4", delimiter=";"),
            "decimal-comma",
            "line 2: rate is '1,5'",
        ),
        ("lat;lon;rate\n35,996;114,543;5\n35,997;114,543;5\n", "decimal-comma", "line 2"),
        ('lat,lon,rate\n"35,996","114,543",5\n', "decimal-comma", "line 2"),
        ("lat,lon,rate\n35,996,114,543,5\n", "bad-line", "line 2 has 5 fields, the header 3"),
        ("lat,lon,rate\n35.9,114.5,5\n35.9,114.5\n", "bad-line", "line 3 has 2 fields"),
        ("lat,lon,rate\n35.9,,5\n", "bad-number", "line 2: lon is ''"),
        ("lat,lon,rate\n35.9,114.5,5\nx,114.5,5\n", "bad-number", "line 3: lat is 'x'"),
        ("lat,lon,rate\n35.9,114.5,5\n35.9,114.5,1e999\n", "bad-number", "line 3"),
        ("lat,lon,rate\n114.5,35.9,5\n", "swapped-axes", "look exchanged"),
        ("lat,lon,rate\n3986000,280000,5\n", "out-of-range", "line 2"),
        ("lat,lon,rate\n", "truncated", "no rows"),
        ("", "no-coordinates", "the file is empty"),
        ("36.0,114.5,5\n36.0,114.6,5\n", "no-coordinates", "is not a header"),
        ("plot,rate\n1,5\n", "no-coordinates", "plot, rate"),
        ("lat,latitude,rate\n1,5,6\n", "no-coordinates", "no columns say where"),
        ("lat,lon,rate,rate\n36.0,114.5,5,6\n", "duplicate-column", "rate is there 2 times"),
        (square("lat,lon,crop", "a", "b", "c", "d"), "no-rate-column", "no column but those"),
        ('lat,lon,rate\n36.0,114.5,"5\n', "truncated", "not a whole CSV file"),
        ("lat,lon,rate" + ",a" * 300 + "\n", "too-large", "303 columns"),
    ],
)
def test_refused_with_its_line(folder: Path, text: str, code: str, says: str) -> None:
    with pytest.raises(MapError, match=r"map\.csv") as caught:
        read_csv(write(folder, text))
    assert caught.value.code == code
    assert says in str(caught.value)
    assert caught.value.fix


@pytest.mark.parametrize("cell", ["inf", "0x10", "1_0", "abc", "5 L/ha"])
@pytest.mark.parametrize("header", ["lat,lon,rate", "lat,lon,rate,zone", "lat,lon,plain"])
def test_one_bad_cell_among_numbers_is_named(folder: Path, cell: str, header: str) -> None:
    rest = ",1" if header.endswith("zone") else ""
    text = square(header, f"1{rest}", f"2.5{rest}", f"{cell}{rest}", rest)
    with pytest.raises(MapError) as caught:
        read_csv(write(folder, text))
    name = header.split(",")[2]
    assert caught.value.code == "bad-number"
    assert f"line 4: {name} is {cell!r}, which is not a number" in str(caught.value)


def test_one_bad_cell_beside_polygons_is_named(folder: Path) -> None:
    text = wkt(ground(0).wkt, ground(1).wkt, ground(2).wkt).replace(";2\n", ";0x10\n")
    with pytest.raises(MapError, match="line 3: rate is '0x10'") as caught:
        read_csv(write(folder, text))
    assert caught.value.code == "bad-number"


def test_labels_may_have_letters_and_columns_of_text_are_none_of_numbers(folder: Path) -> None:
    text = square("lat,lon,rate,plot,target", "1,101,a", "2,102,b", "3,103B,1", "4,104,2")
    assert [band.name for band in grid_of(write(folder, text)).bands] == ["rate"]


def test_a_byte_of_another_encoding_is_named_with_the_way_out(folder: Path) -> None:
    path = folder / "map.csv"
    path.write_bytes("lat;lon;Rate\n52.1;13.1;20\n52.1;13.1;größer\n".encode("cp1252"))
    with pytest.raises(MapError) as caught:
        read_csv(path)
    assert "byte 0xF6 in line 3" in str(caught.value)
    assert "iconv -f WINDOWS-1252 -t UTF-8" in str(caught.value.fix)


@pytest.mark.parametrize("content", ["lat,lon\n".encode("utf-16"), "lat,lon,Dosé".encode("cp1252")])
def test_other_encodings_are_refused(folder: Path, content: bytes) -> None:
    path = folder / "encoded.csv"
    path.write_bytes(content)
    with pytest.raises(MapError) as caught:
        read_csv(path)
    assert caught.value.code == "encoding"


def test_layer_is_refused(folder: Path) -> None:
    with pytest.raises(MapError) as caught:
        read_csv(write(folder, square("lat,lon,rate", "1", "2", "3", "4")), "one")
    assert caught.value.code == "no-layer"


# -------------------------------------------------------------------------------------- polygons


def ground(index: int) -> shapely.Polygon:
    west = WEST + index * 1e-3
    return box(west, SOUTH, west + 1e-3, SOUTH + 1e-3)


def test_polygons_as_gdal_writes_them_are_read(folder: Path) -> None:
    path = folder / "gdal.csv"
    holed = ground(0).difference(ground(0).buffer(-2e-4))
    several = shapely.MultiPolygon([ground(2), ground(4)])
    pyogrio.raw.write(
        str(path),
        np.array([shapely.to_wkb(one) for one in (holed, ground(1), several)], dtype=object),
        [np.array([12.5, 0.0, np.nan]), np.array(["a", "b", "c"], dtype=object)],
        ["rate_l_ha", "name"],
        geometry_type="Unknown",
        crs="EPSG:4326",
        driver="CSV",
        layer_options={"GEOMETRY": "AS_WKT"},
    )
    layer = layer_of(path)
    assert layer.crs == CRS.from_epsg(4326)
    for found, expected in zip(layer.geometries, (holed, ground(1), several), strict=True):
        assert found is not None
        assert found.symmetric_difference(expected).area < 1e-15
    found_map = map_of(layer, path, rate_field=None, crs=None, given=Given())
    assert [(zone.name, zone.rate_l_ha) for zone in found_map.zones] == [
        ("a", 12.5),
        ("b", 0.0),
        ("c", None),
    ]


def wkt(*texts: str, header: str = "wkt;rate") -> str:
    return "\n".join([header, *(f'"{text}";{i + 1}' for i, text in enumerate(texts)), ""])


def test_what_is_no_ground_is_left_out_with_its_reason(folder: Path) -> None:
    text = wkt(ground(0).wkt, "POINT (1 2)", "", "POLYGON EMPTY", f"SRID=4326;{ground(1).wkt}")
    with pytest.raises(MapError) as caught:
        read_csv(write(folder, text))
    assert caught.value.code == "wrong-crs"
    layer = layer_of(write(folder, text.replace("SRID=4326;", "")))
    assert layer.skipped == {1: "not-a-polygon:POINT", 2: "null-geometry", 3: "no-area"}
    assert [area is not None for area in layer.geometries] == [True, False, False, False, True]


def test_srid_says_the_crs_and_large_numbers_leave_it_open(folder: Path) -> None:
    metres = box(280_000, 3_986_000, 280_100, 3_986_100).wkt
    layer = layer_of(write(folder, wkt(f"SRID=32650;{metres}")))
    assert layer.crs == CRS.from_epsg(32650)
    assert layer_of(write(folder, wkt(metres))).crs is None
    assert layer_of(write(folder, wkt(f"srid=0; {ground(0).wkt.lower()}"))).crs == 4326


def test_heights_of_corners_are_dropped(folder: Path) -> None:
    layer = layer_of(write(folder, wkt(shapely.force_3d(ground(0), 7.0).wkt)))
    (area,) = layer.geometries
    assert area is not None
    assert not area.has_z


@pytest.mark.parametrize(
    "text",
    ["POLYGON ((1 2, 3", "POLYGON ((0 0, 1 1))", "POLYGON ((nan 0, 1 1, 2 0, nan 0))",
     "POLYGON ((0 0, 1e300 1, 2 0, 0 0))", "MULTIPOLYGON (7)"],
)  # fmt: skip
def test_broken_polygons_are_refused(folder: Path, text: str) -> None:
    with pytest.raises(MapError) as caught:
        read_csv(write(folder, wkt(ground(0).wkt, text)))
    assert caught.value.code == "broken-geometry"
    assert "line 3" in str(caught.value)


def test_nested_collections_are_never_parsed(folder: Path) -> None:
    deep = "GEOMETRYCOLLECTION(" * 50_000
    layer = layer_of(write(folder, wkt(ground(0).wkt, deep)))
    assert layer.skipped == {1: "not-a-polygon:GEOMETRYCOLLECTION"}


def test_geometry_of_points_gives_way_to_latitude_and_longitude(folder: Path) -> None:
    text = square("lat,lon,rate,geometry", *(f"{i},POINT (0 {i})" for i in range(4)))
    assert grid_of(write(folder, text)).bands[0].values.tolist() == [[0.0, 1.0], [2.0, 3.0]]


def test_large_polygon_is_one_field_and_the_limit_of_csv_is_as_before(folder: Path) -> None:
    import csv

    before = csv.field_size_limit()
    circle = shapely.Point(WEST, SOUTH).buffer(1e-3, quad_segs=5000)
    layer = layer_of(write(folder, wkt(circle.wkt)))
    (area,) = layer.geometries
    assert area is not None
    assert shapely.get_num_coordinates(area) == 20_001
    assert len(circle.wkt) > before
    assert csv.field_size_limit() == before


# ------------------------------------------------------------------------------------ any bytes


SOUND = (
    square("lat,lon,rate,unit", "1,L/ha", "2.5,L/ha", ",L/ha", "4,L/ha"),
    wkt(ground(0).wkt, ground(1).wkt, "", "POINT (1 2)"),
    "easting;northing;rate_l_ha\n500000;4000000;1\n500010;4000000;2\n500000;4000010;3\n",
)


@settings(max_examples=150)
@given(
    which=st.integers(0, len(SOUND) - 1),
    changed=st.lists(
        st.tuples(st.floats(0.0, 1.0, exclude_max=True), st.integers(0, 255)), max_size=6
    ),
    keep=st.just(1.0) | st.floats(0.0, 1.0),
    text=st.text(st.sampled_from('0123456789.,;-+eE \t\r\n"naifPOLYGON()'), max_size=20),
)
def test_any_bytes_are_read_or_refused(
    folder: Path, which: int, changed: list[tuple[float, int]], keep: float, text: str
) -> None:
    content = bytearray(SOUND[which].encode())
    for place, byte in changed:
        content[int(place * len(content))] = byte
    path = folder / "any.csv"
    path.write_bytes(bytes(content[: int(keep * len(content))]) + text.encode())
    try:
        read_csv(path)
    except MapError as error:
        assert "\n" not in str(error)
        assert error.code != "unusable"
