"""Makes the files of this folder: a small, ragged orchard, made up, and a mission over it.

About 2 ha; 120 to 180 L/ha in steps of 20, in cells of 4 m as maps made from satellite images
have them, so that zones fall into many parts with holes; two ponds that are not part of the
field; a patch and a strip of rate 0. Without a boundary file: the outline of all zones is the
border. The mission is a set of straight passes 6 m apart, 4 m/s, 15 m of run-out. Run it again and
nothing changes: `python examples/orchard/make.py [FOLDER]`.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import shapefile
import shapely
from pyproj import CRS

from companion.core.frame import LocalFrame
from sitl.calibration_mission import write_mission
from sitl.stub.mission_items import MissionItem, speed, waypoint
from sitl.stub.protocol import dialect

LATITUDE_DEG, LONGITUDE_DEG = 47.4205, 8.7312  # the middle, where nothing stands
AZIMUTH_DEG = 23.0  # of the rows
LENGTH_M, WIDTH_M = 190.0, 118.0
CELL_M = 4.0
LEVELS_L_HA = (120.0, 140.0, 160.0, 180.0)
PONDS = ((-42.0, 12.0, 9.0), (38.0, -24.0, 6.5))  # along, across, radius
BARE = (20.0, 22.0, 13.0)  # the patch of rate 0
STRIP_ACROSS_M = (-9.0, -2.0)  # the strip of rate 0 lies between these, along -10 to 60
STRIP_ALONG_M = (-10.0, 60.0)
SPACING_M, RUN_OUT_M, SPEED_M_S, HEIGHT_M = 6.0, 15.0, 4.0, 3.5

Ground = Any  # a polygon or several


def outline() -> Ground:
    """Return the ragged outline, in metres along and across, ponds taken out."""
    ring = []
    for degree in range(0, 360, 4):
        angle = math.radians(degree)
        bend = 1.0 + 0.06 * math.sin(3.0 * angle + 1.0) + 0.04 * math.sin(11.0 * angle)
        bend += 0.025 * math.sin(29.0 * angle + 2.0)
        ring.append(
            (0.5 * LENGTH_M * bend * math.cos(angle), 0.5 * WIDTH_M * bend * math.sin(angle))
        )
    ground: Ground = shapely.Polygon(ring)
    for along, across, radius in PONDS:
        ground = ground.difference(shapely.Point(along, across).buffer(radius, quad_segs=4))
    return ground


def level(along_m: float, across_m: float) -> int:
    """Return which of the levels a place has: a smooth ground with some speckle."""
    value = 0.5 + 0.35 * math.sin(along_m / 23.0 + 0.4) * math.cos(across_m / 17.0)
    value += 0.15 * math.sin(along_m / 7.0 - across_m / 5.0)
    return min(max(int(value * len(LEVELS_L_HA)), 0), len(LEVELS_L_HA) - 1)


def bare() -> Ground:
    """Return the ground of rate 0."""
    along, across, radius = BARE
    strip = shapely.box(STRIP_ALONG_M[0], STRIP_ACROSS_M[0], STRIP_ALONG_M[1], STRIP_ACROSS_M[1])
    return strip.union(shapely.Point(along, across).buffer(radius, quad_segs=3))


def zones() -> Iterator[tuple[float, Ground]]:
    """Yield each rate with its ground, in metres along and across."""
    field, dry = outline(), bare()
    cells: dict[int, list[Ground]] = {number: [] for number in range(len(LEVELS_L_HA))}
    columns, rows = math.ceil(0.6 * LENGTH_M / CELL_M), math.ceil(0.6 * WIDTH_M / CELL_M)
    for column in range(-columns, columns):
        for row in range(-rows, rows):
            west, south = column * CELL_M, row * CELL_M
            cell = shapely.box(west, south, west + CELL_M, south + CELL_M)
            cells[level(west + 0.5 * CELL_M, south + 0.5 * CELL_M)].append(cell)
    yield 0.0, field.intersection(dry)
    for number, rate in enumerate(LEVELS_L_HA):
        yield rate, shapely.union_all(cells[number]).intersection(field).difference(dry)


def _place(along_m: float, across_m: float) -> tuple[float, float]:
    """Return east and north of a place along and across the rows."""
    azimuth = math.radians(AZIMUTH_DEG)
    return (
        along_m * math.sin(azimuth) + across_m * math.cos(azimuth),
        along_m * math.cos(azimuth) - across_m * math.sin(azimuth),
    )


def write_prescription(frame: LocalFrame, folder: Path) -> None:
    """Write the shapefile: one record a rate, of many parts."""
    target = str(folder / "prescription")
    with shapefile.Writer(target, shapeType=shapefile.POLYGON, encoding="utf-8") as writer:
        writer.field("zone", "N", 4, 0)
        writer.field("rate", "N", 8, 1)
        writer.field("unit", "C", 8)
        for number, (rate, ground) in enumerate(zones()):
            writer.poly([ring for part in _polygons(ground) for ring in _rings(part, frame)])
            writer.record(number, rate, "L/ha")
    dbf = folder / "prescription.dbf"
    header = bytearray(dbf.read_bytes())
    header[1:4] = bytes((124, 1, 1))  # the date of the last update: not that of the run
    dbf.write_bytes(bytes(header))
    (folder / "prescription.prj").write_text(
        CRS.from_epsg(4326).to_wkt("WKT1_ESRI"), encoding="ascii"
    )
    (folder / "prescription.cpg").write_text("UTF-8", encoding="ascii")


def _polygons(ground: Ground) -> list[shapely.Polygon]:
    """Return the parts that are large enough to be drawn."""
    parts = [part for part in shapely.get_parts(ground) if isinstance(part, shapely.Polygon)]
    return [part for part in parts if part.area > 1e-6]


def _rings(part: shapely.Polygon, frame: LocalFrame) -> Iterator[list[tuple[float, float]]]:
    """Yield the rings in degrees; the format wants shells clockwise and holes the other way."""
    turned = shapely.orient_polygons(part, exterior_cw=True)
    for ring in (turned.exterior, *turned.interiors):
        degrees = []
        for along, across in ring.coords:
            latitude, longitude = frame.to_geographic(*_place(along, -across))
            degrees.append((round(longitude, 9), round(latitude, 9)))
        yield degrees


def passes() -> Iterator[tuple[tuple[float, float], tuple[float, float]]]:
    """Yield start and end of each pass, along and across, back and forth."""
    half_m = 0.5 * LENGTH_M + RUN_OUT_M
    count = round(WIDTH_M / SPACING_M)
    for number in range(count):
        across = (number - 0.5 * (count - 1)) * SPACING_M
        sign = 1.0 if number % 2 == 0 else -1.0
        yield (-sign * half_m, across), (sign * half_m, across)


def items(frame: LocalFrame) -> tuple[MissionItem, ...]:
    """Return the mission: home, take-off, speed, the passes, the way home."""
    ends = [frame.to_geographic(*_place(*end)) for line in passes() for end in line]
    go, hop = dialect.MAV_CMD_NAV_WAYPOINT, dialect.MAV_CMD_NAV_TAKEOFF
    return (
        waypoint(go, *ends[0], height_m=0.0),
        waypoint(hop, *ends[0], height_m=HEIGHT_M),
        speed(SPEED_M_S),
        *(waypoint(go, *end, height_m=HEIGHT_M) for end in ends[1:]),
        MissionItem(command=dialect.MAV_CMD_NAV_RETURN_TO_LAUNCH),
    )


def main(folder: Path) -> None:
    """Write all files of the example that are data."""
    frame = LocalFrame(LATITUDE_DEG, LONGITUDE_DEG)
    write_prescription(frame, folder)
    write_mission(items(frame), folder)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent)
