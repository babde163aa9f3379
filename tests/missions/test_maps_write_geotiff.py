"""Written GeoTIFF and DJI packages, read by GDAL and by our own readers."""

from __future__ import annotations

import sys
import zipfile
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import rasterio
import shapely
from pyproj import CRS
from shapely import MultiPolygon, Polygon, box

from companion.errors import MapError
from missions.maps.assemble import map_of
from missions.maps.fields import Given
from missions.maps.geotiff import read_dji, read_geotiff, write_dji, write_geotiff
from missions.maps.model import Affine, Grid, MapCells

WEST, NORTH, WIDTH, HEIGHT = 114.5, 36.0, 1.1e-5, 0.9e-5
NORTH_UP: Affine = (WIDTH, 0.0, WEST, 0.0, -HEIGHT, NORTH)
RATES = np.array([[12.345, 0.0, np.nan], [99_999.0, 22.5, 0.01]])
WGS84 = CRS.from_epsg(4326)
CELLS = MapCells(rates_l_ha=RATES, transform=NORTH_UP, crs=WGS84)
OUTER = box(WEST, NORTH - 2 * HEIGHT, WEST + 3 * WIDTH, NORTH)
FIELD = MultiPolygon(
    [
        Polygon(OUTER.exterior, [OUTER.buffer(-HEIGHT / 2).exterior]),
        box(WEST + 4 * WIDTH, NORTH - HEIGHT, WEST + 5 * WIDTH, NORTH),
    ]
)


def check(grid: Grid) -> None:
    found = map_of(grid, Path("rx.tif"), rate_field=None, crs=None, given=Given())
    assert (found.unit, found.problems) == ("L/ha", ())
    assert found.cells is not None
    np.testing.assert_allclose(found.cells.rates_l_ha, RATES, atol=0.01)
    assert found.cells.transform == pytest.approx(NORTH_UP, abs=1e-13)


def test_gdal_reads_the_rates_where_they_were(tmp_path: Path) -> None:
    path = tmp_path / "rx.tif"
    write_geotiff(CELLS, path)
    with rasterio.open(path) as found:
        assert found.crs.to_epsg() == 4326
        assert (found.count, found.dtypes, found.nodata) == (1, ("float32",), -9999.0)
        assert (found.descriptions, found.units) == (("rate",), ("L/ha",))
        assert found.transform[:6] == pytest.approx(NORTH_UP, abs=1e-15)
        values = found.read(1, masked=True)
        np.testing.assert_array_equal(values.mask, np.isnan(RATES))
        np.testing.assert_allclose(values.compressed(), RATES[~np.isnan(RATES)], atol=0.01)
        assert values[0, 1] == 0.0
        # Where a person would look for 22.5: in the middle of row 2, column 2.
        place = (WEST + 1.5 * WIDTH, NORTH - 1.5 * HEIGHT)
        assert next(found.sample([place]))[0] == 22.5


def test_our_reader_reads_them_back_without_a_word(tmp_path: Path) -> None:
    write_geotiff(CELLS, tmp_path / "rx.tif")
    check(read_geotiff(tmp_path / "rx.tif"))


def test_the_world_file_has_the_centre_of_the_first_cell(tmp_path: Path) -> None:
    write_geotiff(CELLS, tmp_path / "rx.tif")
    lines = [float(line) for line in (tmp_path / "rx.tfw").read_text("ascii").split()]
    expected = [WIDTH, 0.0, 0.0, -HEIGHT, WEST + WIDTH / 2, NORTH - HEIGHT / 2]
    assert lines == pytest.approx(expected, abs=1e-13)
    with rasterio.Env(GDAL_GEOREF_SOURCES="WORLDFILE"), rasterio.open(tmp_path / "rx.tif") as found:
        assert found.transform[:6] == pytest.approx(NORTH_UP, abs=1e-13)


def test_cells_with_the_south_first_are_turned_over(tmp_path: Path) -> None:
    upward = (WIDTH, 0.0, WEST, 0.0, HEIGHT, NORTH - 2 * HEIGHT)
    cells = MapCells(rates_l_ha=RATES[::-1], transform=upward, crs=WGS84)
    write_geotiff(cells, tmp_path / "rx.tif")
    check(read_geotiff(tmp_path / "rx.tif"))


def test_other_cells_for_dji_are_a_mistake_of_the_caller(tmp_path: Path) -> None:
    turned = (WIDTH, 1e-6, WEST, 0.0, -HEIGHT, NORTH)
    for cells in (
        MapCells(rates_l_ha=RATES, transform=turned, crs=WGS84),
        MapCells(rates_l_ha=RATES, transform=NORTH_UP, crs=CRS.from_epsg(32650)),
    ):
        with pytest.raises(ValueError, match="longitude and latitude"):
            write_dji(cells, tmp_path / "rx")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["field", "field.zip"])
def test_a_dji_package_keeps_rates_and_boundary(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    write_dji(CELLS, path, FIELD)
    grid = read_dji(path)
    assert grid.format == "dji"
    check(grid)
    assert grid.boundary is not None
    assert grid.boundary.symmetric_difference(FIELD).area < 1e-20


def test_the_package_is_laid_out_as_dji_does_it(tmp_path: Path) -> None:
    write_dji(CELLS, tmp_path / "field.zip", FIELD)
    with zipfile.ZipFile(tmp_path / "field.zip") as archive:
        assert archive.namelist() == [
            *(f"DJI/Rx/field.{end}" for end in ("tfw", "tif")),
            *(f"DJI/ShapeFile/field.{end}" for end in ("dbf", "prj", "shp", "shx")),
        ]
        archive.extractall(tmp_path / "out")
    layer = tmp_path / "out/DJI/ShapeFile/field.shp"
    meta, _, geometry, _ = pyogrio.raw.read(str(layer))
    assert meta["crs"] == "EPSG:4326"
    assert len(geometry) == 1
    assert shapely.from_wkb(geometry[0]).symmetric_difference(FIELD).area < 1e-20
    write_dji(CELLS, tmp_path / "bare")
    assert sorted(file.name for file in (tmp_path / "bare/DJI").iterdir()) == ["Rx"]


def test_two_runs_write_the_same_bytes(tmp_path: Path) -> None:
    for run in ("a", "b"):
        (tmp_path / run).mkdir()
        write_geotiff(CELLS, tmp_path / run / "rx.tif")
        write_dji(CELLS, tmp_path / run / "field.zip", FIELD)
    for name in ("rx.tif", "rx.tfw", "field.zip"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    with zipfile.ZipFile(tmp_path / "a/field.zip") as archive:
        table = archive.read("DJI/ShapeFile/field.dbf")
    assert table[1:4] == bytes([100, 1, 1])  # 1 January 2000, whenever it is written


def test_nothing_is_left_where_nothing_can_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("", "ascii")
    for write in (write_geotiff, write_dji):
        with pytest.raises(MapError) as caught:
            write(CELLS, tmp_path / "file" / "rx.tif")
        assert caught.value.code == "not-written"
    assert [one.name for one in tmp_path.iterdir()] == ["file"]


def test_without_rasterio_the_extra_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rasterio", None)
    with pytest.raises(MapError, match=r"vrspray\[office\]") as caught:
        write_geotiff(CELLS, tmp_path / "rx.tif")
    assert caught.value.code == "missing-library"
    assert list(tmp_path.iterdir()) == []
