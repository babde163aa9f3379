"""Questions to a fleet in SQL, and their answers' tables as files and as lines.

By DuckDB: read only, and with no way out of the data set. It opens no file and no address itself:
it is handed the files' rows, and then locked. What a query may do is to compute, within its memory.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from datetime import date, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import duckdb
import pyarrow as pa
import pyarrow.csv as pa_csv
import pyarrow.parquet as pq

from analysis.fleet.store import DAMAGED_SCHEMA, STORE_ERRORS, TRIES
from companion.atomic_write import write_atomically
from companion.csv_table import cell
from companion.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Callable

    from analysis.fleet.store import Store

MEMORY_MB = 300
_SETTINGS: dict[str, str | int | float | list[str]] = {
    "autoinstall_known_extensions": False,
    "autoload_known_extensions": False,
    "python_enable_replacements": False,
    "temp_directory": "",
}
_LOCKED = (
    "SET TimeZone = 'UTC'",
    "SET enable_external_access = false",
    "SET lock_configuration = true",
)
_READING = ("SELECT", "EXPLAIN")
_VIEWS = (
    "CREATE VIEW closings AS SELECT flight_id, kind, month, machine, field, product, operator, "
    "each.reason, each.count, each.seconds FROM flights, UNNEST(closings) AS t(each)",
    "CREATE VIEW faults AS SELECT flight_id, kind, month, machine, field, product, operator, "
    "each.kind AS fault, each.count FROM flights, UNNEST(faults) AS t(each)",
    "CREATE VIEW valves AS SELECT flight_id, kind, month, machine, started_utc, each.valve, "
    "each.flow_factor FROM flights, UNNEST(valves) AS t(each)",
)
_TABLES = "flights, closings, faults, valves, damaged"
# Two writers at once left a flight in two files, or in two months.
_NEWEST = " QUALIFY row_number() OVER (PARTITION BY flight_id ORDER BY record_version DESC) = 1"


class Fleet:
    """A fleet's flights, open for questions."""

    def __init__(self, store: Store, connection: duckdb.DuckDBPyConnection) -> None:
        self.store, self._connection = store, connection

    def rows(self, sql: str, *values: Any) -> list[dict[str, Any]]:
        """Return the answer to a question of our own."""
        found = self._connection.sql(sql, params=list(values))
        rows: list[dict[str, Any]] = _plain(found.to_arrow_table()).to_pylist()
        return rows

    def ask(self, sql: str) -> pa.Table:
        """Return the answer to anybody's question; a ConfigError for one that is none."""
        try:
            statements = self._connection.extract_statements(sql)
            if len(statements) != 1 or statements[0].type.name not in _READING:
                raise ConfigError("SQL: give one query, such as SELECT count(*) FROM flights")
            return _plain(self._connection.sql(sql).to_arrow_table())
        except duckdb.OutOfMemoryException as error:
            raise ConfigError(
                "SQL: the query needs too much memory; allow more with --memory-mb"
            ) from error
        except duckdb.Error as error:
            text = _line(error)
            if "Table with name" in text:  # DuckDB's guesses are tables of its own
                text = f"{text.partition('Did you mean')[0].rstrip(' !')}; the tables: {_TABLES}"
            raise ConfigError(f"SQL: {text}") from error


@contextmanager
def asked(store: Store, *, memory_mb: int = MEMORY_MB) -> Iterator[Fleet]:
    """Open a fleet for questions."""
    for _ in range(TRIES - 1):
        # A file that was listed is gone: a writer has joined it with others meanwhile.
        with suppress(FileNotFoundError):
            connection = _connected(store, memory_mb)
            break
    else:
        connection = _connected(store, memory_mb)
    with closing(connection):
        try:
            yield Fleet(store, connection)
        except STORE_ERRORS as error:
            raise store.refused(error) from error


def _connected(store: Store, memory_mb: int) -> duckdb.DuckDBPyConnection:
    connection = duckdb.connect(":memory:", config={**_SETTINGS, "memory_limit": f"{memory_mb}MB"})
    try:
        dataset = store.dataset()
        numbers = dataset.to_table(["flight_id"])["flight_id"]
        is_doubled = len(numbers.unique()) != len(numbers)
        connection.register("stored", dataset)
        connection.register("stored_damaged", pa.Table.from_pylist(store.damaged(), DAMAGED_SCHEMA))
        once = _NEWEST if is_doubled else ""
        connection.execute(f"CREATE VIEW flights AS SELECT * EXCLUDE (ground) FROM stored{once}")
        connection.execute("CREATE VIEW damaged AS SELECT * FROM stored_damaged")
        for sql in (*_VIEWS, *_LOCKED):
            connection.execute(sql)
    except BaseException:
        connection.close()
        raise
    return connection


def _plain(table: pa.Table) -> pa.Table:
    """Return a table without decimals: DuckDB's sums of whole numbers are some."""
    columns = [
        column.cast(pa.int64() if column.type.scale == 0 else pa.float64())
        if pa.types.is_decimal(column.type)
        else column
        for column in table.columns
    ]
    return pa.table(columns, names=table.column_names)


def _line(error: Exception) -> str:
    """Return what DuckDB says in one line, without the picture of where it stands."""
    lines = [each.strip() for each in str(error).splitlines() if each.strip()]
    kept = [each for each in lines if not each.startswith(("LINE ", "^"))]
    return " ".join(kept)[:400] or type(error).__name__


# ------------------------------------------------------------------------ the table of an answer

ROWS_SHOWN, WIDTH_MAX = 200, 44


def rows_of(table: pa.Table) -> list[dict[str, Any]]:
    """Return rows as JSON has them: times as text."""
    return [{key: _as_json(value) for key, value in row.items()} for row in table.to_pylist()]


def _as_json(value: Any) -> Any:
    if isinstance(value, datetime | date):
        return value.isoformat()
    if isinstance(value, dict):
        return {str(key): _as_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_as_json(item) for item in value]
    return value if value is None or isinstance(value, str | int | float | bool) else str(value)


def csv_of(table: pa.Table) -> bytes:
    """Return a table as CSV; what is a list in it is JSON in its cell."""
    columns = [
        column
        if pa.types.is_primitive(column.type)
        else pa.array(
            cell(json.dumps(_as_json(each)) if isinstance(each, list | dict) else each)
            for each in column.to_pylist()
        )
        for column in table.columns
    ]
    sink = io.BytesIO()
    names = [str(cell(name)) for name in table.column_names]
    pa_csv.write_csv(pa.table(columns, names=names), sink)
    return sink.getvalue()


def parquet_of(table: pa.Table) -> bytes:
    """Return a table as Parquet."""
    sink = io.BytesIO()
    pq.write_table(table, sink, compression="zstd")
    return sink.getvalue()


def json_of(table: pa.Table) -> bytes:
    """Return a table as a JSON list of objects."""
    return (json.dumps(rows_of(table), indent=1) + "\n").encode()


_FORMATS: dict[str, Callable[[pa.Table], bytes]] = {
    ".csv": csv_of,
    ".parquet": parquet_of,
    ".json": json_of,
}


def check_out(path: Path) -> None:
    """Refuse a file that no table can become, before any work is done for it."""
    if path.suffix.lower() not in _FORMATS:
        raise ConfigError(f"--out {path}: no such format; end its name in .csv, .parquet or .json")
    if not path.parent.is_dir():
        raise ConfigError(f"--out {path}: its folder is not there; make it, or name another")


def write_table(path: Path, table: pa.Table) -> None:
    """Write a table in the format of the file's name."""
    try:
        write_atomically(path, _FORMATS[path.suffix.lower()](table))
    except (OSError, pa.ArrowException) as error:
        reason = (getattr(error, "strerror", None) or str(error)).lower()
        raise ConfigError(f"--out {path}: {reason}; name a file that can be written") from error


def lines_of(table: pa.Table) -> Iterator[str]:
    """Yield a table for a person."""
    shown = table.slice(0, ROWS_SHOWN)
    is_number = [_is_number(column.type) for column in shown.columns]
    cells = [[_cell(each) for each in column.to_pylist()] for column in shown.columns]
    widths = [
        max(len(name), *(len(each) for each in column), 0)
        for name, column in zip(table.column_names, cells, strict=True)
    ]
    yield _row_line(table.column_names, widths, is_number)
    for row in zip(*cells, strict=True):
        yield _row_line(row, widths, is_number)
    if len(table) > len(shown):
        yield f"({len(table) - len(shown)} more rows; --out FILE writes all)"


def _is_number(kind: pa.DataType) -> bool:
    return bool(
        pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_decimal(kind)
    )


def _row_line(cells: Any, widths: list[int], is_number: list[bool]) -> str:
    parts = (
        cell.rjust(width) if right else cell.ljust(width)
        for cell, width, right in zip(cells, widths, is_number, strict=True)
    )
    return "  ".join(parts).rstrip()


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, datetime):
        return value.strftime("%Y-%m-%d %H:%M:%S")
    text = value if isinstance(value, str) else json.dumps(_as_json(value))
    text = "".join(each if each.isprintable() else " " for each in text)
    return text if len(text) <= WIDTH_MAX else f"{text[: WIDTH_MAX - 3]}..."
