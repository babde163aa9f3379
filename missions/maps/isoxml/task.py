"""Tasks of an ISOXML file: which one prescribes, and its treatment zones as they stand there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element, tostring

from companion.wording import typed
from missions.maps.isoxml.values import (
    EXPORT_AGAIN,
    children,
    ddi_of,
    integer,
    meaning,
    required,
    tag,
    text,
)
from missions.maps.model import Problem, check_counts, map_error
from missions.maps.units import rate_unit

# The standard ends at 254; some programs number their polygons beyond.
_CODE_MAX = 65_535
_RAW_MAX = 2**31 - 1


@dataclass(frozen=True, slots=True, kw_only=True)
class Variable:
    """One PDV: a raw value of a DDI, of a product, for a part of the machine, and how to show it.

    The references are ids; None where the file gives none.
    """

    ddi: int
    raw: int
    product: str | None
    device: str | None
    presentation: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class TreatmentZone:
    """One TZN; the polygons are left as elements."""

    code: int
    name: str | None
    variables: tuple[Variable, ...]
    polygons: tuple[Element, ...]

    @property
    def label(self) -> str:
        """Return the designator, or the code where there is none."""
        return self.name or str(self.code)


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """One TSK with a prescription; the codes name the treatment zones for the special cases."""

    id: str
    name: str | None
    zones: dict[int, TreatmentZone]
    grid: Element | None
    field: str | None
    default_code: int | None
    position_lost_code: int | None
    out_of_field_code: int | None

    @property
    def special_codes(self) -> set[int]:
        """Return the codes for default, position lost and out of field, where they are given."""
        codes = (self.default_code, self.position_lost_code, self.out_of_field_code)
        return {code for code in codes if code is not None}


class ById:
    """All elements of one kind by their ids, looked up only when something refers to them.

    Programs write a line again wherever it is used, byte for byte: that is one and the same. What
    differs under one id is refused where the id is in use, and nowhere else.
    """

    def __init__(self, root: Element, name: str, path: Path) -> None:
        self._name, self._path = name, path
        self._found: dict[str, list[Element]] = {}
        for element in children(root, name):
            own = text(element, "A")
            if own is not None:
                self._found.setdefault(own, []).append(element)

    def get(self, own: str) -> Element | None:
        """Return the element of this id, or None where the file has none."""
        alike = self._found.get(own, [])
        if len(alike) > 1 and len({_content(element) for element in alike}) > 1:
            raise _duplicate(
                self._path, f"{own[:40]} is the id of several {self._name} that differ"
            )
        return alike[0] if alike else None


def _content(element: Element) -> bytes:
    """Return what an element says; the blanks behind it are the file's."""
    written: bytes = tostring(element, encoding="utf-8")
    return written.rstrip()


def chosen_task(
    root: Element, path: Path, layer: str | None, products: Mapping[str, str]
) -> tuple[Task, list[TaskContents]]:
    """Return the one task that prescribes, or the one that `layer` names by id or designator.

    With it, what each of the tasks prescribes that could be chosen instead.
    """
    tasks = children(root, "TSK")
    prescribing: dict[str, list[Element]] = {}
    for task in tasks:
        if _prescribes(task):
            prescribing.setdefault(required(task, "A", path), []).append(task)
    if not prescribing:
        raise _nothing_prescribed(tasks, path)
    every = [contents_of(alike[0], products) for alike in prescribing.values()]
    if layer is None:
        found = list(prescribing)
    else:
        wanted = layer.strip()
        found = [own for own in prescribing if own == wanted] or [
            one.id for one in every if (one.name or "").casefold() == wanted.casefold()
        ]
        if not found:
            raise map_error(
                path,
                f"there is no task {layer[:40]!r} with a prescription",
                fix=f"choose with --layer one of {task_list(every)}",
                code="no-layer",
            )
    if len(found) > 1:
        listed = [one for one in every if one.id in found]
        example = next((one.id for one in listed if one.sprayable), found[0])
        raise map_error(
            path,
            f"several tasks have a prescription: {task_list(listed)}",
            fix=f"choose one with --layer, for example --layer {typed([example])}",
            code="several-layers",
        )
    chosen = ById(root, "TSK", path).get(found[0])
    if chosen is None:
        raise ValueError("a task that prescribes has its id")
    _check_grid(chosen, tasks, path)
    return _task(chosen, path), every


def spread_over_field(root: Element) -> list[Problem]:
    """Lay the only rate of the only task over its field, where neither has any other ground.

    Without polygons and without a grid a treatment zone holds for all of the task's field.
    """
    tasks = children(root, "TSK")
    zones = [zone for task in tasks for zone in children(task, "TZN")]
    fields = [
        one for one in children(root, "PFD") if tasks and text(one, "A") == text(tasks[0], "E")
    ]
    ground = [one for field in fields for one in children(field, "PLN")]
    alone = len(tasks) == len(zones) == len(fields) == 1 and ground
    if not alone or not children(zones[0], "PDV"):
        return []
    if children(zones[0], "PLN") or children(tasks[0], "GRD"):
        return []
    zones[0].extend(ground)
    problem = Problem(
        severity="warning",
        code="rate-of-field",
        text="the task has one rate and no ground of its own; it is taken for the whole field",
        where=(text(fields[0], "C") or text(fields[0], "A") or "")[:40],
        fix="nothing, if the field is sprayed at one rate",
    )
    return [problem]


def _nothing_prescribed(tasks: Sequence[Element], path: Path) -> Exception:
    """Return the refusal, with what the tasks have and what they lack."""
    for task in tasks:
        zones = children(task, "TZN")
        valued = [zone for zone in zones if children(zone, "PDV")]
        if valued or any(children(zone, "PLN") for zone in zones):
            lack = (
                "treatment zones with values but no ground: neither polygons nor a grid"
                if valued
                else "treatment zones with polygons but no values"
            )
            return map_error(
                path,
                f"task {(text(task, 'A') or '')[:40]} has {lack}",
                fix="export the task with its application map"
                + (", or fly one rate for the whole field without a map" if valued else ""),
                code="no-rate-column",
            )
    return map_error(
        path,
        f"none of its {len(tasks)} tasks has treatment zones with values or a grid",
        fix="export the task with its application map",
        code="no-rate-column",
    )


def _prescribes(task: Element) -> bool:
    """Tell whether a task says a rate anywhere; one that only names its defaults does not."""
    return any(
        tag(child) == "GRD"
        or (tag(child) == "TZN" and children(child, "PDV") and children(child, "PLN"))
        for child in task
    )


def _task(element: Element, path: Path) -> Task:
    own = required(element, "A", path)
    zones: dict[int, TreatmentZone] = {}
    found = children(element, "TZN")
    check_counts(path, records=len(found), vertices=0)
    for zone in found:
        made = _zone(zone, path)
        if made.code in zones:
            raise _duplicate(path, f"treatment zone {made.code} is there twice in task {own[:40]}")
        zones[made.code] = made
    grids = children(element, "GRD")
    if len(grids) > 1:
        raise map_error(
            path,
            f"task {own[:40]} has {len(grids)} grids, where one is allowed",
            fix="export the task with one grid",
            code="several-layers",
        )
    if grids and any(zone.polygons for zone in zones.values()):
        raise map_error(
            path,
            f"task {own[:40]} has both a grid and polygons, which could contradict each other",
            fix="export the task as a grid, or as polygons",
            code="grid-and-zones",
        )
    default, lost, out = (_special(element, key, zones, path) for key in "HIJ")
    return Task(
        id=own,
        name=text(element, "B"),
        zones=zones,
        grid=grids[0] if grids else None,
        field=text(element, "E"),
        default_code=default,
        position_lost_code=lost,
        out_of_field_code=out,
    )


def _zone(element: Element, path: Path) -> TreatmentZone:
    return TreatmentZone(
        code=integer(element, "A", path, low=0, high=_CODE_MAX),
        name=text(element, "B"),
        variables=tuple(_variable(one, path) for one in children(element, "PDV")),
        polygons=tuple(children(element, "PLN")),
    )


def _variable(element: Element, path: Path) -> Variable:
    ddi = ddi_of(required(element, "A", path))
    if ddi is None:
        raise map_error(
            path,
            f"PDV has A={element.get('A', '')[:40]!r} where a DDI of four hexadecimal digits "
            "belongs",
            fix=EXPORT_AGAIN,
            code="bad-attribute",
        )
    return Variable(
        ddi=ddi,
        raw=integer(element, "B", path, low=-_RAW_MAX - 1, high=_RAW_MAX, code="bad-rate"),
        product=text(element, "C"),
        device=text(element, "D"),
        presentation=text(element, "E"),
    )


def _special(element: Element, key: str, zones: dict[int, TreatmentZone], path: Path) -> int | None:
    """Return the code that a task names for a special case, which has to be one of its zones."""
    if text(element, key) is None:
        return None
    code = integer(element, key, path, low=0, high=_CODE_MAX)
    if code not in zones:
        case = {"H": "default", "I": "position lost", "J": "out of field"}[key]
        raise map_error(
            path,
            f"its task names treatment zone {code} for {case}, and there is no such zone",
            fix=EXPORT_AGAIN,
            code="undefined-code",
        )
    return code


def _check_grid(chosen: Element, tasks: Sequence[Element], path: Path) -> None:
    """Refuse a file of cells that another task reads as another grid: it cannot be both."""
    own = {_grid_shape(grid) for grid in children(chosen, "GRD")}
    every = {_grid_shape(grid) for task in tasks for grid in children(task, "GRD")}
    for name, shape in own:
        if any(other == name and other_shape != shape for other, other_shape in every):
            raise _duplicate(path, f"{name[:40]} is the file of several different grids")


def _grid_shape(grid: Element) -> tuple[str, tuple[str | None, ...]]:
    return text(grid, "G") or "", tuple(text(grid, key) for key in "ABCDEFI")


def _duplicate(path: Path, said: str) -> Exception:
    return map_error(path, said, fix=EXPORT_AGAIN, code="duplicate-code")


# What the tasks of a file prescribe, product by product: for messages that offer a choice.

# A message names so many tasks, and of each so many products.
_TASKS_MAX, _PRODUCTS_MAX = 12, 4


@dataclass(frozen=True, slots=True, kw_only=True)
class Content:
    """One product of a task and the unit of its rate."""

    product: str
    unit: str

    @property
    def is_volume(self) -> bool:
        """Whether this is a volume per area, as a sprayer applies it."""
        found = rate_unit(self.unit)
        return found is not None and found.kind == "volume"


@dataclass(frozen=True, slots=True, kw_only=True)
class TaskContents:
    """A task by its id and its designator, and what it prescribes."""

    id: str
    name: str | None
    contents: tuple[Content, ...]

    @property
    def sprayable(self) -> tuple[Content, ...]:
        """Return the products whose rates are a volume per area."""
        return tuple(one for one in self.contents if one.is_volume)

    def __str__(self) -> str:
        called = f"{self.id[:40]} ({self.name[:60]})" if self.name else self.id[:40]
        return f"{called}: {_listed(self.contents)}" if self.contents else called


def contents_of(task: Element, products: Mapping[str, str]) -> TaskContents:
    """Return what a task prescribes; what is broken in it is left out here, and told on reading."""
    zones = children(task, "TZN")
    grids = children(task, "GRD")
    if grids and text(grids[0], "I") == "2":
        zones = [zone for zone in zones if text(zone, "A") == text(grids[0], "J")]
    elif not grids:
        zones = [zone for zone in zones if children(zone, "PLN")]
    found: dict[Content, None] = {}
    for zone in zones:
        for value in children(zone, "PDV"):
            ddi = ddi_of(text(value, "A") or "")
            known = None if ddi is None else meaning(ddi)
            if known is None or known[1] not in ("setpoint", "default"):
                continue
            own = text(value, "C")
            product = products.get(own, own) if own else "rate"
            found[Content(product=" ".join(product.split())[:40], unit=known[0].unit)] = None
    return TaskContents(
        id=text(task, "A") or "a task without an id", name=text(task, "B"), contents=tuple(found)
    )


def task_list(tasks: Sequence[TaskContents]) -> str:
    """Return the tasks with product and unit, as many as a message bears."""
    left = len(tasks) - _TASKS_MAX
    more = f", and {left} more" if left > 0 else ""
    return ", ".join(map(str, tasks[:_TASKS_MAX])) + more


def instead_of(chosen: str, tasks: Sequence[TaskContents]) -> str:
    """Return what to choose where a product of the chosen task is not a volume per area."""
    own = [one for task in tasks if task.id == chosen for one in task.sprayable]
    if own:
        return f"take with --rate-field (prescription.rate_field): {_listed(own)}"
    others = [task for task in tasks if task.sprayable]
    if others:
        return f"choose with --layer a task that can be sprayed: {task_list(others)}"
    return "no task of the file has a volume per area: make the map in L/ha"


def _listed(contents: Sequence[Content]) -> str:
    left = len(contents) - _PRODUCTS_MAX
    more = f" and {left} more" if left > 0 else ""
    return " and ".join(f"{one.product} in {one.unit}" for one in contents[:_PRODUCTS_MAX]) + more
