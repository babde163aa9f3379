"""`vrspray map offset`: how far a map and the receiver disagree, from one surveyed mark."""

from __future__ import annotations

import math
from typing import Annotated

import typer

from companion.cli.answer import AsJson, answer
from companion.core.frame import LocalFrame
from companion.errors import MapError
from missions.maps.cli.grid import parse_mark

OFFSET_EXAMPLE = (
    "Example: vrspray map offset --map 35.996089,114.543487 --surveyed 35.996094,114.543481"
)
# Datums and bases differ by metres; a mark farther off is another mark.
PLAUSIBLE_M = 10.0


def offset(
    in_map: Annotated[
        str, typer.Option("--map", metavar="LAT,LON", help="The mark, as the map has it.")
    ],
    surveyed: Annotated[
        str, typer.Option(metavar="LAT,LON", help="The same mark, by the receiver that will fly.")
    ],
    as_json: AsJson = False,
) -> None:
    """Say by how much a map has to move, from one mark that map and receiver both know.

    Read the mark (a corner of the field, a pole) out of the map, survey it with the receiver and
    the base that will fly, and paste the two lines into [prescription].
    """
    first, second = parse_mark(in_map, "--map"), parse_mark(surveyed, "--surveyed")
    east_m, north_m = offset_between(first, second)
    distance_m = math.hypot(east_m, north_m)
    if not distance_m <= PLAUSIBLE_M:
        raise MapError(
            f"--surveyed lies {distance_m:.1f} m from --map, more than {PLAUSIBLE_M:.0f} m; check "
            "that both are the same mark, the latitude first",
            code="wrong-mark",
        )
    result = {"offset_east_m": east_m, "offset_north_m": north_m, "distance_m": distance_m}
    lines = [
        f"offset_east_m = {east_m:.3f}",
        f"offset_north_m = {north_m:.3f}",
        f"check_map = [{first[0]!r}, {first[1]!r}]",
        f"check_surveyed = [{second[0]!r}, {second[1]!r}]",
    ]
    answer(result, lines, as_json=as_json)


# The offset between a map and a receiver, from one mark that both know.
#
# WGS84, ETRS89 and CGCS2000 lie up to a metre and more apart, and a base on a guessed point moves
# everything by its own error; on one field each of these is the same shift everywhere. A mark on
# the ground, read out of the map and surveyed with the receiver that will fly, shows it.

Place = tuple[float, float]


def offset_between(in_map: Place, surveyed: Place) -> tuple[float, float]:
    """Return by how much the map has to move: metres east and north.

    Both are (latitude, longitude) in degrees.

    >>> east_m, north_m = offset_between((36.0, 114.5), (36.000005, 114.500005))
    >>> round(east_m, 2), round(north_m, 2)
    (0.45, 0.55)
    """
    return LocalFrame(latitude_deg=in_map[0], longitude_deg=in_map[1]).to_local(*surveyed)
