"""The files of several aircraft: one set for each, numbered beside the one that was asked for."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from missions.files.fence import Fences
from missions.files.write import lines_path, write_plan
from missions.plan import Plan


def fleet_path(out: Path, aircraft: int, count: int) -> Path:
    """Return the file of one aircraft.

    >>> fleet_path(Path("m.plan"), 2, 3).name, fleet_path(Path("m.plan"), 1, 1).name
    ('m-a2.plan', 'm.plan')
    """
    return out if count == 1 else out.with_name(f"{out.stem}-a{aircraft}{out.suffix}")


def write_fleet(
    plan: Plan, out: Path, *, with_sprayer: bool = False, fences: Fences | None = None
) -> tuple[list[Path], list[Path]]:
    """Write the files of every aircraft; return the missions, and the lines for their sprayers.

    The first sortie of an aircraft is in its first file, whatever its number in the whole plan.
    """
    crafts = sorted({sortie.aircraft for sortie in plan.sorties})
    count = max(crafts)
    files: list[Path] = []
    marks: list[Path] = []
    for aircraft in crafts:
        own = [sortie for sortie in plan.sorties if sortie.aircraft == aircraft]
        path = fleet_path(out, aircraft, count)
        files += write_plan(
            replace(plan, sorties=tuple(own)), path, with_sprayer=with_sprayer, fences=fences
        )
        lines = lines_path(path)
        if lines is not None:
            marks.append(lines)
    return files, marks
