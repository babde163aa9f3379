"""Going on after a refill, a change of battery or a cut: what earlier flights have treated."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import shapely
from shapely import MultiPolygon
from shapely.errors import ShapelyError
from shapely.geometry.base import BaseGeometry

from companion.core.frame import LocalFrame
from companion.core.options.coverage import CELL_M, Coverage
from companion.core.options.overlap import OverlapGuard
from companion.core.setup import Setup
from companion.errors import JournalError, UnreadableError, VrsprayError
from companion.journal.coverage import as_polygons, moved, polygons, read_coverage
from companion.journal.folder import journals
from companion.journal.geopackage import wkb_of
from companion.journal.read_only import DAMAGE, distrust, one_line
from companion.journal.reader import OpenJournal, opened
from companion.simulated import UNMARKED, Simulated, simulated_in

# Where nothing else is configured, whoever goes on closes a valve that is more over treated ground
# than over bare: misses and doubles come out even.
SWITCH_OFF_PERCENT = 50.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Treated:
    """What one journal says of treated ground; `stopped` is (latitude, longitude).

    `unread` says in a line each what is damaged and left out; empty for a sound file.
    """

    path: Path
    coverage: Coverage
    frame: LocalFrame
    setup: Setup
    stopped: tuple[float, float] | None
    started_utc: str
    is_closed: bool
    training: str | None
    simulated: Simulated = UNMARKED
    unread: tuple[str, ...] = ()

    @property
    def strip_m(self) -> float:
        """Return the width of the narrowest valve's strip."""
        return 2.0 * float(self.setup.boom.half_width_m.min())


def read_treated_ground(path: Path) -> Treated:
    """Return what was treated when a flight ended, by it and before it.

    JournalError where the file cannot be used or keeps no coverage, or where any of it is damaged.
    """
    with opened(path) as journal:
        return treated_ground_of(journal)


def treated_ground_of(journal: OpenJournal, unread: list[str] | None = None) -> Treated:
    """Return what was treated; with `unread` what is damaged is left out and said there."""
    path = journal.path
    coverage = read_coverage(journal.connection, unread=unread)
    if coverage is None and unread:
        raise UnreadableError(
            f"{path}: is damaged: no treated ground can be read of it ({unread[0]}); see "
            "vrspray flights show"
        )
    if coverage is None:
        raise JournalError(
            f"{path}: keeps no treated ground: coverage.record was false, or an older version "
            "wrote it"
        )
    setup = journal.setup(unread)
    stopped = _stopped(journal, unread)
    return Treated(
        path=path,
        coverage=coverage,
        frame=setup.frame,
        setup=setup,
        stopped=stopped,
        started_utc=journal.meta.get("started_utc", ""),
        is_closed=journal.meta.get("closed") == "yes",
        training=journal.meta.get("training"),
        simulated=simulated_in(journal.meta),
        unread=tuple(unread or ()),
    )


def _stopped(journal: OpenJournal, unread: list[str] | None) -> tuple[float, float] | None:
    """Return where a valve was open for the last time."""
    try:
        row = journal.connection.execute(
            "SELECT geom FROM applied WHERE duty > 0 AND geom IS NOT NULL "
            "ORDER BY sequence DESC LIMIT 1"
        ).fetchone()
        if row is None:
            return None
        places = shapely.get_coordinates(shapely.from_wkb(wkb_of(row[0])))
        ((longitude_deg, latitude_deg),) = places
    except (*DAMAGE, shapely.errors.ShapelyError) as error:
        if unread is None:
            raise
        unread.append(f"where the spraying stopped: {one_line(error)}")
        return None
    return float(latitude_deg), float(longitude_deg)


def is_journal(path: Path) -> bool:
    """Return whether a file is a journal, and no map; what cannot be read is none."""
    if path.suffix.lower() != ".gpkg" or not path.is_file():
        return False
    # Without locks or a look at the log beside it: what makes it a journal is never changed.
    uri = f"{path.resolve().as_uri()}?immutable=1"
    try:
        with closing(sqlite3.connect(uri, uri=True)) as connection:
            distrust(connection, path.stat().st_size)
            sql = "SELECT 1 FROM meta WHERE key = 'journal_version'"
            return connection.execute(sql).fetchone() is not None
    except (sqlite3.Error, OSError):
        return False


def rest_of(field: BaseGeometry, coverage: Coverage, strip_m: float) -> MultiPolygon:
    """Return the ground of a field that is not treated yet, as wide as half a strip or wider.

    What is narrower is no valve's work: the margin that a strict border leaves, the noise of a
    position between two passes.
    """
    # The steps of the raster are no shape of the ground.
    treated = polygons(coverage).simplify(CELL_M)
    bare = field.difference(treated)
    thin_m = 0.25 * strip_m
    core = bare.buffer(-thin_m, join_style="mitre")
    return as_polygons(core.buffer(thin_m, join_style="mitre").intersection(bare))


def treated_by(
    paths: Sequence[Path], frame: LocalFrame, *, training: str = "no", takes_unmarked: bool = False
) -> Coverage:
    """Return what all these flights treated, in another flight's frame.

    A flight with water, or a simulated one, treated nothing for one with a product, and the other
    way round. What says nothing of it counts only where somebody vouches for it.
    """
    whole = Coverage()
    for path in paths:
        try:
            found = read_treated_ground(path)
        except UnreadableError as error:
            # For a start it is a wrong input: exit 2, which no service tries again.
            raise JournalError(str(error)) from error
        if found.training is None and not takes_unmarked:
            raise JournalError(
                f"{path}: does not say whether a product was sprayed: an old journal, or one of a "
                "simulation; leave it out, or vouch for it with --continue-unmarked"
            )
        if found.training not in (None, training):
            raise JournalError(
                f"{path}: was flown with training = {found.training}, this flight has {training}: "
                "it treated nothing; leave it out"
            )
        whole = whole.joined(moved(found.coverage, found.frame, frame))
    return replace(whole, ahead_s=0.0)


def simulated_lines(paths: Sequence[Path]) -> list[str]:
    """Return which of the flights that another goes on from were no flights."""
    found = []
    for path in paths:
        with opened(path) as journal:
            if simulated_in(journal.meta).is_simulated:
                found.append(
                    f"WARNING: {path} was SIMULATED: its ground was never treated, and the valves "
                    "close over it all the same; leave it out unless this is a simulation too"
                )
    return found


def continued(
    setup: Setup,
    paths: Sequence[Path],
    *,
    training: str = "no",
    takes_unmarked: bool = False,
    by_default: bool = False,
) -> Setup:
    """Return the set-up of a flight that goes on where these ended: nothing is sprayed twice.

    With `by_default` the guard of the set-up is nobody's choice. That of a plan's lines closes over
    strips that are treated wholly, and lines that are flown again lie some centimetres aside.
    """
    if not paths:
        return setup
    guard = None if by_default else setup.overlap
    guard = guard or OverlapGuard(switch_off_percent=SWITCH_OFF_PERCENT)
    treated = treated_by(paths, setup.frame, training=training, takes_unmarked=takes_unmarked)
    return replace(setup, overlap=guard, treated=treated)


# Which earlier flight left ground of this map untreated: for whoever forgets to go on with it.

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
    mark: str = ""


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
    return Unfinished(
        path=found.path,
        left_share=left_m2 / field.area,
        left_ha=left_m2 / 10_000.0,
        mark=" (SIMULATED)" if found.simulated.is_simulated else "",
    )
