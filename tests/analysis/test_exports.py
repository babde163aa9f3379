"""Exports, read back by readers that are not ours: places, rates, times, volumes are the same."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import mcap.reader
import numpy as np
import pyarrow.parquet
import pytest
import shapely
from numpy.typing import NDArray
from pyproj import Geod

from analysis.exports.cli import FORMATS, format_for
from analysis.exports.output import write_beside
from analysis.exports.source import Shape, Source
from analysis.flown.applied_flight import AppliedFlight
from analysis.flown.read_applied import read_applied
from tests.analysis.export_flight import fly
from tests.analysis.export_readers import Layer, read_layer

# 20, 25, 15, 20 L/ha on 12 m each: 6 m wide, and 3 m wide on the way back.
PRESCRIBED_ML = 9.0 * 12.0 * 80.0 / 10.0
MAP_HASH = "ab" * 32
FACTS = {"training": "water", "utc_source": "computer", "map": MAP_HASH[:12]}

Floats = NDArray[np.float64]


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> AppliedFlight:
    flown = read_applied(fly(tmp_path_factory.mktemp("flown"), training="water"))
    return replace(flown, meta={**flown.meta, "map_sha256": MAP_HASH})


def source(flight: AppliedFlight, shape: Shape = "points", **how: Any) -> Source:
    return Source(flight=flight, shape=shape, **how)


def written(given: Source, name: str, folder: Path, form: str | None = None) -> Path:
    out = folder / name
    content = format_for(out, form).maker()(given, out)
    assert out.name in content
    write_beside(out, content, force=False)
    return out


def check_points(
    given: Source, places: Floats, ms: NDArray[np.int64], columns: dict[str, Floats]
) -> None:
    """Compare what was read with what the flight has."""
    samples = given.samples
    truth = np.stack((samples.longitude_deg, samples.latitude_deg), axis=1)
    assert places.shape == truth.shape
    assert np.abs(places - truth).max() <= 1e-7
    assert np.abs(ms - 1000.0 * samples.utc_s).max() <= 1.0
    np.testing.assert_allclose(columns["target"], samples.rate_l_ha, rtol=1e-3)
    np.testing.assert_allclose(columns["applied"], samples.applied_l_ha, rtol=1e-3, atol=1e-3)
    assert columns["volume_ml"].sum() == pytest.approx(1000.0 * given.volume_l, rel=1e-3)


def check_swaths(
    given: Source, shapes: NDArray[np.object_], ms: NDArray[np.int64], columns: dict[str, Floats]
) -> None:
    """Compare what was read with what the flight has, and areas with the geodesic ones."""
    swaths = given.swaths
    assert len(shapes) == len(swaths) > 50
    for ours, theirs in zip(swaths.polygons, shapes, strict=True):
        assert shapely.hausdorff_distance(ours, theirs) <= 1e-7
    start_s = swaths.start_s + swaths.utc_offset_s
    assert np.abs(ms - 1000.0 * start_s).max() <= 1.0
    np.testing.assert_allclose(columns["target"], swaths.rate_l_ha, rtol=1e-3)
    np.testing.assert_allclose(columns["applied"], swaths.applied_l_ha, rtol=1e-3)
    np.testing.assert_allclose(columns["area_m2"], geodesic_m2(shapes), rtol=2e-3)
    assert columns["volume_ml"].sum() == pytest.approx(1000.0 * given.volume_l, rel=1e-3)


def geodesic_m2(shapes: NDArray[np.object_]) -> Floats:
    ellipsoid = Geod(ellps="WGS84")
    return np.array([abs(ellipsoid.geometry_area_perimeter(each)[0]) for each in shapes])


def test_the_flight_of_these_tests_sprays_what_is_prescribed(flight: AppliedFlight) -> None:
    given = source(flight)
    assert 1000.0 * given.volume_l == pytest.approx(PRESCRIBED_ML, rel=0.01)
    assert given.samples.volume_ml.sum() == pytest.approx(1000.0 * given.volume_l, rel=1e-9)
    assert set(given.samples.width_m.tolist()) == {0.0, 3.0, 6.0}


def test_applied_and_prescribed_rates_agree_where_nothing_changes(flight: AppliedFlight) -> None:
    samples = source(flight).samples
    steady = (samples.volume_ml > 0.0) & (np.abs(np.gradient(samples.applied_l_ha)) < 1e-3)
    assert steady.sum() > 80
    ratio = samples.applied_l_ha[steady] / samples.rate_l_ha[steady]
    assert np.abs(ratio - 1.0).max() < 0.01


def points_of(layer: Layer) -> Floats:
    return shapely.get_coordinates(layer.shapes)


LONG = {
    "target": "target_rate_l_ha",
    "applied": "applied_rate_l_ha",
    "volume_ml": "volume_ml",
    "area_m2": "area_m2",
}
SHORT = {"target": "TargetRate", "applied": "AppliedRat", "volume_ml": "Volume", "area_m2": "Area"}


@pytest.mark.parametrize("name", ["f.csv", "f.geojson", "f.json", "f.geojsonl", "f.shp", "f.zip"])
def test_points_come_back_through_gdal(flight: AppliedFlight, tmp_path: Path, name: str) -> None:
    given = source(flight)
    path = written(given, name, tmp_path)
    layer = read_layer(path)
    is_short = path.suffix in (".shp", ".zip")
    names = SHORT if is_short else LONG
    if path.suffix == ".csv":
        places = np.stack((layer.numbers("longitude_deg"), layer.numbers("latitude_deg")), axis=1)
    else:
        places = points_of(layer)
        assert layer.crs == "EPSG:4326"
    ms = layer.milliseconds("IsoTime" if is_short else "time_utc")
    columns = {key: layer.numbers(column) for key, column in names.items()}
    check_points(given, places, ms, columns)


@pytest.mark.parametrize("name", ["s.geojson", "s.geojsonl", "s.shp", "s.zip", "s.kml", "s.kmz"])
def test_swaths_come_back_through_gdal(flight: AppliedFlight, tmp_path: Path, name: str) -> None:
    given = source(flight, "swaths")
    path = written(given, name, tmp_path)
    layer = read_layer(path, "applied" if path.suffix in (".kml", ".kmz") else None)
    is_short = path.suffix in (".shp", ".zip")
    names = SHORT if is_short else LONG
    columns = {key: layer.numbers(column) for key, column in names.items()}
    ms = layer.milliseconds("IsoTime" if is_short else "time_utc")
    # KML has a height for every corner.
    check_swaths(given, shapely.force_2d(layer.shapes), ms, columns)
    valves = layer.columns["SECTIONID" if is_short else "valve"]
    assert set(valves.tolist()) == {"1", "2", "3", "4", "5", "6"}


@pytest.mark.parametrize("name", ["f.csv", "f.geojson", "f.geojsonl", "f.kml"])
def test_every_row_says_what_flight_it_is_of(
    flight: AppliedFlight, tmp_path: Path, name: str
) -> None:
    path = written(source(flight, "swaths" if name == "f.kml" else "points"), name, tmp_path)
    columns = read_layer(path, "applied" if name == "f.kml" else None).columns
    for key, value in {**FACTS, "flight": "flight-0001"}.items():
        assert set(columns[key].tolist()) == {value}


def test_a_shapefile_says_its_units_beside_it(flight: AppliedFlight, tmp_path: Path) -> None:
    path = written(source(flight, system="us"), "rx.shp", tmp_path)
    columns = read_layer(path).columns
    assert {each.name for each in tmp_path.iterdir()} == {
        "rx.shp", "rx.shx", "rx.dbf", "rx.prj", "rx.cpg", "rx-Deere-Metadata.json",
    }  # fmt: skip
    metadata = json.loads((tmp_path / "rx-Deere-Metadata.json").read_text())
    units = {each["Name"]: each["Unit"] for each in metadata["DataAttributes"]}
    assert list(units) == list(columns)
    assert len(units) <= 20
    assert max(len(name) for name in units) <= 10
    assert units["AppliedRat"] == "gal1ac-1"
    assert units["SWATHWIDTH"] == "ft"
    assert metadata["vrspray"]["map_sha256"] == MAP_HASH
    assert set(columns["Training"].tolist()) == {"water"}


def test_other_units_are_the_same_amounts(flight: AppliedFlight, tmp_path: Path) -> None:
    layer = read_layer(written(source(flight, system="us"), "f.csv", tmp_path))
    samples = source(flight).samples
    # 1 US gal/ac is 9.353958 L/ha, a foot 0.3048 m, a mile an hour 0.44704 m/s.
    for name, factor, values in (
        ("applied_rate_gal_ac", 9.353958, samples.applied_l_ha),
        ("width_ft", 0.3048, samples.width_m),
        ("speed_mph", 0.44704, samples.speed_m_s),
        ("flow_gal_min", 3.785411784, samples.flow_l_min),
        ("volume_fl_oz", 29.5735295625, samples.volume_ml),
        ("pressure_psi", 6.894757, samples.pressure_kpa),
    ):
        np.testing.assert_allclose(factor * layer.numbers(name), values, rtol=1e-3, atol=1e-3)


def test_fewer_points_hold_the_same_volume(flight: AppliedFlight) -> None:
    thin, full = source(flight, rate_hz=2.0).samples, source(flight).samples
    assert len(thin) == pytest.approx(2.0 * flight.duration_s, abs=2)
    assert np.diff(thin.time_s).min() > 0.4
    assert thin.volume_ml.sum() == pytest.approx(full.volume_ml.sum(), rel=1e-9)
    # From sample to sample a valve may open or close, and the speed change.
    thinnest = source(flight, rate_hz=0.5).samples
    for each in (thin, thinnest):
        assert each.area_m2.sum() == pytest.approx(full.area_m2.sum(), rel=1e-4)
        assert each.distance_m.sum() == pytest.approx(full.distance_m.sum(), rel=1e-3)


def test_points_have_what_each_valve_did(flight: AppliedFlight, tmp_path: Path) -> None:
    layer = read_layer(written(source(flight), "f.csv", tmp_path))
    flows = np.stack([layer.numbers(f"flow_v{valve}_l_min") for valve in range(1, 7)])
    np.testing.assert_allclose(flows.sum(axis=0), layer.numbers("flow_l_min"), atol=1e-4)
    duties = np.stack([layer.numbers(f"duty_v{valve}") for valve in range(1, 7)])
    assert ((duties > 0.0).sum(axis=0) == 3).sum() > 80
    assert layer.numbers("target_rate_v1_l_ha")[np.argmax(flows[0] > 0.0) + 2] == 20.0


def test_a_csv_has_its_meaning_beside_it(flight: AppliedFlight, tmp_path: Path) -> None:
    path = written(source(flight), "f.csv", tmp_path)
    about = json.loads((tmp_path / "f.csv-metadata.json").read_text())
    with path.open(newline="") as file:
        header = next(csv.reader(file))
    assert [each["name"] for each in about["tableSchema"]["columns"]] == header
    (note,) = about["notes"]
    assert note["training"] == "water"
    assert note["units"]["applied_rate_l_ha"] == "L/ha"
    assert note["rows"] == len(source(flight).samples)


def test_every_ten_milliseconds_hold_path_and_flow(flight: AppliedFlight, tmp_path: Path) -> None:
    given = source(flight, "steps")
    path = written(given, "f.csv", tmp_path, "csv-samples")
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    about = json.loads((tmp_path / "f.csv-metadata.json").read_text())["notes"][0]
    assert len(rows) == about["rows"] == len(given.record.time_s)
    flow = np.array([[float(row[f"flow_l_min_v{k}"]) for k in range(1, 7)] for row in rows])
    litres = flow.sum() * about["step_s"] / 60.0
    assert litres == pytest.approx(given.volume_l, rel=1e-4)
    rate = np.array([float(row["rate_l_ha_v3"]) for row in rows])
    east = np.array([float(row["east_m"]) for row in rows])
    north = np.array([float(row["north_m"]) for row in rows])
    assert set(rate[(east > 13.0) & (east < 23.0) & (north < 4.0)].tolist()) == {25.0}
    inside = np.array([int(row["inside_v6"]) for row in rows])
    assert inside[(north < 4.0) & (east > 1.0) & (east < 47.0)].all()
    # On the way back the right wing is beyond the north border.
    assert not inside[north > 5.0].any()
    assert [each["right_m"] for each in about["valves"]] == [-2.5, -1.5, -0.5, 0.5, 1.5, 2.5]


def test_a_map_has_colours_times_and_a_legend(flight: AppliedFlight, tmp_path: Path) -> None:
    path = written(source(flight, "swaths"), "s.kml", tmp_path)
    text = path.read_text("utf-8")
    assert "training: water" in text
    assert text.count("<TimeSpan>") == len(source(flight, "swaths").swaths) + 1
    legend = read_layer(path, "legend")
    names = legend.columns["Name"].tolist()
    assert len(names) == 7
    assert all(name.endswith(" L/ha") for name in names)
    field = read_layer(path, "field")
    west, south, east, north = shapely.total_bounds(field.shapes)
    frame = flight.setup.frame
    assert frame.to_local(south, west) == pytest.approx((0.0, -1.0), abs=1e-3)
    assert frame.to_local(north, east) == pytest.approx((48.0, 7.0), abs=1e-3)


def test_two_exports_of_a_flight_are_the_same_bytes(flight: AppliedFlight) -> None:
    for form in FORMATS:
        out = Path("x" + (*form.suffixes, *form.also)[-1])
        first, second = (
            {
                name: b"".join(chunks)
                for name, chunks in form.maker()(source(flight, form.shapes[0]), out).items()
            }
            for _ in range(2)
        )
        assert first == second, form.name


@pytest.mark.parametrize("shape", ["points", "swaths"])
def test_a_parquet_comes_back_through_arrow(
    flight: AppliedFlight, tmp_path: Path, shape: Shape
) -> None:
    given = source(flight, shape)
    table = pyarrow.parquet.read_table(written(given, "f.parquet", tmp_path))
    geo = json.loads(table.schema.metadata[b"geo"])
    assert geo["primary_column"] == "geometry"
    assert geo["columns"]["geometry"]["encoding"] == "WKB"
    assert geo["columns"]["geometry"]["geometry_types"] == [
        "Point" if shape == "points" else "Polygon"
    ]
    shapes = shapely.from_wkb(table["geometry"].to_pylist())
    assert geo["columns"]["geometry"]["bbox"] == pytest.approx(shapely.total_bounds(shapes))
    columns = {
        "target": np.array(table["AppliedVolumePerAreaTarget"], dtype=np.float64),
        "applied": np.array(table["AppliedVolumePerAreaActual"]),
        "volume_ml": 1000.0 * np.array(table["AppliedTotalVolume"]),
        "area_m2": 10_000.0 * np.array(table["AppliedArea"]),
    }
    texts = [text.removesuffix("Z") for text in table["timestamp"].to_pylist()]
    ms = np.array(texts, dtype="datetime64[ms]").astype(np.int64)
    if shape == "points":
        check_points(given, shapely.get_coordinates(shapes), ms, columns)
    else:
        check_swaths(given, shapes, ms, columns)
    facts = json.loads(table.schema.metadata[b"vrspray"])
    assert (facts["training"], facts["map_sha256"]) == ("water", MAP_HASH)
    assert table.schema.field("Speed").metadata == {b"unit": b"m1sec-1"}


def test_messages_come_back_through_mcap(flight: AppliedFlight, tmp_path: Path) -> None:
    given = source(flight)
    path = written(given, "f.mcap", tmp_path)
    reader = mcap.reader.make_reader(io.BytesIO(path.read_bytes()))
    found: dict[str, list[tuple[int, dict[str, Any]]]] = {}
    schemas = {}
    for schema, channel, message in reader.iter_messages():
        assert schema is not None
        schemas[channel.topic] = (schema.name, schema.encoding, json.loads(schema.data))
        found.setdefault(channel.topic, []).append((message.log_time, json.loads(message.data)))
    assert schemas["/position"][:2] == ("foxglove.LocationFix", "jsonschema")
    assert set(found["/spray"][0][1]) == set(schemas["/spray"][2]["properties"])
    places = np.array([(each["longitude"], each["latitude"]) for _, each in found["/position"]])
    ms = np.array([at_ns for at_ns, _ in found["/spray"]]) // 1_000_000
    names = {"target": "target_rate_l_ha", "applied": "applied_rate_l_ha", "volume_ml": "volume_ml"}
    columns = {
        key: np.array([each[name] for _, each in found["/spray"]], dtype=np.float64)
        for key, name in names.items()
    }
    check_points(given, places, ms, columns)
    at_ns, message = found["/spray"][100]
    stamp = message["timestamp"]
    assert stamp["sec"] * 1_000_000_000 + stamp["nsec"] == at_ns
    assert [each["kind"] for _, each in found["/events"]] == ["turn", "turn"]
    facts = {each.name: each.metadata for each in reader.iter_metadata()}["vrspray"]
    assert (facts["training"], facts["map_sha256"]) == ("water", MAP_HASH)
    assert json.loads(facts["units"])["flow_l_min"] == "L/min"


def test_times_are_those_of_the_journal(flight: AppliedFlight, tmp_path: Path) -> None:
    layer = read_layer(written(source(flight), "f.geojson", tmp_path))
    started = datetime.fromisoformat(flight.meta["started_utc"]).astimezone(UTC).timestamp()
    first_ms = layer.milliseconds("time_utc")[0]
    expected_s = started - float(flight.meta["started_s"]) + flight.time_s[0]
    assert abs(first_ms - 1000.0 * expected_s) <= 1.0
