"""Which limits of label and permit a flight kept, by its journal, and which it does not tell."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from datetime import UTC
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from analysis.assess.ground import treated_of
from analysis.flown.applied_flight import AppliedFlight, Series
from analysis.flown.read_applied import read_applied
from analysis.report.clock import Clock
from analysis.report.label import label_of
from analysis.report.legal_fields import told_with
from companion.core.inputs import WindReport
from companion.journal.journal import Journal
from tests.analysis.applied_flights import eastwards
from tests.analysis.report_flight import fly
from tests.builders import setup

# 2026-05-01T05:00:00Z, less the seconds that the flight's clock shows where it begins to spray.
OFFSET_S = 1_777_611_600.0 - 100.0
CLOCK = Clock(offset_s=OFFSET_S, source="autopilot", zone=UTC, zone_name="UTC")
SEEN = {"application.observed_at": "2026-05-01T06:30:00+02:00"}
NAN = math.nan


def winds(*values: float) -> Series:
    """Return a wind each half second from before the spraying; values repeat with a grain more."""
    at_s = np.arange(99.0, 118.0, 0.5)
    grain = 1e-6 * np.arange(len(at_s))
    return Series(time_s=at_s, value=np.resize(np.array(values), len(at_s)) + grain)


FLIGHT = replace(
    eastwards(), utc_offset_s=OFFSET_S, utc_source="autopilot", wind_m_s=winds(3.0),
    wind_from_deg=winds(270.0),
)  # fmt: skip


def report(
    limits: dict[str, Any],
    *,
    flight: AppliedFlight = FLIGHT,
    said: dict[str, Any] | None = None,
    later: tuple[str, ...] = (),
    meta: dict[str, str] | None = None,
) -> dict[str, Any]:
    """Return what the report says of limits."""
    label = {"version": 1, "title": "a label", **limits}
    about = {
        "limits_json": json.dumps(label),
        "application_json": json.dumps(SEEN if said is None else {**SEEN, **said}),
        **(meta or {}),
    }
    given = replace(flight, meta=about)
    found = label_of(given, treated_of(given), CLOCK, told_with(about, changes=later))
    assert found is not None
    return found


WEATHER = ("temperature_c", "humidity_percent", "inversion", "observed_at")
# Limits, what is said, and whether each row was kept: None is not known.
TABLE: dict[str, tuple[dict[str, Any], dict[str, Any], dict[str, bool | None]]] = {
    "rate": ({"rate_max_l_ha": 25.3, "rate_min_l_ha": 14.7}, {}, {"prescribed rate": True}),
    "rate above": ({"rate_max_l_ha": 24.9}, {}, {"prescribed rate": False}),
    "rate below": ({"rate_min_l_ha": 15.1}, {}, {"prescribed rate": False}),
    "speed": ({"speed_min_m_s": 4.9, "speed_max_m_s": 5.1}, {}, {"ground speed": True}),
    "speed above": ({"speed_max_m_s": 4.9}, {}, {"ground speed": False}),
    "speed below": ({"speed_min_m_s": 5.1}, {}, {"ground speed": False}),
    "height": ({"height_min_m": 3.4, "height_max_m": 3.6}, {}, {"height": True}),
    "height above": ({"height_max_m": 3.4}, {}, {"height": False}),
    "height below": ({"height_min_m": 3.6}, {}, {"height": False}),
    "wind": ({"wind_min_m_s": 2.9, "wind_max_m_s": 3.1}, {}, {"wind": True}),
    "wind above": ({"wind_max_m_s": 2.9}, {}, {"wind": False}),
    "wind below": ({"wind_min_m_s": 3.1}, {}, {"wind": False}),
    "direction": ({"wind_from_deg": [[260, 280]]}, {}, {"wind direction": True}),
    "direction else": ({"wind_from_deg": [[0, 180]]}, {}, {"wind direction": False}),
    "droplets": (
        {"droplet_classes": ["coarse"]}, {"product.droplet_class": "Coarse"},
        {"droplet_class": True},
    ),
    "droplets else": (
        {"droplet_classes": ["coarse"]}, {"product.droplet_class": "fine"},
        {"droplet_class": False},
    ),
    "droplets not said": ({"droplet_classes": ["coarse"]}, {}, {"droplet_class": None}),
    "temperature": (
        {"temperature_max_c": 25}, {"application.temperature_c": 25}, {"temperature_c": True},
    ),
    "heat": (
        {"temperature_max_c": 25}, {"application.temperature_c": 26}, {"temperature_c": False},
    ),
    "temperature not said": ({"temperature_max_c": 25}, {}, {"temperature_c": None}),
    "humidity": (
        {"humidity_min_percent": 50}, {"application.humidity_percent": 50},
        {"humidity_percent": True},
    ),
    "dry air": (
        {"humidity_min_percent": 50}, {"application.humidity_percent": 49},
        {"humidity_percent": False},
    ),
    "no inversion": (
        {"inversion": "forbidden"}, {"application.inversion": "no"}, {"inversion": True},
    ),
    "inversion": (
        {"inversion": "forbidden"}, {"application.inversion": "yes"}, {"inversion": False},
    ),
    "inversion not said": ({"inversion": "forbidden"}, {}, {"inversion": None}),
    "weather of the day": (
        {"inversion": "forbidden", "observed_max_h": 0.6}, {"application.inversion": "no"},
        {"age of the weather": True},
    ),
    "old weather": (
        {"inversion": "forbidden", "observed_max_h": 0.4}, {"application.inversion": "no"},
        {"age of the weather": False},
    ),
    "hours": ({"hours": ["06:59-08:00"], "utc_offset": "+02:00"}, {}, {"hours": True}),
    "hours over": ({"hours": ["06:00-07:00"], "utc_offset": "+02:00"}, {}, {"hours": False}),
    "day": ({"last_day": "2026-05-01", "utc_offset": "+02:00"}, {}, {"hours": True}),
    "permit over": ({"last_day": "2026-04-30", "utc_offset": "+02:00"}, {}, {"hours": False}),
}  # fmt: skip


@pytest.mark.parametrize("name", TABLE)
def test_each_limit_in_the_report(name: str) -> None:
    limits, said, expected = TABLE[name]
    found = report(limits, said=said)
    kept = {row["name"]: row["kept"] for row in found["limits"]}
    assert {key: kept[key] for key in expected} == expected
    assert found["kept"] is all(each is True for each in kept.values())
    if set(expected.values()) == {True}:
        assert found["kept"], found


@pytest.mark.parametrize(("most_h", "kept"), [(0.6, [True, True]), (0.4, [False, True])])
def test_each_spraying_is_judged_by_the_weather_declared_before_it(
    most_h: float, kept: list[bool]
) -> None:
    said = {"application.inversion": "no", "application.observed_at": "2026-05-01T05:00:00Z"}
    meta = {"declared_json": json.dumps([[110.0, json.dumps(said)]])}
    limits = {"inversion": "forbidden", "observed_max_h": most_h}
    found = report(limits, said={"application.inversion": "no"}, meta=meta)
    rows = [row["kept"] for row in found["limits"] if row["name"] == "age of the weather"]
    assert rows == kept


def test_without_limits_a_report_says_nothing_of_them() -> None:
    assert label_of(FLIGHT, treated_of(FLIGHT), CLOCK, told_with({})) is None


@pytest.mark.parametrize(
    ("wind", "direction", "kept"),
    [
        (None, None, None),
        (winds(NAN), winds(NAN), None),
        (replace(winds(3.0), value=np.full(38, 3.0)), winds(270.0), None),
        (Series(time_s=np.array([90.0, 91.0]), value=np.array([2.9, 3.0])), None, None),
    ],
)
def test_a_wind_that_nobody_knew_is_not_known_to_be_kept(
    wind: Series | None, direction: Series | None, kept: bool | None
) -> None:
    blown = replace(FLIGHT, wind_m_s=wind, wind_from_deg=direction)
    limits = {"wind_max_m_s": 9, "wind_from_deg": [[0, 360]]}
    rows = {row["name"]: row["kept"] for row in report(limits, flight=blown)["limits"]}
    assert rows == {"wind": kept, "wind direction": kept}
    # Where the operator measures it, it need not be heard.
    said = {"application.wind_m_s": 2.0, "application.wind_from_deg": 270.0}
    found = report({**limits, "wind_by": "operator"}, flight=blown, said=said)
    assert found["kept"]


def test_a_gust_that_closed_the_valves_broke_nothing() -> None:
    gust = winds(3.0)
    during = (gust.time_s > 106.9) & (gust.time_s < 108.1)
    blown = np.where(during, 9.0, gust.value)
    shut = eastwards(shut_m=(20.0, 30.0), inhibit="label-wind")
    spraying = shut.flow_l_min > 0.0
    closed = (shut.time_s >= 107.0) & (shut.time_s <= 108.7)
    closed_flight = replace(
        FLIGHT, flow_l_min=np.where(closed, 0.0, shut.flow_l_min),
        wind_m_s=Series(time_s=gust.time_s, value=blown),
    )  # fmt: skip
    open_flight = replace(closed_flight, flow_l_min=np.where(closed, 5.0, shut.flow_l_min))
    assert spraying.any()
    for flight, kept in ((closed_flight, True), (open_flight, False)):
        (row,) = report({"wind_max_m_s": 6}, flight=flight)["limits"]
        assert row["kept"] is kept


def test_hours_are_not_known_by_a_computers_clock() -> None:
    flight = replace(FLIGHT, utc_source="computer")
    limits = {"last_day": "2026-05-01", "utc_offset": "+02:00", "inversion": "forbidden"}
    rows = report(limits, flight=flight, said={"application.inversion": "no"})["limits"]
    kept = {row["name"]: row["kept"] for row in rows}
    assert (kept["hours"], kept["age of the weather"]) == (None, None)


def test_what_is_said_after_the_flight_is_marked() -> None:
    (row, *_) = report({"inversion": "forbidden"}, later=("application.inversion=no",))["limits"][
        1:
    ]
    assert (row["kept"], row["found"]) == (True, "declared: no, said after the flight")


def test_buffers_are_those_of_the_flown_map() -> None:
    limits = {"buffer": [{"kind": "water", "distance_m": 10, "files": ["w.geojson"]}]}
    flown = {"flight_map_json": json.dumps({"frozen": {"limits.buffer": [["water", 10, ["w"]]]}})}
    for meta, kept in ((flown, True), ({}, None)):
        (row,) = report(limits, meta=meta)["limits"]
        assert (row["limit"], row["kept"]) == ("10 m from water", kept)


def test_reentry_counts_from_the_end_of_the_spraying() -> None:
    found = report({"reentry_h": 24})
    last_s = treated_of(FLIGHT).last_s
    assert last_s is not None
    assert found["reentry_from"] == f"2026-05-02T05:00:{int(last_s - 100.0):02d}+00:00"
    assert report({})["reentry_from"] is None


def test_the_direction_of_the_wind_comes_out_of_the_journal(tmp_path: Path) -> None:
    with Journal.create(
        tmp_path, setup=setup(), setup_text={}, started_s=100.0, waits=True, training="no"
    ) as journal:
        for number, (east, north) in enumerate(((3.0, 0.0), (0.0, 3.0), (0.0, 0.0))):
            journal.record_input(
                WindReport(received_s=100.0 + number, speed_m_s=3.0, east_m_s=east, north_m_s=north)
            )
        journal.record_input(WindReport(received_s=104.0, speed_m_s=3.0))
    found = read_applied(journal.path).wind_from_deg
    assert found is not None
    np.testing.assert_allclose(found.value, [270.0, 180.0, NAN, NAN], equal_nan=True)
    assert read_applied(fly(tmp_path / "other")).wind_from_deg is None
