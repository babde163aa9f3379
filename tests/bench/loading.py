"""How long a large map takes from its file to the core."""

from __future__ import annotations

import tempfile
from pathlib import Path
from time import perf_counter

import numpy as np
import pyogrio
import shapefile
import shapely
from pyproj import CRS

from companion.core.frame import LocalFrame
from companion.maps.build import build_prescription, frame_for
from companion.maps.registry import read_map
from tests.bench.fields import grid_zones
from tests.bench.figures import Figure

ORIGIN = LocalFrame(36.0, 114.5)


def loading(*, seed: int, side: int = 150, repeats: int = 3) -> Figure:
    """Measure reading, checking and indexing a shapefile of `side` x `side` plots."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "grid.shp"
        _write(path, side, seed)
        times = []
        for _ in range(repeats):
            begin = perf_counter()
            found = read_map(path, rate_field="rate", unit="L/ha")
            prescription = build_prescription(found, frame_for(found))
            times.append(perf_counter() - begin)
        if len(prescription.zones) != side * side:
            raise ValueError(f"{len(prescription.zones)} zones were read, not {side * side}")
        begin = perf_counter()
        _, _, geometry, _ = pyogrio.raw.read(path)
        shapely.from_wkb(geometry)
        other = perf_counter() - begin
    return Figure(
        key="load_map",
        what=f"a shapefile of {side * side} polygons loads",
        value=float(np.median(times)),
        unit="s",
        n=repeats,
        target=3.0,
        alternative={"pyogrio, reading alone": other},
        details={"worst": max(times)},
    )


def _write(path: Path, side: int, seed: int) -> None:
    zones = grid_zones(side, side, seed=seed)
    with shapefile.Writer(path, shapeType=shapefile.POLYGON) as writer:
        writer.field("rate", "N", 10, 2)
        for zone in zones:
            east, north = shapely.get_coordinates(zone.polygon).T
            latitudes, longitudes = ORIGIN.to_geographic_all(east.tolist(), north.tolist())
            ring = [list(corner) for corner in zip(longitudes, latitudes, strict=True)]
            writer.poly([ring[::-1]])
            writer.record(zone.rate_l_ha)
    path.with_suffix(".prj").write_text(CRS.from_epsg(4326).to_wkt("WKT1_ESRI"), encoding="ascii")
