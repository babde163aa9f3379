"""ISOXML that is written says the same to an independent reader as to our own."""

from __future__ import annotations

import errno
import zipfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import shapely
from isoxml.converter.np_grid import to_numpy_array
from isoxml.converter.shapely_geom import ShapelyConverterV4
from isoxml.models.ddi_entities import DDEntity
from isoxml.util.isoxml_io import isoxml_from_path
from pyproj import CRS
from shapely import MultiPolygon, box

from companion.errors import MapError
from missions.maps.crs import WGS84
from missions.maps.isoxml.reader import read_isoxml
from missions.maps.isoxml.writer import write_isoxml
from missions.maps.model import Affine, Grid, Layer, MapCells, MapFile, MapZone

WEST, SOUTH, STEP = 114.543, 35.996, 0.0005
PLACES = ["TASKDATA.XML", "map.zip", "field"]


def square(column: int, row: int = 0) -> shapely.Polygon:
    west, south = WEST + column * STEP, SOUTH + row * STEP
    return box(west, south, west + STEP, south + STEP)


HOLED = square(0).difference(square(0).buffer(-STEP / 4))
ZONES = (
    MapZone(name="Süd & <Nord>", geometry=HOLED, rate_l_ha=12.3456),
    MapZone(name="two", geometry=MultiPolygon([square(1), square(3)]), rate_l_ha=0.0),
    MapZone(name="blank", geometry=square(2), rate_l_ha=None),
)


def map_file(zones: Sequence[MapZone] = ZONES) -> MapFile:
    return MapFile(
        path=Path("north field.shp"), format="shapefile", crs="EPSG:4326", unit="L/ha",
        rate_field="rate", zones=tuple(zones), sha256="",
    )  # fmt: skip


def cell_map(
    rates: list[list[float]], transform: Affine | None = None, crs: CRS = WGS84
) -> MapFile:
    transform = transform or (STEP, 0.0, WEST, 0.0, STEP / 2, SOUTH)
    cells = MapCells(rates_l_ha=np.array(rates), transform=transform, crs=crs)
    return replace(map_file(()), cells=cells)


def back(found: MapFile, path: Path) -> Layer | Grid:
    write_isoxml(found, path)
    return read_isoxml(path)


@pytest.mark.parametrize("place", PLACES)
def test_zones_come_back_with_rates_names_and_ground(tmp_path: Path, place: str) -> None:
    found = back(map_file(), tmp_path / place)
    assert isinstance(found, Layer)
    names, rates = found.columns
    assert names.values == tuple(zone.name for zone in ZONES)
    assert rates.values == (12.3456, 0.0, None)
    assert rates.unit == "L/ha"
    for area, zone in zip(found.geometries, ZONES, strict=True):
        assert area is not None
        # 1e-9 degrees around the ring.
        assert area.symmetric_difference(zone.geometry).area < 1e-9 * zone.geometry.length
        assert len(shapely.get_parts(area)) == zone.part_count
    assert found.problems == ()
    assert found.boundary is not None
    assert found.boundary.area == pytest.approx(3 * STEP**2 + HOLED.area, rel=1e-5)


def test_zones_are_the_same_to_an_independent_reader(tmp_path: Path) -> None:
    write_isoxml(map_file(), tmp_path / "field")
    data, _ = isoxml_from_path(tmp_path / "field")
    (task,) = data.tasks
    convert = ShapelyConverterV4()
    scale = DDEntity.from_id(1).bit_resolution * 0.01  # mm3/m2 to L/ha
    special, zones = task.treatment_zones[:3], task.treatment_zones[3:]
    assert [one.code for one in special] == [0, 1, 2]
    assert (task.default_treatment_zone_code, task.position_lost_treatment_zone_code) == (0, 1)
    assert task.out_of_field_treatment_zone_code == 2
    assert [one.process_data_variables[0].process_data_value for one in special] == [0, 0, 0]
    for one, zone in zip(zones, ZONES, strict=True):
        ground = convert.to_shapely_multi_polygon(one.polygons)
        assert ground.symmetric_difference(zone.geometry).area < 1e-9 * zone.geometry.length
        values = [value.process_data_value * scale for value in one.process_data_variables]
        assert values == ([] if zone.rate_l_ha is None else [pytest.approx(zone.rate_l_ha)])
        for value in one.process_data_variables:
            assert bytes(value.process_data_ddi) == bytes((0, 1))
    (shown,) = data.value_presentations
    assert (shown.offset, float(shown.scale), shown.unit_designator) == (0, 0.0001, "l/ha")
    (field,) = data.partfields
    assert task.partfield_id_ref == field.id
    assert convert.to_shapely_multi_polygon(field.polygons).is_valid


def test_boundary_and_default_come_back(tmp_path: Path) -> None:
    boundary = MultiPolygon([box(WEST, SOUTH, WEST + 1e-2, SOUTH + 1e-2)])
    found = replace(map_file(), boundary=boundary, default_rate_l_ha=33.0)
    layer = back(found, tmp_path / "a.zip")
    assert isinstance(layer, Layer)
    assert layer.boundary is not None
    assert layer.boundary.symmetric_difference(boundary).area < 1e-9 * boundary.length
    assert layer.columns[1].default == 33.0


def test_default_without_a_boundary_holds_nowhere_and_is_not_written(tmp_path: Path) -> None:
    layer = back(replace(map_file(), default_rate_l_ha=33.0), tmp_path / "a.zip")
    assert isinstance(layer, Layer)
    assert layer.columns[1].default == 0.0


def test_more_zones_than_codes_go_by_rate(tmp_path: Path) -> None:
    zones = [
        MapZone(name=f"{i}", geometry=square(i % 40, i // 40), rate_l_ha=(None, 5.0, 7.25)[i % 3])
        for i in range(300)
    ]
    found = back(map_file(zones), tmp_path / "a.zip")
    assert isinstance(found, Layer)
    names, rates = found.columns
    assert dict(zip(names.values, rates.values, strict=True)) == {
        "no rate": None, "5 L/ha": 5.0, "7.25 L/ha": 7.25,
    }  # fmt: skip
    for area in found.geometries:
        assert area is not None
        assert area.area == pytest.approx(100 * STEP**2, rel=1e-5)


def test_more_rates_than_codes_are_refused(tmp_path: Path) -> None:
    zones = [MapZone(name=f"{i}", geometry=square(i), rate_l_ha=float(i)) for i in range(253)]
    with pytest.raises(MapError) as caught:
        write_isoxml(map_file(zones), tmp_path / "a.zip")
    assert caught.value.code == "too-many-rates"
    assert list(tmp_path.iterdir()) == []
    write_isoxml(map_file(zones[:252]), tmp_path / "a.zip")
    layer = read_isoxml(tmp_path / "a.zip")
    assert isinstance(layer, Layer)
    assert layer.columns[1].values == tuple(map(float, range(252)))


RATES = [[1.0, 2.0, np.nan], [0.0, 123.4567, 6.0]]


@pytest.mark.parametrize("place", PLACES)
def test_cells_come_back_in_their_places(tmp_path: Path, place: str) -> None:
    found = back(cell_map(RATES), tmp_path / place)
    assert isinstance(found, Grid)
    assert found.transform == (STEP, 0.0, WEST, 0.0, STEP / 2, SOUTH)
    assert found.bands[0].values.tolist() == [[1.0, 2.0, 0.0], [0.0, 123.4567, 6.0]]
    assert found.bands[0].unit == "L/ha"
    assert found.problems == ()


@pytest.mark.parametrize(("east", "north"), [(1, -1), (-1, 1), (-1, -1)])
def test_rows_from_the_north_are_turned(tmp_path: Path, east: int, north: int) -> None:
    rates = np.array(RATES)
    west = WEST if east > 0 else WEST + 3 * STEP
    south = SOUTH if north > 0 else SOUTH + STEP
    turned = rates[::north, ::east]
    found = back(
        cell_map(turned.tolist(), (east * STEP, 0.0, west, 0.0, north * STEP / 2, south)),
        tmp_path / "a.zip",
    )
    assert isinstance(found, Grid)
    np.testing.assert_allclose(
        found.transform, (STEP, 0, WEST, 0, STEP / 2, SOUTH), rtol=0, atol=1e-12
    )
    np.testing.assert_array_equal(found.bands[0].values, np.nan_to_num(rates))


def test_cells_are_the_same_to_an_independent_reader(tmp_path: Path) -> None:
    write_isoxml(cell_map(RATES), tmp_path / "field")
    data, _ = isoxml_from_path(tmp_path / "field")
    (grid,) = data.tasks[0].grids
    content = (tmp_path / "field" / "GRD00001.BIN").read_bytes()
    assert grid.filelength == len(content)
    values = to_numpy_array(content, grid, [DDEntity.from_id(1)])[:, :, 0] * 0.01
    np.testing.assert_allclose(values, [[1, 2, 0], [0, 123.4567, 6]], rtol=1e-6)
    assert float(grid.minimum_north_position) == SOUTH
    assert float(grid.minimum_east_position) == WEST
    assert (float(grid.cell_north_size), float(grid.cell_east_size)) == (STEP / 2, STEP)
    assert (grid.maximum_row, grid.maximum_column) == (2, 3)


def test_cells_without_a_rate_get_the_default_of_the_field(tmp_path: Path) -> None:
    boundary = MultiPolygon([box(WEST, SOUTH, WEST + 3 * STEP, SOUTH + STEP)])
    found = replace(cell_map(RATES), boundary=boundary, default_rate_l_ha=9.0)
    grid = back(found, tmp_path / "a.zip")
    assert isinstance(grid, Grid)
    assert grid.bands[0].values[0].tolist() == [1.0, 2.0, 9.0]
    assert grid.bands[0].default == 9.0
    assert grid.boundary is not None


@pytest.mark.parametrize(
    ("transform", "crs"),
    [
        ((10.0, 0.0, 500_000.0, 0.0, 10.0, 4_000_000.0), CRS.from_epsg(32650)),
        ((STEP, 1e-6, WEST, 0.0, STEP, SOUTH), WGS84),
    ],
    ids=["metres", "turned"],
)
def test_cells_that_no_grid_can_hold_are_refused(
    tmp_path: Path, transform: Affine, crs: CRS
) -> None:
    with pytest.raises(MapError) as caught:
        write_isoxml(cell_map(RATES, transform, crs), tmp_path / "a.zip")
    assert caught.value.code == "grid-crs"
    assert list(tmp_path.iterdir()) == []


def test_large_empty_grid_in_a_zip_is_read_again(tmp_path: Path) -> None:
    found = back(cell_map(np.zeros((500, 500)).tolist()), tmp_path / "a.zip")
    assert isinstance(found, Grid)
    assert found.bands[0].values.shape == (500, 500)


def test_zip_has_the_folder_that_terminals_look_for(tmp_path: Path) -> None:
    write_isoxml(cell_map(RATES), tmp_path / "a.zip")
    with zipfile.ZipFile(tmp_path / "a.zip") as archive:
        assert archive.namelist() == ["TASKDATA/TASKDATA.XML", "TASKDATA/GRD00001.BIN"]
        assert archive.testzip() is None
        root = ElementTree.fromstring(archive.read("TASKDATA/TASKDATA.XML"))
    assert root.attrib["VersionMajor"] == "4"


@pytest.mark.parametrize("made", [map_file(), cell_map(RATES)], ids=["zones", "cells"])
def test_same_map_makes_the_same_bytes(tmp_path: Path, made: MapFile) -> None:
    for name in ("a.zip", "b.zip"):
        write_isoxml(made, tmp_path / name)
    assert (tmp_path / "a.zip").read_bytes() == (tmp_path / "b.zip").read_bytes()


def test_grid_of_another_task_is_left_alone(tmp_path: Path) -> None:
    other = tmp_path / "grd00001.bin"
    other.write_bytes(b"other")
    with pytest.raises(MapError) as caught:
        write_isoxml(cell_map(RATES), tmp_path / "TASKDATA.XML")
    assert caught.value.code == "file-exists"
    assert other.read_bytes() == b"other"
    assert [file.name for file in tmp_path.iterdir()] == ["grd00001.bin"]


def test_map_is_written_over_its_own_files(tmp_path: Path) -> None:
    path = tmp_path / "TASKDATA.XML"
    write_isoxml(cell_map(RATES), path)
    found = back(cell_map([[5.0]]), path)
    assert isinstance(found, Grid)
    assert found.bands[0].values.tolist() == [[5.0]]
    assert sorted(file.name for file in tmp_path.iterdir()) == ["GRD00001.BIN", "TASKDATA.XML"]


def test_a_folder_that_cannot_be_written_whole_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(self: Path, target: Path) -> Path:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "rename", full)
    with pytest.raises(MapError) as caught:
        write_isoxml(cell_map(RATES), tmp_path / "field")
    assert caught.value.code == "not-written"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("place", ["nowhere/TASKDATA.XML", "nowhere/a.zip", "nowhere/field"])
def test_folder_that_is_not_there_is_one_line(tmp_path: Path, place: str) -> None:
    with pytest.raises(MapError) as caught:
        write_isoxml(cell_map(RATES), tmp_path / place)
    assert caught.value.code == "not-written"


def test_other_suffix_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MapError) as caught:
        write_isoxml(map_file(), tmp_path / "map.tif")
    assert caught.value.code == "unknown-format"
