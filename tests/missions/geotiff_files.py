"""GeoTIFF files, made by rasterio (GDAL) or byte by byte where GDAL would hide what is tested."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine

from companion.errors import MapError
from missions.maps.geotiff import read_geotiff
from missions.maps.model import Grid

WEST, NORTH, CELL = 114.5, 36.0, 1e-4
PLACE = Affine(CELL, 0.0, WEST, 0.0, -CELL, NORTH)
RATES = np.array([[12.5, 0.0, 15.0], [20.0, 22.5, 25.0]], dtype="float32")


def write(path: Path, values: Any = RATES, **options: Any) -> Path:
    """Write bands (or one) with GDAL; `tags`, `names`, `units`, `scales` go into the file."""
    bands = np.asarray(values)
    bands = bands[None] if bands.ndim == 2 else bands
    special = {key: options.pop(key, None) for key in ("tags", "names", "units", "scales", "mask")}
    options = {"crs": "EPSG:4326", "transform": PLACE, **options}
    with rasterio.open(
        path, "w", driver="GTiff", width=bands.shape[2], height=bands.shape[1],
        count=bands.shape[0], dtype=bands.dtype, **options,
    ) as target:  # fmt: skip
        target.write(bands)
        if special["mask"] is not None:
            target.write_mask(special["mask"])
        if special["tags"]:
            target.update_tags(**special["tags"])
        if special["names"]:
            target.descriptions = special["names"]
        if special["units"]:
            target.units = special["units"]
        if special["scales"]:
            target.scales, target.offsets = special["scales"]
    return path


def refused(code: str, path: Path, reader: Any = read_geotiff, **options: Any) -> str:
    with pytest.raises(MapError) as caught:
        reader(path, **options)
    assert caught.value.code == code, str(caught.value)
    assert "\n" not in str(caught.value)
    assert "vsimem" not in str(caught.value)
    return str(caught.value)


def codes(grid: Grid) -> list[str]:
    return [problem.code for problem in grid.problems]


def tfw(
    path: Path, *, x: float = WEST + CELL / 2, y: float = NORTH - CELL / 2, suffix: str = ".tfw"
) -> None:
    text = f"{CELL!r}\n0.0\n0.0\n{-CELL!r}\n{x!r}\n{y!r}\n"
    path.with_suffix(suffix).write_text(text, "ascii")
