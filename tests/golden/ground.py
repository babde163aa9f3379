"""The ground and the configuration of a recorded flight: small fields, made anew for each."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from shapely import Polygon

from companion.core.frame import LocalFrame

EXAMPLES = Path(__file__).parents[2] / "examples"
HOME = LocalFrame(36.0, 114.5)
# Northwards over home: a change every 10 m, a plot of rate 0, one that is missing, and a border
# that no pass meets at a right angle.
_RATES = ((15.0, 25.0, 0.0, 27.0), (20.0, 26.0, None, 24.0))
_PLOT_M, _SOUTH_M = 10.0, 20.0
OUTLINE = Polygon([(-3.6, 20.0), (9.6, 22.0), (9.6, 60.0), (3.0, 58.0), (-3.6, 55.0)])
EXCLUSION = Polygon([(1.5, 41.0), (2.6, 40.0), (3.8, 41.5), (2.6, 43.0)])
# What PX4 counts otherwise than ArduPilot, and how late its positions are.
_PX4 = {
    'modes = ["AUTO"]': 'modes = ["MISSION"]',
    "position_s = 0.0349": "position_s = 0.0100",
    **{f"channel = {9 + valve}\n": f"channel = {1 + valve}\n" for valve in range(6)},
}
_HEADER = re.compile(r"^\[+([a-z_]+)\]+$")
PASS = ((0.0, 66.0),)
# Up, aside, and down again over both columns of plots.
BOTH = ((0.0, 66.0), (6.0, 66.0), (6.0, 14.0))
# Up and down again on nearly the same line.
AGAIN = ((0.0, 60.0), (1.2, 60.0), (1.2, 14.0))
# Straight on in short legs, as a plan with heights has them.
SHORT_LEGS = ((0.0, 30.0), (0.0, 41.0), (0.1, 52.0), (0.0, 66.0))

Places = tuple[tuple[float, float], ...]


def geographic(polygon: Polygon) -> Polygon:
    """Return a polygon of the local frame in longitude and latitude."""
    return shapely.transform(
        polygon, lambda xy: [HOME.to_geographic(x, y)[::-1] for x, y in xy.tolist()]
    )


def write_features(path: Path, features: list[tuple[Any, dict[str, Any]]]) -> None:
    """Write geometries in longitude and latitude with their properties as GeoJSON."""
    found = [
        {
            "type": "Feature",
            "properties": properties,
            "geometry": json.loads(shapely.to_geojson(geometry)),
        }
        for geometry, properties in features
    ]
    path.write_text(json.dumps({"type": "FeatureCollection", "features": found}))


def write_plots(folder: Path) -> None:
    """Write two columns of plots, their outline, and a place that is left out."""
    plots = [
        (_plot(column, row), {"rate": rate})
        for column, rates in enumerate(_RATES)
        for row, rate in enumerate(rates)
        if rate is not None
    ]
    write_features(folder / "map.geojson", plots)
    write_features(folder / "outline.geojson", [(geographic(OUTLINE), {})])
    write_features(folder / "exclusion.geojson", [(geographic(EXCLUSION), {})])


def _plot(column: int, row: int) -> Polygon:
    west_m, south_m = -3.0 + 6.0 * column, _SOUTH_M + _PLOT_M * row
    return geographic(shapely.box(west_m, south_m, west_m + 6.0, south_m + _PLOT_M))


def write_overlapping(folder: Path) -> None:
    """Write plots that overlap, with edges at an angle."""
    first = Polygon([(-4.0, 20.0), (10.0, 20.0), (10.0, 42.0), (-4.0, 35.0)])
    second = Polygon([(-4.0, 33.0), (10.0, 38.0), (10.0, 58.0), (-4.0, 58.0)])
    plots = [(geographic(first), {"rate": 15.0}), (geographic(second), {"rate": 26.0})]
    write_features(folder / "map.geojson", plots)
    write_features(folder / "outline.geojson", [(geographic(OUTLINE), {})])


def write_grid(folder: Path) -> None:
    """Write a raster of cells of about 4 m, turned against north by what a degree is here."""
    import rasterio
    from rasterio.transform import from_bounds

    south, west = HOME.to_geographic(-6.0, 16.0)
    north, east = HOME.to_geographic(14.0, 60.0)
    rates = np.array([[15.0 + 3.0 * ((row + 2 * column) % 5) for column in range(5)]
                      for row in range(11)])  # fmt: skip
    rates[4, 2] = rates[8, 1] = -1.0
    with rasterio.open(
        folder / "map.tif",
        "w",
        driver="GTiff",
        width=5,
        height=11,
        count=1,
        dtype="float64",
        crs="EPSG:4326",
        transform=from_bounds(west, south, east, north, 5, 11),
        nodata=-1.0,
    ) as file:
        file.write(rates, 1)


def write_line(folder: Path) -> None:
    """Write the spray line of one pass, from 28 to 50 m north."""
    ends = [HOME.to_geographic(0.0, north_m)[::-1] for north_m in (28.0, 50.0)]
    write_features(
        folder / "lines.geojson", [(shapely.LineString(ends), {"kind": "spray", "sortie": 1})]
    )


def write_mission(path: Path, places: Places) -> None:
    """Write take-off, 5 m/s, and a way through places."""
    degrees = ["{:.7f} {:.7f}".format(*HOME.to_geographic(*place)) for place in places]
    path.write_text(
        "QGC WPL 110\n"
        "0 1 0 16 0 0 0 0 36.0 114.5 60 1\n"
        "1 0 3 22 0 0 0 0 36.0 114.5 3.5 1\n"
        "2 0 2 178 1 5 0 0 0 0 0 1\n"
        + "".join(f"{3 + n} 0 3 16 0 0 0 0 {place} 3.5 1\n" for n, place in enumerate(degrees))
    )


MAPS = {
    "plots": ("map.geojson", write_plots),
    "overlapping": ("map.geojson", write_overlapping),
    "grid": ("map.tif", write_grid),
}


def write_config(
    folder: Path,
    *,
    base: str,
    map_name: str,
    autopilot: str,
    settings: Mapping[str, str],
    small_set: str = "",
) -> Path:
    """Write an example's configuration with other settings and one of the maps above."""
    folder.mkdir(parents=True, exist_ok=True)
    map_file, write = MAPS[map_name]
    write(folder)
    write_line(folder)
    text = (EXAMPLES / base / "config.toml").read_text(encoding="utf-8")
    for old, new in (_PX4 if autopilot == "px4" else {}).items():
        text = text.replace(old, new)
    given = {"prescription.file": f'"{map_file}"'}
    if map_name != "grid":
        given["prescription.rate_field"] = '"rate"'
        given["prescription.boundary"] = '"outline.geojson"'
    else:
        text = re.sub(r"^(rate_field|boundary) = .*\n", "", text, flags=re.MULTILINE)
    given["prescription.unit"] = '"L/ha"'
    for key, value in (given | dict(settings)).items():
        text = with_setting(text, key, value)
    if small_set:
        text = text.replace("[[nozzle_set]]\n", f"{small_set}\n[[nozzle_set]]\n", 1)
    path = folder / "config.toml"
    path.write_text(text, encoding="utf-8")
    return path


def with_setting(text: str, key: str, value: str) -> str:
    """Return a TOML text with one key of one of its tables set.

    >>> with_setting("[lag]\\non_s = 0.1\\n", "lag.on_s", "0.2")
    '[lag]\\non_s = 0.2\\n'
    """
    table, name = key.rsplit(".", 1)
    lines = text.splitlines()
    if f"[{table}]" not in lines:
        return text + f"\n[{table}]\n{name} = {value}\n"
    begin = lines.index(f"[{table}]") + 1
    for number in range(begin, len(lines)):
        if _HEADER.match(lines[number]):
            break
        if lines[number].startswith(f"{name} = "):
            lines[number] = f"{name} = {value}"
            return "\n".join(lines) + "\n"
    lines.insert(begin, f"{name} = {value}")
    return "\n".join(lines) + "\n"
