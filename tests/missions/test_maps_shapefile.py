"""Shapefiles, written by GDAL and then damaged where GDAL would not."""

from __future__ import annotations

import hashlib
import struct
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import shapely
from pyproj import Geod
from shapely import MultiPolygon, Polygon, box

from companion.errors import MapError
from missions.maps import model
from missions.maps.assemble import Repair, repair_problems
from missions.maps.registry import read_area, read_map
from tests.missions.shapefiles import CELL, SOUTH, WEST, cell, codes, simple, without_prj, write


def test_a_shapefile_gives_its_zones_with_rates_unit_and_crs(tmp_path: Path) -> None:
    found = read_map(simple(tmp_path))
    assert (found.format, found.crs, found.unit, found.rate_field) == (
        "shapefile",
        "EPSG:4326",
        "L/ha",
        "rate",
    )
    assert [zone.rate_l_ha for zone in found.zones] == [12.5, 0.0]
    assert found.zones[0].geometry.equals(cell(0))
    assert found.problems == ()


def test_a_folder_with_one_shapefile_is_read_as_the_file(tmp_path: Path) -> None:
    path = simple(tmp_path)
    assert read_map(tmp_path).zones == read_map(path).zones


def test_a_folder_with_two_shapefiles_is_refused_until_one_is_named(tmp_path: Path) -> None:
    simple(tmp_path)
    write(tmp_path / "other.shp", [cell(5)], geometry_type="Polygon", rate=[1.0], unit=["L/ha"])
    with pytest.raises(MapError, match=r"other, rx; name one of them") as caught:
        read_map(tmp_path)
    assert caught.value.code == "several-layers"
    assert [zone.rate_l_ha for zone in read_map(tmp_path, layer="other").zones] == [1.0]


def test_the_hash_covers_every_file_of_the_set(tmp_path: Path) -> None:
    path = simple(tmp_path)
    suffixes = (".cpg", ".dbf", ".prj", ".shp", ".shx")
    content = b"".join(path.with_suffix(suffix).read_bytes() for suffix in suffixes)
    before = read_map(path).sha256
    assert before == hashlib.sha256(content).hexdigest()
    path.with_suffix(".prj").write_text(path.with_suffix(".prj").read_text() + "\n")
    assert read_map(path).sha256 != before


def test_suffixes_in_upper_case_belong_to_the_set(tmp_path: Path) -> None:
    path = simple(tmp_path)
    for file in sorted(tmp_path.iterdir()):
        file.rename(file.with_suffix(file.suffix.upper()))
    assert len(read_map(path.with_suffix(".SHP")).zones) == 2


def test_a_missing_prj_is_refused_even_when_the_coordinates_could_be_degrees(
    tmp_path: Path,
) -> None:
    path = without_prj(simple(tmp_path))
    with pytest.raises(MapError, match=r"rx\.shp: .*no \.prj.*--crs EPSG:4326"):
        read_map(path)
    assert read_map(path, crs="EPSG:4326").crs == "EPSG:4326"


def test_metres_in_a_file_called_geographic_are_refused(tmp_path: Path) -> None:
    square = box(500_000, 3_983_000, 500_100, 3_983_100)
    path = without_prj(
        write(
            tmp_path / "rx.shp",
            [square],
            crs="EPSG:32650",
            geometry_type="Polygon",
            rate=[1.0],
            unit=["L/ha"],
        )
    )
    with pytest.raises(MapError, match="look like metres") as caught:
        read_map(path, crs="EPSG:4326")
    assert caught.value.code == "wrong-crs"
    assert read_map(path, crs="EPSG:32650").zones[0].geometry.centroid.x == pytest.approx(
        117.0, abs=0.001
    )


def test_a_projected_map_lies_where_gdal_puts_it(tmp_path: Path) -> None:
    square = box(278_000, 3_986_000, 278_400, 3_986_100)
    found = read_map(
        write(
            tmp_path / "rx.shp",
            [square],
            crs="EPSG:32650",
            geometry_type="Polygon",
            rate=[1.0],
            unit=["L/ha"],
        )
    )
    west, south, east, north = found.zones[0].geometry.bounds
    # 222 km off the central meridian of 117 degrees the scale is 0.9996 (1 + x^2 / (2 R^2)).
    scale = 0.9996 * (1 + (0.222 / 6.38) ** 2 / 2)
    area_m2, _ = Geod(ellps="WGS84").geometry_area_perimeter(found.zones[0].geometry)
    assert found.crs == "EPSG:32650"
    assert abs(area_m2) == pytest.approx(400 * 100 / scale**2, rel=1e-4)
    # North of the equator by its northing over the scale on the meridian, 111 km a degree.
    assert (south + north) / 2 == pytest.approx(35.99, abs=0.02)
    assert (west + east) / 2 == pytest.approx(117 - 222 / 90.2, abs=0.01)


def test_another_datum_is_read_with_a_warning(tmp_path: Path) -> None:
    found = read_map(
        write(
            tmp_path / "rx.shp",
            [cell(0)],
            crs="EPSG:4490",
            geometry_type="Polygon",
            rate=[1.0],
            unit=["L/ha"],
        )
    )
    assert codes(found) == {"datum"}


def test_a_crs_that_contradicts_the_prj_is_taken_with_a_warning(tmp_path: Path) -> None:
    assert "crs-overridden" in codes(read_map(simple(tmp_path), crs="EPSG:4490"))
    assert "crs-overridden" not in codes(read_map(simple(tmp_path), crs="EPSG:4326"))


@pytest.mark.parametrize("text", ["", "   ", "rubbish", 'LOCAL_CS["x",UNIT["m",1]]', "\xff\xfe"])
def test_a_prj_that_says_nothing_is_refused(tmp_path: Path, text: str) -> None:
    path = simple(tmp_path)
    path.with_suffix(".prj").write_text(text, encoding="latin-1")
    with pytest.raises(MapError, match=r"coordinate reference system.*--crs"):
        read_map(path)


def test_holes_and_islands_in_holes_are_where_gdal_sees_them(tmp_path: Path) -> None:
    outer, hole, island = cell(0), cell(0).buffer(-CELL / 5), cell(0).buffer(-CELL / 3)
    second = cell(3).difference(cell(3).buffer(-CELL / 4))
    ground = MultiPolygon([outer.difference(hole), island, second])
    path = write(tmp_path / "rx.shp", [ground], rate=[5.0], unit=["L/ha"])
    zone = read_map(path).zones[0]
    assert (zone.part_count, zone.hole_count) == (3, 2)
    assert zone.geometry.symmetric_difference(ground).area < 1e-15


def test_rings_that_all_turn_the_wrong_way_are_ground_with_holes(tmp_path: Path) -> None:
    ring = cell(0).difference(cell(0).buffer(-CELL / 4))
    path = write(tmp_path / "rx.shp", [ring], geometry_type="Polygon", rate=[5.0], unit=["L/ha"])
    content = bytearray(path.read_bytes())
    parts, points = struct.unpack("<2i", content[100 + 8 + 36 : 100 + 8 + 44])
    start = 100 + 8 + 44 + 4 * parts
    bounds = [*struct.unpack(f"<{parts}i", content[start - 4 * parts : start]), points]
    for first, last in pairwise(bounds):
        at = slice(start + 16 * first, start + 16 * last)
        ring_points = np.frombuffer(content[at], dtype="<f8").reshape(-1, 2)
        content[at] = ring_points[::-1].tobytes()
    path.write_bytes(content)
    assert read_map(path).zones[0].geometry.symmetric_difference(ring).area < 1e-15


def test_heights_are_left_aside(tmp_path: Path) -> None:
    path = write(
        tmp_path / "rx.shp",
        [shapely.force_3d(cell(0), 7.0)],
        geometry_type="Polygon Z",
        rate=[3.0],
        unit=["L/ha"],
    )
    geometry = read_map(path).zones[0].geometry
    assert not geometry.has_z
    assert geometry.equals(cell(0))


def test_measures_are_left_aside(tmp_path: Path) -> None:
    path = simple(tmp_path)
    content = bytearray(path.read_bytes())
    for at in (32, 108, 108 + 136):  # the file's type, and each record's: PolygonM without measures
        content[at : at + 4] = struct.pack("<i", 25)
    path.write_bytes(content)
    assert read_map(path).zones[0].geometry.equals(cell(0))


def test_a_record_without_geometry_is_left_out_and_the_others_keep_their_rates(
    tmp_path: Path,
) -> None:
    path = write(
        tmp_path / "rx.shp",
        [cell(0), None, cell(2)],
        geometry_type="Polygon",
        rate=[1.0, 2.0, 3.0],
        unit=["L/ha"] * 3,
    )
    found = read_map(path)
    assert [(zone.rate_l_ha, zone.geometry.equals(cell(i))) for i, zone in
            zip((0, 2), found.zones, strict=True)] == [(1.0, True), (3.0, True)]  # fmt: skip
    assert codes(found) == {"null-geometry"}


def test_a_deleted_record_does_not_shift_the_rates_of_the_others(tmp_path: Path) -> None:
    path = write(
        tmp_path / "rx.shp",
        [cell(0), cell(1), cell(2)],
        geometry_type="Polygon",
        rate=[1.0, 2.0, 3.0],
        unit=["L/ha"] * 3,
    )
    dbf = path.with_suffix(".dbf")
    content = bytearray(dbf.read_bytes())
    header, width = struct.unpack("<HH", content[8:12])
    content[header + width] = ord("*")
    dbf.write_bytes(content)
    found = read_map(path)
    assert [zone.rate_l_ha for zone in found.zones] == [1.0, 3.0]


def test_shapes_out_of_order_are_found_through_the_index(tmp_path: Path) -> None:
    path = simple(tmp_path)
    shx = path.with_suffix(".shx")
    content = shx.read_bytes()
    shx.write_bytes(content[:100] + content[108:116] + content[100:108])
    first = read_map(path).zones[0].geometry
    _, _, seen_by_gdal, _ = pyogrio.raw.read(str(path))
    assert first.equals(shapely.from_wkb(seen_by_gdal[0]))
    assert first.equals(cell(1))


def newer_shapes(tmp_path: Path) -> Path:
    """Return a shapefile of two records whose `.shp` is of a later export with three."""
    path = simple(tmp_path)
    later = write(
        tmp_path / "later.shp", [cell(0), cell(1), cell(2)], geometry_type="Polygon",
        rate=[1.0, 2.0, 3.0],
    )  # fmt: skip
    path.write_bytes(later.read_bytes())
    for end in (".shp", ".shx", ".dbf", ".prj", ".cpg"):
        later.with_suffix(end).unlink(missing_ok=True)
    return path


def test_shapes_that_no_record_points_to_are_said(tmp_path: Path) -> None:
    found = read_map(newer_shapes(tmp_path))
    assert [zone.rate_l_ha for zone in found.zones] == [12.5, 0.0]
    (problem,) = found.problems
    assert (problem.severity, problem.code) == ("warning", "stray-records")
    assert "1 of 3 shapes" in problem.text
    assert problem.where.endswith("rx.shp")


def test_a_shape_that_was_replaced_at_the_end_is_a_stray_too(tmp_path: Path) -> None:
    """As programs edit in place: the old shape stays, the index points to the new one."""
    path = simple(tmp_path)
    content, shx = bytearray(path.read_bytes()), path.with_suffix(".shx")
    end, size = len(content), 8 + 2 * struct.unpack_from(">i", content, 104)[0]
    content += content[100 : 100 + size]
    struct.pack_into(">i", content, 24, len(content) // 2)
    path.write_bytes(content)
    index = bytearray(shx.read_bytes())
    struct.pack_into(">i", index, 100, end // 2)
    shx.write_bytes(index)
    found = read_map(path)
    assert [zone.geometry.equals(cell(number)) for number, zone in enumerate(found.zones)] == [
        True, True,
    ]  # fmt: skip
    assert codes(found) == {"stray-records"}


def test_rows_behind_the_last_of_the_table_are_said(tmp_path: Path) -> None:
    path = simple(tmp_path)
    dbf = path.with_suffix(".dbf")
    content = dbf.read_bytes()
    header, width = struct.unpack("<HH", content[8:12])
    end = header + 2 * width
    dbf.write_bytes(content[:end] + content[header : header + width] + b"\x1a")
    found = read_map(path)
    assert [zone.rate_l_ha for zone in found.zones] == [12.5, 0.0]
    (problem,) = found.problems
    assert (problem.code, problem.where) == ("stray-records", str(dbf))
    assert "1 row" in problem.text


def test_an_index_with_entries_behind_its_own_end_is_read_to_its_end(tmp_path: Path) -> None:
    path = simple(tmp_path)
    shx = path.with_suffix(".shx")
    shx.write_bytes(shx.read_bytes() + shx.read_bytes()[100:108])
    found = read_map(path)
    assert len(found.zones) == 2
    assert found.problems == ()


@pytest.mark.parametrize("rows", [1, 3])
def test_a_table_of_another_export_is_refused_with_both_counts(tmp_path: Path, rows: int) -> None:
    path = simple(tmp_path)
    other = write(
        tmp_path / "other.shp", [cell(n) for n in range(rows)], geometry_type="Polygon",
        rate=[5.0] * rows,
    )  # fmt: skip
    path.with_suffix(".dbf").write_bytes(other.with_suffix(".dbf").read_bytes())
    with pytest.raises(MapError, match=f"{rows} records for 2 shapes") as caught:
        read_map(path)
    assert caught.value.code == "table-mismatch"


def test_a_missing_index_is_a_warning(tmp_path: Path) -> None:
    path = simple(tmp_path)
    path.with_suffix(".shx").unlink()
    found = read_map(path)
    assert len(found.zones) == 2
    assert codes(found) == {"no-shx"}


def test_a_ring_that_crosses_itself_is_repaired_and_the_change_stated(tmp_path: Path) -> None:
    bow = Polygon(
        [(WEST, SOUTH), (WEST + CELL, SOUTH + CELL), (WEST + CELL, SOUTH), (WEST, SOUTH + CELL)]
    )
    path = write(tmp_path / "rx.shp", [bow], geometry_type="Polygon", rate=[1.0], unit=["L/ha"])
    found = read_map(path)
    assert found.zones[0].geometry.is_valid
    assert found.zones[0].geometry.area == pytest.approx(cell(0).area / 2, rel=1e-6)
    (problem,) = found.problems
    assert problem.code == "invalid-ring"
    assert "from 0.00 to 50.0" in problem.text


@pytest.mark.parametrize("encoding", ["UTF-8", "GBK", "CP949"])
def test_names_are_read_in_the_encoding_that_the_cpg_states(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "rx.shp"
    names = ["\u519c\u573a", "\u7530"] if encoding != "CP949" else ["\ub17c", "\ubc2d"]
    write(
        path,
        [cell(0), cell(1)],
        geometry_type="Polygon",
        encoding=encoding,
        name=names,
        rate=[1.0, 2.0],
        unit=["L/ha"] * 2,
    )
    assert [zone.name for zone in read_map(path).zones] == names


def test_a_fraction_in_a_column_declared_without_decimals_is_kept(tmp_path: Path) -> None:
    path = write(
        tmp_path / "rx.shp",
        [cell(0)],
        geometry_type="Polygon",
        rate=np.array([125], dtype=np.int32),
        unit=["L/ha"],
    )
    dbf = path.with_suffix(".dbf")
    content = dbf.read_bytes()
    assert content.count(b"125") == 1
    dbf.write_bytes(content.replace(b" 125", b"12.5"))
    assert read_map(path).zones[0].rate_l_ha == 12.5


def test_a_blank_rate_is_none_and_not_zero(tmp_path: Path) -> None:
    path = write(
        tmp_path / "rx.shp",
        [cell(0), cell(1)],
        geometry_type="Polygon",
        rate=[np.nan, 0.0],
        unit=["L/ha"] * 2,
    )
    assert [zone.rate_l_ha for zone in read_map(path).zones] == [None, 0.0]


@pytest.mark.parametrize("value", [-1.0, -9999.0, 1e6])
def test_a_rate_that_cannot_be_is_refused_with_its_zone(tmp_path: Path, value: float) -> None:
    path = write(
        tmp_path / "rx.shp",
        [cell(0), cell(1)],
        geometry_type="Polygon",
        name=["north", "south"],
        rate=[5.0, value],
        unit=["L/ha"] * 2,
    )
    with pytest.raises(MapError, match="rate of zone south is"):
        read_map(path)


@pytest.mark.parametrize("suffix", [".shp", ".shx", ".dbf"])
@pytest.mark.parametrize("keep", [0, 3, 50, 110, 0.5, 0.9])
def test_a_file_cut_off_is_refused_or_read_whole(tmp_path: Path, suffix: str, keep: float) -> None:
    path = simple(tmp_path)
    file = path.with_suffix(suffix)
    content = file.read_bytes()
    file.write_bytes(content[: int(keep * len(content)) if keep < 1 else int(keep)])
    with pytest.raises(MapError, match="rx") as caught:
        read_map(path)
    assert caught.value.code == "truncated"


def test_a_length_that_goes_nowhere_does_not_hang(tmp_path: Path) -> None:
    path = simple(tmp_path)
    path.with_suffix(".shx").unlink()
    content = bytearray(path.read_bytes())
    content[104:108] = struct.pack(">i", -4)
    path.write_bytes(content)
    with pytest.raises(MapError, match="cut off or damaged"):
        read_map(path)


def test_a_table_of_another_map_is_refused(tmp_path: Path) -> None:
    path = simple(tmp_path)
    other = write(
        tmp_path / "other.shp", [cell(0)], geometry_type="Polygon", rate=[1.0], unit=["L/ha"]
    )
    path.with_suffix(".dbf").write_bytes(other.with_suffix(".dbf").read_bytes())
    with pytest.raises(MapError, match="1 records for 2 shapes") as caught:
        read_map(path)
    assert caught.value.code == "table-mismatch"


def test_a_shapefile_of_points_is_no_map(tmp_path: Path) -> None:
    path = write(
        tmp_path / "rx.shp",
        [shapely.Point(WEST, SOUTH)],
        geometry_type="Point",
        rate=[1.0],
        unit=["L/ha"],
    )
    with pytest.raises(MapError, match="no polygon in the file"):
        read_map(path)


@pytest.mark.parametrize(
    "name", ["rx.dbf", "rx.prj", "rx.shx", "rx", "rx.xyz", "no.shp", "a\0.shp"]
)
def test_another_path_is_refused_with_the_way_out(tmp_path: Path, name: str) -> None:
    simple(tmp_path)
    (tmp_path / "rx.xyz").write_text("")
    with pytest.raises(MapError, match=r";"):
        read_map(tmp_path / name)


def test_an_empty_shapefile_is_refused(tmp_path: Path) -> None:
    path = write(
        tmp_path / "rx.shp",
        [],
        geometry_type="Polygon",
        rate=np.array([], dtype=float),
        unit=np.array([], dtype=object),
    )
    with pytest.raises(MapError):
        read_map(path)


def test_a_boundary_needs_neither_rate_nor_unit_nor_table(tmp_path: Path) -> None:
    ring = cell(0).difference(cell(0).buffer(-CELL / 4))
    path = write(tmp_path / "edge.shp", [ring], geometry_type="Polygon", n=[1])
    path.with_suffix(".dbf").unlink()
    area = read_area(path)
    assert area.geom_type == "MultiPolygon"
    assert area.symmetric_difference(ring).area < 1e-15


def test_an_exclusion_that_would_lose_ground_is_refused(tmp_path: Path) -> None:
    bow = Polygon(
        [(WEST, SOUTH), (WEST + CELL, SOUTH + CELL), (WEST + CELL, SOUTH), (WEST, SOUTH + CELL)]
    )
    crossed = write(tmp_path / "bow.shp", [bow], geometry_type="Polygon", n=[1])
    with pytest.raises(MapError, match="rings cross themselves"):
        read_area(crossed)
    partly = write(tmp_path / "null.shp", [cell(0), None], geometry_type="Polygon", n=[1, 2])
    with pytest.raises(MapError, match="record 2 is not an area: null-geometry"):
        read_area(partly)


def test_a_crossed_ring_in_metres_is_not_repaired_in_silence(tmp_path: Path) -> None:
    bow = Polygon(
        [(278_000, 3_986_000), (278_300, 3_986_300), (278_300, 3_986_000), (278_000, 3_986_300)]
    )
    path = write(
        tmp_path / "rx.shp",
        [bow],
        crs="EPSG:32650",
        geometry_type="Polygon",
        rate=[1.0],
        unit=["L/ha"],
    )
    (problem,) = read_map(path).problems
    assert problem.code == "invalid-ring"
    assert "to 449" in problem.text or "to 450" in problem.text


@pytest.mark.parametrize(("limit", "most"), [("MAX_RECORDS", 1), ("MAX_VERTICES", 9)])
def test_a_file_beyond_all_bounds_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: str, most: int
) -> None:
    path = simple(tmp_path)
    monkeypatch.setattr(model, limit, most + 1)
    assert read_map(path)
    monkeypatch.setattr(model, limit, most)
    with pytest.raises(MapError, match=f"are more than {most}"):
        read_map(path)


def test_a_file_too_large_to_read_is_refused_unread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = simple(tmp_path)
    monkeypatch.setattr(model, "MAX_FILE_BYTES", 100)
    with pytest.raises(MapError, match="more than 0 MB"):
        read_map(path)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -1e308])
@pytest.mark.parametrize("vertex", [0, 1, 4])
def test_a_coordinate_that_is_no_place_is_refused(
    tmp_path: Path, value: float, vertex: int
) -> None:
    path = simple(tmp_path)
    content = bytearray(path.read_bytes())
    at = 100 + 8 + 44 + 4 + 16 * vertex
    content[at : at + 8] = struct.pack("<d", value)
    path.write_bytes(content)
    with pytest.raises(MapError, match=r"record 1 of its shapes is broken.*coordinate") as caught:
        read_map(path)
    assert caught.value.code == "broken-geometry"


def test_many_repaired_rings_are_one_problem_with_the_worst_named() -> None:
    repairs = [
        Repair(zone=f"zone{i}", reason="Self-intersection", before_m2=10.0, after_m2=10.0 + i)
        for i in (3, 2, 1)
    ]
    (problem,) = repair_problems(repairs)
    assert problem.where == "zone3"
    assert problem.text.startswith(
        "rings of 3 zones cross themselves; the repairs change 6.00 m2 in all, and 3.00 m2"
    )
    assert repair_problems([]) == []
