"""GeoTIFF of one band of 32-bit numbers with its `.tfw`; DJI's package of one in degrees.

No data is -9999 and never 0, so that 0 L/ha stays a rate. The place is written twice: the GeoTIFF
has the corner of the first cell, the world file its centre.
"""

from __future__ import annotations

import struct
import zipfile
from io import BytesIO
from pathlib import Path

import numpy as np
import shapefile
import shapely
from pyproj import CRS
from shapely import MultiPolygon

from missions.maps.geotiff.dji import RX_FOLDER, SHAPE_FOLDER
from missions.maps.geotiff.file import gdal
from missions.maps.model import MapCells, map_error
from missions.maps.whole_file import write_whole

NODATA = -9999.0
_ROOT = "DJI"
# What a dBASE file says of its last change, and the oldest date of a zip: two runs give the same.
_DBF_DATE, _ZIP_DATE = b"\x64\x01\x01", (1980, 1, 1, 0, 0, 0)


def write_geotiff(cells: MapCells, path: Path, *, boundary: MultiPolygon | None = None) -> None:
    """Write cells of any CRS as GeoTIFF, with a world file beside it.

    A GeoTIFF has no place for the outline of the field; `write_dji` keeps it.
    """
    del boundary
    picture, world = _content(cells, path)
    write_whole(path, picture)
    write_whole(path.with_suffix(".tfw"), world)


def write_dji(cells: MapCells, path: Path, boundary: MultiPolygon | None = None) -> None:
    """Write DJI's package: a zip where the name ends in `.zip`, else a folder."""
    zipped = path.suffix.casefold() == ".zip"
    name = path.stem if zipped else path.name
    a, b, _, d, _, _ = cells.transform
    if cells.crs.to_epsg() != 4326 or not (a > 0.0 and b == d == 0.0):
        raise ValueError("cells for DJI need longitude and latitude along their edges")
    picture, world = _content(cells, path)
    files = {f"{_ROOT}/{RX_FOLDER}/{name}{end}": part for end, part in
             ((".tif", picture), (".tfw", world))}  # fmt: skip
    if boundary is not None:
        shape = _shapefile(boundary, path)
        files |= {f"{_ROOT}/{SHAPE_FOLDER}/{name}{end}": part for end, part in shape.items()}
    if zipped:
        write_whole(path, _zipped(files))
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
    """Return the files of a shapefile with one record, clockwise outside as its rules have it."""
    polygons = shapely.orient_polygons(boundary, exterior_cw=True)
    rings = [
        [(x, y) for x, y, *_ in ring.coords]
        for polygon in polygons.geoms
        for ring in (polygon.exterior, *polygon.interiors)
    ]
    shp, shx, dbf = BytesIO(), BytesIO(), BytesIO()
    try:
        with shapefile.Writer(shp=shp, shx=shx, dbf=dbf, shapeType=shapefile.POLYGON) as writer:
            writer.field("name", "C", size=16)
            writer.poly(rings)
            writer.record("boundary")
    except (shapefile.ShapefileException, struct.error, ValueError) as error:
        raise map_error(
            path,
            f"the boundary cannot be written ({str(error)[:80]})",
            fix="give a boundary with an area",
            code="broken-geometry",
        ) from None
    table = dbf.getvalue()
    return {
        ".shp": shp.getvalue(),
        ".shx": shx.getvalue(),
        ".dbf": table[:1] + _DBF_DATE + table[4:],
        ".prj": CRS.from_epsg(4326).to_wkt("WKT1_ESRI").encode("ascii"),
    }


def _zipped(files: dict[str, bytes]) -> bytes:
    buffer = BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in sorted(files.items()):
            member = zipfile.ZipInfo(name, _ZIP_DATE)
            member.compress_type = zipfile.ZIP_DEFLATED
            # Unix, and readable: else the members depend on the system that packs them.
            member.create_system, member.external_attr = 3, 0o644 << 16
            archive.writestr(member, content)
    return buffer.getvalue()
