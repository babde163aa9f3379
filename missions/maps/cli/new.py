"""`vrspray map new` and `vrspray map grid`: maps for trials, and the cells of P2's text map."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
import shapely
import typer

from companion.cli.answer import AsJson, answer, note, problem_line, problem_object
from companion.core.frame import LocalFrame
from missions.maps.model import Floats, MapFile, MapZone, digest, map_error, read_bytes, write_whole
from missions.maps.text_lattice import M2_PER_HA, MERGES
from missions.maps.text_map import PointGrid, grid_of_points, grid_problems
from missions.maps.text_points import (
    MAX_POINTS,
    TangentPlane,
    TextMap,
    parse_text_map,
    write_text_map,
)

# --------------------------------------------------------------------------------- vrspray map grid

GRID_EXAMPLE = "Example: vrspray map grid field.txt --origin 37.85,-4.8,120 --merge mean --json"

Force = Annotated[bool, typer.Option("--force", help="Replace an existing file.")]


def grid(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Text map of points.")],
    origin: Annotated[
        str | None,
        typer.Option(metavar="LAT,LON,ALT", help="Origin of the plane; default: the first point."),
    ] = None,
    merge: Annotated[
        str, typer.Option(metavar="HOW", help="Several points in a cell: max, average or mean.")
    ] = "max",
    cell_m: Annotated[
        int | None, typer.Option(metavar="M", help="Cell size; default: the map's own.", min=1)
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="CSV", help="Write the cells that have a rate.")
    ] = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Show the cells of a text map, by the equations of Rovira-Mas et al. 2024.

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
    high = ", the altitude in metres" if "ALT" in form.split(",") else ""
    if len(numbers) not in counts or not (abs(numbers[0]) <= 90.0 and abs(numbers[1]) <= 180.0):
        raise typer.BadParameter(
            f"{option} is {text!r}; write {form} in degrees, the latitude first{high}"
        )
    return numbers


# ---------------------------------------------------------------------------------- vrspray map new

__all__ = ["NEW_EXAMPLE", "grid", "new"]


# Maps for trials and tests: points in P2's format, and plots in rows as in P1's field.
#
# Everything follows from the arguments and a seed: the same call makes the same map.

PLOTS_MAX = 100_000
RANGE_MAX_M = 20_000.0
# Different rates in a map of points, and bumps in its field.
LEVELS = 10
_BUMPS = 6


@dataclass(frozen=True, slots=True, kw_only=True)
class Points:
    """What a map of points shall be: `count` of them over two ranges, rates in L/min.

    The coordinates begin at `east_min_m` and `north_min_m` from the origin (latitude, longitude,
    altitude).
    """

    origin: tuple[float, float, float]
    count: int
    east_range_m: float
    north_range_m: float
    east_min_m: float = 0.0
    north_min_m: float = 0.0
    rate_min_l_min: float
    rate_max_l_min: float
    seed: int = 0

    def __post_init__(self) -> None:
        if not 4 <= self.count <= MAX_POINTS:
            raise ValueError(f"a map has 4 to {MAX_POINTS} points, not {self.count}")
        for size in (self.east_range_m, self.north_range_m):
            if not 0.0 < size <= RANGE_MAX_M:
                raise ValueError(f"a map reaches over 0 to {RANGE_MAX_M:g} m, not {size:g}")
        for start in (self.east_min_m, self.north_min_m):
            if not abs(start) <= RANGE_MAX_M:
                raise ValueError(f"a map lies within {RANGE_MAX_M:g} m of its origin")
        if not 0.0 <= self.rate_min_l_min <= self.rate_max_l_min < 1e5:
            raise ValueError(
                f"no rates in L/min: {self.rate_min_l_min:g} to {self.rate_max_l_min:g}"
            )


def make_points(wanted: Points) -> TextMap:
    """Return points in rows, like vines, that fill both ranges to their ends.

    >>> made = make_points(Points(
    ...     origin=(39.5, -0.4, 50.0), count=7, east_range_m=20.0, north_range_m=10.0,
    ...     rate_min_l_min=10.0, rate_max_l_min=13.0,
    ... ))
    >>> made.count, float(made.rate_l_min.min()), float(made.rate_l_min.max())
    (7, 10.0, 13.0)
    """
    across = math.sqrt(wanted.count * wanted.north_range_m / wanted.east_range_m)
    rows = min(max(2, round(across)), wanted.count // 2)
    counts = [wanted.count // rows + (row < wanted.count % rows) for row in range(rows)]
    east = np.concatenate([np.linspace(0.0, wanted.east_range_m, count) for count in counts])
    north = np.repeat(np.linspace(0.0, wanted.north_range_m, rows), counts)
    rates = _rates(east / wanted.east_range_m, north / wanted.north_range_m, wanted)
    latitude, longitude, altitude = wanted.origin
    plane = TangentPlane(latitude_deg=latitude, longitude_deg=longitude, altitude_m=altitude)
    found = plane.to_geodetic(
        east + wanted.east_min_m, north + wanted.north_min_m, np.zeros(wanted.count)
    )
    return TextMap(
        latitude_deg=found[0], longitude_deg=found[1], altitude_m=found[2], rate_l_min=rates
    )


def _rates(x: Floats, y: Floats, wanted: Points) -> Floats:
    """Return a hilly field in steps, from the least to the largest rate."""
    chance = random.Random(wanted.seed)
    height = np.zeros(len(x))
    for _ in range(_BUMPS):
        east, north, width = chance.random(), chance.random(), 0.1 + 0.3 * chance.random()
        size = chance.choice((-1.0, 1.0)) * (0.5 + chance.random())
        height += size * np.exp(-((x - east) ** 2 + (y - north) ** 2) / (2.0 * width**2))
    low, high = float(height.min()), float(height.max())
    share = (height - low) / (high - low) if high > low else np.zeros(len(x))
    steps = np.rint(share * (LEVELS - 1)) / (LEVELS - 1)
    span = wanted.rate_max_l_min - wanted.rate_min_l_min
    rates: Floats = np.round(wanted.rate_min_l_min + span * steps, 6)
    return rates


@dataclass(frozen=True, slots=True, kw_only=True)
class Plots:
    """What a map of plots shall be: rows of rectangles, rates in L/ha.

    A row runs in the direction of `angle_deg` (clockwise from north) from the origin, and each
    further row lies to the left of the one before it.

    Args:
        origin: latitude and longitude of the corner where the first plot begins, on its right.
        rates_l_ha: one after the other along the rows, again and again; with a seed, each time
            in another order, so that every row of as many plots has each rate once.
        gap_m: alley between plots, without a rate.
    """

    origin: tuple[float, float]
    rows: int
    columns: int
    length_m: float
    width_m: float
    rates_l_ha: tuple[float, ...]
    gap_m: float = 0.0
    angle_deg: float = 90.0
    seed: int | None = None

    def __post_init__(self) -> None:
        if not (self.rows >= 1 and self.columns >= 1 and self.rows * self.columns <= PLOTS_MAX):
            raise ValueError(f"a map has 1 to {PLOTS_MAX} plots")
        if not (0.1 <= self.length_m <= RANGE_MAX_M and 0.1 <= self.width_m <= RANGE_MAX_M):
            raise ValueError(f"a plot is 0.1 to {RANGE_MAX_M:g} m long and wide")
        if not 0.0 <= self.gap_m <= 1_000.0:
            raise ValueError(f"a gap between plots is 0 to 1000 m, not {self.gap_m:g}")
        longest = max(
            self.columns * (self.length_m + self.gap_m), self.rows * (self.width_m + self.gap_m)
        )
        if not longest <= RANGE_MAX_M:
            raise ValueError(f"the plots reach over {longest:g} m, more than {RANGE_MAX_M:g}")
        if not math.isfinite(self.angle_deg):
            raise ValueError(f"no direction: {self.angle_deg}")
        if not self.rates_l_ha or not all(0.0 <= rate < 1e5 for rate in self.rates_l_ha):
            raise ValueError("plots need rates in L/ha, 0 or more")


def make_plots(wanted: Plots, path: Path, *, map_format: str) -> MapFile:
    """Return the plots as a map, row by row; the first is called r1c1, the next r1c2."""
    frame = LocalFrame(latitude_deg=wanted.origin[0], longitude_deg=wanted.origin[1])
    heading = math.radians(wanted.angle_deg)
    # Along the row, and to the left of it.
    turn = np.array(
        [[math.sin(heading), math.cos(heading)], [-math.cos(heading), math.sin(heading)]]
    )

    def to_degrees(points: Floats) -> Floats:
        local = points @ turn
        latitude, longitude = frame.to_geographic_all(local[:, 0].tolist(), local[:, 1].tolist())
        return np.column_stack([longitude, latitude])

    row, column = np.divmod(np.arange(wanted.rows * wanted.columns), wanted.columns)
    along = column * (wanted.length_m + wanted.gap_m)
    left = row * (wanted.width_m + wanted.gap_m)
    plots = shapely.box(along, left, along + wanted.length_m, left + wanted.width_m)
    zones = [
        MapZone(name=f"r{row + 1}c{column + 1}", geometry=ground, rate_l_ha=rate)
        for row, column, ground, rate in zip(
            row.tolist(),
            column.tolist(),
            shapely.transform(plots, to_degrees),
            plot_rates(wanted),
            strict=True,
        )
    ]
    return MapFile(
        path=path,
        format=map_format,
        crs="EPSG:4326",
        unit="L/ha",
        rate_field="rate",
        zones=tuple(zones),
        sha256="",
    )


def plot_rates(wanted: Plots) -> list[float]:
    """Return the rate of every plot, row by row."""
    chance = None if wanted.seed is None else random.Random(wanted.seed)
    count = wanted.rows * wanted.columns
    found: list[float] = []
    while len(found) < count:
        block: Sequence[float] = wanted.rates_l_ha
        if chance is not None:
            block = chance.sample(block, len(block))
        found.extend(block)
    return found[:count]


Wanted = TypeVar("Wanted", Points, Plots)

NEW_EXAMPLE = (
    "Examples: vrspray map new --out field.txt --points 2302 --east-m 480.3 --north-m 595.3 "
    "--origin 37.85,-4.8,120 --rate-min 15 --rate-max 45 | "
    "vrspray map new --out plots.geojson --rows 4 --columns 10 --plot-length-m 12 "
    "--plot-width-m 6 --rates 15,18,21,24,27 --seed 1 --origin 35.996,114.543"
)

_OF_POINTS = ("points", "east_m", "north_m", "rate_min", "rate_max")
_OF_PLOTS = ("rows", "columns", "plot_length_m", "plot_width_m", "rates")

_Count = Annotated[int | None, typer.Option("--points", metavar="NP", help="Text: how many.")]
_EastRange = Annotated[float | None, typer.Option(metavar="M", help="Text: from west to east.")]
_NorthRange = Annotated[float | None, typer.Option(metavar="M", help="Text: from south to north.")]
_EastMin = Annotated[float, typer.Option(metavar="M", help="Text: of the origin, the west edge.")]
_NorthMin = Annotated[float, typer.Option(metavar="M", help="Text: of the origin, the south edge.")]
_RateMin = Annotated[float | None, typer.Option(metavar="L_MIN", help="Text: the least rate.")]
_RateMax = Annotated[float | None, typer.Option(metavar="L_MIN", help="Text: the largest rate.")]
_Rows = Annotated[int | None, typer.Option(metavar="N", help="Plots: how many rows.")]
_Columns = Annotated[int | None, typer.Option(metavar="N", help="Plots: how many in a row.")]
_Length = Annotated[float | None, typer.Option(metavar="M", help="Plots: size along the row.")]
_Width = Annotated[float | None, typer.Option(metavar="M", help="Plots: size across the row.")]
_Gap = Annotated[float, typer.Option(metavar="M", help="Plots: alley between them.")]
_Angle = Annotated[
    float, typer.Option(metavar="DEG", help="Plots: direction of the rows, clockwise from north.")
]
_Rates = Annotated[
    str | None, typer.Option(metavar="L_HA,…", help="Plots: rates in turn along the rows.")
]
_Seed = Annotated[
    int | None, typer.Option(metavar="N", help="Another field; plots: rates in random order.")
]
_Out = Annotated[
    Path, typer.Option("--out", metavar="FILE", help=".txt for points, else the format of plots.")
]
_Origin = Annotated[
    str, typer.Option(metavar="LAT,LON[,ALT]", help="Degrees, metres; south-west corner.")
]


def new(
    out: _Out,
    origin: _Origin,
    points: _Count = None,
    east_m: _EastRange = None,
    north_m: _NorthRange = None,
    east_min_m: _EastMin = 0.0,
    north_min_m: _NorthMin = 0.0,
    rate_min: _RateMin = None,
    rate_max: _RateMax = None,
    rows: _Rows = None,
    columns: _Columns = None,
    plot_length_m: _Length = None,
    plot_width_m: _Width = None,
    gap_m: _Gap = 0.0,
    angle_deg: _Angle = 90.0,
    rates: _Rates = None,
    seed: _Seed = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Make a map for a trial: points or plots.

    Points in L/min (.txt), or plots in L/ha in any other format.
    """
    given = {
        "points": points,
        "east_m": east_m,
        "north_m": north_m,
        "rate_min": rate_min,
        "rate_max": rate_max,
        "rows": rows,
        "columns": columns,
        "plot_length_m": plot_length_m,
        "plot_width_m": plot_width_m,
        "rates": rates,
    }
    text = out.suffix.casefold() == ".txt"
    _check_given(given, text=text)
    place = parse_place(origin, "--origin")
    check_new(out, force=force)
    if text:
        start_m = (east_min_m, north_min_m)
        result = _new_points(out, given, origin=place, start_m=start_m, seed=seed or 0)
    else:
        wanted = _asked(
            Plots,
            origin=place[:2],
            rows=rows,
            columns=columns,
            length_m=plot_length_m,
            width_m=plot_width_m,
            rates_l_ha=parse_numbers(str(rates), "--rates"),
            gap_m=gap_m,
            angle_deg=angle_deg,
            seed=seed,
        )
        result = _new_plots(out, wanted, force=force)
    amount = f"{result['points']} points" if text else f"{result['zones']} plots"
    least, most = result["rates"][0], result["rates"][-1]
    line = f"{out}: {amount}, {result['area_ha']:.4g} ha, {least:g} to {most:g} {result['unit']}"
    answer(result, [line], as_json=as_json)


def _check_given(given: dict[str, Any], *, text: bool) -> None:
    """Ask for what is missing, and refuse what belongs to the other kind of map."""
    needed, foreign = (_OF_POINTS, _OF_PLOTS) if text else (_OF_PLOTS, _OF_POINTS)
    kind = "a text map (.txt)" if text else "a map of plots"
    wrong = [_option(name) for name in foreign if given[name] is not None]
    if wrong:
        raise typer.BadParameter(f"{kind} has no {', '.join(wrong)}")
    missing = [_option(name) for name in needed if given[name] is None]
    if missing:
        raise typer.BadParameter(f"{kind} needs {', '.join(missing)}")


def _option(name: str) -> str:
    return "--" + name.replace("_", "-")


def _new_points(
    out: Path,
    given: dict[str, Any],
    *,
    origin: tuple[float, float, float],
    start_m: tuple[float, float],
    seed: int,
) -> dict[str, Any]:
    wanted = _asked(
        Points,
        origin=origin,
        count=given["points"],
        east_range_m=given["east_m"],
        north_range_m=given["north_m"],
        east_min_m=start_m[0],
        north_min_m=start_m[1],
        rate_min_l_min=given["rate_min"],
        rate_max_l_min=given["rate_max"],
        seed=seed,
    )
    made = make_points(wanted)
    write_text_map(made, out)
    return {
        "file": str(out),
        "kind": "text",
        "points": made.count,
        "area_ha": wanted.east_range_m * wanted.north_range_m / 10_000.0,
        "rates": np.unique(made.rate_l_min).tolist(),
        "unit": "L/min",
        "sha256": digest([read_bytes(out)]),
    }


def _new_plots(out: Path, wanted: Plots, *, force: bool) -> dict[str, Any]:
    from missions.maps.convert.formats import write_map

    made = make_plots(wanted, out, map_format=out.suffix.lstrip("."))
    write_map(made, out, force=force)
    return {
        "file": str(out),
        "kind": "plots",
        "zones": len(made.zones),
        "area_ha": len(made.zones) * wanted.length_m * wanted.width_m / 10_000.0,
        "rates": list(made.rates_l_ha),
        "unit": "L/ha",
    }


def _asked(kind: type[Wanted], **fields: Any) -> Wanted:
    """Return what is asked for, checked."""
    try:
        return kind(**fields)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from error
