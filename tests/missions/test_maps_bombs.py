"""Small files that ask for much: memory out of all proportion, or a number that is cut in two.

What a file asks for is read in a process that may take half a gigabyte, and no more.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from companion.cli.app import execute
from companion.errors import MapError
from missions.maps.build import build_prescription, frame_for
from missions.maps.csvfile import read_csv
from missions.maps.geotiff_bands import parse_world_file
from missions.maps.lint import summary
from missions.maps.model import Grid, Layer
from missions.maps.registry import read_map
from missions.maps.text_map import read_text_map

MORE_BYTES = 512 * 1024**2
# Reads, checks and builds every map that it is given, within so much memory beyond its own.
CHILD = """
import json, resource, sys
from pathlib import Path
from companion.errors import MapError
from missions.maps.build import build_prescription, frame_for
from missions.maps.lint import summary
from missions.maps.registry import read_map

lines = Path("/proc/self/status").read_text().splitlines()
status = dict(line.split(":", 1) for line in lines)
most = int(status["VmSize"].split()[0]) * 1024 + int(sys.argv[1])
resource.setrlimit(resource.RLIMIT_AS, (most, most))
for name in sys.argv[2:]:
    try:
        found = read_map(Path(name), unit="L/ha")
        result = summary(found)
        build_prescription(found, frame_for(found))
        print(json.dumps(["read", found.rates_l_ha[0]]))
    except MapError as error:
        print(json.dumps([error.code, str(error)]))
"""


@pytest.fixture(scope="module")
def folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as name:
        yield Path(name)


def points(*, rate: str) -> str:
    """Return 90 x 100 points on a lattice, one of them with the rate given."""
    lines = [f"36.0{i // 100:03d},114.50{i % 100:02d},5" for i in range(9_000)]
    lines[5] = lines[5].removesuffix("5") + rate
    return "\n".join(["lat,lon,rate", *lines, ""])


def polygon(ring: list[tuple[float, float]]) -> str:
    corners = ",".join(f"{x:.10f} {y:.10f}" for x, y in [*ring, ring[0]])
    return f'wkt,rate\n"POLYGON(({corners}))",10\n'


def zigzag(count: int) -> list[tuple[float, float]]:
    """Return a strip whose edges are each 70 km long: cut every 100 m they are many."""
    there = [(114.0 + 0.8 * (i % 2), 36.0 + i * 5e-5) for i in range(count)]
    return there + [(x + 1e-5, y) for x, y in reversed(there)]


def star(count: int) -> list[tuple[float, float]]:
    """Return a ring whose every edge crosses a fifth of all others."""
    return [
        (float(x), float(y))
        for x, y in np.random.default_rng(1).uniform((114.0, 36.0), (114.01, 36.01), (count, 2))
    ]


def test_a_small_file_never_takes_much_memory(folder: Path) -> None:
    cases = {
        "wide-cell.csv": (points(rate="0" * 100_000 + "5"), "read", 5.0),
        "long-edges.csv": (polygon(zigzag(9_000)), "too-large", "vertices"),
        "crossings.csv": (polygon(star(18_000)), "too-complicated", "cross"),
    }
    for name, (text, _, _) in cases.items():
        (folder / name).write_text(text, "ascii")
    done = subprocess.run(
        [sys.executable, "-c", CHILD, str(MORE_BYTES), *(str(folder / name) for name in cases)],
        capture_output=True, text=True, timeout=50, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-500:]
    found = [json.loads(line) for line in done.stdout.splitlines()]
    for (name, (_, outcome, says)), (was, said) in zip(cases.items(), found, strict=True):
        assert was == outcome, (name, said)
        assert said == says if isinstance(says, float) else says in said, name
        if was != "read":
            assert name in said and "\n" not in said


def test_an_outline_that_would_take_long_is_refused_by_check_and_flight_alike(
    folder: Path,
) -> None:
    """20 000 corners on 20 m: closing the slivers between its teeth would take most of a minute."""
    x = np.repeat(np.linspace(0.0, 20.0, 10_001), 2)
    y = np.tile([20.0, 20.0, 1.0, 1.0], 5_001)[: len(x)]
    teeth = np.column_stack([x[1:-1], y[2:]]) / 111_320.0 + (114.5, 36.0)
    ring = [(114.5, 36.0), *map(tuple, teeth.tolist()), (float(teeth[-1, 0]), 36.0)]
    path = folder / "comb.csv"
    path.write_text(polygon(ring), "ascii")
    found = read_map(path, unit="L/ha")
    for use in (summary, lambda one: build_prescription(one, frame_for(one))):
        with pytest.raises(MapError, match=r"comb\.csv: its outline has \d+ edges") as caught:
            use(found)
        assert caught.value.code == "too-complicated"
        assert "simplify" in caught.value.fix


def rates_of(found: Grid | Layer) -> list[float]:
    """Return all rates of a file in its order, without those that are none."""
    if isinstance(found, Grid):
        values = found.bands[0].values.ravel()
        return sorted(values[~np.isnan(values)].tolist())
    column = next(column for column in found.columns if column.name == "rate")
    return sorted(value for value in column.values if isinstance(value, float))


POINTS = (
    "lat,lon,rate\n36.0000,114.5000,12.5\n36.0000,114.5001,120\n"
    "36.0001,114.5000,35.25\n36.0001,114.5001,47\n"
)
POLYGONS = (
    "wkt;rate\n"
    "POLYGON((114.5 36,114.501 36,114.501 36.001,114.5 36));12.5\n"
    "POLYGON((114.6 36,114.601 36,114.601 36.001,114.6 36));120\n"
)
TEXT_MAP = "3\n36.0\t114.5\t10\t1.25\n36.0001\t114.5\t10\t2.5\n36.0001\t114.5001\t10\t12.5\n"


@pytest.mark.parametrize(
    "text", [POINTS, POINTS.replace("\n", "\r\n"), POLYGONS], ids=["points", "crlf", "polygons"]
)
def test_table_cut_anywhere_never_gives_a_rate_that_it_does_not_have(
    folder: Path, text: str
) -> None:
    path = folder / "cut.csv"
    whole = {12.5, 120.0, 35.25, 47.0}
    read = 0
    for end in range(len(text) + 1):
        path.write_text(text[:end], "ascii", newline="")
        try:
            found = read_csv(path)
        except MapError as error:
            assert "cut.csv" in str(error)
            continue
        read += 1
        assert set(rates_of(found)) <= whole, text[:end][-40:]
    assert read  # the whole file, and where a row ends
    path.write_text(text.rstrip(), "ascii", newline="")
    with pytest.raises(MapError, match=r"is the last and has no line end") as caught:
        read_csv(path)
    assert caught.value.code == "truncated"
    assert "add a line end" in str(caught.value)


@pytest.mark.parametrize(
    "end", [',"47"', ",47,wheat", ",47,"], ids=["closed by a quotation mark", "text", "blank"]
)
def test_last_field_that_is_no_bare_number_needs_no_line_end(folder: Path, end: str) -> None:
    """A quotation mark or a word behind the number shows that it is whole; a blank does not."""
    extra = ",crop" if end.count(",") == 2 else ""
    rows = POINTS.splitlines()
    body = [row + (",barley" if extra else "") for row in rows[1:4]]
    text = "\n".join([rows[0] + extra, *body, rows[4].removesuffix(",47") + end])
    path = folder / "end.csv"
    path.write_text(text, "ascii", newline="")
    if end.endswith(","):
        with pytest.raises(MapError, match="no line end"):
            read_csv(path)
    else:
        assert rates_of(read_csv(path)) == [12.5, 35.25, 47.0, 120.0]


def test_text_map_cut_inside_its_last_number_is_refused(folder: Path) -> None:
    path = folder / "cut.txt"
    path.write_text(TEXT_MAP, "ascii")
    assert rates_of(read_text_map(path)) == [1.25, 2.5, 12.5]
    for end in (1, 2, 3, 4):
        path.write_text(TEXT_MAP[:-end], "ascii")
        with pytest.raises(MapError) as caught:
            read_text_map(path)
        assert caught.value.code in ("truncated", "bad-number"), end


def test_world_file_that_alone_says_the_place_needs_its_last_line_end() -> None:
    content = b"2.0\n0\n0\n-2.0\n280001.0\n3986099.5\n"
    path = Path("map.tfw")
    whole = parse_world_file(content, path, alone=True)
    assert parse_world_file(content.rstrip(), path, alone=False) == whole
    for end in range(1, 9):
        with pytest.raises(MapError, match=r"map\.tfw"):
            parse_world_file(content[:-end], path, alone=True)


def test_places_to_look_up_cut_inside_the_last_number_are_refused(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = folder / "places.csv"
    path.write_text("lat,lon\n35.9962,114.5436\n35.9962,114.54", "ascii")
    rate = ["map", "rate", "examples/anyang/prescription.shp", "--points", str(path)]
    assert execute(rate) == 2
    assert "line 3 is the last and has no line end" in capsys.readouterr().err
    path.write_text(path.read_text("ascii") + "\n", "ascii")
    assert execute(rate) == 0


def test_running_out_of_memory_is_one_line(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def no_memory(*_: object, **__: object) -> None:
        raise MemoryError

    monkeypatch.setattr("missions.maps.cli.options.read_map", no_memory)
    assert execute(["map", "check", str(folder / "any.csv")]) == 2
    assert capsys.readouterr().err.startswith("error: not enough memory")
