"""GeoParquet, alone and as the ADAPT Standard names its columns."""

from __future__ import annotations

import json
import sys
from decimal import Decimal
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import shapely
from pyproj import CRS, Geod
from shapely import MultiPolygon, Point, Polygon, box

from companion.errors import MapError
from missions.maps.adapt import read_geoparquet, read_table
from missions.maps.assemble import map_of
from missions.maps.fields import Given
from missions.maps.model import Layer
from missions.maps.registry import read_adapt

WEST, SOUTH, CELL = 114.5, 36.0, 1e-3
SQUARES = [box(WEST + i * CELL, SOUTH, WEST + (i + 1) * CELL, SOUTH + CELL) for i in range(3)]
HOLED = Polygon(SQUARES[0].exterior, [SQUARES[0].buffer(-CELL / 4).exterior])
GROUND: list[Any] = [HOLED, MultiPolygon([SQUARES[1]]), SQUARES[2]]


def geo(**about: Any) -> dict[str, Any]:
    column = {"encoding": "WKB", "geometry_types": ["Polygon", "MultiPolygon"], **about}
    return {"version": "1.1.0", "primary_column": "geometry", "columns": {"geometry": column}}


def write(
    path: Path, ground: list[Any] | None = None, *, about: Any = None, columns: Any = None,
    **options: Any,
) -> Path:  # fmt: skip
    ground = GROUND if ground is None else ground
    blobs = [None if one is None else shapely.to_wkb(one) for one in ground]
    content = {"rate": [12.5, 0.0, None], "unit": ["l/ha"] * 3} if columns is None else columns
    table = pa.table({**content, "geometry": pa.array(blobs, pa.binary())})
    about = geo() if about is None else about
    text = about if isinstance(about, str) else json.dumps(about)
    metadata = {b"geo": text.encode()} if text else {}
    pq.write_table(table.replace_schema_metadata(metadata), path, **options)
    return path


def refused(code: str, path: Path, **options: Any) -> str:
    with pytest.raises(MapError) as caught:
        read_geoparquet(path, **options)
    assert caught.value.code == code, str(caught.value)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def values(layer: Layer) -> dict[str, tuple[Any, ...]]:
    return {column.name: column.values for column in layer.columns}


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"compression": "zstd"},
        {"compression": "gzip", "use_dictionary": False},
        {"row_group_size": 1},
        {"version": "1.0", "data_page_version": "2.0"},
    ],
)
def test_polygons_and_columns_are_those_that_were_written(
    tmp_path: Path, options: dict[str, Any]
) -> None:
    layer = read_geoparquet(write(tmp_path / "rx.parquet", **options))
    assert layer.format == "geoparquet"
    assert layer.crs is not None
    assert layer.crs.to_epsg() == 4326
    assert values(layer) == {"rate": (12.5, 0.0, None), "unit": ("l/ha",) * 3}
    assert [column.numeric for column in layer.columns] == [True, False]
    for found, written in zip(layer.geometries, GROUND, strict=True):
        assert found is not None
        assert found.equals(written)
    found_map = map_of(layer, tmp_path / "rx", rate_field=None, crs=None, given=Given())
    assert [zone.rate_l_ha for zone in found_map.zones] == [12.5, 0.0, None]


def test_every_flat_type_is_read_and_others_are_left(tmp_path: Path) -> None:
    columns = {
        "whole": pa.array([1, None, 3], pa.int64()),
        "small": pa.array([1, 2, 3], pa.uint8()),
        "single": pa.array([1.5, float("nan"), 3.0], pa.float32()),
        "exact": pa.array([Decimal("1.25"), None, Decimal("3.00")], pa.decimal128(10, 2)),
        "text": pa.array(["a", None, "中"], pa.large_string()),
        "category": pa.array(["x", "y", "x"]).dictionary_encode(),
        "nested": pa.array([{"a": 1}] * 3),
        "list": pa.array([[1], [2], []]),
        "flag": pa.array([True, False, None]),
        "day": pa.array([1, 2, 3], pa.date32()),
        "blob": pa.array([b"\0", b"\1", None]),
    }
    found = values(read_geoparquet(write(tmp_path / "rx.parquet", columns=columns)))
    assert found == {
        "whole": (1.0, None, 3.0),
        "small": (1.0, 2.0, 3.0),
        "single": (1.5, None, 3.0),
        "exact": (1.25, None, 3.0),
        "text": ("a", None, "中"),
        "category": ("x", "y", "x"),
    }


def test_the_crs_is_the_one_of_the_file_absent_or_unknown(tmp_path: Path) -> None:
    utm = CRS.from_epsg(32650)
    about = geo(crs=json.loads(utm.to_json()))
    layer = read_geoparquet(write(tmp_path / "utm.parquet", about=about))
    assert layer.crs is not None
    assert layer.crs.to_epsg() == 32650
    assert read_geoparquet(write(tmp_path / "null.parquet", about=geo(crs=None))).crs is None
    bad = read_geoparquet(write(tmp_path / "bad.parquet", about=geo(crs={"type": "nothing"})))
    assert isinstance(bad.crs, MapError)


def test_records_without_ground_are_named(tmp_path: Path) -> None:
    layer = read_geoparquet(write(tmp_path / "rx.parquet", [None, Point(1, 2), SQUARES[0]]))
    assert layer.skipped == {0: "null-geometry", 1: "not-a-polygon:Point"}
    assert [area is None for area in layer.geometries] == [True, True, False]


@pytest.mark.parametrize(
    ("about", "code"),
    [
        ("", "no-polygon"),
        ("{", "truncated"),
        ("[]", "truncated"),
        ({"version": "1.0.0"}, "truncated"),
        ({"primary_column": "shape", "columns": {"shape": {"encoding": "WKB"}}}, "truncated"),
        ({"primary_column": ["a"], "columns": {}}, "truncated"),
        (geo(encoding="multipolygon"), "unknown-format"),
    ],
)
def test_a_description_that_says_too_little_is_refused(
    tmp_path: Path, about: Any, code: str
) -> None:
    refused(code, write(tmp_path / "rx.parquet", about=about))


def test_a_broken_geometry_is_refused_with_its_record(tmp_path: Path) -> None:
    path = tmp_path / "rx.parquet"
    table = pa.table({"geometry": [shapely.to_wkb(SQUARES[0]), b"\1\3\0\0\0\xff\xff\xff\xff"]})
    pq.write_table(table.replace_schema_metadata({b"geo": json.dumps(geo())}), path)
    assert "record 2" in refused("broken-geometry", path)


def test_geometry_as_text_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "rx.parquet"
    table = pa.table({"geometry": [SQUARES[0].wkt]})
    pq.write_table(table.replace_schema_metadata({b"geo": json.dumps(geo())}), path)
    refused("truncated", path)


@pytest.mark.parametrize("keep", [0.0, 0.01, 0.3, 0.9, 0.999])
def test_a_file_cut_short_is_refused(tmp_path: Path, keep: float) -> None:
    path = write(tmp_path / "rx.parquet")
    content = path.read_bytes()
    path.write_bytes(content[: int(keep * len(content))])
    refused("truncated", path)


def test_what_is_too_large_is_refused_by_its_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    table = pa.table({"geometry": pa.nulls(1_000_001, pa.binary())})
    path = tmp_path / "rows.parquet"
    pq.write_table(table.replace_schema_metadata({b"geo": json.dumps(geo())}), path)
    with pytest.raises(MapError, match="1000001 records are more"):
        read_geoparquet(path)
    wide = {f"c{number}": [1.0, 2.0, 3.0] for number in range(256)}
    refused("too-large", write(tmp_path / "wide.parquet", columns=wide))
    many = {f"c{number}": pa.nulls(100_000, pa.float64()) for number in range(101)}
    path = write(tmp_path / "many.parquet", [None] * 100_000, columns=many)
    refused("too-large", path)


def test_one_geometry_repeated_is_counted_every_time(tmp_path: Path) -> None:
    """A small file must not grow without bound: 6 000 circles of 1 025 vertices are 6 million."""
    circle = Point(WEST, SOUTH).buffer(CELL, quad_segs=256)
    path = write(tmp_path / "rx.parquet", [circle] * 6_000, columns={})
    assert path.stat().st_size < 100_000
    with pytest.raises(MapError, match="vertices are more"):
        read_geoparquet(path)


def test_a_long_text_repeated_is_held_once(tmp_path: Path) -> None:
    """A gigabyte of text in a file of some kilobytes."""
    once = pa.DictionaryArray.from_arrays(pa.array([0] * 10_000), pa.array(["x" * 100_000]))
    columns = {"note": once}
    path = write(tmp_path / "rx.parquet", [SQUARES[0]] * 10_000, columns=columns)
    assert path.stat().st_size < 200_000
    found = values(read_geoparquet(path))["note"]
    assert len({id(text) for text in found}) == 1


def test_a_name_that_is_there_twice_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "rx.parquet"
    table = pa.table(
        [pa.array([1.0]), pa.array([2.0]), pa.array([shapely.to_wkb(SQUARES[0])])],
        names=["rate", "rate", "geometry"],
    )
    pq.write_table(table.replace_schema_metadata({b"geo": json.dumps(geo())}), path)
    refused("several-columns", path)


def test_a_folder_with_one_file_is_read_and_with_two_needs_a_choice(tmp_path: Path) -> None:
    write(tmp_path / "rx.parquet")
    assert len(read_geoparquet(tmp_path).geometries) == 3
    write(tmp_path / "other.parquet")
    refused("several-layers", tmp_path)
    assert len(read_geoparquet(tmp_path, "other").geometries) == 3
    refused("no-layer", tmp_path / "rx.parquet", layer="third")


def test_without_pyarrow_the_extra_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path / "rx.parquet")
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    assert "vrspray[office]" in refused("missing-library", path)


def test_the_refusal_of_a_caller_is_passed_on(tmp_path: Path) -> None:
    path = write(tmp_path / "rx.parquet")

    def refuse(_: bytes | None) -> str:
        raise MapError("no", code="mine")

    with pytest.raises(MapError) as caught:
        read_table(path.read_bytes(), path, geometry_of=refuse)
    assert caught.value.code == "mine"


# --- ADAPT ---


def adapt(folder: Path, *variables: dict[str, Any]) -> Path:
    folder.mkdir(exist_ok=True)
    operation = {
        "name": "spray",
        "spatialRecordsFile": "rx.parquet",
        "variables": [{"id": {"referenceId": "v"}, "name": "a name", **one} for one in variables],
    }
    product = {"id": {"referenceId": "p1"}, "name": "Water"}
    root = {
        "catalog": {"products": [product]},
        "documents": {"workOrders": [{"operations": [operation]}]},
    }
    (folder / "adapt.json").write_text(json.dumps(root), "utf-8")
    return folder


VOLUME = {"definitionCode": "AppliedVolumePerAreaTarget", "productId": "p1"}


@pytest.mark.parametrize("place", [{"geoParquetColumnName": "c"}, {"fileDataIndex": 2}])
def test_adapt_names_products_and_units_by_column(tmp_path: Path, place: dict[str, Any]) -> None:
    folder = adapt(tmp_path / "adapt", {**VOLUME, **place, "defaultRate": 3})
    write(folder / "rx.parquet", columns={"other": [1.0] * 3, "c": [5.0, 6.0, 7.0]})
    for layer in (read_geoparquet(folder / "rx.parquet"), read_adapt(folder)):
        assert isinstance(layer, Layer)
        assert layer.format == "adapt"
        other, rate = layer.columns
        assert (other.name, other.is_rate, other.unit) == ("other", False, None)
        assert (rate.name, rate.is_rate, rate.unit, rate.default) == ("Water", True, "L/ha", 3.0)
        assert rate.values == (5.0, 6.0, 7.0)
        found = map_of(layer, folder, rate_field=None, crs=None, given=Given())
        assert (found.rate_field, found.default_rate_l_ha) == ("Water", 3.0)


@pytest.mark.parametrize("place", [{"geoParquetColumnName": "d"}, {"fileDataIndex": 9}])
def test_a_column_that_is_not_there_is_refused(tmp_path: Path, place: dict[str, Any]) -> None:
    folder = adapt(tmp_path / "adapt", {**VOLUME, **place})
    refused("wrong-description", write(folder / "rx.parquet"))


@pytest.mark.parametrize("default", ["7", True, float("nan"), 1e300, [1]])
def test_a_default_that_is_no_rate_is_refused(tmp_path: Path, default: Any) -> None:
    folder = adapt(
        tmp_path / "adapt", {**VOLUME, "geoParquetColumnName": "rate", "defaultRate": default}
    )
    layer = read_geoparquet(write(folder / "rx.parquet"))
    with pytest.raises(MapError) as caught:
        map_of(layer, folder, rate_field=None, crs=None, given=Given())
    assert caught.value.code == "bad-rate"


def test_the_real_vector_prescription_has_two_products(samples: Path) -> None:
    path = samples / "14_geotiff_adapt" / "vector" / "-49.parquet"
    layer = read_geoparquet(path)
    assert [(column.name, column.unit, column.is_rate) for column in layer.columns] == [
        ("Product 1", "count/ha", True),
        ("Product 4", "L/ha", True),
    ]
    table = pq.read_table(path)
    independent = shapely.from_wkb(table["geometry"].to_pylist())
    geod = Geod(ellps="WGS84")
    areas = [abs(geod.geometry_area_perimeter(one)[0]) / 10_000 for one in independent]
    assert areas == pytest.approx([0.9217, 0.9217], abs=1e-3)
    for found, one in zip(layer.geometries, independent, strict=True):
        assert found is not None
        assert found.equals(one)
    with pytest.raises(MapError) as caught:
        map_of(layer, path, rate_field=None, crs=None, given=Given())
    assert caught.value.code == "several-products"
    found_map = map_of(layer, path, rate_field="Product 4", crs=None, given=Given())
    rates = tuple(sorted(table["AppliedVolumePerAreaActual_Product 4"].to_pylist()))
    assert found_map.rates_l_ha == rates
    assert found_map.unit == "L/ha"
