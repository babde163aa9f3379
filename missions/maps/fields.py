"""Which column is the rate, and in which unit: one clear candidate, or the operator says.

A wrong column is a wrong dose on the whole field, so nothing is guessed: a column becomes a
candidate by its name alone, and two candidates that say different things are refused.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from companion.errors import ConfigError
from missions.maps.model import Band, Column, Grid, Layer, Problem, Value, as_number, map_error
from missions.maps.units import (
    RateUnit,
    is_mass_per_area,
    l_ha_per_unit,
    other_quantity,
    quantity_in_name,
    quantity_of_word,
    rate_unit,
    unit_in_name,
    unit_name,
)

# What rate columns are called; DBF cuts names at ten characters (`TargetRate`, `Tgt_Rate_l`).
# Seen in maps: rate, rateInt, dose, DOSE, value, Tgt_Rate; the others are the words of farm
# software in English, French, Spanish, Italian, Portuguese, German and Chinese.
_WORDS = frozenset(
    {
        "rate", "rates", "apprate", "targetrate", "targetrat", "tgtrate", "rxrate", "ratelha",
        "dose", "doses", "dosis", "dosage", "dosaggio", "dosi", "appdose", "rx",
        "prescription", "prescrip", "setpoint", "aufwandmenge", "aufwand", "sollwert",
        "sollmenge", "lha", "施药量", "用量", "亩用量", "剂量", "喷量",
    }
)  # fmt: skip
_WEAK_WORDS = frozenset(
    {
        "value", "values", "val", "amount", "quantity", "menge", "target", "application",
        "volume", "wert", "valor", "valeur", "quantite", "cantidad", "quantita", "quantidade",
    }
)  # fmt: skip
# Numbers that stand beside a rate and are none.
_DECOYS = frozenset(
    {
        "area", "areas", "ha", "acres", "id", "fid", "oid", "gid", "objectid", "zone", "zones",
        "zoneid", "level", "class", "classid", "cluster", "rank", "perimeter", "length", "len",
        "width", "lon", "lat", "longitude", "latitude", "x", "y", "z", "elevation", "altitude",
        "height", "count", "total", "sum", "percent", "pct", "ndvi", "ndre", "yield", "speed",
        "time", "date", "year", "price", "cost", "color", "colour", "unit", "min", "max",
        "mean", "avg", "std", "stdev", "shape",
    }
)  # fmt: skip
STRONG, NAMED, WEAK, NONE = 3, 2, 1, 0


Source = TypeVar("Source", Column, Band)


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice(Generic[Source]):
    """The rate column or band, and what there is to say about the choice."""

    column: Source
    problems: tuple[Problem, ...] = ()


def words(name: str) -> list[str]:
    """Return the words of a column's name, in lower case.

    >>> words("Tgt_Rate"), words("rateInt"), words("DOSE_UNIT"), words("area_total")
    (['tgt', 'rate'], ['rate', 'int'], ['dose', 'unit'], ['area', 'total'])
    """
    split = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name)
    return [word for word in re.split(r"[\W_\d]+", split.casefold()) if word]


def score(column: Column | Band) -> int:
    """Return how clearly a column's name says that it holds the rate.

    >>> [score(Column(name=name, values=(), numeric=True)) for name in ("rate", "rateInt", "value")]
    [3, 2, 1]
    >>> [score(Column(name=name, values=(), numeric=True)) for name in ("area", "zone", "rate_id")]
    [0, 0, 0]
    """
    parts = words(column.name)
    if isinstance(column, Column) and not column.numeric:
        return NONE
    if "".join(parts) in _WORDS or unit_in_name(column.name) is not None:
        return STRONG
    if any(part in _DECOYS for part in parts):
        return NONE
    if any(part in _WORDS for part in parts):
        return NAMED
    return WEAK if any(part in _WEAK_WORDS for part in parts) else NONE


def choose(columns: Sequence[Source], *, asked: str | None, path: Path) -> Choice[Source]:
    """Return the rate column: the one asked for, or the only one that it can be.

    A format that marks its rates has one for each product; one product is flown at a time.
    """
    if asked is not None:
        return Choice(column=_asked(columns, asked, path))
    marked = [column for column in columns if column.is_rate]
    if len(marked) > 1:
        raise map_error(
            path,
            f"the map holds {len(marked)} products: {', '.join(one.name for one in marked)}",
            fix="name the one to spray with --rate-field (prescription.rate_field)",
            code="several-products",
        )
    if marked:
        return Choice(column=marked[0])
    columns = [_with_numbers(column) for column in columns]
    usable = [column for column in columns if score(column) and _holds_numbers(column)]
    blank = [column for column in columns if score(column) >= NAMED and column not in usable]
    if not usable and len(blank) == 1:
        raise map_error(
            path,
            f"{blank[0].name} is blank in every record",
            fix="give the zones a rate, 0 for none, or name another column with --rate-field "
            "(prescription.rate_field)",
            code="null-rate",
        )
    strong = [column for column in usable if score(column) >= NAMED]
    candidates = sorted(strong or usable, key=score, reverse=True)
    if not candidates and len(columns) == 1 and isinstance(columns[0], Band):
        candidates = list(columns)  # a raster of one band is a map of that
    if not candidates:
        several_bands = len(columns) > 1 and isinstance(columns[0], Band)
        raise map_error(
            path,
            f"no band looks like a rate; there are {_names(columns)}"
            if several_bands
            else f"no column looks like a rate; its numeric columns are {_names(columns)}",
            fix="name it with --rate-field (prescription.rate_field)"
            if several_bands
            else "name the column with --rate-field (prescription.rate_field)",
            code="several-products" if several_bands else "no-rate-column",
        )
    if len(candidates) == 1:
        return Choice(column=candidates[0])
    return _among(candidates, path)


def _with_numbers(column: Source) -> Source:
    """Return a column of texts that are plain numbers as numeric: some programs write it so."""
    if isinstance(column, Band) or column.numeric:
        return column
    try:
        numbers = [as_number(value) for value in column.values]
    except ValueError:
        return column
    return column if all(one is None for one in numbers) else replace(column, numeric=True)


def _asked(columns: Sequence[Source], asked: str, path: Path) -> Source:
    exact = [column for column in columns if column.name == asked]
    alike = [column for column in columns if column.name.casefold() == asked.casefold()]
    found = exact or alike
    if len(found) != 1:
        raise map_error(
            path,
            f"there is no column {asked!r}"
            if not found
            else f"the column {asked!r} is there {len(found)} times",
            fix=f"take one of {', '.join(column.name for column in columns) or 'none'}"
            " for --rate-field (prescription.rate_field)",
            code="no-rate-column",
        )
    return found[0]


def _holds_numbers(column: Column | Band) -> bool:
    if isinstance(column, Band):
        return not bool(np.isnan(column.values).all())
    return any(value is not None for value in column.values)


def _names(columns: Sequence[Column] | Sequence[Band]) -> str:
    numeric = [one for one in columns if isinstance(one, Band) or one.numeric]
    return ", ".join(column.name for column in numeric) or "none"


def _among(candidates: Sequence[Source], path: Path) -> Choice[Source]:
    """Return the one whose values the other candidates repeat, if there is such a one."""
    best = next((one for one in candidates if _repeated_by(one, candidates)), None)
    if best is None:
        names = ", ".join(column.name for column in candidates)
        raise map_error(
            path,
            f"several columns can be the rate and differ: {names}",
            fix="name one with --rate-field (prescription.rate_field)",
            code="several-columns",
        )
    others = ", ".join(column.name for column in candidates if column is not best)
    problem = Problem(
        severity="warning",
        code="several-candidates",
        text=f"the rate is taken from {best.name}; {others} could be it too, but says the same "
        "(equal, or rounded to whole numbers) in every record",
        where=best.name,
        fix="name the column with --rate-field (prescription.rate_field)",
    )
    return Choice(column=best, problems=(problem,))


def _repeated_by(best: Source, candidates: Sequence[Source]) -> bool:
    """Tell whether all others hold the same values, or those values rounded."""
    try:
        own = _numbers(best)
        return all(_same_or_rounded(own, _numbers(one)) for one in candidates if one is not best)
    except ValueError:
        return False


def _numbers(column: Column | Band) -> NDArray[np.float64]:
    if isinstance(column, Band):
        return column.values.ravel()
    values = [as_number(value) for value in column.values]
    return np.array([np.nan if value is None else value for value in values])


def _same_or_rounded(own: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    both_blank = np.isnan(own) & np.isnan(other)
    with np.errstate(invalid="ignore"):
        rounded = (other == np.rint(other)) & (np.abs(own - other) <= 0.5)
    return bool((both_blank | (own == other) | rounded).all())


# Attributes of formats that hold their numbers as text, or say a column's unit in its title.

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


# ----------------------------------------------------------------------------------------- the unit

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
    mix_rate: float | None = None
    scale: float | None = None

    def __post_init__(self) -> None:
        for name in ("density_kg_l", "flow_width_m", "flow_speed_m_s"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < 1e6:
                raise ConfigError(f"{name} is {value}; give a number above 0")
        if self.mix_rate is not None and not 1.0 <= self.mix_rate <= 1e4:
            raise ConfigError(
                f"mix_rate is {self.mix_rate}; give the litres of spray mix that hold one litre of "
                "product, 1 to 10000"
            )
        if self.scale is not None and not 0.0 < self.scale <= 1e3:
            raise ConfigError(f"scale is {self.scale}; give a factor above 0, up to 1000")


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
            f"its unit {unknown[0][:40]!r} is not a volume per area",
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
            f"{rate.name} is in {text[:40]!r}: {quantity}, not a volume per area"
            if text != rate.name
            else f"{rate.name} is {quantity} by its name, not a volume per area",
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
            f"its unit {found.name!r} is a weight, not a volume per area",
            fix="give the density of what is sprayed with --density-kg-l "
            f"(prescription.density_kg_l), or {instead or 'make the map in L/ha'}",
            code="not-a-volume",
        )
    if l_ha is None:
        raise map_error(
            path,
            f"its unit {found.name!r} is a flow, not a volume per area",
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
    factors = []
    if given.mix_rate is not None:
        factors.append(f"litres of product, 1 L in {given.mix_rate:g} L of spray mix")
    if given.scale is not None:
        factors.append(f"taken {given.scale:g} times")
    whole = l_ha * (given.mix_rate or 1.0) * (given.scale or 1.0)
    if factors:
        problem = Problem(
            severity="warning",
            code="scaled-rates",
            text=f"the map's rates are {', '.join(factors)}: 1 {found.name} is {whole:.6g} L/ha of "
            "spray mix",
            where=str(path),
            fix="check the figure; leave out --mix-rate and --scale (prescription.mix_rate, scale) "
            "for a map in L/ha of spray mix, such as one that was converted",
        )
        problems = (*problems, problem)
    return Unit(name=found.name, l_ha=whole, problems=problems)


def _wanted(asked: str, path: Path) -> RateUnit:
    found = rate_unit(asked)
    if found is None:
        raise map_error(
            path,
            f"the unit {asked!r} is not a volume per area",
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
            text=f"the file's unit {unknown[0][:40]!r} is not understood; {wanted} is used",
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
