"""No simulated flight makes a complete record: not beside the stub, nor in the twin."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import pytest

from analysis.report.build import Report, ReportOptions, build_report
from companion.cli.app import execute
from companion.cli.record_parts import follow
from companion.config import load
from companion.config.application_table import PROFILES
from companion.journal.journal import Journal
from companion.simulated import Simulated
from missions.maps.compiling import compiled_setup
from sitl.serve import ServeOptions
from tests.analysis.report_flight import EU_TOLD, REAL, fly
from tests.bench.wire import example
from tests.bench.wire_clock import fly as fly_by_clock
from tests.bench.worst import judged
from tests.companion.realtime.test_wire_flight import write_field, write_mission
from tests.virtual_time import START_S

# Of the short mission: its first plots are sprayed by then.
FLOWN_S = 28.0
TOLD = (*(f"{key}={value}" for key, value in EU_TOLD.items()), "application.real_flight=yes")


def stub_journal(folder: Path, autopilot: str) -> Path:
    """Fly beside the stub as a product is sprayed, and return the journal."""
    config = example(folder, autopilot=autopilot, port=14550)
    write_field(folder)
    write_mission(folder / "short.waypoints")
    text = config.read_text(encoding="utf-8")
    config.write_text(
        text.replace('rate_field = "rate"', 'rate_field = "rate"\nunit = "L/ha"'), encoding="utf-8"
    )
    setup = compiled_setup(load(config))
    with Journal.create(
        folder / "flights",
        setup=setup,
        setup_text={"application_json": json.dumps(EU_TOLD)},
        started_s=START_S,
        waits=True,
        training="no",
    ) as journal:
        fly_by_clock(
            config,
            ServeOptions(
                autopilot=autopilot,
                field_config=config,
                mission=folder / "short.waypoints",
                seed=5,
                out=folder / "truth",
            ),
            recorder=journal,
            setup=setup,
            wired=lambda link, executor: follow(journal, link, executor),
            duration_s=FLOWN_S,
        )
    return journal.path


def report_of(path: Path, *changes: str) -> Report:
    options = ReportOptions(profiles=PROFILES, with_figures=False, changes=changes)
    return build_report(path, options)


@pytest.mark.sitl
@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
def test_a_flight_beside_the_stub_is_simulated_in_page_record_and_exports(
    tmp_path: Path, autopilot: str
) -> None:
    path = stub_journal(tmp_path / "field", autopilot)
    report = report_of(path, *TOLD)
    flight = report.contents["flight"]
    assert flight["simulated"] == "yes"
    assert "simulated sensor" in flight["simulated_because"]
    assert report.contents["verdict"]["applied_l"] > 0.2
    page = report.files["report.html"].decode()
    assert "<title>SIMULATED" in page
    assert "SIMULATED FLIGHT" in page
    for profile in PROFILES:
        record = json.loads(report.files[f"application-{profile}.json"])
        assert record["complete"] is False
        assert record["simulated"] == "yes"
        assert any("SIMULATED" in each for each in record["missing"])
        head, row = report.files[f"application-{profile}.csv"].decode().splitlines()[:2]
        assert "simulated" in head.split(",")
        assert "yes" in row


def test_of_an_unknown_flight_the_operator_may_vouch_after_it_and_not_before(
    tmp_path: Path,
) -> None:
    unknown = Simulated(word="unknown", because="INS_ACC_ID: no answer")
    before = {**EU_TOLD, "application.real_flight": "yes"}
    path = fly(tmp_path, told=before, simulated=unknown)
    report = report_of(path)
    record = report.contents["application"]["eu"]
    assert not record["complete"]
    assert any("not known whether simulated" in each for each in record["missing"])
    assert "not known whether simulated" in report.files["report.html"].decode()
    assert report_of(path, "application.real_flight=yes").contents["application"]["eu"]["complete"]
    # Said before the flight it would vouch for every simulation flown with that file.
    path = fly(tmp_path, told=EU_TOLD, simulated=unknown)
    vouched = report_of(path, "application.real_flight=yes").contents["application"]["eu"]
    assert vouched["complete"]
    assert "real_flight" in vouched["added_after_flight"]


@pytest.mark.parametrize(
    ("simulated", "complete"),
    [
        (REAL, True),
        (Simulated(word="yes", because="its sensors"), False),
        (Simulated(word="unknown", because="nobody told"), False),
    ],
)
def test_only_a_real_flight_makes_a_complete_record(
    tmp_path: Path, simulated: Simulated, complete: bool
) -> None:
    path = fly(tmp_path, told=EU_TOLD, simulated=simulated)
    assert report_of(path).contents["application"]["eu"]["complete"] is complete


@pytest.fixture(scope="module")
def simulated_flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the journal of a flight as with a product: only what the vehicle is tells."""
    folder = tmp_path_factory.mktemp("simulated")
    return fly(folder, simulated=Simulated(word="yes", because="its sensors"))


@pytest.mark.parametrize(
    "name", ["a.csv", "a.geojson", "a.geojsonl", "a.kml", "a.shp", "a.parquet", "a.mcap", "a.zip"]
)
def test_every_export_of_a_simulated_flight_says_so(
    simulated_flight: Path, tmp_path: Path, name: str
) -> None:
    assert execute(["export", str(simulated_flight), "--out", str(tmp_path / name)]) == 0
    written = b""
    for file in tmp_path.iterdir():
        written += file.read_bytes()
        if zipfile.is_zipfile(file):
            with zipfile.ZipFile(file) as packed:
                written += b"".join(packed.read(each) for each in packed.namelist())
    assert b"simulated" in written.lower()


@pytest.mark.parametrize("number", [0, 3])
def test_a_twin_flight_keeps_its_bound_agrees_with_itself_and_is_no_application(
    number: int, two_passes: None
) -> None:
    found = judged(number)
    assert found["truth_m"] <= found["bound_m"]
    assert found["disagrees"] == []
    assert (found["complete"], found["simulated"]) == ([], "yes")
