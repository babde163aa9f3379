"""Makes the files of this folder: a made-up field with zones that are long enough for a pump.

Four passes of 6 m over eight zones of 60 m each, every rate 30 % above or below the one before it,
in the order of flight; both ends of the field are slanted by 45 degrees, so that sections shut one
after the other. Across the passes all is one zone: one pump gives all sections one rate. 15 m of
run-out. Run it again and nothing changes: `python examples/pump-sections/make.py [FOLDER]`.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from companion.core.frame import LocalFrame
from sitl.calibration_mission import write_mission
from sitl.stub.mission_items import MissionItem, speed, waypoint
from sitl.stub.protocol import dialect

LATITUDE_DEG, LONGITUDE_DEG = 46.1503, 14.4408  # the middle, where nothing stands
AZIMUTH_DEG = 80.0  # of the passes
PASSES, PASS_M, ZONE_M = 4, 6.0, 60.0
# Each 30 % above or below the one before it, as the first and third pass fly; the others backwards.
FORTH = (18.0, 23.4, 16.4, 21.3, 27.7, 19.4, 13.6, 17.7)
BACK = (22.0, 15.4, 20.0, 26.0, 18.2, 23.7, 16.6, 11.6)
LENGTH_M, HALF_M = ZONE_M * len(FORTH), 0.5 * PASSES * PASS_M
# Beside the outer passes, so that the outer strips are inside with their buffer.
ASIDE_M = 0.5
RUN_OUT_M, SPEED_M_S, HEIGHT_M = 15.0, 5.0, 3.5

Place = tuple[float, float]
Corner = Callable[[float, float], Place]


def slanted(along_m: float, across_m: float) -> Place:
    """Return a corner of the field, whose ends are slanted."""
    return along_m + across_m, across_m


def shifted(row: int) -> Corner:
    """Return how a boundary across the middle of a pass lies in the slanted field."""
    middle_m = (row + 0.5) * PASS_M - HALF_M
    return lambda along_m, across_m: (along_m + middle_m, across_m)


def zones() -> Iterator[tuple[float, list[Place]]]:
    """Yield each rate with its corners, in metres along and across; across to the right."""
    for row in range(PASSES):
        left, right = row * PASS_M - HALF_M, (row + 1) * PASS_M - HALF_M
        left -= ASIDE_M if row == 0 else 0.0
        right += ASIDE_M if row == PASSES - 1 else 0.0
        rates = FORTH if row % 2 == 0 else BACK[::-1]
        for number, rate in enumerate(rates):
            start, end = number * ZONE_M - 0.5 * LENGTH_M, (number + 1) * ZONE_M - 0.5 * LENGTH_M
            # Only the ends of the field are slanted: sections cross a change of rate together.
            first = slanted if number == 0 else shifted(row)
            last = slanted if number == len(rates) - 1 else shifted(row)
            yield rate, [first(start, left), last(end, left), last(end, right), first(start, right)]


def outline() -> list[Place]:
    """Return the corners of the field."""
    half, side = 0.5 * LENGTH_M, HALF_M + ASIDE_M
    return [slanted(a, c) for a, c in ((-half, -side), (half, -side), (half, side), (-half, side))]


def place(along_m: float, across_m: float) -> Place:
    """Return east and north of a place along and across the passes."""
    azimuth = math.radians(AZIMUTH_DEG)
    return (
        along_m * math.sin(azimuth) + across_m * math.cos(azimuth),
        along_m * math.cos(azimuth) - across_m * math.sin(azimuth),
    )


def feature(frame: LocalFrame, corners: list[Place], properties: dict[str, Any]) -> dict[str, Any]:
    """Return a polygon of a GeoJSON file; shells run against the clock."""
    ring = []
    for corner in [*corners[::-1], corners[-1]]:
        latitude, longitude = frame.to_geographic(*place(*corner))
        ring.append([round(longitude, 8), round(latitude, 8)])
    shape = {"type": "Polygon", "coordinates": [ring]}
    return {"type": "Feature", "properties": properties, "geometry": shape}


def write(path: Path, features: list[dict[str, Any]]) -> None:
    """Write a collection, one feature a line."""
    lines = ",\n".join(json.dumps(each) for each in features)
    path.write_text(
        f'{{"type": "FeatureCollection", "features": [\n{lines}\n]}}\n', encoding="utf-8"
    )


def items(frame: LocalFrame) -> tuple[MissionItem, ...]:
    """Return the mission: home, take-off, speed, the passes, the way home."""
    ends = []
    for row in range(PASSES):
        across = (row + 0.5) * PASS_M - HALF_M
        sign = 1.0 if row % 2 == 0 else -1.0
        for way in (-sign, sign):
            along = way * (0.5 * LENGTH_M + 0.5 * PASS_M + RUN_OUT_M) + across
            ends.append(frame.to_geographic(*place(along, across)))
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
    write(
        folder / "prescription.geojson",
        [
            feature(frame, corners, {"zone": str(number), "rate": rate, "unit": "L/ha"})
            for number, (rate, corners) in enumerate(zones(), start=1)
        ],
    )
    write(folder / "boundary.geojson", [feature(frame, outline(), {})])
    write_mission(items(frame), folder)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent)
