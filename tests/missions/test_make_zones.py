"""`make zones`: classes, cleaning, what the sprayer follows, and the map that comes out.

The judge of the map knows nothing of how it was made: it reads the file with GDAL, flies straight
lines over it, and measures how long each rate lasts.
"""

from __future__ import annotations

import importlib.util
import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import pytest
import shapely
import typer
from numpy.typing import NDArray
from pyproj import CRS, Transformer

from companion.errors import VrsprayError
from missions.make import cli
from missions.make.classes import classify, natural_breaks
from missions.make.cleaning import Track, cleaned, is_track
from missions.make.data import index_of
from missions.make.passes import Passes, passes_of, places_in
from missions.make.zones import Limits, Wish, make_zones, settled

pytestmark = pytest.mark.usefixtures("searched_briefly", "laid_out_once")

ROOT = Path(__file__).resolve().parents[2]
EXAMPLE = ROOT / "examples" / "zones"
Floats = NDArray[np.float64]


# Along one pass: the best of all ways to cut it, found by trying every one.


def runs_of(labels: tuple[int, ...]) -> list[tuple[int, int]]:
    ends = [at for at in range(1, len(labels)) if labels[at] != labels[at - 1]]
    return list(itertools.pairwise([0, *ends, len(labels)]))


@pytest.mark.parametrize("seed", range(25))
def test_zones_along_a_pass_misapply_least_of_all_that_are_long_enough(seed: int) -> None:
    draw = np.random.default_rng(seed)
    count, zones = int(draw.integers(1, 8)), int(draw.integers(2, 4))
    cost, length = draw.random((1, count, zones)), 0.05 + draw.random((1, count))
    least = float(draw.uniform(0.0, 2.5))
    best = min(
        float(cost[0][np.arange(count), list(labels)].sum())
        for labels in itertools.product(range(zones), repeat=count)
        if len(runs_of(labels)) == 1
        or all(length[0, start:end].sum() >= least - 1e-9 for start, end in runs_of(labels))
    )
    found = settled(cost, length, least)[0]
    assert cost[0][np.arange(count), found].sum() == pytest.approx(best)


def test_ground_that_is_no_field_parts_a_pass() -> None:
    cost = np.array([[[0.0, 1.0]] * 3 + [[1.0, 0.0]] * 3])
    length = np.array([[1.0, 1.0, 1.0, 0.0, 1.0, 1.0]])
    assert settled(cost, length, 2.0).tolist() == [[0, 0, 0, -1, 1, 1]]


# Classes, beside mapclassify 2.10.0 (FisherJenks, Quantiles, EqualInterval; k = 4) and
# scikit-learn 1.9.1 (KMeans(4, n_init=50).inertia_), whose figures these are.


@pytest.mark.parametrize(
    ("seed", "jenks", "quantiles", "equal"),
    [
        (1, [3.54, 6.83, 11.41], [3.0025, 5.08, 6.755], [4.5525, 8.975, 13.3975]),
        (2, [3.87, 7.48, 13.54], [2.735, 5.225, 8.2225], [6.93, 13.32, 19.71]),
        (3, [3.47, 6.80, 10.76], [3.5525, 5.55, 8.57], [5.795, 11.16, 16.525]),
    ],
)
def test_classes_are_those_of_mapclassify(
    seed: int, jenks: list[float], quantiles: list[float], equal: list[float]
) -> None:
    values = np.random.default_rng(seed).gamma(2.0, 3.0, 120).round(2)
    found = classify(values[None], 4, "jenks").labels
    # Its breaks are the largest values of the classes, ours lie between these and the next.
    assert [float(values[found == one].max()) for one in range(3)] == jenks
    assert classify(values[None], 4, "quantiles").breaks == pytest.approx(quantiles)
    assert classify(values[None], 4, "equal").breaks == pytest.approx(equal)


@pytest.mark.parametrize(("seed", "inertia"), [(1, 118.385939), (2, 133.747624), (3, 134.24036)])
def test_clusters_of_several_layers_are_as_tight_as_those_of_scikit_learn(
    seed: int, inertia: float
) -> None:
    layers = np.random.default_rng(seed).normal(size=(3, 200))
    layers[:, :70] += 3
    layers[1, 70:130] -= 4
    labels = classify(layers, 4, "kmeans").labels
    scaled = (layers - layers.mean(1, keepdims=True)) / layers.std(1, keepdims=True)
    within = sum(
        float(((part - part.mean(1, keepdims=True)) ** 2).sum())
        for part in (scaled[:, labels == one] for one in range(4))
    )
    assert within <= inertia * (1 + 1e-6)
    means = [layers[0, labels == one].mean() for one in range(4)]
    assert means == sorted(means)


def test_natural_breaks_of_many_values_are_those_of_their_bins() -> None:
    values = np.random.default_rng(4).normal(size=20_000)
    some = np.sort(values)[::10]
    assert natural_breaks(values, 4) == pytest.approx(natural_breaks(some, 4), abs=0.02)


@pytest.mark.parametrize("method", ["jenks", "quantiles", "equal", "kmeans"])
def test_values_that_are_all_alike_are_one_class(method: Any) -> None:
    assert classify(np.full((1, 50), 0.4), 4, method).labels.tolist() == [0] * 50


def test_indices_are_their_formulas() -> None:
    nir, other = np.array([0.45, 0.30]), np.array([0.05, 0.10])
    for name in ("NDVI", "GNDVI", "NDRE", "NDMI"):
        assert index_of(name, nir, other) == pytest.approx([0.40 / 0.50, 0.20 / 0.40])
    assert index_of("CIRE", nir, other) == pytest.approx([8.0, 2.0])


# Cleaning, judged by a harvest whose faults are known.


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of the example's data."""
    spec = importlib.util.spec_from_file_location("zones_example", EXAMPLE / "make.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    folder = tmp_path_factory.mktemp("zones")
    module.main(folder)
    return folder


def test_cleaning_finds_the_faults_of_a_harvest_and_keeps_its_measurements(data: Path) -> None:
    table = np.genfromtxt(data / "yield.csv", delimiter=",", skip_header=1)
    faults = np.array((data / "yield-truth.csv").read_text().split("\n")[1:-1])
    there = Transformer.from_crs(4326, 32633, always_xy=True)
    points = np.column_stack(there.transform(table[:, 1], table[:, 0]))
    found = cleaned(Track(points=points, values=table[:, 2], speed_m_s=table[:, 3], ends_m=12.0))
    removed = ~found.kept
    assert removed[faults == "end"].mean() >= 0.95
    assert removed[faults == "over"].mean() >= 0.95
    assert removed[faults == "jump"].mean() >= 0.90
    assert removed[faults == "slow"].mean() >= 0.95
    assert removed[faults == ""].mean() <= 0.06
    assert found.kept.sum() + sum(found.removed.values()) == len(points)
    assert list(found.removed) == ["no value", "speed", "ends", "overlap", "outliers"]


@pytest.mark.parametrize("turn_deg", [0.0, 1.4, 45.0])
def test_a_grid_row_by_row_is_no_machines_track(turn_deg: float) -> None:
    # Estimates in a square grid have no ends of passes to be cut off.
    y, x = (10.0 * index.ravel() for index in np.mgrid[:15, :20])
    angle = np.radians(turn_deg)
    grid = np.column_stack([x * np.cos(angle) - y * np.sin(angle),
                            x * np.sin(angle) + y * np.cos(angle)])  # fmt: skip
    assert not is_track(grid)
    assert is_track(np.column_stack([0.2 * grid[:, 0], grid[:, 1]]))


def test_points_without_speed_are_cleaned_by_their_steps() -> None:
    along = np.concatenate([np.arange(0, 100, 2.0), 100 + np.arange(0, 2, 0.1)])
    points = np.column_stack([along, np.zeros(len(along))])
    found = cleaned(Track(points=points, values=np.ones(len(along))), ("speed",))
    assert found.removed["speed"] == 19


# Rates.


def square(limits: Limits | None, wish: Wish, values: Floats | None = None) -> Any:
    """Return zones on 60 m x 24 m, four passes north: one value a metre, south to north."""
    ground = shapely.box(0.0, 0.0, 24.0, 60.0)
    passes = Passes(angle_deg=0.0, edges_m=np.arange(0.0, 25.0, 6.0), aligned_percent=100.0)
    places = places_in(ground, passes, size_m=1.0, path=Path("field"))
    given = np.arange(60.0) if values is None else values
    return make_zones(given[places.column][None], places, wish, limits)


EASY = Limits(least_m=1.0, low_l_ha=5.0, high_l_ha=40.0)


def test_every_zone_has_its_rate_and_its_ground() -> None:
    made = square(EASY, Wish(count=3, method="equal", rates_l_ha=(10.0, 20.0, 30.0)))
    assert made.rates_l_ha == (10.0, 20.0, 30.0)
    assert made.areas_ha == pytest.approx([0.048] * 3)
    assert made.litres == pytest.approx(0.048 * 60.0)
    assert made.misapplied_l == 0.0
    assert made.steps == () == made.became


def test_what_is_left_of_the_data_is_none_where_every_rate_is_another() -> None:
    made = square(
        Limits(least_m=1.0, low_l_ha=33.0, high_l_ha=34.0),
        Wish(count=3, method="equal", law=((0.0, 250.0), (59.0, 260.0))),
    )
    assert made.steps[-1].variance_kept_percent == 0.0
    assert {rate for _, rate in made.became} == {34.0}


def test_rates_that_the_nozzles_do_not_deliver_are_refused_unless_as_is(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "a.gpkg"
    words = [data / "soil.csv", "--config", data / "config.toml", "--out", out]
    for rates, wrong in (("5,20", "--rates 5"), ("20,260", "--rates 260")):
        with pytest.raises(VrsprayError, match=f"{wrong}: nozzles and label allow"):
            run(*words, "--rates", rates, "--angle-deg", "40")
    assert not out.exists()
    assert run(*words, "--rates", "5,20", "--angle-deg", "40", "--as-is") == 0
    capsys.readouterr()
    # By a law the ends may lie beyond them; the first line says so.
    assert run(*words, "--law", "0:5,99:5", "--angle-deg", "40", "--zones", "1", "--force") == 0
    assert capsys.readouterr().out.startswith("rates are not those asked for [L/ha]: 5 became ")


def test_rates_beyond_the_nozzles_are_what_they_deliver_and_the_price_is_told() -> None:
    made = square(
        Limits(least_m=1.0, low_l_ha=12.0, high_l_ha=25.0),
        Wish(count=3, method="equal", rates_l_ha=(0.0, 10.0, 30.0)),
    )
    assert made.rates_l_ha == (0.0, 12.0, 25.0)
    assert made.became == ((10.0, 12.0), (30.0, 25.0))
    (step,) = made.steps
    assert (step.name, step.changed_ha) == ("nozzles", pytest.approx(0.096))
    assert step.moved_l == pytest.approx(0.048 * (2.0 + 5.0))
    ideal = np.repeat([0.0, 10.0, 30.0], 20)
    kept = 1 - (np.repeat([0.0, 12.0, 25.0], 20) - ideal).var() / ideal.var()
    shift = (np.repeat([0.0, 12.0, 25.0], 20) - ideal).mean() ** 2 / ideal.var()
    assert step.variance_kept_percent == pytest.approx(100 * (kept - shift))


def test_rates_too_close_to_be_worth_a_change_become_one() -> None:
    made = square(EASY, Wish(count=3, method="equal", rates_l_ha=(20.0, 21.0, 30.0)))
    assert made.rates_l_ha == (20.5, 30.0)
    assert made.became == ((20.0, 20.5), (21.0, 20.5))
    assert [step.name for step in made.steps] == ["steps of rate"]


def test_litres_stay_within_the_total_and_within_the_nozzles() -> None:
    wish = Wish(count=3, method="equal", rates_l_ha=(10.0, 20.0, 30.0), litres_max=2.0)
    made = square(Limits(least_m=1.0, low_l_ha=9.0, high_l_ha=40.0), wish)
    assert 1.99 <= made.litres <= 2.0
    assert min(made.rates_l_ha) >= 9.0
    with pytest.raises(VrsprayError, match=r"--litres-max 2: at 15\.00 L/ha"):
        square(Limits(least_m=1.0, low_l_ha=15.0, high_l_ha=40.0), wish)


def test_a_law_goes_by_straight_lines_between_its_points() -> None:
    made = square(EASY, Wish(count=2, method="equal", law=((0.0, 10.0), (59.0, 30.0))))
    at = np.arange(60.0)
    rate = 10.0 + 20.0 * at / 59.0
    assert made.rates_l_ha == pytest.approx([rate[:30].mean(), rate[30:].mean()], abs=0.01)
    assert made.ideal_l == pytest.approx(0.144 * rate.mean())


def test_what_is_too_short_is_taken_by_the_zones_around_it() -> None:
    values = np.zeros(60)
    values[20:23], values[40:50] = 1.0, 1.0
    wish = Wish(count=2, method="equal", rates_l_ha=(10.0, 20.0))
    made = square(Limits(least_m=6.0, low_l_ha=5.0, high_l_ha=40.0), wish, values)
    (step,) = made.steps
    assert step.name == "length and width"
    # Three metres, dropped rather than made six: 3 x 10 L/ha on either way, and the ten stay.
    assert step.moved_l == pytest.approx(3 * 24 * 10 / 1e4)
    free = square(None, wish, values)
    assert free.misapplied_l == 0.0


def test_smoothing_lets_the_most_common_zone_hold() -> None:
    values = np.zeros(60)
    values[20:22], values[40:60] = 1.0, 1.0
    wish = Wish(count=2, method="equal", rates_l_ha=(10.0, 20.0), smooth_m=9.0)
    made = square(EASY, wish, values)
    assert [step.name for step in made.steps] == ["smoothing"]
    assert made.areas_ha[1] == pytest.approx(20 * 24 / 1e4, rel=0.06)


def test_bands_lie_around_the_planned_passes() -> None:
    ground = shapely.box(0.0, 0.0, 20.0, 100.0)
    lines = np.array([[right, 3.0, right, 97.0] for right in (3.0, 8.5, 14.0)])
    found = passes_of(np.vstack([lines, [[0.0, 3.0, 20.0, 3.0]]]), 0.0, ground, 6.0)
    assert found.edges_m.tolist() == [0.0, 5.75, 11.25, 17.0, 23.0]
    assert found.aligned_percent == pytest.approx(100 * 282 / 302)
    # What passes keep from the border is no band of its own.
    ground = shapely.box(0.0, 0.0, 12.4, 100.0)
    lines = np.array([[right, 3.2, right, 96.8] for right in (3.2, 9.2)])
    edges = passes_of(lines, 0.0, ground, 6.0).edges_m
    assert edges == pytest.approx(np.array([0.0, 6.2, 12.4]))


# From files to a map, and the map's judge.


app = typer.Typer(add_completion=False)
app.command()(cli.zones)


def run(*arguments: object) -> int:
    words = [str(one) for one in arguments]
    result = typer.main.get_command(app).main(words, prog_name="zones", standalone_mode=False)
    return result if isinstance(result, int) else 0


def made_of(
    capsys: pytest.CaptureFixture[str], data: Path, out: Path, *arguments: object
) -> dict[str, Any]:
    code = run(*arguments, "--config", data / "config.toml", "--out", out, "--force", "--json")
    found = json.loads(capsys.readouterr().out)
    assert code == (0 if found["ok"] else 1)
    assert isinstance(found, dict)
    return found


def table_of(path: Path) -> tuple[Any, dict[str, Any]]:
    meta, _, geometries, columns = pyogrio.raw.read(path, layer=0)
    return shapely.from_wkb(geometries), dict(zip(meta["fields"], columns, strict=True))


def judged(path: Path, boundary: Path, course_deg: float) -> tuple[Floats, Floats, float, float]:
    """Return rates and areas of the zones in a file, ground in no zone or two, and the field's."""
    field = shapely.union_all(table_of(boundary)[0])
    middle = field.centroid
    local = CRS.from_proj4(f"+proj=laea +lat_0={middle.y} +lon_0={middle.x}")
    there = Transformer.from_crs(4326, local, always_xy=True)

    def moved(points: Floats) -> Floats:
        return np.column_stack(there.transform(points[:, 0], points[:, 1]))

    native, columns = table_of(path)
    zones = shapely.transform(native, moved)
    ground = shapely.transform(field, moved)
    assert shapely.is_valid(zones).all()
    apart = ground.symmetric_difference(shapely.union_all(zones)).area
    twice = shapely.area(zones).sum() - shapely.union_all(zones).area
    return columns["rate"], shapely.area(zones) / 1e4, apart + twice, ground.area / 1e4


def shortest_m(path: Path, lines: Any, frame_at: tuple[float, float]) -> float:
    """Return the shortest way that a rate lasts along planned lines, whole inside the field."""
    local = CRS.from_proj4(f"+proj=laea +lat_0={frame_at[0]} +lon_0={frame_at[1]}")
    there = Transformer.from_crs(4326, local, always_xy=True)

    def moved(points: Floats) -> Floats:
        return np.column_stack(there.transform(points[:, 0], points[:, 1]))

    zones = shapely.transform(table_of(path)[0], moved)
    least = np.inf
    for line in shapely.transform(lines, moved):
        for zone in zones:
            for part in shapely.get_parts(shapely.line_merge(shapely.intersection(line, zone))):
                # At its ends a pass is cut by the border, not by another rate.
                inner = shapely.distance(shapely.boundary(line), part) > 0.01
                if part.geom_type == "LineString" and part.length > 1e-3 and inner:
                    least = min(least, part.length)
    return float(least)


def test_a_drones_ndvi_becomes_zones_that_last_as_long_as_a_change_takes(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "map.gpkg"
    found = made_of(
        capsys, data, out, data / "drone.tif", "--value", "NDVI", "--rates", "26,22,18,14",
        "--angle-deg", "40", "--margin", "4",
    )  # fmt: skip
    assert found["ok"]
    assert not [one for one in found["problems"] if one["code"] in ("short-zone", "narrow-zone")]
    # (0.1059 + 0.012 + 1/11) s x 5 m/s, four times.
    assert found["least_m"] == pytest.approx(4 * 5.0 * (0.1059 + 0.012 + 1 / 11), rel=1e-6)
    rates, areas_ha, wrong_m2, field_ha = judged(out, data / "boundary.geojson", 40.0)
    assert sorted(rates.tolist()) == [14.0, 18.0, 22.0, 26.0]
    assert wrong_m2 < 1.0
    assert areas_ha.sum() == pytest.approx(field_ha, rel=1e-4)
    assert float(rates @ areas_ha) == pytest.approx(found["litres"], rel=2e-3)
    assert found["litres"] == pytest.approx(found["ideal_litres"], rel=0.02)
    (step,) = found["steps"]
    assert step["moved_l"] == pytest.approx(found["misapplied_litres"])
    assert 80.0 < step["variance_kept_percent"] < 95.0
    # Straight lines through the middles of the bands, well inside, as a judge draws them.
    lines = planned(data, 40.0, tmp_path)
    assert shortest_m(out, lines, (48.2712, 16.9034)) >= found["least_m"] - 0.01


def planned(data: Path, course_deg: float, folder: Path) -> Any:
    """Return the passes that `vrspray plan` lays at this course."""
    from missions.cli import app as plan_app

    out = folder / "plan.geojson"
    words = [
        str(data / "boundary.geojson"), "--config", str(data / "config.toml"), "--rate-l-ha", "20",
        "--angle-deg", f"{course_deg:g}", "--tank-l", "500", "--out", str(out), "--json",
    ]  # fmt: skip
    typer.main.get_command(plan_app).main(words, prog_name="plan", standalone_mode=False)
    lines = np.array([one for one in table_of(out)[0] if shapely.get_num_coordinates(one) == 2])
    step = np.array([shapely.get_coordinates(one)[[0, -1]] for one in lines])
    way = (step[:, 1] - step[:, 0]) * [np.cos(np.radians(48.27)), 1.0]
    off = (np.degrees(np.arctan2(way[:, 0], way[:, 1])) - course_deg + 90.0) % 180.0 - 90.0
    passes = lines[np.abs(off) < 0.5]
    assert len(passes) >= 15
    return passes


@pytest.mark.parametrize(
    ("arguments", "zones"),
    [
        (["drone.tif", "--value", "GNDVI", "--rates", "26,14", "--across", "valve"], 2),
        (["satellite.tif", "--value", "NDRE", "--rates", "26,22,18", "--method", "quantiles"], 3),
        (["yield.csv", "--value", "yield_t_ha", "--law", "3:14,9:26"], 4),
        (["soil.csv", "--rates", "14,22", "--smooth-m", "10"], 2),
        (["scouted.geojson", "--value", "weeds", "--rates", "0,12,24", "--method", "equal"], 3),
        (["satellite.tif", "yield.csv", "--value", "NDVI", "--value", "yield_t_ha",
          "--method", "kmeans", "--rates", "24,18,12"], 3),
    ],
)  # fmt: skip
def test_every_kind_of_data_becomes_a_map_of_the_whole_field(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], zones: int
) -> None:
    words = [data / one if (data / one).is_file() else one for one in arguments]
    out = tmp_path / "map.geojson"
    found = made_of(capsys, data, out, *words, "--angle-deg", "40")
    assert found["ok"]
    assert len(found["zones"]) <= zones
    _, areas_ha, wrong_m2, field_ha = judged(out, data / "boundary.geojson", 40.0)
    assert wrong_m2 < 1.0
    assert areas_ha.sum() == pytest.approx(field_ha, rel=1e-4)


def test_points_that_are_left_are_written_and_make_the_same_zones(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--value", "yield_t_ha", "--rates", "22,14", "--angle-deg", "40"]
    first = made_of(
        capsys, data, tmp_path / "a.gpkg", data / "yield.csv", *words,
        "--cleaned", tmp_path / "left.csv",
    )  # fmt: skip
    assert first["files"] == [str(tmp_path / "a.gpkg"), str(tmp_path / "left.csv")]
    (of_all,) = first["values"]
    lines = (tmp_path / "left.csv").read_text().splitlines()
    assert lines[0] == "lat,lon,yield_t_ha,speed_m_s"
    assert len(lines) - 1 == of_all["points"] - sum(of_all["removed"].values())

    def rounded(path: Path) -> set[tuple[float, ...]]:
        rows = np.genfromtxt(path, delimiter=",", skip_header=1)
        return {tuple(row) for row in np.round(rows, 7).tolist()}

    assert rounded(tmp_path / "left.csv") < rounded(data / "yield.csv")
    width = ["--data-width-m", str(of_all["grain_m"])]
    for name in ("left.csv", "left.geojson"):
        found = made_of(
            capsys, data, tmp_path / "b.gpkg", tmp_path / name, *words, *width,
            "--clean", "none", "--cleaned", tmp_path / "left.geojson" if name != "left.geojson"
            else tmp_path / "again.csv",
        )  # fmt: skip
        assert found["litres"] == pytest.approx(first["litres"], rel=1e-4)
    assert rounded(tmp_path / "again.csv") == rounded(tmp_path / "left.csv")


def test_the_flight_map_is_written_beside_the_map_that_it_is_made_from(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from companion.flight_map import read_flight_map

    out = tmp_path / "field.flightmap.gpkg"
    found = made_of(capsys, data, out, data / "soil.csv", "--rates", "14,22", "--angle-deg", "40")
    assert found["files"] == [str(out), str(tmp_path / "field.gpkg")]
    assert read_flight_map(out).prescription.rates_l_ha == (14.0, 22.0)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["drone.tif", "--rates", "1,2"], "several bands: 1 red, 2 green, 3 rededge, 4 nir; name"),
        (["drone.tif", "--value", "NDMI", "--rates", "1,2"], "--band swir=NUMBER"),
        (["drone.tif", "--value", "NDVI"], "either with --rates or with --law"),
        (["drone.tif", "--value", "NDVI", "--rates", "1,x"], "numbers with commas"),
        (["drone.tif", "--value", "NDVI", "--rates", "1,2", "--zones", "3"], "2 rates for 3 zones"),
        (["yield.csv", "--value", "rate", "--rates", "1,2"], "has yield_t_ha, speed_m_s"),
        (["soil.csv", "--law", "1:2"], "two or more different values"),
        (["soil.csv", "--rates", "0,0"], "nothing would be sprayed"),
        (["soil.csv", "--rates", "9,9", "--clean", "dust"], "--clean takes speed"),
        (["nowhere.tif", "--rates", "9,9"], "there is no such file"),
        (["soil.csv", "--rates", "9,9", "--cleaned", "a.xlsx"], "written as .csv or .geojson"),
        (["soil.csv", "--rates", "9,9", "--cleaned", "soil.csv"], "would replace the data"),
        (["soil.csv", "--rates", "9,9", "--cleaned", "yield.csv"], "give another --cleaned"),
        (["satellite.tif", "--value", "NDVI", "--rates", "9,9", "--cleaned", "b.csv"],
         "takes one file of points, and DATA has no points"),
    ],
)  # fmt: skip
def test_what_cannot_be_made_is_said_in_one_line(
    data: Path, tmp_path: Path, arguments: list[str], text: str
) -> None:
    words = [data / one if one.endswith((".tif", ".csv")) else one for one in arguments]
    config = ["--config", data / "config.toml", "--out", tmp_path / "a.shp"]
    with pytest.raises((VrsprayError, typer.BadParameter)) as caught:
        run(*words, *config)
    assert text in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_without_scipy_the_extra_is_named(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _name: None)
    with pytest.raises(VrsprayError, match="scipy is not installed; add it: "):
        run(data / "soil.csv", "--config", data / "config.toml", "--rates", "9,12", "--out",
            tmp_path / "a.shp")  # fmt: skip


def test_data_of_another_place_are_refused(data: Path, tmp_path: Path) -> None:
    far = tmp_path / "far.csv"
    far.write_text("lat,lon,ec\n" + "".join(f"48.3,16.{90 + i},1.{i}\n" for i in range(9)))
    with pytest.raises(VrsprayError, match="100 % of the field has no data"):
        run(far, "--config", data / "config.toml", "--rates", "9,12", "--out", tmp_path / "a.shp")
