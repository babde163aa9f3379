"""GeoTIFF, world files, DJI's package and rasters of the ADAPT Standard.

The files are made by rasterio (GDAL), or byte by byte where GDAL would hide what is tested.
"""

from __future__ import annotations

import struct
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine

from companion.errors import MapError
from missions.maps.assemble import map_of
from missions.maps.cells import bounds_deg
from missions.maps.fields import Given
from missions.maps.geotiff import read_geotiff
from missions.maps.geotiff_bands import parse_world_file
from tests.missions.geotiff_files import CELL, NORTH, PLACE, RATES, WEST, codes, refused, tfw, write


def by_hand(pages: Sequence[Any], *, point: bool = False, placed: bool = True) -> bytes:
    """Return a TIFF of 32-bit floats, one directory a page, tie point at the first cell."""
    content = bytearray(b"II*\0\0\0\0\0")
    link = 4
    for page in pages:
        values = np.asarray(page, dtype="<f4")
        data_at = len(content)
        content += values.tobytes()
        entries = [
            (256, 3, [values.shape[1]]), (257, 3, [values.shape[0]]), (258, 3, [32]),
            (259, 3, [1]), (262, 3, [1]), (273, 4, [data_at]), (277, 3, [1]),
            (278, 3, [values.shape[0]]), (279, 4, [values.nbytes]), (339, 3, [3]),
        ]  # fmt: skip
        if placed:
            keys = [1, 1, 0, 3, 1024, 0, 1, 2, 1025, 0, 1, 2 if point else 1, 2048, 0, 1, 4326]
            entries += [
                (33550, 12, [CELL, CELL, 0.0]),
                (33922, 12, [0.0, 0.0, 0.0, WEST, NORTH, 0.0]),
                (34735, 3, keys),
            ]
        packed = b""
        for tag, kind, numbers in entries:
            body = struct.pack(f"<{len(numbers)}{ {3: 'H', 4: 'I', 12: 'd'}[kind] }", *numbers)
            if len(body) > 4:
                place = struct.pack("<I", len(content))
                content += body
                body = place
            packed += struct.pack("<HHI", tag, kind, len(numbers)) + body.ljust(4, b"\0")
        content += b"\0" * (len(content) % 2)
        struct.pack_into("<I", content, link, len(content))
        content += struct.pack("<H", len(entries)) + packed
        link = len(content)
        content += b"\0\0\0\0"
    return bytes(content)


# --- Values ---


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"compress": "deflate", "predictor": 3},
        {"compress": "lzw"},
        {"compress": "zstd"},
        {"tiled": True, "blockxsize": 16, "blockysize": 16},
        {"BIGTIFF": "YES"},
        {"ENDIANNESS": "BIG"},
    ],
)
def test_the_rates_are_those_that_were_written(tmp_path: Path, options: dict[str, Any]) -> None:
    grid = read_geotiff(write(tmp_path / "rx.tif", **options))
    assert [band.name for band in grid.bands] == ["band 1"]
    np.testing.assert_array_equal(grid.bands[0].values, RATES.astype(np.float64))
    assert grid.transform == pytest.approx(PLACE[:6], abs=1e-15)
    assert grid.crs is not None
    assert grid.crs.to_epsg() == 4326
    assert (grid.format, grid.unit, codes(grid)) == ("geotiff", None, [])


@pytest.mark.parametrize(
    "dtype", ["uint8", "int8", "int16", "uint16", "int32", "uint32", "float64"]
)
def test_every_type_of_numbers_is_read(tmp_path: Path, dtype: str) -> None:
    values = np.array([[12, 0, 15], [20, 22, 25]], dtype=dtype)
    grid = read_geotiff(write(tmp_path / "rx.tif", values))
    np.testing.assert_array_equal(grid.bands[0].values, values.astype(np.float64))


def test_scale_and_offset_of_a_band_are_applied(tmp_path: Path) -> None:
    values = np.array([[125, 0], [200, 9999]], dtype="uint16")
    path = write(tmp_path / "rx.tif", values, nodata=9999, scales=((0.1,), (5.0,)))
    found = read_geotiff(path).bands[0].values
    np.testing.assert_allclose(found, [[17.5, 5.0], [25.0, np.nan]])


def test_a_scale_that_is_none_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "rx.tif", scales=((0.0,), (1.0,)))
    refused("bad-rate", path)


@pytest.mark.parametrize("nodata", [-9999.0, float("nan"), -3.4028234663852886e38, 12.5])
def test_declared_no_data_is_no_rate_and_zero_is_one(tmp_path: Path, nodata: float) -> None:
    values = RATES.copy()
    values[0, 0] = nodata
    grid = read_geotiff(write(tmp_path / "rx.tif", values, nodata=nodata))
    assert np.isnan(grid.bands[0].values).tolist() == [[True, False, False], [False] * 3]
    assert grid.bands[0].values[0, 1] == 0.0
    assert codes(grid) == []


def test_zero_declared_as_no_data_is_outside_with_a_warning(tmp_path: Path) -> None:
    grid = read_geotiff(write(tmp_path / "rx.tif", nodata=0))
    assert np.isnan(grid.bands[0].values[0, 1])
    assert codes(grid) == ["nodata-zero"]
    assert "1 cells" in grid.problems[0].text


def test_nan_needs_no_declaration(tmp_path: Path) -> None:
    values = RATES.copy()
    values[1, 2] = np.nan
    grid = read_geotiff(write(tmp_path / "rx.tif", values))
    assert np.isnan(grid.bands[0].values).sum() == 1


@pytest.mark.parametrize("fill", [-9999.0, -1.0, -3.4028234663852886e38, 3.4028234663852886e38])
def test_undeclared_no_data_is_refused_with_its_value(tmp_path: Path, fill: float) -> None:
    values = RATES.copy()
    values[0] = fill
    text = refused("nodata-undeclared", write(tmp_path / "rx.tif", values))
    assert f"{np.float32(fill):.6g}" in text


@pytest.mark.parametrize("dtype", ["uint16", "int16", "int32", "uint32"])
def test_the_largest_number_of_a_type_is_no_rate(tmp_path: Path, dtype: str) -> None:
    values = np.array([[10, 20, np.iinfo(dtype).max]], dtype=dtype)
    refused("nodata-undeclared", write(tmp_path / "rx.tif", values))
    declared = write(tmp_path / "declared.tif", values, nodata=int(np.iinfo(dtype).max))
    assert np.isnan(read_geotiff(declared).bands[0].values).tolist() == [[False, False, True]]


def test_another_fill_beside_the_declared_one_is_refused(tmp_path: Path) -> None:
    values = RATES.copy()
    values[0, 0], values[1, 1] = -9999.0, -3.4e38
    assert "beside" in refused(
        "nodata-undeclared", write(tmp_path / "rx.tif", values, nodata=-9999)
    )


@pytest.mark.parametrize("wrong", [[np.inf, 1.0], [-np.inf, -np.inf], [-1.0, -2.0]])
def test_numbers_that_are_no_rates_are_refused(tmp_path: Path, wrong: list[float]) -> None:
    values = RATES.copy()
    values[0, :2] = wrong
    assert "row 1" in refused("bad-rate", write(tmp_path / "rx.tif", values))


def test_a_band_that_is_no_rate_does_not_stop_the_others(tmp_path: Path) -> None:
    path = write(tmp_path / "rx.tif", np.stack([RATES, RATES - 20]), names=("rate", "ndvi"))
    grid = read_geotiff(path)
    assert [band.name for band in grid.bands] == ["rate", "ndvi"]
    refused("nodata-undeclared", write(tmp_path / "all.tif", np.stack([RATES * 0 - 1] * 2)))


def test_cells_that_a_mask_hides_are_no_rate(tmp_path: Path) -> None:
    mask = np.array([[255, 0, 255], [255, 255, 0]], dtype="uint8")
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True):
        path = write(tmp_path / "rx.tif", mask=mask)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["rx.tif"]
    np.testing.assert_array_equal(np.isnan(read_geotiff(path).bands[0].values), mask == 0)


def test_an_alpha_band_hides_cells_and_is_no_product(tmp_path: Path) -> None:
    alpha = np.array([[255, 0, 255], [255, 255, 0]], dtype="uint8")
    values = np.stack([RATES.astype("uint8"), alpha])
    grid = read_geotiff(write(tmp_path / "rx.tif", values, photometric="MINISBLACK", ALPHA="YES"))
    assert len(grid.bands) == 1
    np.testing.assert_array_equal(np.isnan(grid.bands[0].values), alpha == 0)


# --- What is not a rate ---


def test_numbers_of_zones_are_taken_with_a_warning(tmp_path: Path) -> None:
    for dtype in ("uint8", "float32"):
        grid = read_geotiff(write(tmp_path / "rx.tif", np.array([[0, 1, 2], [3, 3, 1]], dtype)))
        assert codes(grid) == ["class-raster"]
        assert "1, 2, 3" in grid.problems[0].text


@pytest.mark.parametrize("values", [[[1, 2, 4]], [[5, 6, 7]], [[1, 1, 0]], [[1, 2, 12]]])
def test_small_rates_are_no_numbers_of_zones(tmp_path: Path, values: list[list[int]]) -> None:
    assert codes(read_geotiff(write(tmp_path / "rx.tif", np.array(values, "uint8")))) == []


def test_numbers_with_a_unit_are_no_numbers_of_zones(tmp_path: Path) -> None:
    values = np.array([[1, 2, 3]], "uint8")
    assert codes(read_geotiff(write(tmp_path / "rx.tif", values, units=("L/ha",)))) == []


def test_a_picture_is_refused(tmp_path: Path) -> None:
    colours = np.full((3, 2, 3), 7, dtype="uint8")
    refused("picture", write(tmp_path / "rgb.tif", colours, photometric="RGB"))
    colours = np.full((4, 2, 3), 7, dtype="uint8")
    refused("picture", write(tmp_path / "rgba.tif", colours, photometric="RGB", ALPHA="YES"))
    path = write(tmp_path / "palette.tif", np.array([[1, 2]], "uint8"), photometric="palette")
    with rasterio.open(path, "r+") as target:
        target.write_colormap(1, {1: (255, 0, 0, 255), 2: (0, 255, 0, 255)})
    refused("picture", path)


def test_complex_numbers_are_refused(tmp_path: Path) -> None:
    refused("bad-rate", write(tmp_path / "rx.tif", RATES.astype("complex64")))


# --- Names and units ---


def test_bands_keep_their_names_and_are_told_apart(tmp_path: Path) -> None:
    path = write(tmp_path / "rx.tif", np.stack([RATES] * 4), names=("water", "mix", "mix", None))
    names = [band.name for band in read_geotiff(path).bands]
    assert names == ["water", "mix (band 2)", "mix (band 3)", "band 4"]


def test_several_products_need_a_choice(tmp_path: Path) -> None:
    path = write(tmp_path / "rx.tif", np.stack([RATES, RATES + 1]), names=("A", "B"))
    with pytest.raises(MapError) as caught:
        map_of(read_geotiff(path), path, rate_field=None, crs=None, given=Given(unit="L/ha"))
    assert caught.value.code == "several-products"
    found = map_of(read_geotiff(path), path, rate_field="B", crs=None, given=Given(unit="L/ha"))
    assert found.rates_l_ha == (1.0, 13.5, 16.0, 21.0, 23.5, 26.0)


def test_units_are_those_of_the_band_and_of_the_file(tmp_path: Path) -> None:
    grid = read_geotiff(write(tmp_path / "rx.tif", units=("L/ha",), tags={"UNIT": "gal/ac"}))
    assert (grid.bands[0].unit, grid.unit) == ("L/ha", "gal/ac")


def test_without_a_unit_a_map_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "rx.tif")
    with pytest.raises(MapError) as caught:
        map_of(read_geotiff(path), path, rate_field=None, crs=None, given=Given())
    assert caught.value.code == "no-unit"


# --- Place ---


def test_a_tie_point_is_a_corner_or_a_centre_as_the_file_says(tmp_path: Path) -> None:
    path = tmp_path / "rx.tif"
    path.write_bytes(by_hand([RATES]))
    assert read_geotiff(path).transform == pytest.approx(PLACE[:6], abs=1e-12)
    path.write_bytes(by_hand([RATES], point=True))
    moved = (CELL, 0.0, WEST - CELL / 2, 0.0, -CELL, NORTH + CELL / 2)
    assert read_geotiff(path).transform == pytest.approx(moved, abs=1e-12)


def test_longitude_is_x_though_the_crs_has_latitude_first(tmp_path: Path) -> None:
    path = write(tmp_path / "rx.tif")
    found = map_of(read_geotiff(path), path, rate_field=None, crs=None, given=Given(unit="L/ha"))
    assert found.cells is not None
    assert found.cells.crs.axis_info[0].direction == "north"
    west, south, east, north = bounds_deg(found.cells)
    assert (west, north) == pytest.approx((WEST, NORTH))
    assert (east, south) == pytest.approx((WEST + 3 * CELL, NORTH - 2 * CELL))


def test_exchanged_axes_are_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "rx.tif", transform=Affine(CELL, 0.0, 36.0, 0.0, -CELL, 114.5))
    with pytest.raises(MapError) as caught:
        map_of(read_geotiff(path), path, rate_field=None, crs=None, given=Given(unit="L/ha"))
    assert caught.value.code == "swapped-axes"


def test_rotated_cells_and_projections_are_read(tmp_path: Path) -> None:
    turned = Affine.translation(500_000.0, 3_984_000.0) @ Affine.rotation(30) @ Affine.scale(2, -2)
    grid = read_geotiff(write(tmp_path / "rx.tif", crs="EPSG:32650", transform=turned))
    assert grid.transform == pytest.approx(turned[:6])
    assert grid.crs is not None
    assert grid.crs.to_epsg() == 32650


@pytest.mark.parametrize("suffix", [".tfw", ".TFW", ".tifw", ".wld"])
def test_a_world_file_is_the_centre_of_the_first_cell(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / "rx.tif"
    path.write_bytes(by_hand([RATES], placed=False))
    tfw(path, suffix=suffix)
    grid = read_geotiff(path)
    assert grid.transform == pytest.approx(PLACE[:6], abs=1e-12)
    assert grid.crs is None


def test_gdal_reads_the_same_place_from_a_world_file(tmp_path: Path) -> None:
    path = tmp_path / "rx.tif"
    path.write_bytes(by_hand([RATES], placed=False))
    path.with_suffix(".tfw").write_text("2.0\n0.5\n0.25\n-3.0\n100.0\n200.0\n", "ascii")
    with rasterio.open(path) as independent:
        assert read_geotiff(path).transform == pytest.approx(independent.transform[:6])


def test_a_world_file_that_agrees_says_nothing_and_counts_in_the_checksum(tmp_path: Path) -> None:
    path = write(tmp_path / "rx.tif")
    alone = read_geotiff(path).sha256
    tfw(path)
    grid = read_geotiff(path)
    assert codes(grid) == []
    assert grid.sha256 != alone


def test_a_corner_in_the_world_file_is_half_a_cell_off(tmp_path: Path) -> None:
    path = write(tmp_path / "rx.tif")
    tfw(path, x=WEST, y=NORTH)
    grid = read_geotiff(path)
    assert grid.transform == pytest.approx(PLACE[:6], abs=1e-15)
    assert codes(grid) == ["half-pixel"]
    # Half a cell: 4.50 m of longitude at 36 degrees (cos 0.809) and 5.57 m of latitude.
    assert "7.16 m" in grid.problems[0].text


def test_half_a_cell_is_said_in_metres_of_a_projection(tmp_path: Path) -> None:
    path = write(tmp_path / "rx.tif", crs="EPSG:32650", transform=Affine(3, 0, 5e5, 0, -4, 4e6))
    path.with_suffix(".tfw").write_text("3\n0\n0\n-4\n500000\n4000000\n", "ascii")
    grid = read_geotiff(path)
    assert codes(grid) == ["half-pixel"]
    assert "2.50 m" in grid.problems[0].text


def test_a_world_file_cut_to_few_decimals_is_named(tmp_path: Path) -> None:
    path = write(tmp_path / "rx.tif")
    tfw(path, x=WEST + 0.8 * CELL)
    assert codes(read_geotiff(path)) == ["world-file"]


def test_a_world_file_of_another_place_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "rx.tif")
    tfw(path, x=WEST + 5 * CELL)
    refused("georeference-conflict", path)


def test_two_world_files_are_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "rx.tif")
    tfw(path)
    tfw(path, suffix=".wld")
    refused("several-files", path)


@pytest.mark.parametrize(
    "text", ["", "1\n2\n3", "0\n0\n0\n0\n1\n1", "0,1\n0\n0\n-0,1\n1\n1", "nan\n0\n0\n1\n1\n1",
             "1\n0\n0\n-1\n1e99\n1", "1\n0\n0\n-1\n1\n1\n" * 2, "\u4e2d"],
)  # fmt: skip
def test_a_broken_world_file_is_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(MapError) as caught:
        parse_world_file(text.encode(), tmp_path / "rx.tfw")
    assert caught.value.code == "bad-world-file"


def test_a_map_without_a_place_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "rx.tif"
    path.write_bytes(by_hand([RATES], placed=False))
    refused("not-georeferenced", path)


def test_control_points_alone_are_refused(tmp_path: Path) -> None:
    points = [
        rasterio.control.GroundControlPoint(row, column, WEST + column * CELL, NORTH - row * CELL)
        for row, column in ((0, 0), (0, 3), (2, 0), (2, 3))
    ]
    path = tmp_path / "rx.tif"
    write(path, transform=None, gcps=points)
    assert "control points" in refused("not-georeferenced", path)


# --- Bounds and damage ---


@pytest.mark.parametrize(
    "size",
    [
        {"width": 4001, "height": 4001, "count": 1},
        {"width": 1, "height": 1, "count": 65},
        {"width": 3000, "height": 3000, "count": 8},
        {"width": 1, "height": 1, "count": 1, "tiled": True, "blockxsize": 8192,
         "blockysize": 8192},
    ],
)  # fmt: skip
def test_what_is_too_large_is_refused_by_its_head(tmp_path: Path, size: dict[str, Any]) -> None:
    path = tmp_path / "rx.tif"
    options = {"crs": "EPSG:4326", "transform": PLACE, "SPARSE_OK": "TRUE", **size}
    with rasterio.open(path, "w", driver="GTiff", dtype="float32", **options):
        pass
    assert path.stat().st_size < 1_000_000
    refused("too-large", path)


def test_a_virtual_raster_under_the_name_of_a_tiff_is_refused(tmp_path: Path) -> None:
    source = write(tmp_path / "source.tif")
    path = tmp_path / "rx.tif"
    path.write_text(
        '<VRTDataset rasterXSize="3" rasterYSize="2"><VRTRasterBand dataType="Float32" band="1">'
        f"<SimpleSource><SourceFilename>{source}</SourceFilename></SimpleSource></VRTRasterBand>"
        "</VRTDataset>",
        "utf-8",
    )
    refused("unknown-format", path)


@pytest.mark.parametrize("options", [{}, {"compress": "deflate"}, {"compress": "lzw"}])
@pytest.mark.parametrize("keep", [0.02, 0.2, 0.5, 0.9])
def test_a_file_cut_short_is_refused(tmp_path: Path, options: dict[str, Any], keep: float) -> None:
    values = np.random.default_rng(1).uniform(5.0, 50.0, (80, 90)).astype("float32")
    path = write(tmp_path / "rx.tif", values, **options)
    content = path.read_bytes()
    path.write_bytes(content[: int(keep * len(content))])
    refused("truncated", path)


@pytest.mark.parametrize("options", [{"compress": "deflate"}, {"compress": "lzw"}])
def test_pixels_that_cannot_be_unpacked_are_said_in_our_words(
    tmp_path: Path, options: dict[str, Any]
) -> None:
    values = np.random.default_rng(1).uniform(5.0, 50.0, (80, 90)).astype("float32")
    path = write(tmp_path / "rx.tif", values, **options)
    content = path.read_bytes()
    path.write_bytes(content[:-4000] + b"\xff" * 4000)
    assert "damaged (its pixels cannot be read);" in refused("truncated", path)


@pytest.mark.parametrize(
    ("old", "new", "code"),
    [
        (b"<Item", b"<\xb3tem", "encoding"),
        (b"</GDALMetadata>", b"</GDALMetadat\0>", "truncated"),
        (b"</GDALMetadata>", b"</GDALMetadata ", "truncated"),
    ],
)
def test_a_damaged_description_of_the_bands_is_refused(
    tmp_path: Path, old: bytes, new: bytes, code: str
) -> None:
    """GDAL would go on without the scale."""
    path = write(tmp_path / "rx.tif", scales=((0.5,), (1.0,)))
    content = path.read_bytes()
    assert content.count(old) >= 1
    path.write_bytes(content.replace(old, new))
    refused(code, path)


def test_a_tag_beyond_the_end_is_refused(tmp_path: Path) -> None:
    """GDAL would go on without the value for no data."""
    path = write(tmp_path / "rx.tif", nodata=-9999)
    content = path.read_bytes()
    at = content.index(struct.pack("<HHI", 42113, 2, 6)) + 8
    path.write_bytes(content[:at] + struct.pack("<I", len(content)) + content[at + 4 :])
    assert "42113" in refused("truncated", path)


def test_directories_without_end_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "rx.tif"
    content = bytearray(by_hand([RATES]))
    first = struct.unpack_from("<I", content, 4)[0]
    link = first + 2 + 12 * struct.unpack_from("<H", content, first)[0]
    struct.pack_into("<I", content, link, first)
    path.write_bytes(content)
    assert "without end" in refused("truncated", path)


def test_several_pictures_in_a_file_need_a_choice(tmp_path: Path) -> None:
    path = tmp_path / "rx.tif"
    path.write_bytes(by_hand([RATES, RATES + 1]))
    assert "1 to 2" in refused("several-layers", path)
    refused("no-layer", path, layer="3")
    np.testing.assert_array_equal(read_geotiff(path, "2").bands[0].values, RATES + 1.0)


def test_a_layer_that_is_not_there_is_refused(tmp_path: Path) -> None:
    refused("no-layer", write(tmp_path / "rx.tif"), layer="other")
    assert read_geotiff(tmp_path / "rx.tif", "rx").format == "geotiff"


def test_without_rasterio_the_extra_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path / "rx.tif")
    monkeypatch.setitem(sys.modules, "rasterio", None)
    assert "vrspray[office]" in refused("missing-library", path)
