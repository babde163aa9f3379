"""The offset between a map and a receiver, from one mark that both know.

WGS84, ETRS89 and CGCS2000 lie up to a metre and more apart, and a base on a guessed point moves
everything by its own error; on one field each of these is the same shift everywhere. A mark on
the ground, read out of the map and surveyed with the receiver that will fly, shows it.
"""

from __future__ import annotations

from companion.core.frame import LocalFrame

Place = tuple[float, float]


def offset_between(in_map: Place, surveyed: Place) -> tuple[float, float]:
    """Return by how much the map has to move: metres east and north.

    Both are (latitude, longitude) in degrees.

    >>> east_m, north_m = offset_between((36.0, 114.5), (36.000005, 114.500005))
    >>> round(east_m, 2), round(north_m, 2)
    (0.45, 0.55)
    """
    return LocalFrame(latitude_deg=in_map[0], longitude_deg=in_map[1]).to_local(*surveyed)
