"""Laws of reading maps: no bytes make a traceback, and no ring changes its ground."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import shapely
from hypothesis import example, given
from hypothesis import strategies as st
from shapely import MultiPolygon, Polygon, box

from companion.errors import MapError
from missions.maps.build import build_prescription, frame_for
from missions.maps.lint import point_rates, summary
from missions.maps.model import MapFile, MapZone
from missions.maps.registry import read_area, read_map
from missions.maps.shapefile import area_of_rings

WEST, SOUTH, CELL = 114.543, 35.996, 0.0005
SUFFIXES = (".shp", ".shx", ".dbf", ".prj", ".cpg")


def cells(count: int) -> list[Polygon]:
    return [box(WEST + i * CELL, SOUTH, WEST + (i + 1) * CELL, SOUTH + CELL) for i in range(count)]


@pytest.fixture(scope="module")
def folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as name:
        yield Path(name)


@pytest.fixture(scope="module")
def original(folder: Path) -> dict[str, bytes]:
    ground = cells(3)
    holed = ground[0].difference(ground[0].buffer(-CELL / 4))
    path = folder / "original.shp"
    pyogrio.raw.write(
        str(path),
        np.array([shapely.to_wkb(one) for one in (holed, ground[1], None)], dtype=object),
        [
            np.array([12.5, 0.0, np.nan]),
            np.array([1, 2, 3]),
            np.array(["l/ha"] * 3, dtype=object),
            np.array(["2024-01-01"] * 3, dtype="datetime64[D]"),
        ],
        ["rate", "zone", "unit", "day"],
        geometry_type="Polygon",
        crs="EPSG:4326",
        driver="ESRI Shapefile",
    )
    return {suffix: path.with_suffix(suffix).read_bytes() for suffix in SUFFIXES}


def changes() -> st.SearchStrategy[list[tuple[float, int]]]:
    """Places as fractions of the file, half of them in its head, and new bytes."""
    place = st.floats(0.0, 1.0, exclude_max=True) | st.floats(0.0, 0.2)
    return st.lists(st.tuples(place, st.integers(0, 255)), min_size=1, max_size=6)


def mutated(content: bytes, changed: list[tuple[float, int]], keep: float) -> bytes:
    result = bytearray(content)
    for place, byte in changed:
        if result:
            result[int(place * len(result))] = byte
    return bytes(result[: int(keep * len(result)) + 1] if keep < 1.0 else result)


def use(path: Path, **options: str) -> None:
    """Do all that the commands do with a map; only a `MapError` of one line may come out."""
    try:
        found = read_map(path, **options)
        summary(found)
        build_prescription(found, frame_for(found), overlap="max")
        point_rates(found, [(SOUTH, WEST)], overlap="max")
    except MapError as error:
        assert "\n" not in str(error)
    try:
        read_area(path)
    except MapError as error:
        assert "\n" not in str(error)


@given(
    suffix=st.sampled_from(SUFFIXES),
    changed=changes(),
    keep=st.just(1.0) | st.floats(0.0, 1.0),
    with_index=st.booleans(),
)
def test_any_bytes_in_a_shapefile_are_read_or_refused(
    folder: Path,
    original: dict[str, bytes],
    suffix: str,
    changed: list[tuple[float, int]],
    keep: float,
    with_index: bool,
) -> None:
    path = folder / "mutated.shp"
    for name, content in original.items():
        given_bytes = mutated(content, changed, keep) if name == suffix else content
        path.with_suffix(name).write_bytes(given_bytes)
    if not with_index:
        path.with_suffix(".shx").unlink()
    use(path)


GEOJSON = json.dumps(
    {
        "type": "FeatureCollection",
        "crs": {"type": "name", "properties": {"name": "EPSG:4326"}},
        "features": [
            {
                "type": "Feature",
                "properties": {"rate": rate, "unit": "L/ha"},
                "geometry": shapely.geometry.mapping(ground),
            }
            for rate, ground in zip((1.5, None, 0), cells(3), strict=True)
        ],
    }
).encode()


@given(changed=changes(), keep=st.just(1.0) | st.floats(0.0, 1.0))
def test_any_bytes_in_a_geojson_are_read_or_refused(
    folder: Path, changed: list[tuple[float, int]], keep: float
) -> None:
    path = folder / "mutated.geojson"
    path.write_bytes(mutated(GEOJSON, changed, keep))
    use(path)


def json_values() -> st.SearchStrategy[object]:
    leaves = (
        st.none()
        | st.booleans()
        | st.integers()
        | st.floats()
        | st.sampled_from(["Polygon", "MultiPolygon", "GeometryCollection", "Feature", ""])
    )
    keys = st.sampled_from(
        ["type", "features", "geometry", "geometries", "coordinates", "properties", "rate", "crs"]
    )
    return st.recursive(
        leaves, lambda inner: st.lists(inner) | st.dictionaries(keys, inner), max_leaves=20
    )


@given(document=json_values(), inside=st.sampled_from(["", "features", "geometry", "coordinates"]))
@example(document=10**400, inside="coordinates")
def test_any_json_is_read_or_refused(folder: Path, document: object, inside: str) -> None:
    if inside == "coordinates":
        document = {"type": "Polygon", "coordinates": document}
    if inside in ("geometry", "coordinates"):
        document = {"type": "Feature", "properties": {"rate": 1}, "geometry": document}
    if inside:
        document = {"type": "FeatureCollection", "features": [document]}
    path = folder / "any.geojson"
    path.write_text(json.dumps(document), "utf-8")
    use(path, unit="L/ha")


@st.composite
def grounds(draw: st.DrawFn) -> MultiPolygon:
    """Squares beside each other, some with a hole, some with an island in the hole."""
    parts: list[Polygon] = []
    for column in range(draw(st.integers(1, 5))):
        size = draw(st.floats(4.0, 9.0))
        outer = box(column * 10.0, 0.0, column * 10.0 + size, size)
        depth = draw(st.integers(0, 3))
        rings = [outer.buffer(-size * step / 10, join_style="mitre") for step in range(depth + 1)]
        parts += [
            one.difference(rings[index + 1]) if index + 1 < len(rings) else one
            for index, one in enumerate(rings)
            if index % 2 == 0
        ]
    return MultiPolygon(parts)


@given(ground=grounds(), order=st.randoms(use_true_random=False), turned=st.booleans())
def test_rings_in_any_order_give_the_same_ground(
    ground: MultiPolygon, order: np.random.Generator, turned: bool
) -> None:
    rings = [
        np.array(ring.coords)[:: -1 if turned else 1]
        for part in shapely.orient_polygons(ground, exterior_cw=True).geoms
        for ring in (part.exterior, *part.interiors)
    ]
    order.shuffle(rings)
    found = area_of_rings(rings)
    assert found is not None
    assert found.is_valid
    assert found.symmetric_difference(ground).area < 1e-9 * ground.area


@given(
    columns=st.lists(st.booleans(), min_size=2, max_size=8),
    shift=st.floats(-0.9, 0.9),
)
def test_an_overlap_is_refused_exactly_when_two_zones_share_ground(
    columns: list[bool], shift: float
) -> None:
    zones = [
        MapZone(name=str(index), geometry=ground, rate_l_ha=float(index))
        for index, (ground, there) in enumerate(zip(cells(8), columns, strict=False))
        if there
    ]
    west = WEST + shift * CELL
    zones.append(
        MapZone(name="new", geometry=box(west, SOUTH, west + CELL, SOUTH + CELL), rate_l_ha=1.0)
    )
    found = MapFile(
        path=Path("x"), format="", crs="", unit="L/ha", rate_field="rate", zones=tuple(zones),
        sha256="",
    )  # fmt: skip
    # A zone is 45 m wide and 55 m high: 1 m2 is 4e-4 of it.
    shared = max(zone.geometry.intersection(zones[-1].geometry).area for zone in zones[:-1]) if (
        len(zones) > 1
    ) else 0.0  # fmt: skip
    if shared > 1e-3 * CELL**2:
        with pytest.raises(MapError, match="overlap by"):
            build_prescription(found, frame_for(found))
    elif shared < 1e-4 * CELL**2:
        build_prescription(found, frame_for(found))
