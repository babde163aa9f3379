"""Writing a plan; the suffix says in which format."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from companion.map_formats import (
    DEGREE_DECIMALS,
    KML_HEAD,
    KML_TAIL,
    geojson_feature,
    geojson_text,
    kml_places,
    kml_text,
)
from missions.errors import PlanError
from missions.files.fence import Fences, fence_content
from missions.files.items import (
    ABOVE_GROUND,
    RELATIVE,
    WAYPOINT,
    Autopilot,
    Item,
    check_content,
    check_items,
    items_of,
)
from missions.maps.model import write_whole
from missions.plan import Leg, Place, Plan, Sortie

ONE_SORTIE = (".plan", ".waypoints")
FORMATS = (*ONE_SORTIE, ".geojson", ".kml")
LINES_SUFFIX = ".lines.geojson"


def check_suffix(out: Path) -> None:
    """Refuse a file whose suffix names no format."""
    if out.suffix.casefold() not in FORMATS:
        raise PlanError(
            f"--out {out}: the format {out.suffix or 'without a suffix'} is not known; "
            f"take one of {', '.join(FORMATS)}"
        )


def format_warnings(plan: Plan, out: Path) -> list[str]:
    """Warn of a format that says less than the autopilot of the plan needs."""
    if plan.settings.autopilot != "px4" or out.suffix.casefold() != ".waypoints":
        return []
    return [
        f"{out.name}: a ground station sends PX4 a yaw of 0 with every waypoint of this format: "
        "nose and boom stay pointed north; write a .plan, or send this file with vrspray upload"
    ]


def paths_of(out: Path, sorties: int) -> list[Path]:
    """Return the files that are written: of formats for one sortie, one for each.

    The first sortie is in the file that was asked for, the others are numbered beside it.

    >>> [path.name for path in paths_of(Path("m.plan"), 3)]
    ['m.plan', 'm-2.plan', 'm-3.plan']
    """
    if out.suffix.casefold() not in ONE_SORTIE:
        return [out]
    more = [out.with_name(f"{out.stem}-{number}{out.suffix}") for number in range(2, sorties + 1)]
    return [out, *more]


def lines_path(out: Path) -> Path | None:
    """Return where the lines of a plan are, for `mission.lines`; None for a format to look at.

    >>> lines_path(Path("m.plan")), lines_path(Path("m.kml"))
    (PosixPath('m.lines.geojson'), None)
    """
    suffix = out.suffix.casefold()
    if suffix == ".geojson":
        return out
    return out.with_name(out.stem + LINES_SUFFIX) if suffix in ONE_SORTIE else None


def refuse_existing(out: Path, beside: Sequence[Path] = (), *, option: str = "--out") -> None:
    """Refuse to replace a plan or what is `beside` it, or to mix its sorties with another's."""
    older = [*([out] if out.is_file() else []), *older_files(out, [out])]
    there = [path for path in older if path.suffix == out.suffix]
    more = [path for path in (*older, *beside) if path not in there and path.is_file()]
    if not there and not more:
        return
    names = " and ".join(names_of(paths) for paths in (there, more) if paths)
    verb = "are" if len(there) + len(more) > 1 else "is"
    where = "" if out.parent == Path() else f" in {out.parent}"
    raise PlanError(
        f"{names} {verb} there already{where}; give another {option}, or --force to replace "
        "this plan with all its files"
    )


def remove_older(out: Path, written: Sequence[Path]) -> list[Path]:
    """Remove files of the plan that was replaced: one of them would be flown for one of these."""
    found = older_files(out, written)
    for path in found:
        try:
            path.unlink()
        except OSError as error:
            reason = (error.strerror or "cannot be removed").lower()
            raise PlanError(f"{path}: a file of an earlier plan: {reason}; delete it") from error
    return found


def names_of(paths: Sequence[Path]) -> str:
    """Return the names of files for a line of text.

    >>> names_of([Path("a/m.plan"), Path("a/m-2.plan"), Path("a/m-3.plan")])
    'm.plan, m-2.plan, m-3.plan'
    """
    names = [path.name for path in paths]
    return ", ".join(names if len(names) <= 3 else [names[0], names[1], "...", names[-1]])


def older_files(out: Path, written: Sequence[Path]) -> list[Path]:
    """Return files that are named as if they were more sorties of this plan, or its lines."""
    if out.suffix.casefold() not in ONE_SORTIE:
        return []
    ends = rf"((-\d+)?{re.escape(out.suffix)}|{re.escape(LINES_SUFFIX)})"
    return _named(out, ends, written)


def stale_warnings(out: Path, before: Mapping[Path, bytes]) -> list[str]:
    """Warn of missions of the other format whose lines file is no longer the one they came with."""
    now = lines_beside(out)
    if all(now.get(path) == content for path, content in before.items()):
        return []
    others = "|".join(re.escape(suffix) for suffix in ONE_SORTIE if suffix != out.suffix.casefold())
    stale = [path.name for path in _named(out, rf"(-\d+)?({others})", ())]
    return stale and [
        f"{', '.join(stale)}: of an earlier plan whose lines file is gone: valves would stay "
        "closed on its passes; plan it again or delete it"
    ]


def lines_beside(out: Path) -> dict[Path, bytes]:
    """Return the files of lines that have the name of this plan, with their content."""
    if out.suffix.casefold() not in ONE_SORTIE:
        return {}
    return {path: path.read_bytes() for path in _named(out, re.escape(LINES_SUFFIX), ())}


def _named(out: Path, ends: str, written: Sequence[Path]) -> list[Path]:
    """Return the files beside a plan that have its name, for any aircraft, and one of the ends."""
    names = re.compile(rf"{re.escape(out.stem)}(-a\d+)?{ends}")
    found = [
        path
        for path in out.parent.iterdir()
        if names.fullmatch(path.name) and path not in written and path.is_file()
    ]
    return sorted(found, key=lambda path: (len(path.name), path.name))


def write_plan(
    plan: Plan,
    out: Path,
    *,
    with_sprayer: bool = False,
    fences: Fences | None = None,
    job: str | None = None,
) -> list[Path]:
    """Write the plan and return its files; all texts are made before the first is written.

    The lines, beside missions that have no marks for them, are not among these files. `job` is the
    id of a plan that this one is a part of.
    """
    check_suffix(out)
    suffix, job = out.suffix.casefold(), job or job_of(plan)
    if suffix == ".geojson":
        texts = [lines_text(plan, job)]
    elif suffix == ".kml":
        texts = [plan_kml(plan)]
    elif suffix == ".plan":
        fences = fences or Fences(plan)
        texts = [
            plan_text(plan, each, with_sprayer=with_sprayer, fences=fences, job=job)
            for each in plan.sorties
        ]
    else:
        texts = [waypoints_text(plan, each, with_sprayer=with_sprayer) for each in plan.sorties]
    paths = paths_of(out, len(texts))
    marks = lines_path(out)
    if marks is not None and marks not in paths:
        # First: whoever finds a mission finds its lines.
        write_whole(marks, lines_text(plan, job).encode("utf-8"))
    for path, text in zip(paths, texts, strict=True):
        write_whole(path, text.encode("utf-8"))
    return paths


# The files of several aircraft: one set for each, numbered beside the one that was asked for.


def fleet_path(out: Path, aircraft: int, count: int) -> Path:
    """Return the file of one aircraft.

    >>> fleet_path(Path("m.plan"), 2, 3).name, fleet_path(Path("m.plan"), 1, 1).name
    ('m-a2.plan', 'm.plan')
    """
    return out if count == 1 else out.with_name(f"{out.stem}-a{aircraft}{out.suffix}")


def write_fleet(
    plan: Plan, out: Path, *, with_sprayer: bool = False, fences: Fences | None = None
) -> tuple[list[Path], list[Path]]:
    """Write the files of every aircraft; return the missions, and the lines for their sprayers.

    The first sortie of an aircraft is in its first file, whatever its number in the whole plan.
    """
    crafts = sorted({sortie.aircraft for sortie in plan.sorties})
    count = max(crafts)
    files: list[Path] = []
    marks: list[Path] = []
    for aircraft in crafts:
        own = [sortie for sortie in plan.sorties if sortie.aircraft == aircraft]
        path = fleet_path(out, aircraft, count)
        files += write_plan(
            replace(plan, sorties=tuple(own)), path,
            with_sprayer=with_sprayer, fences=fences, job=job_of(plan),
        )  # fmt: skip
        lines = lines_path(path)
        if lines is not None:
            marks.append(lines)
    return files, marks


# The whole plan as GeoJSON: a line for each leg, a point for each depot.


def job_of(plan: Plan) -> str:
    """Return the id that joins the journals of all sorties, whichever aircraft fly them."""
    return hashlib.sha256(lines_text(plan).encode()).hexdigest()[:12]


def lines_text(plan: Plan, job: str | None = None) -> str:
    """Return the content of the file."""
    features = [
        _leg(plan, sortie, sequence, leg)
        for sortie in plan.sorties
        for sequence, leg in enumerate(sortie.legs)
        if leg.length_m > 0.0
    ]
    features += [_depot(plan, number, depot) for number, depot in enumerate(plan.depots, start=1)]
    return geojson_text(features, **({} if job is None else {"job": job}))


def _place(plan: Plan, place: Place) -> list[float]:
    latitude_deg, longitude_deg = plan.frame.to_geographic(*place)
    return [longitude_deg, latitude_deg]


def _leg(plan: Plan, sortie: Sortie, sequence: int, leg: Leg) -> dict[str, Any]:
    return geojson_feature(
        shapely.LineString([_place(plan, point) for point in leg.points]),
        {
            "kind": leg.kind,
            "sortie": sortie.number,
            "sequence": sequence,
            "speed_m_s": leg.speed_m_s,
            "volume_l": round(leg.volume_l, 6),
            "height_m": plan.settings.height_m if leg.height_m is None else leg.height_m,
        },
    )


def _depot(plan: Plan, number: int, depot: Place) -> dict[str, Any]:
    return geojson_feature(shapely.Point(_place(plan, depot)), {"kind": "depot", "number": number})


# The whole plan as KML, to look at: a folder for each sortie, a colour for each kind of leg.
#
# With an elevation model heights are above sea level, as the model has them; without one they are
# above whatever ground the viewer knows, because nothing says how high the depot is.

# Alpha, blue, green, red.
COLOURS = {"spray": "ff3ca03c", "transit": "ff00a5ff", "ferry": "ff3232dc"}


def plan_kml(plan: Plan) -> str:
    """Return the content of the file."""
    styles = [
        f'<Style id="{kind}"><LineStyle><color>{colour}</color><width>2</width></LineStyle></Style>'
        for kind, colour in COLOURS.items()
    ]
    folders = [
        f"<Folder><name>{kml_text(f'Sortie {sortie.number}: {sortie.volume_l:.1f} L')}</name>"
        + "".join(_kml_leg(plan, leg) for leg in sortie.legs if leg.length_m > 0.0)
        + "</Folder>"
        for sortie in plan.sorties
    ]
    depots = [
        f"<Placemark><name>Depot {number}</name><Point><coordinates>"
        f"{kml_places(np.array([_place(plan, depot)]))}</coordinates></Point></Placemark>"
        for number, depot in enumerate(plan.depots, start=1)
    ]
    body = "\n".join([*styles, *folders, *depots])
    return f"{KML_HEAD}<Document>\n{body}\n</Document>{KML_TAIL}"


def _kml_leg(plan: Plan, leg: Leg) -> str:
    height_m = plan.settings.height_m if leg.height_m is None else leg.height_m
    if plan.terrain is None:
        mode, heights = "relativeToGround", [(place, height_m) for place in leg.points]
    else:
        way = plan.terrain.straight_parts(leg.points)
        mode = "absolute"
        heights = [
            ((east_m, north_m), ground_m + height_m)
            for (east_m, north_m), ground_m in zip(
                way.places.tolist(), way.ground_m.tolist(), strict=True
            )
        ]
    line = kml_places(np.array([[*_place(plan, place), above_m] for place, above_m in heights]))
    return (
        f"<Placemark><name>{leg.kind}</name><styleUrl>#{leg.kind}</styleUrl>"
        f"<LineString><altitudeMode>{mode}</altitudeMode>"
        f"<coordinates>{line}</coordinates></LineString></Placemark>"
    )


# QGroundControl's `.plan`: one sortie, with the field as its fence and the depots as rally points.
#
# What the loader needs beyond its documentation: `geoFence` and `rallyPoints` must be there, a
# simple item has exactly seven parameters, and of `Altitude`, `AltitudeMode` and
# `AMSLAltAboveTerrain` all or none.

FIRMWARES = {"ardupilot": 3, "px4": 12}  # MAV_AUTOPILOT
COPTER = 2  # MAV_TYPE_QUADROTOR
# By frame: heights above home, absolute, and above the ground as the vehicle knows it.
ALTITUDE_MODES = {RELATIVE: 1, 0: 2, ABOVE_GROUND: 4}


def plan_text(
    plan: Plan,
    sortie: Sortie,
    *,
    with_sprayer: bool = False,
    fences: Fences | None = None,
    job: str | None = None,
) -> str:
    """Return the content of the file; `fences` are those of the plan, where they are at hand."""
    fence = (fences or Fences(plan)).of(sortie)
    items = items_of(plan, sortie, with_sprayer=with_sprayer)
    check_items(plan, sortie, len(items))
    content = plan_content(
        items,
        home=plan.frame.to_geographic(*plan.depots[sortie.depot]),
        autopilot=plan.settings.autopilot,
        speed_m_s=plan.settings.speed_m_s,
        fence=fence_content(plan, fence),
        rally=[plan.frame.to_geographic(*depot) for depot in plan.depots],
    )
    check_content(plan, sortie, content)
    return plan_json(content | ({} if job is None else {"vrspray": {"job": job}}))


def plan_content(
    items: Sequence[Item],
    *,
    home: tuple[float, float],
    autopilot: Autopilot,
    speed_m_s: float,
    fence: dict[str, Any] | None = None,
    rally: Sequence[tuple[float, float]] = (),
) -> dict[str, Any]:
    """Return the content of a file with these items; places are (latitude, longitude)."""
    return {
        "fileType": "Plan",
        "geoFence": fence or {"circles": [], "polygons": [], "version": 2},
        "groundStation": "vrspray",
        "mission": {
            "cruiseSpeed": speed_m_s,
            "firmwareType": FIRMWARES[autopilot],
            "globalPlanAltitudeMode": _mode_of_all(items),
            "hoverSpeed": speed_m_s,
            "items": [_simple(number, item) for number, item in enumerate(items, start=1)],
            "plannedHomePosition": [*_rounded(home), 0.0],
            "vehicleType": COPTER,
            "version": 2,
        },
        "rallyPoints": {"points": [[*_rounded(place), 0.0] for place in rally], "version": 2},
        "version": 1,
    }


def plan_json(content: dict[str, Any]) -> str:
    """Return the content as the text of the file."""
    return json.dumps(content, indent=1, allow_nan=False) + "\n"


def _mode_of_all(items: Sequence[Item]) -> int:
    """Return the one altitude mode of a plan; 0 where they are mixed."""
    modes = {ALTITUDE_MODES[item.frame] for item in items if item.has_place}
    return modes.pop() if len(modes) == 1 else 0


def _rounded(place: tuple[float, float]) -> list[float]:
    return [round(value, DEGREE_DECIMALS) for value in place]


def _simple(number: int, item: Item) -> dict[str, Any]:
    place = _rounded((item.latitude_deg, item.longitude_deg))
    found: dict[str, Any] = {
        "autoContinue": True,
        "command": item.command,
        "doJumpId": number,
        "frame": item.frame,
        "params": [*item.params, *place, item.altitude_m],
        "type": "SimpleItem",
    }
    if item.has_place:
        found |= {
            "AMSLAltAboveTerrain": None,
            "Altitude": item.altitude_m,
            "AltitudeMode": ALTITUDE_MODES[item.frame],
        }
    return found


# QGC WPL 110 (`.waypoints`), for Mission Planner and MAVProxy: one sortie, row 0 is home.

ABSOLUTE = 0  # MAV_FRAME_GLOBAL: the frame of home


def waypoints_text(plan: Plan, sortie: Sortie, *, with_sprayer: bool = False) -> str:
    """Return the content of the file."""
    items = items_of(plan, sortie, with_sprayer=with_sprayer)
    check_items(plan, sortie, len(items))
    return rows_text(items, home=plan.frame.to_geographic(*plan.depots[sortie.depot]))


def rows_text(items: Sequence[Item], *, home: tuple[float, float]) -> str:
    """Return items as a file; there is no NaN in it: readers stumble over the word."""
    latitude_deg, longitude_deg = home
    first = Item(
        command=WAYPOINT,
        frame=RELATIVE,
        params=(0.0, 0.0, 0.0, 0.0),
        latitude_deg=latitude_deg,
        longitude_deg=longitude_deg,
    )
    rows = (_row(number, item) for number, item in enumerate((first, *items)))
    return "\n".join(["QGC WPL 110", *rows]) + "\n"


def _row(number: int, item: Item) -> str:
    columns = [
        str(number),
        str(int(number == 0)),
        str(item.frame if number else ABSOLUTE),
        str(item.command),
        *(f"{value or 0.0:g}" for value in item.params),
        f"{item.latitude_deg:.9f}",
        f"{item.longitude_deg:.9f}",
        f"{item.altitude_m:.3f}",
        "1",
    ]
    return "\t".join(columns)
