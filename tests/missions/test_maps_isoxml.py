"""ISOXML task data are read as they stand, or refused with the right code."""

from __future__ import annotations

import hashlib
import struct
import zipfile
from collections.abc import Mapping
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

WEST, SOUTH = 15.0, 48.0
HEAD = '<?xml version="1.0" encoding="UTF-8"?>'
VPN = '<VPN A="VPN1" B="0" C="0.0001" D="2" E="l/ha"/>'


def ring(ground: Polygon, kind: int = 1, interior: int | None = None) -> str:
    points = (ground.exterior if interior is None else ground.interiors[interior]).coords
    inner = "".join(f'<PNT A="2" C="{north:.9f}" D="{east:.9f}"/>' for east, north in points)
    return f'<LSG A="{kind}">{inner}</LSG>'


def polygon(ground: Polygon, kind: int = 2) -> str:
    holes = "".join(ring(ground, 2, index) for index in range(len(ground.interiors)))
    return f'<PLN A="{kind}">{ring(ground)}{holes}</PLN>'


def zone(code: int, *inside: str, name: str = "") -> str:
    designator = f' B="{name}"' if name else ""
    return f'<TZN A="{code}"{designator}>{"".join(inside)}</TZN>'


def value(raw: int, ddi: str = "0001", more: str = 'E="VPN1"') -> str:
    return f'<PDV A="{ddi}" B="{raw}" {more}/>'


def grid(kind: int, rows: int, columns: int, more: str = "", **changed: str) -> str:
    given = {
        "A": f"{SOUTH}", "B": f"{WEST}", "C": "0.001", "D": "0.002", "E": f"{columns}",
        "F": f"{rows}", "G": "GRD00001", "I": f"{kind}",
    } | changed  # fmt: skip
    attributes = " ".join(f'{key}="{text}"' for key, text in given.items())
    return f"<GRD {attributes} {more}/>"


def task(*inside: str, own: str = "TSK1", more: str = "") -> str:
    return f'<TSK A="{own}" G="1" {more}>{"".join(inside)}</TSK>'


def document(*inside: str, version: str = "4", head: str = HEAD) -> bytes:
    text = f'{head}<ISO11783_TaskData VersionMajor="{version}">{"".join(inside)}'
    encoding = "latin-1" if "8859" in head else "utf-8"
    return f"{text}</ISO11783_TaskData>".encode(encoding)


def field(ground: Polygon, own: str = "PFD1", more: str = "") -> str:
    return f'<PFD A="{own}" C="field" D="0">{polygon(ground, 1)}{more}</PFD>'


def write(folder: Path, files: Mapping[str, bytes]) -> Path:
    for name, content in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    return folder


def read(tmp_path: Path, *inside: str, layer: str | None = None, **files: bytes) -> Layer | Grid:
    """Read task data with the binaries given by name."""
    binaries = {f"{name}.bin": content for name, content in files.items()}
    return read_isoxml(write(tmp_path, {"TASKDATA.XML": document(*inside)} | binaries), layer)


def read_layer(tmp_path: Path, *inside: str, layer: str | None = None) -> Layer:
    found = read(tmp_path, *inside, layer=layer)
    assert isinstance(found, Layer)
    return found


def read_grid(tmp_path: Path, *inside: str, content: bytes) -> Grid:
    found = read(tmp_path, *inside, GRD00001=content)
    assert isinstance(found, Grid)
    return found


def refusal(tmp_path: Path, *inside: str, layer: str | None = None, **files: bytes) -> MapError:
    with pytest.raises(MapError) as caught:
        read(tmp_path, *inside, layer=layer, **files)
    assert "\n" not in str(caught.value)
    return caught.value


def codes(found: Layer | Grid) -> list[str]:
    return [problem.code for problem in found.problems]


def ints(*raws: int) -> bytes:
    return struct.pack(f"<{len(raws)}i", *raws)


LEFT = box(WEST, SOUTH, WEST + 0.004, SOUTH + 0.004)
RIGHT = box(WEST + 0.004, SOUTH, WEST + 0.008, SOUTH + 0.004)
HOLED = LEFT.difference(box(WEST + 0.001, SOUTH + 0.001, WEST + 0.002, SOUTH + 0.002))
TWO = (
    zone(3, polygon(HOLED), value(1_500_000), name="Süd"),
    zone(4, polygon(RIGHT), value(0)),
)
TYPE_2 = zone(0, value(0))
# Two things of one id.
OTHER_PRODUCTS = ('<PDT A="PDT1" B="a"/>', '<PDT A="PDT1" B="b"/>')
OTHER_PRESENTATIONS = (VPN, VPN.replace("0.0001", "0.01"))
OTHER_FIELDS = (field(LEFT), field(RIGHT))
OTHER_GRIDS = (
    task(grid(1, 1, 1), zone(0, value(1)), own="TSK1"),
    task(grid(1, 2, 1), zone(0, value(1)), own="TSK2"),
)


# --- polygons


def test_polygon_zones_come_with_rates_names_and_holes(tmp_path: Path) -> None:
    found = read_layer(tmp_path, VPN, task(*TWO))
    names, rates = found.columns
    assert names.values == ("Süd", "4")
    assert (rates.values, rates.unit, rates.is_rate) == ((150.0, 0.0), "L/ha", True)
    assert rates.name == "DDI 0001"
    assert rates.default is None
    assert found.geometries[0] is not None
    assert found.geometries[0].symmetric_difference(HOLED).area < 1e-12
    assert found.crs is not None
    assert found.crs.to_epsg() == 4326
    assert found.problems == ()
    assert found.boundary is None


def test_version_3_is_read_the_same(tmp_path: Path) -> None:
    write(tmp_path, {"TASKDATA.XML": document(VPN, task(*TWO), version="3")})
    found = read_isoxml(tmp_path)
    assert isinstance(found, Layer)
    assert found.columns[1].values == (150.0, 0.0)
    assert found.problems == ()


def test_several_polygons_of_a_zone_are_one_ground(tmp_path: Path) -> None:
    far = box(WEST + 0.02, SOUTH, WEST + 0.03, SOUTH + 0.01)
    found = read_layer(
        tmp_path, task(zone(3, polygon(LEFT), polygon(RIGHT), polygon(far), value(10)))
    )
    (ground,) = found.geometries
    assert ground is not None
    assert ground.is_valid
    assert ground.area == pytest.approx(LEFT.area + RIGHT.area + far.area)


def test_two_exterior_rings_of_one_polygon_each_get_their_own_hole(tmp_path: Path) -> None:
    hole = HOLED.interiors[0]
    both = f'<PLN A="2">{ring(LEFT)}{ring(RIGHT)}{ring(Polygon(hole), 2)}</PLN>'
    (ground,) = read_layer(tmp_path, task(zone(3, both, value(10)))).geometries
    assert ground is not None
    assert ground.area == pytest.approx(HOLED.area + RIGHT.area)


def test_single_ring_is_the_outline_whatever_it_is_marked_as(tmp_path: Path) -> None:
    flag = f'<PLN A="2">{ring(LEFT, 8)}</PLN>'
    (ground,) = read_layer(tmp_path, task(zone(3, flag, value(10)))).geometries
    assert ground is not None
    assert ground.equals(LEFT)


def test_exterior_ring_inside_another_is_refused_as_it_may_be_a_hole(tmp_path: Path) -> None:
    both = f'<PLN A="2">{ring(LEFT)}{ring(Polygon(HOLED.interiors[0]))}</PLN>'
    error = refusal(tmp_path, task(zone(3, both, value(10))))
    assert error.code == "broken-geometry"
    assert "treatment zone 3" in str(error)


def test_zone_without_a_value_has_no_rate(tmp_path: Path) -> None:
    found = read_layer(tmp_path, task(zone(3, polygon(LEFT), value(10)), zone(4, polygon(RIGHT))))
    assert found.columns[1].values == (0.001, None)


def test_codes_of_the_task_give_the_default_and_warnings(tmp_path: Path) -> None:
    special = (
        zone(0, value(100_000)), zone(1, value(200_000)), zone(2, value(300_000)),
    )  # fmt: skip
    found = read_layer(tmp_path, VPN, task(*special, *TWO, more='H="0" I="1" J="2"'))
    assert len(found.geometries) == 2
    assert found.columns[1].default == 10.0
    assert codes(found) == ["position-lost-rate", "out-of-field-rate"]
    assert "20 L/ha" in found.problems[0].text
    assert "30 L/ha" in found.problems[1].text


def test_obstacles_among_the_polygons_of_a_zone_are_left_out(tmp_path: Path) -> None:
    inside = zone(3, polygon(LEFT), polygon(RIGHT, 6), value(10))
    found = read_layer(tmp_path, VPN, task(inside))
    assert found.geometries[0] is not None
    assert found.geometries[0].area == pytest.approx(LEFT.area)
    assert codes(found) == ["polygon-type"]


def test_zone_that_is_nowhere_is_told(tmp_path: Path) -> None:
    found = read_layer(tmp_path, VPN, task(zone(9, value(5), name="lost one"), *TWO))
    assert codes(found) == ["zone-without-ground"]
    assert found.problems[0].where == "lost one"


@pytest.mark.parametrize(
    ("bad", "code"),
    [
        ('<PLN A="2"><LSG A="2"><PNT A="2" C="1" D="1"/></LSG></PLN>', "broken-geometry"),
        ('<PLN A="2"><LSG A="1"><PNT A="2" C="1" D="1"/></LSG></PLN>', "broken-geometry"),
        (polygon(LEFT).replace('C="48.0', 'C="48,0'), "broken-geometry"),
        (polygon(LEFT).replace("48.004000000", "nan"), "broken-geometry"),
        (polygon(LEFT).replace("48.004000000", "48.0_04"), "broken-geometry"),
        (polygon(LEFT).replace("48.004000000", "1e300"), "broken-geometry"),
        (polygon(LEFT).replace('D="15.004000000"', ""), "broken-geometry"),
        ('<PLN A="2"><LSG A="1"><PNT A="2" J="PNT00001"/></LSG></PLN>', "broken-geometry"),
    ],
)
def test_broken_rings_are_refused(tmp_path: Path, bad: str, code: str) -> None:
    assert refusal(tmp_path, task(zone(3, bad, value(10)))).code == code


# --- tasks, products, references


def test_several_tasks_are_refused_without_a_choice(tmp_path: Path) -> None:
    tasks = (
        task(*TWO, own="TSK1", more='B="North"'),
        task(zone(3, polygon(LEFT), value(70_000)), own="TSK2", more='B="South"'),
        task(own="TSK3", more='B="no prescription"'),
    )
    error = refusal(tmp_path, VPN, *tasks)
    assert error.code == "several-layers"
    assert "TSK1 (North): rate in L/ha, TSK2 (South): rate in L/ha" in str(error)
    for chosen in ("TSK2", "South", "south"):
        assert read_layer(tmp_path, VPN, *tasks, layer=chosen).columns[1].values == (7.0,)
    missing = refusal(tmp_path, VPN, *tasks, layer="TSK3")
    assert missing.code == "no-layer"
    assert "TSK2" in missing.fix


def test_two_tasks_of_one_designator_are_refused(tmp_path: Path) -> None:
    tasks = [task(*TWO, own=own, more='B="Same"') for own in ("TSK1", "TSK2")]
    assert refusal(tmp_path, *tasks, layer="same").code == "several-layers"


def test_products_are_columns_with_their_names(tmp_path: Path) -> None:
    products = '<PDT A="PDT1" B="Roundup"/><PDT A="PDT2" B="Water"/>'
    both = (value(20_000, more='C="PDT1"'), value(1_000_000, more='C="PDT2"'))
    found = read_layer(
        tmp_path, products, task(zone(3, polygon(LEFT), *both), zone(4, polygon(RIGHT), both[1]))
    )
    assert [(one.name, one.values) for one in found.columns[1:]] == [
        ("Roundup", (2.0, None)),
        ("Water", (100.0, 100.0)),
    ]
    assert all(one.is_rate for one in found.columns[1:])


def test_value_without_product_is_of_the_only_product(tmp_path: Path) -> None:
    found = read_layer(
        tmp_path,
        '<PDT A="PDT1" B="Roundup"/>',
        task(
            zone(0, value(50_000, more="")),
            zone(3, polygon(LEFT), value(20_000, more='C="PDT1"')),
            more='H="0"',
        ),
    )
    (rate,) = found.columns[1:]
    assert (rate.name, rate.default) == ("Roundup", 5.0)


def test_same_product_from_two_tanks_is_two_columns(tmp_path: Path) -> None:
    both = (value(20_000, more='D="DET1"'), value(30_000, more='D="DET2"'))
    found = read_layer(tmp_path, task(zone(3, polygon(LEFT), *both)))
    assert [one.values for one in found.columns[1:]] == [(2.0,), (3.0,)]
    assert len({one.name for one in found.columns}) == 3


def test_product_that_the_file_lacks_is_told(tmp_path: Path) -> None:
    found = read_layer(tmp_path, task(zone(3, polygon(LEFT), value(20_000, more='C="PDT7"'))))
    assert found.columns[1].name == "PDT7"
    assert codes(found) == ["undefined-code"]


@pytest.mark.parametrize(
    "inside",
    [
        (task(*TWO, own="TSK1"), task(own="TSK1")),
        (task(zone(3, polygon(LEFT), value(1, more='C="PDT1"'))), *OTHER_PRODUCTS),
        (task(*TWO), *OTHER_PRESENTATIONS),
        (task(*TWO, more='E="PFD1"'), *OTHER_FIELDS),
        (task(*TWO, TWO[0]),),
        (task(zone(3, polygon(LEFT), value(1), value(2))),),
        OTHER_GRIDS,
    ],
    ids=["task", "product", "presentation", "field", "zone", "value", "grid"],
)
def test_what_is_there_twice_is_refused(tmp_path: Path, inside: tuple[str, ...]) -> None:
    assert refusal(tmp_path, *inside, layer="TSK1").code == "duplicate-code"


def test_lines_that_are_repeated_byte_for_byte_are_one(tmp_path: Path) -> None:
    product, ground = '<PDT A="PDT1" B="Roundup"/>', field(LEFT)
    repeated = (product, ground, VPN, f"{VPN}\n  ", product, ground)
    own = task(zone(3, polygon(LEFT), value(20_000, more='C="PDT1" E="VPN1"')), more='E="PFD1"')
    found = read_layer(tmp_path, *repeated, own, own)
    assert (found.columns[1].name, found.columns[1].values) == ("Roundup", (2.0,))
    assert found.boundary is not None
    assert found.problems == ()


def test_an_id_that_the_task_does_not_use_may_stand_for_anything(tmp_path: Path) -> None:
    value_of_vpn9 = value(20_000, more='E="VPN9"')
    used = VPN.replace("VPN1", "VPN9")
    broken = '<VPN A="VPN8" B="not a number"/><VPN B="0"/><PDT B="no id"/>'
    others = (*OTHER_PRODUCTS, *OTHER_PRESENTATIONS, *OTHER_FIELDS, broken)
    own = task(zone(3, polygon(LEFT), value_of_vpn9), own="TSK7")
    assert read_layer(tmp_path, used, *others, own).columns[1].values == (2.0,)
    tasks = (own, *OTHER_GRIDS)
    assert read_layer(tmp_path, used, *tasks, layer="TSK7").columns[1].values == (2.0,)


MIXED = (
    '<PDT A="PDT1" B="Maize"/><PDT A="PDT2" B="Roundup"/><PDT A="PDT3" B="Urea"/>',
    task(zone(3, polygon(LEFT), value(80_000, "000B", 'C="PDT1"')), own="TSK1", more='B="Plant"'),
    task(zone(3, polygon(LEFT), value(490_000, "0001", 'C="PDT2"')), own="TSK2", more='B="Spray"'),
    task(zone(3, polygon(LEFT), value(16_000, "0006", 'C="PDT3"')), own="TSK3"),
)


def test_lists_of_tasks_name_product_and_unit(tmp_path: Path) -> None:
    error = refusal(tmp_path, *MIXED)
    assert "TSK1 (Plant): Maize in 1/m2, TSK2 (Spray): Roundup in L/ha, TSK3: Urea" in str(error)
    assert error.fix.endswith("--layer TSK2")


# Each family of rates in ISO 11783-11 that is not a volume per area and cannot become one, by its
# setpoint: count and spacing, shares, weight and count per time, volume per length.
@pytest.mark.parametrize("ddi", ["000B", "0010", "0015", "001A", "001F", "0029", "002E", "0279"])
def test_no_unit_makes_litres_of_seeds_and_shares(tmp_path: Path, ddi: str) -> None:
    seeds = task(zone(3, polygon(LEFT), value(80_000, ddi, 'C="PDT1"')), own="TSK1")
    write(tmp_path, {"TASKDATA.XML": document(*(seeds, MIXED[0], *MIXED[2:]))})
    for unit in (None, "L/ha", "gal/ac", "kg/ha", "L/min"):
        with pytest.raises(MapError) as caught:
            read_map(
                tmp_path, layer="TSK1", unit=unit, density_kg_l=1.0, flow_width_m=6.0,
                flow_speed_m_s=5.0,
            )  # fmt: skip
        assert caught.value.code == "not-a-volume"
        assert caught.value.fix == (
            "choose with --layer a task that can be sprayed: TSK2 (Spray): Roundup in L/ha"
        )


def test_another_product_of_the_task_is_named_where_one_can_be_sprayed(tmp_path: Path) -> None:
    both = (value(80_000, "000B", 'C="PDT1"'), value(490_000, "0001", 'C="PDT2"'))
    write(tmp_path, {"TASKDATA.XML": document(MIXED[0], task(zone(3, polygon(LEFT), *both)))})
    with pytest.raises(MapError) as caught:
        read_map(tmp_path, rate_field="Maize", unit="L/ha")
    assert caught.value.fix.startswith("take with --rate-field (prescription.rate_field): Roundup")
    assert read_map(tmp_path, rate_field="Roundup").rates_l_ha == (49.0,)


@pytest.mark.parametrize(
    ("ddi", "said"),
    [("008C", "percentage of a rate"), ("0038", "seeding depth"), ("0053", "yield"), ("DFFF", "")],
)
def test_values_that_are_no_rates_are_named(tmp_path: Path, ddi: str, said: str) -> None:
    error = refusal(tmp_path, task(zone(3, polygon(LEFT), value(5, ddi))))
    assert error.code == "not-a-volume"
    assert f"DDI {ddi}" in str(error)
    assert said in str(error)
    assert error.fix == "no task of the file has a volume per area: make the map in L/ha"


@pytest.mark.parametrize("shown", ["seeds/ha", "%", "kg N/ha", "cm"])
def test_a_presentation_in_another_quantity_is_a_conflict(tmp_path: Path, shown: str) -> None:
    for ddi in ("0001", "0006"):
        inside = (VPN.replace("l/ha", shown), task(zone(3, polygon(LEFT), value(10_000, ddi))))
        assert refusal(tmp_path, *inside).code == "unit-conflict"


@pytest.mark.parametrize(
    ("inside", "said"),
    [
        (zone(0, value(490_000)), "task TSK1 has treatment zones with values but no ground"),
        (zone(0, polygon(LEFT)), "task TSK1 has treatment zones with polygons but no values"),
        ("", "none of its 2 tasks has treatment zones"),
    ],
)
def test_a_task_with_half_a_prescription_is_not_called_empty(
    tmp_path: Path, inside: str, said: str
) -> None:
    error = refusal(tmp_path, task(own="TSK0"), task(inside))
    assert error.code == "no-rate-column"
    assert said in str(error)


@pytest.mark.parametrize("key", ["H", "I", "J"])
def test_special_code_without_a_zone_is_refused(tmp_path: Path, key: str) -> None:
    error = refusal(tmp_path, task(*TWO, more=f'{key}="77"'))
    assert error.code == "undefined-code"
    assert "77" in str(error)


# --- units


@pytest.mark.parametrize(
    ("ddi", "raw", "unit", "amount"),
    [
        ("0001", 490_000, "L/ha", 49.0),
        ("1", 490_000, "L/ha", 49.0),
        ("024C", 49, "L/ha", 49.0),
        ("0003", 490_000, "L/ha", 49.0),
        ("0006", 16_000, "kg/ha", 160.0),
        ("000B", 80_000, "1/m2", 80.0),
        ("0010", 200, "mm between seeds", 200.0),
        ("0024", 16_667, "L/min", 1.00002),
    ],
)
def test_dictionary_says_unit_and_resolution(
    tmp_path: Path, ddi: str, raw: int, unit: str, amount: float
) -> None:
    found = read_layer(tmp_path, task(zone(3, polygon(LEFT), value(raw, ddi, ""))))
    assert found.columns[1].unit == unit
    assert found.columns[1].values[0] == pytest.approx(amount, rel=1e-12)


def test_dictionary_agrees_with_an_independent_one() -> None:
    from isoxml.models.ddi_entities import DDEntity

    from missions.maps.isoxml.values import FAMILIES
    from missions.maps.units import rate_unit

    roles = ("setpoint", "actual", "default", "minimum", "maximum")
    for family in FAMILIES:
        for ddi, role in zip(family.ddis, roles, strict=True):
            entity = DDEntity.from_id(ddi)
            assert entity.name.casefold().startswith(role)
            own, other = rate_unit(family.unit), rate_unit(entity.unit)
            if own is None or other is None:
                assert family.raw_per_unit == pytest.approx(1.0 / entity.bit_resolution)
            else:
                assert own.kind == other.kind
                assert own.factor / family.raw_per_unit == pytest.approx(
                    other.factor * entity.bit_resolution
                )


def test_other_values_beside_the_setpoint_are_left_aside(tmp_path: Path) -> None:
    values = (value(20_000), value(7, "0003"), value(9, "0002"), value(5, "DFFF"))
    found = read_layer(tmp_path, VPN, task(zone(3, polygon(LEFT), *values)))
    assert [one.name for one in found.columns] == ["name", "DDI 0001"]
    assert codes(found) == ["value-ignored"]
    assert "DDI 0002 (1), DDI 0003 (1), DDI DFFF (1)" in found.problems[0].text


def test_task_without_any_setpoint_is_refused(tmp_path: Path) -> None:
    error = refusal(tmp_path, task(zone(3, polygon(LEFT), value(5, "0002"))))
    assert error.code == "not-a-volume"
    assert "DDI 0002" in str(error)
    assert refusal(tmp_path, task(zone(3, polygon(LEFT)))).code == "no-rate-column"
    assert refusal(tmp_path).code == "no-rate-column"


@pytest.mark.parametrize(
    ("scale", "unit", "ddi", "numbers"),
    [
        ("0.01", "l/ha", "0001", ("150 L/ha", "15000 L/ha")),
        ("0.0001", "gal/ac", "0001", ("150 L/ha", "150 gal/ac")),
        ("0.1", "kg/ha", "0006", ("15000 kg/ha", "150000 kg/ha")),
        ("0.0001", "kg/ha", "0001", ("L/ha", "kg/ha")),
    ],
)
def test_presentation_of_another_amount_is_a_conflict(
    tmp_path: Path, scale: str, unit: str, ddi: str, numbers: tuple[str, str]
) -> None:
    shown = f'<VPN A="VPN1" B="0" C="{scale}" D="2" E="{unit}"/>'
    error = refusal(tmp_path, shown, task(zone(3, polygon(LEFT), value(1_500_000, ddi))))
    assert error.code == "unit-conflict"
    assert all(number in str(error) for number in numbers)


def test_offset_of_a_presentation_is_a_conflict(tmp_path: Path) -> None:
    shown = VPN.replace('B="0"', 'B="100000"')
    assert refusal(tmp_path, shown, task(*TWO)).code == "unit-conflict"


def test_presentation_in_gallons_with_a_rounded_scale_is_none(tmp_path: Path) -> None:
    shown = '<VPN A="VPN1" B="0" C="0.0000107" D="1" E="gal/ac"/>'
    found = read_layer(tmp_path, shown, task(*TWO))
    assert found.columns[1].values == (150.0, 0.0)
    assert found.problems == ()


def test_presentation_in_an_unknown_unit_is_told(tmp_path: Path) -> None:
    found = read_layer(tmp_path, VPN.replace("l/ha", "Liter"), task(*TWO))
    assert codes(found) == ["presentation-unit"]


@pytest.mark.parametrize("raw", ["", "1.5", "2147483648", "nan", "1_0"])
def test_value_that_is_no_whole_number_is_refused(tmp_path: Path, raw: str) -> None:
    bad = value(0).replace('B="0"', f'B="{raw}"')
    assert refusal(tmp_path, task(zone(3, polygon(LEFT), bad))).code == "bad-rate"


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


def test_nearest_task_data_of_a_folder_is_taken(tmp_path: Path) -> None:
    write(tmp_path, {"TASKDATA.XML": document(task(*TWO)), "old/TASKDATA.XML": b"broken"})
    assert isinstance(read_isoxml(tmp_path), Layer)


def test_two_task_data_beside_each_other_are_refused(tmp_path: Path) -> None:
    write(tmp_path, {f"{name}/TASKDATA.XML": document(task(*TWO)) for name in "ab"})
    with pytest.raises(MapError) as caught:
        read_isoxml(tmp_path)
    assert caught.value.code == "several-layers"


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
        read_isoxml(samples / "11_isoxml_grid1_dotnet")
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
