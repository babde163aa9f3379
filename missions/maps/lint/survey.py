"""A map in metres, measured once for all checks; places in words that a grower can look up."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cached_property

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import Geometry, MultiPolygon, Polygon

from companion.core.outline import dissolved, without_overlay
from missions.maps.build import frame_for
from missions.maps.cells import bounds_deg, cell_areas_m2, cell_size_m, to_degrees
from missions.maps.local import make_valid, project, project_all
from missions.maps.model import MapCells, MapFile, MapZone
from missions.maps.totals import Ground, inside_m2

Objects = NDArray[np.object_]
Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

# Joining and comparing more parts or vertices than this takes longer than an operator waits.
PARTS_MAX = 100_000
VERTICES_MAX = 1_000_000
# How many places a problem names.
PLACES_MAX = 3
_NOTHING = MultiPolygon()


class Survey:
    """The map's zones or cells in the map's own frame, with area and rate of each.

    Args:
        map_file: the map.
        boundary: where spraying is allowed, in longitude and latitude; the map's own without it.
        exclusions: where it is not, in longitude and latitude.
    """

    def __init__(
        self,
        map_file: MapFile,
        *,
        boundary: MultiPolygon | None = None,
        exclusions: Sequence[MultiPolygon] = (),
    ) -> None:
        self.map_file = map_file
        self.exclusions = tuple(exclusions)
        self.frame = frame_for(map_file)
        self.boundary_deg = map_file.boundary if boundary is None else boundary
        if map_file.cells is None:
            self.rates: Floats = np.array(
                [np.nan if zone.rate_l_ha is None else zone.rate_l_ha for zone in map_file.zones],
                dtype=np.float64,
            )
        else:
            self.rates = map_file.cells.rates_l_ha

    @property
    def zones(self) -> tuple[MapZone, ...]:
        """Return the zones of the map; none for a map of cells."""
        return self.map_file.zones

    @property
    def cells(self) -> MapCells | None:
        """Return the cells of the map, if it is made of them."""
        return self.map_file.cells

    @cached_property
    def local(self) -> Objects:
        """Return the ground of every zone in metres; none for a map of cells."""
        return _valid(project_all(_geometries(self.zones), self.frame))

    @cached_property
    def area_m2(self) -> Floats:
        """Return the area of every zone or cell."""
        if self.cells is not None:
            return cell_areas_m2(self.cells, self.frame)
        found: Floats = shapely.area(self.local)
        return found

    @cached_property
    def inside_m2(self) -> Floats:
        """Return how much of every zone or cell may be sprayed."""
        if self.boundary_deg is None and not self.exclusions:
            return self.area_m2
        return inside_m2(self.map_file, Ground.of(self.boundary_deg, self.exclusions), self.frame)

    @cached_property
    def rated(self) -> Bools:
        """Return which zones or cells have a rate, 0 included."""
        found: Bools = ~np.isnan(self.rates)
        return found

    @cached_property
    def is_simple(self) -> bool:
        """Whether the zones are few enough to be joined while somebody waits."""
        parts = int(shapely.get_num_geometries(self.local).sum())
        vertices = int(shapely.get_num_coordinates(self.local).sum())
        return parts <= PARTS_MAX and vertices <= VERTICES_MAX

    @cached_property
    def boundary(self) -> MultiPolygon | Polygon | None:
        """Return where spraying is allowed, in metres."""
        if self.boundary_deg is None:
            return None
        local = project(self.boundary_deg, self.frame)
        return local if local.is_valid else (make_valid(local) or _NOTHING)

    @cached_property
    def meets_boundary(self) -> bool:
        """Whether any zone or cell with a rate lies on ground that may be sprayed."""
        if self.boundary is None:
            return True
        if self.cells is not None:
            return bool((self.rated & self.cells_inside).any())
        shapely.prepare(self.boundary)
        return bool(shapely.intersects(self.boundary, self.local[self.rated]).any())

    @cached_property
    def covered(self) -> Geometry:
        """Return the ground of all zones, those without a rate included."""
        if self.rated.all() and self.rated_joined is not None:
            return self.rated_joined[0]
        return dissolved(shapely.get_parts(self.local), tried=bool(self.rated.all()))

    @cached_property
    def rated_joined(self) -> tuple[Geometry, float] | None:
        """Return the ground of all zones with a rate where their edges show that none overlap."""
        return without_overlay(shapely.get_parts(self.local[self.rated]))

    @cached_property
    def rated_ground(self) -> Geometry:
        """Return the ground of all zones with a rate."""
        if self.rated_joined is not None:
            return self.rated_joined[0]
        return (
            self.covered
            if self.rated.all()
            else dissolved(shapely.get_parts(self.local[self.rated]), tried=True)
        )

    @cached_property
    def bounds_deg(self) -> tuple[float, float, float, float]:
        """Return west, south, east, north of the map."""
        if self.cells is None:
            west, south, east, north = shapely.total_bounds(_geometries(self.zones)).tolist()
            return west, south, east, north
        return bounds_deg(self.cells)

    @cached_property
    def cell_size_m(self) -> tuple[float, float] | None:
        """Return the length of a cell along its row and along its column."""
        return None if self.cells is None else cell_size_m(self.cells, self.frame)

    @cached_property
    def cells_inside(self) -> Bools:
        """Return which cells have their centre inside the boundary; all where there is none."""
        if self.cells is None or self.boundary_deg is None:
            return np.ones(self.rates.shape, dtype=np.bool_)
        rows, columns = self.rates.shape
        column, row = np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5)
        longitude, latitude = to_degrees(self.cells, column.ravel(), row.ravel())
        shapely.prepare(self.boundary_deg)
        inside: Bools = shapely.contains_xy(self.boundary_deg, longitude, latitude)
        return inside.reshape(self.rates.shape)

    def hectares(self, which: Bools) -> float:
        """Return the ground of some zones or cells that may be sprayed [ha]."""
        return float(self.inside_m2[which].sum()) / 10_000.0

    def zone_name(self, index: int) -> str:
        """Return what a zone is called in a sentence; a mere number says that it is a zone."""
        name = self.zones[index].name
        return name if any(letter.isalpha() for letter in name) else f"zone {name}"

    def spot(self, geometry: Geometry) -> str:
        """Return a place inside a geometry in metres, as latitude, longitude."""
        point = shapely.point_on_surface(geometry)
        if point is None or point.is_empty:
            return ""
        return latitude_longitude(*self.frame.to_geographic(float(point.x), float(point.y)))

    def spots(self, geometries: Sequence[Geometry]) -> str:
        """Return places inside the first few geometries."""
        return some([self.spot(one) for one in geometries[:PLACES_MAX]], len(geometries))

    def zone_spots(self, which: Iterable[int]) -> str:
        """Return the names of the first few of these zones, each with a place in it."""
        indices = list(which)
        named = []
        for index in indices[:PLACES_MAX]:
            point = shapely.point_on_surface(self.zones[index].geometry)
            named.append(f"{self.zone_name(index)} at {latitude_longitude(point.y, point.x)}")
        return some(named, len(indices))

    def cell_spots(self, which: Bools) -> str:
        """Return the place of a cell in the middle of those that are meant, and which it is."""
        if self.cells is None or not which.any():
            return ""
        found = np.flatnonzero(which.ravel())
        row, column = divmod(int(found[len(found) // 2]), self.rates.shape[1])
        longitude, latitude = to_degrees(
            self.cells, np.array([column + 0.5]), np.array([row + 0.5])
        )
        place = latitude_longitude(float(latitude[0]), float(longitude[0]))
        return f"row {row + 1}, column {column + 1} at {place}"

    def rate_spots(self, rate_l_ha: float) -> str:
        """Return where a rate stands in the map."""
        which = self.rates == rate_l_ha
        if self.cells is not None:
            return self.cell_spots(which)
        return self.zone_spots(np.flatnonzero(which).tolist())


def latitude_longitude(latitude_deg: float, longitude_deg: float) -> str:
    """Return a place as maps on the net take it; a millionth of a degree is 11 cm.

    >>> latitude_longitude(35.9965, -114.5)
    '35.996500, -114.500000'
    """
    return f"{latitude_deg:.6f}, {longitude_deg:.6f}"


def some(texts: Sequence[str], count: int) -> str:
    """Return a list in words that says how many it leaves out.

    >>> some(["a", "b"], 5)
    'a; b; and 3 more'
    """
    left = count - len(texts)
    return "; ".join([*texts, *([f"and {left} more"] if left > 0 else [])])


def area_text(area_m2: float) -> str:
    """Return an area in the unit that suits it.

    >>> area_text(17138.4), area_text(12.34)
    ('1.714 ha', '12.3 m2')
    """
    return f"{area_m2 / 10_000:.3f} ha" if area_m2 >= 1_000.0 else f"{area_m2:.1f} m2"


def _geometries(zones: Sequence[MapZone]) -> Objects:
    return np.array([zone.geometry for zone in zones], dtype=object)


def _valid(local: Objects) -> Objects:
    """Return the geometries with those repaired whose rings cross after rounding."""
    for index in np.flatnonzero(~shapely.is_valid(local)).tolist():
        local[index] = make_valid(local[index]) or _NOTHING
    return local
