"""ISOXML task data are read as they stand, or refused with the right code."""

from __future__ import annotations

from pathlib import Path

import pytest
from shapely import Polygon, box

from companion.errors import MapError
from missions.maps.isoxml.reader import read_isoxml
from missions.maps.model import Layer
from missions.maps.registry import read_map
from tests.missions.isoxml_documents import (
    HOLED,
    LEFT,
    RIGHT,
    SOUTH,
    TWO,
    VPN,
    WEST,
    codes,
    document,
    field,
    grid,
    polygon,
    read_layer,
    refusal,
    ring,
    task,
    value,
    write,
    zone,
)

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
    assert error.code == "nested-polygon"
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
