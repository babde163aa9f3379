"""Fields, missions and configurations of the flights: written by hand, as a user has them."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any

from tests.firmware.station import MissionItem

EXAMPLE = Path(__file__).parents[2] / "examples" / "anyang"
HOME_DEG = (35.9959511, 114.5434850)
HOME = f"{HOME_DEG[0]},{HOME_DEG[1]},60,12"
COURSE_DEG = 12.0
HEIGHT_M = 3.5
# Zones of 9 to 16 m; rates for 5 m/s, with steps of 17 to 75 %, up and down.
ZONES_M = (9.0, 12.0, 16.0, 10.0, 14.0, 11.0, 13.0, 15.0)
RATES_L_HA = (15.0, 24.0, 20.0, 28.0, 18.0, 21.0, 12.0, 17.0)
# Steps of 17 % at the lower end of the flow table, for 3 m/s: where a curve through the table that
# is flat at its end lets most of them vanish (42 changes: 30 missed).
LOW_RATES_L_HA = (15.0, 17.6, 15.0, 17.6, 20.6, 17.6, 15.0, 17.6)
FIRST_M, HALF_WIDTH_M, RUN_OUT_M = 20.0, 5.0, 15.0
METRES_A_DEGREE = 111_319.49


@dataclass(frozen=True, slots=True)
class Track:
    """A straight line from home: places on it by the way along and to its right."""

    course_deg: float = COURSE_DEG

    def place(self, along_m: float, right_m: float = 0.0) -> tuple[float, float]:
        """Return latitude and longitude."""
        course = math.radians(self.course_deg)
        north_m = along_m * math.cos(course) - right_m * math.sin(course)
        east_m = along_m * math.sin(course) + right_m * math.cos(course)
        latitude = HOME_DEG[0] + north_m / METRES_A_DEGREE
        longitude = HOME_DEG[1] + east_m / METRES_A_DEGREE / math.cos(math.radians(HOME_DEG[0]))
        return latitude, longitude

    def ring(self, from_m: float, to_m: float, half_m: float) -> list[list[float]]:
        """Return a rectangle as GeoJSON has it."""
        corners = ((from_m, -half_m), (from_m, half_m), (to_m, half_m), (to_m, -half_m))
        found = [list(reversed(self.place(*corner))) for corner in corners]
        return [*found, found[0]]


def _features(*rings: tuple[list[list[float]], dict[str, Any]]) -> str:
    return json.dumps(
        {
            "type": "FeatureCollection",
            "features": [
                {
                    "type": "Feature",
                    "geometry": {"type": "Polygon", "coordinates": [ring]},
                    "properties": properties,
                }
                for ring, properties in rings
            ],
        }
    )


def copy_example(folder: Path) -> Path:
    """Copy the example's folder; return it."""
    return shutil.copytree(EXAMPLE, folder, ignore=shutil.ignore_patterns("flights", "state"))


def write_pass(
    folder: Path, rates_l_ha: Sequence[float] = RATES_L_HA, *, config: str = "config.toml"
) -> Path:
    """Write one pass over eight zones; return the configuration."""
    copy_example(folder)
    track = Track()
    ends_m = list(accumulate(ZONES_M, initial=FIRST_M))
    zones = [
        (track.ring(start, end, HALF_WIDTH_M), {"rate": rate})
        for (start, end), rate in zip(pairwise(ends_m), rates_l_ha, strict=True)
    ]
    (folder / "zones.geojson").write_text(_features(*zones))
    outline = track.ring(ends_m[0], ends_m[-1], HALF_WIDTH_M)
    (folder / "boundary.geojson").write_text(_features((outline, {})))
    path = folder / config
    text = path.read_text().replace("prescription.shp", "zones.geojson")
    path.write_text(text.replace('rate_field = "rate"', 'rate_field = "rate"\nunit = "L/ha"'))
    return path


def pass_items(speed_m_s: float, *, passes: int = 1) -> list[MissionItem]:
    """Return the mission of that pass, home first: there, and back for a second one."""
    track = Track()
    far_m = FIRST_M + sum(ZONES_M) + RUN_OUT_M
    turns = [track.place(far_m if number % 2 == 0 else 0.0) for number in range(passes)]
    return [
        MissionItem(16, *HOME_DEG, 0.0, 0),
        MissionItem(22, *HOME_DEG, HEIGHT_M),
        MissionItem(178, frame=2, values=(1.0, speed_m_s, 0.0, 0.0)),
        MissionItem(16, *HOME_DEG, HEIGHT_M),
        *(MissionItem(16, *turn, HEIGHT_M) for turn in turns),
        MissionItem(21, *turns[-1]),
    ]


def file_items(path: Path) -> list[MissionItem]:
    """Return the items of a QGC WPL 110 file."""
    rows = [line.split("\t") for line in path.read_text().splitlines()[1:]]
    return [
        MissionItem(
            command=int(row[3]),
            latitude_deg=float(row[8]),
            longitude_deg=float(row[9]),
            height_m=float(row[10]),
            frame=int(row[2]),
            values=(float(row[4]), float(row[5]), float(row[6]), float(row[7])),
        )
        for row in rows
    ]
