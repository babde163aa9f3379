"""Maps for the tests of the linter: squares of 0.0001 degrees, some 9 m by 11 m, made by code."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pyproj import CRS
from shapely import MultiPolygon, Polygon, box

from missions.maps.lint import Plan, Sprayer
from missions.maps.model import MapCells, MapFile, MapZone, Problem

WEST, SOUTH, CELL = 114.543, 35.996, 0.0001
WIDTH_M, HEIGHT_M = 9.017, 11.096
Ground = Polygon | MultiPolygon


def cell(
    column: float, row: float = 0.0, *, width: float = 1.0, height: float = 1.0, west: float = WEST
) -> Polygon:
    left, low = west + column * CELL, SOUTH + row * CELL
    return box(left, low, left + width * CELL, low + height * CELL)


def a_map(
    *zones: tuple[Ground, float | None],
    boundary: Ground | None = None,
    default_rate_l_ha: float | None = None,
    problems: Sequence[Problem] = (),
    cells: MapCells | None = None,
) -> MapFile:
    if isinstance(boundary, Polygon):
        boundary = MultiPolygon([boundary])
    return MapFile(
        path=Path("rx.geojson"),
        format="geojson",
        crs="EPSG:4326",
        unit="L/ha",
        rate_field="rate",
        zones=tuple(
            MapZone(name=f"zone{index}", geometry=ground, rate_l_ha=rate)
            for index, (ground, rate) in enumerate(zones)
        ),
        sha256="abc",
        cells=cells,
        boundary=boundary,
        default_rate_l_ha=default_rate_l_ha,
        problems=tuple(problems),
    )


def cells_map(
    rates: Sequence[Sequence[float]], *, size_deg: float = CELL, boundary: Ground | None = None
) -> MapFile:
    """Return a raster whose first row is the northern one."""
    grid = MapCells(
        rates_l_ha=np.array(rates, dtype=np.float64),
        transform=(size_deg, 0.0, WEST, 0.0, -size_deg, SOUTH + len(rates) * size_deg),
        crs=CRS.from_epsg(4326),
    )
    return a_map(cells=grid, boundary=boundary)


def sprayer(
    *, speed_m_s: float = 5.0, strip_m: float = 1.0, angle_deg: float | None = 0.0
) -> Sprayer:
    """Return a sprayer that takes 0.2 s for a change: 1 m at 5 m/s; its passes run north."""
    return Sprayer(
        speed_m_s=speed_m_s,
        lag_s=0.1,
        period_s=0.1,
        strip_m=strip_m,
        angle_deg=angle_deg,
        speed_min_m_s=1.0,
    )


def plan_with(one: Sprayer) -> Plan:
    return Plan(sprayer=one)
