"""How other programs write: a function a format."""

from __future__ import annotations

import json
import os
import shutil
import struct
import subprocess
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pyogrio.raw
import shapely
from pyproj import CRS

from tests.file_kinds.ground import Ground

Writer = Callable[[Ground, Path], Path]


def _array(values: list[Any]) -> tuple[np.ndarray, np.ndarray]:
    """Return a column as GDAL takes it: values and where they are missing."""
    missing = np.array([value is None for value in values])
    kind = next((type(value) for value in values if value is not None), str)
    filled = [kind() if value is None else value for value in values]
    return np.array(filled, dtype=object if kind is str else None), missing


def by_gdal(driver: str, suffix: str, **options: Any) -> Writer:
    """Return the writer of one of GDAL's drivers."""

    def write(ground: Ground, folder: Path) -> Path:
        path = folder / f"map{suffix}"
        polygons = ground.native()
        columns = [_array(values) for values in ground.columns.values()]
        crs = ground.crs_text or (None if ground.epsg is None else f"EPSG:{ground.epsg}")
        kinds = {one.geom_type for one in polygons}
        with warnings.catch_warnings():  # that no CRS was given, which is meant
            warnings.filterwarnings("ignore", "'crs' was not provided")
            pyogrio.raw.write(
                path,
                geometry=np.array(shapely.to_wkb(polygons), dtype=object),
                field_data=[values for values, _ in columns],
                field_mask=[missing for _, missing in columns],
                fields=np.array(list(ground.columns), dtype=object),
                crs=crs,
                driver=driver,
                geometry_type=next(iter(kinds)) if len(kinds) == 1 else "Unknown",
                **options,
            )
        return path

    return write


def geojson_by_hand(ground: Ground, folder: Path) -> Path:
    """Write as small tools do: rings as they stand, no word of a CRS."""
    path = folder / "map.geojson"
    features = [
        {
            "type": "Feature",
            "properties": {name: values[k] for name, values in ground.columns.items()},
            "geometry": shapely.geometry.mapping(polygon),
        }
        for k, polygon in enumerate(ground.native())
    ]
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    return path


def geoparquet(ground: Ground, folder: Path) -> Path:
    """Write GeoParquet 1.1 with pyarrow."""
    path = folder / "map.parquet"
    polygons = ground.native()
    about: dict[str, Any] = {"encoding": "WKB", "geometry_types": []}
    if ground.epsg not in (4326, None):
        about["crs"] = CRS.from_epsg(ground.epsg).to_json_dict()
    elif ground.epsg is None:
        about["crs"] = None
    head = {"version": "1.1.0", "primary_column": "geometry", "columns": {"geometry": about}}
    table = pa.table(
        {**ground.columns, "geometry": pa.array(shapely.to_wkb(polygons), pa.binary())}
    )
    pq.write_table(table.replace_schema_metadata({b"geo": json.dumps(head).encode()}), path)
    return path


def zipped(writer: Writer) -> Writer:
    """Return a writer that packs what another one writes, as mails do."""

    def write(ground: Ground, folder: Path) -> Path:
        inside = folder / "inside"
        inside.mkdir()
        writer(ground, inside)
        path = folder / "map.zip"
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            for one in sorted(inside.iterdir()):
                archive.write(one, f"rx/{one.name}")
        shutil.rmtree(inside)
        return path

    return write


NODE_MODULES = "VRSPRAY_NODE_MODULES"
_ISOXML = """
const {ISOXMLManager} = require('isoxml'), fs = require('fs');
const given = JSON.parse(fs.readFileSync(0));
(async () => {
    const manager = new ISOXMLManager({version: 4});
    const make = (tag, values) => manager.createEntityFromAttributes(tag, values);
    const ring = (points, kind) => make('LSG', {LineStringType: kind, Point: points.map(
        ([x, y]) => make('PNT', {PointType: '2', PointNorth: y, PointEast: x}))});
    const polygon = (rings, kind) => make('PLN', {PolygonType: kind,
        LineString: rings.map((one, k) => ring(one, k ? '2' : '1'))});
    const zones = given.zones.map((zone, k) => make('TZN', {TreatmentZoneCode: k + 1,
        ProcessDataVariable: [make('PDV', {ProcessDataDDI: '0001',
            ProcessDataValue: Math.round(zone.rate * 10000)})],
        PolygonTreatmentZoneonly: zone.parts.map(rings => polygon(rings, '2'))}));
    const parts = given.outline.map(([rings, kind]) => polygon(rings, kind));
    const field = parts.length ? make('PFD', {PartfieldDesignator: 'field', PartfieldArea: 1,
        PolygonnonTreatmentZoneonly: parts}) : null;
    const root = manager.rootElement.attributes;
    if (field) { manager.registerEntity(field); root.Partfield = [field]; }
    if (zones.length) {
        const task = make('TSK', {TaskDesignator: 'rx', TaskStatus: '1', TreatmentZone: zones});
        manager.registerEntity(task);
        root.Task = [task];
    }
    fs.writeFileSync(given.path, await manager.saveISOXML());
})().catch(error => { console.error(error); process.exit(1); });
"""


def _rings(polygon: shapely.Polygon) -> list[list[list[float]]]:
    return [
        [list(point[:2]) for point in ring.coords]
        for ring in (polygon.exterior, *polygon.interiors)
    ]


def isoxml_by_npm(ground: Ground, folder: Path) -> Path:
    """Write a task with the package `isoxml` of npm."""
    path = folder / "task.zip"
    parts = [[_rings(part) for part in shapely.get_parts(one)] for one in ground.native()]
    rates = ground.columns.get("rate")
    content: dict[str, Any] = {"path": str(path), "zones": [], "outline": []}
    if rates is None:
        kinds = ground.columns.get("pln", ["1"] * len(parts))
        content["outline"] = [
            (part, kind) for one, kind in zip(parts, kinds, strict=True) for part in one
        ]
    else:
        content["zones"] = [
            {"rate": rate, "parts": one} for rate, one in zip(rates, parts, strict=True)
        ]
    subprocess.run(
        ["node", "-e", _ISOXML],
        input=json.dumps(content).encode(),
        env={**os.environ, "NODE_PATH": os.environ[NODE_MODULES]},
        check=True,
        capture_output=True,
    )
    return path


VECTOR: dict[str, Writer] = {
    "shapefile": by_gdal("ESRI Shapefile", ".shp"),
    "GeoJSON": by_gdal("GeoJSON", ".geojson", layer_options={"RFC7946": "NO"}),
    "GeoJSON by hand": geojson_by_hand,
    "GeoPackage": by_gdal("GPKG", ".gpkg"),
    "KML": by_gdal("KML", ".kml"),
    "KML, libkml": by_gdal("LIBKML", ".kml"),
    "KMZ": by_gdal("LIBKML", ".kmz"),
    "GeoParquet": geoparquet,
    "zip of a shapefile": zipped(by_gdal("ESRI Shapefile", ".shp")),
}
if os.environ.get(NODE_MODULES):
    VECTOR["ISOXML"] = isoxml_by_npm


# Bytes that GDAL would not write.


def delete_record(path: Path, index: int) -> None:
    """Mark a record of a DBF deleted, as programs leave it until the file is packed."""
    table = path.with_suffix(".dbf")
    content = bytearray(table.read_bytes())
    header, length = struct.unpack("<HH", content[8:12])
    content[header + index * length] = ord("*")
    table.write_bytes(content)


def turn_ring(path: Path, ring: int) -> None:
    """Turn the points of one ring of a shapefile's first record round."""
    content = bytearray(path.read_bytes())
    start = 100 + 8 + 4 + 32
    parts, points = struct.unpack("<ii", content[start : start + 8])
    firsts = [*struct.unpack(f"<{parts}i", content[start + 8 : start + 8 + 4 * parts]), points]
    places = start + 8 + 4 * parts
    one, end = places + 16 * firsts[ring], places + 16 * firsts[ring + 1]
    turned = [content[k : k + 16] for k in range(one, end, 16)][::-1]
    content[one:end] = b"".join(turned)
    path.write_bytes(content)
