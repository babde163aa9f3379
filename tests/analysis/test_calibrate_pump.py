"""The bucket test of a pump, by pulse width: curve, warnings, lines to paste."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import pytest

from companion.cli.app import execute

ROWS = ((1200, 1.0), (1350, 2.1), (1500, 3.2), (1650, 4.2), (1800, 5.0), (2000, 5.8))


def table(folder: Path, rows: tuple[tuple[int, float], ...] = ROWS, head: str = "us") -> Path:
    """Write each flow twice, one percent apart, caught in a minute."""
    lines = [f"{head},seconds,litres"]
    lines += [f"{us},60,{flow * part:.4f}" for us, flow in rows for part in (0.995, 1.005)]
    path = folder / "pump.csv"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def test_the_lines_to_paste_are_the_measured_means_within_their_scatter(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert execute(["calibrate", "flow", str(table(tmp_path)), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    pump = tomllib.loads(said["toml"])["pump"]
    assert pump["us"] == [us for us, _ in ROWS]
    assert pump["min_us"] == 1200
    assert pump["flow_l_min"] == pytest.approx([flow for _, flow in ROWS], rel=0.005)
    assert said["warnings"] == []
    assert said["sets"] == []
    assert said["pump"]["points"][0]["us"] == pytest.approx(1200.0)
    assert said["pump"]["points"][0]["count"] == 2
    assert said["pump"]["repeatability_percent"] == pytest.approx(0.71, abs=0.01)


def test_a_person_reads_pulses_and_not_shares(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    falling = (*ROWS[:4], (1800, 4.1), ROWS[5])
    assert execute(["calibrate", "flow", str(table(tmp_path, falling))]) == 0
    said = capsys.readouterr()
    assert "does not rise from pulse 1650 us to 1800 us" in said.err
    assert "at 1725 us; measure again" in said.err
    assert "   1500        2   3.200" in said.out
    assert "us = [1200, 1350, 1500, 1725, 2000]" in said.out


@pytest.mark.parametrize(
    ("rows", "text"),
    [
        (ROWS[:4], "4 pulses are few for a curve; measure at 5 or more"),
        ((ROWS[0], *ROWS[3:]), "no catch between pulse 1200 us and 1650 us"),
    ],
)
def test_doubts_are_said_in_microseconds(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    rows: tuple[tuple[int, float], ...],
    text: str,
) -> None:
    assert execute(["calibrate", "flow", str(table(tmp_path, rows)), "--json"]) == 0
    assert text in json.loads(capsys.readouterr().out)["warnings"]


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("us,seconds,litres\n400,60,1\n", "us must be a number from 500 to 2500"),
        ("us,seconds,litres\n1500,60,0\n", "nothing was caught"),
        ("us,seconds,litres\n1500,60,1\n", "at least two pulses are needed"),
        ("us,seconds,litres,set\n1500,60,1,1-4\n", "a pump has one curve"),
    ],
)
def test_a_table_that_cannot_be_used_is_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, why: str
) -> None:
    path = tmp_path / "pump.csv"
    path.write_text(text, encoding="utf-8")
    assert execute(["calibrate", "flow", str(path)]) == 2
    said = capsys.readouterr().err
    assert why in said
    assert said.count("\n") == 1


def test_a_pump_is_not_compared_with_valves(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = table(tmp_path)
    assert execute(["calibrate", "flow", str(path), "--compare", "wang-2024"]) == 2
    assert "was measured by duty" in capsys.readouterr().err


def test_the_picture_of_a_pumps_curve_is_written(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    picture = tmp_path / "curve.png"
    assert execute(["calibrate", "flow", str(table(tmp_path)), "--plot", str(picture)]) == 0
    assert picture.read_bytes()[:4] == b"\x89PNG"
