"""A prescription as a shapefile: five files side by side, or in one zip as terminals take it."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

import shapefile
import shapely
from shapely import MultiPolygon, Polygon

from missions.maps.model import MapZone, map_error
from missions.maps.outline import BOUNDARY_NAME
from missions.maps.whole_file import not_written, write_whole

UNIT = "L/ha"
# Four decimals hold a rate to a ten-thousandth of a litre; the core's limit is 100 000 L/ha.
_RATE_WIDTH, _RATE_DECIMALS = 12, 4
# The widest text column that dBASE III knows.
_TEXT_WIDTH_MAX = 254
# WGS84 in Esri's dialect, which the programs that read a .prj understand best (EPSG:4326).
_PRJ = (
    'GEOGCS["GCS_WGS_1984",DATUM["D_WGS_1984",SPHEROID["WGS_1984",6378137.0,298.257223563]],'
    'PRIMEM["Greenwich",0.0],UNIT["Degree",0.0174532925199433]]'
)
# Year since 1900, month and day of the last change: two runs give the same bytes.
_DATE = bytes((100, 1, 1))
_ZIP_DATE = (2000, 1, 1, 0, 0, 0)


def write_shapefile(
    zones: Sequence[MapZone], path: Path, *, boundary: MultiPolygon | None = None
) -> None:
    """Write a `.shp` and the files that belong to it, or all of them in a `.zip`.

    A shapefile has one kind of record and so no place for the outline of the field; the zip
    holds it as another shapefile, in a folder of its own.
    """
    if not zones:
        raise map_error(
            path, "there is no zone to write", fix="take a map with zones", code="no-polygon"
        )
    content = _files(zones)
    if path.suffix.casefold() == ".zip":
        members = {f"{path.stem}{suffix}": one for suffix, one in content.items()}
        if boundary is not None:
            outline = MapZone(name=BOUNDARY_NAME, geometry=boundary, rate_l_ha=None)
            members |= {
                f"{BOUNDARY_NAME}/{BOUNDARY_NAME}{suffix}": one
                for suffix, one in _files([outline]).items()
            }
        write_whole(path, _zipped(members))
        return
    # The .shp goes first and comes last: what there is without it is no map to anybody.
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise not_written(path, error) from None
    for suffix in sorted(content, key=lambda suffix: suffix == ".shp"):
        write_whole(path if suffix == ".shp" else path.with_suffix(suffix), content[suffix])


def _files(zones: Sequence[MapZone]) -> dict[str, bytes]:
    """Return the content of each file of the set, by its suffix."""
    shp, shx, dbf = BytesIO(), BytesIO(), BytesIO()
    names = [_fitting(zone.name) for zone in zones]
    with shapefile.Writer(
        shp=shp, shx=shx, dbf=dbf, shapeType=shapefile.POLYGON, encoding="utf-8"
    ) as writer:
        writer.field("name", "C", size=max(1, *(len(name.encode()) for name in names)))
        writer.field("rate", "N", size=_RATE_WIDTH, decimal=_RATE_DECIMALS)
        writer.field("unit", "C", size=len(UNIT))
        for name, zone in zip(names, zones, strict=True):
            writer.poly(_rings(zone.geometry))
            writer.record(name, zone.rate_l_ha, UNIT)
    table = dbf.getvalue()
    return {
        ".cpg": b"UTF-8",
        ".dbf": table[:1] + _DATE + table[4:],
        ".prj": _PRJ.encode("ascii"),
        ".shp": shp.getvalue(),
        ".shx": shx.getvalue(),
    }


def _rings(geometry: Polygon | MultiPolygon) -> list[list[list[float]]]:
    """Return all rings, the ground clockwise and its holes the other way (Esri, 1998)."""
    turned = shapely.orient_polygons(geometry, exterior_cw=True)
    return [
        shapely.get_coordinates(ring).tolist()
        for part in shapely.get_parts(turned)
        for ring in shapely.get_rings(part)
    ]


def _fitting(name: str) -> str:
    """Return a name on one line, cut between letters where it is wider than a column can be."""
    plain = " ".join(name.replace("\0", " ").split()).encode("utf-8", "replace")
    return plain[:_TEXT_WIDTH_MAX].decode("utf-8", "ignore").rstrip()


def _zipped(members: dict[str, bytes]) -> bytes:
    content = BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in sorted(members):
            entry = zipfile.ZipInfo(name, _ZIP_DATE)
            entry.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(entry, members[name])
    return content.getvalue()
