"""Which earlier flight left ground of this map untreated: for whoever forgets to go on with it."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from shapely.errors import ShapelyError

from companion.core.setup import Setup
from companion.errors import VrsprayError
from companion.record.continuing import Treated, read_treated_ground, rest_of
from companion.record.folder import journals
from companion.record.read_only import DAMAGE
from companion.record.reader import opened

# As far back as a day of flights goes; each costs a look at its `meta`.
FLIGHTS_LOOKED_AT = 20
# Less than this of a field is its edge.
LEFT_MIN_SHARE = 0.01
# A raster of more tiles (80 ha) takes too long to outline before a flight: nothing is said then.
TILES_MAX = 5000


@dataclass(frozen=True, slots=True, kw_only=True)
class Unfinished:
    """A journal, and how much of the field it leaves."""

    path: Path
    left_share: float
    left_ha: float


def unfinished(folder: Path, setup: Setup, *, training: str = "no") -> Unfinished | None:
    """Return the newest flight over the same map that treated some of it, if it left the rest.

    It says something or nothing, and never hinders a start.
    """
    try:
        for path in islice(reversed(journals(folder)), FLIGHTS_LOOKED_AT):
            if not _is_of(path, setup, training):
                continue
            found = read_treated_ground(path)
            if found.coverage.tiles:
                return _left(found)
    except (VrsprayError, ShapelyError, *DAMAGE):
        return None
    return None


def _is_of(path: Path, setup: Setup, training: str) -> bool:
    """Return whether a flight that has ended sprayed the same over the same map."""
    try:
        with opened(path, is_lenient=True) as journal:
            meta = journal.meta
    except VrsprayError:
        return False
    return (
        meta.get("closed") in ("yes", "recovered")
        and meta.get("training") == training
        and meta.get("map_sha256") == setup.prescription.sha256 != ""
    )


def _left(found: Treated) -> Unfinished | None:
    if len(found.coverage.tiles) > TILES_MAX:
        return None
    field = found.setup.prescription.field
    left_m2 = rest_of(field, found.coverage, found.strip_m).area
    if not left_m2 > LEFT_MIN_SHARE * field.area:
        return None
    return Unfinished(path=found.path, left_share=left_m2 / field.area, left_ha=left_m2 / 10_000.0)
