from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pyogrio
import pytest
import shapely
import typer
from typer.testing import CliRunner

from companion.errors import MapError
from missions.maps.cli.new import GRID_EXAMPLE, NEW_EXAMPLE, grid, new
from missions.maps.csvfile import read_csv
from missions.maps.model import Grid
from missions.maps.text_map import read_text_map

app = typer.Typer(add_completion=False, rich_markup_mode=None)
app.command(epilog=NEW_EXAMPLE)(new)
app.command(epilog=GRID_EXAMPLE)(grid)

TEXT = (
    "--points", "11243", "--east-m", "314.2", "--north-m", "293", "--origin", "39.5,-0.4,50",
    "--rate-min", "10", "--rate-max", "13", "--seed", "1",
)  # fmt: skip
PLOTS = (
    "--rows", "4", "--columns", "10", "--plot-length-m", "12", "--plot-width-m", "6",
    "--rates", "14.5,15.4,16,17,18", "--seed", "1", "--origin", "-35.996,114.543",
)  # fmt: skip


def run(*arguments: object) -> str:
    """Return what a command prints on stdout, or raise what it raises."""
    done = CliRunner().invoke(app, [str(one) for one in arguments], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done.stdout


def refused(*arguments: object) -> str:
    """Return what a command says of wrong usage."""
    done = CliRunner().invoke(app, [str(one) for one in arguments], catch_exceptions=False)
    assert done.exit_code == 2
    return " ".join(done.stderr.split())


def run_json(*arguments: object) -> dict[str, Any]:
    found = json.loads(run(*arguments, "--json"))
    assert isinstance(found, dict)
    return found


@pytest.mark.parametrize(
    ("points", "east", "north", "table"),
    [
        (
            11243,
            (-167.0, 147.2),
            (-181.1, 111.9),
            {"cell_m": 3, "columns": 105, "rows": 98, "area_ha": 9.2, "points_per_ha": 1221},
        ),
        (
            2302,
            (-2.2, 478.1),
            (-28.2, 567.1),
            {"cell_m": 12, "columns": 41, "rows": 50, "area_ha": 28.59, "points_per_ha": 80},
        ),
    ],
    ids=["vineyard", "olives"],
)
def test_published_tables_come_out_of_a_file(
    tmp_path: Path,
    points: int,
    east: tuple[float, float],
    north: tuple[float, float],
    table: dict[str, float],
) -> None:
    path = tmp_path / "field.txt"
    made = run_json(
        "new", "--out", path, "--points", points, "--origin", "39.5,-0.4,50",
        "--east-m", round(east[1] - east[0], 1), "--north-m", round(north[1] - north[0], 1),
        "--east-min-m", east[0], "--north-min-m", north[0], "--rate-min", 10, "--rate-max", 13,
    )  # fmt: skip
    assert (made["kind"], made["points"], made["unit"]) == ("text", points, "L/min")
    assert (made["rates"][0], made["rates"][-1]) == (10.0, 13.0)
    found = run_json("grid", path, "--origin", "39.5,-0.4,50")
    assert found["points"] == points
    assert {name: found[name] for name in table} == table
    edges = {"east_min_m": east[0], "east_max_m": east[1]}
    edges |= {"north_min_m": north[0], "north_max_m": north[1]}
    assert {name: round(found[name], 1) for name in edges} == edges
    assert found["origin"] == [39.5, -0.4, 50.0]
    assert found["empty_cells"] == 0
    # The same table without an origin: sizes do not hang on it.
    first = run_json("grid", path)
    assert {name: first[name] for name in table} == table
    assert first["origin"][0] == pytest.approx(39.5 + north[0] / 111_000, abs=1e-4)


def test_same_call_makes_the_same_bytes_and_another_seed_another_field(tmp_path: Path) -> None:
    first, second, third = (tmp_path / f"{name}.txt" for name in "abc")
    shas = [run_json("new", "--out", path, *TEXT)["sha256"] for path in (first, second)]
    run("new", "--out", third, *TEXT[:-1], "2")
    assert first.read_bytes() == second.read_bytes() != third.read_bytes()
    assert shas[0] == shas[1] == read_text_map(first).sha256


def test_grid_prints_a_table_and_warnings_apart_from_it(tmp_path: Path) -> None:
    path = tmp_path / "field.txt"
    run("new", "--out", path, *TEXT)
    done = CliRunner().invoke(app, ["grid", str(path)], catch_exceptions=False)
    for line in ("cell          3 m", "columns (H)   105", "rows (V)      98", "9.2 ha", "(max)"):
        assert line in done.stdout
    assert "warning:" not in done.stdout
    assert "hold points of different rates; the largest is taken" in done.stderr


@pytest.mark.parametrize(
    ("merge", "rate"), [("max", 40.0), ("average", 27.5), ("mean", 70.0 / 3.0)]
)
def test_merge_policies(tmp_path: Path, merge: str, rate: float) -> None:
    path = tmp_path / "one.txt"
    rows = "".join(f"39.5000000\t-0.4000000\t5\t{value}\n" for value in (10, 20, 40))
    path.write_text(f"3\n{rows}", "utf-8")
    found = run_json("grid", path, "--merge", merge)
    assert found["merge"] == merge
    assert found["rates_l_min"] == pytest.approx([rate, rate])
    assert (found["rows"], found["columns"], found["points_per_ha"]) == (1, 1, None)
    assert found["mixed_cells"] == 1


def test_cells_are_written_as_points_that_read_back_as_the_same_cells(tmp_path: Path) -> None:
    path, out = tmp_path / "field.txt", tmp_path / "cells.csv"
    run("new", "--out", path, *TEXT)
    assert run_json("grid", path, "--cell-m", 5, "--out", out)["out"] == str(out)
    back = read_csv(out)
    assert isinstance(back, Grid)
    assert back.problems == ()
    expected = read_text_map(path, cell_m=5).bands[0].values
    bands = {band.name: band.values for band in back.bands}
    assert (bands["rate_l_min"] == expected).all()
    assert bands["column"][0].tolist() == list(range(1, 64))
    with pytest.raises(MapError) as caught:
        run("grid", path, "--out", out)
    assert caught.value.code == "file-exists"
    run("grid", path, "--out", out, "--force")
    with pytest.raises(MapError) as caught:
        run("grid", path, "--out", tmp_path / "cells.shp")
    assert caught.value.code == "unknown-format"


def test_plots_are_made_in_a_format_of_the_suffix(tmp_path: Path) -> None:
    path = tmp_path / "plots.geojson"
    made = run_json("new", "--out", path, *PLOTS)
    assert made["zones"] == 40
    assert made["area_ha"] == pytest.approx(0.288)
    assert made["rates"] == [14.5, 15.4, 16.0, 17.0, 18.0]
    meta, _, geometry, columns = pyogrio.raw.read(str(path))
    rates = dict(zip(meta["fields"].tolist(), columns, strict=True))["rate"].tolist()
    assert sorted(rates) == sorted([14.5, 15.4, 16.0, 17.0, 18.0] * 8)
    assert rates[:5] != [14.5, 15.4, 16.0, 17.0, 18.0]
    west, south, east, north = shapely.total_bounds(shapely.from_wkb(geometry))
    assert (west, south) == pytest.approx((114.543, -35.996), abs=1e-8)
    assert (north - south) * 110_950 == pytest.approx(24.0, abs=0.1)
    assert (east - west) * 90_170 == pytest.approx(120.0, abs=0.1)


def test_a_file_is_not_overwritten_unasked(tmp_path: Path) -> None:
    path = tmp_path / "field.txt"
    path.write_text("mine", "utf-8")
    with pytest.raises(MapError) as caught:
        run("new", "--out", path, *TEXT)
    assert caught.value.code == "file-exists"
    assert path.read_text("utf-8") == "mine"
    run("new", "--out", path, *TEXT, "--force")
    assert path.read_text("utf-8").startswith("11243\n")


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("new", "--out", "x.txt", *PLOTS), "a text map (.txt) has no --rows"),
        (("new", "--out", "x.geojson", *TEXT), "a map of plots has no --points"),
        (("new", "--out", "x.txt", *TEXT[:2], *TEXT[6:8]), "needs --east-m, --north-m"),
        (("new", "--out", "x.txt", *TEXT, "--origin", "139.5,-0.4"), "the latitude first"),
        (("new", "--out", "x.txt", *TEXT, "--origin", "north"), "write numbers"),
        (("new", "--out", "x.txt", *TEXT, "--points", "3"), "4 to 1000000 points"),
        (("new", "--out", "x.geojson", *PLOTS, "--rates", "a,b"), "--rates is 'a,b'"),
        (("new", "--out", "x.geojson", *PLOTS, "--rates", "-5"), "0 or more"),
        (("new", "--out", "x.geojson", *PLOTS, "--rows", "0"), "1 to 100000 plots"),
        (("grid", "x.txt", "--merge", "sum"), "take one of max, average, mean"),
        (("grid", "x.txt", "--origin", "1"), "LAT,LON,ALT"),
        (("grid", "x.txt", "--cell-m", "0"), "--cell-m"),
    ],
)
def test_wrong_usage_says_what_is_wanted(
    arguments: tuple[str, ...], says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert says in refused(*arguments)
    assert not list(tmp_path.iterdir())


def test_the_examples_run_as_they_are_printed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    lines = f"{NEW_EXAMPLE.removeprefix('Examples: ')} | {GRID_EXAMPLE.removeprefix('Example: ')}"
    commands = [line.split() for line in lines.split(" | ")]
    assert [words[:3] for words in commands] == [
        ["vrspray", "map", command] for command in ("new", "new", "grid")
    ]
    printed = [run(*words[2:]) for words in commands]
    assert sorted(file.name for file in tmp_path.iterdir()) == ["field.txt", "plots.geojson"]
    found = json.loads(printed[-1])
    assert (found["points"], found["merge"]) == (2302, "mean")
    # Both have the same origin, the south-west corner.
    assert found["origin"] == [37.85, -4.8, 120.0]
    edges = [found[name] for name in ("east_min_m", "north_min_m", "east_max_m", "north_max_m")]
    assert edges == pytest.approx([0.0, 0.0, 480.3, 595.3], abs=0.1)


def test_unreadable_map_is_a_map_error(tmp_path: Path) -> None:
    with pytest.raises(MapError, match="no such file"):
        run("grid", tmp_path / "none.txt")


@pytest.mark.parametrize("command", ["new", "grid"])
def test_help_ends_with_an_example(command: str) -> None:
    assert f"vrspray map {command} " in run(command, "--help")
