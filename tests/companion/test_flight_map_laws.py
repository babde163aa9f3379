"""A flight map is a stranger's file: whatever is in it, it is refused or it can be flown over."""

from __future__ import annotations

import sqlite3
import tempfile
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.config import load
from companion.errors import MapError
from companion.flight_map import file, read_flight_map
from missions.maps.compiling import MapOrder, compile_map, write_flight_map
from tests.companion.test_flight_map import map_of_cells

ANYANG = Path(__file__).parents[2] / "examples" / "anyang" / "config.toml"
TABLES = (
    "zones", "field", "exclusions", "lines", "source_rates", "sources", "findings", "cells", "meta",
)  # fmt: skip


@pytest.fixture(scope="module")
def folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as name:
        yield Path(name)


@pytest.fixture(scope="module")
def originals(folder: Path) -> list[Path]:
    """Return flight maps of zones and of cells."""
    zones = compile_map(MapOrder.of(load(ANYANG)))
    paths = [folder / "zones.flightmap.gpkg", folder / "cells.flightmap.gpkg"]
    for path, flight_map in zip(paths, (zones, map_of_cells()), strict=True):
        write_flight_map(path, flight_map)
    return paths


def read_or_refused(path: Path) -> None:
    """Read a file; what is read must be flown over without an error."""
    try:
        found = read_flight_map(path)
    except MapError as error:
        assert "\n" not in str(error)
        assert error.fix
        return
    ground = found.moved(1.0, -1.0)
    places = np.linspace(-300.0, 300.0, 40)
    ground.rates_at(places, places)
    ground.edges_near(-20.0, -20.0, 20.0, 20.0)
    assert np.isfinite(ground.edges.ends).all()
    assert all(0.0 <= rate < 100_000.0 for rate in ground.rates_l_ha)


@settings(max_examples=150)
@given(
    which=st.integers(0, 1),
    changed=st.lists(st.tuples(st.floats(0.0, 1.0), st.integers(0, 255)), max_size=8),
    keep=st.floats(0.0, 1.0) | st.just(1.0),
)
def test_any_bytes_are_read_or_refused(
    which: int,
    changed: list[tuple[float, int]],
    keep: float,
    originals: list[Path],
    folder: Path,
) -> None:
    content = bytearray(originals[which].read_bytes())
    for place, value in changed:
        content[int(place * (len(content) - 1))] = value
    path = folder / "mutated.flightmap.gpkg"
    path.write_bytes(bytes(content[: int(len(content) * keep)]))
    read_or_refused(path)


numbers = st.floats() | st.integers(-(2**63), 2**63 - 1)
values = st.none() | numbers | st.text(max_size=40) | st.binary(max_size=60)


@settings(max_examples=400)
@given(
    which=st.integers(0, 1),
    table=st.sampled_from(TABLES),
    place=st.tuples(st.integers(0, 100), st.integers(0, 100)),
    value=values | st.tuples(st.floats(0.0, 1.0), st.integers(0, 255)),
)
def test_any_content_with_the_right_hash_is_read_or_refused(
    which: int,
    table: str,
    place: tuple[int, int],
    value: Any,
    originals: list[Path],
    folder: Path,
) -> None:
    """Whoever changes a value can work out the hash anew: it is not a signature."""
    path = folder / "changed.flightmap.gpkg"
    path.write_bytes(originals[which].read_bytes())
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        connection.execute("PRAGMA ignore_check_constraints = ON")
        names = [row[1] for row in connection.execute(f"PRAGMA table_info({table})")]
        rows = connection.execute(f"SELECT rowid, * FROM {table}").fetchall() if names else []
        if not rows:
            return
        row, column = rows[place[0] % len(rows)], 1 + place[1] % len(names)
        if isinstance(value, tuple):
            value = one_byte_other(row[column], *value)
        try:
            sql = f"UPDATE {table} SET {names[column - 1]} = ? WHERE rowid = ?"
            connection.execute(sql, (value, row[0]))
        except (sqlite3.Error, OverflowError, UnicodeEncodeError):
            return
        sha256 = file.content_sha256(connection)
        connection.execute("UPDATE meta SET value = ? WHERE key = 'sha256'", (sha256,))
    read_or_refused(path)


def one_byte_other(value: Any, share: float, byte: int) -> Any:
    """Return a value with one of its bytes or letters changed; numbers stay."""
    if isinstance(value, bytes) and value:
        at = int(share * (len(value) - 1))
        return value[:at] + bytes([byte]) + value[at + 1 :]
    if isinstance(value, str) and value:
        at = int(share * (len(value) - 1))
        return value[:at] + chr(byte) + value[at + 1 :]
    return value
