"""How long a large map takes from its file to the core, and how much memory."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from time import perf_counter

import numpy as np
import pyogrio
import shapefile
import shapely
from pyproj import CRS

from companion.core.frame import LocalFrame
from missions.maps.build import build_prescription, frame_for
from missions.maps.registry import read_map
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


# In a process of its own, so that the peak of its memory is this map's and the libraries' alone.
_RASTER = """
import json, sys
from pathlib import Path
from time import perf_counter
from missions.maps.build import build_prescription, frame_for
from missions.maps.registry import read_map
begin = perf_counter()
found = read_map(Path(sys.argv[1]), unit="L/ha")
prescription = build_prescription(found, frame_for(found))
wall_s = perf_counter() - begin
# Not ru_maxrss, which a child inherits from the process that started it.
status = dict(line.split(":", 1) for line in open("/proc/self/status"))
peak_mb = int(status["VmHWM"].split()[0]) / 1024
print(json.dumps([wall_s, peak_mb, int((prescription.cells.classes >= 0).sum())]))
"""


def raster(*, seed: int, side: int = 1000, repeats: int = 3) -> list[Figure]:
    """Measure a GeoTIFF of `side` x `side` cells, each of its own rate, inside a round field."""
    import rasterio
    from rasterio.transform import from_origin

    rng = np.random.default_rng(seed)
    rates = rng.uniform(10.0, 30.0, (side, side)).astype(np.float32)
    row, column = np.mgrid[0:side, 0:side] - (side - 1) / 2
    rates[np.hypot(row, column) > side / 2] = -9999.0
    times, peaks = [], []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "raster.tif"
        with rasterio.open(
            path, "w", driver="GTiff", height=side, width=side, count=1, dtype="float32",
            crs="EPSG:4326", transform=from_origin(114.5, 36.0, 1.1e-5, 9e-6), nodata=-9999.0,
        ) as file:  # fmt: skip
            file.write(rates, 1)
        for _ in range(repeats):
            done = subprocess.run(
                [sys.executable, "-c", _RASTER, str(path)], check=True, capture_output=True
            )
            wall_s, peak_mb, count = json.loads(done.stdout)
            if count != int((rates > 0).sum()):
                raise ValueError(f"{count} cells were read, not {int((rates > 0).sum())}")
            times.append(wall_s)
            peaks.append(peak_mb)
    what = f"a GeoTIFF of {side * side} cells"
    return [
        Figure(
            key="load_raster",
            what=f"{what}, each of its own rate, loads",
            value=float(np.median(times)),
            unit="s",
            n=repeats,
            target=2.0,
            details={"worst": max(times)},
        ),
        Figure(
            key="load_raster_memory",
            what=f"{what}: peak memory of the whole process",
            value=max(peaks),
            unit="MB",
            n=repeats,
            target=300.0,
        ),
    ]


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
