"""Shapefiles in folders and archives, and the metadata beside them."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
import shapely

from companion.errors import MapError
from missions.maps.shapefile import read_shapefile
from tests.missions.shapefiles import cell, simple, write


def zipped(folder: Path, inside: str = "", name: str = "rx.zip") -> Path:
    path = folder.parent / name
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(file for file in folder.rglob("*") if file.is_file()):
            archive.write(file, f"{inside}{file.relative_to(folder).as_posix()}")
    return path


@pytest.mark.parametrize("inside", ["", "Rx/", "RX/grower/farm/", "anything/"])
@pytest.mark.parametrize("upper", [False, True])
def test_a_zip_is_read_as_its_files_are(tmp_path: Path, inside: str, upper: bool) -> None:
    folder = tmp_path / "set"
    folder.mkdir()
    path = simple(folder)
    plain = read_shapefile(path)
    if upper:
        for file in sorted(folder.iterdir()):
            file.rename(file.with_suffix(file.suffix.upper()))
    found = read_shapefile(zipped(folder, inside))
    assert (found.sha256, found.columns, found.crs) == (plain.sha256, plain.columns, plain.crs)
    assert found.geometries == plain.geometries
    assert found.problems == ()


def test_a_folder_in_folders_is_searched(tmp_path: Path) -> None:
    deep = tmp_path / "Rx" / "grower" / "farm"
    deep.mkdir(parents=True)
    path = simple(deep)
    assert read_shapefile(tmp_path).sha256 == read_shapefile(path).sha256


def two_layers(tmp_path: Path, first: str, second: str) -> Path:
    """A folder with two shapefiles, the first with a rate of 1, the second with 2."""
    folder = tmp_path / "set"
    for rate, name in ((1.0, first), (2.0, second)):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        write(folder / name, [cell(0)], geometry_type="Polygon", rate=[rate], unit=["L/ha"])
    return folder


def rate_of(path: Path, name: str | None = None) -> object:
    (column,) = [one for one in read_shapefile(path, name).columns if one.name == "rate"]
    return column.values[0]


@pytest.mark.parametrize("pack", [lambda folder: folder, zipped])
def test_a_layer_is_chosen_by_stem_or_place(tmp_path: Path, pack: Callable[[Path], Path]) -> None:
    path = pack(two_layers(tmp_path, "Rx/a.shp", "Rx/b.shp"))
    with pytest.raises(MapError, match=r"the .shp files a, b; name one") as caught:
        read_shapefile(path)
    assert caught.value.code == "several-layers"
    for name in ("b", "Rx/b", "Rx/b.shp"):
        assert rate_of(path, name) == 2.0
    with pytest.raises(MapError, match=r"the .shp files a, b, and no 'c'") as caught:
        read_shapefile(path, "c")
    assert caught.value.code == "no-layer"


def test_stems_that_repeat_are_told_apart_by_their_place(tmp_path: Path) -> None:
    path = two_layers(tmp_path, "north/rx.shp", "south/rx.shp")
    with pytest.raises(MapError, match=r"the .shp files north/rx.shp, south/rx.shp;") as caught:
        read_shapefile(path)
    assert caught.value.code == "several-layers"
    with pytest.raises(MapError, match=r"north/rx.shp, south/rx.shp"):
        read_shapefile(path, "rx")
    assert rate_of(path, "south/rx") == 2.0


def test_a_boundary_in_a_folder_of_its_own_is_not_in_the_way(tmp_path: Path) -> None:
    assert rate_of(two_layers(tmp_path, "rx.shp", "boundary/edge.shp")) == 1.0


def test_a_map_in_the_folder_rx_competes_with_one_outside(tmp_path: Path) -> None:
    with pytest.raises(MapError, match="rx, edge") as caught:
        read_shapefile(two_layers(tmp_path, "edge.shp", "Rx/grower/rx.shp"))
    assert caught.value.code == "several-layers"


def test_a_zip_without_a_shapefile_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "set"
    folder.mkdir()
    (folder / "readme.txt").write_text("no map")
    with pytest.raises(MapError) as caught:
        read_shapefile(zipped(folder))
    assert caught.value.code == "unknown-format"


def test_two_tables_for_one_shapefile_are_refused(tmp_path: Path) -> None:
    path = simple(tmp_path)
    (tmp_path / "rx.DBF").write_bytes(path.with_suffix(".dbf").read_bytes())
    with pytest.raises(MapError, match="could both belong to rx") as caught:
        read_shapefile(path)
    assert caught.value.code == "several-files"


def test_a_stem_in_another_case_belongs_to_the_set_if_there_is_no_other(tmp_path: Path) -> None:
    path = simple(tmp_path)
    plain = read_shapefile(path)
    path.with_suffix(".dbf").rename(tmp_path / "RX.DBF")
    assert read_shapefile(path).columns == plain.columns


def metadata(tmp_path: Path, content: object, name: str = "rx-Deere-Metadata.json") -> None:
    text = content if isinstance(content, str) else json.dumps(content)
    (tmp_path / name).write_text(text, "utf-8")


def units(path: Path) -> dict[str, str | None]:
    return {column.name: column.unit for column in read_shapefile(path).columns}


@pytest.mark.parametrize("name", ["rx-Deere-Metadata.json", "RX-metadata.JSON"])
def test_units_come_from_the_metadata_beside(tmp_path: Path, name: str) -> None:
    path = write(
        tmp_path / "rx.shp", [cell(0)], geometry_type="Polygon", TargetRate=[15.0], Moisture=[1.0]
    )
    before = read_shapefile(path)
    assert units(path) == {"TargetRate": None, "Moisture": None}
    attributes = [
        {"Name": "TargetRateLiquid", "Unit": "gal1ac-1"},
        {"Name": "Moisture", "Unit": ""},
        {"Name": "Other", "Unit": "ha"},
    ]
    metadata(tmp_path, {"Version": "1.0", "DataAttributes": attributes}, name)
    assert units(path) == {"TargetRate": "gal1ac-1", "Moisture": None}
    assert read_shapefile(path).sha256 != before.sha256


@pytest.mark.parametrize(
    "content",
    [
        "",
        "{",
        "[" * 100_000,
        [],
        {"DataAttributes": {"Name": "rate"}},
        {"DataAttributes": [1, None, {"Name": 3, "Unit": "l"}, {"Name": "rate", "Unit": 3}]},
        {"DataAttributes": [{"Name": "rate", "Unit": "l1ha-1"}, {"Name": "RATE", "Unit": "gal"}]},
    ],
)
def test_metadata_that_says_nothing_clear_gives_no_unit(tmp_path: Path, content: object) -> None:
    path = simple(tmp_path)
    metadata(tmp_path, content)
    assert units(path)["rate"] is None


def test_the_real_maps_are_read_from_a_zip_as_from_their_folder(
    samples: Path, tmp_path: Path
) -> None:
    folder = samples / "01_shp_lha_multipolygon"
    path = tmp_path / "01.zip"
    with zipfile.ZipFile(path, "w") as archive:
        for file in sorted(folder.rglob("*.*")):
            archive.write(file, f"Rx/{file.relative_to(folder)}")
    with pytest.raises(MapError, match="Boundary") as caught:
        read_shapefile(path)
    assert caught.value.code == "several-layers"
    found = read_shapefile(path, "Rx")
    assert found.sha256 == read_shapefile(folder).sha256
    assert found.problems == ()
    parts = [
        part for area in found.geometries if area is not None for part in shapely.get_parts(area)
    ]
    assert len(parts) == 527
