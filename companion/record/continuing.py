"""Going on after a refill, a change of battery or a cut: what earlier flights have treated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import shapely

from companion.core.controller import Setup
from companion.core.coverage import Coverage
from companion.core.frame import LocalFrame
from companion.core.overlap_guard import OverlapGuard
from companion.errors import JournalError
from companion.record.coverage_area import moved
from companion.record.coverage_table import read_coverage
from companion.record.geopackage import wkb_of
from companion.record.reader import OpenJournal, opened

# Where nothing else is configured, whoever goes on closes a valve that is more over treated ground
# than over bare: misses and doubles come out even.
SWITCH_OFF_PERCENT = 50.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Treated:
    """What one journal says of treated ground; `stopped` is (latitude, longitude)."""

    path: Path
    coverage: Coverage
    frame: LocalFrame
    setup: Setup
    stopped: tuple[float, float] | None
    is_closed: bool
    training: str | None


def read_treated_ground(path: Path) -> Treated:
    """Return what was treated when a flight ended, by it and before it.

    JournalError where the file cannot be used or keeps no coverage.
    """
    with opened(path) as journal:
        coverage = read_coverage(journal.connection)
        if coverage is None:
            raise JournalError(
                f"{path}: keeps no treated ground: coverage.record was false, or an older version "
                "wrote it"
            )
        setup = journal.setup()
        return Treated(
            path=path,
            coverage=coverage,
            frame=setup.frame,
            setup=setup,
            stopped=_stopped(journal),
            is_closed=journal.meta.get("closed") == "yes",
            training=journal.meta.get("training"),
        )


def _stopped(journal: OpenJournal) -> tuple[float, float] | None:
    """Return where a valve was open for the last time."""
    row = journal.connection.execute(
        "SELECT geom FROM applied WHERE duty > 0 AND geom IS NOT NULL "
        "ORDER BY sequence DESC LIMIT 1"
    ).fetchone()
    if row is None:
        return None
    ((longitude_deg, latitude_deg),) = shapely.get_coordinates(shapely.from_wkb(wkb_of(row[0])))
    return float(latitude_deg), float(longitude_deg)


def treated_by(paths: Sequence[Path], frame: LocalFrame, *, training: str = "no") -> Coverage:
    """Return what all these flights treated, in another flight's frame.

    A flight with water treated nothing for one with a product, and the other way round.
    """
    whole = Coverage()
    for path in paths:
        found = read_treated_ground(path)
        if (found.training or "no") != training:
            raise JournalError(
                f"{path}: was flown with training = {found.training}, this flight has {training}: "
                "it treated nothing; leave it out"
            )
        whole = whole.joined(moved(found.coverage, found.frame, frame))
    return replace(whole, ahead_s=0.0)


def continued(setup: Setup, paths: Sequence[Path], *, training: str = "no") -> Setup:
    """Return the set-up of a flight that goes on where these ended: nothing is sprayed twice."""
    if not paths:
        return setup
    guard = setup.overlap or OverlapGuard(switch_off_percent=SWITCH_OFF_PERCENT)
    treated = treated_by(paths, setup.frame, training=training)
    return replace(setup, overlap=guard, treated=treated)
