"""What the tasks of a file prescribe, product by product: for messages that offer a choice."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from xml.etree.ElementTree import Element

from missions.maps.isoxml.ddi import ddi_of, meaning
from missions.maps.isoxml.values import children, text
from missions.maps.units import rate_unit

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
    """Return what to choose where a product of the chosen task is no volume per area."""
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
