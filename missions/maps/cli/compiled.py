"""`vrspray map compile`: the flight map, the only map that a flight opens."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from companion.cli.answer import AsJson, Overrides, answer, problem_line, problem_object
from companion.config import Config, load
from companion.config.tables import PrescriptionTable
from companion.flight_map import SUFFIX, FlightMap, is_flight_map, write_flight_map
from companion.problem import Problem
from missions.maps.cli.options import File
from missions.maps.cli.plan import plan_of, sprayer_problems
from missions.maps.compiling import MapOrder, compile_map, read_ordered_map
from missions.maps.lint import check_map
from missions.maps.model import MapFile, map_error
from missions.maps.whole_file import check_folder, not_written

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
        typer.Option("--overlap", metavar="P", help="Where zones overlap, without --config."),
    ] = None,
    overrides: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Compile a map, its boundary, exclusions and planned lines into what the vehicle opens.

    Exit 0: compiled; 1: compiled, and the check of the map found errors; 2: it cannot be flown.
    """
    if not is_flight_map(out):
        raise typer.BadParameter(f"--out has to end in {SUFFIX}")
    if is_flight_map(file):
        raise map_error(file, "this is a flight map already", fix="name the map it is made of")
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
        [*map(problem_line, problems), _verdict(written)],
        as_json=as_json,
    )
    raise typer.Exit(0 if ok else 1)


def _order(file: Path, config: Config | None, overlap: str | None) -> MapOrder:
    """Return what is to be compiled: the map that was named, by the rules of the configuration."""
    own = None if config is None or config.prescription is None else config.prescription.file
    is_own = config is not None and own is not None and _is_same(config.resolve(own), file)
    changes: dict[str, object] = {"file": own if is_own else str(file.absolute())}
    if overlap is not None:
        changes["overlap"] = overlap
    if config is None or config.prescription is None:
        table = PrescriptionTable.model_validate(changes)
    else:
        table = config.prescription.model_copy(update=changes)
    if config is None:
        return MapOrder(table=table)
    lines = None if config.mission is None else config.mission.lines
    return MapOrder(table=table, lines=lines, folder=config.path.parent, config=config.path)


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


def _verdict(flight_map: FlightMap) -> str:
    rates = flight_map.prescription.rates_l_ha
    span = f"{min(rates):g} to {max(rates):g} L/ha" if rates else "no rates"
    return (
        f"{flight_map.path}: flight map {flight_map.sha256[:8]} of {flight_map.source}, "
        f"{flight_map.prescription.field.area / 1e4:.2f} ha, {span}"
    )
