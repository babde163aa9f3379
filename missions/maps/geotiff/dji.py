"""DJI's package: a GeoTIFF in `DJI/Rx` with its `.tfw`, and the field in `DJI/ShapeFile`.

The numbers are L/ha or kg/ha; no package says which, so the operator does.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path, PurePosixPath

from shapely import MultiPolygon

from missions.maps.bundle import Bundle, one_of, open_bundle
from missions.maps.geotiff.reader import grid_of_tiff
from missions.maps.layer import Grid
from missions.maps.local import outline_of
from missions.maps.model import Problem, map_error
from missions.maps.shapefile.dbf import find_shapefile
from missions.maps.shapefile.reader import read_shapefile

RX_FOLDER, SHAPE_FOLDER = "Rx", "ShapeFile"
_RASTERS = (".tif", ".tiff")


def read_dji(path: Path, layer: str | None = None) -> Grid:
    """Return the map of a folder or a zip with a GeoTIFF in it; `layer` is the name of one.

    Laid out as DJI does it, or otherwise, when it is a GeoTIFF and no more.
    """
    bundle = open_bundle(path)
    rasters = bundle.with_suffix(*_RASTERS)
    in_rx = [name for name in rasters if _folder(name) == RX_FOLDER.casefold()]
    if not in_rx:
        return grid_of_tiff(bundle, one_of(bundle, rasters, layer, kind="GeoTIFF (.tif)"))
    name = one_of(bundle, in_rx, layer, kind="GeoTIFF")
    shape = _shape_of(bundle, name)
    if shape is None:
        return grid_of_tiff(bundle, name, format="dji")
    boundary, problems, files = _boundary(bundle, shape)
    grid = grid_of_tiff(bundle, name, format="dji", also=files)
    return replace(grid, boundary=boundary, problems=(*grid.problems, *problems))


def _folder(name: str) -> str:
    """Return the folder in which a file lies, in lower case."""
    return PurePosixPath(name).parent.name.casefold()


def _shape_of(bundle: Bundle, name: str) -> str | None:
    """Return the shapefile of the field: the one named as the map, or the only one."""
    shapes = [
        shape for shape in bundle.with_suffix(".shp") if _folder(shape) == SHAPE_FOLDER.casefold()
    ]
    stem = PurePosixPath(name).stem.casefold()
    own = [shape for shape in shapes if PurePosixPath(shape).stem.casefold() == stem]
    found = own or shapes
    if len(found) > 1:
        names = ", ".join(PurePosixPath(shape).stem for shape in found[:8])
        raise map_error(
            bundle.path,
            f"the boundary of {PurePosixPath(name).name} may be any of {names}",
            fix="leave the one of this map in the folder ShapeFile, or name it as the map",
            code="several-layers",
        )
    return found[0] if found else None


def _boundary(
    bundle: Bundle, name: str
) -> tuple[MultiPolygon | None, tuple[Problem, ...], dict[str, bytes]]:
    """Return the ground of the field, what there is to say, and the files that say it."""
    where = bundle.path / name
    layer = read_shapefile(bundle.path, name)
    if layer.skipped:
        index, reason = next(iter(layer.skipped.items()))
        raise map_error(
            where,
            f"record {index + 1} of the boundary is no area: {reason}",
            fix="draw the boundary as polygons",
            code="no-polygon",
        )
    if layer.crs is None:
        raise map_error(
            where,
            "the boundary does not say its coordinate reference system (no .prj beside it)",
            fix="copy the whole package again",
            code="no-crs",
        )
    content = find_shapefile(bundle.path, name).content
    files = {str(PurePosixPath(name).with_suffix(end)): part for end, part in content.items()}
    return outline_of(layer.geometries, layer.crs, where), layer.problems, files
