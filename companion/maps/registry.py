"""Reading a map of any known format; a new format is one file and one line here."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path, PurePosixPath

import numpy as np
import shapely
from shapely import MultiPolygon
from shapely.errors import ShapelyError

from companion.maps.adapt.geoparquet import read_geoparquet
from companion.maps.adapt.reader import read_adapt
from companion.maps.assemble import crs_of, ground_of, map_of, zone_names
from companion.maps.bundle import open_bundle
from companion.maps.csvfile.reader import read_csv
from companion.maps.declared import Given
from companion.maps.geojson.reader import read_geojson
from companion.maps.geopackage.reader import read_geopackage
from companion.maps.geotiff.dji import read_dji
from companion.maps.geotiff.reader import read_geotiff
from companion.maps.isoxml.reader import read_isoxml
from companion.maps.kml.reader import read_kml
from companion.maps.layer import Grid, Layer
from companion.maps.local import polygons_of
from companion.maps.model import MapFile, map_error
from companion.maps.shapefile.reader import read_shapefile
from companion.maps.text.reader import read_text_map

Reader = Callable[[Path, str | None], Layer | Grid]

# The suffix, in lower case, and who reads it.
READERS: dict[str, Reader] = {
    ".shp": read_shapefile,
    ".geojson": read_geojson,
    ".json": read_geojson,
    ".gpkg": read_geopackage,
    ".kml": read_kml,
    ".kmz": read_kml,
    ".xml": read_isoxml,
    ".tif": read_geotiff,
    ".tiff": read_geotiff,
    ".parquet": read_geoparquet,
    ".geoparquet": read_geoparquet,
    ".csv": read_csv,
    ".txt": read_text_map,
}
# Folders and archives, by a file in them: the first pattern that any name matches. A shapefile
# comes last, as other formats carry boundaries in shapefiles.
PACKAGES: tuple[tuple[str, Reader], ...] = (
    ("taskdata.xml", read_isoxml),
    ("adapt.json", read_adapt),
    ("*.gpkg", read_geopackage),
    ("*.kml", read_kml),
    ("*.tif", read_dji),
    ("*.tiff", read_dji),
    ("*.parquet", read_geoparquet),
    ("*.shp", read_shapefile),
)
# A repair of a boundary or an exclusion may move the limit of spraying by this much unasked.
REPAIR_MAX_M2 = 1.0


def read_map(
    path: Path,
    *,
    rate_field: str | None = None,
    unit: str | None = None,
    crs: str | None = None,
    layer: str | None = None,
    density_kg_l: float | None = None,
    flow_width_m: float | None = None,
    flow_speed_m_s: float | None = None,
    merge: str | None = None,
    origin: tuple[float, float, float] | None = None,
) -> MapFile:
    """Return the prescription in a file, or raise a `MapError` that names file, reason and fix.

    The arguments answer what the file leaves open: which column, band or product is the rate, in
    which unit, in which coordinate reference system, in which layer or task; the density for
    rates by weight, width and speed for rates by time; how P2's text map makes its cells.
    """
    path = Path(path)
    given = Given(
        unit=unit,
        density_kg_l=density_kg_l,
        flow_width_m=flow_width_m,
        flow_speed_m_s=flow_speed_m_s,
    )
    found = _read(path, layer, merge=merge, origin=origin)
    return map_of(found, path, rate_field=rate_field, crs=crs, given=given)


def read_area(
    path: Path, *, crs: str | None = None, repairs: list[str] | None = None
) -> MultiPolygon:
    """Return the ground that a boundary or exclusion file covers, in longitude and latitude.

    Of a file that has an outline of the field beside its zones (ISOXML, a DJI package), that
    outline. Stricter than a prescription: a record that has to be left out, or a ring whose
    repair moves more than a square metre, could be the ground that must not be sprayed. Whoever
    gives `repairs` takes such rings repaired, and finds there what each repair changed.
    """
    path = Path(path)
    layer = _read(path, None)
    if layer.boundary is not None:
        return layer.boundary
    if isinstance(layer, Grid):
        raise map_error(
            path,
            "rows and columns of cells are no outline",
            fix="give the boundary or the exclusion as polygons",
            code="no-polygon",
        )
    used_crs, _ = crs_of(layer, path, crs)
    names = zone_names(layer)
    ground, repaired = ground_of(layer, used_crs, names, path)
    if layer.skipped:
        index, reason = next(iter(layer.skipped.items()))
        raise map_error(
            path,
            f"record {names[index]} is no area: {reason}",
            fix="draw it as a polygon",
            code="no-polygon",
        )
    large = [repair for repair in repaired if not repair.change_m2 <= REPAIR_MAX_M2]
    if repairs is not None:
        repairs += [f"{path}: record {repair.zone}: {repair.text}" for repair in large]
    elif large:
        raise map_error(
            path,
            f"record {large[0].zone}: {large[0].text}",
            fix="repair it where it is made",
            code="invalid-ring",
        )
    try:
        united = shapely.union_all(np.array(ground, dtype=object))
    except ShapelyError as error:
        raise map_error(
            path, f"its polygons do not unite ({error})", fix="repair them", code="broken-geometry"
        ) from None
    return MultiPolygon(polygons_of(united))


def _read(
    path: Path,
    layer: str | None,
    *,
    merge: str | None = None,
    origin: tuple[float, float, float] | None = None,
) -> Layer | Grid:
    try:
        folder = path.is_dir()
        there = path.exists()
        usable = folder or path.is_file()
    except (OSError, ValueError) as error:
        raise map_error(
            path, f"is no path ({error})", fix="check the path", code="no-file"
        ) from None
    if not there:
        raise map_error(path, "there is no such file", fix="check the path", code="no-file")
    if not usable:
        raise map_error(path, "this is no regular file", fix="name the map's file", code="no-file")
    suffix = path.suffix.casefold()
    reader = READERS.get(suffix)
    if folder or suffix == ".zip":
        reader = _of_package(path)
    elif path.name.casefold() == "adapt.json":
        reader = read_adapt
    if reader is None:
        known = ", ".join(READERS)
        raise map_error(
            path,
            f"the format {suffix or 'without a suffix'} is not known",
            fix="name the .shp of the shapefile"
            if suffix in (".dbf", ".prj", ".shx", ".cpg")
            else f"take one of {known}, or a folder or .zip with such files",
            code="unknown-format",
        )
    if reader is read_text_map:
        return read_text_map(path, layer, merge=merge or "max", origin=origin)
    if merge is not None or origin is not None:
        raise map_error(
            path,
            "it is not P2's text map, which alone has points to merge and an origin",
            fix="leave out --merge and --origin (prescription.merge, prescription.origin)",
            code="not-a-text-map",
        )
    return reader(path, layer)


def _of_package(path: Path) -> Reader:
    """Return who reads a folder or an archive, by what lies in it."""
    bundle = open_bundle(path)
    for sign, reader in PACKAGES:
        if any(PurePosixPath(name.casefold()).match(sign) for name in bundle.names):
            return reader
    signs = ", ".join(sign for sign, _ in PACKAGES)
    raise map_error(
        path,
        f"it holds none of {signs}",
        fix="name the file of the map itself",
        code="unknown-format",
    )
