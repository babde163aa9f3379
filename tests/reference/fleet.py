"""The tables of a fleet, from the code that writes them."""

from __future__ import annotations

from analysis.fleet.row import COLUMNS
from analysis.fleet.summary import FIGURES

INTRODUCTION = """# Fleet tables

What `vrspray fleet query` asks ([how](../howto/keep-a-fleet.md)): one row of `flights` for each flight, and beside it

| Table | Columns |
|---|---|
| `closings` | `flight_id`, `kind`, `month`, `machine`, `field`, `product`, `operator`, `reason`, `count`, `seconds` |
| `faults` | the same seven, `fault`, `count` |
| `valves` | `flight_id`, `kind`, `month`, `machine`, `started_utc`, `valve`, `flow_factor` |
| `damaged` | `journal`, `journal_sha256`, `flight_id`, `problem`: journals that gave no row |

SQL is that of [DuckDB](https://duckdb.org/docs/stable/sql/introduction). A query reads only these tables: no file, no network, no
extension. It takes 300 MB at most, or `--memory-mb`.

The files are Parquet, `flights/kind=KIND/month=MONTH/part-HASH.parquet`, which any other program reads. Nothing is locked: a
writer puts down a new file and then removes those that it read. Two writers at once leave a flight in two files; of rows with
the same `flight_id` the one with the last `record_version` counts. `forgotten/` holds a hash for each operator who was removed.
"""


def page() -> str:
    """Return the page."""
    parts = [INTRODUCTION, "## flights\n\n| Column | Type | Meaning |\n|---|---|---|"]
    types = {"closings": "list", "faults": "list", "valves": "list"}
    parts += [
        f"| `{each.name}` | {types.get(each.type, each.type)} | {each.meaning} |"
        for each in COLUMNS
    ]
    parts.append(
        "\nColumns from `within_10_percent` to `worst_lag_m`, and `modelled_l` to `flow_drift_percent`, are empty until "
        "the flight is evaluated. An operator's number is a hash of the name: no name is kept, but who knows a name can find its "
        "number.\n\n## Figures of the report\n\n| Figure | Meaning |\n|---|---|"
    )
    parts += [f"| `{each.name}` | {each.meaning} |" for each in FIGURES]
    return "\n".join(parts)
