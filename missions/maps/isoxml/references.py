"""Products (PDT) and value presentations (VPN) of an ISOXML file, to which its values refer."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from xml.etree.ElementTree import Element

from missions.maps.isoxml.ddi import Presentation, presentation_of
from missions.maps.isoxml.task import ById, Variable
from missions.maps.isoxml.values import children, text


class References:
    """The products and presentations to which variables refer; only what is in use is checked."""

    def __init__(self, root: Element, path: Path, instead: str) -> None:
        """Index both; `instead` says what to choose where a task cannot be sprayed."""
        self.path, self.instead = path, instead
        self._products = ById(root, "PDT", path)
        self._presentations = ById(root, "VPN", path)

    def product(self, own: str) -> str:
        """Return a product's name, or its id where it has none."""
        element = self._products.get(own)
        name = None if element is None else text(element, "B")
        return " ".join((name or own).split())[:60]

    def presentation(self, own: str | None) -> Presentation | None:
        """Return a presentation, or None where there is none of that id."""
        element = None if own is None else self._presentations.get(own)
        return None if own is None or element is None else presentation_of(element, own, self.path)

    def missing(self, variables: Iterable[Variable]) -> list[str]:
        """Return the ids to which variables refer and which are nowhere."""
        products = {one.product for one in variables if one.product}
        shown = {one.presentation for one in variables if one.presentation}
        return sorted(
            {own for own in products if self._products.get(own) is None}
            | {own for own in shown if self._presentations.get(own) is None}
        )


def product_names(root: Element) -> dict[str, str]:
    """Return the products' names as they stand in the file, for a list of what there is."""
    return {
        own: text(element, "B") or own
        for element in reversed(children(root, "PDT"))
        if (own := text(element, "A")) is not None
    }
