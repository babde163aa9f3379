"""Bucket tests: a curve that the controller takes, and what speaks against it."""

from __future__ import annotations

import json
import random
import re
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import fmean

import numpy as np
import pytest
import typer
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from typer.testing import CliRunner

from analysis.bucket import BucketCurve, Catch, fit_bucket
from analysis.calibrate_flow import flow, valves_of
from analysis.csv_rows import TableError
from analysis.published import EIGHT, SETS, TWELVE, disagreements, excess_percent
from sitl.profile import load_profile

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "anyang" / "config.toml"
DUTIES = (0.2, 0.4, 0.5, 0.6, 0.8, 0.9, 1.0)
WINDOW = (0.2, 0.9)


def catches(flows: dict[float, list[float]], seconds: float = 60.0) -> list[Catch]:
    return [
        Catch(duty=duty, seconds=seconds, millilitres=1000.0 * each * seconds / 60.0)
        for duty, repeated in flows.items()
        for each in repeated
    ]


def even(spread: float = 0.01) -> dict[float, list[float]]:
    return {d: [6.0 * d * (1.0 - spread / 2), 6.0 * d * (1.0 + spread / 2)] for d in DUTIES}


def fitted(flows: dict[float, list[float]], seconds: float = 60.0) -> BucketCurve:
    return fit_bucket(catches(flows, seconds), window=WINDOW)


def test_the_curve_goes_through_the_means() -> None:
    curve = fitted(even())
    assert curve.duty == DUTIES
    assert curve.flow_l_min == pytest.approx([6.0 * duty for duty in DUTIES])
    assert curve.warnings == ()


def test_repeatability_is_the_deviation_of_one_catch() -> None:
    # Two catches 2 % apart deviate by 2 % / sqrt(2).
    assert fitted(even(0.02)).repeatability_percent == pytest.approx(2.0 / 2.0**0.5)


def test_residuals_are_catch_less_curve() -> None:
    residual = fitted(even(0.02)).residuals[0]
    assert residual.residual_percent == pytest.approx(-1.0, abs=1e-6)
    assert residual.residual_l_min == pytest.approx(-0.012, abs=1e-6)


def test_means_weigh_each_catch_by_its_time() -> None:
    flows = even()
    items = catches(flows)
    items += [Catch(duty=0.5, seconds=120.0, millilitres=8000.0)]
    curve = fit_bucket(items, window=WINDOW)
    expected = (sum(flows[0.5]) + 8.0) / 4.0
    assert curve.means[curve.duty.index(0.5)].flow_l_min == pytest.approx(expected)


@given(st.lists(st.floats(0.1, 10.0), min_size=4, max_size=9))
def test_whatever_was_caught_the_curve_rises_or_is_refused(flows: list[float]) -> None:
    items = catches({(i + 1) / 10.0: [each] for i, each in enumerate(flows)})
    try:
        curve = fit_bucket(items, window=WINDOW)
    except ValueError as error:
        falls = any(b < 0.9 * a for i, a in enumerate(flows) for b in flows[i + 1 :])
        said = "the flow falls from" if falls else "at least two duties"
        assert said in str(error)
        assert flows[0] >= min(flows[1:]) or falls
        return
    assert all(a < b for a, b in zip(curve.flow_l_min, curve.flow_l_min[1:], strict=False))
    assert curve.flow_curve.flow_for(curve.duty[0]) == pytest.approx(curve.flow_l_min[0])
    assert curve.flow_l_min[0] >= min(flows) * (1.0 - 1e-9)
    assert curve.flow_l_min[-1] <= max(flows) * (1.0 + 1e-9)


def test_what_does_not_rise_is_pooled_and_said() -> None:
    flows = even()
    flows[0.6] = [2.9, 2.9]
    curve = fitted(flows)
    assert len(curve.duty) == len(DUTIES) - 1
    assert curve.duty[2] == pytest.approx(0.55)
    assert curve.flow_l_min[2] == pytest.approx(2.95)
    assert any("does not rise from duty 0.5 to 0.6" in text for text in curve.warnings)


def test_a_curve_ends_where_the_flow_no_longer_rises() -> None:
    flows = even() | {0.8: [4.0, 4.02], 1.0: [4.0, 4.0]}
    flows = {duty: caught for duty, caught in flows.items() if duty <= 0.6 or duty in (0.8, 1.0)}
    curve = fitted(flows)
    assert curve.duty[-1] == 0.8
    assert curve.flow_l_min[-1] == pytest.approx(4.005)
    assert curve.flow_curve.flow_for(1.0) == pytest.approx(4.005)
    assert any("or set pwm.duty_max to 0.8" in text for text in curve.warnings)


def test_a_curve_begins_where_the_flow_begins_to_rise() -> None:
    least = min(even())
    flows = {duty: caught[:1] for duty, caught in even().items()}  # no smoothing
    flows[least / 2] = flows[least]
    curve = fitted(flows)
    assert curve.duty[0] == least
    assert not any("duty_max" in text for text in curve.warnings)


@pytest.mark.parametrize(
    ("change", "seconds", "said"),
    [
        ({0.5: [2.8, 3.2]}, 60.0, "duty 0.5 spread by 13.3 %"),
        ({0.5: [3.0]}, 60.0, "measured once at duty 0.5"),
        ({0.1: [0.6, 0.6]}, 60.0, "duty 0.1 is outside"),
        ({0.95: [5.7, 5.7]}, 60.0, "duty 0.95 is outside"),
        ({0.6: [4.4, 4.4]}, 60.0, "the curve is uneven"),
        ({}, 10.0, "14 catches of less than 20 s"),
    ],
)
def test_what_speaks_against_a_curve_is_said(
    change: dict[float, list[float]], seconds: float, said: str
) -> None:
    curve = fitted(even() | change, seconds)
    assert any(said in text for text in curve.warnings), curve.warnings


def test_few_duties_and_wide_gaps_are_said() -> None:
    curve = fitted({duty: [6.0 * duty, 6.0 * duty] for duty in (0.2, 0.5, 0.9)})
    assert any("3 duties are few" in text for text in curve.warnings)
    assert any("no catch between duty 0.5 and 0.9" in text for text in curve.warnings)


# ------------------------------------------------------------------------------ what P1 published


def test_table_2_is_the_twins_profile() -> None:
    for published, nozzle_set in zip(SETS, load_profile("wang-2024").nozzle_sets, strict=True):
        flows = [published.nozzles * each for each in published.nozzle_flow_l_min]
        assert list(nozzle_set.flow_l_min) == pytest.approx(flows)
        assert nozzle_set.duty == published.duty


@pytest.mark.parametrize(
    ("flow_l_min", "percent"), [(2.0, 22.4), (2.5, 15.3), (3.0, 9.0), (3.5, 5.5), (3.99, 5.1)]
)
def test_eq_2_with_eight_nozzles_gives_more_than_it_is_asked_for(
    flow_l_min: float, percent: float
) -> None:
    excess = excess_percent(EIGHT, flow_l_min)
    assert excess is not None
    assert round(excess, 1) == percent


@pytest.mark.parametrize(
    ("flow_l_min", "percent"), [(4.0, 0.1), (4.5, 2.1), (5.0, -0.3), (5.5, 3.8), (6.0, 0.7)]
)
def test_eq_2_with_twelve_nozzles_is_nearer(flow_l_min: float, percent: float) -> None:
    excess = excess_percent(TWELVE, flow_l_min)
    assert excess is not None
    assert round(excess, 1) == percent


def test_the_largest_disagreements_lie_at_2_l_min_and_at_a_duty_of_90_percent() -> None:
    eight = max(disagreements(EIGHT), key=lambda row: row.excess_percent)
    twelve = max(disagreements(TWELVE), key=lambda row: row.excess_percent)
    assert (eight.asked_l_min, round(eight.excess_percent, 1)) == (2.0, 22.4)
    assert (round(twelve.duty, 3), round(twelve.excess_percent, 1)) == (0.9, 5.3)


def test_law_and_its_inverse_agree() -> None:
    for published in SETS:
        assert published.law_flow_l_min(published.law.duty(3.3)) == pytest.approx(3.3)


# ------------------------------------------------------------------------------- the command line


def run(*arguments: str) -> tuple[int, str, str]:
    app = typer.Typer()
    app.command()(flow)
    result = CliRunner().invoke(app, arguments)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.stdout, result.stderr


def written(path: Path, text: str) -> str:
    path.write_text(text, encoding="utf-8")
    return str(path)


def table_2(path: Path) -> str:
    """Write P1's Table 2 as a bucket test: one nozzle, one minute."""
    rows = ["duty,seconds,millilitres,set"]
    for published, valves in zip(SETS, ("1-4", "1-6"), strict=True):
        for duty, each in zip(published.duty, published.nozzle_flow_l_min, strict=True):
            rows.append(f"{duty},60,{1000.0 * each * published.nozzles:.1f},{valves}")
    return written(path, "\n".join(rows))


def test_table_2_comes_out_as_it_stands_in_the_example(tmp_path: Path) -> None:
    file = table_2(tmp_path / "b.csv")
    code, out, _ = run(file, "--config", str(EXAMPLE), "--json")
    assert code == 0
    sets = tomllib.loads(json.loads(out)["toml"])["nozzle_set"]
    example = tomllib.loads(EXAMPLE.read_text(encoding="utf-8"))["nozzle_set"][0]
    assert sets[1]["valves"] == example["valves"]
    assert sets[1]["duty"] == example["duty"]
    assert sets[1]["flow_l_min"] == pytest.approx(example["flow_l_min"])
    assert sets[0]["valves"] == ["1", "2", "3", "4"]


def test_compared_with_the_paper_its_contradiction_is_a_warning(tmp_path: Path) -> None:
    code, out, err = run(table_2(tmp_path / "b.csv"), "--compare", "wang-2024", "--json")
    assert code == 0
    eight, twelve = json.loads(out)["compare"]
    assert (eight["nozzles"], twelve["nozzles"]) == (8, 12)
    assert "Eq. 2 and Table 2 disagree by up to +22.4 % of flow (asked 2.00 L/min" in err
    assert all(abs(row["over_table_2_percent"]) < 1e-6 for row in eight["rows"])
    at_70 = next(row for row in eight["rows"] if row["duty"] == 0.7)
    assert at_70["over_eq_2_percent"] == pytest.approx(12.3, abs=0.05)


def test_one_nozzle_of_many_is_multiplied(tmp_path: Path) -> None:
    text = "duty,seconds,litres\n0.5,60,0.25\n1.0,60,0.5\n"
    _, out, err = run(written(tmp_path / "b.csv", text), "--times", "12", "--json")
    assert json.loads(out)["sets"][0]["flow_l_min"] == pytest.approx([3.0, 6.0])
    assert "write the names of the valves" in err


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("duty,millilitres\n0.5,3000\n", "no column seconds"),
        ("duty,seconds,millilitres\n50,60,3000\n", "write 0.5 for 50 %"),
        ("duty,seconds\n0.5,60\n", "either millilitres or litres"),
        ("duty,seconds,litres,millilitres\n0.5,60,3,3000\n", "either millilitres or litres"),
        ("duty,seconds,litres\n0.5,60,0\n", "nothing was caught"),
        ("duty,seconds,litres\n0.5,0,3\n", "seconds must be a number from 1"),
        ("duty,seconds,litres\n0.5,60,3\n", "at least two duties"),
        ("duty,seconds,litres,set\n0.5,60,3,7\n0.9,60,4,7\n", "no valve 7"),
    ],
)
def test_a_table_that_cannot_be_used_is_refused_in_one_line(
    tmp_path: Path, text: str, said: str
) -> None:
    with pytest.raises(TableError, match=said) as refused:
        run(written(tmp_path / "b.csv", text), "--config", str(EXAMPLE))
    assert "\n" not in str(refused.value)


def test_an_unknown_comparison_is_refused(tmp_path: Path) -> None:
    with pytest.raises(TableError, match="there is only wang-2024"):
        run(table_2(tmp_path / "b.csv"), "--compare", "other")


def test_sets_are_named_by_range_or_one_by_one() -> None:
    path = Path("b.csv")
    assert valves_of("1-3 5", None, path) == ["1", "2", "3", "5"]
    assert valves_of("left, right", ("left", "right"), path) == ["left", "right"]
    assert valves_of("1-2", ("1-2", "3"), path) == ["1-2"]
    assert valves_of("", ("1", "2"), path) == ["1", "2"]


def test_a_picture_is_drawn(tmp_path: Path) -> None:
    picture = tmp_path / "curve.png"
    code, out, _ = run(table_2(tmp_path / "b.csv"), "--plot", str(picture))
    assert code == 0
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert "[[nozzle_set]]" in out


# ------------------------------------------------------------------------- through the scatter

LAWS: dict[str, Callable[[float], float]] = {
    # A pulse delivers from 5 ms after its start: in proportion to what is left of it.
    "dead time": lambda duty: 6.5 * (duty - 0.055),
    # The pump gives way: the pressure falls as the flow rises.
    "pump": lambda duty: 6.0 * duty**0.5,
    # Above 0.9 the valve stays open.
    "kink": lambda duty: min(6.4 * duty, 5.76 + 0.3 * (duty - 0.9)),
}
EIGHT_DUTIES = (0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)


def scattered(law: str, scatter: float, seed: int) -> list[Catch]:
    """Return two catches at each duty that differ from the law by chance."""
    chance = random.Random(f"{law} {seed}")
    return catches(
        {d: [LAWS[law](d) * chance.gauss(1.0, scatter) for _ in range(2)] for d in EIGHT_DUTIES}
    )


def error_percent(law: str, duty: Sequence[float], flow: Sequence[float]) -> float:
    """Return the root mean square of what straight lines between points are off the law."""
    grid = np.linspace(EIGHT_DUTIES[0], EIGHT_DUTIES[-1], 141)
    truth = np.array([LAWS[law](each) for each in grid.tolist()])
    return float(100.0 * np.sqrt(np.mean((np.interp(grid, duty, flow) / truth - 1.0) ** 2)))


def errors_percent(law: str, scatter: float) -> tuple[float, float]:
    """Return the mean error of the fitted curves and that of the means, over forty tests."""
    fits, raws = [], []
    for seed in range(40):
        curve = fit_bucket(scattered(law, scatter, seed), window=WINDOW)
        means = np.maximum.accumulate([mean.flow_l_min for mean in curve.means]).tolist()
        fits.append(error_percent(law, curve.duty, curve.flow_l_min))
        raws.append(error_percent(law, EIGHT_DUTIES, means))
    return fmean(fits), fmean(raws)


@pytest.mark.parametrize(
    ("law", "scatter", "share"), [("dead time", 0.03, 0.75), ("pump", 0.03, 0.95)]
)
def test_a_curve_through_scatter_is_nearer_the_truth_than_the_means(
    law: str, scatter: float, share: float
) -> None:
    fitted_percent, raw_percent = errors_percent(law, scatter)
    assert fitted_percent < share * raw_percent


@pytest.mark.parametrize("law", LAWS)
def test_where_catches_hardly_scatter_nothing_is_smoothed_away(law: str) -> None:
    fitted_percent, raw_percent = errors_percent(law, 0.002)
    assert fitted_percent < 1.05 * raw_percent


def test_a_bend_beyond_the_scatter_is_kept() -> None:
    curve = fit_bucket(
        catches({d: [LAWS["kink"](d) * p for p in (0.998, 1.002)] for d in (*EIGHT_DUTIES, 1.0)}),
        window=WINDOW,
    )
    assert curve.fit.kind == "points"
    assert curve.fit.line_p is not None and curve.fit.line_p < 0.01
    assert curve.flow_l_min == pytest.approx([mean.flow_l_min for mean in curve.means])


def test_what_was_measured_once_is_taken_as_it_is() -> None:
    curve = fitted(
        {duty: [6.0 * duty * (1.03 if i % 2 else 0.97)] for i, duty in enumerate(DUTIES)}
    )
    assert (curve.fit.kind, curve.fit.p) == ("points", None)
    assert curve.flow_l_min == pytest.approx([mean.flow_l_min for mean in curve.means])


def test_a_straight_line_passes_the_test_that_is_printed(tmp_path: Path) -> None:
    rows = [f"{c.duty},60,{c.millilitres}" for c in scattered("dead time", 0.02, 2)]
    file = written(tmp_path / "b.csv", "\n".join(("duty,seconds,millilitres", *rows)))
    code, out, _ = run(file, "--config", str(EXAMPLE))
    assert code == 0
    assert "curve: a straight line; lack of fit F = " in out
    found = json.loads(run(file, "--config", str(EXAMPLE), "--json")[1])["sets"][0]
    # The F-test by hand: scipy has the distribution, the rest are sums.
    flows = np.array(found["flow_l_min"])
    means = np.array([point["flow_l_min"] for point in found["points"]])
    relative = (
        np.array(
            [[r["flow_l_min"] for r in found["residuals"] if r["duty"] == d] for d in EIGHT_DUTIES]
        )
        / means[:, None]
    )
    pure = np.sum((relative - 1.0) ** 2) / 8.0
    f = np.sum(2.0 * (flows / means - 1.0) ** 2) / 6.0 / pure
    assert found["fit"]["f"] == pytest.approx(f)
    assert found["fit"]["f_degrees_of_freedom"] == pytest.approx([6.0, 8.0])
    assert found["fit"]["p"] == pytest.approx(stats.f.sf(f, 6, 8))
    assert np.ptp(np.diff(flows)) == pytest.approx(0.0, abs=1e-9)


def test_residuals_of_every_catch_are_shown(tmp_path: Path) -> None:
    rows = [f"{c.duty},60,{c.millilitres}" for c in catches(even(0.02))]
    file = written(tmp_path / "b.csv", "\n".join(("duty,seconds,millilitres", *rows)))
    _, out, _ = run(file, "--config", str(EXAMPLE))
    assert "off the curve %" in out
    assert out.count("-1.0 +1.0") == len(DUTIES)


@pytest.mark.parametrize(
    ("flows", "said"),
    [
        (
            even() | {0.6: [2.4, 2.42]},
            "the flow falls from 3.000 L/min at duty 0.5 to 2.410 at 0.6",
        ),
        (even() | {0.2: [6.0], 1.0: [1.2]}, "the flow falls from 6.000 L/min at duty 0.2"),
        (
            {d: [3.0 + 0.02 * d, 2.6, 3.4] for d in DUTIES},
            "the flow does not rise by more than the catches scatter",
        ),
    ],
)
def test_what_cannot_be_a_curve_is_refused_in_one_line(
    tmp_path: Path, flows: dict[float, list[float]], said: str
) -> None:
    rows = [f"{c.duty},60,{c.millilitres}" for c in catches(flows)]
    file = written(tmp_path / "b.csv", "\n".join(("duty,seconds,millilitres", *rows)))
    with pytest.raises(TableError, match=re.escape(said)) as refused:
        run(file, "--config", str(EXAMPLE))
    assert "\n" not in str(refused.value)
