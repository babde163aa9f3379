"""From a layer, as it stands in the file, to zones with rates in L/ha.

The same for every format, so that a new one has nothing to decide about rates, units and ground.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely
from pyproj import CRS
from shapely.errors import ShapelyError

from companion.errors import MapError
from missions.maps.cells import check_place, corner
from missions.maps.crs import (
    EXTENT_MAX_M,
    METRES_PER_DEGREE,
    Objects,
    check_edges,
    crs_name,
    datum_problem,
    parse_crs,
    to_longitude_latitude,
)
from missions.maps.fields import Given, Unit, choose, unit_of
from missions.maps.local import Area, frame_around, make_valid, project_all
from missions.maps.model import (
    RATE_MAX_L_HA,
    Band,
    Column,
    Grid,
    Layer,
    MapCells,
    MapFile,
    MapZone,
    Problem,
    as_number,
    map_error,
    unusable_polygons,
)
from missions.maps.outlines import check_apart
from missions.maps.overlaps import check_crossings

# Names of zones, the best first: the first of these columns that tells all records apart.
_NAME_COLUMNS = ("name", "zonename", "zone", "zoneid", "zone_id", "label", "id", "fid", "level")

_CRS_FIX = "give it with --crs (--crs EPSG:4326 for GPS coordinates), or copy the missing file"
# Less does not show in the figures. More, and more than a hundredth of the zone, and nobody knows
# which of the loops was meant as ground.
_SAME_M2, _MEANT_M2, _MEANT_SHARE = 0.005, 1.0, 0.01
_PROJECTION_FIX = "give with --crs the projection that it was made in, or copy the missing file"


@dataclass(frozen=True, slots=True, kw_only=True)
class Repair:
    """One record whose rings crossed themselves, and its area [m2] before and after."""

    zone: str
    reason: str
    before_m2: float
    after_m2: float

    @property
    def change_m2(self) -> float:
        """Return by how much the repair changes the area."""
        return abs(self.after_m2 - self.before_m2)

    @property
    def text(self) -> str:
        """Return what was wrong, and what the repair does to the area."""
        if self.change_m2 < _SAME_M2:
            return f"rings touch or repeat themselves ({self.reason}), without change of the area"
        return (
            f"rings cross themselves ({self.reason}); the repair changes the area "
            f"from {self.before_m2:.2f} to {self.after_m2:.2f} m2"
        )


def repair_problems(repairs: Sequence[Repair]) -> list[Problem]:
    """Return what to tell the operator of repairs, the one that changes most ground first."""
    if not repairs:
        return []
    worst = repairs[0]
    text = worst.text
    if len(repairs) > 1:
        total_m2 = sum(repair.change_m2 for repair in repairs)
        text = (
            f"rings of {len(repairs)} zones cross themselves; the repairs change "
            f"{total_m2:.2f} m2 in all, and {worst.change_m2:.2f} m2 in the worst "
            f"({worst.reason})"
        )
    unclear = any(
        not repair.change_m2 <= max(_MEANT_M2, _MEANT_SHARE * repair.after_m2) for repair in repairs
    )
    return [
        Problem(
            severity="error" if unclear else "warning",
            code="invalid-ring",
            text=text,
            where=worst.zone,
            fix="repair the zone where the map is made"
            if len(repairs) == 1
            else "repair them where the map is made (in QGIS: Fix geometries)",
        )
    ]


def map_of(
    found: Layer | Grid, path: Path, *, rate_field: str | None, crs: str | None, given: Given
) -> MapFile:
    """Return the map that a file holds, or refuse what is ambiguous in it."""
    if isinstance(found, Grid):
        return _map_of_grid(found, path, rate_field=rate_field, crs=crs, given=given)
    if found.rateless is not None:
        raise found.rateless
    used_crs, crs_problems = crs_of(found, path, crs)
    _polygons(found, path)
    if not found.columns:
        raise map_error(
            path,
            "the map has no attributes and so no rates",
            fix="copy all of its files (.shp, .shx, .dbf and .prj), or export it again"
            if found.format == "shapefile"
            else "export it again with the rate as an attribute",
            code="no-rate-column",
        )
    areas = shapely.area(np.array(found.geometries, dtype=object))
    choice = choose(found.columns, asked=rate_field, path=path, areas=areas)
    unit = unit_of(found, choice.column, given=given, path=path)
    names = zone_names(found)
    rates = _rates(choice.column, unit, names, path)
    ground, repairs = ground_of(found, used_crs, names, path)
    zones, repeated = _once(
        [
            MapZone(name=name, geometry=area, rate_l_ha=rate)
            for name, area, rate in zip(names, ground, rates, strict=True)
            if area is not None
        ]
    )
    return MapFile(
        path=path,
        format=found.format,
        crs=crs_name(used_crs),
        unit=unit.name,
        rate_field=choice.column.name,
        zones=zones,
        sha256=found.sha256,
        boundary=found.boundary,
        default_rate_l_ha=_default(choice.column, unit, path),
        problems=(
            *found.problems,
            *crs_problems,
            *choice.problems,
            *unit.problems,
            *skip_problems(found, names),
            *repair_problems(repairs),
            *repeated,
        ),
    )


def _once(zones: list[MapZone]) -> tuple[tuple[MapZone, ...], list[Problem]]:
    """Return the zones without those drawn a second time with the same rate, and which they are."""
    shapes = np.array([zone.geometry for zone in zones], dtype=object)
    rates = [
        -1.0 - index if zone.rate_l_ha is None else zone.rate_l_ha
        for index, zone in enumerate(zones)
    ]
    rows = np.column_stack([shapely.bounds(shapes), rates])
    _, first, row = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    if len(first) == len(zones):
        return tuple(zones), []
    before = first[row.ravel()]
    again = np.flatnonzero(before != np.arange(len(zones)))
    one, two = (shapely.normalize(shapes[some]) for some in (again, before[again]))
    twice = again[shapely.equals_exact(one, two)].tolist()
    if not twice:
        return tuple(zones), []
    problem = Problem(
        severity="warning",
        code="repeated-zone",
        text=f"{len(twice)} of {len(zones)} zones are drawn once more with the same rate, and "
        "counted once",
        where=", ".join(zones[index].name for index in twice[:5]),
        fix="delete them where the map is made",
    )
    left = set(twice)
    return tuple(zone for index, zone in enumerate(zones) if index not in left), [problem]


def _map_of_grid(
    found: Grid, path: Path, *, rate_field: str | None, crs: str | None, given: Given
) -> MapFile:
    """Return the map that rows and columns of cells hold."""
    used_crs, crs_problems = crs_of(found, path, crs)
    choice = choose(found.bands, asked=rate_field, path=path)
    if choice.column.fault is not None:
        raise choice.column.fault
    unit = unit_of(found, choice.column, given=given, path=path)
    rates = choice.column.values * unit.l_ha + 0.0  # no -0
    with np.errstate(invalid="ignore"):
        wrong = ~np.isnan(rates) & ~((rates >= 0.0) & (rates < RATE_MAX_L_HA))
    if wrong.any():
        row, column = np.argwhere(wrong)[0].tolist()
        line_of = choice.column.line_of
        where = f"row {row + 1}, column {column + 1}"
        where = where if line_of is None else f"line {line_of(row, column)}"
        raise _bad_rate(path, choice.column, where, float(choice.column.values[row, column]))
    cells = MapCells(rates_l_ha=rates, transform=found.transform, crs=used_crs)
    check_place(cells, path)
    return MapFile(
        path=path,
        format=found.format,
        crs=crs_name(used_crs),
        unit=unit.name,
        rate_field=choice.column.name,
        zones=(),
        sha256=found.sha256,
        cells=cells,
        boundary=found.boundary,
        default_rate_l_ha=_default(choice.column, unit, path),
        problems=(*found.problems, *crs_problems, *choice.problems, *unit.problems),
    )


def _default(column: Column | Band, unit: Unit, path: Path) -> float | None:
    """Return what the file prescribes inside the field where there is no zone [L/ha]."""
    if column.default is None:
        return None
    rate = column.default * unit.l_ha
    if not 0.0 <= rate < RATE_MAX_L_HA:
        raise _bad_rate(path, column, "the default", column.default)
    return rate


def crs_of(layer: Layer | Grid, path: Path, asked: str | None) -> tuple[CRS, list[Problem]]:
    """Return the CRS of the coordinates: what the operator says, else what the file says."""
    problems: list[Problem] = []
    if asked is not None:
        crs = parse_crs(asked, path=path, source=f"--crs {asked!r}")
        said = crs_name(layer.crs) if isinstance(layer.crs, CRS) else "nothing usable"
        silent = layer.crs is None or getattr(layer.crs, "code", "") == "no-crs"
        if not silent and said != crs_name(crs):
            problems.append(
                Problem(
                    severity="warning",
                    code="crs-overridden",
                    text=f"the file says {said}, but you asked for {crs_name(crs)}",
                    where=str(path),
                    fix="leave out --crs (prescription.crs) to believe the file"
                    if isinstance(layer.crs, CRS)
                    else "check where on earth the map then lies",
                )
            )
    elif isinstance(layer.crs, MapError):
        raise layer.crs
    elif layer.crs is not None:
        crs = layer.crs
    else:
        raise map_error(
            path,
            "the file does not say its coordinate reference system"
            + (" (no .prj beside it)" if layer.format == "shapefile" else "")
            + _looks_like(layer),
            fix=_CRS_FIX if "degrees" in _looks_like(layer) else _PROJECTION_FIX,
            code="no-crs",
        )
    datum = datum_problem(crs)
    return crs, [*problems, *([datum] if datum is not None else [])]


def _looks_like(layer: Layer | Grid) -> str:
    """Return what the coordinates look like; a hint, on which nothing rests."""
    if isinstance(layer, Grid):
        rows, columns = layer.bands[0].values.shape
        x, y = corner(layer.transform, np.array([0.0, columns]), np.array([0.0, rows]))
        points = np.column_stack([x, y])
    else:
        areas = [area for area in layer.geometries if area is not None]
        points = shapely.get_coordinates(areas)
    if not len(points):
        return ""
    (west, south), (east, north) = points.min(axis=0), points.max(axis=0)
    span = f"x {west:.7g} to {east:.7g}, y {south:.7g} to {north:.7g}"
    degrees = max(abs(west), abs(east)) <= 180.0 and max(abs(south), abs(north)) <= 90.0
    return f"; its numbers ({span}) look like {'degrees' if degrees else 'metres'}"


def zone_names(layer: Layer) -> list[str]:
    """Return a name for every record: of a column that tells them apart, else its number."""
    count = len(layer.geometries)
    by_name = {column.name.casefold(): column for column in reversed(layer.columns)}
    for name in _NAME_COLUMNS:
        column = by_name.get(name)
        if column is None:
            continue
        texts = [_label(value) for value in column.values]
        if all(texts) and len(set(texts)) == count:
            return texts
    return [str(number) for number in range(1, count + 1)]


def _label(value: str | float | None) -> str:
    if isinstance(value, float):
        return f"{value:.10g}"
    return " ".join((value or "").split())[:60]


def _rates(column: Column, unit: Unit, names: Sequence[str], path: Path) -> list[float | None]:
    """Return every record's rate in L/ha; a record without one stays without."""
    rates: list[float | None] = []
    for name, value in zip(names, column.values, strict=True):
        try:
            number = as_number(value)
        except ValueError:
            raise _bad_rate(path, column, f"zone {name}", value) from None
        rate = None if number is None else number * unit.l_ha + 0.0  # no -0
        if rate is not None and not 0.0 <= rate < RATE_MAX_L_HA:
            raise _bad_rate(path, column, f"zone {name}", value)
        rates.append(rate)
    return rates


def _bad_rate(path: Path, column: Column | Band, where: str, value: object) -> Exception:
    shown = repr(value)[:40]
    return map_error(
        path,
        f"{column.name} of {where} is {shown}, which is not a rate",
        fix="correct the value (leave it blank where nothing is prescribed), or name another "
        "column with --rate-field (prescription.rate_field)",
        code="bad-rate",
    )


def ground_of(
    layer: Layer, crs: CRS, names: Sequence[str], path: Path
) -> tuple[list[Area | None], list[Repair]]:
    """Return every record's ground in longitude and latitude, repaired where rings cross."""
    here = _polygons(layer, path)
    try:
        native: Objects = np.array([layer.geometries[index] for index in here], dtype=object)
        try:
            areas = to_longitude_latitude(native, crs, path=path)
        except MapError as error:
            strays = _strays(native, crs)
            if not strays:
                raise
            listed = ", ".join(names[here[index]] for index in strays[:5])
            raise map_error(
                path,
                f"{len(strays)} of {len(here)} records lie far from all others: {listed}"
                + (", …" if len(strays) > 5 else "")
                + f" ({str(error).removeprefix(f'{path}: ').removesuffix(f'; {error.fix}')})",
                fix="delete them where the map is made",
                code=error.code or "out-of-range",
            ) from None
        repaired, repairs = _repaired(areas, [names[index] for index in here], path)
        check_edges(np.array([area for area in repaired if area is not None], dtype=object), path)
    except ShapelyError as error:
        raise unusable_polygons(path, error) from None
    ground: list[Area | None] = [None] * len(layer.geometries)
    for index, area in zip(here, repaired, strict=True):
        ground[index] = area
    if all(area is None for area in ground):
        raise map_error(
            path,
            "no polygon in the file has an area",
            fix="export the map again",
            code="no-polygon",
        )
    return ground, repairs


def _polygons(layer: Layer, path: Path) -> list[int]:
    """Return which records are polygons; where none is, nothing else of the file matters."""
    here = [index for index, area in enumerate(layer.geometries) if area is not None]
    if not here:
        kinds = Counter(layer.skipped.values())
        found = ", ".join(f"{count} x {kind}" for kind, count in kinds.items())
        raise map_error(
            path,
            f"there is no polygon in the file ({found or 'it has no records'})",
            fix="export the zones as polygons",
            code="no-polygon",
        )
    return here


def _strays(native: Objects, crs: CRS) -> list[int]:
    """Return which records lie farther from the middle than a map reaches, if they are few."""
    west, south, east, north = shapely.bounds(native).T
    middles = np.column_stack([west + east, south + north]) / 2.0
    away = np.hypot(*(middles - np.median(middles, axis=0)).T)
    reach = EXTENT_MAX_M / (METRES_PER_DEGREE if crs.is_geographic else 1.0)
    far = np.flatnonzero(~(away <= reach)).tolist()
    return far if len(far) < len(native) / 2 else []


def _repaired(
    areas: Objects, names: Sequence[str], path: Path
) -> tuple[list[Area | None], list[Repair]]:
    """Return valid polygons, and for each that was not, how much ground the repair changed."""
    result: list[Area | None] = list(areas)
    broken = np.flatnonzero(~shapely.is_valid(areas))
    if not len(broken):
        return result, []
    check_crossings(areas[broken], path)
    check_apart(areas[broken], [f"record {names[index]}" for index in broken.tolist()], path)
    mended = [make_valid(area) for area in areas[broken]]
    frame = frame_around(areas)
    before_m2 = shapely.area(project_all(areas[broken], frame))
    after_m2 = shapely.area(project_all(np.array(mended, dtype=object), frame))
    for index, area in zip(broken.tolist(), mended, strict=True):
        result[index] = area
    repairs = [
        Repair(
            zone=names[index],
            reason=shapely.is_valid_reason(areas[index])[:60],
            before_m2=before,
            after_m2=after,
        )
        for index, before, after in zip(
            broken.tolist(), before_m2.tolist(), after_m2.tolist(), strict=True
        )
    ]
    repairs.sort(key=lambda repair: repair.change_m2, reverse=True)
    return result, repairs


def skip_problems(layer: Layer, names: Sequence[str]) -> list[Problem]:
    """Return one problem for each reason for which records were left out."""
    by_reason: dict[str, list[str]] = {}
    for index, reason in layer.skipped.items():
        by_reason.setdefault(reason, []).append(names[index])
    return [
        Problem(
            severity="warning",
            code=reason.split(":")[0],
            text=f"{len(where)} of {len(layer.geometries)} records are left out: {reason}",
            where=", ".join(where[:5]) + (", …" if len(where) > 5 else ""),
            fix="remove them, or draw them as polygons",
        )
        for reason, where in by_reason.items()
    ]
