"""Label and permit as data: what the file says, and what is refused, in one line."""

from __future__ import annotations

import json
import math
import os
import tomllib
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

import pytest
import shapely

from companion.assembly import above_label, beyond_label, build_setup
from companion.cli.run import label_notes as of_run
from companion.config import Config, load
from companion.config.limits import LimitsFile, limits_of, read_limits
from companion.core.estimator import Track, estimate, observe
from companion.core.frame import LocalFrame
from companion.core.inputs import UtcReport
from companion.core.safety import inhibits
from companion.core.types import Inhibit, WindReport
from companion.doctor.check import Status, label_check
from companion.doctor.vehicle import Heard, wind_check
from companion.errors import ConfigError, MapError
from companion.flight_map import difference
from missions.errors import PlanError
from missions.maps.cli.options import plan_of, sprayer_problems
from missions.maps.compiling import MapOrder, compile_map
from missions.maps.local import project
from missions.maps.registry import read_map
from missions.plan import Settings
from missions.reading_ground import GroundAsked, buffered, check_label, label_warnings
from sitl.fly import label_notes
from tests.builders import SPRAYING, position, setup

NOW = datetime(2026, 5, 1, 5, 0, tzinfo=UTC)
EXAMPLE = Path("examples/anyang/config.toml")
HEAD = 'version = 1\ntitle = "a label"\n'
DECLARED = (
    "application.temperature_c=20", "application.humidity_percent=60", "application.inversion=no",
    "application.wind_m_s=2", "application.wind_from_deg=270", "product.droplet_class=Coarse",
    "application.observed_at=2026-05-01T06:30:00+02:00",
)  # fmt: skip


def config(folder: Path, limits: str, *said: str) -> Config:
    """Return the example's configuration with limits."""
    file = folder / "limits.toml"
    file.write_text(HEAD + limits)
    return load(EXAMPLE, overrides=[f'limits.file="{file}"', *said])


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("rate_max_l_h = 30", "rate_max_l_h = 30: unknown key; did you mean rate_max_l_ha?"),
        ("rate_max_l_ha = nan", "rate_max_l_ha"),
        ("rate_max_l_ha = -1", "out of range"),
        ("wind_max_m_s = inf", "wind_max_m_s"),
        ("height_min_m = 4\nheight_max_m = 3", "height_min_m = 4: above height_max_m = 3"),
        ('hours = ["06:00-10:00"]', "utc_offset: missing"),
        ('utc_offset = "+02:00"\nhours = ["06:00-06:00"]', "a span of no time"),
        ('utc_offset = "+02:00"\nhours = ["6-7"]', "hours"),
        ('utc_offset = "+02:00"\nfirst_day = "2026-02-30"', "no such day"),
        ('utc_offset = "+02:00"\nfirst_day = "2026-05-02"\nlast_day = "2026-05-01"', "after last"),
        ("[[buffer]]\nkind = 'water'\ndistance_m = 5\nfiles = []", "buffer[0].files"),
        ("[[buffer]]\nkind = 'water'\ndistance_m = 5e9\nfiles = ['a']", "buffer[0].distance_m"),
        ('droplet_classes = ["wet"]', "droplet_classes[0]"),
        ("a = [" + "[" * 5000, "limits.toml"),
        ("= 3", "line 3"),
        ("\udcff", "not UTF-8"),
    ],
)
def test_a_wrong_file_is_refused_in_one_line(tmp_path: Path, text: str, wrong: str) -> None:
    file = tmp_path / "limits.toml"
    file.write_text(HEAD + text, errors="surrogateescape", encoding="utf-8")
    with pytest.raises(ConfigError) as refused:
        load(EXAMPLE, overrides=[f'limits.file="{file}"'])
    assert wrong in str(refused.value)
    assert "limits.toml" in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_file_that_is_not_there_or_is_no_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "large.toml").write_bytes(b"#" * 100_001)
    os.mkfifo(tmp_path / "pipe.toml")
    for name in ("none.toml", ".", "large.toml", "pipe.toml"):
        with pytest.raises(ConfigError, match=r"limits\.file"):
            read_limits(tmp_path / name, "limits.file")


# ------------------------------------------------------------- each limit where it is enforced

NO_WIND: dict[str, object] = {"wind_m_s": None, "wind": None, "wind_received_s": None}
PERMIT = 'utc_offset = "+02:00"\nlast_day = "2026-12-31"'
HERE = replace(
    SPRAYING, height_m=3.5, wind_m_s=3.0, wind_received_s=9.9, utc_offset_s=NOW.timestamp() - 10.0,
    wind=WindReport(received_s=9.9, speed_m_s=3.0, east_m_s=3.0, north_m_s=0.0),
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """A limit; what breaks it; what each place says then, None where it cannot mean anything."""

    limit: str
    said: tuple[str, ...] = ()  # of the configuration
    state: dict[str, object] = field(default_factory=dict)  # in flight
    wind: tuple[float, float] | None = None  # that the plan is for
    map_check: str | None = None
    plan: str | None = None
    doctor: str | None = None
    safety: Inhibit | None = None


TABLE = {
    "rate above": Case(limit="rate_max_l_ha = 25", map_check="above-label", plan="above-label"),
    "rate below": Case(limit="rate_min_l_ha = 18", map_check="below-label", plan="below-label"),
    "speed above": Case(
        limit="speed_max_m_s = 4.9", state={"velocity_east_m_s": 4.91}, map_check="label-speed",
        plan="speed at most 4.9 m/s", doctor="mission.speed_m_s = 5", safety=Inhibit.LABEL_SPEED,
    ),
    "speed below": Case(
        limit="speed_min_m_s = 5.1", state={"velocity_east_m_s": 5.09}, map_check="label-speed",
        plan="speed at least 5.1 m/s", doctor="mission.speed_m_s = 5", safety=Inhibit.LABEL_SPEED,
    ),
    "height above": Case(
        limit="height_max_m = 3.4", map_check="label-height", plan="height at most 3.4 m",
        doctor="mission.height_m = 3.5", safety=Inhibit.LABEL_HEIGHT,
    ),
    "height below": Case(
        limit="height_min_m = 3.6\nheight_max_m = 4", map_check="label-height",
        plan="height 3.6 to 4 m", doctor="mission.height_m = 3.5", safety=Inhibit.LABEL_HEIGHT,
    ),
    "wind above": Case(
        limit="wind_max_m_s = 2.9", wind=(3.0, 270.0), plan="wind at most 2.9 m/s",
        safety=Inhibit.LABEL_WIND,
    ),
    "wind below": Case(
        limit="wind_min_m_s = 3.1", wind=(3.0, 270.0), plan="wind at least 3.1 m/s",
        safety=Inhibit.LABEL_WIND,
    ),
    "wind unknown": Case(limit="wind_max_m_s = 9", state=NO_WIND, safety=Inhibit.LABEL_WIND),
    "wind heard long ago": Case(
        limit="wind_max_m_s = 9", state={"wind_received_s": 4.9}, safety=Inhibit.LABEL_WIND
    ),
    "wind heard tomorrow": Case(
        limit="wind_max_m_s = 9", state={"wind_received_s": 10.2}, safety=Inhibit.LABEL_WIND
    ),
    "direction heard long ago": Case(
        limit="wind_from_deg = [[260, 280]]", state={"wind_received_s": 4.9},
        safety=Inhibit.LABEL_WIND_DIRECTION,
    ),
    "no direction": Case(
        limit="wind_from_deg = [[0, 360]]", state={"wind": None},
        safety=Inhibit.LABEL_WIND_DIRECTION,
    ),
    "wind from elsewhere": Case(
        limit="wind_from_deg = [[0, 180]]", wind=(3.0, 270.0), plan="from 0 to 180 deg",
        safety=Inhibit.LABEL_WIND_DIRECTION,
    ),
    "wind by the operator": Case(
        limit='wind_by = "operator"\nwind_max_m_s = 3.5', said=("application.wind_m_s=3.6",),
        doctor="application.wind_m_s = 3.6", safety=Inhibit.LABEL_WIND,
    ),
    "no wind by the operator": Case(
        limit='wind_by = "operator"\nwind_min_m_s = 1', said=("application.wind_m_s=0.9",),
        state=NO_WIND, doctor="application.wind_m_s = 0.9", safety=Inhibit.LABEL_WIND,
    ),
    "direction by the operator": Case(
        limit='wind_by = "operator"\nwind_from_deg = [[225, 315]]',
        said=("application.wind_from_deg=90",), doctor="application.wind_from_deg = 90",
        safety=Inhibit.LABEL_WIND_DIRECTION,
    ),
    "droplets": Case(
        limit='droplet_classes = ["coarse"]', said=("product.droplet_class=fine",),
        map_check="label-droplets", plan="droplet_class = fine", doctor="droplet_class = fine",
        safety=Inhibit.LABEL_DROPLETS,
    ),
    "heat": Case(
        limit="temperature_max_c = 25", said=("application.temperature_c=25.1",),
        doctor="application.temperature_c = 25.1", safety=Inhibit.LABEL_TEMPERATURE,
    ),
    "cold": Case(
        limit="temperature_min_c = -5", said=("application.temperature_c=-5.1",),
        doctor="application.temperature_c = -5.1", safety=Inhibit.LABEL_TEMPERATURE,
    ),
    "dry air": Case(
        limit="humidity_min_percent = 50", said=("application.humidity_percent=49",),
        doctor="application.humidity_percent = 49", safety=Inhibit.LABEL_HUMIDITY,
    ),
    "wet air": Case(
        limit="humidity_max_percent = 90", said=("application.humidity_percent=91",),
        doctor="application.humidity_percent = 91", safety=Inhibit.LABEL_HUMIDITY,
    ),
    "inversion": Case(
        limit='inversion = "forbidden"', said=("application.inversion=yes",),
        doctor="application.inversion = yes", safety=Inhibit.LABEL_INVERSION,
    ),
    "old weather": Case(
        limit='inversion = "forbidden"\nobserved_max_h = 0.49',
        doctor="2026-05-01T06:30:00+02:00", safety=Inhibit.LABEL_WEATHER_AGE,
    ),
    "weather of tomorrow": Case(
        limit='inversion = "forbidden"', said=("application.observed_at=2026-05-01T05:06:00Z",),
        doctor="2026-05-01T05:06:00Z", safety=Inhibit.LABEL_WEATHER_AGE,
    ),
    "hours": Case(
        limit='utc_offset = "+02:00"\nhours = ["07:01-09:00"]', doctor="07:01-09:00",
        safety=Inhibit.LABEL_TIME,
    ),
    "days": Case(
        limit='utc_offset = "+02:00"\nlast_day = "2026-04-30"', plan="ended on 2026-04-30",
        doctor="2026-04-30", safety=Inhibit.LABEL_TIME,
    ),
    "days to come": Case(
        limit='utc_offset = "+02:00"\nfirst_day = "2026-05-02"', doctor="2026-05-02",
        safety=Inhibit.LABEL_TIME,
    ),
    "no clock": Case(
        limit='utc_offset = "+02:00"\nlast_day = "2026-12-31"', state={"utc_offset_s": None},
        safety=Inhibit.LABEL_TIME,
    ),
    "sorties longer than the hours": Case(
        limit='utc_offset = "+00:00"\nhours = ["04:59-05:04"]', plan="6 min does not fit",
    ),
    "re-entry": Case(limit="reentry_h = 24"),  # only the report has the time that it counts from
}  # fmt: skip


def map_codes(given: Config) -> list[str]:
    """Return what `map check` has against the example's map."""
    plan, found = plan_of(given, None)
    assert given.prescription is not None
    map_file = read_map(given.resolve(given.prescription.file))
    return [each.code for each in (*found, *sprayer_problems(given, map_file, plan))]


def of_plan(given: Config, wind: tuple[float, float] | None) -> str:
    """Return what `plan` has against speed, height, wind, rates and a sortie of 6 minutes."""
    asked = GroundAsked(wind=wind)
    settings = Settings(swath_width_m=6.0, speed_m_s=5.0, height_m=3.5)
    rates = above_label(given, "a map", rates_l_ha=(0.0, 17.0, 27.0), default_rate_l_ha=None)
    warned = label_warnings(given, [300.0, 360.0], NOW.timestamp())
    try:
        check_label(given, settings, asked)
    except PlanError as error:
        return str(error)
    return " ".join([*([] if rates is None else [rates.code]), *warned])


def in_flight(given: Config, state: dict[str, object]) -> frozenset[Inhibit]:
    """Return which of the label's reasons close the valves."""
    limits = replace(given.limits(), wind_required=False)
    found = inhibits(
        replace(HERE, **state),
        limits,
        field_bounds_m=(-1e3, -1e3, 1e3, 1e3),
        now_s=10.0,  # type: ignore[arg-type]
    )
    return frozenset(each for each in found if each.name.startswith("LABEL_"))


@pytest.mark.parametrize("name", TABLE)
def test_each_limit_at_each_place_where_it_means_something(tmp_path: Path, name: str) -> None:
    case = TABLE[name]
    given = config(tmp_path, case.limit, "mission.speed_m_s=5", *DECLARED, *case.said)
    codes = [code for code in map_codes(given) if "label" in code]
    assert codes == ([] if case.map_check is None else [case.map_check])
    planned = of_plan(given, case.wind)
    assert (case.plan in planned) if case.plan else planned == ""
    check = label_check(given, NOW)
    assert check.status is (Status.FAIL if case.doctor else Status.OK), check.text
    assert (case.doctor or "") in check.text
    assert in_flight(given, case.state) == ({case.safety} if case.safety else set())


@pytest.mark.parametrize("name", [name for name in TABLE if TABLE[name].said])
def test_what_is_kept_is_kept_and_what_is_not_declared_is_not(tmp_path: Path, name: str) -> None:
    case = TABLE[name]
    kept = config(tmp_path, case.limit, *DECLARED)
    assert label_check(kept, NOW).status is Status.OK
    assert in_flight(kept, {}) == set()
    key = case.said[0].partition("=")[0]
    silent = config(tmp_path, case.limit, *(each for each in DECLARED if not each.startswith(key)))
    check = label_check(silent, NOW)
    assert check.status is Status.FAIL
    assert f"not declared: {key}" in check.text
    assert not of_run(kept)
    assert any(note.startswith(f"warning: {key} is not declared, and") for note in of_run(silent))
    assert case.safety in in_flight(silent, {})


def test_the_lower_of_two_greatest_rates_holds_in_flight(tmp_path: Path) -> None:
    assert config(tmp_path, "rate_max_l_ha = 25").rate_max_l_ha() == 25.0
    lower = config(tmp_path, "rate_max_l_ha = 25", "product.rate_max_l_ha=24")
    assert lower.rate_max_l_ha() == 24.0
    assert config(tmp_path, "").rate_max_l_ha() is None


@pytest.mark.parametrize(("own", "differs"), [("40", True), ("20", True), ("25", False)])
def test_a_rate_that_product_and_label_say_otherwise_is_told(
    tmp_path: Path, own: str, differs: bool
) -> None:
    given = config(tmp_path, "rate_max_l_ha = 25", f"product.rate_max_l_ha={own}")
    found = {problem.code: problem for problem in beyond_label(given)}
    assert ("label-rates-differ" in found) is differs
    assert label_check(given, NOW).status is (Status.WARN if differs else Status.OK)
    if differs:
        assert found["label-rates-differ"].severity == "warning"
        assert f"product.rate_max_l_ha = {own}" in found["label-rates-differ"].text
    assert given.rate_max_l_ha() == min(25.0, float(own))


@pytest.mark.parametrize("limit", ["rate_max_l_ha = 25", "rate_min_l_ha = 18"])
def test_a_flight_above_or_below_the_labels_rates_is_not_set_up(tmp_path: Path, limit: str) -> None:
    given = load(EXAMPLE)
    made = compile_map(MapOrder.of(given))
    build_setup(given, made)
    with pytest.raises(ConfigError, match="L/ha"):
        build_setup(config(tmp_path, limit), made)


def test_plan_refuses_a_speed_that_low_rates_would_be_flown_at(tmp_path: Path) -> None:
    settings = Settings(swath_width_m=6.0, speed_m_s=5.0, height_m=3.5, speeds_m_s=(1.0, 8.0))
    with pytest.raises(PlanError, match="8 m/s"):
        check_label(config(tmp_path, "speed_max_m_s = 7"), settings)


HEARD = Heard(url="udp", has_wind=True, wind_m_s=3.0, wind_from_deg=270.0)


@pytest.mark.parametrize(
    ("limit", "heard", "status"),
    [
        ("wind_max_m_s = 3", {}, Status.OK),
        ("wind_max_m_s = 2.9", {}, Status.FAIL),
        ("wind_max_m_s = 9", {"wind_m_s": math.nan}, Status.FAIL),
        ("wind_max_m_s = 9", {"has_wind": False, "wind_m_s": None}, Status.FAIL),
        ("wind_from_deg = [[260, 280]]", {}, Status.OK),
        ("wind_from_deg = [[0, 180]]", {}, Status.FAIL),
        ("wind_from_deg = [[0, 360]]", {"wind_from_deg": None}, Status.FAIL),
        ('wind_by = "operator"\nwind_max_m_s = 9', {"has_wind": False}, Status.NOT_APPLICABLE),
        ('wind_by = "operator"\nwind_from_deg = [[0, 9]]', {"wind_from_deg": None}, Status.OK),
        ('wind_by = "operator"\nwind_max_m_s = 2', {}, Status.FAIL),
        ("reentry_h = 1", {"has_wind": False}, Status.NOT_APPLICABLE),
    ],
)
def test_doctor_judges_the_wind_that_it_hears(
    tmp_path: Path, limit: str, heard: dict[str, object], status: Status
) -> None:
    given = config(tmp_path, limit, "safety.wind_required=false")
    assert wind_check(replace(HEARD, **heard), given).status is status  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("received_s", "known"),
    [(10.0, True), (10.09, True), (-49.9, True), (-50.1, False), (10.2, False), (None, False)],
)
def test_the_time_of_day_is_the_autopilots_for_a_minute(
    tmp_path: Path, received_s: float | None, known: bool
) -> None:
    given = setup(limits=config(tmp_path, PERMIT).limits())
    track = Track()
    for number in range(20):
        at_s = 8.1 + 0.1 * number
        track = observe(track, position(at_s, 5.0 * at_s, 3.0), given)
    if received_s is not None:
        report = UtcReport(received_s=received_s, utc_s=NOW.timestamp())
        track = observe(track, report, given)
    state = estimate(track, 10.0)
    assert state is not None
    expected = NOW.timestamp() - received_s if known and received_s is not None else None
    assert state.utc_offset_s == expected
    bounds_m = (-1e3, -1e3, 1e3, 1e3)
    found = inhibits(state, given.limits, field_bounds_m=bounds_m, now_s=10.0)
    assert (Inhibit.LABEL_TIME in found) is not known


def test_without_a_file_nothing_is_limited() -> None:
    given = load(EXAMPLE)
    assert given.limits().label is None
    assert label_check(given, NOW).status is Status.NOT_APPLICABLE
    assert given.label is None


def test_hours_and_days_are_those_of_the_files_offset(tmp_path: Path) -> None:
    text = 'utc_offset = "+02:00"\nhours = ["01:00-10:00"]\nfirst_day = "1970-01-02"\n'
    label = config(tmp_path, text).limits().label
    assert label is not None
    assert label.hours_s == ((23 * 3600.0, 8 * 3600.0),)
    assert label.days_s == (22 * 3600.0, math.inf)


def test_a_journal_keeps_the_limits_and_what_are_none_is_none(tmp_path: Path) -> None:
    given = config(tmp_path, "rate_max_l_ha = 25\nspeed_max_m_s = 7").label
    assert given is not None
    assert limits_of(given.as_meta()) == given
    for text in ("", "{", "[]", '{"version": 2, "title": "x"}', '{"version": 1, "title": ""}'):
        assert limits_of({"limits_json": text}) is None


def test_buffers_are_named_from_the_configurations_folder() -> None:
    text = {"kind": "water", "distance_m": 10.0, "files": ["stream.geojson"]}
    label = LimitsFile.model_validate({"version": 1, "title": "x", "buffer": [text]})
    (found,) = label.buffers("permits/limits.toml")
    assert found.files == ("permits/stream.geojson",)


# Along the middle of the field: a pond, a watercourse drawn as a line, a well drawn as a point.
FEATURES = {
    "Polygon": ((-50.0, -0.5), (50.0, -0.5), (50.0, 0.5), (-50.0, 0.5), (-50.0, -0.5)),
    "LineString": ((-50.0, 0.0), (50.0, 0.0)),
    "Point": ((0.0, 0.0),),
}


def feature(folder: Path, kind: str) -> tuple[shapely.Geometry, LocalFrame]:
    """Write a feature to `water.geojson`; return it in metres, with the frame."""
    frame = compile_map(MapOrder.of(load(EXAMPLE))).frame
    degrees = [frame.to_geographic(east, north) for east, north in FEATURES[kind]]
    ring = [[longitude, latitude] for latitude, longitude in degrees]
    content = {"Polygon": [ring], "LineString": ring, "Point": ring[0]}[kind]
    document = {
        "type": "Feature",
        "properties": {},
        "geometry": {"type": kind, "coordinates": content},
    }
    (folder / "water.geojson").write_text(json.dumps(document))
    made = {"Polygon": shapely.Polygon, "LineString": shapely.LineString}.get(kind)
    return (shapely.Point(0.0, 0.0) if made is None else made(FEATURES[kind])), frame


BUFFER = "[[buffer]]\nkind = 'water'\ndistance_m = 10\nfiles = ['water.geojson']\n"


@pytest.mark.parametrize("kind", FEATURES)
def test_a_buffer_is_kept_by_map_check_plan_and_flight_map(tmp_path: Path, kind: str) -> None:
    water, _ = feature(tmp_path, kind)
    given, bare = config(tmp_path, BUFFER), load(EXAMPLE)
    made, without = compile_map(MapOrder.of(given)), compile_map(MapOrder.of(bare))
    kept = without.prescription.field.difference(made.prescription.field)
    # The flight map lacks all ground within 10 m, and hardly more.
    assert water.buffer(9.99, quad_segs=64).intersection(made.prescription.field).area < 1e-6
    field_m = without.prescription.field
    near = water.buffer(10.0, quad_segs=64).intersection(field_m)
    assert kept.area == pytest.approx(near.area, rel=5e-3)
    plan, found = plan_of(given, None)
    assert given.prescription is not None
    map_file = read_map(given.resolve(given.prescription.file))
    (problem,) = [
        each for each in (*found, *sprayer_problems(given, map_file, plan))
        if each.code == "label-buffer"
    ]  # fmt: skip
    rated = [zone.polygon for zone in without.prescription.zones if zone.rate_l_ha > 0.0]
    lost_m2 = shapely.union_all(rated).intersection(kept).area
    assert float(problem.text.split()[0]) == pytest.approx(lost_m2 / 1e4, abs=2e-4)
    assert "10 m from water" in problem.text
    (closed,) = buffered(given, 0.0, made.frame, {})
    apart = project(closed, made.frame).symmetric_difference(kept).intersection(field_m)
    assert apart.area < 5e-3 * kept.area
    # What the plan keeps from every area already is not added twice.
    (closed,) = buffered(given, 4.0, made.frame, {})
    wider = project(closed, made.frame).buffer(4.0)
    assert wider.symmetric_difference(kept).intersection(field_m).area < 5e-3 * kept.area


def test_a_buffer_whose_file_is_not_there_is_an_error_everywhere(tmp_path: Path) -> None:
    given = config(tmp_path, BUFFER)
    _, found = plan_of(given, None)
    assert [(each.severity, each.where) for each in found] == [
        ("error", "limits.buffer[0].files")
    ]  # fmt: skip
    with pytest.raises(MapError, match=r"limits\.buffer\[0\]\.files"):
        compile_map(MapOrder.of(given))
    with pytest.raises(MapError, match="no such file"):
        buffered(given, 0.0, compile_map(MapOrder.of(load(EXAMPLE))).frame, {})


def test_a_flight_map_without_the_buffers_is_refused(tmp_path: Path) -> None:
    feature(tmp_path, "LineString")
    given = config(tmp_path, BUFFER)
    made, bare = compile_map(MapOrder.of(given)), compile_map(MapOrder.of(load(EXAMPLE)))
    assert "limits.buffer" in made.frozen
    assert "limits.buffer" not in bare.frozen
    changed = difference(bare, given)
    assert changed is not None
    assert changed[0] == "limits.buffer"
    assert difference(made, given) is None
    assert difference(made, load(EXAMPLE)) is None  # more is kept free than is asked for
    build_setup(given, made)
    with pytest.raises(ConfigError, match=r"limits\.buffer"):
        build_setup(given, bare)


def test_the_example_has_every_key_and_holds_for_its_field(tmp_path: Path) -> None:
    file = EXAMPLE.parent / "limits.toml"
    assert set(tomllib.loads(file.read_text())) == set(LimitsFile.model_fields)
    given = load(EXAMPLE, overrides=['limits.file="limits.toml"', *DECLARED])
    assert label_check(given, datetime(2026, 5, 1, 6, 0, tzinfo=UTC)).status is Status.FAIL
    assert label_check(given, datetime(2026, 5, 1, 4, 40, tzinfo=UTC)).status is Status.FAIL
    seen = ("application.observed_at=2026-05-01T06:30:00+08:00", *DECLARED[:-1])
    given = load(EXAMPLE, overrides=['limits.file="limits.toml"', *seen])
    assert label_check(given, datetime(2026, 4, 30, 23, 0, tzinfo=UTC)).status is Status.OK
    assert map_codes(given) == ["label-buffer"]
    kept = compile_map(MapOrder.of(given)).prescription.field
    whole = compile_map(MapOrder.of(load(EXAMPLE))).prescription.field
    assert 50.0 < whole.area - kept.area < 300.0


def test_sitl_fly_says_why_it_sprays_nothing_under_limits(tmp_path: Path) -> None:
    def notes(limits: str) -> list[str]:
        return label_notes(config(tmp_path, limits).limits().label)

    assert label_notes(None) == notes("speed_max_m_s = 9") == []
    (note,) = notes('wind_max_m_s = 4\ninversion = "forbidden"')
    assert "label-inversion" in note
    assert "label-wind" in note
