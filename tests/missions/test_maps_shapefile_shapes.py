"""Shapes and indices that were damaged or are of another kind."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest
from shapely import Polygon

from companion.errors import MapError
from missions.maps import model
from missions.maps.shapefile import read_shapefile
from tests.missions.shapefiles import CELL, SOUTH, WEST, cell, simple, write


@pytest.mark.parametrize("suffix", [".shp", ".shx"])
def test_a_file_shorter_than_its_header_says_is_refused_even_at_a_whole_record(
    tmp_path: Path, suffix: str
) -> None:
    path = simple(tmp_path)
    path.with_suffix(".dbf").unlink()
    if suffix == ".shp":
        path.with_suffix(".shx").unlink()
    file = path.with_suffix(suffix)
    file.write_bytes(file.read_bytes()[: 100 + (8 + 128 if suffix == ".shp" else 8)])
    with pytest.raises(MapError, match="cut off") as caught:
        read_shapefile(path)
    assert caught.value.code == "truncated"


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (bytes(range(256)), "this is no .shp file"),
        (bytes(500), "this is no .shp file"),
        (b"PK", "this is no .shp file"),
        (b"", "the file is empty"),
    ],
    ids=["other", "zeros", "short", "empty"],
)
def test_what_is_no_shapefile_is_to_be_copied_or_exported_again(
    tmp_path: Path, content: bytes, says: str
) -> None:
    path = simple(tmp_path)
    path.write_bytes(content)
    with pytest.raises(MapError, match=says) as caught:
        read_shapefile(path)
    assert caught.value.code == "truncated"
    assert caught.value.fix == "copy the whole set of files, or export the map again"


def test_bytes_behind_the_last_record_do_no_harm(tmp_path: Path) -> None:
    path = simple(tmp_path)
    plain = read_shapefile(path)
    path.write_bytes(path.read_bytes() + bytes(50))
    assert read_shapefile(path).geometries == plain.geometries


@pytest.mark.parametrize(
    ("at", "value", "code"),
    [
        (0, 99, "broken-geometry"),  # a shape of no known type
        (36, -1, "truncated"),  # rings
        (36, 2**30, "truncated"),
        (40, -1, "truncated"),  # points
        (40, 2**30, "truncated"),
        (44, 1, "broken-geometry"),  # the first point of the first ring
    ],
)
def test_a_record_that_contradicts_itself_is_refused(
    tmp_path: Path, at: int, value: int, code: str
) -> None:
    path = simple(tmp_path)
    content = bytearray(path.read_bytes())
    struct.pack_into("<i", content, 108 + at, value)
    path.write_bytes(content)
    with pytest.raises(MapError, match="record 1 of its shapes is broken") as caught:
        read_shapefile(path)
    assert caught.value.code == code


@pytest.mark.parametrize("words", [0, -100, 49, 10**6, 2**31 - 1])
def test_an_index_that_leads_nowhere_is_refused(tmp_path: Path, words: int) -> None:
    path = simple(tmp_path)
    shx = path.with_suffix(".shx")
    content = bytearray(shx.read_bytes())
    struct.pack_into(">i", content, 108, words)
    shx.write_bytes(content)
    with pytest.raises(MapError, match="record 2 of its shapes is broken") as caught:
        read_shapefile(path)
    assert caught.value.code == "truncated"


def test_a_ring_without_an_area_is_left_out(tmp_path: Path) -> None:
    flat = Polygon([(WEST, SOUTH), (WEST + CELL, SOUTH), (WEST + 2 * CELL, SOUTH), (WEST, SOUTH)])
    path = write(tmp_path / "rx.shp", [flat, cell(0)], geometry_type="Polygon", rate=[1.0, 2.0])
    found = read_shapefile(path)
    assert found.skipped == {0: "no-area"}
    assert found.geometries[0] is None


def test_one_shape_named_many_times_counts_each_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = simple(tmp_path)
    path.with_suffix(".dbf").unlink()
    shx = path.with_suffix(".shx")
    content = bytearray(shx.read_bytes()[:108] + shx.read_bytes()[100:108] * 9)
    content[24:28] = struct.pack(">i", len(content) // 2)
    shx.write_bytes(content)
    monkeypatch.setattr(model, "MAX_VERTICES", 49)
    with pytest.raises(MapError, match="50 vertices are more than 49"):
        read_shapefile(path)


@pytest.mark.parametrize("name", ["Point", "PolyLine", "MultiPoint", "MultiPatch"])
def test_every_other_shape_is_named(tmp_path: Path, name: str) -> None:
    kinds = {"Point": 1, "PolyLine": 3, "MultiPoint": 8, "MultiPatch": 31}
    path = simple(tmp_path)
    content = bytearray(path.read_bytes())
    struct.pack_into("<i", content, 108, kinds[name])
    path.write_bytes(content)
    found = read_shapefile(path)
    assert found.skipped == {0: f"not-a-polygon:{name}"}
    assert found.geometries[0] is None
