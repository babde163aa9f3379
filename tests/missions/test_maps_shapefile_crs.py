"""What the .prj of a shapefile says, and where the map would lie by it."""

from __future__ import annotations

from pathlib import Path

import pytest
from pyproj import CRS
from shapely import Geometry, box

from companion.errors import MapError
from missions.maps.registry import read_map
from tests.missions.shapefiles import cell, simple, write

UTM_50 = (
    'PROJCS["WGS_1984_UTM_Zone_50N",GEOGCS["GCS_WGS_1984",DATUM["D_WGS_1984",'
    'SPHEROID["WGS_1984",6378137.0,298.257223563]],PRIMEM["Greenwich",0.0],'
    'UNIT["Degree",0.0174532925199433]],PROJECTION["Transverse_Mercator"],'
    'PARAMETER["False_Easting",500000.0],PARAMETER["False_Northing",0.0],'
    'PARAMETER["Central_Meridian",117.0],PARAMETER["Scale_Factor",0.9996],'
    'PARAMETER["Latitude_Of_Origin",0.0],UNIT["Meter",1.0]]'
)
SQUARE_M = box(278_000, 3_986_000, 278_400, 3_986_100)


def metres(tmp_path: Path, prj: str | None, ground: Geometry = SQUARE_M) -> Path:
    path = write(tmp_path / "rx.shp", [ground], geometry_type="Polygon", rate=[1.0], unit=["L/ha"])
    path.with_suffix(".prj").unlink()
    if prj is not None:
        path.with_suffix(".prj").write_text(prj)
    return path


@pytest.mark.parametrize(
    "prj", [UTM_50, CRS.from_epsg(32650).to_wkt("WKT1_GDAL"), CRS.from_epsg(32650).to_wkt()]
)
def test_every_dialect_of_a_prj_says_the_same(tmp_path: Path, prj: str) -> None:
    found = read_map(metres(tmp_path, prj))
    assert found.crs == "EPSG:32650"
    assert found.zones[0].geometry.bounds[0] == pytest.approx(117 - 222 / 90.2, abs=0.01)
    assert found.problems == ()


@pytest.mark.parametrize(
    ("prj", "crs"),
    [
        ('GEOGCS["GCS_WGS_1984",DATUM["D_WGS_1984",SPHEROID["WGS_1984",6378137.0,298.257223563]],'
         'PRIMEM["Greenwich",0.0],UNIT["Degree",0.0174532925199433]]', "EPSG:4326"),
        ("EPSG:4326", "EPSG:4326"),
    ],
)  # fmt: skip
def test_degrees_of_wgs84_need_no_word(tmp_path: Path, prj: str, crs: str) -> None:
    path = simple(tmp_path)
    path.with_suffix(".prj").write_text(prj)
    found = read_map(path)
    assert (found.crs, found.problems) == (crs, ())


@pytest.mark.parametrize(
    "prj", ["+init=epsg:4326", "+init=/etc/passwd:1", "EPSG:4978", "EPSG:4326" + " " * 10**5]
)
def test_a_prj_that_is_of_no_map_is_refused(tmp_path: Path, prj: str) -> None:
    path = simple(tmp_path)
    path.with_suffix(".prj").write_text(prj)
    with pytest.raises(MapError, match="not a usable coordinate reference system") as caught:
        read_map(path)
    assert caught.value.code == "wrong-crs"


def test_a_damaged_prj_is_not_repeated_in_the_refusal(tmp_path: Path) -> None:
    path = simple(tmp_path)
    prj = path.with_suffix(".prj")
    prj.write_text(prj.read_text()[:60])
    with pytest.raises(MapError) as caught:
        read_map(path)
    assert caught.value.code == "wrong-crs"
    assert "coordinate reference system (it is unknown or damaged);" in str(caught.value)
    assert "GEOGCS" not in str(caught.value)


def test_east_and_north_exchanged_are_refused(tmp_path: Path) -> None:
    turned = box(3_986_000, 278_000, 3_986_100, 278_400)
    with pytest.raises(MapError, match="look exchanged") as caught:
        read_map(metres(tmp_path, UTM_50, turned))
    assert caught.value.code == "swapped-axes"


def test_latitude_first_is_refused_where_the_crs_is_not_used(tmp_path: Path) -> None:
    path = simple(tmp_path)
    write(
        path,
        [box(48.0, 11.0, 48.001, 11.001)],  # Bavaria, turned round: a valid place in Yemen
        crs="EPSG:4258",
        geometry_type="Polygon",
        rate=[1.0],
        unit=["L/ha"],
    )
    with pytest.raises(MapError, match="look exchanged") as caught:
        read_map(path)
    assert caught.value.code == "swapped-axes"


def test_a_map_a_little_beyond_where_its_crs_is_used_is_not_turned_round(tmp_path: Path) -> None:
    path = write(
        tmp_path / "rx.shp",
        [box(40.0, 37.0, 40.001, 37.001)],  # EPSG:4258 is meant for up to 38 degrees east
        crs="EPSG:4258",
        geometry_type="Polygon",
        rate=[1.0],
        unit=["L/ha"],
    )
    assert read_map(path).zones[0].geometry.bounds[0] == pytest.approx(40.0)


def test_degrees_under_a_prj_in_metres_are_refused(tmp_path: Path) -> None:
    with pytest.raises(MapError, match="look like degrees") as caught:
        read_map(metres(tmp_path, UTM_50, cell(0)))
    assert caught.value.code == "wrong-crs"


def test_a_map_far_from_where_its_crs_is_used_is_refused(tmp_path: Path) -> None:
    path = metres(tmp_path, CRS.from_epsg(28354).to_wkt("WKT1_ESRI"))
    with pytest.raises(MapError, match="EPSG:28354, which is meant for x 138") as caught:
        read_map(path)
    assert caught.value.code == "wrong-crs"


def test_a_map_drawn_in_the_next_zone_is_read(tmp_path: Path) -> None:
    ground = box(1_100_000, 3_986_000, 1_100_400, 3_986_100)
    assert read_map(metres(tmp_path, UTM_50, ground)).zones[0].geometry.bounds[0] > 123.0


def test_metres_without_a_prj_are_called_so(tmp_path: Path) -> None:
    with pytest.raises(MapError, match=r"no \.prj.*look like metres.*--crs") as caught:
        read_map(metres(tmp_path, None))
    assert caught.value.code == "no-crs"
