"""Polygons inside polygons are no ground unasked, and --crs holds, in every format alike."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from shapely import MultiPolygon, Polygon, affinity, box
from shapely.geometry import mapping

from companion.cli.app import execute
from companion.errors import MapError
from missions.errors import PlanError
from missions.maps.lint import check_map, point_rates
from missions.maps.registry import read_area, read_map
from missions.maps.totals import totals
from missions.reading_outline import outline_of, told
from tests.file_kinds import writers
from tests.file_kinds.ground import FIELD, HOLED, ISLAND, Ground
from tests.missions.isoxml_documents import document, field, polygon, ring, task, value, zone

NESTED = MultiPolygon([FIELD, ISLAND])
FORMATS = {name: write for name, write in writers.VECTOR.items() if name != "ISOXML"}
every_format = pytest.mark.parametrize("write", FORMATS.values(), ids=list(FORMATS))


def ground(*polygons: Polygon | MultiPolygon, **more: object) -> Ground:
    columns = {"rate": [20.0] * len(polygons)}
    return Ground(polygons=polygons, columns=columns, **more)  # type: ignore[arg-type]


def refused(path: Path, **how: object) -> str:
    with pytest.raises(MapError) as caught:
        read_area(path, **how)  # type: ignore[arg-type]
    assert caught.value.code == "nested-polygon"
    return str(caught.value)


@every_format
def test_a_record_inside_another_is_no_ground_of_an_outline(
    tmp_path: Path, write: writers.Writer
) -> None:
    path = write(ground(FIELD, ISLAND), tmp_path)
    said = refused(path)
    assert "record 2: it (400 m2 at 48.0002" in said
    assert "lies inside record 1" in said
    assert "--no-spray" in said
    with pytest.raises(MapError, match="lies inside record 1"):
        outline_of(path, None, [])


@every_format
def test_what_is_kept_from_spraying_may_lie_in_each_other(
    tmp_path: Path, write: writers.Writer
) -> None:
    path = write(ground(FIELD, ISLAND), tmp_path)
    whole = write(ground(FIELD), tmp_path)
    assert read_area(path, nested=True).area == pytest.approx(read_area(whole).area)


@every_format
def test_a_part_inside_another_of_its_record_is_refused_in_maps_and_outlines(
    tmp_path: Path, write: writers.Writer
) -> None:
    if "shapefile" in str(write.__qualname__):
        pytest.skip("GDAL turns it into a hole")
    path = write(ground(NESTED, affinity.translate(FIELD, 100.0)), tmp_path)
    if path.suffix in (".shp", ".zip"):
        return
    assert "a polygon of it (400 m2" in refused(path)
    with pytest.raises(MapError, match="lies inside another of it"):
        read_map(path, unit="L/ha")


def test_a_ring_of_a_shapefile_turned_like_its_shell_is_refused(tmp_path: Path) -> None:
    path = FORMATS["shapefile"](ground(HOLED), tmp_path)
    writers.turn_ring(path, 1)
    with pytest.raises(MapError, match="lies inside another of it, and would be sprayed"):
        read_map(path, unit="L/ha")


@every_format
def test_neighbours_duplicates_and_slight_overlaps_are_one_outline(
    tmp_path: Path, write: writers.Writer
) -> None:
    beside, over = affinity.translate(FIELD, 60.0), affinity.translate(FIELD, 57.0)
    one = read_area(write(ground(FIELD), tmp_path)).area
    assert read_area(write(ground(FIELD, FIELD), tmp_path)).area == pytest.approx(one)
    assert read_area(write(ground(FIELD, beside), tmp_path)).area == pytest.approx(2.0 * one)
    assert read_area(write(ground(FIELD, over), tmp_path)).area == pytest.approx(1.95 * one)


def test_a_pond_that_sticks_out_a_little_is_asked_about(tmp_path: Path) -> None:
    pond = box(50.0, 20.0, 65.0, 40.0)
    refused(writers.geojson_by_hand(ground(FIELD, pond), tmp_path))


def test_a_boundary_beside_the_zones_is_under_the_same_rule(tmp_path: Path) -> None:
    path = writers.geojson_by_hand(ground(FIELD), tmp_path)
    content = json.loads(path.read_text())
    nested = ground(NESTED).native()[0]
    content["boundary"] = {
        "type": "MultiPolygon",
        "coordinates": [[np.array(part.exterior.coords).tolist()] for part in nested.geoms],
    }
    path.write_text(json.dumps(content))
    with pytest.raises(MapError) as caught:
        read_map(path, unit="L/ha")
    assert caught.value.code == "nested-polygon"


def test_zones_of_the_prescription_itself_are_left_to_its_rule_of_overlaps(tmp_path: Path) -> None:
    path = writers.geojson_by_hand(ground(FIELD, ISLAND), tmp_path)
    whole = outline_of(path, read_map(path, unit="L/ha"), [])
    assert whole.area == pytest.approx(read_area(path, nested=True).area)


# ISOXML by hand: the field and its zones.

OUTER, INNER = ground(FIELD).degrees()[0], ground(ISLAND).degrees()[0]


def written(folder: Path, *inside: str) -> Path:
    (folder / "TASKDATA.XML").write_bytes(document(*inside))
    return folder


def prescribed(*polygons: str) -> str:
    return task(zone(1, *polygons, value(2000)), more='E="PFD1"')


@pytest.mark.parametrize(
    "inside",
    [polygon(OUTER) + polygon(INNER), f'<PLN A="2">{ring(OUTER)}{ring(INNER)}</PLN>'],
    ids=["two polygons", "two exteriors"],
)
def test_isoxml_zones_that_lie_in_each_other_are_refused(tmp_path: Path, inside: str) -> None:
    path = written(tmp_path, field(OUTER), prescribed(inside))
    with pytest.raises(MapError, match=r"treatment zone 1.* lies inside another of it") as caught:
        read_map(path, unit="L/ha")
    assert caught.value.code == "nested-polygon"


def test_an_isoxml_field_that_lies_in_itself_is_refused(tmp_path: Path) -> None:
    more = f'<PFD A="PFD1" C="f">{polygon(OUTER, 1)}{polygon(INNER, 1)}</PFD>'
    path = written(tmp_path, more, prescribed(polygon(OUTER)))
    with pytest.raises(MapError, match="field PFD1"):
        read_map(path, unit="L/ha")


@pytest.mark.parametrize("kind", [1, 2, 5])
def test_an_obstacle_of_one_ring_is_that_ring_whatever_its_type(tmp_path: Path, kind: int) -> None:
    pond = f'<PLN A="3">{ring(INNER, kind)}</PLN>'
    more = f'<PFD A="PFD1" C="f">{polygon(OUTER, 1)}{pond}</PFD>'
    found = read_area(written(tmp_path, more, prescribed(polygon(OUTER))))
    assert found.area == pytest.approx(OUTER.area - INNER.area)


# --crs holds where what the file says is unusable.

LOCAL_CS = 'LOCAL_CS["Undefined SRS",UNIT["metre",1]]'


def local(folder: Path, kind: str) -> Path:
    write = {"shp": "shapefile", "gpkg": "GeoPackage"}.get(kind, "GeoJSON by hand")
    text = LOCAL_CS if kind == "gpkg" else None
    path = FORMATS[write](ground(FIELD, crs_text=text), folder)
    if kind == "shp":
        path.with_suffix(".prj").write_text(LOCAL_CS)
    elif kind == "json":
        content = json.loads(path.read_text())
        content["crs"] = {"type": "name", "properties": {"name": "local:1"}}
        path.write_text(json.dumps(content))
    return path


@pytest.mark.parametrize("kind", ["shp", "gpkg", "json"])
def test_what_names_no_usable_crs_is_read_in_that_of_the_operator(
    tmp_path: Path, kind: str
) -> None:
    path = local(tmp_path, kind)
    with pytest.raises(MapError, match="--crs"):
        read_map(path, unit="L/ha")
    found = read_map(path, unit="L/ha", crs="EPSG:4326")
    assert found.zones[0].geometry.bounds == pytest.approx(OUTER.bounds)
    codes = [problem.code for problem in found.problems]
    assert codes == ([] if kind == "gpkg" else ["crs-overridden"])
    asked = {"crs": "EPSG:4326"}
    area = told(lambda **answers: read_area(path, **answers), asked)
    assert area.bounds == pytest.approx(OUTER.bounds)


def test_an_empty_prj_is_called_empty(tmp_path: Path) -> None:
    path = local(tmp_path, "shp")
    path.with_suffix(".prj").write_text("")
    with pytest.raises(MapError, match=r"its \.prj is empty"):
        read_map(path, unit="L/ha")
    path.with_suffix(".prj").unlink()
    with pytest.raises(MapError, match=r"no \.prj beside it"):
        read_map(path, unit="L/ha")


# A field of ISOXML without a task is an outline; a task with one rate and no ground is its field's.

FIELD_ONLY = (
    f'<PFD A="PFD1" C="north">{polygon(OUTER, 1)}{polygon(INNER, 6)}{polygon(INNER, 10)}</PFD>'
)


def test_a_field_without_a_task_is_an_outline_and_no_map(tmp_path: Path) -> None:
    path = written(tmp_path, FIELD_ONLY)
    assert outline_of(path, None, []).area == pytest.approx(OUTER.area - INNER.area)
    with pytest.raises(MapError, match="none of its 0 tasks has treatment zones"):
        read_map(path, unit="L/ha")


def test_of_several_fields_one_is_chosen(tmp_path: Path) -> None:
    other = Polygon([(x + 0.01, y) for x, y in OUTER.exterior.coords])
    path = written(tmp_path, FIELD_ONLY, f'<PFD A="PFD2" C="south">{polygon(other, 1)}</PFD>')
    with pytest.raises(MapError, match=r"several fields: PFD1 \(north\), PFD2 \(south\)"):
        read_area(path)
    assert read_area(path, layer="south").area == pytest.approx(OUTER.area)
    assert outline_of(path, None, [], {"layer": "PFD2"}).area == pytest.approx(OUTER.area)


def test_a_lone_task_with_one_rate_is_for_its_field(tmp_path: Path) -> None:
    lone = task(zone(1, value(200_000)), more='E="PFD1"')
    found = read_map(written(tmp_path, FIELD_ONLY, lone))
    assert found.rates_l_ha == (20.0,)
    assert found.zones[0].geometry.area == pytest.approx(OUTER.area - INNER.area)
    assert "rate-of-field" in [problem.code for problem in found.problems]


@pytest.mark.parametrize(
    "inside",
    [
        task(zone(1, value(200_000)), zone(2, value(100_000)), more='E="PFD1"'),
        task(zone(1, value(200_000))),
        task(zone(1, value(200_000)), more='E="PFD1"') + task(zone(1), own="TSK2"),
    ],
    ids=["two rates", "no field", "two tasks"],
)
def test_a_rate_without_ground_is_laid_over_nothing_else(tmp_path: Path, inside: str) -> None:
    with pytest.raises(MapError, match="neither polygons nor a grid"):
        read_map(written(tmp_path, FIELD_ONLY, inside))


def test_two_sets_of_task_data_are_refused_at_any_depth(tmp_path: Path) -> None:
    written(tmp_path, FIELD_ONLY)
    deep = tmp_path / "backup" / "TASKDATA"
    deep.mkdir(parents=True)
    (deep / "taskdata.xml").write_bytes(document(FIELD_ONLY))
    for path in (tmp_path, tmp_path / "backup"):
        if path == tmp_path:
            with pytest.raises(MapError, match=r"several sets .*backup/TASKDATA/taskdata\.xml"):
                read_area(path)
        else:
            assert read_area(path).area > 0.0
    assert read_area(tmp_path / "TASKDATA.XML").area > 0.0


# A zone drawn twice is one zone, and a flight map is read by the rule that was frozen in it.


@every_format
def test_a_zone_drawn_twice_with_one_rate_is_one(tmp_path: Path, write: writers.Writer) -> None:
    beside = affinity.translate(FIELD, 60.0)
    path = write(ground(FIELD, beside, FIELD), tmp_path)
    found = read_map(path, unit="L/ha")
    assert len(found.zones) == 2
    assert totals(found).all_litres == pytest.approx(2 * 7.2, rel=1e-3)
    assert [problem.code for problem in check_map(found)] == ["repeated-zone"]


def test_a_zone_drawn_twice_with_two_rates_still_overlaps(tmp_path: Path) -> None:
    made = Ground(polygons=(FIELD, FIELD), columns={"rate": [20.0, 26.0]})
    found = read_map(writers.geojson_by_hand(made, tmp_path), unit="L/ha")
    assert [problem.code for problem in check_map(found)] == ["overlap"]


def test_a_flight_map_is_read_by_its_own_rule_of_overlaps(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    over = affinity.translate(FIELD, 30.0)
    made = Ground(polygons=(FIELD, over), columns={"rate": [20.0, 30.0], "unit": ["L/ha"] * 2})
    source = writers.geojson_by_hand(made, tmp_path)
    path = tmp_path / "f.flightmap.gpkg"
    compiled = ["map", "compile", str(source), "--overlap", "max", "--out", str(path)]
    assert execute(compiled) == 0
    capsys.readouterr()

    def asked(*arguments: str) -> dict[str, object]:
        assert execute(["map", *arguments, "--json"]) == 0
        found: dict[str, object] = json.loads(capsys.readouterr().out)
        return found

    litres = pytest.approx(0.18 * 20.0 + 0.36 * 30.0, rel=1e-3)
    assert asked("check", str(path))["litres"] == litres
    assert asked("show", str(path), "--out", str(tmp_path / "m.png"))["litres"] == litres
    assert asked("rate", str(path), "48.0002", "11.0006")["rate_l_ha"] == 30.0
    assert execute(["map", "check", str(path), "--overlap", "min"]) == 2
    assert "it was compiled with the rule max" in capsys.readouterr().err


# The 180th meridian: RFC 7946 cuts a field there, others write 180.0004 or -180.0004.

HALVES = (box(179.9996, -17.0, 180.0, -16.9995), box(-180.0, -17.0, -179.9996, -16.9995))


def over_meridian(folder: Path, *polygons: Polygon | MultiPolygon) -> Path:
    path = folder / "fiji.geojson"
    features = [
        {"type": "Feature", "geometry": mapping(one), "properties": {"rate": 20.0, "unit": "L/ha"}}
        for one in polygons
    ]
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    return path


@pytest.mark.parametrize(
    "polygons",
    [
        (MultiPolygon(HALVES),),
        HALVES,
        (box(179.9996, -17.0, 180.0004, -16.9995),),
        (box(-180.0004, -17.0, -179.9996, -16.9995),),
    ],
    ids=["parts", "records", "beyond 180", "beyond -180"],
)
def test_a_map_over_the_180th_meridian_is_one_field(
    tmp_path: Path, polygons: tuple[Polygon | MultiPolygon, ...]
) -> None:
    path = over_meridian(tmp_path, *polygons)
    found = read_map(path)
    assert totals(found).area_ha == pytest.approx(0.4713, rel=1e-3)
    both = point_rates(found, [(-16.9998, 179.9998), (-16.9998, -179.9998), (-16.9998, 179.9)])
    assert [row["rate_l_ha"] for row in both] == [20.0, 20.0, None]
    with pytest.raises(PlanError, match="180th meridian"):
        outline_of(path, None, [])
    compiled = tmp_path / "f.flightmap.gpkg"
    assert execute(["map", "compile", str(path), "--out", str(compiled)]) in (0, 1)
    again = read_map(compiled)
    assert totals(again).area_ha == pytest.approx(0.4713, rel=1e-3)


def test_no_plan_is_made_beside_the_180th_meridian(tmp_path: Path) -> None:
    path = over_meridian(tmp_path, box(179.9988, -17.0, 179.99998, -16.9995))
    with pytest.raises(PlanError, match="180th meridian"):
        outline_of(path, None, [])


def test_longitudes_of_two_continents_are_not_brought_together(tmp_path: Path) -> None:
    with pytest.raises(MapError, match="degrees of longitude"):
        read_map(over_meridian(tmp_path, box(170, 0, 170.001, 1), box(-140, 0, -139.9, 1)))


def test_a_rate_of_minus_nothing_is_nothing(tmp_path: Path) -> None:
    made = Ground(polygons=(FIELD,), columns={"rate": [-0.0]})
    found = read_map(writers.geojson_by_hand(made, tmp_path), unit="L/ha")
    assert f"{found.rates_l_ha[0]:g}" == "0"


@every_format
def test_records_far_from_all_others_are_named(tmp_path: Path, write: writers.Writer) -> None:
    far = [affinity.translate(FIELD, 60.0 * k + 3e6 * (k > 3), 0.0) for k in range(6)]
    path = write(ground(*far), tmp_path)
    for read in (partial(read_map, unit="L/ha"), read_area):
        with pytest.raises(MapError, match="2 of 6 records lie far from all others: 5, 6 "):
            read(path)  # type: ignore[operator]
