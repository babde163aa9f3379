"""Maps that are made up: points within ranges, and plots in rows."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import shapely

from companion.core.frame import LocalFrame
from missions.maps.cli.new import Plots, Points, make_plots, make_points, plot_rates
from missions.maps.text_map import grid_of_points
from missions.maps.text_points import MAX_POINTS, parse_text_map, text_of

ORIGIN = (39.5, -0.4, 50.0)


@pytest.mark.parametrize("count", [4, 5, 100, 2302])
@pytest.mark.parametrize("ranges", [(480.3, 595.3), (1000.0, 10.0), (7.7, 300.0)])
def test_points_fill_their_ranges_and_rates(count: int, ranges: tuple[float, float]) -> None:
    wanted = Points(
        origin=ORIGIN, count=count, east_range_m=ranges[0], north_range_m=ranges[1],
        east_min_m=-2.2, north_min_m=-28.2, rate_min_l_min=15.0, rate_max_l_min=45.0, seed=3,
    )  # fmt: skip
    text = text_of(make_points(wanted))
    made = parse_text_map(text.encode(), Path("x.txt"))
    layout = grid_of_points(made, Path("x.txt"), origin=ORIGIN).layout
    assert made.count == layout.points == count
    assert layout.east_min_m == pytest.approx(-2.2, abs=1e-4)
    assert layout.east_max_m == pytest.approx(-2.2 + ranges[0], abs=1e-4)
    assert layout.north_min_m == pytest.approx(-28.2, abs=1e-4)
    assert layout.north_max_m == pytest.approx(-28.2 + ranges[1], abs=1e-4)
    assert (made.rate_l_min.min(), made.rate_l_min.max()) == (15.0, 45.0)
    assert text == text_of(make_points(wanted))


@pytest.mark.parametrize(("count", "east", "north"), [(11243, 314.2, 293.0), (2302, 480.3, 595.3)])
def test_generated_points_leave_no_cell_empty(count: int, east: float, north: float) -> None:
    wanted = Points(
        origin=ORIGIN, count=count, east_range_m=east, north_range_m=north,
        rate_min_l_min=10.0, rate_max_l_min=13.0,
    )  # fmt: skip
    grid = grid_of_points(make_points(wanted), Path("x.txt"), origin=ORIGIN)
    assert not np.isnan(grid.rates_l_min).any()


@pytest.mark.parametrize(
    "wrong",
    [
        {"count": 3},
        {"count": MAX_POINTS + 1},
        {"east_range_m": 0.0},
        {"north_range_m": math.inf},
        {"east_min_m": math.nan},
        {"rate_min_l_min": -1.0},
        {"rate_max_l_min": 5.0},
    ],
)
def test_points_that_cannot_be_are_refused(wrong: dict[str, float]) -> None:
    usual = {
        "count": 10, "east_range_m": 10.0, "north_range_m": 10.0, "rate_min_l_min": 10.0,
        "rate_max_l_min": 20.0,
    }  # fmt: skip
    with pytest.raises(ValueError, match=r"map|rates"):
        Points(origin=ORIGIN, **(usual | wrong))  # type: ignore[arg-type]


@pytest.mark.parametrize("angle", [0.0, 30.0, 90.0, 200.0])
def test_plots_have_their_size_gap_and_direction(angle: float) -> None:
    wanted = Plots(
        origin=(-33.9, 18.4), rows=3, columns=4, length_m=12.0, width_m=6.0, gap_m=1.5,
        rates_l_ha=(1.0, 2.0), angle_deg=angle,
    )  # fmt: skip
    made = make_plots(wanted, Path("p.geojson"), map_format="geojson")
    frame = LocalFrame(latitude_deg=-33.9, longitude_deg=18.4)
    ground = [
        shapely.Polygon([frame.to_local(y, x) for x, y in shapely.get_coordinates(zone.geometry)])
        for zone in made.zones
    ]
    assert [zone.name for zone in made.zones[:5]] == ["r1c1", "r1c2", "r1c3", "r1c4", "r2c1"]
    assert all(one.area == pytest.approx(72.0, abs=1e-4) for one in ground)
    first, next_along, next_row = (ground[i].centroid for i in (0, 1, 4))
    along = np.array([next_along.x - first.x, next_along.y - first.y])
    across = np.array([next_row.x - first.x, next_row.y - first.y])
    heading = math.radians(angle)
    expected = 13.5 * np.array([math.sin(heading), math.cos(heading)])
    np.testing.assert_allclose(along, expected, atol=1e-4)
    np.testing.assert_allclose(
        across, 7.5 * np.array([-math.cos(heading), math.sin(heading)]), atol=1e-4
    )


def test_rates_of_plots_go_in_turn_and_are_shuffled_in_blocks_by_a_seed() -> None:
    usual = {
        "origin": (0.0, 0.0), "rows": 4, "columns": 5, "length_m": 1.0, "width_m": 1.0,
        "rates_l_ha": (1.0, 2.0, 3.0, 4.0, 5.0),
    }  # fmt: skip
    plain = plot_rates(Plots(**usual))  # type: ignore[arg-type]
    assert plain == [1.0, 2.0, 3.0, 4.0, 5.0] * 4
    drawn = plot_rates(Plots(**usual, seed=1))  # type: ignore[arg-type]
    assert drawn == plot_rates(Plots(**usual, seed=1))  # type: ignore[arg-type]
    assert drawn != plain
    for start in range(0, 20, 5):
        assert sorted(drawn[start : start + 5]) == [1.0, 2.0, 3.0, 4.0, 5.0]


@pytest.mark.parametrize(
    "wrong",
    [
        {"rows": 0},
        {"rows": 400, "columns": 400},
        {"length_m": 0.0},
        {"gap_m": -1.0},
        {"angle_deg": math.inf},
        {"rates_l_ha": ()},
        {"rates_l_ha": (math.nan,)},
        {"columns": 10_000, "length_m": 10.0},
    ],
)
def test_plots_that_cannot_be_are_refused(wrong: dict[str, object]) -> None:
    usual = {
        "origin": (0.0, 0.0), "rows": 2, "columns": 2, "length_m": 1.0, "width_m": 1.0,
        "rates_l_ha": (1.0,),
    }  # fmt: skip
    with pytest.raises(ValueError, match=r"plot|direction"):
        Plots(**(usual | wrong))  # type: ignore[arg-type]
