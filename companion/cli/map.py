"""`vrspray map`: what is in a prescription file, what is wrong with it, the rate at a place."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Annotated, Any

import typer

from companion.assembly import above_label, undelivered
from companion.cli.answer import AsJson, answer, problem_line, problem_object
from companion.cli.map_options import File, Reading, reading_options
from companion.config import Config
from companion.errors import MapError
from companion.maps.lint import point_rates, summary
from companion.maps.model import MapFile

POINTS_MAX = 1_000_000
RATES_SHOWN_MAX = 12

app = typer.Typer(
    add_completion=False,
    rich_markup_mode=None,
    help="Check a prescription map; look up rates in it.",
    epilog="Example: vrspray map check examples/anyang/prescription.shp",
)


@app.command(epilog="Example: vrspray map check field.shp --rate-field dose --unit L/ha")
@reading_options
def check(
    file: File,
    reading: Reading,
    as_json: AsJson = False,
) -> None:
    """Say what is in a map and what is wrong with it.

    With --config also whether its sprayer can deliver the rates. Exit 0: usable; 1: readable,
    with errors; 2: unreadable.
    """
    config = reading.config
    map_file = reading.read(file)
    result: dict[str, Any] = dict(summary(map_file, overlap=reading.overlap))
    if config is not None:
        result["problems"] = [*result["problems"], *_sprayer_problems(config, map_file)]
    result["ok"] = not any(problem["severity"] == "error" for problem in result["problems"])
    answer(result, _lines(file, result), as_json=as_json)
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
    as_json: AsJson = False,
) -> None:
    """Say the rate at a place, or at all places of a file."""
    if (points is None) == (latitude is None or longitude is None):
        raise typer.BadParameter("give LAT and LON, or --points CSV")
    if points is not None:
        places = _read_points(points)
    else:
        places = [_place(latitude, longitude, "LAT LON")]
    found = point_rates(reading.read(file), places, overlap=reading.overlap)
    lines = (
        f"{item['lat']},{item['lon']}: "
        + ("no rate" if item["rate_l_ha"] is None else f"{item['rate_l_ha']:g} L/ha")
        + ("" if item["zone"] is None else f" in zone {item['zone']}")
        for item in found
    )
    answer(found[0] if points is None else {"points": found}, lines, as_json=as_json)


def _sprayer_problems(config: Config, map_file: MapFile) -> list[dict[str, str]]:
    """Return what this sprayer and this product have against the map."""
    problems = []
    label = above_label(config, map_file)
    if label is not None:
        problems.append(label)
    if config.mission is not None:
        problems += undelivered(
            {zone.rate_l_ha for zone in map_file.zones if zone.rate_l_ha is not None},
            sets=config.nozzle_sets(),
            pwm=config.pwm_limits(),
            width_m=config.boom_table.width_m,
            speed_m_s=config.mission.speed_m_s,
        )
    return [problem_object(problem) for problem in problems]


def _lines(file: Path, result: dict[str, Any]) -> list[str]:
    rates = result["rates_l_ha"]
    if len(rates) <= RATES_SHOWN_MAX:
        rates_text = " ".join(f"{value:g}" for value in rates)
    else:
        rates_text = f"{len(rates)} from {rates[0]:g} to {rates[-1]:g}"
    return [
        f"{file}: {result['format']}, {result['crs']}",
        f"{result['zones']} zones, {result['area_ha']:.4f} ha",
        f"rates [L/ha] from {result['rate_field']!r} in {result['unit']}: {rates_text}",
        *map(problem_line, result["problems"]),
        "ok" if result["ok"] else "not usable",
    ]


def _read_points(path: Path) -> list[tuple[float, float]]:
    """Return (latitude, longitude) of each line of a CSV file with columns lat and lon."""
    places: list[tuple[float, float]] = []
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            if not {"lat", "lon"} <= set(reader.fieldnames or ()):
                raise MapError(f"{path}: no columns lat and lon; name them in the first line")
            for row in reader:
                if len(places) >= POINTS_MAX:
                    raise MapError(f"{path}: more than {POINTS_MAX} points; split the file")
                where = f"{path}: line {reader.line_num}"
                places.append(_place(row["lat"], row["lon"], where))
    except OSError as error:
        reason = (error.strerror or "cannot be read").lower()
        raise MapError(f"{path}: {reason}; give a CSV file with columns lat and lon") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise MapError(f"{path}: no CSV text in UTF-8 ({error}); save it as that") from error
    return places


def _place(
    latitude: str | float | None, longitude: str | float | None, where: str
) -> tuple[float, float]:
    try:
        place = float(latitude), float(longitude)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        place = (999.0, 999.0)
    if not (abs(place[0]) <= 90.0 and abs(place[1]) <= 180.0):
        raise MapError(
            f"{where}: {latitude!r}, {longitude!r}: no place; write degrees, the latitude first"
        )
    return place
