"""ISOXML task data, version 3 and 4 (ISO 11783-10): grids of type 1 and 2, and polygons."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from missions.maps.isoxml.contents import instead_of
from missions.maps.isoxml.field import field_of
from missions.maps.isoxml.files import TaskFiles
from missions.maps.isoxml.grid import grid_of_task
from missions.maps.isoxml.references import References, product_names
from missions.maps.isoxml.task import chosen_task
from missions.maps.isoxml.zones import zones_layer
from missions.maps.layer import Grid, Layer


def read_isoxml(path: Path, layer: str | None = None) -> Layer | Grid:
    """Return what a task prescribes, from a TASKDATA.XML, its folder, or a zip of it.

    `layer` is the id or the designator of one of several tasks.
    """
    files = TaskFiles(path)
    task, tasks = chosen_task(files.root, path, layer, product_names(files.root))
    instead = instead_of(task.id, tasks)
    references = References(files.root, path, instead)
    boundary, problems = field_of(files.root, task, path)
    found: Layer | Grid
    if task.grid is not None:
        found = grid_of_task(files, task.grid, task, references, boundary)
    else:
        found = zones_layer(files, task, references, boundary)
    return replace(found, instead=instead, problems=(*files.problems, *problems, *found.problems))
