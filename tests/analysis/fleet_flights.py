"""Journals for tests of fleets: one short flight, copied with other starts, places and people."""

from __future__ import annotations

import json
import shutil
import sqlite3
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

from companion.simulated import SIMULATED
from tests.analysis.report_flight import EU_TOLD

TOLD: Mapping[str, object] = {
    **EU_TOLD,
    "application.aircraft": "T40 ES-1",
    "application.field_name": "North",
}


def copied(source: Path, target: Path, meta: Mapping[str, str] | None = None, **told: Any) -> Path:
    """Copy a journal as that of another flight: `meta` is changed, `told` for the record too."""
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, target)
    changes = dict(meta or {})
    if told:
        said = {f"application.{key}": value for key, value in told.items()}
        changes["application_json"] = json.dumps({**TOLD, **said})
    change(target, changes)
    return target


def change(path: Path, meta: Mapping[str, str], *statements: str) -> None:
    """Change what a journal says of itself."""
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        for key, value in meta.items():
            connection.execute("DELETE FROM meta WHERE key = ?", (key,))
            connection.execute("INSERT INTO meta (key, value) VALUES (?, ?)", (key, value))
        for statement in statements:
            connection.execute(statement)


def started(day: int, month: int = 5) -> dict[str, str]:
    """Return what `meta` says of a flight that began on a day of 2026, at noon by UTC."""
    text = f"2026-{month:02d}-{day:02d}T12:00:00.{day:06d}+00:00"
    return {
        "started_utc": text,
        "utc_offset_s": repr(_utc_s(day, month)),
        "utc_source": "autopilot",
    }


def _utc_s(day: int, month: int) -> float:
    # 1 January 2026 began at 1,767,225,600 s; the flight's own clock shows 100 s at its start.
    days = (0, 31, 59, 90, 120, 151, 181, 212, 243, 273, 304, 334)[month - 1] + day - 1
    return 1_767_225_600.0 + 86_400.0 * days + 43_200.0 - 100.0


def earlier(source: Path, target: Path) -> Path:
    """Copy a journal as it was before its flight ended: without its last second, not closed."""
    shutil.copyfile(source, target)
    change(
        target,
        {"closed": "no"},
        "DELETE FROM meta WHERE key LIKE 'rows_%'",
        "DELETE FROM blocks WHERE first_sequence = (SELECT max(first_sequence) FROM blocks)",
    )
    return target


def damaged(source: Path, target: Path) -> Path:
    """Copy a journal of which a page was overwritten."""
    content = bytearray(source.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 6000] = b"\x5a" * 6000
    target.write_bytes(content)
    return target


def simulated(source: Path, target: Path, day: int) -> Path:
    """Copy a journal as that of a simulation."""
    return copied(source, target, {**started(day), SIMULATED: "yes", "training": "simulated"})
