"""The ground under a plan: profiles of ways, and what is refused where no height is known."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray
from pyproj import CRS, Transformer

from companion.core.frame import METRES_PER_DEGREE, LocalFrame
from missions.errors import PlanError
from missions.field import Field
from missions.maps.bundle import files_beside
from missions.maps.geotiff_bands import BYTE_FILL
from missions.maps.geotiff_file import read_raster
from missions.maps.model import read_bytes
from missions.strips import Floats

# An elevation model: heights of the ground in rows and columns, read between its posts.

# Heights of the ground on land, Dead Sea and Everest with room; other numbers are fills.
LOWEST_M, HIGHEST_M = -500.0, 9000.0
# Rounding must not put a place on the last post outside the model.
EDGE_CELLS = 1e-6
WGS84_CRS = CRS.from_epsg(4326)


@dataclass(frozen=True)
class Dem:
    """Heights in metres, NaN where there are none, at posts (the middles of cells).

    `transform` leads from column and row of a post to x and y of `crs`, as (a, b, c, d, e, f):
    x = a column + b row + c, y = d column + e row + f. Only differences of heights are used, so
    that it does not matter above which surface they count, as long as it is one.
    """

    name: str
    heights_m: Floats
    transform: tuple[float, float, float, float, float, float]
    crs: CRS

    def __post_init__(self) -> None:
        if self.heights_m.ndim != 2 or min(self.heights_m.shape) < 2:
            raise ValueError(f"{self.name}: heights in two rows and columns or more are needed")

    @cached_property
    def _inverse(self) -> Floats:
        a, b, _, d, e, _ = self.transform
        found: Floats = np.linalg.inv(np.array([[a, b], [d, e]]))
        return found

    @cached_property
    def _to_crs(self) -> Transformer:
        return Transformer.from_crs(WGS84_CRS, self.crs, always_xy=True)

    def at(self, latitude_deg: Floats, longitude_deg: Floats) -> Floats:
        """Return the heights at places, NaN outside and beside missing posts (bilinear)."""
        x, y = self._to_crs.transform(longitude_deg, latitude_deg)
        c, f = self.transform[2], self.transform[5]
        column, row = self._inverse @ np.stack([np.asarray(x) - c, np.asarray(y) - f])
        rows, columns = self.heights_m.shape
        inside = (column >= -EDGE_CELLS) & (column <= columns - 1 + EDGE_CELLS)
        inside &= (row >= -EDGE_CELLS) & (row <= rows - 1 + EDGE_CELLS)
        column, row = np.where(inside, column, 0.0), np.where(inside, row, 0.0)
        left = np.clip(np.floor(column), 0, columns - 2).astype(np.int64)
        top = np.clip(np.floor(row), 0, rows - 2).astype(np.int64)
        right_share = np.clip(column - left, 0.0, 1.0)
        down_share = np.clip(row - top, 0.0, 1.0)
        found = np.zeros_like(right_share)
        for down in (0, 1):
            for right in (0, 1):
                share = right_share if right else 1.0 - right_share
                share = share * (down_share if down else 1.0 - down_share)
                height = self.heights_m[top + down, left + right]
                # A missing post beside a place on a row or column of posts has no share in it.
                found = found + np.where(share > 0.0, share * height, 0.0)
        usable = inside & (found >= LOWEST_M) & (found <= HIGHEST_M)
        result: Floats = np.where(usable, found, np.nan)
        return result

    def under(self, frame: LocalFrame, places: Floats) -> Floats:
        """Return the heights at rows of east and north in a frame."""
        latitude_deg, longitude_deg = frame.to_geographic_all(
            places[:, 0].tolist(), places[:, 1].tolist()
        )
        return self.at(np.array(latitude_deg), np.array(longitude_deg))

    def step_m(self, frame: LocalFrame) -> float:
        """Return how closely a way over it is looked at: half a cell, from 1 m to 15 m."""
        a, b, _, d, e, _ = self.transform
        cells = min(float(np.hypot(a, d)), float(np.hypot(b, e)))
        if self.crs.is_geographic:
            shrunk = float(np.cos(np.radians(frame.latitude_deg)))
            cells *= METRES_PER_DEGREE * max(shrunk, 0.05)
        else:
            cells *= self.crs.axis_info[0].unit_conversion_factor or 1.0
        return min(max(cells / 2.0, 1.0), 15.0)


# Elevation models from files: GeoTIFF, and the tiles of the Shuttle Radar Topography Mission.
#
# An `.hgt` tile has no head: its name is its south-west corner, its size the number of its posts,
# and its heights are big-endian 16-bit metres from the north-west corner on; -32768 is no data. The
# outer posts lie on whole degrees, so that neighbours share them (SRTM User's Guide, section 3).

HGT_NAME = re.compile(r"([NS])(\d{2})([EW])(\d{3})", re.ASCII | re.IGNORECASE)
HGT_POSTS = {2 * posts * posts: posts for posts in (1201, 3601)}
NO_HEIGHT = -32768
# What files call the unit of their heights, and how many metres it is.
UNITS_M = {
    "m": 1.0, "metre": 1.0, "meter": 1.0, "metres": 1.0, "meters": 1.0,
    "ft": 0.3048, "foot": 0.3048, "feet": 0.3048,
    "us-ft": 1200.0 / 3937.0, "ftus": 1200.0 / 3937.0, "us survey foot": 1200.0 / 3937.0,
}  # fmt: skip


def read_dem(path: Path) -> Dem:
    """Return the elevation model in a file.

    Raises:
        PlanError, MapError: in one line, what is wrong and what to do.
    """
    suffix = path.suffix.casefold()
    if suffix == ".hgt":
        return _hgt(path)
    if suffix in (".tif", ".tiff"):
        return _geotiff(path)
    raise PlanError(f"{path}: an elevation model is a GeoTIFF (.tif) or an SRTM tile (.hgt)")


def _hgt(path: Path) -> Dem:
    found = HGT_NAME.match(path.name)
    if found is None:
        raise PlanError(f"{path}: the name of an .hgt tile is its corner, such as N48E011.hgt")
    content = read_bytes(path)
    posts = HGT_POSTS.get(len(content))
    if posts is None:
        raise PlanError(
            f"{path}: {len(content)} bytes are not a tile of 1201 or 3601 posts; copy it again"
        )
    raw = np.frombuffer(content, dtype=">i2").reshape(posts, posts)
    heights = np.where(raw == NO_HEIGHT, np.nan, raw.astype(np.float64))
    south = int(found[2]) * (1 if found[1] in "Nn" else -1)
    west = int(found[4]) * (1 if found[3] in "Ee" else -1)
    step = 1.0 / (posts - 1)
    return Dem(
        name=path.name, heights_m=heights,
        transform=(step, 0.0, float(west), 0.0, -step, float(south + 1)), crs=WGS84_CRS,
    )  # fmt: skip


def _geotiff(path: Path) -> Dem:
    # "Described": a byte raster of heights is no picture to be refused here.
    raster = read_raster(files_beside(path), path.name, layer=None, described=True)
    if len(raster.bands) != 1:
        raise PlanError(f"{path}: an elevation model has one band, not {len(raster.bands)}")
    if not isinstance(raster.crs, CRS):
        raise PlanError(f"{path}: it does not say where it lies; export it with its CRS")
    band = raster.bands[0].band
    for one in raster.bands[0].problems:
        if one.code == BYTE_FILL:
            raise PlanError(f"{path}: {one.text}; {one.fix}")
    unit = (band.unit or raster.unit or "m").strip().casefold()
    if unit not in UNITS_M:
        raise PlanError(f"{path}: heights in {unit!r:.40} are not known; export them in metres")
    a, b, c, d, e, f = raster.transform
    middle = (a, b, c + (a + b) / 2.0, d, e, f + (d + e) / 2.0)
    heights = _plausible(band.values * UNITS_M[unit])
    try:
        return Dem(name=path.name, heights_m=heights, transform=middle, crs=raster.crs)
    except ValueError as error:
        raise PlanError(str(error)) from None


def _plausible(heights_m: Floats) -> Floats:
    """Return the heights, NaN for the fills that files do not declare."""
    with np.errstate(invalid="ignore"):
        good = (heights_m >= LOWEST_M) & (heights_m <= HIGHEST_M)
    return np.where(good, heights_m, math.nan)


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
