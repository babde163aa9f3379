"""As-applied points or ground as a shapefile, with the units of its columns in a file beside.

`<name>-Deere-Metadata.json` is what John Deere's programs write beside a shapefile, and what
others read for the units; its `DataAttributes` name the columns of the table.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

import shapefile

from companion.map_formats import shapefile_rings, shapefile_set, table_text, zipped

if TYPE_CHECKING:
    from analysis.exports.columns import Column, Value
    from analysis.exports.output import Content
    from analysis.exports.source import Source

_NUMBER_WIDTH = 18
# Some farm programs take twenty columns and no more; the companion's own clock means nothing there.
_LEFT_OUT = ("FlightTime",)


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
                writer.poly(shapefile_rings(ground))
                writer.record(*row)
    return shapefile_set(shp=shp.getvalue(), shx=shx.getvalue(), dbf=dbf.getvalue())


def _declared(writer: shapefile.Writer, column: Column) -> Sequence[Value]:
    """Declare a column and return what goes into it."""
    values = column.python()
    if column.unit is not None:
        writer.field(column.short, "N", size=_NUMBER_WIDTH, decimal=column.unit.decimals)
        return values
    texts = [table_text(value) if isinstance(value, str) else "" for value in values]
    size = max([1, *(len(text.encode()) for text in set(texts))])
    writer.field(column.short, "C", size=size)
    return texts


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
