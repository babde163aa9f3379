"""Files beside a GeoTIFF: read as GDAL reads them, by maps, measurements and heights alike."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio

from companion.errors import MapError
from missions.errors import PlanError
from missions.maps.assemble import map_of
from missions.maps.fields import Given
from missions.maps.geotiff import read_bands, read_geotiff
from missions.maps.registry import read_map
from missions.terrain import read_dem
from tests.missions.geotiff_files import PLACE, refused, write

Floats = np.ndarray[Any, np.dtype[np.float64]]
STORED = np.array([[185, 240, 185], [255, 185, 240], [240, 0, 185]], dtype="int16")
BAND = '<PAMDataset><PAMRasterBand band="1">{}</PAMRasterBand></PAMDataset>'
BESIDE = {
    "scale": BAND.format("<Scale>0.1</Scale>"),
    "scale and offset": BAND.format("<Offset>2</Offset><Scale>0.1</Scale>"),
    "no data": BAND.format("<NoDataValue>255</NoDataValue>"),
    "no data and scale": BAND.format("<NoDataValue>240</NoDataValue><Scale>0.5</Scale>"),
    "other case": BAND.format("<nodatavalue>240</nodatavalue><SCALE>0.5</SCALE>"),
    "place": "<PAMDataset><GeoTransform>9, 1e-4, 0, 48, 0, -1e-4</GeoTransform></PAMDataset>",
    "statistics": BAND.format('<Metadata><MDI key="STATISTICS_MAXIMUM">9</MDI></Metadata>'),
}


def packed(path: Path) -> Path:
    """Put a map and what lies beside it into an archive."""
    archive = path.parent / "package.zip"
    with zipfile.ZipFile(archive, "w") as out:
        for file in sorted(path.parent.glob(f"{path.name}*")):
            out.write(file, f"Rx/{file.name}")
    return archive


def of_map(path: Path) -> Floats:
    return map_of(
        read_geotiff(path), path, rate_field=None, crs=None, given=Given(unit="L/ha")
    ).cells.rates_l_ha  # type: ignore[union-attr]


def of_archive(path: Path) -> Floats:
    return read_map(packed(path), unit="L/ha").cells.rates_l_ha  # type: ignore[union-attr]


def of_folder(path: Path) -> Floats:
    return read_map(path.parent, unit="L/ha").cells.rates_l_ha  # type: ignore[union-attr]


def of_bands(path: Path) -> Floats:
    return read_bands(path).bands[0].values


def of_heights(path: Path) -> Floats:
    return read_dem(path).heights_m


READERS = [of_map, of_archive, of_folder, of_bands, of_heights]


def as_gdal_reads(path: Path) -> Floats:
    with rasterio.open(path) as source:
        values = source.read(1, masked=True).astype("float64").filled(np.nan)
        result: Floats = values * source.scales[0] + source.offsets[0]
        return result


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("text", BESIDE.values(), ids=BESIDE)
def test_numbers_are_what_gdal_makes_of_both_files(
    tmp_path: Path, text: str, reader: Callable[[Path], Floats]
) -> None:
    path = write(tmp_path / "rx.tif", STORED)
    Path(f"{path}.aux.xml").write_text(text)
    np.testing.assert_allclose(reader(path), as_gdal_reads(path))


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("nodata", [None, 240])
def test_a_mask_beside_the_map_hides_cells(
    tmp_path: Path, reader: Callable[[Path], Floats], nodata: int | None
) -> None:
    path = tmp_path / "rx.tif"
    mask = np.array([[0, 255, 255], [255, 0, 255], [255, 255, 255]], dtype="uint8")
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=False):
        write(path, STORED, nodata=nodata, mask=mask)
    assert Path(f"{path}.msk").exists()
    hidden = (mask == 0) | (nodata == STORED)
    np.testing.assert_array_equal(np.isnan(reader(path)), hidden)


def test_overviews_beside_the_map_change_nothing(tmp_path: Path) -> None:
    path = write(tmp_path / "rx.tif", np.tile(STORED, (40, 40)))
    before = of_map(path)
    with rasterio.Env(TIFF_USE_OVR=True), rasterio.open(path, "r+") as source:
        source.build_overviews([2, 4])
    assert Path(f"{path}.ovr").exists()
    np.testing.assert_array_equal(of_map(path), before)


def test_place_unit_and_crs_are_read_beside_the_map(tmp_path: Path) -> None:
    path = tmp_path / "rx.tif"
    write(path, STORED, units=("gal/ac",), profile="BASELINE")
    assert "<SRS" in Path(f"{path}.aux.xml").read_text()
    grid = read_geotiff(path)
    assert grid.transform == pytest.approx(PLACE[:6])
    assert grid.crs is not None and grid.crs.to_epsg() == 4326
    assert read_map(path).unit == "gal/ac"


def test_a_file_beside_the_map_changes_the_hash_of_the_map(tmp_path: Path) -> None:
    path = write(tmp_path / "rx.tif", STORED)
    before = read_geotiff(path).sha256
    Path(f"{path}.aux.xml").write_text(BESIDE["scale"])
    assert read_geotiff(path).sha256 != before


def test_other_files_that_a_file_beside_the_map_names_stay_shut(tmp_path: Path) -> None:
    from missions.maps.geotiff_file import _aux

    text = b"""<PAMDataset><Metadata domain="OVERVIEWS"><MDI key="OVERVIEW_FILE">/etc/x.vrt</MDI>
      </Metadata><Subdataset name="x"/><PAMRasterBand band="1"><Scale>2</Scale><Metadata
      domain="Z"><MDI key="b">/etc/x</MDI></Metadata></PAMRasterBand></PAMDataset>"""
    left = _aux(text, tmp_path / "rx.tif.aux.xml")
    assert b"/etc" not in left and b"Subdataset" not in left and b"<Scale>2</Scale>" in left


@pytest.mark.parametrize(
    ("name", "content", "code"),
    [
        ("rx.tif.aux.xml", b'<!DOCTYPE a [<!ENTITY b "c">]><PAMDataset/>', "xml-unsafe"),
        ("rx.tif.aux.xml", b"<PAMDataset><PAMRaster", "truncated"),
        ("rx.tif.aux.xml", BAND.format("<Scale>0,1</Scale>").encode(), "bad-rate"),
        ("rx.tif.aux.xml", BAND.format("<Scale>0</Scale>").encode(), "bad-rate"),
        ("rx.tif.aux.xml", BAND.format("<NoDataValue/>").encode(), "bad-rate"),
        ("rx.tif.msk", b"<VRTDataset/>", "truncated"),
        ("rx.tif.msk", b"II*\0", "truncated"),
        ("rx.aux", b"EHFA_HEADER_TAG", "file-beside"),
    ],
)
def test_what_cannot_be_read_beside_the_map_refuses_it(
    tmp_path: Path, name: str, content: bytes, code: str
) -> None:
    path = write(tmp_path / "rx.tif", STORED)
    (tmp_path / name).write_bytes(content)
    refused(code, path)
    refused(code, path, read_bands)
    refused(code, path, read_dem)


def test_a_mask_of_another_size_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "rx.tif", STORED)
    write(tmp_path / "other.tif", np.ones((2, 2), "uint8")).rename(f"{path}.msk")
    refused("file-beside", path)


def test_two_files_that_say_the_same_thing_are_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "rx.tif", STORED)
    for name in ("rx.tif.aux.xml", "rx.TIF.aux.xml"):
        (tmp_path / name).write_text(BESIDE["scale"])
    refused("several-files", path)


# --- The largest number of a byte ---


def byte_map(path: Path, *, at: tuple[int, int], most: int = 24, dtype: str = "uint8") -> Path:
    values = np.full((5, 5), 18, dtype=dtype)
    values[2, 3] = most
    values[at] = np.iinfo(dtype).max
    return write(path, values)


@pytest.mark.parametrize("dtype", ["uint8", "int8"])
def test_a_byte_of_255_at_the_edge_is_no_rate(tmp_path: Path, dtype: str) -> None:
    path = byte_map(tmp_path / "rx.tif", at=(0, 2), dtype=dtype)
    refused("nodata-undeclared", path)
    with pytest.raises(PlanError, match="may stand for no data"):
        read_dem(path)
    assert [one.code for one in read_bands(path).problems] == ["nodata-byte"]


def test_a_byte_of_255_among_low_rates_is_named(tmp_path: Path) -> None:
    found = read_map(byte_map(tmp_path / "rx.tif", at=(2, 2)), unit="L/ha")
    assert "nodata-byte" in [one.code for one in found.problems]


def test_a_byte_of_255_beside_rates_of_its_size_is_a_rate(tmp_path: Path) -> None:
    found = read_map(byte_map(tmp_path / "rx.tif", at=(0, 2), most=140), unit="L/ha")
    assert "nodata-byte" not in [one.code for one in found.problems]


def test_a_band_that_cannot_be_a_rate_is_refused_when_it_is_asked_for(tmp_path: Path) -> None:
    good = np.full((5, 5), 20, "uint16")
    bad = good.copy()
    bad[0, 0] = 65535
    path = write(tmp_path / "rx.tif", np.stack([good, bad]), names=("good", "bad"))
    assert read_map(path, unit="L/ha", rate_field="good").rate_field == "good"
    with pytest.raises(MapError, match="not declared as no data"):
        read_map(path, unit="L/ha", rate_field="bad")


def test_a_mask_of_each_band_beside_the_map_hides_cells(tmp_path: Path) -> None:
    path = write(tmp_path / "rx.tif", np.stack([STORED, STORED + 1]), names=("rate", "other"))
    masks = np.full((2, 3, 3), 255, "uint8")
    masks[0, 1, 1] = masks[1, 0, 0] = 0
    flags = {"INTERNAL_MASK_FLAGS_1": "0", "INTERNAL_MASK_FLAGS_2": "0"}
    write(tmp_path / "other.tif", masks, tags=flags)
    (tmp_path / "other.tif").rename(f"{path}.msk")
    first, second = read_geotiff(path).bands
    with rasterio.open(path) as source:
        assert not source.read_masks(2)[0, 0]
        assert not source.mask_flag_enums[0]
    assert np.argwhere(np.isnan(first.values)).tolist() == [[1, 1]]
    assert np.argwhere(np.isnan(second.values)).tolist() == [[0, 0]]
