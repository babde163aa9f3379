"""Which unit a file declares for its rates, in whichever of the usual places."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from companion.maps.fields import words
from companion.maps.layer import Column, Layer
from companion.maps.model import Problem, map_error
from companion.maps.units import is_mass_per_area, unit_in_name, unit_name

_UNIT_WORDS = frozenset(
    {
        "unit", "units", "uom", "einheit", "unite", "unites", "unidad", "unita", "单位",
    }
)  # fmt: skip
# `area_unit` is of the area; these words before `unit` mean the rate.
_RATE_WORDS = frozenset(
    {
        "rate", "dose", "dosis", "app", "application", "target", "tgt", "rx", "value",
        "amount",
    }
)  # fmt: skip
_BLANK = frozenset(("", "-", "n/a", "na", "none", "null", "unknown"))
_FIX = "give the unit with --unit (prescription.unit): L/ha, gal/ac, mL/m2 or L/mu"


def unit_of(
    layer: Layer, rate: Column, *, asked: str | None, path: Path
) -> tuple[str, list[Problem]]:
    """Return the unit of the rates, or refuse: never a guess.

    What the operator says holds where the file says nothing that can be read. Where both speak
    and differ, one of them is wrong, and which is not for a program to decide.
    """
    wanted = None if asked is None else _wanted(asked, path)
    declared = _declared(layer, rate)
    known = {unit_name(text) for text in declared} - {None}
    unknown = [text for text in declared if unit_name(text) is None]
    mass = next((text for text in unknown if is_mass_per_area(text)), None)
    if mass is not None or (unknown and wanted is None):
        said = (mass or unknown[0])[:40]
        raise map_error(path, f"its unit {said!r} is no volume per area", fix=_FIX)
    if len(known) > 1:
        names = ", ".join(sorted(str(name) for name in known))
        raise map_error(path, f"it declares several units: {names}", fix="convert it to one")
    said_unit = next(iter(known), None)
    if wanted is None and said_unit is None:
        raise map_error(path, f"no unit is given for the rates in {rate.name}", fix=_FIX)
    if wanted is not None and said_unit is not None and wanted != said_unit:
        raise map_error(
            path,
            f"its unit is {said_unit}, but {wanted} is asked for",
            fix="leave out --unit (prescription.unit), or correct the file",
        )
    return str(wanted or said_unit), _overridden(unknown, wanted, rate)


def _wanted(asked: str, path: Path) -> str:
    name = unit_name(asked)
    if name is None:
        raise map_error(path, f"the unit {asked!r} is no volume per area", fix=_FIX)
    return name


def _overridden(unknown: Sequence[str], wanted: str | None, rate: Column) -> list[Problem]:
    if not unknown:
        return []
    return [
        Problem(
            severity="warning",
            code="unit-overridden",
            text=f"the file's unit {unknown[0][:40]!r} is not understood; {wanted} holds, as asked",
            where=rate.name,
            fix="make sure that it means the same",
        )
    ]


def _declared(layer: Layer, rate: Column) -> list[str]:
    """Return every unit that the file states for its rates."""
    columns = [column for column in layer.columns if _is_unit_column(column, rate)]
    own = [column for column in columns if set(words(column.name)) & set(words(rate.name))]
    stated = [value for column in own or columns for value in column.values]
    texts = dict.fromkeys(
        str(text).strip()
        for text in (layer.unit, unit_in_name(rate.name), *stated)
        if text is not None
    )
    return [text for text in texts if text.casefold() not in _BLANK]


def _is_unit_column(column: Column, rate: Column) -> bool:
    """Tell whether a column holds the unit of the rate, and not of something else."""
    parts = words(column.name)
    others = set(parts) - _UNIT_WORDS
    meant = _RATE_WORDS | set(words(rate.name))
    return len(others) < len(parts) and not column.numeric and others <= meant
