"""`vrspray map`: what is in a prescription file, what is wrong with it, the rate at a place.

The other commands stand in files of their own and are gathered at the end.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from os import SEEK_END
from pathlib import Path
from typing import Annotated, Any

import typer

from companion.cli.answer import (
    AsJson,
    Overrides,
    answer,
    new_app,
    problem_line,
    problem_object,
)
from companion.config import Config, load
from companion.config.tables import PrescriptionTable
from companion.core.frame import LocalFrame
from companion.errors import MapError, Problem
from companion.flight_map import SUFFIX, FlightMap, is_flight_map
from companion.wording import counted
from missions.maps.cli.convert import convert, show
from missions.maps.cli.new import GRID_EXAMPLE, NEW_EXAMPLE, grid, new, parse_mark
from missions.maps.cli.options import (
    File,
    OverlapPolicy,
    Reading,
    check_overlap,
    plan_of,
    reading_options,
    sprayer_problems,
)
from missions.maps.compiling import (
    MapOrder,
    compile_map,
    flown_at,
    read_ordered_map,
    write_flight_map,
)
from missions.maps.lint import check_map, point_rates, summary
from missions.maps.model import MapFile, check_folder, cut_off, map_error, not_written

# `vrspray map compile`: the flight map, the only map that a flight opens.

COMPILE_EXAMPLE = (
    "Example: vrspray map compile field.shp --config field.toml --out field.flightmap.gpkg"
)


def compile_(
    file: File,
    out: Annotated[
        Path, typer.Option("--out", metavar=f"NAME{SUFFIX}", help="The flight map to write.")
    ],
    config_file: Annotated[
        Path | None,
        typer.Option("--config", metavar="FILE", help="Configuration of the flight."),
    ] = None,
    overlap: Annotated[
        str | None,
        typer.Option(
            "--overlap", metavar="P", help="Rule where zones overlap, if there is no --config."
        ),
    ] = None,
    overrides: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Compile a map and what belongs to it into a flight map.

    That is its boundary, exclusions and planned lines.

    Exit 0: compiled; 1: compiled, and the check of the map found errors; 2: it cannot be flown.
    """
    if not is_flight_map(out):
        raise typer.BadParameter(f"--out must end in {SUFFIX}")
    if is_flight_map(file):
        raise map_error(
            file, "this is already a flight map", fix="name the map that it was compiled from"
        )
    check_folder(out)
    config = None if config_file is None else load(config_file, overrides=overrides or ())
    order = _order(file, config, overlap)
    map_file = read_ordered_map(order)
    compiled = compile_map(order, map_file=map_file, findings=_findings(order, config, map_file))
    try:
        written = write_flight_map(out, compiled)
    except OSError as error:
        raise not_written(out, error) from None
    problems = [problem_object(found) for found in written.findings]
    ok = not any(problem["severity"] == "error" for problem in problems)
    answer(
        {"ok": ok, "file": str(out), **_result(written), "problems": problems},
        [*map(problem_line, problems), _compiled_verdict(written)],
        as_json=as_json,
    )
    raise typer.Exit(0 if ok else 1)


def _order(file: Path, config: Config | None, overlap: str | None) -> MapOrder:
    """Return what is to be compiled: the map that was named, by the rules of the configuration."""
    own = None if config is None or config.prescription is None else config.prescription.file
    is_own = config is not None and own is not None and _is_same(config.resolve(own), file)
    changes: dict[str, object] = {"file": own if is_own else str(file.absolute())}
    if overlap is not None:
        check_overlap(overlap)
        changes["overlap"] = overlap
    if config is None or config.prescription is None:
        table = PrescriptionTable.model_validate(changes)
    else:
        table = config.prescription.model_copy(update=changes)
    if config is None:
        return MapOrder(table=table)
    lines = None if config.mission is None else config.mission.lines
    return MapOrder(
        table=table,
        lines=lines,
        buffers=config.buffers,
        folder=config.path.parent,
        config=config.path,
    )


def _is_same(one: Path, other: Path) -> bool:
    return one.resolve() == other.resolve()


def _findings(order: MapOrder, config: Config | None, map_file: MapFile) -> tuple[Problem, ...]:
    """Return what `map check` finds in the map, for this flight."""
    plan, problems = plan_of(config, None)
    problems += sprayer_problems(config, map_file, plan)
    found = check_map(map_file, overlap=order.table.overlap, plan=plan)
    return (*found, *problems)


def _result(flight_map: FlightMap) -> dict[str, object]:
    ground = flight_map.prescription
    return {
        "sha256": flight_map.sha256,
        "map_sha256": ground.sha256,
        "source": flight_map.source,
        "field_ha": ground.field.area / 1e4,
        "rates_l_ha": list(ground.rates_l_ha),
        "lines": len(flight_map.polylines),
        "compiled_utc": flight_map.compiled_utc,
        "compiled_by": flight_map.compiled_by,
    }


def _compiled_verdict(flight_map: FlightMap) -> str:
    rates = flight_map.prescription.rates_l_ha
    span = f"{min(rates):g} to {max(rates):g} L/ha" if rates else "no rates"
    return (
        f"{flight_map.path}: flight map {flight_map.sha256[:8]} of {flight_map.source}, "
        f"{flight_map.prescription.field.area / 1e4:.2f} ha, {span}"
    )


# `vrspray map offset`: how far a map and the receiver disagree, from one surveyed mark.

OFFSET_EXAMPLE = (
    "Example: vrspray map offset --map 35.996089,114.543487 --surveyed 35.996094,114.543481"
)
# Datums and bases differ by metres; a mark farther off is another mark.
PLAUSIBLE_M = 10.0


def offset(
    in_map: Annotated[
        str, typer.Option("--map", metavar="LAT,LON", help="Position of the mark on the map.")
    ],
    surveyed: Annotated[
        str,
        typer.Option(
            metavar="LAT,LON", help="Position of the same mark, measured by the drone's receiver."
        ),
    ],
    as_json: AsJson = False,
) -> None:
    """Measure the offset between map and receiver by one mark.

    Read the mark (a corner of the field, a pole) out of the map, survey it with the receiver and
    the base that will fly, and paste the two lines into [prescription].
    """
    first, second = parse_mark(in_map, "--map"), parse_mark(surveyed, "--surveyed")
    east_m, north_m = offset_between(first, second)
    distance_m = math.hypot(east_m, north_m)
    if not distance_m <= PLAUSIBLE_M:
        raise MapError(
            f"--surveyed lies {distance_m:.1f} m from --map, more than {PLAUSIBLE_M:.0f} m; check "
            "that both are the same mark, each with the latitude first",
            code="wrong-mark",
        )
    result = {"offset_east_m": east_m, "offset_north_m": north_m, "distance_m": distance_m}
    lines = [
        f"offset_east_m = {east_m:.3f}",
        f"offset_north_m = {north_m:.3f}",
        f"check_map = [{first[0]!r}, {first[1]!r}]",
        f"check_surveyed = [{second[0]!r}, {second[1]!r}]",
    ]
    answer(result, lines, as_json=as_json)


# The offset between a map and a receiver, from one mark that both know.
#
# WGS84, ETRS89 and CGCS2000 lie up to a metre and more apart, and a base on a guessed point moves
# everything by its own error; on one field each of these is the same shift everywhere. A mark on
# the ground, read out of the map and surveyed with the receiver that will fly, shows it.

Place = tuple[float, float]


def offset_between(in_map: Place, surveyed: Place) -> tuple[float, float]:
    """Return by how much the map has to move: metres east and north.

    Both are (latitude, longitude) in degrees.

    >>> east_m, north_m = offset_between((36.0, 114.5), (36.000005, 114.500005))
    >>> round(east_m, 2), round(north_m, 2)
    (0.45, 0.55)
    """
    return LocalFrame(latitude_deg=in_map[0], longitude_deg=in_map[1]).to_local(*surveyed)


POINTS_MAX = 1_000_000

app = new_app(
    help="Check, show, convert, compile and make prescription maps.",
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
            metavar="LAT,LON", help="Place of the sprayer; default: mission.depots of --config."
        ),
    ] = None,
    overlap: OverlapPolicy = None,
    as_json: AsJson = False,
) -> None:
    """Show what is in a map and what is wrong with it.

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
        typer.Option(
            "--points", metavar="CSV", help="Look up all points of a file with columns lat and lon."
        ),
    ] = None,
    overlap: OverlapPolicy = None,
    as_json: AsJson = False,
) -> None:
    """Look up the rate at one position, or at all positions in a file.

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
        raise _bad_points(f"{path}: not CSV text in UTF-8 ({error})", "save it as UTF-8") from error
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
            f"{where}: {latitude!r}, {longitude!r}: not a position", "write degrees, latitude first"
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


# What `map check` says to a person: the map in a few lines, its problems on at most a screen.

RATES_SHOWN_MAX = 12
# Problems of one kind, and kinds, that are written out; all of them are in --json.
ALIKE_SHOWN_MAX = 2
KINDS_SHOWN_MAX = 15
LINE_MAX = 500


def report_lines(file: Path, result: Mapping[str, Any]) -> list[str]:
    """Return the lines for a person."""
    digest = result["sha256"]
    return [
        f"{_judged(file)}: {result['format']}, {result['crs']}"
        + (f", hash {digest[:8]}" if digest else ""),
        _extent(result),
        _rates(result),
        _amount(result),
        _ground(result),
        *_problems(result["problems"]),
        _verdict(result),
    ]


def _judged(file: Path) -> str:
    """Return the map that is judged: of a folder with one shapefile, that."""
    found = sorted(file.glob("*.[sS][hH][pP]")) if file.is_dir() else []
    return str(found[0] if len(found) == 1 else file)


def _extent(result: Mapping[str, Any]) -> str:
    if result["rows"] is not None:
        along, across = result["cell_m"]
        return (
            f"{result['rows']} rows x {result['columns']} columns of cells, {along:.2f} m x "
            f"{across:.2f} m; {result['zones']} have a rate, {_area(result)}"
        )
    zones, parts, holes = (counted(result[f"{name}s"], name) for name in ("zone", "part", "hole"))
    in_parts = f" in {parts}" if result["parts"] != result["zones"] else ""
    with_holes = f" with {holes}" if result["holes"] else ""
    return f"{zones}{in_parts}{with_holes}, {_area(result)}"


def _area(result: Mapping[str, Any]) -> str:
    """Return the ground that is sprayed, and that of the file where it reaches further."""
    own, inside = result["map_area_ha"], result["area_ha"]
    if abs(own - inside) <= 5e-5:
        return f"{inside:.4f} ha"
    return f"{own:.4f} ha, {inside:.4f} ha to spray"


def _rates(result: Mapping[str, Any]) -> str:
    rates: Sequence[float] = result["rates_l_ha"]
    if len(rates) <= RATES_SHOWN_MAX:
        text = " ".join(f"{value:g}" for value in rates) or "none"
    else:
        text = f"{len(rates)} from {rates[0]:g} to {rates[-1]:g}"
    return f"rates [L/ha] from {result['rate_field']!r} in {result['unit']}: {text}"


def _amount(result: Mapping[str, Any]) -> str:
    mean = result["mean_rate_l_ha"]
    text = f"{result['litres']:.1f} L in all"
    text += "" if mean is None else f", {mean:.4g} L/ha on average"
    text += f"; {result['zero_ha']:.3f} ha at rate 0" if result["zero_ha"] else ""
    return text + (
        f"; {result['no_rate_ha']:.3f} ha without a rate" if result["no_rate_ha"] else ""
    )


def _ground(result: Mapping[str, Any]) -> str:
    if result["boundary_ha"] is None:
        boundary = "none; the outline of all zones is the border"
    else:
        boundary = f"{result['boundary_ha']:.4f} ha, from the {result['boundary_from']}"
    default = result["default_rate_l_ha"]
    south, east = result["bounds"][1], result["bounds"][2]
    west, north = result["bounds"][0], result["bounds"][3]
    return (
        f"from {south:.5f}, {west:.5f} to {north:.5f}, {east:.5f}; boundary: {boundary}; "
        f"default rate: {'none' if default is None else f'{default:g} L/ha'}"
    )


def _problems(problems: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Yield a line for each problem; many of a kind stand together and are counted."""
    ranks = {problem["code"]: rank for rank, problem in reversed(list(enumerate(problems)))}

    def kind(problem: Mapping[str, Any]) -> tuple[bool, int]:
        return problem["severity"] != "error", ranks[problem["code"]]

    kinds = [list(alike) for _, alike in groupby(sorted(problems, key=kind), key=kind)]
    for alike in kinds[:KINDS_SHOWN_MAX]:
        for problem in alike[:ALIKE_SHOWN_MAX]:
            line = f"{problem_line(problem)} [{problem['code']}]"
            yield line if len(line) <= LINE_MAX else f"{line[: LINE_MAX - 3]}..."
        left = len(alike) - ALIKE_SHOWN_MAX
        if left > 0:
            yield f"  and {left} more of the kind {alike[0]['code']} (--json lists them)"
    if len(kinds) > KINDS_SHOWN_MAX:
        yield f"and {len(kinds) - KINDS_SHOWN_MAX} more kinds of warnings (--json lists them)"


def _verdict(result: Mapping[str, Any]) -> str:
    severities = [problem["severity"] for problem in result["problems"]]
    found = [
        counted(severities.count(name), name) for name in ("error", "warning") if name in severities
    ]
    return ("ok" if result["ok"] else "not usable") + (f": {', '.join(found)}" if found else "")
