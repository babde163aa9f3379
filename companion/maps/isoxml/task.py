"""Tasks of an ISOXML file: which one prescribes, and its treatment zones as they stand there."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

from companion.maps.isoxml.values import (
    EXPORT_AGAIN,
    children,
    integer,
    required,
    tag,
    text,
)
from companion.maps.layer import check_counts
from companion.maps.model import map_error

# The standard ends at 254; some programs number their polygons beyond.
_CODE_MAX = 65_535
_RAW_MAX = 2**31 - 1
_DDI = re.compile(r"(?:0[xX])?([0-9A-Fa-f]{1,4})")


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


def by_id(root: Element, name: str, path: Path) -> dict[str, Element]:
    """Return all elements of one kind by their ids, each of which may be given once."""
    found: dict[str, Element] = {}
    for element in children(root, name):
        own = required(element, "A", path)
        if own in found:
            raise _duplicate(path, f"{own[:40]} is the id of several {name}")
        found[own] = element
    return found


def chosen_task(root: Element, path: Path, layer: str | None) -> Task:
    """Return the one task that prescribes, or the one that `layer` names by id or designator."""
    tasks = by_id(root, "TSK", path)
    _check_grids(tasks.values(), path)
    prescribing = {own: task for own, task in tasks.items() if _prescribes(task)}
    if not prescribing:
        raise map_error(
            path,
            f"none of its {len(tasks)} tasks has treatment zones with values or a grid",
            fix="export the task with its application map",
            code="no-rate-column",
        )
    names = ", ".join(_called(own, task) for own, task in list(prescribing.items())[:20])
    if layer is None:
        found = list(prescribing)
    else:
        wanted = layer.strip()
        found = [own for own in prescribing if own == wanted] or [
            own
            for own, task in prescribing.items()
            if (text(task, "B") or "").casefold() == wanted.casefold()
        ]
        if not found:
            raise map_error(
                path,
                f"there is no task {layer[:40]!r} with a prescription",
                fix=f"choose with --layer one of {names}",
                code="no-layer",
            )
    if len(found) > 1:
        raise map_error(
            path,
            f"several tasks have a prescription: {names}",
            fix=f"choose one with --layer, for example --layer {found[0]}",
            code="several-layers",
        )
    return _task(prescribing[found[0]], path)


def _prescribes(task: Element) -> bool:
    """Tell whether a task says a rate anywhere; one that only names its defaults does not."""
    return any(
        tag(child) == "GRD"
        or (tag(child) == "TZN" and children(child, "PDV") and children(child, "PLN"))
        for child in task
    )


def _called(own: str, task: Element) -> str:
    name = text(task, "B")
    return f"{own} ({name[:60]})" if name else own


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
    ddi = _DDI.fullmatch(required(element, "A", path))
    if ddi is None:
        raise map_error(
            path,
            f"PDV has A={element.get('A', '')[:40]!r} where a DDI of four hexadecimal digits "
            "belongs",
            fix=EXPORT_AGAIN,
            code="bad-attribute",
        )
    return Variable(
        ddi=int(ddi[1], 16),
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


def _check_grids(tasks: Iterable[Element], path: Path) -> None:
    """Refuse one file for two different grids: it cannot be both."""
    shapes = {
        (text(grid, "G") or "", tuple(text(grid, key) for key in "ABCDEFI"))
        for task in tasks
        for grid in children(task, "GRD")
    }
    names = Counter(name for name, _ in shapes)
    twice = next((name for name, count in names.items() if count > 1), None)
    if twice is not None:
        raise _duplicate(path, f"{twice[:40]} is the file of several different grids")


def _duplicate(path: Path, said: str) -> Exception:
    return map_error(path, said, fix=EXPORT_AGAIN, code="duplicate-code")
