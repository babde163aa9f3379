"""QGC WPL 110 (`.waypoints`), for Mission Planner and MAVProxy: one sortie, row 0 is home."""

from __future__ import annotations

from missions.files.items import RELATIVE, WAYPOINT, Item, items_of
from missions.files.limits import check_items
from missions.plan import Plan, Sortie

ABSOLUTE = 0  # MAV_FRAME_GLOBAL: the frame of home


def waypoints_text(plan: Plan, sortie: Sortie, *, with_sprayer: bool = False) -> str:
    """Return the content of the file; there is no NaN in it: readers stumble over the word."""
    latitude_deg, longitude_deg = plan.frame.to_geographic(*plan.depots[sortie.depot])
    home = Item(
        command=WAYPOINT,
        frame=RELATIVE,
        params=(0.0, 0.0, 0.0, 0.0),
        latitude_deg=latitude_deg,
        longitude_deg=longitude_deg,
    )
    own = items_of(plan, sortie, with_sprayer=with_sprayer)
    check_items(plan, sortie, len(own))
    items = (home, *own)
    lines = ["QGC WPL 110", *(_row(number, item) for number, item in enumerate(items))]
    return "\n".join(lines) + "\n"


def _row(number: int, item: Item) -> str:
    columns = [
        str(number),
        str(int(number == 0)),
        str(item.frame if number else ABSOLUTE),
        str(item.command),
        *(f"{value or 0.0:g}" for value in item.params),
        f"{item.latitude_deg:.9f}",
        f"{item.longitude_deg:.9f}",
        f"{item.altitude_m:.3f}",
        "1",
    ]
    return "\t".join(columns)
