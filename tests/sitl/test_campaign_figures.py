"""What a campaign's tables say, beside scipy and statsmodels on the same Parquet."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from numpy.typing import NDArray
from scipy import stats
from statsmodels.stats.weightstats import CompareMeans, DescrStatsW
from typer.testing import CliRunner

from companion.errors import ConfigError
from sitl.campaign import cli, pictures
from sitl.campaign.bundle import bundle_of
from sitl.campaign.dataset import Dataset, open_dataset
from sitl.campaign.design import read_campaign
from sitl.campaign.show import Estimate, differences_of, groups_of, least_of, read_rows

FIGURE = "misapplied_percent"
CASES, SPEEDS, SEEDS = ("ours", "theirs"), (4.0, 6.0), 8
TEXT = f"""\
version = 1
seeds = {SEEDS}
[[case]]
name = "ours"
[[case]]
name = "theirs"
method.name = "look-ahead"
[[vary]]
set = "vehicle.speed_m_s"
values = [4.0, 6.0]
"""
# What seeds do to all cases alike is much more than what lies between the cases.
BY_SEED = np.random.default_rng(3).normal(0.0, 1.0, SEEDS)
NOISE = np.random.default_rng(4).normal(0.0, 0.05, (2, 2, SEEDS))


def misapplied(case: str, speed: float, seed: int) -> float:
    noise = NOISE[CASES.index(case), int(speed == SPEEDS[1]), seed - 1]
    # Two speeds that agree for ours, and differ by much for theirs.
    slope = 4.0 if case == "theirs" else 0.0
    return float(6.0 + slope * (speed - 4.0) + 0.5 * (case == "theirs") + BY_SEED[seed - 1] + noise)


def written(folder: Path, *, text: str = TEXT, lacking: Mapping[int, str] = {}) -> Path:
    """Return a dataset of figures by hand."""
    folder.mkdir(exist_ok=True)
    (folder / "by-hand.toml").write_text(text)
    campaign = read_campaign(folder / "by-hand.toml")
    dataset = open_dataset(campaign, bundle_of(campaign), folder / "out")
    for part in dataset.missing():
        dataset.write(part, [row(dataset, number, lacking) for number in dataset.flights_of(part)])
    return folder / "out"


def row(dataset: Dataset, number: int, lacking: Mapping[int, str]) -> dict[str, Any]:
    case, settings, seed = dataset.campaign.flight(number)
    value = misapplied(case, float(dict(settings)["vehicle.speed_m_s"]), seed)  # type: ignore[arg-type]
    return dataset.row(number, {} if number in lacking else {FIGURE: value}, lacking.get(number))


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("by-hand"))


def parquet(out: Path) -> list[dict[str, Any]]:
    return [
        each
        for path in sorted(out.glob("flights/part=*/*.parquet"))
        for each in pq.ParquetFile(path).read().to_pylist()
    ]


def by_seed(out: Path, case: str, speed: float | None = None) -> NDArray[np.float64]:
    """Return the mean of a case's settings for each seed, by the Parquet alone."""
    rows = [
        each for each in parquet(out)
        if each["case"] == case and speed in (None, each["vehicle.speed_m_s"])
    ]  # fmt: skip
    return np.array([
        np.mean([each[FIGURE] for each in rows if each["seed"] == seed])
        for seed in sorted({each["seed"] for each in rows})
    ])  # fmt: skip


def shown(out: Path, *given: str) -> dict[str, Any]:
    answer = CliRunner().invoke(cli.app, ["show", str(out), "--figure", FIGURE, "--json", *given])
    assert answer.exit_code == 0, answer.output
    found: dict[str, Any] = json.loads(answer.stdout)
    return found


def ends(estimate: dict[str, Any]) -> tuple[float, float, float]:
    return estimate["mean"], estimate["low"], estimate["high"]


@pytest.mark.parametrize("case", CASES)
def test_the_interval_of_a_case_is_over_its_seeds_whatever_its_settings(
    out: Path, case: str
) -> None:
    group = next(each for each in shown(out, "--by", "case")["groups"] if each["value"] == case)
    samples = by_seed(out, case)
    low, high = stats.ttest_1samp(samples, 0.0).confidence_interval(0.95)
    assert ends(group["figures"][FIGURE]) == pytest.approx((samples.mean(), low, high))
    assert (low, high) == pytest.approx(DescrStatsW(samples).tconfint_mean())
    assert group["figures"][FIGURE]["seeds"] == SEEDS


def test_cases_by_settings_have_a_row_each(out: Path) -> None:
    for given in ((), ("--by", "case", "--by", "vehicle.speed_m_s")):
        groups = [each for each in shown(out, *given)["groups"] if each["within"]]
        assert [(each["within"]["case"], each["value"]) for each in groups] == [
            ("ours", "4"), ("ours", "6"), ("theirs", "4"), ("theirs", "6"),
        ]  # fmt: skip
        for each in groups:
            samples = by_seed(out, each["within"]["case"], float(each["value"]))
            low, high = DescrStatsW(samples).tconfint_mean()
            assert ends(each["figures"][FIGURE]) == pytest.approx((samples.mean(), low, high))


@pytest.mark.parametrize("speed", [None, *SPEEDS])
def test_the_effect_of_a_case_is_over_pairs_of_one_seed(out: Path, speed: float | None) -> None:
    given = () if speed is None else ("--by", "case", "--by", "vehicle.speed_m_s")
    within = {} if speed is None else {"vehicle.speed_m_s": f"{speed:g}"}
    (found,) = (each for each in shown(out, *given)["differences"] if each["within"] == within)
    assert (found["value"], found["against"]) == ("theirs", "ours")
    ours, theirs = (by_seed(out, case, speed) for case in CASES)
    test = stats.ttest_rel(theirs, ours)
    low, high = test.confidence_interval(0.95)
    assert ends(found["figures"][FIGURE]) == pytest.approx(
        (float(np.mean(theirs - ours)), low, high)
    )
    # Without pairs the seeds' own scatter hides it.
    apart = CompareMeans(DescrStatsW(theirs), DescrStatsW(ours)).tconfint_diff(usevar="unequal")
    assert high - low < 0.2 * (apart[1] - apart[0])


def test_the_effect_of_a_setting_is_within_its_case(out: Path) -> None:
    found = shown(out, "--by", "vehicle.speed_m_s", "--by", "case")["differences"]
    for each in found:
        case = each["within"]["case"]
        more = by_seed(out, case, 6.0) - by_seed(out, case, 4.0)
        low, high = DescrStatsW(more).tconfint_mean()
        assert (each["value"], each["against"]) == ("6", "4")
        assert ends(each["figures"][FIGURE]) == pytest.approx((more.mean(), low, high))
    assert [each["within"]["case"] for each in found] == list(CASES)


def test_ranges_of_a_setting_have_no_pairs(tmp_path: Path) -> None:
    text = few("2").replace("values = [4.0, 6.0]", "low = 4.0\nhigh = 6.0\nsteps = 14")
    rows = read_rows(written(tmp_path, text=text), [FIGURE])
    assert len(groups_of(rows, ["vehicle.speed_m_s"])) == 6
    assert differences_of(rows, ["vehicle.speed_m_s"]) == []
    assert len(differences_of(rows, ["case", "vehicle.speed_m_s"])) == 6


def test_intervals_hold_the_mean_of_all_seeds_as_often_as_they_say() -> None:
    """Settings far apart or alike, seeds by chance: 95 of 100 intervals hold the true mean."""
    rng = np.random.default_rng(11)
    for spread in (0.0, 10.0):
        held = 0
        for _ in range(600):
            table = spread * np.arange(3.0)[:, None] + rng.normal(size=5) + rng.normal(size=(3, 5))
            found = Estimate.of(table)
            assert found is not None and found.low is not None and found.high is not None
            held += found.low <= spread <= found.high
        assert 0.925 < held / 600 < 0.975


def test_seeds_that_lack_a_setting_are_left_out_and_so_is_a_setting_that_never_flew() -> None:
    nan = np.nan
    found = Estimate.of(np.array([[1.0, 2.0, nan, 4.0], [3.0, 4.0, 5.0, 6.0], [nan] * 4]))
    assert found is not None and (found.mean, found.seeds) == (pytest.approx(10.0 / 3.0), 3)
    # A campaign that was broken off at its second setting: the first has all seeds.
    found = Estimate.of(np.array([[1.0, 2.0, 3.0], [9.0, nan, nan]]))
    assert found is not None and (found.mean, found.seeds) == (2.0, 3)
    one = Estimate.of(np.array([[1.0], [3.0]]))
    assert one is not None and (one.mean, one.low, one.seeds) == (2.0, None, 1)
    assert Estimate.of(np.full((2, 2), nan)) is None


def test_no_interval_reaches_below_what_a_figure_can_be() -> None:
    table = np.array([[0.01, 0.09]])
    found = Estimate.of(table, least=least_of("lag_distance_mean_abs_m"))
    assert found is not None and found.low == 0.0
    signed = Estimate.of(table, least=least_of("lag_distance_mean_m"))
    assert signed is not None and signed.low is not None and signed.low < 0.0
    assert least_of("border_margin_count") == least_of("off_target_ml") == 0.0
    assert least_of("spraying_accuracy_percent") == least_of("volume_error_percent") == -np.inf


def test_a_flight_that_failed_takes_its_pair_along(tmp_path: Path) -> None:
    out = written(tmp_path, lacking={0: "too far"})  # ours, 4 m/s, seed 1
    found = differences_of(read_rows(out, [FIGURE]))[0].figures[FIGURE]
    ours, theirs = (by_seed_without(out, case, 1) for case in CASES)
    low, high = stats.ttest_rel(theirs, ours).confidence_interval(0.95)
    assert found is not None
    assert (found.mean, found.low, found.high, found.seeds) == (
        pytest.approx(float(np.mean(theirs - ours))), pytest.approx(low), pytest.approx(high), 7,
    )  # fmt: skip


def by_seed_without(out: Path, case: str, seed: int) -> NDArray[np.float64]:
    rows = [each for each in parquet(out) if each["case"] == case and each["seed"] != seed]
    return np.array([
        np.mean([each[FIGURE] for each in rows if each["seed"] == one])
        for one in sorted({each["seed"] for each in rows})
    ])  # fmt: skip


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_the_tables_in_a_file_are_those_of_the_answer(
    out: Path, tmp_path: Path, suffix: str
) -> None:
    path = tmp_path / f"table{suffix}"
    found = shown(out, "--by", "case", "--by", "vehicle.speed_m_s", "--out", str(path))
    rows = _csv(path) if suffix == ".csv" else pq.ParquetFile(path).read().to_pylist()
    assert [each["kind"] for each in rows] == ["mean"] * 4 + ["difference"] * 2
    for each, of in zip(rows, [*found["groups"], *found["differences"]], strict=True):
        assert each["figure"] == FIGURE
        told = of["figures"][FIGURE]
        assert (float(each["mean"]), float(each["low"])) == pytest.approx(
            (told["mean"], told["low"])
        )
        assert each["vehicle.speed_m_s"] in ("4", "6")
    assert (rows[-1]["case"], rows[-1]["against"]) == ("theirs", "ours")


def _csv(path: Path) -> list[dict[str, str]]:
    head, *lines = path.read_text().splitlines()
    return [dict(zip(head.split(","), line.split(","), strict=True)) for line in lines]


def test_a_table_for_a_paper_needs_no_package(out: Path, tmp_path: Path) -> None:
    shown(out, "--out", str(tmp_path / "table.tex"))
    text = (tmp_path / "table.tex").read_text()
    assert text.count(r"\begin{tabular}") == text.count(r"\end{tabular}") == 3
    assert (
        r"vehicle.speed\_m\_s" in text and r"$\pm$" in text and "_" not in text.replace(r"\_", "")
    )
    for table in text.split(r"\begin{tabular}")[1:]:
        columns = len(table.partition("}")[0]) - 1
        lines = [line for line in table.splitlines() if line.endswith(r"\\")]
        assert len(lines) > 1 and all(line.count(" & ") == columns - 1 for line in lines)
    assert "\\&" not in text


def test_what_is_no_table_is_refused(out: Path, tmp_path: Path) -> None:
    answer = CliRunner().invoke(cli.app, ["show", str(out), "--out", str(tmp_path / "table.xlsx")])
    assert "give .csv, .tex or .parquet" in str(answer.exception)
    assert not (tmp_path / "table.xlsx").exists()


def test_a_table_that_is_there_is_kept_unless_forced(out: Path, tmp_path: Path) -> None:
    words = ["show", str(out), "--figure", FIGURE, "--out", str(tmp_path / "table.csv")]
    (tmp_path / "table.csv").write_text("mine")
    answer = CliRunner().invoke(cli.app, words)
    assert "is there already; give another --out, or --force" in str(answer.exception)
    assert (tmp_path / "table.csv").read_text() == "mine"
    answer = CliRunner().invoke(cli.app, [*words, "--force"])
    assert (answer.exit_code, (tmp_path / "table.csv").read_text() != "mine") == (0, True)
    # As `--figure` names it.
    assert FIGURE in answer.stdout


def test_the_terminal_says_what_intervals_are_over(out: Path) -> None:
    answer = CliRunner().invoke(cli.app, ["show", str(out), "--figure", FIGURE])
    lines = answer.stdout.splitlines()
    assert "mean ± half of its 95 % interval over 8 seeds, of these settings" in answer.stdout
    at = next(n for n, line in enumerate(lines) if line.startswith("case, beyond ours"))
    assert lines[at + 1].startswith("theirs") and "±" in lines[at + 1]


def test_one_seed_has_no_intervals_and_says_how_to_get_them(tmp_path: Path) -> None:
    out = written(tmp_path, text=TEXT.replace(f"seeds = {SEEDS}", "seeds = 1"))
    found = shown(out)
    assert all(each["figures"][FIGURE]["low"] is None for each in found["groups"])
    assert any("one seed" in each and "same --out" in each for each in found["notes"])


def test_cases_are_drawn_side_by_side(out: Path) -> None:
    rows = read_rows(out, [FIGURE])
    figure = pictures._responses(rows, groups_of(rows))
    assert figure is not None
    panels = figure.axes
    assert [axis.get_xlabel() for axis in panels] == ["case", "vehicle.speed_m_s"]
    assert panels[1].get_legend_handles_labels()[1] == list(CASES)


# ------------------------------------------------------------------------------------- more seeds


def few(seeds: str) -> str:
    return TEXT.replace(f"seeds = {SEEDS}", f"seeds = {seeds}")


def files(out: Path) -> dict[str, bytes]:
    return {path.relative_to(out).as_posix(): path.read_bytes() for path in out.glob("flights/*/*")}


def sorted_rows(out: Path) -> list[tuple[Any, ...]]:
    """Return the rows but for their numbers, in one order."""
    return sorted(
        tuple(value for name, value in each.items() if name != "flight" and value is not None)
        for each in parquet(out)
    )


@pytest.mark.parametrize(("first", "then"), [("3", "8"), ("[1, 2, 3]", "[1, 2, 3, 4, 5, 6, 7, 8]")])
def test_more_seeds_continue_a_campaign_and_leave_what_was_flown(
    tmp_path: Path, out: Path, first: str, then: str
) -> None:
    before = files(written(tmp_path, text=few(first)))
    again = written(tmp_path, text=few(then))
    after = files(again)
    assert before.items() <= after.items() and len(after) > len(before)
    assert sorted_rows(again) == sorted_rows(out)
    assert [each["flight"] for each in parquet(again)] == list(range(32))
    manifest = json.loads((again / "manifest.json").read_text())
    assert (manifest["seeds"], manifest["flights"], manifest["seed_blocks"]) == (8, 32, [3, 5])
    assert shown(again)["differences"] == shown(out)["differences"]


def test_seeds_are_added_again_and_to_what_was_broken_off(tmp_path: Path) -> None:
    out = written(tmp_path, text=few("3"))
    next(iter(sorted(out.glob("flights/*/*")))).unlink()
    written(tmp_path, text=few("4"))
    assert files(written(tmp_path, text=few("6"))) == files(written(tmp_path, text=few("6")))
    assert {(each["case"], each["seed"]) for each in parquet(out)} == {
        (case, seed) for case in CASES for seed in range(1, 7)
    }


def test_a_kill_between_the_two_files_of_a_continued_campaign_costs_nothing(
    tmp_path: Path,
) -> None:
    out = written(tmp_path, text=few("3"))
    manifest = (out / "manifest.json").read_bytes()
    written(tmp_path, text=few("4"))
    (out / "manifest.json").write_bytes(manifest)
    assert len(parquet(written(tmp_path, text=few("4")))) == 16


@pytest.mark.parametrize("then", ["2", "[2, 1, 3, 4]", "{first = 2, count = 5}"])
def test_other_seeds_do_not_continue_it(tmp_path: Path, then: str) -> None:
    written(tmp_path, text=few("3"))
    with pytest.raises(ConfigError, match="add seeds behind the others"):
        written(tmp_path, text=few(then))


def test_more_seeds_of_other_settings_do_not_continue_it(tmp_path: Path) -> None:
    written(tmp_path, text=few("3"))
    with pytest.raises(ConfigError, match="another campaign_sha256"):
        written(tmp_path, text=few("4").replace("6.0]", "7.0]"))
