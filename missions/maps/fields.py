"""Which column is the rate, and in which unit: one clear candidate, or the operator says.

A wrong column is a wrong dose on the whole field, so nothing is guessed: a column becomes a
candidate by its name alone, and two candidates that say different things are refused.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from companion.errors import ConfigError, MapError
from companion.wording import typed
from missions.maps.model import (
    Band,
    Column,
    Floats,
    Grid,
    Layer,
    Problem,
    Value,
    as_number,
    map_error,
)
from missions.maps.units import (
    RateUnit,
    bare,
    is_volume,
    l_ha_per_unit,
    other_quantity,
    quantity_in_name,
    quantity_of_word,
    rate_unit,
    unit_in_name,
)


def _words(text: str) -> frozenset[str]:
    return frozenset(bare(text).split())


# What rate columns are called, by the farm software of those who write the formats. DBF cuts names
# at ten characters (`TargetRate`).
_RATES = _words(
    "rate rates targetrat dose doses dosis dosi dosage dosaggio dosagem dosificacion dosierung "
    "dosering doz doza dozy dozsa dozis dos giva gift annos davka davky dawka dawki deva adag "
    "tasa taxa rx prescription prescrip setpoint aufwand aufwandmenge ausbringmenge sollwert "
    "sollmenge lha доза дозы норма δοση 施药量 用量 亩用量 剂量 喷量 散布量 施用量 살포량 처방량"
)
# Quantities of something, over an area or in all.
_AMOUNTS = _words(
    "amount quantity volume menge quantite cantidad quantita quantidade hoeveelheid mængde mängd "
    "mengde määrä ilosc mnozstvi kolicina cantitate mennyiseg miktar ποσοτητα количество "
    "кількість объем volumen vol qty 数量 量 수량"
)
_WEAK = _AMOUNTS | _words(
    "value values val target application wert valor valeur valore waarde arvo wartosc hodnota "
    "norm norma taux tasso oran deger значение 值"
)
_TOTALS = _words(
    "total totals totale totali totaux totaal totalt tot ttl ges gesamt insgesamt summe summa sum "
    "suma somme somma soma ialt toplam razem lacznie celkem celkom celkova ukupno osszes yhteensa "
    "σύνολο сумма итого всего общий общая всього 总 总量 合计 合計 총"
)
_AREAS = _words("ha ac acre acres hectare hectares hektar")
_MEANS = _words(
    "mean avg average moy moyenne media promedio mittel mittelwert durchschnitt gem medel median"
)
# What numbers that stand beside a rate are of.
_OTHERS = _words(
    "area areas flache flaeche surface superficie id fid oid gid objectid zone zones zoneid level "
    "class classid cluster rank perimeter length len width lon lat longitude latitude x y z "
    "elevation altitude height count percent pct ndvi ndre yield speed time date year price cost "
    "color colour unit min max std stdev shape"
)
_OF_NAMES = _words("app tgt spray")
_PLAIN = _RATES | _WEAK | _AREAS | _OF_NAMES
_KNOWN = _PLAIN | _TOTALS | _MEANS | _OTHERS
# How clearly a column is the rate. Who has a word for it, but is not clearly it, is never taken
# unasked, and nothing weaker beside it.
STRONG, NAMED, WEAK, NONE, UNCLEAR, TOTAL = 3, 2, 1, 0, -1, -2
# Values that grow with the area of their records: divided by it they spread so much less. Of few
# records, and of a column that is called a rate, more is asked for than chance gives.
_SPREAD_MIN, _SHARE_MAX, _SHARE_FEW, _FEW = 0.2, 0.45, 0.1, 4


Source = TypeVar("Source", Column, Band)


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice(Generic[Source]):
    """The rate column or band, and what there is to say about the choice."""

    column: Source
    problems: tuple[Problem, ...] = ()


@lru_cache(maxsize=4096)
def words(name: str) -> tuple[str, ...]:
    """Return the words of a column's name, in lower case, without accents, compounds taken apart.

    >>> words("Tgt_Rate"), words("rateInt"), words("DOSETOT"), words("Gesamtmenge")
    (('tgt', 'rate'), ('rate', 'int'), ('dose', 'tot'), ('gesamt', 'menge'))
    """
    split = bare(re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name))
    return tuple(part for word in re.split(r"[\W_\d]+", split) if word for part in _apart(word))


def _apart(word: str) -> tuple[str, ...]:
    """Return the known words that one is made of, or the word itself."""
    if word not in _KNOWN and len(word) <= 40:
        for end in range(len(word) - 1, 1 if word.isascii() else 0, -1):
            rest = _apart(word[end:])
            known = _KNOWN.issuperset((word[:end], *rest))
            if known and len(word) - end > word.isascii():
                return word[:end], *rest
    return (word,)


def score(column: Column | Band) -> int:
    """Return how clearly a column's name says that it holds the rate.

    >>> def score_of(name): return score(Column(name=name, values=(), numeric=True))
    >>> [score_of(name) for name in ("rate", "DOSE_HA", "MeanRate", "value")]
    [3, 3, 2, 1]
    >>> [score_of(name) for name in ("area", "zone", "rate_id", "DOSE_TOT", "Menge_l")]
    [0, 0, -1, -2, -2]
    """
    if isinstance(column, Column) and not column.numeric:
        return NONE
    parts = set(words(column.name))
    unit = unit_in_name(column.name)
    rate = unit is not None or not parts.isdisjoint(_RATES)
    other = not parts.isdisjoint(_OTHERS)
    if unit is None and not other and _is_total(column.name):
        return TOTAL
    if rate:
        return UNCLEAR if other else NAMED + (unit is not None or parts <= _PLAIN)
    if other or parts & _MEANS or not parts & (_WEAK if not parts & _AREAS else _AMOUNTS):
        return NONE
    return NAMED if parts & _AREAS else WEAK


def _is_total(name: str) -> bool:
    """Tell whether a name says that its numbers are of a whole area, by a word or by the unit."""
    parts = words(name)
    in_all = _AMOUNTS.intersection(parts) and is_volume(parts[-1])
    return bool(in_all) or not _TOTALS.isdisjoint(parts)


def choose(
    columns: Sequence[Source], *, asked: str | None, path: Path, areas: Floats | None = None
) -> Choice[Source]:
    """Return the rate column: the one asked for, or the only one that it can be.

    A format that marks its rates has one for each product; one product is flown at a time.
    `areas` are those of the records, on any scale: values that grow with them are a total.
    """
    marked = [column for column in columns if column.is_rate]
    choice: Choice[Source]
    if asked is not None:
        choice = Choice(column=_asked(columns, asked, path))
    elif len(marked) > 1:
        raise map_error(
            path,
            f"the map holds {len(marked)} products: {typed(one.name for one in marked)}",
            fix="name the one to spray with --rate-field (prescription.rate_field)",
            code="several-products",
        )
    else:
        choice = Choice(column=marked[0]) if marked else _among(_candidates(columns, path), path)
    rate = choice.column
    if areas is not None and isinstance(rate, Column) and grows(rate, areas):
        name = rate.name
        text = f"the values of {name} grow with the area of its zones, so {name} is a total"
        fix = "name the column with the rate per area with --rate-field (prescription.rate_field)"
        if asked is None and not marked:
            fix += f", or {typed([name])} if it is one"
            raise map_error(path, text, fix=fix, code="total-column")
        problem = Problem(severity="warning", code="total-column", text=text, where=name, fix=fix)
        choice = replace(choice, problems=(*choice.problems, problem))
    return choice


def _candidates(columns: Sequence[Source], path: Path) -> list[Source]:
    """Return the columns that the rate can be, all equally: what only may be it is asked about."""
    columns = [_with_numbers(column) for column in columns]
    full = [column for column in columns if _holds_numbers(column)]
    named = [column for column in full if score(column) >= NAMED]
    if named:
        return sorted(named, key=score, reverse=True)
    weak: list[Source] = [column for column in full if score(column) == WEAK]
    for column in columns:
        if isinstance(column, Column):
            refuse_text(column.name, column.values, path)
    blank = [column for column in columns if score(column) >= NAMED]
    if blank:
        raise map_error(
            path,
            f"{typed(one.name for one in blank)} is blank in every record",
            fix=f"give the zones a rate, 0 for none, or {_NAME_IT}",
            code="null-rate",
        )
    unclear: list[Source] = [
        one for one in full if score(one) < NONE and not _RATES.isdisjoint(words(one.name))
    ]
    if weak:
        return unclear + weak
    bands: list[Source] = [column for column in columns if isinstance(column, Band)]
    if len(columns) == 1 and bands and not {*words(bands[0].name)} & (_OTHERS | _TOTALS):
        return list(columns)  # a raster of one band is a map of that
    numeric = [one.name for one in columns if isinstance(one, Band) or one.numeric]
    totals = typed(one.name for one in full if score(one) == TOTAL)
    several = len(bands) > 1
    raise map_error(
        path,
        f"no band looks like a rate; there are {typed(numeric) or 'none'}"
        if several
        else f"no column looks like a rate; it has {typed(numeric) or 'no column of numbers'}"
        + (f"; {totals} is a total by its name" if totals else ""),
        fix=_NAME_IT if numeric else "give its zones a column of numbers with their rates",
        code="several-products" if several else "no-rate-column",
    )


_NAME_IT = "name the column with --rate-field (prescription.rate_field)"


def refuse_text(name: str, values: Iterable[Value], path: Path) -> None:
    """Refuse a column that is called a rate and holds text like `18,5` or `18.5 L/ha`."""
    if score(Column(name=name, values=(), numeric=True)) < NAMED:
        return
    texts = (value.strip() for value in values if isinstance(value, str) and value.strip())
    text = next((one for one in texts if _NUMBER.fullmatch(one) is None), "")
    if re.match(r"[+-]?[\d.,]*\d", text, re.ASCII):
        raise map_error(
            path,
            f"{name} holds {text[:40]!r}, which is text and not a number",
            fix="write its rates as numbers like 18.5, with a point and without a unit",
            code="text-rate",
        )


def grows(column: Column, areas: Floats) -> bool:
    """Tell whether a column's values follow the area of their records, as totals do."""
    try:
        values = _numbers(column)
    except ValueError:
        return False
    some = (values > 0.0) & np.isfinite(values) & (areas > 0.0)
    if np.count_nonzero(some) < 2:
        return False
    value, area = np.log(values[some]), np.log(areas[some])
    few = len(value) < _FEW and score(column) != WEAK
    most = (_SHARE_FEW if few else _SHARE_MAX) * float(value.std())
    return float(area.std()) > _SPREAD_MIN and float((value - area).std()) < most


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
            fix=f"take one of {typed(column.name for column in columns) or 'none'}"
            " for --rate-field (prescription.rate_field)",
            code="no-rate-column",
        )
    return found[0]


def _holds_numbers(column: Column | Band) -> bool:
    if isinstance(column, Band):
        return not bool(np.isnan(column.values).all())
    return any(value is not None for value in column.values)


def _among(candidates: Sequence[Source], path: Path) -> Choice[Source]:
    """Return the one whose values the other candidates repeat, if there is such a one."""
    if len(candidates) == 1:
        return Choice(column=candidates[0])
    clear = all(score(one) > NONE for one in candidates)
    best = next((one for one in candidates if clear and _repeated_by(one, candidates)), None)
    if best is None:
        names = typed(column.name for column in candidates)
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
        fix=_NAME_IT,
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
    units = {unit for text in texts if (unit := unit_in_name(text)) is not None}
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


# ----------------------------------------------------------------------------------------- the unit

_UNIT_WORDS = _words(
    "unit units uom einheit einh unite unites unidad unidade unita eenheid enhed enhet jednostka "
    "jednotka birim единица ед 单位"
)
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
    declared = _declared(layer, rate, given, path)
    known = {found.name: found for found in map(rate_unit, declared) if found is not None}
    _refuse_other_quantity(layer, rate, declared, wanted=wanted, known=bool(known), path=path)
    unknown = [text for text in declared if rate_unit(text) is None]
    if unknown and wanted is None:
        raise _no_unit(f"its unit {unknown[0][:40]!r}", unknown[0], path)
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
    problems = tuple(
        Problem(
            severity="warning",
            code="unit-overridden",
            text=f"the file's unit {text[:40]!r} is not understood; {found.name} is used",
            where=rate.name,
            fix="make sure that it means the same",
        )
        for text in unknown[:1]
    )
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
        raise _no_unit(f"the unit {asked[:40]!r}", asked, path)
    return found


def _no_unit(what: str, unit: str, path: Path) -> MapError:
    """Return the refusal of a unit: of something else, or of nothing that is known here."""
    other = is_volume(unit) or other_quantity(unit) is not None
    return map_error(
        path,
        f"{what} is not a volume per area" if other else f"{what} is none that is known here",
        fix=_FIX,
        code="not-a-volume",
    )


def _declared(layer: Layer | Grid, rate: Column | Band, given: Given, path: Path) -> list[str]:
    """Return every unit that the file states for its rates; that of the column itself first.

    A record whose unit is blank has none: that of its neighbours is theirs.
    """
    if not _is_blank(rate.unit):
        return [str(rate.unit).strip()]
    every = layer.bands if isinstance(layer, Grid) else layer.columns
    others = [set(words(one.name)) for one in every if one.name != rate.name]
    columns = [one for one in layer.columns if _is_unit_column(one, rate, others)]
    own = [column for column in columns if set(words(column.name)) & set(words(rate.name))]
    stated = [column.values for column in own or columns]
    whole = [text for text in (layer.unit, unit_in_name(rate.name)) if not _is_blank(text)]
    said = [str(value).strip() for one in stated for value in one if not _is_blank(value)]
    if said and not whole and given.unit is None:
        has_rate = rate.values if isinstance(rate, Column) else None
        for index, units in enumerate(zip(*stated, strict=True)):
            rated = has_rate is None or has_rate[index] is not None
            if rated and all(map(_is_blank, units)):
                raise map_error(
                    path,
                    f"record {index + 1} has no unit, others {said[0][:40]}",
                    fix="give it one, or say with --unit (prescription.unit) that all have it",
                    code="no-unit",
                )
    return list(dict.fromkeys(map(str, (*whole, *said))))


def _is_blank(text: Value) -> bool:
    return text is None or str(text).strip().casefold() in _BLANK


def _is_unit_column(column: Column, rate: Column | Band, others: Sequence[set[str]]) -> bool:
    """Tell whether a column holds the unit of the rate, and not of something else or another."""
    parts = set(words(column.name))
    of = parts - _UNIT_WORDS
    meant = _PLAIN | set(words(rate.name))
    return of < parts and not column.numeric and of <= meant and of not in others
