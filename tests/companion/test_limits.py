"""Label and permit as data: what the file says, and what is refused, in one line."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import shapely

from companion.assembly import above_label, build_setup
from companion.config import Config, load
from companion.config.limits import LimitsFile, limits_meta, limits_of, read_limits
from companion.core.frame import LocalFrame
from companion.core.types import Inhibit
from companion.doctor.check import Status, label_check
from companion.errors import ConfigError
from companion.flight_map import difference
from missions.errors import PlanError
from missions.maps.compiling import MapOrder, compile_map
from missions.plan import Settings
from missions.reading_ground import check_label

EXAMPLE = Path("examples/anyang/config.toml")
HEAD = 'version = 1\ntitle = "a label"\n'
DECLARED = (
    "application.temperature_c=20", "application.humidity_percent=60", "application.inversion=no",
    "application.wind_m_s=2", "application.wind_from_deg=270", "product.droplet_class=Coarse",
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
    for name in ("none.toml", ".", "large.toml"):
        with pytest.raises(ConfigError, match=r"limits\.file"):
            read_limits(tmp_path / name, "limits.file")


# ------------------------------------------------------------- each limit where it is enforced


@pytest.mark.parametrize(
    ("limit", "code"),
    [("rate_max_l_ha = 25", "above-label"), ("rate_min_l_ha = 18", "below-label"), ("", None)],
)
def test_map_check_run_and_plan_refuse_a_rate(tmp_path: Path, limit: str, code: str | None) -> None:
    given = config(tmp_path, limit)
    found = above_label(given, "a map", rates_l_ha=(0.0, 17.0, 27.0), default_rate_l_ha=None)
    assert (found.code if found else None) == code


def test_the_lower_of_two_greatest_rates_holds_in_flight(tmp_path: Path) -> None:
    assert config(tmp_path, "rate_max_l_ha = 25").rate_max_l_ha() == 25.0
    assert (
        config(tmp_path, "rate_max_l_ha = 25", "product.rate_max_l_ha=24").rate_max_l_ha() == 24.0
    )
    assert config(tmp_path, "").rate_max_l_ha() is None


@pytest.mark.parametrize(
    ("limit", "said"),
    [
        ("speed_max_m_s = 4.9", "speed at most 4.9 m/s"),
        ("speed_min_m_s = 5.1", "speed at least 5.1 m/s"),
        ("height_max_m = 3.4", "height at most 3.4 m"),
        ("height_min_m = 3.6\nheight_max_m = 4", "height 3.6 to 4 m"),
    ],
)
def test_plan_refuses_speed_and_height(tmp_path: Path, limit: str, said: str) -> None:
    settings = Settings(swath_width_m=6.0, speed_m_s=5.0, height_m=3.5)
    check_label(config(tmp_path, ""), settings)
    with pytest.raises(PlanError, match=said):
        check_label(config(tmp_path, limit), settings)


def test_plan_refuses_a_speed_that_low_rates_would_be_flown_at(tmp_path: Path) -> None:
    settings = Settings(swath_width_m=6.0, speed_m_s=5.0, height_m=3.5, speeds_m_s=(1.0, 8.0))
    with pytest.raises(PlanError, match="8 m/s"):
        check_label(config(tmp_path, "speed_max_m_s = 7"), settings)


# limit; the entry that breaks it; the reason that keeps the valves closed
OF_THE_OPERATOR = [
    ("temperature_max_c = 25", "application.temperature_c=25.1", Inhibit.LABEL_TEMPERATURE),
    ("temperature_min_c = 5", "application.temperature_c=4.9", Inhibit.LABEL_TEMPERATURE),
    ("humidity_min_percent = 50", "application.humidity_percent=49", Inhibit.LABEL_HUMIDITY),
    ("humidity_max_percent = 90", "application.humidity_percent=91", Inhibit.LABEL_HUMIDITY),
    ('inversion = "forbidden"', "application.inversion=yes", Inhibit.LABEL_INVERSION),
    ('droplet_classes = ["coarse"]', "product.droplet_class=fine", Inhibit.LABEL_DROPLETS),
    ('wind_by = "operator"\nwind_max_m_s = 3', "application.wind_m_s=3.1", Inhibit.LABEL_WIND),
    ('wind_by = "operator"\nwind_min_m_s = 1', "application.wind_m_s=0.9", Inhibit.LABEL_WIND),
    (
        'wind_by = "operator"\nwind_from_deg = [[225, 315]]', "application.wind_from_deg=90",
        Inhibit.LABEL_WIND_DIRECTION,
    ),
]  # fmt: skip


@pytest.mark.parametrize(("limit", "broken", "reason"), OF_THE_OPERATOR)
def test_what_is_declared_decides_in_doctor_and_in_flight(
    tmp_path: Path, limit: str, broken: str, reason: Inhibit
) -> None:
    kept = config(tmp_path, limit, *DECLARED)
    assert label_check(kept).status is Status.OK
    label = kept.limits().label
    assert label is not None
    assert label.broken == frozenset()
    for said in ((broken,), ()):  # declared outside, and not declared at all
        given = config(tmp_path, limit, *said)
        check = label_check(given)
        assert check.status is Status.FAIL
        assert broken.partition("=")[0] in f"{check.text} {check.fix}"
        label = given.limits().label
        assert label is not None
        assert label.broken == {reason}


def test_doctor_refuses_speed_and_height_of_the_mission(tmp_path: Path) -> None:
    for limit in ("speed_max_m_s = 1", "height_max_m = 1"):
        assert label_check(config(tmp_path, limit)).status is Status.FAIL


def test_without_a_file_nothing_is_limited() -> None:
    given = load(EXAMPLE)
    assert given.limits().label is None
    assert label_check(given).status is Status.NOT_APPLICABLE
    assert limits_meta(given.label) == {}


def test_hours_and_days_are_those_of_the_files_offset(tmp_path: Path) -> None:
    text = 'utc_offset = "+02:00"\nhours = ["01:00-10:00"]\nfirst_day = "1970-01-02"\n'
    label = config(tmp_path, text).limits().label
    assert label is not None
    assert label.hours_s == ((23 * 3600.0, 8 * 3600.0),)
    assert label.days_s == (22 * 3600.0, math.inf)


def test_a_journal_keeps_the_limits_and_what_are_none_is_none(tmp_path: Path) -> None:
    given = config(tmp_path, "rate_max_l_ha = 25\nspeed_max_m_s = 7").label
    assert given is not None
    assert limits_of(limits_meta(given)) == given
    for text in ("", "{", "[]", '{"version": 2, "title": "x"}', '{"version": 1, "title": ""}'):
        assert limits_of({"limits_json": text}) is None


def test_buffers_are_named_from_the_configurations_folder() -> None:
    text = {"kind": "water", "distance_m": 10.0, "files": ["stream.geojson"]}
    label = LimitsFile.model_validate({"version": 1, "title": "x", "buffer": [text]})
    (found,) = label.buffers("permits/limits.toml")
    assert found.files == ("permits/stream.geojson",)


def test_buffers_are_cut_out_of_the_flight_map_and_a_map_without_them_is_refused(
    tmp_path: Path,
) -> None:
    limits = "[[buffer]]\nkind = 'water'\ndistance_m = 10\nfiles = ['water.geojson']\n"
    given = config(tmp_path, limits)
    frame = read_map_frame()
    # Water along the middle of the field, 1 m wide: 10 m to each side of it stays dry.
    corners = [frame.to_geographic(east, north) for east, north in WATER]
    ring = [[longitude, latitude] for latitude, longitude in corners]
    area = {"type": "Polygon", "coordinates": [[*ring, ring[0]]]}
    feature = {"type": "Feature", "properties": {}, "geometry": area}
    document = {"type": "FeatureCollection", "features": [feature]}
    (tmp_path / "water.geojson").write_text(json.dumps(document))
    made = compile_map(MapOrder.of(given))
    water = shapely.Polygon([made.frame.to_local(*corner) for corner in corners])
    field = made.prescription.field
    assert field.distance(water) == pytest.approx(10.0, abs=0.05)
    assert "limits.buffer" in made.frozen
    bare = compile_map(MapOrder.of(load(EXAMPLE)))
    assert "limits.buffer" not in bare.frozen
    changed = difference(bare, given)
    assert changed is not None
    assert changed[0] == "limits.buffer"
    assert difference(made, given) is None
    assert difference(made, load(EXAMPLE)) is None  # more is kept free than is asked for
    build_setup(given, made)
    with pytest.raises(ConfigError, match=r"limits\.buffer"):
        build_setup(given, bare)


WATER = ((-50.0, -0.5), (50.0, -0.5), (50.0, 0.5), (-50.0, 0.5))


def read_map_frame() -> LocalFrame:
    return compile_map(MapOrder.of(load(EXAMPLE))).frame
