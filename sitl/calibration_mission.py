"""Files of the flight that `vrspray calibrate lag` needs: mission, map, configuration."""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass
from pathlib import Path

from companion.config import Config, load
from companion.core.frame import LocalFrame
from companion.core.rate import rate_for_flow
from companion.errors import ConfigError
from companion.maps.compiling import compiled_setup
from sitl.calibration_layout import RUN_OUT_M, Layout, make_layout
from sitl.mission_writing import plan, waypoint_lines
from sitl.stub.mission_items import MissionItem, landing, speed, waypoint
from sitl.stub.protocol import dialect

SUFFIXES = (".plan", ".waypoints")


@dataclass(frozen=True, slots=True, kw_only=True)
class Written:
    """The files of a calibration flight, and what it will be like."""

    mission: Path
    prescription: Path
    config: Path
    layout: Layout


def write_calibration(
    config_path: Path,
    out: Path,
    *,
    origin: tuple[float, float] | None = None,
    heading_deg: float | None = None,
) -> Written:
    """Write mission, map and configuration of a calibration flight, and check that they fit.

    The first pass begins at `origin` (latitude, longitude), by default at the first depot or the
    centre of the configured map, and leads along `heading_deg`.
    """
    if out.suffix not in SUFFIXES:
        raise ConfigError(f"--out {out}: name it .plan or .waypoints")
    config = load(config_path)
    layout = make_layout(config)
    heading = _heading_deg(config) if heading_deg is None else heading_deg
    if not math.isfinite(heading):
        raise ConfigError(f"--heading-deg {heading}: give degrees clockwise from north")
    frame = LocalFrame(*(_place(config) if origin is None else origin))
    turned = _Turned(frame, heading)
    prescription = out.with_name(f"{out.stem}-map.geojson")
    copy = out.with_name(f"{out.stem}-config.toml")
    if copy.resolve() == config_path.resolve():
        raise ConfigError(f"--out {out}: {copy} is the configuration itself; take another name")
    _write(prescription, _map_text(layout, turned))
    _write(copy, _with_map(config.source_text, prescription.name))
    items = _items(layout, turned)
    if out.suffix == ".plan":
        text = json.dumps(plan(items), indent=1)
    else:
        text = "\n".join(waypoint_lines(items))
    _write(out, f"{text}\n")
    compiled_setup(load(copy))  # refuses what could not be flown, such as a product's label
    return Written(mission=out, prescription=prescription, config=copy, layout=layout)


def _place(config: Config) -> tuple[float, float]:
    """Return latitude and longitude of the first depot, or of the middle of the map."""
    if config.mission is not None and config.mission.depots:
        return config.mission.depots[0]
    if config.prescription is None:
        raise ConfigError(
            f"{config.path}: neither mission.depots nor a map says where to fly; give "
            "--origin LATITUDE,LONGITUDE"
        )
    frame = compiled_setup(config).frame
    return frame.latitude_deg, frame.longitude_deg


def _heading_deg(config: Config) -> float:
    angle = None if config.mission is None else config.mission.angle_deg
    return angle if isinstance(angle, float) else 0.0


class _Turned:
    """Metres along the first pass and to its right, as degrees."""

    def __init__(self, frame: LocalFrame, heading_deg: float) -> None:
        self._frame = frame
        self._east, self._north = (
            math.sin(math.radians(heading_deg)),
            math.cos(math.radians(heading_deg)),
        )

    def place(self, along_m: float, right_m: float) -> tuple[float, float]:
        """Return latitude and longitude."""
        east_m = along_m * self._east + right_m * self._north
        north_m = along_m * self._north - right_m * self._east
        return self._frame.to_geographic(east_m, north_m)


def _spans(layout: Layout) -> list[tuple[int, int, float, float, float, float]]:
    """Return pass, strip, from, to (along the first pass), distance to the right, and flow."""
    spans = []
    for number, flows in enumerate(layout.passes):
        right_m = number * (layout.width_m + 1.0)
        longest_m = len(layout.passes[0]) * layout.strip_m
        for place, flow in enumerate(flows):
            from_m, to_m = place * layout.strip_m, (place + 1) * layout.strip_m
            if number % 2:  # flown the other way
                from_m, to_m = longest_m - to_m, longest_m - from_m
            spans.append((number, place, from_m, to_m, right_m, flow))
    return spans


def _map_text(layout: Layout, turned: _Turned) -> str:
    """Return the prescription as GeoJSON: one strip on a line."""
    features = []
    for number, place, from_m, to_m, right_m, flow in _spans(layout):
        left_m, far_m = right_m - 0.5 * layout.width_m, right_m + 0.5 * layout.width_m
        corners = (
            (from_m, left_m),
            (from_m, far_m),
            (to_m, far_m),
            (to_m, left_m),
            (from_m, left_m),
        )
        ring = [[round(value, 9) for value in turned.place(*corner)[::-1]] for corner in corners]
        rate = rate_for_flow(flow, layout.speed_m_s, layout.boom_m) if flow else 0.0
        name = f"{number + 1}.{place + 1}"
        feature = {
            "type": "Feature",
            "properties": {"name": name, "rate": round(rate, 6), "unit": "L/ha"},
            "geometry": {"type": "Polygon", "coordinates": [ring]},
        }
        features.append(json.dumps(feature))
    lines = ",\n".join(features)
    return f'{{"type": "FeatureCollection",\n"features": [\n{lines}\n]}}\n'


def _items(layout: Layout, turned: _Turned) -> tuple[MissionItem, ...]:
    """Return home, take-off, speed, the passes back and forth, landing."""
    ends = []
    longest_m = len(layout.passes[0]) * layout.strip_m
    for number in range(len(layout.passes)):
        right_m = number * (layout.width_m + 1.0)
        both = [turned.place(at_m, right_m) for at_m in (-RUN_OUT_M, longest_m + RUN_OUT_M)]
        ends += both if number % 2 == 0 else both[::-1]
    start = ends[0]
    return (
        waypoint(dialect.MAV_CMD_NAV_WAYPOINT, *start, height_m=0.0),
        waypoint(dialect.MAV_CMD_NAV_TAKEOFF, *start, height_m=layout.height_m),
        speed(layout.speed_m_s),
        *(
            waypoint(dialect.MAV_CMD_NAV_WAYPOINT, *end, height_m=layout.height_m)
            for end in ends[1:]
        ),
        landing(*ends[-1]),
    )


def _with_map(text: str, file: str) -> str:
    """Return a configuration's text with another map, and nothing else of its prescription."""
    kept, is_dropped = [], False
    for line in text.splitlines():
        header = re.match(r"\s*\[+\s*([A-Za-z0-9_.-]+)", line)
        if header is not None:
            is_dropped = header[1].split(".")[0] == "prescription"
        if not is_dropped:
            kept.append(line)
    table = f'[prescription]\nfile = {json.dumps(file)}\nrate_field = "rate"\n'
    return "\n".join([*kept, "", table])


def _write(path: Path, text: str) -> None:
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written ({error.strerror or error})") from error
