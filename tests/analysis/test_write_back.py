"""`calibrate ... --write`: the measured keys change, and nothing else in the file."""

from __future__ import annotations

import json
import tomllib
from datetime import UTC, datetime
from pathlib import Path

import pytest

from analysis.write_back import write_back
from companion.cli.app import execute
from companion.config import load
from companion.errors import ConfigError

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "anyang" / "config.toml"
LAGS = "[lag]\non_s = 0.2000\noff_s = 0.2100\n"

Captured = pytest.CaptureFixture[str]


def copy(folder: Path, text: str | None = None) -> Path:
    path = folder / "config.toml"
    given = EXAMPLE.read_text() if text is None else text
    path.write_text(given.replace("[prescription]\n", "[prescription]\n# of the office\n"))
    return path


def test_measured_keys_change_and_comments_stay(tmp_path: Path) -> None:
    path = copy(tmp_path)
    path.write_text(path.read_text().replace("on_s = 0.1028", "on_s = 0.1028  # 2024"))
    before = path.read_text()
    lines = write_back(path, LAGS + "off_end_s = 0.3\n")
    after = path.read_text()
    assert "on_s = 0.2  # 2024" in after
    assert [line for line in before.splitlines() if line.startswith("#")] == [
        line for line in after.splitlines() if line.startswith("#")
    ]
    changed = [line for line in lines if line[:1] in "+-" and line[:3] not in ("+++", "---")]
    today = datetime.now(tz=UTC).astimezone().date().isoformat()
    assert f'+measured_on = "{today}"' in changed
    assert len(changed) == 7
    assert (tmp_path / "config.toml.bak").read_text() == before
    lag = load(path).lag
    assert (lag.on_s, lag.off_s, lag.off_end_s, lag.up_s) == (0.2, 0.21, 0.3, 0.1033)


def test_lists_over_several_lines_and_tables_that_are_not_there(tmp_path: Path) -> None:
    text = EXAMPLE.read_text().replace(
        "duty = [0.2, 0.4, 0.5, 0.7, 0.8, 0.9, 1.0]",
        "duty = [ # of the paper\n  0.2, 0.4, 0.5,\n  0.7, 0.8, 0.9, 1.0,\n]",
    )
    path = copy(tmp_path, text.replace("[mission]", "[mission]  # planning"))
    measured = (
        '[[nozzle_set]]\nvalves = ["6", "5", "4", "3", "2", "1"]\n'
        "duty = [0.2, 1.0]\nflow_l_min = [1.5, 6.0]\n[tank]\ncapacity_l = 12.0\n"
    )
    write_back(path, measured)
    found = tomllib.loads(path.read_text())
    assert found["nozzle_set"][0]["duty"] == [0.2, 1.0]
    assert found["tank"] == {"capacity_l": 12.0}
    assert "# planning" in path.read_text()


@pytest.mark.parametrize(
    ("measured", "said"),
    [
        ('[[nozzle_set]]\nvalves = ["1"]\nduty = [0.2, 1.0]', "has no [[nozzle_set]] of these"),
        ("[lag]\non_s = -1.0", "not written: "),
        ("[boom]\nwidht_m = 3.0", "not written: "),
    ],
)
def test_what_would_be_refused_is_not_written(measured: str, said: str, tmp_path: Path) -> None:
    path = copy(tmp_path)
    before = path.read_text()
    with pytest.raises(ConfigError) as refused:
        write_back(path, measured)
    assert said in str(refused.value)
    assert path.read_text() == before
    assert [each.name for each in tmp_path.iterdir()] == ["config.toml"]


def test_flow_is_written_by_its_command(tmp_path: Path, capsys: Captured) -> None:
    path, table = copy(tmp_path), tmp_path / "bucket.csv"
    rows = [(duty, 60, 6000 * duty) for duty in (0.2, 0.4, 0.6, 0.8, 1.0) for _ in range(2)]
    table.write_text(
        "duty,seconds,millilitres\n" + "".join(f"{a},{b},{c:.0f}\n" for a, b, c in rows)
    )
    words = ["calibrate", "flow", str(table), "--write"]
    assert execute(words) == 2
    assert "--config" in capsys.readouterr().err
    assert execute([*words, "--config", str(path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["written"]
    assert load(path).nozzle_sets()[0].flow_max_l_min == pytest.approx(6.0, abs=0.05)


def test_a_calibration_flight_without_a_meter_is_warned_of(
    tmp_path: Path, capsys: Captured
) -> None:
    words = ["calibrate", "mission", "--config", str(EXAMPLE), "--out", str(tmp_path / "c.plan")]
    assert execute(words) == 0
    assert "has no [flow_meter]" in capsys.readouterr().err


def bucket(path: Path, seconds: float) -> Path:
    rows = [(duty, 6000 * duty) for duty in (0.2, 0.4, 0.6, 0.8, 1.0) for _ in range(2)]
    told = "".join(f"{duty},{seconds:g},{caught:.0f}\n" for duty, caught in rows)
    path.write_text("duty,seconds,millilitres\n" + told)
    return path


@pytest.mark.parametrize("seconds", [1.0, 60.0 * 2.5])
@pytest.mark.parametrize("more", [(), ("--write",)])
def test_a_flow_far_from_the_configured_one_is_refused_until_it_is_confirmed(
    seconds: float, more: tuple[str, ...], tmp_path: Path, capsys: Captured
) -> None:
    path = copy(tmp_path)
    before = path.read_text()
    table = bucket(tmp_path / "bucket.csv", seconds)
    words = ["calibrate", "flow", str(table), "--config", str(path), *more]
    assert execute(words) == 2
    told = capsys.readouterr()
    assert "--confirm" in told.err and "nozzle_set" not in told.out
    assert path.read_text() == before
    assert execute([*words, "--confirm"]) == 0
    assert (path.read_text() != before) is bool(more)
    path.write_text(before)
    # What another nozzle or wear do is no mistake.
    assert execute([*words[:2], str(bucket(table, 50.0)), *words[3:]]) == 0


def test_a_comment_that_called_the_figures_a_guess_goes_with_them(tmp_path: Path) -> None:
    path = tmp_path / "new.toml"
    assert execute(["config", "new", "--yes", "--out", str(path)]) == 0
    assert path.read_text().count("# MEASURE") == 2
    words = ["calibrate", "flow", str(bucket(tmp_path / "a.csv", 60.0)), "--config", str(path)]
    for _ in range(2):
        assert execute([*words, "--write"]) == 0
        text = path.read_text()
        assert text.count("# MEASURE") == 1
        assert "0.8 L/min a valve" not in text
        assert text.count("# Measured by `vrspray calibrate`") == 1
    write_back(path, LAGS + "off_end_s = 0.3\n")
    assert "# MEASURE" not in path.read_text()
    assert "# Valves on outputs of the flight controller" in path.read_text()
    assert load(path).lag.on_s == 0.2
