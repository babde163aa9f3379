"""Tables of a fleet as files and as lines: CSV, Parquet, JSON, and text."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from datetime import date, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow as pa
import pyarrow.csv as pa_csv
import pyarrow.parquet as pq

from companion.atomic_write import write_atomically
from companion.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Callable

ROWS_SHOWN, WIDTH_MAX = 200, 44


def rows_of(table: pa.Table) -> list[dict[str, Any]]:
    """Return rows as JSON has them: times as text."""
    return [{key: _plain(value) for key, value in row.items()} for row in table.to_pylist()]


def _plain(value: Any) -> Any:
    if isinstance(value, datetime | date):
        return value.isoformat()
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value if value is None or isinstance(value, str | int | float | bool) else str(value)


def csv_of(table: pa.Table) -> bytes:
    """Return a table as CSV; what is a list in it is JSON in its cell."""
    columns = [
        pa.array(
            [None if each is None else json.dumps(_plain(each)) for each in column.to_pylist()]
        )
        if pa.types.is_nested(column.type)
        else column
        for column in table.columns
    ]
    sink = io.BytesIO()
    pa_csv.write_csv(pa.table(columns, names=table.column_names), sink)
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
    yield _line(table.column_names, widths, is_number)
    for row in zip(*cells, strict=True):
        yield _line(row, widths, is_number)
    if len(table) > len(shown):
        yield f"({len(table) - len(shown)} more rows; --out FILE writes all)"


def _is_number(kind: pa.DataType) -> bool:
    return bool(
        pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_decimal(kind)
    )


def _line(cells: Any, widths: list[int], is_number: list[bool]) -> str:
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
    text = value if isinstance(value, str) else json.dumps(_plain(value))
    text = "".join(each if each.isprintable() else " " for each in text)
    return text if len(text) <= WIDTH_MAX else f"{text[: WIDTH_MAX - 3]}..."
