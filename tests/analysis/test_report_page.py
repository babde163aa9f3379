"""The page: one file, nothing from outside, every number in it, and what must be seen first."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from analysis.assess.assessment import assess, figures_of
from analysis.assess.causes import Cause
from analysis.assess.cell_maps import Histogram
from analysis.assess.ground import treated_of
from analysis.flown.read_applied import read_applied
from analysis.report.build import Report, ReportOptions, build_report, embedded, page_of
from analysis.report.clock import clock_of
from analysis.report.contents import (
    METRICS,
    contents_of,
    held_between,
    held_ground,
    valve_in_force,
)
from analysis.report.drawing import histogram
from analysis.report.legal_fields import told_with
from companion.journal.writer import Event
from tests import builders
from tests.analysis.report_flight import EU_TOLD, fly

# Attributes by which a page would fetch something.
FETCHES = {"src", "href", "data", "action", "poster", "srcset", "background", "formaction"}


class Parsed(HTMLParser):
    """What stands in a page."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.script = self.text = ""
        self._in: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        self._in.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag in self._in:
            while self._in.pop() != tag:
                pass

    def handle_data(self, data: str) -> None:
        if self._in and self._in[-1] == "script":
            self.script += data
        elif not self._in or self._in[-1] != "style":
            self.text += data


@pytest.fixture(scope="module")
def journal(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fly(tmp_path_factory.mktemp("page"), told=EU_TOLD, event=("fault-clog", "valve 3 <&"))


@pytest.fixture(scope="module")
def report(journal: Path) -> Report:
    changes = ("application.customer=A & <b>B</b>", "application.remarks=</script><script>x")
    options = ReportOptions(time_zone="Europe/Madrid", changes=changes)
    return build_report(journal, options)


@pytest.fixture(scope="module")
def page(report: Report) -> Parsed:
    return Parsed(report.files["report.html"].decode())


def test_nothing_is_fetched_from_outside_and_nothing_runs(report: Report, page: Parsed) -> None:
    links = [
        value or ""
        for _, attributes in page.tags
        for name, value in attributes.items()
        if name.removeprefix("xlink:") in FETCHES
    ]
    assert links
    assert all(link.startswith(("data:image/png;base64,", "#")) for link in links)
    text = report.files["report.html"].decode()
    assert re.findall(r"url\((?!#)[^)]*\)|@import", text) == []
    scripts = [attributes for tag, attributes in page.tags if tag == "script"]
    assert scripts == [{"type": "application/json", "id": "report"}]
    assert not any(name.startswith("on") for _, each in page.tags for name in each)
    assert {"iframe", "object", "link", "embed"}.isdisjoint(tag for tag, _ in page.tags)


def test_every_number_of_the_page_is_in_it_as_json(report: Report, page: Parsed) -> None:
    assert json.loads(page.script) == json.loads(report.files["report.json"])


def test_what_the_figures_mean_is_one_click_away(page: Parsed) -> None:
    ids = {attributes["id"] for _, attributes in page.tags if "id" in attributes}
    links = {attributes.get("href") for tag, attributes in page.tags if tag == "a"}
    assert links == {"#definitions"}
    assert "definitions" in ids


def test_the_published_flights_stand_beside_this_one(page: Parsed) -> None:
    assert "+0.32" in page.text
    assert "+3.87" in page.text
    assert "94.77" in page.text


def test_the_first_screen_speaks_to_a_farmer(report: Report, page: Parsed) -> None:
    contents = report.contents
    text = re.sub(r"\s+", " ", page.text).partition("On the ground")[0]
    assert f"{contents['verdict']['applied_l']:.2f} L" in text
    assert "modelled, not metered" in text
    percent = f"({contents['verdict']['untreated_percent']:.0f} %)"
    assert re.search(rf"m² {re.escape(percent)}\s?of the field not treated", text)
    # The model's largest lag distance is no bound, and no headline.
    assert "worst" not in text
    # Times as they are read; the zone is named beside them.
    start = contents["flight"]["spraying_from"][:19]
    assert f"sprayed {start.replace('T', ' ')} to" in text
    assert start not in text


def test_what_is_missing_of_a_record_is_said_in_words(journal: Path) -> None:
    options = ReportOptions(profiles=("us",), with_figures=False)
    contents = build_report(journal, options).contents
    (told,) = [each for each in contents["warnings"] if each["code"] == "record"]
    missing = contents["application"]["us"]["missing"]
    assert "pilot_certificate" in missing
    label = contents["application"]["us"]["fields"]["customer_address"]["label"]
    assert label.lower() in told["text"].lower()
    assert "_" not in told["text"]


@pytest.mark.parametrize("missed", [0, 7])
def test_changes_that_never_settled_are_counted_beside_those_that_did(
    report: Report, missed: int
) -> None:
    settled = report.contents["settled_lag_distance_m"] | {"missed": missed}
    text = Parsed(page_of({**report.contents, "settled_lag_distance_m": settled}, {})).text
    assert (f"{missed} never settled" in text) == (missed > 0)
    assert ("Where rates differ across the boom" in text) == (missed > 0)


@pytest.mark.parametrize(("most", "scale"), [(200, "linear"), (20_000, "log")])
def test_a_histogram_of_one_great_bar_shows_the_others_too(most: int, scale: str) -> None:
    counts = np.array([30, 40, 50, most, 40, 30])
    found = Histogram(
        unit="L/ha",
        edges=np.linspace(-3.0, 3.0, 7),
        counts=counts,
        mean=0.0,
        sd=1.0,
        mean_abs=0.5,
        sd_abs=0.5,
        cells=int(counts.sum()),
    )
    drawn = histogram([found])
    assert drawn is not None
    (panel,) = drawn.figure.axes
    assert panel.get_yscale() == scale
    assert panel.get_ylim()[1] > most


def test_another_percentage_of_the_rates_is_told(tmp_path: Path) -> None:
    flown = fly(tmp_path, event=("command", "rate override 80 %"))
    warnings = build_report(flown, ReportOptions(with_figures=False)).contents["warnings"]
    (told,) = [each for each in warnings if each["code"] == "rate-override"]
    assert "80 % from 20" in told["text"] or "80 % from a time not known" in told["text"]


def test_names_of_parts_are_used_once(page: Parsed) -> None:
    names = [attributes["id"] for _, attributes in page.tags if "id" in attributes]
    assert len(names) == len(set(names)) > 20


def test_pictures_are_told_to_those_who_cannot_see_them(page: Parsed) -> None:
    alts = [attributes.get("alt") for tag, attributes in page.tags if tag == "img"]
    labels = [attributes.get("aria-label") for tag, attributes in page.tags if tag == "svg"]
    assert len(alts) >= 3 and len(labels) >= 3
    assert all(text and len(text) > 20 for text in [*alts, *labels])


def test_what_people_wrote_is_text_and_never_a_part_of_the_page(
    report: Report, page: Parsed
) -> None:
    assert "A & <b>B</b>" in page.text
    assert "valve 3 <&" in page.text
    assert "<b>B" not in report.files["report.html"].decode()
    assert embedded({"a": "</script>"}) == '{"a": "\\u003c/script\\u003e"}'


def test_times_are_in_the_zone_that_was_asked_for(report: Report, page: Parsed) -> None:
    flight = report.contents["flight"]
    assert re.search(r"\+0[12]:00$", flight["spraying_from"])
    assert "time zone Europe/Madrid" in page.text
    assert "clock of the companion, not verified" in page.text


def test_a_complete_record_is_called_complete(report: Report, page: Parsed) -> None:
    record = report.contents["application"]["eu"]
    assert (record["complete"], record["missing"]) == (True, [])
    assert "Complete: every field" in page.text
    assert "INCOMPLETE" not in page.text
    assert json.loads(report.files["application-eu.json"]) == record


def test_an_incomplete_record_says_so_in_words(journal: Path) -> None:
    options = ReportOptions(profiles=("us",), with_figures=False)
    report = build_report(journal, options)
    text = Parsed(report.files["report.html"].decode()).text
    assert report.contents["application"]["us"]["complete"] is False
    assert "INCOMPLETE" in text and "pilot_certificate" in text
    assert {"application-us.json", "application-us.csv"} <= report.files.keys()
    assert not any(name.startswith("figures/") for name in report.files)


def test_faults_are_named_above_the_figures(page: Parsed) -> None:
    warned = page.text.index("Fault in flight: valve 3 <&")
    assert warned < page.text.index("On the ground")


def test_a_good_flight_has_the_metrics_of_the_contract(report: Report) -> None:
    contents = report.contents
    assert set(METRICS) <= contents.keys()
    assert contents["lag_distance_m"]["mean_abs"] < 0.1
    assert contents["lag_distance_m"]["count"] > 10
    assert contents["verdict"]["applied_l"] == pytest.approx(contents["applied_ml"] / 1e3)
    assert 0.5 < contents["verdict"]["applied_l"] < 0.7
    assert contents["causes"]["within_10_percent"] > 90.0
    assert [row["rate_l_ha"] for row in contents["table_5"]["rows"]][:3] == [15.0, 20.0, 25.0]


def test_figures_are_there_as_png_and_svg(report: Report) -> None:
    names = {"map", "deviation", "flow", "lags", "histogram", "causes", "duty", "treated"}
    found = {Path(name).stem for name in report.contents["figures"]}
    assert found == names
    for name in names:
        assert report.files[f"figures/{name}.png"].startswith(b"\x89PNG")
        svg = report.files[f"figures/{name}.svg"].decode()
        assert svg.startswith("<?xml") and svg.rstrip().endswith("</svg>")


@pytest.mark.parametrize(
    ("training", "words", "done"),
    [
        ("water", "TRAINING WITH WATER", "L of water applied"),
        ("dry", "DRY RUN", "L would have been applied"),
        ("no", None, "L applied"),
        (None, None, "L applied"),
    ],
)
def test_training_stands_large_above_all(
    tmp_path: Path, training: str | None, words: str | None, done: str
) -> None:
    path = fly(tmp_path, told=EU_TOLD, training=training)
    report = build_report(path, ReportOptions(with_figures=False))
    found = Parsed(report.files["report.html"].decode())
    marks = [a for tag, a in found.tags if tag == "p" and a.get("class") == "mark"]
    assert len(marks) == (words is not None)
    assert done in report.contents["verdict"]["sentence"]
    if words is not None:
        assert found.text.index(words) < found.text.index(done)
        assert report.contents["application"]["eu"]["complete"] is False


def test_a_flight_without_spraying_says_so(tmp_path: Path) -> None:
    report = build_report(fly(tmp_path, enabled=False, told=EU_TOLD), ReportOptions())
    contents = report.contents
    assert contents["verdict"]["sentence"] == "Nothing was sprayed in this flight."
    assert "nothing was sprayed" in " ".join(contents["application"]["eu"]["missing"])
    assert "Nothing was sprayed" in report.files["report.html"].decode()


def test_a_flight_that_never_had_a_position_is_reported_without_figures(tmp_path: Path) -> None:
    report = build_report(fly(tmp_path, steps=0), ReportOptions())
    contents = report.contents
    assert all(contents[key] is None for key in METRICS)
    assert [each["code"] for each in contents["warnings"]].count("not-evaluated") == 1


def test_only_what_held_during_the_work_is_a_warning(journal: Path) -> None:
    flight = read_applied(journal)
    treated = treated_of(flight)
    assert treated.first_s is not None and treated.last_s is not None
    middle_s = 0.5 * (treated.first_s + treated.last_s)

    def held(low_s: float, high_s: float) -> dict[str, float]:
        inside = (flight.time_s >= low_s) & (flight.time_s < high_s)
        reasons = tuple("fix-too-low speed-below-min" if each else "" for each in inside)
        return held_between(replace(flight, inhibits=reasons), treated.first_s, treated.last_s)

    assert held(flight.time_s[0], treated.first_s - 0.1) == {}
    assert held(middle_s, middle_s + 1.0)["fix-too-low"] == pytest.approx(1.0, abs=0.2)


def test_ground_that_was_flown_over_closed_is_a_warning_with_its_reasons(journal: Path) -> None:
    assessment = assess(read_applied(journal))
    causes = assessment.causes

    def said(share: float, **by_inhibit: float) -> list[str]:
        area_m2 = {**causes.by_cause, Cause.INHIBIT: share * causes.passed_m2}
        reasons = {name.replace("_", "-"): each for name, each in by_inhibit.items()}
        held = replace(assessment, causes=replace(causes, by_cause=area_m2, by_inhibit=reasons))
        return [each.text for each in held_ground(held)]

    (text,) = said(0.5, output_fault=2.0, rearm_needed=70.0)
    assert text.endswith(
        "the valves held closed: 70 m2 (disable, then enable again), 2 m2 (output fault)."
    )
    assert said(0.009, rearm_needed=1.0) == []
    # Of missing rows other warnings tell.
    assert said(0.5, unread=70.0) == []
    assert list(held_ground(None)) == []


def test_lost_rows_and_a_cut_are_warnings(journal: Path) -> None:
    flight = read_applied(journal)
    event = Event(at_s=math.nan, kind="odd", text="at no time")
    flight = replace(flight, is_closed=False, lost=7, events=(*flight.events, event))
    found = assess(flight)
    contents: dict[str, Any] = contents_of(
        flight,
        found,
        treated=treated_of(flight),
        figures=figures_of(found, area_ha=treated_of(flight).area_ha),
        clock=clock_of(flight, None),
        told=told_with(flight.meta),
        records=(),
    )
    codes = [each["code"] for each in contents["warnings"]]
    assert {"cut", "rows-lost"} <= set(codes)
    assert contents["events"][-1]["time_s"] is None
    text = page_of(contents, {})
    assert "The journal was cut" in text
    assert "7 rows of the journal are lost" in text


def test_the_report_shows_what_is_in_force_for_each_valve(report: Report, page: Parsed) -> None:
    assert "flow 0.980" not in page.text
    setup = builders.setup()
    late = replace(setup.boom.valves[0], flow_factor=0.98, lag_up_s=0.0041)
    own = valve_in_force(late, setup.lag)
    assert own["lags_in_force"]["up_s"] == pytest.approx(setup.lag.up_s + 0.0041)
    assert own["lags_in_force"]["on_s"] == setup.lag.on_s
    known = report.contents["setup"]
    boom = {**known["boom"], "valves": [own]}
    text = Parsed(page_of({**report.contents, "setup": {**known, "boom": boom}}, {})).text
    assert f"{late.name}: flow 0.980, on {1000.0 * setup.lag.on_s:.1f}" in text
    assert f"up {1000.0 * setup.lag.up_s + 4.1:.1f}" in text


@pytest.mark.parametrize(("bound_m", "words"), [(0.0357, "0.036 m of that cannot"), (None, "")])
def test_the_margin_stands_beside_its_bound(
    report: Report, bound_m: float | None, words: str
) -> None:
    assert "bound" in report.contents["border_margin_m"]
    margin = report.contents["border_margin_m"] | {"bound": bound_m}
    text = Parsed(page_of({**report.contents, "border_margin_m": margin}, {})).text
    assert words in text
    assert ("cannot be predicted" in text) == bool(words)
