"""Elevation models from files: GeoTIFF, and the tiles of the Shuttle Radar Topography Mission.

An `.hgt` tile has no head: its name is its south-west corner, its size the number of its posts,
and its heights are big-endian 16-bit metres from the north-west corner on; -32768 is no data. The
outer posts lie on whole degrees, so that neighbours share them (SRTM User's Guide, section 3).
"""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np

from missions.errors import PlanError
from missions.maps.geotiff.file import read_raster
from missions.maps.layer import read_bytes
from missions.strips import Floats
from missions.terrain.dem import HIGHEST_M, LOWEST_M, WGS84_CRS, Dem

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
