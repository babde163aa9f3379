"""The legal record: complete only when nothing is missing, and who said what, and when."""

from __future__ import annotations

import csv
import io
import json
import math
from dataclasses import replace
from datetime import UTC
from pathlib import Path

import numpy as np
import pytest
import shapely

from analysis.assess.ground import treated_of
from analysis.flown.applied_flight import AppliedFlight, Series
from analysis.flown.read_applied import read_applied
from analysis.report.build import record_csv, record_json
from analysis.report.clock import Clock
from analysis.report.contents import warnings_of
from analysis.report.legal import AFTER, BEFORE, FLIGHT, legal_record
from analysis.report.legal_fields import Facts, ends_spraying, facts_of, told_in, told_with
from companion.config.application_table import PROFILES
from companion.errors import ConfigError
from tests.analysis.report_flight import EU_TOLD, fly

# 2026-05-01T06:00:00Z, less the seconds that the flight's clock shows then.
OFFSET_S = 1_777_615_200.0 - 100.0
META = {"application_json": json.dumps(EU_TOLD)}
US_TOLD = {
    "application.customer": "B. Farmer",
    "application.customer_address": "1 Farm Road",
    "product.name": "Mix 50",
    "application.pilot": "C. Pilot",
    "application.pilot_address": "2 Air Street",
    "application.pilot_certificate": "1234567",
    "application.pilot_skills_date": "2024-02-01",
}


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> AppliedFlight:
    return read_applied(fly(tmp_path_factory.mktemp("legal"), told=EU_TOLD))


def clock(source: str = "autopilot") -> Clock:
    return Clock(offset_s=OFFSET_S, source=source, zone=UTC, zone_name="UTC")


@pytest.fixture
def facts(flight: AppliedFlight) -> Facts:
    return facts_of(
        flight, treated_of(flight), clock(), volume_l=0.5, volume_by="model", prescribed_l=0.48
    )


def test_a_record_with_all_fields_is_complete(facts: Facts) -> None:
    record = legal_record("eu", told_with(META), facts)
    assert (record.is_complete, record.missing) == (True, ())
    fields = record.as_json()["fields"]
    assert fields["date"]["value"] == "2026-05-01"
    assert fields["start_time"]["value"].startswith("2026-05-01T06:00:0")
    assert fields["crop_eppo"] == {
        "label": "Crop, EPPO code", "value": "TRZAW", "unit": "", "said": BEFORE,
    }  # fmt: skip
    assert fields["treated_area_ha"]["said"] == FLIGHT


def test_dose_is_the_product_over_the_treated_area(facts: Facts) -> None:
    fields = legal_record("eu", told_with(META), facts).as_json()["fields"]
    assert fields["product_quantity"]["value"] == pytest.approx(0.5 * 0.05)
    dose = fields["dose"]
    assert dose["value"] == pytest.approx(0.025 / facts.area_ha, abs=1e-3)
    assert dose["unit"] == "L/ha"


@pytest.mark.parametrize(
    "key", [key for key in EU_TOLD if key not in ("application.profile", "application.crop")]
)
def test_without_any_one_field_a_record_is_never_complete(facts: Facts, key: str) -> None:
    told = {name: value for name, value in EU_TOLD.items() if name != key}
    record = legal_record("eu", told_with({"application_json": json.dumps(told)}), facts)
    name = key.removeprefix("application.").replace(".", "_")
    assert not record.is_complete
    assert name in record.missing


@pytest.mark.parametrize("profile", PROFILES)
def test_nothing_said_is_named_field_by_field(facts: Facts, profile: str) -> None:
    record = legal_record(profile, told_with({}), facts)  # type: ignore[arg-type]
    empty = {name for name, entry in record.as_json()["fields"].items() if entry["value"] is None}
    assert set(record.missing) <= empty
    assert not record.is_complete


def test_us_record_has_gallons_and_the_pilots_day(facts: Facts) -> None:
    record = legal_record("us", told_with({"application_json": json.dumps(US_TOLD)}), facts)
    fields = record.as_json()["fields"]
    assert record.is_complete
    assert fields["quantity_gal"]["value"] == pytest.approx(0.5 / 3.785411784, abs=1e-3)
    assert fields["pilot_skills_date"]["value"] == "2024-02-01"


def test_a_pilot_who_met_the_requirements_after_the_flight_had_not(facts: Facts) -> None:
    said = {**US_TOLD, "application.pilot_skills_date": "2026-05-02"}
    record = legal_record("us", told_with({"application_json": json.dumps(said)}), facts)
    assert record.missing == ("pilot_skills_date: 2026-05-02 is after the flight",)
    on_the_day = {**said, "application.pilot_skills_date": facts.date}
    assert legal_record(
        "us", told_with({"application_json": json.dumps(on_the_day)}), facts
    ).is_complete


def test_a_day_that_never_was_in_a_journal_is_not_believed() -> None:
    said = {**EU_TOLD, "application.start_time": "2026-02-31T06:30:00Z"}
    assert told_in({"application_json": json.dumps(said)}) == EU_TOLD


@pytest.mark.parametrize(
    ("wind_m_s", "known"),
    [
        ([0.0, 0.0, 0.0, 0.0], None),  # what ArduCopter tells while it estimates none
        ([3.0, 3.0, 3.0, 3.0], None),  # an estimate that stopped
        ([math.nan] * 4, None),
        ([2.0, 3.0, 3.0, 4.0], 3.5),
        ([0.0, 3.0, math.nan, 4.0], 3.5),
    ],
)
def test_a_wind_that_is_no_estimate_is_not_known_and_the_record_says_so(
    flight: AppliedFlight, wind_m_s: list[float], known: float | None
) -> None:
    treated = treated_of(flight)
    assert treated.first_s is not None
    assert treated.last_s is not None
    time_s = np.linspace(treated.first_s, treated.last_s, 4)
    blown = replace(flight, wind_m_s=Series(time_s=time_s, value=np.array(wind_m_s)))
    facts = facts_of(blown, treated, clock(), volume_l=0.5, volume_by="model", prescribed_l=0.48)
    assert facts.wind_m_s == known
    record = legal_record("generic", told_with({}), facts)
    assert any("the wind in flight is not known" in text for text in record.remarks) is (
        known is None
    )
    assert ("wind_m_s" in record.missing) is (known is None)
    codes = [each.code for each in warnings_of(
        blown, None, clock(), [], treated=treated, unread=[], why_not_evaluated=""
    )]  # fmt: skip
    assert ("wind-unknown" in codes) is (known is None)


def test_wind_that_was_measured_in_flight_needs_no_saying(facts: Facts) -> None:
    without = legal_record("generic", told_with({}), facts)
    measured = legal_record("generic", told_with({}), replace(facts, wind_m_s=2.34))
    assert "wind_m_s" in without.missing
    assert "wind_m_s" not in measured.missing
    assert measured.as_json()["fields"]["wind_m_s"]["value"] == 2.3


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"training": "water"}, "training (water)"),
        ({"training": "dry"}, "training (dry)"),
        ({"area_ha": 0.0}, "nothing was sprayed"),
        ({"lost_rows": 3}, "3 lost or unreadable rows"),
        ({"ends_spraying": True, "is_closed": False}, "journal was cut while valves were open"),
        ({"start_time": None}, "start_time"),
        ({"date": None}, "date"),
    ],
)
def test_some_flights_make_no_complete_record_whatever_is_said(
    facts: Facts, change: dict[str, object], text: str
) -> None:
    record = legal_record("eu", told_with(META), replace(facts, **change))  # type: ignore[arg-type]
    assert not record.is_complete
    assert any(text in reason for reason in record.missing)


@pytest.mark.parametrize("source", ["computer", "autopilot-jumped"])
def test_a_clock_that_nobody_verified_is_said(flight: AppliedFlight, source: str) -> None:
    facts = facts_of(
        flight, treated_of(flight), clock(source), volume_l=0.5, volume_by="", prescribed_l=0.5
    )
    record = legal_record("eu", told_with(META), facts)
    assert "not verified" in record.as_json()["fields"]["start_time"]["said"]
    assert any("not verified" in remark for remark in record.remarks)


def test_a_clock_that_was_never_set_gives_no_time(flight: AppliedFlight) -> None:
    never = Clock(offset_s=0.0, source="computer", zone=UTC, zone_name="UTC")
    facts = facts_of(
        flight, treated_of(flight), never, volume_l=0.5, volume_by="", prescribed_l=0.5
    )
    assert (facts.date, facts.start_time) == (None, None)


def test_the_operators_time_stands_for_a_clock_that_was_wrong(flight: AppliedFlight) -> None:
    treated = treated_of(flight)
    never = Clock(offset_s=0.0, source="computer", zone=UTC, zone_name="UTC")
    moved = never.moved_to("2026-05-01T08:30:00+02:00", treated.first_s)
    assert moved.text(treated.first_s) == "2026-05-01T06:30:00+00:00"
    assert (moved.source, moved.is_verified) == ("operator", True)


# ------------------------------------------------------------------------------ what people said


def test_a_later_correction_is_marked_and_the_earlier_value_kept(facts: Facts) -> None:
    told = told_with(META, changes=["application.crop_eppo=HORVX", 'application.customer="D, E"'])
    record = legal_record("eu", told, facts)
    fields = record.as_json()["fields"]
    assert fields["crop_eppo"]["said"] == AFTER
    assert fields["crop_eppo"]["replaced"] == "TRZAW"
    assert fields["customer"]["value"] == "D, E"
    assert set(record.added_after_flight) == {"crop_eppo", "customer"}


def test_saying_the_same_again_is_no_correction() -> None:
    assert told_with(META, changes=["application.crop_eppo=TRZAW"]).after == frozenset()


def test_a_file_says_several_at_once(tmp_path: Path) -> None:
    file = tmp_path / "later.toml"
    file.write_text('[application]\ncustomer = "B"\n[product]\nname = "Other"\n')
    told = told_with(META, file=file)
    assert told.after == {"application.customer", "product.name"}
    assert told.before == {"product.name": "Mix 50"}


def test_older_journals_say_it_by_their_configuration() -> None:
    text = '[application]\nprofile = "us"\ncustomer = "B"\n[boom]\nwidth_m = 6.0\n'
    assert told_in({"config_toml": text}) == {
        "application.profile": "us", "application.customer": "B",
    }  # fmt: skip
    assert told_in({"config_toml": "not [ toml"}) == {}
    assert told_in({"application_json": "[1"}) == {}
    odd = {"application.product_per_l": "lots", "application.crop": "wheat", "lag.on_s": 0.1}
    assert told_in({"application_json": json.dumps(odd)}) == {"application.crop": "wheat"}


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ("customer=B", "no entry of the record"),
        ("application.customer", "no entry of the record"),
        ("application.costumer=B", "no entry of the record"),
        ("application.crop_eppo=wheat", "application.crop_eppo"),
        ("application.product_per_l=lots", "application.product_per_l"),
        ("lag.on_s=0.1", "no entry of the record"),
    ],
)
def test_what_is_no_entry_is_refused_in_one_line(change: str, text: str) -> None:
    with pytest.raises(ConfigError) as refused:
        told_with(META, changes=[change])
    assert text in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("text", ["", "x = ", "[boom]\nwidth_m = 1.0\n", "\udcff"])
def test_a_file_that_says_nothing_is_refused_in_one_line(tmp_path: Path, text: str) -> None:
    file = tmp_path / "later.toml"
    file.write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(ConfigError) as refused:
        told_with(META, file=file)
    assert str(file) in str(refused.value)
    assert "\n" not in str(refused.value)


# -------------------------------------------------------------------------------------- the files


def test_files_say_the_same_as_the_record(facts: Facts) -> None:
    record = legal_record("eu", told_with(META), facts)
    found = json.loads(record_json(record))
    (row,) = csv.DictReader(io.StringIO(record_csv(record).decode()))
    assert (row["complete"], found["complete"]) == ("yes", True)
    assert float(row["treated_area_ha"]) == found["fields"]["treated_area_ha"]["value"]
    assert row["product_name"] == "Mix 50"
    assert row["dose_unit"] == "L/ha"
    area = shapely.from_wkt(row["treated_area_wkt"])
    assert area.equals_exact(shapely.from_geojson(json.dumps(found["treated_area"])), 1e-6)


def test_an_end_within_the_spraying_is_noticed(flight: AppliedFlight) -> None:
    treated = treated_of(flight)
    assert treated.last_s is not None
    cut = replace(flight, is_closed=False, time_s=flight.time_s - 2.0)
    assert not ends_spraying(flight, treated)
    assert not ends_spraying(replace(flight, is_closed=False), replace(treated, last_s=101.0))
    assert ends_spraying(cut, replace(treated, last_s=float(cut.time_s[-1])))
