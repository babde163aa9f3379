"""From the process data variables of treatment zones to one column of rates for each product."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element

from missions.maps.isoxml.task import ById, Task, TreatmentZone, Variable
from missions.maps.isoxml.values import (
    EXPORT_AGAIN,
    Family,
    Presentation,
    check_presentation,
    children,
    ddi_meaning,
    ddi_name,
    meaning,
    presentation_of,
    text,
)
from missions.maps.model import Problem, map_error


class Key(NamedTuple):
    """What tells one column of rates from another."""

    ddi: int  # of the family's setpoint
    product: str | None
    device: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Rates:
    """One product of a task: its name, its unit, and its variable in each zone that has one."""

    key: Key
    name: str
    family: Family
    by_code: dict[int, Variable]

    def amount(self, code: int | None) -> float | None:
        """Return what a zone prescribes, in the family's unit, or None where it does not."""
        variable = None if code is None else self.by_code.get(code)
        return None if variable is None else variable.raw / self.family.raw_per_unit


def rates_of(task: Task, references: References) -> tuple[list[Rates], list[Problem]]:
    """Return the columns of a task, one for each product, and what was left aside."""
    path = references.path
    variables = [one for zone in task.zones.values() for one in zone.variables]
    usable, problems = _usable(variables)
    if not usable:
        found = ", ".join(map(ddi_meaning, sorted({one.ddi for one in variables}))) or "none"
        raise map_error(
            path,
            f"task {task.id[:40]} has no setpoint that a sprayer could use (values: {found})",
            fix=references.instead,
            code="not-a-volume" if variables else "no-rate-column",
        )
    missing = references.missing(usable)
    if missing:
        problems.append(
            Problem(
                severity="warning",
                code="undefined-code",
                text=f"its values refer to {', '.join(missing[:5])}, which the file does not have",
                where=task.id,
                fix=EXPORT_AGAIN,
            )
        )
    taken = set(usable)
    key_of = _keys(task.zones.values(), taken, path)
    families: dict[Key, Family] = {}
    by_key: dict[Key, dict[int, Variable]] = {}
    for zone in task.zones.values():
        for one in zone.variables:
            known = meaning(one.ddi)
            if one in taken and known is not None:
                key = key_of(one)
                families[key] = known[0]
                by_key.setdefault(key, {})[zone.code] = one
    names = _names(list(by_key), references)
    rates = [
        Rates(key=key, name=name, family=families[key], by_code=by_code)
        for name, (key, by_code) in zip(names, by_key.items(), strict=True)
    ]
    return rates, problems


def key_among(rates: Sequence[Rates], code: int, variable: Variable) -> Rates | None:
    """Return the column to which a variable of a zone belongs, or None for one left aside."""
    return next((one for one in rates if one.by_code.get(code) is variable), None)


def check_shown(
    one: Rates, raws_by_presentation: Mapping[str | None, tuple[int, ...]], references: References
) -> list[Problem]:
    """Refuse a presentation that tells other amounts; return what could not be compared."""
    problems = []
    for own, raws in raws_by_presentation.items():
        presentation = references.presentation(own)
        if presentation is None or not raws:
            continue
        if not check_presentation(presentation, one.family, raws, references.path):
            problems.append(
                Problem(
                    severity="warning",
                    code="presentation-unit",
                    text=f"{presentation.id} shows {one.name} in {presentation.unit[:20]!r}, "
                    f"which cannot be compared with {one.family.unit}; the value by "
                    f"{ddi_name(one.key.ddi)} is taken",
                    where=one.name,
                    fix="compare a rate with the program that made the map",
                )
            )
    return problems


def shown_in_zones(one: Rates) -> dict[str | None, tuple[int, ...]]:
    """Return the raw values of all zones by the presentation that shows them."""
    found: dict[str | None, set[int]] = {}
    for variable in one.by_code.values():
        found.setdefault(variable.presentation, set()).add(variable.raw)
    return {own: tuple(sorted(raws)) for own, raws in found.items()}


def special_problems(task: Task, rates: Sequence[Rates]) -> list[Problem]:
    """Return a warning for each rate prescribed where the nozzles are closed all the same."""
    problems = []
    for code, name, said in (
        (task.position_lost_code, "position-lost-rate", "when the position is lost"),
        (task.out_of_field_code, "out-of-field-rate", "outside the field"),
    ):
        for one in rates:
            amount = one.amount(code)
            if amount is not None and amount > 0.0:
                problems.append(
                    Problem(
                        severity="warning",
                        code=name,
                        text=f"the task prescribes {amount:.6g} {one.family.unit} of {one.name} "
                        f"{said}; the nozzles are closed there",
                        where=f"treatment zone {code}",
                        fix=f"set treatment zone {code} to 0",
                    )
                )
    return problems


def _usable(variables: Sequence[Variable]) -> tuple[list[Variable], list[Problem]]:
    """Return the setpoints, and the defaults of quantities that have no setpoint."""
    families = {
        known[0].ddis[0]
        for known in (meaning(one.ddi) for one in variables)
        if known is not None and known[1] == "setpoint"
    }
    usable, aside = [], Counter[int]()
    for one in variables:
        known = meaning(one.ddi)
        if known is not None and (
            known[1] == "setpoint" or (known[1] == "default" and known[0].ddis[0] not in families)
        ):
            usable.append(one)
        else:
            aside[one.ddi] += 1
    if not aside:
        return usable, []
    found = ", ".join(f"{ddi_name(ddi)} ({count})" for ddi, count in sorted(aside.items())[:8])
    problem = Problem(
        severity="warning",
        code="value-ignored",
        text=f"values that prescribe no rate are left aside: {found}",
        where="treatment zones",
        fix="nothing, if the rates are right",
    )
    return usable, [problem]


def _keys(
    zones: Iterable[TreatmentZone], usable: set[Variable], path: Path
) -> Callable[[Variable], Key]:
    """Return how to tell columns apart: by product, and by device only where that is needed.

    Programs leave the product out in the zones for default and out of field; where a quantity has
    but one product, a value without one is of it.
    """
    products: dict[int, set[str]] = {}
    for one in usable:
        if one.product:
            products.setdefault(_setpoint(one), set()).add(one.product)

    def only_product(one: Variable) -> str | None:
        of_all = products.get(_setpoint(one), set())
        return one.product or (next(iter(of_all)) if len(of_all) == 1 else None)

    ways: tuple[Callable[[Variable], Key], ...] = (
        lambda one: Key(_setpoint(one), only_product(one), None),
        lambda one: Key(_setpoint(one), one.product, None),
        lambda one: Key(_setpoint(one), one.product, one.device),
    )
    in_zones = [[one for one in zone.variables if one in usable] for zone in zones]
    for way in ways:
        if all(len(set(map(way, ones))) == len(ones) for ones in in_zones):
            return way
    raise map_error(
        path,
        "a treatment zone prescribes the same product twice",
        fix=EXPORT_AGAIN,
        code="duplicate-code",
    )


def _setpoint(one: Variable) -> int:
    known = meaning(one.ddi)
    return one.ddi if known is None else known[0].ddis[0]


def _names(keys: Sequence[Key], references: References) -> list[str]:
    """Return a name for each column that no other has."""
    plain = [references.product(key.product) if key.product else ddi_name(key.ddi) for key in keys]
    longer = [
        " ".join(filter(None, (name, key.product and ddi_name(key.ddi), key.device)))
        for name, key in zip(plain, keys, strict=True)
    ]
    for names in (plain, longer):
        if len({name.casefold() for name in names}) == len(names):
            return names
    return [f"{name} {number}" for number, name in enumerate(longer, 1)]


# Products (PDT) and value presentations (VPN) of an ISOXML file, to which its values refer.


class References:
    """The products and presentations to which variables refer; only what is in use is checked."""

    def __init__(self, root: Element, path: Path, instead: str) -> None:
        """Index both; `instead` says what to choose where a task cannot be sprayed."""
        self.path, self.instead = path, instead
        self._products = ById(root, "PDT", path)
        self._presentations = ById(root, "VPN", path)

    def product(self, own: str) -> str:
        """Return a product's name, or its id where it has none."""
        element = self._products.get(own)
        name = None if element is None else text(element, "B")
        return " ".join((name or own).split())[:60]

    def presentation(self, own: str | None) -> Presentation | None:
        """Return a presentation, or None where there is none of that id."""
        element = None if own is None else self._presentations.get(own)
        return None if own is None or element is None else presentation_of(element, own, self.path)

    def missing(self, variables: Iterable[Variable]) -> list[str]:
        """Return the ids to which variables refer and which are nowhere."""
        products = {one.product for one in variables if one.product}
        shown = {one.presentation for one in variables if one.presentation}
        return sorted(
            {own for own in products if self._products.get(own) is None}
            | {own for own in shown if self._presentations.get(own) is None}
        )


def product_names(root: Element) -> dict[str, str]:
    """Return the products' names as they stand in the file, for a list of what there is."""
    return {
        own: text(element, "B") or own
        for element in reversed(children(root, "PDT"))
        if (own := text(element, "A")) is not None
    }
