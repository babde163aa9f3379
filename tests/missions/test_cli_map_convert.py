"""`map convert` and `map show` as they are typed."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import rasterio.warp
import shapely
import typer
from pyproj import CRS, Geod
from shapely import MultiPolygon, Polygon, box

from companion.errors import MapError
from missions.maps.cli import convert as convert_cli
from missions.maps.convert.formats import WRITERS, Writer, write_map
from missions.maps.model import MapCells, MapFile
from missions.maps.registry import read_map

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
PLOTS = EXAMPLES / "anyang" / "prescription.shp"
ORCHARD = EXAMPLES / "orchard" / "prescription.shp"
FLOW = ("--flow-width-m", "6", "--flow-speed-m-s", "5")

Captured = pytest.CaptureFixture[str]

app = typer.Typer(add_completion=False)
app.command()(convert_cli.convert)
app.command()(convert_cli.show)


def run(*arguments: object) -> int:
    words = [str(one) for one in arguments]
    result = typer.main.get_command(app).main(words, prog_name="map", standalone_mode=False)
    return result if isinstance(result, int) else 0


def run_json(capsys: Captured, *arguments: object) -> tuple[int, dict[str, Any]]:
    code = run(*arguments, "--json")
    found = json.loads(capsys.readouterr().out)
    assert isinstance(found, dict)
    return code, found


@pytest.mark.parametrize("file", ["a.shp", "a.geojson", "a.gpkg", "a.kmz", "a.xml"])
def test_zones_stay_zones_and_keep_their_rates(tmp_path: Path, capsys: Captured, file: str) -> None:
    code, found = run_json(capsys, "convert", PLOTS, tmp_path / file)
    assert code == 0
    assert (found["ok"], found["zones"], found["rows"]) == (True, 40, None)
    assert found["max_rate_change_l_ha"] <= 0.01
    assert found["points_compared"] == 1000
    assert found["area_ha"] == pytest.approx(0.288, rel=1e-3)
    assert found["litres"] == pytest.approx(found["source_litres"], rel=1e-6)
    assert found["out"] == str(tmp_path / file)
    assert sorted(found["files"]) == sorted(str(one) for one in tmp_path.iterdir())


@pytest.mark.parametrize("file", ["a.tif", "a.txt"])
def test_cells_hold_nearly_the_same_ground(tmp_path: Path, capsys: Captured, file: str) -> None:
    code, found = run_json(capsys, "convert", ORCHARD, tmp_path / file, *FLOW, "--cell-m", "1")
    assert code == 0
    assert found["rows"] * found["columns"] > 10_000
    assert found["max_rate_change_l_ha"] <= 0.01
    assert found["points_compared"] > 1000
    assert found["litres"] == pytest.approx(found["source_litres"], rel=0.005)


@pytest.mark.parametrize(
    ("file", "more"),
    [("a.tif", ()), ("a.zip", ("--format", "dji")), ("a.txt", (*FLOW,))],
)
def test_cells_that_change_the_area_are_told(
    tmp_path: Path, capsys: Captured, file: str, more: tuple[str, ...]
) -> None:
    out = tmp_path / file
    code, found = run_json(capsys, "convert", PLOTS, out, *more, "--cell-m", "2")
    assert code == 0
    assert abs(found["area_ha"] / found["source_area_ha"] - 1.0) > 0.001
    (problem,) = (one for one in found["problems"] if one["code"] == "area-changed")
    assert problem["severity"] == "warning"
    for name in ("area_ha", "source_area_ha"):
        assert f"{found[name]:.4f} ha" in problem["text"]
    assert "--cell-m" in problem["fix"]


def test_cells_and_zones_of_the_same_area_say_nothing(
    tmp_path: Path, capsys: Captured, raster: Path
) -> None:
    for source, file in ((raster, "a.tif"), (PLOTS, "a.shp"), (raster, "TASKDATA.XML")):
        code, found = run_json(capsys, "convert", source, tmp_path / file)
        assert (code, found["problems"]) == (0, [])


def test_a_person_reads_what_was_written_and_compared(tmp_path: Path, capsys: Captured) -> None:
    assert run("convert", PLOTS, tmp_path / "a.shp") == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"{tmp_path / 'a.shp'}: shapefile, 40 zones, 0.2880 ha, 5.9 L"
    assert "largest difference at 1000 places: 0 L/ha" in lines
    assert f"also written: {tmp_path / 'a.dbf'}" in lines
    assert f"also written: {tmp_path / 'a.shp'}" not in lines


def test_a_zip_needs_its_format(tmp_path: Path, capsys: Captured) -> None:
    with pytest.raises(MapError) as caught:
        run("convert", PLOTS, tmp_path / "a.zip")
    assert caught.value.code == "several-formats"
    code, found = run_json(capsys, "convert", PLOTS, tmp_path / "a.zip", "--format", "DJI")
    assert (code, found["format"], found["boundary"]) == (0, "dji", True)


def test_nothing_is_replaced_without_force(tmp_path: Path, capsys: Captured) -> None:
    (tmp_path / "a.kml").write_text("mine", "utf-8")
    with pytest.raises(MapError, match="--force") as caught:
        run("convert", PLOTS, tmp_path / "a.kml")
    assert caught.value.code == "file-exists"
    assert (tmp_path / "a.kml").read_text("utf-8") == "mine"
    assert run_json(capsys, "convert", PLOTS, tmp_path / "a.kml", "--force")[0] == 0
    assert len(read_map(tmp_path / "a.kml").zones) == 40


def test_a_map_may_be_converted_onto_itself(tmp_path: Path, capsys: Captured) -> None:
    run("convert", PLOTS, tmp_path / "a.geojson")
    before = (tmp_path / "a.geojson").read_bytes()
    run("convert", tmp_path / "a.geojson", tmp_path / "a.geojson", "--force")
    assert (tmp_path / "a.geojson").read_bytes() == before


def broken(writer: Writer, monkeypatch: pytest.MonkeyPatch, add_l_ha: float) -> None:
    """Let a writer write every rate wrongly."""

    def wrong(map_file: Any, path: Path, wish: Any) -> None:
        zones = [replace(zone, rate_l_ha=zone.rate_l_ha + add_l_ha) for zone in map_file.zones]
        writer.write(replace(map_file, zones=tuple(zones)), path, wish)

    monkeypatch.setitem(WRITERS, writer.name, replace(writer, write=wrong))


def test_a_writer_that_changes_a_rate_is_caught_and_nothing_kept(
    tmp_path: Path, capsys: Captured, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken(WRITERS["geopackage"], monkeypatch, 0.011)
    code, found = run_json(capsys, "convert", PLOTS, tmp_path / "a.gpkg")
    assert (code, found["ok"], found["code"]) == (1, False, "not-preserved")
    assert "0.011 L/ha" in found["error"]
    assert str(tmp_path / "a.gpkg") in found["error"]
    assert list(tmp_path.iterdir()) == []
    broken(WRITERS["geojson"], monkeypatch, 0.009)
    code, found = run_json(capsys, "convert", PLOTS, tmp_path / "a.geojson")
    assert code == 0
    assert found["max_rate_change_l_ha"] == pytest.approx(0.009)


def test_what_does_not_read_back_is_not_kept(
    tmp_path: Path, capsys: Captured, monkeypatch: pytest.MonkeyPatch
) -> None:
    cut = replace(WRITERS["kml"], write=lambda _map, path, _wish: path.write_text("<kml", "utf-8"))
    monkeypatch.setitem(WRITERS, "kml", cut)
    assert run("convert", PLOTS, tmp_path / "a.kml") == 1
    caught = capsys.readouterr()
    assert caught.err.startswith(f"error: {tmp_path / 'a.kml'}: what was written does not read")
    assert caught.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_rates_that_are_lost_are_named_with_a_place(
    tmp_path: Path, capsys: Captured, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer = WRITERS["geojson"]
    fewer = replace(
        writer,
        write=lambda map_file, path, wish: writer.write(
            replace(map_file, zones=map_file.zones[1:]), path, wish
        ),
    )
    monkeypatch.setitem(WRITERS, "geojson", fewer)
    code, found = run_json(capsys, "convert", PLOTS, tmp_path / "a.geojson")
    assert code == 1
    assert "a rate in one file and none in the other (at 35.99" in found["error"]


# --------------------------------------------------------------------------- cells as the source


@pytest.fixture
def raster(tmp_path: Path) -> Path:
    """Return a GeoTIFF whose cells all have different rates, and some none."""
    rates = (20.0 + np.arange(1200.0).reshape(30, 40) / 100.0).astype(np.float32)
    rates[:5, :5] = -9999.0
    path = tmp_path / "rates.tif"
    with rasterio.open(
        path, "w", driver="GTiff", width=40, height=30, count=1, dtype="float32",
        crs="EPSG:4326", transform=rasterio.Affine(2e-5, 0.0, 10.0, 0.0, -1e-5, 50.0),
        nodata=-9999.0,
    ) as target:  # fmt: skip
        target.write(rates, 1)
        target.units = ("L/ha",)
    return path


def test_cells_keep_their_lattice(tmp_path: Path, capsys: Captured, raster: Path) -> None:
    code, found = run_json(capsys, "convert", raster, tmp_path / "a.tif", "--format", "geotiff")
    assert (code, found["rows"], found["columns"]) == (0, 30, 40)
    with rasterio.open(raster) as one, rasterio.open(tmp_path / "a.tif") as two:
        assert np.array_equal(one.read(1), two.read(1))
        assert two.transform.almost_equals(one.transform, 1e-12)
    # Rates of a millionth of a litre, and 0 for the cells that had none.
    code, found = run_json(capsys, "convert", raster, tmp_path / "TASKDATA.XML")
    assert (code, found["rows"]) == (0, 30)
    assert found["max_rate_change_l_ha"] <= 5.1e-5


# Speckled, so that every edge of a cell is an edge of the rates.
SPECKLED = np.random.default_rng(3).choice([20.0, 35.0, 50.0, 65.0], (30, 40)).astype(np.float32)
TURN = np.radians(20.0)


def projected(path: Path, transform: rasterio.Affine, crs: str = "EPSG:32650") -> Path:
    with rasterio.open(
        path, "w", driver="GTiff", width=40, height=30, count=1, dtype="float32", crs=crs,
        transform=transform, nodata=-9999.0,
    ) as target:  # fmt: skip
        target.write(SPECKLED, 1)
        target.units = ("L/ha",)
    return path


def at(transform: rasterio.Affine, column: Any, row: Any) -> tuple[Any, Any]:
    a, b, c, d, e, f = transform[:6]
    return a * column + b * row + c, d * column + e * row + f


LATTICES = {
    "utm": rasterio.Affine(3.0, 0.0, 443_000.0, 0.0, -3.0, 3_984_000.0),
    "turned": rasterio.Affine(
        3.0 * np.cos(TURN), 3.0 * np.sin(TURN), 443_000.0,
        3.0 * np.sin(TURN), -3.0 * np.cos(TURN), 3_984_000.0,
    ),
    "south-first": rasterio.Affine(3.0, 0.0, 443_000.0, 0.0, 3.0, 3_984_000.0),
}  # fmt: skip


@pytest.mark.parametrize("name", LATTICES)
def test_a_geotiff_of_any_projection_stays_as_it_is(
    tmp_path: Path, capsys: Captured, name: str
) -> None:
    source = projected(tmp_path / "in.tif", LATTICES[name])
    code, found = run_json(capsys, "convert", source, tmp_path / "a.tif")
    assert (code, found["rows"], found["columns"]) == (0, 30, 40)
    assert found["changed_percent"] is None
    assert found["litres"] == pytest.approx(found["source_litres"], rel=1e-9)
    assert found["problems"] == []
    with rasterio.open(source) as one, rasterio.open(tmp_path / "a.tif") as two:
        assert two.crs == one.crs
        # By place, since the first row may be another one.
        places = [at(one.transform, c + 0.5, r + 0.5) for r in range(30) for c in range(40)]
        assert [v[0] for v in one.sample(places)] == [v[0] for v in two.sample(places)]


def sampled(path: Path, x: np.ndarray, y: np.ndarray, crs: str) -> np.ndarray:
    """Return what GDAL finds in a raster at places of EPSG:32650; NaN where there is nothing."""
    xs, ys = rasterio.warp.transform("EPSG:32650", crs, x.tolist(), y.tolist())
    with rasterio.open(path) as found:
        values = np.array([v[0] for v in found.sample(zip(xs, ys, strict=True))], dtype=float)
    values[values == -9999.0] = np.nan
    return values


@pytest.mark.parametrize("more", [(), ("--cell-m", "3"), ("--cell-m", "0.5")])
def test_what_a_new_lattice_changes_is_said_as_gdal_finds_it(
    tmp_path: Path, capsys: Captured, more: tuple[str, ...]
) -> None:
    source = projected(tmp_path / "in.tif", LATTICES["turned"])
    code, found = run_json(capsys, "convert", source, tmp_path / "a", "--format", "dji", *more)
    assert code == 0
    random = np.random.default_rng(11)
    column, row = random.uniform(0.0, 40.0, 8000), random.uniform(0.0, 30.0, 8000)
    x, y = at(LATTICES["turned"], column, row)
    one = sampled(source, x, y, "EPSG:32650")
    two = sampled(tmp_path / "a/DJI/Rx/a.tif", x, y, "EPSG:4326")
    theirs = 100.0 * float(np.mean(one != two))
    assert found["changed_percent"] == pytest.approx(theirs, rel=0.25, abs=1.0)
    assert found["max_rate_change_anywhere_l_ha"] == 45.0
    told = [one for one in found["problems"] if one["code"] == "edges-moved"]
    assert len(told) == (theirs > 5.0)
    if more == ("--cell-m", "3"):
        assert theirs > 20.0
        assert f"{found['changed_percent']:.1f} %" in told[0]["text"]
        assert "--cell-m" in told[0]["fix"]
    if not more:  # a quarter as wide as those of the source
        assert found["rows"] * found["columns"] > 16 * 1200
        assert theirs < 12.0


def test_a_person_reads_what_changed_at_the_edges(tmp_path: Path, capsys: Captured) -> None:
    source = projected(tmp_path / "in.tif", LATTICES["turned"])
    assert run("convert", source, tmp_path / "a", "--format", "dji", "--cell-m", "3") == 0
    text = capsys.readouterr().out
    assert " places away from edges: 0 L/ha" in text
    assert "one of the files alone; rates differ by up to 45 L/ha" in text


def test_ground_that_a_geotiff_leaves_out_at_the_edge_is_said(
    tmp_path: Path, capsys: Captured
) -> None:
    """A boundary across large cells, which a GeoTIFF cannot hold."""
    cells = MapCells(
        rates_l_ha=SPECKLED.astype(np.float64),
        transform=(2.4e-4, 0.0, 10.0, 0.0, 1.8e-4, 50.0), crs=CRS.from_epsg(4326),
    )  # fmt: skip
    a, e = 2.4e-4, 1.8e-4
    corners = [(3.4, 2.6), (37.7, 4.2), (35.1, 27.3), (5.2, 26.4)]
    field = Polygon([(10.0 + a * x, 50.0 + e * y) for x, y in corners])
    whole = MapFile(
        path=tmp_path, format="test", crs="EPSG:4326", unit="L/ha", rate_field="rate", zones=(),
        sha256="", cells=cells, boundary=MultiPolygon([field]),
    )  # fmt: skip
    write_map(whole, tmp_path / "TASKDATA.XML")
    code, found = run_json(capsys, "convert", tmp_path / "TASKDATA.XML", tmp_path / "a.tif")
    assert code == 0
    with rasterio.open(tmp_path / "a.tif") as made:
        values = made.read(1)
        boxes = [
            box(*at(made.transform, c, r), *at(made.transform, c + 1, r + 1))
            for r, c in zip(*np.nonzero(values != -9999.0), strict=True)
        ]
    kept = shapely.union_all(boxes)
    degrees_to_ha = Geod(ellps="WGS84").geometry_area_perimeter(field)[0] / field.area / 1e4
    lost_ha = field.difference(kept).area * abs(degrees_to_ha)
    beyond_ha = kept.difference(field).area * abs(degrees_to_ha)
    assert lost_ha / found["source_area_ha"] > 0.015
    assert found["lost_ha"] == pytest.approx(lost_ha, rel=1e-3)
    assert found["beyond_ha"] == pytest.approx(beyond_ha, rel=1e-3)
    (problem,) = (one for one in found["problems"] if one["code"] == "area-changed")
    assert f"{found['lost_ha']:.4f} ha with a rate have none in it" in problem["text"]
    assert f"{found['beyond_ha']:.4f} ha beyond" in problem["text"]
    assert "--cell-m" in problem["fix"]
    fine, finer = run_json(
        capsys, "convert", tmp_path / "TASKDATA.XML", tmp_path / "b.tif", "--cell-m", "1"
    )
    assert (fine, finer["lost_ha"] < 0.1 * found["lost_ha"]) == (0, True)


def test_messages_name_the_options_that_help(tmp_path: Path, capsys: Captured) -> None:
    many = projected(tmp_path / "in.tif", LATTICES["utm"])
    with rasterio.open(many, "r+") as target:
        target.write((20.0 + np.arange(1200.0).reshape(30, 40) / 100.0).astype("float32"), 1)
    with pytest.raises(MapError, match="different rates") as caught:
        run("convert", many, tmp_path / "TASKDATA.XML")
    assert "--round" in caught.value.fix
    thin = json.loads(json.dumps(OVERLAPPING).replace("50.0002", "50.000003"))
    (tmp_path / "thin.geojson").write_text(json.dumps(thin), "utf-8")
    code, found = run_json(
        capsys, "convert", tmp_path / "thin.geojson", tmp_path / "b.tif", "--overlap", "max"
    )
    assert (code, found["code"]) == (1, "not-preserved")
    assert "--cell-m" in found["error"]


def test_rates_can_be_rounded_on_the_way_to_zones(
    tmp_path: Path, capsys: Captured, raster: Path
) -> None:
    code, found = run_json(capsys, "convert", raster, tmp_path / "a.gpkg", "--round", "2.5")
    assert code == 0
    back = read_map(tmp_path / "a.gpkg")
    assert back.rates_l_ha == (20.0, 22.5, 25.0, 27.5, 30.0, 32.5)
    assert found["zones"] == 6
    assert found["max_rate_change_l_ha"] <= 0.01


@pytest.mark.parametrize("step", ["0", "-1", "nan", "1e9"])
def test_a_step_that_rounds_nothing_is_wrong_usage(tmp_path: Path, raster: Path, step: str) -> None:
    with pytest.raises(typer.BadParameter, match="--round"):
        run("convert", raster, tmp_path / "a.gpkg", "--round", step)


OVERLAPPING = {
    "type": "FeatureCollection",
    "features": [
        {
            "type": "Feature",
            "properties": {"rate": rate, "unit": "L/ha"},
            "geometry": {
                "type": "Polygon",
                "coordinates": [
                    [[x, 50.0], [x + 3e-4, 50.0], [x + 3e-4, 50.0002], [x, 50.0002], [x, 50.0]]
                ],
            },
        }
        for x, rate in ((10.0, 10.0), (10.0002, 20.0))
    ],
}


def test_overlapping_zones_are_kept_in_zones_and_need_a_policy_in_cells(
    tmp_path: Path, capsys: Captured
) -> None:
    source = tmp_path / "map.geojson"
    source.write_text(json.dumps(OVERLAPPING), "utf-8")
    assert run_json(capsys, "convert", source, tmp_path / "a.shp")[1]["zones"] == 2
    with pytest.raises(MapError) as caught:
        run("convert", source, tmp_path / "a.tif")
    assert caught.value.code == "overlap"
    assert run_json(capsys, "convert", source, tmp_path / "a.tif", "--overlap", "max")[0] == 0
    cells = read_map(tmp_path / "a.tif").cells
    assert cells is not None
    values, counts = np.unique(cells.rates_l_ha, return_counts=True)
    assert values.tolist() == [10.0, 20.0]
    assert counts[1] / counts[0] == pytest.approx(1.5, rel=0.1)
    with pytest.raises(typer.BadParameter, match="max, min, mean, last"):
        run("convert", source, tmp_path / "b.tif", "--overlap", "first")


def test_a_text_map_without_width_and_speed_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MapError, match="--flow-width-m") as caught:
        run("convert", PLOTS, tmp_path / "a.txt")
    assert caught.value.code == "no-flow-basis"


def test_a_map_that_cannot_be_compared_is_not_written(tmp_path: Path, capsys: Captured) -> None:
    thin = json.loads(json.dumps(OVERLAPPING).replace("50.0002", "50.0000003"))
    (tmp_path / "thin.geojson").write_text(json.dumps(thin), "utf-8")
    code, found = run_json(capsys, "convert", tmp_path / "thin.geojson", tmp_path / "a.shp")
    assert (code, found["code"]) == (1, "not-preserved")
    assert "no place" in found["error"]
    assert [file.name for file in tmp_path.iterdir()] == ["thin.geojson"]


# --------------------------------------------------------------------------------------- pictures


def test_show_draws_and_says_what(tmp_path: Path, capsys: Captured) -> None:
    code, found = run_json(capsys, "show", PLOTS, "--out", tmp_path / "map.png")
    assert code == 0
    assert len(found["rates_l_ha"]) == 10
    assert found["area_ha"] == pytest.approx(0.288, rel=1e-3)
    assert found["out"] == str(tmp_path / "map.png")
    assert (tmp_path / "map.png").read_bytes().startswith(b"\x89PNG")
    assert run("show", PLOTS, "--out", tmp_path / "map.svg") == 0
    assert capsys.readouterr().out == f"{tmp_path / 'map.svg'}: 10 rates on 0.2880 ha, 5.9 L\n"


def test_show_needs_a_picture_to_write(tmp_path: Path) -> None:
    with pytest.raises(MapError) as caught:
        run("show", PLOTS, "--out", tmp_path / "map.shp")
    assert caught.value.code == "unknown-format"


@pytest.mark.parametrize(
    ("source", "options"),
    [
        ("01_shp_lha_multipolygon/Rx.shp", ()),
        ("03_shp_value_noUnit/20250415_211530.shp", ("--unit", "L/ha")),
        ("06_isoxml_v3_grid2_lha", ()),
        ("08_isoxml_v4_tzn_vector_map1", ("--density-kg-l", "1.1")),
        ("10_geojson/app_map_vector.geojson", ("--unit", "L/ha")),
    ],
)
def test_real_maps_are_drawn_and_converted(
    tmp_path: Path, capsys: Captured, samples: Path, source: str, options: tuple[str, ...]
) -> None:
    assert run("show", samples / source, "--out", tmp_path / "map.png", *options) == 0
    capsys.readouterr()
    for file in ("a.shp", "a.geojson", "a.gpkg", "a.kmz", "a.xml", "a.tif"):
        code, found = run_json(capsys, "convert", samples / source, tmp_path / file, *options)
        assert code == 0
        assert found["max_rate_change_l_ha"] <= 0.01
        assert found["points_compared"] >= 900
        assert found["litres"] == pytest.approx(found["source_litres"], rel=0.01)
