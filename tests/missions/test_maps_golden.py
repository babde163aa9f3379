"""Real maps, with what other programs measured in them (GDAL, shapely, the geodesic area)."""

from __future__ import annotations

from pathlib import Path

import pyogrio
import pytest
import shapely
from pyproj import Geod

from companion.errors import MapError
from missions.maps.build import build_prescription, frame_for
from missions.maps.lint import point_rates, summary
from missions.maps.registry import read_area, read_map


def seen_by_gdal(path: Path) -> list[shapely.Geometry]:
    return list(shapely.from_wkb(pyogrio.raw.read(str(path))[2]))


def test_multipolygons_in_litres_per_hectare(samples: Path) -> None:
    path = samples / "01_shp_lha_multipolygon" / "Rx.shp"
    found = read_map(path)
    result = summary(found)
    assert (found.unit, found.rate_field, found.crs) == ("L/ha", "rate", "EPSG:4326")
    assert (result["zones"], result["parts"], result["holes"]) == (6, 527, 68)
    # 76.82 ha in UTM zone 52N, whose scale there is 1.0001; 76.806 on the ellipsoid.
    assert result["area_ha"] == pytest.approx(76.82, rel=5e-4)
    assert result["rates_l_ha"] == [0.0, 120.0, 140.0, 160.0, 170.0, 180.0]
    assert result["ok"] is True
    assert [problem.code for problem in found.problems] == ["several-candidates"]


def test_the_same_holes_as_gdal(samples: Path) -> None:
    for name in ("01_shp_lha_multipolygon/Rx.shp", "03_shp_value_noUnit/20250415_211530.shp"):
        zones = read_map(samples / name, unit="L/ha").zones
        for zone, theirs in zip(zones, seen_by_gdal(samples / name), strict=True):
            assert zone.geometry.symmetric_difference(theirs).area < 1e-15


def test_a_boundary_with_a_hole(samples: Path) -> None:
    area = read_area(samples / "01_shp_lha_multipolygon" / "boundary")
    assert [len(part.interiors) for part in area.geoms] == [1]


def test_a_real_map_builds_without_overlaps(samples: Path) -> None:
    found = read_map(samples / "01_shp_lha_multipolygon")
    prescription = build_prescription(found, frame_for(found))
    geod = Geod(ellps="WGS84")
    truth_m2 = sum(
        abs(geod.geometry_area_perimeter(shapely.orient_polygons(zone.geometry))[0])
        for zone in found.zones
    )
    assert prescription.area_m2 == pytest.approx(truth_m2, rel=1e-6)


def test_no_unit_is_refused_until_it_is_given(samples: Path) -> None:
    path = samples / "03_shp_value_noUnit"
    with pytest.raises(MapError, match="no unit is given for the rates in value"):
        read_map(path)
    result = summary(read_map(path, unit="L/ha"))
    assert result["area_ha"] == pytest.approx(36.80, abs=0.01)
    assert result["rates_l_ha"] == [125.0, 130.0, 133.0, 135.0, 140.0, 146.0, 150.0, 155.0]
    assert (result["zones"], result["parts"], result["holes"]) == (8, 102, 56)


def test_a_border_without_a_rate_hides_nothing(samples: Path) -> None:
    path = samples / "10_geojson" / "app_map_vector.geojson"
    with pytest.raises(MapError, match="no unit"):
        read_map(path)
    found = read_map(path, unit="L/ha")
    assert [zone.rate_l_ha for zone in found.zones] == [10.0, 20.0, 30.0, None]
    points = [zone.geometry.representative_point() for zone in found.zones[:3]]
    rows = point_rates(found, [(point.y, point.x) for point in points])
    assert [row["rate_l_ha"] for row in rows] == [10.0, 20.0, 30.0]
    assert [row["zone"] for row in rows] == ["zone0", "zone1", "zone3"]


def test_no_prj_is_refused_and_a_projected_prj_is_used(samples: Path) -> None:
    folder = samples / "16_shp_pyprecag_edge"
    with pytest.raises(MapError, match=r"no \.prj"):
        read_map(folder / "PointMZ_mga54_MixedPartFieldsTypes_noPrj.shp")
    projected = folder / "Poly_mga54_SinglePartFieldsTypes_qgis-prj.shp"
    with pytest.raises(MapError, match="no column looks like a rate"):
        read_map(projected)
    found = read_map(projected, rate_field="float_area", unit="L/ha")
    assert found.crs == "EPSG:28354"
    # The column says the zone's own area in square metres.
    area_m2 = [project.area for project in build_prescription(found, frame_for(found)).field.geoms]
    assert sum(area_m2) == pytest.approx(3 * 18_029.7, rel=1e-3)
    with_measures = folder / "PolyMZ_wgs84_MixedPartFieldsTypes.shp"
    assert read_map(with_measures, rate_field="Id", unit="L/ha").zones[1].part_count == 2
