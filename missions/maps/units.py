"""Units of an application rate: what they are called in files, and how many L/ha each is.

Only volume per area is a rate for a sprayer. Mass per area (kg/ha) needs a density that no map
states, and volume per time (L/min) needs a speed and a width: whoever asks for the conversion has
to state them.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from companion.core.nozzle import rate_for_flow

Kind = Literal["volume", "mass", "flow"]

# Litres of each volume, by its usual name. US customary: 1 gal = 231 in^3 = 3.785411784 L
# exactly, 1 gal = 4 qt = 8 pt = 128 fl oz (NIST Handbook 44, appendix C); the imperial gallon is
# 4.54609 L (UK Weights and Measures Act 1985). A plain "gal" in a prescription is the US one.
_LITRES: dict[str, tuple[float, str]] = {
    "L": (
        1.0,
        r"l|lts?|ltrs?|lits?|lit(?:er|re|ro)s?|litr(?:[aiuy]|aa|ow)?|litar[ai]|"
        r"л|л[иі]тр(?:а|и|ы|ов|ів)?|λ|λιτρ[αο]|公?升|リットル|리터",
    ),
    "mL": (1e-3, r"ml|cc|millilit(?:er|re)s?|毫升"),
    "cL": (1e-2, r"cl|centilit(?:er|re)s?"),
    "dL": (1e-1, r"dl|decilit(?:er|re)s?"),
    "hL": (1e2, r"hl|hectolit(?:er|re)s?"),
    "mm3": (1e-6, r"mm3|mm\^3"),
    "m3": (1e3, r"m3|m\^3|cubicmet(?:er|re)s?"),
    "gal": (3.785411784, r"gals?|gallons?|us\.?gals?|us\.?gallons?|gals?\(us\)"),
    "imp gal": (4.54609, r"imp(?:erial)?\.?gal(?:lon)?s?|uk\.?gal(?:lon)?s?"),
    "qt": (3.785411784 / 4, r"qts?|quarts?"),
    "pt": (3.785411784 / 8, r"pts?|pints?"),
    "fl oz": (3.785411784 / 128, r"fl[._-]?oz|fluid[._-]?ounces?"),
}
# Hectares of each area. 1 ac = 4 046.8564224 m2 (international acre); 1 mu is 1/15 ha.
_HECTARES: dict[str, tuple[float, str]] = {
    "ha": (
        1.0,
        r"has?|he[ck]tar(?:e|ea|i?a|y|i|ow)?s?|ettar[oi]|hehtaaria?|га|гектар(?:а|ів|ов)?|"
        r"εκταρι[οα]|公顷|公頃|ヘクタール|헥타르",
    ),
    "ac": (0.40468564224, r"ac|acres?|英亩"),
    # 1 000 m2: the decare of Turkey (dönüm), Norway and the Balkans, Greece's stremma, Israel's
    # dunam, and the ten ares of Japan's labels.
    "da": (
        0.1,
        r"daa?|dek|dka|de[ck]ar(?:es?|a|i)?|donum|dunams?|stremmas?|στρεμμα(?:τα)?|декара?|10a|反",
    ),
    "m2": (1e-4, r"m2|m\^2|m-2|m\^-2|sqm|squaremet(?:er|re)s?"),
    "mu": (1.0 / 15.0, r"mu|亩"),
}
# Kilograms of each weight; 1 lb = 0.45359237 kg exactly (NIST Handbook 44), 1 oz = 1/16 lb; the
# short ton of 2 000 lb goes by the name of ton in the United States, so a plain ton is refused.
_KILOGRAMS: dict[str, tuple[float, str]] = {
    "kg": (1.0, r"kgs?|кг|kilo(?:gram)?(?:me)?s?|公斤|千克"),
    "g": (1e-3, r"g|г|grams?|gr|克"),
    "mg": (1e-6, r"mg|milligrams?"),
    "t": (1e3, r"t|tonnes?"),
    "lb": (0.45359237, r"lbs?|pounds?"),
    "oz": (0.45359237 / 16, r"oz|ounces?"),
}
# Minutes of each time.
_MINUTES: dict[str, tuple[float, str]] = {
    "min": (1.0, r"min(?:ute)?s?|分钟?"),
    "s": (1.0 / 60.0, r"s|sec(?:ond)?s?|秒"),
    "h": (60.0, r"h|hrs?|hours?"),
}
_MASS = r"(?:k|m|µ|u)?g|kgs?|kilo(?:gram)?s?|grams?|t|to|tons?|tonnes?|lbs?|pounds?|oz|cwt|dt"
_BY = r"(?:1?(?:/|_?(?:per|p[ao]r|pro|je|na|на|ανα)_?|[·.*_-])1?)"
_SEPARATOR = f"(?:{_BY}|1?)"
# What is counted, measured along a line, harvested, or a part of what is weighed: units of other
# machines' maps, which no density, width or speed turns into litres.
_COUNTED = (
    r"(?:k|m|mio\.?|mil|thousand|million|[0-9.,])*(?:seeds?|sds|grains?|kernels?|krn|graines?|"
    r"korner|koerner|samen|semillas?|sementes?|semi|plants?|pl|pflanzen|plantes?|plantas?|piante|"
    r"pop(?:ulation)?|pieces?|pcs|stk|stuck|bags?|粒|株)"
)
_LENGTHS = r"mm|cm|dm|m|km|in|inch(?:es)?|ft|feet|foot|yd|yards?|\"|毫米|厘米|米"
# Nutrients and active ingredients: so much of the product holds so much of them.
_PART = (
    r"n|p|k|s|mg|ca|b|zn|mn|p2o5|k2o|cao|mgo|so3|no3|nh4|nitrogen|azote?|stickstoff|phosph[a-z]*|"
    r"potas[a-z]*|kali|sul(?:f|ph)ur|a\.?i\.?|a\.?e\.?|a\.?s\.?|wirkstoff|active[a-z]*"
)
# "l ha^-1", "l.ha⁻¹", and "gal1ac-1", as ADAPT codes it; with the power no separator is needed.
_POWER = r"\^?\(?-1\)?"
_WHOLE = {"gpa": ("gal", "ac"), "lha": ("L", "ha"), "lpha": ("L", "ha"), "lda": ("L", "da")}


def bare(text: str) -> str:
    """Return a text in lower case without accents, wide letters and powers as plain ones.

    >>> bare("Dávka"), bare("m⁻²"), bare("Fläche")
    ('davka', 'm-2', 'flache')
    """
    plain = unicodedata.normalize("NFKD", text.replace("\N{MICRO SIGN}", "u"))
    marked = "".join(one for one in plain if not unicodedata.combining(one))
    return unicodedata.normalize("NFC", marked).replace("\N{MINUS SIGN}", "-").casefold()


def _plain(unit: str) -> str:
    return re.sub(r"[\s\[\]']+", "", bare(unit)).rstrip(".")


def _ratio(amounts: str, bases: str, separator: str = _SEPARATOR) -> str:
    return f"(?:{amounts})(?:{separator}(?:{bases})(?:{_POWER})?|1?(?:{bases}){_POWER})"


@dataclass(frozen=True, slots=True, kw_only=True)
class RateUnit:
    """A unit of a rate: what kind, how this project spells it, and what one of it is.

    `factor` is in L/ha for a volume, in kg/ha for a mass, in L/min for a flow.
    """

    kind: Kind
    name: str
    factor: float


_KINDS: tuple[tuple[Kind, dict[str, tuple[float, str]], dict[str, tuple[float, str]]], ...] = (
    ("volume", _LITRES, _HECTARES),
    ("mass", _KILOGRAMS, _HECTARES),
    ("flow", _LITRES, _MINUTES),
)


def rate_unit(unit: str) -> RateUnit | None:
    """Return what a unit means, or None for what is no rate of anything.

    >>> [(found.kind, found.name) for found in (rate_unit("kg/ha"), rate_unit("l per min"))]
    [('mass', 'kg/ha'), ('flow', 'L/min')]
    >>> rate_unit("g/m2").factor, rate_unit("seeds/ha"), rate_unit("litres")
    (10.0, None, None)
    >>> [rate_unit(text).name for text in ("Lts/Ha", "litros por hectárea", "l/dekar", "L/10a")]
    ['L/ha', 'L/ha', 'L/da', 'L/da']
    """
    plain = _plain(unit)
    if len(plain) > 40:
        return None
    for kind, amounts, bases in _KINDS:
        for base, (size, bases_called) in bases.items():
            for amount, (content, called) in amounts.items():
                if _WHOLE.get(plain) == (amount, base) or re.fullmatch(
                    _ratio(called, bases_called, _BY if kind == "flow" else _SEPARATOR), plain
                ):
                    return RateUnit(kind=kind, name=f"{amount}/{base}", factor=content / size)
    return None


def l_ha_per_unit(
    unit: str,
    *,
    density_kg_l: float | None = None,
    flow_width_m: float | None = None,
    flow_speed_m_s: float | None = None,
) -> float | None:
    """Return how many L/ha one of this unit is, or None where that cannot be known.

    rate [L/ha] = rate [unit] * litres of its volume / hectares of its area; a mass is divided by
    the density, a flow spread over the width and the way of its time (P1 Eq. 1).

    >>> l_ha_per_unit("L/ha")
    1.0
    >>> round(l_ha_per_unit("gal/ac"), 4)
    9.354
    >>> round(l_ha_per_unit("mL/m2"), 9)
    10.0
    >>> round(l_ha_per_unit("L/mu"), 9)
    15.0
    >>> round(l_ha_per_unit("mm3/m2"), 9), round(l_ha_per_unit("mL/ha"), 9)
    (0.01, 0.001)
    >>> round(l_ha_per_unit("L/ac"), 4), round(l_ha_per_unit("fl oz/ac"), 5)
    (2.4711, 0.07308)
    >>> l_ha_per_unit("kg/ha") is None, l_ha_per_unit("kg/ha", density_kg_l=1.25)
    (True, 0.8)
    >>> round(l_ha_per_unit("L/min", flow_width_m=5.0, flow_speed_m_s=6.0), 4)
    5.5556
    """
    found = rate_unit(unit)
    if found is None:
        return None
    if found.kind == "mass":
        return None if density_kg_l is None else found.factor / density_kg_l
    if found.kind == "flow":
        if flow_width_m is None or flow_speed_m_s is None:
            return None
        return rate_for_flow(found.factor, flow_speed_m_s, flow_width_m)
    return found.factor


def is_volume(unit: str) -> bool:
    """Tell whether this is a volume alone, without what it is spread over."""
    return any(re.fullmatch(called, _plain(unit)[:40]) for _, called in _LITRES.values())


def other_quantity(unit: str) -> str | None:
    """Return what a known unit measures that is not a volume per area and cannot become one.

    None for units that can, and for what is no unit that is known here.

    >>> other_quantity("seeds/ha"), other_quantity("%"), other_quantity("kg N/ha")
    ('a count', 'a share', 'a weight of a nutrient or an active ingredient')
    >>> other_quantity("L/ha"), other_quantity("kg/ha"), other_quantity("Einh.")
    (None, None, None)
    """
    plain = _plain(unit)
    if not plain or len(plain) > 40 or rate_unit(unit) is not None:
        return None
    return next((name for name, form in _OTHERS if form.fullmatch(plain)), None)


# Of what is no certain weight: tons are of several sizes.
A_MASS = "a weight per area"


def _others() -> tuple[tuple[str, re.Pattern[str]], ...]:
    volumes, areas, masses, times = (
        "|".join(called for _, called in units.values())
        for units in (_LITRES, _HECTARES, _KILOGRAMS, _MINUTES)
    )
    masses = f"{_MASS}|{masses}"
    liquid_or_solid = f"{volumes}|{masses}"
    join = r"[._-]?"
    per_area = f"(?:{_SEPARATOR}(?:{areas})(?:{_POWER})?)"
    forms = {
        "a count": f"(?:{_COUNTED})(?:{per_area}|{_SEPARATOR}(?:{times}))?|"
        f"1?(?:/|per)(?:{areas}|{times})|1?(?:{areas}|{times}){_POWER}|"
        rf"m-2|m\^-2|units?{per_area}",
        "a share": r"%.*|percent.*|pct|prozent|pour-?cent.*|por(?:cento|ciento)|‰|pp[mb]|"
        f"(?:{liquid_or_solid})(?:/|per)(?:100|1000)?(?:{liquid_or_solid})",
        "a length": rf"(?:{_LENGTHS})(?:between.*|spacing|depth)?",
        "an amount per length": f"(?:{liquid_or_solid}|{_COUNTED}|1)?(?:/|per)(?:100|1000)?"
        f"(?:{_LENGTHS})",
        "a weight of a nutrient or an active ingredient": f"(?:{masses}){join}(?:{_PART})"
        f"{per_area}?|(?:{_PART}){join}(?:{masses}){per_area}",
        "a weight per time": f"(?:{masses})(?:/|per)(?:{times})",
        "a weight": f"(?:{masses})",
        A_MASS: f"(?:{masses}){per_area}",
        "a yield": f"(?:bu|bushels?|bales?){per_area}?",
        "a speed": r"km/?h|kmh|kph|m/s|mph|kn(?:ots)?",
        "a pressure": r"bar|psi|[kmh]?pa",
        "an index": r"ndvi|ndre|index|score",
    }
    return tuple((name, re.compile(form)) for name, form in forms.items())


_OTHERS = _others()
# Alone at the end of a name these letters may be anything: `rate_s`, `dose_m`, `value_k`.
_SHORT = 2
# Words that say what a column counts or compares, with or without a unit behind them.
_OTHER_WORDS = {
    "a count": {"seed", "seeds", "seeding", "plants", "kernels", "population", "graines", "korner"},
    "a share": {"percent", "percentage", "pct", "prozent"},
    "a length": {"spacing", "depth"},
}


def _runs(name: str) -> list[str]:
    """Return all runs of words of a name, the long ones first; of a longer text those at its end.

    >>> _runs("doseLHa")
    ['dose LHa', 'dose', 'LHa']
    """
    apart = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name)
    words = list(re.finditer(r"[^\s_()\[\],;:-]+", apart))[-8:]
    runs = [(first.start(), last.end()) for first in words for last in words]
    ends = {end for _, end in runs} if len(name) <= 40 else {words[-1].end()}
    runs = [(start, end) for start, end in runs if start < end and end in ends]
    return [apart[start:end] for start, end in sorted(runs, key=lambda run: run[0] - run[1])]


def quantity_in_name(column: str) -> tuple[str, str] | None:
    """Return a unit in which a column's name ends and what it measures, as `other_quantity` does.

    >>> quantity_in_name("rate_seeds_ha"), quantity_in_name("rate (%)")
    (('seeds_ha', 'a count'), ('%', 'a share'))
    >>> quantity_in_name("N_kg_ha")
    ('N_kg_ha', 'a weight of a nutrient or an active ingredient')
    >>> quantity_in_name("rate_l_ha"), quantity_in_name("rate_m"), quantity_in_name("value")
    (None, None, None)
    """
    for start in (0, *(match.end() for match in re.finditer(r"[\s_(\[]+", column))):
        tail = column[start:].rstrip(")] ")
        if rate_unit(tail) is not None:
            return None
        found = other_quantity(tail)
        if found is not None and (len(tail) > _SHORT or tail in ("%", "‰", "cm", "mm", "kg", "lb")):
            return tail, found
    return None


def quantity_of_word(words: Sequence[str]) -> str | None:
    """Return what one of the words of a column's name says that it measures, if no volume.

    >>> quantity_of_word(["seed", "rate"]), quantity_of_word(["rate"])
    ('a count', None)
    """
    return next((name for name, known in _OTHER_WORDS.items() if known & set(words)), None)


def unit_in_name(column: str) -> str | None:
    """Return the unit that a column's name holds, or None: `rate_l_ha`, `kg/ha`, `doseLHa`.

    Letters alone are a unit where nobody writes them for anything else.

    >>> unit_in_name("rate_l_ha"), unit_in_name("Dose (L/ha)"), unit_in_name("gal/ac rate")
    ('L/ha', 'L/ha', 'gal/ac')
    >>> unit_in_name("rate"), unit_in_name("alpha"), unit_in_name("tac"), unit_in_name("lits")
    (None, None, None, None)
    """
    for run in _runs(column):
        found = rate_unit(run)
        if found is None and other_quantity(run) != A_MASS:
            continue
        if len(run) > _SHORT + 1 or not run.isalnum() or run.casefold() in _WHOLE:
            return run if found is None else found.name
    return None
