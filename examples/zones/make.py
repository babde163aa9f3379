"""Makes a field's data, made up from a seed: what a drone, a satellite, a harvester and others see.

`python examples/zones/make.py FOLDER [BOUNDARY]` writes into the folder

- `boundary.geojson`, a field of about 4 ha, or uses the outline that is given;
- `drone.tif`, four bands of reflectance in ten-thousandths, cells of 0.5 m, slightly cloudy;
- `satellite.tif`, the same in cells of 10 m along the grid north of UTM, as Sentinel-2 has them;
- `yield.csv`, a harvester's points with what goes wrong on it: filling and emptying, stops,
  a pass over harvested ground, and a sensor that jumps;
- `soil.csv`, samples of electrical conductivity on a loose grid;
- `scouted.geojson`, polygons with a score of weeds;
- `weeds.csv`, single weeds in a dozen patches;
- `cards.csv`, the deposit on cards across the track of four passes in different winds.

The same seed makes the same files. `config.toml`, a sprayer for it, is copied beside them.
"""

from __future__ import annotations

import json
import math
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import shapely
from numpy.typing import NDArray
from pyproj import CRS, Transformer
from rasterio.transform import Affine

Floats = NDArray[np.float64]
Ground = Any  # a polygon or several

SEED = 24
LATITUDE_DEG, LONGITUDE_DEG = 48.2712, 16.9034  # the middle, where nothing stands
LENGTH_M, WIDTH_M, AZIMUTH_DEG = 260.0, 170.0, 34.0
BANDS = ("red", "green", "rededge", "nir")
DRONE_M, SATELLITE_M = 0.5, 10.0
# The harvester.
HEADER_M, SPEED_M_S, ENDS_M = 6.0, 1.6, 12.0


def outline() -> Ground:
    """Return the made-up field, in metres east and north of its middle."""
    ring = []
    for degree in range(0, 360, 6):
        angle = math.radians(degree)
        bend = 1.0 + 0.05 * math.sin(3 * angle + 1.0) + 0.03 * math.sin(7 * angle)
        # Between an ellipse and a rectangle, as fields are.
        radius = bend / (abs(math.cos(angle)) ** 4 + abs(math.sin(angle)) ** 4) ** 0.25
        ring.append((0.5 * LENGTH_M * radius * math.cos(angle),
                     0.5 * WIDTH_M * radius * math.sin(angle)))  # fmt: skip
    return shapely.affinity.rotate(shapely.Polygon(ring), 90.0 - AZIMUTH_DEG, origin=(0, 0))


def moved(ground: Ground, there: Transformer) -> Ground:
    """Return ground in other coordinates."""
    return shapely.transform(
        ground, lambda points: np.column_stack(there.transform(points[:, 0], points[:, 1]))
    )


def vigour(east: Floats, north: Floats) -> Floats:
    """Return how well the crop stands, 0 to 1: soils tens of metres wide, and patches of metres."""
    draw = np.random.default_rng(SEED)
    found = np.zeros_like(east)
    for wave_m, weight, count in ((180.0, 1.0, 6), (45.0, 0.6, 12), (11.0, 0.35, 24)):
        for _ in range(count):
            turn, phase = draw.uniform(0, 2 * math.pi, 2)
            along = east * math.sin(turn) + north * math.cos(turn)
            length = wave_m * draw.uniform(0.7, 1.4)
            found += weight / math.sqrt(count) * np.sin(2 * math.pi * along / length + phase)
    result: Floats = 1.0 / (1.0 + np.exp(-2.0 * found))
    return result


def bands(stand: Floats, draw: np.random.Generator) -> NDArray[np.uint16]:
    """Return reflectance in ten-thousandths of each band for a stand, with 1 % of noise."""
    pure = np.stack(
        [
            0.16 - 0.13 * stand, 0.12 - 0.05 * stand, 0.19 - 0.06 * stand, 0.22 + 0.30 * stand,
        ]
    )  # fmt: skip
    noisy = pure * (1.0 + 0.01 * draw.standard_normal(pure.shape))
    return np.clip(np.rint(10_000 * noisy), 1, 65_000).astype(np.uint16)


def raster(path: Path, ground: Ground, utm: CRS, cell_m: float, gap_m: float) -> None:
    """Write the bands over the bounds of the field (UTM); a cloud of `gap_m` hides some of it."""
    west, south, east, north = ground.buffer(2 * cell_m).bounds
    west, north = math.floor(west / cell_m) * cell_m, math.ceil(north / cell_m) * cell_m
    columns, rows = math.ceil((east - west) / cell_m), math.ceil((north - south) / cell_m)
    x, y = np.meshgrid(
        west + cell_m * (np.arange(columns) + 0.5), north - cell_m * (np.arange(rows) + 0.5)
    )
    middle = ground.centroid
    draw = np.random.default_rng(SEED + 1)
    # What a large cell sees is the average of what stands in it.
    steps = (np.arange(5) - 2.0) / 5.0 * cell_m if cell_m > 2.0 else np.zeros(1)
    seen = [vigour(x - middle.x + dx, y - middle.y + dy) for dx in steps for dy in steps]
    stand: Floats = np.mean(seen, axis=0)
    values = bands(stand, draw)
    values[:, np.hypot(x - middle.x - 30.0, y - middle.y - 20.0) < gap_m] = 0
    with rasterio.open(
        path, "w", driver="GTiff", width=columns, height=rows, count=len(BANDS), dtype="uint16",
        crs=utm.to_wkt(), transform=Affine(cell_m, 0.0, west, 0.0, -cell_m, north), nodata=0,
        compress="deflate",
    ) as target:  # fmt: skip
        target.write(values)
        target.descriptions = BANDS


def harvest(ground: Ground) -> list[tuple[float, float, float, float, str]]:
    """Return x, y, yield [t/ha], speed [m/s] and what is wrong with each point, in its order."""
    draw = np.random.default_rng(SEED + 2)
    middle = ground.centroid
    turned = shapely.affinity.rotate(ground, AZIMUTH_DEG, origin=middle)
    west, south, east, north = turned.bounds
    rows: list[tuple[float, float, float, float, str]] = []
    angle = math.radians(-AZIMUTH_DEG)
    lines = np.arange(west + HEADER_M / 2, east, HEADER_M).tolist()
    lines.insert(len(lines) // 2, lines[len(lines) // 2] + 1.0)  # once more, over harvested ground
    for number, x in enumerate(lines):
        over = number == len(lines) // 2 + 1
        found = shapely.get_parts(shapely.LineString([(x, south), (x, north)]).intersection(turned))
        for part in found:
            y = np.arange(part.bounds[1], part.bounds[3], SPEED_M_S)
            if len(y) < 25:
                continue
            y = y if number % 2 == 0 else y[::-1]
            dx, dy = np.full(len(y), x) - middle.x, y - middle.y
            px = middle.x + dx * math.cos(angle) - dy * math.sin(angle)
            py = middle.y + dx * math.sin(angle) + dy * math.cos(angle)
            true = 3.0 + 6.0 * vigour(px - middle.x, py - middle.y)
            value = true * (1.0 + 0.03 * draw.standard_normal(len(y)))
            speed = SPEED_M_S * (1.0 + 0.04 * draw.standard_normal(len(y)))
            wrong = np.array(["" for _ in y], dtype=object)
            ends = np.minimum(np.arange(len(y)), np.arange(len(y))[::-1]) * SPEED_M_S
            value = np.where(ends < ENDS_M, value * ends / ENDS_M, value)
            wrong[ends < ENDS_M] = "end"
            jumps = draw.random(len(y)) < 0.01
            value[jumps] *= draw.choice([0.2, 2.5], jumps.sum())
            slow = draw.random(len(y)) < 0.005
            speed[slow], value[slow] = 0.3, value[slow] * 3.0
            wrong[jumps & (wrong == "")], wrong[slow & (wrong == "")] = "jump", "slow"
            if over:
                value, wrong[:] = value * 0.15, "over"
            rows += list(zip(px.tolist(), py.tolist(), value.tolist(), speed.tolist(),
                             wrong.tolist(), strict=True))  # fmt: skip
    return rows


def weeds(ground: Ground) -> list[tuple[float, float]]:
    """Return x and y of weeds, in patches."""
    draw = np.random.default_rng(SEED + 4)
    west, south, east, north = ground.bounds
    found: list[tuple[float, float]] = []
    for _ in range(12):
        x, y = draw.uniform(west, east), draw.uniform(south, north)
        for dx, dy in draw.normal(0.0, 2.0, (int(draw.integers(1, 9)), 2)).tolist():
            if ground.contains(shapely.Point(x + dx, y + dy)):
                found.append((x + dx, y + dy))
    return found


def cards() -> list[str]:
    """Return the rows of a table of cards under four passes."""
    draw = np.random.default_rng(SEED + 5)
    lines = ["pass,right_m,deposit,wind_right_m_s"]
    for number, wind in enumerate((0.4, 1.2, -0.8, 1.9), 1):
        for right in np.arange(-8.0, 8.1, 0.5).tolist():
            from_middle = right - 0.45 * wind
            flat = math.exp(-((abs(from_middle) / 3.1) ** 4))
            deposit = 10.0 * flat * (1.0 + 0.12 * math.cos(2.0 * math.pi * from_middle / 2.2))
            deposit = max(deposit * (1.0 + 0.08 * draw.standard_normal()), 0.0)
            lines.append(f"{number},{right:g},{deposit:.2f},{wind:g}")
    return lines


def main(folder: Path, given: Path | None = None) -> None:
    """Write all files."""
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(Path(__file__).with_name("config.toml"), folder / "config.toml")
    if given is None:
        local = CRS.from_proj4(
            f"+proj=tmerc +lat_0={LATITUDE_DEG} +lon_0={LONGITUDE_DEG} +k=1 +datum=WGS84"
        )
        degrees = moved(outline(), Transformer.from_crs(local, 4326, always_xy=True))
        text = {"type": "FeatureCollection", "features": [
            {"type": "Feature", "properties": {"name": "made up"},
             "geometry": json.loads(shapely.to_geojson(shapely.set_precision(degrees, 1e-9)))}
        ]}  # fmt: skip
        (folder / "boundary.geojson").write_text(json.dumps(text, indent=1) + "\n")
    else:
        collection = json.loads(given.read_text())
        degrees = shapely.union_all(
            [shapely.geometry.shape(one["geometry"]) for one in collection["features"]]
        )
        (folder / "boundary.geojson").write_text(given.read_text())
    longitude = degrees.centroid.x
    south = 100 if degrees.centroid.y < 0 else 0
    utm = CRS.from_epsg(32601 + south + int((longitude + 180.0) // 6))
    back = Transformer.from_crs(utm, 4326, always_xy=True)
    ground = moved(degrees, Transformer.from_crs(4326, utm, always_xy=True))
    raster(folder / "drone.tif", ground, utm, DRONE_M, 6.0)
    raster(folder / "satellite.tif", ground, utm, SATELLITE_M, 0.0)
    lines = ["lat,lon,yield_t_ha,speed_m_s"]
    truth = ["wrong"]
    for x, y, value, speed, wrong in harvest(ground):
        lon, lat = back.transform(x, y)
        lines.append(f"{lat:.8f},{lon:.8f},{value:.3f},{speed:.2f}")
        truth.append(wrong)
    (folder / "yield.csv").write_text("\n".join(lines) + "\n")
    (folder / "yield-truth.csv").write_text("\n".join(truth) + "\n")
    draw = np.random.default_rng(SEED + 3)
    west, low, east, high = ground.bounds
    soil = ["lat,lon,ec_ms_m"]
    scouted = []
    for x in np.arange(west, east, 25.0):
        for y in np.arange(low, high, 25.0):
            at = shapely.Point(x + draw.uniform(0, 12), y + draw.uniform(0, 12))
            if ground.contains(at):
                stand = float(vigour(np.array(at.x - ground.centroid.x),
                                     np.array(at.y - ground.centroid.y)))  # fmt: skip
                lon, lat = back.transform(at.x, at.y)
                soil.append(f"{lat:.8f},{lon:.8f},{20 + 30 * stand + draw.normal():.2f}")
            square = shapely.box(x, y, x + 25.0, y + 25.0)
            score = int(4 * float(vigour(np.array(x + 12 - ground.centroid.x),
                                         np.array(y + 12 - ground.centroid.y))))  # fmt: skip
            piece = moved(square, back)
            scouted.append({"type": "Feature", "properties": {"weeds": 4 - score},
                            "geometry": json.loads(str(shapely.to_geojson(piece)))})  # fmt: skip
    spots = [back.transform(x, y) for x, y in weeds(ground)]
    (folder / "weeds.csv").write_text(
        "\n".join(["lat,lon", *(f"{lat:.8f},{lon:.8f}" for lon, lat in spots)]) + "\n"
    )
    (folder / "cards.csv").write_text("\n".join(cards()) + "\n")
    (folder / "soil.csv").write_text("\n".join(soil) + "\n")
    (folder / "scouted.geojson").write_text(
        json.dumps({"type": "FeatureCollection", "features": scouted}) + "\n"
    )


if __name__ == "__main__":
    main(
        Path(sys.argv[1] if len(sys.argv) > 1 else "zones-data"),
        Path(sys.argv[2]) if len(sys.argv) > 2 else None,
    )
