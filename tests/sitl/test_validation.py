"""The twin flies P1's lag distances, and the accuracy by rate is that of the flights."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from analysis.dose import (
    RateAccuracy,
    accuracy_by_rate,
    flow_accuracy,
)
from analysis.evaluation import Distances
from analysis.published import (
    P1_RATES_L_HA,
    P1_SPRAYING_ACCURACY_PERCENT,
    P1LagDistance,
    p1_lag_distance_m,
)
from analysis.strips import strips_of
from companion.errors import ConfigError
from sitl.anyang import demo_setup, demo_trajectory
from sitl.campaign.dataset import read_columns
from sitl.campaign.design import read_campaign
from sitl.campaign.flying import fly_flight
from sitl.demo import PROFILE
from sitl.flight import FlightOptions, fly
from sitl.profile import load_profile
from tests.sitl.campaign_files import fly_here
from tools.studies import validation, validation_flights
from tools.studies.validation_flights import (
    BOUND_M,
    BOUND_METHODS,
    EVERY_WAY,
    SPEEDS_M_S,
    Flown,
    FlownMethod,
    Row,
    Validation,
    pooled,
    pooled_by_rate,
    pooled_percent,
    validate,
)

CAMPAIGN = Path(__file__).parents[2] / "examples" / "campaigns" / "validation.toml"
SEEDS = (4, 5)
SPEED_M_S = 5.0
NONE, LOOK_AHEAD = FlownMethod(method="none"), FlownMethod(method="look-ahead")
CHANGES = 36  # forty plots in four passes


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two cases of the campaign that is shipped, at one speed, of two seeds."""
    folder = tmp_path_factory.mktemp("validation")
    head, *cases = CAMPAIGN.read_text(encoding="utf-8").split("[[case]]\n")
    head = head.replace("seeds = 20", f"seeds = {list(SEEDS)}").replace("4.0, 5.0, 6.0", "5.0")
    text = "[[case]]\n".join([head, *cases[:2]])
    (folder / "some.toml").write_text(text, encoding="utf-8")
    fly_here(folder / "some.toml", folder / "flown")
    return folder / "flown"


@pytest.fixture(scope="module")
def result(flown: Path) -> Validation:
    return validate(flown)


def rows_of(percent: float, samples: int, rate_l_ha: float | None = 10.0) -> RateAccuracy:
    return RateAccuracy(rate_l_ha=rate_l_ha, percent=percent, samples=samples)


@pytest.mark.parametrize("way", [NONE, LOOK_AHEAD])
def test_the_means_at_5_m_s_are_within_0_3_m_of_the_published_ones(
    result: Validation, way: FlownMethod
) -> None:
    published = p1_lag_distance_m(way.method, SPEED_M_S)
    lag = result.row(way, SPEED_M_S).settled
    assert published is not None
    assert lag.all_m.mean == pytest.approx(published.mean, abs=0.3)
    # At the jumps of Eq. 2 (see test_wang) a change may not settle; by the table every one does.
    assert lag.all_m.count + lag.missed == CHANGES * len(SEEDS)
    assert lag.missed <= 2


def test_the_bounds_are_held_and_said_to_be(result: Validation) -> None:
    assert result.bounds() == dict.fromkeys(BOUND_METHODS, True)
    assert result.as_json()["valid"] is True


def shifted(result: Validation, mean_m: float | None) -> Validation:
    """Return the same with another mean of `none`."""
    row = result.row(NONE, SPEED_M_S)
    other = replace(
        row, settled=replace(row.settled, all_m=replace(row.settled.all_m, mean=mean_m))
    )
    return replace(result, rows=(other, result.row(LOOK_AHEAD, SPEED_M_S)))


@pytest.mark.parametrize("mean_m", [3.87 + 1.01 * BOUND_M, 3.87 - 1.01 * BOUND_M, math.nan, None])
def test_a_mean_beyond_the_bound_or_missing_is_not_valid(
    result: Validation, mean_m: float | None
) -> None:
    found = shifted(result, mean_m)
    assert found.bounds() == {"none": False, "look-ahead": True}
    assert found.as_json()["valid"] is False


def test_without_flights_at_the_bound_speed_nothing_is_valid() -> None:
    assert Validation(seeds=(1,), rows=()).bounds() == dict.fromkeys(BOUND_METHODS, False)


def test_the_table_has_the_published_rates_and_each_is_flown_equally_long(
    result: Validation,
) -> None:
    for row in result.rows:
        assert [each.rate_l_ha for each in row.by_rate] == list(P1_RATES_L_HA)
        assert None not in row.cells_percent()
        samples = [each.samples for each in row.by_rate]
        # Four plots of 12 m at 5 m/s every 10 ms, in gusts; at the border strips must be inside.
        assert min(samples) == pytest.approx(len(SEEDS) * 960, rel=0.05)
        assert max(samples) == pytest.approx(len(SEEDS) * 960, rel=0.05)


def test_the_campaign_that_is_shipped_has_every_method_at_the_published_rates_and_speeds() -> None:
    campaign = read_campaign(CAMPAIGN)
    assert [name for name, _ in campaign.cases] == [way.name for way in EVERY_WAY]
    assert campaign.factors[0].values == SPEEDS_M_S and len(campaign.seeds) == 20
    assert campaign.fixed == {"flight.fidelity": "pulsed", "map.rates": "as-published"}


def test_the_rates_are_the_published_ones_at_every_speed(tmp_path: Path) -> None:
    settings = (("map.rates", "as-published"), ("vehicle.speed_m_s", 6.0))
    row = fly_flight(settings, 1, tmp_path).figures
    assert row["rate_l_ha"] == list(P1_RATES_L_HA)


def test_rates_weighted_by_their_samples_are_the_accuracy_of_the_whole_flight(flown: Path) -> None:
    rows = read_columns(flown, None).to_pylist()
    assert len(rows) == 2 * len(SEEDS)
    for row in rows:
        whole = row["spraying_accuracy_percent"]
        assert pooled_percent(Flown(row=row).by_rate) == pytest.approx(whole, abs=1e-9)


def test_distances_of_several_flights_are_those_of_one_that_has_them_all() -> None:
    first, second, none = [0.1, -0.3], [0.2, 0.4, -0.1], []
    together = pooled(Distances.of(values) for values in (first, none, second))
    assert asdict(together) == pytest.approx(asdict(Distances.of([*first, *second])))
    assert pooled([Distances.of([])]).count == 0


def test_flights_weighted_by_their_samples_are_the_accuracy_of_all(result: Validation) -> None:
    row = result.row(NONE, SPEED_M_S)
    assert pooled_percent(row.by_rate) == row.accuracy_percent
    assert row.seed_accuracy_percent[0] < row.accuracy_percent < row.seed_accuracy_percent[1]


def test_strips_over_several_rates_have_a_row_of_their_own() -> None:
    record = fly(
        demo_setup(SPEED_M_S),
        demo_trajectory(SPEED_M_S, 1),
        load_profile(PROFILE),
        FlightOptions(fidelity="averaged"),
        speed_m_s=SPEED_M_S,
    ).record
    # Three metres to the side, every pass lies over the plots of two rows.
    strips = strips_of(replace(record, east_m=record.east_m - 3.0))
    rows = accuracy_by_rate(strips)
    assert rows[-1].rate_l_ha is None
    assert rows[-1].samples > sum(row.samples for row in rows[:-1])
    whole = flow_accuracy(strips).all_percent
    assert pooled_percent(rows) == pytest.approx(whole, abs=1e-9)


def test_pooling_weighs_by_samples_and_keeps_rates_apart() -> None:
    first = [rows_of(90.0, 1), rows_of(50.0, 2, rate_l_ha=None)]
    second = [rows_of(98.0, 3), rows_of(80.0, 5, rate_l_ha=5.0)]
    assert pooled_by_rate([first, second]) == (
        rows_of(80.0, 5, rate_l_ha=5.0),
        rows_of(96.0, 4),
        rows_of(50.0, 2, rate_l_ha=None),
    )
    assert pooled_percent([]) is None


def test_compensation_pays(result: Validation) -> None:
    none, compensated = (result.row(way, SPEED_M_S) for way in (NONE, LOOK_AHEAD))
    assert compensated.accuracy_percent > none.accuracy_percent + 8.0
    assert none.accuracy_percent < min(P1_SPRAYING_ACCURACY_PERCENT[SPEED_M_S])


def test_settled_lags_are_summed_up_by_rate_and_by_flight(result: Validation) -> None:
    lag = result.row(NONE, SPEED_M_S).settled
    assert lag.seed_means_m is not None and lag.all_m.mean is not None
    assert len(lag.rate_means_m) == len(P1_RATES_L_HA)
    assert lag.seed_means_m[0] < lag.all_m.mean < lag.seed_means_m[1]
    assert min(lag.rate_means_m) < lag.all_m.mean < max(lag.rate_means_m)


def full(result: Validation) -> Validation:
    """Return rows of all methods and speeds; the figures are those of two."""
    rows = []
    for speed_m_s in SPEEDS_M_S:
        for way in EVERY_WAY:
            row = result.row(NONE if way == NONE else LOOK_AHEAD, SPEED_M_S)
            published = p1_lag_distance_m(way.method, speed_m_s)
            rows.append(replace(row, way=way, speed_m_s=speed_m_s, published=published))
    return replace(result, rows=tuple(rows))


def test_page_and_pictures_show_every_method_beside_the_published(
    result: Validation, tmp_path: Path
) -> None:
    validation.check_folder(tmp_path)
    validation.write_all(
        full(result), tmp_path, command="python -m tools.studies.validation --seeds 2"
    )
    page = (tmp_path / "validation.md").read_text(encoding="utf-8")
    for way in EVERY_WAY:
        tables = 4 if way.method == "look-ahead" else 3
        assert page.count(f"| {way.name} |") == tables * len(SPEEDS_M_S)
    assert "Made by `python -m tools.studies.validation --seeds 2`" in page
    assert "| 3.87 | 3.50 to 4.30 |" in page and "| 0.32 | -0.27 to 0.78 |" in page
    for published in P1_SPRAYING_ACCURACY_PERCENT.values():
        assert " | ".join(f"{cell:.2f}" for cell in published) in page
    for name in ("validation.png", "validation-accuracy.png"):
        assert f"](images/{name})" in page
        assert (tmp_path / "images" / name).read_bytes().startswith(b"\x89PNG")


def test_the_page_in_docs_says_what_the_code_says() -> None:
    docs = Path(__file__).parents[2] / "docs" / "measurements"
    page = (docs / "validation.md").read_text(encoding="utf-8")
    for name in (
        "INTRODUCTION", "LAG_TEXT", "OURS_TEXT", "CLOSE_TEXT", "ACCURACY_TEXT", "EQ_2_TEXT",
    ):  # fmt: skip
        assert getattr(validation_flights, name) in page, name
    assert "seeds 1 to 20" in page


def run(
    monkeypatch: pytest.MonkeyPatch, found: Validation, *arguments: str
) -> tuple[int, str, BaseException | None]:
    monkeypatch.setattr(validation, "validate", lambda _: found)
    outcome = CliRunner().invoke(validation.app, ["flown", *arguments])
    return outcome.exit_code, outcome.stdout, outcome.exception


def test_json_is_one_object_with_what_is_published(
    monkeypatch: pytest.MonkeyPatch, result: Validation
) -> None:
    code, text, _ = run(monkeypatch, result, "--json")
    found = json.loads(text)
    assert (code, found["valid"], found["flights"]) == (0, True, 4)
    assert found["published"]["spraying_accuracy_percent"]["mean"] == 94.77
    assert found["rows"][0]["by_rate"][0]["rate_l_ha"] == 14.5


def test_a_twin_beyond_its_bounds_is_a_failure_but_shows_its_figures(
    monkeypatch: pytest.MonkeyPatch, result: Validation
) -> None:
    code, text, error = run(monkeypatch, shifted(result, 4.5), "--json")
    assert code == 1 and "not within" in str(error)
    assert json.loads(text)["within_bound"] == {"none": False, "look-ahead": True}


def test_a_folder_that_cannot_be_made_is_refused_before_flying(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="cannot be made"):
        validation.check_folder(tmp_path / "file")


def test_rows_without_a_published_figure_have_none(result: Validation) -> None:
    row: Row = replace(result.row(NONE, SPEED_M_S), published=None)
    empty = replace(row.settled, all_m=Distances.of([]), rate_means_m=(), seed_means_m=None)
    shown = replace(result, rows=(replace(row, settled=empty),))
    lines = validation_flights.summary_lines(shown)
    assert "none at 5 m/s within 0.3 m of P1: NO" in lines
    assert lines[1].split()[-2:] == ["-", "-"]
    assert isinstance(p1_lag_distance_m("none", SPEED_M_S), P1LagDistance)
