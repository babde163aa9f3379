"""Rasters and points: what else stands in the file and beside it, and what that does to a rate."""

from __future__ import annotations

import csv
import warnings
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import rasterio
from pyproj import Transformer
from rasterio import Affine
from shapely import box

from tests.file_kinds.ground import Ground
from tests.file_kinds.kind import ASKED, HERE, OR_ASKED, SILENT, SURE, TOLD, UNIT, Kind


@dataclass(frozen=True, kw_only=True)
class _InDegrees(Ground):
    """Truth that is in degrees already."""

    def places(self) -> list[tuple[float, float, float | None]]:
        return list(self.truth)


CELL_M = 10.0
GRID = np.array([[20.0, 20.0, 26.0, 26.0], [20.0, 15.0, 15.0, 26.0], [0.0, 15.0, 15.0, 20.0]])
WIDE = np.repeat(np.repeat(GRID, 3, axis=0), 3, axis=1)
EAST_M, NORTH_M = 600_000.0, 5_300_000.0


def raster_truth(grid: np.ndarray) -> Ground:
    """Return the truth of cells in UTM 32N, the northernmost row first; NaN: no rate."""
    rows, columns = grid.shape
    cells, truth = [], []
    for row in range(rows):
        for column in range(columns):
            west, north = EAST_M + CELL_M * column, NORTH_M - CELL_M * row
            cells.append(box(west, north - CELL_M, west + CELL_M, north))
            rate = grid[row, column]
            truth.append((west + 4.0, north - 6.0, None if np.isnan(rate) else float(rate)))
    way = Transformer.from_crs(32632, 4326, always_xy=True)
    return _InDegrees(
        polygons=tuple(cells), truth=tuple((*way.transform(x, y), rate) for x, y, rate in truth)
    )


def tiff(
    grid: np.ndarray, path: Path, *, dtype: str = "float32", scale: float | None = None,
    offset: float = 0.0, nodata: float | None = None, mask: np.ndarray | None = None,
    inside: bool = True, beside: float | None = None, overviews: bool = False,
    step: tuple[float, float] = (CELL_M, -CELL_M), **options: object,
) -> Path:  # fmt: skip
    """Write a GeoTIFF with rasterio; what GDAL keeps beside the file it does.

    Args:
        beside: a value for no data that only the file beside it declares.
        step: of a column east and a row north, in metres.
    """
    north = NORTH_M if step[1] < 0.0 else NORTH_M - CELL_M * grid.shape[0]
    profile = {
        "driver": "GTiff", "width": grid.shape[1], "height": grid.shape[0], "count": 1,
        "dtype": dtype, "crs": "EPSG:32632", "nodata": nodata,
        "transform": Affine(step[0], 0.0, EAST_M, 0.0, step[1], north), **options,
    }  # fmt: skip
    rows = grid if step[1] < 0.0 else grid[::-1]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        env = {"GDAL_TIFF_INTERNAL_MASK": inside, "TIFF_USE_OVR": overviews}
        with rasterio.Env(**env), rasterio.open(path, "w", **profile) as out:
            out.write(rows.astype(dtype), 1)
            if scale is not None:
                out.scales, out.offsets = (scale,), (offset,)
            if mask is not None:
                out.write_mask(mask)
        if overviews:
            with rasterio.Env(**env), rasterio.open(path, "r+") as out:
                out.build_overviews([2])
    if beside is not None:
        Path(f"{path}.aux.xml").write_text(
            '<PAMDataset><PAMRasterBand band="1">'
            f"<NoDataValue>{beside:g}</NoDataValue></PAMRasterBand></PAMDataset>"
        )
    with rasterio.open(path) as seen:  # as GDAL reads it, so it is meant
        assert beside is None or seen.nodata == beside
        assert scale is None or seen.scales == (scale,)
    return path


def _holed() -> np.ndarray:
    grid = GRID.copy()
    grid[0, 0] = np.nan
    grid[2, 3] = np.nan
    return grid


def _filled(value: float) -> np.ndarray:
    return np.where(np.isnan(_holed()), value, _holed())


def _raster(name: str, truth: np.ndarray, may: frozenset[str] = SILENT, *, stored: np.ndarray | None
            = None, **options: object) -> Kind:  # fmt: skip
    content = truth if stored is None else stored

    def write(_: Ground, folder: Path) -> Path:
        return tiff(content, folder / "map.tif", **options)  # type: ignore[arg-type]

    return Kind(
        name=f"raster: {name}", make=partial(raster_truth, truth), may=may, writer=write,
        formats=("GeoTIFF",),
    )  # fmt: skip


_MASK = np.where(np.isnan(_holed()), 0, 255).astype("uint8")
RASTERS = [
    _raster("plain", GRID),
    _raster("bytes", GRID, dtype="uint8"),
    _raster("deflate with predictor", GRID, compress="deflate", predictor=3),
    _raster("lzw", GRID, compress="lzw", dtype="int16", predictor=2),
    _raster("tiles", GRID, tiled=True, blockxsize=16, blockysize=16),
    _raster("double", GRID, dtype="float64"),
    _raster("big", GRID, BIGTIFF="YES"),
    _raster("NaN", _holed()),
    _raster("no data inside", _holed(), stored=_filled(-9999), nodata=-9999),
    _raster("no data beside", _holed(), OR_ASKED, stored=_filled(-9999), beside=-9999),
    _raster(
        "255 for no data, said beside",
        _holed(),
        OR_ASKED,
        stored=_filled(255),
        beside=255,
        dtype="uint8",
    ),
    _raster(
        "a rate that is no data, said beside",
        np.where(GRID == 26.0, np.nan, GRID),
        OR_ASKED,
        stored=GRID,
        beside=26.0,
    ),
    _raster("255 for no data, not said", _holed(), TOLD, stored=_filled(255), dtype="uint8"),
    _raster("254 for no data, not said", _holed(), TOLD, stored=_filled(254), dtype="uint8"),
    _raster("65535 for no data, not said", _holed(), TOLD, stored=_filled(65535), dtype="uint16"),
    _raster("scale inside", GRID, stored=GRID * 10, dtype="int16", scale=0.1),
    _raster(
        "scale and offset inside",
        GRID,
        stored=(GRID - 5) * 10,
        dtype="int16",
        scale=0.1,
        offset=5.0,
    ),
    _raster(
        "scale beside",
        GRID,
        OR_ASKED,
        stored=GRID * 10,
        dtype="int16",
        scale=0.1,
        PROFILE="GeoTIFF",
    ),
    _raster(
        "no tags, a world file and the rest beside", GRID, OR_ASKED, PROFILE="BASELINE", TFW="YES"
    ),
    _raster("tags and a world file", GRID, SURE, TFW="YES"),
    _raster("south first", GRID, SURE, step=(CELL_M, CELL_M)),
    _raster("overviews beside", WIDE, SURE, overviews=True),
    _raster("mask inside", _holed(), OR_ASKED, stored=_filled(77), mask=_MASK),
    _raster("mask beside", _holed(), OR_ASKED, stored=_filled(77), mask=_MASK, inside=False),
]


def _points(
    rows: list[tuple[float, float, float]], folder: Path, *, encoding: str = "utf-8",
    names: tuple[str, str, str] = ("lon", "lat", "rate"), **dialect: object,
) -> Path:  # fmt: skip
    path = folder / "points.csv"
    with path.open("w", encoding=encoding, newline="") as out:
        table = csv.writer(out, **dialect)  # type: ignore[arg-type]
        table.writerow(names)
        table.writerows((f"{x:.9f}", f"{y:.9f}", f"{rate:g}") for x, y, rate in rows)
    return path


# A lattice in degrees, as text files have it.
STEP_LON, STEP_LAT = 7e-5, 5e-5


def _lattice(grid: np.ndarray) -> list[tuple[float, float, float]]:
    rows, columns = grid.shape
    return [
        (11.0 + STEP_LON * column, 48.0 - STEP_LAT * row, float(grid[row, column]))
        for row in range(rows)
        for column in range(columns)
    ]


def _csv(name: str, may: frozenset[str] = SILENT, *, more: list[tuple[float, float, float]] | None
         = None, given: tuple[str, ...] = UNIT, **options: object) -> Kind:  # fmt: skip
    points = _lattice(WIDE)
    rows = points + (more or [])

    def write(_: Ground, folder: Path) -> Path:
        return _points(rows, folder, **options)  # type: ignore[arg-type]

    return Kind(
        name=f"points: {name}", may=may, writer=write, formats=("CSV",),
        make=lambda: _degrees_truth(points), options=given,
    )  # fmt: skip


def _degrees_truth(points: list[tuple[float, float, float]]) -> Ground:
    return _InDegrees(
        polygons=(),
        truth=tuple((x + STEP_LON / 5, y - STEP_LAT / 5, rate) for x, y, rate in points),
    )


_FIRST = _lattice(WIDE)[:3]
POINTS = [
    _csv("plain"),
    _csv("semicolons", delimiter=";"),
    _csv("tabs", delimiter="\t", may=OR_ASKED),
    _csv("names in capitals", names=("Longitude", "Latitude", "Rate")),
    _csv("UTF-8 with a mark", encoding="utf-8-sig"),
    _csv("UTF-16", ASKED | SURE, encoding="utf-16"),
    _csv("three rows once more", SURE, more=_FIRST),
    _csv("another rate at one place", ASKED, more=[(*_FIRST[0][:2], 40.0)]),
    _csv(
        "another rate a centimetre away",
        ASKED,
        more=[(_FIRST[0][0] + 1e-7, _FIRST[0][1], 40.0)],
    ),
    _csv("names the wrong way round", TOLD, given=HERE, names=("lat", "lon", "rate")),
]  # fmt: skip
