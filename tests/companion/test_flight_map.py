"""The flight map: what is compiled is what is flown, to the last bit, and nothing else is."""

from __future__ import annotations

import json
import math
import sqlite3
import struct
import zlib
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely
from pyproj import CRS

from companion.assembly import build_setup, flight_map_of
from companion.cli.app import execute
from companion.config import load
from companion.config.tables import PrescriptionTable
from companion.core.prescription import Prescription
from companion.errors import ConfigError, MapError, Problem
from companion.flight_map import (
    FlightMap,
    difference,
    read_flight_map,
)
from companion.flight_map import child as child_module
from companion.flight_map import file as file_module
from companion.journal.geopackage import LOCAL_ID, geometry_blob
from missions.maps.build import build_prescription, frame_for, point_rates
from missions.maps.cells import bounds_deg
from missions.maps.compiling import (
    MapOrder,
    compile_map,
    compiled_setup,
    read_configured_map,
    read_ordered_map,
    write_flight_map,
)
from missions.maps.model import Affine, MapCells, MapFile
from missions.maps.registry import read_map

EXAMPLES = Path(__file__).parents[2] / "examples"
ANYANG = EXAMPLES / "anyang" / "config.toml"
CONFIGURATIONS = [
    EXAMPLES / name / "config.toml" for name in ("anyang", "orchard", "pump-sections", "pinpoint")
]


def compiled(config_file: Path = ANYANG, *overrides: str) -> FlightMap:
    return compile_map(MapOrder.of(load(config_file, overrides=overrides)))


def written(folder: Path, config_file: Path = ANYANG, *overrides: str) -> FlightMap:
    return write_flight_map(folder / "a.flightmap.gpkg", compiled(config_file, *overrides))


def assert_same(one: Prescription, two: Prescription) -> None:
    """Assert that two prescriptions have the same ground, edges and rates, bit for bit."""
    assert np.array_equal(one.edges.ends, two.edges.ends)
    assert np.array_equal(one.edges.owner, two.edges.owner)
    assert shapely.to_wkb(one.field) == shapely.to_wkb(two.field)
    assert (one.rates_l_ha, one.overlap, one.default_rate_l_ha, one.sha256) == (
        two.rates_l_ha,
        two.overlap,
        two.default_rate_l_ha,
        two.sha256,
    )
    west, south, east, north = one.bounds_m
    places = np.random.default_rng(1).uniform((west, south), (east, north), (2000, 2))
    assert np.array_equal(
        one.rates_at(places[:, 0], places[:, 1]),
        two.rates_at(places[:, 0], places[:, 1]),
        equal_nan=True,
    )
    box = ((west + east) / 2 - 20, (south + north) / 2 - 20)
    for first, second in zip(
        one.edges_near(*box, box[0] + 40, box[1] + 40),
        two.edges_near(*box, box[0] + 40, box[1] + 40),
        strict=True,
    ):
        assert np.array_equal(first, second)


@pytest.mark.parametrize("config_file", CONFIGURATIONS, ids=lambda path: path.parent.name)
def test_what_is_flown_is_what_the_source_says_to_the_last_bit(
    config_file: Path, tmp_path: Path
) -> None:
    config = load(config_file)
    map_file = read_configured_map(config)
    again = read_flight_map(written(tmp_path, config_file).path)
    table = config.prescription
    assert table is not None
    if table.boundary is None and not table.exclusions:
        source = build_prescription(map_file, frame_for(map_file), overlap=table.overlap)
        assert_same(again.prescription, source)
    assert again.frame == frame_for(map_file)
    assert again.source_rates_l_ha == map_file.rates_l_ha
    direct = compiled_setup(config)
    assert_same(build_setup(config, again).prescription, direct.prescription)


def test_the_same_source_and_settings_have_the_same_hash(tmp_path: Path) -> None:
    one = written(tmp_path)
    two = write_flight_map(tmp_path / "b.flightmap.gpkg", compiled())
    other = write_flight_map(
        tmp_path / "c.flightmap.gpkg", compiled(ANYANG, "prescription.overlap=max")
    )
    assert one.sha256 == two.sha256 != other.sha256
    assert read_flight_map(one.path).sha256 == one.sha256


def test_findings_sources_and_settings_come_back(tmp_path: Path) -> None:
    found = Problem(severity="warning", code="odd", text="a zone", where="here", fix="look")
    one = write_flight_map(tmp_path / "a.flightmap.gpkg", replace(compiled(), findings=(found,)))
    again = read_flight_map(one.path)
    assert again.findings == (found,)
    assert again.sources == one.sources
    assert {each.key for each in again.sources} == {"prescription.file", "prescription.boundary"}
    assert again.frozen == one.frozen
    assert again.as_object() == one.as_object()


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("prescription.overlap", "max"),
        ("prescription.default_rate_l_ha", "12.0"),
        ("prescription.unit", "gal/ac"),
        ("prescription.density_kg_l", "1.1"),
        ("prescription.mix_rate", "20.0"),
        ("prescription.scale", "0.1"),
        ("prescription.boundary", "other.geojson"),
        ("prescription.exclusions", '["pond.geojson"]'),
        ("mission.lines", "field.lines.geojson"),
        ("prescription.rate_field", "other"),
    ],
)
def test_a_flight_map_of_other_settings_is_refused_by_the_key(
    key: str, value: str, tmp_path: Path
) -> None:
    flight_map = read_flight_map(written(tmp_path).path)
    config = load(ANYANG, overrides=[f"{key}={value}"])
    found = difference(flight_map, config)
    assert found is not None
    assert found[0] == key
    with pytest.raises(ConfigError, match=rf"{key} = .*compile the map again") as refused:
        build_setup(config, flight_map)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "override",
    [
        "prescription.offset_east_m=1.5",
        "prescription.border=volume",
        "prescription.border_buffer_m=0.5",
        "prescription.across=max",
        "product.rate_max_l_ha=60",
    ],
)
def test_what_is_live_needs_no_new_flight_map(override: str, tmp_path: Path) -> None:
    flight_map = read_flight_map(written(tmp_path).path)
    config = load(ANYANG, overrides=[override])
    assert build_setup(config, flight_map) is not None


def test_a_configuration_that_says_nothing_of_reading_does_not_object(tmp_path: Path) -> None:
    flight_map = written(tmp_path, ANYANG, "prescription.crs=EPSG:4326")
    assert difference(flight_map, load(ANYANG)) is None
    other = load(ANYANG, overrides=["prescription.crs=EPSG:4490"])
    assert difference(flight_map, other) == ("prescription.crs", "EPSG:4490", "EPSG:4326")


def test_the_label_limits_the_rates_of_the_source(tmp_path: Path) -> None:
    flight_map = read_flight_map(written(tmp_path).path)
    with pytest.raises(ConfigError, match=r"above product\.rate_max_l_ha = 5"):
        build_setup(load(ANYANG, overrides=["product.rate_max_l_ha=5"]), flight_map)


def test_an_offset_moves_the_compiled_ground(tmp_path: Path) -> None:
    flight_map = read_flight_map(written(tmp_path).path)
    moved = flight_map.moved(10.0, -5.0)
    here, there = flight_map.prescription, moved
    assert np.allclose(
        there.edges.ends, here.edges.ends + np.array([10.0, -5.0, 10.0, -5.0]), atol=1e-9
    )
    assert flight_map.moved(0.0, 0.0) is flight_map.prescription


def config_naming(folder: Path, name: str) -> Path:
    """Write a configuration that names another map, beside nothing but that."""
    text = ANYANG.read_text().replace('file = "prescription.shp"', f'file = "{name}"')
    path = folder / "config.toml"
    path.write_text(text)
    return path


def test_a_flight_map_alone_is_enough(tmp_path: Path) -> None:
    flight_map = written(tmp_path)
    config = load(config_naming(tmp_path, flight_map.path.name))
    assert_same(
        build_setup(config, flight_map_of(config)).prescription,
        compiled_setup(load(ANYANG)).prescription,
    )


def test_a_boundary_that_was_changed_since_is_refused(tmp_path: Path) -> None:
    flight_map = written(tmp_path)
    config = load(config_naming(tmp_path, flight_map.path.name))
    boundary = tmp_path / "boundary.geojson"
    boundary.write_bytes((EXAMPLES / "anyang" / "boundary.geojson").read_bytes())
    assert flight_map_of(config).sha256 == flight_map.sha256
    boundary.write_bytes(boundary.read_bytes() + b"\n")
    with pytest.raises(ConfigError, match=r"prescription\.boundary: .* was changed"):
        flight_map_of(config)


def office_files(folder: Path) -> Path:
    """Copy the example with its map into a folder and return its configuration."""
    for file in (EXAMPLES / "anyang").iterdir():
        if file.is_file() and file.suffix != ".py":
            (folder / file.name).write_bytes(file.read_bytes())
    return folder / "config.toml"


def test_any_other_map_is_compiled_by_a_child_and_once_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = load(office_files(tmp_path))
    first = flight_map_of(config)
    assert (
        first.sha256
        == write_flight_map(
            tmp_path / "other.flightmap.gpkg",
            replace(compiled(config.path), findings=first.findings),
        ).sha256
    )

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("compiled again")

    with monkeypatch.context() as patch:
        patch.setattr(child_module.subprocess, "Popen", refuse)
        assert flight_map_of(config).as_object() == first.as_object()
        with pytest.raises(AssertionError, match="compiled again"):
            flight_map_of(load(config.path, overrides=["prescription.overlap=max"]))
        (tmp_path / "prescription.prj").touch()
        assert flight_map_of(config).sha256 == first.sha256
        (tmp_path / "boundary.geojson").write_bytes(
            (tmp_path / "boundary.geojson").read_bytes() + b"\n"
        )
        with pytest.raises(AssertionError, match="compiled again"):
            flight_map_of(config)


def test_what_the_child_refuses_is_refused_in_its_words(tmp_path: Path) -> None:
    config = load(office_files(tmp_path))
    (tmp_path / "prescription.dbf").write_bytes(b"nonsense")
    with pytest.raises(MapError) as direct:
        compiled_setup(config)
    with pytest.raises(MapError) as by_child:
        flight_map_of(config)
    assert str(by_child.value) == str(direct.value)
    assert (by_child.value.code, by_child.value.fix) == (direct.value.code, direct.value.fix)


def test_command_says_what_it_made(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "field.flightmap.gpkg"
    source = EXAMPLES / "anyang" / "prescription.shp"
    order = ["map", "compile", str(source), "--config", str(ANYANG), "--out", str(out)]
    assert execute(order) == 0
    assert read_flight_map(out).sha256[:8] in capsys.readouterr().out
    assert execute([*order[:-1], str(tmp_path / "field.gpkg")]) == 2
    assert execute(["map", "compile", str(out), "--out", str(out)]) == 2


Change = Callable[[sqlite3.Connection], object]


def changed(path: Path, change: Change) -> None:
    with closing(sqlite3.connect(path)) as connection:
        change(connection)
        connection.commit()


@pytest.mark.parametrize(
    "sql",
    [
        "UPDATE zones SET rate_l_ha = 99.0 WHERE id = 1",
        "DELETE FROM zones",
        "DELETE FROM meta",
        "UPDATE meta SET value = '[' WHERE key = 'frozen'",
        "UPDATE meta SET value = '2' WHERE key = 'flight_map_version'",
        "DROP TABLE field",
        "DROP TABLE zones; CREATE VIEW zones AS SELECT 1 AS id, 'a' AS name",
        "CREATE TRIGGER t AFTER INSERT ON zones BEGIN DELETE FROM meta; END; "
        "UPDATE zones SET name = name || 'x'",
        "PRAGMA application_id = 1",
    ],
)
def test_a_flight_map_that_was_changed_is_refused(sql: str, tmp_path: Path) -> None:
    path = written(tmp_path).path
    changed(path, lambda connection: connection.executescript(sql))
    with pytest.raises(MapError, match="not a sound flight map") as refused:
        read_flight_map(path)
    assert "\n" not in str(refused.value)
    assert refused.value.code == "flight-map"


# ------------------------------------------------------------------ what the hash does not find

CELL_DEG = 1e-4


def file_of_cells() -> MapFile:
    rates = np.arange(12.0).reshape(3, 4)
    rates[0, 0] = np.nan
    return MapFile(
        path=Path("grid.tif"),
        format="GeoTIFF",
        crs="EPSG:4326",
        unit="L/ha",
        rate_field="1",
        zones=(),
        sha256="0" * 64,
        cells=MapCells(
            rates_l_ha=rates,
            transform=(CELL_DEG, 0.0, 114.5, 0.0, -CELL_DEG, 36.0),
            crs=CRS.from_epsg(4326),
        ),
    )


def map_of_cells() -> FlightMap:
    map_file = file_of_cells()
    frame = frame_for(map_file)
    return FlightMap(
        path=map_file.path,
        frame=frame,
        prescription=build_prescription(map_file, frame),
        is_bounded=False,
        source="grid.tif",
        source_rates_l_ha=map_file.rates_l_ha,
        polylines=(((0.0, 0.0), (5.0, 5.0)),),
    )


@pytest.mark.parametrize("has_boundary", [False, True])
def test_cells_are_bounded_where_somebody_drew_a_border(has_boundary: bool) -> None:
    map_file = file_of_cells()
    field = shapely.MultiPolygon([shapely.box(114.5, 35.9997, 114.5004, 36.0)])
    if has_boundary:
        map_file = replace(map_file, boundary=field)
    order = MapOrder(table=PrescriptionTable.model_validate({"file": "grid.tif"}))
    assert compile_map(order, map_file=map_file).is_bounded is has_boundary


def test_cells_without_a_border_have_none_from_the_file_either(tmp_path: Path) -> None:
    before = map_of_cells()
    path = write_flight_map(tmp_path / "a.flightmap.gpkg", before).path
    again = read_flight_map(path)
    assert_same(again.prescription, before.prescription)
    assert again.polylines == before.polylines
    moved = again.moved(2.0, -3.0)
    assert moved.rate_at(2.0, -3.0) == before.prescription.rate_at(0.0, 0.0)
    assert moved.cells is not None
    assert np.allclose(
        moved.edges_near(-50, -50, 50, 50)[0],
        before.prescription.edges_near(-52, -47, 48, 53)[0] + np.array([2.0, -3.0, 2.0, -3.0]),
        atol=1e-9,
    )


@pytest.mark.parametrize("has_boundary", [False, True])
@pytest.mark.parametrize(
    ("code", "transform"),
    [
        (4326, (CELL_DEG, 0.0, 114.5, 0.0, -CELL_DEG, 36.0)),
        (4326, (CELL_DEG, 0.0, 114.5, 0.0, CELL_DEG, 36.0)),
        (4326, (CELL_DEG, 2e-5, 114.5, -2e-5, -CELL_DEG, 36.0)),
        (32650, (7.0, 0.0, 300_000.0, 0.0, -7.0, 3_984_000.0)),
        (3035, (4_000.0, 0.0, 4_300_000.0, 0.0, -4_000.0, 2_700_000.0)),  # bent
    ],
)
def test_cells_of_a_flight_map_are_read_as_their_source(
    code: int, transform: Affine, has_boundary: bool, tmp_path: Path
) -> None:
    map_file = file_of_cells()
    assert map_file.cells is not None
    cells = replace(map_file.cells, transform=transform, crs=CRS.from_epsg(code))
    map_file = replace(map_file, cells=cells)
    west, south, east, north = bounds_deg(cells)
    if has_boundary:
        drawn = shapely.box(west, (south + north) / 2, east, north)
        map_file = replace(map_file, boundary=shapely.MultiPolygon([drawn]))
    order = MapOrder(table=PrescriptionTable.model_validate({"file": "grid.tif"}))
    flight_map = compile_map(order, map_file=map_file)
    found = read_map(write_flight_map(tmp_path / "a.flightmap.gpkg", flight_map).path)
    assert (found.cells is None) is (code == 3035)
    assert (found.boundary is not None) is has_boundary or code == 3035
    points = np.random.default_rng(1).uniform((south, west), (north, east), (400, 2))
    asked = [(float(one), float(two)) for one, two in points]
    before, after = (
        [(row["rate_l_ha"], row["zone"], row.get("inside")) for row in point_rates(one, asked)]
        for one in (map_file, found)
    )
    if found.cells is None:
        before, after = ([row[0] for row in rows] for rows in (before, after))
    if transform[4] > 0.0:  # rows are counted from the north
        before, after = ([(row[0], row[2]) for row in rows] for rows in (before, after))
    assert sum(one != two for one, two in zip(before, after, strict=True)) <= (code == 3035)


def polygon(*places: tuple[float, float]) -> bytes:
    wkb = shapely.to_wkb(shapely.Polygon(places), byte_order=1)
    return geometry_blob(wkb, srs_id=LOCAL_ID, is_empty=False)


SEVEN, NAN = struct.pack("<d", 7.0), struct.pack("<d", math.nan)
WARPS = json.dumps([{"x0": 0.0, "y0": 0.0, "scale": 1.0, "terms": [[5, 0], [0, 1], [1, 0]]}] * 2)


@pytest.mark.parametrize(
    ("table", "column", "value", "why"),
    [
        ("zones", "geom", polygon((0, 0), (9, 9), (9, 0), (0, 9)), "crosses itself"),
        ("zones", "geom", polygon((0, 0), (1e6, 0), (0, 9)), "farther off"),
        ("zones", "geom", polygon((0, 0), (7, 0), (0, 9)).replace(SEVEN, NAN), "not a number"),
        ("zones", "geom", b"GP", "no GeoPackage geometry"),
        ("zones", "rate_l_ha", -1.0, "not a rate"),
        ("zones", "rate_l_ha", None, "no rate"),
        ("zones", "name", b"x", "no name"),
        ("field", "geom", geometry_blob(shapely.to_wkb(shapely.Point(1, 1)), srs_id=LOCAL_ID,
                                        is_empty=False), "other than polygons"),
        ("source_rates", "rate_l_ha", math.inf, "not a rate"),
        ("findings", "severity", "grave", "no severity"),
        ("sources", "sha256", b"x", "another kind"),
    ],
)  # fmt: skip
def test_a_flight_map_with_the_right_hash_is_looked_at_all_the_same(
    table: str, column: str, value: object, why: str, tmp_path: Path
) -> None:
    found = Problem(severity="warning", code="odd", text="a zone")
    path = write_flight_map(
        tmp_path / "a.flightmap.gpkg", replace(compiled(), findings=(found,))
    ).path
    changed_with_hash(path, f"UPDATE {table} SET {column} = ?", value)
    with pytest.raises(MapError, match=why):
        read_flight_map(path)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("default_rate_l_ha", "NaN"),
        ("default_rate_l_ha", "true"),
        ("overlap", "all"),
        ("is_bounded", "false"),
        ("origin_latitude_deg", "91"),
        ("origin_latitude_deg", "nan"),
        ("frozen", "[]"),
        ("frozen", "[" * 5000),
    ],
)
def test_what_a_flight_map_says_of_itself_is_looked_at(
    key: str, value: str, tmp_path: Path
) -> None:
    path = written(tmp_path).path
    changed_with_hash(path, f"UPDATE meta SET value = ? WHERE key = '{key}'", value)
    with pytest.raises(MapError, match="not a sound flight map"):
        read_flight_map(path)


@pytest.mark.parametrize(
    ("column", "value"),
    [
        ("row_count", 10**9),
        ("row_count", -3),
        ("column_count", None),
        ("classes", zlib.compress(b"\0" * 10**7)),
        ("rates_l_ha", b"nonsense"),
        ("warps", WARPS),
        ("warps", WARPS.replace("1.0", "NaN")),
        ("warps", "[1, 2]"),
    ],
)
def test_cells_that_lie_nowhere_are_refused(column: str, value: object, tmp_path: Path) -> None:
    path = write_flight_map(tmp_path / "a.flightmap.gpkg", map_of_cells()).path
    changed_with_hash(path, f"UPDATE cells SET {column} = ?", value)
    with pytest.raises(MapError, match="not a sound flight map"):
        read_flight_map(path)


def changed_with_hash(path: Path, sql: str, value: object) -> None:
    """Change a flight map as somebody would who works out its hash anew."""
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        connection.execute(sql, (value,))
        sha256 = file_module.content_sha256(connection)
        connection.execute("UPDATE meta SET value = ? WHERE key = 'sha256'", (sha256,))


# ------------------------------------------------------------------------------------ real maps

# What the files of the samples leave open.
SAMPLES: list[tuple[str, dict[str, object]]] = [
    ("01_shp_lha_multipolygon/Rx.shp", {}),
    ("03_shp_value_noUnit/20250415_211530.shp", {"unit": "L/ha"}),
    ("07_isoxml_v3_onesoil", {"layer": "TSK2"}),
    ("08_isoxml_v4_tzn_vector_map1", {"density_kg_l": 1.2}),
    ("10_geojson", {"unit": "L/ha"}),
    (
        "14_geotiff_adapt",
        {
            "layer": "RasterRx-15.tiff",
            "rate_field": "Product 2",
            "density_kg_l": 1.2,
        },
    ),
    ("06_isoxml_v3_grid2_lha", {}),
]


@pytest.mark.parametrize(("name", "answers"), SAMPLES, ids=[name for name, _ in SAMPLES])
def test_real_maps_come_back_to_the_last_bit(
    name: str, answers: dict[str, object], samples: Path, tmp_path: Path
) -> None:
    table = PrescriptionTable.model_validate(
        {"file": str(samples / name), "overlap": "max", **answers}
    )
    order = MapOrder(table=table)
    map_file = read_ordered_map(order)
    source = build_prescription(map_file, frame_for(map_file), overlap="max")
    path = tmp_path / "a.flightmap.gpkg"
    write_flight_map(path, compile_map(order, map_file=map_file))
    again = read_flight_map(path)
    assert_same(again.prescription, source)
    assert_same(
        again.moved(3.0, 4.0),
        build_prescription(
            map_file, frame_for(map_file), overlap="max", offset_east_m=3.0, offset_north_m=4.0
        ),
    )


def test_a_flight_map_can_be_looked_at_and_planned_over(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flight_map = written(tmp_path)
    found = read_map(flight_map.path)
    source = read_configured_map(load(ANYANG))
    assert (found.format, found.unit, found.rates_l_ha) == ("flight map", "L/ha", source.rates_l_ha)
    for zone, other in zip(found.zones, source.zones, strict=True):
        assert zone.name == other.name
        assert zone.geometry.symmetric_difference(other.geometry).area < 1e-15
    config = config_naming(tmp_path, flight_map.path.name)
    assert execute(["map", "check", str(flight_map.path), "--config", str(config)]) == 0
    boundary = tmp_path / "boundary.geojson"
    boundary.write_bytes((EXAMPLES / "anyang" / "boundary.geojson").read_bytes())
    order = [
        "plan",
        "--force",
        str(boundary),
        "--config",
        str(config),
        "--out",
        str(tmp_path / "a.plan"),
    ]
    assert execute(order) == 0, capsys.readouterr().err


def test_a_compiler_that_takes_too_long_is_refused_in_words(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(child_module, "_TIMEOUT_S", 0.001)
    with pytest.raises(MapError, match=r"took longer than 0 s\); compile it in the office"):
        child_module.flight_map_of_file(Path("examples/anyang/prescription.shp"), overlap="max")


def test_a_compiler_that_takes_too_much_memory_is_refused_in_words(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    teeth = [(114.0 + number * 1e-8, 36.0 + number % 2 * 1e-3) for number in range(400_000)]
    ring = [*teeth, (114.02, 35.9), teeth[0]]
    corners = ",".join(f"{x:.8f} {y:.3f}" for x, y in ring)
    path = tmp_path / "teeth.csv"
    path.write_text(f'wkt,rate\n"POLYGON(({corners}))",10\n', "ascii")
    monkeypatch.setattr(child_module, "_MEMORY_MAX_BYTES", 200 * 1024**2)
    with pytest.raises(
        MapError, match=r"teeth.csv: cannot be compiled \(it needs more than 200 MB"
    ):
        child_module.flight_map_of_file(path, overlap="max")
    # A map of a usual size has room there.
    small = child_module.flight_map_of_file(Path("examples/anyang/prescription.shp"), overlap="max")
    assert small.source == "prescription.shp"


def test_an_overlap_rule_that_is_none_is_refused_in_words(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    out = str(tmp_path / "a.flightmap.gpkg")
    order = ["map", "compile", "examples/anyang/prescription.shp", "--out", out]
    assert execute([*order, "--overlap", "refuse"]) == 2
    assert (
        "--overlap is one of error, max, min, mean, last, not 'refuse'" in capsys.readouterr().err
    )


def test_a_flight_map_is_named_where_a_journal_is_wanted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    written(tmp_path)
    flight_map = tmp_path / "a.flightmap.gpkg"
    assert execute(["flights", "show", str(flight_map)]) == 2
    assert capsys.readouterr().err == (
        f"error: {flight_map}: this is a flight map, not a journal; give the .gpkg file of a "
        "flight\n"
    )


def test_a_map_on_which_no_valve_can_open_is_refused_before_the_flight(tmp_path: Path) -> None:
    square = [[8.0, 47.0], [8.001, 47.0], [8.001, 47.001], [8.0, 47.001], [8.0, 47.0]]
    geometry = {"type": "Polygon", "coordinates": [square]}
    features = [
        {"type": "Feature", "geometry": geometry, "properties": {"rate": 0.0, "unit": "L/ha"}}
    ]
    (tmp_path / "zero.geojson").write_text(
        json.dumps({"type": "FeatureCollection", "features": features})
    )
    given = [f"prescription.file={tmp_path / 'zero.geojson'}"]
    path = tmp_path / "config.toml"
    text = ANYANG.read_text().replace('boundary = "boundary.geojson"\n', "")
    path.write_text(text)
    config = load(path, overrides=given)
    with pytest.raises(ConfigError, match="can open no valve on this map, because every rate is 0"):
        build_setup(config, flight_map_of(config, given))
