"""Attributes of formats that hold their numbers as text, or say a column's unit in its title."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from missions.maps.layer import Column, Value
from missions.maps.model import map_error
from missions.maps.units import is_mass_per_area, quantity_in_name, unit_in_name, unit_name

_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,3})?", re.ASCII)


def column_of(
    name: str, values: Sequence[Value], *, declared: bool = False, unit: str | None = None
) -> Column:
    """Return a column, numeric where the file declares it so or all that it holds are numbers.

    >>> column_of("rate", ("12.5", None, " 0 ")).numeric, column_of("rate", ("12,5",)).numeric
    (True, False)
    """
    numeric = declared or _all_numbers(values)
    return Column(name=name, values=tuple(values), numeric=numeric, unit=unit)


def _all_numbers(values: Iterable[Value]) -> bool:
    """Tell whether there is something, and nothing but plain decimal numbers and blanks."""
    some = False
    for value in values:
        if value is None or (isinstance(value, str) and not value.strip()):
            continue
        if isinstance(value, str) and _NUMBER.fullmatch(value.strip()) is None:
            return False
        some = True
    return some


def stated_unit(texts: Iterable[str], *, column: str, path: Path) -> str | None:
    """Return the unit that a column's titles and descriptions state, each as a whole or at its end.

    >>> stated_unit(["Dose (L/ha)", "l/ha"], column="dose", path=Path("rx.gpkg"))
    'L/ha'
    >>> stated_unit(["dose by the soil map"], column="dose", path=Path("rx.gpkg")) is None
    True
    """
    texts = [text.strip()[:200] for text in texts]
    units = {unit for text in texts if (unit := _unit(text)) is not None}
    if not units:
        # A quantity that is none of ours, so that nobody takes its numbers for litres.
        units = {found[0] for text in texts if (found := quantity_in_name(text)) is not None}
    if len(units) > 1:
        raise map_error(
            path,
            f"the titles of the column {column} state several units: {', '.join(sorted(units))}",
            fix="correct the titles",
            code="unit-conflict",
        )
    return next(iter(units), None)


def _unit(text: str) -> str | None:
    if is_mass_per_area(text):
        return text
    return unit_name(text) or unit_in_name(text)
