"""Which column is the rate and what unit it has, the same in every format that has columns."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.cli.app import execute
from companion.errors import MapError
from missions.maps.fields import choose, score
from missions.maps.model import Column, Value
from missions.maps.registry import read_area, read_map, read_records
from tests.missions.shapefiles import CELL, SOUTH, WEST, cell

DRIVERS = {
    "rx.shp": "ESRI Shapefile", "rx.geojson": "GeoJSON", "rx.gpkg": "GPKG", "rx.kml": "KML",
    "rx.csv": "CSV",
}  # fmt: skip
EVERY = pytest.mark.parametrize("name", DRIVERS)


def wide(widths: Sequence[float]) -> list[shapely.Polygon]:
    """Return strips side by side, so many cells wide."""
    ends = np.cumsum([0.0, *widths]) * CELL + WEST
    return [shapely.box(west, SOUTH, east, SOUTH + CELL) for west, east in pairwise(ends.tolist())]


def by_gdal(
    path: Path, columns: Mapping[str, Sequence[object]], widths: Sequence[float] = (1, 1)
) -> Path:
    path.unlink(missing_ok=True)
    arrays = [
        np.array(
            [np.nan if one is None else one for one in values]
            if all(isinstance(one, int | float | None) for one in values)
            else list(values),
            dtype=float if all(isinstance(one, int | float | None) for one in values) else object,
        )
        for values in columns.values()
    ]
    pyogrio.raw.write(
        str(path), np.array(shapely.to_wkb(wide(widths)), dtype=object), arrays, list(columns),
        geometry_type="Polygon", crs="EPSG:4326", driver=DRIVERS[path.name],
        layer_options={"GEOMETRY": "AS_WKT"} if path.suffix == ".csv" else None,
    )  # fmt: skip
    return path


def refused(path: Path, code: str, **answers: str) -> str:
    with pytest.raises(MapError) as caught:
        read_map(path, **answers)
    assert caught.value.code == code, caught.value
    return str(caught.value)


def rates(path: Path, **answers: str) -> tuple[str, tuple[float, ...]]:
    found = read_map(path, **answers)
    return found.rate_field, found.rates_l_ha


@EVERY
@pytest.mark.parametrize(
    ("rate", "beside"),
    [
        ("DOSE_HA", "DOSE_TOT"), ("Dosis_ha", "Menge"), ("Rate_ha", "amount"), ("rate", "total"),
        ("MeanRate", "volume"), ("dose", "Litres"), ("Menge_ha", "Menge_ges"), ("taxa", "soma"),
        ("DOSETOTAL", "dawka"), ("dose", "summe_l"), ("Davka", "celkem"), ("avg_dose", "quantite"),
    ],
)  # fmt: skip
def test_the_rate_is_taken_and_not_the_total_beside_it(
    tmp_path: Path, name: str, rate: str, beside: str
) -> None:
    if rate == "DOSETOTAL":
        rate, beside = beside, rate
    path = by_gdal(tmp_path / name, {beside: [3.6, 4.7], rate: [20, 26]})
    assert rates(path, unit="L/ha") == (rate, (20.0, 26.0))


@EVERY
@pytest.mark.parametrize(
    ("one", "two"),
    [("rate_max", "amount"), ("DOSE_TOT", "menge"), ("rate_zone", "value"), ("rate", "MeanRate")],
)
def test_two_columns_that_could_be_the_rate_are_asked_about(
    tmp_path: Path, name: str, one: str, two: str
) -> None:
    path = by_gdal(tmp_path / name, {one: [3, 4], two: [20, 26]})
    said = refused(path, "several-columns", unit="L/ha")
    assert one in said and two in said and "--rate-field" in said
    assert rates(path, unit="L/ha", rate_field=two) == (two, (20.0, 26.0))


@EVERY
@pytest.mark.parametrize("total", ["DOSE_TOT", "Menge_l", "TotalRate", "Summe"])
def test_a_total_alone_is_no_rate(tmp_path: Path, name: str, total: str) -> None:
    path = by_gdal(tmp_path / name, {total: [3.6, 4.7]})
    assert f"{total} is a total by its name" in refused(path, "no-rate-column", unit="L/ha")


@EVERY
def test_values_that_grow_with_the_area_are_a_total(tmp_path: Path, name: str) -> None:
    widths = (1, 2, 4, 3, 9)
    litres = [3.6, 8.9, 13.1, 11.7, 31.0]
    path = by_gdal(tmp_path / name, {"dose": litres}, widths)
    assert "dose is a total" in refused(path, "total-column", unit="L/ha")
    asked = read_map(path, unit="L/ha", rate_field="dose")
    assert "total-column" in {problem.code for problem in asked.problems}
    path = by_gdal(tmp_path / name, {"dose": [20, 26, 18, 20, 24]}, widths)
    assert rates(path, unit="L/ha") == ("dose", (18.0, 20.0, 24.0, 26.0))


@EVERY
@pytest.mark.parametrize("text", ["18,5", "18.5 L/ha", "18.5l/ha"])
def test_a_column_of_rates_as_text_is_named(tmp_path: Path, name: str, text: str) -> None:
    path = by_gdal(tmp_path / name, {"dose": [text, text], "value": [1, 2]})
    code = "decimal-comma" if name == "rx.csv" and text == "18,5" else "text-rate"
    assert text in refused(path, code, unit="L/ha")


@pytest.mark.parametrize("name", ["rx.shp", "rx.geojson", "rx.gpkg"])
def test_a_weak_column_is_not_taken_beside_a_blank_rate(tmp_path: Path, name: str) -> None:
    path = by_gdal(tmp_path / name, {"dose": [None, None], "value": [1, 2]})
    refused(path, "null-rate", unit="L/ha")


@EVERY
def test_a_record_without_a_unit_does_not_take_its_neighbours(tmp_path: Path, name: str) -> None:
    path = by_gdal(tmp_path / name, {"rate": [20, 26, 12], "unit": ["gal/ac", None, None]}, [1] * 3)
    assert "record 2 has no unit, others gal/ac" in refused(path, "no-unit")
    assert read_map(path, unit="gal/ac").unit == "gal/ac"
    path = by_gdal(tmp_path / name, {"rate": [20, None], "unit": ["gal/ac", None]})
    assert read_map(path).unit == "gal/ac"


@EVERY
def test_a_weight_by_its_name_is_asked_about(tmp_path: Path, name: str) -> None:
    for column in ("kg_ha", "DosisKgHa", "kg_ha_rate"):
        path = by_gdal(tmp_path / name, {column: [20, 26]})
        assert "kg/ha, but L/ha is asked for" in refused(path, "unit-conflict", unit="L/ha")
    path = by_gdal(tmp_path / name, {"L_ha": [20, 26], "area": [1, 2]})
    assert rates(path) == ("L_ha", (20.0, 26.0))


@EVERY
def test_advice_quotes_names_as_a_shell_wants_them(tmp_path: Path, name: str) -> None:
    path = by_gdal(tmp_path / name, {"rate a": [20, 26], "dose b": [1, 2]})
    assert "'rate a', 'dose b'" in refused(path, "several-columns", unit="L/ha")


@pytest.mark.parametrize(
    ("unit", "name"),
    [
        ("L/da", "L/da"), ("Lt/Da", "L/da"), ("L/dönüm", "L/da"), ("l/dekar", "L/da"),
        ("λίτρα/στρέμμα", "L/da"), ("L/10a", "L/da"), ("lts/ha", "L/ha"), ("Lts/Ha.", "L/ha"),
        ("litros/ha", "L/ha"), ("litros por hectárea", "L/ha"), ("litri/ettaro", "L/ha"),
        ("Liter je Hektar", "L/ha"), ("litres par hectare", "L/ha"), ("л/га", "L/ha"),
        ("литров на гектар", "L/ha"), ("litrów/ha", "L/ha"), ("升/公顷", "L/ha"), ("ℓ/ha", "L/ha"),
        ("リットル/ha", "L/ha"), ("Ｌ／ｈａ", "L/ha"), ("GPA", "gal/ac"), ("µL/m2", None),
    ],
)  # fmt: skip
def test_units_in_the_languages_of_those_who_write_maps(
    tmp_path: Path, unit: str, name: str | None
) -> None:
    path = by_gdal(tmp_path / "rx.gpkg", {"rate": [20, 26], "unit": [unit, unit]})
    if name is None:
        assert "is none that is known here" in refused(path, "not-a-volume")
        return
    factor = {"L/ha": 1.0, "L/da": 10.0, "gal/ac": 9.353958}[name]
    assert read_map(path).unit == name
    assert read_map(path).rates_l_ha == pytest.approx((20 * factor, 26 * factor))
    assert read_map(path, unit=unit).unit == name


def test_is_not_a_volume_per_area_is_said_only_where_it_is_so(tmp_path: Path) -> None:
    path = by_gdal(tmp_path / "rx.gpkg", {"rate": [20, 26]})
    for unit in ("kg", "Liter", "seeds/ha", "t N/ha", "%"):
        assert "is not a volume per area" in refused(path, "not-a-volume", unit=unit)
    for unit in ("Einh.", "L/fanega", "foo"):
        assert "is none that is known here" in refused(path, "not-a-volume", unit=unit)


# Deleted records of a shapefile.


def deleted(tmp_path: Path, index: int) -> Path:
    path = by_gdal(tmp_path / "rx.shp", {"rate": [18, 26, 12]}, [1] * 3)
    content = bytearray(path.with_suffix(".dbf").read_bytes())
    header, width = struct.unpack("<HH", content[8:12])
    content[header + index * width] = ord("*")
    path.with_suffix(".dbf").write_bytes(content)
    return path


@pytest.mark.parametrize("index", [0, 1, 2])
def test_a_deleted_record_is_no_ground(tmp_path: Path, index: int) -> None:
    path = deleted(tmp_path, index)
    left = [cell(number) for number in range(3) if number != index]
    found = read_map(path, unit="L/ha")
    assert [zone.geometry.equals(one) for zone, one in zip(found.zones, left, strict=True)]
    (problem,) = found.problems
    assert (problem.code, problem.text) == ("stray-records", "1 deleted record is left out")
    assert read_area(path).symmetric_difference(shapely.union_all(left)).area < 1e-14
    assert len(read_records(path)) == 2


def test_a_plan_leaves_deleted_ground_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = deleted(tmp_path, 2)
    assert execute(["plan", str(path), "--rate-l-ha", "20", "--out", str(tmp_path / "x.plan")]) == 0
    out = capsys.readouterr().out
    whole_ha = 2 * 9.03 * 11.1 / 1e4
    assert f"{whole_ha:.3f}"[:4] in out, out


# CSV points.


def points(path: Path, *more: str, values: Sequence[str] = ()) -> Path:
    rows = [
        f"{SOUTH + row * CELL:.7f},{WEST + column * CELL:.7f},{18.5 + row}"
        for row in range(4)
        for column in range(4)
    ]
    for number, value in enumerate(values):
        rows[number] = f"{rows[number].rpartition(',')[0]},{value}"
    path.write_text("\n".join(["lat,lon,rate", *rows, *[rows[int(one)] for one in more], ""]))
    return path


def test_rows_once_more_are_dropped_and_the_lattice_stays(tmp_path: Path) -> None:
    once = read_map(points(tmp_path / "once.csv"), unit="L/ha")
    twice = read_map(points(tmp_path / "twice.csv", "0", "5", "5"), unit="L/ha")
    assert once.cells is not None and twice.cells is not None
    np.testing.assert_array_equal(once.cells.rates_l_ha, twice.cells.rates_l_ha)
    assert once.cells.transform == pytest.approx(twice.cells.transform, abs=1e-12)
    (problem,) = twice.problems
    assert problem.code == "duplicate-points"
    assert "3 rows" in problem.text and "line 18 is of the place of line 2" in problem.text


@pytest.mark.parametrize("value", ["30", ""])
def test_two_rates_at_one_place_are_refused(tmp_path: Path, value: str) -> None:
    path = points(tmp_path / "rx.csv")
    path.write_text(path.read_text() + f"{SOUTH:.7f},{WEST:.7f},{value}\n")
    said = refused(path, "two-rates", unit="L/ha")
    assert "lines 2 and 18 are of one place" in said


def test_what_differs_beside_the_rate_is_no_second_rate(tmp_path: Path) -> None:
    path = points(tmp_path / "rx.csv", "0")
    lines = path.read_text().split()
    path.write_text("\n".join(f"{line},{n or 'id'}" for n, line in enumerate(lines)) + "\n")
    assert read_map(path, unit="L/ha").rate_field == "rate"
    refused(path, "two-rates", unit="L/ha", rate_field="id")


def test_a_bad_rate_is_named_by_its_line(tmp_path: Path) -> None:
    path = points(tmp_path / "rx.csv", values=["18", "19", "-5"])
    assert "rate of line 4 is -5.0" in refused(path, "bad-rate", unit="L/ha")


def test_a_bad_rate_does_not_hide_among_its_neighbours(tmp_path: Path) -> None:
    generator = np.random.default_rng(3)
    at = generator.random((200, 2)) * 20 * CELL + (SOUTH, WEST)
    at[77] = at[76] + 4e-6
    rows = [f"{lat:.7f},{lon:.7f},20" for lat, lon in at]
    rows[77] = rows[77].replace(",20", ",-9")
    path = tmp_path / "rx.csv"
    path.write_text("\n".join(["lat,lon,rate", *rows, ""]))
    assert "rate of line 79 is -9.0" in refused(path, "bad-rate", unit="L/ha")


def test_one_column_that_is_something_else_is_no_rate(tmp_path: Path) -> None:
    path = points(tmp_path / "rx.csv")
    for name in ("ndvi", "id", "total", "elevation"):
        path.write_text(path.read_text().replace("rate\n", f"{name}\n", 1))
        assert name in refused(path, "no-rate-column", unit="L/ha")
        path.write_text(path.read_text().replace(f"{name}\n", "rate\n", 1))


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-32", "utf-16-be"])
def test_iconv_is_told_the_encoding_that_the_file_shows(tmp_path: Path, encoding: str) -> None:
    path = points(tmp_path / "my map.csv")
    path.write_bytes(path.read_text().encode(encoding))
    said = refused(path, "encoding", unit="L/ha")
    wanted = {"utf-16-le": "UTF-16LE", "utf-16-be": "UTF-16BE"}.get(encoding, encoding.upper())
    assert f"iconv -f {wanted} -t UTF-8 '{path}'" in said


# Laws of names and values.

RATE = st.sampled_from(["dose", "Rate", "DOSIS", "taxa", "dawka", "Aufwand", "施药量", "норма"])
TOTAL = st.sampled_from(["tot", "Total", "GES", "summe", "soma", "celkem", "всего"])
WEAK = st.sampled_from(["amount", "Menge", "volume", "Quantity", "value", "mængde"])
JOIN = st.sampled_from(["_", " ", "-", ""])
AMOUNT = st.floats(0.5, 500.0)


def names(*parts: st.SearchStrategy[str]) -> st.SearchStrategy[str]:
    return st.tuples(JOIN, st.permutations(range(len(parts))), *parts).map(
        lambda found: found[0].join(
            [str(found[2 + at]) if found[0] else str(found[2 + at]).title() for at in found[1]]
        )
    )


def column(name: str, values: Sequence[Value]) -> Column:
    return Column(name=name, values=tuple(values), numeric=True)


@given(total=names(RATE, TOTAL), weak=WEAK, rate=RATE, values=st.lists(AMOUNT, min_size=2))
@settings(deadline=None)
def test_a_total_is_never_taken_and_nothing_weak_beside_it(
    total: str, weak: str, rate: str, values: list[float]
) -> None:
    doubled = [2.0 * value for value in values]
    assert score(column(total, values)) < 0
    taken = choose([column(total, values), column(rate, doubled)], asked=None, path=Path("rx"))
    assert taken.column.name == rate
    for columns in ([total], [total, weak]):
        with pytest.raises(MapError):
            choose([column(one, values) for one in columns], asked=None, path=Path("rx"))


@given(
    zones=st.lists(
        st.tuples(st.floats(15.0, 25.0), st.floats(0.05, 50.0)), min_size=4, max_size=40
    ),
    unit=st.floats(1e-12, 1e6),
)
@settings(deadline=None)
def test_the_litres_of_zones_of_many_sizes_are_never_taken_for_rates(
    zones: list[tuple[float, float]], unit: float
) -> None:
    rate, area = np.array(zones).T
    litres = column("dose", (rate * area).tolist())
    if np.log(area).std() > 1.0:
        with pytest.raises(MapError, match="is a total"):
            choose([litres], asked=None, path=Path("rx"), areas=unit * area)
    # Rates are taken whatever the sizes are, but for those that follow them as closely.
    if np.log(rate / area).std() > np.log(rate).std():
        plain = column("dose", rate.tolist())
        assert choose([plain], asked=None, path=Path("rx"), areas=unit * area).column is plain
