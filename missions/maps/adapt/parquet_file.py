"""The bytes of a Parquet file, taken apart by pyarrow within bounds.

Text and geometry stay in dictionaries while they are read: a file of a few kilobytes can repeat
one long value a million times.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from companion.errors import MapError
from missions.maps.layer import Column, Value, check_counts
from missions.maps.model import map_error

EXPORT_AGAIN = "copy it again, or export the map again"
_COLUMNS_MAX = 255  # as many as a shapefile can have
# A million records of ten columns, or 40 000 of 250.
_CELLS_MAX = 10_000_000
_ROW_GROUPS_MAX = 10_000
_UNPACKED_MAX_BYTES = 512 * 1024 * 1024


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """The flat columns of a file; `names` are those of all, in the order of the file."""

    columns: tuple[Column, ...]
    geometry: tuple[bytes | None, ...]
    geo: bytes | None
    names: tuple[str, ...]


def read_table(content: bytes, path: Path, *, geometry_of: Callable[[bytes | None], str]) -> Table:
    """Return the columns of a Parquet file; `geometry_of` finds the geometry by its description."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise map_error(
            path,
            "reading GeoParquet takes the library pyarrow, which is not installed",
            fix="install it with: pip install 'vrspray[maps]'",
            code="missing-library",
        ) from None
    broken = (
        pyarrow.ArrowException, OSError, ValueError, TypeError, KeyError, OverflowError,
        MemoryError, NotImplementedError,
    )  # fmt: skip
    try:
        return _table(pyarrow, content, path, geometry_of)
    except MapError:
        raise
    except broken as error:
        reason = " ".join(str(error).split())[:120]
        raise map_error(
            path,
            f"the Parquet file is cut short or damaged ({reason})",
            fix=EXPORT_AGAIN,
            code="truncated",
        ) from None


def _table(
    pyarrow: Any, content: bytes, path: Path, geometry_of: Callable[[bytes | None], str]
) -> Table:
    buffer = pyarrow.BufferReader(content)
    about = pyarrow.parquet.read_metadata(buffer)
    _check_size(about, path)
    geo = (about.metadata or {}).get(b"geo")
    geometry_name = geometry_of(geo)
    buffer.seek(0)
    # Kinds by the file's own schema: what is text or bytes there is read as a dictionary.
    kinds = pyarrow.parquet.ParquetFile(buffer, metadata=about).schema_arrow
    texts = [field.name for field in kinds if _is_text(pyarrow, field.type)]
    buffer.seek(0)
    file = pyarrow.parquet.ParquetFile(
        buffer, metadata=about, read_dictionary=texts, pre_buffer=False
    )
    names = [field.name for field in kinds if _is_flat(pyarrow, field.type)]
    _check_names(names, geometry_name, path)
    read = file.read(columns=names, use_threads=False)
    columns = []
    geometry: tuple[bytes | None, ...] = ()
    for name, chunks in zip(read.column_names, read.columns, strict=True):
        if name == geometry_name:
            geometry = tuple(_blobs(pyarrow, chunks))
        elif not pyarrow.types.is_binary(_plain(pyarrow, chunks.type)):
            columns.append(_column(pyarrow, name, chunks))
    return Table(columns=tuple(columns), geometry=geometry, geo=geo, names=tuple(kinds.names))


def _check_size(about: Any, path: Path) -> None:
    """Refuse what would take the vehicle's memory; the end of the file says it all."""
    check_counts(path, records=about.num_rows, vertices=0)
    groups = about.num_row_groups
    unpacked = 0
    if groups <= _ROW_GROUPS_MAX:
        unpacked = sum(about.row_group(index).total_byte_size for index in range(groups))
    for count, limit, of in (
        (about.num_columns, _COLUMNS_MAX, "columns"),
        (about.num_columns * about.num_rows, _CELLS_MAX, "values"),
        (groups, _ROW_GROUPS_MAX, "row groups"),
        (unpacked, _UNPACKED_MAX_BYTES, "bytes unpacked"),
    ):
        if not 0 <= count <= limit:
            raise map_error(
                path,
                f"its {count} {of} are more than {limit}",
                fix="keep the rate and its unit, and cut the map to one field",
                code="too-large",
            )


def _check_names(names: list[str], geometry: str, path: Path) -> None:
    if len(set(names)) != len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise map_error(
            path,
            f"it has the column {twice[:60]!r} twice",
            fix=EXPORT_AGAIN,
            code="several-columns",
        )
    if geometry not in names:
        raise map_error(
            path,
            f"the column {geometry[:60]!r}, which is to be its geometry, is not there",
            fix=EXPORT_AGAIN,
            code="truncated",
        )


def _plain(pyarrow: Any, kind: Any) -> Any:
    """Return the type of the values, in a dictionary or not, large or not."""
    kind = kind.value_type if pyarrow.types.is_dictionary(kind) else kind
    return pyarrow.binary() if pyarrow.types.is_large_binary(kind) else kind


def _is_text(pyarrow: Any, kind: Any) -> bool:
    types, kind = pyarrow.types, _plain(pyarrow, kind)
    return bool(types.is_string(kind) or types.is_large_string(kind) or types.is_binary(kind))


def _is_number(pyarrow: Any, kind: Any) -> bool:
    types, kind = pyarrow.types, _plain(pyarrow, kind)
    return bool(types.is_integer(kind) or types.is_floating(kind) or types.is_decimal(kind))


def _is_flat(pyarrow: Any, kind: Any) -> bool:
    return _is_text(pyarrow, kind) or _is_number(pyarrow, kind)


def _column(pyarrow: Any, name: str, chunks: Any) -> Column:
    numeric = _is_number(pyarrow, chunks.type)
    if not numeric:
        texts: list[Value] = list(_values(pyarrow, chunks))
        return Column(name=name, values=tuple(texts), numeric=False)
    if pyarrow.types.is_dictionary(chunks.type):
        chunks = chunks.cast(chunks.type.value_type)
    numbers = chunks.cast(pyarrow.float64(), safe=False).to_pylist()
    values = tuple(None if one is None or math.isnan(one) else one for one in numbers)
    return Column(name=name, values=values, numeric=True)


def _blobs(pyarrow: Any, chunks: Any) -> Iterator[bytes | None]:
    for blob in _values(pyarrow, chunks):
        if not (blob is None or isinstance(blob, bytes)):
            raise ValueError("its geometry is text")
        yield blob


def _values(pyarrow: Any, chunks: Any) -> Iterator[Any]:
    """Yield the values one after the other, each as one object however often it stands there."""
    for chunk in chunks.chunks:
        if not pyarrow.types.is_dictionary(chunk.type):
            yield from chunk.to_pylist()
            continue
        values = chunk.dictionary.to_pylist()
        for index in chunk.indices.to_pylist():
            yield None if index is None else values[index]
