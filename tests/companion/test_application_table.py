"""The table of the legal record: what it takes, what laws ask for, who says what is missing."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import pytest

from analysis.report.legal_fields import LABELS
from companion.cli.run import _about, _application_notes
from companion.config import application_table, load
from companion.config.application_table import PROFILES, told
from companion.config.legal_entries import ASKED, missing
from companion.doctor.check import Status, application_check
from companion.errors import ConfigError
from tests.analysis.report_flight import EU_TOLD

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "anyang" / "config.toml"
EU = [f"{key}={json.dumps(value)}" for key, value in EU_TOLD.items()]


def test_what_a_law_asks_for_is_a_key_of_the_configuration_and_has_a_label() -> None:
    keys = set(load(EXAMPLE).settings())
    for profile in PROFILES:
        assert set(ASKED[profile]) <= keys & set(LABELS)


def test_example_says_nothing_for_the_record() -> None:
    config = load(EXAMPLE)
    assert told(config.application, config.product) == {}
    assert missing("us", told(config.application, config.product)) == ASKED["us"]


def test_whatever_is_said_is_kept_and_no_longer_missing() -> None:
    config = load(EXAMPLE, overrides=EU)
    assert told(config.application, config.product) == EU_TOLD
    assert missing("eu", told(config.application, config.product)) == ()
    assert (
        json.loads(_about(config, (), SimpleNamespace(as_object=dict))["application_json"])
        == EU_TOLD
    )


@pytest.mark.parametrize("key", ASKED["eu"])
def test_each_key_alone_is_missed(key: str) -> None:
    values = {name: value for name, value in EU_TOLD.items() if name != key}
    assert missing("eu", values) == (key,)
    assert missing("eu", {**values, key: "   "}) == (key,)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("crop_eppo", '"wheat"'),
        ("growth_stage_bbch", '"early"'),
        ("growth_stage_bbch", "31"),
        ("growth_stage_bbch", '"39-31"'),
        ("growth_stage_bbch", '"\u0663\u0661"'),
        ("pilot_skills_date", '"2026-13-01"'),
        ("pilot_skills_date", '"2026-02-31"'),
        ("pilot_skills_date", '"0000-01-01"'),
        ("start_time", '"2026-02-31T06:30:00Z"'),
        ("time_zone", '"Mars/Phobos"'),
        ("time_zone", '"../../etc/passwd"'),
        ("start_time", '"2026-05-01T06:30:00"'),
        ("product_per_l", "0"),
        ("product_unit", '"gal"'),
        ("humidity_percent", "101"),
        ("wind_m_s", "nan"),
        ("profile", '"uk"'),
        ("costumer", '"A. Grower"'),
    ],
)
def test_what_is_no_entry_is_refused(key: str, value: str) -> None:
    with pytest.raises(ConfigError, match=f"application.{key}"):
        load(EXAMPLE, overrides=[f"application.{key}={value}"])


def test_run_names_what_will_be_missing_unless_it_is_training() -> None:
    config = load(EXAMPLE, overrides=EU[:-1])
    (line,) = _application_notes(config, "no")
    assert "eu application record" in line and "product.registration" in line
    assert _application_notes(config, "water") == []
    assert _application_notes(load(EXAMPLE, overrides=EU), "no") == []
    assert _application_notes(load(EXAMPLE), "no") == []


@pytest.mark.parametrize(
    ("overrides", "status", "text"),
    [
        ([], Status.WARN, "application.profile is not set"),
        (EU, Status.OK, "all there"),
        (EU[:-1], Status.WARN, "missing: product.registration"),
        ([*EU, "application.time_zone=Europe/Madrid"], Status.OK, "all there"),
        (["journal.training=true"], Status.NOT_APPLICABLE, "training"),
        (["output.kind=none"], Status.NOT_APPLICABLE, "training"),
    ],
)
def test_doctor_says_how_the_record_stands(overrides: list[str], status: Status, text: str) -> None:
    check = application_check(load(EXAMPLE, overrides=overrides))
    assert (check.status, text in check.text) == (status, True)


def test_a_computer_without_time_zones_takes_any_and_doctor_says_so(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(application_table, "available_timezones", set)
    config = load(EXAMPLE, overrides=[*EU, "application.time_zone=Mars/Base"])
    check = application_check(config)
    assert (check.status, "no time zone" in check.text) == (Status.WARN, True)
