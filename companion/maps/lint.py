"""What is wrong or remarkable about a map that can be read.

`read_map` refuses what cannot be used; here is what the operator should look at before a flight.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely

from companion.core.frame import LocalFrame
from companion.maps.build import frame_for
from companion.maps.local import project_all
from companion.maps.model import MapFile, MapZone, Problem
from companion.maps.overlaps import Objects, Overlap, overlaps
from companion.maps.points import point_rates

__all__ = ["check_map", "point_rates", "summary"]

SMALL_M2 = 1.0
# Mean width of a strip, 2 area / perimeter, that no boom can follow.
SLIVER_WIDTH_M = 0.1
# Zones closer than this are neighbours; ground between them belongs to none by mistake.
GAP_WIDTH_M = 1.0
GAP_MIN_M2 = 1.0
# Morphology over more parts than this takes longer than an operator waits.
GAP_PARTS_MAX = 100_000
FAR_M = 20_000.0
LATITUDE_MAX_DEG = 66.0
RATE_HIGH_L_HA = 2_000.0


def check_map(map_file: MapFile, *, overlap: str = "error") -> tuple[Problem, ...]:
    """Return everything that reading found, and what a look at the whole map adds.

    Overlaps are an error only where the overlap policy refuses them.
    """
    frame = frame_for(map_file)
    zones = map_file.zones
    local = project_all(np.array([zone.geometry for zone in zones], dtype=object), frame)
    return (
        *map_file.problems,
        *_overlap_problems(zones, local, overlap),
        *_rate_problems(map_file),
        *_small_problems(zones, local),
        *_gap_problems(local),
        *_place_problems(map_file, local, frame),
    )


def summary(map_file: MapFile, *, overlap: str = "error") -> dict[str, object]:
    """Return what `map check --json` prints.

    `area_ha` is of the zones that have a rate, each counted once, in the map's local frame.
    """
    problems = check_map(map_file, overlap=overlap)
    rated = [zone for zone in map_file.zones if zone.rate_l_ha is not None]
    local = project_all(
        np.array([zone.geometry for zone in rated], dtype=object), frame_for(map_file)
    )
    return {
        "ok": not any(problem.severity == "error" for problem in problems),
        "path": str(map_file.path),
        "format": map_file.format,
        "crs": map_file.crs,
        "unit": map_file.unit,
        "rate_field": map_file.rate_field,
        "zones": len(map_file.zones),
        "parts": sum(zone.part_count for zone in map_file.zones),
        "holes": sum(zone.hole_count for zone in map_file.zones),
        "area_ha": float(shapely.area(local).sum()) / 10_000.0,
        "rates_l_ha": sorted({zone.rate_l_ha for zone in rated if zone.rate_l_ha is not None}),
        "sha256": map_file.sha256,
        "problems": [
            {
                "severity": problem.severity,
                "code": problem.code,
                "text": problem.text,
                "where": problem.where,
                "fix": problem.fix,
            }
            for problem in problems
        ],
    }


def _overlap_problems(zones: Sequence[MapZone], local: Objects, policy: str) -> list[Problem]:
    rated = [index for index, zone in enumerate(zones) if zone.rate_l_ha is not None]
    found = overlaps([local[index] for index in rated])
    if not found:
        return []

    def pair(overlap: Overlap) -> str:
        first, second = zones[rated[overlap.first]], zones[rated[overlap.second]]
        return f"{first.name} and {second.name}: {overlap.area_m2:.1f} m2"

    total_m2 = sum(overlap.area_m2 for overlap in found)
    return [
        Problem(
            severity="error" if policy == "error" else "warning",
            code="overlap",
            text=f"{len(found)} pairs of zones overlap, by {total_m2:.1f} m2 in all",
            where="; ".join(pair(overlap) for overlap in found[:5]),
            fix="correct the map, or set prescription.overlap to max, min, mean or last",
        )
    ]


def _rate_problems(map_file: MapFile) -> list[Problem]:
    without = [zone.name for zone in map_file.zones if zone.rate_l_ha is None]
    rates = [zone.rate_l_ha for zone in map_file.zones if zone.rate_l_ha is not None]
    problems = []
    if without:
        problems.append(
            Problem(
                severity="warning" if rates else "error",
                code="null-rate",
                text=f"{len(without)} of {len(map_file.zones)} zones have no rate and are left out",
                where=_some(without),
                fix="give them a rate, 0 for none",
            )
        )
    if rates and not max(rates) > 0.0:
        problems.append(
            Problem(
                severity="warning",
                code="all-zero",
                text="every rate is 0: nothing would be sprayed",
                where=map_file.rate_field,
                fix="check the rate column",
            )
        )
    if rates and not max(rates) <= RATE_HIGH_L_HA:
        problems.append(
            Problem(
                severity="warning",
                code="high-rate",
                text=f"the largest rate is {max(rates):.0f} L/ha",
                where=map_file.rate_field,
                fix="check the rate column and its unit",
            )
        )
    return problems


def _small_problems(zones: Sequence[MapZone], local: Objects) -> list[Problem]:
    parts, owner = shapely.get_parts(local, return_index=True)
    area_m2 = shapely.area(parts)
    small = area_m2 < SMALL_M2
    narrow = ~small & (2.0 * area_m2 < SLIVER_WIDTH_M * shapely.length(parts))
    return [
        Problem(
            severity="warning",
            code=code,
            text=f"{int(mask.sum())} parts {text}",
            where=_some(list(dict.fromkeys(zones[index].name for index in owner[mask]))),
            fix="merge them into their neighbours",
        )
        for code, mask, text in (
            ("small-part", small, f"are smaller than {SMALL_M2:.0f} m2"),
            ("sliver", narrow, f"are narrower than {SLIVER_WIDTH_M * 100:.0f} cm"),
        )
        if mask.any()
    ]


def _gap_problems(local: Objects) -> list[Problem]:
    """Return ground narrower than a metre between zones, by closing the outline of them all."""
    if len(shapely.get_parts(local)) > GAP_PARTS_MAX:
        return []
    covered = shapely.union_all(local)
    grown = shapely.buffer(covered, GAP_WIDTH_M / 2, join_style="mitre")
    closed = shapely.buffer(grown, -GAP_WIDTH_M / 2, join_style="mitre")
    gaps = shapely.get_parts(shapely.difference(closed, covered))
    sizes = shapely.area(gaps)
    large = sizes[sizes >= GAP_MIN_M2]
    if not len(large):
        return []
    place = gaps[int(np.argmax(sizes))].representative_point()
    return [
        Problem(
            severity="warning",
            code="gap",
            text=f"{len(large)} gaps narrower than {GAP_WIDTH_M:.0f} m lie between zones, "
            f"{float(large.sum()):.1f} m2 in all; the valves close over them",
            where=f"the largest {place.x:.0f} m east, {place.y:.0f} m north of the map's centre",
            fix="draw the zones up to each other",
        )
    ]


def _place_problems(map_file: MapFile, local: Objects, frame: LocalFrame) -> list[Problem]:
    west, south, east, north = shapely.total_bounds(local)
    problems = []
    if not max(east - west, north - south) <= FAR_M:
        centres = shapely.get_coordinates(shapely.centroid(local))
        middle = np.median(centres, axis=0)
        farthest = int(np.argmax(np.hypot(*(centres - middle).T)))
        problems.append(
            Problem(
                severity="warning",
                code="far-apart",
                text=f"the map reaches over {max(east - west, north - south) / 1000:.0f} km",
                where=map_file.zones[farthest].name,
                fix="check the zone that lies far from the others",
            )
        )
    if not abs(frame.latitude_deg) <= LATITUDE_MAX_DEG or (
        abs(frame.latitude_deg) < 1.0 and abs(frame.longitude_deg) < 1.0
    ):
        problems.append(
            Problem(
                severity="warning",
                code="odd-place",
                text=f"the map lies at latitude {frame.latitude_deg:.4f}, longitude "
                f"{frame.longitude_deg:.4f}; are the two exchanged, or is the CRS wrong?",
                where="the whole map",
                fix="check the place; GeoJSON has the longitude first",
            )
        )
    return problems


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
