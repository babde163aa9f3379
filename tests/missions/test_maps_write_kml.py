"""KML and KMZ as we write them: read back, read by GDAL, coloured by the rate."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pyogrio
import pytest
import shapely
from shapely import LinearRing, MultiPolygon, box

from missions.maps.assemble import map_of
from missions.maps.fields import Given
from missions.maps.kml import read_kml, write_kml
from missions.maps.model import MapFile, MapZone
from tests.missions.two_grounds import CELL, NEXT, RING, SOUTH, SQUARE, TWO, WEST

NAMESPACE = "http://www.opengis.net/kml/2.2"


def understood(path: Path) -> MapFile:
    return map_of(read_kml(path), path, rate_field=None, crs=None, given=Given())


ZONES = (
    MapZone(name="Süd <\"&'> 地块", geometry=RING, rate_l_ha=12.345678901),
    MapZone(name="two", geometry=TWO, rate_l_ha=None),
    MapZone(name="zero", geometry=NEXT, rate_l_ha=0.0),
    MapZone(name="little", geometry=SQUARE, rate_l_ha=0.01),
)
FIELD = MultiPolygon([box(WEST, SOUTH, WEST + 9 * CELL, SOUTH + CELL).difference(SQUARE)])


def assert_same(found: Sequence[MapZone], wanted: Sequence[MapZone]) -> None:
    for one, two in zip(found, wanted, strict=True):
        assert one.name == two.name
        assert (one.part_count, one.hole_count) == (two.part_count, two.hole_count)
        assert shapely.hausdorff_distance(one.geometry.boundary, two.geometry.boundary) < 1e-9
        assert one.rate_l_ha == (None if two.rate_l_ha is None else pytest.approx(two.rate_l_ha))


@pytest.mark.parametrize("suffix", [".kml", ".kmz"])
@pytest.mark.parametrize("boundary", [None, FIELD])
def test_our_own_file_is_read_back(
    tmp_path: Path, suffix: str, boundary: MultiPolygon | None
) -> None:
    path = tmp_path / f"out{suffix}"
    write_kml(ZONES, path, boundary=boundary)
    found = understood(path)
    assert (found.unit, found.crs, found.problems) == ("L/ha", "EPSG:4326", ())
    assert_same(found.zones, ZONES)
    outline = read_kml(path).boundary
    assert (outline is None) == (boundary is None)
    if outline is not None:
        assert outline.symmetric_difference(FIELD).area < 1e-9 * FIELD.area


@pytest.mark.parametrize("suffix", [".kml", ".kmz"])
def test_gdal_reads_our_file(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"out{suffix}"
    write_kml(ZONES, path, boundary=FIELD)
    assert pyogrio.list_layers(path)[:, 0].tolist() == ["prescription", "boundary"]
    # GDAL adds columns of times to any KML; ours has none.
    ours = ["Name", "rate", "unit"]
    meta, _, blobs, values = pyogrio.raw.read(str(path), layer="prescription", columns=ours)
    fields = dict(zip(meta["fields"].tolist(), values, strict=True))
    assert fields["Name"].tolist() == [zone.name for zone in ZONES]
    assert fields["rate"].dtype == np.float64
    rates = [zone.rate_l_ha if zone.rate_l_ha is not None else np.nan for zone in ZONES]
    assert fields["rate"].tolist() == pytest.approx(rates, nan_ok=True, abs=1e-6)
    assert fields["unit"].tolist() == ["L/ha"] * 4
    for ground, zone in zip(shapely.from_wkb(blobs), ZONES, strict=True):
        assert shapely.hausdorff_distance(ground.boundary, zone.geometry.boundary) < 1e-9
    outline = shapely.from_wkb(pyogrio.raw.read(str(path), layer="boundary", columns=[])[2])[0]
    assert outline.symmetric_difference(FIELD).area < 1e-9 * FIELD.area


def tags(path: Path, name: str) -> list[ElementTree.Element]:
    return list(ElementTree.parse(path).getroot().iter(f"{{{NAMESPACE}}}{name}"))


def test_every_zone_has_a_colour_that_is_there(tmp_path: Path) -> None:
    path = tmp_path / "out.kml"
    write_kml(ZONES, path, boundary=FIELD)
    used = [element.text for element in tags(path, "styleUrl")]
    assert used == ["#rate6", "#none", "#rate0", "#rate0", "#boundary"]
    defined = {f"#{style.get('id')}" for style in tags(path, "Style")}
    assert set(used) <= defined
    write_kml(ZONES[:1], path)
    assert [element.text for element in tags(path, "styleUrl")] == ["#rate3"]


def test_colours_get_darker_with_the_rate(tmp_path: Path) -> None:
    path = tmp_path / "out.kml"
    write_kml(ZONES, path)
    fills = [element.findtext(f"{{{NAMESPACE}}}color") or "" for element in tags(path, "PolyStyle")]
    lightness = [
        0.2126 * int(one[6:8], 16) + 0.7152 * int(one[4:6], 16) + 0.0722 * int(one[2:4], 16)
        for one in fills[:7]
    ]
    assert len(set(lightness)) == 7
    assert lightness == sorted(lightness, reverse=True)


def test_outsides_turn_left_and_holes_right(tmp_path: Path) -> None:
    path = tmp_path / "out.kml"
    for ground in (RING, shapely.orient_polygons(RING, exterior_cw=True)):
        write_kml([MapZone(name="a", geometry=ground, rate_l_ha=1.0)], path)
        sides = {
            side: LinearRing(
                [
                    tuple(map(float, one.split(",")))
                    for element in tags(path, side)
                    for one in "".join(element.itertext()).split()
                ]
            ).is_ccw
            for side in ("outerBoundaryIs", "innerBoundaryIs")
        }
        assert sides == {"outerBoundaryIs": True, "innerBoundaryIs": False}


def test_two_runs_give_the_same_bytes(tmp_path: Path) -> None:
    for suffix in (".kml", ".kmz"):
        for name in ("a", "b"):
            write_kml(ZONES, tmp_path / f"{name}{suffix}", boundary=FIELD)
        assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / f"b{suffix}").read_bytes()
    assert len(list(tmp_path.iterdir())) == 4


def test_names_that_xml_cannot_hold(tmp_path: Path) -> None:
    path = tmp_path / "out.kml"
    write_kml([MapZone(name="a\x00b\x1b\ud800\uffffc", geometry=SQUARE, rate_l_ha=1.0)], path)
    assert understood(path).zones[0].name == "a b c"


def test_tiny_coordinates_have_no_exponent(tmp_path: Path) -> None:
    path = tmp_path / "out.kml"
    ground = box(-1e-5, -1e-5, 1e-5, 1e-5)
    write_kml([MapZone(name="a", geometry=ground, rate_l_ha=1e-5)], path)
    assert "e-" not in "".join(element.text or "" for element in tags(path, "coordinates"))
    assert_same(understood(path).zones, [MapZone(name="a", geometry=ground, rate_l_ha=1e-5)])
