"""ISOXML grids, fields and files are read as they stand, or refused with the right code."""

from __future__ import annotations

import hashlib
import zipfile
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import shapely
from shapely import Polygon, box

from companion.errors import MapError
from missions.maps.isoxml.reader import read_isoxml
from missions.maps.model import Grid, Layer
from missions.maps.registry import read_map
from tests.missions.isoxml_documents import (
    HEAD,
    HOLED,
    LEFT,
    RIGHT,
    SOUTH,
    TWO,
    TYPE_2,
    VPN,
    WEST,
    codes,
    document,
    field,
    grid,
    ints,
    polygon,
    read_grid,
    read_layer,
    refusal,
    task,
    value,
    write,
    zone,
)

# --- grids


def test_grid_of_values_starts_in_the_south_west(tmp_path: Path) -> None:
    found = read_grid(
        tmp_path,
        VPN,
        task(TYPE_2, grid(2, 2, 3, J="0", H="24"), more='H="0"'),
        content=ints(10_000, 20_000, 30_000, 40_000, 50_000, 0),
    )
    (band,) = found.bands
    assert band.values.tolist() == [[1.0, 2.0, 3.0], [4.0, 5.0, 0.0]]
    assert (band.name, band.unit, band.is_rate, band.default) == ("DDI 0001", "L/ha", True, 0.0)
    a, b, c, d, e, f = found.transform
    assert (a, b, c) == (0.002, 0.0, WEST)
    assert (d, e, f) == (0.0, 0.001, SOUTH)
    assert found.problems == ()


def test_grid_of_several_values_is_interleaved(tmp_path: Path) -> None:
    products = '<PDT A="PDT1" B="Roundup"/><PDT A="PDT2" B="Water"/>'
    template = zone(
        5, value(0, more='C="PDT1"'), value(0, "0002"), value(0, more='C="PDT2"')
    )  # fmt: skip
    found = read_grid(
        tmp_path,
        products,
        task(zone(0, value(90_000, more='C="PDT2"')), template, grid(2, 1, 2, J="5"), more='H="0"'),
        content=ints(10_000, 7, 30_000, 20_000, 7, 40_000),
    )
    assert [(b.name, b.values.tolist(), b.default) for b in found.bands] == [
        ("Roundup", [[1.0, 2.0]], None),
        ("Water", [[3.0, 4.0]], 9.0),
    ]
    assert codes(found) == ["value-ignored"]


def test_grid_of_codes_takes_the_values_of_its_zones(tmp_path: Path) -> None:
    zones = (zone(1, value(10_000)), zone(7, value(20_000)), zone(200))
    found = read_grid(
        tmp_path, VPN, task(*zones, grid(1, 2, 2)), content=bytes((1, 7, 200, 1))
    )  # fmt: skip
    np.testing.assert_array_equal(found.bands[0].values, [[1.0, 2.0], [np.nan, 1.0]])
    assert len(found.bands) == 1


def test_codes_without_a_zone_are_refused_and_counted(tmp_path: Path) -> None:
    error = refusal(
        tmp_path, task(zone(1, value(1)), grid(1, 2, 2)), GRD00001=bytes((1, 7, 9, 9))
    )  # fmt: skip
    assert error.code == "undefined-code"
    assert "3 of 4 cells" in str(error)
    assert "7, 9" in str(error)


@pytest.mark.parametrize(
    ("kind", "length"), [(1, 3), (1, 5), (1, 0), (2, 15), (2, 17), (2, 4), (2, 32)]
)
def test_binary_of_wrong_length_is_refused(tmp_path: Path, kind: int, length: int) -> None:
    error = refusal(
        tmp_path, task(TYPE_2, grid(kind, 2, 2, J="0", H=f"{length}")), GRD00001=bytes(length)
    )
    assert error.code == "binary-length"
    assert f"has {length} bytes" in str(error)
    assert f"are {4 if kind == 1 else 16}" in str(error)


def test_wrong_declared_length_of_a_right_binary_is_told(tmp_path: Path) -> None:
    found = read_grid(
        tmp_path, VPN, task(TYPE_2, grid(1, 2, 2, H="22896")), content=bytes(4)
    )  # fmt: skip
    assert codes(found) == ["binary-length"]
    assert found.problems[0].severity == "warning"


@pytest.mark.parametrize(
    ("changed", "code"),
    [
        ({"J": "4"}, "undefined-code"),
        ({"I": "3"}, "bad-attribute"),
        ({"I": ""}, "bad-attribute"),
        ({"E": "0"}, "bad-attribute"),
        ({"F": "-1"}, "bad-attribute"),
        ({"C": "0"}, "bad-attribute"),
        ({"D": "nan"}, "bad-attribute"),
        ({"A": "91"}, "out-of-range"),
        ({"A": "89.9999"}, "out-of-range"),
        ({"B": "179.9999"}, "out-of-range"),
        ({"G": "../GRD00001"}, "bad-attribute"),
        ({"G": "GRD00002"}, "no-file"),
        ({"E": "1000000", "F": "1000000", "C": "1e-9", "D": "1e-9"}, "too-large"),
    ],
)
def test_impossible_grids_are_refused(tmp_path: Path, changed: dict[str, str], code: str) -> None:
    given = grid(2, 2, 2, **({"J": "0"} | changed))
    assert refusal(tmp_path, task(TYPE_2, given), GRD00001=bytes(16)).code == code


def test_grid_of_values_has_to_name_its_zone(tmp_path: Path) -> None:
    error = refusal(tmp_path, task(TYPE_2, grid(2, 1, 1)), GRD00001=bytes(4))
    assert error.code == "undefined-code"


def test_grid_and_polygons_in_one_task_are_refused(tmp_path: Path) -> None:
    error = refusal(tmp_path, task(*TWO, grid(1, 1, 1)), GRD00001=bytes(1))
    assert error.code == "grid-and-zones"


def test_two_grids_in_one_task_are_refused(tmp_path: Path) -> None:
    both = grid(1, 1, 1) + grid(1, 1, 1, G="GRD00002")
    assert refusal(tmp_path, task(TYPE_2, both)).code == "several-layers"


def test_presentation_of_a_grid_is_compared_with_its_values(tmp_path: Path) -> None:
    wrong = VPN.replace("0.0001", "0.01")
    inside = (wrong, task(TYPE_2, grid(2, 1, 2, J="0")))
    assert refusal(tmp_path, *inside, GRD00001=ints(0, 490_000)).code == "unit-conflict"


# --- field


def grid_in(tmp_path: Path, ground: Polygon, *, content: bytes | None = None) -> Grid:
    """Read a grid of 10 x 10 cells, 0.02 degrees east and 0.01 north, in a task for a field."""
    return read_grid(
        tmp_path,
        field(ground),
        VPN,
        task(TYPE_2, grid(2, 10, 10, J="0"), more='E="PFD1"'),
        content=ints(*[10_000] * 100) if content is None else content,
    )


def test_outline_of_the_field_comes_with_its_holes(tmp_path: Path) -> None:
    found = read_layer(tmp_path, VPN, field(HOLED), task(*TWO, more='E="PFD1"'))
    assert found.boundary is not None
    assert found.boundary.symmetric_difference(HOLED).area < 1e-12


def test_grid_in_its_field_raises_nothing(tmp_path: Path) -> None:
    found = grid_in(tmp_path, box(WEST, SOUTH, WEST + 0.02, SOUTH + 0.01))
    assert found.problems == ()
    assert found.boundary is not None


def test_grid_elsewhere_is_an_error(tmp_path: Path) -> None:
    found = grid_in(tmp_path, box(WEST + 1, SOUTH, WEST + 1.02, SOUTH + 0.01))
    assert [(one.severity, one.code) for one in found.problems] == [("error", "grid-outside-field")]


def test_grid_that_covers_half_of_its_field_is_told(tmp_path: Path) -> None:
    found = grid_in(tmp_path, box(WEST, SOUTH, WEST + 0.04, SOUTH + 0.01))
    assert [(one.severity, one.code) for one in found.problems] == [
        ("warning", "grid-outside-field")
    ]
    assert "50 %" in found.problems[0].text


def test_cells_to_spray_outside_the_field_are_told_but_zeros_are_not(tmp_path: Path) -> None:
    half = box(WEST, SOUTH, WEST + 0.01, SOUTH + 0.01)
    found = grid_in(tmp_path, half)
    assert codes(found) == ["grid-outside-field"]
    closed = ints(*([10_000] * 5 + [0] * 5) * 10)
    assert grid_in(tmp_path, half, content=closed).problems == ()


def test_grid_with_axes_exchanged_is_refused(tmp_path: Path) -> None:
    ground = box(SOUTH, WEST, SOUTH + 0.01, WEST + 0.02)
    with pytest.raises(MapError) as caught:
        grid_in(tmp_path, ground)
    assert caught.value.code == "swapped-axes"


def test_field_that_the_file_lacks_is_told(tmp_path: Path) -> None:
    found = read_layer(tmp_path, VPN, task(*TWO, more='E="PFD9"'))
    assert found.boundary is None
    assert codes(found) == ["undefined-code"]


def test_obstacles_of_the_field_are_told(tmp_path: Path) -> None:
    found = read_layer(
        tmp_path, VPN, field(LEFT, more=polygon(RIGHT, 6)), task(*TWO, more='E="PFD1"')
    )
    assert codes(found) == ["field-objects"]
    assert found.boundary is not None
    assert found.boundary.area == pytest.approx(LEFT.area)


@pytest.mark.parametrize("kind", [3, 4, 5, 6, 12], ids=["water", "house", "road", "other", "trees"])
def test_obstacles_of_the_field_are_taken_out_of_it(tmp_path: Path, kind: int) -> None:
    west, south, east, north = LEFT.bounds
    pond = box(west, south, (west + east) / 2, (south + north) / 2)
    found = read_layer(
        tmp_path, VPN, field(LEFT, more=polygon(pond, kind)), task(*TWO, more='E="PFD1"')
    )
    assert codes(found) == ["field-objects"]
    assert "taken out of the ground to spray, 25 % of it" in found.problems[0].text
    assert found.boundary is not None
    assert found.boundary.area == pytest.approx(0.75 * LEFT.area)
    assert not found.boundary.intersects(pond.buffer(-1e-6))


def test_headland_of_the_field_is_no_obstacle(tmp_path: Path) -> None:
    found = read_layer(
        tmp_path, VPN, field(LEFT, more=polygon(LEFT, 10)), task(*TWO, more='E="PFD1"')
    )
    assert "not taken out" in found.problems[0].text
    assert found.boundary is not None
    assert found.boundary.area == pytest.approx(LEFT.area)


def test_a_field_that_is_all_obstacle_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MapError, match="cover the whole field"):
        read_layer(tmp_path, VPN, field(LEFT, more=polygon(LEFT, 3)), task(*TWO, more='E="PFD1"'))


def test_an_obstacle_on_a_zone_is_no_ground_of_it(tmp_path: Path) -> None:
    west, south, east, north = LEFT.bounds
    pond = box(west, south, (west + east) / 2, north)
    found = read_layer(tmp_path, VPN, task(zone(3, polygon(LEFT), polygon(pond, 3), value(10))))
    assert found.geometries[0] is not None
    assert found.geometries[0].area == pytest.approx(LEFT.area / 2)


def test_outline_that_crosses_itself_is_refused(tmp_path: Path) -> None:
    bow = Polygon([(15, 48), (15.01, 48.01), (15.01, 48), (15, 48.01)])
    error = refusal(tmp_path, VPN, field(bow), task(*TWO, more='E="PFD1"'))
    assert error.code == "broken-geometry"


# --- files


GRID_TASK = document(VPN, task(TYPE_2, grid(2, 1, 2, J="0")))
PLACES = {
    "upper": ("TASKDATA.XML", "GRD00001.BIN"),
    "lower": ("taskdata.xml", "grd00001.bin"),
    "folder": ("TASKDATA/TASKDATA.XML", "TASKDATA/GRD00001.bin"),
    "deep": ("stick/TaskData/Taskdata.Xml", "stick/TaskData/Grd00001.Bin"),
}


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("packed", [False, True], ids=["folder", "zip"])
def test_folder_and_zip_with_names_in_any_case(tmp_path: Path, place: str, packed: bool) -> None:
    xml, binary = PLACES[place]
    files = {xml: GRID_TASK, binary: ints(10_000, 20_000)}
    path = tmp_path / ("map.zip" if packed else "map")
    if packed:
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, content in files.items():
                archive.writestr(name, content)
    else:
        write(path, files)
    found = read_isoxml(path)
    assert isinstance(found, Grid)
    assert found.bands[0].values.tolist() == [[1.0, 2.0]]
    digest = hashlib.sha256(b"".join(files[name] for name in sorted(files)))
    assert found.sha256 == digest.hexdigest()


def test_task_data_itself_under_any_name(tmp_path: Path) -> None:
    write(tmp_path, {"my field.xml": GRID_TASK, "GRD00001.BIN": ints(10_000, 20_000), "x": b""})
    found = read_isoxml(tmp_path / "my field.xml")
    assert isinstance(found, Grid)
    assert found.bands[0].values.tolist() == [[1.0, 2.0]]


def test_two_task_data_beside_each_other_are_refused(tmp_path: Path) -> None:
    write(tmp_path, {f"{name}/TASKDATA.XML": document(task(*TWO)) for name in "ab"})
    with pytest.raises(MapError) as caught:
        read_isoxml(tmp_path)
    assert caught.value.code == "several-sets"


def test_two_grids_of_one_name_in_different_case_are_refused(tmp_path: Path) -> None:
    write(
        tmp_path,
        {"TASKDATA.XML": GRID_TASK, "GRD00001.BIN": ints(1, 2), "grd00001.bin": ints(3, 4)},
    )
    with pytest.raises(MapError) as caught:
        read_isoxml(tmp_path)
    assert caught.value.code == "duplicate-code"


def external(*inside: str) -> bytes:
    return f"{HEAD}<XFC>{''.join(inside)}</XFC>".encode()


def test_external_files_are_merged(tmp_path: Path) -> None:
    files = {
        "TASKDATA.XML": document('<XFR A="TSK00001" B="1"/>', '<XFR A="VPN00001" B="1"/>'),
        "tsk00001.xml": external(task(*TWO)),
        "VPN00001.XML": external(VPN.replace("0.0001", "0.01")),
    }
    with pytest.raises(MapError) as caught:
        read_isoxml(write(tmp_path, files))
    assert caught.value.code == "unit-conflict"
    found = read_isoxml(write(tmp_path, files | {"VPN00001.XML": external(VPN)}))
    assert isinstance(found, Layer)
    assert found.columns[1].values == (150.0, 0.0)
    assert found.problems == ()


@pytest.mark.parametrize(
    ("files", "code"),
    [
        ({}, "no-file"),
        ({"TSK00001.XML": b"<XFC><TSK A='TSK1'>"}, "truncated"),
        ({"TSK00001.XML": b"<TSK/>"}, "unknown-format"),
        ({"TSK00001.XML": b"<!DOCTYPE x [<!ENTITY a 'b'>]><XFC>&a;</XFC>"}, "xml-unsafe"),
    ],
)
def test_external_files_that_cannot_be_used(
    tmp_path: Path, files: dict[str, bytes], code: str
) -> None:
    write(tmp_path, {"TASKDATA.XML": document('<XFR A="TSK00001" B="1"/>')} | files)
    with pytest.raises(MapError) as caught:
        read_isoxml(tmp_path)
    assert caught.value.code == code


@pytest.mark.parametrize("name", ["../secret", "a/b", "TSK00001.XML/..", "C:x"])
def test_external_file_elsewhere_is_refused(tmp_path: Path, name: str) -> None:
    assert refusal(tmp_path, f'<XFR A="{name}" B="1"/>').code == "bad-attribute"


@pytest.mark.parametrize("encoding", ["ISO-8859-1", "windows-1252", "UTF-16", "UTF-8"])
def test_text_comes_in_the_declared_encoding(tmp_path: Path, encoding: str) -> None:
    head = f'<?xml version="1.0" encoding="{encoding}"?>'
    text = document(VPN, task(*TWO), head=head.replace(encoding, "utf8")).decode()
    write(tmp_path, {"TASKDATA.XML": text.replace("utf8", encoding).encode(encoding)})
    found = read_isoxml(tmp_path)
    assert isinstance(found, Layer)
    assert found.columns[0].values[0] == "Süd"


def test_byte_order_mark_is_no_matter(tmp_path: Path) -> None:
    write(tmp_path, {"TASKDATA.XML": b"\xef\xbb\xbf" + document(task(*TWO))})
    assert isinstance(read_isoxml(tmp_path), Layer)


@pytest.mark.parametrize(
    ("content", "code"),
    [
        (b"", "truncated"),
        (document(task(*TWO))[:-30], "truncated"),
        (b"<kml/>", "unknown-format"),
        (document(task(*TWO), version="5"), "unknown-format"),
        (document(task(*TWO), version=""), "unknown-format"),
        (document(task(*TWO)).replace(b"<ISO", b"<!DOCTYPE x><ISO", 1), "xml-unsafe"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, content: bytes, code: str) -> None:
    write(tmp_path, {"TASKDATA.XML": content})
    with pytest.raises(MapError) as caught:
        read_isoxml(tmp_path)
    assert caught.value.code == code


def test_version_2_is_read_with_a_warning(tmp_path: Path) -> None:
    write(tmp_path, {"TASKDATA.XML": document(VPN, task(*TWO), version="2")})
    assert codes(read_isoxml(tmp_path)) == ["old-version"]


def test_folder_without_task_data_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MapError) as caught:
        read_isoxml(tmp_path)
    assert caught.value.code == "no-file"
    with pytest.raises(MapError):
        read_isoxml(tmp_path / "nowhere" / "TASKDATA.XML")


# --- real files


@pytest.mark.parametrize("place", ["", "TASKDATA.XML", "grid_type_2.zip"])
def test_real_grid_of_values(samples: Path, place: str) -> None:
    folder = samples / "06_isoxml_v3_grid2_lha"
    found = read_isoxml(folder / place)
    assert isinstance(found, Grid)
    raw = np.frombuffer((folder / "GRD00001.bin").read_bytes(), "<i4").reshape(178, 236)
    (band,) = found.bands
    assert band.values.shape == (178, 236)
    assert np.unique(band.values).tolist() == [0.0, 49.0, 300.0]
    np.testing.assert_allclose(band.values, raw / 10_000, rtol=0, atol=1e-9)
    assert (band.unit, band.default) == ("L/ha", 0.0)
    assert found.transform == (1.1184e-5, 0.0, 15.141245418, 0.0, 1.1178e-5, 48.143304983)
    assert found.boundary is not None
    assert shapely.get_num_coordinates(found.boundary) == 10
    assert found.problems == ()


def test_real_polygon_zones(samples: Path) -> None:
    folder = samples / "08_isoxml_v4_tzn_vector_map1"
    found = read_isoxml(folder)
    assert isinstance(found, Layer)
    root = ElementTree.parse(folder / "TASKDATA.XML").getroot()
    zones = [one for one in root.iter("TZN") if one.find("PLN") is not None]
    wanted = [int(one.find("PDV").attrib["B"]) / 100 for one in zones]  # type: ignore[union-attr]
    assert len(zones) == 32
    names, rates = found.columns
    assert names.values == tuple(one.attrib["A"] for one in zones)
    assert rates.values == pytest.approx(wanted)
    assert (rates.unit, rates.default) == ("kg/ha", 148.15)
    assert codes(found) == ["position-lost-rate"]
    assert "148.15 kg/ha" in found.problems[0].text
    assert found.boundary is not None
    ground = shapely.union_all([area for area in found.geometries if area is not None])
    assert ground.intersection(found.boundary).area > 0.99 * found.boundary.area


def test_real_grid_of_undefined_codes(samples: Path) -> None:
    with pytest.raises(MapError) as caught:
        read_isoxml(samples / "11_isoxml_grid1_dotnet" / "TASKDATA.XML")
    assert caught.value.code == "undefined-code"
    assert "93 of 100 cells" in str(caught.value)
    assert "22, 23" in str(caught.value)


def test_real_truncated_grid(samples: Path) -> None:
    with pytest.raises(MapError) as caught:
        read_isoxml(samples / "11_isoxml_grid1_dotnet" / "invalid")
    assert caught.value.code == "binary-length"
    assert "32 bytes" in str(caught.value)
    assert "22896" in str(caught.value)


def test_real_grid_whose_presentation_says_ten_times_as_much(samples: Path) -> None:
    with pytest.raises(MapError) as caught:
        read_isoxml(samples / "12_isoxml_grid2_dotnet")
    assert caught.value.code == "unit-conflict"
    assert "19.05 kg/ha" in str(caught.value)
    assert "190.5 kg/ha" in str(caught.value)


def test_real_herbicide_task_beside_a_repeated_presentation(samples: Path) -> None:
    folder = samples / "07_isoxml_v3_onesoil"
    with pytest.raises(MapError) as caught:
        read_map(folder)
    assert "TSK1 (OneSoil-2024-10-10): seed in kg/ha" in str(caught.value)
    assert "herbicides in L/ha" in str(caught.value)
    assert caught.value.fix.endswith("--layer TSK2")
    assert read_map(folder, layer="TSK2").rates_l_ha == (0.0, 19.0, 20.0, 21.0)
    with pytest.raises(MapError) as caught:
        read_map(folder, layer="TSK1", unit="L/ha")
    assert caught.value.code == "unit-conflict"
    assert "TSK2 (OneSoil-2024-10-10): herbicides in L/ha" in caught.value.fix


def test_real_seeds_are_refused_whatever_is_asked_for(samples: Path) -> None:
    path = samples / "20_isoxml_agco" / "agco_jd_sprayer_900.zip"
    for unit in (None, "L/ha"):
        with pytest.raises(MapError) as caught:
            read_map(path, layer="TSK2", rate_field="Y99", unit=unit)
        assert caught.value.code == "not-a-volume"
        assert "TSK3 (PostSpray): RoundUp in L/ha" in caught.value.fix
