"""What was applied as KML (OGC 12-007r2): ground coloured by rate, with times and a legend.

Google Earth shows no table, so the legend is drawn on the ground, east of the field, in a folder
that can be switched off.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import Polygon

from analysis.exports.output import geographic
from companion.map_formats import (
    KML_HEAD,
    KML_TAIL,
    kml_colour,
    kml_ground,
    kml_places,
    kml_text,
    zipped,
)

if TYPE_CHECKING:
    from analysis.exports.columns import Column
    from analysis.exports.output import Content
    from analysis.exports.source import Source

Floats = NDArray[np.float64]

# Viridis from its light end, as in all maps of the program: the darker, the more, for people who
# do not tell red from green and for prints in grey.
_RAMP = (
    (253, 231, 37), (144, 215, 67), (53, 183, 121), (33, 145, 140),
    (49, 104, 142), (68, 57, 131), (68, 1, 84),
)  # fmt: skip
_OPAQUE = "d8"
# Rates beyond these shares of all are outliers: they take the colours of the ends.
_ENDS_PERCENT = (2.0, 98.0)
# Corners of the path on the ground; nobody sees more.
_PATH_STEP_M = 1.0


def make(source: Source, out: Path) -> Content:
    """Return the document, zipped where the name ends in `.kmz`."""
    document = (part.encode() for part in _document(source))
    if out.suffix.casefold() != ".kmz":
        return {out.name: document}
    return {out.name: [zipped({"doc.kml": b"".join(document)})]}


def _document(source: Source) -> Iterator[str]:
    columns = source.columns
    unit = source.units["rate"]
    rates = source.swaths.applied_l_ha * unit.factor
    limits = _limits(rates)
    yield f"{KML_HEAD}<Document>\n"
    yield f"<name>{kml_text(source.about.title)}</name>\n"
    yield f"<description>{kml_text(_said(source, limits, unit.label))}</description>\n"
    yield f"<TimeSpan><begin>{source.about.started_utc}</begin>"
    yield f"<end>{source.about.ended_utc}</end></TimeSpan>\n"
    yield from _styles()
    yield from _applied(source, columns, np.searchsorted(limits[1:-1], rates, "right"))
    yield from _field(source)
    yield from _path(source)
    yield from _legend(source, limits, unit.label)
    yield f"</Document>\n{KML_TAIL}"


def _limits(rates: Floats) -> Floats:
    """Return the limits of the classes of colour, one more than there are colours."""
    known = rates[rates > 0.0]
    if not len(known):
        return np.linspace(0.0, 1.0, len(_RAMP) + 1)
    least, most = np.percentile(known, _ENDS_PERCENT).tolist()
    if not most > least * 1.001:
        least, most = 0.9 * least, 1.1 * most
    return np.linspace(least, most, len(_RAMP) + 1)


def _said(source: Source, limits: Floats, label: str) -> str:
    """Return what the balloon of the document shows: the facts, and the colours as a table."""
    facts = [(name, value) for name, value in source.facts().items() if name != "units"]
    rows = "".join(
        f"<tr><td>{escape(name)}</td><td>{escape(str(value))}</td></tr>"
        for name, value in facts
        if value is not None
    )
    colours = "".join(
        f'<tr><td bgcolor="#{red:02x}{green:02x}{blue:02x}">&nbsp;&nbsp;</td>'
        f"<td>{limits[i]:.3g} to {limits[i + 1]:.3g} {label}</td></tr>"
        for i, (red, green, blue) in enumerate(_RAMP)
    )
    return f"<table>{rows}</table><table>{colours}</table>"


def _styles() -> Iterator[str]:
    for number, colour in enumerate(_RAMP):
        yield f'<Style id="rate{number}"><LabelStyle><scale>0.8</scale></LabelStyle>'
        yield "<IconStyle><scale>0</scale></IconStyle>"
        yield f"<PolyStyle><color>{kml_colour(colour, opacity=_OPAQUE)}</color>"
        yield "<outline>0</outline></PolyStyle></Style>\n"
    yield '<Style id="field"><LineStyle><color>ffffffff</color><width>2</width></LineStyle>'
    yield "<PolyStyle><fill>0</fill></PolyStyle></Style>\n"
    yield '<Style id="path"><LineStyle><color>a0404040</color><width>1</width></LineStyle>'
    yield "</Style>\n"


def _applied(
    source: Source, columns: Sequence[Column], classes: NDArray[np.int64]
) -> Iterator[str]:
    # A document in the document: a schema belongs to one (section 9.7), and GDAL looks for the
    # schema of a layer nowhere else.
    yield '<Document>\n<name>applied</name>\n<Schema name="applied" id="applied">\n'
    for each in columns:
        kind = "string" if each.unit is None else "double"
        yield f'<SimpleField type="{kind}" name="{each.name}"></SimpleField>\n'
    yield "</Schema>\n"
    texts = list(zip(*(each.texts() for each in columns), strict=True))
    names = [each.name for each in columns]
    at = {name: index for index, name in enumerate(names)}
    rate = next(index for index, each in enumerate(columns) if each.short == "AppliedRat")
    for ground, number, row in zip(source.swaths.polygons, classes.tolist(), texts, strict=True):
        yield f"<Placemark><name>{row[rate]}</name>"
        yield f"<TimeSpan><begin>{row[at['time_utc']]}</begin>"
        yield f"<end>{row[at['end_utc']]}</end></TimeSpan>"
        yield f"<styleUrl>#rate{number}</styleUrl>"
        yield '<ExtendedData><SchemaData schemaUrl="#applied">'
        for name, value in zip(names, row, strict=True):
            if value:
                yield f'<SimpleData name="{name}">{kml_text(value)}</SimpleData>'
        yield f"</SchemaData></ExtendedData>{kml_ground(ground)}</Placemark>\n"
    yield "</Document>\n"


def _field(source: Source) -> Iterator[str]:
    ground = source.flight.setup.prescription.field
    if ground.is_empty:
        return
    (outline,) = geographic([ground], source.flight.setup.frame)
    yield "<Folder>\n<name>field</name>\n<Placemark><name>field</name>"
    yield f"<styleUrl>#field</styleUrl>{kml_ground(outline)}</Placemark>\n"
    yield "</Folder>\n"


def _path(source: Source) -> Iterator[str]:
    samples = source.samples
    steps = np.floor(np.cumsum(samples.distance_m) / _PATH_STEP_M)
    at = np.unique(steps, return_index=True)[1]
    places = np.stack((samples.longitude_deg[at], samples.latitude_deg[at]), axis=1)
    if len(places) < 2:
        return
    yield "<Folder>\n<name>path</name>\n<visibility>0</visibility>\n<Placemark><name>path</name>"
    yield "<visibility>0</visibility><styleUrl>#path</styleUrl><LineString>"
    yield f"<tessellate>1</tessellate><coordinates>{kml_places(places)}</coordinates>"
    yield "</LineString></Placemark>\n</Folder>\n"


def _legend(source: Source, limits: Floats, label: str) -> Iterator[str]:
    """Draw a box for each colour beside the field, from the least rate in the south upwards."""
    frame = source.flight.setup.frame
    _, south_m, east_m, north_m = source.flight.setup.prescription.bounds_m
    size_m = max(north_m - south_m, 10.0) / (1.5 * len(_RAMP))
    yield "<Folder>\n<name>legend</name>\n"
    for number in range(len(_RAMP)):
        low_m = south_m + 1.5 * number * size_m
        box = shapely.box(east_m + 2.0 * size_m, low_m, east_m + 3.0 * size_m, low_m + size_m)
        east, north = shapely.get_coordinates(box).T.tolist()
        latitude_deg, longitude_deg = frame.to_geographic_all(east, north)
        corners = np.stack((longitude_deg, latitude_deg), axis=1)
        middle = kml_places(corners[:4].mean(axis=0, keepdims=True))
        name = f"{limits[number]:.3g} to {limits[number + 1]:.3g} {label}"
        yield f"<Placemark><name>{kml_text(name)}</name><styleUrl>#rate{number}</styleUrl>"
        yield f"<MultiGeometry><Point><coordinates>{middle}</coordinates></Point>"
        yield f"{kml_ground(Polygon(corners))}</MultiGeometry></Placemark>\n"
    yield "</Folder>\n"
