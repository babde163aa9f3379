"""`vrspray map grid`: the cells that P2's text map makes, by the paper's own equations."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from companion.cli.answer import AsJson, answer, note, problem_line, problem_object
from missions.maps.layer import read_bytes
from missions.maps.model import map_error
from missions.maps.text_lattice import M2_PER_HA, MERGES
from missions.maps.text_map import PointGrid, grid_of_points, grid_problems
from missions.maps.text_points import parse_text_map
from missions.maps.whole_file import write_whole

GRID_EXAMPLE = "Example: vrspray map grid field.txt --origin 37.85,-4.8,120 --merge mean --json"

Force = Annotated[bool, typer.Option("--force", help="Overwrite the file.")]


def grid(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="P2's text map.")],
    origin: Annotated[
        str | None,
        typer.Option(metavar="LAT,LON,ALT", help="Of the plane; the first point without it."),
    ] = None,
    merge: Annotated[
        str, typer.Option(metavar="HOW", help="Several points in a cell: max, average or mean.")
    ] = "max",
    cell_m: Annotated[
        int | None, typer.Option(metavar="M", help="In place of the map's own cell size.", min=1)
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="CSV", help="Write the cells with a rate.")
    ] = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Show the cells of a text map, by P2's equations.

    They are written as points of a CSV file where one is named.
    """
    if merge not in MERGES:
        raise typer.BadParameter(f"--merge is {merge!r}; take one of {', '.join(MERGES)}")
    place = None if origin is None else parse_place(origin, "--origin")
    content = read_bytes(file)
    found = grid_of_points(
        parse_text_map(content, file), file, origin=place, merge=merge, cell_m=cell_m
    )
    problems = [problem_object(problem) for problem in grid_problems(found, content, file)]
    result = grid_result(found) | {"problems": problems}
    if out is not None:
        _write_cells(found, out, force=force)
        result["out"] = str(out)
    answer(result, [f"{file}:", *_grid_lines(result)], as_json=as_json)
    if not as_json:
        for problem in problems:
            note(problem_line(problem))


def grid_result(found: PointGrid) -> dict[str, Any]:
    """Return the numbers of P2's Tables 1 and 2, and what else there is to know of the cells."""
    layout, plane = found.layout, found.plane
    rated = found.rates_l_min[~np.isnan(found.rates_l_min)]
    return {
        "points": layout.points,
        "cell_m": layout.cell_m,
        "rows": layout.rows,
        "columns": layout.columns,
        "area_ha": layout.table_area_ha,
        "points_per_ha": layout.table_points_per_ha,
        "area_m2": layout.area_ha * M2_PER_HA,
        "east_min_m": layout.east_min_m,
        "east_max_m": layout.east_max_m,
        "north_min_m": layout.north_min_m,
        "north_max_m": layout.north_max_m,
        "origin": [plane.latitude_deg, plane.longitude_deg, plane.altitude_m],
        "merge": found.merge,
        "empty_cells": int(found.rates_l_min.size - rated.size),
        "mixed_cells": found.mixed_cells,
        "rates_l_min": [float(rated.min()), float(rated.max())],
    }


def _grid_lines(result: dict[str, Any]) -> list[str]:
    latitude, longitude, altitude = result["origin"]
    least, most = result["rates_l_min"]
    per_ha = result["points_per_ha"]
    density = "" if per_ha is None else f", {per_ha} points/ha"
    cells = result["rows"] * result["columns"]
    return [
        f"points        {result['points']}{density}",
        f"origin        {latitude:.9f}, {longitude:.9f}, {altitude:g} m",
        f"east          {result['east_min_m']:.1f} to {result['east_max_m']:.1f} m",
        f"north         {result['north_min_m']:.1f} to {result['north_max_m']:.1f} m",
        f"area          {result['area_ha']:g} ha",
        f"cell          {result['cell_m']} m",
        f"columns (H)   {result['columns']}",
        f"rows (V)      {result['rows']}",
        f"empty cells   {result['empty_cells']} of {cells}",
        f"rates         {least:g} to {most:g} L/min ({result['merge']})",
    ]


def _write_cells(found: PointGrid, out: Path, *, force: bool) -> None:
    """Write the middle of every cell with a rate, its numbers as in P2 and its rate."""
    if out.suffix.casefold() != ".csv":
        raise map_error(
            out, "the cells are written as .csv only",
            fix="for other formats use `vrspray map convert`", code="unknown-format",
        )  # fmt: skip
    check_new(out, force=force)
    row, column = np.nonzero(~np.isnan(found.rates_l_min))
    middles = column.astype(np.float64) + 0.5, row.astype(np.float64) + 0.5
    latitude, longitude = found.corners(*middles)
    cells = zip(
        latitude.tolist(),
        longitude.tolist(),
        (column + 1).tolist(),
        (row + 1).tolist(),
        found.rates_l_min[row, column].tolist(),
        strict=True,
    )
    lines = [f"{lat:.10f},{lon:.10f},{i},{j},{rate:.10g}" for lat, lon, i, j, rate in cells]
    write_whole(out, "\n".join(["lat,lon,column,row,rate_l_min", *lines, ""]).encode("ascii"))


def check_new(out: Path, *, force: bool) -> None:
    """Refuse to overwrite a file that nobody said to overwrite."""
    if out.exists() and not force:
        raise map_error(
            out,
            "the file is there already",
            fix="take another name, or --force",
            code="file-exists",
        )


def parse_numbers(text: str, option: str) -> tuple[float, ...]:
    """Return the numbers of a list with commas."""
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if not numbers or not np.isfinite(numbers).all():
        raise typer.BadParameter(f"{option} is {text!r}; write numbers with commas between them")
    return numbers


def parse_place(text: str, option: str) -> tuple[float, float, float]:
    """Return latitude, longitude and altitude; the altitude may be left out, and is 0 then."""
    place = (*_numbers_of_place(text, option, "LAT,LON,ALT", (2, 3)), 0.0)
    return place[0], place[1], place[2]


def parse_mark(text: str, option: str) -> tuple[float, float]:
    """Return latitude and longitude, and nothing else."""
    latitude_deg, longitude_deg = _numbers_of_place(text, option, "LAT,LON", (2,))
    return latitude_deg, longitude_deg


def _numbers_of_place(
    text: str, option: str, form: str, counts: tuple[int, ...]
) -> tuple[float, ...]:
    numbers = parse_numbers(text, option)
    if len(numbers) not in counts or not (abs(numbers[0]) <= 90.0 and abs(numbers[1]) <= 180.0):
        raise typer.BadParameter(
            f"{option} is {text!r}; write {form} in degrees and metres, the latitude first"
        )
    return numbers
