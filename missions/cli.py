"""`vrspray plan`: from a field and its prescription to mission files."""

from __future__ import annotations

import math
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any, Literal

import typer

from companion.cli.answer import AsJson, answer, note
from companion.cli.map_grid import parse_mark
from companion.config import load
from missions.files.write import check_suffix, write_plan
from missions.picture import check_picture, draw_plan
from missions.plan import Plan
from missions.planner import plan_mission
from missions.reading import Asked, names_of, read_task

# Attempted moves of the search: about one second, ten, and a minute on an old laptop.
MOVES = {"quick": 40_000, "good": 300_000, "best": 2_000_000}

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)


@app.command(
    epilog="Example: vrspray plan examples/anyang/boundary.geojson "
    "--config examples/anyang/config.toml --out field.plan"
)
def plan(
    field: Annotated[
        Path, typer.Argument(metavar="FIELD", help="Outline, with holes, in any map format.")
    ],
    out: Annotated[
        Path, typer.Option("--out", metavar="FILE", help=".plan, .waypoints, .geojson or .kml.")
    ],
    prescription: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Map of rates, for the litres.")
    ] = None,
    config: Annotated[
        Path | None, typer.Option("--config", metavar="FILE", help="Of the flight: [mission].")
    ] = None,
    obstacle: Annotated[
        list[Path] | None, typer.Option(metavar="FILE", help="Not to be flown over; repeat it.")
    ] = None,
    no_spray: Annotated[
        list[Path] | None, typer.Option(metavar="FILE", help="Not to be sprayed; repeat it.")
    ] = None,
    no_spray_buffer_m: Annotated[
        float, typer.Option(metavar="M", help="Kept from it.", min=0.0, max=1000.0)
    ] = 0.0,
    depot: Annotated[
        list[str] | None, typer.Option(metavar="LAT,LON", help="Refill place; repeat it.")
    ] = None,
    swath_m: Annotated[float | None, typer.Option(metavar="M", help="Spacing of passes.")] = None,
    speed_m_s: Annotated[float | None, typer.Option(metavar="V", help="In the passes.")] = None,
    speed_max_m_s: Annotated[
        float | None,
        typer.Option(metavar="V", help="Where rates are too low for the valves, up to this."),
    ] = None,
    angle_deg: Annotated[
        float | None, typer.Option(metavar="DEG", help="Course of the passes; else the best.")
    ] = None,
    rate_l_ha: Annotated[
        float | None, typer.Option(metavar="R", help="One rate for all, in place of a map.")
    ] = None,
    tank_l: Annotated[float | None, typer.Option(metavar="L", help="Full tank.")] = None,
    effort: Annotated[
        Literal["quick", "good", "best"], typer.Option(help="How long to look for short ferries.")
    ] = "quick",
    sprayer: Annotated[
        bool, typer.Option("--sprayer", help="Add DO_SPRAYER at every line; ArduPilot only.")
    ] = False,
    png: Annotated[
        Path | None, typer.Option("--png", metavar="FILE", help="Picture: .png, .svg or .pdf.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Plan the passes over a field, sortie by sortie, and write the mission.

    A .plan or .waypoints file holds one sortie; the second and later ones are numbered beside it.
    """
    start = perf_counter()
    check_suffix(out)
    if png is not None:
        check_picture(png)
    for name, value in (("--angle-deg", angle_deg), ("--rate-l-ha", rate_l_ha)):
        if value is not None and not (math.isfinite(value) and abs(value) < 1e5):
            raise typer.BadParameter(f"{name} is {value}; write a number")
    if rate_l_ha is not None and prescription is not None:
        raise typer.BadParameter("--rate-l-ha and --prescription exclude each other")
    asked = Asked(
        field=field,
        prescription=prescription,
        obstacles=tuple(obstacle or ()),
        no_spray=tuple(no_spray or ()),
        no_spray_buffer_m=no_spray_buffer_m,
        depots=tuple(parse_mark(text, "--depot") for text in depot or ()),
        rate_l_ha=rate_l_ha,
    )
    changes: dict[str, float | int | None] = {
        "swath_width_m": swath_m,
        "speed_m_s": speed_m_s,
        "speed_max_m_s": speed_max_m_s,
        "angle_deg": angle_deg,
        "tank_l": tank_l,
        "moves": MOVES[effort],
    }
    task = read_task(asked, None if config is None else load(config), changes)
    planned = plan_mission(task.field, task.settings, task.rates, depots=task.depots)
    took_s = perf_counter() - start
    files = write_plan(planned, out, with_sprayer=sprayer)
    if png is not None:
        draw_plan(planned, png, title=field.stem)
    warnings = planned.warnings
    result = planned.summary() | {
        "planning_s": took_s,
        "files": [str(path) for path in files],
    }
    answer(result, _lines(planned, result, files), as_json=as_json)
    for warning in warnings:
        note(f"warning: {warning}")


def _lines(planned: Plan, result: dict[str, Any], files: list[Path]) -> list[str]:
    """Return the plan in words."""
    coverage = planned.coverage
    minutes = planned.flight_s / 60.0
    where = ", ".join(f"{lat:.6f} {lon:.6f}" for lat, lon in result["depots"])
    lines = [
        f"{names_of(files)}: {len(planned.sorties)} sorties, {planned.volume_l:.1f} L, "
        f"{minutes:.0f} min",
        f"covered   {coverage.percent:.2f} % of {result['area_ha']:.2f} ha, "
        f"{coverage.overlap_percent:.2f} % twice, {coverage.outside_m2:.1f} m2 outside",
        f"passes    {len(planned.lines)} at {planned.angle_deg:.1f} deg, "
        f"{result['spray_m'] / 1000:.2f} km; transit {result['transit_m'] / 1000:.2f} km, "
        f"ferry {result['ferry_m'] / 1000:.2f} km",
        f"depot     {where}{' (suggested)' if planned.suggested_depot else ''}",
    ]
    lines += [
        f"sortie {sortie.number:3}  {sortie.volume_l:7.2f} L  {sortie.flight_s / 60.0:6.1f} min  "
        f"{sortie.lines} lines, {_speeds(sortie.speeds_m_s)}"
        for sortie in planned.sorties
    ]
    return lines


def _speeds(speeds_m_s: tuple[float, float]) -> str:
    """Return speeds in words.

    >>> _speeds((6.0, 6.0)), _speeds((4.5, 6.0))
    ('6 m/s', '4.5 to 6 m/s')
    """
    low, high = speeds_m_s
    return f"{high:g} m/s" if low == high else f"{low:g} to {high:g} m/s"
