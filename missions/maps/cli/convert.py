"""`vrspray map convert` and `vrspray map show`: a map in another format, and as a picture."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from shapely import MultiPolygon

from companion.cli.answer import (
    AsJson,
    answer,
    note,
    note_problems,
    problem_object,
)
from companion.errors import MapError
from missions.maps.cli.options import File, Reading, reading_options
from missions.maps.convert.cell_zones import outline_of_rates
from missions.maps.convert.compare import CHANGE_MAX_L_HA, Comparison, compare
from missions.maps.convert.formats import Wish, keeps_cells, keeps_raster, write_map, writer_for
from missions.maps.lint.survey import Survey
from missions.maps.lint.zones import overlap_problems
from missions.maps.local import polygons_of
from missions.maps.model import MapFile, Problem, map_error
from missions.maps.registry import read_map
from missions.maps.totals import totals

NOT_PRESERVED = "not-preserved"
# What cells may change of the ground in all before somebody should know.
AREA_CHANGE_MAX = 0.001
# And of the ground at the edges, where what is left out and what is added make up for each other.
EDGE_MAX = 0.01
# Of the ground that has another rate, since edges of cells run elsewhere.
MOVED_MAX_PERCENT = 5.0
_OF_CELLS = ("geotiff", "dji", "text-map")
_OVERLAPS = ("max", "min", "mean", "last")

_Out = Annotated[
    Path, typer.Argument(metavar="OUT", help="File to write; the suffix sets the format.")
]
_Format = Annotated[
    str | None,
    typer.Option("--format", metavar="F", help="Format, if the suffix does not tell, as for .zip."),
]
_CellM = Annotated[
    float | None, typer.Option("--cell-m", metavar="M", help="Cell width; default: 1.")
]
_Overlap = Annotated[
    str | None,
    typer.Option(
        "--overlap", metavar="P", help="For cells where zones overlap: max, min, mean or last."
    ),
]
_Round = Annotated[
    float | None, typer.Option("--round", metavar="L_HA", help="Round rates to multiples of this.")
]
_Force = Annotated[bool, typer.Option("--force", help="Replace existing files.")]
_Picture = Annotated[
    Path, typer.Option("--out", metavar="PNG", help="Picture to write: .png, .svg or .pdf.")
]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Checked:
    """The written file, read back, and how it compares with its source."""

    written: MapFile
    comparison: Comparison


@reading_options
def convert(
    file: File,
    out: _Out,
    reading: Reading,
    format_name: _Format = None,
    cell_m: _CellM = None,
    overlap: _Overlap = None,
    round_l_ha: _Round = None,
    force: _Force = False,
    as_json: AsJson = False,
) -> None:
    """Write a map in another format, and verify it.

    It is read back and compared at 1000 places.

    Exit 1, and nothing written, where a rate would change by more than 0.01 L/ha. A text map in
    L/min is for the width and speed of --flow-width-m and --flow-speed-m-s.
    """
    if overlap is not None and overlap not in _OVERLAPS:
        raise typer.BadParameter(f"--overlap is one of {', '.join(_OVERLAPS)}, not {overlap!r}")
    writer = writer_for(out, format_name)
    source = reading.with_overlap(overlap).read(file)
    if round_l_ha is not None:
        source = _rounded(source, round_l_ha)
    wish = Wish(
        cell_m=cell_m,
        flow_width_m=_flow(reading, "flow_width_m"),
        flow_speed_m_s=_flow(reading, "flow_speed_m_s"),
        overlap=overlap or source.rule(reading.overlap),
    )
    checked: list[_Checked] = []
    try:
        files = write_map(
            source,
            out,
            format=writer.name,
            cell_m=cell_m,
            flow_width_m=wish.flow_width_m,
            flow_speed_m_s=wish.flow_speed_m_s,
            overlap=wish.overlap,
            force=force,
            check=lambda made: checked.append(_check(source, made, writer.name, wish)),
        )
    except MapError as error:
        if error.code != NOT_PRESERVED:
            raise
        answer({"ok": False, "error": str(error), "code": error.code}, [], as_json=as_json)
        note(f"error: {error}")
        raise typer.Exit(1) from None
    result = _result(file, out, files, writer.name, source, checked[0])
    note_problems(result)
    answer(result, _lines(result), as_json=as_json)


def _flow(reading: Reading, name: str) -> float | None:
    """Return width or speed for rates in L/min: of the command line, else of the configuration."""
    given: float | None = getattr(reading, name)
    if given is None and reading.config is not None and reading.config.prescription is not None:
        given = getattr(reading.config.prescription, name, None)
    return given


def _rounded(map_file: MapFile, step_l_ha: float) -> MapFile:
    """Return the map with rates that are multiples of the step."""
    if not 1e-6 <= step_l_ha <= 1000.0:
        raise typer.BadParameter(f"--round takes 0.000001 to 1000 L/ha, not {step_l_ha:g}")

    def rounded(rate_l_ha: float | None) -> float | None:
        return None if rate_l_ha is None else round(round(rate_l_ha / step_l_ha) * step_l_ha, 9)

    cells = map_file.cells
    if cells is not None:
        rates = np.round(np.rint(cells.rates_l_ha / step_l_ha) * step_l_ha, 9)
        cells = replace(cells, rates_l_ha=rates)
    return replace(
        map_file,
        cells=cells,
        zones=tuple(replace(zone, rate_l_ha=rounded(zone.rate_l_ha)) for zone in map_file.zones),
        default_rate_l_ha=rounded(map_file.default_rate_l_ha),
    )


def _check(source: MapFile, made: Path, format_name: str, wish: Wish) -> _Checked:
    """Return what was written, read back, or refuse it."""
    try:
        written = read_map(
            made,
            unit="L/ha" if format_name == "dji" else None,
            flow_width_m=wish.flow_width_m if format_name == "text-map" else None,
            flow_speed_m_s=wish.flow_speed_m_s if format_name == "text-map" else None,
        )
    except MapError as error:
        raise map_error(
            made,
            f"what was written does not read back ({str(error)[:200]})",
            fix="nothing is kept; take smaller cells (--cell-m) or another format"
            if format_name in _OF_CELLS
            else "nothing is kept; take another format",
            code=NOT_PRESERVED,
        ) from None
    cells = written.cells is not None
    keeps = keeps_raster if format_name == "geotiff" else keeps_cells
    clipped = format_name == "geotiff" and source.boundary is not None
    found = compare(
        source,
        written,
        overlaps=(wish.overlap,) if cells else ("min", "max", "last"),
        same_cells=format_name != "text-map" and keeps(source, wish) and not clipped,
        zero_is_none=format_name == "isoxml" and cells,
    )
    what = _objection(found)
    if what is not None:
        raise map_error(
            made,
            what,
            fix="nothing is kept; take smaller cells (--cell-m) or another format",
            code=NOT_PRESERVED,
        )
    return _Checked(written=written, comparison=found)


def _objection(found: Comparison) -> str | None:
    """Return why a written file is not to be kept, or None."""
    if not found.rated:
        return "no place with a rate is far enough from an edge to be compared with the source"
    latitude, longitude = found.worst or (0.0, 0.0)
    where = f"(at {latitude:.7f}, {longitude:.7f})"
    if found.lost:
        return (
            f"{found.lost} of {found.points} places have a rate in one file and none in the other "
            f"{where}"
        )
    if not found.change_l_ha <= CHANGE_MAX_L_HA:
        return f"a rate would change by {found.change_l_ha:.3g} L/ha {where}"
    return None


def _result(
    file: Path, out: Path, files: list[Path], format_name: str, source: MapFile, checked: _Checked
) -> dict[str, Any]:
    written = checked.written
    after, before = totals(written), totals(source)
    problems = list(source.problems)
    # Formats of zones keep them; who reads the file must have a rule for them.
    if source.overlap is None and format_name not in _OF_CELLS:
        shared = overlap_problems(Survey(source), "error")
        problems += [replace(found, severity="warning") for found in shared]
    lost_ha, beyond_ha = _at_edges(source, written, after.area_ha, before.area_ha)
    if format_name in _OF_CELLS:
        problems += _area_problems(out, after.area_ha, before.area_ha, (lost_ha, beyond_ha))
    problems += _moved(out, checked.comparison)
    shape = None if written.cells is None else written.cells.rates_l_ha.shape
    return {
        "ok": True,
        "in": str(file),
        "out": str(out),
        "files": [str(one) for one in files],
        "format": format_name,
        "zones": len(written.zones),
        "rows": None if shape is None else shape[0],
        "columns": None if shape is None else shape[1],
        "area_ha": after.area_ha,
        "litres": after.all_litres,
        "source_area_ha": before.area_ha,
        "source_litres": before.all_litres,
        "lost_ha": lost_ha,
        "beyond_ha": beyond_ha,
        "boundary": written.boundary is not None,
        "points_compared": checked.comparison.points,
        "max_rate_change_l_ha": checked.comparison.change_l_ha,
        "points_anywhere": checked.comparison.anywhere,
        "changed_percent": checked.comparison.changed_percent,
        "max_rate_change_anywhere_l_ha": checked.comparison.changed_max_l_ha,
        "problems": [problem_object(problem) for problem in problems],
    }


def _at_edges(
    source: MapFile, written: MapFile, after_ha: float, before_ha: float
) -> tuple[float, float]:
    """Return the ground with a rate that the written map lacks, and that it has beyond [ha]."""
    if written.cells is None:
        return 0.0, 0.0
    try:
        ground = outline_of_rates(source)
    except MapError:  # cells too speckled for an outline
        return 0.0, 0.0
    if source.boundary is not None:
        default = source.default_rate_l_ha is not None
        ground = source.boundary if default else _common(ground, source.boundary)
    kept_ha = 0.0
    if not ground.is_empty:
        inside = ground if written.boundary is None else _common(ground, written.boundary)
        kept_ha = totals(written, boundary=inside).area_ha if not inside.is_empty else 0.0
    lost_ha, beyond_ha = before_ha - kept_ha, after_ha - kept_ha
    rounding_ha = 1e-4 * before_ha
    return (
        lost_ha if lost_ha > rounding_ha else 0.0,
        beyond_ha if beyond_ha > rounding_ha else 0.0,
    )


def _common(one: MultiPolygon, two: MultiPolygon) -> MultiPolygon:
    return MultiPolygon(polygons_of(one.intersection(two)))


def _area_problems(
    out: Path, after_ha: float, before_ha: float, at_edges_ha: tuple[float, float]
) -> list[Problem]:
    """Return what to say where cells, which follow no border, hold other ground than the map."""
    lost_ha, beyond_ha = at_edges_ha
    if (
        abs(after_ha - before_ha) <= AREA_CHANGE_MAX * before_ha
        and max(lost_ha, beyond_ha) <= EDGE_MAX * before_ha
    ):
        return []
    return [
        Problem(
            severity="warning",
            code="area-changed",
            text=f"cells follow no border: {after_ha:.4f} ha have a rate, {before_ha:.4f} ha in "
            f"the source; {lost_ha:.4f} ha with a rate have none in it, and {beyond_ha:.4f} ha "
            "beyond have one",
            where=str(out),
            fix="take smaller cells with --cell-m, or a format that keeps borders (.gpkg, .shp)",
        )
    ]


def _moved(out: Path, found: Comparison) -> list[Problem]:
    """Return what to say where much of the ground has another rate than in the source."""
    if found.changed_percent is None or not found.changed_percent > MOVED_MAX_PERCENT:
        return []
    return [
        Problem(
            severity="warning",
            code="edges-moved",
            text=f"{found.changed_percent:.1f} % of the ground has another rate than in the "
            f"source, by up to {found.changed_max_l_ha:.3g} L/ha, or none: edges run along other "
            "cells",
            where=str(out),
            fix="take smaller cells with --cell-m, or a format that keeps edges (.gpkg, .tif of "
            "the same raster)",
        )
    ]


def _lines(result: dict[str, Any]) -> list[str]:
    ground = (
        f"{result['zones']} zones"
        if result["rows"] is None
        else f"{result['rows']} x {result['columns']} cells"
    )
    return [
        f"{result['out']}: {result['format']}, {ground}, {result['area_ha']:.4f} ha, "
        f"{result['litres']:.1f} L",
        f"source: {result['source_area_ha']:.4f} ha, {result['source_litres']:.1f} L",
        f"largest difference at {result['points_compared']} places"
        f"{'' if result['changed_percent'] is None else ' away from edges'}: "
        f"{result['max_rate_change_l_ha']:.3g} L/ha",
        *_anywhere(result),
        *(f"also written: {name}" for name in result["files"] if name != result["out"]),
    ]


def _anywhere(result: dict[str, Any]) -> list[str]:
    if result["changed_percent"] is None:
        return []
    return [
        f"{result['changed_percent']:.1f} % of {result['points_anywhere']} places anywhere have "
        "another rate, or one in one of the files alone; rates differ by up to "
        f"{result['max_rate_change_anywhere_l_ha']:.3g} L/ha"
    ]


@reading_options
def show(file: File, reading: Reading, out: _Picture, as_json: AsJson = False) -> None:
    """Draw a map: its rates with a legend, north and a scale."""
    from missions.maps.picture import draw

    source = reading.read(file)
    drawn = draw(source, out, title=file.name)
    result: dict[str, Any] = {
        "in": str(file),
        "out": str(out),
        "rates_l_ha": drawn.rates_l_ha.tolist(),
        "area_ha": drawn.area_ha,
        "litres": drawn.all_litres,
        "problems": [problem_object(problem) for problem in source.problems],
    }
    note_problems(result)
    answer(
        result,
        [
            f"{out}: {len(drawn.rates_l_ha)} rates on {drawn.area_ha:.4f} ha, "
            f"{drawn.all_litres:.1f} L"
        ],
        as_json=as_json,
    )
