"""The spray lines of a plan: the GeoJSON that `vrspray plan` writes, as polylines.

Pieces of one line follow each other in the file (a new speed, a bend of the border) and are
joined; what another sortie goes on with is not.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, NamedTuple

from companion.core.frame import LocalFrame, Place
from companion.core.options.lines import Polyline
from companion.errors import MapError
from missions.maps.layer import read_bytes
from missions.maps.model import map_error

# As in the files for autopilots, where such ends are one waypoint.
JOINED_M = 0.6
# At a sharper bend the vehicle stops, and both lines keep their own ends.
BEND_MAX_DEG = 30.0
POINTS_MAX = 1_000_000
_FIX = "name the .geojson, or the .lines.geojson, that `vrspray plan` wrote"


class _Line(NamedTuple):
    places: list[Place]
    sortie: object


def read_plan_lines(path: Path, frame: LocalFrame) -> tuple[Polyline, ...]:
    """Return the spray lines of a plan in `frame`, joined where they go on in each other."""
    document = _document(path)
    features = document.get("features")
    if document.get("type") != "FeatureCollection" or not isinstance(features, list):
        raise _refused(path, "this is no GeoJSON with features")
    lines = [line for feature in features if (line := _line(path, feature, frame)) is not None]
    if not lines:
        raise _refused(path, 'no LineString has kind = "spray"')
    if sum(len(line.places) for line in lines) > POINTS_MAX:
        raise _refused(path, f"more than {POINTS_MAX} points")
    return tuple(tuple(places) for places in _joined(lines))


def _document(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(read_bytes(path).decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise _refused(path, f"this is not readable JSON ({str(error)[:120]})") from None
    return found if isinstance(found, dict) else {}


def _line(path: Path, feature: Any, frame: LocalFrame) -> _Line | None:
    """Return a spray line; None for any other feature."""
    about = feature.get("properties") if isinstance(feature, dict) else None
    if not isinstance(about, dict) or about.get("kind") != "spray":
        return None
    shape = feature.get("geometry")
    if not isinstance(shape, dict) or shape.get("type") != "LineString":
        raise _refused(path, "a spray line is no LineString")
    places = shape.get("coordinates")
    if not isinstance(places, list) or len(places) < 2:
        raise _refused(path, "a spray line has less than two points")
    return _Line([_place(path, place, frame) for place in places], about.get("sortie"))


def _place(path: Path, place: Any, frame: LocalFrame) -> Place:
    if (
        not isinstance(place, list)
        or len(place) < 2
        or not all(type(number) in (int, float) for number in place[:2])
    ):
        raise _refused(path, f"{str(place)[:60]} is no longitude and latitude")
    longitude_deg, latitude_deg = float(place[0]), float(place[1])
    if not (abs(longitude_deg) <= 180.0 and abs(latitude_deg) <= 90.0):
        raise _refused(path, f"{str(place)[:60]} is no longitude and latitude")
    return frame.to_local(latitude_deg, longitude_deg)


def _joined(lines: list[_Line]) -> list[list[Place]]:
    """Return the lines, one that goes on in the next with it; their two ends are one place."""
    found: list[list[Place]] = []
    before: _Line | None = None
    for line in lines:
        is_next = before is not None and before.sortie == line.sortie
        if is_next and _goes_on(found[-1], line.places):
            (x0, y0), (x1, y1) = found[-1][-1], line.places[0]
            found[-1][-1] = ((x0 + x1) / 2.0, (y0 + y1) / 2.0)
            found[-1] += line.places[1:]
        else:
            found.append(list(line.places))
        before = line
    return found


def _goes_on(before: list[Place], after: list[Place]) -> bool:
    """Return whether a line goes on in another: from the same place, by no more than a bend."""
    if not math.dist(before[-1], after[0]) < JOINED_M:
        return False
    (x0, y0), (x1, y1) = before[-2:]
    (x2, y2), (x3, y3) = after[:2]
    dot = (x1 - x0) * (x3 - x2) + (y1 - y0) * (y3 - y2)
    both = math.dist(before[-2], before[-1]) * math.dist(after[0], after[1])
    return dot >= math.cos(math.radians(BEND_MAX_DEG)) * both


def _refused(path: Path, text: str) -> MapError:
    return map_error(path, text, fix=_FIX, code="no-lines")
