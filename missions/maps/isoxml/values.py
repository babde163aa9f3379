"""Attributes of ISOXML elements: numbers and names, or a refusal that says which one is wrong.

ISO 11783-10 calls attributes by single letters; what each means stands where it is asked for.

What the numbers of ISOXML mean: data dictionary identifiers (DDI) and value presentations. A
process data value is a whole number; its DDI alone says of what and in which resolution (ISO
11783-11). A value presentation (VPN) says how a display shows it, (value + offset) x scale and a
unit. The physical value rests on the DDI; a VPN that tells another amount is a conflict, and which
of the two the maker of the map meant is not for a program to decide.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal
from xml.etree.ElementTree import Element

from missions.maps.model import map_error
from missions.maps.units import other_quantity, rate_unit

_DECIMAL = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]{1,3})?")
_INTEGER = re.compile(r"[+-]?[0-9]{1,12}")
EXPORT_AGAIN = "export the task again"


def tag(element: Element) -> str:
    """Return an element's name without its namespace; the standard has none.

    >>> tag(Element("{urn:x}TSK"))
    'TSK'
    """
    return element.tag.rpartition("}")[2]


def children(element: Element, name: str) -> list[Element]:
    """Return the direct children of one name, in the order of the file."""
    return [child for child in element if tag(child) == name]


def text(element: Element, key: str) -> str | None:
    """Return an attribute without blanks around it, or None where there is nothing in it."""
    return (element.get(key) or "").strip() or None


def required(element: Element, key: str, path: Path, *, code: str = "bad-attribute") -> str:
    """Return an attribute that has to be there."""
    found = text(element, key)
    if found is None:
        raise map_error(
            path, f"{_called(element)} lacks the attribute {key}", fix=EXPORT_AGAIN, code=code
        )
    return found


def integer(
    element: Element, key: str, path: Path, *, low: int, high: int, code: str = "bad-attribute"
) -> int:
    """Return a whole number within its bounds."""
    found = required(element, key, path, code=code)
    if not _INTEGER.fullmatch(found) or not low <= int(found) <= high:
        raise _no_number(element, key, found, path, f"a whole number from {low} to {high}", code)
    return int(found)


def number(
    element: Element, key: str, path: Path, *, low: float, high: float, code: str = "bad-attribute"
) -> float:
    """Return a decimal number within its bounds."""
    found = required(element, key, path, code=code)
    if not _DECIMAL.fullmatch(found) or not low <= float(found) <= high:
        raise _no_number(element, key, found, path, f"a number from {low:g} to {high:g}", code)
    return float(found)


def _called(element: Element) -> str:
    """Return what to call an element in a message: its name and, where it has one, its id."""
    name = tag(element)[:16]
    own = text(element, "A") if name in ("TSK", "TZN", "PFD", "VPN", "PDT") else None
    return f"{name} {own[:40]}" if own else name


def _no_number(
    element: Element, key: str, found: str, path: Path, wanted: str, code: str
) -> Exception:
    return map_error(
        path,
        f"{_called(element)} has {key}={found[:40]!r} where {wanted} belongs",
        fix=EXPORT_AGAIN,
        code=code,
    )


Role = Literal["setpoint", "actual", "default", "minimum", "maximum"]
_ROLES: tuple[Role, ...] = ("setpoint", "actual", "default", "minimum", "maximum")
_DDI = re.compile(r"(?:0[xX])?([0-9A-Fa-f]{1,4})")
# What a scale rounded to few digits may change (gallons), far below any confusion of units.
_ROUNDING = 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class Family:
    """The DDIs of one quantity, in the order of `_ROLES`, and how many raw values one unit has."""

    ddis: tuple[int, int, int, int, int]
    unit: str
    raw_per_unit: float


# ISO 11783-11: the standard's units and resolutions in brackets.
FAMILIES = (
    # [mm3/m2 x 0.01], so 10 000 is 1 L/ha
    Family(ddis=(1, 2, 3, 4, 5), unit="L/ha", raw_per_unit=10_000.0),
    # [mL/m2 x 0.1]; here the default comes last
    Family(ddis=(588, 589, 592, 590, 591), unit="L/ha", raw_per_unit=1.0),
    Family(ddis=(6, 7, 8, 9, 10), unit="kg/ha", raw_per_unit=100.0),  # [mg/m2]
    Family(ddis=(11, 12, 13, 14, 15), unit="1/m2", raw_per_unit=1000.0),  # [/m2 x 0.001]
    Family(ddis=(16, 17, 18, 19, 20), unit="mm between seeds", raw_per_unit=1.0),  # [mm]
    Family(ddis=(21, 22, 23, 24, 25), unit="mm3/m3", raw_per_unit=1.0),
    Family(ddis=(26, 27, 28, 29, 30), unit="mg/kg", raw_per_unit=1.0),
    Family(ddis=(31, 32, 33, 34, 35), unit="mm3/kg", raw_per_unit=1.0),
    # [mm3/s]: 1 L/min is 1e6 mm3 in 60 s
    Family(ddis=(36, 37, 38, 39, 40), unit="L/min", raw_per_unit=1e6 / 60.0),
    Family(ddis=(41, 42, 43, 44, 45), unit="mg/s", raw_per_unit=1.0),
    Family(ddis=(46, 47, 48, 49, 50), unit="1/s", raw_per_unit=1000.0),  # [/s x 0.001]
    Family(ddis=(633, 634, 635, 636, 637), unit="mL/m", raw_per_unit=1000.0),  # [mL/m x 0.001]
)
# What other values in treatment zones are: no rates at all, or a share of a rate that stands
# nowhere in the file (first and last DDI of ISO 11783-11).
_NO_RATES = (
    (51, 55, "tillage depth"), (56, 60, "seeding depth"), (61, 65, "working height"),
    (66, 70, "working width"), (71, 79, "tank content"), (80, 82, "total applied"),
    (83, 98, "yield or crop loss"), (121, 123, "product density"),
    (140, 140, "percentage of a rate"), (153, 153, "vegetation index"), (193, 204, "pressure"),
    (308, 310, "percentage of a rate"), (311, 313, "yield potential"),
)  # fmt: skip
_MEANING: dict[int, tuple[Family, Role]] = {
    ddi: (family, role)
    for family in FAMILIES
    for ddi, role in zip(family.ddis, _ROLES, strict=True)
}


def meaning(ddi: int) -> tuple[Family, Role] | None:
    """Return what quantity a DDI is of and in which role, or None for what is no rate.

    >>> family, role = meaning(1)
    >>> family.unit, role, 490000 / family.raw_per_unit
    ('L/ha', 'setpoint', 49.0)
    >>> meaning(36)[0].unit, round(16667 / meaning(36)[0].raw_per_unit, 3), meaning(0xDFFF)
    ('L/min', 1.0, None)
    """
    return _MEANING.get(ddi)


def ddi_of(written: str) -> int | None:
    """Return the DDI that four hexadecimal digits are, or None.

    >>> ddi_of("000B"), ddi_of("0x24"), ddi_of("12345"), ddi_of("")
    (11, 36, None, None)
    """
    found = _DDI.fullmatch(written)
    return None if found is None else int(found[1], 16)


def ddi_meaning(ddi: int) -> str:
    """Return a DDI with what it stands for, where that is known.

    >>> ddi_meaning(140), ddi_meaning(2), ddi_meaning(0xDFFF)
    ('DDI 008C (percentage of a rate)', 'DDI 0002 (actual value in L/ha)', 'DDI DFFF')
    """
    known = meaning(ddi)
    said = next((name for first, last, name in _NO_RATES if first <= ddi <= last), None)
    if known is not None:
        said = f"{known[1]} value in {known[0].unit}"
    return ddi_name(ddi) if said is None else f"{ddi_name(ddi)} ({said})"


def ddi_name(ddi: int) -> str:
    """Return a DDI as files write it.

    >>> ddi_name(588)
    'DDI 024C'
    """
    return f"DDI {ddi:04X}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Presentation:
    """A VPN: (value + offset) x scale is what a display shows, followed by the unit."""

    id: str
    offset: float
    scale: float
    unit: str

    def shown(self, raw: int) -> float:
        """Return what a display shows for a raw value, before it rounds."""
        return (raw + self.offset) * self.scale


def presentation_of(element: Element, id_: str, path: Path) -> Presentation:
    """Return the presentation that a VPN element holds."""
    return Presentation(
        id=id_,
        offset=number(element, "B", path, low=-(2.0**31), high=2.0**31),
        scale=number(element, "C", path, low=0.0, high=1e9),
        unit=text(element, "E") or "",
    )


def check_presentation(
    presentation: Presentation, family: Family, raws: tuple[int, ...], path: Path
) -> bool:
    """Refuse a presentation that tells another amount than the DDI, for any of the raw values.

    Return whether the two could be compared; a unit that is none of ours says nothing.
    """
    own, other = rate_unit(family.unit), rate_unit(presentation.unit)
    quantity = None if own is None else other_quantity(presentation.unit)
    if own is not None and quantity is not None:
        raise map_error(
            path,
            f"its values are in {own.name} by {ddi_name(family.ddis[0])}, but {presentation.id} "
            f"shows them in {presentation.unit[:20]!r}, {quantity}",
            fix="correct the DDI or the unit where the task is made",
            code="unit-conflict",
        )
    if own is None or other is None:
        return own is None or not presentation.unit
    if own.kind != other.kind:
        raise map_error(
            path,
            f"its values are in {own.name} by {ddi_name(family.ddis[0])}, but {presentation.id} "
            f"shows them in {other.name}",
            fix="correct the unit where the task is made",
            code="unit-conflict",
        )
    for raw in raws:
        amount = raw / family.raw_per_unit * own.factor
        shown = presentation.shown(raw) * other.factor
        if not abs(shown - amount) <= _ROUNDING * max(abs(shown), abs(amount)):
            raise map_error(
                path,
                f"its value {raw} is {amount / own.factor:.6g} {own.name} by "
                f"{ddi_name(family.ddis[0])}, but {presentation.id} shows it as "
                f"{presentation.shown(raw):.6g} {other.name}",
                fix="correct scale, offset or unit of the value presentation where the task is "
                "made",
                code="unit-conflict",
            )
    return True
