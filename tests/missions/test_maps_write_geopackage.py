"""GeoPackages as we write them: read back, read by GDAL, by the rules of the format."""

from __future__ import annotations

import sqlite3
import struct
from contextlib import closing
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import shapely
from shapely import MultiPolygon, Polygon, box

from companion.errors import MapError
from missions.maps.geopackage import read_geopackage, write_geopackage
from missions.maps.model import MapZone
from tests.missions.geopackages import by_gdal, refused, understood
from tests.missions.two_grounds import CELL, RING, SOUTH, SQUARE, TWO, WEST

ZONES = (
    MapZone(name="Süd <\"&'> 地块", geometry=RING, rate_l_ha=12.345678901),
    MapZone(name="two", geometry=TWO, rate_l_ha=None),
    MapZone(name="zero", geometry=SQUARE, rate_l_ha=0.0),
)
FIELD = MultiPolygon([box(WEST, SOUTH, WEST + 9 * CELL, SOUTH + CELL).difference(SQUARE)])


@pytest.mark.parametrize("boundary", [None, FIELD])
def test_our_own_file_is_read_back(tmp_path: Path, boundary: MultiPolygon | None) -> None:
    path = tmp_path / "out.gpkg"
    write_geopackage(ZONES, path, boundary=boundary)
    layer = read_geopackage(path)
    assert layer.boundary == boundary
    found = understood(layer, path)
    assert (found.unit, found.crs, found.problems) == ("L/ha", "EPSG:4326", ())
    assert found.zones == ZONES


def test_gdal_reads_our_file(tmp_path: Path) -> None:
    path = tmp_path / "out.gpkg"
    write_geopackage(ZONES, path, boundary=FIELD)
    assert pyogrio.list_layers(path).tolist() == [
        ["prescription", "MultiPolygon"], ["boundary", "MultiPolygon"],
    ]  # fmt: skip
    info = pyogrio.read_info(path, layer="prescription")
    assert info["crs"] == "EPSG:4326"
    assert info["fields"].tolist() == ["name", "rate", "unit"]
    assert info["total_bounds"] == pytest.approx((WEST, SOUTH, WEST + 4 * CELL, SOUTH + CELL))
    _, _, blobs, (names, rates, units) = pyogrio.raw.read(str(path), layer="prescription")
    assert names.tolist() == [zone.name for zone in ZONES]
    assert rates.tolist() == pytest.approx([12.345678901, np.nan, 0.0], nan_ok=True)
    assert units.tolist() == ["L/ha"] * 3
    for ground, zone in zip(shapely.from_wkb(blobs), ZONES, strict=True):
        assert shapely.normalize(ground) == shapely.normalize(
            MultiPolygon([zone.geometry]) if zone.part_count == 1 else zone.geometry
        )
    outline = pyogrio.raw.read(str(path), layer="boundary")[2]
    assert shapely.from_wkb(outline).tolist() == [FIELD]


def test_our_file_keeps_the_rules_of_the_format(tmp_path: Path) -> None:
    path = tmp_path / "out.gpkg"
    write_geopackage(ZONES, path, boundary=FIELD)
    content = path.read_bytes()
    assert content[68:72] == b"GPKG"
    assert struct.unpack(">I", content[60:64])[0] == 10300
    with closing(sqlite3.connect(path)) as connection:
        assert connection.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
        assert connection.execute("PRAGMA foreign_key_check").fetchall() == []
        systems = connection.execute("SELECT srs_id FROM gpkg_spatial_ref_sys ORDER BY 1")
        assert systems.fetchall() == [(-1,), (0,), (4326,)]


def test_two_runs_give_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a.gpkg", "b.gpkg"):
        write_geopackage(ZONES, tmp_path / name, boundary=FIELD)
    assert (tmp_path / "a.gpkg").read_bytes() == (tmp_path / "b.gpkg").read_bytes()
    assert sorted(one.name for one in tmp_path.iterdir()) == ["a.gpkg", "b.gpkg"]


def test_a_map_without_zones_is_written(tmp_path: Path) -> None:
    write_geopackage((), tmp_path / "out.gpkg")
    assert read_geopackage(tmp_path / "out.gpkg").geometries == ()


def test_a_boundary_alone_is_a_layer_like_others(tmp_path: Path) -> None:
    path = by_gdal(tmp_path / "field.gpkg", grounds=[FIELD], rates=[1.0], layer="boundary")
    layer = read_geopackage(path)
    assert layer.geometries == tuple(FIELD.geoms)
    assert layer.boundary is None


def test_a_boundary_that_crosses_itself_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "out.gpkg"
    bow = MultiPolygon([Polygon(np.array([(0, 0), (1, 1), (1, 0), (0, 1)]) * CELL + [WEST, SOUTH])])
    write_geopackage(ZONES, path, boundary=bow)
    assert refused(path).code == "broken-geometry"


def test_nothing_is_written_where_nothing_can_be(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "out.gpkg"
    path.write_bytes(b"old")

    def full(source: Path, target: Path) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("companion.atomic_write.os.replace", full)
    with pytest.raises(MapError) as caught:
        write_geopackage(ZONES, path)
    assert caught.value.code == "not-written"
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_in_use_is_not_replaced(tmp_path: Path) -> None:
    path = by_gdal(tmp_path / "rx.gpkg")
    (tmp_path / "rx.gpkg-wal").write_bytes(b"changes")
    before = path.read_bytes()
    with pytest.raises(MapError) as caught:
        write_geopackage(ZONES, path)
    assert caught.value.code == "file-in-use"
    assert path.read_bytes() == before
