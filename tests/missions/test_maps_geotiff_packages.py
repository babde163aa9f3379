"""GeoTIFF in DJI's package, and rasters of the ADAPT Standard."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import pytest
import rasterio
import shapely
from shapely import MultiPolygon, box

from companion.errors import MapError
from missions.maps.assemble import map_of
from missions.maps.fields import Given
from missions.maps.geotiff import read_dji, read_geotiff
from missions.maps.model import Grid
from missions.maps.registry import read_adapt
from tests.missions.geotiff_files import CELL, NORTH, RATES, WEST, codes, refused, tfw, write

# --- DJI's package ---

FIELD = MultiPolygon([box(WEST, NORTH - 2 * CELL, WEST + 2 * CELL, NORTH)])


def package(folder: Path, *, root: str = "DJI", rx: str = "Rx", shape: str = "ShapeFile") -> Path:
    """Make a package with GDAL."""
    (folder / root / rx).mkdir(parents=True)
    (folder / root / shape).mkdir()
    tfw(write(folder / root / rx / "field.tif", nodata=-9999))
    pyogrio.raw.write(
        str(folder / root / shape / "field.shp"),
        np.array([shapely.to_wkb(FIELD)], dtype=object), [np.array(["a"], dtype=object)], ["name"],
        geometry_type="Polygon", crs="EPSG:4326", driver="ESRI Shapefile",
    )  # fmt: skip
    return folder


def zipped(folder: Path) -> Path:
    path = folder.with_suffix(".zip")
    with zipfile.ZipFile(path, "w") as archive:
        for file in sorted(folder.rglob("*")):
            if file.is_file():
                archive.write(file, file.relative_to(folder).as_posix())
    return path


@pytest.mark.parametrize("names", [{}, {"root": ""}, {"rx": "RX", "shape": "shapefile"}])
def test_a_dji_package_has_rates_and_a_boundary(tmp_path: Path, names: dict[str, str]) -> None:
    folder = package(tmp_path / "package", **names)
    grids = [read_dji(folder), read_dji(zipped(folder))]
    for grid in grids:
        assert (grid.format, codes(grid)) == ("dji", [])
        np.testing.assert_array_equal(grid.bands[0].values, RATES)
        assert grid.boundary is not None
        assert grid.boundary.symmetric_difference(FIELD).area < 1e-15
    assert grids[0].sha256 == grids[1].sha256
    assert grids[0].sha256 != read_geotiff(next(folder.rglob("*.tif"))).sha256


def test_several_maps_in_a_dji_package_need_a_choice(tmp_path: Path) -> None:
    folder = package(tmp_path / "package")
    write(folder / "DJI/Rx/other.tif", RATES + 1)
    assert "field, other" in refused("several-layers", folder, read_dji)
    assert read_dji(folder, "other").bands[0].values[0, 0] == 13.5
    refused("no-layer", folder, read_dji, layer="third")


def test_the_boundary_named_as_the_map_is_taken(tmp_path: Path) -> None:
    folder = package(tmp_path / "package")
    for file in (folder / "DJI/ShapeFile").glob("field.*"):
        file.with_stem("other").write_bytes(file.read_bytes())
    assert read_dji(folder).boundary is not None
    for file in (folder / "DJI/ShapeFile").glob("field.*"):
        file.rename(file.with_stem("third"))
    refused("several-layers", folder, read_dji)


def test_a_boundary_without_a_crs_is_refused(tmp_path: Path) -> None:
    folder = package(tmp_path / "package")
    (folder / "DJI/ShapeFile/field.prj").unlink()
    refused("no-crs", folder, read_dji)


def test_a_package_without_a_boundary_is_a_map_all_the_same(tmp_path: Path) -> None:
    folder = package(tmp_path / "package")
    for file in (folder / "DJI/ShapeFile").iterdir():
        file.unlink()
    grid = read_dji(folder)
    assert (grid.format, grid.boundary) == ("dji", None)


def test_a_geotiff_in_any_zip_is_read(tmp_path: Path) -> None:
    (tmp_path / "maps").mkdir()
    write(tmp_path / "maps/rx.tif")
    assert read_dji(zipped(tmp_path / "maps")).format == "geotiff"


# --- ADAPT rasters ---


def variable(band: int, code: str, product: str | None = None, **more: Any) -> dict[str, Any]:
    return {
        "definitionCode": code, "geoTIFFBandIndex": band, "id": {"referenceId": str(band)},
        "name": f"variable {band}", **({"productId": product} if product else {}), **more,
    }  # fmt: skip


def adapt(
    folder: Path, variables: list[dict[str, Any]], *, file: str = "rx.tiff", name: str = "one",
    documents: str = "workOrders",
) -> dict[str, Any]:  # fmt: skip
    folder.mkdir(exist_ok=True)
    operation = {"name": name, "spatialRecordsFile": file, "variables": variables}
    root = {
        "catalog": {
            "products": [
                {"id": {"referenceId": "p1"}, "name": "Water"},
                {"id": {"referenceId": "p2"}, "name": "Urea"},
            ],
            "customDataTypeDefinitions": [
                {
                    "definitionCode": "Slurry",
                    "numericDataTypeDefinitionAttributes": {"unitOfMeasureCode": "gal1ac-1"},
                }
            ],
        },
        "documents": {documents: [{"operations": [operation]}]},
    }
    (folder / "adapt.json").write_text(json.dumps(root), "utf-8-sig")
    return root


def test_adapt_names_products_and_units_by_band(tmp_path: Path) -> None:
    folder = tmp_path / "adapt"
    adapt(
        folder,
        [
            variable(2, "AppliedVolumePerAreaTarget", "p1", defaultRate=7.5),
            variable(1, "AppliedMassPerAreaActual", "p2"),
            variable(3, "Slurry", "p1"),
            variable(4, "VehicleSpeed"),
        ],
    )
    write(folder / "rx.tiff", np.stack([RATES + band for band in range(4)]))
    for grid in (
        read_geotiff(folder / "rx.tiff"),
        read_adapt(folder),
        read_adapt(zipped(folder)),
        read_adapt(folder / "adapt.json"),
    ):
        assert isinstance(grid, Grid)
        assert grid.format == "adapt"
        assert [(band.name, band.unit, band.is_rate, band.default) for band in grid.bands] == [
            ("Water (AppliedVolumePerAreaTarget)", "L/ha", True, 7.5),
            ("Urea", "kg/ha", True, None),
            ("Water (Slurry)", "gal1ac-1", True, None),
            ("variable 4", None, False, None),
        ]
        assert [band.values[0, 0] for band in grid.bands] == [13.5, 12.5, 14.5, 15.5]


def test_a_volume_of_adapt_is_a_map_and_a_mass_is_not(tmp_path: Path) -> None:
    folder = tmp_path / "adapt"
    adapt(folder, [variable(1, "AppliedVolumePerAreaActual", "p1")])
    path = write(folder / "rx.tiff")
    found = map_of(read_geotiff(path), path, rate_field=None, crs=None, given=Given())
    assert (found.unit, found.rate_field) == ("L/ha", "Water")
    for code in ("AppliedMassPerAreaActual", "AppliedCountPerAreaActual"):
        adapt(folder, [variable(1, code, "p1")])
        with pytest.raises(MapError) as caught:
            map_of(read_geotiff(path), path, rate_field=None, crs=None, given=Given())
        assert caught.value.code == "not-a-volume"


def test_the_index_of_version_1_is_understood(tmp_path: Path) -> None:
    folder = tmp_path / "adapt"
    one = variable(2, "AppliedVolumePerAreaActual", "p1")
    one["fileDataIndex"] = one.pop("geoTIFFBandIndex")
    adapt(folder, [one])
    write(folder / "rx.tiff", np.stack([RATES, RATES + 1]))
    assert read_geotiff(folder / "rx.tiff").bands[0].values[0, 0] == 13.5


def test_bytes_that_adapt_calls_rates_are_no_picture(tmp_path: Path) -> None:
    folder = tmp_path / "adapt"
    adapt(folder, [variable(band, "AppliedVolumePerAreaActual") for band in (1, 2, 3)])
    write(folder / "rx.tiff", np.full((3, 2, 3), 7, dtype="uint8"), photometric="RGB")
    grid = read_geotiff(folder / "rx.tiff")
    assert [band.name for band in grid.bands] == ["variable 1", "variable 2", "variable 3"]


def test_an_adapt_json_of_other_maps_says_nothing(tmp_path: Path) -> None:
    folder = tmp_path / "adapt"
    adapt(folder, [variable(1, "AppliedVolumePerAreaActual", "p1")], file="other.tiff")
    assert read_geotiff(write(folder / "rx.tiff")).format == "geotiff"
    adapt(folder, [variable(1, "AppliedVolumePerAreaActual", "p1")], documents="workRecords")
    assert read_geotiff(folder / "rx.tiff").format == "geotiff"
    refused("no-file", folder, read_adapt)


@pytest.mark.parametrize(
    ("variables", "code"),
    [
        ([variable(2, "AppliedVolumePerAreaActual")], "wrong-description"),
        ([variable(0, "AppliedVolumePerAreaActual")], "wrong-description"),
        ([variable(1, "AppliedVolumePerAreaActual")] * 2, "duplicate-code"),
    ],
)
def test_a_description_that_does_not_fit_is_refused(
    tmp_path: Path, variables: list[dict[str, Any]], code: str
) -> None:
    folder = tmp_path / "adapt"
    adapt(folder, variables)
    refused(code, write(folder / "rx.tiff"))


def test_several_operations_of_adapt_need_a_choice(tmp_path: Path) -> None:
    folder = tmp_path / "adapt"
    root = adapt(folder, [variable(1, "AppliedVolumePerAreaActual", "p1")])
    second = {"name": "two", "spatialRecordsFile": "b.tiff", "variables": []}
    root["documents"]["workOrders"].append({"operations": [second]})
    (folder / "adapt.json").write_text(json.dumps(root), "utf-8")
    write(folder / "rx.tiff")
    assert "one (rx.tiff), two (b.tiff)" in refused("several-layers", folder, read_adapt)
    assert read_adapt(folder, "one").format == "adapt"
    refused("no-file", folder, read_adapt, layer="b")
    refused("no-layer", folder, read_adapt, layer="three")


@pytest.mark.parametrize("file", ["../rx.tiff", "/etc/passwd", "http://127.0.0.1/rx.tiff"])
def test_adapt_leads_to_no_other_place(tmp_path: Path, file: str) -> None:
    write(tmp_path / "rx.tiff")
    adapt(tmp_path / "adapt", [variable(1, "AppliedVolumePerAreaActual", "p1")], file=file)
    refused("no-file", tmp_path / "adapt", read_adapt)


@pytest.mark.parametrize("text", ["", "[]", "{", "[" * 100_000, "\xff"])
def test_an_unreadable_adapt_json_is_refused(tmp_path: Path, text: str) -> None:
    path = write(tmp_path / "rx.tif")
    (tmp_path / "adapt.json").write_bytes(text.encode("latin-1"))
    refused("truncated", path)


def test_zero_as_no_data_and_a_default_are_refused(tmp_path: Path) -> None:
    folder = tmp_path / "adapt"
    adapt(folder, [variable(1, "AppliedVolumePerAreaActual", "p1", defaultRate=5)])
    refused("nodata-zero", write(folder / "rx.tiff", nodata=0))


def test_the_real_adapt_raster_has_four_products_in_place(samples: Path) -> None:
    path = samples / "14_geotiff_adapt" / "RasterRx-15.tiff"
    grid = read_geotiff(path)
    assert [(band.name, band.unit) for band in grid.bands] == [
        (f"Product {number}", "kg/ha") for number in (1, 2, 3, 4)
    ]
    assert {band.values.shape for band in grid.bands} == {(5, 10)}
    assert grid.transform == pytest.approx((0.002, 0.0, -87.6, 0.0, -0.001, 41.885))
    assert grid.crs is not None
    assert grid.crs.to_epsg() == 4326
    with rasterio.open(path) as independent:
        np.testing.assert_array_equal([band.values for band in grid.bands], independent.read())
    for asked, code in ((None, "several-products"), ("Product 2", "not-a-volume")):
        with pytest.raises(MapError) as caught:
            map_of(grid, path, rate_field=asked, crs=None, given=Given())
        assert caught.value.code == code
    dense = Given(density_kg_l=2.0)
    found = map_of(grid, path, rate_field="Product 2", crs=None, given=dense)
    assert found.rates_l_ha[:2] == (50.0, 50.5)


def test_the_real_adapt_folder_needs_a_choice(samples: Path) -> None:
    folder = samples / "14_geotiff_adapt"
    refused("several-layers", folder, read_adapt)
    assert isinstance(read_adapt(folder, "RasterRx-15"), Grid)
