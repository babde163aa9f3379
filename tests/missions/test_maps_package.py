"""Folders and archives with maps in several formats: the one that is meant, or a refusal.

The files are made by GDAL (pyogrio, rasterio), or as bytes where a format is text.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import rasterio
import shapely
from rasterio.transform import Affine
from shapely import box

from companion.errors import MapError
from missions.maps.registry import read_area, read_map

WEST, SOUTH, CELL = 114.5, 36.0, 1e-3
TASK = (
    '<ISO11783_TaskData VersionMajor="4"><TSK A="TSK7" G="1"><TZN A="1"><PDV A="0001" B="330000"/>'
    '<PLN A="2"><LSG A="1"><PNT A="2" C="36" D="114.5"/><PNT A="2" C="36" D="114.501"/>'
    '<PNT A="2" C="36.001" D="114.501"/></LSG></PLN></TZN></TSK></ISO11783_TaskData>'
)
# The rate that each format's map says here, so that it is known which one was read.
RATES = {".shp": 11.0, ".geojson": 12.0, ".kml": 13.0, ".gpkg": 14.0, ".tif": 15.0, ".xml": 33.0}
_DRIVERS = {".shp": "ESRI Shapefile", ".geojson": "GeoJSON", ".gpkg": "GPKG"}


def put(path: Path, *, more: dict[str, object] | None = None) -> None:
    """Write a map of one zone in the format of its suffix."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rate, zone = RATES[path.suffix], box(WEST, SOUTH, WEST + CELL, SOUTH + CELL)
    if path.suffix == ".xml":
        path.write_text(TASK, encoding="utf-8")
    elif path.suffix == ".kml":
        ring = " ".join(f"{x},{y}" for x, y in zone.exterior.coords)
        path.write_text(
            '<kml xmlns="http://www.opengis.net/kml/2.2"><Placemark><ExtendedData><Data '
            f'name="rate"><value>{rate:g}</value></Data></ExtendedData><Polygon><outerBoundaryIs>'
            f"<LinearRing><coordinates>{ring}</coordinates></LinearRing></outerBoundaryIs>"
            "</Polygon></Placemark></kml>",
            encoding="utf-8",
        )
    elif path.suffix == ".tif":
        with rasterio.open(
            path, "w", driver="GTiff", width=2, height=1, count=1, dtype="float32",
            crs="EPSG:4326", transform=Affine(CELL, 0.0, WEST, 0.0, -CELL, SOUTH + CELL),
        ) as target:  # fmt: skip
            target.write(np.full((1, 1, 2), rate, dtype="float32"))
    else:
        columns: dict[str, object] = {"rate": np.array([rate]), **(more or {})}
        pyogrio.raw.write(
            str(path), np.array([shapely.to_wkb(zone)], dtype=object),
            [np.asarray(values) for values in columns.values()], list(columns),
            geometry_type="Polygon", crs="EPSG:4326", driver=_DRIVERS[path.suffix],
        )  # fmt: skip


def package(tmp_path: Path, kind: str, names: Iterable[str]) -> Path:
    """Return a folder or a zip with these maps."""
    folder = tmp_path / "rx"
    for name in names:
        put(folder / name)
    if kind == "folder":
        return folder
    path = tmp_path / "rx.zip"
    with zipfile.ZipFile(path, "w") as archive:
        for file in sorted(folder.rglob("*")):
            if file.is_file():
                archive.write(file, file.relative_to(folder).as_posix())
    return path


def rate_of(path: Path, layer: str | None = None) -> float:
    (rate,) = read_map(path, unit="L/ha", layer=layer).rates_l_ha
    return rate


def refused(path: Path, layer: str | None = None) -> MapError:
    with pytest.raises(MapError) as caught:
        rate_of(path, layer)
    return caught.value


KINDS = pytest.mark.parametrize("kind", ["folder", "zip"])


@KINDS
@pytest.mark.parametrize("suffix", list(RATES))
def test_the_only_map_of_a_package_is_read(tmp_path: Path, kind: str, suffix: str) -> None:
    name = "TASKDATA.XML" if suffix == ".xml" else f"north{suffix}"
    put(tmp_path / "rx" / ("TASKDATA.xml" if suffix == ".xml" else name))
    path = package(tmp_path, kind, ())
    assert rate_of(path) == RATES[suffix]


@pytest.mark.parametrize(
    ("kind", "names"),
    [
        ("folder", ("rx.shp", "rx.kml")),
        ("zip", ("rx.shp", "ndvi.tif")),
        ("folder", ("Rx/rx.shp", "ndvi.tif")),
        ("zip", ("TASKDATA/TASKDATA.xml", "rx.shp")),
        ("folder", ("TASKDATA/TASKDATA.xml", "TASKDATA/rx.shp")),
        ("zip", ("DJI/Rx/rx.tif", "rx.shp")),
        ("zip", ("ndvi.tif", "rx.kml", "rx.geojson", "rx.gpkg", "rx.shp")),
    ],
)
def test_several_formats_are_refused_until_one_is_named(
    tmp_path: Path, kind: str, names: tuple[str, ...]
) -> None:
    path = package(tmp_path, kind, names)
    error = refused(path)
    assert error.code == "several-layers"
    for name in names:
        assert name in str(error)
        assert rate_of(path, name) == RATES[Path(name).suffix]
        assert rate_of(path, Path(name).name) == RATES[Path(name).suffix]
    assert "--layer" in error.fix
    assert "(prescription.layer)" in error.fix
    missing = refused(path, "south")
    assert missing.code in ("several-layers", "no-layer")
    # Beside task data the name may be a task's.
    assert all(name in str(missing) for name in names) or "TASKDATA" in names[0]


@KINDS
def test_a_stem_that_only_one_file_has_is_enough(tmp_path: Path, kind: str) -> None:
    path = package(tmp_path, kind, ("north.shp", "ndvi.tif"))
    assert (rate_of(path, "north"), rate_of(path, "ndvi")) == (11.0, 15.0)
    both = package(tmp_path / "b", kind, ("rx.shp", "rx.tif"))
    assert refused(both, "rx").code == "several-layers"


@KINDS
def test_a_task_is_named_beside_other_formats(tmp_path: Path, kind: str) -> None:
    path = package(tmp_path, kind, ("TASKDATA/TASKDATA.xml", "north.shp"))
    assert rate_of(path, "TSK7") == 33.0


@KINDS
@pytest.mark.parametrize(
    ("names", "rate"),
    [
        # What belongs to a package of one format is no second map.
        (("TASKDATA/TASKDATA.xml", "TASKDATA/GRD00001.shp"), 33.0),
        (("DJI/Rx/rx.tif", "DJI/ShapeFile/rx.shp"), 15.0),
        (("rx.geojson", "boundary.shp"), 12.0),
        (("rx.shp", "Boundary.kml"), 11.0),
    ],
)
def test_what_belongs_to_a_map_is_no_second_one(
    tmp_path: Path, kind: str, names: tuple[str, ...], rate: float
) -> None:
    assert rate_of(package(tmp_path, kind, names)) == rate


def test_json_that_is_no_map_is_not_in_the_way(tmp_path: Path) -> None:
    path = package(tmp_path, "folder", ("rx.shp",))
    (path / "rx-Deere-Metadata.json").write_text('{"DataAttributes": []}')
    (path / "settings.json").write_text(json.dumps({"type": "settings", "features": []}))
    assert rate_of(path) == 11.0


def test_geojson_by_the_name_of_json_is_a_map(tmp_path: Path) -> None:
    put(tmp_path / "rx.geojson")
    (tmp_path / "rx" / "zones").mkdir(parents=True)
    (tmp_path / "rx.geojson").rename(tmp_path / "rx" / "zones" / "north.json")
    assert rate_of(package(tmp_path, "zip", ())) == 12.0
    put(tmp_path / "rx" / "rx.shp")
    assert refused(tmp_path / "rx").code == "several-layers"


def test_several_of_one_format_are_named_as_before(tmp_path: Path) -> None:
    path = package(tmp_path, "zip", ("north.geojson", "south.geojson"))
    error = refused(path)
    assert error.code == "several-layers"
    assert "north, south" in str(error)
    assert rate_of(path, "south") == 12.0


def test_a_boundary_out_of_a_package_is_as_clear(tmp_path: Path) -> None:
    path = package(tmp_path, "zip", ("north.geojson", "south.kml"))
    with pytest.raises(MapError) as caught:
        read_area(path)
    assert caught.value.code == "several-layers"
    assert read_area(package(tmp_path / "one", "zip", ("north.geojson",))).area > 0.0


def test_the_file_itself_is_read_whatever_lies_beside_it(tmp_path: Path) -> None:
    folder = package(tmp_path, "folder", ("rx.shp", "rx.kml", "rx.tif"))
    assert [rate_of(folder / f"rx{end}") for end in (".shp", ".kml", ".tif")] == [11.0, 13.0, 15.0]
