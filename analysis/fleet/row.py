"""A row of the fleet: its columns, which record of a flight counts, and what gave no row.

Nothing is read here: who has rows in hand need not load what they are made with.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

from companion.journal.read_only import log_of

Row = dict[str, Any]
Type = Literal[
    "text", "whole number", "number", "yes or no", "time", "closings", "faults", "valves"
]

# A row of another meaning is made anew by the next `fleet add`.
ROW_VERSION = 2
KINDS = ("real", "unknown", "training", "simulated")
# What a journal is worth beside another of the same flight; the end of the flight tells most.
STATES = {"no": "cut", "salvaged": "salvaged", "recovered": "recovered", "yes": "closed"}


class Column(NamedTuple):
    """A column of the table of flights."""

    name: str
    type: Type
    meaning: str


COLUMNS = (
    Column("flight_id", "text", "identifies the flight: start, set-up and computer, hashed"),
    Column("kind", "text", "`real`, `training` (water, dry), `simulated`, or `unknown`"),
    Column("month", "text", "of the start, UTC, as 2026-05; `unknown`: no clock was right"),
    Column("journal", "text", "name of the file"),
    Column("journal_sha256", "text", "its hash"),
    Column("journal_state", "text", "`closed`, `recovered`, `salvaged`, or `cut`"),
    Column("entries", "whole number", "inputs, decisions and events of the record"),
    Column("lost_rows", "whole number", "rows that the disk could not take"),
    Column("record_version", "text", "of two records of one flight the later in order counts"),
    Column("is_evaluated", "yes or no", "whether the figures of the report are in the row"),
    Column("why_not_evaluated", "text", "such as: nothing was sprayed"),
    Column("machine", "text", "`application.aircraft`, or what `--machine` said"),
    Column("job", "text", "id of the plan; its flights are sorties of one job"),
    Column("field", "text", "`application.field_name`, else the parcel"),
    Column("product", "text", "`product.name`"),
    Column("operator", "text", "a number made of the name; `fleet forget` removes it"),
    Column("crop", "text", "`application.crop`"),
    Column("training", "text", "`no` for a product, `water`, `dry`, `simulated`"),
    Column("simulated", "text", "`yes`, `no`, or `unknown`"),
    Column("started_utc", "time", "start of the record"),
    Column("utc_source", "text", "whose clock: `autopilot`, else `autopilot-jumped` or `computer`"),
    Column("duration_s", "number", "of the record"),
    Column("spraying_s", "number", "with a valve open"),
    Column("latitude_deg", "number", "of the field's origin, to 10 m"),
    Column("longitude_deg", "number", "of the field's origin, to 10 m"),
    Column("field_ha", "number", "area where spraying was allowed"),
    Column(
        "area_ha",
        "number",
        "ground treated, by the raster until the flight is evaluated; without what an earlier "
        "sortie of its job treated, so that sums are true",
    ),
    Column("own_area_ha", "number", "the same without regard to other sorties"),
    Column("applied_l", "number", "litres"),
    Column("applied_by", "text", "`flow meter`, `model`, `orders` (not evaluated), or `nothing`"),
    Column("modelled_l", "number", "litres by executed changes, curves and lags"),
    Column("prescribed_l", "number", "litres by the map, on the ground treated"),
    Column("flow_drift_percent", "number", "meter against model: wear, blocked nozzles, the meter"),
    Column(
        "within_10_percent",
        "number",
        "share of the ground under its passes that got its rate within 10 %",
    ),
    Column("missed_m2", "number", "under its passes, and left bare by all sorties of its job"),
    Column("doubled_m2", "number", "treated twice, by it or with an earlier sortie"),
    Column("own_doubled_m2", "number", "treated twice by this flight alone"),
    Column("untreated_m2", "number", "of the field with a rate, not treated in this flight"),
    Column("outside_ml", "number", "left the field or fell in an exclusion"),
    Column("changes", "whole number", "changes of rate whose lag was measured"),
    Column("missed_changes", "whole number", "changes of rate that never happened"),
    Column("apart_changes", "whole number", "changes of rate that cannot be measured"),
    Column("mean_lag_m", "number", "mean of the absolute lag distances"),
    Column("worst_lag_m", "number", "bound of the worst change (95 %)"),
    Column("link_lost_percent", "number", "messages of the autopilot that were lost"),
    Column("closings", "closings", "`reason`, `count`, `seconds`: what closed open valves"),
    Column("faults", "faults", "`kind`, `count`: what the fault detection found"),
    Column("valves", "valves", "`valve`, `flow_factor`: as measured by `calibrate valves`"),
    Column("map_sha256", "text", "of the map"),
    Column("calibration_sha256", "text", "of nozzle sets, lags and PWM"),
    Column("method", "text", "of the controller"),
    Column("flown_with", "text", "version of vrspray on board"),
    Column("evaluated_with", "text", "version of vrspray that made the row"),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Problem:
    """A file that gave no row, and why; `is_damaged`: it is a journal, `is_other`: it is none."""

    path: Path
    text: str
    is_damaged: bool
    is_other: bool = False
    journal_sha256: str = ""
    flight_id: str | None = None


def operator_number(name: str) -> str:
    """Return the number that stands for an operator; of a number, itself.

    >>> operator_number("A. Grower") == operator_number(" a.  grower ")
    True
    >>> operator_number("op-0123456789ab")
    'op-0123456789ab'
    """
    text = " ".join(name.split()).casefold()
    if len(text) == 15 and text.startswith("op-") and set(text[3:]) <= set("0123456789abcdef"):
        return text
    return f"op-{hashlib.sha256(f'operator {text}'.encode()).hexdigest()[:12]}"


class Signature(NamedTuple):
    """What says that a file, and the log beside it, did not change since it was read."""

    parts: tuple[tuple[int, int, int] | None, ...]

    @classmethod
    def of(cls, path: Path) -> Signature:
        """Return the signature of a journal."""
        parts: list[tuple[int, int, int] | None] = []
        for each in (path, log_of(path)):
            try:
                about = each.stat()
                parts.append((about.st_ino, about.st_size, about.st_mtime_ns))
            except OSError:
                parts.append(None)
        return cls(tuple(parts))


def versioned(row: Row) -> Row:
    """Return a row with its place among records of the same flight, as a text that sorts so."""
    state = list(STATES.values()).index(row["journal_state"])
    parts = (
        f"{row['entries']:012d}",
        str(state),
        f"{ROW_VERSION:04d}",
        str(int(row["machine"] is not None)),
        str(int(row["is_evaluated"])),
        row["journal_sha256"][:16],
    )
    return {**row, "record_version": ".".join(parts)}


def flown_by(row: Row, machine: str | None) -> Row:
    """Return a row with the machine that was named before, where its journal names none."""
    return row if row["machine"] is not None else versioned({**row, "machine": machine})


def newest(rows: Iterable[Row]) -> dict[str, Row]:
    """Return of each flight the record that counts, by its number."""
    found: dict[str, Row] = {}
    for row in rows:
        known = found.get(row["flight_id"])
        if known is None or known["record_version"] < row["record_version"]:
            found[row["flight_id"]] = row
    return found
