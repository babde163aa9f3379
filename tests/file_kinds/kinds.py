"""What strangers' files do, a row a kind, and what may come of each."""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from shapely import LineString, MultiPolygon, Polygon, affinity, box

from tests.file_kinds import writers
from tests.file_kinds.cells import POINTS, RASTERS
from tests.file_kinds.ground import (
    FIELD,
    HOLED,
    ISLAND,
    Ground,
    three_zones,
    with_hole,
)
from tests.file_kinds.kind import ASKED, HEEDED, HERE, OR_ASKED, SURE, TOLD, UNIT, Kind

# The formats that keep columns of any type; ISOXML has its own values.
COLUMNS = tuple(name for name in writers.VECTOR if name != "ISOXML")
TYPED = ("shapefile", "GeoJSON", "GeoPackage", "GeoParquet")
PROJECTED = ("shapefile", "GeoPackage", "GeoParquet", "zip of a shapefile")
BY_HAND = ("GeoJSON by hand",)

TURNED = Polygon(FIELD.exterior.coords, [ISLAND.exterior.coords[::-1]])
ALIKE = Polygon(FIELD.exterior.coords[::-1], [ISLAND.exterior.coords[::-1]])
NESTED = MultiPolygon([FIELD, ISLAND])
# One ring: round the field, in through a slit, round the pond the same way, and out again.
SLIT = Polygon([*FIELD.exterior.coords, *ISLAND.exterior.coords, FIELD.exterior.coords[0]])


def zones(*rates: float | None) -> Callable[[], Ground]:
    return partial(three_zones, rates or (20.0, 26.0, 0.0))


def columned(
    truth: tuple[float | None, ...] = (20.0, 26.0, 0.0), **columns: list[object]
) -> Ground:
    return three_zones(truth).with_columns(**columns)


def outline(*polygons: Polygon | MultiPolygon, area: float, **columns: list[object]) -> Ground:
    return Ground(
        polygons=polygons, columns=columns or {"name": ["a"] * len(polygons)}, area_m2=area
    )


def _undefined(path: Path, number: int) -> None:
    with sqlite3.connect(path) as base:
        for (trigger,) in base.execute("select name from sqlite_master where type = 'trigger'"):
            base.execute(f'drop trigger "{trigger}"')
        for fid, blob in base.execute("select fid, geom from map").fetchall():
            there = blob[:4] + struct.pack("<i", number) + blob[8:]
            base.execute("update map set geom = ? where fid = ?", (there, fid))
        base.execute("update gpkg_geometry_columns set srs_id = ?", (number,))
        base.execute("update gpkg_contents set srs_id = ?", (number,))
        base.execute(
            "insert or ignore into gpkg_spatial_ref_sys "
            "values ('none', ?, 'NONE', ?, 'undefined', '')",
            (number, number),
        )
    base.close()


def _prj(text: str | None, path: Path) -> None:
    prj = path.with_suffix(".prj")
    prj.unlink(missing_ok=True)
    if text is not None:
        prj.write_text(text)


LOCAL_CS = 'LOCAL_CS["Undefined SRS",UNIT["metre",1]]'

OF_ZONES = [
    Kind(name="three zones", make=zones()),
    Kind(name="a record without rate", make=zones(20.0, None, 26.0), formats=COLUMNS, may=SURE),
    Kind(name="whole numbers", make=lambda: columned(rate=[20, 26, 0]), formats=TYPED),
    Kind(name="UTM", make=lambda: replace(three_zones(), epsg=25832), formats=PROJECTED),
    Kind(name="web mercator", make=lambda: replace(three_zones(), epsg=3857), formats=PROJECTED),
    Kind(
        name="ETRS89, latitude first by its authority",
        make=lambda: replace(three_zones(), epsg=4258),
        formats=PROJECTED,
    ),
    Kind(
        name="height as a third coordinate",
        make=lambda: replace(
            three_zones(), polygons=tuple(_lifted(one) for one in three_zones().polygons)
        ),
        formats=TYPED,
    ),
    Kind(name="parts of one record apart", make=lambda: _parts_apart()),
    Kind(name="a zone with a hole", make=lambda: with_hole((HOLED,))),
    Kind(name="hole turned like its shell", make=lambda: with_hole((TURNED,)), may=HEEDED),
    Kind(name="all rings turned the other way", make=lambda: with_hole((ALIKE,)), may=HEEDED),
    Kind(
        name="hole turned like its shell, by bytes",
        make=lambda: with_hole((HOLED,)),
        may=TOLD,
        formats=("shapefile",),
        spoil=lambda path: writers.turn_ring(path, 1),
    ),
    Kind(
        name="a polygon inside its own shell",
        make=lambda: with_hole((NESTED,)),
        may=TOLD,
        formats=tuple(name for name in writers.VECTOR if "shapefile" not in name),
    ),
    Kind(
        name="a pond drawn as a zone without a rate",
        make=lambda: with_hole((FIELD, ISLAND), rate=[20.0, None]),
        may=TOLD,
        formats=COLUMNS,
    ),
    Kind(name="a zone drawn twice", make=lambda: _twice(20.0), may=SURE),
    Kind(name="two rates on one ground", make=lambda: _twice(26.0), may=ASKED),
    Kind(name="one zone over the edge of another", make=lambda: _over(), may=ASKED),
    Kind(name="a bow tie", make=lambda: _bow_tie(), may=TOLD, formats=BY_HAND),
    Kind(
        name="a pond cut out through a slit, its ring turned on",
        make=lambda: with_hole((SLIT,)),
        may=TOLD,
        formats=(*BY_HAND, "GeoPackage"),
    ),
    Kind(
        name="deleted record",
        make=lambda: replace(three_zones((20.0, 26.0, None)), columns={"rate": [20.0, 26.0, 30.0]}),
        may=SURE,
        formats=("shapefile",),
        spoil=lambda path: writers.delete_record(path, 2),
    ),
    Kind(name="one record 20,000 km away", make=lambda: _astray(), may=TOLD),
    Kind(
        name="latitude before longitude",
        make=lambda: _swapped(),
        may=TOLD,
        formats=BY_HAND,
        options=HERE,
    ),
    Kind(
        name="over the 180th meridian, in two parts",
        make=lambda: _fiji(),
        formats=BY_HAND,
        may=HEEDED,
    ),
    Kind(
        name="a line among the zones",
        make=lambda: _with_line(),
        may=TOLD,
        formats=("GeoJSON by hand", "GeoPackage", "KML"),
    ),
]
OF_CRS = [
    Kind(
        name="no CRS",
        make=lambda: replace(three_zones(), epsg=None),
        may=TOLD,
        formats=("shapefile", "GeoPackage"),
    ),
    Kind(
        name="no CRS, the user's",
        make=lambda: replace(three_zones(), epsg=None),
        formats=("shapefile", "GeoPackage"),
        options=(*UNIT, "--crs", "EPSG:4326"),
        may=SURE,
    ),
    Kind(
        name="LOCAL_CS",
        make=three_zones,
        may=ASKED,
        formats=("shapefile",),
        spoil=partial(_prj, LOCAL_CS),
    ),
    Kind(
        name="LOCAL_CS, the user's",
        make=three_zones,
        formats=("shapefile",),
        spoil=partial(_prj, LOCAL_CS),
        options=(*UNIT, "--crs", "EPSG:4326"),
        may=SURE,
    ),
    Kind(
        name="empty .prj",
        make=three_zones,
        may=TOLD,
        formats=("shapefile",),
        spoil=partial(_prj, ""),
    ),
    Kind(
        name="no .prj, metres",
        make=lambda: replace(three_zones(), epsg=25832),
        may=ASKED,
        formats=("shapefile",),
        spoil=partial(_prj, None),
    ),
    Kind(
        name="srs_id 99999",
        make=three_zones,
        may=TOLD,
        formats=("GeoPackage",),
        spoil=lambda path: _undefined(path, 99999),
    ),
    Kind(
        name="srs_id 99999, the user's",
        make=three_zones,
        formats=("GeoPackage",),
        spoil=lambda path: _undefined(path, 99999),
        options=(*UNIT, "--crs", "EPSG:4326"),
        may=SURE,
    ),
    Kind(
        name="srs_id -1, the user's",
        make=three_zones,
        formats=("GeoPackage",),
        spoil=lambda path: _undefined(path, -1),
        options=(*UNIT, "--crs", "EPSG:4326"),
        may=SURE,
    ),
    Kind(
        name="UTM said, another zone given",
        make=lambda: replace(three_zones(), epsg=25832),
        formats=PROJECTED,
        options=(*UNIT, "--crs", "EPSG:25833"),
        may=TOLD,
    ),
]
# Litres of zones of 0.18, 0.144 and 0.108 ha at these rates: they grow with the area.
_TOTALS: list[object] = [3.6, 3.74, 1.62]
_RATES = (20.0, 26.0, 15.0)
_LISTED: list[object] = [*_RATES]
OF_COLUMNS = (
    [
        Kind(
            name=f"{rate} beside {total}",
            make=partial(columned, _RATES, **{rate: _LISTED, total: _TOTALS}),
            formats=COLUMNS,
            may=OR_ASKED,
        )
        for rate, total in (
            ("DOSE_HA", "DOSE_TOT"),
            ("Rate_ha", "Rate_sum"),
            ("MeanRate", "Quantity"),
            ("Dosis_ha", "Menge"),
            ("dose", "volume"),
            ("rate", "total_l"),
            ("dosi_ha", "quantita"),
            ("dose_ha", "qte"),
            ("rate_l_ha", "amount"),
            ("aufwand_ha", "gesamt"),
        )
    ]
    + [
        Kind(
            name=f"{rate} alone",
            make=partial(columned, _RATES, **{rate: _LISTED}),
            formats=("shapefile", "GeoJSON", "KML"),
            may=OR_ASKED,
        )
        for rate in ("DOSE_HA", "Rate", "Aufwand", "MeanRate", "l_ha", "dosis", "value")
    ]
    + [
        Kind(
            name=f"only a total, {total}",
            make=partial(columned, _RATES, **{total: _TOTALS}),
            formats=COLUMNS,
            may=TOLD,
        )
        for total in ("DOSE_TOT", "total", "Gesamtmenge", "Summe_l", "Totale")
    ]
    + [
        # 20 L/ha of each zone's own area: whatever it is called.
        Kind(
            name=f"litres of each zone, {name}",
            make=partial(columned, (20.0, 20.0, 20.0), **{name: [3.6, 2.88, 2.16]}),
            formats=COLUMNS,
            may=TOLD,
        )
        for name in ("Menge", "rate", "volume", "quantity", "dose")
    ]
    + [
        Kind(
            name="two columns of rates",
            make=partial(columned, _RATES, rate_1=[20.0, 26.0, 15.0], rate_2=[30.0, 31.0, 32.0]),
            formats=COLUMNS,
            may=ASKED,
        ),
        Kind(
            name="decoys: id, area, year",
            make=partial(
                columned,
                _RATES,
                id=[1, 2, 3],
                area_ha=[0.18, 0.144, 0.108],
                year=[2026] * 3,
                rate=_LISTED,
            ),
            formats=COLUMNS,
        ),
        Kind(
            name="rates as text, decimal comma",
            make=partial(columned, (18.5, 26.0, 15.0), rate=["18,5", "26,0", "15,0"]),
            formats=COLUMNS,
            may=HEEDED,
        ),
        Kind(
            name="rates as text with their unit",
            make=partial(columned, (18.5, 26.0, 15.0), rate=["18.5 L/ha", "26 L/ha", "15 L/ha"]),
            formats=COLUMNS,
            may=HEEDED,
        ),
        Kind(
            name="a column kg_ha and L/ha given",
            make=partial(columned, _RATES, kg_ha=_LISTED),
            formats=("shapefile", "GeoJSON"),
            may=TOLD,
        ),
        Kind(
            name="a name with spaces and a unit",
            make=partial(columned, _RATES, **{"Aufwand menge [L/ha]": _LISTED}),
            options=(),
            formats=("GeoJSON", "GeoPackage", "GeoParquet"),
            may=OR_ASKED,
        ),
        Kind(
            name="negative rate",
            make=partial(columned, (20.0, 26.0, None), rate=[20.0, 26.0, -5.0]),
            formats=COLUMNS,
            may=TOLD,
        ),
        Kind(
            name="-9999 for no rate",
            make=partial(columned, (20.0, 26.0, None), rate=[20.0, 26.0, -9999.0]),
            formats=COLUMNS,
            may=TOLD,
        ),
        Kind(
            name="not a number",
            make=partial(columned, (20.0, 26.0, None), rate=[20.0, 26.0, np.nan]),
            formats=("shapefile", "GeoPackage", "GeoParquet"),
            may=HEEDED,
        ),
        Kind(
            name="infinite",
            make=partial(columned, (20.0, 26.0, None), rate=[20.0, 26.0, np.inf]),
            formats=("GeoPackage", "GeoParquet"),
            may=TOLD,
        ),
        Kind(
            name="yes and no for rates",
            make=partial(columned, (None, None, None), rate=[True, False, True]),
            formats=("GeoJSON by hand", "GeoParquet"),
            may=TOLD,
        ),
    ]
)


def _unit(*units: str | None) -> dict[str, list[object]]:
    return {"rate": _LISTED, "unit": list(units)}


GPA = 9.353958
OF_UNITS = (
    [
        Kind(
            name=f"unit {text}",
            make=partial(
                columned, tuple(rate * factor for rate in _RATES), **_unit(text, text, text)
            ),
            options=(),
            formats=("shapefile", "GeoJSON", "GeoPackage"),
            may=OR_ASKED,
        )
        for text, factor in (
            ("L/ha", 1.0),
            ("l/ha", 1.0),
            ("lts/ha", 1.0),
            ("litros/ha", 1.0),
            ("L/da", 10.0),
            ("gal/ac", GPA),
            ("GPA", GPA),
            ("mL/m2", 10.0),
            ("ml/m²", 10.0),
            ("Liter/ha", 1.0),
            ("litres/ha", 1.0),
            ("\u043b/\u0433\u0430", 1.0),
            ("fl oz/ac", GPA / 128),
            ("pt/ac", GPA / 8),
            ("qt/ac", GPA / 4),
            ("L ha-1", 1.0),
            ("L·ha⁻¹", 1.0),
            ("升/公顷", 1.0),
            ("升/亩", 15.0),
        )
    ]
    + [
        Kind(
            name=f"unit {text} is no volume an area",
            make=partial(columned, _RATES, **_unit(text, text, text)),
            options=(),
            formats=("shapefile", "GeoJSON"),
            may=ASKED,
        )
        for text in ("kg/ha", "l/hl", "m", "%", "L", "L/min", "seeds/m2", "")
    ]
    + [
        Kind(
            name=f"a column {name}",
            make=partial(columned, tuple(rate * factor for rate in _RATES), **{name: _LISTED}),
            options=(),
            formats=("shapefile", "GeoJSON"),
            may=OR_ASKED,
        )
        for name, factor in (
            ("fl_oz_ac", GPA / 128),
            ("l_per_ac", 1 / 0.40468564224),
            ("gal_ac", GPA),
            ("litros_ha", 1.0),
        )
    ]
    + [
        Kind(
            name="a unit blank in one record",
            make=partial(columned, _RATES, **_unit(None, "gal/ac", "gal/ac")),
            options=(),
            formats=COLUMNS,
            may=TOLD,
        ),
        Kind(
            name="two units",
            make=partial(columned, _RATES, **_unit("L/ha", "gal/ac", "L/ha")),
            options=(),
            formats=COLUMNS,
            may=ASKED,
        ),
        Kind(
            name="no unit",
            make=partial(columned, _RATES, rate=_LISTED),
            options=(),
            formats=COLUMNS,
            may=ASKED,
        ),
        Kind(
            name="the file's unit against the user's",
            make=partial(columned, _RATES, **_unit("gal/ac", "gal/ac", "gal/ac")),
            formats=("shapefile", "GeoJSON"),
            may=TOLD,
        ),
    ]
)


def _lifted(polygon: Polygon) -> Polygon:
    return Polygon([(*point, 500.0) for point in polygon.exterior.coords])


def _parts_apart() -> Ground:
    first, second, third = three_zones().polygons
    both = MultiPolygon([first, third])
    return Ground(
        polygons=(both, second),
        columns={"rate": [20.0, 26.0]},
        truth=((11.0, 17.0, 20.0), (41.0, 17.0, 26.0), (71.0, 17.0, 20.0)),
        area_m2=first.area + second.area + third.area,
    )


def _twice(rate: float) -> Ground:
    given = three_zones((20.0, 26.0, 15.0))
    return replace(
        given, polygons=(*given.polygons, given.polygons[0]),
        columns={"rate": [20.0, 26.0, 15.0, rate]},
    )  # fmt: skip


def _over() -> Ground:
    given = three_zones((20.0, 26.0, 15.0))
    return replace(
        given, polygons=(*given.polygons, box(20.0, 5.0, 40.0, 15.0)),
        columns={"rate": [20.0, 26.0, 15.0, 30.0]},
    )  # fmt: skip


def _bow_tie() -> Ground:
    crossed = Polygon([(0, 0), (60, 60), (60, 0), (0, 60)])
    return Ground(polygons=(crossed,), columns={"rate": [20.0]}, truth=((30.0, 5.0, 20.0),))


def _astray() -> Ground:
    given = three_zones((20.0, 26.0, 15.0))
    return replace(
        given, polygons=(*given.polygons, box(3e6, 4e6, 3e6 + 30, 4e6 + 30)),
        columns={"rate": [20.0, 26.0, 15.0, 30.0]}, area_m2=None,
    )  # fmt: skip


def _swapped() -> Ground:
    # What a reader makes of latitude before longitude, written by changing the corner's own.
    given = three_zones((20.0, 26.0, 15.0))
    turned = tuple(
        affinity.affine_transform(one, (0.0, 1.0, 1.0, 0.0, 0.0, 0.0)) for one in given.polygons
    )
    return replace(given, polygons=turned, corner=(48.0, 11.0), truth=((1.0, 1.0, -1.0),))


def _fiji() -> Ground:
    west, east = box(0.0, 0.0, 30.0, 60.0), box(30.0, 0.0, 60.0, 60.0)
    return Ground(
        polygons=(MultiPolygon([west, east]),), columns={"rate": [20.0]},
        truth=((10.0, 20.0, 20.0), (50.0, 20.0, 20.0)), area_m2=3600.0,
        corner=(180.0 - 30.0 / 111320.0 / 0.9563, -17.0),
    )  # fmt: skip


def _with_line() -> Ground:
    given = three_zones((20.0, 26.0, 15.0))
    return replace(
        given, polygons=(*given.polygons, LineString([(0, 0), (90, 5)])),
        columns={"rate": [20.0, 26.0, 15.0, 30.0]},
    )  # fmt: skip


# Outlines of fields, given to `plan`: the ground that would be sprayed is the file's, or a word
# is said.
OF_OUTLINES = [
    Kind(name="outline", make=lambda: outline(FIELD, area=FIELD.area), outline=True),
    Kind(name="outline with a hole", make=lambda: outline(HOLED, area=HOLED.area), outline=True),
    Kind(
        name="outline whose hole is a record",
        make=lambda: outline(FIELD, ISLAND, area=HOLED.area, pln=["1", "1"]),
        outline=True,
        may=TOLD,
    ),
    Kind(
        name="outline whose hole is a part",
        make=lambda: outline(NESTED, area=HOLED.area),
        outline=True,
        may=TOLD,
    ),
    Kind(
        name="outline whose hole is turned like its shell",
        make=lambda: outline(TURNED, area=HOLED.area),
        outline=True,
        may=HEEDED,
    ),
    Kind(
        name="outline whose hole is turned, by bytes",
        make=lambda: outline(HOLED, area=HOLED.area),
        outline=True,
        may=TOLD,
        formats=("shapefile",),
        spoil=lambda path: writers.turn_ring(path, 1),
    ),
    Kind(
        name="outline, one of two records deleted",
        make=lambda: outline(FIELD, affinity.translate(FIELD, 100.0), area=FIELD.area),
        outline=True,
        formats=("shapefile",),
        spoil=lambda path: writers.delete_record(path, 1),
        may=SURE,
    ),
    Kind(
        name="two outlines apart",
        make=lambda: outline(FIELD, affinity.translate(FIELD, 100.0), area=2 * FIELD.area),
        outline=True,
        formats=COLUMNS,
    ),
    Kind(
        name="two outlines that overlap",
        make=lambda: outline(FIELD, affinity.translate(FIELD, 30.0), area=1.5 * FIELD.area),
        outline=True,
        formats=COLUMNS,
        may=HEEDED,
    ),
    Kind(
        name="an obstacle's polygon beside the field",
        make=lambda: outline(FIELD, ISLAND, area=HOLED.area, pln=["1", "6"]),
        outline=True,
        formats=("ISOXML",),
        may=SURE,
    ),
]


# A rule a table, in the reference.
RULES: dict[str, list[Kind]] = {
    "Which column is the rate": OF_COLUMNS,
    "The unit": OF_UNITS,
    "The coordinate reference system": OF_CRS,
    "Zones": OF_ZONES,
    "The outline of a field": OF_OUTLINES,
    "Cells and no data": RASTERS,
    "Points": POINTS,
}
