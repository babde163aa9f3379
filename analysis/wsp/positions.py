"""Where the cards lay: a table that a person wrote."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from analysis.csv_rows import read_rows
from analysis.wsp.results import Numbered


@dataclass(frozen=True, slots=True, kw_only=True)
class Position:
    """Where a card lay (WGS84), how high above the ground if that was written down, and a note."""

    card: str
    latitude_deg: float
    longitude_deg: float
    height_m: float | None = None
    note: str = ""


def read_positions(path: Path) -> list[Position]:
    """Return the rows of `card, latitude, longitude[, height][, note]`."""
    found: dict[str, Position] = {}
    for row in read_rows(path, ["card", "latitude", "longitude"]):
        card = row.text("card")
        if card is None:
            raise row.error("card is blank; give its number or the name of its file")
        if card in found:
            raise row.error(f"card {card} stands twice; each card lies in one place")
        found[card] = Position(
            card=card,
            latitude_deg=row.needed("latitude", low=-90.0, high=90.0),
            longitude_deg=row.needed("longitude", low=-180.0, high=180.0),
            height_m=row.number("height", low=-100.0, high=100.0),
            note=row.text("note") or "",
        )
    return list(found.values())


def placed(
    cards: Sequence[Numbered], positions: Sequence[Position]
) -> tuple[dict[int, Position], list[str]]:
    """Return the position of each card by its number, and what does not fit.

    A card goes by its number or by one of its names; the first position that names it holds.
    """
    names = {name: each.number for each in cards for name in reversed(each.names)}
    # Two files of one name in two folders: their common name means neither.
    for name in [name for each in cards for name in each.names[1:]]:
        if sum(name in each.names for each in cards) > 1:
            names.pop(name, None)
    places: dict[int, Position] = {}
    notes = []
    for position in positions:
        number = names.get(position.card)
        if number is None:
            notes.append(f"positions: there is no card {position.card}")
        elif number in places:
            notes.append(f"positions: {position.card} is card {number}, which has a place already")
        else:
            places[number] = position
    without = [str(each.number) for each in cards if each.number not in places]
    if without:
        notes.append(f"positions: none for card {', '.join(without)}")
    return places, notes
