"""What a flight map holds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path, PurePosixPath

import numpy as np
import shapely
from shapely import Geometry, MultiPolygon, Polygon

from companion.config import Config
from companion.config.tables import Buffer, PrescriptionTable
from companion.core.cells import CellGrid, Warp
from companion.core.frame import LocalFrame
from companion.core.options.lines import Polyline
from companion.core.prescription import Prescription, Zone
from companion.errors import Problem

Area = Polygon | MultiPolygon
SUFFIX = ".flightmap.gpkg"


@dataclass(frozen=True, slots=True, kw_only=True)
class SourceFile:
    """A file that the flight map was compiled from; `key` is the setting that named it."""

    key: str
    name: str
    sha256: str


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightMap:
    """A compiled map. All geometry is in metres of `frame`, without the offset of a flight.

    `is_bounded` is false for cells that may be sprayed wherever they have a rate. `source` is
    the name of the map's own file, `source_rates_l_ha` its rates as they stand there, and
    `frozen` the settings that it was compiled with. `sha256` is the hash of all of this, without
    who compiled it and when.
    """

    path: Path
    frame: LocalFrame
    prescription: Prescription
    is_bounded: bool
    source: str
    source_rates_l_ha: tuple[float, ...]
    exclusions: tuple[Area, ...] = ()
    polylines: tuple[Polyline, ...] = ()
    frozen: Mapping[str, object] = field(default_factory=dict)
    sources: tuple[SourceFile, ...] = ()
    findings: tuple[Problem, ...] = ()
    compiled_utc: str = ""
    compiled_by: str = ""
    compiled_with: str = ""
    sha256: str = ""

    def moved(self, east_m: float, north_m: float) -> Prescription:
        """Return the prescription, moved by the offset between map and receiver."""
        if not np.isfinite((east_m, north_m)).all():
            raise ValueError(f"offset is no distance: {(east_m, north_m)}")
        if east_m == 0.0 and north_m == 0.0:
            return self.prescription
        return moved(self.prescription, east_m=east_m, north_m=north_m, is_bounded=self.is_bounded)

    def age_days(self, now: datetime) -> float | None:
        """Return how old the flight map is; None where it does not say."""
        try:
            return (now - datetime.fromisoformat(self.compiled_utc)).total_seconds() / 86_400.0
        except (ValueError, TypeError):
            return None

    def as_object(self) -> dict[str, object]:
        """Return what the journal and the doctor say of it."""
        return {
            "file": self.path.name,
            "sha256": self.sha256,
            "source": self.source,
            "sources": [[each.key, each.name, each.sha256] for each in self.sources],
            "frozen": dict(self.frozen),
            "findings": [
                {
                    "severity": found.severity,
                    "code": found.code,
                    "text": found.text,
                    "where": found.where,
                    "fix": found.fix,
                }
                for found in self.findings
            ],
            "compiled_utc": self.compiled_utc,
            "compiled_by": self.compiled_by,
            "compiled_with": self.compiled_with,
        }


def is_flight_map(path: Path) -> bool:
    """Tell a flight map from any other map by its name.

    >>> is_flight_map(Path("field.flightmap.gpkg")), is_flight_map(Path("field.gpkg"))
    (True, False)
    """
    return path.name.casefold().endswith(SUFFIX)


def moved(
    prescription: Prescription, *, east_m: float, north_m: float, is_bounded: bool
) -> Prescription:
    """Return a prescription whose ground lies elsewhere by an offset."""
    offset_m = np.array([east_m, north_m])

    def shifted(areas: list[Area]) -> list[Area]:
        array = np.array(areas, dtype=object)
        found = shapely.transform(array, lambda points: points + offset_m)
        for index in np.flatnonzero(~shapely.is_valid(found)).tolist():
            # The last bits of a place can make rings cross that touch.
            found[index] = _ground_of(
                shapely.make_valid(found[index], method="structure", keep_collapsed=False)
            )
        return list(found)

    cells = prescription.cells
    zones = [] if cells is not None else list(prescription.zones)
    areas = shifted([zone.polygon for zone in zones]) if zones else []
    boundary = shifted([prescription.field])[0] if is_bounded else None
    return Prescription(
        [
            Zone(name=zone.name, polygon=area, rate_l_ha=zone.rate_l_ha)
            for zone, area in zip(zones, areas, strict=True)
            if not area.is_empty
        ],
        boundary=boundary,
        overlap=prescription.overlap,
        default_rate_l_ha=prescription.default_rate_l_ha,
        cells=None if cells is None else _moved_cells(cells, east_m, north_m),
        sha256=prescription.sha256,
    )


def _ground_of(geometry: Geometry) -> Area:
    parts = shapely.get_parts(shapely.get_parts(np.array([geometry], dtype=object)))
    polygons = [part for part in parts if isinstance(part, Polygon) and part.area > 0.0]
    return polygons[0] if len(polygons) == 1 else MultiPolygon(polygons)


def _moved_cells(cells: CellGrid, east_m: float, north_m: float) -> CellGrid:
    """Return the same cells with polynomials that lead to and from the other place."""
    there, back = cells.to_frame, cells.to_cells
    (u, v), *rest = there.terms
    return CellGrid(
        cells.classes,
        cells.rates_l_ha,
        Warp(
            x0=there.x0,
            y0=there.y0,
            scale=there.scale,
            terms=((u + east_m, v + north_m), *rest),
        ),
        Warp(x0=back.x0 + east_m, y0=back.y0 + north_m, scale=back.scale, terms=back.terms),
    )


# Settings that are compiled into a flight map, and a configuration that says something else.
#
# Where a flight goes on with other settings than those that the map was checked with, the map that
# was checked is not the map that is flown: such a flight is refused, and the key is named.

# What the ground and its rates depend on.
_FROZEN = ("overlap", "default_rate_l_ha", "unit", "density_kg_l", "boundary", "exclusions")
# How the source was read: a configuration that says nothing of it does not object.
_READING = ("rate_field", "crs", "layer", "flow_width_m", "flow_speed_m_s", "merge", "origin")
_LINES = "mission.lines"
_BUFFERS = "limits.buffer"


def frozen_settings(
    table: PrescriptionTable, lines: str | None, buffers: Sequence[Buffer] = ()
) -> dict[str, object]:
    """Return the settings that are frozen in a flight map, as JSON has them.

    Buffers stand in it where there are any: a map without them is the same as ever.
    """
    found = table.model_dump(mode="json", include={*_FROZEN, *_READING})
    named = {f"prescription.{name}": found[name] for name in (*_FROZEN, *_READING)}
    kept = [[each.kind, each.distance_m, list(each.files)] for each in buffers]
    return {**named, _LINES: lines, **({_BUFFERS: kept} if kept else {})}


def difference(flight_map: FlightMap, config: Config) -> tuple[str, object, object] | None:
    """Return the first frozen key in which flight map and configuration differ, and both values.

    The configuration's value comes first. Files are compared by their names here: those of the
    office lie in other folders.
    """
    if config.prescription is None:
        return None
    for key, wanted in frozen_settings(
        config.prescription, config.planned_lines, config.buffers
    ).items():
        compiled = flight_map.frozen.get(key)
        is_hint = key.removeprefix("prescription.") in _READING
        if is_hint and wanted is None:
            continue
        if _comparable(key, wanted) != _comparable(key, compiled):
            return key, wanted, compiled
    return None


def _comparable(key: str, value: object) -> object:
    if key in ("prescription.boundary", _LINES) and isinstance(value, str):
        return PurePosixPath(value).name
    if key == "prescription.exclusions" and isinstance(value, list):
        return [PurePosixPath(str(name)).name for name in value]
    if key == _BUFFERS and isinstance(value, list):
        return [
            [kind, distance_m, [PurePosixPath(str(name)).name for name in files]]
            for kind, distance_m, files in value
        ]
    return value


def named_files(
    table: PrescriptionTable, lines: str | None, folder: Path, buffers: Sequence[Buffer] = ()
) -> dict[str, Path]:
    """Return every file that a flight map is compiled from, by the setting that names it."""
    named: dict[str, str | None] = {
        "prescription.file": table.file,
        "prescription.boundary": table.boundary,
        **{
            f"prescription.exclusions[{number}]": name
            for number, name in enumerate(table.exclusions)
        },
        "mission.lines": lines,
        **{
            f"{_BUFFERS}[{number}].files[{at}]": name
            for number, each in enumerate(buffers)
            for at, name in enumerate(each.files)
        },
    }
    return {key: folder / name for key, name in named.items() if name is not None}
