"""Polygon treatment zones of an ISOXML task, as a layer of records."""

from __future__ import annotations

import shapely
from shapely import MultiPolygon, Polygon

from missions.maps.crs import WGS84
from missions.maps.isoxml.files import TaskFiles
from missions.maps.isoxml.polygons import (
    FIELD,
    OBSTACLES,
    ZONE,
    ground_of_polygons,
    point_count,
)
from missions.maps.isoxml.rates import (
    Rates,
    check_shown,
    rates_of,
    shown_in_zones,
    special_problems,
)
from missions.maps.isoxml.references import References
from missions.maps.isoxml.task import Task, TreatmentZone
from missions.maps.layer import Column, Layer, check_counts
from missions.maps.local import as_area, polygons_of
from missions.maps.model import Problem, map_error


def zones_layer(
    files: TaskFiles, task: Task, references: References, boundary: MultiPolygon | None
) -> Layer:
    """Return the zones that have polygons; the zones of the special codes need none."""
    rates, problems = rates_of(task, references)
    zones = [zone for zone in task.zones.values() if zone.polygons]
    used = [one for one in rates if any(zone.code in one.by_code for zone in zones)]
    if not used:
        raise map_error(
            files.path,
            f"no treatment zone of task {task.id[:40]} that has ground has a rate",
            fix="export the task with an application rate by volume, DDI 0001",
            code="no-rate-column",
        )
    for one in used:
        problems += check_shown(one, shown_in_zones(one), references)
    problems += special_problems(task, used)
    problems += _without_ground(task)
    geometries, skipped, left_out = _ground(files, zones)
    problems += left_out
    return Layer(
        format="isoxml",
        crs=WGS84,
        columns=(
            Column(name="name", values=tuple(zone.label for zone in zones), numeric=False),
            *(_column(one, zones, task) for one in used),
        ),
        geometries=tuple(geometries),
        sha256=files.sha256,
        boundary=boundary,
        skipped=skipped,
        problems=tuple(problems),
    )


def _column(one: Rates, zones: list[TreatmentZone], task: Task) -> Column:
    return Column(
        name=one.name,
        values=tuple(one.amount(zone.code) for zone in zones),
        numeric=True,
        unit=one.family.unit,
        is_rate=True,
        default=one.amount(task.default_code),
    )


def _ground(
    files: TaskFiles, zones: list[TreatmentZone]
) -> tuple[list[Polygon | MultiPolygon | None], dict[int, str], list[Problem]]:
    """Return the ground of every zone, why some have none, and what polygons were left out."""
    count = sum(point_count(zone.polygons) for zone in zones)
    check_counts(files.path, records=len(zones), vertices=count)
    geometries: list[Polygon | MultiPolygon | None] = []
    skipped: dict[int, str] = {}
    odd = []
    for index, zone in enumerate(zones):
        # Some programs write the outline of a zone as the boundary of a field.
        ground, others = ground_of_polygons(
            zone.polygons, (ZONE, FIELD), where=f"treatment zone {zone.code}", path=files.path
        )
        blocked, _ = ground_of_polygons(
            zone.polygons, OBSTACLES, where=f"treatment zone {zone.code}", path=files.path
        )
        if ground is not None and blocked is not None and ground.is_valid and blocked.is_valid:
            ground = as_area(polygons_of(shapely.difference(ground, blocked)))
        geometries.append(ground)
        if ground is None:
            skipped[index] = "not-a-polygon:no treatment zone (PLN type 2)"
        elif others:
            odd.append(zone.label)
    problems = []
    if odd:
        problems.append(
            Problem(
                severity="warning",
                code="polygon-type",
                text="polygons that are marked as neither treatment zone nor field (obstacles, "
                "roads, water) are left out",
                where=", ".join(odd[:5]) + (", …" if len(odd) > 5 else ""),
                fix="mark the ground to spray as treatment zone (PLN type 2)",
            )
        )
    return geometries, skipped, problems


def _without_ground(task: Task) -> list[Problem]:
    """Return a warning for zones with values that are nowhere and for no special case."""
    nowhere = [
        zone.label
        for zone in task.zones.values()
        if zone.variables and not zone.polygons and zone.code not in task.special_codes
    ]
    if not nowhere:
        return []
    problem = Problem(
        severity="warning",
        code="zone-without-ground",
        text=f"{len(nowhere)} treatment zones have a value but no polygon",
        where=", ".join(nowhere[:5]) + (", …" if len(nowhere) > 5 else ""),
        fix="export the task again, or remove them",
    )
    return [problem]
