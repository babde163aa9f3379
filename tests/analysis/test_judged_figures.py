"""What report, record and `sitl fly` print, held against the judge that counts from the truth."""

from __future__ import annotations

import io
import json
import math
import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mcap.reader
import numpy as np
import pyarrow.parquet as pq
import pyogrio
import pytest
import shapely
from isoxml.util.isoxml_io import isoxml_from_path

from analysis.assess.assessment import Assessment, assess, together
from analysis.assess.ground import Treated, treated_of
from analysis.exports.cli import export
from analysis.exports.output import ExportError
from analysis.exports.source import Source
from analysis.flown.modelled_flow import ordered_s
from analysis.flown.read_applied import read_applied
from analysis.journals.jobs import sortie_of
from analysis.report.build import Report, ReportOptions, build_report
from analysis.report.job import build_job
from companion.cli.app import execute
from companion.web.live import BoomTrace
from tests.companion.web_site import served, until
from tests.ground_judge import Field, Truth, Verdict, doses_of, judge, swaths_of, to_local

EXAMPLE = Path("examples/anyang/config.toml")
# Areas to 1 % of the field, litres to 0.5 %.
AREA, LITRES = 0.01, 0.005
# The field of the tutorial: two zones, whose passes overlap by half a metre.
TUTORIAL = (
    (15, [(114.54400, 35.9960), (114.54419, 35.9960), (114.54419, 35.9963), (114.54400, 35.9963)]),
    (25, [(114.54400, 35.9963), (114.54419, 35.9963), (114.54419, 35.9966), (114.54400, 35.9966)]),
)
# Half a hectare, askew to the map, in three sorties.
ASKEW = (
    (20, [(114.54400, 35.9960), (114.54480, 35.9961), (114.54470, 35.9966), (114.54405, 35.9968)]),
)


@dataclass(frozen=True)
class Flown:
    """A simulated flight: what was printed of it, and what the truth says."""

    journal: Path
    truth: Truth
    field: Field
    verdict: Verdict
    result: dict[str, Any]
    contents: dict[str, Any]
    record: dict[str, Any]
    assessed: Assessment


def fly(folder: Path, zones: Any, lines: bool, *more: str) -> Flown:
    """Plan and fly a field without scatter of valves or meter, and make its report."""
    if isinstance(zones[-1], list):
        zones, trees = zones
        points = {"type": "MultiPoint", "coordinates": trees}
        marks = [{"type": "Feature", "properties": {}, "geometry": points}]
        (folder / "trees.geojson").write_text(
            json.dumps({"type": "FeatureCollection", "features": marks})
        )
        more = (*more, "--obstacle", str(folder / "trees.geojson"))
        more = (*more, "--obstacle-radius-m", "2")
    features = [
        {
            "type": "Feature",
            "properties": {"rate": rate},
            "geometry": {"type": "Polygon", "coordinates": [[*ring, ring[0]]]},
        }
        for rate, ring in zones
    ]
    map_file = folder / "field.geojson"
    map_file.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    plant = folder / "even.toml"
    text = Path("sitl/profiles/wang-2024.toml").read_text()
    for key in ("lag_scatter", "flow_scatter", "gain_spread", "noise"):
        text = "\n".join(
            f"{key} = 0.0" if line.startswith(key) else line for line in text.splitlines()
        )
    plant.write_text(text.replace('"smooth"', '"straight"'))
    config = folder / "config.toml"
    text = EXAMPLE.read_text()
    head, _, tail = text.partition("[prescription]")
    _, _, tail = tail.partition("\n[")
    text = f'{head}[prescription]\nfile = "field.geojson"\nunit = "L/ha"\n\n[{tail}'
    text = "\n".join(line for line in text.splitlines() if not line.startswith("angle_deg"))
    config.write_text(text)
    plan = folder / "field.plan"
    depot = ["--depot", "35.9959,114.5440"]
    execute(
        ["plan", str(map_file), "--prescription", str(map_file), "--config", str(config),
         "--out", str(plan), "--json", *depot, *more]
    )  # fmt: skip
    if lines:
        config.write_text(text.replace("[mission]", '[mission]\nlines = "field.lines.geojson"'))
    return flown_of(folder, plan, folder / "flown")


def flown_of(folder: Path, plan: Path, out: Path) -> Flown:
    """Fly a mission of the field in a folder, and make its report."""
    config, plant, map_file = (folder / f for f in ("config.toml", "even.toml", "field.geojson"))
    lines = "field.lines.geojson" in config.read_text()
    execute(
        ["sitl", "fly", "--config", str(config), "--mission", str(plan), "--plant", str(plant),
         "--out", str(out), "--json"]
    )  # fmt: skip
    truth = Truth.read(out / "truth.npz")
    ground = Field.read(
        map_file, truth.origin_deg, lines_file=folder / "field.lines.geojson" if lines else None
    )
    journal = out / "flight-0001.gpkg"
    report = build_report(journal, ReportOptions(with_figures=False))
    return Flown(
        journal=journal,
        truth=truth,
        field=ground,
        verdict=judge([truth], ground),
        result=json.loads((out / "result.json").read_text())["flights"][0],
        contents=dict(report.contents),
        record=json.loads(report.files["application-generic.json"])["fields"],
        assessed=assess(read_applied(journal)),
    )


def real_outline(name: str) -> tuple[Any, list[tuple[float, float]]]:
    """Return a real outline, moved to the example's place, as a map of one rate, and two trees."""
    path = Path(os.environ["VRSPRAY_SAMPLES"]) / "fields" / f"{name}.geojson"
    shape = shapely.from_geojson(path.read_text())
    whole = max(shapely.get_parts(shapely.get_parts(shape)), key=lambda each: each.area)
    west, south = whole.bounds[:2]
    stretch = math.cos(math.radians(south)) / math.cos(math.radians(35.996))

    def moved(ring: Any) -> list[tuple[float, float]]:
        return [(114.544 + (x - west) * stretch, 35.996 + y - south) for x, y in ring.coords]

    corners = moved(whole.exterior)[:-1]
    inside = moved(whole.representative_point())
    return ((20, corners),), [*inside, corners[len(corners) // 3]]


FLIGHTS: dict[str, tuple[Any, ...]] = {
    "tutorial": (TUTORIAL, True, "--angle-deg", "0"),
    "one of three": (ASKEW, True, "--tank-l", "5"),
    "without lines": (TUTORIAL, False, "--angle-deg", "0"),
}
if "VRSPRAY_SAMPLES" in os.environ:
    FLIGHTS["real outline, trees"] = (real_outline("r_ai4sf"), True)


@pytest.fixture(scope="module", params=FLIGHTS)
def flown(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Flown:
    zones, lines, *more = FLIGHTS[request.param]
    return fly(tmp_path_factory.mktemp("judged"), zones, lines, *more)


def test_ground_is_what_the_truth_says(flown: Flown) -> None:
    said, true = flown.contents["verdict"], flown.verdict
    within = {"abs": AREA * true.field_m2}
    assert said["area_ha"] * 1e4 == pytest.approx(true.treated_m2, **within)
    assert said["doubled_m2"] == pytest.approx(true.twice_m2, **within)
    assert said["untreated_m2"] == pytest.approx(true.bare_m2, **within)
    assert said["missed_m2"] == pytest.approx(true.missed_m2, **within)
    assert said["left_m2"] == pytest.approx(true.bare_m2 - true.missed_m2, **within)
    percent = 100.0 * true.bare_m2 / true.field_m2
    assert said["untreated_percent"] == pytest.approx(percent, abs=1.0)


def test_causes_hold_all_ground_that_is_bare_or_treated_twice(flown: Flown) -> None:
    causes = flown.contents["causes"]
    bare_m2 = flown.verdict.missed_m2 + flown.verdict.twice_m2
    assert causes["off_m2"] >= bare_m2 - AREA * flown.verdict.field_m2
    assert causes["off_m2"] == pytest.approx(sum(causes["area_m2"].values()))


def test_litres_are_what_the_truth_says(flown: Flown) -> None:
    said, true = flown.contents["verdict"], flown.verdict
    for name in ("applied_l", "metered_l", "modelled_l"):
        assert said[name] == pytest.approx(true.applied_l, rel=LITRES), name
    assert flown.result["applied_ml"] == pytest.approx(1e3 * true.applied_l, rel=1e-6)
    assert said["outside_ml"] == pytest.approx(true.outside_ml, abs=0.5)
    assert flown.result["off_target_ml"] == pytest.approx(true.outside_ml, abs=0.5)
    assert said["off_line_ml"] == pytest.approx(true.off_line_ml, abs=1.0)


def test_the_swaths_of_a_journal_alone_say_the_same(flown: Flown, tmp_path: Path) -> None:
    out, true = tmp_path / "swaths.geojson", flown.verdict
    words = ["export", str(flown.journal), "--out", str(out), "--geometry", "swaths", "--json"]
    assert execute(words) == 0
    said = swaths_of(out, flown.truth.origin_deg, flown.field)
    assert said.applied_l == pytest.approx(true.applied_l, rel=LITRES)
    assert said.treated_m2 == pytest.approx(true.treated_m2, abs=AREA * true.field_m2)
    assert said.outside_ml == pytest.approx(true.outside_ml, abs=0.01 * 1e3 * true.applied_l)


def test_fleet_and_flights_print_what_the_truth_says(
    flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    true, fleet = flown.verdict, str(tmp_path / "fleet")

    def said(*words: str) -> dict[str, Any]:
        capsys.readouterr()
        assert execute([*words, "--json"]) == 0
        found: dict[str, Any] = json.loads(capsys.readouterr().out)
        return found

    said("fleet", "add", str(flown.journal), "--into", fleet)
    (row,) = said("fleet", "query", "SELECT * FROM flights", "--fleet", fleet)["rows"]
    within = {"abs": AREA * true.field_m2}
    assert row["area_ha"] * 1e4 == pytest.approx(true.treated_m2, **within)
    assert row["missed_m2"] == pytest.approx(true.missed_m2, **within)
    assert row["doubled_m2"] == pytest.approx(true.twice_m2, **within)
    assert row["untreated_m2"] == pytest.approx(true.bare_m2, **within)
    for name in ("applied_l", "modelled_l"):
        assert row[name] == pytest.approx(true.applied_l, rel=LITRES), name
    assert row["outside_ml"] == pytest.approx(true.outside_ml, abs=0.5)
    (listed,) = said("flights", "list", "--folder", str(flown.journal.parent))["flights"]
    # The running sum of the companion, and no model of lags.
    assert listed["applied_l"] == pytest.approx(true.applied_l, rel=2.0 * LITRES)
    rest = said("flights", "remaining", str(flown.journal), "--out", str(tmp_path / "rest.geojson"))
    assert rest["treated_ha"] * 1e4 == pytest.approx(true.treated_m2, **within)
    assert rest["field_ha"] * 1e4 == pytest.approx(true.field_m2, rel=1e-3)


def test_the_page_in_flight_shows_what_the_truth_says(flown: Flown) -> None:
    flight, true = flown.assessed.flight, flown.verdict
    boom, at_s = flight.setup.boom, ordered_s(flight.changes)
    duty = [0.0] * len(boom.valves)
    way = BoomTrace(valves=tuple((v.right_m, v.forward_m, v.width_m) for v in boom.valves))
    change = 0
    for sample, now_s in enumerate(flight.time_s.tolist()):
        while change < len(at_s) and at_s[change] <= now_s:
            duty[int(flight.changes.valve[change])] = float(flight.changes.duty[change])
            change += 1
        vehicle = {
            "east_m": float(flight.east_m[sample]), "north_m": float(flight.north_m[sample]),
            "heading_deg": float(flight.heading_deg[sample]), "in_air": True,
        }  # fmt: skip
        flow = float(flight.flow_l_min[sample])
        way.take({"now_s": now_s, "flow_l_min": flow, "duty": duty, "vehicle": vehicle})
    assert way.area_ha * 1e4 == pytest.approx(true.treated_m2, abs=AREA * true.field_m2)
    assert way.volume_l == pytest.approx(true.applied_l, rel=2.0 * LITRES)


def test_metered_and_modelled_litres_are_the_same_in_all_files(flown: Flown) -> None:
    said = flown.contents["verdict"]
    facts = Source(flight=flown.assessed.flight, shape="swaths").facts()
    assert facts["volume_l"] == pytest.approx(said["modelled_l"], abs=1e-5)
    assert facts["metered_l"] == pytest.approx(said["metered_l"], abs=1e-5)
    assert flown.record["volume_l"]["value"] == round(said["metered_l"], 3)


def test_no_headline_rests_on_changes_that_were_left_out(flown: Flown) -> None:
    said = flown.contents["verdict"]
    assert said["lag_count"] + sum(said["unjudged"].values()) == said["change_count"]
    if said["worst_m"] is not None and said["unjudged"]:
        part = f"the {said['lag_count']} of {said['change_count']} changes of rate"
        assert part in said["sentence"]


def test_asked_applied_and_area_are_of_the_same_ground(flown: Flown) -> None:
    said, true = flown.contents["verdict"], flown.verdict
    area = {"rel": 2.0 * AREA * true.field_m2 / true.treated_m2}
    assert said["asked_rate_l_ha"] == pytest.approx(true.asked_rate_l_ha, rel=0.01)
    assert said["mean_rate_l_ha"] == pytest.approx(1e4 * true.applied_l / true.treated_m2, **area)
    rates = {rate for _, rate in flown.field.zones}
    assert 0.999 * min(rates) <= said["asked_rate_l_ha"] <= 1.001 * max(rates)
    balance = flown.contents["balance"]
    assert balance["prescribed_l"] == said["prescribed_l"]
    assert flown.record["asked_rate_l_ha"]["value"] == round(said["asked_rate_l_ha"], 2)
    assert flown.record["mean_rate_l_ha"]["value"] == round(said["mean_rate_l_ha"], 2)


def test_applied_is_the_sum_of_all_that_fell_on_a_cell(flown: Flown) -> None:
    cells = flown.assessed.cells
    assert cells is not None
    west_m, south_m = float(cells.corner_east_m[0, 0]), float(cells.corner_north_m[0, 0])
    shape = cells.measured_l_ha.shape
    true = doses_of([flown.truth], flown.field, west_m, south_m, cells.cell_m, shape)
    # Nearly whole cells in the field, where no valve is just opening or closing for half of it.
    whole = (true.ground_m2 > 0.5 * cells.cell_m**2) & np.isfinite(cells.measured_l_ha)
    off = np.abs(cells.measured_l_ha - true.dose_l_ha)[whole] / true.asked_l_ha[whole]
    assert np.median(off) < 0.03
    assert np.percentile(off, 95) < 0.15
    asked = true.asked_l_ha > 0.0
    near = asked & (np.abs(true.dose_l_ha - true.asked_l_ha) <= 0.1 * true.asked_l_ha)
    share = 100.0 * true.ground_m2[near].sum() / true.ground_m2[asked].sum()
    assert flown.contents["verdict"]["within_10_percent"] == pytest.approx(share, abs=4.0)
    assert cells.judged_m2 <= 1.001 * flown.verdict.field_m2


def test_ground_that_two_passes_sprayed_is_shown_with_both(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    flown = fly(tmp_path_factory.mktemp("twice"), TUTORIAL, False, "--angle-deg", "0")
    cells = flown.assessed.cells
    assert cells is not None
    # A strip of half a metre got two doses: in cells of a metre half as much again.
    assert np.nanpercentile(cells.relative_error_percent, 95) > 30.0


@dataclass(frozen=True)
class Job:
    """A field in three sorties: their reports, that of all of them, and what the truth says."""

    journals: list[Path]
    flights: list[Flown]
    verdict: Verdict
    report: Report

    @property
    def within(self) -> dict[str, float]:
        return {"abs": AREA * self.verdict.field_m2}


# The first of a fixture's tests flies up to three sorties.
pytestmark = pytest.mark.timeout(300)


@pytest.fixture(scope="module", autouse=True)
def at_full_priority() -> Iterator[None]:
    """Run commands as on a computer with no flight, and fly no twin of perfect knowledge."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("companion.cli.app.give_way", lambda *_: None)
        patch.setattr("sitl.fly._perfect", lambda *_: None)
        yield


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> Job:
    folder = tmp_path_factory.mktemp("job")
    flights = [fly(folder, ASKEW, True, "--tank-l", "5")]
    flights += [
        flown_of(folder, folder / f"field-{number}.plan", folder / f"flown-{number}")
        for number in range(2, 1 + len(list(folder.glob("field*.plan"))))
    ]
    assert len(flights) > 2
    journals = sorted(folder.glob("flown*/flight-0001.gpkg"))
    return Job(
        journals=journals,
        flights=flights,
        verdict=judge([each.truth for each in flights], flights[0].field),
        # In any order.
        report=build_job(journals[::-1], ReportOptions(with_figures=False)),
    )


def test_simulated_sorties_have_the_id_of_their_plan(job: Job) -> None:
    (found,) = {sortie_of(path).job for path in job.journals}
    assert found


def test_the_ground_of_a_job_is_what_the_truth_says(job: Job) -> None:
    said, true = job.report.contents["verdict"], job.verdict
    assert said["area_ha"] * 1e4 == pytest.approx(true.treated_m2, **job.within)
    assert said["doubled_m2"] == pytest.approx(true.twice_m2, **job.within)
    assert said["untreated_m2"] == pytest.approx(true.bare_m2, **job.within)
    assert said["missed_m2"] == pytest.approx(true.missed_m2, **job.within)
    # Where two sorties' bands meet, ground is counted by both: their sums say too much.
    overlap_m2 = sum(1e4 * each.contents["verdict"]["area_ha"] for each in job.flights)
    assert overlap_m2 - true.treated_m2 > 0.01 * true.field_m2
    # One map has one rate: what is missing of it is the litres that are left.
    assert said["untreated_l"] == pytest.approx(20.0 * said["untreated_m2"] / 1e4, rel=1e-3)


def test_the_litres_of_a_job_are_what_the_truth_says(job: Job) -> None:
    said, true = job.report.contents["verdict"], job.verdict
    for name in ("applied_l", "metered_l", "modelled_l"):
        assert said[name] == pytest.approx(true.applied_l, rel=LITRES), name
    assert said["prescribed_l"] == pytest.approx(true.asked_l, rel=LITRES)
    assert said["outside_ml"] == pytest.approx(true.outside_ml, abs=0.5)
    rows = job.report.contents["sorties"]
    for row, flight in zip(rows, job.flights, strict=True):
        assert row["applied_l"] == pytest.approx(flight.verdict.applied_l, rel=LITRES)
        assert row["spraying_from"] < row["spraying_until"]
    # All are called flight-0001.gpkg.
    assert len({row["journal"] for row in rows}) == len(rows)


def test_the_record_of_a_job_has_its_ground_and_litres_once_and_each_sortie(job: Job) -> None:
    record = json.loads(job.report.files["application-generic.json"])
    true, fields = job.verdict, record["fields"]
    assert fields["volume_l"]["value"] == pytest.approx(true.applied_l, rel=LITRES)
    assert 1e4 * fields["treated_area_ha"]["value"] == pytest.approx(true.treated_m2, **job.within)
    area = shapely.from_geojson(json.dumps(record["treated_area"]))
    origin_deg = job.flights[0].truth.origin_deg
    area = shapely.transform(area, lambda xy: to_local(xy, origin_deg))
    assert area.area == pytest.approx(true.treated_m2, **job.within)
    assert area.symmetric_difference(true.treated).area < 2 * AREA * true.field_m2
    assert [each["sortie"] for each in record["sorties"]] == [1, 2, 3]
    assert sum(each["applied_l"] for each in record["sorties"]) == pytest.approx(
        fields["volume_l"]["value"], abs=1e-3
    )


def test_the_doses_of_a_job_are_sums_over_its_sorties(job: Job) -> None:
    cells = together([each.assessed for each in job.flights], treated(job)).cells
    assert cells is not None
    west_m, south_m = float(cells.corner_east_m[0, 0]), float(cells.corner_north_m[0, 0])
    shape = cells.measured_l_ha.shape
    truths = [each.truth for each in job.flights]
    true = doses_of(truths, job.flights[0].field, west_m, south_m, cells.cell_m, shape)
    whole = (true.ground_m2 > 0.5 * cells.cell_m**2) & np.isfinite(cells.measured_l_ha)
    off = np.abs(cells.measured_l_ha - true.dose_l_ha)[whole] / true.asked_l_ha[whole]
    assert np.median(off) < 0.03
    assert np.percentile(off, 95) < 0.15


def treated(job: Job) -> Treated:
    return treated_of(*(each.assessed.flight for each in job.flights))


def test_a_fleet_counts_the_ground_of_a_job_once(
    job: Job, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said, true, summed = job.report.contents["verdict"], job.verdict, []
    first, *others = job.journals
    for number, order in enumerate(([job.journals], [[one] for one in others] + [[first]])):
        fleet = str(tmp_path / f"fleet-{number}")
        for paths in order:
            execute(["fleet", "add", *map(str, paths), "--into", fleet])
        capsys.readouterr()
        out = str(tmp_path / f"report-{number}")
        execute(["fleet", "report", "--fleet", fleet, "--out", out, "--json"])
        (section,) = json.loads(capsys.readouterr().out)["sections"]
        summed.append(section["totals"])
    assert summed[0] == summed[1]
    found = summed[0]
    assert found["flights"] == len(job.journals)
    assert found["area_ha"] * 1e4 == pytest.approx(true.treated_m2, **job.within)
    assert found["doubled_m2"] == pytest.approx(true.twice_m2, **job.within)
    assert found["missed_m2"] == pytest.approx(true.missed_m2, **job.within)
    assert found["applied_l"] == pytest.approx(true.applied_l, rel=LITRES)
    # As the report of the job has them.
    near = {"abs": 0.001 * true.field_m2}
    assert found["area_ha"] * 1e4 == pytest.approx(said["area_ha"] * 1e4, **near)
    for name in ("missed_m2", "doubled_m2"):
        assert found[name] == pytest.approx(said[name], **near), name
    assert found["rate_l_ha"] == pytest.approx(said["mean_rate_l_ha"], rel=1e-3)


async def test_the_page_shows_a_job_and_its_figures_of_ground(job: Job, tmp_path: Path) -> None:
    names = [f"flight-000{number}.gpkg" for number in (1, 2, 3)]
    for path, name in zip(job.journals, names, strict=True):
        shutil.copyfile(path, tmp_path / name)
    host = {
        "folder": str(tmp_path / "state"), "config": [], "upload_link": "",
        "journals": str(tmp_path),
    }  # fmt: skip
    true = job.verdict
    async with served(host=host) as site:
        site.show(armed=False, in_air=False)
        await until(lambda: site.ask("GET", "/api/v1/flights").json["not_now"] is None)
        listed = (await site.asked("POST", "/api/v1/flights/look", {})).json["flights"]
        said = sum(each["applied_l"] for each in listed)
        assert said == pytest.approx(true.applied_l, rel=2.0 * LITRES)
        body: dict[str, Any] = {"file": names[1]}
        for flights in (job.flights[1:2], job.flights):
            its = judge([each.truth for each in flights], job.flights[0].field)
            told = (await site.asked("POST", "/api/v1/flights/report", body)).json["report"]
            assert told["job"] == {"sorties": names, "perhaps": []}
            said, left = told["verdict"], told["left"]
            assert said["area_ha"] * 1e4 == pytest.approx(its.treated_m2, **job.within)
            assert said["missed_m2"] == pytest.approx(its.missed_m2, **job.within)
            assert said["doubled_m2"] == pytest.approx(its.twice_m2, **job.within)
            assert said["untreated_m2"] == pytest.approx(its.bare_m2, **job.within)
            assert said["applied_l"] == pytest.approx(its.applied_l, rel=LITRES)
            assert left["field_ha"] * 1e4 == pytest.approx(true.field_m2, rel=1e-3)
            assert left["treated_ha"] * 1e4 == pytest.approx(its.treated_m2, **job.within)
            # No valve is for slivers.
            half_m = 0.5 * left["narrowest_m"]
            bare = job.flights[0].field.rated.difference(its.treated)
            wide = bare.buffer(-half_m, join_style="mitre").buffer(half_m, join_style="mitre")
            assert left["remaining_ha"] * 1e4 == pytest.approx(wide.area, **job.within)
            assert left["remaining_l"] == pytest.approx(20.0 * left["remaining_ha"], rel=1e-6)
            # Joined by who asks for it, in one report.
            body = {"file": names[0], "also": names[1:]}


def test_a_ferry_along_a_line_of_another_sortie_is_no_flight_of_it(
    job: Job, tmp_path: Path
) -> None:
    folder = tmp_path / "ferry"
    shutil.copytree(job.journals[0].parents[1], folder)
    plan = json.loads((folder / "field.plan").read_text())
    lines = json.loads((folder / "field.lines.geojson").read_text())["features"]
    of_third = [
        np.array(each["geometry"]["coordinates"])
        for each in lines
        if (each["properties"].get("kind"), each["properties"].get("sortie")) == ("spray", 3)
    ]
    longest = max(of_third, key=lambda places: float(np.hypot(*(places[-1] - places[0]))))
    begin, end = longest[0], longest[-1]
    items = plan["mission"]["items"]
    before = max(number for number, item in enumerate(items) if item["command"] == 16)
    # From far before the line to far behind it: its own flight ends at the border.
    for place in (end + 0.6 * (end - begin), begin - 0.6 * (end - begin)):
        item = json.loads(json.dumps(items[before]))
        item["params"][4:6] = [float(place[1]), float(place[0])]
        items.insert(before + 1, item)
    (folder / "ferry.plan").write_text(json.dumps(plan))
    ferried, first = flown_of(folder, folder / "ferry.plan", folder / "ferried"), job.flights[0]
    said, within = ferried.contents["verdict"], job.within
    assert ferried.contents["flight"]["duration_s"] > first.contents["flight"]["duration_s"] + 30.0
    assert ferried.verdict.missed_m2 == pytest.approx(first.verdict.missed_m2, **within)
    assert said["missed_m2"] == pytest.approx(ferried.verdict.missed_m2, **within)
    assert said["left_m2"] == pytest.approx(
        ferried.verdict.bare_m2 - ferried.verdict.missed_m2, **within
    )
    # Nothing was asked there.
    assert ferried.contents["misapplied_percent"] == pytest.approx(
        first.contents["misapplied_percent"], abs=0.5
    )


@pytest.mark.parametrize("name", ["job.geojson", "job.shp", "job.kml", "job.parquet"])
def test_one_file_has_the_ground_and_litres_of_all_sorties(
    job: Job, name: str, tmp_path: Path
) -> None:
    out = tmp_path / name
    shape = [] if name in ("job.kml", "job.parquet") else ["--geometry", "swaths"]
    # In any order.
    execute(["export", *map(str, job.journals[::-1]), "--out", str(out), *shape])
    layer = "applied" if out.suffix == ".kml" else None
    if out.suffix == ".parquet":
        table = pq.read_table(out)
        rows = {each: np.array(table[each].to_pylist()) for each in table.column_names}
        volume_ml, sortie = 1e3 * rows["AppliedTotalVolume"], rows["sortie"]
        ground, times = rows["geometry"], rows["timestamp"]
    else:
        meta, _, ground, values = pyogrio.raw.read(out, layer=layer)
        rows = dict(zip(map(str.lower, meta["fields"]), values, strict=True))
        volume_ml = rows["volume_ml"] if "volume_ml" in rows else rows["volume"]
        sortie, times = rows["sortie"], rows.get("time_utc", rows.get("isotime"))
    assert volume_ml.sum() / 1e3 == pytest.approx(job.verdict.applied_l, rel=LITRES)
    for number, flight in enumerate(job.flights, start=1):
        its = sortie.astype(str) == str(number)
        assert volume_ml[its].sum() / 1e3 == pytest.approx(flight.verdict.applied_l, rel=LITRES)
        assert str(min(times[its]))[:16] <= flight.contents["flight"]["spraying_from"][:16]
    origin_deg = job.flights[0].truth.origin_deg
    shapes = [
        shapely.transform(each, lambda xy: to_local(xy, origin_deg))
        for each in shapely.from_wkb(ground)
    ]
    area = shapely.union_all(shapely.make_valid(shapes)).area
    # Swaths reach as far as anything came out.
    assert area == pytest.approx(job.verdict.treated_m2, abs=2 * AREA * job.verdict.field_m2)


def test_a_terminal_finds_each_sortie_of_a_job_as_a_task(job: Job, tmp_path: Path) -> None:
    out = tmp_path / "TASKDATA"
    assert execute(["export", *map(str, job.journals[::-1]), "--out", str(out)]) == 0
    data, logs = isoxml_from_path(out)
    assert len(data.partfields) == len(data.products) == len(data.devices) == 1
    assert len(data.tasks) == len(logs) == len(job.flights)
    for task, flight in zip(data.tasks, job.flights, strict=True):
        assert task.partfield_id_ref == data.partfields[0].id
        assert task.device_allocations[0].client_name_value == data.devices[0].client_name
        assert (
            task.times[0].start.to_datetime().isoformat()[:16]
            <= (flight.contents["flight"]["spraying_from"][:16])
        )
        totals = {
            int.from_bytes(each.process_data_ddi): each.process_data_value
            for each in task.times[0].data_log_values
        }
        assert totals[351] / 1e3 == pytest.approx(flight.verdict.applied_l, rel=LITRES)
        (log,) = task.time_logs
        assert log.filelength == (out / f"{log.filename}.bin").stat().st_size


def test_messages_of_a_job_have_topics_by_sortie(job: Job, tmp_path: Path) -> None:
    out = tmp_path / "job.mcap"
    assert execute(["export", *map(str, job.journals[::-1]), "--out", str(out)]) == 0
    reader = mcap.reader.make_reader(io.BytesIO(out.read_bytes()))
    found: dict[str, list[tuple[int, float]]] = {}
    for _, channel, message in reader.iter_messages(log_time_order=False):
        volume_ml = json.loads(message.data).get("volume_ml") or 0.0
        found.setdefault(channel.topic, []).append((message.log_time, volume_ml))
    for number, flight in enumerate(job.flights, start=1):
        rows = found[f"/sortie_{number}/spray"]
        assert rows == sorted(rows, key=lambda row: row[0])
        litres = sum(volume_ml for _, volume_ml in rows) / 1e3
        assert litres == pytest.approx(flight.verdict.applied_l, rel=LITRES)
        assert {f"/sortie_{number}/position", f"/sortie_{number}/events"} & {*found}


def test_what_holds_one_flight_refuses_a_job(job: Job, tmp_path: Path) -> None:
    out = str(tmp_path / "a.csv")
    words = [*map(str, job.journals), "--out", out, "--format", "csv-samples"]
    with pytest.raises(ExportError, match="holds one flight; export each sortie by itself"):
        export.main(words, standalone_mode=False)
