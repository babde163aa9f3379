"""What of a task depends on ground, wind and room: read from files and `[mission]`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import shapely
from shapely import MultiPolygon

from companion.assembly import beyond_label
from companion.config import Config
from companion.config.tables import MissionTable
from companion.core.frame import LocalFrame
from companion.core.label import DAY_S, is_from
from missions.errors import PlanError
from missions.field import Field, WindBuffer, local_area
from missions.maps.local import grown
from missions.maps.registry import read_area
from missions.plan import Settings
from missions.reading_outline import near_features, told
from missions.surroundings import OVERRUN_M, RunIn
from missions.terrain import Terrain, read_dem

Autopilot = Literal["ardupilot", "px4"]
# The companion doses for the strips of its valves: passes spaced otherwise get another rate.
SPACING_SHARE = 0.02
CRACK_M = 0.25


@dataclass(frozen=True, slots=True, kw_only=True)
class GroundAsked:
    """What the command line asks for; None leaves it to the configuration."""

    terrain: Path | None = None
    autopilot: Autopilot | None = None
    wind: tuple[float, float] | None = None
    no_spray_buffer_m: float | None = None
    run_in: Literal["auto"] | float | None = None


NOTHING_ASKED = GroundAsked()


def _table(config: Config | None) -> MissionTable:
    """Return the configuration's [mission], or the defaults of its keys."""
    if config is not None and config.mission is not None:
        return config.mission
    return MissionTable(swath_width_m=6.0, speed_m_s=6.0)


def autopilot_of(asked: GroundAsked, config: Config | None) -> Autopilot:
    """Return for whom the files are written."""
    return asked.autopilot or _table(config).autopilot


def terrain_of(asked: GroundAsked, config: Config | None, frame: LocalFrame) -> Terrain | None:
    """Return the ground that the plan follows, if it follows any.

    Raises:
        PlanError, MapError: in one line, what is wrong and what to do.
    """
    mission = _table(config)
    path = asked.terrain
    if path is None and config is not None and mission.terrain is not None:
        path = config.resolve(mission.terrain)
    if path is None:
        return None
    autopilot, heights = autopilot_of(asked, config), mission.terrain_heights
    if autopilot == "px4" and heights == "vehicle":
        raise PlanError(
            "PX4 takes no heights above terrain: mission.terrain_heights must be file, or auto"
        )
    return Terrain(
        dem=read_dem(path),
        frame=frame,
        by_vehicle=heights == "vehicle" or (heights == "auto" and autopilot == "ardupilot"),
        tolerance_m=mission.terrain_tolerance_m,
        climb_m_s=mission.climb_max_m_s,
        descent_m_s=mission.descent_max_m_s,
    )


def wind_of(
    asked: GroundAsked, config: Config | None, *, has_areas: bool = True
) -> WindBuffer | None:
    """Return the wind that widens buffers, if one is given; without areas it widens none."""
    mission = _table(config)
    wind = asked.wind or mission.wind
    if wind is None:
        return None
    m_per_m_s = mission.wind_buffer_m_per_m_s
    if m_per_m_s is None and not has_areas:
        m_per_m_s = 0.0
    if m_per_m_s is None:
        raise PlanError(
            "with a wind the buffers need mission.wind_buffer_m_per_m_s: the metres that are added "
            "for each m/s towards a no-spray area, from the label or a drift trial"
        )
    try:
        return WindBuffer(speed_m_s=wind[0], from_deg=wind[1], m_per_m_s=m_per_m_s)
    except ValueError as error:
        raise PlanError(f"--wind: {error}; write SPEED,FROM in m/s and degrees") from None


def no_spray_buffer_m(asked: GroundAsked, config: Config | None) -> float:
    """Return the buffer of no-spray areas: never less than the configuration's."""
    return max(asked.no_spray_buffer_m or 0.0, _table(config).no_spray_buffer_m)


def buffered(
    config: Config, kept_m: float, frame: LocalFrame, opens: Mapping[str, str | None]
) -> list[MultiPolygon]:
    """Return what the label keeps away from, as wide as needed around what keeps `kept_m`."""
    return [
        grown(near_features(config.resolve(name), frame, opens), each.distance_m - kept_m, frame)
        for each in config.buffers
        for name in each.files
    ]


def check_label(
    config: Config | None, settings: Settings, asked: GroundAsked = NOTHING_ASKED
) -> None:
    """Refuse speed, height, droplets and wind of a plan that label or permit do not allow.

    Raises:
        PlanError: in one line, what is outside and what to change.
    """
    label = None if config is None else config.label
    if config is None or label is None:
        return
    speeds_m_s = (settings.speed_m_s, max(settings.speed_m_s, settings.speeds_m_s[1]))
    for name, values, unit, what in (
        ("speed_m_s", speeds_m_s, "m/s", "speed"),
        ("height_m", (settings.height_m, settings.height_m), "m", "height"),
    ):
        span = label.span(name)
        if span is not None and not span[0] <= values[0] <= values[1] <= span[1]:
            wrong = values[0] if not span[0] <= values[0] <= span[1] else values[1]
            raise PlanError(
                f"{config.limits_table.file}: {what} {label.words(name, unit)}, and passes are "
                f"planned at {wrong:g} {unit}; change mission.{name} or its option"
            )
    for problem in beyond_label(config):
        if problem.code == "label-droplets":
            raise PlanError(f"{problem.text}; {problem.fix}")
    wind, span = asked.wind or _table(config).wind, label.span("wind_m_s")
    if wind is not None and span is not None and not span[0] <= wind[0] <= span[1]:
        raise PlanError(
            f"{config.limits_table.file}: wind {label.words('wind_m_s', 'm/s')}, and this plan is "
            f"for {wind[0]:g} m/s; plan for another day"
        )
    if wind is not None and label.wind_from_deg and not is_from(wind[1], label.wind_from_deg):
        raise PlanError(
            f"{config.limits_table.file}: wind {label.wind_words()}, and this plan is for a wind "
            f"from {wind[1]:g} deg; plan for another day"
        )


def label_warnings(config: Config | None, sorties_s: Sequence[float], now_s: float) -> list[str]:
    """Return what days and hours of label and permit have against a plan.

    `sorties_s` is how long each sortie flies; `now_s` is today, in seconds since 1970.
    """
    label = None if config is None else config.label
    if config is None or label is None:
        return []
    flown, found = label.flown({}), []
    if flown.days_s is not None and not now_s < flown.days_s[1]:
        found.append(f"{config.limits_table.file}: the permit ended on {label.last_day}")
    longest_s = max(((last - first) % DAY_S for first, last in flown.hours_s), default=math.inf)
    if max(sorties_s, default=0.0) > longest_s:
        found.append(
            f"{config.limits_table.file}: a sortie of {max(sorties_s) / 60.0:.0f} min does not fit "
            f"into its hours, of {longest_s / 60.0:.0f} min at most; plan shorter sorties"
        )
    return found


def run_in_of(
    asked: GroundAsked,
    config: Config | None,
    field: Field,
    offset_m: tuple[float, float],
    *,
    opens: Mapping[str, str | None],
) -> RunIn | None:
    """Return the way before and behind passes, None where none is asked for."""
    mission = _table(config)
    wanted = mission.run_in_m if asked.run_in is None else asked.run_in
    if wanted != "auto" and not wanted > 0.0:
        return None
    areas = []
    if config is not None:
        paths = [config.resolve(name) for name in mission.overrun_areas]
        areas = [told(partial(read_area, path), opens) for path in paths]
    outside = [
        shapely.transform(local_area(area, field.frame), lambda points: points + offset_m)
        for area in areas
    ]
    if mission.overrun == "allowed":
        outside.append(field.outline.convex_hull.buffer(OVERRUN_M))
    ground = None
    if outside:
        # Ground beside the field is digitised with cracks to it, over which one may fly.
        everything = shapely.union_all([field.outline, *outside])
        closed = everything.buffer(CRACK_M, join_style="mitre").buffer(-CRACK_M, join_style="mitre")
        ground = closed.difference(field.blocked)
    return RunIn(run_m=None if wanted == "auto" else float(wanted), ground=ground)


def parse_wind(text: str | None) -> tuple[float, float] | None:
    """Return speed and origin of the wind as it is typed.

    >>> parse_wind("4,270"), parse_wind(None)
    ((4.0, 270.0), None)
    """
    if text is None:
        return None
    try:
        speed, origin = (float(part) for part in text.split(","))
    except ValueError:
        raise PlanError(f"--wind {text!r:.40}: write SPEED,FROM, such as 4,270") from None
    return speed, origin


def parse_run_in(text: str | None) -> Literal["auto"] | float | None:
    """Return a run-in as it is typed.

    >>> parse_run_in("auto"), parse_run_in("7.5"), parse_run_in(None)
    ('auto', 7.5, None)
    """
    if text is None or text == "auto":
        return "auto" if text == "auto" else None
    try:
        length_m = float(text)
    except ValueError:
        length_m = -1.0
    if not 0.0 <= length_m <= 200.0:
        raise PlanError(f"--run-in-m {text!r:.40}: write metres up to 200, or auto")
    return length_m


def spacing_m(
    config: Config | None, *, height_m: float, speed_m_s: float, boom_m: float | None
) -> float | None:
    """Return the spacing of passes by the measured swath; None without measurements.

    Raises:
        PlanError: outside of the table, and where the boom is configured for another swath.
    """
    rows: Sequence[SwathPoint] = [
        SwathPoint(height_m=row.height_m, speed_m_s=row.speed_m_s, width_m=row.width_m)
        for row in _table(config).swath
    ]
    if not rows:
        return None
    width_m = swath_width_m(rows, height_m=height_m, speed_m_s=speed_m_s)
    if boom_m is not None and not abs(width_m - boom_m) <= SPACING_SHARE * boom_m:
        raise PlanError(
            f"mission.swath has {width_m:.2f} m at {height_m:g} m and {speed_m_s:g} m/s, and the "
            f"companion doses for boom.width_m = {boom_m:g} m: rates would be "
            f"{100.0 * (boom_m / width_m - 1.0):+.0f} % off; make boom and valves as wide"
        )
    return width_m


# The measured swath by height and speed: bilinear inside the table, nothing outside it.


@dataclass(frozen=True, slots=True, kw_only=True)
class SwathPoint:
    """One measurement: the width that was wet evenly at a height and a speed."""

    height_m: float
    speed_m_s: float
    width_m: float


def swath_width_m(points: Sequence[SwathPoint], *, height_m: float, speed_m_s: float) -> float:
    """Return the swath at a height and a speed.

    >>> table = [SwathPoint(height_m=h, speed_m_s=v, width_m=w)
    ...          for h, v, w in ((2, 4, 5.0), (2, 8, 6.0), (4, 4, 6.0), (4, 8, 8.0))]
    >>> swath_width_m(table, height_m=3.0, speed_m_s=6.0)
    6.25

    Raises:
        PlanError: for a table with holes, and outside of it.
    """
    widths = {(point.height_m, point.speed_m_s): point.width_m for point in points}
    if len(widths) < len(points):
        raise PlanError("mission.swath has two widths for one height and speed; keep one")
    heights = sorted({height for height, _ in widths})
    speeds = sorted({speed for _, speed in widths})
    for height in heights:
        for speed in speeds:
            if (height, speed) not in widths:
                raise PlanError(
                    f"mission.swath has no width at {height:g} m and {speed:g} m/s; measure every "
                    "speed at every height"
                )
    for value, known, name, unit in (
        (height_m, heights, "height_m", "m"), (speed_m_s, speeds, "speed_m_s", "m/s")
    ):  # fmt: skip
        if not known[0] <= value <= known[-1]:
            raise PlanError(
                f"mission.{name} = {value:g} lies outside mission.swath, which was measured from "
                f"{known[0]:g} to {known[-1]:g} {unit}; measure it there, or fly within"
            )
    by_speed = [
        float(np.interp(height_m, heights, [widths[height, speed] for height in heights]))
        for speed in speeds
    ]
    return float(np.interp(speed_m_s, speeds, by_speed))
