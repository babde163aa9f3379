"""As-applied points or ground as a shapefile, with the units of its columns in a file beside.

`<name>-Deere-Metadata.json` is what John Deere's programs write beside a shapefile, and what
others read for the units; its `DataAttributes` name the columns of the table.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

import shapefile
import shapely

from analysis.exports.output import zipped

if TYPE_CHECKING:
    from shapely import MultiPolygon, Polygon

    from analysis.exports.columns import Column, Value
    from analysis.exports.output import Content
    from analysis.exports.source import Source

# WGS84 in Esri's dialect, which the programs that read a .prj understand best (EPSG:4326).
_PRJ = (
    'GEOGCS["GCS_WGS_1984",DATUM["D_WGS_1984",SPHEROID["WGS_1984",6378137.0,298.257223563]],'
    'PRIMEM["Greenwich",0.0],UNIT["Degree",0.0174532925199433]]'
)
_NUMBER_WIDTH = 18
# The widest text column that dBASE III knows.
_TEXT_WIDTH_MAX = 254
# Some farm programs take twenty columns and no more; the companion's own clock means nothing there.
_LEFT_OUT = ("FlightTime",)
# Year since 1900, month and day of the last change: two runs give the same bytes.
_DATE = bytes((100, 1, 1))


def make(source: Source, out: Path) -> Content:
    """Return the files of the set side by side, or in one zip; the `.shp` comes last."""
    columns = [each for each in source.columns if each.short not in _LEFT_OUT]
    files = _table(source, columns) | {"-Deere-Metadata.json": _metadata(source, columns)}
    names = {
        f"{out.stem}{end}": content
        for end, content in sorted(files.items(), key=lambda item: item[0] == ".shp")
    }
    if out.suffix.casefold() != ".zip":
        # The name as it was given, whatever its case.
        shp = names.pop(f"{out.stem}.shp")
        return {name: [content] for name, content in names.items()} | {out.name: [shp]}
    return {out.name: [zipped(names)]}


def _table(source: Source, columns: Sequence[Column]) -> dict[str, bytes]:
    shp, shx, dbf = BytesIO(), BytesIO(), BytesIO()
    kind = shapefile.POINT if source.shape == "points" else shapefile.POLYGON
    with shapefile.Writer(shp=shp, shx=shx, dbf=dbf, shapeType=kind, encoding="utf-8") as writer:
        values = [_declared(writer, each) for each in columns]
        rows = zip(*values, strict=True)
        if source.shape == "points":
            samples = source.samples
            places = zip(samples.longitude_deg.tolist(), samples.latitude_deg.tolist(), strict=True)
            for place, row in zip(places, rows, strict=True):
                writer.point(*place)
                writer.record(*row)
        else:
            for ground, row in zip(source.swaths.polygons, rows, strict=True):
                writer.poly(list(_rings(ground)))
                writer.record(*row)
    table = dbf.getvalue()
    return {
        ".cpg": b"UTF-8",
        ".dbf": table[:1] + _DATE + table[4:],
        ".prj": _PRJ.encode("ascii"),
        ".shx": shx.getvalue(),
        ".shp": shp.getvalue(),
    }


def _declared(writer: shapefile.Writer, column: Column) -> Sequence[Value]:
    """Declare a column and return what goes into it."""
    values = column.python()
    if column.unit is not None:
        writer.field(column.short, "N", size=_NUMBER_WIDTH, decimal=column.unit.decimals)
        return values
    texts = [_fitting(value) if isinstance(value, str) else "" for value in values]
    size = max([1, *(len(text.encode()) for text in set(texts))])
    writer.field(column.short, "C", size=size)
    return texts


def _fitting(text: str) -> str:
    """Return a text cut between letters where it is wider than a column can be."""
    return text.encode("utf-8", "replace")[:_TEXT_WIDTH_MAX].decode("utf-8", "ignore")


def _rings(ground: Polygon | MultiPolygon) -> Iterator[list[list[float]]]:
    """Yield all rings, the ground clockwise and its holes the other way (Esri, 1998)."""
    turned = shapely.orient_polygons(ground, exterior_cw=True)
    for part in shapely.get_parts(turned):
        for ring in shapely.get_rings(part):
            yield shapely.get_coordinates(ring).tolist()


def _metadata(source: Source, columns: Sequence[Column]) -> bytes:
    about = source.about
    document = {
        "Version": "1.0",
        "ClientName": about.operator or "",
        "FarmName": "",
        "FieldName": about.field_name or "",
        "Operation": "Application",
        "Product": "SIMULATED" if about.simulated == "yes" else about.product or "",
        "DataAttributes": [
            {
                "Name": each.short,
                "Unit": "" if each.unit is None else each.unit.code,
                "Description": each.description,
            }
            for each in columns
        ],
        "vrspray": source.facts(),
    }
    return json.dumps(document, indent=2, allow_nan=False).encode() + b"\n"
