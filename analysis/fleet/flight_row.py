"""One journal as one row of the fleet: what it says of itself, and the report's figures.

A row is made in two steps. `recorded` takes what the journal's tables hold already, in some 9 ms
whatever was flown; `evaluated` adds what `vrspray report` says, which takes two thirds of a
millisecond for each second of flight. Names of people are not in a row: an operator is a number.
"""

from __future__ import annotations

import hashlib
import math
import sqlite3
from collections import Counter, defaultdict
from collections.abc import Callable, Container, Mapping
from dataclasses import replace
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

from shapely.errors import ShapelyError

from analysis.assess.assessment import essentials_of, figures_of
from analysis.fleet.row import (
    COLUMNS,
    STATES,
    Problem,
    Row,
    operator_number,
    versioned,
)
from analysis.flown.applied_record import EvaluationError
from analysis.flown.holes import GAP_S
from analysis.flown.read_applied import OFFSET_S_MAX, flight_of
from analysis.journals.content import damages
from analysis.journals.jobs import Sortie
from analysis.report.legal_fields import told_in
from companion.core.setup import Setup
from companion.errors import JournalError, UnreadableError
from companion.journal.coverage import read_coverage, read_treated
from companion.journal.read_only import DAMAGE, log_of, one_line
from companion.journal.reader import NoJournalError, OpenJournal, opened
from companion.journal.writer import applied_l
from companion.simulated import simulated_in

_M2_PER_HA = 10_000.0
_PIECE_BYTES = 1 << 20
_FAULT = "fault-"
# What a file that is a stranger's says, and one of ours that lost its beginning as well.
_NO_JOURNAL = "this is not a journal"
_SQLITE = b"SQLite format 3\0"


def flight_id_of(meta: Mapping[str, str]) -> str:
    """Return what identifies a flight in every copy of its journal; KeyError where that is gone.

    The start to the microsecond, the clock then, the computer, and all that was constant: copies,
    recovered and salvaged ones have the same.
    """
    facts = [meta[key] for key in ("started_utc", "started_s", "setup")]
    facts += [meta.get(key, "") for key in ("platform", "flight", "map_sha256")]
    return hashlib.sha256("\0".join(facts).encode()).hexdigest()[:20]


def sha256_of(path: Path) -> str:
    """Return the hash of a journal, with the log that a cut left beside it."""
    found = hashlib.sha256()
    for each in (path, log_of(path)):
        if each.is_file():
            with each.open("rb") as file:
                while piece := file.read(_PIECE_BYTES):
                    found.update(piece)
    return found.hexdigest()


def recorded(
    path: Path, *, machine: str | None = None, known: Container[str] = ()
) -> Row | Problem | str:
    """Return what a journal's tables hold as a row, or why there is none.

    Of a journal whose hash is among the `known` ones only that.
    """
    return _read(path, machine, lambda _journal, _setup, row: row, known=known)


def _read(
    path: Path,
    machine: str | None,
    finish: Callable[[OpenJournal, Setup, Row], Row],
    *,
    known: Container[str] = (),
    row: Row | None = None,
) -> Row | Problem | str:
    """Return what `finish` makes of the row of a journal, which is open meanwhile.

    A `row` is that of the same file, found sound a moment ago.
    """
    digest = ""
    flight_id = None
    try:
        if row is not None:
            with opened(path, is_lenient=True) as journal:
                return finish(journal, _setup_of(journal), row)
        if path.is_file() and (digest := sha256_of(path)) in known:
            return digest
        with opened(path, is_lenient=True) as journal:
            flight_id = flight_id_of(journal.meta) if "setup" in journal.meta else None
            unread = [*journal.unread, *damages(journal.connection)]
            if unread:
                return Problem(
                    path=path,
                    text=f"is damaged: {'; '.join(unread)}; vrspray flights recover copies what "
                    "can be read",
                    is_damaged=True,
                    journal_sha256=digest,
                    flight_id=flight_id,
                )
            setup = _setup_of(journal)
            return finish(journal, setup, _row(journal, setup, digest, machine))
    except (JournalError, ShapelyError, *DAMAGE) as error:
        is_damaged = isinstance(error, UnreadableError) or not isinstance(error, JournalError)
        text = str(error).removeprefix(f"{path}: ")
        if text.startswith(_NO_JOURNAL) and _is_cut_to_nothing(path):
            is_damaged, text = True, f"{_NO_JOURNAL}: nothing of it was written to the disk"
        return Problem(
            path=path,
            text=text if isinstance(error, JournalError) else f"is damaged: {text}",
            is_damaged=is_damaged,
            is_other=isinstance(error, NoJournalError) and not is_damaged,
            journal_sha256=digest,
            flight_id=flight_id,
        )


# Flights over the same map have the same set-up, and what is worked out of it: zones, edges, areas.
_SETUPS_MAX = 4
_GROUND = (
    "SELECT name, rate_l_ha, geom FROM zones ORDER BY id",
    "SELECT geom FROM field",
    "SELECT * FROM cells",
)
_setups: dict[bytes, Setup] = {}


def _setup_of(journal: OpenJournal) -> Setup:
    """Return a journal's set-up: that of one before it, where text and ground are the same bytes.

    What earlier flights treated is each journal's own.
    """
    try:
        found = hashlib.sha256(journal.meta["setup"].encode())
        for sql in _GROUND:
            if sql is not _GROUND[-1] or _has_cells(journal.connection):
                for row in journal.connection.execute(sql):
                    for value in row:
                        raw = value if isinstance(value, bytes) else repr(value).encode()
                        found.update(b"%d:" % len(raw))
                        found.update(raw)
    except DAMAGE:
        return journal.setup()
    known = _setups.pop(found.digest(), None)
    if known is None:
        setup = journal.setup()
        known = setup if setup.treated is None else replace(setup, treated=None)
    else:
        treated = read_treated(journal.connection)
        setup = known if treated is None else replace(known, treated=treated)
    _setups[found.digest()] = known
    if len(_setups) > _SETUPS_MAX:
        del _setups[next(iter(_setups))]
    return setup


def _has_cells(connection: sqlite3.Connection) -> bool:
    sql = "SELECT 1 FROM sqlite_master WHERE name = 'cells'"
    return connection.execute(sql).fetchone() is not None


def _is_cut_to_nothing(path: Path) -> bool:
    """Return whether a power cut left only the name: no byte, zeros, or not even a whole header."""
    if path.suffix != ".gpkg":
        return False
    with path.open("rb") as file:
        first = file.read(len(_SQLITE))
        return _SQLITE.startswith(first) or not any(
            piece.strip(b"\0") for piece in (first, *iter(lambda: file.read(_PIECE_BYTES), b""))
        )


def evaluated(
    path: Path, *, machine: str | None = None, row: Row | None = None
) -> Row | Problem | str:
    """Return a journal's row with the figures of its report, or why there is none.

    `row` is what `recorded` made of it, where the file is still the same.
    """
    return _read(path, machine, _evaluated, row=row)


def _evaluated(journal: OpenJournal, setup: Setup, row: Row) -> Row:
    found = {**row, "is_evaluated": True, "evaluated_with": _own_version()}
    unread: list[str] = []
    try:
        flight = flight_of(journal, setup, unread)
        assessment = essentials_of(flight, marked=row["job"] is not None)
    except (EvaluationError, JournalError, ShapelyError, *DAMAGE) as error:
        # One strange flight is no reason to lose the others.
        found["why_not_evaluated"] = one_line(error).removeprefix(f"{journal.path}: ")
        return versioned(found)
    is_whole = not (unread or flight.lost)
    if not is_whole and not assessment.evaluation.applied_ml > 0.0:
        found["why_not_evaluated"] = "too little of the journal can be read"
        return versioned(found)
    figures = figures_of(assessment, area_ha=assessment.ground.treated_m2 / 1e4, is_whole=is_whole)
    evaluation = assessment.evaluation
    found |= {
        "area_ha": figures.area_ha,
        "own_area_ha": figures.area_ha,
        "applied_l": figures.applied_l,
        "applied_by": figures.applied_by,
        "modelled_l": assessment.balance.model_l,
        "prescribed_l": figures.prescribed_l,
        "flow_drift_percent": assessment.balance.meter_to_model_percent,
        "within_10_percent": figures.within_10_percent,
        "missed_m2": figures.missed_m2,
        "doubled_m2": figures.doubled_m2,
        "own_doubled_m2": figures.doubled_m2,
        "untreated_m2": figures.untreated_m2,
        "outside_ml": figures.outside_ml,
        "changes": figures.lag_count,
        "missed_changes": evaluation.missed,
        "apart_changes": evaluation.apart,
        "mean_lag_m": figures.mean_lag_m,
        "worst_lag_m": figures.worst_m,
        "ground": assessment.ground.marks if is_whole else None,
    }
    return versioned(found)


def _row(journal: OpenJournal, setup: Setup, digest: str, machine: str | None) -> Row:
    meta, connection = journal.meta, journal.connection
    told, simulated = told_in(meta), simulated_in(meta)
    training = meta.get("training")
    began_s, ended_s, entries = _extent(journal)
    started = _started(meta, began_s)
    flown = _flown(connection)
    row: Row = dict.fromkeys(each.name for each in COLUMNS)
    row |= {
        "flight_id": flight_id_of(meta),
        "kind": _kind(simulated.word, training),
        "month": "unknown" if started is None else started.strftime("%Y-%m"),
        "journal": journal.path.name,
        "journal_sha256": digest,
        "journal_state": STATES[meta["closed"]],
        "entries": entries,
        "lost_rows": int(meta["lost"]),
        "is_evaluated": False,
        "machine": told.get("application.aircraft") or machine,
        "job": Sortie(path=journal.path, meta=meta).job,
        "field": told.get("application.field_name") or told.get("application.parcel"),
        "product": told.get("product.name"),
        "operator": _operator(told),
        "crop": told.get("application.crop"),
        "training": training,
        "simulated": simulated.word,
        "started_utc": started,
        "utc_source": meta["utc_source"],
        "duration_s": None if began_s is None or ended_s is None else ended_s - began_s,
        "spraying_s": flown.spraying_s,
        "latitude_deg": round(setup.frame.latitude_deg, 4),
        "longitude_deg": round(setup.frame.longitude_deg, 4),
        "field_ha": float(setup.prescription.field.area) / _M2_PER_HA,
        "area_ha": _treated_ha(connection),
        "applied_l": applied_l(connection, meta),
        "applied_by": "orders",
        "link_lost_percent": _link_lost(connection),
        "closings": flown.closings,
        "faults": _faults(connection),
        "valves": [
            {"valve": each.name, "flow_factor": each.flow_factor} for each in setup.boom.valves
        ],
        "map_sha256": meta.get("map_sha256") or None,
        "calibration_sha256": meta.get("calibration_sha256"),
        "method": meta.get("method"),
        "flown_with": meta.get("version_vrspray"),
        "evaluated_with": _own_version(),
    }
    return versioned(row)


@cache
def _own_version() -> str:
    return version("vrspray")


def _kind(simulated: str, training: str | None) -> str:
    """Return which flights this one stands with: nothing but product on a field is real.

    >>> _kind("no", "no"), _kind("no", "water"), _kind("unknown", "no"), _kind("yes", "no")
    ('real', 'training', 'unknown', 'simulated')
    """
    if simulated == "yes":
        return "simulated"
    if training in ("water", "dry"):
        return "training"
    return "real" if simulated == "no" and training == "no" else "unknown"


def _operator(told: Mapping[str, Any]) -> str | None:
    for key in ("application.operator", "application.pilot", "application.licence"):
        if told.get(key):
            return operator_number(str(told[key]))
    return None


def _extent(journal: OpenJournal) -> tuple[float | None, float | None, int]:
    """Return first and last time of a record, and how far its numbers go."""
    sql = (
        "SELECT min(time_s), max(time_s), max(sequence) FROM records"
        if journal.version == "1"
        else "SELECT min(from_s), max(until_s), max(last_sequence) FROM blocks"
    )
    began_s, ended_s, last = journal.connection.execute(sql).fetchone()
    (other,) = journal.connection.execute("SELECT max(sequence) FROM events").fetchone()
    return began_s, ended_s, max(last or 0, other or 0)


def _started(meta: Mapping[str, str], began_s: float | None) -> datetime | None:
    """Return the start by the best clock that the flight had; None where it is not a time."""
    offset_s = float(meta["utc_offset_s"])
    at_s = (float(meta["started_s"]) if began_s is None else began_s) + offset_s
    if not (math.isfinite(at_s) and 0.0 <= at_s <= OFFSET_S_MAX):
        return None
    return datetime.fromtimestamp(at_s, UTC)


class _Flown(NamedTuple):
    spraying_s: float
    closings: list[Row]


def _flown(connection: sqlite3.Connection) -> _Flown:
    """Return how long valves were open, and by which reasons they were closed.

    A closing lasts until no reason is left. Reasons that stand while no valve is open, such as a
    vehicle that is not yet armed, close nothing.
    """
    spraying_s, was_open = 0.0, False
    before_s = -math.inf
    reasons: tuple[str, ...] = ()
    counts: Counter[str] = Counter()
    seconds: dict[str, float] = defaultdict(float)
    rows = connection.execute("SELECT time_s, duty, inhibits FROM applied ORDER BY sequence")
    for at_s, duty, inhibits in (row for row in rows if row[0] is not None):
        if was_open and 0.0 < at_s - before_s <= GAP_S:
            spraying_s += at_s - before_s
        for reason in reasons:
            seconds[reason] += at_s - before_s
        if not inhibits:
            reasons = ()
        elif was_open and not reasons:
            reasons = tuple(inhibits.split())
            counts.update(reasons)
        before_s, was_open = at_s, bool(duty and duty > 0.0)
    closings = [
        {"reason": reason, "count": counts[reason], "seconds": round(seconds[reason], 3)}
        for reason in sorted(counts)
    ]
    return _Flown(spraying_s, closings)


def _treated_ha(connection: sqlite3.Connection) -> float | None:
    """Return the ground that this flight treated and none before it, by the raster."""
    whole, before = read_coverage(connection), read_treated(connection)
    if whole is None:
        return None
    return (whole.area_m2 - (0.0 if before is None else before.area_m2)) / _M2_PER_HA


def _faults(connection: sqlite3.Connection) -> list[Row]:
    sql = "SELECT kind, count(*) FROM events WHERE kind LIKE 'fault-%' GROUP BY kind ORDER BY kind"
    return [
        {"kind": str(kind).removeprefix(_FAULT), "count": count}
        for kind, count in connection.execute(sql)
    ]


def _link_lost(connection: sqlite3.Connection) -> float | None:
    sql = "SELECT 1 FROM sqlite_master WHERE name = 'link_stats'"
    if connection.execute(sql).fetchone() is None:
        return None
    (lost,) = connection.execute("SELECT max(lost_percent) FROM link_stats").fetchone()
    return None if lost is None else float(lost)
