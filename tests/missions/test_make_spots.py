"""`make spots`, judged by chance: weeds, aircraft, lags and wind each astray, a hundred times over.

The judge reads the map with GDAL and knows nothing of how it was made. It moves what is sprayed
along and across by errors of its own drawing, and looks which weeds lie in it.
"""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import pytest
import shapely
import typer
from pyproj import CRS, Transformer

from companion.core.frame import LocalFrame
from companion.errors import VrsprayError
from missions.errors import PlanError
from missions.make.spots import Budget, Part, misses, openings
from missions.make.spots_cli import read_weeds, spots

pytestmark = pytest.mark.usefixtures("searched_briefly", "laid_out_once")

ROOT = Path(__file__).resolve().parents[2]
EXAMPLE = ROOT / "examples" / "zones" / "config.toml"
PLANE = CRS.from_proj4("+proj=tmerc +lat_0=48.27 +lon_0=16.9 +k=1 +datum=WGS84")
TO_DEGREES = Transformer.from_crs(PLANE, 4326, always_xy=True)
TO_METRES = Transformer.from_crs(4326, PLANE, always_xy=True)
LENGTH_M, WIDTH_M = 150.0, 60.0
SPEED_M_S = 5.0
app = typer.Typer(add_completion=False)
app.command()(spots)


def moved(geometry: Any, there: Transformer) -> Any:
    return shapely.transform(
        geometry, lambda at: np.column_stack(there.transform(at[:, 0], at[:, 1]))
    )


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("spots")
    outline = moved(shapely.box(0.0, 0.0, LENGTH_M, WIDTH_M), TO_DEGREES)
    feature = {
        "type": "Feature",
        "properties": {},
        "geometry": json.loads(shapely.to_geojson(outline)),
    }
    (folder / "boundary.geojson").write_text(
        json.dumps({"type": "FeatureCollection", "features": [feature]})
    )
    (folder / "config.toml").write_text(
        EXAMPLE.read_text().replace('fix = "rtk-float"', 'fix = "rtk-fixed"')
    )
    weeds = places()
    longitude, latitude = TO_DEGREES.transform(weeds[:, 0], weeds[:, 1])
    rows = [f"{lat:.9f},{lon:.9f}" for lat, lon in zip(latitude, longitude, strict=True)]
    (folder / "weeds.csv").write_text("\n".join(["lat,lon", *rows]) + "\n")
    return folder


def places() -> np.ndarray:
    """Return forty weeds in seven patches, where the scout has marked them."""
    draw = np.random.default_rng(5)
    patches = np.column_stack([draw.uniform(12, LENGTH_M - 12, 7), draw.uniform(8, WIDTH_M - 8, 7)])
    found: np.ndarray = patches[draw.integers(0, 7, 40)] + draw.normal(0.0, 1.5, (40, 2))
    return found


def made(
    capsys: pytest.CaptureFixture[str], data: Path, out: Path, *arguments: object
) -> dict[str, Any]:
    words = [
        data / "weeds.csv", "--config", data / "config.toml", "--out", out, "--rate", "20",
        "--angle-deg", "90", "--force", "--json", *arguments,
    ]  # fmt: skip
    command = typer.main.get_command(app)
    code = command.main([str(one) for one in words], prog_name="spots", standalone_mode=False)
    found = json.loads(capsys.readouterr().out)
    assert (code or 0) == (0 if found["ok"] else 1)
    assert isinstance(found, dict)
    return found


def sprayed(path: Path) -> Any:
    meta, _, geometries, columns = pyogrio.raw.read(path, layer=0)
    rate = dict(zip(meta["fields"], columns, strict=True))["rate"]
    zones = moved(shapely.from_wkb(geometries), TO_METRES)
    assert shapely.union_all(zones).area == pytest.approx(LENGTH_M * WIDTH_M, abs=1.0)
    assert shapely.area(zones).sum() == pytest.approx(LENGTH_M * WIDTH_M, abs=1.0)
    return shapely.union_all(zones[rate > 0.0])


def missed_share(ground: Any, seed: int, *, wind_m: float, weeds_m: float) -> float:
    """Return the share of weeds that are missed: passes go along east."""
    draw = np.random.default_rng(seed)
    weeds = places() + draw.normal(0.0, weeds_m, (40, 2))
    way = draw.uniform(0.0, 2.0 * math.pi)
    # That of the flight: the companion follows it to so much.
    clock_s = draw.choice([-0.0012, 0.0012])
    count = 0
    for weed in weeds:
        # Each weed is met in another pass or moment: errors of its own; the wind is that of all.
        along = draw.normal(0.0, 0.02) + SPEED_M_S * (
            draw.normal(0.0, 0.05 * 0.118) + draw.uniform(-0.01, 0.01) + clock_s
        )
        across = draw.normal(0.0, 0.02)
        # An opening is full from half its rise and up to one PWM period late, and may be carried.
        late = 0.167 + draw.uniform(0.0, 0.0909 / 2.0) * SPEED_M_S
        carried = draw.uniform(0.0, 0.2)
        drift = wind_m * np.array([math.cos(way), math.sin(way)])
        at = weed - drift - np.array([along, across])
        ahead = np.array([late + carried, 0.0])
        spots = shapely.points([at - ahead, at + ahead])
        count += not shapely.covers(ground, spots).all()
    return count / len(weeds)


def test_weeds_as_geojson_points_or_all_in_one_feature_are_those_of_the_table(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = [line.split(",") for line in (data / "weeds.csv").read_text().splitlines()[1:]]
    places = [[float(lon), float(lat)] for lat, lon in rows]
    single = [{"type": "Point", "coordinates": place} for place in places]
    several = [{"type": "MultiPoint", "coordinates": places}]
    budget = made(capsys, data, tmp_path / "a.gpkg")
    clock = next(one for one in budget["budget"]["parts"] if "clock" in one["name"])
    assert (clock["along_m"], clock["by_chance"]) == (pytest.approx(SPEED_M_S * 0.0012), False)
    for geometries in (single, several):
        features = [
            {"type": "Feature", "properties": {}, "geometry": geometry} for geometry in geometries
        ]
        path = tmp_path / "weeds.geojson"
        path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
        frame = LocalFrame(latitude_deg=48.27, longitude_deg=16.9)
        found = read_weeds(path, frame, 0.1, None, None)
        table = read_weeds(data / "weeds.csv", frame, 0.1, None, None)
        assert found.middles == pytest.approx(table.middles, abs=1e-6)


def test_a_hundred_fields_miss_no_more_than_is_said(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "spots.gpkg"
    found = made(capsys, data, out, "--miss-percent", "5", "--wind-m-s", "1")
    ground = sprayed(out)
    shapely.prepare(ground)
    assert found["treated_ha"] == pytest.approx(ground.area / 1e4, rel=1e-3)
    assert found["saved_percent"] == pytest.approx(
        100.0 * (1.0 - ground.area / (LENGTH_M * WIDTH_M)), abs=0.1
    )
    wind_m = next(one["along_m"] for one in found["budget"]["parts"] if "wind" in one["name"])
    shares = [missed_share(ground, seed, wind_m=wind_m, weeds_m=0.1) for seed in range(100)]
    assert np.mean(shares) <= 0.05
    # As little around the weeds as that takes: with the scout twenty times as far off, it shows.
    far = [missed_share(ground, seed, wind_m=wind_m, weeds_m=2.0) for seed in range(20)]
    assert np.mean(far) > 0.05


def test_misses_to_expect_are_those_that_happen() -> None:
    budget = Budget(
        parts=(
            Part(name="by chance", along_m=0.5, across_m=0.3, by_chance=True),
            Part(name="always", along_m=0.2, across_m=0.0, by_chance=False),
        ),
        miss_share=0.1,
    )
    treated = shapely.box(0.0, 0.0, 2.0, 1.0)
    draw = np.random.default_rng(1)
    for place in ([1.0, 0.5], [0.6, 0.5], [1.0, 0.2]):
        told = misses(np.array([place]), treated, budget)[0]
        at = np.array(place) + draw.normal(0.0, [0.5, 0.3], (100_000, 2))
        hit = ((at[:, 0] > 0.2) & (at[:, 0] < 1.8) & (at[:, 1] > 0.0) & (at[:, 1] < 1.0)).mean()
        assert told == pytest.approx(1.0 - hit, abs=0.01)
    assert misses(np.array([[9.0, 9.0]]), treated, budget)[0] == 1.0


def test_valves_that_could_not_close_and_open_again_stay_open() -> None:
    budget = Budget(
        parts=(Part(name="all", along_m=1.0, across_m=0.0, by_chance=False),), miss_share=0.1
    )
    spots = [shapely.box(at, 0.4, at + 0.2, 0.6) for at in (0.0, 3.0, 9.0)]
    edges = np.arange(0.0, 4.0)
    found = openings(spots, edges, budget, least_m=0.5, gap_m=1.0)
    assert [(one.band, round(one.start_m, 6), round(one.end_m, 6)) for one in found] == [
        (0, -1.0, 4.2), (0, 8.0, 10.2),
    ]  # fmt: skip
    parted = openings(spots, edges, budget, least_m=0.5, gap_m=0.5)
    assert len(parted) == 3
    long = openings(spots[:1], edges, budget, least_m=4.0, gap_m=0.5)
    assert long[0].end_m - long[0].start_m == pytest.approx(4.0)


def test_a_weed_on_an_edge_opens_the_valves_on_both_sides() -> None:
    budget = Budget(
        parts=(Part(name="all", along_m=0.5, across_m=0.3, by_chance=False),), miss_share=0.1
    )
    spot = shapely.box(0.0, 0.9, 0.1, 0.95)
    found = openings([spot], np.arange(0.0, 4.0), budget, least_m=0.5, gap_m=1.0)
    assert [one.band for one in found] == [0, 1]


def test_the_quickest_way_is_written(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    every = made(capsys, data, tmp_path / "every.gpkg", "--mission", tmp_path / "every.waypoints")
    few = Path(shutil.copytree(data, tmp_path / "few"))
    head, *rows = (few / "weeds.csv").read_text().split()
    (few / "weeds.csv").write_text("\n".join([head, *sorted(rows)[::8]]) + "\n")
    mission = tmp_path / "spots.waypoints"
    found = made(capsys, few, tmp_path / "spots.gpkg", "--mission", mission)
    assert mission.exists()
    assert found["flight_s"][found["route"]] == min(found["flight_s"].values())
    # Ground without weeds is not flown.
    assert found["flight_s"][found["route"]] < 0.9 * every["flight_s"][every["route"]]
    # The lines of another mission are no more overwritten than itself.
    words = [
        few / "weeds.csv", "--config", few / "config.toml", "--rate", "20",
        "--out", tmp_path / "more.gpkg", "--mission", mission.with_suffix(".plan"),
    ]  # fmt: skip
    with pytest.raises(
        PlanError, match=r"^spots\.lines\.geojson is there .* another --mission, or"
    ):
        typer.main.get_command(app).main([str(one) for one in words], standalone_mode=False)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--rate", "5"), "--rate 5: nozzles and label allow"),
        (("--crs", "EPSG:4326", "--mission", "x.doc"), "suffix|\\.doc"),
    ],
)
def test_what_cannot_be_sprayed_is_refused(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: Any, said: str
) -> None:
    with pytest.raises((VrsprayError, typer.BadParameter), match=said):
        made(capsys, data, tmp_path / "spots.gpkg", *arguments)


def test_weeds_at_the_border_are_said_to_be_missed_more_often(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    field = shapely.from_geojson((data / "boundary.geojson").read_text())
    ground = next(part for part in shapely.get_parts(field) if part.area)
    corner, middle = shapely.get_coordinates(ground)[0], shapely.get_coordinates(ground.centroid)[0]
    edge = corner + 1e-3 * (middle - corner)
    weeds = tmp_path / "weeds.csv"
    rows = [f"{at[1]:.8f},{at[0]:.8f}" for at in (middle, edge)]
    weeds.write_text("\n".join(["lat,lon", *rows]) + "\n")
    words = [weeds, "--config", data / "config.toml", "--out", tmp_path / "s.gpkg", "--rate", "20"]
    typer.main.get_command(app).main([str(one) for one in words], standalone_mode=False)
    said = capsys.readouterr().out
    assert (
        " of 1 weed close to ground that is not sprayed, where 2 % cannot be kept, and 0." in said
    )
    # One figure of what is missed, and no promise beside it.
    assert said.count("misses to expect") == 1 and "at most" not in said


def test_weeds_of_another_field_are_refused(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    far = tmp_path / "far.csv"
    far.write_text("lat,lon\n47.0,16.9\n")
    words = [far, "--config", data / "config.toml", "--out", tmp_path / "s.gpkg", "--rate", "20"]
    with pytest.raises(VrsprayError, match=r"none of its 1 weeds is in the field|far"):
        typer.main.get_command(app).main([str(one) for one in words], standalone_mode=False)
