"""Fields as they are drawn and recorded: rectangles with trees, outlines with noise."""

from __future__ import annotations

import math
import random

import numpy as np
import shapely
from shapely import Polygon
from shapely.geometry.base import BaseGeometry

from tests.mission_judge import Drawn

# A degree of latitude, about; made-up fields need no better.
DEGREE_M = 111_200.0
LATITUDE_DEG, LONGITUDE_DEG = 48.0, 11.0


def degrees(area: BaseGeometry) -> BaseGeometry:
    """Return made-up metres as longitude and latitude."""
    scale = np.array([DEGREE_M * math.cos(math.radians(LATITUDE_DEG)), DEGREE_M])
    return shapely.transform(
        area, lambda points: points / scale + np.array([LONGITUDE_DEG, LATITUDE_DEG])
    )


def trees(count: int, *, corners: int, area_ha: float, seed: int = 1) -> Drawn:
    """Return a rectangle with trees of 1 to 5 m radius, drawn with so many corners."""
    draw = random.Random(seed)
    long_m = math.sqrt(area_ha * 1e4 * 1.6)
    wide_m = area_ha * 1e4 / long_m
    placed: list[tuple[float, float, float]] = []
    while len(placed) < count:
        radius = draw.uniform(1.0, 5.0)
        x = draw.uniform(0.08, 0.92) * long_m
        y = draw.uniform(0.08, 0.92) * wide_m
        if all(math.dist((x, y), other[:2]) > radius + other[2] + 4.0 for other in placed):
            placed.append((x, y, radius))
    rings = [
        Polygon(
            [
                (x + r * math.cos(2 * math.pi * k / corners),
                 y + r * math.sin(2 * math.pi * k / corners))
                for k in range(corners)
            ]
        )
        for x, y, r in placed
    ]  # fmt: skip
    return Drawn(
        outline=degrees(shapely.box(0.0, 0.0, long_m, wide_m)),
        obstacles=[degrees(ring) for ring in rings],
    )


def recorded(area: Polygon, *, step_m: float, noise_m: float = 0.03, seed: int = 1) -> Drawn:
    """Return an outline walked with a receiver: a point every step, each off by some noise."""
    draw = np.random.default_rng(seed)
    ring = area.exterior
    places = np.arange(0.0, ring.length, step_m)
    points = shapely.get_coordinates(shapely.line_interpolate_point(ring, places))
    points += draw.normal(0.0, noise_m, points.shape)
    walked = shapely.make_valid(Polygon(points))
    return Drawn(outline=degrees(max(shapely.get_parts(walked), key=lambda part: part.area)))


def blob(area_ha: float, *, seed: int, rough: float = 0.25) -> Polygon:
    """Return a field with rounded, irregular borders."""
    draw = random.Random(seed)
    waves = [(draw.uniform(0, rough / k), draw.uniform(0, 2 * math.pi), k) for k in range(1, 6)]
    turns = np.linspace(0.0, 2.0 * math.pi, 400, endpoint=False)
    radius = 1.0 + sum(size * np.cos(k * turns + at) for size, at, k in waves)
    shape = Polygon(np.column_stack([1.5 * radius * np.cos(turns), radius * np.sin(turns)]))
    scale = math.sqrt(area_ha * 1e4 / shape.area)
    return shapely.transform(shape, lambda points: points * scale)
