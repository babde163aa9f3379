from __future__ import annotations

import csv
import importlib.util
import json
import math
import shutil
from itertools import pairwise
from pathlib import Path
from types import ModuleType

import pytest
import shapely

from companion.assembly import deliverable
from companion.config import load
from companion.core.frame import LocalFrame
from companion.core.nozzle import flow_for_rate
from companion.core.setup import Setup
from companion.core.types import Method
from companion.errors import ConfigError, MapError
from missions.maps.compiling import compiled_setup

FOLDER = Path(__file__).resolve().parents[2] / "examples" / "anyang"
EXAMPLE = FOLDER / "config.toml"
RATES = [14.5, 15.4, 16.6, 17.7, 19.4, 20.5, 22.7, 23.8, 25.5, 27.8]


def setup_with(*overrides: str) -> Setup:
    return compiled_setup(load(EXAMPLE, overrides=overrides))


def rows() -> list[tuple[int, int, int, float]]:
    with (FOLDER / "plots.csv").open(newline="") as file:
        return [
            (int(row["index"]), int(row["pass"]), int(row["along"]), float(row["rate"]))
            for row in csv.DictReader(file)
        ]


def place(setup: Setup, across_m: float, along_m: float) -> tuple[float, float]:
    """A place on the field, in the set-up's frame: right of the corner, and along the long side."""
    origin_e, origin_n = setup.frame.to_local(35.996089, 114.543487)
    azimuth = math.radians(12.0)
    return (
        origin_e + across_m * math.cos(azimuth) + along_m * math.sin(azimuth),
        origin_n - across_m * math.sin(azimuth) + along_m * math.cos(azimuth),
    )


# ------------------------------------------------------------------------------------ the set-up


def test_setup_has_everything_that_the_configuration_says() -> None:
    setup = setup_with(
        "prescription.across=max",
        "prescription.border=volume",
        "prescription.border_buffer_m=0.25",
        "lag.method=look-ahead",
        "output.lease_s=0.4",
    )
    assert (setup.across, setup.border, setup.border_buffer_m) == ("max", "volume", 0.25)
    assert setup.method is Method.LOOK_AHEAD
    assert setup.look_ahead_s == pytest.approx(0.97)
    assert setup.lease_s == 0.4
    assert len(setup.boom.valves) == 6
    assert len(setup.prescription.sha256) == 64


@pytest.mark.parametrize(("kind", "centres"), [("gpio", True), ("servo", False), ("none", False)])
def test_only_of_our_own_pulses_is_it_known_where_they_stand(kind: str, centres: bool) -> None:
    # Whether a driver board puts them there, nobody here can tell.
    setup = compiled_setup(load(FOLDER / "config.toml", overrides=[f"output.kind={kind}"]))
    assert setup.centres_pulses is centres
    assert (setup.timing.rest_s(0.5) > 0.0) is centres


LINES = 'mission.lines="lines.geojson"'


@pytest.mark.parametrize(
    ("overrides", "percent"),
    [
        ((), None),
        ((LINES,), 100.0),
        ((LINES, "coverage.switch_off_percent=never"), None),
        ((LINES, "coverage.switch_off_percent=50"), 50.0),
        (("coverage.switch_off_percent=70",), 70.0),
        (("coverage.switch_off_percent=never",), None),
        ((LINES, "output.kind=none"), None),
    ],
)
def test_valves_close_over_treated_ground_on_lines_unless_they_are_told_never_to(
    overrides: tuple[str, ...], percent: float | None, tmp_path: Path
) -> None:
    folder = tmp_path / "field"
    shutil.copytree(FOLDER, folder)
    frame = LocalFrame(latitude_deg=35.9965, longitude_deg=114.5437)
    ends = [frame.to_geographic(0.0, north_m) for north_m in (-40.0, 40.0)]
    shape = {"type": "LineString", "coordinates": [[lon, lat] for lat, lon in ends]}
    feature = {"type": "Feature", "properties": {"kind": "spray", "sortie": 1}, "geometry": shape}
    (folder / "lines.geojson").write_text(
        json.dumps({"type": "FeatureCollection", "features": [feature]})
    )
    setup = compiled_setup(load(folder / "config.toml", overrides=overrides))
    assert (setup.lines is not None) == (LINES in overrides)
    guard = setup.overlap
    assert (None if guard is None else guard.switch_off_percent) == percent


def test_offset_moves_the_map_and_its_boundary() -> None:
    frame = LocalFrame(latitude_deg=35.9965, longitude_deg=114.5437)
    config = load(EXAMPLE)
    moved = load(
        EXAMPLE, overrides=["prescription.offset_east_m=3", "prescription.offset_north_m=-4"]
    )
    west, south, east, north = compiled_setup(config, frame=frame).prescription.bounds_m
    assert compiled_setup(moved, frame=frame).prescription.bounds_m == pytest.approx(
        (west + 3.0, south - 4.0, east + 3.0, north - 4.0)
    )


MARK = "prescription.check_map=[36.0, 114.5]"
# 5e-6 degrees north and east: 0.555 m and 0.451 m there.
SURVEYED = "prescription.check_surveyed=[36.000005, 114.500005]"


def test_a_surveyed_mark_has_to_lie_where_the_offset_puts_it() -> None:
    with pytest.raises(ConfigError, match=r"0\.71 m .*offset_east_m = 0\.451 .* = 0\.555"):
        setup_with(MARK, SURVEYED)
    offset = ("prescription.offset_east_m=0.45", "prescription.offset_north_m=0.5")
    assert setup_with(MARK, SURVEYED, *offset)
    with pytest.raises(ConfigError, match="check_surveyed lies"):
        setup_with(MARK, SURVEYED, *offset, "prescription.check_tolerance_m=0.05")


def test_half_a_mark_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"check_map.*needs prescription\.check_surveyed"):
        setup_with(MARK)


def test_frame_that_is_given_is_used() -> None:
    frame = LocalFrame(latitude_deg=36.0, longitude_deg=114.5)
    assert compiled_setup(load(EXAMPLE), frame=frame).frame is frame


def test_exclusion_is_not_sprayed(tmp_path: Path) -> None:
    setup = setup_with()
    corners = [place(setup, across, along) for across, along in ((1, 1), (5, 1), (5, 5), (1, 5))]
    ring = [setup.frame.to_geographic(*corner)[::-1] for corner in [*corners, corners[0]]]
    path = tmp_path / "pond.geojson"
    path.write_text(json.dumps({"type": "Polygon", "coordinates": [ring]}))
    middle = place(setup, 3.0, 3.0)
    assert setup.prescription.rate_at(*middle) == 23.8
    excluded = setup_with(f'prescription.exclusions=["{path}"]')
    assert excluded.prescription.rate_at(*place(excluded, 3.0, 3.0)) is None
    assert excluded.prescription.rate_at(*place(excluded, 3.0, 9.0)) == 23.8


def test_default_rate_holds_inside_the_boundary_only() -> None:
    setup = setup_with("prescription.default_rate_l_ha=18")
    beside, outside = place(setup, -0.3, 60.0), place(setup, -0.7, 60.0)
    assert setup.prescription.rate_at(*beside) == 18.0
    assert setup.prescription.rate_at(*outside) is None
    assert setup_with().prescription.rate_at(*beside) is None


# ------------------------------------------------------------------------------ what is refused


def test_a_map_with_another_hash_is_refused() -> None:
    found = compiled_setup(load(EXAMPLE)).prescription.sha256
    for digits in (found, found[:8]):
        assert compiled_setup(load(EXAMPLE, overrides=[f"prescription.sha256={digits}"]))
    with pytest.raises(ConfigError, match=f"begins with {found[:8]}"):
        compiled_setup(load(EXAMPLE, overrides=["prescription.sha256=0123456789abcdef"]))


def test_map_above_the_label_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"27\.8 L/ha, above product.rate_max_l_ha = 27\.5"):
        setup_with("product.rate_max_l_ha=27.5")
    assert setup_with("product.rate_max_l_ha=27.8")


def test_default_rate_above_the_label_is_refused() -> None:
    config = load(
        EXAMPLE,
        overrides=["product.rate_max_l_ha=30", "prescription.default_rate_l_ha=31"],
    )
    with pytest.raises(ConfigError, match="31 L/ha"):
        compiled_setup(config)


def test_configuration_without_a_map_is_refused(tmp_path: Path) -> None:
    text = EXAMPLE.read_text()
    start, end = text.index("[prescription]"), text.index("[boom]")
    path = tmp_path / "config.toml"
    path.write_text(text[:start] + text[end:])
    with pytest.raises(ConfigError, match=r"prescription\.file: missing"):
        compiled_setup(load(path))


@pytest.mark.parametrize(
    ("override", "key"),
    [
        ("prescription.file=none.shp", "prescription.file"),
        ("prescription.boundary=none.geojson", "prescription.boundary"),
        ('prescription.exclusions=["none.shp"]', "prescription.exclusions[0]"),
    ],
)
def test_missing_file_is_named_with_its_key(override: str, key: str) -> None:
    with pytest.raises(MapError) as refused:
        setup_with(override)
    assert str(refused.value).startswith(f'{EXAMPLE}: {key} = "none.')
    assert "\n" not in str(refused.value)


def test_boundary_of_another_field_is_refused(tmp_path: Path) -> None:
    ring = [[10.0, 50.0], [10.001, 50.0], [10.001, 50.001], [10.0, 50.0]]
    path = tmp_path / "other.geojson"
    path.write_text(json.dumps({"type": "Polygon", "coordinates": [ring]}))
    with pytest.raises(ConfigError, match="leave nothing of"):
        setup_with(f"prescription.boundary={path}")


# ------------------------------------------------------------------------------ what is delivered


def test_all_rates_of_the_example_are_deliverable_at_its_speed() -> None:
    assert deliverable(setup_with(), 5.0) == []


@pytest.mark.parametrize(
    ("speed_m_s", "code", "named"),
    [
        (8.0, "rate-too-high", ("22.7, 23.8, 25.5, 27.8 L/ha", "6.09 m/s or slower")),
        (2.0, "rate-too-low", ("14.5, 15.4, 16.6, 17.7, 19.4 L/ha", "2.83 m/s or faster")),
        (15.0, "rate-too-high", ("10 rates from 14.5 to 27.8 L/ha", "6.09 m/s or slower")),
    ],
)
def test_undeliverable_rates_are_named_with_a_speed_that_does(
    speed_m_s: float, code: str, named: tuple[str, ...]
) -> None:
    setup = setup_with()
    (problem,) = deliverable(setup, speed_m_s)
    assert problem.code == code
    assert all(text in problem.text + problem.fix for text in named)
    does = float(problem.fix.split()[2])
    assert code not in [left.code for left in deliverable(setup, does)]


def test_range_of_several_sets_is_that_of_all_of_them(tmp_path: Path) -> None:
    path = tmp_path / "config.toml"
    small = '[[nozzle_set]]\nvalves = ["3", "4"]\nduty = [0.2, 1.0]\nflow_l_min = [0.4, 1.6]\n'
    path.write_text(EXAMPLE.read_text() + small)
    config = load(
        path,
        overrides=[f"prescription.{key}={FOLDER / name}" for key, name in (
            ("file", "prescription.shp"), ("boundary", "boundary.geojson"),
        )],
    )  # fmt: skip
    assert deliverable(compiled_setup(config), 2.0) == []


def test_smallest_duty_limits_the_smallest_flow() -> None:
    codes = [problem.code for problem in deliverable(setup_with("pwm.duty_min=0.4"), 5.0)]
    assert codes == ["rate-too-low"]
    assert flow_for_rate(14.5, 5.0, 6.0) < 3.024


# ------------------------------------------------------------------------------- the example field


def maker() -> ModuleType:
    spec = importlib.util.spec_from_file_location("make_anyang", FOLDER / "make.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_files_of_the_example_are_what_its_script_makes(tmp_path: Path) -> None:
    maker().main(tmp_path)
    made = sorted(path.name for path in tmp_path.iterdir())
    assert len(made) == 7
    for name in made:
        assert (tmp_path / name).read_bytes() == (FOLDER / name).read_bytes(), name


def test_each_pass_of_the_example_has_each_rate_once() -> None:
    for number in range(4):
        assert sorted(rate for _, pass_, _, rate in rows() if pass_ == number) == RATES


def test_neighbours_along_a_pass_differ_by_a_fifth_but_for_the_printed_ones() -> None:
    for number in range(4):
        order = [rate for _, pass_, _, rate in rows() if pass_ == number]
        steps = [abs(a - b) / max(a, b) for a, b in pairwise(order)]
        printed = 2 if number == 0 else 0
        assert min(steps) >= 0.10
        assert min(steps[printed:]) >= 0.20


def test_steps_up_are_as_many_as_steps_down_as_flown() -> None:
    ups = 0
    for number in range(4):
        order = [rate for _, pass_, _, rate in rows() if pass_ == number]
        flown = order if number % 2 == 0 else order[::-1]
        ups += sum(a < b for a, b in pairwise(flown))
    assert ups == 18


def test_rates_that_the_paper_prints_are_where_it_prints_them() -> None:
    printed = {0: 23.8, 1: 20.5, 2: 16.6, 38: 17.7, 39: 25.5}
    assert {index: rate for index, _, _, rate in rows() if index in printed} == printed


def test_map_of_the_example_has_the_rates_of_its_list_where_they_belong() -> None:
    setup = setup_with()
    for _, pass_, along, rate in rows():
        middle = place(setup, 6.0 * pass_ + 3.0, 12.0 * along + 6.0)
        assert setup.prescription.rate_at(*middle) == rate
    areas = [zone.polygon.area for zone in setup.prescription.zones]
    assert areas == pytest.approx([72.0] * 40, abs=0.01)


def test_boundary_of_the_example_is_exact_at_the_ends_and_wider_at_the_sides() -> None:
    prescription = setup_with().prescription
    plots = shapely.union_all([zone.polygon for zone in prescription.zones])
    beyond = prescription.field.difference(plots)
    assert prescription.field.area == pytest.approx(25.0 * 120.0, abs=0.1)
    assert beyond.area == pytest.approx(2 * 0.5 * 120.0, abs=0.1)
    assert plots.difference(prescription.field).area < 0.01
