"""Each profile against its law's own list, written here by hand from the text of the law."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import replace
from datetime import UTC

import pytest

from analysis.assess.ground import treated_of
from analysis.flown.read_applied import read_applied
from analysis.report.build import record_csv, record_json
from analysis.report.clock import Clock
from analysis.report.legal import legal_record
from analysis.report.legal_fields import Facts, Told, facts_of, told_with
from companion.config.application_table import PROFILES, Profile
from companion.simulated import Simulated
from tests.analysis.report_flight import EU_TOLD, fly

# What a law lists, in its words, shortened; the fields of the record that answer it.
LAWS: dict[Profile, dict[str, tuple[str, ...]]] = {
    # (EU) 2023/564, annex, with Article 67(1) of (EC) 1107/2009.
    "eu": {
        "professional user": ("operator",),
        "type of use": ("type_of_use",),
        "product: name": ("product_name",),
        "product: authorisation number": ("product_registration",),
        "date": ("date",),
        "start time, where the use is restricted to times": ("start_time",),
        "dose": ("dose",),
        "area treated, its size": ("treated_area_ha",),
        "location: parcel of the aid application, or geodata": ("parcel", "geodata", "location"),
        "crop or land use, EPPO code": ("crop_eppo",),
        "BBCH stage": ("growth_stage_bbch",),
    },
    # 14 CFR 137.71(a).
    "us": {
        "(1) name and address of each person served": ("customer", "customer_address"),
        "(2) date of the service": ("date",),
        "(3) name and quantity of the material dispensed": ("product_name", "quantity_gal"),
        "(4) name, address, certificate number of the pilot": (
            "pilot", "pilot_address", "pilot_certificate",
        ),
        "(4) day on which 137.19(e) was met": ("pilot_skills_date",),
    },
    "australia": {
        # Pesticides Regulation 2017 (NSW), clause 26(4).
        "(a) name and address of the pilot": ("pilot", "pilot_address"),
        "(b) product name and active constituents": ("product_name", "product_active_constituents"),
        "(c) date and time, start and finish": ("date", "start_time", "end_time"),
        "(d), (e) registration mark or serial number of the aircraft": ("aircraft",),
        "manner and equipment": ("nozzles", "boom_width_m", "height_m", "speed_m_s"),
        "weather: wind speed and direction": ("wind_m_s", "wind_from_deg"),
        "weather: temperature and humidity": ("temperature_c", "humidity_percent"),
        "weather: temperature inversion": ("inversion",),
        "land: address and paddock": ("land_address", "field_name"),
        "crop or situation": ("crop",),
        "rate and total quantity": ("dose", "mean_rate_l_ha", "product_quantity", "volume_l"),
        "owner or occupier: name, address, contact": (
            "customer", "customer_address", "customer_contact",
        ),
        # Agricultural Chemicals Distribution Control Act 1966 (Queensland), aerial distribution.
        "APVMA distinguishing number": ("product_registration",),
        "diluent and additives": ("diluent",),
        "concentration": ("product_per_l", "product_unit"),
        "exact location and total area": ("location", "geodata", "treated_area_ha"),
        "purpose": ("purpose",),
        "contractor": ("operator",),
    },
}  # fmt: skip
SAID = EU_TOLD | {
    "application.customer": "B. Farmer",
    "application.customer_address": "1 Farm Road",
    "application.customer_contact": "02 5550 0000",
    "application.pilot": "C. Pilot",
    "application.pilot_address": "2 Air Street",
    "application.pilot_certificate": "1234567",
    "application.pilot_skills_date": "2024-02-01",
    "application.land_address": "1 Farm Road",
    "application.field_name": "West",
    "application.purpose": "rust",
    "application.diluent": "water 19 L/ha",
    "application.aircraft": "Hexa, serial 42",
    "application.nozzles": "6 x 11003",
    "application.wind_m_s": 2.0,
    "application.wind_from_deg": 270.0,
    "application.temperature_c": 20.0,
    "application.humidity_percent": 60.0,
    "application.inversion": "no",
    "product.registration": "12345",
    "product.active_constituents": "propiconazole 250 g/L",
}
YEARS = {"eu": 3, "us": 1, "australia": 3}


@pytest.fixture(scope="module")
def facts(tmp_path_factory: pytest.TempPathFactory) -> Facts:
    flight = read_applied(fly(tmp_path_factory.mktemp("laws")))
    # 2028-02-29T06:00:00Z at the flight's start.
    clock = Clock(
        offset_s=1_835_416_800.0 - 100.0, source="autopilot", zone=UTC, zone_name="UTC"
    )  # fmt: skip
    treated = treated_of(flight)
    return facts_of(
        flight, treated, clock, volume_l=0.5, volume_by="model", prescribed_l=0.48
    )  # fmt: skip


def told(leave: str = "") -> Told:
    said = {key: value for key, value in SAID.items() if key != leave}
    return told_with({"application_json": json.dumps(said)})


@pytest.mark.parametrize("profile", LAWS)
def test_a_record_has_all_that_its_law_lists_and_is_complete(
    facts: Facts, profile: Profile
) -> None:
    record = legal_record(profile, told(), facts)
    assert record.missing == ()
    fields = json.loads(record_json(record))["fields"]
    (row,) = csv.DictReader(io.StringIO(record_csv(record).decode()))
    for asked, names in LAWS[profile].items():
        for name in names:
            assert fields[name]["value"] not in (None, ""), asked
            assert row[name] == str(fields[name]["value"]), asked


@pytest.mark.parametrize(
    ("profile", "name"),
    [(law, name) for law, list_ in LAWS.items() for names in list_.values() for name in names],
)
def test_without_any_one_of_them_it_says_which_is_missing(
    facts: Facts, profile: Profile, name: str
) -> None:
    own = [key for key in SAID if key.removeprefix("application.").replace(".", "_") == name]
    if own:
        record = legal_record(profile, told(own[0]), facts)
    elif name in ("dose", "product_quantity"):
        record = legal_record(profile, told("application.product_per_l"), facts)
    else:
        nothing = {
            "date": None, "start_time": None, "end_time": None, "latitude_deg": None,
            "area_ha": 0.0, "mean_rate_l_ha": None, "height_m": None, "speed_m_s": None,
        }  # fmt: skip
        if name == "boom_width_m":
            return  # no flight is without a boom
        record = legal_record(profile, told(), replace(facts, **nothing))  # type: ignore[arg-type]
    assert name in record.missing
    assert not record.is_complete
    assert json.loads(record_json(record))["complete"] is False


@pytest.mark.parametrize("profile", PROFILES)
def test_a_simulated_flights_record_is_never_complete(facts: Facts, profile: Profile) -> None:
    flown = replace(facts, simulated=Simulated(word="yes", because="it says so"))
    later = told_with(
        {"application_json": json.dumps(SAID)}, changes=["application.real_flight=yes"]
    )  # fmt: skip
    record = legal_record(profile, later, flown)
    assert not record.is_complete
    assert any("SIMULATED" in reason for reason in record.missing)


@pytest.mark.parametrize("profile", PROFILES)
def test_how_long_to_keep_it_is_said_in_words_years_and_as_a_day(
    facts: Facts, profile: Profile
) -> None:
    found = json.loads(record_json(legal_record(profile, told(), facts)))
    years = YEARS.get(profile)
    assert found["retention_years"] == years
    assert found["keep_until"] == (None if years is None else f"{2028 + years}-03-01")
    assert "keep it for" in found["retention"]
    undated = legal_record(profile, told(), replace(facts, date=None))
    assert undated.keep_until is None


def test_every_profile_with_a_law_has_its_list_here() -> None:
    assert set(LAWS) | {"generic"} == set(PROFILES)
