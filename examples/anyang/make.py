"""Makes the files of this folder: the field of Wang et al. 2024, as far as the paper tells it.

Told (Journal of Agricultural Engineering LV:1547): 120 x 24 m near 114.543487 E, 35.996089 N, 40
plots of 12 m along by 6 m across, flown through their centres at 3.5 m; plots 0, 1, 2, 38 and 39
have 23.8, 20.5, 16.6, 17.7 and 25.5 L/ha (Table 3). Not told, and chosen here: the other rates
(ten, four times each), their order, and the azimuth of the long side, 12 degrees; the first
corners of plots 0, 1 and 2 lie 10 degrees east of north of each other, but 20 m apart and not 12,
so that the table cannot be taken at its word.

The order is searched with a fixed seed: each pass has each rate once, neighbours along a pass
differ by at least 20 % of the larger (but for the plots whose rates are told), so that a change
stands clear of the sprayer's own noise, and steps up are as many as steps down, in all, whichever
way a pass is flown. Run it again and nothing changes: `python examples/anyang/make.py [FOLDER]`.
"""

from __future__ import annotations

import csv
import json
import random
import sys
from collections.abc import Iterable, Iterator
from itertools import pairwise
from math import cos, radians, sin
from pathlib import Path

import shapefile
from pyproj import CRS, Transformer

LONGITUDE_DEG, LATITUDE_DEG = 114.543487, 35.996089  # the south-west corner of plot 0
AZIMUTH_DEG = 12.0
PASSES, PLOTS = 4, 10
ALONG_M, ACROSS_M = 12.0, 6.0
RATES_L_HA = (14.5, 15.4, 16.6, 17.7, 19.4, 20.5, 22.7, 23.8, 25.5, 27.8)
KNOWN_L_HA = {0: 23.8, 1: 20.5, 2: 16.6, 38: 17.7, 39: 25.5}
STEP_MIN = 0.20
UPS_OF_PASS = (4, 5, 5, 4)
SIDE_MARGIN_M = 0.5  # of the boundary beyond the plots on the two long sides
SEED = 2024

Ring = list[tuple[float, float]]


def _fits(order: list[float], first_index: int, ups: int) -> bool:
    known = (KNOWN_L_HA.get(first_index + place, rate) == rate for place, rate in enumerate(order))
    return all(known) and sum(a < b for a, b in pairwise(order)) == ups


def _orders(generator: random.Random, start: list[float]) -> Iterator[list[float]]:
    """Yield orders that go on from `start` with steps of at least 20 %, in a random sequence."""
    if len(start) == len(RATES_L_HA):
        yield start
        return
    left = [rate for rate in RATES_L_HA if rate not in start]
    generator.shuffle(left)
    for rate in left:
        if not start or abs(rate - start[-1]) >= STEP_MIN * max(rate, start[-1]):
            yield from _orders(generator, [*start, rate])


def rates_by_pass() -> list[list[float]]:
    """Return the rates of the plots, pass by pass, from south to north."""
    generator = random.Random(SEED)
    passes: list[list[float]] = []
    for number, ups in enumerate(UPS_OF_PASS):
        first_index = number * PLOTS
        start = [KNOWN_L_HA[i] for i in sorted(KNOWN_L_HA) if i - first_index in (0, 1, 2)]
        passes.append(next(o for o in _orders(generator, start) if _fits(o, first_index, ups)))
    return passes


def _to_geographic() -> Transformer:
    """Return the way from metres across (right) and along to longitude and latitude."""
    frame = CRS.from_proj4(
        f"+proj=tmerc +lat_0={LATITUDE_DEG} +lon_0={LONGITUDE_DEG} +k=1 +datum=WGS84 +units=m"
    )
    return Transformer.from_crs(frame, CRS.from_epsg(4326), always_xy=True)


def rectangle(
    transformer: Transformer, across_m: tuple[float, float], along_m: tuple[float, float]
) -> Ring:
    """Return a closed ring, anticlockwise, in longitude and latitude to a tenth of a millimetre."""
    azimuth = radians(AZIMUTH_DEG)
    (left, right), (near, far) = across_m, along_m
    ring = []
    for across, along in ((left, near), (right, near), (right, far), (left, far), (left, near)):
        east = across * cos(azimuth) + along * sin(azimuth)
        north = along * cos(azimuth) - across * sin(azimuth)
        longitude, latitude = transformer.transform(east, north)
        ring.append((round(longitude, 9), round(latitude, 9)))
    return ring


def _plots(transformer: Transformer) -> Iterator[tuple[int, int, int, float, Ring]]:
    """Yield index, pass, place along, rate and ring of every plot."""
    for number, rates in enumerate(rates_by_pass()):
        across = (number * ACROSS_M, (number + 1) * ACROSS_M)
        for place, rate in enumerate(rates):
            along = (place * ALONG_M, (place + 1) * ALONG_M)
            ring = rectangle(transformer, across, along)
            yield number * PLOTS + place, number, place, rate, ring


def write_prescription(plots: Iterable[tuple[int, int, int, float, Ring]], folder: Path) -> None:
    """Write the shapefile with its projection and code page."""
    target = str(folder / "prescription")
    with shapefile.Writer(target, shapeType=shapefile.POLYGON, encoding="utf-8") as writer:
        writer.field("index", "N", 4, 0)
        writer.field("rate", "N", 8, 1)
        writer.field("unit", "C", 8)
        for index, _, _, rate, ring in plots:
            writer.poly([ring[::-1]])  # the format wants outer rings clockwise
            writer.record(index, rate, "L/ha")
    dbf = folder / "prescription.dbf"
    header = bytearray(dbf.read_bytes())
    header[1:4] = bytes((124, 1, 1))  # the date of the last update: not that of the run
    dbf.write_bytes(bytes(header))
    (folder / "prescription.prj").write_text(
        CRS.from_epsg(4326).to_wkt("WKT1_ESRI"), encoding="ascii"
    )
    (folder / "prescription.cpg").write_text("UTF-8", encoding="ascii")


def write_order(plots: Iterable[tuple[int, int, int, float, Ring]], folder: Path) -> None:
    """Write the order of the rates; pass 0 lies in the west, place 0 in the south."""
    with (folder / "plots.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("index", "pass", "along", "rate"))
        writer.writerows((index, number, place, rate) for index, number, place, rate, _ in plots)


def write_boundary(transformer: Transformer, folder: Path) -> None:
    """Write the outline of the field: the plots, and a margin on the two long sides.

    The margin keeps the outer strips inside when the aircraft is centimetres off its line.
    """
    ring = rectangle(
        transformer,
        (-SIDE_MARGIN_M, PASSES * ACROSS_M + SIDE_MARGIN_M),
        (0.0, PLOTS * ALONG_M),
    )
    properties = {
        "name": "Anyang",
        "azimuth_deg": AZIMUTH_DEG,
        "passes": PASSES,
        "plots_along": PLOTS,
        "plot_along_m": ALONG_M,
        "plot_across_m": ACROSS_M,
        "side_margin_m": SIDE_MARGIN_M,
        "origin_longitude_deg": LONGITUDE_DEG,
        "origin_latitude_deg": LATITUDE_DEG,
    }
    feature = {
        "type": "Feature",
        "properties": properties,
        "geometry": {"type": "Polygon", "coordinates": [[list(point) for point in ring]]},
    }
    text = json.dumps({"type": "FeatureCollection", "features": [feature]}, indent=1)
    (folder / "boundary.geojson").write_text(text + "\n", encoding="utf-8")


def main(folder: Path) -> None:
    """Write all files of the example that are data."""
    transformer = _to_geographic()
    plots = list(_plots(transformer))
    write_prescription(plots, folder)
    write_order(plots, folder)
    write_boundary(transformer, folder)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent)
