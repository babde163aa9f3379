"""KML and KMZ as programs and people write them."""

from __future__ import annotations

import hashlib
import zipfile
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import shapely
from shapely import LinearRing, MultiPolygon, Polygon

from companion.errors import MapError
from missions.maps.assemble import map_of
from missions.maps.fields import Given
from missions.maps.kml import read_kml
from missions.maps.model import Layer, MapFile
from tests.missions.two_grounds import RING, SQUARE, TWO

NAMESPACE = "http://www.opengis.net/kml/2.2"
CORNERS = "15.1,48.1,200 15.2,48.1,200 15.2,48.2,200 15.1,48.1,200"
TRIANGLE = Polygon([(15.1, 48.1), (15.2, 48.1), (15.2, 48.2)])


def polygon(corners: str = CORNERS, *holes: str) -> str:
    def side(name: str, text: str) -> str:
        ring = f"<LinearRing><coordinates>{text}</coordinates></LinearRing>"
        return f"<{name}>{ring}</{name}>"

    inner = "".join(side("innerBoundaryIs", hole) for hole in holes)
    return f"<Polygon><extrude>0</extrude>{side('outerBoundaryIs', corners)}{inner}</Polygon>"


def data(**values: object) -> str:
    pairs = (f"<Data name='{name}'><value>{v}</value></Data>" for name, v in values.items())
    return f"<ExtendedData>{''.join(pairs)}</ExtendedData>"


def placemark(*content: str, name: str = "a zone") -> str:
    return f"<Placemark><name>{name}</name>{''.join(content)}</Placemark>"


def folder(name: str, *content: str) -> str:
    return f"<Folder><name>{name}</name>{''.join(content)}</Folder>"


def kml(*content: str, namespace: str = NAMESPACE) -> str:
    return (
        f'<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="{namespace}">'
        f"<Document><name>field</name>{''.join(content)}</Document></kml>"
    )


def saved(tmp_path: Path, text: str, name: str = "rx.kml") -> Path:
    path = tmp_path / name
    path.write_text(text, "utf-8")
    return path


def read(tmp_path: Path, *content: str, layer: str | None = None) -> Layer:
    return read_kml(saved(tmp_path, kml(*content)), layer)


def understood(path: Path) -> MapFile:
    return map_of(read_kml(path), path, rate_field=None, crs=None, given=Given())


def refused(path: Path, layer: str | None = None) -> MapError:
    with pytest.raises(MapError) as caught:
        read_kml(path, layer)
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith(str(path))
    assert caught.value.fix
    return caught.value


def columns(layer: Layer) -> dict[str, tuple[tuple[object, ...], bool]]:
    return {column.name: (column.values, column.numeric) for column in layer.columns}


@pytest.mark.parametrize(
    ("driver", "suffix"), [("KML", ".kml"), ("LIBKML", ".kml"), ("LIBKML", ".kmz")]
)
def test_what_gdal_writes_is_read(tmp_path: Path, driver: str, suffix: str) -> None:
    path = tmp_path / f"rx{suffix}"
    pyogrio.raw.write(
        str(path),
        shapely.to_wkb(np.array([RING, TWO, SQUARE], dtype=object)),
        [np.array([12.5, np.nan, 0.0]), np.array(["gal/ac"] * 3, dtype=object)],
        ["rate", "unit"],
        geometry_type="Unknown",
        crs="EPSG:4326",
        driver=driver,
    )
    found = understood(path)
    assert (found.format, found.crs, found.unit) == ("kml", "EPSG:4326", "gal/ac")
    assert [zone.rate_l_ha for zone in found.zones] == [pytest.approx(116.925, abs=1e-3), None, 0.0]
    for zone, ground in zip(found.zones, (RING, TWO, SQUARE), strict=True):
        assert zone.geometry.symmetric_difference(ground).area < 1e-9 * ground.area


@pytest.mark.parametrize(
    "namespace",
    [NAMESPACE, "http://www.opengis.net/kml/2.3", "http://earth.google.com/kml/2.1", ""],
)
def test_every_version_of_the_namespace(tmp_path: Path, namespace: str) -> None:
    path = saved(tmp_path, kml(placemark(data(rate=5), polygon()), namespace=namespace))
    layer = read_kml(path)
    assert layer.geometries == (TRIANGLE,)
    assert columns(layer) == {"rate": (("5",), True), "name": (("a zone",), True)} | {
        "name": (("a zone",), False)
    }
    assert layer.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()


def test_a_placemark_or_a_folder_may_be_all_there_is(tmp_path: Path) -> None:
    assert read_kml(saved(tmp_path, placemark(polygon()))).geometries == (TRIANGLE,)
    assert read_kml(saved(tmp_path, folder("x", placemark(polygon())))).geometries == (TRIANGLE,)


SCHEMA = """<Schema name="rx" id="rx"><SimpleField type="double" name="rate"/>
<SimpleField type="xsd:float" name="other"/><SimpleField type="string" name="dose"/>
<SimpleField type="bool" name="wet"/><SimpleField type="int" name="broken"/></Schema>"""


def schema_data(**values: str) -> str:
    pairs = (f'<SimpleData name="{name}">{v}</SimpleData>' for name, v in values.items())
    return f'<ExtendedData><SchemaData schemaUrl="#rx">{"".join(pairs)}</SchemaData></ExtendedData>'


def test_types_of_a_schema(tmp_path: Path) -> None:
    one = schema_data(rate=" 12.5\n", other="", dose="7", wet="1", broken="1,5")
    two = schema_data(dose=" ", wet="0", broken="")
    layer = read(tmp_path, SCHEMA, placemark(one, polygon()), placemark(two, polygon()))
    assert columns(layer) == {
        "rate": (("12.5", None), True),
        "other": ((None, None), True),
        "dose": (("7", None), True),
        "wet": (("true", "false"), False),
        "broken": (("1,5", None), True),
        "name": (("a zone", "a zone"), False),
    }


def test_a_decimal_comma_is_no_number(tmp_path: Path) -> None:
    path = saved(tmp_path, kml(placemark(data(rate="12,5", unit="L/ha"), polygon())))
    assert not columns(read_kml(path))["rate"][1]
    with pytest.raises(MapError):
        understood(path)
    path = saved(tmp_path, kml(SCHEMA, placemark(schema_data(rate="12,5"), polygon())))
    with pytest.raises(MapError, match="12,5"):
        map_of(read_kml(path), path, rate_field=None, crs=None, given=Given(unit="L/ha"))


def test_elements_of_another_namespace_are_attributes(tmp_path: Path) -> None:
    extended = (
        '<ExtendedData xmlns:farm="http://farm.example/x"><farm:rate>4.5</farm:rate>'
        "<farm:more><farm:deep>1</farm:deep></farm:more></ExtendedData>"
    )
    layer = read(tmp_path, placemark(extended, polygon()))
    assert columns(layer) == {"rate": (("4.5",), True), "name": (("a zone",), False)}


def test_no_rate_is_read_out_of_text_for_people(tmp_path: Path) -> None:
    content = "<description>rate: 12.5 L/ha, &lt;b&gt;dose 3&lt;/b&gt;</description>"
    layer = read(tmp_path, placemark(content, polygon(), name="12.5 L/ha"))
    assert columns(layer) == {"name": (("12.5 L/ha",), False)}


@pytest.mark.parametrize("form", ["Data", "Schema"])
def test_units_in_titles(tmp_path: Path, form: str) -> None:
    title = "<displayName>Dose (gal/ac)</displayName>"
    if form == "Data":
        extended = f"<ExtendedData><Data name='dose'>{title}<value>3</value></Data></ExtendedData>"
        layer = read(tmp_path, placemark(extended, polygon()))
    else:
        field = f"<SimpleField type='double' name='dose'>{title}</SimpleField>"
        schema = f"<Schema id='rx'>{field}</Schema>"
        layer = read(tmp_path, schema, placemark(schema_data(dose="3"), polygon()))
    assert {column.name: column.unit for column in layer.columns} == {
        "dose": "gal/ac",
        "name": None,
    }


def test_titles_that_state_two_units_are_refused(tmp_path: Path) -> None:
    extended = [
        f"<ExtendedData><Data name='dose'><displayName>{unit}</displayName><value>3</value></Data>"
        "</ExtendedData>"
        for unit in ("L/ha", "gal/ac")
    ]
    path = saved(tmp_path, kml(*(placemark(one, polygon()) for one in extended)))
    assert refused(path).code == "unit-conflict"


def test_one_name_with_two_values_is_refused(tmp_path: Path) -> None:
    both = (
        '<ExtendedData><Data name="rate"><value>1</value></Data>'
        '<SchemaData><SimpleData name="rate">{}</SimpleData></SchemaData></ExtendedData>'
    )
    assert columns(read(tmp_path, placemark(both.format("1"), polygon())))["rate"][0] == ("1",)
    assert columns(read(tmp_path, placemark(both.format(""), polygon())))["rate"][0] == ("1",)
    path = saved(tmp_path, kml(placemark(both.format("2"), polygon())))
    assert refused(path).code == "several-columns"


@pytest.mark.parametrize(
    "corners",
    [
        "15.1,48.1 15.2,48.1 15.2,48.2 15.1,48.1",
        "\n\t 15.1,48.1,0\r\n15.2,48.1,1e3\n\n15.2,48.2,-5   15.1,48.1,0 \n",
        "15.1, 48.1, 0 15.2 ,48.1 , 0  15.2,\n48.2, 0 15.1 , 48.1,0",
        "15.1,48.1 15.2,48.1,7 15.2,48.2",
        "15.1,48.1, 15.2,48.1, 15.2,48.2,".replace(", ", ",0 ") + "0",
    ],
)
def test_coordinates_in_every_layout(tmp_path: Path, corners: str) -> None:
    assert read(tmp_path, placemark(polygon(corners))).geometries == (TRIANGLE,)


@pytest.mark.parametrize(
    "corners",
    [
        "15.1,48.1,0,15.2,48.1,0,15.2,48.2,0",
        "15.1 48.1 15.2 48.1 15.2 48.2",
        "15.1,48.1 15.2,48.1",
        "15.1,48.1 15.2,48.1 15.1,48.1",
        "15.1,48.1 15.2,abc 15.2,48.2",
        "15.1,48.1 15.2, 15.2,48.2",
        "15.1,48.1, 15.2,48.1, 15.2,48.2,",
        "15.1,48.1,high 15.2,48.1,0 15.2,48.2,0",
        "15.1,48.1 1_5.2,48.1 15.2,48.2",
        "nan,48.1 15.2,48.1 15.2,48.2",
        "inf,48.1 15.2,48.1 15.2,48.2",
        "1e300,48.1 15.2,48.1 15.2,48.2",
    ],
)
def test_coordinates_that_are_none_are_refused(tmp_path: Path, corners: str) -> None:
    path = saved(tmp_path, kml(placemark(polygon()), placemark(polygon(corners), name="west")))
    error = refused(path)
    assert error.code == "broken-geometry"
    assert "placemark 2 (west)" in str(error)


def test_longitude_and_latitude_exchanged_are_refused(tmp_path: Path) -> None:
    corners = "48.1,115.1 48.1,115.2 48.2,115.2"
    path = saved(tmp_path, kml(placemark(data(rate=1, unit="L/ha"), polygon(corners))))
    with pytest.raises(MapError, match="exchanged"):
        understood(path)


def test_holes_and_parts(tmp_path: Path) -> None:
    def text(ring: LinearRing) -> str:
        return " ".join(f"{x!r},{y!r},0" for x, y in ring.coords)

    holed = polygon(text(RING.exterior), *(text(hole) for hole in RING.interiors))
    nested = f"<MultiGeometry>{holed}<MultiGeometry>{polygon()}</MultiGeometry></MultiGeometry>"
    layer = read(tmp_path, placemark(nested))
    assert layer.geometries == (MultiPolygon([RING, TRIANGLE]),)
    rings = "".join(
        f"<LinearRing><coordinates>{text(LinearRing(one))}</coordinates></LinearRing>"
        for one in ([(1, 1), (2, 1), (2, 2)], [(3, 3), (4, 3), (4, 4)])
    )
    big = "0,0 9,0 9,9 0,9 0,0"
    both = polygon(big).replace(
        "</Polygon>", f"<innerBoundaryIs>{rings}</innerBoundaryIs></Polygon>"
    )
    found = read(tmp_path, placemark(both)).geometries[0]
    assert isinstance(found, Polygon)
    assert len(found.interiors) == 2


@pytest.mark.parametrize(
    ("geometry", "reason"),
    [
        ("", "null-geometry"),
        ("<Point><coordinates>15,48</coordinates></Point>", "not-a-polygon:Point"),
        ("<LineString><coordinates>15,48 16,48</coordinates></LineString>",
         "not-a-polygon:LineString"),
        (polygon(" "), "no-area"),
        ("<Polygon/>", "no-area"),
        ("<MultiGeometry><Point/></MultiGeometry>", "not-a-polygon:Point"),
    ],
)  # fmt: skip
def test_placemarks_without_ground_are_told(tmp_path: Path, geometry: str, reason: str) -> None:
    layer = read(tmp_path, placemark(polygon()), placemark(geometry))
    assert layer.geometries == (TRIANGLE, None)
    assert layer.skipped == {1: reason}


@pytest.mark.parametrize("broken", ["innerBoundaryIs", "two outsides"])
def test_polygons_without_one_outside_are_refused(tmp_path: Path, broken: str) -> None:
    good = polygon()
    bad = (
        good.replace("outerBoundaryIs", broken)
        if broken == "innerBoundaryIs"
        else good.replace("</Polygon>", good.removeprefix("<Polygon>"))
    )
    assert refused(saved(tmp_path, kml(placemark(bad)))).code == "broken-geometry"


FOLDERS = (
    folder("May", folder("north", placemark(data(rate=1), polygon()))),
    folder("June", placemark(data(rate=2), polygon()), placemark(data(rate=3), polygon())),
)


def test_folders_are_one_map_unless_one_is_asked_for(tmp_path: Path) -> None:
    assert columns(read(tmp_path, *FOLDERS))["rate"][0] == ("1", "2", "3")
    assert columns(read(tmp_path, *FOLDERS, layer="June"))["rate"][0] == ("2", "3")
    assert columns(read(tmp_path, *FOLDERS, layer="May"))["rate"][0] == ("1",)
    assert columns(read(tmp_path, *FOLDERS, layer="north"))["rate"][0] == ("1",)
    error = refused(tmp_path / "rx.kml", "July")
    assert error.code == "no-layer"
    assert "May, north, June" in str(error)


def test_a_folder_called_boundary_is_the_outline(tmp_path: Path) -> None:
    zones = folder("zones", placemark(data(rate=1), polygon()))
    corner = "<Point><coordinates>15,48</coordinates></Point>"
    outline = folder("Boundary", placemark(polygon()), placemark(corner))
    layer = read(tmp_path, outline, zones)
    assert layer.geometries == (TRIANGLE,)
    assert layer.boundary is not None
    assert layer.boundary.equals(TRIANGLE)
    assert layer.skipped == {}
    with_rate = folder("boundary", placemark(data(rate=9), polygon()))
    layer = read(tmp_path, with_rate, zones)
    assert columns(layer)["rate"][0] == ("9", "1")
    assert layer.boundary is None
    alone = read(tmp_path, outline)
    assert alone.geometries == (TRIANGLE, None)
    assert alone.boundary is None


def test_a_boundary_that_crosses_itself_is_refused(tmp_path: Path) -> None:
    bow = "15.1,48.1 15.2,48.2 15.2,48.1 15.1,48.2 15.1,48.1"
    zones = placemark(data(rate=1), polygon())
    path = saved(tmp_path, kml(zones, folder("boundary", placemark(polygon(bow)))))
    assert refused(path).code == "broken-geometry"


def test_links_are_told_and_not_followed(tmp_path: Path) -> None:
    link = "<NetworkLink><Link><href>http://127.0.0.1:9/x.kml</href></Link></NetworkLink>"
    layer = read(tmp_path, link, folder("x", link), placemark(data(rate=1), polygon()))
    assert [problem.code for problem in layer.problems] == ["network-link"]
    assert layer.problems[0].text.startswith("2 links")
    assert read(tmp_path, placemark(polygon())).problems == ()


def test_a_file_of_links_alone_is_refused(tmp_path: Path) -> None:
    link = "<NetworkLink><Link><href>http://127.0.0.1:9/x.kml</href></Link></NetworkLink>"
    assert refused(saved(tmp_path, kml(link))).code == "network-link"
    assert refused(saved(tmp_path, kml(folder("empty")))).code == "no-polygon"


def zipped(tmp_path: Path, files: dict[str, str], name: str = "rx.kmz") -> Path:
    path = tmp_path / name
    with zipfile.ZipFile(path, "w") as archive:
        for member, text in files.items():
            archive.writestr(member, text)
    return path


MAY, JUNE = (kml(placemark(data(rate=rate), polygon())) for rate in (5, 6))


@pytest.mark.parametrize(
    "files",
    [
        {"files/june.kml": JUNE, "doc.kml": MAY},
        {"a.kml": JUNE, "Doc.KML": MAY},
        {"Files/MAY.KML": MAY, "icon.png": ""},
    ],
)
def test_the_main_file_of_an_archive(tmp_path: Path, files: dict[str, str]) -> None:
    layer = read_kml(zipped(tmp_path, files))
    assert columns(layer)["rate"][0] == ("5",)
    assert layer.sha256 == hashlib.sha256(MAY.encode()).hexdigest()


def test_an_archive_with_several_maps_asks_which(tmp_path: Path) -> None:
    path = zipped(tmp_path, {"may.kml": MAY, "june.kml": JUNE}, "rx.zip")
    assert refused(path).code == "several-layers"
    assert columns(read_kml(path, "june"))["rate"][0] == ("6",)
    assert columns(read_kml(path, "may.kml"))["rate"][0] == ("5",)
    assert refused(path, "july").code == "no-layer"
    assert refused(zipped(tmp_path, {"a.txt": ""})).code == "unknown-format"


def links(*targets: str) -> str:
    return "".join(
        f"<NetworkLink><Link><href> {one} </href></Link></NetworkLink>" for one in targets
    )


def test_links_inside_an_archive_are_followed_once(tmp_path: Path) -> None:
    files = {
        "doc.kml": kml(folder("x", links("layers/may%201.kml", "layers/may%201.kml"))),
        "layers/may 1.kml": kml(folder("May", placemark(data(rate=5), polygon())), links("b.kml")),
        "layers/b.kml": JUNE,
    }
    path = zipped(tmp_path, files)
    layer = read_kml(path)
    assert columns(layer)["rate"][0] == ("5",)
    assert [problem.code for problem in layer.problems] == ["network-link"]
    assert columns(read_kml(path, "May"))["rate"][0] == ("5",)
    parts = (files["doc.kml"] + files["layers/may 1.kml"]).encode()
    assert layer.sha256 == hashlib.sha256(parts).hexdigest()


def test_links_in_a_circle_or_out_of_the_archive_end(tmp_path: Path) -> None:
    (tmp_path / "june.kml").write_text(JUNE, "utf-8")
    outside = links("doc.kml", "../june.kml", str(tmp_path / "june.kml"), "http://127.0.0.1:9/a")
    zones = placemark(data(rate=5), polygon())
    layer = read_kml(zipped(tmp_path, {"doc.kml": kml(zones, outside)}))
    assert columns(layer)["rate"][0] == ("5",)
    assert layer.problems[0].text.startswith("3 links")


def test_linked_files_are_bounded_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = zipped(tmp_path, {"doc.kml": kml(links("a.kml")), "a.kml": MAY})
    assert len(read_kml(path).geometries) == 1
    monkeypatch.setattr("missions.maps.kml.MAX_ELEMENTS", 15)
    assert refused(path).code == "too-large"


def test_a_folder_of_files(tmp_path: Path) -> None:
    saved(tmp_path, MAY)
    assert columns(read_kml(tmp_path))["rate"][0] == ("5",)


def test_archives_that_lead_astray_are_refused(tmp_path: Path) -> None:
    assert refused(zipped(tmp_path, {"../doc.kml": MAY})).code == "archive-unsafe"
    path = tmp_path / "rx.kmz"
    path.write_bytes(path.read_bytes()[:60])
    assert refused(path).code == "truncated"


def test_other_xml_is_refused(tmp_path: Path) -> None:
    assert refused(saved(tmp_path, "<gpx/>")).code == "unknown-format"
    assert refused(saved(tmp_path, MAY[:-9])).code == "truncated"
    bomb = '<!DOCTYPE x [<!ENTITY a "aa">]>' + placemark(polygon())
    assert refused(saved(tmp_path, bomb)).code == "xml-unsafe"
    deep = "<Folder>" * 5000 + "</Folder>" * 5000
    assert refused(saved(tmp_path, deep)).code == "xml-unsafe"


@pytest.mark.parametrize(
    ("limit", "value"),
    [
        ("model.MAX_RECORDS", 1),
        ("model.MAX_VERTICES", 7),
        ("kml._CELLS_MAX", 1),
        ("kml._COLUMNS_MAX", 0),
        ("kml_polygons.MAX_VERTICES", 2),
    ],
)
def test_what_is_too_large_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: str, value: int
) -> None:
    path = saved(tmp_path, kml(*[placemark(data(rate=1), polygon())] * 2))
    assert len(read_kml(path).geometries) == 2
    monkeypatch.setattr(f"missions.maps.{limit}", value)
    with pytest.raises(MapError, match=r"more than|too many"):
        read_kml(path)


def test_a_real_map_keeps_its_facts(samples: Path, tmp_path: Path) -> None:
    source = samples / "01_shp_lha_multipolygon" / "Rx.shp"
    meta, _, blobs, fields = pyogrio.raw.read(str(source))
    path = tmp_path / "rx.kml"
    pyogrio.raw.write(
        str(path), blobs, fields, meta["fields"].tolist(), geometry_type="MultiPolygon",
        crs=meta["crs"], driver="LIBKML",
    )  # fmt: skip
    found = understood(path)
    assert (found.unit, found.rate_field) == ("L/ha", "rate")
    assert found.rates_l_ha == (0.0, 120.0, 140.0, 160.0, 170.0, 180.0)
    assert sum(zone.part_count for zone in found.zones) == 527
    assert sum(zone.hole_count for zone in found.zones) == 68
