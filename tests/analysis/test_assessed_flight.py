"""A twin's flight judged from its journal: near its truth, and as an independent script has it."""

from __future__ import annotations

import json
import sqlite3
import zlib
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from analysis.assess.assessment import Assessment, assess
from analysis.evaluation import Evaluation, evaluate
from analysis.exports import csv_tables
from analysis.exports.source import Source
from analysis.flown.applied_flight import AppliedFlight
from analysis.flown.modelled_flow import ordered_s
from analysis.flown.read_applied import read_applied
from analysis.flown.sensor_series import sensors_of
from analysis.journals.content import read_journal
from analysis.replay import replay
from analysis.report import contents
from companion.cli.app import execute
from companion.errors import JournalError
from companion.journal.codec import field_names_of
from companion.journal.journal import Journal
from companion.journal.reader import opened
from sitl.flight import FlightOptions
from sitl.flight import fly as simulate
from sitl.fly import FlyOptions, prepare
from sitl.vehicle import Vehicle
from tests.analysis.test_replay import fly
from tests.companion.test_receiver import to_and_fro, watched
from tests.independent_figures import figures

ANYANG = Path(__file__).parents[2] / "examples" / "anyang"


@dataclass(frozen=True)
class Flown:
    journal: Path
    flight: AppliedFlight
    found: Assessment
    truth: Evaluation


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    folder = tmp_path_factory.mktemp("assessed")
    task = prepare(FlyOptions(config=ANYANG / "config.toml", mission=ANYANG / "mission.waypoints"))
    trajectory = Vehicle(task.route, start_s=0.0, seed=1, acceleration_m_s2=2.5).fly_to_end()
    # A sprayer whose law the configuration's curve has: what else is between journal and truth.
    options = FlightOptions(
        fidelity="averaged", output="servo", seed=1, meter_rate_hz=10.0, flow_law="straight"
    )
    with Journal.create(folder, setup=task.setup, started_s=0.0, waits=True) as journal:
        result = simulate(
            task.setup,
            trajectory,
            task.profile,
            options,
            speed_m_s=task.speed_m_s,
            observer=journal.record_decision,
            on_input=journal.record_input,
        )
    flight = read_applied(journal.path)
    return Flown(journal.path, flight, assess(flight), evaluate(result.record))


def test_figures_agree_with_those_of_an_independent_script(flown: Flown, tmp_path: Path) -> None:
    samples = tmp_path / "samples.csv"
    for name, chunks in csv_tables.make_samples(
        Source(flight=flown.flight, shape="points"), samples
    ).items():
        (tmp_path / name).write_bytes(b"".join(chunks))
    theirs, ours = figures(samples, flown.journal), flown.found.evaluation
    assert theirs["changes"] == ours.lag_distance_m.count == 216
    assert theirs["missed"] == ours.missed == 0
    assert theirs["volume_l"] == pytest.approx(ours.applied_ml / 1000.0, rel=1e-4)
    for name, value in (
        ("spraying_accuracy_percent", ours.spraying_accuracy_percent),
        ("misapplied_percent", ours.misapplied_percent),
        ("lag_distance_mean_abs_m", ours.lag_distance_m.mean_abs),
    ):
        assert theirs[name] == pytest.approx(value, rel=0.01)


def test_a_journal_comes_near_the_truth_that_it_does_not_know(flown: Flown) -> None:
    ours, truth = flown.found.evaluation, flown.truth
    assert ours.applied_ml == pytest.approx(truth.applied_ml, rel=1e-3)
    assert ours.lag_distance_m.count == truth.lag_distance_m.count
    assert ours.lag_distance_m.mean == pytest.approx(truth.lag_distance_m.mean, abs=0.03)
    assert ours.lag_distance_m.mean_abs == pytest.approx(truth.lag_distance_m.mean_abs, abs=0.02)
    assert ours.spraying_accuracy_percent == pytest.approx(truth.spraying_accuracy_percent, abs=0.5)
    assert ours.misapplied_percent == pytest.approx(truth.misapplied_percent, abs=0.6)


def test_the_meter_is_in_the_balance(flown: Flown) -> None:
    balance = flown.found.balance
    assert balance.meter_l is not None
    assert balance.meter_to_model_percent is not None
    assert balance.meter_l == pytest.approx(balance.model_l, rel=0.05)


# -------------------------------------------------------------------------------------- reading


def test_the_reader_finds_what_the_decisions_say(flown: Flown) -> None:
    content = read_journal(flown.journal)
    flight = flown.flight
    assert flight.is_closed
    assert flight.lost == content.lost == 0
    counts = [entry for entry in content.entries if entry.kind == "FlowReport"]
    assert flight.meter_ml is not None
    assert len(flight.meter_ml.time_s) == len(counts)
    assert (np.diff(flight.time_s) > 0.0).all()
    assert (np.diff(ordered_s(flight.changes)) >= 0.0).all()
    east_m, north_m = flight.setup.frame.to_local(
        float(flight.latitude_deg[100]), float(flight.longitude_deg[100])
    )
    assert (flight.east_m[100], flight.north_m[100]) == pytest.approx((east_m, north_m), abs=1e-6)


def test_a_damaged_journal_is_read_as_far_as_it_goes(flown: Flown, tmp_path: Path) -> None:
    path = tmp_path / "flight-0001.gpkg"
    path.write_bytes(flown.journal.read_bytes())
    with closing(sqlite3.connect(path)) as connection, connection:
        ((first,),) = connection.execute("SELECT max(first_sequence) FROM blocks").fetchall()
        connection.execute("UPDATE blocks SET crc32 = 1 WHERE first_sequence = ?", (first,))
    with pytest.raises(JournalError, match="is damaged"):
        read_applied(path)
    unread: list[str] = []
    flight = read_applied(path, unread=unread)
    assert len(unread) == 1
    assert f"rows from {first}" in unread[0]
    assert len(flight.time_s) == len(flown.flight.time_s)


@pytest.mark.parametrize(("off_m", "severity"), [(0.2, "note"), (0.6, "warning")])
def test_a_receiver_beside_the_estimator_is_in_the_report(
    off_m: float, severity: str, tmp_path: Path
) -> None:
    """From the journal alone; one of before the receiver's place was kept says nothing of it."""
    task = prepare(FlyOptions(config=ANYANG / "config.toml", mission=ANYANG / "mission.waypoints"))
    with Journal.create(tmp_path, setup=task.setup, started_s=0.0, waits=True) as journal:
        for item in to_and_fro(0.09, off_m):
            journal.record_input(item)
    flight = read_applied(journal.path)
    assert flight.receiver == watched(*to_and_fro(0.09, off_m))
    (said,) = contents._receiver(flight)
    assert said.severity == severity
    assert f"90 ms, {off_m:.2f} m beside it" in said.text
    with opened(journal.path) as kept:
        names = dict(field_names_of(kept.meta["setup"]))
        names["GnssReport"] = names["GnssReport"][:4]
        assert sensors_of(kept, names, None)[1] is None


def test_a_journal_of_version_1_is_read_from_its_decisions(tmp_path: Path) -> None:
    path = tmp_path / "flight-0001.gpkg"
    packed = Path(__file__).parents[1] / "data" / "journal" / "flight-v1.gpkg.zlib"
    path.write_bytes(zlib.decompress(packed.read_bytes()))
    flight = read_applied(path)
    assert 100 < len(flight.time_s) <= 120
    assert np.isnan(flight.changes.actual_s).all()
    assert {0.0} < set(flight.changes.duty.tolist())
    found = assess(flight)
    assert found.flight.training == "water"
    assert found.evaluation.applied_ml > 0.0


# -------------------------------------------------------------------------------------- what-if


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fly(tmp_path_factory.mktemp("short"), steps=260)[0]


def test_a_what_if_moves_the_changes_by_the_way_flown_in_that_time(short: Path) -> None:
    found = replay(short, overrides=["lag.output_s=0.03"])
    assert found.recorded is not None
    assert found.what_if is not None
    assert found.moved_m is not None
    assert found.differences > 20
    # Ordered 20 ms sooner: 0.1 m of flight. The border's first change comes before the record.
    assert found.moved_m.mean == pytest.approx(-0.02 * 5.0, abs=0.02)
    assert found.moved_m.count >= 18
    was, now = found.recorded.lag_distance_m.mean, found.what_if.lag_distance_m.mean
    assert was is not None
    assert now is not None
    assert now - was == pytest.approx(-0.1, abs=0.02)


def test_what_was_recorded_is_what_the_journal_says_was_sprayed(short: Path) -> None:
    found = replay(short, overrides=["lag.output_s=0.03"]).recorded
    ours = assess(read_applied(short)).evaluation
    assert found is not None
    assert found.volume_l == pytest.approx(ours.applied_ml / 1000.0, rel=1e-6)
    assert sum(found.zones.values()) == pytest.approx(found.volume_l, rel=1e-3)


def test_a_change_that_changes_nothing_moves_nothing(short: Path) -> None:
    recorded = read_journal(short).setup.lag.output_s
    found = replay(short, overrides=[f"lag.output_s={recorded!r}"])
    assert found.differences == 0
    assert found.recorded == found.what_if
    assert found.moved_m is not None
    assert found.moved_m.max_abs == 0.0


def test_replay_as_json_has_both_ways(short: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code = execute(["replay", str(short), "--set", "method=none", "--json"])
    assert code == 1
    found = json.loads(capsys.readouterr().out)
    assert found["recorded"]["volume_l"] > 0.0
    assert found["what_if"]["lag_distance_m"]["mean"] > 0.4
    assert found["moved_m"]["mean"] > 0.4
    assert set(found["recorded"]["zones"]) == set(found["what_if"]["zones"])


def test_replay_for_a_person_has_both_ways_in_a_table(
    short: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    execute(["replay", str(short), "--set", "method=none"])
    lines = capsys.readouterr().out.splitlines()
    assert any(line.split() == ["recorded", "what-if"] for line in lines)
    assert any(line.startswith("sprayed, L") for line in lines)
    assert any("changes moved by +" in line for line in lines)


def test_a_replay_without_changes_compares_nothing_else(short: Path) -> None:
    found = replay(short)
    assert found.differences == 0
    assert found.recorded is None
    assert found.what_if is None
