"""The field of an ISOXML task: its outline, its grid, and whether that lies in it at all."""

from __future__ import annotations

from collections.abc import Container, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import MultiPolygon, Polygon, box
from shapely.errors import ShapelyError

from missions.maps.crs import WGS84
from missions.maps.isoxml.task import ById
from missions.maps.isoxml.values import EXPORT_AGAIN, children, integer, number, required, text
from missions.maps.local import Area, as_area, polygons_of
from missions.maps.model import Affine, Problem, check_coordinates, check_counts, map_error
from missions.maps.outlines import outline_of, united

# A grid covers its field but for the cells along its edge, and sprays nothing beyond it but what
# those cells stick out.
_COVERED_MIN = 0.90
_OUTSIDE_MAX = 0.05
# So many of the sprayed cells are tried, evenly spread, whatever the size of the grid.
_TRIED_MAX = 50_000


def field_of(
    root: Element, own: str | None, path: Path
) -> tuple[MultiPolygon | None, list[Problem]]:
    """Return the outline of the field of this id, in longitude and latitude."""
    if own is None:
        return None, []
    field = ById(root, "PFD", path).get(own)
    if field is None:
        problem = Problem(
            severity="warning",
            code="undefined-code",
            text=f"the task is for the field {own[:40]}, which the file does not have; "
            "the map has no outline",
            where=own,
            fix=EXPORT_AGAIN,
        )
        return None, [problem]
    polygons = children(field, "PLN")
    check_counts(path, records=len(polygons), vertices=point_count(polygons))
    ground, others = ground_of_polygons(polygons, (FIELD,), where=f"field {own}", path=path)
    blocked, rest = ground_of_polygons(
        polygons, OBSTACLES, where=f"field {own}", path=path, nested=True
    )
    objects = others - (len(polygons) - rest)
    outline = outline_of([ground], WGS84, path)
    problems = []
    if outline is not None and blocked is not None:
        outline, taken = _without(outline, blocked, path)
        problems.append(_field_objects(own, taken))
    if objects:
        problems.append(
            Problem(
                severity="warning",
                code="field-objects",
                text=f"the field has {objects} other polygons (headland, buffer zones), which are "
                "not taken out of the map",
                where=own,
                fix="give what must not be sprayed as an exclusion (prescription.exclusions)",
            )
        )
    return outline, problems


def _without(outline: MultiPolygon, blocked: Area, path: Path) -> tuple[MultiPolygon, float]:
    """Return the outline without its obstacles, and which part of it they take, 0 to 1."""
    ground = outline_of([blocked], WGS84, path) or MultiPolygon()
    left = MultiPolygon(polygons_of(shapely.difference(outline, ground)))
    if left.is_empty:
        raise map_error(
            path,
            "water, buildings, roads and obstacles cover the whole field",
            fix=EXPORT_AGAIN,
            code="field-objects",
        )
    return left, 1.0 - left.area / outline.area


def _field_objects(field: str, taken: float) -> Problem:
    return Problem(
        severity="warning",
        code="field-objects",
        text="water, buildings, roads, obstacles and windbreaks of the field are taken out of the "
        f"ground to spray, {100 * taken:.2g} % of it",
        where=field,
        fix="nothing, if they are where the field has them",
    )


def check_grid_in_field(
    rates: NDArray[np.float64], transform: Affine, boundary: MultiPolygon, path: Path
) -> list[Problem]:
    """Return what is wrong with the place of a grid; refuse one whose axes are exchanged.

    `rates` are of any unit; more than 0 is sprayed. The comparison is in degrees, which changes
    no share of an area as small as a field by more than a few parts in a thousand.
    """
    rows, columns = rates.shape
    east, _, west, _, north, south = transform
    grid = box(west, south, west + columns * east, south + rows * north)
    covered = grid.intersection(boundary).area / boundary.area
    if covered == 0.0:
        exchanged = box(south, west, south + columns * east, west + rows * north)
        if exchanged.intersects(boundary):
            raise map_error(
                path,
                "its grid lies in its field only with latitude and longitude exchanged",
                fix="export the grid with north in A and east in B",
                code="swapped-axes",
            )
        return [_problem("error", "the grid lies wholly outside its own field", grid.bounds)]
    problems = []
    if not covered >= _COVERED_MIN:
        said = f"the grid covers {100 * covered:.0f} % of its own field"
        problems.append(_problem("warning", said, grid.bounds))
    outside = _share_outside(rates, transform, boundary)
    if not outside <= _OUTSIDE_MAX:
        said = f"{100 * outside:.0f} % of the cells to spray lie outside the field"
        problems.append(_problem("warning", said, grid.bounds))
    return problems


def _share_outside(rates: NDArray[np.float64], transform: Affine, boundary: MultiPolygon) -> float:
    """Return the share of the sprayed cells that lie outside the boundary as a whole."""
    east, _, west, _, north, south = transform
    # `flatnonzero` of a comparison: NaN is not sprayed.
    sprayed = np.flatnonzero(rates > 0.0)
    if not len(sprayed):
        return 0.0
    tried = sprayed[:: max(1, len(sprayed) // _TRIED_MAX)]
    row, column = np.divmod(tried, rates.shape[1])
    around = boundary.buffer(float(np.hypot(east, north)) / 2.0)
    shapely.prepare(around)
    inside = shapely.contains_xy(around, west + (column + 0.5) * east, south + (row + 0.5) * north)
    return float(1.0 - inside.mean())


def _problem(severity: str, said: str, bounds: tuple[float, ...]) -> Problem:
    west, south, east, north = bounds
    return Problem(
        severity="error" if severity == "error" else "warning",
        code="grid-outside-field",
        text=said,
        where=f"grid {south:.6f} to {north:.6f} N, {west:.6f} to {east:.6f} E",
        fix="check that grid and field of the task belong together",
    )


# From ISOXML polygons (PLN) to ground: exterior and interior rings, latitude before longitude.

Floats = NDArray[np.float64]
# Types of a PLN (ISO 11783-10): 1 boundary of the field, 2 treatment zone; 3 to 7 and 12 are
# water, building, road, obstacle, flag and windbreak; 8 to 11 other, mainfield, headland, buffer.
FIELD, ZONE = "1", "2"
# What nobody sprays, wherever it lies in the field: water, building, road, obstacle, windbreak.
OBSTACLES = ("3", "4", "5", "6", "12")
# Types of a ring (LSG).
_EXTERIOR, _INTERIOR = "1", "2"
# What numbers are written with; keeps out "nan", "inf" and "1_000", which float() would take.
_DIGITS = frozenset("0123456789+-.eE")


def ground_of_polygons(
    elements: Sequence[Element],
    types: Container[str | None],
    *,
    where: str,
    path: Path,
    nested: bool = False,
) -> tuple[Area | None, int]:
    """Return the ground of all polygons of the given types, and how many others were left out."""
    wanted = [one for one in elements if text(one, "A") in types]
    try:
        parts = [part for one in wanted for part in _parts(one)]
        whole = as_area(parts)
        # Polygons that touch along an edge are ground together, which is no fault; rings that
        # cross are left for the repair, which tells of them.
        if isinstance(whole, MultiPolygon) and not whole.is_valid and _valid(parts):
            one = united(parts, [where[:60]] * len(parts), path, nested=nested)
            whole = as_area(list(one.geoms))
    except (ValueError, ShapelyError) as error:
        raise map_error(
            path,
            f"a polygon of {where[:60]} is broken ({str(error)[:120]})",
            fix=EXPORT_AGAIN,
            code="broken-geometry",
        ) from None
    return whole, len(elements) - len(wanted)


def point_count(elements: Iterable[Element]) -> int:
    """Return the number of points of polygons, before anything is made of them."""
    return sum(len(ring) for one in elements for ring in children(one, "LSG"))


def _valid(parts: Sequence[Polygon]) -> bool:
    return bool(shapely.is_valid(np.array(parts, dtype=object)).all())


def _parts(element: Element) -> list[Polygon]:
    """Return the polygons of one PLN, each exterior with the interiors that lie in it."""
    rings = children(element, "LSG")
    outer = [_ring(ring) for ring in rings if text(ring, "A") == _EXTERIOR]
    inner = [_ring(ring) for ring in rings if text(ring, "A") == _INTERIOR]
    obstacle = text(element, "A") in OBSTACLES
    if len(rings) == 1 and (obstacle or not inner):
        # Some terminals mark the outline as a flag or a fence, that of an obstacle as a hole in the
        # field; a single ring can be nothing else.
        return [Polygon(_ring(rings[0]))]
    if not outer:
        raise ValueError("it has no exterior ring")
    if len(outer) == 1:
        return [Polygon(outer[0], inner)]
    shells = [Polygon(ring) for ring in outer]
    holes: list[list[Floats]] = [[] for _ in outer]
    for ring in inner:
        holes[_around(shells, ring)].append(ring)
    return [Polygon(ring, own) for ring, own in zip(outer, holes, strict=True)]


def _around(shells: Sequence[Polygon], ring: Floats) -> int:
    """Return which exterior ring lies around an interior one."""
    point = Polygon(ring).representative_point()
    found = [index for index, shell in enumerate(shells) if shell.contains(point)]
    if not found:
        raise ValueError("an interior ring lies in no exterior ring")
    return min(found, key=lambda index: float(shells[index].area))


def _ring(element: Element) -> Floats:
    """Return the points of one LSG as longitude and latitude, closed."""
    points = children(element, "PNT")
    if any(point.get("J") for point in points):
        raise ValueError("its points are in a binary file, which is not read")
    pairs = [(point.get("D", "").strip(), point.get("C", "").strip()) for point in points]
    if not all(east and north for east, north in pairs):
        raise ValueError("a point lacks its latitude (C) or longitude (D)")
    if not _DIGITS.issuperset("".join(east + north for east, north in pairs)):
        raise ValueError("a coordinate is not a plain decimal number")
    ring = np.array([(float(east), float(north)) for east, north in pairs], dtype=np.float64)
    if len(ring) and not np.array_equal(ring[0], ring[-1]):
        ring = np.vstack([ring, ring[:1]])
    if len(ring) < 4:
        raise ValueError("a ring needs three points")
    check_coordinates(ring)
    return ring


# Cells of all bands together; 16 million are 128 MB.
CELLS_MAX = 16_000_000
_SIDE_MAX = 1_000_000
_BYTES_MAX = 2**32


@dataclass(frozen=True, slots=True, kw_only=True)
class GridShape:
    """What a GRD says of its cells."""

    name: str
    rows: int
    columns: int
    transform: Affine
    type: int
    declared_bytes: int | None


def grid_shape(element: Element, path: Path) -> GridShape:
    """Return what a GRD element says, within bounds."""
    south = number(element, "A", path, low=-90.0, high=90.0, code="out-of-range")
    west = number(element, "B", path, low=-180.0, high=180.0, code="out-of-range")
    north_deg = number(element, "C", path, low=1e-9, high=1.0)
    east_deg = number(element, "D", path, low=1e-9, high=1.0)
    columns = integer(element, "E", path, low=1, high=_SIDE_MAX)
    rows = integer(element, "F", path, low=1, high=_SIDE_MAX)
    kind = integer(element, "I", path, low=1, high=2)
    length = text(element, "H")
    shape = GridShape(
        name=required(element, "G", path),
        rows=rows,
        columns=columns,
        transform=(east_deg, 0.0, west, 0.0, north_deg, south),
        type=kind,
        declared_bytes=None
        if length is None
        else integer(element, "H", path, low=0, high=_BYTES_MAX),
    )
    if not (south + rows * north_deg <= 90.0 and west + columns * east_deg <= 180.0):
        raise map_error(
            path,
            f"its grid {shape.name[:40]} reaches beyond 90 degrees of latitude or 180 of longitude",
            fix=EXPORT_AGAIN,
            code="out-of-range",
        )
    return shape


def check_length(
    shape: GridShape, content: bytes, path: Path, *, cell_bytes: int, bands: int
) -> None:
    """Refuse a binary that does not hold what the grid says, before anything is made of it."""
    if shape.rows * shape.columns * bands > CELLS_MAX:
        raise map_error(
            path,
            f"its grid has {shape.rows} x {shape.columns} cells for {bands} values, more than "
            f"{CELLS_MAX} in all",
            fix="export one field, or larger cells",
            code="too-large",
        )
    expected = shape.rows * shape.columns * cell_bytes * bands
    if len(content) != expected:
        values = f" x {bands} values" if bands > 1 else ""
        each = "byte" if cell_bytes == 1 else "bytes"
        raise map_error(
            path,
            f"its grid {shape.name[:40]} has {len(content)} bytes, but {shape.rows} rows x "
            f"{shape.columns} columns x {cell_bytes} {each}{values} are {expected}",
            fix="export the task again, and copy all of its files",
            code="binary-length",
        )


def declared_length(shape: GridShape, content: bytes) -> list[Problem]:
    """Return a warning where the declared length is wrong and the file is as it has to be."""
    if shape.declared_bytes is None or shape.declared_bytes == len(content):
        return []
    problem = Problem(
        severity="warning",
        code="binary-length",
        text=f"the task declares {shape.declared_bytes} bytes for its grid, which has "
        f"{len(content)}, as its rows and columns ask for",
        where=shape.name,
        fix=EXPORT_AGAIN,
    )
    return [problem]
