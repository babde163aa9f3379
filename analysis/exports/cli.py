"""Command line of the exports: a journal in, a file that others read out; and which formats."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from analysis.exports.output import ExportError
from analysis.exports.source import Shape
from companion.cli.answer import AsJson, JournalFiles, answer, new_app, note
from companion.wording import CUT

if TYPE_CHECKING:
    from analysis.exports.columns import System
    from analysis.exports.output import Content
    from analysis.exports.source import Source
    from analysis.flown.applied_flight import AppliedFlight
    from companion.errors import UnreadableError

# ------------------------------------------------------------------------------------------ formats

Make = Callable[["Source", Path], "Content"]
_MODULES = "analysis.exports."


@dataclass(frozen=True, slots=True, kw_only=True)
class Format:
    """A format; `make` is `module:function`, `shapes` what a row may be, the usual one first.

    `suffixes` choose it without its name, `also` only with it. With `has_units` it can be had in
    other units than the recorded ones; others have units of their own.
    """

    name: str
    description: str
    make: str
    suffixes: tuple[str, ...]
    also: tuple[str, ...] = ()
    shapes: tuple[Shape, ...] = ("points",)
    has_units: bool = False
    has_rate: bool = True

    def maker(self) -> Make:
        """Return the function that makes it, imported now."""
        module, _, function = self.make.partition(":")
        found: Make = getattr(import_module(_MODULES + module), function)
        return found


FORMATS = (
    Format(
        name="csv", description="points, one a row", make="csv_tables:make_points",
        suffixes=(".csv",), has_units=True,
    ),
    Format(
        name="csv-samples", description="path and flow of each valve every 10 ms",
        make="csv_tables:make_samples", suffixes=(), also=(".csv",), shapes=("steps",),
        has_rate=False,
    ),
    Format(
        name="geojson", description="points or swaths", make="geojson:make",
        suffixes=(".geojson", ".json"), shapes=("points", "swaths"), has_units=True,
    ),
    Format(
        name="geojsonl", description="points or swaths, one a line", make="geojson:make_lines",
        suffixes=(".geojsonl", ".geojsons", ".ndjson"), shapes=("points", "swaths"),
        has_units=True,
    ),
    Format(
        name="kml", description="swaths coloured by rate, for Google Earth", make="kml:make",
        suffixes=(".kml", ".kmz"), shapes=("swaths",), has_units=True, has_rate=False,
    ),
    Format(
        name="shapefile", description="points or swaths, units beside", make="shape:make",
        suffixes=(".shp", ".zip"), shapes=("points", "swaths"), has_units=True,
    ),
    Format(
        name="isoxml", description="ISO 11783-10 task data and time log", make="isoxml_task:make",
        suffixes=(), also=("", ".zip"),
    ),
    Format(
        name="geoparquet", description="swaths or points", make="geoparquet:make",
        suffixes=(".parquet", ".geoparquet"), shapes=("swaths", "points"),
    ),
    Format(
        name="adapt", description="ADAPT standard: adapt.json and GeoParquet",
        make="geoparquet:make_adapt", suffixes=(), also=("", ".zip"), shapes=("swaths",),
        has_rate=False,
    ),
    Format(
        name="mcap", description="messages for Foxglove and its kin", make="mcap_file:make",
        suffixes=(".mcap",),
    ),
)  # fmt: skip
# A terminal looks for a folder of this name.
_TASK_DATA = "taskdata"


def format_for(out: Path, name: str | None) -> Format:
    """Return the format that is asked for by name, or by how the file is called."""
    suffix = out.suffix.casefold()
    if name is None:
        if out.name.casefold() == _TASK_DATA:
            return _named("isoxml")
        found = next((each for each in FORMATS if suffix in each.suffixes), None)
        if found is None:
            raise ExportError(
                f"{out}: no format is known by {suffix or 'a name without an end'}; there are "
                f"{', '.join(_ends())}, a folder TASKDATA, or --format "
                f"{', '.join(each.name for each in FORMATS)}"
            )
        return found
    found = _named(name)
    if suffix not in found.suffixes + found.also:
        ends = [end for end in found.suffixes + found.also if end]
        folder = "a folder (a name without a dot) or into " if "" in found.also else ""
        raise ExportError(
            f"{out}: {found.name} is written into {folder}a file whose name ends in "
            f"{' or '.join(ends)}"
        )
    return found


def _named(name: str) -> Format:
    found = next((each for each in FORMATS if each.name == name), None)
    if found is None:
        names = ", ".join(each.name for each in FORMATS)
        raise ExportError(f"there is no format {name!r}; there are {names}")
    return found


def _ends() -> list[str]:
    return [suffix for each in FORMATS for suffix in each.suffixes]


# -------------------------------------------------------------------------------------- the command

app = new_app()
RATE_HZ_MAX = 1000.0


@app.command(epilog="Example: vrspray export flights/flight-0001.gpkg --out flight-0001.geojson")
def export_journal(
    journals: JournalFiles,
    out: Annotated[Path, typer.Option(help="File to write; the suffix sets the format.")],
    name: Annotated[
        str | None,
        typer.Option(
            "--format",
            help="csv, csv-samples, geojson, geojsonl, kml, shapefile, isoxml, geoparquet, "
            "adapt, mcap; default: by the end of OUT.",
        ),
    ] = None,
    shape: Annotated[
        str | None,
        typer.Option(
            "--geometry", help="points (of the path) or swaths (ground treated by each valve)."
        ),
    ] = None,
    rate_hz: Annotated[
        float | None,
        typer.Option("--rate-hz", help="Points per second; default: all of the journal."),
    ] = None,
    units: Annotated[
        str, typer.Option(help="metric or us; not for formats with their own units.")
    ] = ("metric"),
    force: Annotated[bool, typer.Option("--force", help="Replace existing files.")] = False,
    as_json: AsJson = False,
) -> None:
    """Export what was applied, for farm software and map programs.

    Exit 0: all of the flight; 1: the journal was cut, is damaged, lacks rows or is of another
    version, and what can be read was written; 2: no journal, or an option or OUT cannot be used.
    """
    from analysis.exports.source import Source
    from analysis.flown.applied_record import EvaluationError

    form = format_for(out, name)
    system = _system(form, units)
    chosen = _shape(form, shape)
    _check_rate(form, rate_hz)
    _check_free(out, force=force)
    form.maker()  # what is not installed is said before the work
    if len(journals) > 1:
        journals = _of_a_job(form, journals)
    also: tuple[Source, ...] = ()
    warnings: list[str] = []
    for journal in journals[::-1]:
        note(f"reading {journal}")
        unread: list[str] = []
        flight = _read(journal, unread)
        source = Source(
            flight=flight,
            shape=chosen,
            system=system,
            rate_hz=rate_hz,
            unread=tuple(unread),
            also=also if journal is journals[0] else (),
        )
        also = (source, *also)
        warnings += [*_warnings(flight), *(f"not read: {each}" for each in unread)]
    if len({each.valve_names for each in also}) > 1:
        raise ExportError("the sorties were flown with other valves; export each by itself")
    note(f"writing {out} ({form.name})")
    try:
        size = _write(source, form, out, force=force)
    except EvaluationError as error:
        if not warnings:
            raise
        raise _too_little(flight, unread) from error
    result = {
        "out": str(out),
        "format": form.name,
        "geometry": source.shape,
        "units": system,
        "bytes": size,
        **{key: value for key, value in source.facts().items() if key != "units"},
        "warnings": warnings,
    }
    answer(result, [_sentence(result)], as_json=as_json)
    for warning in warnings:
        note(f"warning: {warning}")
    raise typer.Exit(1 if warnings else 0)


def _of_a_job(form: Format, journals: list[Path]) -> list[Path]:
    """Return the journals in order of time; ExportError where a file holds one flight."""
    from analysis.journals.jobs import one_job

    if form.shapes == ("steps",):
        raise ExportError(f"{form.name} holds one flight; export each sortie by itself")
    return [each.path for each in one_job(journals)]


def _read(journal: Path, unread: list[str]) -> AppliedFlight:
    """Return the flight; what of it is damaged is left out and said in `unread`."""
    from analysis.exports.output import ExportError
    from analysis.flown.read_applied import read_applied

    flight = read_applied(journal, unread=unread)
    if len(flight.time_s):
        return flight
    if unread or flight.lost:
        raise _too_little(flight, unread)
    raise ExportError(f"{journal}: the flight has no position, so there is nothing to export")


def _too_little(flight: AppliedFlight, unread: list[str]) -> UnreadableError:
    from companion.errors import UnreadableError

    why = unread[0] if unread else f"{flight.lost} rows are missing"
    return UnreadableError(
        f"{flight.path}: is damaged: too little of its path can be read ({why}); there is nothing "
        "to export; see vrspray flights show"
    )


def _write(source: Source, form: Format, out: Path, *, force: bool) -> int:
    from analysis.exports.output import write_beside, write_folder

    content = form.maker()(source, out)
    is_folder = out.name not in content
    return (write_folder if is_folder else write_beside)(out, content, force=force)


def _system(form: Format, units: str) -> System:
    from analysis.exports.columns import SYSTEMS
    from analysis.exports.output import ExportError

    found = next((each for each in SYSTEMS if each == units), None)
    if found is None:
        raise ExportError(f"--units {units}: there are {' and '.join(SYSTEMS)}")
    if found != "metric" and not form.has_units:
        raise ExportError(f"--units {units}: {form.name} has units of its own; leave it out")
    return found


def _shape(form: Format, shape: str | None) -> Shape:
    from analysis.exports.output import ExportError

    if shape is None:
        return form.shapes[0]
    found = next((each for each in form.shapes if each == shape), None)
    if found is None:
        raise ExportError(f"--geometry {shape}: {form.name} has {' or '.join(form.shapes)}")
    return found


def _check_rate(form: Format, rate_hz: float | None) -> None:
    from analysis.exports.output import ExportError

    if rate_hz is None:
        return
    if not 0.0 < rate_hz <= RATE_HZ_MAX:
        raise ExportError(f"--rate-hz {rate_hz:g}: must lie in (0, {RATE_HZ_MAX:g}]")
    if not form.has_rate:
        raise ExportError(f"--rate-hz {rate_hz:g}: {form.name} has no points to thin; leave it out")


def _check_free(out: Path, *, force: bool) -> None:
    """Refuse before reading what would be refused after it."""
    from analysis.exports.output import check_free

    check_free(out, [out.name], force=force)


def _warnings(flight: AppliedFlight) -> list[str]:
    found = []
    if not flight.is_closed:
        found.append(CUT)
    if flight.lost:
        found.append(f"{flight.lost} rows are missing in the journal")
    return found


def _sentence(result: dict[str, object]) -> str:
    rows = {"points": "points", "swaths": "polygons", "steps": "rows"}[str(result["geometry"])]
    mark = (
        ""
        if result["training"] in ("no", "unknown", "simulated")
        else f", training: {result['training']}"
    )
    mark += ", SIMULATED" if result["simulated"] == "yes" else ""
    metered_l = result["metered_l"]
    meter = "" if metered_l is None else f" ({metered_l:.3f} L by the flow meter)"
    return (
        f"{result['out']}: {result['rows']} {rows}, {result['volume_l']:.3f} L modelled"
        f"{meter}, {result['bytes']} bytes{mark}"
    )


# What the program's own command line takes in: one command of the kind that Typer makes.
export = typer.main.get_command(app)
