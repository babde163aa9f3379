"""Attributes of ISOXML elements: numbers and names, or a refusal that says which one is wrong.

ISO 11783-10 calls attributes by single letters; what each means stands where it is asked for.
"""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree.ElementTree import Element

from missions.maps.model import map_error

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
