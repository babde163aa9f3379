"""`vrspray map`: what is in a prescription file, what is wrong with it, the rate at a place.

The other commands stand in files of their own and are gathered at the end.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from os import SEEK_END
from pathlib import Path
from typing import Annotated, Any

import typer

from companion.cli.answer import AsJson, answer
from companion.errors import MapError
from missions.maps.cli.compiled import COMPILE_EXAMPLE, compile_
from missions.maps.cli.convert import convert, show
from missions.maps.cli.grid import GRID_EXAMPLE, grid, parse_mark
from missions.maps.cli.new import NEW_EXAMPLE, new
from missions.maps.cli.offset import OFFSET_EXAMPLE, offset
from missions.maps.cli.options import File, OverlapPolicy, Reading, reading_options
from missions.maps.cli.plan import plan_of, sprayer_problems
from missions.maps.cli.report import report_lines
from missions.maps.compiling import flown_at
from missions.maps.layer import cut_off
from missions.maps.lint import point_rates, summary

POINTS_MAX = 1_000_000

app = typer.Typer(
    add_completion=False,
    rich_markup_mode=None,
    help="Check, show, convert and make prescription maps; look up rates in them.",
    epilog="Example: vrspray map check examples/anyang/prescription.shp",
)


@app.command(epilog="Example: vrspray map check field.shp --rate-field dose --unit L/ha")
@reading_options
def check(
    file: File,
    reading: Reading,
    home: Annotated[
        str | None,
        typer.Option(
            metavar="LAT,LON", help="Where the sprayer stands; else mission.depots of --config."
        ),
    ] = None,
    overlap: OverlapPolicy = None,
    as_json: AsJson = False,
) -> None:
    """Say what is in a map and what is wrong with it.

    With --config also whether its sprayer can deliver the rates and settle in every zone, and
    whether the map lies in its field. Exit 0: usable; 1: readable, with errors; 2: unreadable.
    """
    reading = reading.with_overlap(overlap)
    plan, found = plan_of(reading.config, None if home is None else parse_mark(home, "--home"))
    map_file = reading.read(file)
    found += sprayer_problems(reading.config, map_file, plan)
    result = summary(map_file, overlap=reading.overlap, plan=plan, more=found)
    answer(result, report_lines(file, result), as_json=as_json)
    raise typer.Exit(0 if result["ok"] else 1)


@app.command(
    epilog="Example: vrspray map rate examples/anyang/prescription.shp 35.9962 114.5436",
    context_settings={"ignore_unknown_options": True},  # a latitude may be negative
)
@reading_options
def rate(
    file: File,
    reading: Reading,
    latitude: Annotated[float | None, typer.Argument(metavar="LAT", help="Degrees.")] = None,
    longitude: Annotated[float | None, typer.Argument(metavar="LON", help="Degrees.")] = None,
    points: Annotated[
        Path | None,
        typer.Option("--points", metavar="CSV", help="File with columns lat and lon instead."),
    ] = None,
    overlap: OverlapPolicy = None,
    as_json: AsJson = False,
) -> None:
    """Say the rate at a place, or at all places of a file.

    As the map has it; with --config as it will be flown: boundary, exclusions, default rate and
    offset applied.
    """
    reading = reading.with_overlap(overlap)
    if (points is None) == (latitude is None or longitude is None):
        raise typer.BadParameter("give LAT and LON, or --points CSV")
    if points is not None:
        places = _read_points(points)
    else:
        places = [_place(latitude, longitude, "LAT LON")]
    map_file = reading.read(file)
    if reading.config is not None and reading.config.prescription is not None and places:
        found = flown_at(reading.config, map_file, places)
    else:
        found = point_rates(map_file, places, overlap=reading.overlap)
    answer(
        found[0] if points is None else {"points": found}, map(_rate_line, found), as_json=as_json
    )


def _rate_line(item: Mapping[str, Any]) -> str:
    """Return one place's answer for a person; `inside` is there where the map has a boundary."""
    found = "no rate" if item["rate_l_ha"] is None else f"{item['rate_l_ha']:g} L/ha"
    zone = "" if item["zone"] is None else f" in zone {item['zone']}"
    outside = "" if item.get("inside", True) else ", outside the field's boundary"
    return f"{item['lat']},{item['lon']}: {found}{zone}{outside}"


def _read_points(path: Path) -> list[tuple[float, float]]:
    """Return (latitude, longitude) of each line of a CSV file with columns lat and lon."""
    places: list[tuple[float, float]] = []
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            if not {"lat", "lon"} <= set(reader.fieldnames or ()):
                raise _bad_points(f"{path}: no columns lat and lon", "name them in the first line")
            for row in reader:
                if len(places) >= POINTS_MAX:
                    raise _bad_points(f"{path}: more than {POINTS_MAX} points", "split the file")
                where = f"{path}: line {reader.line_num}"
                places.append(_place(row["lat"], row["lon"], where))
        if places and list(row)[-1] in ("lat", "lon") and not _last_line_ends(path):
            raise cut_off(path, reader.line_num, row[list(row)[-1]])
    except OSError as error:
        reason = (error.strerror or "cannot be read").lower()
        raise _bad_points(
            f"{path}: {reason}", "give a CSV file with columns lat and lon"
        ) from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise _bad_points(f"{path}: no CSV text in UTF-8 ({error})", "save it as that") from error
    return places


def _last_line_ends(path: Path) -> bool:
    with path.open("rb") as file:
        file.seek(-1, SEEK_END)
        return file.read(1) in b'\r\n"'


def _place(
    latitude: str | float | None, longitude: str | float | None, where: str
) -> tuple[float, float]:
    try:
        # None is refused below, as a TypeError.
        place = float(latitude), float(longitude)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        place = (999.0, 999.0)
    if not (abs(place[0]) <= 90.0 and abs(place[1]) <= 180.0):
        raise _bad_points(
            f"{where}: {latitude!r}, {longitude!r}: no place", "write degrees, the latitude first"
        )
    return place


def _bad_points(text: str, fix: str) -> MapError:
    return MapError(f"{text}; {fix}", code="bad-points", fix=fix)


app.command(epilog="Example: vrspray map show examples/anyang/prescription.shp --out map.png")(show)
app.command(epilog="Example: vrspray map convert field.shp field.gpkg")(convert)
app.command(epilog=GRID_EXAMPLE)(grid)
app.command(epilog=NEW_EXAMPLE)(new)
app.command(epilog=OFFSET_EXAMPLE)(offset)
app.command("compile", epilog=COMPILE_EXAMPLE)(compile_)
