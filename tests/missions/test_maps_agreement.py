"""On every real map, `point_rates` says what an independent reader says, at 1 000 random points.

The other side is GDAL (pyogrio, rasterio), pyarrow, or the bytes taken apart by hand; shapely
decides what a point lies in. Only within a centimetre of an edge may the two differ.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pyarrow.parquet
import pyogrio
import pytest
import rasterio
import shapely

from missions.maps.lint import point_rates
from missions.maps.registry import read_map
from tests.random_places import places_in

POINTS = 1_000
EDGE_M = 0.01
METRES_PER_DEGREE = 111_320.0

# (rate or None, distance to the next edge in metres) at a longitude and a latitude.
Oracle = Callable[[float, float], tuple[float | None, float]]


@dataclass(frozen=True, kw_only=True)
class Case:
    """A sample, how it is read, and who else reads it."""

    path: str
    oracle: Callable[[Path], tuple[Oracle, tuple[float, float, float, float]]]
    reading: dict[str, object]

    def __str__(self) -> str:
        return self.path


def of_polygons(
    geometries: list[shapely.Geometry], rates: list[float | None]
) -> tuple[Oracle, tuple[float, float, float, float]]:
    """Return an oracle over polygons in degrees; the smallest rate where several lie."""
    bounds = shapely.total_bounds(np.array(geometries, dtype=object))
    narrow = math.cos(math.radians((bounds[1] + bounds[3]) / 2))
    # In metres, so that a distance to an edge is one: degrees are of two lengths.
    scale = np.array([METRES_PER_DEGREE * narrow, METRES_PER_DEGREE])
    local = [shapely.transform(one, lambda p: p * scale) for one in geometries]
    parts, owner = shapely.get_parts(np.array(local, dtype=object), return_index=True)
    tree = shapely.STRtree(parts)
    edges = shapely.STRtree(shapely.boundary(parts))

    def oracle(longitude_deg: float, latitude_deg: float) -> tuple[float | None, float]:
        spot = shapely.Point(np.array([longitude_deg, latitude_deg]) * scale)
        here = [rates[owner[k]] for k in tree.query(spot, predicate="within")]
        found = [rate for rate in here if rate is not None]
        away = edges.query_nearest(spot, return_distance=True)[1]
        return (min(found) if found else None), float(away[0])

    return oracle, tuple(bounds)


def of_cells(
    rates: np.ndarray, west: float, south: float, width: float, height: float
) -> tuple[Oracle, tuple[float, float, float, float]]:
    """Return an oracle over cells in degrees, the southernmost row first."""
    rows, columns = rates.shape

    def oracle(longitude_deg: float, latitude_deg: float) -> tuple[float | None, float]:
        column, row = (longitude_deg - west) / width, (latitude_deg - south) / height
        narrow = math.cos(math.radians(latitude_deg))
        away = min(
            abs(column - round(column)) * width * narrow * METRES_PER_DEGREE,
            abs(row - round(row)) * height * METRES_PER_DEGREE,
        )
        if not (0 <= column < columns and 0 <= row < rows):
            return None, away
        rate = float(rates[int(row), int(column)])
        return (None if math.isnan(rate) else rate), away

    return oracle, (west, south, west + columns * width, south + rows * height)


def by_ogr(field: str) -> Callable[[Path], tuple[Oracle, tuple[float, float, float, float]]]:
    def oracle(path: Path) -> tuple[Oracle, tuple[float, float, float, float]]:
        meta, _, blobs, columns = pyogrio.raw.read(str(path), columns=[field])
        values = columns[list(meta["fields"]).index(field)]
        geometries = list(shapely.from_wkb(blobs))
        if "28354" in str(meta["crs"]) or "GDA" in str(meta["crs"]):
            from pyproj import Transformer

            to_degrees = Transformer.from_crs(28354, 4326, always_xy=True)
            geometries = [
                shapely.transform(
                    shapely.segmentize(one, 50.0),
                    lambda p: np.column_stack(to_degrees.transform(p[:, 0], p[:, 1])),
                )
                for one in geometries
            ]
        rates = [None if value is None or value != value else float(value) for value in values]
        return of_polygons(geometries, rates)

    return oracle


def by_rasterio(band: int) -> Callable[[Path], tuple[Oracle, tuple[float, float, float, float]]]:
    def oracle(path: Path) -> tuple[Oracle, tuple[float, float, float, float]]:
        with rasterio.open(path) as file:
            values, at = file.read(band), file.transform
        return of_cells(values[::-1].astype(float), at.c, at.f + at.e * len(values), at.a, -at.e)

    return oracle


def by_hand_isoxml_grid(path: Path) -> tuple[Oracle, tuple[float, float, float, float]]:
    root = ElementTree.parse(path / "TASKDATA.XML").getroot()
    grid = next(root.iter("GRD"))
    raw = np.fromfile(path / "GRD00001.bin", dtype="<i4")
    cells = raw.reshape(int(grid.get("F")), int(grid.get("E")))
    south, west, height, width = (float(grid.get(key)) for key in "ABCD")
    # DDI 1 counts hundredths of a mm3/m2, DDI 6 milligrams a square metre.
    ddi = int(next(root.iter("PDV")).get("A"), 16)
    return of_cells(cells * {1: 1e-4, 6: 1e-2}[ddi], west, south, width, height)


def by_hand_isoxml_zones(path: Path) -> tuple[Oracle, tuple[float, float, float, float]]:
    root = ElementTree.parse(path / "TASKDATA.XML").getroot()
    geometries, rates = [], []
    for zone in root.iter("TZN"):
        for outline in zone.findall("PLN"):
            rings = [
                [(float(point.get("D")), float(point.get("C"))) for point in ring.findall("PNT")]
                for ring in outline.findall("LSG")
            ]
            geometries.append(shapely.Polygon(rings[0], rings[1:]))
            rates.append(int(zone.find("PDV").get("B")) * 1e-2)
    return of_polygons(geometries, rates)


def by_pyarrow(field: str) -> Callable[[Path], tuple[Oracle, tuple[float, float, float, float]]]:
    def oracle(path: Path) -> tuple[Oracle, tuple[float, float, float, float]]:
        table = pyarrow.parquet.read_table(path)
        name = json.loads(table.schema.metadata[b"geo"])["primary_column"]
        geometries = list(shapely.from_wkb(table.column(name).to_pylist()))
        return of_polygons(geometries, table.column(field).to_pylist())

    return oracle


CASES = [
    Case(path="01_shp_lha_multipolygon/Rx.shp", oracle=by_ogr("rate"), reading={}),
    Case(
        path="03_shp_value_noUnit/20250415_211530.shp",
        oracle=by_ogr("value"),
        reading={"unit": "L/ha"},
    ),
    Case(path="06_isoxml_v3_grid2_lha", oracle=by_hand_isoxml_grid, reading={}),
    Case(
        path="08_isoxml_v4_tzn_vector_map1",
        oracle=by_hand_isoxml_zones,
        reading={"density_kg_l": 1.0},
    ),
    Case(path="10_geojson/app_map_vector.geojson", oracle=by_ogr("dose"), reading={"unit": "L/ha"}),
    Case(
        path="14_geotiff_adapt/RasterRx-15.tiff",
        oracle=by_rasterio(2),
        reading={"rate_field": "Product 2", "density_kg_l": 1.0},
    ),
    Case(
        path="16_shp_pyprecag_edge/Poly_mga54_SinglePartFieldsTypes_qgis-prj.shp",
        oracle=by_ogr("float_area"),
        reading={"rate_field": "float_area", "unit": "L/ha"},
    ),
    Case(
        path="16_shp_pyprecag_edge/PolyMZ_wgs84_MixedPartFieldsTypes.shp",
        oracle=by_ogr("Id"),
        reading={"rate_field": "Id", "unit": "L/ha"},
    ),
]


@pytest.mark.parametrize("case", CASES, ids=str)
def test_the_rate_at_a_thousand_places(case: Case, samples: Path) -> None:
    path = samples / case.path
    oracle, bounds = case.oracle(path)
    points = places_in(bounds, POINTS, seed=20261121)
    found = point_rates(read_map(path, **case.reading), points)  # type: ignore[arg-type]
    rated = 0
    for (latitude_deg, longitude_deg), row in zip(points, found, strict=True):
        wanted, edge_m = oracle(longitude_deg, latitude_deg)
        if edge_m <= EDGE_M or row["zone"] == "default":
            continue
        rated += wanted is not None
        if wanted is None:
            assert row["rate_l_ha"] is None, (latitude_deg, longitude_deg)
        else:
            assert row["rate_l_ha"] == pytest.approx(wanted, rel=1e-9), (
                latitude_deg,
                longitude_deg,
            )
    assert rated > POINTS / 10
