"""Laws of ISOXML: no bytes make a traceback, and what is written comes back."""

from __future__ import annotations

import tempfile
import zipfile
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from shapely import MultiPolygon, box

from companion.errors import MapError
from missions.maps.crs import WGS84
from missions.maps.isoxml.reader import read_isoxml
from missions.maps.isoxml.writer import write_isoxml
from missions.maps.model import Grid, Layer, MapCells, MapFile, MapZone

WEST, SOUTH, STEP = 15.0, 48.0, 0.0005
FIELD = MultiPolygon([box(WEST, SOUTH, WEST + 4 * STEP, SOUTH + 3 * STEP)])
EXAMPLES = 60


@pytest.fixture(scope="module")
def folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as name:
        yield Path(name)


def made(zones: tuple[MapZone, ...], cells: MapCells | None = None) -> MapFile:
    return MapFile(
        path=Path("x.shp"), format="", crs="", unit="L/ha", rate_field="", zones=zones, sha256="",
        cells=cells, boundary=FIELD, default_rate_l_ha=3.0,
    )  # fmt: skip


def cells_of(rates: np.ndarray[tuple[int, int], np.dtype[np.float64]]) -> MapCells:
    return MapCells(rates_l_ha=rates, transform=(STEP, 0, WEST, 0, STEP, SOUTH), crs=WGS84)


def originals() -> dict[str, dict[str, bytes]]:
    """A small map of each kind, as the names and bytes of its files."""
    zone = box(WEST, SOUTH, WEST + STEP, SOUTH + STEP)
    holed = zone.difference(zone.buffer(-STEP / 4))
    grid = cells_of(np.arange(12.0).reshape(3, 4))
    with tempfile.TemporaryDirectory() as name:
        zones_path, values_path = Path(name, "zones"), Path(name, "values")
        write_isoxml(made((MapZone(name="a", geometry=holed, rate_l_ha=5.0),)), zones_path)
        write_isoxml(made((), grid), values_path)
        zones = (zones_path / "TASKDATA.XML").read_bytes()
        values = (values_path / "TASKDATA.XML").read_bytes()
        binary = (values_path / "GRD00001.BIN").read_bytes()
    codes = values.replace(b'I="2" J="0" />', b'I="1" />').replace(b'H="48"', b'H="12"')
    assert codes != values
    return {
        "zones": {"TASKDATA.XML": zones},
        "values": {"TASKDATA.XML": values, "GRD00001.BIN": binary},
        "codes": {"TASKDATA.XML": codes, "GRD00001.BIN": bytes([0, 1, 2] * 4)},
    }


ORIGINALS = originals()


def changes() -> st.SearchStrategy[list[tuple[float, int]]]:
    return st.lists(
        st.tuples(st.floats(0.0, 1.0, exclude_max=True), st.integers(0, 255)), max_size=4
    )


def mutated(content: bytes, changed: list[tuple[float, int]], keep: float) -> bytes:
    result = bytearray(content)
    for place, byte in changed:
        result[int(place * len(result))] = byte
    return bytes(result[: int(keep * len(result))] if keep < 1.0 else result)


def use(path: Path) -> None:
    """Only a whole map or a `MapError` of one line may come out."""
    try:
        found = read_isoxml(path)
    except MapError as error:
        assert "\n" not in str(error)
        assert error.code != "unusable"
        assert error.fix
    else:
        assert found.bands if isinstance(found, Grid) else found.geometries


@pytest.mark.parametrize("kind", ORIGINALS)
def test_originals_are_read(folder: Path, kind: str) -> None:
    path = folder / "original"
    path.mkdir(exist_ok=True)
    for name, content in ORIGINALS[kind].items():
        (path / name).write_bytes(content)
    assert not read_isoxml(path).problems


@settings(max_examples=3 * EXAMPLES)
@given(
    kind=st.sampled_from(sorted(ORIGINALS)),
    changed=changes(),
    keep=st.just(1.0) | st.floats(0.0, 1.0),
    xml=st.booleans(),
)
def test_any_bytes_are_read_or_refused(
    folder: Path, kind: str, changed: list[tuple[float, int]], keep: float, xml: bool
) -> None:
    path = folder / "mutated"
    path.mkdir(exist_ok=True)
    (path / "GRD00001.BIN").unlink(missing_ok=True)
    for name, content in ORIGINALS[kind].items():
        changes_here = name.endswith(".XML") == xml
        (path / name).write_bytes(mutated(content, changed, keep) if changes_here else content)
    use(path)


# What a hostile or careless program writes where a number or a reference belongs.
ODD = st.sampled_from(
    [
        *("", " ", "0", "-1", "1", "2", "255", "1e308", "-1e-300", "nan", "inf", "1,5", "0x1"),
        *("9" * 40, "TSK1", "VPN1", "GRD00001", "..", "\u0661", "l/ha", "kg/ha", "180", "-90"),
    ]
)


@settings(max_examples=2 * EXAMPLES)
@given(
    kind=st.sampled_from(sorted(ORIGINALS)),
    changed=st.lists(st.tuples(st.floats(0.0, 1.0, exclude_max=True), ODD), min_size=1, max_size=3),
)
def test_any_attribute_is_read_or_refused(
    folder: Path, kind: str, changed: list[tuple[float, str]]
) -> None:
    files = dict(ORIGINALS[kind])
    parts = files["TASKDATA.XML"].decode().split('"')
    # After the head's own attributes every second part is a value.
    first, count = 5, (len(parts) - 5) // 2
    for place, text in changed:
        parts[first + 2 * int(place * count)] = text
    path = folder / "odd"
    path.mkdir(exist_ok=True)
    for name, content in (files | {"TASKDATA.XML": '"'.join(parts).encode()}).items():
        (path / name).write_bytes(content)
    use(path)


@settings(max_examples=EXAMPLES)
@given(changed=changes(), keep=st.just(1.0) | st.floats(0.0, 1.0))
def test_any_bytes_of_a_zip_are_read_or_refused(
    folder: Path, changed: list[tuple[float, int]], keep: float
) -> None:
    buffer = BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in ORIGINALS["values"].items():
            archive.writestr(name, content)
    path = folder / "mutated.zip"
    path.write_bytes(mutated(buffer.getvalue(), changed, keep))
    use(path)


@settings(max_examples=EXAMPLES)
@given(
    rates=st.lists(st.none() | st.floats(0.0, 99_999.0), min_size=1, max_size=12),
)
def test_rates_of_zones_come_back_to_a_hundredth(folder: Path, rates: list[float | None]) -> None:
    rates = [*rates, 1.0]
    zones = tuple(
        MapZone(
            name=f"{i}",
            geometry=box(WEST + i * STEP, SOUTH, WEST + (i + 1) * STEP, SOUTH + STEP),
            rate_l_ha=rate,
        )
        for i, rate in enumerate(rates)
    )
    write_isoxml(made(zones), folder / "zones.zip")
    found = read_isoxml(folder / "zones.zip")
    assert isinstance(found, Layer)
    for value, rate in zip(found.columns[1].values, rates, strict=True):
        assert (value is None) == (rate is None)
        assert value is None or rate is None or abs(float(value) - rate) <= 0.01


@settings(max_examples=EXAMPLES)
@given(
    rates=arrays.arrays(
        np.float64,
        st.tuples(st.integers(1, 9), st.integers(1, 9)),
        elements=st.floats(0.0, 99_999.0),
    )
)
def test_rates_of_cells_come_back_to_a_hundredth(
    folder: Path, rates: np.ndarray[tuple[int, int], np.dtype[np.float64]]
) -> None:
    write_isoxml(made((), cells_of(rates)), folder / "cells.zip")
    found = read_isoxml(folder / "cells.zip")
    assert isinstance(found, Grid)
    assert found.transform == (STEP, 0, WEST, 0, STEP, SOUTH)
    np.testing.assert_allclose(found.bands[0].values, rates, rtol=0, atol=0.01)
