"""GeoPackages as GDAL writes them, and what is refused."""

from __future__ import annotations

import hashlib
import sqlite3
import struct
import zipfile
from contextlib import closing
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import shapely
from pyproj import CRS, Transformer
from shapely import MultiPolygon, Polygon

from companion.errors import MapError
from missions.maps.geopackage import read_geopackage
from missions.maps.model import Layer
from tests.missions.geopackages import by_gdal, refused, understood
from tests.missions.two_grounds import RING, SOUTH, SQUARE, TWO, WEST


def edited(path: Path, *statements: str) -> Path:
    """Change a file by SQL; its triggers need functions that only GDAL has."""
    with closing(sqlite3.connect(path)) as connection:
        triggers = connection.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'")
        for (name,) in triggers.fetchall():
            connection.execute(f'DROP TRIGGER "{name}"')
        connection.executescript(";".join(statements))
    return path


def values(layer: Layer, name: str) -> tuple[object, ...]:
    return next(column.values for column in layer.columns if column.name == name)


def test_what_gdal_writes_is_read(tmp_path: Path) -> None:
    path = by_gdal(tmp_path / "rx.gpkg")
    layer = read_geopackage(path)
    assert layer.geometries == (RING, TWO)
    assert [(column.name, column.numeric) for column in layer.columns] == [
        ("fid", True), ("rate", True), ("unit", False),
    ]  # fmt: skip
    assert layer.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    found = understood(layer, path)
    assert (found.format, found.crs, found.unit) == ("geopackage", "EPSG:4326", "L/ha")
    assert [zone.rate_l_ha for zone in found.zones] == [12.5, None]
    assert [zone.name for zone in found.zones] == ["1", "2"]
    assert found.zones[0].hole_count == 1
    assert found.zones[1].part_count == 2


@pytest.mark.parametrize("byte_order", [0, 1])
@pytest.mark.parametrize("flavor", ["iso", "extended"])
@pytest.mark.parametrize("dimension", [2, 3])
def test_heights_and_both_byte_orders(
    tmp_path: Path, dimension: int, byte_order: int, flavor: str
) -> None:
    path = by_gdal(tmp_path / "rx.gpkg")
    wkb = shapely.to_wkb(
        shapely.force_3d(TWO, z=200.0), output_dimension=dimension, byte_order=byte_order,
        flavor=flavor,
    )  # fmt: skip
    header = struct.pack("<2sBBi" if byte_order else ">2sBBi", b"GP", 0, byte_order, 4326)
    edited(path, f"UPDATE rx SET geom = x'{(header + wkb).hex()}'")
    assert read_geopackage(path).geometries == (TWO, TWO)


def test_measures_are_dropped(tmp_path: Path) -> None:
    zm = "POLYGON ZM ((0 0 7 8, 1 0 7 8, 1 1 7 8, 0 0 7 8))"
    m = "POLYGON M ((0 0 8, 1 0 8, 1 1 8, 0 0 8))"
    blobs = [shapely.to_wkb(shapely.from_wkt(one), flavor="iso") for one in (zm, m)]
    path = by_gdal(tmp_path / "rx.gpkg", blobs=blobs)
    plain = Polygon([(0, 0), (1, 0), (1, 1)])
    assert read_geopackage(path).geometries == (plain, plain)


def test_projected_maps_lie_where_proj_puts_them(tmp_path: Path) -> None:
    to_metres = Transformer.from_crs("EPSG:4326", "EPSG:32633", always_xy=True)
    metres = shapely.transform(SQUARE, lambda p: np.column_stack(to_metres.transform(*p.T)))
    path = by_gdal(tmp_path / "rx.gpkg", grounds=[metres], rates=[1.0], crs="EPSG:32633")
    found = understood(read_geopackage(path), path)
    assert found.crs == "EPSG:32633"
    assert found.zones[0].geometry.symmetric_difference(SQUARE).area < 1e-7 * SQUARE.area


@pytest.mark.parametrize("crs", ["EPSG:4258", "EPSG:2193", "EPSG:4326", "EPSG:31256", "OGC:CRS84"])
def test_x_stands_first_whatever_the_crs(tmp_path: Path, crs: str) -> None:
    path = by_gdal(tmp_path / "rx.gpkg", crs=crs)
    layer = read_geopackage(path)
    assert layer.crs is not None
    assert layer.crs.equals(CRS(crs), ignore_axis_order=True)
    assert layer.geometries[0] == RING


def test_a_crs_without_a_code_is_read_from_its_text(tmp_path: Path) -> None:
    crs = "+proj=tmerc +lat_0=48 +lon_0=15 +k=1 +x_0=1000 +y_0=2000 +ellps=GRS80 +units=m"
    path = by_gdal(tmp_path / "rx.gpkg", crs=crs)
    layer = read_geopackage(path)
    assert layer.crs is not None
    point = Transformer.from_crs(layer.crs, "EPSG:4326", always_xy=True).transform(1000.0, 2000.0)
    assert point == pytest.approx((15.0, 48.0))


@pytest.mark.parametrize("undefined", [0, -1])
def test_an_undefined_crs_is_none(tmp_path: Path, undefined: int) -> None:
    path = edited(
        by_gdal(tmp_path / "rx.gpkg"), f"UPDATE gpkg_geometry_columns SET srs_id = {undefined}",
        "UPDATE rx SET geom = NULL",
    )  # fmt: skip
    assert read_geopackage(path).crs is None


def test_a_crs_whose_code_and_text_differ_is_refused(tmp_path: Path) -> None:
    wkt = CRS("EPSG:4258").to_wkt("WKT1_GDAL")
    path = edited(
        by_gdal(tmp_path / "rx.gpkg"),
        f"UPDATE gpkg_spatial_ref_sys SET definition = '{wkt}' WHERE srs_id = 4326",
    )
    assert refused(path).code == "wrong-crs"


def test_a_record_in_another_crs_than_its_layer_is_refused(tmp_path: Path) -> None:
    path = edited(
        by_gdal(tmp_path / "rx.gpkg", crs="EPSG:32633"),
        "UPDATE gpkg_geometry_columns SET srs_id = 4326",
    )
    assert refused(path).code == "wrong-crs"


def test_a_crs_that_is_not_described_is_refused(tmp_path: Path) -> None:
    path = edited(
        by_gdal(tmp_path / "rx.gpkg"), "DELETE FROM gpkg_spatial_ref_sys WHERE srs_id = 4326"
    )
    assert refused(path).code == "no-crs"


def test_records_without_ground_are_told(tmp_path: Path) -> None:
    grounds = [SQUARE, None, Polygon(), shapely.Point(WEST, SOUTH)]
    path = by_gdal(tmp_path / "rx.gpkg", grounds=grounds, rates=[1.0, 2.0, 3.0, 4.0])
    layer = read_geopackage(path)
    assert layer.geometries == (SQUARE, None, None, None)
    assert layer.skipped == {1: "null-geometry", 2: "no-area", 3: "not-a-polygon:Point"}


def test_polygons_in_a_collection_are_found(tmp_path: Path) -> None:
    mixed = shapely.GeometryCollection([shapely.Point(WEST, SOUTH), TWO, SQUARE])
    path = by_gdal(tmp_path / "rx.gpkg", grounds=[mixed], rates=[1.0])
    assert read_geopackage(path).geometries == (MultiPolygon([*TWO.geoms, SQUARE]),)


def curve(*rings: bytes) -> bytes:
    return struct.pack("<BII", 1, 10, len(rings)) + b"".join(rings)


def line(kind: int) -> bytes:
    points = [0.0, 0.0, 1.0, 0.0, 1.0, 1.0, 0.0, 1.0, 0.0, 0.0]
    return struct.pack("<BII10d", 1, kind, 5, *points)


def test_curves_with_straight_edges_are_polygons(tmp_path: Path) -> None:
    surface = struct.pack("<BII", 1, 12, 1) + curve(line(2))
    path = by_gdal(tmp_path / "rx.gpkg", blobs=[curve(line(2)), surface])
    unit = Polygon([(0, 0), (1, 0), (1, 1), (0, 1)])
    assert read_geopackage(path).geometries == (unit, unit)


def test_round_edges_are_refused(tmp_path: Path) -> None:
    path = by_gdal(tmp_path / "rx.gpkg", blobs=[curve(line(2)), curve(line(8))])
    error = refused(path)
    assert error.code == "curved-geometry"
    assert "record 2" in str(error)


GOOD = shapely.to_wkb(SQUARE, byte_order=1)
HEADER = struct.pack("<2sBBi", b"GP", 0, 1, 4326)


@pytest.mark.parametrize(
    "blob",
    [
        b"",
        b"GP\0\1",
        b"XX" + HEADER[2:] + GOOD,
        HEADER + GOOD[:-1],
        HEADER + GOOD + b"\0",
        HEADER + GOOD[:-8] + struct.pack("<d", 99.0),
        HEADER + GOOD[:1] + struct.pack("<I", 99) + GOOD[5:],
        HEADER + GOOD[:5] + struct.pack("<I", 4_000_000_000) + GOOD[9:],
        HEADER + GOOD[:9] + struct.pack("<I", 4_000_000_000) + GOOD[13:],
        HEADER + b"\7" + GOOD[1:],
        HEADER[:3] + b"\x0f" + HEADER[4:] + GOOD,
        HEADER[:3] + b"\x21" + HEADER[4:] + GOOD,
        HEADER + struct.pack("<BII", 1, 7, 1) * 100_000,
        HEADER + struct.pack("<BII", 1, 6, 1) + struct.pack("<BI2d", 1, 1, 0, 0),
        HEADER + struct.pack("<BIII6d", 1, 3, 1, 3, 0, 0, 1, 1, 0, 0),
    ],
)
def test_broken_geometry_is_refused(tmp_path: Path, blob: bytes) -> None:
    path = edited(by_gdal(tmp_path / "rx.gpkg"), f"UPDATE rx SET geom = x'{blob.hex()}'")
    error = refused(path)
    assert error.code == "broken-geometry"
    assert "record 1 of the layer rx" in str(error)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e300])
def test_coordinates_nowhere_on_earth_are_refused(tmp_path: Path, value: float) -> None:
    blob = HEADER + GOOD[:29] + struct.pack("<d", value) + GOOD[37:]
    path = edited(by_gdal(tmp_path / "rx.gpkg"), f"UPDATE rx SET geom = x'{blob.hex()}'")
    assert refused(path).code == "broken-geometry"


def test_numbers_in_text_and_odd_names(tmp_path: Path) -> None:
    path = edited(
        by_gdal(tmp_path / "rx.gpkg", field='do`se"x', layer="Rx 'of' `2024`"),
        """ALTER TABLE "Rx 'of' `2024`" ADD COLUMN dose TEXT""",
        """ALTER TABLE "Rx 'of' `2024`" ADD COLUMN wet BOOLEAN""",
        """ALTER TABLE "Rx 'of' `2024`" ADD COLUMN comma TEXT""",
        """UPDATE "Rx 'of' `2024`" SET dose = ' 7.5', wet = 1, comma = '7,5'""",
    )
    layer = read_geopackage(path)
    assert values(layer, 'do`se"x') == (12.5, None)
    assert values(layer, "dose") == (" 7.5", " 7.5")
    assert values(layer, "wet") == ("true", "true")
    assert {column.name: column.numeric for column in layer.columns} == {
        "fid": True, 'do`se"x': True, "unit": False, "dose": True, "wet": False, "comma": False,
    }  # fmt: skip


DATA_COLUMNS = """CREATE TABLE IF NOT EXISTS gpkg_data_columns (table_name TEXT, column_name TEXT,
    name TEXT, title TEXT, description TEXT, mime_type TEXT, constraint_name TEXT)"""


@pytest.mark.parametrize(
    ("title", "description", "unit"),
    [
        ("Dose (gal/ac)", "", "gal/ac"),
        ("", "L/ha", "L/ha"),
        ("Dose (L/ha)", "l/ha", "L/ha"),
        ("Dose", "as the agronomist said", None),
        ("Dose (kg/ha)", "", "kg/ha"),
    ],
)
def test_units_in_titles(tmp_path: Path, title: str, description: str, unit: str | None) -> None:
    path = edited(
        by_gdal(tmp_path / "rx.gpkg"),
        DATA_COLUMNS,
        f"INSERT INTO gpkg_data_columns VALUES ('rx','rate',NULL,'{title}','{description}','','')",
    )
    columns = {column.name: column.unit for column in read_geopackage(path).columns}
    assert columns == {"fid": None, "rate": unit, "unit": None}


def test_titles_that_state_two_units_are_refused(tmp_path: Path) -> None:
    path = edited(
        by_gdal(tmp_path / "rx.gpkg"),
        DATA_COLUMNS,
        "INSERT INTO gpkg_data_columns VALUES ('rx','rate','','Dose (L/ha)','gal/ac','','')",
    )
    assert refused(path).code == "unit-conflict"


def test_several_layers_ask_which(tmp_path: Path) -> None:
    path = by_gdal(tmp_path / "rx.gpkg", layer="may")
    by_gdal(path, layer="june", append=True, rates=[1.0, 2.0])
    error = refused(path)
    assert error.code == "several-layers"
    assert "may, june" in str(error)
    assert values(read_geopackage(path, "june"), "rate") == (1.0, 2.0)
    assert values(read_geopackage(path, "MAY"), "rate") == (12.5, None)
    assert refused(path, "july").code == "no-layer"


def test_a_second_layer_of_points_is_no_choice(tmp_path: Path) -> None:
    path = by_gdal(tmp_path / "rx.gpkg")
    point = shapely.Point(WEST, SOUTH)
    by_gdal(path, layer="samples", grounds=[point], rates=[9.0], geometry_type="Point", append=True)
    assert values(read_geopackage(path), "rate") == (12.5, None)


def test_a_second_layer_whose_rates_are_text_is_a_choice(tmp_path: Path) -> None:
    path = by_gdal(tmp_path / "rx.gpkg", layer="may")
    by_gdal(path, layer="june", append=True)
    edited(path, "ALTER TABLE june DROP COLUMN rate", "ALTER TABLE june ADD COLUMN dose TEXT")
    assert values(read_geopackage(path), "rate") == (12.5, None)
    edited(path, "UPDATE june SET dose = '30'")
    assert refused(path).code == "several-layers"


def test_a_view_is_refused(tmp_path: Path) -> None:
    path = edited(
        by_gdal(tmp_path / "rx.gpkg"),
        "CREATE VIEW loud AS SELECT fid, geom, rate * 2 AS rate, unit FROM rx",
        "INSERT INTO gpkg_contents (table_name, data_type, identifier, srs_id) "
        "VALUES ('loud', 'features', 'loud', 4326)",
        "INSERT INTO gpkg_geometry_columns VALUES ('loud', 'geom', 'POLYGON', 4326, 0, 0)",
    )
    assert refused(path).code == "several-layers"
    assert refused(path, "loud").code == "not-a-table"
    assert values(read_geopackage(path, "rx"), "rate") == (12.5, None)


ENDLESS = """WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n)
    SELECT '' || i AS table_name, 'features' AS data_type FROM n"""


def test_the_tables_of_the_format_are_no_views(tmp_path: Path) -> None:
    path = edited(
        by_gdal(tmp_path / "rx.gpkg"),
        "DROP TABLE gpkg_contents",
        f"CREATE VIEW gpkg_contents AS {ENDLESS}",
    )
    assert refused(path).code == "unknown-format"


def more(path: Path, column: str) -> Path:
    return edited(
        path,
        f"CREATE TABLE more (fid INTEGER PRIMARY KEY, geom BLOB, rate REAL, {column})",
        "INSERT INTO more (geom, rate) VALUES (NULL, 1.0)",
        "INSERT INTO gpkg_contents (table_name, data_type, identifier, srs_id) "
        "VALUES ('more', 'features', 'more', 4326)",
        "INSERT INTO gpkg_geometry_columns VALUES ('more', 'geom', 'POLYGON', 4326, 0, 0)",
    )


def test_constraints_are_not_computed(tmp_path: Path) -> None:
    # True when the record was made; false now, which only a program that computes it can tell.
    path = more(by_gdal(tmp_path / "rx.gpkg"), "x INT DEFAULT 1 CHECK (x < 2)")
    edited(path, "PRAGMA ignore_check_constraints = ON", "UPDATE more SET x = 3")
    assert values(read_geopackage(path, "more"), "x") == (3.0,)


@pytest.mark.parametrize("kind", ["VIRTUAL", "STORED"])
def test_computed_columns_are_refused(tmp_path: Path, kind: str) -> None:
    path = more(by_gdal(tmp_path / "rx.gpkg"), f"x AS (hex(zeroblob(9))) {kind} NOT NULL")
    error = refused(path, "more")
    assert error.code == "not-a-table"
    assert "computed column (x)" in str(error)


def test_a_virtual_table_is_no_layer(tmp_path: Path) -> None:
    path = edited(
        by_gdal(tmp_path / "rx.gpkg"),
        "UPDATE gpkg_contents SET table_name = 'rtree_rx_geom'",
        "UPDATE gpkg_geometry_columns SET table_name = 'rtree_rx_geom'",
    )
    assert refused(path).code == "not-a-table"


def test_work_without_end_is_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = by_gdal(tmp_path / "rx.gpkg", grounds=[SQUARE] * 2000, rates=[1.0] * 2000)
    assert len(read_geopackage(path).geometries) == 2000
    monkeypatch.setattr("missions.maps.geopackage_layers._STEPS_MAX", 1000)
    monkeypatch.setattr("missions.maps.geopackage_layers._STEPS_PER_CALL", 500)
    assert refused(path).code == "too-large"


@pytest.mark.parametrize(
    ("limit", "value"),
    [
        ("model.MAX_RECORDS", 1),
        ("model.MAX_VERTICES", 14),
        ("geopackage_layers._CELLS_MAX", 7),
        ("geopackage_layers._COLUMNS_MAX", 3),
        ("geopackage_layers._LAYERS_MAX", 0),
        ("model.MAX_FILE_BYTES", 10_000),
    ],
)
def test_what_is_too_large_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: str, value: int
) -> None:
    path = by_gdal(tmp_path / "rx.gpkg")
    monkeypatch.setattr(f"missions.maps.{limit}", value)
    with pytest.raises(MapError, match=r"more than|too many"):
        read_geopackage(path)


def test_a_file_in_wal_mode_is_read_and_left_alone(tmp_path: Path) -> None:
    path = edited(by_gdal(tmp_path / "rx.gpkg"), "PRAGMA journal_mode = WAL")
    before = path.read_bytes()
    assert before[18:20] == b"\2\2"
    assert values(read_geopackage(path), "rate") == (12.5, None)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("mode", ["WAL", "DELETE"])
def test_changes_that_are_not_in_the_file_yet_are_refused(tmp_path: Path, mode: str) -> None:
    path = edited(by_gdal(tmp_path / "rx.gpkg"), f"PRAGMA journal_mode = {mode}")
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        connection.execute("PRAGMA cache_size = 1")
        connection.execute("PRAGMA synchronous = FULL")
        connection.execute("BEGIN")
        connection.execute("UPDATE rx SET rate = 99, unit = hex(zeroblob(100000))")
        if mode == "WAL":
            connection.execute("COMMIT")
        error = refused(path)
    assert error.code == "file-in-use"
    assert "close the program" in str(error)


def test_a_wiped_journal_does_no_harm(tmp_path: Path) -> None:
    path = by_gdal(tmp_path / "rx.gpkg")
    (tmp_path / "rx.gpkg-journal").write_bytes(bytes(512))
    (tmp_path / "rx.gpkg-wal").write_bytes(b"")
    assert len(read_geopackage(path).geometries) == 2


def test_other_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "rx.gpkg"
    path.write_bytes(b"")
    assert refused(path).code == "truncated"
    path.write_bytes(np.random.default_rng(1).bytes(8192))
    assert refused(path).code == "unknown-format"
    path.unlink()
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("CREATE TABLE rx (rate REAL)")
    assert refused(path).code == "unknown-format"


@pytest.mark.parametrize("share", [0.02, 0.3, 0.5, 0.99])
def test_a_file_cut_short_is_refused(tmp_path: Path, share: float) -> None:
    path = by_gdal(tmp_path / "rx.gpkg", grounds=[SQUARE] * 500, rates=[1.0] * 500)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    assert refused(path).code == "truncated"


def test_a_lost_page_loses_no_record_in_silence(tmp_path: Path) -> None:
    path = by_gdal(tmp_path / "rx.gpkg", grounds=[SQUARE] * 500, rates=[1.0] * 500)
    content = bytearray(path.read_bytes())
    with closing(sqlite3.connect(path)) as connection:
        root = connection.execute("SELECT rootpage FROM sqlite_master WHERE name='rx'").fetchone()
    # The root page's count of cells: with one less, the records of one child page are gone.
    at = (root[0] - 1) * 4096 + 3
    count = struct.unpack_from(">H", content, at)[0]
    assert count > 2
    struct.pack_into(">H", content, at, count - 1)
    path.write_bytes(content)
    assert refused(path).code == "truncated"


@pytest.mark.parametrize(
    "statement",
    [
        "DELETE FROM gpkg_geometry_columns",
        "UPDATE gpkg_geometry_columns SET column_name = 'nowhere'",
        "UPDATE gpkg_geometry_columns SET srs_id = 'x'",
    ],
)
def test_a_layer_without_its_description_is_refused(tmp_path: Path, statement: str) -> None:
    assert refused(edited(by_gdal(tmp_path / "rx.gpkg"), statement)).code == "truncated"


def test_pictures_alone_are_refused(tmp_path: Path) -> None:
    path = edited(by_gdal(tmp_path / "rx.gpkg"), "UPDATE gpkg_contents SET data_type = 'tiles'")
    assert refused(path).code == "no-polygon"


def test_folders_and_archives(tmp_path: Path) -> None:
    folder = tmp_path / "map"
    folder.mkdir()
    path = by_gdal(folder / "rx.gpkg")
    archive = tmp_path / "rx.zip"
    with zipfile.ZipFile(archive, "w") as made:
        made.write(path, "maps/rx.gpkg")
    assert values(read_geopackage(folder), "rate") == (12.5, None)
    assert values(read_geopackage(archive), "rate") == (12.5, None)
    by_gdal(folder / "other.gpkg")
    assert refused(folder).code == "several-layers"
    with zipfile.ZipFile(archive, "a") as made:
        made.writestr("maps/rx.gpkg-wal", b"more")
    assert refused(archive).code == "file-in-use"


def test_a_real_map_keeps_its_facts(samples: Path, tmp_path: Path) -> None:
    source = samples / "01_shp_lha_multipolygon" / "Rx.shp"
    meta, _, blobs, fields = pyogrio.raw.read(str(source))
    path = tmp_path / "rx.gpkg"
    pyogrio.raw.write(
        str(path), blobs, fields, meta["fields"].tolist(), geometry_type="MultiPolygon",
        crs=meta["crs"], driver="GPKG",
    )  # fmt: skip
    found = understood(read_geopackage(path), path)
    assert (found.unit, found.rate_field) == ("L/ha", "rate")
    assert found.rates_l_ha == (0.0, 120.0, 140.0, 160.0, 170.0, 180.0)
    assert sum(zone.part_count for zone in found.zones) == 527
    assert sum(zone.hole_count for zone in found.zones) == 68
    assert [zone.geometry for zone in found.zones] == shapely.from_wkb(blobs).tolist()
