"""Reading a map of any known format; a new format is one file and one line here."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import shapely
from shapely import MultiPolygon
from shapely.errors import ShapelyError

from companion.maps.assemble import crs_of, ground_of, map_of, zone_names
from companion.maps.geojson import read_geojson
from companion.maps.layer import Layer
from companion.maps.local import polygons_of
from companion.maps.model import MapFile, map_error
from companion.maps.shapefile import read_shapefile

Reader = Callable[[Path, str | None], Layer]

# The suffix, in lower case, and who reads it; "" is a folder.
READERS: dict[str, Reader] = {
    ".shp": read_shapefile,
    "": read_shapefile,
    ".geojson": read_geojson,
    ".json": read_geojson,
}
# A repair of a boundary or an exclusion may move the limit of spraying by this much unasked.
REPAIR_MAX_M2 = 1.0


def read_map(
    path: Path,
    *,
    rate_field: str | None = None,
    unit: str | None = None,
    crs: str | None = None,
    layer: str | None = None,
) -> MapFile:
    """Return the prescription in a file, or raise a `MapError` that names file, reason and fix.

    The arguments answer what the file leaves open: which column is the rate, in which unit, and
    in which coordinate reference system.
    """
    path = Path(path)
    found = _read(path, layer)
    return map_of(found, path, rate_field=rate_field, unit=unit, crs=crs)


def read_area(path: Path, *, crs: str | None = None) -> MultiPolygon:
    """Return the ground that a boundary or exclusion file covers, in longitude and latitude.

    Stricter than a prescription: a record that has to be left out, or a ring whose repair moves
    more than a square metre, could be the ground that must not be sprayed.
    """
    path = Path(path)
    layer = _read(path, None)
    used_crs, _ = crs_of(layer, path, crs)
    names = zone_names(layer)
    ground, repairs = ground_of(layer, used_crs, names, path)
    if layer.skipped:
        index, reason = next(iter(layer.skipped.items()))
        raise map_error(
            path, f"record {names[index]} is no area: {reason}", fix="draw it as a polygon"
        )
    large = [repair for repair in repairs if not repair.change_m2 <= REPAIR_MAX_M2]
    if large:
        raise map_error(
            path, f"record {large[0].zone}: {large[0].text}", fix="repair it where it is made"
        )
    try:
        united = shapely.union_all(np.array(ground, dtype=object))
    except ShapelyError as error:
        raise map_error(path, f"its polygons do not unite ({error})", fix="repair them") from None
    return MultiPolygon(polygons_of(united))


def _read(path: Path, layer: str | None) -> Layer:
    suffix = path.suffix.casefold()
    try:
        folder = path.is_dir()
        there = path.exists()
    except (OSError, ValueError) as error:
        raise map_error(path, f"is no path ({error})", fix="check the path") from None
    if not there:
        raise map_error(path, "there is no such file", fix="check the path")
    reader = READERS.get("" if folder else suffix) if folder or suffix else None
    if reader is None:
        known = ", ".join(name for name in READERS if name)
        raise map_error(
            path,
            f"the format {suffix or 'without a suffix'} is not known",
            fix="name the .shp of the shapefile"
            if suffix in (".dbf", ".prj", ".shx", ".cpg")
            else f"take one of {known}",
        )
    return reader(path, layer)
