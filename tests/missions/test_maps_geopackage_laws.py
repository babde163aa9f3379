"""Laws of GeoPackage and KML: any bytes are a map or a refusal, and what is written comes back."""

from __future__ import annotations

import tempfile
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import MultiPolygon, Polygon, box

from companion.errors import MapError
from missions.maps.assemble import map_of
from missions.maps.fields import Given
from missions.maps.geopackage import read_geopackage, write_geopackage
from missions.maps.geopackage_layers import CurvedError, areas_of, polygons_in
from missions.maps.kml import read_kml, write_kml
from missions.maps.model import Layer, MapFile, MapZone

WEST, SOUTH, CELL = 114.543, 35.996, 0.0005
READERS: dict[str, Callable[[Path], Layer]] = {
    ".gpkg": read_geopackage, ".kml": read_kml, ".kmz": read_kml,
}  # fmt: skip
WRITERS = {".gpkg": write_geopackage, ".kml": write_kml, ".kmz": write_kml}


def understood(path: Path) -> MapFile:
    layer = READERS[path.suffix](path)
    return map_of(layer, path, rate_field=None, crs=None, given=Given())


@pytest.fixture(scope="module")
def folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as name:
        yield Path(name)


@pytest.fixture(scope="module")
def originals(folder: Path) -> dict[str, bytes]:
    """Return one map as GDAL writes it, in each format."""
    square = box(WEST, SOUTH, WEST + CELL, SOUTH + CELL)
    grounds = [square.difference(square.buffer(-CELL / 4)), MultiPolygon([square]), square]
    found = {}
    for suffix, driver in ((".gpkg", "GPKG"), (".kml", "LIBKML"), (".kmz", "LIBKML")):
        path = folder / f"original{suffix}"
        pyogrio.raw.write(
            str(path),
            np.array(shapely.to_wkb(grounds), dtype=object),
            [np.array([12.5, 0.0, np.nan]), np.array(["l/ha"] * 3, dtype=object)],
            ["rate", "unit"],
            geometry_type="Unknown",
            crs="EPSG:4326",
            driver=driver,
        )
        assert len(understood(path).zones) == 3
        found[suffix] = path.read_bytes()
    return found


NAMES = st.text(st.characters(exclude_characters="\0"), min_size=1, max_size=20)


def changes() -> st.SearchStrategy[list[tuple[float, int]]]:
    """Places as fractions of the file, half of them in its head, and new bytes."""
    place = st.floats(0.0, 1.0, exclude_max=True) | st.floats(0.0, 0.05)
    return st.lists(st.tuples(place, st.integers(0, 255)), max_size=6)


def mutated(content: bytes, changed: list[tuple[float, int]], keep: float) -> bytes:
    result = bytearray(content)
    for place, byte in changed:
        result[int(place * len(result))] = byte
    return bytes(result[: int(keep * len(result)) + 1] if keep < 1.0 else result)


@settings(max_examples=300)
@given(
    suffix=st.sampled_from(sorted(READERS)),
    changed=changes(),
    keep=st.just(1.0) | st.floats(0.0, 1.0),
)
def test_any_bytes_are_read_or_refused(
    folder: Path,
    originals: dict[str, bytes],
    suffix: str,
    changed: list[tuple[float, int]],
    keep: float,
) -> None:
    path = folder / f"mutated{suffix}"
    path.write_bytes(mutated(originals[suffix], changed, keep))
    try:
        found = understood(path)
    except MapError as error:
        assert "\n" not in str(error)
    else:
        # The file has three records, and a map of fewer would be half of it.
        assert len(found.zones) == 3 or found.problems or suffix != ".gpkg"


@settings(max_examples=300)
@given(
    changed=st.lists(st.tuples(st.floats(0.0, 1.0, exclude_max=True), st.integers(0, 255))),
    keep=st.just(1.0) | st.floats(0.0, 1.0),
    extra=st.binary(max_size=3),
    dimension=st.sampled_from([2, 3]),
)
def test_any_geometry_is_read_or_refused(
    changed: list[tuple[float, int]], keep: float, extra: bytes, dimension: int
) -> None:
    square = box(0, 0, 9, 9).difference(box(1, 1, 2, 2))
    good = shapely.GeometryCollection([MultiPolygon([square, box(10, 0, 11, 1)]), square])
    blob = shapely.to_wkb(shapely.force_3d(good), output_dimension=dimension)
    content = mutated(blob, changed, keep) + extra
    try:
        found = polygons_in(content)
    except CurvedError:
        return
    except ValueError as error:
        assert "\n" not in str(error)
        return
    if content == blob:
        assert areas_of([found.polygons]) == [MultiPolygon([*good.geoms[0].geoms, square])]
    else:
        assert all(np.isfinite(ring).all() for rings in found.polygons for ring in rings)
        assert len(areas_of([found.polygons])) == 1


@st.composite
def grounds(draw: st.DrawFn) -> Polygon | MultiPolygon:
    """Squares beside each other, some with a hole."""
    west = draw(st.floats(-179.0, 178.0))
    south = draw(st.floats(-80.0, 80.0))
    parts = []
    for column in range(draw(st.integers(1, 3))):
        at = west + column * CELL
        square = box(at, south, at + 0.9 * CELL, south + CELL)
        holed = draw(st.booleans())
        parts.append(square.difference(square.buffer(-CELL / 5)) if holed else square)
    return MultiPolygon(parts) if len(parts) > 1 else parts[0]


RATES = st.none() | st.integers(0, 500_000).map(lambda hundredths: hundredths / 100)


@settings(max_examples=60)
@given(
    ground=grounds(),
    zones=st.lists(st.tuples(NAMES, RATES), min_size=1, max_size=5),
    with_boundary=st.booleans(),
)
@pytest.mark.parametrize("suffix", sorted(WRITERS))
def test_what_is_written_comes_back(
    folder: Path,
    suffix: str,
    ground: Polygon | MultiPolygon,
    zones: list[tuple[str, float | None]],
    with_boundary: bool,
) -> None:
    written = [MapZone(name=f"{name}\0", geometry=ground, rate_l_ha=rate) for name, rate in zones]
    written.append(MapZone(name="last", geometry=ground, rate_l_ha=1.0))
    boundary = MultiPolygon([shapely.box(*ground.bounds)]) if with_boundary else None
    path = folder / f"written{suffix}"
    WRITERS[suffix](written, path, boundary=boundary)
    found = understood(path)
    assert found.unit == "L/ha"
    # The same ground with the same rate once more is no other zone.
    rates = [one.rate_l_ha for one in written]
    once = [
        one
        for number, one in enumerate(written)
        if one.rate_l_ha is None or one.rate_l_ha not in rates[:number]
    ]
    for one, two in zip(found.zones, once, strict=True):
        assert (one.rate_l_ha is None) == (two.rate_l_ha is None)
        assert one.rate_l_ha == pytest.approx(two.rate_l_ha, abs=0.01)
        assert (one.part_count, one.hole_count) == (two.part_count, two.hole_count)
        assert shapely.hausdorff_distance(one.geometry.boundary, two.geometry.boundary) < 1e-9
    outline = READERS[suffix](path).boundary
    assert (outline is not None) == with_boundary


@given(members=st.dictionaries(NAMES, st.binary(max_size=40), max_size=4))
def test_any_archive_is_read_or_refused(folder: Path, members: dict[str, bytes]) -> None:
    path = folder / "any.kmz"
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(f"{name}.kml".encode(errors="replace").decode(), content)
    with pytest.raises(MapError) as caught:
        read_kml(path)
    assert "\n" not in str(caught.value)
