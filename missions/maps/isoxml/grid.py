"""Grids of an ISOXML task: type 1, a treatment zone's code for each cell; type 2, its values.

A and B of a GRD are the minimum north and east, so the corner in the south-west; C and D the size
of a cell in degrees; E and F the numbers of columns and rows. Rows go from south to north, the
cells of a row from west to east; type 2 holds 32-bit integers with the low byte first, for each
cell one for every process data variable of its treatment zone.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray
from shapely import MultiPolygon
from shapely.errors import ShapelyError

from missions.maps.crs import WGS84
from missions.maps.isoxml.field import check_grid_in_field
from missions.maps.isoxml.files import TaskFiles
from missions.maps.isoxml.grid_shape import (
    CELLS_MAX,
    GridShape,
    check_length,
    declared_length,
    grid_shape,
)
from missions.maps.isoxml.rates import (
    Rates,
    check_shown,
    key_among,
    rates_of,
    shown_in_zones,
    special_problems,
)
from missions.maps.isoxml.references import References
from missions.maps.isoxml.task import Task, TreatmentZone
from missions.maps.isoxml.values import EXPORT_AGAIN, integer, text
from missions.maps.layer import Band, Grid
from missions.maps.model import Problem, map_error


def grid_of_task(
    files: TaskFiles,
    element: Element,
    task: Task,
    references: References,
    boundary: MultiPolygon | None,
) -> Grid:
    """Return the cells of the task's grid, one band for each product."""
    shape = grid_shape(element, files.path)
    content = files.referred(shape.name, ".bin")
    if shape.type == 1:
        bands, problems = _by_codes(shape, content, task, references)
    else:
        bands, problems = _by_values(shape, content, element, task, references)
    problems = [*declared_length(shape, content), *problems]
    if boundary is not None:
        most = bands[0].values if len(bands) == 1 else np.fmax.reduce([b.values for b in bands])
        problems += _in_field(most, shape, boundary, files.path)
    return Grid(
        format="isoxml",
        crs=WGS84,
        transform=shape.transform,
        bands=tuple(bands),
        sha256=files.sha256,
        boundary=boundary,
        problems=tuple(problems),
    )


def _in_field(
    rates: NDArray[np.float64], shape: GridShape, boundary: MultiPolygon, path: Path
) -> list[Problem]:
    try:
        return check_grid_in_field(rates, shape.transform, boundary, path)
    except ShapelyError as error:
        raise map_error(
            path,
            f"grid and field cannot be compared ({str(error)[:120]})",
            fix=EXPORT_AGAIN,
            code="broken-geometry",
        ) from None


def _by_codes(
    shape: GridShape, content: bytes, task: Task, references: References
) -> tuple[list[Band], list[Problem]]:
    """Return the bands of a grid of type 1."""
    path = references.path
    check_length(shape, content, path, cell_bytes=1, bands=1)
    codes = np.frombuffer(content, dtype=np.uint8).reshape(shape.rows, shape.columns)
    counts = np.bincount(codes.ravel(), minlength=256)
    undefined = [code for code in np.flatnonzero(counts).tolist() if code not in task.zones]
    if undefined:
        shown = ", ".join(map(str, undefined[:30])) + (", …" if len(undefined) > 30 else "")
        raise map_error(
            path,
            f"{int(counts[undefined].sum())} of {codes.size} cells of its grid have codes that "
            f"are no treatment zone of task {task.id[:40]}: {shown}",
            fix="export the task again with all of its treatment zones",
            code="undefined-code",
        )
    rates, problems = rates_of(task, references)
    used = [one for one in rates if any(counts[code] for code in one.by_code if code < 256)]
    if not used:
        raise _no_rate(task, path)
    if codes.size * len(used) > CELLS_MAX:
        check_length(shape, content, path, cell_bytes=1, bands=len(used))
    bands = []
    for one in used:
        problems += check_shown(one, shown_in_zones(one), references)
        table = np.full(256, np.nan)
        for code in one.by_code:
            amount = one.amount(code)
            if amount is not None and code < 256:
                table[code] = amount
        bands.append(_band(one, table[codes], task))
    return bands, [*problems, *special_problems(task, used)]


def _by_values(
    shape: GridShape, content: bytes, element: Element, task: Task, references: References
) -> tuple[list[Band], list[Problem]]:
    """Return the bands of a grid of type 2, for the variables of the zone that the grid names."""
    path = references.path
    zone = _template(element, task, path)
    count = len(zone.variables)
    if not count:
        raise _no_rate(task, path)
    check_length(shape, content, path, cell_bytes=4, bands=count)
    raw = np.frombuffer(content, dtype="<i4").reshape(shape.rows, shape.columns, count)
    rates, problems = rates_of(task, references)
    bands, used = [], []
    for index, variable in enumerate(zone.variables):
        one = key_among(rates, zone.code, variable)
        if one is None:
            continue
        own = raw[:, :, index]
        shown = {variable.presentation: (int(own.min()), int(own.max()))}
        problems += check_shown(one, shown, references)
        bands.append(_band(one, own / one.family.raw_per_unit, task))
        used.append(one)
    if not bands:
        raise _no_rate(task, path)
    return bands, [*problems, *special_problems(task, used)]


def _template(element: Element, task: Task, path: Path) -> TreatmentZone:
    """Return the treatment zone whose variables a grid of type 2 holds."""
    if text(element, "J") is None:
        raise map_error(
            path,
            "its grid of type 2 does not name the treatment zone whose values it holds (J)",
            fix=EXPORT_AGAIN,
            code="undefined-code",
        )
    code = integer(element, "J", path, low=0, high=254)
    if code not in task.zones:
        raise map_error(
            path,
            f"its grid holds values of treatment zone {code}, which task {task.id[:40]} does not "
            "have",
            fix=EXPORT_AGAIN,
            code="undefined-code",
        )
    return task.zones[code]


def _band(one: Rates, values: NDArray[np.float64], task: Task) -> Band:
    return Band(
        name=one.name,
        values=values,
        unit=one.family.unit,
        is_rate=True,
        default=one.amount(task.default_code),
    )


def _no_rate(task: Task, path: Path) -> Exception:
    return map_error(
        path,
        f"no treatment zone in the grid of task {task.id[:40]} has a rate",
        fix="export the task with an application rate by volume, DDI 0001",
        code="no-rate-column",
    )
