"""Shapefiles, written by GDAL and then damaged where GDAL would not."""

from __future__ import annotations

import hashlib
import json
import struct
import zipfile
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import shapely
from pyproj import CRS, Geod
from shapely import Geometry, MultiPolygon, Polygon, box

from companion.errors import MapError
from missions.maps import dbf, model
from missions.maps.assemble import Repair, repair_problems
from missions.maps.model import MapFile
from missions.maps.registry import read_area, read_map
from missions.maps.shapefile import read_shapefile

# A degree of latitude is 111.0 km here, a degree of longitude 90.2 km.
WEST, SOUTH = 114.543, 35.996
CELL = 0.0001


def cell(column: int, row: int = 0) -> Polygon:
    west, south = WEST + column * CELL, SOUTH + row * CELL
    return box(west, south, west + CELL, south + CELL)


def write(
    path: Path,
    geometries: Sequence[Geometry | None],
    *,
    crs: str | None = "EPSG:4326",
    geometry_type: str = "Unknown",
    encoding: str | None = None,
    **columns: object,
) -> Path:
    arrays = [np.asarray(values) for values in columns.values()]
    pyogrio.raw.write(
        str(path),
        np.array([shapely.to_wkb(one) for one in geometries], dtype=object),
        [one.astype(object) if one.dtype.kind in "UO" else one for one in arrays],
        list(columns),
        geometry_type=geometry_type,
        crs=crs,
        driver="ESRI Shapefile",
        encoding=encoding,
    )
    return path


def simple(tmp_path: Path, **more: object) -> Path:
    return write(
        tmp_path / "rx.shp",
        [cell(0), cell(1)],
        geometry_type="Polygon",
        rate=np.array([12.5, 0.0]),
        unit=["l/ha", "l/ha"],
        **more,
    )


def codes(map_file: MapFile) -> set[str]:
    return {problem.code for problem in map_file.problems}


def without_prj(path: Path) -> Path:
    path.with_suffix(".prj").unlink()
    return path


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
    assert [zone.rate_l_ha for zone in found.zones] == [1.0, None, 3.0]


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


# Archives and folders


def zipped(folder: Path, inside: str = "", name: str = "rx.zip") -> Path:
    path = folder.parent / name
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(file for file in folder.rglob("*") if file.is_file()):
            archive.write(file, f"{inside}{file.relative_to(folder).as_posix()}")
    return path


@pytest.mark.parametrize("inside", ["", "Rx/", "RX/grower/farm/", "anything/"])
@pytest.mark.parametrize("upper", [False, True])
def test_a_zip_is_read_as_its_files_are(tmp_path: Path, inside: str, upper: bool) -> None:
    folder = tmp_path / "set"
    folder.mkdir()
    path = simple(folder)
    plain = read_shapefile(path)
    if upper:
        for file in sorted(folder.iterdir()):
            file.rename(file.with_suffix(file.suffix.upper()))
    found = read_shapefile(zipped(folder, inside))
    assert (found.sha256, found.columns, found.crs) == (plain.sha256, plain.columns, plain.crs)
    assert found.geometries == plain.geometries
    assert found.problems == ()


def test_a_folder_in_folders_is_searched(tmp_path: Path) -> None:
    deep = tmp_path / "Rx" / "grower" / "farm"
    deep.mkdir(parents=True)
    path = simple(deep)
    assert read_shapefile(tmp_path).sha256 == read_shapefile(path).sha256


def two_layers(tmp_path: Path, first: str, second: str) -> Path:
    """A folder with two shapefiles, the first with a rate of 1, the second with 2."""
    folder = tmp_path / "set"
    for rate, name in ((1.0, first), (2.0, second)):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        write(folder / name, [cell(0)], geometry_type="Polygon", rate=[rate], unit=["L/ha"])
    return folder


def rate_of(path: Path, name: str | None = None) -> object:
    (column,) = [one for one in read_shapefile(path, name).columns if one.name == "rate"]
    return column.values[0]


@pytest.mark.parametrize("pack", [lambda folder: folder, zipped])
def test_a_layer_is_chosen_by_stem_or_place(tmp_path: Path, pack: Callable[[Path], Path]) -> None:
    path = pack(two_layers(tmp_path, "Rx/a.shp", "Rx/b.shp"))
    with pytest.raises(MapError, match="the shapefiles a, b; name one") as caught:
        read_shapefile(path)
    assert caught.value.code == "several-layers"
    for name in ("b", "Rx/b", "Rx/b.shp"):
        assert rate_of(path, name) == 2.0
    with pytest.raises(MapError, match="no layer 'c', but the shapefiles a, b") as caught:
        read_shapefile(path, "c")
    assert caught.value.code == "no-layer"


def test_stems_that_repeat_are_told_apart_by_their_place(tmp_path: Path) -> None:
    path = two_layers(tmp_path, "north/rx.shp", "south/rx.shp")
    with pytest.raises(MapError, match="the shapefiles north/rx, south/rx;") as caught:
        read_shapefile(path)
    assert caught.value.code == "several-layers"
    with pytest.raises(MapError, match="north/rx, south/rx"):
        read_shapefile(path, "rx")
    assert rate_of(path, "south/rx") == 2.0


def test_a_boundary_in_a_folder_of_its_own_is_not_in_the_way(tmp_path: Path) -> None:
    assert rate_of(two_layers(tmp_path, "rx.shp", "boundary/edge.shp")) == 1.0


def test_a_map_in_the_folder_rx_competes_with_one_outside(tmp_path: Path) -> None:
    with pytest.raises(MapError, match="rx, edge") as caught:
        read_shapefile(two_layers(tmp_path, "edge.shp", "Rx/grower/rx.shp"))
    assert caught.value.code == "several-layers"


def test_a_zip_without_a_shapefile_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "set"
    folder.mkdir()
    (folder / "readme.txt").write_text("no map")
    with pytest.raises(MapError) as caught:
        read_shapefile(zipped(folder))
    assert caught.value.code == "unknown-format"


def test_two_tables_for_one_shapefile_are_refused(tmp_path: Path) -> None:
    path = simple(tmp_path)
    (tmp_path / "rx.DBF").write_bytes(path.with_suffix(".dbf").read_bytes())
    with pytest.raises(MapError, match="could both belong to rx") as caught:
        read_shapefile(path)
    assert caught.value.code == "several-files"


def test_a_stem_in_another_case_belongs_to_the_set_if_there_is_no_other(tmp_path: Path) -> None:
    path = simple(tmp_path)
    plain = read_shapefile(path)
    path.with_suffix(".dbf").rename(tmp_path / "RX.DBF")
    assert read_shapefile(path).columns == plain.columns


def metadata(tmp_path: Path, content: object, name: str = "rx-Deere-Metadata.json") -> None:
    text = content if isinstance(content, str) else json.dumps(content)
    (tmp_path / name).write_text(text, "utf-8")


def units(path: Path) -> dict[str, str | None]:
    return {column.name: column.unit for column in read_shapefile(path).columns}


@pytest.mark.parametrize("name", ["rx-Deere-Metadata.json", "RX-metadata.JSON"])
def test_units_come_from_the_metadata_beside(tmp_path: Path, name: str) -> None:
    path = write(
        tmp_path / "rx.shp", [cell(0)], geometry_type="Polygon", TargetRate=[15.0], Moisture=[1.0]
    )
    before = read_shapefile(path)
    assert units(path) == {"TargetRate": None, "Moisture": None}
    attributes = [
        {"Name": "TargetRateLiquid", "Unit": "gal1ac-1"},
        {"Name": "Moisture", "Unit": ""},
        {"Name": "Other", "Unit": "ha"},
    ]
    metadata(tmp_path, {"Version": "1.0", "DataAttributes": attributes}, name)
    assert units(path) == {"TargetRate": "gal1ac-1", "Moisture": None}
    assert read_shapefile(path).sha256 != before.sha256


@pytest.mark.parametrize(
    "content",
    [
        "",
        "{",
        "[" * 100_000,
        [],
        {"DataAttributes": {"Name": "rate"}},
        {"DataAttributes": [1, None, {"Name": 3, "Unit": "l"}, {"Name": "rate", "Unit": 3}]},
        {"DataAttributes": [{"Name": "rate", "Unit": "l1ha-1"}, {"Name": "RATE", "Unit": "gal"}]},
    ],
)
def test_metadata_that_says_nothing_clear_gives_no_unit(tmp_path: Path, content: object) -> None:
    path = simple(tmp_path)
    metadata(tmp_path, content)
    assert units(path)["rate"] is None


# The attribute table


def table(
    path: Path,
    columns: Sequence[tuple[bytes, bytes, int]],
    rows: Sequence[Sequence[bytes]],
    *,
    driver: int = 0,
    cpg: bytes | None = None,
) -> Path:
    """Write a shapefile whose table is made by hand, column by column and byte by byte."""
    write(
        path,
        [cell(index) for index in range(len(rows))],
        geometry_type="Polygon",
        n=range(len(rows)),
    )
    header = 33 + 32 * len(columns)
    width = 1 + sum(size for _, _, size in columns)
    content = struct.pack("<B3BLHH17xB2x", 3, 100, 1, 1, len(rows), header, width, driver)
    for name, kind, size in columns:
        content += struct.pack("<11sc4xB15x", name, kind, size)
    content += b"\r"
    for row in rows:
        content += b" " + b"".join(
            one.ljust(size)[:size] for one, (_, _, size) in zip(row, columns, strict=True)
        )
    path.with_suffix(".dbf").write_bytes(content + b"\x1a")
    path.with_suffix(".cpg").unlink(missing_ok=True)
    if cpg is not None:
        path.with_suffix(".cpg").write_bytes(cpg)
    return path


def columns_of(path: Path) -> dict[str, tuple[object, ...]]:
    return {column.name: column.values for column in read_shapefile(path).columns}


ENCODED = [
    ("gbk", b"GBK", 0, "\u5730\u5757"),
    ("gbk", b"936", 0, "\u5730\u5757"),
    ("gbk", None, 0x4D, "\u5730\u5757"),
    ("utf-8", b"UTF-8", 0x57, "\u5730\u5757"),
    ("utf-8", b"\xef\xbb\xbfUTF-8\r\n", 0, "\u5730\u5757"),
    ("utf-8", None, 0, "\u5730\u5757"),
    ("cp949", b"CP949", 0, "\ub17c"),
    ("cp949", b"EUC-KR", 0, "\ub17c"),
    ("cp949", None, 0x4E, "\ub17c"),
    ("cp932", b"932", 0, "\u7551"),
    ("cp932", b"Shift_JIS", 0, "\u7551"),
    ("cp932", None, 0x13, "\u7551"),
    ("big5", b"Big5", 0, "\u7530"),
    ("cp1252", b"ANSI 1252", 0, "Gr\u00fcn \u2013 S\u00fcd"),
    ("cp1252", b"1252", 0, "Gr\u00fcn \u2013 S\u00fcd"),
    ("cp1252", None, 0x57, "Gr\u00fcn \u2013 S\u00fcd"),
    ("iso8859-1", b"ISO 88591", 0, "Gr\u00fcn"),
    ("iso8859-15", b"ISO-8859-15", 0, "5 \u20ac"),
    ("cp1251", None, 0xC9, "\u043f\u043e\u043b\u0435"),
    ("cp866", b"OEM 866", 0, "\u043f\u043e\u043b\u0435"),
]


@pytest.mark.parametrize(("encoding", "cpg", "driver", "text"), ENCODED)
def test_texts_are_read_in_the_encoding_that_the_set_declares(
    tmp_path: Path, encoding: str, cpg: bytes | None, driver: int, text: str
) -> None:
    raw = text.encode(encoding)
    path = table(
        tmp_path / "rx.shp",
        [(raw, b"C", 30), (b"rate", b"N", 8)],
        [[raw, b"    12.5"]],
        driver=driver,
        cpg=cpg,
    )
    found = read_shapefile(path)
    assert columns_of(path) == {text: (text,), "rate": (12.5,)}
    assert found.problems == ()


@pytest.mark.parametrize(
    "cpg", [None, b"", b"no-such", b"rot13", b"zlib", b"utf-16", b"utf-7", b"037"]
)
def test_texts_without_a_known_encoding_are_a_warning_and_numbers_are_right(
    tmp_path: Path, cpg: bytes | None
) -> None:
    path = table(
        tmp_path / "rx.shp",
        [(b"name", b"C", 10), (b"plain", b"C", 10), (b"rate", b"N", 8)],
        [["\u5730\u5757".encode("gbk"), b"a", b"12.5"]],
        cpg=cpg,
    )
    found = read_shapefile(path)
    (problem,) = found.problems
    assert (problem.severity, problem.code, problem.where) == (
        "warning",
        "encoding",
        "rx.dbf: name",
    )
    assert ".cpg" in problem.fix
    assert "not all in" not in problem.text  # what nobody knows is not what the file declares
    assert columns_of(path)["rate"] == (12.5,)
    assert columns_of(path)["plain"] == ("a",)


def test_texts_in_another_encoding_than_declared_are_a_warning(tmp_path: Path) -> None:
    path = table(
        tmp_path / "rx.shp",
        [(b"name", b"C", 10), (b"rate", b"N", 8)],
        [["S\u00fcd-Ost".encode("latin-1"), b"12.5"]],
        cpg=b"UTF-8",
    )
    assert [problem.code for problem in read_shapefile(path).problems] == ["encoding"]
    assert columns_of(path)["name"] == ("S\ufffdd-Ost",)


@pytest.mark.parametrize("cpg", [b"UTF-8", None])
def test_a_letter_cut_in_two_by_the_width_of_a_column_is_left_out(
    tmp_path: Path, cpg: bytes | None
) -> None:
    raw = ("\u5730" * 4).encode()
    path = table(
        tmp_path / "rx.shp", [(raw[:10], b"C", 10), (b"rate", b"N", 8)], [[raw, b"1"]], cpg=cpg
    )
    assert columns_of(path) == {"\u5730" * 3: ("\u5730" * 3,), "rate": (1.0,)}
    assert read_shapefile(path).problems == ()


@pytest.mark.parametrize(
    ("cell_bytes", "value"),
    [
        (b"", None),
        (b"********", None),
        (b"\0\0\0", None),
        (b"nan", None),
        (b"NaN", None),
        (b"0", 0.0),
        (b"-.5", -0.5),
        (b"+12.", 12.0),
        (b"1.25e+01", 12.5),
        (b"12.5\0zz", 12.5),
        (b"12,5", "12,5"),
        (b"1_0", "1_0"),
        (b"inf", "inf"),
        (b"-1.#IND", "-1.#IND"),
        (b"1 2", "1 2"),
        (b"0x10", "0x10"),
    ],
)
@pytest.mark.parametrize("kind", [b"N", b"F"])
def test_a_number_is_a_number_a_blank_is_none_and_the_rest_stays_text(
    tmp_path: Path, kind: bytes, cell_bytes: bytes, value: object
) -> None:
    path = table(tmp_path / "rx.shp", [(b"rate", kind, 8)], [[cell_bytes]])
    (column,) = read_shapefile(path).columns
    assert (column.numeric, column.values) == (True, (value,))


@pytest.mark.parametrize(
    ("kind", "size", "cell_bytes", "value"),
    [
        (b"L", 1, b"T", "T"),
        (b"L", 1, b"?", None),
        (b"D", 8, b"20240501", "20240501"),
        (b"D", 8, b"00000000", None),
        (b"D", 8, b"", None),
        (b"M", 10, b"       512", "(field of type M)"),
        (b"M", 10, b"", None),
        (b"I", 4, b"\x0c\1\2\3", "(field of type I)"),
        (b"O", 8, b"\x40\x29\1\1\1\1\1\1", "(field of type O)"),
        (b"C", 0, b"", None),
    ],
)
def test_other_columns_are_no_numbers(
    tmp_path: Path, kind: bytes, size: int, cell_bytes: bytes, value: object
) -> None:
    path = table(
        tmp_path / "rx.shp", [(b"a", kind, size), (b"rate", b"N", 4)], [[cell_bytes, b"12.5"]]
    )
    first, second = read_shapefile(path).columns
    assert (first.numeric, first.values, second.values) == (False, (value,), (12.5,))


@pytest.mark.parametrize(
    ("at", "fmt", "value"),
    [
        (4, "<L", 3),
        (4, "<L", 2**32 - 1),
        (8, "<H", 0),
        (8, "<H", 32),
        (8, "<H", 66),
        (8, "<H", 64),
        (8, "<H", 60_000),
        (10, "<H", 0),
        (10, "<H", 4),
        (10, "<H", 8),
        (48, "<B", 200),
    ],
)
def test_a_table_whose_header_lies_is_refused(
    tmp_path: Path, at: int, fmt: str, value: int
) -> None:
    path = table(tmp_path / "rx.shp", [(b"rate", b"N", 8)], [[b"12.5"], [b"7"]])
    dbf = path.with_suffix(".dbf")
    content = bytearray(dbf.read_bytes())
    struct.pack_into(fmt, content, at, value)
    dbf.write_bytes(content)
    with pytest.raises(MapError) as caught:
        read_shapefile(path)
    assert caught.value.code in ("truncated", "table-mismatch", "unusable", "too-large")


def test_more_cells_than_any_map_has_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = table(tmp_path / "rx.shp", [(b"a", b"N", 1), (b"b", b"N", 1)], [[b"1", b"2"]] * 3)
    monkeypatch.setattr(dbf, "_CELLS_MAX", 6)
    assert read_shapefile(path)
    monkeypatch.setattr(dbf, "_CELLS_MAX", 5)
    with pytest.raises(MapError) as caught:
        read_shapefile(path)
    assert caught.value.code == "too-large"


# Shapes


@pytest.mark.parametrize("suffix", [".shp", ".shx"])
def test_a_file_shorter_than_its_header_says_is_refused_even_at_a_whole_record(
    tmp_path: Path, suffix: str
) -> None:
    path = simple(tmp_path)
    path.with_suffix(".dbf").unlink()
    if suffix == ".shp":
        path.with_suffix(".shx").unlink()
    file = path.with_suffix(suffix)
    file.write_bytes(file.read_bytes()[: 100 + (8 + 128 if suffix == ".shp" else 8)])
    with pytest.raises(MapError, match="cut off") as caught:
        read_shapefile(path)
    assert caught.value.code == "truncated"


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (bytes(range(256)), "this is no .shp file"),
        (bytes(500), "this is no .shp file"),
        (b"PK", "this is no .shp file"),
        (b"", "the file is empty"),
    ],
    ids=["other", "zeros", "short", "empty"],
)
def test_what_is_no_shapefile_is_to_be_copied_or_exported_again(
    tmp_path: Path, content: bytes, says: str
) -> None:
    path = simple(tmp_path)
    path.write_bytes(content)
    with pytest.raises(MapError, match=says) as caught:
        read_shapefile(path)
    assert caught.value.code == "truncated"
    assert caught.value.fix == "copy the whole set of files, or export the map again"


def test_bytes_behind_the_last_record_do_no_harm(tmp_path: Path) -> None:
    path = simple(tmp_path)
    plain = read_shapefile(path)
    path.write_bytes(path.read_bytes() + bytes(50))
    assert read_shapefile(path).geometries == plain.geometries


@pytest.mark.parametrize(
    ("at", "value", "code"),
    [
        (0, 99, "broken-geometry"),  # a shape of no known type
        (36, -1, "truncated"),  # rings
        (36, 2**30, "truncated"),
        (40, -1, "truncated"),  # points
        (40, 2**30, "truncated"),
        (44, 1, "broken-geometry"),  # the first point of the first ring
    ],
)
def test_a_record_that_contradicts_itself_is_refused(
    tmp_path: Path, at: int, value: int, code: str
) -> None:
    path = simple(tmp_path)
    content = bytearray(path.read_bytes())
    struct.pack_into("<i", content, 108 + at, value)
    path.write_bytes(content)
    with pytest.raises(MapError, match="record 1 of its shapes is broken") as caught:
        read_shapefile(path)
    assert caught.value.code == code


@pytest.mark.parametrize("words", [0, -100, 49, 10**6, 2**31 - 1])
def test_an_index_that_leads_nowhere_is_refused(tmp_path: Path, words: int) -> None:
    path = simple(tmp_path)
    shx = path.with_suffix(".shx")
    content = bytearray(shx.read_bytes())
    struct.pack_into(">i", content, 108, words)
    shx.write_bytes(content)
    with pytest.raises(MapError, match="record 2 of its shapes is broken") as caught:
        read_shapefile(path)
    assert caught.value.code == "truncated"


def test_a_ring_without_an_area_is_left_out(tmp_path: Path) -> None:
    flat = Polygon([(WEST, SOUTH), (WEST + CELL, SOUTH), (WEST + 2 * CELL, SOUTH), (WEST, SOUTH)])
    path = write(tmp_path / "rx.shp", [flat, cell(0)], geometry_type="Polygon", rate=[1.0, 2.0])
    found = read_shapefile(path)
    assert found.skipped == {0: "no-area"}
    assert found.geometries[0] is None


def test_one_shape_named_many_times_counts_each_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = simple(tmp_path)
    shx = path.with_suffix(".shx")
    content = bytearray(shx.read_bytes()[:108] + shx.read_bytes()[100:108] * 9)
    content[24:28] = struct.pack(">i", len(content) // 2)
    shx.write_bytes(content)
    monkeypatch.setattr(model, "MAX_VERTICES", 49)
    with pytest.raises(MapError, match="50 vertices are more than 49"):
        read_shapefile(path)


# Coordinate reference systems

UTM_50 = (
    'PROJCS["WGS_1984_UTM_Zone_50N",GEOGCS["GCS_WGS_1984",DATUM["D_WGS_1984",'
    'SPHEROID["WGS_1984",6378137.0,298.257223563]],PRIMEM["Greenwich",0.0],'
    'UNIT["Degree",0.0174532925199433]],PROJECTION["Transverse_Mercator"],'
    'PARAMETER["False_Easting",500000.0],PARAMETER["False_Northing",0.0],'
    'PARAMETER["Central_Meridian",117.0],PARAMETER["Scale_Factor",0.9996],'
    'PARAMETER["Latitude_Of_Origin",0.0],UNIT["Meter",1.0]]'
)
SQUARE_M = box(278_000, 3_986_000, 278_400, 3_986_100)


def metres(tmp_path: Path, prj: str | None, ground: Geometry = SQUARE_M) -> Path:
    path = write(tmp_path / "rx.shp", [ground], geometry_type="Polygon", rate=[1.0], unit=["L/ha"])
    path.with_suffix(".prj").unlink()
    if prj is not None:
        path.with_suffix(".prj").write_text(prj)
    return path


@pytest.mark.parametrize(
    "prj", [UTM_50, CRS.from_epsg(32650).to_wkt("WKT1_GDAL"), CRS.from_epsg(32650).to_wkt()]
)
def test_every_dialect_of_a_prj_says_the_same(tmp_path: Path, prj: str) -> None:
    found = read_map(metres(tmp_path, prj))
    assert found.crs == "EPSG:32650"
    assert found.zones[0].geometry.bounds[0] == pytest.approx(117 - 222 / 90.2, abs=0.01)
    assert found.problems == ()


@pytest.mark.parametrize(
    ("prj", "crs"),
    [
        ('GEOGCS["GCS_WGS_1984",DATUM["D_WGS_1984",SPHEROID["WGS_1984",6378137.0,298.257223563]],'
         'PRIMEM["Greenwich",0.0],UNIT["Degree",0.0174532925199433]]', "EPSG:4326"),
        ("EPSG:4326", "EPSG:4326"),
    ],
)  # fmt: skip
def test_degrees_of_wgs84_need_no_word(tmp_path: Path, prj: str, crs: str) -> None:
    path = simple(tmp_path)
    path.with_suffix(".prj").write_text(prj)
    found = read_map(path)
    assert (found.crs, found.problems) == (crs, ())


@pytest.mark.parametrize(
    "prj", ["+init=epsg:4326", "+init=/etc/passwd:1", "EPSG:4978", "EPSG:4326" + " " * 10**5]
)
def test_a_prj_that_is_of_no_map_is_refused(tmp_path: Path, prj: str) -> None:
    path = simple(tmp_path)
    path.with_suffix(".prj").write_text(prj)
    with pytest.raises(MapError, match="not a usable coordinate reference system") as caught:
        read_map(path)
    assert caught.value.code == "wrong-crs"


def test_a_damaged_prj_is_not_repeated_in_the_refusal(tmp_path: Path) -> None:
    path = simple(tmp_path)
    prj = path.with_suffix(".prj")
    prj.write_text(prj.read_text()[:60])
    with pytest.raises(MapError) as caught:
        read_map(path)
    assert caught.value.code == "wrong-crs"
    assert "coordinate reference system (it is unknown or damaged);" in str(caught.value)
    assert "GEOGCS" not in str(caught.value)


def test_east_and_north_exchanged_are_refused(tmp_path: Path) -> None:
    turned = box(3_986_000, 278_000, 3_986_100, 278_400)
    with pytest.raises(MapError, match="look exchanged") as caught:
        read_map(metres(tmp_path, UTM_50, turned))
    assert caught.value.code == "swapped-axes"


def test_latitude_first_is_refused_where_the_crs_is_not_used(tmp_path: Path) -> None:
    path = simple(tmp_path)
    write(
        path,
        [box(48.0, 11.0, 48.001, 11.001)],  # Bavaria, turned round: a valid place in Yemen
        crs="EPSG:4258",
        geometry_type="Polygon",
        rate=[1.0],
        unit=["L/ha"],
    )
    with pytest.raises(MapError, match="look exchanged") as caught:
        read_map(path)
    assert caught.value.code == "swapped-axes"


def test_a_map_a_little_beyond_where_its_crs_is_used_is_not_turned_round(tmp_path: Path) -> None:
    path = write(
        tmp_path / "rx.shp",
        [box(40.0, 37.0, 40.001, 37.001)],  # EPSG:4258 is meant for up to 38 degrees east
        crs="EPSG:4258",
        geometry_type="Polygon",
        rate=[1.0],
        unit=["L/ha"],
    )
    assert read_map(path).zones[0].geometry.bounds[0] == pytest.approx(40.0)


def test_degrees_under_a_prj_in_metres_are_refused(tmp_path: Path) -> None:
    with pytest.raises(MapError, match="look like degrees") as caught:
        read_map(metres(tmp_path, UTM_50, cell(0)))
    assert caught.value.code == "wrong-crs"


def test_a_map_far_from_where_its_crs_is_used_is_refused(tmp_path: Path) -> None:
    path = metres(tmp_path, CRS.from_epsg(28354).to_wkt("WKT1_ESRI"))
    with pytest.raises(MapError, match="EPSG:28354, which is meant for x 138") as caught:
        read_map(path)
    assert caught.value.code == "wrong-crs"


def test_a_map_drawn_in_the_next_zone_is_read(tmp_path: Path) -> None:
    ground = box(1_100_000, 3_986_000, 1_100_400, 3_986_100)
    assert read_map(metres(tmp_path, UTM_50, ground)).zones[0].geometry.bounds[0] > 123.0


def test_metres_without_a_prj_are_called_so(tmp_path: Path) -> None:
    with pytest.raises(MapError, match=r"no \.prj.*look like metres.*--crs") as caught:
        read_map(metres(tmp_path, None))
    assert caught.value.code == "no-crs"


@pytest.mark.parametrize("name", ["Point", "PolyLine", "MultiPoint", "MultiPatch"])
def test_every_other_shape_is_named(tmp_path: Path, name: str) -> None:
    kinds = {"Point": 1, "PolyLine": 3, "MultiPoint": 8, "MultiPatch": 31}
    path = simple(tmp_path)
    content = bytearray(path.read_bytes())
    struct.pack_into("<i", content, 108, kinds[name])
    path.write_bytes(content)
    found = read_shapefile(path)
    assert found.skipped == {0: f"not-a-polygon:{name}"}
    assert found.geometries[0] is None


def test_the_real_maps_are_read_from_a_zip_as_from_their_folder(
    samples: Path, tmp_path: Path
) -> None:
    folder = samples / "01_shp_lha_multipolygon"
    path = tmp_path / "01.zip"
    with zipfile.ZipFile(path, "w") as archive:
        for file in sorted(folder.rglob("*.*")):
            archive.write(file, f"Rx/{file.relative_to(folder)}")
    with pytest.raises(MapError, match="Boundary") as caught:
        read_shapefile(path)
    assert caught.value.code == "several-layers"
    found = read_shapefile(path, "Rx")
    assert found.sha256 == read_shapefile(folder).sha256
    assert found.problems == ()
    parts = [
        part for area in found.geometries if area is not None for part in shapely.get_parts(area)
    ]
    assert len(parts) == 527


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
