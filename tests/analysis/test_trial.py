"""Trials: rates of plots on a flight worked out by hand, means against the textbook's formulas."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import shapely

from analysis.strips import strips_of
from analysis.student import f_above, t_factor
from analysis.trial import (
    Errors,
    Plot,
    Tolerance,
    achieved,
    half_intervals,
    plot_means,
    treatment_means,
)
from analysis.trial_cli import TrialError, read_harvest, read_trial
from tests.analysis.report_flight import fly

RATES = (10.0, 20.0, 30.0)
# Blocks by treatments, made up.
YIELDS = np.array([[5.1, 6.0, 6.8], [4.7, 5.9, 6.1], [5.6, 6.1, 7.0], [5.0, 6.3, 6.6]])


def means(table: np.ndarray, check: float | None = None) -> dict[str, object]:
    rows = [(b, t) for b in range(4) for t in range(3) if np.isfinite(table[b, t])]
    found = treatment_means(
        [RATES[t] for _, t in rows], [b + 1 for b, _ in rows], [table[b, t] for b, t in rows], check
    )
    assert found is not None
    return found


def test_whole_blocks_have_the_means_of_the_textbook() -> None:
    found = means(YIELDS, check=10.0)
    grand = YIELDS.mean()
    rest = YIELDS - YIELDS.mean(axis=0) - YIELDS.mean(axis=1)[:, None] + grand
    variance = (rest**2).sum() / 6
    half = t_factor(6) * np.sqrt(variance / 4)
    for at, one in enumerate(found["treatments"]):  # type: ignore[arg-type]
        middle = YIELDS[:, at].mean()
        assert (one["value"], one["low"], one["high"]) == pytest.approx(
            (middle, middle - half, middle + half)
        )
        assert one["plots"] == 4
    between = 4 * ((YIELDS.mean(axis=0) - grand) ** 2).sum() / 2
    assert found["p_value"] == pytest.approx(f_above(between / variance, 2, 6))
    wide = t_factor(6) * np.sqrt(2 * variance / 4)
    for at, one in enumerate(found["against_check"], 1):  # type: ignore[arg-type]
        step = YIELDS[:, at].mean() - YIELDS[:, 0].mean()
        assert (one["value"], one["low"], one["high"]) == pytest.approx(
            (step, step - wide, step + wide)
        )


def test_a_plot_that_is_left_out_is_made_up_for_as_yates_did() -> None:
    table = YIELDS.copy()
    table[1, 2] = np.nan
    # Yates (1933): (t T + b B - G) / ((t - 1)(b - 1)) of what is left.
    block, treatment, every = np.nansum(table[1]), np.nansum(table[:, 2]), np.nansum(table)
    whole = table.copy()
    whole[1, 2] = (3 * treatment + 4 * block - every) / (2 * 3)
    found = means(table)
    values = [one["value"] for one in found["treatments"]]  # type: ignore[attr-defined]
    assert values == pytest.approx(whole.mean(axis=0))
    assert found["degrees_of_freedom"] == 5


def test_too_few_plots_are_not_compared() -> None:
    assert treatment_means([1.0, 2.0], [1, 1], [3.0, 4.0], None) is None
    assert treatment_means([1.0, 2.0, 1.0], [1, 1, 2], [3.0, 4.0, 5.0], None) is None


def test_harvest_points_count_where_they_lie_inside() -> None:
    plots = [
        Plot(number=1, block=1, rate_l_ha=10.0, inner=shapely.box(0, 0, 10, 10)),
        Plot(number=2, block=1, rate_l_ha=20.0, inner=shapely.box(20, 0, 30, 10)),
    ]
    points = np.array([[1.0, 1.0], [9.0, 9.0], [15.0, 5.0]])
    assert plot_means(plots, points, np.array([4.0, 6.0, 100.0])) == [(2, 5.0), (0, None)]


@pytest.fixture(scope="module")
def strips(tmp_path_factory: pytest.TempPathFactory) -> list[object]:
    from analysis.flown.applied_record import record_of
    from analysis.flown.read_applied import read_applied

    return list(strips_of(record_of(read_applied(fly(tmp_path_factory.mktemp("trial"))))))


def plot_under(strips: list[object], low: float, high: float, rate: float) -> Plot:
    """Return a plot under the middle valves' strips while they lie from `low` to `high` metres."""
    track = strips[0].track  # type: ignore[attr-defined]
    far = track.distance_m - track.distance_m[0]
    part = (far >= low) & (far <= high)
    east, north = track.east_m[part], track.north_m[part]
    line = shapely.LineString(np.column_stack([east, north])[[0, -1]])
    inner = shapely.buffer(line, 0.4 * track.width_m, cap_style="flat")
    return Plot(number=1, block=1, rate_l_ha=rate, inner=inner)


def test_a_plots_rate_is_the_volume_on_its_ground(strips: list[object]) -> None:
    tolerance = Tolerance(rate_percent=10.0, covered_percent=90.0)
    plot = plot_under(strips, 14.0, 20.0, 20.0)
    track = strips[0].track  # type: ignore[attr-defined]
    far = track.distance_m - track.distance_m[0]
    ml = float(np.interp(20.0, far, track.volume_ml) - np.interp(14.0, far, track.volume_ml))
    by_hand = ml / 1000.0 / (6.0 * track.width_m) * 1e4
    (found,) = achieved([plot], strips[:1], tolerance)  # type: ignore[arg-type]
    assert by_hand > 1.0
    assert found.rate_l_ha == pytest.approx(by_hand, rel=0.03)
    assert found.covered_percent == pytest.approx(100.0, abs=1.0)
    # Flown twice it gets twice as much, and that is no valid plot.
    (twice,) = achieved([plot], [strips[0], strips[0]], tolerance)  # type: ignore[list-item]
    assert twice.rate_l_ha == pytest.approx(2.0 * found.rate_l_ha)
    assert any("times" in one for one in twice.reasons)


def test_the_interval_of_a_plot_is_of_place_lag_and_meter(strips: list[object]) -> None:
    tolerance = Tolerance(rate_percent=10.0, covered_percent=90.0)
    found = achieved([plot_under(strips, 14.0, 20.0, 20.0)], strips[:1], tolerance)  # type: ignore[arg-type]

    def half(**errors: float) -> float:
        given = {"position_m": 0.0, "lag_s": 0.0, "speed_m_s": 5.0, "meter_percent": 0.0}
        (one,) = half_intervals(found, strips[:1], Errors(**given | errors))  # type: ignore[arg-type]
        return one

    meter = half(meter_percent=3.0)
    assert meter == pytest.approx(1.96 * 0.03 * found[0].rate_l_ha)
    assert half() == 0.0
    # A strip 1 m wide covers the plot's 0.8 m: moved by 0.6 m across it leaves half of it dry.
    assert half(position_m=0.6) > 1.96 * 0.3 * found[0].rate_l_ha
    assert half(position_m=0.02) < half(position_m=0.3) < half(position_m=0.6)
    assert half(lag_s=0.12) == pytest.approx(half(position_m=0.6))
    assert half(position_m=0.6, meter_percent=3.0) == pytest.approx(
        np.hypot(half(position_m=0.6), meter)
    )


def test_a_plot_that_nobody_flew_over_fails_unless_it_gets_nothing(strips: list[object]) -> None:
    tolerance = Tolerance(rate_percent=10.0, covered_percent=90.0)
    for rate, fails in ((20.0, True), (0.0, False)):
        plot = Plot(number=1, block=1, rate_l_ha=rate, inner=shapely.box(900, 900, 910, 910))
        (found,) = achieved([plot], strips, tolerance)  # type: ignore[arg-type]
        assert found.rate_l_ha == 0.0
        assert bool(found.reasons) is fails


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("{}", "this is not a trial"),
        ("[1]", "this is not a trial"),
        (json.dumps({"trial": {"version": 9}, "features": []}), "version 9"),
        (json.dumps({"trial": {"version": 1}, "features": []}), "no plots"),
    ],
)
def test_what_is_no_trial_is_refused(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "x.trial.geojson"
    path.write_text(text)
    with pytest.raises(TrialError, match=said):
        read_trial(path)


def test_harvests_are_read_from_csv_and_shapefile(tmp_path: Path) -> None:
    import shapefile

    table = tmp_path / "harvest.csv"
    table.write_text("Lon;Lat;Yield\n16.9;48.2;5.5\n16.8;48.1;\n")
    latitude, longitude, values = read_harvest(table, "yield")
    assert (latitude.tolist(), longitude.tolist(), values.tolist()) == ([48.2], [16.9], [5.5])
    with shapefile.Writer(str(tmp_path / "harvest.shp"), shapeType=shapefile.POINT) as writer:
        writer.field("yield", "N", decimal=2)
        writer.point(16.9, 48.2)
        writer.record(5.5)
    again = read_harvest(tmp_path / "harvest.shp", "yield")
    assert [one.tolist() for one in again] == [[48.2], [16.9], [5.5]]
    with pytest.raises(TrialError, match="no column mass"):
        read_harvest(tmp_path / "harvest.shp", "mass")
    with pytest.raises(TrialError, match="needs columns lat, lon and mass"):
        read_harvest(table, "mass")
    table.write_text("lat,lon,yield\n48,x,5\n")
    with pytest.raises(TrialError, match="line 2: no numbers"):
        read_harvest(table, "yield")
