"""P2's open text map: read into its grid of square cells.

The format is in `text_points.py`, the grid in `text_lattice.py`, the way back from any other map in
`text_lattice.py`. Here the cells, which lie in the tangent plane of an origin, are tied to the
ground, and what a grower should know about the map is said.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pyproj import CRS

from companion.core.frame import METRES_PER_DEGREE, LocalFrame
from missions.maps.crs import EXTENT_MAX_M
from missions.maps.model import Affine, Band, Floats, Grid, Problem, digest, map_error, read_bytes
from missions.maps.text_lattice import (
    MERGES,
    GridLayout,
    cell_numbers,
    layout_for,
    merged,
    text_map_of,
)
from missions.maps.text_points import TangentPlane, TextMap, parse_text_map, write_text_map

__all__ = ["PointGrid", "grid_of_points", "read_text_map", "text_map_of", "write_text_map"]

MAX_CELLS = 16_000_000
# P2: at least 50 points/ha; at least seven decimals of a degree (1 cm).
POINTS_PER_HA_MIN = 50.0
DECIMALS_MIN = 7
_MERGED_BY = {"max": "the largest", "average": "the running average", "mean": "the mean"}
_DECIMALS = re.compile(rb"^[ \t]*[+-]?\d+\.(\d+)[ \t]+[+-]?\d+\.(\d+)", re.MULTILINE)


@dataclass(frozen=True, slots=True, kw_only=True)
class PointGrid:
    """The grid that a text map means: (rows, columns) L/min, southern row first, NaN for none."""

    layout: GridLayout
    plane: TangentPlane
    merge: str
    altitude_m: float
    rates_l_min: Floats
    mixed_cells: int

    def corners(self, column: Floats, row: Floats) -> tuple[Floats, Floats]:
        """Return latitude and longitude of corners of cells, at the mean altitude of the points."""
        layout = self.layout
        return self.plane.on_ground(
            layout.east_min_m + layout.cell_m * column,
            layout.north_min_m + layout.cell_m * row,
            self.altitude_m,
        )


def grid_of_points(
    points: TextMap,
    path: Path,
    *,
    origin: tuple[float, float, float] | None = None,
    merge: str = "max",
    cell_m: int | None = None,
) -> PointGrid:
    """Return P2's grid of a map's points.

    Args:
        points: of the file.
        path: of the file, for messages.
        origin: latitude, longitude, altitude; without it the first point. P2 leaves it to the
            grower and asks only that it be kept. Its altitude has no effect on east and north.
        merge: what several points in one cell make together.
        cell_m: in place of the size that the number of points gives.
    """
    if merge not in MERGES:
        raise map_error(
            path, f"no way to merge points: {merge!r}", fix=f"take one of {', '.join(MERGES)}",
            code="merge-policy",
        )  # fmt: skip
    first = (points.latitude_deg[0], points.longitude_deg[0], points.altitude_m[0])
    latitude, longitude, altitude = map(float, first if origin is None else origin)
    plane = TangentPlane(latitude_deg=latitude, longitude_deg=longitude, altitude_m=altitude)
    east, north, _ = plane.to_local(points.latitude_deg, points.longitude_deg, points.altitude_m)
    _check_extent(east, north, path)
    layout = layout_for(
        points.count,
        east_m=(float(east.min()), float(east.max())),
        north_m=(float(north.min()), float(north.max())),
        cell_m=cell_m,
    )
    if not layout.columns * layout.rows <= MAX_CELLS:
        raise map_error(
            path,
            f"{layout.rows} rows of {layout.columns} cells are more than {MAX_CELLS} cells",
            fix="take larger cells",
            code="too-large",
        )
    cells = cell_numbers(layout, east, north)
    rates = merged(layout, cells, points.rate_l_min, merge=merge)
    place = (cells[1] - 1) * layout.columns + cells[0] - 1
    largest = rates if merge == "max" else merged(layout, cells, points.rate_l_min, merge="max")
    mixed = np.unique(place[points.rate_l_min < largest.ravel()[place]])
    return PointGrid(
        layout=layout,
        plane=plane,
        merge=merge,
        altitude_m=float(points.altitude_m.mean()),
        rates_l_min=rates,
        mixed_cells=len(mixed),
    )


def _check_extent(east_m: Floats, north_m: Floats, path: Path) -> None:
    """Refuse points that are no field, and an origin that belongs to another one."""
    extent_m = max(float(np.ptp(east_m)), float(np.ptp(north_m)))
    if not extent_m <= EXTENT_MAX_M:
        raise map_error(
            path,
            f"its points reach over {extent_m / 1000:.0f} km",
            fix="remove the stray point, or cut the map to one field",
            code="too-large",
        )
    distance_m = float(np.hypot(east_m, north_m).min())
    if not distance_m <= EXTENT_MAX_M:
        raise map_error(
            path,
            f"the origin is {distance_m / 1000:.0f} km from the field",
            fix="give latitude, longitude and altitude of a place near the field as the origin",
            code="wrong-origin",
        )


def read_text_map(
    path: Path,
    layer: str | None = None,
    *,
    origin: tuple[float, float, float] | None = None,
    merge: str = "max",
    cell_m: int | None = None,
) -> Grid:
    """Return the cells of a text map, with rates in L/min; it has no layers."""
    if layer is not None:
        raise map_error(path, "a text map has no layers", fix="leave out --layer", code="no-layer")
    content = read_bytes(path)
    grid = grid_of_points(
        parse_text_map(content, path), path, origin=origin, merge=merge, cell_m=cell_m
    )
    frame, transform = tied_down(grid)
    return Grid(
        format="text-map",
        crs=named_crs(frame),
        transform=transform,
        bands=(Band(name="rate", values=grid.rates_l_min, unit="L/min", is_rate=True),),
        sha256=digest([content]),
        problems=tuple(grid_problems(grid, content, path)),
    )


def named_crs(frame: LocalFrame) -> CRS:
    """Return the frame's projection under a name that says where it is."""
    content = frame.crs.to_json_dict()
    place = f"{frame.latitude_deg:.6f}, {frame.longitude_deg:.6f}"
    return CRS.from_json_dict(content | {"name": f"metres east and north of {place}"})


def tied_down(grid: PointGrid) -> tuple[LocalFrame, Affine]:
    """Return a frame in the middle of the cells, and where they lie in it.

    The transform is fitted to the corners of the grid. What it leaves is some tenths of a
    millimetre for a field of a kilometre, however far away the origin is.
    """
    layout = grid.layout
    column, row = (
        np.array(values, dtype=np.float64) * count
        for values, count in (((0, 1, 0, 1), layout.columns), ((0, 0, 1, 1), layout.rows))
    )
    latitude, longitude = grid.corners(column, row)
    frame = LocalFrame(latitude_deg=float(latitude.mean()), longitude_deg=float(longitude.mean()))
    x, y = frame.to_local_all(latitude.tolist(), longitude.tolist())
    matrix = np.column_stack([column, row, np.ones(4)])
    (a, d), (b, e), (c, f) = np.linalg.lstsq(matrix, np.column_stack([x, y]), rcond=None)[0]
    return frame, (float(a), float(b), float(c), float(d), float(e), float(f))


def grid_problems(grid: PointGrid, content: bytes, path: Path) -> list[Problem]:
    """Return what a grower should know about the map."""
    layout = grid.layout
    found = []
    gaps = gap_count(grid.rates_l_min)
    if gaps:
        found.append(
            (
                "empty-cells",
                f"{gaps} cells of {layout.cell_m} m between cells with a rate hold no point; the "
                "valves close over them",
                "add points there, or take larger cells",
            )
        )
    if grid.mixed_cells:
        found.append(
            (
                "merged-points",
                f"{grid.mixed_cells} cells hold points of different rates; "
                f"{_MERGED_BY[grid.merge]} is taken",
                "choose how points are merged, or take smaller cells",
            )
        )
    if not layout.points_per_ha >= POINTS_PER_HA_MIN:
        found.append(
            (
                "few-points",
                f"the map has {layout.points_per_ha:.0f} points/ha, fewer than "
                f"{POINTS_PER_HA_MIN:.0f}; its cells are {layout.cell_m} m wide",
                "add points where the rate changes",
            )
        )
    decimals = _decimals(content)
    if decimals < DECIMALS_MIN:
        step_m = float(f"{METRES_PER_DEGREE / 10**decimals:.2g}")
        found.append(
            (
                "coarse-position",
                f"its degrees have {decimals} decimals, steps of {step_m:g} m",
                f"write latitude and longitude with {DECIMALS_MIN} decimals or more",
            )
        )
    return [
        Problem(severity="warning", code=code, text=text, where=str(path), fix=fix)
        for code, text, fix in found
    ]


def _decimals(content: bytes) -> int:
    """Return the decimals of the finest latitude and longitude near the file's beginning.

    The finest, because programs leave out zeros at the end.
    """
    pairs = _DECIMALS.finditer(content[:65_536])
    return max((min(len(one) for one in pair.groups()) for pair in pairs), default=0)


def gap_count(rates: Floats) -> int:
    """Return how many cells without a rate have cells with one on two opposite sides."""
    rated = np.pad(~np.isnan(rates), 1)
    across = rated[1:-1, :-2] & rated[1:-1, 2:]
    along = rated[:-2, 1:-1] & rated[2:, 1:-1]
    return int((~rated[1:-1, 1:-1] & (across | along)).sum())
