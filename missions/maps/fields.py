"""Which column is the rate: exactly one clear candidate, or the operator says which.

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

from missions.maps.model import Band, Column, Problem, Value, as_number, map_error
from missions.maps.units import is_mass_per_area, quantity_in_name, unit_in_name, unit_name

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
            f"{blank[0].name} holds no rate at all",
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
