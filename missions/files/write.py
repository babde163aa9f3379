"""Writing a plan; the suffix says in which format."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from missions.errors import PlanError
from missions.files.fence import Fences
from missions.files.geojson import geojson_text
from missions.files.kml import kml_text
from missions.files.plan_file import plan_text
from missions.files.waypoints import waypoints_text
from missions.maps.whole_file import write_whole
from missions.plan import Plan

ONE_SORTIE = (".plan", ".waypoints")
FORMATS = (*ONE_SORTIE, ".geojson", ".kml")


def check_suffix(out: Path) -> None:
    """Refuse a file whose suffix names no format."""
    if out.suffix.casefold() not in FORMATS:
        raise PlanError(
            f"--out {out}: the format {out.suffix or 'without a suffix'} is not known; "
            f"take one of {', '.join(FORMATS)}"
        )


def paths_of(out: Path, sorties: int) -> list[Path]:
    """Return the files that are written: of formats for one sortie, one for each.

    The first sortie is in the file that was asked for, the others are numbered beside it.

    >>> [path.name for path in paths_of(Path("m.plan"), 3)]
    ['m.plan', 'm-2.plan', 'm-3.plan']
    """
    if out.suffix.casefold() not in ONE_SORTIE:
        return [out]
    more = [out.with_name(f"{out.stem}-{number}{out.suffix}") for number in range(2, sorties + 1)]
    return [out, *more]


def lines_path(out: Path) -> Path | None:
    """Return where the lines of a plan are, for `mission.lines`; None for a format to look at.

    >>> lines_path(Path("m.plan")), lines_path(Path("m.kml"))
    (PosixPath('m.lines.geojson'), None)
    """
    suffix = out.suffix.casefold()
    if suffix == ".geojson":
        return out
    return out.with_name(f"{out.stem}.lines.geojson") if suffix in ONE_SORTIE else None


def older_sorties(out: Path, written: Sequence[Path]) -> list[Path]:
    """Return missions that are named as if they were more sorties of this plan."""
    if out.suffix.casefold() not in ONE_SORTIE:
        return []
    names = re.compile(re.escape(out.stem) + r"(-a\d+)?(-\d+)?" + re.escape(out.suffix))
    found = [
        path
        for path in out.parent.iterdir()
        if names.fullmatch(path.name) and path not in written and path.is_file()
    ]
    return sorted(found, key=lambda path: (len(path.name), path.name))


def write_plan(
    plan: Plan, out: Path, *, with_sprayer: bool = False, fences: Fences | None = None
) -> list[Path]:
    """Write the plan and return its files; all texts are made before the first is written.

    The lines, beside missions that have no marks for them, are not among these files.
    """
    check_suffix(out)
    suffix = out.suffix.casefold()
    if suffix == ".geojson":
        texts = [geojson_text(plan)]
    elif suffix == ".kml":
        texts = [kml_text(plan)]
    elif suffix == ".plan":
        fences = fences or Fences(plan)
        texts = [
            plan_text(plan, each, with_sprayer=with_sprayer, fences=fences) for each in plan.sorties
        ]
    else:
        texts = [waypoints_text(plan, each, with_sprayer=with_sprayer) for each in plan.sorties]
    paths = paths_of(out, len(texts))
    marks = lines_path(out)
    if marks is not None and marks not in paths:
        # First: whoever finds a mission finds its lines.
        write_whole(marks, geojson_text(plan).encode("utf-8"))
    for path, text in zip(paths, texts, strict=True):
        write_whole(path, text.encode("utf-8"))
    return paths
