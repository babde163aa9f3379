"""Trees and power lines from files: how far they reach, and what lacks a word is refused."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from shapely import LineString, Point, box
from shapely.geometry.base import BaseGeometry

from companion.cli.app import execute
from companion.errors import MapError
from missions.field import frame_of
from missions.maps.registry import read_area
from missions.reading_outline import read_obstacles
from tests.bench.missions import to_degrees
from tests.missions.test_missions_cli import written

pytestmark = pytest.mark.usefixtures("searched_briefly", "laid_out_once")

pyogrio = pytest.importorskip("pyogrio")

DRIVERS = {".geojson": "GeoJSON", ".shp": "ESRI Shapefile", ".kml": "LIBKML", ".gpkg": "GPKG"}
FIELD = box(0, 0, 160, 200)


def degrees(shape: Any) -> BaseGeometry:
    """Return a shape where the fields of these tests are."""
    found: BaseGeometry = to_degrees(shape)
    return found


def by_gdal(path: Path, shapes: Sequence[BaseGeometry], **columns: list[Any]) -> Path:
    """Write shapes in made-up metres with GDAL's own writer, in longitude and latitude."""
    driver = DRIVERS[path.suffix]
    if driver == "LIBKML" and driver not in pyogrio.list_drivers():
        driver = "KML"
    pyogrio.raw.write(
        path, shapely.to_wkb(np.array([degrees(each) for each in shapes])),
        [np.array(values) for values in columns.values()], list(columns), driver=driver,
        geometry_type=shapes[0].geom_type, crs="EPSG:4326",
    )  # fmt: skip
    return path


def planned(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str, str]:
    code = execute(["plan", "--force", *map(str, words)])
    out, err = capsys.readouterr()
    return code, out, err


def ways_m(path: Path) -> BaseGeometry:
    """Return all legs of a plan in the metres that fields are made up in."""
    features = json.loads(path.read_text())["features"]
    corner = shapely.get_coordinates(degrees(Point(0, 0)))[0]
    one = shapely.get_coordinates(degrees(Point(1, 1)))[0] - corner
    lines = [
        LineString((np.array(each["geometry"]["coordinates"]) - corner) / one)
        for each in features
        if each["geometry"]["type"] == "LineString"
    ]
    return shapely.union_all(lines)


@pytest.mark.parametrize("suffix", [".geojson", ".shp", ".kml", ".gpkg"])
def test_trees_are_kept_from_by_their_own_radius_and_the_buffer(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, suffix: str
) -> None:
    field = written(FIELD, tmp_path / "f.geojson")
    middles, radii = [Point(40, 50), Point(100, 120)], [2.0, 6.5]
    trees = by_gdal(tmp_path / f"trees{suffix}", middles, radius_m=radii)
    out = tmp_path / "m.geojson"
    code, _, err = planned(capsys, field, "--obstacle", trees, "--out", out)
    assert code == 0
    assert re.fullmatch(r"assumed, not given: .*\n", err)  # one line, no warning
    way = ways_m(out)
    for middle, radius_m in zip(middles, radii, strict=True):
        far_m = way.distance(middle)
        assert radius_m + 2.0 - 0.01 <= far_m
        # No tree is kept from by much more than it needs: half a swath would fit otherwise.
        assert far_m <= radius_m + 2.0 + 3.0


@pytest.mark.parametrize("suffix", [".geojson", ".shp", ".kml", ".gpkg"])
def test_a_power_line_keeps_its_corridor_free_of_every_way(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, suffix: str
) -> None:
    field = written(FIELD, tmp_path / "f.geojson")
    wire = LineString([(60, 30), (80, 120), (200, 180)])
    line = by_gdal(tmp_path / f"wire{suffix}", [wire], corridor_m=[16.0])
    out = tmp_path / "m.geojson"
    code, _, err = planned(capsys, field, "--obstacle", line, "--out", out)
    assert code == 0
    assert re.fullmatch(r"assumed, not given: .*\n", err)  # one line, no warning
    assert ways_m(out).distance(wire) >= 8.0 + 2.0 - 0.01


def test_one_radius_and_one_corridor_hold_for_all_that_have_none(tmp_path: Path) -> None:
    frame = frame_of(to_degrees(FIELD))
    trees = by_gdal(
        tmp_path / "t.geojson", [Point(40, 50), Point(90, 50)], radius_m=[4.0, math.nan]
    )
    found = read_obstacles(trees, frame, radius_m=7.0)
    assert sorted(each.beyond_m for each in found) == [4.0, 7.0]
    wire = by_gdal(tmp_path / "w.shp", [LineString([(0, 50), (160, 50)])], name=["20 kV"])
    (corridor,) = read_obstacles(wire, frame, corridor_m=12.0)
    assert corridor.beyond_m == 6.0


@pytest.mark.parametrize("buffer_m", [0.0, 2.0])
def test_the_ground_of_a_tree_holds_its_whole_circle_and_little_more(
    tmp_path: Path, buffer_m: float
) -> None:
    frame = frame_of(to_degrees(FIELD))
    (tree,) = read_obstacles(by_gdal(tmp_path / "t.shp", [Point(40, 50)], radius_m=[5.0]), frame)
    ground = tree.ground(frame, buffer_m)
    circle = ground.centroid.buffer(5.0 + buffer_m, quad_segs=64)
    assert ground.buffer(1e-6).covers(circle)
    assert ground.area < 1.02 * circle.area


@pytest.mark.parametrize(
    ("shape", "columns", "more", "said"),
    [
        (Point(40, 50), {"crown": [3.0]}, [], "is a point without radius_m"),
        (Point(40, 50), {"radius_m": ["3 m"]}, [], "radius_m of record 1 is '3 m'"),
        (Point(40, 50), {"radius_m": [-3.0]}, [], "above 0 and up to 100"),
        (Point(40, 50), {"radius_m": [1e9]}, [], "above 0 and up to 100"),
        (Point(40, 50), {"radius_m": [3.0], "height_m": [0.0]}, [], "height_m of record 1"),
        (LineString([(0, 9), (99, 9)]), {"kv": [20.0]}, [], "is a line without corridor_m"),
        (LineString([(0, 9), (99, 9)]), {"radius_m": [3.0]}, ["--obstacle-radius-m", "3"],
         "--corridor-m"),
    ],
)  # fmt: skip
def test_an_obstacle_without_its_reach_is_refused_in_one_line(
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    shape: BaseGeometry,
    columns: dict[str, list[Any]],
    more: list[str],
    said: str,
) -> None:
    field = written(FIELD, tmp_path / "f.geojson")
    file = by_gdal(tmp_path / "o.geojson", [shape], **columns)
    out = tmp_path / "m.plan"
    code, _, err = planned(capsys, field, "--obstacle", file, *more, "--out", out)
    assert (code, len(err.strip().splitlines())) == (2, 1)
    assert said in err and "o.geojson" in err
    assert not out.exists()


def test_trees_of_another_country_are_refused(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    field = written(FIELD, tmp_path / "f.geojson")
    file = tmp_path / "t.geojson"
    feature = {"type": "Feature", "properties": {"radius_m": 3},
               "geometry": {"type": "Point", "coordinates": [-11.0, 48.0]}}  # fmt: skip
    file.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    code, _, err = planned(capsys, field, "--obstacle", file, "--out", tmp_path / "m.plan")
    assert code == 2
    assert "its longitude is of the wrong hemisphere" in err


@pytest.mark.parametrize("coordinates", [[11.0], ["a", "b"], [], None, [[1, 2], [3]]])
def test_a_broken_point_is_no_obstacle_and_is_refused(tmp_path: Path, coordinates: object) -> None:
    file = tmp_path / "t.geojson"
    feature = {"type": "Feature", "properties": {"radius_m": 3},
               "geometry": {"type": "Point", "coordinates": coordinates}}  # fmt: skip
    file.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    with pytest.raises(MapError, match="record 1 is not an area, point or line"):
        read_obstacles(file, frame_of(to_degrees(FIELD)))


def test_points_are_still_no_boundary(tmp_path: Path) -> None:
    file = by_gdal(tmp_path / "t.geojson", [Point(40, 50)], radius_m=[4.0])
    with pytest.raises(MapError, match="no polygon in the file"):
        read_area(file)
