"""Effective swath: CVs against closed forms and a judge that adds passes up on a fine grid."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from analysis.calibrate_swath import read_passes, swath
from analysis.csv_rows import TableError
from analysis.swath import Pattern, cv_percent, evaluate
from companion.config import load

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "zones" / "config.toml"
APP = typer.Typer()
APP.command()(swath)


def pattern(places: tuple[float, ...], deposit: tuple[float, ...]) -> Pattern:
    return Pattern(name="1", right_m=places, deposit=deposit)


TRIANGLE = pattern((-3.0, 0.0, 3.0), (0.0, 7.0, 0.0))
RECTANGLE = pattern((-2.0, 0.0, 2.0), (1.0, 1.0, 1.0))
SAWTOOTH = pattern((-2.0, -1.9999999, 0.0, 2.0), (0.0, 0.0, 2.0, 4.0))
LOPSIDED = pattern((-4.0, -2.0, -0.5, 1.0, 3.0), (0.0, 3.0, 1.0, 5.0, 0.0))


@pytest.mark.parametrize("spacing", [3.0, 3.5, 4.2, 5.0, 6.0])
@pytest.mark.parametrize("to_and_fro", [True, False])
def test_a_triangle_has_the_cv_of_its_closed_form(spacing: float, to_and_fro: bool) -> None:
    # Half base 1, spacing s in [1, 2]: mean 1/s, mean square (2/3 + (2 - s)^3 / 3) / s.
    s = spacing / 3.0
    expected = 100.0 * math.sqrt(max(s * (2.0 + (2.0 - s) ** 3) / 3.0 - 1.0, 0.0))
    assert cv_percent(TRIANGLE, spacing, to_and_fro=to_and_fro) == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("gap", [0.0, 0.2, 1.0])
def test_a_rectangle_has_the_cv_of_its_gaps(gap: float) -> None:
    # Spacing s over width w, s >= w: mean w/s, mean square w/s.
    expected = 100.0 * math.sqrt(gap / 4.0)
    assert cv_percent(RECTANGLE, 4.0 + gap, to_and_fro=True) == pytest.approx(expected, abs=1e-5)


def test_a_trapezoid_whose_flanks_meet_is_even() -> None:
    trapezoid = pattern((-4.0, -2.0, 2.0, 4.0), (0.0, 5.0, 5.0, 0.0))
    assert cv_percent(trapezoid, 6.0, to_and_fro=False) == pytest.approx(0.0, abs=1e-5)
    # 8 m apart nothing overlaps: mean 30/8, mean square (4*25 + 2*2*25/3) / 8.
    mean, square = 30.0 / 8.0, (100.0 + 100.0 / 3.0) / 8.0
    expected = 100.0 * math.sqrt(square - mean**2) / mean
    assert cv_percent(trapezoid, 8.0, to_and_fro=True) == pytest.approx(expected)


FOOT_M = 0.3048


@pytest.mark.parametrize("to_and_fro", [True, False])
def test_the_worked_example_of_a_pattern_test_is_even_at_its_effective_swath(
    to_and_fro: bool,
) -> None:
    # Ohio State University Extension, Bulletin 817, Figure 20: 4 inches in the first bottles, 3 to
    # 4 feet out, and 2 inches at 6 feet to each side make an effective swath of 12 feet.
    right_m = tuple(FOOT_M * feet for feet in (-8.0, -6.0, -4.0, -3.0, 0.0, 3.0, 4.0, 6.0, 8.0))
    inches = pattern(right_m, (0.0, 2.0, 4.0, 4.0, 4.0, 4.0, 4.0, 2.0, 0.0))
    assert cv_percent(inches, 12.0 * FOOT_M, to_and_fro=to_and_fro) == pytest.approx(0.0, abs=1e-4)
    for feet in (10.5, 13.5):
        assert cv_percent(inches, feet * FOOT_M, to_and_fro=to_and_fro) > 5.0
    found = evaluate([inches], 25.0).swath_m["to_and_fro" if to_and_fro else "one_way"]
    assert found is not None
    assert found > 12.0 * FOOT_M


def summed(one: Pattern, spacing: float, to_and_fro: bool) -> float:
    """Return the CV [%] of forty passes, added up every 2 mm between the middle ones."""
    at = np.arange(0.0, 2.0 * spacing, 0.002) + 0.001
    total = np.zeros_like(at)
    for lane in range(-20, 21):
        side = at - lane * spacing
        if to_and_fro and lane % 2:
            side = -side
        total += np.interp(side, one.right_m, one.deposit, left=0.0, right=0.0)
    return float(100.0 * total.std() / total.mean())


@pytest.mark.parametrize("one", [LOPSIDED, SAWTOOTH], ids=["lopsided", "sawtooth"])
@pytest.mark.parametrize("spacing", [0.9, 2.3, 4.0, 5.7])
@pytest.mark.parametrize("to_and_fro", [True, False])
def test_the_cv_is_that_of_passes_added_up(one: Pattern, spacing: float, to_and_fro: bool) -> None:
    assert cv_percent(one, spacing, to_and_fro=to_and_fro) == pytest.approx(
        summed(one, spacing, to_and_fro), abs=0.1
    )


def test_a_lopsided_pattern_differs_one_way_and_to_and_fro() -> None:
    one_way = cv_percent(SAWTOOTH, 4.0, to_and_fro=False)
    assert one_way == pytest.approx(100.0 / math.sqrt(3.0), abs=0.1)
    # Mirrored beside each other, two sawteeth 2 m closer lie over one another and fill up.
    assert cv_percent(LOPSIDED, 4.0, to_and_fro=True) != pytest.approx(
        cv_percent(LOPSIDED, 4.0, to_and_fro=False), abs=1.0
    )


def test_the_effective_swath_of_a_triangle_is_where_its_cv_is_25_percent() -> None:
    found = evaluate([TRIANGLE], 25.0)
    wide = found.swath_m["to_and_fro"]
    assert wide is not None
    assert summed(TRIANGLE, wide, to_and_fro=True) <= 25.0
    assert summed(TRIANGLE, wide + 0.1, to_and_fro=True) > 25.0


def cards(folder: Path, *, shift_m: float = 0.3, fall_s: float = 0.4) -> Path:
    """Write four passes over a trapezoid that stands aside and is blown aside."""
    lines = ["pass,right_m,deposit,wind_right_m_s"]
    for number, wind in enumerate((0.0, 1.5, -1.0, 2.0)):
        for at in np.arange(-9.0, 9.01, 0.25):
            side = at - shift_m - fall_s * wind
            deposit = float(np.interp(side, (-4.0, -2.0, 2.0, 4.0), (0.0, 8.0, 8.0, 0.0)))
            lines.append(f"{number},{at:g},{deposit:.3f},{wind:g}")
    path = folder / "cards.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_wind_is_told_from_what_stands_aside_without_it(tmp_path: Path) -> None:
    found = evaluate(read_passes(cards(tmp_path)), 25.0)
    fall = found.displacement.fall_s
    assert fall is not None
    assert fall.low <= fall.value <= fall.high
    assert fall.value == pytest.approx(0.4, abs=0.005)
    assert found.displacement.still_m == pytest.approx(0.3, abs=0.01)
    # Blown aside or not, each pass has the swath of all: wind does not widen it.
    assert found.swath_m["to_and_fro"] == pytest.approx(found.by_pass_m[0], abs=0.1)


def test_the_command_writes_what_the_configuration_takes(tmp_path: Path) -> None:
    config = tmp_path / "config.toml"
    config.write_text(EXAMPLE.read_text())
    plot = tmp_path / "swath.png"
    args = [str(cards(tmp_path)), "--config", str(config), "--plot", str(plot), "--write"]
    done = CliRunner().invoke(APP, [*args, "--json"], catch_exceptions=False)
    assert done.exit_code == 0
    result = json.loads(done.stdout)
    loaded = load(config)
    assert loaded.mission is not None
    assert loaded.boom_table.width_m == result["effective_swath_m"]
    assert loaded.mission.swath_width_m == result["effective_swath_m"]
    assert loaded.drift.fall_s == pytest.approx(0.4, abs=0.005)
    assert plot.read_bytes().startswith(b"\x89PNG")


def test_a_pattern_that_is_never_even_ends_with_1(tmp_path: Path) -> None:
    path = tmp_path / "cards.csv"
    # Two centimetres wide: no lane spacing that is tried covers the ground.
    path.write_text("right_m,deposit\n-0.01,0\n0,9\n0.01,0\n")
    done = CliRunner().invoke(APP, [str(path), "--json"], catch_exceptions=False)
    assert done.exit_code == 1
    assert "no lane spacing" in json.loads(done.stdout)["error"]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("right_m,deposit\n0,1\n0,2\n1,1\n", "two samples at one place"),
        ("right_m,deposit\n0,1\n1,2\n", "three samples"),
        ("right_m,deposit\n0,0\n1,0\n2,0\n", "some deposit"),
        ("right_m,deposit\n0,-1\n1,0\n2,0\n", "line 2: deposit must be a number"),
        ("x,y\n0,1\n", "no column right_m, deposit"),
        ("right_m,deposit,pass,wind_right_m_s\n0,1,1,2\n1,1,1,3\n2,1,1,2\n", "two winds"),
    ],
)
def test_a_table_that_cannot_be_used_is_refused_in_one_line(
    tmp_path: Path, text: str, said: str
) -> None:
    path = tmp_path / "cards.csv"
    path.write_text(text)
    with pytest.raises(TableError, match=said):
        read_passes(path)


def test_samples_that_end_before_the_deposit_does_are_told(tmp_path: Path) -> None:
    path = tmp_path / "cards.csv"
    path.write_text("right_m,deposit\n-2,5\n0,9\n2,5\n")
    done = CliRunner().invoke(APP, [str(path), "--json"], catch_exceptions=False)
    assert any("ends before the deposit" in one for one in json.loads(done.stdout)["warnings"])
