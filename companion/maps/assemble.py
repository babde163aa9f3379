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

from companion.maps.crs import Objects, crs_name, datum_problem, parse_crs, to_longitude_latitude
from companion.maps.declared import unit_of
from companion.maps.fields import choose
from companion.maps.layer import Column, Layer, as_number
from companion.maps.local import Area, frame_around, make_valid, project
from companion.maps.model import RATE_MAX_L_HA, MapFile, MapZone, Problem, map_error
from companion.maps.units import l_ha_per_unit

# Names of zones, the best first: the first of these columns that tells all records apart.
_NAME_COLUMNS = ("name", "zonename", "zone", "zoneid", "zone_id", "label", "id", "fid", "level")


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
        return (
            f"rings cross themselves ({self.reason}); the repair changes the area "
            f"from {self.before_m2:.2f} to {self.after_m2:.2f} m2"
        )

    @property
    def problem(self) -> Problem:
        """Return the repair as something to tell the operator."""
        return Problem(
            severity="warning",
            code="invalid-ring",
            text=self.text,
            where=self.zone,
            fix="repair the zone where the map is made",
        )


def map_of(
    layer: Layer, path: Path, *, rate_field: str | None, unit: str | None, crs: str | None
) -> MapFile:
    """Return the map that a layer holds, or refuse what is ambiguous in it."""
    used_crs, crs_problems = crs_of(layer, path, crs)
    if not layer.columns:
        raise map_error(
            path,
            "the map has no attributes and so no rates",
            fix="copy all of its files (.shp, .shx, .dbf and .prj), or export it again",
        )
    choice = choose(layer.columns, asked=rate_field, path=path)
    used_unit, unit_problems = unit_of(layer, choice.column, asked=unit, path=path)
    names = zone_names(layer)
    rates = _rates(choice.column, used_unit, names, path)
    ground, repairs = ground_of(layer, used_crs, names, path)
    zones = tuple(
        MapZone(name=name, geometry=area, rate_l_ha=rate)
        for name, area, rate in zip(names, ground, rates, strict=True)
        if area is not None
    )
    return MapFile(
        path=path,
        format=layer.format,
        crs=crs_name(used_crs),
        unit=used_unit,
        rate_field=choice.column.name,
        zones=zones,
        sha256=layer.sha256,
        problems=(
            *layer.problems,
            *crs_problems,
            *choice.problems,
            *unit_problems,
            *skip_problems(layer, names),
            *(repair.problem for repair in repairs),
        ),
    )


def crs_of(layer: Layer, path: Path, asked: str | None) -> tuple[CRS, list[Problem]]:
    """Return the CRS of the coordinates: what the operator says, else what the file says."""
    problems: list[Problem] = []
    if asked is not None:
        crs = parse_crs(asked, path=path, source=f"--crs {asked!r}")
        if layer.crs is not None and crs_name(layer.crs) != crs_name(crs):
            problems.append(
                Problem(
                    severity="warning",
                    code="crs-overridden",
                    text=f"the file says {crs_name(layer.crs)}, {crs_name(crs)} is used as asked",
                    where=str(path),
                    fix="leave out --crs (prescription.crs) to believe the file",
                )
            )
    elif layer.crs is not None:
        crs = layer.crs
    else:
        raise map_error(
            path,
            "the file does not say its coordinate reference system"
            + (" (no .prj beside it)" if layer.format == "shapefile" else ""),
            fix="give it with --crs, for example --crs EPSG:4326, or copy the missing file",
        )
    datum = datum_problem(crs)
    return crs, [*problems, *([datum] if datum is not None else [])]


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


def _rates(column: Column, unit: str, names: Sequence[str], path: Path) -> list[float | None]:
    """Return every record's rate in L/ha; a record without one stays without."""
    factor = l_ha_per_unit(unit)
    if factor is None:
        raise ValueError(f"no unit of volume per area: {unit}")
    rates: list[float | None] = []
    for name, value in zip(names, column.values, strict=True):
        try:
            number = as_number(value)
        except ValueError:
            raise _bad_rate(path, column, name, value) from None
        rate = None if number is None else number * factor
        if rate is not None and not 0.0 <= rate < RATE_MAX_L_HA:
            raise _bad_rate(path, column, name, value)
        rates.append(rate)
    return rates


def _bad_rate(path: Path, column: Column, name: str, value: object) -> Exception:
    shown = repr(value)[:40]
    return map_error(
        path,
        f"{column.name} of zone {name} is {shown}, which is no rate",
        fix="correct the value (leave it blank where nothing is prescribed), or name another "
        "column with --rate-field (prescription.rate_field)",
    )


def ground_of(
    layer: Layer, crs: CRS, names: Sequence[str], path: Path
) -> tuple[list[Area | None], list[Repair]]:
    """Return every record's ground in longitude and latitude, repaired where rings cross."""
    here = [index for index, area in enumerate(layer.geometries) if area is not None]
    if not here:
        kinds = Counter(layer.skipped.values())
        found = ", ".join(f"{count} x {kind}" for kind, count in kinds.items())
        raise map_error(
            path,
            f"there is no polygon in the file ({found or 'it is empty'})",
            fix="export the zones as polygons",
        )
    try:
        native: Objects = np.array([layer.geometries[index] for index in here], dtype=object)
        areas = to_longitude_latitude(native, crs, path=path)
        repaired, repairs = _repaired(areas, [names[index] for index in here])
    except ShapelyError as error:
        raise map_error(
            path, f"its polygons cannot be used ({str(error)[:120]})", fix="export the map again"
        ) from None
    ground: list[Area | None] = [None] * len(layer.geometries)
    for index, area in zip(here, repaired, strict=True):
        ground[index] = area
    if all(area is None for area in ground):
        raise map_error(path, "no polygon in the file has an area", fix="export the map again")
    return ground, repairs


def _repaired(areas: Objects, names: Sequence[str]) -> tuple[list[Area | None], list[Repair]]:
    """Return valid polygons, and for each that was not, how much ground the repair changed."""
    result: list[Area | None] = list(areas)
    repairs = []
    broken = np.flatnonzero(~shapely.is_valid(areas))
    frame = frame_around(areas)
    for index in broken.tolist():
        area = result[index] = make_valid(areas[index])
        repairs.append(
            Repair(
                zone=names[index],
                reason=shapely.is_valid_reason(areas[index])[:60],
                before_m2=project(areas[index], frame).area,
                after_m2=0.0 if area is None else project(area, frame).area,
            )
        )
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
