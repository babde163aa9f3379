"""Outlines from files: repaired where their rings cross, and near the field they are meant for."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TypeVar

import numpy as np
import shapely
from shapely import MultiPolygon

from companion.core.frame import WGS84, LocalFrame
from companion.errors import MapError
from missions.errors import PlanError
from missions.maps.build import frame_for
from missions.maps.cells import grid_of
from missions.maps.local import Area, as_area, polygons_of
from missions.maps.model import MapFile
from missions.maps.registry import read_area, read_map
from missions.strips import Floats

T = TypeVar("T")

# The nearest land is 1.4 degrees south and 5.6 east of 0, 0.
AT_SEA_DEG = 1.0


# What a file leaves open, by the code of its refusal, and what answers it.
NOTHING_TOLD: Mapping[str, str | None] = MappingProxyType({})
ANSWERS = {"no-crs": "crs", "several-layers": "layer"}


def told(read: Callable[..., T], asked: Mapping[str, str | None]) -> T:
    """Return what `read` makes of a file; it is told only what the file leaves open.

    One plan reads several files: what is asked for the one without a CRS must not move the others.
    """
    answers: dict[str, str] = {}
    while True:
        try:
            return read(**answers)
        except MapError as error:
            name = ANSWERS.get(error.code or "", "")
            answer = asked.get(name)
            if answer is None or name in answers:
                raise
            answers[name] = answer


def outline_of(
    path: Path,
    map_file: MapFile | None,
    said: list[str],
    asked: Mapping[str, str | None] = NOTHING_TOLD,
) -> Area:
    """Return the field's outline; of a prescription in cells, that of its cells with a rate.

    `asked` has the CRS and the layer, where they are given.

    Rings that cross themselves are repaired, and what that changes is added to `said`.
    """
    try:
        outline = told(partial(read_area, path, repairs=said), asked)
        check_degrees(outline, path)
        return outline
    except MapError as error:
        if error.code != "no-polygon":
            raise
        same = map_file is not None and map_file.path.resolve() == path.resolve()
        try:
            cells = map_file if same else told(partial(read_map, path), asked)
        except MapError:
            raise error from None  # no map of cells either: what is missing is an outline
        if cells is None or cells.cells is None:
            raise
        return _of_cells(cells)


def check_degrees(area: Area, path: Path) -> None:
    """Refuse metres of a local origin that were read as degrees: they begin at 0, 0.

    Raises:
        PlanError: for what lies beside 0, 0 in the Gulf of Guinea, where no field is.
    """
    west, south, east, north = area.bounds
    beside = west <= AT_SEA_DEG and east >= -AT_SEA_DEG
    if beside and south <= AT_SEA_DEG and north >= -AT_SEA_DEG:
        raise PlanError(
            f"{path}: the outline lies at latitude 0, longitude 0, in the sea (x {west:g} to "
            f"{east:g}, y {south:g} to {north:g}); these look like metres from a local origin: "
            "give longitude and latitude in degrees, or metres with their CRS"
        )


def _of_cells(map_file: MapFile) -> MultiPolygon | Area:
    """Return the ground of all cells with a rate, in longitude and latitude."""
    if map_file.cells is None:
        raise PlanError(f"{map_file.path}: there are no cells")
    frame = frame_for(map_file)

    def back(points: Floats) -> Floats:
        lat, lon = frame.to_geographic_all(points[:, 0].tolist(), points[:, 1].tolist())
        return np.column_stack([lon, lat])

    local = grid_of(map_file.cells, frame, map_file.path).outline
    found = as_area(polygons_of(shapely.transform(local, back)))
    if found is None:
        raise PlanError(f"{map_file.path}: no cell has a rate")
    return found


def near_area(path: Path, frame: LocalFrame, asked: Mapping[str, str | None]) -> MultiPolygon:
    """Return the ground of a file, which must lie near the field to mean anything for it."""
    area = told(partial(read_area, path), asked)
    west, south, east, north = area.bounds
    check_near(str(path), (south + north) / 2.0, (west + east) / 2.0, frame)
    return area


# Whether what a task names lies near its field; a forgotten sign puts it on another continent.

# Fields are refused beyond 20 km of extent, and so are depots beyond as much: this is no field's.
FAR_M = 50_000.0


def check_near(what: str, latitude_deg: float, longitude_deg: float, frame: LocalFrame) -> None:
    """Refuse what lies far from the field, and say when one sign would bring it there.

    Raises:
        PlanError: naming `what` and where it lies.
    """
    far_m = _far_m(latitude_deg, longitude_deg, frame)
    if far_m <= FAR_M:
        return
    for name, lat, lon in (
        ("latitude", -latitude_deg, longitude_deg),
        ("longitude", latitude_deg, -longitude_deg),
        ("latitude and longitude", -latitude_deg, -longitude_deg),
    ):
        if _far_m(lat, lon, frame) <= FAR_M:
            fix = f"its {name} is of the wrong hemisphere: change the sign"
            break
    else:
        swapped = abs(longitude_deg) <= 90.0 and _far_m(longitude_deg, latitude_deg, frame) <= FAR_M
        fix = "latitude and longitude are swapped" if swapped else "is it of another field?"
    raise PlanError(
        f"{what} lies at {latitude_deg:.4f}, {longitude_deg:.4f}, {far_m / 1000.0:.0f} km from the "
        f"field at {frame.latitude_deg:.4f}, {frame.longitude_deg:.4f}; {fix}"
    )


def _far_m(latitude_deg: float, longitude_deg: float, frame: LocalFrame) -> float:
    """Return the distance to the field's middle; infinite for what is no place."""
    if not (abs(latitude_deg) <= 90.0 and abs(longitude_deg) <= 180.0):
        return float("inf")
    _, _, far_m = WGS84.inv(longitude_deg, latitude_deg, frame.longitude_deg, frame.latitude_deg)
    return float(far_m)
