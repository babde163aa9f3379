"""The field of an ISOXML task: its outline, and whether a grid lies in it at all."""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import MultiPolygon, box

from missions.maps.crs import WGS84
from missions.maps.isoxml.polygons import (
    FIELD,
    OBSTACLES,
    ground_of_polygons,
    point_count,
)
from missions.maps.isoxml.task import ById, Task
from missions.maps.isoxml.values import EXPORT_AGAIN, children
from missions.maps.layer import check_counts
from missions.maps.local import Area, polygons_of
from missions.maps.model import Affine, Problem, map_error
from missions.maps.outline import outline_of

# A grid covers its field but for the cells along its edge, and sprays nothing beyond it but what
# those cells stick out.
_COVERED_MIN = 0.90
_OUTSIDE_MAX = 0.05
# So many of the sprayed cells are tried, evenly spread, whatever the size of the grid.
_TRIED_MAX = 50_000


def field_of(root: Element, task: Task, path: Path) -> tuple[MultiPolygon | None, list[Problem]]:
    """Return the outline of the field that the task names, in longitude and latitude."""
    if task.field is None:
        return None, []
    field = ById(root, "PFD", path).get(task.field)
    if field is None:
        problem = Problem(
            severity="warning",
            code="undefined-code",
            text=f"the task is for the field {task.field[:40]}, which the file does not have; "
            "the map has no outline",
            where=task.id,
            fix=EXPORT_AGAIN,
        )
        return None, [problem]
    polygons = children(field, "PLN")
    check_counts(path, records=len(polygons), vertices=point_count(polygons))
    ground, others = ground_of_polygons(polygons, (FIELD,), where=f"field {task.field}", path=path)
    blocked, rest = ground_of_polygons(polygons, OBSTACLES, where=f"field {task.field}", path=path)
    objects = others - (len(polygons) - rest)
    outline = outline_of([ground], WGS84, path)
    problems = []
    if outline is not None and blocked is not None:
        outline, taken = _without(outline, blocked, path)
        problems.append(_field_objects(task.field, taken))
    if objects:
        problems.append(
            Problem(
                severity="warning",
                code="field-objects",
                text=f"the field has {objects} other polygons (headland, buffer zones), which are "
                "not taken out of the map",
                where=task.field,
                fix="give what must not be sprayed as an exclusion (prescription.exclusions)",
            )
        )
    return outline, problems


def _without(outline: MultiPolygon, blocked: Area, path: Path) -> tuple[MultiPolygon, float]:
    """Return the outline without its obstacles, and which part of it they take, 0 to 1."""
    ground = outline_of([blocked], WGS84, path) or MultiPolygon()
    left = MultiPolygon(polygons_of(shapely.difference(outline, ground)))
    if left.is_empty:
        raise map_error(
            path,
            "water, buildings, roads and obstacles cover the whole field",
            fix=EXPORT_AGAIN,
            code="field-objects",
        )
    return left, 1.0 - left.area / outline.area


def _field_objects(field: str, taken: float) -> Problem:
    return Problem(
        severity="warning",
        code="field-objects",
        text="water, buildings, roads, obstacles and windbreaks of the field are taken out of the "
        f"ground to spray, {100 * taken:.2g} % of it",
        where=field,
        fix="nothing, if they are where the field has them",
    )


def check_grid_in_field(
    rates: NDArray[np.float64], transform: Affine, boundary: MultiPolygon, path: Path
) -> list[Problem]:
    """Return what is wrong with the place of a grid; refuse one whose axes are exchanged.

    `rates` are of any unit; more than 0 is sprayed. The comparison is in degrees, which changes
    no share of an area as small as a field by more than a few parts in a thousand.
    """
    rows, columns = rates.shape
    east, _, west, _, north, south = transform
    grid = box(west, south, west + columns * east, south + rows * north)
    covered = grid.intersection(boundary).area / boundary.area
    if covered == 0.0:
        exchanged = box(south, west, south + columns * east, west + rows * north)
        if exchanged.intersects(boundary):
            raise map_error(
                path,
                "its grid lies in its field only with latitude and longitude exchanged",
                fix="export the grid with north in A and east in B",
                code="swapped-axes",
            )
        return [_problem("error", "the grid lies wholly outside its own field", grid.bounds)]
    problems = []
    if not covered >= _COVERED_MIN:
        said = f"the grid covers {100 * covered:.0f} % of its own field"
        problems.append(_problem("warning", said, grid.bounds))
    outside = _share_outside(rates, transform, boundary)
    if not outside <= _OUTSIDE_MAX:
        said = f"{100 * outside:.0f} % of the cells to spray lie outside the field"
        problems.append(_problem("warning", said, grid.bounds))
    return problems


def _share_outside(rates: NDArray[np.float64], transform: Affine, boundary: MultiPolygon) -> float:
    """Return the share of the sprayed cells that lie outside the boundary as a whole."""
    east, _, west, _, north, south = transform
    # `flatnonzero` of a comparison: NaN is not sprayed.
    sprayed = np.flatnonzero(rates > 0.0)
    if not len(sprayed):
        return 0.0
    tried = sprayed[:: max(1, len(sprayed) // _TRIED_MAX)]
    row, column = np.divmod(tried, rates.shape[1])
    around = boundary.buffer(float(np.hypot(east, north)) / 2.0)
    shapely.prepare(around)
    inside = shapely.contains_xy(around, west + (column + 0.5) * east, south + (row + 0.5) * north)
    return float(1.0 - inside.mean())


def _problem(severity: str, said: str, bounds: tuple[float, ...]) -> Problem:
    west, south, east, north = bounds
    return Problem(
        severity="error" if severity == "error" else "warning",
        code="grid-outside-field",
        text=said,
        where=f"grid {south:.6f} to {north:.6f} N, {west:.6f} to {east:.6f} E",
        fix="check that grid and field of the task belong together",
    )
