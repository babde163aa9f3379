"""From rings to polygons with holes, as a shapefile leaves it to the reader.

A shapefile record is a list of rings in any order: clockwise is outside, anticlockwise is a hole
(ESRI shapefile technical description, 1998, page 8), and which hole belongs to which outside is
for the reader to find.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import Polygon, STRtree

from missions.maps.local import Area, as_area

Floats = NDArray[np.float64]
Objects = NDArray[np.object_]


def areas_of_records(records: Sequence[Sequence[Floats]]) -> list[Area | None]:
    """Return `area_of_rings` of every record.

    Records of a single ring, which most are, are made at once: there is nothing to sort out.
    """
    single = [index for index, rings in enumerate(records) if _is_plain(rings)]
    made = _polygons([records[index][0] for index in single])
    quick = {
        index: polygon
        for index, polygon, area in zip(single, made, shapely.area(made), strict=True)
        if area > 0.0
    }
    return [
        quick[index] if index in quick else area_of_rings(rings)
        for index, rings in enumerate(records)
    ]


def _is_plain(rings: Sequence[Floats]) -> bool:
    return len(rings) == 1 and len(rings[0]) >= 4 and bool((rings[0][0] == rings[0][-1]).all())


def area_of_rings(rings: Sequence[Floats]) -> Area | None:
    """Return the polygon or multipolygon of one record, or None where no ring has an area."""
    shells, holes = [], []
    for ring in map(_closed, rings):
        turn = signed_area(ring) if len(ring) >= 4 else 0.0
        if turn > 0.0:
            holes.append(ring)
        elif turn < 0.0 or _crosses_itself(ring):
            shells.append(ring)
    return as_area(_assigned(shells, holes))


def signed_area(ring: Floats) -> float:
    """Return the area of a closed ring by the shoelace formula, positive anticlockwise.

    >>> signed_area(np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 1.0], [0.0, 1.0], [0.0, 0.0]]))
    2.0
    """
    # From the first point, so that large coordinates do not swallow a small area.
    x, y = (ring - ring[0]).T
    return float(np.dot(x[:-1], y[1:]) - np.dot(x[1:], y[:-1])) / 2.0


def _crosses_itself(ring: Floats) -> bool:
    """Tell a ring whose loops cancel out, which is for the repair, from one that is a line."""
    return len(ring) >= 4 and Polygon(ring).convex_hull.area > 0.0


def _closed(ring: Floats) -> Floats:
    if len(ring) and not np.array_equal(ring[0], ring[-1]):
        return np.vstack([ring, ring[:1]])
    return ring


def _polygons(rings: Sequence[Floats]) -> Objects:
    """Return a polygon without holes for every closed ring."""
    if not rings:
        return np.empty(0, dtype=object)
    owner = np.repeat(np.arange(len(rings)), [len(ring) for ring in rings])
    return np.array(shapely.polygons(shapely.linearrings(np.vstack(rings), indices=owner)))


def _owners(inner: Objects, outer: Objects) -> dict[int, list[int]]:
    """Return, for each inner polygon, the outer ones around it, the smallest first.

    One point tells which rings of a record lie in each other, as they do not cross; but what is
    smaller is not around it, it is an island whose ground the point happens to hit.
    """
    points = shapely.point_on_surface(inner)
    found = defaultdict(list)
    own, areas = shapely.area(inner), shapely.area(outer)
    for i, j in STRtree(outer).query(points, predicate="within").T.tolist():
        if areas[j] >= own[i]:
            found[i].append(j)
    return {i: sorted(around, key=lambda j: float(areas[j])) for i, around in found.items()}


def _assigned(shells: list[Floats], holes: list[Floats]) -> list[Polygon]:
    """Return the shells, each with the holes whose smallest surrounding shell it is.

    A hole that no shell surrounds shows that the writer paid no heed to the turns.
    """
    if not holes:
        return [Polygon(ring) for ring in shells]
    owners = _owners(_polygons(holes), _polygons(shells))
    if len(owners) < len(holes):
        return _by_depth([*shells, *holes])
    mine: dict[int, list[Floats]] = defaultdict(list)
    for index, around in owners.items():
        mine[around[0]].append(holes[index])
    return [Polygon(shell, mine.get(index)) for index, shell in enumerate(shells)]


def _by_depth(rings: list[Floats]) -> list[Polygon]:
    """Return polygons by how many others lie around each ring: even is ground, odd is a hole."""
    areas = _polygons(rings)
    owners = _owners(areas, areas)
    around = {
        index: [j for j in owners.get(index, []) if j != index] for index in range(len(rings))
    }
    holes: dict[int, list[Floats]] = defaultdict(list)
    for index, outer in around.items():
        if len(outer) % 2:
            holes[outer[0]].append(rings[index])
    return [
        Polygon(rings[index], holes.get(index))
        for index, outer in around.items()
        if len(outer) % 2 == 0
    ]
