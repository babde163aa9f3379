"""The field, the pass over it and the configuration of a flight, all east of one point.

The field begins at 0 m east and ends at `field_m`; the vehicle comes from the west, stands, goes
and leaves it in the east, along a line of constant latitude.
"""

from __future__ import annotations

import json
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from companion.core.frame import LocalFrame
from sitl.stub.world import Pose

ROOT = Path(__file__).parents[3]
EXAMPLE = ROOT / "examples" / "anyang"
ORIGIN = LocalFrame(latitude_deg=36.0, longitude_deg=114.5)
CHANNELS = tuple(range(9, 15))
ALIVE_LINE = 15
CLOSED_US, FULL_US, DITHER_US = 1000, 2000, 8
SPEED_M_S, ACCELERATION_M_S2, HEIGHT_M = 5.0, 5.0, 3.5
# From the start to the border: to gather speed, and for the filters to settle.
RUN_UP_M = 5.0
HALF_LENGTH_M = 15.0
RATES_L_HA = (15.0, 25.0, 20.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Pass:
    """Gathers speed at `start_s` and goes on east for ever: a motion of the stub's world."""

    start_s: float

    def advance(self, until_s: float) -> None:
        """Do nothing: it is a formula."""

    def pose_at(self, time_s: float) -> Pose:
        """Return the pose at any time."""
        t_s = max(time_s - self.start_s, 0.0)
        full_s = SPEED_M_S / ACCELERATION_M_S2
        speed_m_s = ACCELERATION_M_S2 * min(t_s, full_s)
        gone_m = 0.5 * speed_m_s * min(t_s, full_s) + SPEED_M_S * max(t_s - full_s, 0.0)
        return Pose(
            time_s=time_s,
            east_m=gone_m - RUN_UP_M,
            north_m=0.0,
            height_m=HEIGHT_M,
            velocity_east_m_s=speed_m_s,
            heading_deg=90.0,
        )

    def finished(self, time_s: float) -> bool:
        """Return false: it never ends."""
        return False

    def reaches_s(self, east_m: float) -> float:
        """Return when it is somewhere east of where it has its full speed."""
        full_s = SPEED_M_S / ACCELERATION_M_S2
        gathered_m = 0.5 * SPEED_M_S * full_s
        return self.start_s + full_s + (east_m + RUN_UP_M - gathered_m) / SPEED_M_S


def lags(output: str) -> dict[str, float]:
    """Return the measured lags of the example's sprayer."""
    name = "gpio.toml" if output == "gpio" else "servo.toml"
    found = tomllib.loads((EXAMPLE / "lags" / name).read_text(encoding="utf-8"))
    return {key: float(value) for key, value in found["lag"].items() if key.endswith("_s")}


def write_files(folder: Path, field_m: float) -> Path:
    """Write map, border and configuration of a flight; return the configuration."""
    edges = [field_m * share for share in (0.0, 0.3, 0.7, 1.0)]
    zones = [
        _feature(west, east, {"rate": rate})
        for west, east, rate in zip(edges, edges[1:], RATES_L_HA, strict=False)
    ]
    _write(folder / "zones.geojson", zones)
    _write(folder / "border.geojson", [_feature(0.0, field_m, {})])
    text = (EXAMPLE / "config.toml").read_text(encoding="utf-8")
    for was, becomes in (("prescription.shp", "zones.geojson"), ("boundary.geo", "border.geo")):
        if was not in text:
            raise ValueError(f"the example's configuration has no {was} any more")
        text = text.replace(was, becomes)
    path = folder / "config.toml"
    path.write_text(text, encoding="utf-8")
    return path


def settings(output: str, url: str) -> list[str]:
    """Return the settings that a flight has beside those of the file."""
    # Where a script runs, it is another's than the stub's.
    found = [f"link.url={url}", "prescription.unit=L/ha", "output.guard=none-on-power-loss"]
    if output == "gpio":
        found += ["output.kind=gpio", f"gpio.alive_line={ALIVE_LINE}"]
        found += [f"lag.{key}={value}" for key, value in lags("gpio").items()]
    elif output == "dither":
        found.append(f"output.dither_us={DITHER_US}")
    return found


def _feature(west_m: float, east_m: float, properties: dict[str, Any]) -> dict[str, Any]:
    corners = ((west_m, -1), (east_m, -1), (east_m, 1), (west_m, 1), (west_m, -1))
    ring = []
    for east, side in corners:
        latitude, longitude = ORIGIN.to_geographic(east, side * HALF_LENGTH_M)
        ring.append([round(float(longitude), 9), round(float(latitude), 9)])
    geometry = {"type": "Polygon", "coordinates": [ring]}
    return {"type": "Feature", "properties": properties, "geometry": geometry}


def _write(path: Path, features: list[dict[str, Any]]) -> None:
    whole = {"type": "FeatureCollection", "features": features}
    path.write_text(json.dumps(whole), encoding="utf-8")
