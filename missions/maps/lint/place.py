"""Where the map lies on earth, against the field and the home that are known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely

from companion.core.frame import WGS84
from missions.maps.lint.survey import Survey, latitude_longitude
from missions.maps.model import Problem

Bounds = tuple[float, float, float, float]

# A map over more than this holds a zone of another field.
FAR_APART_M = 20_000.0
# Nobody farms beyond the northern end of Norway's fields; there the two axes are exchanged.
LATITUDE_MAX_DEG = 66.0
# A sprayer that is carried to the field stands beside it; beyond the second, something is wrong.
HOME_NEAR_M = 2_000.0
HOME_FAR_M = 20_000.0


def place_problems(survey: Survey, homes: Sequence[tuple[float, float]]) -> list[Problem]:
    """Return where the map lies in an odd place, or far from the field or from home."""
    return [*_field(survey), *_home(survey, homes), *_apart(survey), *_odd(survey)]


def gap_m(one: Bounds, two: Bounds) -> float:
    """Return the distance between two boxes of west, south, east, north; 0 where they meet.

    >>> gap_m((0.0, 0.0, 1.0, 1.0), (0.5, 0.5, 2.0, 2.0))
    0.0
    >>> round(gap_m((0.0, 0.0, 1.0, 0.0), (2.0, 0.0, 3.0, 0.0)))
    111319
    """
    west, south = max(one[0], two[0]), max(one[1], two[1])
    east, north = min(one[2], two[2]), min(one[3], two[3])
    longitudes = (east, west) if west > east else (west, west)
    latitudes = (north, south) if south > north else (south, south)
    return float(WGS84.inv(longitudes[0], latitudes[0], longitudes[1], latitudes[1])[2])


def _field(survey: Survey) -> list[Problem]:
    if survey.boundary_deg is None or survey.meets_boundary or not survey.rated.any():
        return []
    bounds = _bounds(survey.boundary_deg)
    away_m = gap_m(survey.bounds_deg, bounds)
    exchanged = _exchanged(survey, bounds, away_m)
    if exchanged is not None:
        return [exchanged]
    far = f"{away_m / 1000:.1f} km away from" if away_m > 50.0 else "beside"
    return [
        Problem(
            severity="error",
            code="far-from-field",
            text=f"the map lies {far} the field's boundary and has no ground in common with it: "
            "nothing would be sprayed",
            where=f"map at {_middle(survey.bounds_deg)}, field at {_middle(bounds)}",
            fix="give map and boundary (prescription.boundary) of the same field, or correct the "
            "CRS with --crs",
        )
    ]


def _home(survey: Survey, homes: Sequence[tuple[float, float]]) -> list[Problem]:
    if not homes:
        return []
    boxes = [(longitude, latitude, longitude, latitude) for latitude, longitude in homes]
    away_m = [gap_m(survey.bounds_deg, box) for box in boxes]
    nearest = int(np.argmin(away_m))
    if away_m[nearest] <= HOME_NEAR_M:
        return []
    exchanged = _exchanged(survey, boxes[nearest], away_m[nearest])
    if exchanged is not None:
        return [exchanged]
    return [
        Problem(
            severity="error" if away_m[nearest] > HOME_FAR_M else "warning",
            code="far-from-home",
            text=f"the map lies {away_m[nearest] / 1000:.1f} km away from the home point",
            where=f"map at {_middle(survey.bounds_deg)}, "
            f"home at {latitude_longitude(*homes[nearest])}",
            fix="check that the map is of this field, its CRS (--crs), and the home point (--home, "
            "mission.depots)",
        )
    ]


def _exchanged(survey: Survey, known: Bounds, away_m: float) -> Problem | None:
    """Return the problem of a map that would be in place with its axes the other way round."""
    west, south, east, north = survey.bounds_deg
    turned = (south, west, north, east)
    if max(abs(west), abs(east)) > 90.0 or away_m <= HOME_FAR_M:
        return None
    turned_m = gap_m(turned, known)
    if turned_m > HOME_FAR_M:
        return None
    return Problem(
        severity="error",
        code="swapped-axes",
        text=f"the map lies {away_m / 1000:.0f} km away; with latitude and longitude exchanged it "
        f"would be {turned_m / 1000:.1f} km away: its file has them the wrong way round",
        where=f"map at {_middle(survey.bounds_deg)}, expected near {_middle(known)}",
        fix=_put_right(survey),
    )


def _put_right(survey: Survey) -> str:
    """Return how to exchange the axes in the format of the map."""
    if survey.map_file.format == "text-map":
        return "latitude stands first in this format: exchange the two columns"
    if survey.map_file.format == "csv" and survey.cells is not None:
        return "exchange the names of the two columns"
    return "export the map with the longitude first"


def _apart(survey: Survey) -> list[Problem]:
    west, south, east, north = survey.bounds_deg
    reach_m = max(
        gap_m((west, south, west, south), (east, south, east, south)),
        gap_m((west, south, west, south), (west, north, west, north)),
    )
    if reach_m <= FAR_APART_M:
        return []
    where = f"from {south:.4f}, {west:.4f} to {north:.4f}, {east:.4f}"
    if survey.cells is None:
        centres = shapely.get_coordinates(shapely.centroid(survey.local))
        middle = np.median(centres, axis=0)
        where = survey.zone_spots([int(np.argmax(np.hypot(*(centres - middle).T)))])
    return [
        Problem(
            severity="warning",
            code="far-apart",
            text=f"the map reaches over {reach_m / 1000:.0f} km, more than a field",
            where=where,
            fix="check the zone that lies far from the others, and the CRS (--crs)",
        )
    ]


def _odd(survey: Survey) -> list[Problem]:
    latitude, longitude = survey.frame.latitude_deg, survey.frame.longitude_deg
    if abs(latitude) < 1.0 and abs(longitude) < 1.0:
        text = "the map lies in the sea off Africa, where latitude and longitude are 0"
        fix = "check the CRS: metres may have been written as degrees"
    elif not abs(latitude) <= LATITUDE_MAX_DEG:
        text = f"the map lies at latitude {latitude:.2f}, where nobody farms"
        fix = "check whether latitude and longitude are exchanged, and the CRS"
    else:
        return []
    return [
        Problem(
            severity="warning",
            code="odd-place",
            text=text,
            where=latitude_longitude(latitude, longitude),
            fix=fix,
        )
    ]


def _bounds(area: shapely.Geometry) -> Bounds:
    west, south, east, north = shapely.bounds(area).tolist()
    return west, south, east, north


def _middle(bounds: Bounds) -> str:
    west, south, east, north = bounds
    return latitude_longitude((south + north) / 2, (west + east) / 2)
