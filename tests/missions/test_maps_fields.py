"""Which column is the rate and what its unit is: one clear answer, or none."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import shapely
from pyproj import CRS

from companion.errors import MapError
from missions.maps.fields import Choice, Given, choose, stated_unit, unit_of
from missions.maps.model import Column, Layer, Value
from missions.maps.registry import read_map
from missions.maps.units import l_ha_per_unit, other_quantity, rate_unit

PATH = Path("rx.shp")


def column(name: str, *values: Value) -> Column:
    numeric = all(not isinstance(value, str) for value in values)
    return Column(name=name, values=values or (1.0, 2.0), numeric=numeric)


def chosen(*columns: Column, asked: str | None = None) -> Choice:
    return choose(columns, asked=asked, path=PATH)


@pytest.mark.parametrize(
    "name",
    ["rate", "Rate", "RATE", "Tgt_Rate", "TargetRate", "dose", "DOSE", "value", "rx", "AppRate",
     "Tgt_Rate_l", "rate_l_ha", "Dose (L/ha)", "Menge", "用量"],
)  # fmt: skip
def test_the_usual_names_are_found_among_decoys(name: str) -> None:
    decoys = [column(decoy) for decoy in ("area", "id", "zone", "level", "area_total", "OBJECTID")]
    assert chosen(*decoys, column(name)).column.name == name


@pytest.mark.parametrize("name", ["area", "id", "zone", "level", "Shape_Area", "rate_id", "N", "x"])
def test_a_decoy_alone_is_not_taken(name: str) -> None:
    with pytest.raises(MapError, match=rf"no column looks like a rate; .*{name}.*--rate-field"):
        chosen(column(name))


def test_two_candidates_that_differ_are_refused_with_both_named() -> None:
    with pytest.raises(MapError, match=r"rate, dose; name one with --rate-field"):
        chosen(column("rate", 1.0, 2.0), column("dose", 1.0, 3.0))


def test_a_rate_and_its_rounded_copy_give_the_exact_one_and_a_warning() -> None:
    for columns in ((1.0, 2.0), (1.4, 2.4)):
        found = chosen(column("rateInt", 1.0, 2.0), column("rate", *columns))
        assert found.column.name == "rate"
        assert [problem.code for problem in found.problems] == ["several-candidates"]


def test_the_exact_column_is_taken_whatever_it_is_called() -> None:
    found = chosen(column("rate", 1.0, 2.0), column("rate_real", 1.4, 2.4))
    assert found.column.name == "rate_real"


def test_candidates_that_differ_in_a_blank_are_refused() -> None:
    with pytest.raises(MapError, match="several columns"):
        chosen(column("rate", 1.0, None), column("dose", 1.0, 2.0))


def test_a_weak_name_does_not_compete_with_a_rate() -> None:
    assert chosen(column("value", 7.0, 8.0), column("rate")).column.name == "rate"


def test_an_empty_column_is_no_candidate() -> None:
    assert chosen(column("rate", None, None), column("dose", 1.0, 2.0)).column.name == "dose"


def test_the_column_asked_for_is_taken_even_if_it_is_a_decoy() -> None:
    assert chosen(column("rate"), column("area"), asked="AREA").column.name == "area"


def test_a_column_that_is_not_there_is_refused_with_those_that_are() -> None:
    with pytest.raises(MapError, match="no column 'dose'; take one of rate, area"):
        chosen(column("rate"), column("area"), asked="dose")


def unit(*columns: Column, asked: str | None = None, rate: str = "rate") -> str:
    value = column(rate)
    layer = Layer(
        format="shapefile",
        crs=CRS.from_epsg(4326),
        columns=(value, *columns),
        geometries=(None, None),
        sha256="",
    )
    return unit_of(layer, value, given=Given(unit=asked), path=PATH).name


@pytest.mark.parametrize("name", ["unit", "Units", "UOM", "DOSE_UNIT", "rate_unit", "rateUnits"])
def test_a_unit_column_is_believed(name: str) -> None:
    assert unit(column(name, "l/ha", "L/ha")) == "L/ha"


def test_the_unit_of_the_area_is_not_the_unit_of_the_rate() -> None:
    with pytest.raises(MapError, match="no unit is given"):
        unit(column("area_unit", "ha", "ha"))


def test_the_units_own_column_comes_before_the_general_one() -> None:
    assert unit(column("unit", "kg", "kg"), column("rate_unit", "gal/ac", "gal/ac")) == "gal/ac"


def test_the_name_of_the_column_can_state_the_unit() -> None:
    assert unit(rate="dose_l_ha") == "L/ha"
    with pytest.raises(MapError, match="not a volume per area"):
        unit(rate="dose_kg_ha")


def test_no_unit_is_never_taken_for_litres() -> None:
    with pytest.raises(MapError, match=r"no unit is given .*--unit"):
        unit()
    assert unit(asked="L/mu") == "L/mu"


def test_mass_per_area_is_refused_whoever_says_it() -> None:
    with pytest.raises(MapError, match="kg/ha"):
        unit(asked="kg/ha")
    with pytest.raises(MapError, match="kg/ha"):
        unit(column("unit", "kg/ha", "kg/ha"))
    with pytest.raises(MapError, match="kg/ha"):
        unit(column("unit", "kg/ha", "kg/ha"), asked="L/ha")


def test_file_and_operator_have_to_agree() -> None:
    with pytest.raises(MapError, match="its unit is L/ha, but gal/ac is asked for"):
        unit(column("unit", "l/ha", "l/ha"), asked="gal/ac")
    assert unit(column("unit", "l/ha", "l/ha"), asked="litres per hectare") == "L/ha"


def test_a_file_with_two_units_is_refused() -> None:
    with pytest.raises(MapError, match="several units: L/ha, gal/ac"):
        unit(column("unit", "l/ha", "gal/ac"))


def test_a_unit_that_nobody_understands_yields_to_the_operator() -> None:
    with pytest.raises(MapError, match="'Liter' is not a volume per area"):
        unit(column("unit", "Liter", "Liter"))
    assert unit(column("unit", "Liter", "Liter"), asked="L/ha") == "L/ha"


@pytest.mark.parametrize(
    ("text", "factor"),
    [
        ("L/ha", 1.0), ("l ha-1", 1.0), ("l.ha⁻¹", 1.0), ("litre per hectare", 1.0), ("lha", 1.0),
        ("Gal/Ac", 9.353957), ("gpa", 9.353957), ("gal1ac-1", 9.353957), ("imp gal/ac", 11.23364),
        ("mL/m²", 10.0), ("ml/m2", 10.0), ("ml m-2", 10.0), ("L/m2", 10_000.0), ("mL/ha", 0.001),
        ("L/mu", 15.0), ("升/亩", 15.0), ("mL/mu", 0.015), ("L/ac", 2.471054), ("hl/ha", 100.0),
        ("m3/ha", 1000.0), ("mm3/m2", 0.01), ("qt/ac", 2.338489), ("pt/ac", 1.169245),
    ],
)  # fmt: skip
def test_every_spelling_has_its_factor(text: str, factor: float) -> None:
    assert l_ha_per_unit(text) == pytest.approx(factor, rel=1e-6)


@pytest.mark.parametrize(
    "text", ["", "kg/ha", "lb/ac", "t/ha", "L", "ha", "L/min", "seeds/ha", "/", "1", "%", "L/" * 50]
)
def test_what_is_no_volume_per_area_has_no_factor(text: str) -> None:
    assert l_ha_per_unit(text) is None


def test_weighed_rates_are_known_as_such() -> None:
    for text in ("kg/ha", "kg ha-1", "lbs/acre", "t/ha", "g/m2"):
        found = rate_unit(text)
        assert found is not None and found.kind == "mass"
    assert other_quantity("cwt/ac") == "a weight per area"


NO_VOLUME = (
    "seeds/ha", "Seeds/acre", "kseeds/ac", "plants m-2", "1/m2", "/m2", "ha-1", "seeds1ac-1",
    "Körner/m²", "graines/m2", "pl/m2", "seeds", "%", "percent", "Prozent", "ppm", "mL/L", "g/kg",
    "L/100L", "mm3/m3", "mg/kg", "cm", "mm", "inch", "mm between seeds", "kg N/ha", "kgN/ha",
    "lb N/ac", "kg P2O5/ha", "N kg/ha", "g a.i./ha", "kg ai/ha", "kg", "lbs", "ton/ac", "mL/m",
    "seeds/m", "L/100m", "kg/min", "mg/s", "1/s", "bu/ac", "km/h", "bar",
)  # fmt: skip


@pytest.mark.parametrize("text", NO_VOLUME)
def test_a_known_unit_of_something_else_is_refused_whatever_is_asked_for(text: str) -> None:
    for asked in (None, "L/ha", "gal/ac"):
        with pytest.raises(MapError) as caught:
            unit(column("unit", text, text), asked=asked)
        assert caught.value.code == "not-a-volume"
        assert "give the unit with --unit" not in str(caught.value)


@pytest.mark.parametrize("text", ["L/ha", "gal/ac", "mL/m2", "L/mu", "kg/ha", "g/m2", "L/min"])
def test_units_that_can_be_converted_are_not_of_something_else(text: str) -> None:
    assert other_quantity(text) is None


@pytest.mark.parametrize(
    "name",
    [
        "rate_seeds_ha", "Seeds/ha", "rate (seeds/ha)", "SeedRate", "seed_rate", "plants_m2",
        "rate_pct", "rate (%)", "rate %", "dose_percent", "kgN_ha", "rate_kg_N_ha", "N_kg_ha",
        "rate_N_kg_ha", "dose_cm", "rate_kg", "Population", "rate_ksds_ac",
    ],
)  # fmt: skip
def test_a_column_whose_name_says_another_unit_is_refused(name: str) -> None:
    for asked in (None, "L/ha"):
        with pytest.raises(MapError) as caught:
            unit(asked=asked, rate=name)
        assert caught.value.code == "not-a-volume", name
        assert "give the unit with --unit" not in str(caught.value)


@pytest.mark.parametrize(
    "name",
    [
        "rate", "rate_m", "dose_s", "Tgt_Rate", "value", "rate_k", "P_rate_l_ha", "K_l_ha", "rate1",
        "Rate_L", "amount", "rate_t", "rate in",
    ],
)  # fmt: skip
def test_a_column_whose_name_says_no_unit_waits_for_the_operator(name: str) -> None:
    assert unit(asked="L/ha", rate=name) == "L/ha"


def test_a_weight_without_its_area_is_a_weight_for_whoever_says_the_area() -> None:
    given = Given(unit="kg/ha", density_kg_l=1.25)
    rate = column("rate", 7.0, 8.0)
    layer = Layer(
        format="shapefile", crs=None, columns=(rate, column("unit", "kg", "kg")), geometries=(),
        sha256="",
    )  # fmt: skip
    assert unit_of(layer, rate, given=given, path=PATH).l_ha == 0.8


def test_the_unit_that_the_file_states_prevails_over_a_word_in_a_name() -> None:
    assert unit(column("unit", "L/ha", "L/ha"), rate="seed_treatment") == "L/ha"


@pytest.mark.parametrize(
    ("titles", "stated"),
    [
        (["Rate (seeds/ha)"], "seeds/ha"),
        (["target", "percent"], "percent"),
        (["Spacing [cm]"], "cm"),
        (["Dose (L/ha)", "80 seeds/m2 were sown"], "L/ha"),
        (["soil map of 2024", "rate in"], None),
    ],
)
def test_titles_that_say_another_quantity_are_heard(titles: list[str], stated: str | None) -> None:
    assert stated_unit(titles, column="rate", path=PATH) == stated


def seeds_geojson(path: Path) -> None:
    zone = [[[114.5, 36.0], [114.501, 36.0], [114.501, 36.001], [114.5, 36.0]]]
    shape = {"type": "Polygon", "coordinates": zone}
    one = {"type": "Feature", "properties": {"seed_rate": 80}, "geometry": shape}
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [one]}))


def seeds_csv(path: Path) -> None:
    path.write_text(
        'wkt,rate,unit\n"POLYGON((114.5 36,114.501 36,114.501 36.001,114.5 36))",80,plants/m2\n'
    )


def seeds_shapefile(path: Path) -> None:
    wkb = shapely.to_wkb(shapely.box(114.5, 36.0, 114.501, 36.001))
    pyogrio.raw.write(
        str(path), np.array([wkb], dtype=object), [np.array([12.0])], ["rate_cm"],
        geometry_type="Polygon", crs="EPSG:4326", driver="ESRI Shapefile",
    )  # fmt: skip


@pytest.mark.parametrize(
    ("name", "make"),
    [("rx.geojson", seeds_geojson), ("rx.csv", seeds_csv), ("rx.shp", seeds_shapefile)],
)
def test_files_of_every_kind_with_another_quantity_are_refused(
    tmp_path: Path, name: str, make: Callable[[Path], None]
) -> None:
    make(tmp_path / name)
    for asked in (None, "L/ha"):
        with pytest.raises(MapError) as caught:
            read_map(tmp_path / name, unit=asked)
        assert caught.value.code == "not-a-volume"
