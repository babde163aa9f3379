"""A campaign whose flights are short: the beginning of one pass over the example's field."""

from __future__ import annotations

import shutil
from pathlib import Path

from sitl.anyang import EXAMPLE

# Home, take-off, 5 m/s, and 45 m along the first pass.
MISSION = """\
QGC WPL 110
0 1 0 16 0 0 0 0 35.9959511 114.5434850 0 1
1 0 3 22 0 0 0 0 35.9959511 114.5434850 3.5 1
2 0 2 178 1 5 -1 0 0 0 0 1
3 0 3 16 0 0 0 0 35.9963478 114.5435887 3.5 1
"""
HEAD = """\
version = 1
[fixed]
flight.config = "field/config.toml"
flight.mission = "field/short.waypoints"
"""


def write_campaign(folder: Path, text: str) -> Path:
    """Write a campaign beside its own copies of configuration, map and a short mission."""
    field = folder / "field"
    field.mkdir(parents=True)
    for path in [*EXAMPLE.glob("prescription.*"), EXAMPLE / "config.toml"]:
        shutil.copy(path, field)
    shutil.copy(EXAMPLE / "boundary.geojson", field)
    (field / "short.waypoints").write_text(
        MISSION.replace(" ", "\t").replace("QGC\tWPL\t", "QGC WPL ")
    )
    path = folder / "short.toml"
    path.write_text(HEAD.replace("version = 1\n", f"version = 1\n{text}", 1))
    return path


def files_of(folder: Path) -> dict[str, bytes]:
    """Return the dataset of a campaign to the byte; how fast it was is no part of it."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != "log.jsonl"
    }
