"""GeoJSON as programs and people write it."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import shapely
from shapely import box

from companion.errors import MapError
from missions.maps import geojson, model
from missions.maps.geojson import read_geojson
from missions.maps.registry import read_area, read_map

WEST, SOUTH, CELL = 15.14, 48.12, 0.001
SQUARE = [[WEST, SOUTH], [WEST + CELL, SOUTH], [WEST + CELL, SOUTH + CELL], [WEST, SOUTH]]


def feature(rate: object = 10, ring: object = SQUARE, **properties: object) -> dict[str, object]:
    return {
        "type": "Feature",
        "properties": {"dose": rate, "unit": "L/ha"} | properties,
        "geometry": {"type": "Polygon", "coordinates": [ring]},
    }


def collection(*features: object, **members: object) -> dict[str, object]:
    return {"type": "FeatureCollection", "features": list(features)} | members


def saved(tmp_path: Path, document: object) -> Path:
    path = tmp_path / "rx.geojson"
    path.write_text(document if isinstance(document, str) else json.dumps(document), "utf-8")
    return path


def old_crs(name: str) -> dict[str, object]:
    return {"type": "name", "properties": {"name": name}}


def test_what_gdal_writes_is_read(tmp_path: Path) -> None:
    ground = box(WEST, SOUTH, WEST + CELL, SOUTH + CELL)
    ring = ground.difference(ground.buffer(-CELL / 4))
    path = tmp_path / "rx.geojson"
    pyogrio.raw.write(
        str(path),
        shapely.to_wkb(np.array([ring, ground], dtype=object)),
        [np.array([10.0, np.nan]), np.array(["gal/ac"] * 2, dtype=object)],
        ["rate", "unit"],
        geometry_type="Polygon",
        crs="EPSG:4326",
        driver="GeoJSON",
        layer_options={"COORDINATE_PRECISION": "15"},
    )
    found = read_map(path)
    assert (found.format, found.crs, found.unit) == ("geojson", "EPSG:4326", "gal/ac")
    assert found.zones[0].rate_l_ha == pytest.approx(93.54, abs=0.001)
    assert found.zones[1].rate_l_ha is None
    assert found.zones[0].geometry.symmetric_difference(ring).area < 1e-15
    assert found.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()


def test_null_and_zero_are_different_rates(tmp_path: Path) -> None:
    found = read_map(saved(tmp_path, collection(feature(None), feature(0), feature(5))))
    assert [zone.rate_l_ha for zone in found.zones] == [None, 0.0, 5.0]


@pytest.mark.parametrize("name", ["urn:ogc:def:crs:OGC:1.3:CRS84", "EPSG:4326", "OGC:CRS84"])
def test_the_old_crs_member_keeps_longitude_first(tmp_path: Path, name: str) -> None:
    found = read_map(saved(tmp_path, collection(feature(), crs=old_crs(name))))
    assert found.zones[0].geometry.bounds[:2] == (WEST, SOUTH)
    assert found.crs == "EPSG:4326"
    assert not found.problems


def test_the_old_crs_member_may_be_projected(tmp_path: Path) -> None:
    ring = [[500000, 5330000], [500100, 5330000], [500100, 5330100], [500000, 5330000]]
    found = read_map(saved(tmp_path, collection(feature(1, ring), crs=old_crs("EPSG:32633"))))
    assert found.crs == "EPSG:32633"
    assert found.zones[0].geometry.bounds[0] == pytest.approx(15.0, abs=1e-9)
    assert {problem.code for problem in found.problems} == {"old-crs-member"}


@pytest.mark.parametrize("crs", [7, {}, old_crs("EPSG:0"), {"type": "link", "properties": {}}])
def test_a_crs_member_that_names_nothing_is_refused(tmp_path: Path, crs: object) -> None:
    with pytest.raises(MapError, match="crs member") as caught:
        read_map(saved(tmp_path, collection(feature(), crs=crs)))
    assert caught.value.code == "wrong-crs"


def test_a_crs_member_of_null_says_that_the_crs_is_unknown(tmp_path: Path) -> None:
    path = saved(tmp_path, collection(feature(), crs=None))
    assert read_geojson(path).crs is None
    assert read_map(path, crs="EPSG:4326").crs == "EPSG:4326"


def test_latitude_first_is_refused_where_it_shows(tmp_path: Path) -> None:
    ring = [[36.0, 114.5], [36.0, 114.6], [36.1, 114.6], [36.0, 114.5]]
    with pytest.raises(MapError, match="look exchanged") as caught:
        read_map(saved(tmp_path, collection(feature(1, ring))))
    assert caught.value.code == "swapped-axes"


def test_metres_without_a_crs_are_refused(tmp_path: Path) -> None:
    ring = [[500000, 5330000], [500100, 5330000], [500100, 5330100], [500000, 5330000]]
    path = saved(tmp_path, collection(feature(1, ring)))
    with pytest.raises(
        MapError, match="look like metres: give with --crs the projection"
    ) as caught:
        read_map(path)
    assert caught.value.code == "wrong-crs"
    assert read_map(path, crs="EPSG:32633").crs == "EPSG:32633"


def test_a_map_over_half_a_country_is_refused(tmp_path: Path) -> None:
    far = [[x + 5.0, y] for x, y in SQUARE]
    with pytest.raises(MapError, match="reaches over") as caught:
        read_map(saved(tmp_path, collection(feature(), feature(1, far))))
    assert caught.value.code == "out-of-range"


def test_zones_are_named_by_the_column_that_tells_them_apart(tmp_path: Path) -> None:
    named = collection(feature(1, name="a", zone=1), feature(2, name="a", zone=2))
    assert [zone.name for zone in read_map(saved(tmp_path, named)).zones] == ["1", "2"]
    numbered = collection(feature(1), feature(2))
    assert [zone.name for zone in read_map(saved(tmp_path, numbered)).zones] == ["1", "2"]
    by_id = collection(feature(1) | {"id": "x7"}, feature(2) | {"id": "x8"})
    assert [zone.name for zone in read_map(saved(tmp_path, by_id)).zones] == ["x7", "x8"]


def test_a_unit_of_the_whole_file_is_read(tmp_path: Path) -> None:
    plain = feature()
    plain["properties"] = {"dose": 2}
    found = read_map(saved(tmp_path, collection(plain, unit="mL/m2")))
    assert found.zones[0].rate_l_ha == 20.0


def test_three_coordinates_and_a_byte_order_mark_do_no_harm(tmp_path: Path) -> None:
    ring = [[*SQUARE[0], 3.0], SQUARE[1], [*SQUARE[2], 4.0], SQUARE[3]]
    path = tmp_path / "rx.geojson"
    path.write_text(json.dumps(collection(feature(1, ring))), "utf-8-sig")
    assert not read_map(path).zones[0].geometry.has_z


@pytest.mark.parametrize(
    "document",
    [
        "",
        "{",
        "[1]",
        "null",
        "[" * 100_000,
        '{"type": "FeatureCollection"}',
        '{"type": "FeatureCollection", "features": {}}',
        '{"type": "FeatureCollection", "features": [3]}',
        '{"type": "FeatureCollection", "features": []}',
        '{"type": ["Polygon"]}',
        '{"type": "Topology", "objects": {}}',
        collection(feature(1, [])),
        collection(feature(1, SQUARE[:2])),
        collection(feature(1, [["1", "2"]] * 4)),
        collection(feature(1, [[None, 2]] * 4)),
        collection(feature(1, [[10**400, 2]] * 4)),
        collection(feature(1, [[float("nan"), 2]] * 4)),
        collection(feature(1, [[float("inf"), 2.0]] * 4)),
        collection(feature(1, "ring")),
        collection(feature("many")),
        collection(feature(float("inf"))),
        collection(feature(-3)),
        collection(feature([1])),
        collection(feature(True)),
        collection({"type": "Feature", "properties": 3, "geometry": {"type": "Polygon"}}),
        collection({"type": "Feature", "properties": {"rate": 1}, "geometry": {"type": "Point"}}),
    ],
)  # fmt: skip
def test_nonsense_is_refused_in_one_line(tmp_path: Path, document: object) -> None:
    with pytest.raises(MapError, match=r"rx\.geojson: ") as caught:
        read_map(saved(tmp_path, document), unit="L/ha")
    assert "\n" not in str(caught.value)
    assert "; " in str(caught.value)


def test_a_layer_of_geojson_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MapError, match="no layers") as caught:
        read_map(saved(tmp_path, collection(feature())), layer="x")
    assert caught.value.code == "no-layer"


def test_a_bare_geometry_is_a_boundary(tmp_path: Path) -> None:
    area = read_area(saved(tmp_path, feature()["geometry"]))
    assert area.bounds == (WEST, SOUTH, WEST + CELL, SOUTH + CELL)


def test_the_parts_of_a_boundary_are_united(tmp_path: Path) -> None:
    beside = [[x + CELL / 2, y] for x, y in SQUARE]
    area = read_area(saved(tmp_path, collection(feature(1), feature(1, beside))))
    assert len(area.geoms) == 1
    assert area.area < 2 * shapely.Polygon(SQUARE).area


def test_an_obstacle_drawn_as_a_point_is_refused(tmp_path: Path) -> None:
    point = {"type": "Feature", "geometry": {"type": "Point", "coordinates": [WEST, SOUTH]}}
    with pytest.raises(MapError, match="not-a-polygon:Point"):
        read_area(saved(tmp_path, collection(feature(), point)))


def test_ground_that_two_rings_of_a_zone_share_stays_ground(tmp_path: Path) -> None:
    other = [[x - 0.4 * CELL, y] for x, y in SQUARE]
    zone = feature(1)
    zone["geometry"] = {"type": "MultiPolygon", "coordinates": [[SQUARE], [other]]}
    found = read_map(saved(tmp_path, collection(zone)))
    assert found.zones[0].geometry.area == pytest.approx(1.64 * shapely.Polygon(SQUARE).area)
    assert [problem.code for problem in found.problems] == ["invalid-ring"]


def test_a_rate_of_nan_is_no_rate(tmp_path: Path) -> None:
    rates = [float("nan"), "NaN", " ", "7.5"]
    found = read_map(saved(tmp_path, collection(*map(feature, rates))), rate_field="dose")
    assert [zone.rate_l_ha for zone in found.zones] == [None, None, None, 7.5]


def test_a_decimal_comma_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MapError, match="dose of zone 1 is '7,5', which is not a rate"):
        read_map(saved(tmp_path, collection(feature("7,5"))), rate_field="dose")


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e300])
@pytest.mark.parametrize("vertex", [0, 1])
def test_a_coordinate_that_is_no_number_is_called_so(
    tmp_path: Path, value: float, vertex: int
) -> None:
    ring = [[value, SOUTH] if index == vertex else xy for index, xy in enumerate(SQUARE)]
    with pytest.raises(MapError, match="a coordinate is not a finite number"):
        read_map(saved(tmp_path, collection(feature(1, ring))))


def test_a_line_break_in_the_path_stays_out_of_the_message(tmp_path: Path) -> None:
    with pytest.raises(MapError) as caught:
        read_map(tmp_path / "a\nb.geojson")
    assert "\n" not in str(caught.value)


def refused(path: Path) -> str:
    with pytest.raises(MapError) as caught:
        read_geojson(path)
    assert "\n" not in str(caught.value)
    return caught.value.code


@pytest.mark.parametrize(
    ("document", "code"),
    [
        ('{"type": "FeatureCollection", "features": [', "truncated"),
        ("", "truncated"),
        ("[]", "unknown-format"),
        ({"type": "Topology"}, "unknown-format"),
        (collection(feature(1, SQUARE[:2])), "broken-geometry"),
        (collection(feature(1, [[1, 2, 3], [1, "2"], [1, 2], [1, 2]])), "broken-geometry"),
        (collection(feature(1, [[1], [2], [3], [4]])), "broken-geometry"),
        (collection(feature(1, [[[1, 2]] * 4])), "broken-geometry"),
        (collection(feature(1, [[1e300, 2]] * 4)), "broken-geometry"),
    ],
)
def test_every_refusal_has_its_code(tmp_path: Path, document: object, code: str) -> None:
    assert refused(saved(tmp_path, document)) == code


@pytest.mark.parametrize(
    ("text", "code", "says"),
    [
        ("[" * 200_000, "too-large", "it nests too deep;"),
        (f'{{"a": {"9" * 5000}}}', "bad-number", "a number has too many digits;"),
    ],
    ids=["deep", "digits"],
)
def test_what_python_does_not_parse_is_said_in_our_words(
    tmp_path: Path, text: str, code: str, says: str
) -> None:
    path = saved(tmp_path, text)
    with pytest.raises(MapError) as caught:
        read_geojson(path)
    assert caught.value.code == code
    assert str(caught.value).startswith(f"{path}: {says}")


def test_positions_of_which_only_some_have_a_height_are_read(tmp_path: Path) -> None:
    ring = [[*SQUARE[0], 3.0], *SQUARE[1:]]
    plain = read_geojson(saved(tmp_path, collection(feature(1)))).geometries
    assert read_geojson(saved(tmp_path, collection(feature(1, ring)))).geometries == plain


def test_a_member_that_is_there_twice_is_refused(tmp_path: Path) -> None:
    text = json.dumps(collection(feature(10))).replace('"dose": 10', '"dose": 10, "dose": 20')
    assert refused(saved(tmp_path, text)) == "duplicate-member"


def test_text_that_is_not_in_utf_8_is_refused(tmp_path: Path) -> None:
    path = saved(tmp_path, collection(feature()))
    path.write_bytes(path.read_bytes().replace(b"L/ha", b"L/h\xe4"))
    assert refused(path) == "encoding"


def test_what_is_no_text_is_not_to_be_saved_in_another_coding(tmp_path: Path) -> None:
    path = tmp_path / "field.geojson"
    path.write_bytes(bytes(range(256)))
    with pytest.raises(MapError, match="not text, so it cannot be GeoJSON; export the map again"):
        read_geojson(path)


def test_half_a_letter_becomes_a_mark_that_can_be_written(tmp_path: Path) -> None:
    (column, *_) = read_geojson(
        saved(tmp_path, '{"type": "Feature", "properties": {"a\\ud800": "b\\udfff"}}')
    ).columns
    assert (column.name, column.values) == ("a?", ("b?",))


@pytest.mark.parametrize(
    ("name", "most", "text"),
    [("MAX_VERTICES", 12, "vertices"), ("MAX_RECORDS", 1, "records")],
)
def test_a_file_of_too_many_things_is_refused_before_it_is_parsed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, most: int, text: str
) -> None:
    path = saved(tmp_path, collection(feature(), feature()))
    monkeypatch.setattr(model, name, most + 1)
    assert read_geojson(path)
    monkeypatch.setattr(model, name, most)
    monkeypatch.setattr(geojson.json, "loads", lambda *_, **__: pytest.fail("it was parsed"))
    with pytest.raises(MapError, match=f"{text} are more than {most}"):
        read_geojson(path)


def test_more_properties_than_any_map_has_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    many = {f"p{index}": index for index in range(254)}
    assert len(read_geojson(saved(tmp_path, collection(feature(1, SQUARE)))).columns) == 2
    assert refused(saved(tmp_path, collection(feature(1, SQUARE, **many)))) == "too-large"
    monkeypatch.setattr(geojson, "_CELLS_MAX", 3)
    assert refused(saved(tmp_path, collection(feature(), feature()))) == "too-large"


def test_the_outline_beside_the_features_is_the_boundary(tmp_path: Path) -> None:
    outline = {"type": "Polygon", "coordinates": [SQUARE]}
    found = read_geojson(saved(tmp_path, collection(feature(), boundary=outline)))
    assert found.boundary is not None
    assert found.boundary.equals(shapely.Polygon(SQUARE))
    assert len(found.geometries) == 1
    for other in (7, {}, {"type": "Point", "coordinates": [1, 2]}, None):
        assert read_geojson(saved(tmp_path, collection(feature(), boundary=other))).boundary is None
    broken = {"type": "Polygon", "coordinates": [SQUARE[:2]]}
    assert refused(saved(tmp_path, collection(feature(), boundary=broken))) == "broken-geometry"
    bow = [SQUARE[0], SQUARE[2], SQUARE[1], [WEST, SOUTH + CELL], SQUARE[0]]
    crossed = {"type": "Polygon", "coordinates": [bow]}
    assert refused(saved(tmp_path, collection(feature(), boundary=crossed))) == "broken-geometry"
