"""`vrspray make`: prescriptions from a field's data."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np
import typer

from companion.cli.answer import (
    new_app,
    problem_object,
    progress,
)
from companion.errors import Problem
from companion.flight_map import is_flight_map
from companion.wording import counted, lack_of, refuse_existing
from missions.errors import PlanError
from missions.make.classes import Method
from missions.make.cleaning import STEPS, Step
from missions.make.data import (
    INDICES,
    POINT_SUFFIXES,
    Points,
    Values,
    Wanted,
    filled,
    read_values,
    write_points,
)
from missions.make.flown import (
    MARGIN,
    FlownField,
    Making,
    Margin,
    check_rate,
    limits_of,
    making,
    numbers,
    problems_of,
)
from missions.make.passes import Places, places_in
from missions.make.spots_cli import spots
from missions.make.trial import trial
from missions.make.zones import Limits, Made, Wish, cells, make_zones, polygons
from missions.maps.model import MapFile, digest, map_error, read_bytes

ZONES_EXAMPLE = (
    "vrspray make zones ndvi.tif --value NDVI --boundary field.geojson --config field.toml "
    "--rates 24,18,12 --out field.gpkg"
)
app = new_app(
    no_args_is_help=True, help="Make prescriptions from a field's data.",
    epilog=f"Example: {ZONES_EXAMPLE}",
)  # fmt: skip

BAR_AFTER_S = 2.0
# Places are finer than the data and than a run, and never so many that they take the memory.
PLACE_MAX_M, PLACES_MAX = 1.0, 12_000_000
# More zones are no management zones any more.
ZONES_MAX = 20


@app.callback()
def _make() -> None:
    """Make prescriptions from a field's data."""


@app.command(epilog=f"Example: {ZONES_EXAMPLE}")
@making
def zones(
    data: Annotated[
        list[Path], typer.Argument(metavar="DATA...", help="Raster, points or polygons.")
    ],
    making: Making,
    rates: Annotated[
        str | None,
        typer.Option(metavar="R,R,...", help="L/ha of each zone, lowest values first."),
    ] = None,
    law: Annotated[
        str | None,
        typer.Option(metavar="V:R,V:R,...", help="L/ha by value, straight lines between."),
    ] = None,
    litres_max: Annotated[
        float | None, typer.Option(metavar="L", help="Lower all rates to this total.", min=0.001)
    ] = None,
    count: Annotated[
        int | None,
        typer.Option(
            "--zones",
            metavar="K",
            help="Number of zones; default 4, or one a rate.",
            min=1,
            max=ZONES_MAX,
        ),
    ] = None,
    method: Annotated[
        str, typer.Option(metavar="M", help=f"{', '.join(get_args(Method))}.")
    ] = "jenks",
    value: Annotated[
        list[str] | None,
        typer.Option(metavar="V", help="Band, index or column; one, or one for each DATA."),
    ] = None,
    band: Annotated[
        list[str] | None,
        typer.Option(metavar="COLOUR=B", help="Which band is nir, red, green, rededge or swir."),
    ] = None,
    band_offset: Annotated[
        float, typer.Option(metavar="D", help="Added to bands; Sentinel-2 since 2022: -1000.")
    ] = 0.0,
    smooth_m: Annotated[
        float,
        typer.Option(
            metavar="M",
            help="Smooth: take the most common zone within this distance.",
            min=0.0,
            max=500.0,
        ),
    ] = 0.0,
    margin: Margin = MARGIN,
    across: Annotated[
        Literal["swath", "valve"],
        typer.Option(help="Zones at least as wide as a swath, or as one valve's strip."),
    ] = "swath",
    step_percent: Annotated[
        float,
        typer.Option(metavar="PCT", help="Rates closer than this become one.", min=0.0, max=100.0),
    ] = 8.0,
    clean: Annotated[
        str | None,
        typer.Option(metavar="S,S,...", help=f"Steps for points: {', '.join(STEPS)}, or none."),
    ] = None,
    cleaned: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Also write the points that were kept: .csv, .geojson."),
    ] = None,
    data_width_m: Annotated[
        float | None, typer.Option(metavar="M", help="Distance between passes of points.", min=0.1)
    ] = None,
    ends_m: Annotated[
        float | None,
        typer.Option(
            metavar="M", help="Length to leave out at both ends of a pass of points.", min=0.0
        ),
    ] = None,
    as_is: Annotated[
        bool, typer.Option("--as-is", help="Ignore the sprayer's limits, to compare.")
    ] = False,
    crs: Annotated[
        str | None, typer.Option(metavar="C", help="CRS of DATA, where it does not say.")
    ] = None,
    layer: Annotated[
        str | None, typer.Option(metavar="L", help="Layer of DATA, where there are several.")
    ] = None,
) -> None:
    """Make zones that the sprayer can follow; say what that costs.

    Exit 0: made; 1: made, and the check of the map found errors; 2: refused.
    """
    if importlib.util.find_spec("scipy") is None:
        text, fix = lack_of("scipy")
        raise map_error(data[0], text, fix=fix, code="missing-library")
    config = making.config(cleaned)
    wish = _wish(rates, law, litres_max, count, method, smooth_m, step_percent)
    if as_is and is_flight_map(making.out):
        raise typer.BadParameter("--as-is makes a map to compare, not to fly: name another format")
    _check_cleaned(cleaned, data, force=making.force)
    wanted = _wanted(
        data, value or [],
        Wanted(
            bands=_bands(band or []), band_offset=band_offset, crs=crs, layer=layer,
            steps=_steps(clean), width_m=data_width_m, ends_m=ends_m,
        ),
    )  # fmt: skip
    with progress(after_s=BAR_AFTER_S) as tell:
        tell("planning the passes", 0, 4)
        field = making.field(config, across)
        tell("reading the data", 1, 4)
        read = [read_values(path, one, field.frame) for path, one in zip(data, wanted, strict=True)]
        points = _points_of(read, data) if cleaned is not None else None
        limits = None if as_is else limits_of(config, field.sprayer, margin)
        for rate in wish.rates_l_ha:
            if limits is not None and rate > 0.0:
                check_rate(rate, limits, said=f"--rates {rate:g}")
        places = _places(
            field, read, limits or limits_of(config, field.sprayer, margin), as_is, making.out
        )
        layers, missing = [], 0.0
        for path, values in zip(data, read, strict=True):
            whole, share = filled(values.at(places), places, path)
            layers.append(whole)
            missing = max(missing, share)
        tell("making the zones", 2, 4)
        made = make_zones(np.array(layers), places, wish, limits)
        tell("writing the map", 3, 4)
        map_file = _map_file(made, field, making.target, data, as_is)
        problems = problems_of(map_file, config, field)
        files = making.written(map_file, config, field, problems)
        if cleaned is not None and points is not None:
            write_points(cleaned, points)
            files = [*files, cleaned]
    result = _result(made, read, field, limits, missing, problems, files)
    making.answer(result, _lines(result, made, read))


app.command(
    epilog="Example: vrspray make spots weeds.csv --config field.toml --rate 20 --out spots.gpkg "
    "--mission spots.waypoints"
)(spots)
app.command(
    epilog="Example: vrspray make trial --config field.toml --rates 15,20,25 --check 10 --rest 20 "
    "--out trial.gpkg"
)(trial)


# What is asked.


def _wish(
    rates: str | None, law: str | None, litres_max: float | None, count: int | None, method: str,
    smooth_m: float, step_percent: float,
) -> Wish:  # fmt: skip
    if method not in get_args(Method):
        raise typer.BadParameter(f"--method is one of {', '.join(get_args(Method))}")
    if (rates is None) == (law is None):
        raise typer.BadParameter("give the rates, either with --rates or with --law")
    table = [] if rates is None else numbers(rates, "--rates")
    points = [] if law is None else _law(law)
    for rate in (*table, *(rate for _, rate in points)):
        if not 0.0 <= rate < 10_000.0:
            raise typer.BadParameter(f"{rate:g} L/ha is not a rate")
    number = count or (len(table) if table else 4)
    if (table and len(table) != number) or number > ZONES_MAX:
        raise typer.BadParameter(
            f"--rates gives {len(table)} rates for {number} zones: one for each, at most "
            f"{ZONES_MAX}"
        )
    return Wish(
        count=number, method=method, rates_l_ha=tuple(table), law=tuple(points),  # type: ignore[arg-type]
        litres_max=litres_max, smooth_m=smooth_m, step_percent=step_percent,
    )  # fmt: skip


def _law(text: str) -> list[tuple[float, float]]:
    pairs = [part.split(":") for part in text.split(",")]
    if any(len(pair) != 2 for pair in pairs):
        raise typer.BadParameter(f"--law takes value:rate with commas between, not {text!r}")
    points = [tuple(numbers(",".join(pair), "--law")) for pair in pairs]
    points.sort()
    if len({at for at, _ in points}) < max(len(points), 2):
        raise typer.BadParameter("--law takes two or more different values")
    return points  # type: ignore[return-value]


def _bands(given: Sequence[str]) -> dict[str, str]:
    found = {}
    for text in given:
        name, _, number = text.partition("=")
        colours = sorted({colour for pair in INDICES.values() for colour in pair})
        if name.casefold() not in colours or not number:
            raise typer.BadParameter(
                f"--band takes COLOUR=BAND with a colour of {', '.join(colours)}, not {text!r}"
            )
        found[name.casefold()] = number
    return found


def _steps(clean: str | None) -> tuple[Step, ...] | None:
    if clean is None:
        return None
    names = [] if clean == "none" else clean.split(",")
    unknown = [name for name in names if name not in STEPS]
    if unknown:
        raise typer.BadParameter(f"--clean takes {', '.join(STEPS)} or none, not {unknown[0]!r}")
    return tuple(step for step in STEPS if step in names)


def _wanted(data: Sequence[Path], values: Sequence[str], of_all: Wanted) -> list[Wanted]:
    if len(values) not in (0, 1, len(data)):
        raise typer.BadParameter(f"{len(values)} --value for {counted(len(data), 'file')}")
    names: list[str | None] = [*values] * (len(data) if len(values) == 1 else 1)
    names = names or [None] * len(data)
    return [replace(of_all, value=name) for name in names]


def _check_cleaned(cleaned: Path | None, data: Sequence[Path], *, force: bool) -> None:
    if cleaned is None:
        return
    if cleaned.suffix.casefold() not in POINT_SUFFIXES:
        raise typer.BadParameter(f"--cleaned is written as {' or '.join(POINT_SUFFIXES)}")
    if cleaned in data:
        raise PlanError(f"{cleaned}: --cleaned would replace the data; give another name")
    refuse_existing(cleaned, force=force, option="--cleaned")


def _points_of(read: Sequence[Values], data: Sequence[Path]) -> Points:
    """Return the points that are left of the one file of points."""
    found = [one.kept for one in read if one.kept is not None]
    if len(found) != 1:
        what = "no points" if not found else f"{len(found)} files of points"
        raise PlanError(f"{data[0]}: --cleaned takes one file of points, and DATA has {what}")
    return found[0]


def _places(
    field: FlownField, read: Sequence[Values], limits: Limits, as_is: bool, out: Path
) -> Places:
    grain_m = min(values.grain_m for values in read)
    size_m = min(max(grain_m / 8.0, limits.least_m / 6.0), grain_m, PLACE_MAX_M)
    ground = field.task.field.limit
    size_m = max(size_m, math.sqrt(ground.area / PLACES_MAX))
    passes = field.passes
    if as_is:
        # As the data have it, in even rows.
        count = len(passes.edges_m) - 1
        even = np.linspace(passes.edges_m[0], passes.edges_m[-1], count + 1)
        passes = replace(passes, edges_m=even)
    places = places_in(ground, passes, size_m=size_m, path=out)
    if not len(places.row):
        raise PlanError(f"{field.boundary_file}: no part of the field may be sprayed")
    return places


# What is made of it.


def _map_file(
    made: Made, field: FlownField, target: Path, data: Sequence[Path], as_is: bool
) -> MapFile:
    found: dict[str, Any] = (
        {"zones": (), "cells": cells(made, field.frame)}
        if as_is
        else {
            "zones": tuple(
                polygons(made, field.task.field.limit, field.frame, strip_m=field.sprayer.strip_m)
            )
        }
    )
    return MapFile(
        path=target, format="made", crs="EPSG:4326", unit="L/ha", rate_field="rate",
        sha256=digest([read_bytes(path) for path in data if path.is_file()]),
        boundary=field.boundary, **found,
    )  # fmt: skip


def _result(
    made: Made, read: Sequence[Values], field: FlownField, limits: Limits | None, missing: float,
    problems: Sequence[Problem], files: Sequence[Path],
) -> dict[str, Any]:  # fmt: skip
    ok = not any(problem.severity == "error" for problem in problems)
    return {
        "ok": ok,
        "files": [str(path) for path in files],
        "values": [
            {"name": one.name, "grain_m": one.grain_m, "points": one.count,
             "removed": None if one.removed is None else dict(one.removed)}
            for one in read
        ],
        "missing_percent": 100.0 * missing,
        "course_deg": field.passes.angle_deg,
        "aligned_percent": field.passes.aligned_percent,
        "least_m": None if limits is None else limits.least_m,
        "rates_min_l_ha": None if limits is None else limits.low_l_ha,
        "rates_max_l_ha": None if limits is None else limits.high_l_ha,
        "became": [{"asked_l_ha": asked, "rate_l_ha": rate} for asked, rate in made.became],
        "zones": [
            {"rate_l_ha": rate, "mean_value": mean, "area_ha": area_ha}
            for rate, mean, area_ha in zip(
                made.rates_l_ha, made.means, made.areas_ha, strict=True
            )
        ],
        "breaks": list(made.breaks),
        "steps": [asdict(step) for step in made.steps],
        "litres": made.litres,
        "ideal_litres": made.ideal_l,
        "misapplied_litres": made.misapplied_l,
        "misapplied_percent": made.misapplied_percent,
        "short_ha": made.short_ha,
        "notes": list(dict.fromkeys((*made.notes, *(text for one in read for text in one.said)))),
        "problems": [problem_object(problem) for problem in problems],
    }  # fmt: skip


def _lines(result: dict[str, Any], made: Made, read: Sequence[Values]) -> list[str]:
    lines = []
    if made.became:
        shown = ", ".join(f"{asked:.4g} became {rate:g}" for asked, rate in made.became)
        lines.append(f"rates are not those asked for [L/ha]: {shown}")
    for one in read:
        removed = {name: count for name, count in (one.removed or {}).items() if count}
        if one.count is not None:
            shown = ", ".join(f"{name} {count}" for name, count in removed.items()) or "none"
            left = one.count - sum(removed.values())
            lines.append(f"{one.name}: {left} of {one.count} points kept; removed: {shown}")
    if result["missing_percent"] > 0.0:
        lines.append(
            f"{result['missing_percent']:.1f} % of the field has no data: it takes the nearest"
        )
    if result["least_m"] is None:
        lines.append("as the data have it, without the sprayer's limits: to compare, not to fly")
    else:
        lines.append(
            f"course {result['course_deg']:g} deg; zones at least {result['least_m']:.2f} m along "
            f"the passes, {result['rates_min_l_ha']:.2f} to {result['rates_max_l_ha']:.2f} L/ha"
        )
    lines += [
        f"zone {number}: {zone['rate_l_ha']:g} L/ha on {zone['area_ha']:.4f} ha, "
        f"{read[0].name} {zone['mean_value']:.4g} on average"
        for number, zone in enumerate(result["zones"], 1)
    ]
    lines += [
        f"{step.name}: {step.changed_ha:.4f} ha changed, {step.moved_l:.2f} L moved; "
        f"{step.variance_kept_percent:.1f} % of the variance kept"
        for step in made.steps
    ]
    lines += result["notes"]
    lines.append(
        f"{made.litres:.1f} L; the data ask for {made.ideal_l:.1f} L, and "
        f"{made.misapplied_percent:.1f} % of that lies elsewhere"
    )
    if result["least_m"] is not None and result["aligned_percent"] < 99.95:
        lines.append(
            f"{100 - result['aligned_percent']:.1f} % of the planned passes are flown across these "
            "zones or beside their middle: along the border, or in parts side by side"
        )
    if made.short_ha >= 5e-5:
        lines.append(
            f"{made.short_ha:.4f} ha at corners of the field are shorter than a zone, and take one"
        )
    lines += [f"written: {name}" for name in result["files"]]
    return lines
