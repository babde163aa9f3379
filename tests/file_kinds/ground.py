"""The ground that a stranger's program has in mind: what it writes, and what is true of it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import shapely
from pyproj import Transformer
from shapely import Polygon, box

WEST_DEG, SOUTH_DEG = 11.0, 48.0


@dataclass(frozen=True, kw_only=True)
class Ground:
    """Polygons in metres east and north of a corner, their columns, and what holds there.

    Args:
        polygons: of each record, in metres.
        columns: values of each record.
        truth: at each place (metres), the rate that falls there; None: none.
        area_m2: of the ground that has a rate, or of the outline; None: not asked.
        epsg: of the file; None: it names none.
        crs_text: what stands in the file for its CRS, where that is not `epsg`.
    """

    polygons: tuple[shapely.Geometry, ...]
    columns: dict[str, list[Any]] = field(default_factory=dict)
    truth: tuple[tuple[float, float, float | None], ...] = ()
    area_m2: float | None = None
    epsg: int | None = 4326
    crs_text: str | None = None
    corner: tuple[float, float] = (WEST_DEG, SOUTH_DEG)

    def local(self) -> str:
        return f"+proj=aeqd +lat_0={self.corner[1]} +lon_0={self.corner[0]} +datum=WGS84 +units=m"

    def degrees(self) -> list[shapely.Geometry]:
        """Return the polygons in longitude and latitude."""
        way = Transformer.from_crs(self.local(), 4326, always_xy=True)
        return [shapely.transform(one, _through(way)) for one in self.polygons]

    def native(self) -> list[shapely.Geometry]:
        """Return the polygons in the file's own coordinates, x or longitude first."""
        if self.epsg in (4326, None):
            return self.degrees()
        way = Transformer.from_crs(self.local(), self.epsg, always_xy=True)
        return [shapely.transform(one, _through(way)) for one in self.polygons]

    def places(self) -> list[tuple[float, float, float | None]]:
        """Return longitude, latitude and rate where the truth is known."""
        way = Transformer.from_crs(self.local(), 4326, always_xy=True)
        return [(*way.transform(x, y), rate) for x, y, rate in self.truth]

    def with_columns(self, **columns: list[Any]) -> Ground:
        """Return the same ground with other columns."""
        return replace(self, columns=columns)


def _through(way: Transformer) -> Any:
    def there(points: Any) -> Any:
        found = points.copy()
        found[:, 0], found[:, 1] = way.transform(points[:, 0], points[:, 1])
        return found

    return there


def three_zones(rates: tuple[float | None, ...] = (20.0, 26.0, 0.0)) -> Ground:
    """Return three zones side by side, 30 m wide and of different depth."""
    depths = (60.0, 48.0, 36.0)
    polygons = tuple(box(30.0 * k, 0.0, 30.0 * (k + 1), depth) for k, depth in enumerate(depths))
    truth = [(30.0 * k + 11.0, 17.0, rate) for k, rate in enumerate(rates)]
    truth += [(15.0, 59.5, rates[0]), (45.0, 47.5, rates[1]), (45.0, 48.5, None), (-1.0, 5.0, None)]
    rated = sum(30.0 * depth for depth, rate in zip(depths, rates, strict=True) if rate is not None)
    return Ground(
        polygons=polygons, columns={"rate": list(rates)}, truth=tuple(truth), area_m2=rated
    )


FIELD = box(0.0, 0.0, 60.0, 60.0)
ISLAND = box(20.0, 20.0, 40.0, 40.0)
HOLED = Polygon(FIELD.exterior.coords, [ISLAND.exterior.coords])
IN_ISLAND = (30.0, 31.0)
OUT_OF_ISLAND = (10.0, 11.0)


def with_hole(polygons: tuple[shapely.Geometry, ...], **columns: list[Any]) -> Ground:
    """Return a field whose middle is no ground, however that is drawn."""
    return Ground(
        polygons=polygons,
        columns=columns or {"rate": [20.0] * len(polygons)},
        truth=((*IN_ISLAND, None), (*OUT_OF_ISLAND, 20.0)),
        area_m2=HOLED.area,
    )
