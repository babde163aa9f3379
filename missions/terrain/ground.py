"""The ground under a plan: profiles of ways, and what is refused where no height is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from companion.core.frame import LocalFrame
from missions.errors import PlanError
from missions.field import Field
from missions.strips import Floats
from missions.terrain.dem import Dem

# The field is looked at on so many places, or every 5 m where that is fewer.
PLACES_MAX, GRID_MIN_M = 40_000, 5.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Terrain:
    """An elevation model and how a plan follows it.

    `by_vehicle`: waypoints hold heights above ground, and the autopilot knows the ground. Else
    they hold heights above home, with points between them such that the way over straight lines
    leaves the wanted height by no more than `tolerance_m`.
    """

    dem: Dem
    frame: LocalFrame
    by_vehicle: bool = False
    tolerance_m: float = 0.5
    climb_m_s: float = 2.5
    descent_m_s: float = 1.5

    def __post_init__(self) -> None:
        for name in ("tolerance_m", "climb_m_s", "descent_m_s"):
            if not 0.0 < getattr(self, name) < 1e3:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")

    def heights_m(self, places: Floats) -> Floats:
        """Return the ground at rows of east and north; PlanError where it is not known."""
        found = self.dem.under(self.frame, places)
        missing = np.flatnonzero(~np.isfinite(found))
        if len(missing):
            raise self._unknown(places, missing)
        return found

    def _unknown(self, places: Floats, missing: np.ndarray[tuple[int, ...], np.dtype[np.int64]]
                 ) -> PlanError:  # fmt: skip
        east_m, north_m = places[int(missing[0])].tolist()
        latitude_deg, longitude_deg = self.frame.to_geographic(east_m, north_m)
        share = 100.0 * len(missing) / len(places)
        how_much = f" nor at {share:.0f} % of the places asked for" if len(missing) > 1 else ""
        return PlanError(
            f"{self.dem.name} has no height at {latitude_deg:.6f}, {longitude_deg:.6f}{how_much}; "
            "take an elevation model that covers field, depots and ways (mission.terrain)"
        )

    def check_field(self, field: Field, depots: Floats) -> None:
        """Refuse a model that does not cover the field or a depot, before anything is planned."""
        corners = shapely.get_coordinates(field.outline)
        west, south, east, north = field.outline.bounds
        step_m = max(GRID_MIN_M, float(np.sqrt((east - west) * (north - south) / PLACES_MAX)))
        across, up = np.meshgrid(np.arange(west, east, step_m), np.arange(south, north, step_m))
        grid = np.column_stack([across.ravel(), up.ravel()])
        inside = grid[shapely.contains_xy(field.outline, grid[:, 0], grid[:, 1])]
        self.heights_m(np.concatenate([corners, depots.reshape(-1, 2), inside]))

    def profile(self, points: Sequence[tuple[float, float]]) -> Profile:
        """Return the ground along a way, its bends among the places."""
        step_m = self.dem.step_m(self.frame)
        way = np.array(points, dtype=np.float64)
        lengths = np.hypot(*np.diff(way, axis=0).T)
        bends = np.concatenate([[0.0], np.cumsum(lengths)])
        at_m = bends
        if bends[-1] > 0.0:
            count = int(np.ceil(bends[-1] / step_m)) + 1
            at_m = np.unique(np.concatenate([bends, np.linspace(0.0, bends[-1], count)]))
            keep = np.concatenate([[True], np.diff(bends) > 0.0])
            bends, way = bends[keep], way[keep]
        places = np.column_stack([np.interp(at_m, bends, way[:, axis]) for axis in (0, 1)])
        return Profile(at_m=at_m, places=places, ground_m=self.heights_m(places))

    def summary(self, places: Floats) -> dict[str, object]:
        """Return the figures of the ground under the places of a plan."""
        ground_m = self.heights_m(places)
        return {
            "file": self.dem.name,
            "heights": "vehicle" if self.by_vehicle else "file",
            "tolerance_m": self.tolerance_m,
            "lowest_m": float(ground_m.min()),
            "highest_m": float(ground_m.max()),
        }

    def straight_parts(self, points: Sequence[tuple[float, float]]) -> Profile:
        """Return the profile with the few points that keep it within the tolerance."""
        found = self.profile(points)
        kept = kept_points(found.at_m, found.ground_m, self.tolerance_m)
        return Profile(
            at_m=found.at_m[kept], places=found.places[kept], ground_m=found.ground_m[kept]
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Profile:
    """Ground along a way: distance from its start, place and height, row by row."""

    at_m: Floats
    places: Floats
    ground_m: Floats


# Which points of a profile are needed, such that straight lines between them stay near it.


def kept_points(at_m: Floats, height_m: Floats, tolerance_m: float) -> NDArray[np.int64]:
    """Return which points are kept, first and last among them.

    Between two that are kept the profile leaves the straight line by no more than the tolerance,
    in height: Douglas and Peucker (1973), with the error that an aircraft flies. Where it leaves
    it by more, the worst point is kept, and both sides are looked at again.

    >>> at = np.array([0.0, 10.0, 20.0, 30.0, 40.0])
    >>> kept_points(at, np.array([0.0, 0.1, 3.0, 0.0, 0.0]), 0.5).tolist()
    [0, 1, 2, 3, 4]
    >>> kept_points(at, np.array([0.0, 1.0, 2.1, 3.0, 4.0]), 0.5).tolist()
    [0, 4]
    """
    last = len(at_m) - 1
    kept = {0, last}
    todo = [(0, last)]
    while todo:
        start, end = todo.pop()
        if end - start < 2:
            continue
        inside = slice(start + 1, end)
        straight = np.interp(at_m[inside], at_m[[start, end]], height_m[[start, end]])
        error = np.abs(height_m[inside] - straight)
        worst = int(np.argmax(error))
        if not error[worst] <= tolerance_m:
            middle = start + 1 + worst
            kept.add(middle)
            todo += [(start, middle), (middle, end)]
    return np.array(sorted(kept), dtype=np.int64)
