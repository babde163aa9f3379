"""Files of the flight that `vrspray calibrate lag` needs: mission, map, configuration."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import shapely

from analysis.calibration.steps import settle_s
from companion.config import Config, load
from companion.core.frame import LocalFrame
from companion.core.nozzle import SET_UP_FRACTION, rate_for_flow, set_change_l_min
from companion.errors import ConfigError, VrsprayError
from companion.map_formats import geojson_feature, geojson_text
from missions.files.items import Autopilot, Item
from missions.files.write import plan_content, plan_json, rows_text
from missions.maps.compiling import compiled_setup
from sitl.stub.mission_items import PLACES, MissionItem, landing, speed, waypoint
from sitl.stub.protocol import dialect

# The flight that `vrspray calibrate lag` needs: strips across the passes, a step at every edge.
#
# Each cycle goes closed, low, high, low, closed or closed, high, low, high, closed by turns: one
# change of each kind. Every strip is long enough for the flow to settle and then to be metered
# over whole PWM periods. Strips of rate 0 lie between the cycles and around them, so all steps
# are inside the field and every valve changes at once.

CYCLES = 12
STEADY_S = 1.6  # of metered flow on both sides of a step
PASS_MAX_M = 200.0
RUN_OUT_M = 20.0
MARGIN_M = 4.0  # strips are wider than the boom by this
TURN_S = 8.0  # about, for the stated duration
DEFAULT_SPEED_M_S = 5.0
DEFAULT_HEIGHT_M = 3.5
# Within the valves' window, away from its ends: the speed is not quite that of the mission.
LOW_SHARE, HIGH_SHARE = 0.15, 0.90
# A low flow that must not have the controller change to a smaller nozzle set.
ABOVE_SET = 1.05
STEP_MIN = 0.15


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """The whole flight: every pass has the same strips, one after the other along it.

    `flows_l_min` are those of the strips of one pass, closed ones included.
    """

    speed_m_s: float
    height_m: float
    strip_m: float
    width_m: float
    boom_m: float
    passes: tuple[tuple[float, ...], ...]

    @property
    def volume_l(self) -> float:
        """Return what is sprayed in all."""
        return math.fsum(map(math.fsum, self.passes)) * self.strip_m / self.speed_m_s / 60.0

    @property
    def duration_s(self) -> float:
        """Return how long the passes and the turns between them take, about."""
        length_m = math.fsum(len(flows) * self.strip_m + 2.0 * RUN_OUT_M for flows in self.passes)
        return length_m / self.speed_m_s + TURN_S * len(self.passes)


def make_layout(config: Config) -> Layout:
    """Return strips for twelve changes of each kind, for the sprayer of a configuration."""
    speed_m_s = DEFAULT_SPEED_M_S if config.mission is None else config.mission.speed_m_s
    height_m = DEFAULT_HEIGHT_M if config.mission is None else config.mission.height_m
    low, high = _flows(config)
    strip_m = speed_m_s * (settle_s(config.lag_model()) + STEADY_S)
    per_pass = max(1, min(CYCLES, int((PASS_MAX_M / strip_m - 1.0) / 4.0)))
    cycles = [(low, high, low) if i % 2 == 0 else (high, low, high) for i in range(CYCLES)]
    passes = []
    for first in range(0, CYCLES, per_pass):
        flows = [0.0]
        for cycle in cycles[first : first + per_pass]:
            flows += [*cycle, 0.0]
        passes.append(tuple(flows))
    boom_m = config.boom().width_m
    return Layout(
        speed_m_s=speed_m_s,
        height_m=height_m,
        strip_m=strip_m,
        width_m=boom_m + MARGIN_M,
        boom_m=boom_m,
        passes=tuple(passes),
    )


def _flows(config: Config) -> tuple[float, float]:
    """Return a low and a high flow that all valves of the largest set can make."""
    sets, pwm = config.nozzle_sets(), config.pwm_limits()
    curve = sets[-1].curve
    window = pwm.duty_max - pwm.duty_min
    low = curve.flow_for(max(pwm.duty_min + LOW_SHARE * window, curve.duty[0]))
    high = curve.flow_for(min(pwm.duty_min + HIGH_SHARE * window, curve.duty[-1]))
    if len(sets) > 1:
        low = max(low, set_change_l_min(sets[-2], sets[-1]) * SET_UP_FRACTION * ABOVE_SET)
    if not low <= (1.0 - STEP_MIN) * high:
        raise ConfigError(
            f"{config.path}: the largest nozzle set makes {low:.2f} to {high:.2f} L/min and no "
            f"step of {STEP_MIN:.0%} within; measure pwm.duty_min, pwm.duty_max and its curve"
        )
    return low, high


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
    items = _items(layout, turned)
    autopilot = config.mission.autopilot if config.mission else "ardupilot"
    is_plan = out.suffix == ".plan"
    _write(prescription, _map_text(layout, turned))
    _write(copy, _with_map(config.source_text, prescription.name))
    _write(out, plan_of(items, autopilot=autopilot) if is_plan else waypoints_of(items))
    try:
        compiled_setup(load(copy))
    except VrsprayError:  # nobody flies what would spray nothing
        for path in (prescription, copy, out):
            path.unlink()
        raise
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
        ground = shapely.Polygon([turned.place(*corner)[::-1] for corner in corners])
        rate = rate_for_flow(flow, layout.speed_m_s, layout.boom_m) if flow else 0.0
        name = f"{number + 1}.{place + 1}"
        features.append(
            geojson_feature(ground, {"name": name, "rate": round(rate, 6), "unit": "L/ha"})
        )
    return geojson_text(features)


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


# What a configuration says of its field and of what is sprayed there: here it is water.
OF_A_FIELD = ("prescription", "coverage", "limits", "tank", "application", "product", "mix")
LINES = "mission.lines"


def _with_map(text: str, file: str) -> str:
    """Return a configuration's text with another map, and nothing that belongs to its own field."""
    kept, table = [], ""
    for line in text.splitlines():
        if header := re.match(r"\s*\[{1,2}\s*([A-Za-z][\w.-]*)\s*\]", line):
            table = f"{header[1]}."
        key = re.match(r"\s*([\w.-]+)\s*=", line)
        name = table + (key[1] if key else "")
        if name.partition(".")[0] not in OF_A_FIELD and name != LINES:
            kept.append(line)
    named = f'[prescription]\nfile = {json.dumps(file)}\nrate_field = "rate"\n'
    return "\n".join([*kept, "", named])


def _write(path: Path, text: str) -> None:
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written ({error.strerror or error})") from error


# Mission files for simulated flights, of what `stub/mission_items.py` flies; home comes first.

OPEN_YAW = (dialect.MAV_CMD_NAV_WAYPOINT, dialect.MAV_CMD_NAV_TAKEOFF, dialect.MAV_CMD_NAV_LAND)
# What QGroundControl takes for legs without a speed of their own.
HOVER_M_S = 5.0


def plan_of(items: Sequence[MissionItem], *, autopilot: Autopilot = "ardupilot") -> str:
    """Return QGroundControl's plan."""
    home, *own = items
    content = plan_content(
        [_item(one) for one in own],
        home=(home.latitude_deg, home.longitude_deg),
        autopilot=autopilot,
        speed_m_s=HOVER_M_S,
    )
    return plan_json(content)


def waypoints_of(items: Sequence[MissionItem]) -> str:
    """Return QGC WPL 110."""
    home, *own = items
    return rows_text([_item(one) for one in own], home=(home.latitude_deg, home.longitude_deg))


def _item(item: MissionItem) -> Item:
    has_place = item.command in PLACES
    # A yaw of 0 is the north to PX4; null leaves it to the autopilot.
    yaw_deg = item.param4 if item.param4 or item.command not in OPEN_YAW else None
    return Item(
        command=item.command,
        frame=item.frame,
        params=(item.param1, item.param2, item.param3, yaw_deg),
        latitude_deg=item.latitude_deg if has_place else 0.0,
        longitude_deg=item.longitude_deg if has_place else 0.0,
        altitude_m=item.z_m,
    )


def write_mission(items: Sequence[MissionItem], folder: Path) -> None:
    """Write `mission.waypoints` and `mission.plan` into a folder."""
    (folder / "mission.waypoints").write_text(waypoints_of(items), encoding="utf-8")
    (folder / "mission.plan").write_text(plan_of(items), encoding="utf-8")
