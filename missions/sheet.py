"""What is known of each sortie before take-off, in words and as keys."""

from __future__ import annotations

from typing import Any

from missions.files.items import items_of
from missions.plan import Plan, Sortie
from missions.schedule import separation_m


def sheet(plan: Plan, *, with_sprayer: bool = False) -> dict[str, Any]:
    """Return the summary, with the mission items of each sortie and, for several, their gap."""
    found: dict[str, Any] = plan.summary()
    for row, sortie in zip(found["sorties"], plan.sorties, strict=True):
        row["items"] = len(items_of(plan, sortie, with_sprayer=with_sprayer))
    if plan.settings.aircraft > 1:
        found["aircraft"] = _crafts(plan)
        found["separation_m"] = separation_m(plan)
    return found


def _crafts(plan: Plan) -> list[dict[str, Any]]:
    rows = []
    for number in sorted({sortie.aircraft for sortie in plan.sorties}):
        own = [sortie for sortie in plan.sorties if sortie.aircraft == number]
        rows.append(
            {
                "number": number,
                "sorties": [sortie.number for sortie in own],
                "volume_l": sum(sortie.volume_l for sortie in own),
                "flight_s": sum(sortie.flight_s for sortie in own),
                "end_s": max(sortie.start_s + plan.airborne_s(sortie) for sortie in own),
            }
        )
    return rows


def sortie_lines(plan: Plan, found: dict[str, Any]) -> list[str]:
    """Return a line for each sortie, with what it waits for."""
    rows = zip(plan.sorties, found["sorties"], strict=True)
    return [_line(plan, sortie, row["items"]) for sortie, row in rows]


def _line(plan: Plan, sortie: Sortie, items: int) -> str:
    texts = [
        f"sortie {sortie.number:3}  {sortie.volume_l:7.2f} L  {sortie.flight_s / 60.0:6.1f} min  "
        f"{sortie.lines} lines, {_speeds(sortie.speeds_m_s)}, {items} items"
    ]
    used_wh = plan.energy_wh(sortie)
    if used_wh is not None:
        texts.append(f"{used_wh:.0f} Wh{', fresh battery' if sortie.swaps else ''}")
    if plan.settings.aircraft > 1:
        texts.append(f"aircraft {sortie.aircraft} at {sortie.start_s / 60.0:.1f} min")
    if sortie.after:
        numbers = " and ".join(str(number) for number in sortie.after)
        texts.append(f"not before sortie {numbers} has landed")
    return ", ".join(texts)


def _speeds(speeds_m_s: tuple[float, float]) -> str:
    """Return speeds in words.

    >>> _speeds((6.0, 6.0)), _speeds((4.5, 6.0))
    ('6 m/s', '4.5 to 6 m/s')
    """
    low, high = speeds_m_s
    return f"{high:g} m/s" if low == high else f"{low:g} to {high:g} m/s"
