"""KML (OGC 12-007r2) for maps on a screen: zones coloured by rate, rates in ExtendedData."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Iterator, Sequence
from io import BytesIO
from pathlib import Path
from xml.sax.saxutils import escape

import shapely
from shapely import LinearRing, MultiPolygon, Polygon

from missions.maps.model import MapZone
from missions.maps.outline import BOUNDARY_NAME
from missions.maps.whole_file import write_whole

# From light yellow to dark green, red, green and blue: ever darker, so that it can be read in grey
# and by people who do not tell red from green.
_RAMP = (
    (255, 250, 190), (220, 238, 150), (172, 219, 128), (113, 193, 112),
    (55, 158, 88), (12, 117, 65), (0, 74, 42),
)  # fmt: skip
_NO_RATE = "none"
# 1e-12 degrees are a ten-thousandth of a millimetre.
_COORDINATE_DECIMALS = 12
_RATE_DECIMALS = 6
# What XML 1.0 cannot hold, not even as a reference (section 2.2).
_FORBIDDEN = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
# The oldest date that a zip can state: two runs give the same bytes.
_ZIP_DATE = (1980, 1, 1, 0, 0, 0)
_ZIP_UNIX, _ZIP_RIGHTS = 3, 0o644 << 16

_HEAD = """<?xml version="1.0" encoding="UTF-8"?>
<kml xmlns="http://www.opengis.net/kml/2.2">
<Document>
<name>prescription</name>
"""
# A document in the document: a schema belongs to one (section 9.7), and GDAL looks for the schema
# of a layer in an archive nowhere else.
_ZONES_HEAD = """<Document>
<name>prescription</name>
<Schema name="prescription" id="prescription">
<SimpleField type="double" name="rate"></SimpleField>
<SimpleField type="string" name="unit"></SimpleField>
</Schema>
"""


def write_kml(
    zones: Sequence[MapZone], path: Path, *, boundary: MultiPolygon | None = None
) -> None:
    """Write zones with their rates in L/ha; a path that ends in `.kmz` gets the zipped form.

    The outline of the field goes into a folder "boundary". A zone without a rate has no element
    for it: many programs read an empty one as 0.
    """
    content = "".join(_document(zones, boundary)).encode()
    write_whole(path, _zipped(content) if path.suffix.casefold() == ".kmz" else content)


def _document(zones: Sequence[MapZone], boundary: MultiPolygon | None) -> Iterator[str]:
    yield _HEAD
    yield from _styles()
    rates = [zone.rate_l_ha for zone in zones if zone.rate_l_ha is not None]
    least, most = min(rates, default=0.0), max(rates, default=0.0)
    yield _ZONES_HEAD
    for zone in zones:
        yield from _placemark(zone, _style(zone.rate_l_ha, least, most))
    yield "</Document>\n"
    if boundary is not None:
        yield f"<Folder>\n<name>{BOUNDARY_NAME}</name>\n<Placemark>\n<name>{BOUNDARY_NAME}</name>\n"
        yield f"<styleUrl>#{BOUNDARY_NAME}</styleUrl>\n"
        yield from _geometry(boundary)
        yield "</Placemark>\n</Folder>\n"
    yield "</Document>\n</kml>\n"


def _styles() -> Iterator[str]:
    """Yield a style for every colour of the ramp; KML writes alpha, blue, green, red."""
    for index, (red, green, blue) in enumerate(_RAMP):
        colour = f"c0{blue:02x}{green:02x}{red:02x}"
        yield _shape_style(f"rate{index}", f"<color>{colour}</color>")
    yield _shape_style(_NO_RATE, "<color>40808080</color>")
    yield _shape_style(BOUNDARY_NAME, "<fill>0</fill>")


def _shape_style(name: str, fill: str) -> str:
    return (
        f'<Style id="{name}">\n<LineStyle><color>ff404040</color><width>1</width></LineStyle>\n'
        f"<PolyStyle>{fill}</PolyStyle>\n</Style>\n"
    )


def _style(rate_l_ha: float | None, least: float, most: float) -> str:
    if rate_l_ha is None:
        return _NO_RATE
    share = (rate_l_ha - least) / (most - least) if most > least else 0.5
    return f"rate{round(share * (len(_RAMP) - 1))}"


def _placemark(zone: MapZone, style: str) -> Iterator[str]:
    yield f"<Placemark>\n<name>{escape(_FORBIDDEN.sub(' ', zone.name))}</name>\n"
    yield f"<styleUrl>#{style}</styleUrl>\n"
    yield '<ExtendedData><SchemaData schemaUrl="#prescription">\n'
    if zone.rate_l_ha is not None:
        rate = _decimal(zone.rate_l_ha, _RATE_DECIMALS)
        yield f'<SimpleData name="rate">{rate}</SimpleData>\n'
    yield '<SimpleData name="unit">L/ha</SimpleData>\n</SchemaData></ExtendedData>\n'
    yield from _geometry(zone.geometry)
    yield "</Placemark>\n"


def _geometry(area: Polygon | MultiPolygon) -> Iterator[str]:
    """Yield the polygons, the outside of each anticlockwise as KML wants it."""
    parts = shapely.get_parts(shapely.orient_polygons(area)).tolist()
    if len(parts) > 1:
        yield "<MultiGeometry>\n"
    for part in parts:
        yield "<Polygon>\n"
        yield _side("outerBoundaryIs", part.exterior)
        for hole in part.interiors:
            yield _side("innerBoundaryIs", hole)
        yield "</Polygon>\n"
    if len(parts) > 1:
        yield "</MultiGeometry>\n"


def _side(side: str, ring: LinearRing) -> str:
    positions = " ".join(
        f"{_decimal(longitude, _COORDINATE_DECIMALS)},{_decimal(latitude, _COORDINATE_DECIMALS)}"
        for longitude, latitude in shapely.get_coordinates(ring).tolist()
    )
    return f"<{side}><LinearRing><coordinates>{positions}</coordinates></LinearRing></{side}>\n"


def _decimal(value: float, decimals: int) -> str:
    """Return a number without exponent and without idle zeros.

    >>> _decimal(12.50, 6), _decimal(100.0, 6), _decimal(1e-5, 6)
    ('12.5', '100', '0.00001')
    """
    return f"{value:.{decimals}f}".rstrip("0").rstrip(".")


def _zipped(content: bytes) -> bytes:
    entry = zipfile.ZipInfo("doc.kml", _ZIP_DATE)
    entry.compress_type = zipfile.ZIP_DEFLATED
    entry.create_system, entry.external_attr = _ZIP_UNIX, _ZIP_RIGHTS
    buffer = BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr(entry, content)
    return buffer.getvalue()
