"""Shapefiles to be read in tests, written by GDAL."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyogrio
import shapely
from shapely import Geometry, Polygon, box

from missions.maps.model import MapFile

# A degree of latitude is 111.0 km here, a degree of longitude 90.2 km.
WEST, SOUTH = 114.543, 35.996
CELL = 0.0001


def cell(column: int, row: int = 0) -> Polygon:
    west, south = WEST + column * CELL, SOUTH + row * CELL
    return box(west, south, west + CELL, south + CELL)


def write(
    path: Path,
    geometries: Sequence[Geometry | None],
    *,
    crs: str | None = "EPSG:4326",
    geometry_type: str = "Unknown",
    encoding: str | None = None,
    **columns: object,
) -> Path:
    arrays = [np.asarray(values) for values in columns.values()]
    pyogrio.raw.write(
        str(path),
        np.array([shapely.to_wkb(one) for one in geometries], dtype=object),
        [one.astype(object) if one.dtype.kind in "UO" else one for one in arrays],
        list(columns),
        geometry_type=geometry_type,
        crs=crs,
        driver="ESRI Shapefile",
        encoding=encoding,
    )
    return path


def simple(tmp_path: Path, **more: object) -> Path:
    return write(
        tmp_path / "rx.shp",
        [cell(0), cell(1)],
        geometry_type="Polygon",
        rate=np.array([12.5, 0.0]),
        unit=["l/ha", "l/ha"],
        **more,
    )


def codes(map_file: MapFile) -> set[str]:
    return {problem.code for problem in map_file.problems}


def without_prj(path: Path) -> Path:
    path.with_suffix(".prj").unlink()
    return path
