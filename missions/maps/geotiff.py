"""GeoTIFF: rows and columns of rates, with a world file beside it or without.

The file's own position holds; a world file says where the map lies when the file does not. What
its bands are, an `adapt.json` beside it may say, or their own names.

DJI's package: a GeoTIFF in `DJI/Rx` with its `.tfw`, and the field in `DJI/ShapeFile`. The numbers
are L/ha or kg/ha; no package says which, so the operator does.

GeoTIFF of one band of 32-bit numbers with its `.tfw`; DJI's package of one in degrees. No data is
-9999 and never 0, so that 0 L/ha stays a rate. The place is written twice: the GeoTIFF has the
corner of the first cell, the world file its centre.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from io import BytesIO
from pathlib import Path, PurePosixPath

import numpy as np
import shapefile
from pyproj import CRS
from shapely import MultiPolygon

from companion.map_formats import shapefile_rings, shapefile_set, zipped
from missions.maps.adapt import Operation, described_beside
from missions.maps.bundle import Bundle, files_beside, one_of, open_bundle
from missions.maps.dbf import find_shapefile
from missions.maps.geotiff_bands import (
    ReadBand,
    class_problem,
    usable,
)
from missions.maps.geotiff_file import Raster, gdal, read_raster
from missions.maps.model import (
    Band,
    Grid,
    MapCells,
    Problem,
    digest,
    map_error,
    write_whole,
)
from missions.maps.outlines import outline_of
from missions.maps.shapefile import read_shapefile

# What programs fill with lies below and above all indices, reflectances and yields.
FILL_LEAST, FILL_MOST = 5_000.0, 65_000.0


def read_geotiff(path: Path, layer: str | None = None) -> Grid:
    """Return what a GeoTIFF holds; `layer` is the number of one of several pictures in it."""
    found = described_beside(path, layer)
    bundle = files_beside(path)
    if found is None:
        return grid_of_tiff(bundle, path.name, layer=layer)
    operation, content = found
    return grid_of_tiff(
        bundle, path.name, format="adapt", operation=operation, also={"adapt.json": content}
    )


def read_bands(path: Path, layer: str | None = None) -> Grid:
    """Return the bands of a GeoTIFF as measurements, which are not rates and may be negative."""
    raster = read_raster(files_beside(path), path.name, layer=layer, described=False, colours=True)
    for one in raster.bands:
        values = one.band.values
        if one.band.fault is None or one.band.fault.code != "nodata-undeclared":
            continue
        # A fill is far from all measurements; a single negative index is one.
        if not float(np.nanmin(values)) >= -FILL_LEAST or float(np.nanmax(values)) > FILL_MOST:
            raise one.band.fault
    return Grid(
        format="geotiff",
        crs=raster.crs,
        transform=raster.transform,
        bands=_told_apart([one.band for one in raster.bands]),
        sha256=digest(raster.files[one] for one in sorted(raster.files)),
        problems=(*raster.problems, *(problem for one in raster.bands for problem in one.problems)),
    )


def grid_of_tiff(
    bundle: Bundle,
    name: str,
    *,
    layer: str | None = None,
    format: str = "geotiff",
    operation: Operation | None = None,
    also: dict[str, bytes] | None = None,
) -> Grid:
    """Return the GeoTIFF `name` of a bundle; `also` are files of the map that others have read."""
    raster = read_raster(bundle, name, layer=layer, described=operation is not None)
    files = {**(also or {}), **raster.files}
    bands, said = _bands(raster, operation, bundle.path / name)
    return Grid(
        format=format,
        crs=raster.crs,
        transform=raster.transform,
        bands=bands,
        sha256=digest(files[one] for one in sorted(files)),
        unit=raster.unit,
        problems=(*raster.problems, *said),
    )


def _bands(
    raster: Raster, operation: Operation | None, path: Path
) -> tuple[tuple[Band, ...], list[Problem]]:
    """Return the bands by names that tell them apart, and what there is to say about them."""
    if operation is not None:
        return _described(raster.bands, operation, path)
    bands = _told_apart(usable(raster.bands))
    problems = [problem for one in raster.bands for problem in one.problems]
    for band in bands:
        looks = class_problem(band) if (band.unit or raster.unit) is None else None
        problems += [looks] if looks is not None else []
    return bands, problems


def _described(
    found: Sequence[ReadBand], operation: Operation, path: Path
) -> tuple[tuple[Band, ...], list[Problem]]:
    """Return the bands that the description names, as it names them, and no others."""
    chosen: list[ReadBand] = []
    for variable in operation.variables:
        if variable.index is None or not 1 <= variable.index <= len(found):
            raise map_error(
                path,
                f"its adapt.json puts {variable.name} in band {variable.index} of {len(found)}",
                fix="copy the files again, or export the map again",
                code="wrong-description",
            )
        one = found[variable.index - 1]
        band = replace(
            one.band,
            name=variable.name,
            unit=variable.unit,
            is_rate=variable.is_rate,
            default=variable.default,
        )
        problems = tuple(replace(problem, where=band.name) for problem in one.problems)
        chosen.append(replace(one, band=band, problems=problems))
        if problems and variable.default:
            raise map_error(
                path,
                f"0 is no data in {band.name}, and its adapt.json prescribes "
                f"{variable.default:g} where there are none",
                fix="export the map with -9999 for no data",
                code="nodata-zero",
            )
    usable([one for one in chosen if one.band.is_rate])
    return tuple(one.band for one in chosen), [
        problem for one in chosen for problem in one.problems
    ]


def _told_apart(bands: Sequence[Band]) -> tuple[Band, ...]:
    """Return the bands with their numbers behind names that several of them have."""
    count = Counter(band.name for band in bands)
    return tuple(
        band if count[band.name] == 1 else replace(band, name=f"{band.name} (band {number})")
        for number, band in enumerate(bands, start=1)
    )


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
            f"record {index + 1} of the boundary is not an area: {reason}",
            fix="draw the boundary as polygons",
            code="no-polygon",
        )
    content = find_shapefile(bundle.path, name).content
    files = {str(PurePosixPath(name).with_suffix(end)): part for end, part in content.items()}
    return outline_of(layer.geometries, layer.crs, where), layer.problems, files


NODATA = -9999.0
_ROOT = "DJI"


def write_geotiff(cells: MapCells, path: Path) -> None:
    """Write cells of any CRS as GeoTIFF, with a world file beside it.

    A GeoTIFF has no place for the outline of the field; `write_dji` keeps it.
    """
    picture, world = _content(cells, path)
    write_whole(path, picture)
    write_whole(path.with_suffix(".tfw"), world)


def write_dji(cells: MapCells, path: Path, boundary: MultiPolygon | None = None) -> None:
    """Write DJI's package: a zip where the name ends in `.zip`, else a folder."""
    is_zip = path.suffix.casefold() == ".zip"
    name = path.stem if is_zip else path.name
    a, b, _, d, _, _ = cells.transform
    if cells.crs.to_epsg() != 4326 or not (a > 0.0 and b == d == 0.0):
        raise ValueError("cells for DJI need longitude and latitude along their edges")
    picture, world = _content(cells, path)
    files = {f"{_ROOT}/{RX_FOLDER}/{name}{end}": part for end, part in
             ((".tif", picture), (".tfw", world))}  # fmt: skip
    if boundary is not None:
        shape = _shapefile(boundary, path)
        files |= {f"{_ROOT}/{SHAPE_FOLDER}/{name}{end}": part for end, part in shape.items()}
    if is_zip:
        write_whole(path, zipped(dict(sorted(files.items()))))
        return
    # The picture last: without it the folder is no map.
    for place, content in sorted(files.items(), reverse=True):
        file = path / place
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise map_error(
                path,
                f"the folder cannot be made ({error.strerror or error})",
                fix="check folder, rights and free space",
                code="not-written",
            ) from None
        write_whole(file, content)


def _content(cells: MapCells, path: Path) -> tuple[bytes, bytes]:
    """Return the GeoTIFF and its world file, the north first where rows run east."""
    a, b, c, d, e, f = cells.transform
    rates = cells.rates_l_ha
    if b == d == 0.0 and e > 0.0:
        rates, e, f = rates[::-1], -e, f + e * rates.shape[0]
    values = np.where(np.isnan(rates), NODATA, rates).astype(np.float32)
    # x from column and row, then y: the order of the lines, and the centre of the first cell.
    centre = (c + (a + b) / 2.0, f + (d + e) / 2.0)
    world = "".join(f"{value!r}\n" for value in (a, d, b, e, *centre))
    return _tiff(values, (a, b, c, d, e, f), cells.crs, path), world.encode("ascii")


def _tiff(
    values: np.ndarray[tuple[int, ...], np.dtype[np.float32]],
    transform: tuple[float, ...],
    crs: CRS,
    path: Path,
) -> bytes:
    rasterio = gdal(path)
    code = crs.to_epsg()
    rows, columns = values.shape
    with rasterio.Env(GDAL_PAM_ENABLED=False), rasterio.io.MemoryFile() as memory:
        with memory.open(
            driver="GTiff",
            width=columns,
            height=rows,
            count=1,
            dtype="float32",
            crs=crs.to_wkt() if code is None else f"EPSG:{code}",
            transform=rasterio.Affine(*transform),
            nodata=NODATA,
        ) as target:
            target.write(values, 1)
            target.set_band_description(1, "rate")
            target.units = ("L/ha",)
            target.update_tags(unit="L/ha")
        return bytes(memory.getbuffer())


def _shapefile(boundary: MultiPolygon, path: Path) -> dict[str, bytes]:
    """Return the files of a shapefile with one record."""
    shp, shx, dbf = BytesIO(), BytesIO(), BytesIO()
    try:
        with shapefile.Writer(shp=shp, shx=shx, dbf=dbf, shapeType=shapefile.POLYGON) as writer:
            writer.field("name", "C", size=16)
            writer.poly(shapefile_rings(boundary))
            writer.record("boundary")
    except (shapefile.ShapefileException, struct.error, ValueError) as error:
        raise map_error(
            path,
            f"the boundary cannot be written ({str(error)[:80]})",
            fix="give a boundary with an area",
            code="broken-geometry",
        ) from None
    found = shapefile_set(shp=shp.getvalue(), shx=shx.getvalue(), dbf=dbf.getvalue())
    return {end: content for end, content in found.items() if end != ".cpg"}
