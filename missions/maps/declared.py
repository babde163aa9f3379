"""Which unit a file declares for its rates, in whichever of the usual places."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from companion.errors import ConfigError
from missions.maps.fields import words
from missions.maps.model import Band, Column, Grid, Layer, Problem, map_error
from missions.maps.units import (
    RateUnit,
    is_mass_per_area,
    l_ha_per_unit,
    other_quantity,
    quantity_in_name,
    quantity_of_word,
    rate_unit,
    unit_in_name,
)

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


@dataclass(frozen=True, slots=True, kw_only=True)
class Given:
    """What the operator states about the rates of a map."""

    unit: str | None = None
    density_kg_l: float | None = None
    flow_width_m: float | None = None
    flow_speed_m_s: float | None = None

    def __post_init__(self) -> None:
        for name in ("density_kg_l", "flow_width_m", "flow_speed_m_s"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < 1e6:
                raise ConfigError(f"{name} is {value}; give a number above 0")


@dataclass(frozen=True, slots=True, kw_only=True)
class Unit:
    """The unit of a map's rates, and how many L/ha one of it is."""

    name: str
    l_ha: float
    problems: tuple[Problem, ...] = ()


def unit_of(layer: Layer | Grid, rate: Column | Band, *, given: Given, path: Path) -> Unit:
    """Return the unit of the rates, or refuse: never a guess.

    What the operator says holds where the file says nothing that can be read. Where both speak
    and differ, one of them is wrong, and which is not for a program to decide.
    """
    wanted = None if given.unit is None else _wanted(given.unit, path)
    declared = _declared(layer, rate)
    known = {found.name: found for found in map(rate_unit, declared) if found is not None}
    _refuse_other_quantity(layer, rate, declared, wanted=wanted, known=bool(known), path=path)
    unknown = [text for text in declared if rate_unit(text) is None]
    if unknown and (wanted is None or any(map(is_mass_per_area, unknown))):
        raise map_error(
            path,
            f"its unit {unknown[0][:40]!r} is no volume per area",
            fix=_FIX,
            code="not-a-volume",
        )
    if len(known) > 1:
        names = ", ".join(sorted(known))
        raise map_error(
            path, f"it declares several units: {names}", fix="convert it to one",
            code="unit-conflict",
        )  # fmt: skip
    said = next(iter(known.values()), None)
    if wanted is not None and said is not None and wanted.name != said.name:
        raise map_error(
            path,
            f"its unit is {said.name}, but {wanted.name} is asked for",
            fix="leave out --unit (prescription.unit), or correct the file"
            + (f"; or {layer.instead}" if layer.instead and said.kind != "volume" else ""),
            code="unit-conflict",
        )
    found = wanted or said
    if found is None:
        raise map_error(
            path, f"no unit is given for the rates in {rate.name}", fix=_FIX, code="no-unit"
        )
    problems = tuple(_overridden(unknown, found.name, rate))
    return _in_litres(found, given, path, problems, layer.instead)


def _refuse_other_quantity(
    layer: Layer | Grid,
    rate: Column | Band,
    declared: Sequence[str],
    *,
    wanted: RateUnit | None,
    known: bool,
    path: Path,
) -> None:
    """Refuse rates of which the file says that they are seeds, centimetres, percent, nutrients.

    Whatever the operator states: those numbers are no litres. Only a weight without its area may
    be of an area that the operator knows.
    """
    found = [(text, other_quantity(text)) for text in declared]
    named = None if rate.unit is not None else quantity_in_name(rate.name)
    if named is not None:
        found.append(named)
    elif not known:
        found.append((rate.name, quantity_of_word(words(rate.name))))
    for text, quantity in found:
        if quantity is None or (
            quantity == "a weight" and wanted is not None and wanted.kind == "mass"
        ):
            continue
        raise map_error(
            path,
            f"{rate.name} is in {text[:40]!r}: {quantity}, and no volume per area"
            if text != rate.name
            else f"{rate.name} is {quantity} by its name, and no volume per area",
            fix=layer.instead
            or "name a column with a volume per area with --rate-field (prescription.rate_field), "
            "or make the map in L/ha",
            code="not-a-volume",
        )


def _in_litres(
    found: RateUnit, given: Given, path: Path, problems: tuple[Problem, ...], instead: str
) -> Unit:
    """Return the unit with its L/ha; a weight needs a density, a flow a width and a speed."""
    l_ha = l_ha_per_unit(
        found.name,
        density_kg_l=given.density_kg_l,
        flow_width_m=given.flow_width_m,
        flow_speed_m_s=given.flow_speed_m_s,
    )
    if l_ha is None and found.kind == "mass":
        raise map_error(
            path,
            f"its unit {found.name!r} is a weight, and no volume per area",
            fix="give the density of what is sprayed with --density-kg-l "
            f"(prescription.density_kg_l), or {instead or 'make the map in L/ha'}",
            code="not-a-volume",
        )
    if l_ha is None:
        raise map_error(
            path,
            f"its unit {found.name!r} is a flow, and no volume per area",
            fix="give the width and the speed that the map was made for with --flow-width-m and "
            "--flow-speed-m-s (prescription.flow_width_m, flow_speed_m_s)",
            code="not-a-volume",
        )
    if found.kind != "volume":
        basis = (
            f"a density of {given.density_kg_l:g} kg/L"
            if found.kind == "mass"
            else f"{given.flow_width_m:g} m of width at {given.flow_speed_m_s:g} m/s"
        )
        problem = Problem(
            severity="warning",
            code="converted-unit",
            text=f"the rates are in {found.name}; with {basis}, 1 {found.name} is {l_ha:.6g} L/ha",
            where=str(path),
            fix="check the figure, or make the map in L/ha",
        )
        problems = (*problems, problem)
    return Unit(name=found.name, l_ha=l_ha, problems=problems)


def _wanted(asked: str, path: Path) -> RateUnit:
    found = rate_unit(asked)
    if found is None:
        raise map_error(
            path,
            f"the unit {asked!r} is no volume per area",
            fix=_FIX,
            code="not-a-volume",
        )
    return found


def _overridden(unknown: Sequence[str], wanted: str, rate: Column | Band) -> list[Problem]:
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


def _declared(layer: Layer | Grid, rate: Column | Band) -> list[str]:
    """Return every unit that the file states for its rates; that of the column itself first."""
    if rate.unit is not None and rate.unit.strip().casefold() not in _BLANK:
        return [rate.unit.strip()]
    every = layer.columns if isinstance(layer, Layer) else ()
    columns = [column for column in every if _is_unit_column(column, rate)]
    own = [column for column in columns if set(words(column.name)) & set(words(rate.name))]
    stated = [value for column in own or columns for value in column.values]
    texts = dict.fromkeys(
        str(text).strip()
        for text in (layer.unit, unit_in_name(rate.name), *stated)
        if text is not None
    )
    return [text for text in texts if text.casefold() not in _BLANK]


def _is_unit_column(column: Column, rate: Column | Band) -> bool:
    """Tell whether a column holds the unit of the rate, and not of something else."""
    parts = words(column.name)
    others = set(parts) - _UNIT_WORDS
    meant = _RATE_WORDS | set(words(rate.name))
    return len(others) < len(parts) and not column.numeric and others <= meant
