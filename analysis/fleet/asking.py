"""SQL over a fleet's flights, by DuckDB: read only, and with no way out of the data set.

DuckDB opens no file and no address itself: it is handed the files' rows, and then locked. What a
query may do is to compute, within its memory.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from typing import TYPE_CHECKING, Any

import duckdb
import pyarrow as pa

from analysis.fleet.store import DAMAGED_SCHEMA, STORE_ERRORS, TRIES
from companion.errors import ConfigError

if TYPE_CHECKING:
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
            raise ConfigError(f"SQL: {_line(error)}") from error


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
        connection.execute(
            f"CREATE VIEW flights AS SELECT * FROM stored{_NEWEST if is_doubled else ''}"
        )
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
