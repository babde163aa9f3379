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


_CHECK = """
import contextlib, io, json, sys
from pathlib import Path
from time import process_time
from companion.cli.app import execute
said = io.StringIO()
with contextlib.redirect_stdout(said):
    code = execute(["map", "check", sys.argv[1], "--unit", "L/ha", "--json"])
status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
peak_mb = int(status["VmHWM"].split()[0]) / 1024
print(json.dumps([process_time(), peak_mb, code, json.loads(said.getvalue())["zones"]]))
"""


def ragged(*, seed: int, side: int = 150, repeats: int = 3) -> list[Figure]:
    """Measure `map check` of polygons whose borders are ragged, by processor time.

    Once neighbours have one border, and once each polygon is simplified by itself, as programs do
    that draw zones from a raster: then they part and overlap by centimetres.
    """
    found = []
    with tempfile.TemporaryDirectory() as folder:
        zones = ragged_zones(side, np.random.default_rng(seed))
        apart = shapely.simplify(zones, 0.25)
        for key, what, areas in (
            ("check_ragged", "with one border between neighbours", zones),
            ("check_ragged_apart", "each simplified by itself", apart[shapely.is_valid(apart)]),
        ):
            path = Path(folder) / f"{key}.shp"
            rates = np.random.default_rng(seed).integers(10, 30, len(areas)).astype(float)
            pyogrio.raw.write(
                path, geometry=shapely.to_wkb(areas), field_data=[rates], fields=["rate"],
                geometry_type="Polygon", crs="EPSG:32650",
            )  # fmt: skip
            runs = []
            for _ in range(repeats):
                done = subprocess.run(
                    [sys.executable, "-c", _CHECK, str(path)], check=True, capture_output=True
                )
                cpu_s, peak_mb, code, count = json.loads(done.stdout)
                if code == 2 or count != len(areas):
                    raise ValueError(f"{count} zones were read, not {len(areas)}")
                runs.append((cpu_s, peak_mb))
            text = f"map check of {len(areas)} ragged polygons, {what}"
            cpu_s, peak_mb = (float(np.median(each)) for each in zip(*runs, strict=True))
            found.append(
                Figure(
                    key=key, what=f"{text}: processor time, start and all", value=cpu_s, unit="s",
                    n=repeats, target=1.0, details={"worst": max(one for one, _ in runs)},
                )
            )  # fmt: skip
            found.append(
                Figure(
                    key=f"{key}_memory", what=f"{text}: peak memory of the whole process",
                    value=peak_mb, unit="MB", n=repeats, target=200.0,
                )
            )  # fmt: skip
    return found


def ragged_zones(side: int, rng: np.random.Generator, *, cuts: int = 6) -> np.ndarray:
    """Return cells of 10 m in UTM whose borders are broken lines, the same for both neighbours."""
    east, north = np.meshgrid(np.arange(side + 1) * 10.0, np.arange(side + 1) * 10.0)
    nodes = np.stack([east + 455_000.0, north + 3_984_000.0], axis=-1)
    nodes += rng.uniform(-1.5, 1.5, nodes.shape)
    share = np.linspace(0.0, 1.0, cuts + 2)[:-1, None]

    def border(start: np.ndarray, end: np.ndarray) -> np.ndarray:
        line = start[..., None, :] + (end - start)[..., None, :] * share
        line[..., 1:, :] += rng.uniform(-0.4, 0.4, line[..., 1:, :].shape)
        return line

    along, up = border(nodes[:, :-1], nodes[:, 1:]), border(nodes[:-1], nodes[1:])

    def back(line: np.ndarray, end: np.ndarray) -> np.ndarray:
        return np.concatenate([end[..., None, :], line[..., :0:-1, :]], axis=-2)

    rings = np.concatenate(
        [along[:-1], up[:, 1:], back(along[1:], nodes[1:, 1:]), back(up[:, :-1], nodes[1:, :-1])],
        axis=2,
    )
    zones: np.ndarray = shapely.polygons(rings.reshape(side * side, -1, 2))
    if not shapely.is_valid(zones).all():
        raise ValueError("borders cross themselves")
    return zones


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
