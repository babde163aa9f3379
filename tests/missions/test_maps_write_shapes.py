"""Maps that we write as shapefile and GeoJSON, read back by us and by GDAL."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import shapely
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from shapely import MultiPolygon, Polygon, box

from companion.errors import MapError
from missions.maps import shapefile
from missions.maps.geojson import write_geojson
from missions.maps.model import MapZone
from missions.maps.registry import read_map
from missions.maps.shapefile import read_shapefile, write_shapefile

WEST, SOUTH, CELL = 114.543_123_456_789, 35.996_987_654_321, 0.001
Writer = Callable[..., None]
WRITERS: list[tuple[Writer, str]] = [
    (write_shapefile, "rx.shp"),
    (write_shapefile, "rx.zip"),
    (write_geojson, "rx.geojson"),
]
# A strip of this width along an outline is what rounding may move: 9 decimals are 0.1 mm.
SLIVER_DEG = 1e-9


def cell(column: int, row: int = 0) -> Polygon:
    west, south = WEST + column * CELL, SOUTH + row * CELL
    return box(west, south, west + CELL, south + CELL)


def holed(column: int) -> Polygon:
    return cell(column).difference(cell(column).buffer(-CELL / 5))


def zone(rate_l_ha: float | None, *parts: Polygon, name: str = "zone") -> MapZone:
    ground = parts[0] if len(parts) == 1 else MultiPolygon(parts)
    return MapZone(name=name, geometry=ground, rate_l_ha=rate_l_ha)


ZONES = [
    zone(12.5, cell(0), name="plain"),
    zone(0.0, holed(1), name="holed"),
    zone(None, cell(2), name="no rate"),
    zone(99_999.994, holed(3), cell(3).buffer(-CELL / 3), cell(5), name="island in a hole"),
    zone(1 / 3, shapely.orient_polygons(cell(6), exterior_cw=True), name="turned"),
    zone(0.001, shapely.orient_polygons(holed(7)), name='"quoted", <b> & \u5730\u5757 \u00fc'),
]


def same_ground(ours: shapely.Geometry, theirs: shapely.Geometry) -> bool:
    """Tell whether two areas differ by less than a sliver along their outlines."""
    difference = ours.symmetric_difference(theirs)
    return bool(difference.area <= SLIVER_DEG * ours.length) and (
        shapely.get_num_interior_rings(shapely.get_parts(ours)).tolist()
        == shapely.get_num_interior_rings(shapely.get_parts(theirs)).tolist()
    )


def seen_by_gdal(path: Path) -> tuple[list[shapely.Geometry], dict[str, list[object]], str]:
    source = f"/vsizip/{path}/{path.stem}.shp" if path.suffix == ".zip" else str(path)
    meta, _, geometry, fields = pyogrio.raw.read(source)
    columns = {
        str(name): values.tolist() for name, values in zip(meta["fields"], fields, strict=True)
    }
    return list(shapely.from_wkb(geometry)), columns, meta["crs"]


@pytest.mark.parametrize(("write", "name"), WRITERS)
def test_gdal_reads_what_was_written(tmp_path: Path, write: Writer, name: str) -> None:
    path = tmp_path / name
    write(ZONES, path)
    grounds, columns, crs = seen_by_gdal(path)
    assert crs == "EPSG:4326"
    assert columns["name"] == [one.name for one in ZONES]
    assert columns["unit"] == ["L/ha"] * len(ZONES)
    for one, ground, rate in zip(ZONES, grounds, columns["rate"], strict=True):
        assert same_ground(one.geometry, ground), one.name
        if one.rate_l_ha is None:
            assert isinstance(rate, float)
            assert np.isnan(rate)
        else:
            assert rate == pytest.approx(one.rate_l_ha, abs=0.0001)


@pytest.mark.parametrize(("write", "name"), WRITERS)
def test_our_reader_reads_what_was_written(tmp_path: Path, write: Writer, name: str) -> None:
    path = tmp_path / name
    write(ZONES, path)
    found = read_map(path)
    assert (found.crs, found.unit, found.rate_field) == ("EPSG:4326", "L/ha", "rate")
    assert found.problems == ()
    for one, read in zip(ZONES, found.zones, strict=True):
        assert read.name == one.name
        assert same_ground(one.geometry, read.geometry), one.name
        if one.rate_l_ha is None:
            assert read.rate_l_ha is None
        else:
            assert read.rate_l_ha == pytest.approx(one.rate_l_ha, abs=0.0001)


@pytest.mark.parametrize(("write", "name"), WRITERS)
def test_two_runs_give_the_same_bytes_and_leave_nothing_else(
    tmp_path: Path, write: Writer, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    contents = []
    for year in (2024, 2031):
        folder = tmp_path / str(year)
        folder.mkdir()
        monkeypatch.setattr("time.localtime", lambda *_, y=year: (y, 5, 6, 7, 8, 9, 0, 1, 0))
        write(ZONES, folder / name)
        contents.append({file.name: file.read_bytes() for file in sorted(folder.iterdir())})
    assert contents[0] == contents[1]
    expected = [f"rx{suffix}" for suffix in (".cpg", ".dbf", ".prj", ".shp", ".shx")]
    assert list(contents[0]) == (expected if name == "rx.shp" else [name])


@pytest.mark.parametrize(("write", "name"), WRITERS)
def test_a_map_takes_the_place_of_an_older_one(tmp_path: Path, write: Writer, name: str) -> None:
    path = tmp_path / name
    write(ZONES, path)
    write(ZONES[:1], path)
    assert [one.rate_l_ha for one in read_map(path).zones] == [12.5]


@pytest.mark.parametrize(("write", "name"), WRITERS)
def test_what_cannot_be_written_is_said_and_leaves_nothing(
    tmp_path: Path, write: Writer, name: str
) -> None:
    with pytest.raises(MapError) as caught:
        write(ZONES, tmp_path / "none" / name)
    assert caught.value.code == "not-written"
    with pytest.raises(MapError) as caught:
        write([], tmp_path / name)
    assert caught.value.code == "no-polygon"
    assert list(tmp_path.iterdir()) == []


def test_a_shapefile_half_written_is_no_map(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "rx.shp"
    write_shapefile(ZONES, path)
    whole = shapefile.write_whole

    def fail_at_the_index(path: Path, content: bytes) -> None:
        if path.suffix == ".shx":
            raise MapError("disk full")
        whole(path, content)

    monkeypatch.setattr(shapefile, "write_whole", fail_at_the_index)
    with pytest.raises(MapError, match="disk full"):
        write_shapefile(ZONES[:1], path)
    assert not path.exists()


def rings_of(path: Path) -> list[tuple[bool, bool]]:
    """Return of each ring whether it is a shell, and whether it turns anticlockwise."""
    turns = []
    for geometry in json.loads(path.read_text("utf-8"))["features"]:
        coordinates = geometry["geometry"]["coordinates"]
        parts = [coordinates] if geometry["geometry"]["type"] == "Polygon" else coordinates
        for part in parts:
            turns += [
                (index == 0, shapely.LinearRing(ring).is_ccw) for index, ring in enumerate(part)
            ]
    return turns


def test_shells_of_geojson_turn_anticlockwise_and_holes_the_other_way(tmp_path: Path) -> None:
    write_geojson(ZONES, tmp_path / "rx.geojson")
    turns = rings_of(tmp_path / "rx.geojson")
    assert len(turns) == 11
    assert all(shell == anticlockwise for shell, anticlockwise in turns)


def test_members_of_geojson_stand_in_a_fixed_order(tmp_path: Path) -> None:
    path = tmp_path / "rx.geojson"
    write_geojson([zone(12.5, box(1.0, 2.0, 3.0, 4.0), name="a")], path)
    assert path.read_text("utf-8") == (
        '{"type": "FeatureCollection",\n"features": [\n'
        '{"type": "Feature", "properties": {"name": "a", "rate": 12.5, "unit": "L/ha"}, '
        '"geometry": {"type": "Polygon", "coordinates": '
        "[[[3.0, 2.0], [3.0, 4.0], [1.0, 4.0], [1.0, 2.0], [3.0, 2.0]]]}}\n]}\n"
    )


def test_shells_of_a_shapefile_turn_clockwise(tmp_path: Path) -> None:
    path = tmp_path / "rx.shp"
    write_shapefile(ZONES[:2], path)
    content = path.read_bytes()
    first = np.frombuffer(content, "<f8", 10, 108 + 48).reshape(-1, 2)
    second = np.frombuffer(content, "<f8", 20, 108 + 128 + 8 + 52).reshape(-1, 2)
    rings = (first, second[:5], second[5:])
    assert [shapely.LinearRing(ring).is_ccw for ring in rings] == [False, False, True]


def test_the_boundary_goes_where_the_format_has_a_place(tmp_path: Path) -> None:
    boundary = MultiPolygon([box(WEST, SOUTH, WEST + 9 * CELL, SOUTH + CELL)])
    write_geojson(ZONES, tmp_path / "rx.geojson", boundary=boundary)
    found = read_map(tmp_path / "rx.geojson")
    assert found.boundary is not None
    assert same_ground(boundary, found.boundary)
    assert len(found.zones) == len(ZONES)
    assert len(seen_by_gdal(tmp_path / "rx.geojson")[0]) == len(ZONES)
    write_shapefile(ZONES, tmp_path / "rx.zip", boundary=boundary)
    assert len(read_shapefile(tmp_path / "rx.zip").geometries) == len(ZONES)
    (outline,) = read_shapefile(tmp_path / "rx.zip", "boundary").geometries
    assert outline is not None
    assert same_ground(boundary, outline)
    write_shapefile(ZONES, tmp_path / "rx.shp", boundary=boundary)
    assert len(read_map(tmp_path / "rx.shp").zones) == len(ZONES)


def test_names_are_cut_between_letters_and_kept_on_one_line(tmp_path: Path) -> None:
    path = tmp_path / "rx.shp"
    names = ["\u5730" * 100, " two\nlines ", "", "a\0b", "half \ud800 letter"]
    write_shapefile([zone(1.0, cell(i), name=name) for i, name in enumerate(names)], path)
    expected = ["\u5730" * 84, "two lines", None, "a b", "half ? letter"]
    assert list(read_shapefile(path).columns[0].values) == expected
    assert seen_by_gdal(path)[1]["name"] == expected
    write_geojson([zone(1.0, cell(0), name=name) for name in names], tmp_path / "rx.geojson")
    assert json.loads((tmp_path / "rx.geojson").read_text("utf-8"))["features"][4]["properties"][
        "name"
    ] == ("half ? letter")


def test_a_zip_holds_the_set_without_folders(tmp_path: Path) -> None:
    write_shapefile(ZONES, tmp_path / "Rx Nord.zip")
    with zipfile.ZipFile(tmp_path / "Rx Nord.zip") as archive:
        assert archive.testzip() is None
        assert archive.namelist() == [
            f"Rx Nord{suffix}" for suffix in (".cpg", ".dbf", ".prj", ".shp", ".shx")
        ]


@given(
    rates=st.lists(st.none() | st.floats(0.0, 99_999.0), min_size=1, max_size=5),
    angle=st.floats(0.0, 6.28),
    size=st.floats(1e-5, 1e-2),
)
@hypothesis_settings(max_examples=40)
@pytest.mark.parametrize(("write", "name"), WRITERS)
def test_rates_and_ground_come_back(
    tmp_path_factory: pytest.TempPathFactory,
    write: Writer,
    name: str,
    rates: Sequence[float | None],
    angle: float,
    size: float,
) -> None:
    path = tmp_path_factory.getbasetemp() / name
    plot = shapely.affinity.rotate(
        box(WEST, SOUTH, WEST + size, SOUTH + size / 2), angle, use_radians=True
    )
    zones = [
        zone(rate, shapely.affinity.translate(plot, xoff=2 * index * size), name=str(index))
        for index, rate in enumerate(rates)
    ]
    write(zones, path)
    for one, read in zip(zones, read_map(path, rate_field="rate").zones, strict=True):
        assert same_ground(one.geometry, read.geometry)
        assert (read.rate_l_ha is None) == (one.rate_l_ha is None)
        assert abs((read.rate_l_ha or 0.0) - (one.rate_l_ha or 0.0)) <= 0.0001
