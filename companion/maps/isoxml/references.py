"""Products (PDT) and value presentations (VPN) of an ISOXML file, to which its values refer."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from xml.etree.ElementTree import Element

from companion.maps.isoxml.ddi import Presentation, presentation_of
from companion.maps.isoxml.task import Variable, by_id
from companion.maps.isoxml.values import text


class References:
    """The products and presentations to which variables refer."""

    def __init__(self, root: Element, path: Path) -> None:
        """Index both; ids given twice are refused."""
        self.path = path
        self._products = {
            own: text(element, "B") or own for own, element in by_id(root, "PDT", path).items()
        }
        self._presentations = {
            own: presentation_of(element, own, path)
            for own, element in by_id(root, "VPN", path).items()
        }

    def product(self, own: str) -> str:
        """Return a product's name, or its id where it has none."""
        return " ".join(self._products.get(own, own).split())[:60]

    def presentation(self, own: str | None) -> Presentation | None:
        """Return a presentation, or None where there is none of that id."""
        return None if own is None else self._presentations.get(own)

    def missing(self, variables: Iterable[Variable]) -> list[str]:
        """Return the ids to which variables refer and which are nowhere."""
        products = {one.product for one in variables if one.product} - set(self._products)
        shown = {one.presentation for one in variables if one.presentation}
        return sorted(products | (shown - set(self._presentations)))
