"""An elevation model: heights of the ground in rows and columns, read between its posts."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from pyproj import CRS, Transformer

from companion.core.frame import LocalFrame
from missions.errors import PlanError
from missions.maps.geotiff.file import read_raster
from missions.maps.layer import read_bytes
from missions.strips import Floats

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
            cells *= 111_000.0 * max(shrunk, 0.05)
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
            f"{path}: {len(content)} bytes are no tile of 1201 or 3601 posts; copy it again"
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
    raster = read_raster(read_bytes(path), path, layer=None, described=True)
    if len(raster.bands) != 1:
        raise PlanError(f"{path}: an elevation model has one band, not {len(raster.bands)}")
    if raster.crs is None or raster.transform is None:
        raise PlanError(f"{path}: it does not say where it lies; export it with its CRS")
    band = raster.bands[0].band
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
