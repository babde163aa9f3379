"""Campaigns: one flight as a function, who may die, the dataset to the byte, what is shown."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from scipy.stats import t
from typer.testing import CliRunner

from analysis.evaluation import evaluate
from companion.cli.app import execute
from companion.errors import ConfigError
from sitl.anyang import demo_lags, demo_setup, demo_trajectory
from sitl.campaign import cli, pictures, running
from sitl.campaign.bundle import program_files
from sitl.campaign.dataset import part_size
from sitl.campaign.design import read_campaign
from sitl.campaign.flying import fly_flight
from sitl.campaign.running import LOST, Tally, fly_missing, pool_of
from sitl.campaign.show import groups_of, notes_of, read_rows, sensitivity_lines, sensitivity_of
from sitl.flight import FlightOptions, fly
from sitl.profile import load_profile
from tests.sitl.campaign_files import VARIED, designed, files_of, fly_here, opened, write_campaign


@pytest.fixture
def here(tmp_path: Path) -> Path:
    return write_campaign(tmp_path, VARIED)


def rows_of(out: Path) -> list[dict[str, Any]]:
    paths = sorted((out / "flights").glob("part=*/flights.parquet"))
    return [row for path in paths for row in pq.ParquetFile(path).read().to_pylist()]


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The dataset as this process alone makes it."""
    folder = tmp_path_factory.mktemp("reference")
    fly_here(write_campaign(folder, VARIED), folder / "out")
    return folder / "out"


# --------------------------------------------------------------------------------------- one flight


def test_a_flight_of_the_published_field_is_that_of_the_demo_to_the_bit(tmp_path: Path) -> None:
    setup = replace(demo_setup(6.0), lag=demo_lags("gpio"))
    flown = fly(
        setup,
        demo_trajectory(6.0, 3),
        load_profile("wang-2024"),
        FlightOptions(fidelity="averaged", seed=3),
        speed_m_s=6.0,
    )
    found = evaluate(flown.record)
    row = fly_flight((("vehicle.speed_m_s", 6.0),), 3, tmp_path).figures
    assert row["lag_distance_mean_m"] == found.lag_distance_m.mean
    assert row["misapplied_percent"] == found.misapplied_percent
    assert row["border_margin_min_m"] == found.border_margin_m.min
    assert (row["applied_ml"], row["missed"]) == (found.applied_ml, found.missed)


def test_rows_have_settings_figures_and_the_reason_where_there_are_none(reference: Path) -> None:
    rows = rows_of(reference)
    assert [row["flight"] for row in rows] == list(range(24))
    assert [row["seed"] for row in rows] == [1, 2, 3, 4] * 6
    good = [row for row in rows if row["error"] is None]
    assert {row["config.lag.up_s"] for row in good} == {0.10} and len(good) == 12
    assert all(row["lag_distance_count"] > 0 and row["applied_ml"] > 0.0 for row in good)
    assert len({row["misapplied_percent"] for row in good}) == 12  # each flight is its own
    assert all(sum(row["rate_samples"]) > 0 for row in good)
    bad = [row for row in rows if row["error"] is not None]
    assert {row["error"].partition("; ")[0] for row in bad} == {
        "field/config.toml: lag.up_s = -1.0: out of range"
    }
    assert all(row["misapplied_percent"] is None for row in bad)


# ------------------------------------------------------------------------------------------- dying


def test_a_worker_that_is_killed_costs_no_row(here: Path, reference: Path, tmp_path: Path) -> None:
    dataset, bundle = opened(here, tmp_path / "out")
    tally, killed = Tally(), []

    def kill_one(flights: int) -> None:
        if flights == 3:
            victim = multiprocessing.active_children()[0]
            assert victim.pid is not None
            os.kill(victim.pid, signal.SIGKILL)
            killed.append(victim.pid)

    with pool_of(2, bundle) as pool:
        fly_missing(dataset, bundle, pool, tally, tell=kill_one)
    assert killed and tally.lost_workers > 0
    assert files_of(tmp_path / "out") == files_of(reference)


DIES = """
import os, signal, sys
from pathlib import Path
from sitl.campaign.running import pool_of
from sitl.campaign.running import Tally, fly_missing
from tests.sitl.campaign_files import opened

if __name__ == "__main__":
    dataset, bundle = opened(Path(sys.argv[1]), Path(sys.argv[2]))

    def die(flights):
        if flights == 13:
            os.kill(os.getpid(), signal.SIGKILL)

    with pool_of(2, bundle) as pool:
        fly_missing(dataset, bundle, pool, Tally(), tell=die)
"""


def test_a_campaign_whose_scheduler_is_killed_goes_on_to_the_same_bytes(
    here: Path, reference: Path, tmp_path: Path
) -> None:
    script, out = tmp_path / "dies.py", tmp_path / "out"
    script.write_text(DIES)
    given = [sys.executable, str(script), str(here), str(out)]
    # What is killed leaves its temporary files: here.
    own = {"PYTHONPATH": str(Path(__file__).parents[2]), "TMPDIR": str(tmp_path)}
    # Its workers hold its output open: that it ends says that they have ended.
    ended = subprocess.run(given, env=os.environ | own, capture_output=True)
    assert ended.returncode == -signal.SIGKILL, ended.stderr.decode()
    parts = len(rows_of(out)) // part_size(24)
    assert 0 < parts < 3
    tally = fly_here(here, out)
    assert tally.flights == 24 - 10 * parts
    assert files_of(out) == files_of(reference)


def test_seeds_that_are_added_are_flown_and_nothing_else_is(
    here: Path, reference: Path, tmp_path: Path
) -> None:
    text = here.read_text()
    here.write_text(text.replace("seeds = 4", "seeds = 3"))
    fly_here(here, tmp_path / "out")
    before = files_of(tmp_path / "out" / "flights")
    here.write_text(text)
    assert fly_here(here, tmp_path / "out").flights == 6
    assert before.items() < files_of(tmp_path / "out" / "flights").items()
    key = ["case", "seed", "vehicle.gust_m_s", "config.lag.up_s"]
    found, wanted = (
        sorted(
            ({**row, "flight": None} for row in rows_of(out)),
            key=lambda row: [row[name] for name in key],
        )
        for out in (tmp_path / "out", reference)
    )
    assert found == wanted
    assert [row["flight"] for row in rows_of(tmp_path / "out")] == list(range(24))


KILLER = """
import os, signal


class Killer:
    def __init__(self, sprayer):
        pass

    def order(self, seen):
        os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_flight_that_kills_its_worker_is_a_row_and_the_others_are_flown(tmp_path: Path) -> None:
    file = write_campaign(
        tmp_path,
        '[[case]]\nname = "kills"\nmethod.controller = "killer.py:Killer"\n'
        '[[case]]\nname = "ours"\n[[case]]\nname = "gust"\nvehicle.gust_m_s = 2.0\n',
    )
    (tmp_path / "killer.py").write_text(KILLER)
    dataset, bundle = opened(file, tmp_path / "out")
    with pool_of(1, bundle) as pool:
        fly_missing(dataset, bundle, pool, Tally(), tell=lambda _: None)
    rows = rows_of(tmp_path / "out")
    assert [(row["case"], row["error"]) for row in rows] == [
        ("kills", LOST),
        ("ours", None),
        ("gust", None),
    ]


LOOPS = """
class Loops:
    def __init__(self, sprayer):
        pass

    def order(self, seen):
        while True:
            try:
                len("round and round")
            except Exception:
                pass
"""
LOOPING = (
    '[[case]]\nname = "loops"\nmethod.controller = "loops.py:Loops"\nflight.cpu_max_s = 1\n'
    '[[case]]\nname = "ours"\n'
)
GIVEN_UP = "did not end within 1 s of processor time (flight.cpu_max_s)"


@pytest.mark.parametrize("is_main", [True, False])
def test_a_flight_without_an_end_is_a_row_in_whatever_thread_it_is(
    tmp_path: Path, is_main: bool
) -> None:
    """A pool flies in the main thread of its processes, Dask in another one."""
    file = write_campaign(tmp_path, LOOPING)
    (tmp_path / "loops.py").write_text(LOOPS)
    if is_main:
        fly_here(file, tmp_path / "out")
    else:
        with ThreadPoolExecutor(1) as thread:
            thread.submit(fly_here, file, tmp_path / "out").result()
    rows = rows_of(tmp_path / "out")
    assert [(row["case"], row["error"]) for row in rows] == [("loops", GIVEN_UP), ("ours", None)]


def test_the_bound_of_a_flight_ends_with_it() -> None:
    with running._bounded(0.2):
        pass
    until_s = process_time() + 0.5
    while process_time() < until_s:  # nothing is raised here any more
        pass
    assert not [each for each in threading.enumerate() if each.name == running.WATCH]


ENDLESS = """
import threading
from sitl.campaign import running

running.WALL_TIMES, running.GRACE_S = 1.0, 0.1
with running._bounded(1.0):
    threading.Event().wait()
"""


def test_a_flight_that_waits_without_an_end_ends_its_worker() -> None:
    """It takes no processor time, and nothing can be raised in it while it waits."""
    root = str(Path(__file__).parents[2])
    given = [sys.executable, "-c", ENDLESS]
    ended = subprocess.run(given, env=os.environ | {"PYTHONPATH": root}, capture_output=True)
    assert (ended.returncode, ended.stderr) == (1, b"")


# -------------------------------------------------------------------------------------- the cluster


@pytest.mark.timeout(300)
def test_a_real_dask_cluster_gives_the_same_rows_though_a_worker_is_killed(
    here: Path, reference: Path, tmp_path: Path
) -> None:
    """A scheduler and two workers as processes, none of which has the campaign's files."""
    dask, told = [sys.executable, "-m", "dask"], tmp_path / "scheduler.json"
    (left := tmp_path / "left").mkdir()
    own = os.environ | {"TMPDIR": str(left), "DASK_TEMPORARY_DIRECTORY": str(tmp_path)}
    common: dict[str, Any] = {
        "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "env": own,
    }  # fmt: skip
    worker = [*dask, "worker", "--scheduler-file", str(told), "--nthreads", "1", "--no-nanny",
              "--dashboard-address", "127.0.0.1:0", "--host", "127.0.0.1",
              "--local-directory"]  # fmt: skip
    started = [
        subprocess.Popen(
            [*dask, "scheduler", "--host", "127.0.0.1", "--port", "0",
             "--dashboard-address", "127.0.0.1:0", "--scheduler-file", str(told)], **common,
        ),
        *(subprocess.Popen([*worker, str(tmp_path / name)], **common) for name in "ab"),
    ]  # fmt: skip
    try:
        flown = subprocess.run(
            [
                sys.executable,
                "-c",
                THROUGH_DASK,
                str(told),
                str(here),
                str(tmp_path / "out"),
                str(started[-1].pid),
            ],
            capture_output=True,
            text=True,
        )
    finally:
        for process in started:
            process.kill()
            process.wait()
    assert flown.returncode == 0, flown.stderr
    found = json.loads(flown.stdout)
    assert (found["workers"], found["lost_workers"]) == (2, 1)
    # A worker that is killed clears nothing itself: its files lie where its cluster does.
    assert not list(left.glob("vrspray-*"))
    assert files_of(tmp_path / "out") == files_of(reference)


# The scheduler's file tells its address; the client of it waits for the workers.
THROUGH_DASK = """
import json, os, signal, sys, time
from pathlib import Path
from companion.cli.app import execute
from distributed import Client
from sitl.campaign import running

told, file, out, victim = sys.argv[1:]
fly_missing = running.fly_missing


def fly(*given, tell):
    def kill(flights):
        if flights == 7:
            os.kill(int(victim), signal.SIGKILL)
        tell(flights)

    fly_missing(*given, tell=kill)


running.fly_missing = fly
for _ in range(600):
    if Path(told).exists() and Path(told).read_text().endswith("}"):
        break
    time.sleep(0.1)
address = json.loads(Path(told).read_text())["address"]
with Client(address) as client:
    client.wait_for_workers(2, timeout=60)
sys.exit(execute(["campaign", file, "--out", out, "--cluster", address, "--json"]))
"""


def test_an_address_where_nobody_is_is_refused_in_one_line(
    here: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert execute(["campaign", str(here), "--cluster", "tcp://127.0.0.1:1"]) == 2
    line = capsys.readouterr().err.strip()
    assert "no Dask scheduler answers" in line and "\n" not in line


# ------------------------------------------------------------------------------------- the dataset


def test_another_campaign_does_not_go_on_in_a_dataset(here: Path, tmp_path: Path) -> None:
    opened(here, tmp_path / "out")
    opened(here, tmp_path / "out")
    here.write_text(here.read_text() + "# changed\n")
    with pytest.raises(ConfigError, match="another campaign_sha256"):
        opened(here, tmp_path / "out")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("dear")
    with pytest.raises(ConfigError, match="holds other files"):
        opened(here, tmp_path / "mine")


def test_the_manifest_names_every_file_and_what_flew(reference: Path) -> None:
    manifest = json.loads((reference / "manifest.json").read_text())
    assert {"field/config.toml", "field/short.waypoints", "field/prescription.dbf"} <= set(
        manifest["files"]
    )
    assert {"vrspray", "numpy", "python"} <= set(manifest["versions"])
    assert (manifest["flights"], manifest["settings"], manifest["part_flights"]) == (24, 6, 10)


def test_rows_belong_to_code_sprayers_and_the_published_field() -> None:
    names = {name for name, _ in program_files()}
    assert {"sitl/campaign/flying.py", "companion/core/controller.py"} < names
    assert {"profiles/wang-2024.toml", "anyang/prescription.dbf", "anyang/lags/gpio.toml"} < names
    # A wheel holds copies of them, a source tree has links.
    assert not any(name.startswith(("sitl/examples/", "companion/deploy/")) for name in names)


# ------------------------------------------------------------------------------------------ showing


def test_means_and_intervals_are_those_of_the_rows(reference: Path) -> None:
    shown = CliRunner().invoke(cli.app, ["show", str(reference), "--json"])
    assert shown.exit_code == 0, shown.output
    found = json.loads(shown.stdout)
    assert (found["written"], found["failed"], len(found["errors"])) == (24, 12, 1)
    group = next(
        each for each in found["groups"]
        if (each["setting"], each["value"]) == ("vehicle.gust_m_s", "2")
    )  # fmt: skip
    values = [
        row["misapplied_percent"] for row in rows_of(reference)
        if row["vehicle.gust_m_s"] == 2.0 and row["error"] is None
    ]  # fmt: skip
    estimate = group["figures"]["misapplied_percent"]
    assert estimate["mean"] == pytest.approx(np.mean(values))
    assert (estimate["min"], estimate["max"]) == (min(values), max(values))


def test_one_setting_has_its_interval_over_the_seeds(reference: Path) -> None:
    rows = read_rows(reference, ["misapplied_percent"])
    point = rows.point[0]
    chosen = rows.point == point
    one = replace(
        rows,
        case=["x"] * int(chosen.sum()),
        point=rows.point[chosen],
        seed=rows.seed[chosen],
        settings={name: column[: int(chosen.sum())] for name, column in rows.settings.items()},
        figures={"misapplied_percent": rows.figures["misapplied_percent"][chosen]},
    )
    values = one.figures["misapplied_percent"]
    estimate = groups_of(one, ["case"])[0].figures["misapplied_percent"]
    half = t.ppf(0.975, len(values) - 1) * values.std(ddof=1) / len(values) ** 0.5
    assert estimate is not None and estimate.high is not None
    assert estimate.high - estimate.mean == pytest.approx(half)


@pytest.mark.parametrize("kind", ["sobol", "morris", "latin-hypercube"])
def test_sensitivity_finds_the_setting_that_matters(
    reference: Path, tmp_path: Path, kind: str
) -> None:
    """Of a figure that is known: four times one setting, and nothing of the other."""
    campaign = read_campaign(
        write_campaign(
            tmp_path,
            f'seeds = 5\n[design]\nkind = "{kind}"\nsamples = 128\n'
            '[[vary]]\nset = "vehicle.gust_m_s"\nlow = 0.0\nhigh = 3.0\n'
            '[[vary]]\nset = "vehicle.gust_time_s"\nlow = 1.0\nhigh = 3.0\n',
        )
    )
    count = campaign.settings_count
    rows = replace(
        read_rows(reference, []),
        campaign=campaign,
        point=np.arange(count),
        seed=np.zeros(count, dtype=np.int64),
        figures={"misapplied_percent": 4.0 * campaign.points[:, 0]},
    )
    found = {(each.setting, each.name): each for each in sensitivity_of(rows)}
    name, size, slack = {
        "sobol": ("ST", 1.0, 0.1),
        "morris": ("mu_star", 4.0, 1e-6),
        "latin-hypercube": ("S1", 1.0, 0.1),
    }[kind]
    matters, other = found["vehicle.gust_m_s", name], found["vehicle.gust_time_s", name]
    assert matters.value == pytest.approx(size, abs=slack)
    assert abs(other.value) < 0.15
    assert matters.low is not None and matters.high is not None
    assert matters.low <= matters.value <= matters.high
    assert not list(notes_of(rows, list(found.values())))


@pytest.mark.parametrize(("kind", "samples", "needed"), [("sobol", 32, 64), ("morris", 15, 16)])
def test_too_few_samples_give_no_interval_and_say_so(
    reference: Path, tmp_path: Path, kind: str, samples: int, needed: int
) -> None:
    campaign = designed(tmp_path, kind, samples)
    rows = replace(
        read_rows(reference, []),
        campaign=campaign,
        point=np.arange(campaign.settings_count),
        seed=np.zeros(campaign.settings_count, dtype=np.int64),
        figures={"misapplied_percent": 4.0 * campaign.points[:, 0]},
    )
    found = sensitivity_of(rows)
    assert found and all((each.low, each.high) == (None, None) for each in found)
    few, too_few = notes_of(rows, found)
    assert few.startswith("intervals over 2 seeds mean little; write seeds = 10")
    assert [too_few] == [
        f"no intervals of sensitivity: {samples} samples are too few for a {kind} design; write "
        f"design.samples = {needed} or more"
    ]
    assert not any("[" in line for line in sensitivity_lines(found))
    assert pictures._sensitivity(rows, found) is not None


def test_texts_are_categories_of_the_parallel_coordinates(reference: Path) -> None:
    rows = read_rows(reference, ["applied_ml"])
    count = len(rows.point)
    words = [("scheduled", "none", None, True)[point % 4] for point in rows.point.tolist()]
    settings, figures = pictures._columns(replace(rows, settings={"method.name": words}))
    axis = settings["method.name"]
    assert axis.marks == ((0.125, "scheduled"), (0.375, "none"), (0.625, "-"), (0.875, "True"))
    assert axis.places.tolist() == [0.125, 0.375, 0.625, 0.875, 0.125, 0.375]
    assert list(figures) == ["applied_ml"] and count == 24


def test_pictures_are_drawn(reference: Path, tmp_path: Path) -> None:
    given = ["show", str(reference), "--plots", str(tmp_path), "--figure", "applied_ml"]
    shown = CliRunner().invoke(cli.app, given)
    assert shown.exit_code == 0, shown.output
    for name in ("responses.png", "parallel.png"):
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")
    assert "applied_ml" in shown.stdout


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["show", "nowhere"], "no campaign's manifest"),
        (["nowhere.toml"], "no such file or directory"),
        (["FILE", "--workers", "0"], "--workers 0: give 1 to 256"),
        (["FILE", "--workers", "2", "--cluster", "tcp://x:1"], "leave it out with --cluster"),
        (["show", "DIR", "--figure", "lag"], "--figure lag: choose of"),
        (["show", "DIR", "--by", "lag"], "--by lag: choose of case, "),
    ],
)
def test_a_wrong_call_is_refused_in_one_line(
    reference: Path, here: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch, given: list[str], said: str,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    names = {"FILE": str(here), "DIR": str(reference)}
    assert execute(["campaign", *(names.get(each, each) for each in given)]) == 2
    error = capsys.readouterr().err.strip()
    assert said in error and "\n" not in error
