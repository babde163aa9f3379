"""Terrain: elevation models read, points where the ground bends, speeds that climb allows."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from shapely import box

from companion.cli.app import execute
from missions.demand import Uniform
from missions.errors import PlanError
from missions.field import build_field
from missions.files.items import ABOVE_GROUND, CHANGE_SPEED, TAKEOFF, WAYPOINT, items_of
from missions.files.write import write_plan
from missions.plan import Plan, Settings
from missions.planner import plan_mission
from missions.strips import Floats
from missions.surroundings import Surroundings
from missions.terrain import WGS84_CRS, Dem, Terrain, kept_points, read_dem
from tests.bench.missions import FRAME, to_degrees
from tests.missions.test_missions_cli import run, written

pytestmark = pytest.mark.usefixtures("searched_briefly", "laid_out_once")

Height = Callable[[Floats, Floats], Floats]


def hill(east_m: Floats, north_m: Floats) -> Floats:
    """Return a hill of 12 m in the middle of a field of 200 m by 120 m."""
    return 500.0 + 12.0 * np.exp(-(((east_m - 100.0) / 40.0) ** 2 + ((north_m - 60.0) / 60.0) ** 2))


def dem_of(height: Height, *, cell_m: float = 5.0, low_m: float = -100.0) -> Dem:
    """Return a model of the frame's own metres, from `low_m` on for 500 m."""
    posts = low_m + np.arange(0.0, 500.0, cell_m)
    east, north = np.meshgrid(posts, posts[::-1])
    return Dem(
        name="dem.tif", heights_m=height(east, north),
        transform=(cell_m, 0.0, posts[0], 0.0, -cell_m, posts[-1]), crs=FRAME.crs,
    )  # fmt: skip


def plan_over(terrain: Terrain, **changes: Any) -> Plan:
    field = build_field(to_degrees(box(0, 0, 200, 120)), swath_width_m=6.0, frame=FRAME)
    settings = Settings(swath_width_m=6.0, speed_m_s=6.0, moves=0, angle_deg=90.0, **changes)
    return plan_mission(
        field, settings, Uniform(rate_l_ha=20.0), depots=(FRAME.to_geographic(0.0, 0.0),),
        around=Surroundings(terrain=terrain),
    )  # fmt: skip


def flown(plan: Plan, number: int = 0) -> list[tuple[float, float, float]]:
    """Return east, north and height above home of a sortie's waypoints, take-off first."""
    return [
        (*FRAME.to_local(item.latitude_deg, item.longitude_deg), item.altitude_m)
        for item in items_of(plan, plan.sorties[number])
        if item.has_place
    ]


@pytest.mark.parametrize("tolerance_m", [0.3, 0.5, 2.0])
def test_heights_above_home_keep_the_height_above_ground(tolerance_m: float) -> None:
    terrain = Terrain(dem=dem_of(hill), frame=FRAME, tolerance_m=tolerance_m)
    plan = plan_over(terrain)
    home_m = float(hill(np.zeros(1), np.zeros(1))[0])
    places = np.array(flown(plan))
    worst = 0.0
    for (x0, y0, z0), (x1, y1, z1) in pairwise(places):
        share = np.linspace(0.0, 1.0, 60)
        ground = terrain.heights_m(
            np.column_stack([x0 + share * (x1 - x0), y0 + share * (y1 - y0)])
        )
        above = home_m + z0 + share * (z1 - z0) - ground
        worst = max(worst, float(np.abs(above - 3.5).max()))
    # Posts are 5 m apart, so that between the places looked at the ground hardly bends.
    assert 0.05 < worst <= tolerance_m + 0.06


def test_points_are_added_only_where_the_ground_needs_them() -> None:
    plane = Terrain(dem=dem_of(lambda e, n: 400.0 + 0.05 * e - 0.02 * n), frame=FRAME)
    flat = len(flown(plan_over(plane)))
    over_hill = [
        len(flown(plan_over(Terrain(dem=dem_of(hill), frame=FRAME, tolerance_m=each))))
        for each in (0.25, 0.5, 1.0, 5.0)
    ]
    assert over_hill[0] > over_hill[1] > over_hill[2] > over_hill[3] >= flat
    settings = Settings(swath_width_m=6.0, speed_m_s=6.0, moves=0, angle_deg=90.0)
    field = build_field(to_degrees(box(0, 0, 200, 120)), swath_width_m=6.0, frame=FRAME)
    plain = plan_mission(
        field, settings, Uniform(rate_l_ha=20.0), depots=(FRAME.to_geographic(0.0, 0.0),)
    )
    assert flat == len(flown(plain))


def test_an_autopilot_that_knows_the_ground_gets_heights_above_it() -> None:
    plan = plan_over(Terrain(dem=dem_of(hill), frame=FRAME, by_vehicle=True))
    items = items_of(plan, plan.sorties[0])
    ways = [item for item in items if item.command == WAYPOINT]
    assert {(item.frame, item.altitude_m) for item in ways} == {(ABOVE_GROUND, 3.5)}
    assert [item.frame for item in items if item.command == TAKEOFF] == [3]


def test_slopes_are_flown_as_slowly_as_climb_and_descent_allow() -> None:
    # 50 m up a slope of 40 %, then level: 2 m/s of climb allow 5 m/s; down it 1.5 allow 3.7.
    def ramp(east_m: Floats, _: Floats) -> Floats:
        return np.clip(east_m - 60.0, 0.0, 50.0) * 0.4

    terrain = Terrain(dem=dem_of(ramp, cell_m=1.0), frame=FRAME, climb_m_s=2.0)
    plan = plan_over(terrain)
    checked = 0
    for leg in (leg for sortie in plan.sorties for leg in sortie.legs):
        profile = terrain.profile(leg.points)
        slope = np.diff(profile.ground_m) / np.maximum(np.diff(profile.at_m), 1e-9)
        if leg.kind != "spray" or leg.length_m < 20.0 or abs(slope).max() < 0.39:
            continue
        checked += 1
        assert leg.speed_m_s == pytest.approx(5.0 if slope.max() > 0.39 else 3.7)
    assert checked >= 8
    level = plan_over(Terrain(dem=dem_of(lambda e, n: 0.0 * e + 7.0), frame=FRAME))
    assert plan.volume_l == pytest.approx(level.volume_l)
    assert plan.flight_s > level.flight_s + 20.0
    orders = {i.params[1] for i in items_of(plan, plan.sorties[0]) if i.command == CHANGE_SPEED}
    assert {6.0, 5.0, 3.7} <= orders


def test_ground_too_steep_to_fly_is_refused_with_the_place() -> None:
    def cliff(east_m: Floats, _: Floats) -> Floats:
        return np.where(east_m > 100.0, 30.0, 0.0)

    terrain = Terrain(dem=dem_of(cliff, cell_m=1.0), frame=FRAME)
    with pytest.raises(PlanError, match=r"(rises|falls) \d+\.\d m on .* near 48\.00.*max_m_s"):
        plan_over(terrain)


def test_the_return_over_a_hill_is_warned_of() -> None:
    high = plan_over(Terrain(dem=dem_of(hill), frame=FRAME))
    assert any("RTL_ALT" in warning for warning in high.warnings)
    low = plan_over(Terrain(dem=dem_of(lambda e, n: 500.0 + 0.4 * (hill(e, n) - 500.0)),
                            frame=FRAME))  # fmt: skip
    assert not low.warnings


@pytest.mark.parametrize(
    ("height", "low_m"),
    [
        (lambda e, n: 100.0 + 0.0 * e, 50.0),
        (lambda e, n: np.where((abs(e - 150.0) < 6.0) & (abs(n - 60.0) < 6.0), np.nan, 1.0), -100),
        (lambda e, n: 0.0 * e - 32768.0, -100.0),
    ],
)
def test_a_model_without_heights_under_the_field_is_refused(height: Height, low_m: float) -> None:
    with pytest.raises(PlanError, match=r"^dem\.tif has no height at 48\.0"):
        plan_over(Terrain(dem=dem_of(height, low_m=low_m), frame=FRAME))


def test_heights_between_posts_are_bilinear_and_none_beyond() -> None:
    dem = Dem(
        name="d", heights_m=np.array([[0.0, 10.0], [20.0, 50.0]]),
        transform=(1.0, 0.0, 10.0, 0.0, -1.0, 51.0), crs=WGS84_CRS,
    )  # fmt: skip
    at = dem.at(
        np.array([51.0, 50.0, 50.5, 50.25, 49.99]), np.array([10.0, 11.0, 10.5, 10.0, 10.5])
    )
    assert at[:4] == pytest.approx([0.0, 50.0, 20.0, 15.0])
    assert math.isnan(at[4])


def tile(path: Path, height: Callable[[Floats, Floats], Floats], posts: int = 1201) -> Path:
    """Write an SRTM tile of heights by latitude and longitude."""
    latitude = 49.0 - np.arange(posts) / (posts - 1)
    longitude = 11.0 + np.arange(posts) / (posts - 1)
    lon, lat = np.meshgrid(longitude, latitude)
    path.write_bytes(np.round(height(lat, lon)).astype(">i2").tobytes())
    return path


def test_an_srtm_tile_lies_where_its_name_says(tmp_path: Path) -> None:
    path = tile(tmp_path / "N48E011.hgt", lambda lat, lon: 1000 * (lat - 48) + 2000 * (lon - 11))
    dem = read_dem(path)
    found = dem.at(np.array([48.0, 48.5, 48.75]), np.array([11.0, 11.25, 12.0]))
    assert found == pytest.approx([0.0, 1000.0, 2750.0], abs=0.6)
    assert np.isnan(dem.at(np.array([47.999, 49.001]), np.array([11.5, 11.5]))).all()


def test_a_missing_post_of_a_tile_is_no_height(tmp_path: Path) -> None:
    path = tile(tmp_path / "n48e011.HGT", lambda lat, lon: np.where(lat < 48.5, 100.0, -32768.0))
    found = read_dem(path).at(np.array([48.2, 48.7]), np.array([11.5, 11.5]))
    assert found[0] == 100.0
    assert math.isnan(found[1])


def geotiff(path: Path, values: Any, **more: Any) -> Path:
    """Write heights around the frame's origin in UTM 32, cells of 10 m."""
    rasterio = pytest.importorskip("rasterio")
    from pyproj import Transformer

    to_utm = Transformer.from_crs(4326, 32632, always_xy=True)
    x, y = to_utm.transform(11.0, 48.0)
    unit = more.pop("unit", None)
    profile: dict[str, Any] = {
        "driver": "GTiff", "height": values.shape[0], "width": values.shape[1], "count": 1,
        "dtype": values.dtype.name, "crs": "EPSG:32632",
        "transform": rasterio.Affine(
            10.0, 0.0, x - 205.0, 0.0, -10.0, y - 195.0 + 10.0 * values.shape[0]
        ),
    } | more  # fmt: skip
    with rasterio.open(path, "w", **profile) as target:
        target.write(values, 1)
        if unit is not None:
            target.units = (unit,)
    return path


@pytest.mark.parametrize(("unit", "metres"), [(None, 1.0), ("ft", 0.3048), ("metre", 1.0)])
def test_a_geotiff_has_its_heights_at_the_middles_of_cells(
    tmp_path: Path, unit: str | None, metres: float
) -> None:
    rows, columns = np.mgrid[0:60, 0:60]
    values = (100.0 + 2.0 * columns + 3.0 * rows).astype(np.float32)
    dem = read_dem(geotiff(tmp_path / "d.tif", values, unit=unit, nodata=-9999.0))
    # The origin of the frame is 205 m right of the western and 405 m below the northern edge.
    found = dem.at(np.array([48.0]), np.array([11.0]))
    assert found[0] == pytest.approx((100.0 + 2.0 * 20.0 + 3.0 * 40.0) * metres, abs=0.01)


def test_heights_in_an_unknown_unit_are_refused(tmp_path: Path) -> None:
    values = np.full((4, 4), 3.0, dtype=np.float32)
    with pytest.raises(PlanError, match="'fathom' are not known"):
        read_dem(geotiff(tmp_path / "d.tif", values, unit="fathom"))


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("dem.asc", b"", "GeoTIFF"),
        ("alps.hgt", b"", "N48E011.hgt"),
        ("N48E011.hgt", b"12", "2 bytes are not a tile"),
        ("dem.tif", b"no tiff", "not a TIFF"),
        (None, b"", "no such file"),
    ],
)
def test_a_model_that_cannot_be_read_is_one_line(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, name: str | None, content: bytes, says: str
) -> None:
    field = written(box(0, 0, 100, 100), tmp_path / "f.geojson")
    path = tmp_path / (name or "none.tif")
    if name is not None:
        path.write_bytes(content)
    code, found, err = run(capsys, field, "--terrain", path, "--out", tmp_path / "m.plan")
    assert (code, len(err.strip().splitlines())) == (2, 1)
    assert says in found["error"]
    assert not (tmp_path / "m.plan").exists()


@pytest.mark.parametrize(("autopilot", "frames"), [("ardupilot", {10}), ("px4", {3})])
def test_the_command_follows_a_model_as_the_autopilot_can(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, autopilot: str, frames: set[int]
) -> None:
    field = written(box(10, 10, 210, 130), tmp_path / "f.geojson")
    path = tile(tmp_path / "N48E011.hgt", lambda lat, lon: 5000.0 * (lon - 11.0), posts=3601)
    code, found, _ = run(
        capsys, field, "--terrain", path, "--autopilot", autopilot, "--depot", "48.0001,11.0001",
        "--out", tmp_path / "m.plan",
    )  # fmt: skip
    assert code == 0
    assert found["terrain"]["file"] == "N48E011.hgt"
    assert found["terrain"]["highest_m"] > 10.0
    mission = json.loads((tmp_path / "m.plan").read_text())["mission"]
    ways = [item for item in mission["items"] if item["command"] == WAYPOINT]
    assert {item["frame"] for item in ways} == frames
    assert mission["firmwareType"] == {"ardupilot": 3, "px4": 12}[autopilot]
    heights = [item["params"][6] for item in ways]
    assert (max(heights) - min(heights) > 5.0) == (autopilot == "px4")


def test_a_tile_beside_the_field_writes_no_file(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    field = written(box(-500, 0, -100, 120), tmp_path / "f.geojson")
    path = tile(tmp_path / "N48E011.hgt", lambda lat, lon: 0.0 * lat)
    code, found, err = run(capsys, field, "--terrain", path, "--out", tmp_path / "m.plan")
    assert (code, len(err.strip().splitlines())) == (2, 1)
    assert "N48E011.hgt has no height at 48.00" in found["error"]
    assert list(tmp_path.glob("m*")) == []


def test_nothing_is_kept_of_a_straight_profile_but_its_ends() -> None:
    at = np.linspace(0.0, 100.0, 50)
    assert kept_points(at, 0.3 * at + 7.0, 0.01).tolist() == [0, 49]
    assert execute(["plan", "--force", "--help"]) == 0


def test_kml_follows_the_ground_above_the_sea(tmp_path: Path) -> None:
    plan = plan_over(Terrain(dem=dem_of(hill), frame=FRAME))
    path = write_plan(plan, tmp_path / "m.kml")[0]
    root = ElementTree.parse(path)
    assert {each.text for each in root.iterfind(".//{*}altitudeMode")} == {"absolute"}
    rows = [
        [float(part) for part in word.split(",")]
        for each in root.iterfind(".//{*}LineString/{*}coordinates")
        for word in (each.text or "").split()
    ]
    places = np.array([FRAME.to_local(latitude, longitude) for longitude, latitude, _ in rows])
    above_m = np.array(rows)[:, 2] - hill(places[:, 0], places[:, 1])
    assert np.abs(above_m - 3.5).max() < 0.2  # cells of 5 m on a hill
    assert np.array(rows)[:, 2].max() > 514.0
