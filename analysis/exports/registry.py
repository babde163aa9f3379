"""Which formats there are, by name and by the end of a file's name; imported when asked for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from analysis.exports.output import ExportError
from analysis.exports.source import Shape
from companion.wording import install_command

if TYPE_CHECKING:
    from analysis.exports.output import Content
    from analysis.exports.source import Source

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
        try:
            found: Make = getattr(import_module(_MODULES + module), function)
        except ModuleNotFoundError as error:
            raise ExportError(
                f"{self.name}: the module {error.name} is not installed; "
                f"{install_command('office')}"
            ) from error
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
