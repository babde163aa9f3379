"""Every format that can be written, read by somebody else's program: the rates are the same."""

from __future__ import annotations

import io
import math
import os
import struct
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pyogrio
import pytest
import rasterio
import shapely
from numpy.typing import NDArray
from pyproj import CRS
from shapely import MultiPolygon, Polygon, box

from companion.core.frame import metres_per_degree
from companion.errors import MapError
from missions.maps.convert.compare import centres, compare, rates_at, sample_places
from missions.maps.convert.formats import WRITERS, write_map, writer_for
from missions.maps.model import MapCells, MapFile, MapZone
from missions.maps.registry import read_map

Floats = NDArray[np.float64]
Lookup = Callable[[Floats, Floats], Floats]

WEST, SOUTH = 114.543, 35.996
ACROSS_M, ALONG_M = metres_per_degree(SOUTH)
WIDTH_M, SPEED_M_S = 6.0, 5.0


def to_degrees(points: Floats) -> Floats:
    return points / (ACROSS_M, ALONG_M) + np.array([WEST, SOUTH])


def ground(*parts: Polygon) -> MultiPolygon | Polygon:
    area = shapely.transform(MultiPolygon(parts), to_degrees)
    return area if len(parts) > 1 else area.geoms[0]


HOLED = box(0, 0, 20, 30).difference(box(5, 10, 12, 20))
FIELD = MapFile(
    path=Path("field.shp"),
    format="",
    crs="EPSG:4326",
    unit="L/ha",
    rate_field="rate",
    zones=(
        MapZone(name="west", geometry=ground(HOLED, box(50, 0, 60, 30)), rate_l_ha=14.537),
        MapZone(name="hole", geometry=ground(box(5, 10, 12, 20)), rate_l_ha=0.0),
        MapZone(name="块", geometry=ground(Polygon([(20, 0), (50, 0), (40, 30), (20, 30)])),
                rate_l_ha=27.8),
        MapZone(name="blank", geometry=ground(box(60, 0, 70, 30)), rate_l_ha=None),
    ),
    sha256="",
)  # fmt: skip


def cell_map() -> MapFile:
    """Rows and columns of rates with a corner without any, and some zeros."""
    rates = np.add.outer(np.arange(30) // 6, np.arange(40) // 8).astype(np.float64) * 7.3
    rates[:9, 20:29] = math.nan
    cells = MapCells(
        rates_l_ha=rates,
        transform=(1.1 / ACROSS_M, 0.0, WEST, 0.0, -0.9 / ALONG_M, SOUTH + 30 * 0.9 / ALONG_M),
        crs=CRS.from_epsg(4326),
    )
    return replace(FIELD, zones=(), cells=cells)


# ------------------------------------------------------------------------- what others read in it


def _zones_by_gdal(path: Path, rate: str = "rate") -> Lookup:
    layers = pyogrio.list_layers(path)[:, 0].tolist()
    layer = next(name for name in layers if name.casefold() != "boundary")
    meta, _, blobs, values = pyogrio.raw.read(str(path), layer=layer, columns=[rate])
    rates = values[meta["fields"].tolist().index(rate)].astype(np.float64)
    return _in_zones(shapely.from_wkb(blobs), rates)


def _in_zones(areas: NDArray[np.object_], rates: Floats) -> Lookup:
    def found(longitude: Floats, latitude: Floats) -> Floats:
        result = np.full(len(longitude), np.nan)
        for area, rate in zip(areas, rates, strict=True):
            inside = shapely.contains_xy(area, longitude, latitude)
            result[inside] = np.fmin(result[inside], rate)
        return result

    return found


def _zipped_shapefile(path: Path) -> Lookup:
    with zipfile.ZipFile(path) as archive:
        archive.extractall(path.with_suffix(".d"))
    return _zones_by_gdal(path.with_suffix(".d") / f"{path.stem}.shp")


def _raster(path: Path) -> Lookup:
    def found(longitude: Floats, latitude: Floats) -> Floats:
        with rasterio.open(path) as source:
            assert source.crs.to_epsg() == 4326
            assert (source.count, source.dtypes) == (1, ("float32",))
            places = zip(longitude.tolist(), latitude.tolist(), strict=True)
            values = np.array([value[0] for value in source.sample(places)], dtype=np.float64)
            return np.where(values == source.nodata, np.nan, values)

    return found


def _dji(path: Path) -> Lookup:
    if path.suffix == ".zip":
        with zipfile.ZipFile(path) as archive:
            archive.extractall(path.with_suffix(".d"))
        path = path.with_suffix(".d")
    (tiff,) = (path / "DJI" / "Rx").glob("*.tif")
    # Its place is told twice, in the file by a corner, beside it by a centre.
    a, _, _, e, x, y = map(float, tiff.with_suffix(".tfw").read_text().split())
    with rasterio.open(tiff) as source:
        assert source.xy(0, 0) == pytest.approx((x, y), abs=1e-12)
        assert (source.transform.a, source.transform.e) == pytest.approx((a, e))
    return _raster(tiff)


def _task(path: Path) -> Lookup:
    if path.suffix == ".zip":
        with zipfile.ZipFile(path) as archive:
            archive.extractall(path.with_suffix(".d"))
        path = path.with_suffix(".d") / "TASKDATA" / "TASKDATA.XML"
    if path.is_dir():
        path = path / "TASKDATA.XML"
    (task,) = ElementTree.parse(path).getroot().iter("TSK")
    rate_of = {}
    for zone in task.iter("TZN"):
        (value,) = (one for one in zone.iter("PDV")) if zone.find("PDV") is not None else (None,)
        assert value is None or value.get("A") == "0001"
        rate_of[zone.get("A")] = np.nan if value is None else int(value.get("B", "")) * 1e-4
    grid = task.find("GRD")
    if grid is not None:
        return _task_grid(path, {name: grid.get(name, "") for name in "ABCDEFGI"})
    areas, rates = [], []
    for zone in task.iter("TZN"):
        for polygon in zone.iter("PLN"):
            rings: dict[str, list[list[tuple[float, float]]]] = {"1": [], "2": []}
            for ring in polygon.iter("LSG"):
                rings[ring.get("A", "")].append(
                    [(float(p.get("D", "")), float(p.get("C", ""))) for p in ring.iter("PNT")]
                )
            assert len(rings["1"]) == 1
            areas.append(Polygon(rings["1"][0], rings["2"]))
            rates.append(rate_of[zone.get("A")])
    return _in_zones(np.array(areas, dtype=object), np.array(rates))


def _task_grid(path: Path, grid: dict[str, str]) -> Lookup:
    south, west, high, wide = (float(grid[name]) for name in "ABCD")
    rows, columns = int(grid["F"]), int(grid["E"])
    assert grid["I"] == "2"
    raw = (path.parent / f"{grid['G']}.BIN").read_bytes()
    rates = np.array(struct.unpack(f"<{rows * columns}i", raw)).reshape(rows, columns) * 1e-4

    def found(longitude: Floats, latitude: Floats) -> Floats:
        row, column = np.floor((latitude - south) / high), np.floor((longitude - west) / wide)
        inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        result = np.full(len(longitude), np.nan)
        result[inside] = rates[row[inside].astype(int), column[inside].astype(int)]
        return result

    return found


def _nearest_point(path: Path) -> Lookup:
    """Return the rate of the nearest point of a text map, none beyond the reach of a cell."""
    lines = path.read_text("ascii").splitlines()
    assert int(lines[0]) == len(lines) - 1
    table = np.array([[float(word) for word in line.split("\t")] for line in lines[1:]])
    # L/min = L/ha x m x m/s x 0.006, the law of every rate controller.
    rates = table[:, 3] / (0.006 * WIDTH_M * SPEED_M_S)
    spots = np.column_stack([table[:, 1] * ACROSS_M, table[:, 0] * ALONG_M])
    tree = shapely.STRtree(shapely.points(spots))

    def found(longitude: Floats, latitude: Floats) -> Floats:
        asked = shapely.points(longitude * ACROSS_M, latitude * ALONG_M)
        (place, point) = tree.query_nearest(asked, max_distance=0.75, all_matches=False)
        result = np.full(len(longitude), np.nan)
        result[place] = rates[point]
        return result

    return found


READ_BY_OTHERS: dict[tuple[str, str], Callable[[Path], Lookup]] = {
    ("shapefile", "map.shp"): _zones_by_gdal,
    ("shapefile", "map.zip"): _zipped_shapefile,
    ("geojson", "map.geojson"): _zones_by_gdal,
    ("geojson", "map.json"): _zones_by_gdal,
    ("geopackage", "map.gpkg"): _zones_by_gdal,
    ("kml", "map.kml"): _zones_by_gdal,
    ("kml", "map.kmz"): _zones_by_gdal,
    ("isoxml", "TASKDATA.XML"): _task,
    ("isoxml", "map.zip"): _task,
    ("isoxml", "map"): _task,
    ("geotiff", "map.tif"): _raster,
    ("geotiff", "map.tiff"): _raster,
    ("dji", "map.zip"): _dji,
    ("dji", "map"): _dji,
    ("text-map", "map.txt"): _nearest_point,
}


def test_every_format_and_suffix_is_read_by_another_program() -> None:
    known = {(writer.name, suffix) for writer in WRITERS.values() for suffix in writer.suffixes}
    assert {(name, Path(file).suffix.casefold()) for name, file in READ_BY_OTHERS} == known


def written(map_file: MapFile, path: Path, name: str, **more: object) -> list[Path]:
    return write_map(
        map_file, path, format=name, flow_width_m=WIDTH_M, flow_speed_m_s=SPEED_M_S,
        **more,  # type: ignore[arg-type]
    )  # fmt: skip


@pytest.mark.parametrize("source", [FIELD, cell_map()], ids=["zones", "cells"])
@pytest.mark.parametrize(("name", "file"), READ_BY_OTHERS)
def test_rates_are_the_same_for_another_program(
    tmp_path: Path, source: MapFile, name: str, file: str
) -> None:
    written(source, tmp_path / file, name)
    found = READ_BY_OTHERS[name, file](tmp_path / file)
    has_cells = name in ("geotiff", "dji", "text-map")
    longitude, latitude = sample_places(source, count=1000, margin_m=1.5 if has_cells else 0.02)
    assert len(longitude) > 200
    wanted = rates_at(source, longitude, latitude, "min")
    rates = found(longitude, latitude)
    if name == "isoxml" and source.cells is not None:
        wanted, rates = np.nan_to_num(wanted), np.nan_to_num(rates)  # a number in every cell
    assert set(np.unique(wanted[~np.isnan(wanted)])) >= {0.0}
    assert (np.isnan(rates) == np.isnan(wanted)).all()
    assert np.nanmax(np.abs(rates - wanted)) <= 0.01


@pytest.mark.parametrize(("name", "file"), READ_BY_OTHERS)
def test_two_runs_give_the_same_bytes(tmp_path: Path, name: str, file: str) -> None:
    contents = []
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        files = written(FIELD, tmp_path / folder / file, name)
        contents.append([(one.name, one.read_bytes()) for one in sorted(files)])
    assert contents[0] == contents[1]


# ---------------------------------------------------------------- boundary, default, other cells

BOUNDED = replace(
    FIELD,
    zones=FIELD.zones[:1],
    boundary=MultiPolygon([ground(box(-5, -5, 55, 25))]),
    default_rate_l_ha=9.5,
)


@pytest.mark.parametrize(("name", "file"), READ_BY_OTHERS)
def test_boundary_and_default_hold_in_every_format(tmp_path: Path, name: str, file: str) -> None:
    written(BOUNDED, tmp_path / file, name)
    flow = {"flow_width_m": WIDTH_M, "flow_speed_m_s": SPEED_M_S} if name == "text-map" else {}
    back = read_map(tmp_path / file, **flow)
    longitude, latitude = sample_places(BOUNDED, count=800, margin_m=1.6)
    wanted = rates_at(BOUNDED, longitude, latitude, "min")
    assert {9.5, 14.537} <= set(wanted.tolist())
    assert np.isnan(wanted).sum() > 20
    rates = rates_at(back, longitude, latitude, "min")
    assert (np.isnan(rates) == np.isnan(wanted)).all()
    assert np.nanmax(np.abs(rates - wanted)) <= 0.01


def test_cells_of_a_task_can_be_asked_for(tmp_path: Path) -> None:
    write_map(FIELD, tmp_path / "TASKDATA.XML", cell_m=0.5)
    assert (tmp_path / "GRD00001.BIN").exists()
    found = _task(tmp_path / "TASKDATA.XML")
    at = np.array([[15.0, 15.0], [30.0, 5.0]]) / (ACROSS_M, ALONG_M) + np.array([WEST, SOUTH])
    assert found(at[:, 0], at[:, 1]) == pytest.approx([14.537, 27.8])


# ------------------------------------------------------------------------- what is not written


@pytest.mark.parametrize(
    ("file", "name", "code", "text"),
    [
        ("map.dwg", None, "unknown-format", ".geojson, .gpkg"),
        ("map.zip", None, "several-formats", "--format: shapefile, isoxml, dji"),
        ("map", None, "several-formats", "isoxml, dji"),
        ("map.gpkg", "kml", "unknown-format", ".kml or .kmz"),
        ("map.gpkg", "autocad", "unknown-format", "geopackage"),
    ],
)
def test_a_format_that_is_not_clear_is_refused(
    file: str, name: str | None, code: str, text: str
) -> None:
    with pytest.raises(MapError) as caught:
        writer_for(Path(file), name)
    assert caught.value.code == code
    assert text in str(caught.value)


def test_a_file_that_is_there_is_replaced_only_by_force(tmp_path: Path) -> None:
    path = tmp_path / "map.shp"
    (tmp_path / "map.dbf").write_bytes(b"of another map")
    with pytest.raises(MapError, match=r"map\.dbf is there already") as caught:
        write_map(FIELD, path)
    assert caught.value.code == "file-exists"
    assert [file.name for file in tmp_path.iterdir()] == ["map.dbf"]
    (tmp_path / "map.qix").write_bytes(b"an index of the old zones")
    files = write_map(FIELD, path, force=True)
    assert files[0] == path
    assert sorted(tmp_path.iterdir()) == sorted(files)
    with pytest.raises(MapError, match=r"map\.shp is there already") as caught:
        write_map(FIELD, path)
    assert caught.value.code == "file-exists"


def test_a_folder_with_files_is_never_written_into(tmp_path: Path) -> None:
    (tmp_path / "card").mkdir()
    (tmp_path / "card" / "photo.jpg").write_bytes(b"")
    with pytest.raises(MapError, match="folder with files") as caught:
        write_map(FIELD, tmp_path / "card", format="dji", force=True)
    assert caught.value.code == "file-exists"
    (tmp_path / "new").mkdir()
    write_map(FIELD, tmp_path / "new", format="dji")
    assert (tmp_path / "new" / "DJI" / "Rx" / "new.tif").exists()


def test_a_folder_that_is_not_there_is_not_made_up(tmp_path: Path) -> None:
    with pytest.raises(MapError, match="make the folder") as caught:
        write_map(FIELD, tmp_path / "none" / "map.shp")
    assert caught.value.code == "no-file"


@pytest.mark.parametrize("after", ["mkdir", "write"])
def test_an_interrupt_leaves_nothing_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, after: str
) -> None:
    folders = []
    make = Path.mkdir

    def made(self: Path, *arguments: Any, **more: Any) -> None:
        make(self, *arguments, **more)
        folders.append(self.name)
        if after == "mkdir":
            raise KeyboardInterrupt

    def check(_: Path) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "mkdir", made)
    with pytest.raises(KeyboardInterrupt):
        write_map(FIELD, tmp_path / "map.kml", check=check)
    assert folders == [f".vrspray-{os.getpid()}-map.kml"]
    assert list(tmp_path.iterdir()) == []


def test_what_a_killed_process_left_is_not_moved_and_names_may_be_long(tmp_path: Path) -> None:
    path = tmp_path / f"{'ß' * 120}.kml"
    left = tmp_path / f".vrspray-{os.getpid()}-{'ß' * 40}"
    left.mkdir()
    (left / "old.txt").write_text("old", "utf-8")
    assert write_map(FIELD, path) == [path]
    assert list(tmp_path.iterdir()) == [path]


def test_what_the_check_refuses_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "map.kml"
    path.write_text("old", "utf-8")

    def refuse(made: Path) -> None:
        assert made.name == "map.kml"
        assert made.stat().st_size > 1000
        raise MapError(f"{made}: no", code="not-preserved")

    with pytest.raises(MapError) as caught:
        write_map(FIELD, path, force=True, check=refuse)
    assert str(caught.value) == f"{path}: no"
    assert path.read_text("utf-8") == "old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("more", "code"),
    [
        ({}, "no-flow-basis"),
        ({"flow_width_m": 6.0, "flow_speed_m_s": 0.0}, "no-flow-basis"),
        ({"flow_width_m": 6.0, "flow_speed_m_s": 5.0, "cell_m": 1.5}, "cell-size"),
    ],
)
def test_a_text_map_needs_width_speed_and_whole_metres(
    tmp_path: Path, more: dict[str, float], code: str
) -> None:
    with pytest.raises(MapError) as caught:
        write_map(FIELD, tmp_path / "map.txt", **more)  # type: ignore[arg-type]
    assert caught.value.code == code
    assert list(tmp_path.iterdir()) == []


# ------------------------------------------------------------------------- the comparison itself


def changed(**change: object) -> MapFile:
    first, *others = FIELD.zones
    return replace(FIELD, zones=(replace(first, **change), *others))  # type: ignore[arg-type]


def test_a_map_is_the_same_as_itself() -> None:
    found = compare(FIELD, FIELD, overlaps=("min", "max", "last", "mean"))
    assert (found.points, found.change_l_ha, found.lost, found.worst) == (1000, 0.0, 0, None)
    assert 700 < found.rated < 1000


def test_a_changed_rate_is_found_with_its_place() -> None:
    found = compare(FIELD, changed(rate_l_ha=14.55), overlaps=("min",))
    assert found.change_l_ha == pytest.approx(0.013)
    assert found.worst is not None
    latitude, longitude = found.worst
    assert shapely.contains_xy(FIELD.zones[0].geometry, longitude, latitude)


@pytest.mark.parametrize("rate", [None, 0.0])
def test_a_rate_that_is_gone_is_found(rate: float | None) -> None:
    found = compare(FIELD, changed(rate_l_ha=rate), overlaps=("min",))
    assert (found.lost > 0) == (rate is None)
    assert found.lost > 0 or found.change_l_ha == pytest.approx(14.537)


def test_ground_that_no_zone_had_is_found() -> None:
    new = MapZone(name="new", geometry=ground(box(-20, -20, -1, 50)), rate_l_ha=5.0)
    wider = replace(FIELD, zones=(*FIELD.zones, new))
    assert compare(FIELD, wider, overlaps=("min",)).lost > 0


def test_a_map_that_is_off_by_half_a_cell_is_found() -> None:
    source = cell_map()
    cells = source.cells
    assert cells is not None
    a, b, c, d, e, f = cells.transform
    moved = replace(source, cells=replace(cells, transform=(a, b, c + a / 2, d, e, f + e / 2)))
    assert compare(source, source, overlaps=("min",), same_cells=True).lost == 0
    off = compare(source, moved, overlaps=("min",), same_cells=True)
    assert off.lost > 0
    assert off.change_l_ha in (pytest.approx(7.3), pytest.approx(14.6))


def test_the_order_of_overlapping_zones_is_compared() -> None:
    zones = tuple(
        MapZone(name=str(rate), geometry=ground(box(0, 0, 30, 30)), rate_l_ha=rate)
        for rate in (10.0, 20.0)
    )
    one, two = replace(FIELD, zones=zones), replace(FIELD, zones=zones[::-1])
    assert compare(one, two, overlaps=("min", "max", "mean")).change_l_ha == 0.0
    assert compare(one, two, overlaps=("last",)).change_l_ha == 10.0


def test_middles_of_cells_keep_away_from_edges() -> None:
    cells = cell_map().cells
    assert cells is not None
    longitude, latitude = centres(FIELD, cells, count=500, margin_m=0.3)
    assert len(longitude) > 100
    edges = shapely.boundary(np.array([zone.geometry for zone in FIELD.zones], dtype=object))
    lines = shapely.transform(edges, lambda p: p * (ACROSS_M, ALONG_M))
    spots = shapely.points(longitude * ACROSS_M, latitude * ALONG_M)
    assert min(line.distance(spots).min() for line in lines) >= 0.299


def test_a_zip_holds_the_whole_shapefile(tmp_path: Path) -> None:
    write_map(FIELD, tmp_path / "rx.zip", format="shapefile")
    with zipfile.ZipFile(io.BytesIO((tmp_path / "rx.zip").read_bytes())) as archive:
        assert sorted(archive.namelist()) == ["rx.cpg", "rx.dbf", "rx.prj", "rx.shp", "rx.shx"]
