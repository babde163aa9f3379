"""The tables of a journal, from the statements that make them."""

from __future__ import annotations

import sqlite3
from contextlib import closing

from companion.journal.geopackage import SCHEMA
from companion.journal.reader import JOURNAL_VERSION

INTRODUCTION = f"""# Journal tables

A journal is a [GeoPackage](https://www.geopackage.org), version {JOURNAL_VERSION} of our format: an SQLite
database that QGIS, GDAL and `sqlite3` open. [The flight record](../explanation/flight-record.md) explains
it. Open it after the flight; while the flight writes it, it is locked.

`time_s` is the companion's monotonic clock. `time` is UTC by the autopilot's clock; `utc_source` in `meta`
says `computer` where the autopilot never told. `zones` and `field` lie in the flight's own frame, metres
east and north of its origin, which the file defines.
"""
TABLES: dict[str, str] = {
    "applied": "points, ten a second and at each change of the reasons not to spray or of the state",
    "zones": "the zones of the prescription, as flown (polygons)",
    "field": "where spraying was allowed (polygons)",
    "valve_changes": "each change of a valve's duty. `valve_changes` in `meta` is `orders` where an output says "
    "when it gave each order, `plans` where none does",
    "link_stats": "how the link did, once a second",
    "coverage_tiles": "treated ground, in tiles of 64 x 64 cells of 0.2 m",
    "events": "what else happened",
    "blocks": "a second of inputs and decisions in each row: lines of JSON, packed (`companion/journal/rows.py`, "
    "`analysis/journals/unpacking.py`)",
    "block_dictionaries": "preset dictionaries for unpacking the blocks",
    "meta": "facts about the flight, each with a key",
}
COLUMNS: dict[str, str] = {
    "applied.geom": "position of the vehicle, WGS84",
    "applied.rate_l_ha": "mean of the valves' prescribed rates; empty: none",
    "applied.target_flow_l_min": "flow that the prescription asks for",
    "applied.flow_l_min": "flow that the ordered duties stand for; not measured",
    "applied.duty": "mean duty cycle",
    "applied.inhibits": "reasons not to spray",
    "applied.valve_rates_l_ha": "one value a valve; one alone where all are the same",
    "valve_changes.planned_us": "when the plan wanted it; empty where no plan did (a fault, the end)",
    "valve_changes.actual_us": "when the output gave the order; empty where no output says",
    "valve_changes.valve": "0 is the first",
    "valve_changes.duty_permille": "thousandths of fully open",
    "link_stats.refused_frames": "refused for their signature",
    "link_stats.lost_percent": "missing, by the frames' numbers",
    "link_stats.round_trip_s": "shortest TIMESYNC exchange",
    "coverage_tiles.kind": "`flight`: treated when it ended; `before`: brought by `--continue`",
    "coverage_tiles.tile_east": "number of the tile from the origin; a tile is 12.8 m wide",
    "coverage_tiles.cells": "a bit a cell, rows northwards, first bit of a byte in the west, deflated",
    "blocks.body": "inputs, deflated", "blocks.decisions": "decisions, deflated",
    "blocks.crc32": "of the lines of `body`", "blocks.decisions_crc32": "of the lines of `decisions`",
    "blocks.dictionary": "`id` of the preset dictionary; empty: none",
}  # fmt: skip
META: dict[str, str] = {
    "journal_version": "version of the format",
    "closed": "`yes` after an orderly end, `recovered` after a cut, `salvaged` in a copy of a damaged file",
    "lost": "rows that are not in the file",
    "started_utc, started_s": "start of the flight, by UTC and by `time_s`",
    "utc_source, utc_offset_s": "`autopilot`, `autopilot-jumped` or `computer`; what to add to `time_s` for seconds since 1970",
    "training": "what was sprayed: `no` a product, `water`, `dry` nothing, `simulated` nothing",
    "simulated, simulated_because": "whether the flight was simulated: `yes`, `no` or `unknown`, and what told; absent in older journals",
    "applied_l": "litres that the ordered duties stand for",
    "rows_applied, rows_valve_changes": "how many rows these tables have, from the end of the flight on",
    "setup": "all that is constant in the flight, as JSON, with the names of the fields of every type",
    "map_sha256, calibration_sha256": "hash of the map; of nozzle sets, lags and PWM",
    "flight_map_json": "the flight map that was flown: hash, age, sources, findings",
    "config_path, config_toml, config_overrides": "the configuration of `vrspray run`",
    "application_json": "who sprayed what",
    "declared_json": "what the operator declared on the page, and when",
    "coverage_ahead_s": "how far ahead the treated ground is written; 0 after an orderly end",
    "machine, python, version_NAME": "what computed the flight",
}
_KINDS = {
    "DOUBLE": "number",
    "INTEGER": "whole number",
    "BLOB": "bytes",
    "DATETIME": "UTC",
    "TEXT": "text",
}


def page() -> str:
    """Return the page; KeyError for a table that is not described."""
    parts = [INTRODUCTION]
    with closing(sqlite3.connect(":memory:")) as connection:
        connection.executescript(SCHEMA)
        listed = connection.execute(
            "SELECT name FROM sqlite_master WHERE type = 'table'"
        ).fetchall()
        names = [name for (name,) in listed if not name.startswith(("gpkg_", "sqlite_"))]
        for name in sorted(names, key=list(TABLES).index):
            parts.append(f"## {name}\n\n{TABLES[name][0].upper()}{TABLES[name][1:]}.\n")
            parts.append("| Column | Type | Meaning |\n|---|---|---|")
            for _, column, kind, *_ in connection.execute(f"PRAGMA table_info({name})"):
                meaning = COLUMNS.get(f"{name}.{column}", "")
                parts.append(f"| `{column}` | {_KINDS.get(kind, kind.lower())} | {meaning} |")
            parts.append("")
    parts.append("### Keys of meta\n\n| Key | Meaning |\n|---|---|")
    for keys, meaning in META.items():
        named = ", ".join(f"`{key}`" for key in keys.split(", "))
        parts.append(f"| {named} | {meaning} |")
    return "\n".join(parts)
