"""ISOXML task data, version 3 and 4 (ISO 11783-10): its files, grids of type 1 and 2, polygons.

One code path for a folder, a zip and the XML file itself. Names are found in any case, since
terminals and file systems change it; grids and external files lie in the folder of TASKDATA.XML.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path, PurePosixPath
from xml.etree.ElementTree import Element

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import MultiPolygon, Polygon
from shapely.errors import ShapelyError

from companion.errors import MapError
from missions.maps.bundle import MAX_ELEMENTS, Bundle, open_bundle, parse_xml
from missions.maps.crs import WGS84
from missions.maps.isoxml.field import (
    CELLS_MAX,
    FIELD,
    OBSTACLES,
    ZONE,
    GridShape,
    check_grid_in_field,
    check_length,
    declared_length,
    field_of,
    grid_shape,
    ground_of_polygons,
    point_count,
)
from missions.maps.isoxml.rates import (
    Rates,
    References,
    check_shown,
    key_among,
    product_names,
    rates_of,
    shown_in_zones,
    special_problems,
)
from missions.maps.isoxml.task import (
    Task,
    TreatmentZone,
    chosen_task,
    instead_of,
    spread_over_field,
)
from missions.maps.isoxml.values import EXPORT_AGAIN, children, integer, required, tag, text
from missions.maps.local import as_area, polygons_of
from missions.maps.model import (
    MAX_FILE_BYTES,
    Band,
    Column,
    Grid,
    Layer,
    Problem,
    check_counts,
    digest,
    map_error,
)

# ------------------------------------------------------------------------------ the files of a task

_TASK_DATA = "TASKDATA.XML"
_SETS_MAX = 8
# "TSK00001", "GRD00001": ISO 11783-10 wants three letters and five digits.
_FILE_NAME = re.compile(r"[A-Za-z0-9_-]{1,32}")
_KNOWN_VERSIONS = ("3", "4")
# Drafts of what became version 3; the elements of a prescription are the same.
_OLD_VERSIONS = ("0", "1", "2")


class TaskFiles:
    """TASKDATA.XML with its external files merged in; remembers all bytes that were used."""

    def __init__(self, path: Path) -> None:
        """Find, read and merge, or refuse."""
        self.path = path
        self._bundle = _bundle(path)
        self._used: dict[str, bytes] = {}
        self._main = _main_name(self._bundle, path)
        self.root = parse_xml(self._read(self._main), path, name=self._main)
        self.problems = _check_root(self.root, path)
        self._merge()

    @property
    def sha256(self) -> str:
        """Return the digest over the bytes of all files used, in the order of their names."""
        return digest(self._used[name] for name in sorted(self._used))

    def referred(self, name: str, suffix: str) -> bytes:
        """Return the bytes of a file that the task data names without its suffix."""
        stem = name[: -len(suffix)] if name.casefold().endswith(suffix) else name
        if not _FILE_NAME.fullmatch(stem):
            raise map_error(
                self.path,
                f"it refers to a file {name[:40]!r}, which is not a name of a task file",
                fix=EXPORT_AGAIN,
                code="bad-attribute",
            )
        folder = PurePosixPath(self._main).parent
        found = [
            one for one in self._bundle.called(stem + suffix) if PurePosixPath(one).parent == folder
        ]
        # On a stick both GRD00001.BIN and grd00001.bin are one file, in a folder two.
        if len(found) > 1:
            raise map_error(
                self.path,
                f"there are several files for {stem}: {', '.join(found)}",
                fix="keep the one that belongs to the task",
                code="duplicate-code",
            )
        if not found:
            raise map_error(
                self.path,
                f"the file {stem}{suffix} to which it refers is not there",
                fix=f"copy it beside {PurePosixPath(self._main).name}",
                code="no-file",
            )
        return self._read(found[0])

    def _read(self, name: str) -> bytes:
        if name not in self._used:
            self._used[name] = self._bundle.read(name)
            if sum(map(len, self._used.values())) > MAX_FILE_BYTES:
                raise map_error(
                    self.path,
                    f"its files have more than {MAX_FILE_BYTES // 1024**2} MB together",
                    fix="export one field",
                    code="too-large",
                )
        return self._used[name]

    def _merge(self) -> None:
        """Put the elements of external files (XFR) where the references stand."""
        seen: set[str] = set()
        count = 0
        for reference in children(self.root, "XFR"):
            name = required(reference, "A", self.path)
            if name.casefold() in seen:
                raise map_error(
                    self.path,
                    f"it refers to the external file {name[:40]} twice",
                    fix=EXPORT_AGAIN,
                    code="duplicate-code",
                )
            seen.add(name.casefold())
            external = parse_xml(self.referred(name, ".xml"), self.path, name=name)
            if tag(external) != "XFC":
                raise map_error(
                    self.path,
                    f"its external file {name[:40]} is not part of a task ({tag(external)[:40]})",
                    fix=EXPORT_AGAIN,
                    code="unknown-format",
                )
            count += sum(1 for _ in external.iter())
            if count > MAX_ELEMENTS:
                raise map_error(
                    self.path,
                    f"its external files have more than {MAX_ELEMENTS} elements together",
                    fix="export one field",
                    code="too-large",
                )
            self.root.extend(external)
            self.root.remove(reference)


def _bundle(path: Path) -> Bundle:
    """Return the files beside a TASKDATA.XML, or those in a folder or zip."""
    if path.suffix.casefold() != ".xml" or path.is_dir():
        return open_bundle(path)
    try:
        beside: dict[str, Path] = {
            file.name: file
            for file in sorted(path.parent.iterdir())
            if file.suffix.casefold() in (".xml", ".bin")
            and file.is_file()
            and not file.is_symlink()
        }
    except OSError as error:
        raise map_error(
            path, f"cannot be read ({error.strerror})", fix="check path and rights", code="no-file"
        ) from None
    return Bundle(path, {**beside, path.name: path})


def _main_name(bundle: Bundle, path: Path) -> str:
    """Return the name of the task data; several in a package may be of different fields."""
    if path.name in bundle.files and path.suffix.casefold() == ".xml":
        return path.name
    found = bundle.called(_TASK_DATA)
    if not found:
        raise map_error(
            path,
            f"there is no {_TASK_DATA} in it",
            fix=f"name the folder or the zip that holds {_TASK_DATA}",
            code="no-file",
        )
    if len(found) > 1:
        raise map_error(
            path,
            f"there are several sets of task data: {', '.join(found[:_SETS_MAX])}",
            fix=f"unpack it, and name one {_TASK_DATA} or its folder",
            code="several-sets",
        )
    return found[0]


def _check_root(root: Element, path: Path) -> list[Problem]:
    """Refuse other XML and other versions of the standard."""
    if tag(root) != "ISO11783_TaskData":
        raise map_error(
            path,
            f"this XML is no ISOXML task data but {tag(root)[:40]!r}",
            fix=f"name the {_TASK_DATA}",
            code="unknown-format",
        )
    version = text(root, "VersionMajor")
    if version in _KNOWN_VERSIONS:
        return []
    if version not in _OLD_VERSIONS:
        raise map_error(
            path,
            f"its ISOXML version {(version or 'is missing')[:20]} is not known",
            fix="export the task as ISOXML version 3 or 4",
            code="unknown-format",
        )
    return [
        Problem(
            severity="warning",
            code="old-version",
            text=f"the task data are of ISOXML version {version}, and read as version 3",
            where=str(path),
            fix="export the task as ISOXML version 3 or 4",
        )
    ]


# ---------------------------------------------------------------------------------- the map in them


def read_isoxml(path: Path, layer: str | None = None) -> Layer | Grid:
    """Return what a task prescribes, from a TASKDATA.XML, its folder, or a zip of it.

    `layer` is the id or the designator of one of several tasks.
    """
    files = TaskFiles(path)
    spread_problems = spread_over_field(files.root)
    try:
        task, tasks = chosen_task(files.root, path, layer, product_names(files.root))
    except MapError as error:
        if error.code != "no-rate-column":
            raise
        return _of_field(files, layer, error)
    instead = instead_of(task.id, tasks)
    references = References(files.root, path, instead)
    boundary, problems = field_of(files.root, task.field, path)
    found: Layer | Grid
    if task.grid is not None:
        found = grid_of_task(files, task.grid, task, references, boundary)
    else:
        found = zones_layer(files, task, references, boundary)
    problems = [*files.problems, *spread_problems, *problems, *found.problems]
    return replace(found, instead=instead, problems=tuple(problems))


def _of_field(files: TaskFiles, layer: str | None, rateless: MapError) -> Layer:
    """Return the outline of the only field, or of the one that `layer` names.

    Whoever looks for rates in it is told why there are none.
    """
    fields = [one for one in children(files.root, "PFD") if children(one, "PLN")]
    found = [one for one in fields if layer is None or layer in (text(one, "A"), text(one, "C"))]
    if not fields or (layer is not None and not found):
        raise rateless
    if len(found) > 1:
        listed = ", ".join(f"{text(one, 'A')} ({text(one, 'C')})" for one in found[:_SETS_MAX])
        raise map_error(
            files.path,
            f"no task of it has a prescription, and it has several fields: {listed}",
            fix="for the outline of one of them, choose it with --layer",
            code="several-layers",
        )
    own = required(found[0], "A", files.path)
    boundary, problems = field_of(files.root, own, files.path)
    if boundary is None:
        raise rateless
    return Layer(
        format="isoxml",
        crs=WGS84,
        columns=(),
        geometries=(boundary,),
        sha256=files.sha256,
        boundary=boundary,
        rateless=rateless,
        problems=(*files.problems, *problems),
    )


# Polygon treatment zones of an ISOXML task, as a layer of records.


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
            zone.polygons,
            OBSTACLES,
            where=f"treatment zone {zone.code}",
            path=files.path,
            nested=True,
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


# Grids of an ISOXML task: type 1, a treatment zone's code for each cell; type 2, its values.
#
# A and B of a GRD are the minimum north and east, so the corner in the south-west; C and D the size
# of a cell in degrees; E and F the numbers of columns and rows. Rows go from south to north, the
# cells of a row from west to east; type 2 holds 32-bit integers with the low byte first, for each
# cell one for every process data variable of its treatment zone.


def grid_of_task(
    files: TaskFiles,
    element: Element,
    task: Task,
    references: References,
    boundary: MultiPolygon | None,
) -> Grid:
    """Return the cells of the task's grid, one band for each product."""
    shape = grid_shape(element, files.path)
    content = files.referred(shape.name, ".bin")
    if shape.type == 1:
        bands, problems = _by_codes(shape, content, task, references)
    else:
        bands, problems = _by_values(shape, content, element, task, references)
    problems = [*declared_length(shape, content), *problems]
    if boundary is not None:
        most = bands[0].values if len(bands) == 1 else np.fmax.reduce([b.values for b in bands])
        problems += _in_field(most, shape, boundary, files.path)
    return Grid(
        format="isoxml",
        crs=WGS84,
        transform=shape.transform,
        bands=tuple(bands),
        sha256=files.sha256,
        boundary=boundary,
        problems=tuple(problems),
    )


def _in_field(
    rates: NDArray[np.float64], shape: GridShape, boundary: MultiPolygon, path: Path
) -> list[Problem]:
    try:
        return check_grid_in_field(rates, shape.transform, boundary, path)
    except ShapelyError as error:
        raise map_error(
            path,
            f"grid and field cannot be compared ({str(error)[:120]})",
            fix=EXPORT_AGAIN,
            code="broken-geometry",
        ) from None


def _by_codes(
    shape: GridShape, content: bytes, task: Task, references: References
) -> tuple[list[Band], list[Problem]]:
    """Return the bands of a grid of type 1."""
    path = references.path
    check_length(shape, content, path, cell_bytes=1, bands=1)
    codes = np.frombuffer(content, dtype=np.uint8).reshape(shape.rows, shape.columns)
    counts = np.bincount(codes.ravel(), minlength=256)
    undefined = [code for code in np.flatnonzero(counts).tolist() if code not in task.zones]
    if undefined:
        shown = ", ".join(map(str, undefined[:30])) + (", …" if len(undefined) > 30 else "")
        raise map_error(
            path,
            f"{int(counts[undefined].sum())} of {codes.size} cells of its grid have codes that "
            f"are not treatment zones of task {task.id[:40]}: {shown}",
            fix="export the task again with all of its treatment zones",
            code="undefined-code",
        )
    rates, problems = rates_of(task, references)
    used = [one for one in rates if any(counts[code] for code in one.by_code if code < 256)]
    if not used:
        raise _no_rate(task, path)
    if codes.size * len(used) > CELLS_MAX:
        check_length(shape, content, path, cell_bytes=1, bands=len(used))
    bands = []
    for one in used:
        problems += check_shown(one, shown_in_zones(one), references)
        table = np.full(256, np.nan)
        for code in one.by_code:
            amount = one.amount(code)
            if amount is not None and code < 256:
                table[code] = amount
        bands.append(_band(one, table[codes], task))
    return bands, [*problems, *special_problems(task, used)]


def _by_values(
    shape: GridShape, content: bytes, element: Element, task: Task, references: References
) -> tuple[list[Band], list[Problem]]:
    """Return the bands of a grid of type 2, for the variables of the zone that the grid names."""
    path = references.path
    zone = _template(element, task, path)
    count = len(zone.variables)
    if not count:
        raise _no_rate(task, path)
    check_length(shape, content, path, cell_bytes=4, bands=count)
    raw = np.frombuffer(content, dtype="<i4").reshape(shape.rows, shape.columns, count)
    rates, problems = rates_of(task, references)
    bands, used = [], []
    for index, variable in enumerate(zone.variables):
        one = key_among(rates, zone.code, variable)
        if one is None:
            continue
        own = raw[:, :, index]
        shown = {variable.presentation: (int(own.min()), int(own.max()))}
        problems += check_shown(one, shown, references)
        bands.append(_band(one, own / one.family.raw_per_unit, task))
        used.append(one)
    if not bands:
        raise _no_rate(task, path)
    return bands, [*problems, *special_problems(task, used)]


def _template(element: Element, task: Task, path: Path) -> TreatmentZone:
    """Return the treatment zone whose variables a grid of type 2 holds."""
    if text(element, "J") is None:
        raise map_error(
            path,
            "its grid of type 2 does not name the treatment zone whose values it holds (J)",
            fix=EXPORT_AGAIN,
            code="undefined-code",
        )
    code = integer(element, "J", path, low=0, high=254)
    if code not in task.zones:
        raise map_error(
            path,
            f"its grid holds values of treatment zone {code}, which task {task.id[:40]} does not "
            "have",
            fix=EXPORT_AGAIN,
            code="undefined-code",
        )
    return task.zones[code]


def _band(one: Rates, values: NDArray[np.float64], task: Task) -> Band:
    return Band(
        name=one.name,
        values=values,
        unit=one.family.unit,
        is_rate=True,
        default=one.amount(task.default_code),
    )


def _no_rate(task: Task, path: Path) -> Exception:
    return map_error(
        path,
        f"no treatment zone in the grid of task {task.id[:40]} has a rate",
        fix="export the task with an application rate by volume, DDI 0001",
        code="no-rate-column",
    )


# Place and size of an ISOXML grid, and whether its binary is as long as that asks for.
