"""Laws of GeoTIFF and GeoParquet: no bytes make a traceback, and cells come back as written."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import rasterio
import shapely
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from pyproj import CRS
from shapely import MultiPolygon, box

from companion.errors import MapError
from missions.maps.adapt import read_geoparquet
from missions.maps.assemble import map_of
from missions.maps.fields import Given
from missions.maps.geotiff import read_dji, read_geotiff, write_dji, write_geotiff
from missions.maps.model import Grid, Layer, MapCells
from missions.maps.registry import read_adapt

WEST, NORTH, CELL = 114.5, 36.0, 1e-4
RATES = np.linspace(0.0, 50.0, 600, dtype="float32").reshape(20, 30)
GIVEN = Given(unit="L/ha")
Reader = Callable[[Path], Layer | Grid]


@pytest.fixture(scope="module")
def folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as name:
        yield Path(name)


def tiff(path: Path, **options: Any) -> Path:
    place = rasterio.Affine(CELL, 0.0, WEST, 0.0, -CELL, NORTH)
    with rasterio.open(
        path, "w", driver="GTiff", width=30, height=20, count=2, dtype="float32",
        crs="EPSG:4326", transform=place, nodata=-9999.0, **options,
    ) as target:  # fmt: skip
        target.write(np.stack([RATES, RATES]))
        target.descriptions = ("rate", "other")
        target.units = ("L/ha", "kg/ha")
        target.scales, target.offsets = (0.5, 1.0), (1.0, 0.0)
    return path


@pytest.fixture(scope="module")
def tiffs(folder: Path) -> list[Path]:
    return [
        tiff(folder / f"original{number}.tif", **options)
        for number, options in enumerate(
            (
                {"compress": "none"},
                {"compress": "deflate", "predictor": 2},
                {"compress": "lzw", "tiled": True, "blockxsize": 16, "blockysize": 16},
            )
        )
    ]


@pytest.fixture(scope="module")
def parquet(folder: Path) -> Path:
    ground = [shapely.to_wkb(box(x, 36.0, x + 1e-4, 36.0001)) for x in (114.5, 114.5001)]
    about = {"encoding": "WKB", "geometry_types": ["Polygon"]}
    geo = {"version": "1.0.0", "primary_column": "geometry", "columns": {"geometry": about}}
    table = pa.table({"rate": [1.5, 0.0], "unit": ["L/ha"] * 2, "geometry": ground})
    path = folder / "original.parquet"
    pq.write_table(table.replace_schema_metadata({b"geo": json.dumps(geo)}), path)
    return path


def changes() -> st.SearchStrategy[list[tuple[float, int]]]:
    """Places as fractions of the file, half of them in its ends, and new bytes."""
    place = st.floats(0.0, 1.0, exclude_max=True) | st.floats(0.0, 0.1) | st.floats(0.7, 0.9999)
    return st.lists(st.tuples(place, st.integers(0, 255)), min_size=1, max_size=6)


def mutated(content: bytes, changed: list[tuple[float, int]], keep: float) -> bytes:
    result = bytearray(content)
    for place, byte in changed:
        result[int(place * len(result))] = byte
    return bytes(result[: int(keep * len(result))] if keep < 1.0 else result)


def use(path: Path, reader: Reader) -> None:
    """Read a map and assemble it; only a `MapError` of one line may come out."""
    try:
        found = reader(path)
        map_of(found, path, rate_field=None, crs=None, given=GIVEN)
    except MapError as error:
        assert "\n" not in str(error)
        assert error.fix


@given(which=st.integers(0, 2), changed=changes(), keep=st.just(1.0) | st.floats(0.0, 1.0))
def test_any_bytes_in_a_geotiff_are_read_or_refused(
    folder: Path, tiffs: list[Path], which: int, changed: list[tuple[float, int]], keep: float
) -> None:
    path = folder / "mutated.tif"
    path.write_bytes(mutated(tiffs[which].read_bytes(), changed, keep))
    use(path, read_geotiff)


@given(changed=changes(), keep=st.just(1.0) | st.floats(0.0, 1.0))
def test_any_bytes_in_a_geoparquet_are_read_or_refused(
    folder: Path, parquet: Path, changed: list[tuple[float, int]], keep: float
) -> None:
    path = folder / "mutated.parquet"
    path.write_bytes(mutated(parquet.read_bytes(), changed, keep))
    use(path, read_geoparquet)


@given(changed=changes(), keep=st.just(1.0) | st.floats(0.0, 1.0))
def test_any_bytes_in_a_dji_package_are_read_or_refused(
    folder: Path, package: Path, changed: list[tuple[float, int]], keep: float
) -> None:
    path = folder / "mutated.zip"
    path.write_bytes(mutated(package.read_bytes(), changed, keep))
    use(path, read_dji)


@pytest.fixture(scope="module")
def package(folder: Path) -> Path:
    place = (CELL, 0.0, WEST, 0.0, -CELL, NORTH)
    cells = MapCells(rates_l_ha=RATES.astype(np.float64), transform=place, crs=CRS.from_epsg(4326))
    write_dji(cells, folder / "field.zip", MultiPolygon([box(WEST, 35.99, WEST + 0.01, NORTH)]))
    return folder / "field.zip"


@given(text=st.text("0123456789.,-+eE naif\n\t", max_size=60), whole=st.booleans())
def test_any_text_in_a_world_file_is_read_or_refused(
    folder: Path, tiffs: list[Path], text: str, whole: bool
) -> None:
    path = folder / "placed.tif"
    path.write_bytes(tiffs[0].read_bytes())
    lines = f"{CELL}\n0\n0\n{-CELL}\n{text}\n{NORTH}" if whole else text
    path.with_suffix(".tfw").write_text(lines, "ascii")
    use(path, read_geotiff)


def json_values() -> st.SearchStrategy[object]:
    leaves = (
        st.none() | st.booleans() | st.integers(-1, 3) | st.floats()
        | st.sampled_from(["rx.tif", "AppliedVolumePerAreaActual", "Own", "p", "L/ha", ""])
    )  # fmt: skip
    keys = st.sampled_from(
        ["catalog", "products", "documents", "workOrders", "operations", "variables", "id",
         "referenceId", "name", "productId", "definitionCode", "geoTIFFBandIndex", "defaultRate",
         "spatialRecordsFile", "customDataTypeDefinitions"]
    )  # fmt: skip
    return st.recursive(
        leaves, lambda inner: st.lists(inner) | st.dictionaries(keys, inner), max_leaves=20
    )


@given(value=json_values(), inside=st.sampled_from(["", "catalog", "operations", "variables"]))
def test_any_adapt_json_is_read_or_refused(
    folder: Path, tiffs: list[Path], value: object, inside: str
) -> None:
    variable = {"definitionCode": "AppliedVolumePerAreaActual", "geoTIFFBandIndex": 1}
    operation = {
        "name": "one",
        "spatialRecordsFile": "rx.tif",
        "variables": value if inside == "variables" else [variable],
    }
    orders = [{"operations": value if inside == "operations" else [operation]}]
    root = {"catalog": value if inside == "catalog" else {}, "documents": {"workOrders": orders}}
    place = folder / "adapt"
    place.mkdir(exist_ok=True)
    (place / "rx.tif").write_bytes(tiffs[0].read_bytes())
    (place / "adapt.json").write_text(json.dumps(root if inside else value), "utf-8")
    use(place, read_adapt)
    use(place / "rx.tif", read_geotiff)


@given(
    rates=arrays.arrays(
        np.float64,
        arrays.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=12),
        elements=st.floats(0.0, 9_999.0) | st.just(float("nan")) | st.just(0.0),
    ),
    west=st.floats(-179.0, 179.0),
    north=st.floats(-80.0, 80.0),
    size=st.floats(1e-6, 1e-3),
)
def test_cells_come_back_as_they_were_written(
    folder: Path, rates: Any, west: float, north: float, size: float
) -> None:
    place = (size, 0.0, west, 0.0, -size, north)
    path = folder / "written.tif"
    write_geotiff(MapCells(rates_l_ha=rates, transform=place, crs=CRS.from_epsg(4326)), path)
    grid = read_geotiff(path)
    np.testing.assert_allclose(grid.bands[0].values, rates, atol=0.005)
    np.testing.assert_array_equal(grid.bands[0].values == 0.0, rates.astype("float32") == 0.0)
    assert grid.transform == pytest.approx(place, abs=1e-12)
    assert grid.problems == ()
