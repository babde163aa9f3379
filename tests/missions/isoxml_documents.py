"""ISOXML task data as text: what the tests of its reader are made of."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path

import pytest
from shapely import Polygon, box

from companion.errors import MapError
from missions.maps.isoxml.reader import read_isoxml
from missions.maps.model import Grid, Layer

WEST, SOUTH = 15.0, 48.0
HEAD = '<?xml version="1.0" encoding="UTF-8"?>'
VPN = '<VPN A="VPN1" B="0" C="0.0001" D="2" E="l/ha"/>'


def ring(ground: Polygon, kind: int = 1, interior: int | None = None) -> str:
    points = (ground.exterior if interior is None else ground.interiors[interior]).coords
    inner = "".join(f'<PNT A="2" C="{north:.9f}" D="{east:.9f}"/>' for east, north in points)
    return f'<LSG A="{kind}">{inner}</LSG>'


def polygon(ground: Polygon, kind: int = 2) -> str:
    holes = "".join(ring(ground, 2, index) for index in range(len(ground.interiors)))
    return f'<PLN A="{kind}">{ring(ground)}{holes}</PLN>'


def zone(code: int, *inside: str, name: str = "") -> str:
    designator = f' B="{name}"' if name else ""
    return f'<TZN A="{code}"{designator}>{"".join(inside)}</TZN>'


def value(raw: int, ddi: str = "0001", more: str = 'E="VPN1"') -> str:
    return f'<PDV A="{ddi}" B="{raw}" {more}/>'


def grid(kind: int, rows: int, columns: int, more: str = "", **changed: str) -> str:
    given = {
        "A": f"{SOUTH}", "B": f"{WEST}", "C": "0.001", "D": "0.002", "E": f"{columns}",
        "F": f"{rows}", "G": "GRD00001", "I": f"{kind}",
    } | changed  # fmt: skip
    attributes = " ".join(f'{key}="{text}"' for key, text in given.items())
    return f"<GRD {attributes} {more}/>"


def task(*inside: str, own: str = "TSK1", more: str = "") -> str:
    return f'<TSK A="{own}" G="1" {more}>{"".join(inside)}</TSK>'


def document(*inside: str, version: str = "4", head: str = HEAD) -> bytes:
    text = f'{head}<ISO11783_TaskData VersionMajor="{version}">{"".join(inside)}'
    encoding = "latin-1" if "8859" in head else "utf-8"
    return f"{text}</ISO11783_TaskData>".encode(encoding)


def field(ground: Polygon, own: str = "PFD1", more: str = "") -> str:
    return f'<PFD A="{own}" C="field" D="0">{polygon(ground, 1)}{more}</PFD>'


def write(folder: Path, files: Mapping[str, bytes]) -> Path:
    for name, content in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    return folder


def read(tmp_path: Path, *inside: str, layer: str | None = None, **files: bytes) -> Layer | Grid:
    """Read task data with the binaries given by name."""
    binaries = {f"{name}.bin": content for name, content in files.items()}
    return read_isoxml(write(tmp_path, {"TASKDATA.XML": document(*inside)} | binaries), layer)


def read_layer(tmp_path: Path, *inside: str, layer: str | None = None) -> Layer:
    found = read(tmp_path, *inside, layer=layer)
    assert isinstance(found, Layer)
    return found


def read_grid(tmp_path: Path, *inside: str, content: bytes) -> Grid:
    found = read(tmp_path, *inside, GRD00001=content)
    assert isinstance(found, Grid)
    return found


def refusal(tmp_path: Path, *inside: str, layer: str | None = None, **files: bytes) -> MapError:
    with pytest.raises(MapError) as caught:
        read(tmp_path, *inside, layer=layer, **files)
    assert "\n" not in str(caught.value)
    return caught.value


def codes(found: Layer | Grid) -> list[str]:
    return [problem.code for problem in found.problems]


def ints(*raws: int) -> bytes:
    return struct.pack(f"<{len(raws)}i", *raws)


LEFT = box(WEST, SOUTH, WEST + 0.004, SOUTH + 0.004)
RIGHT = box(WEST + 0.004, SOUTH, WEST + 0.008, SOUTH + 0.004)
HOLED = LEFT.difference(box(WEST + 0.001, SOUTH + 0.001, WEST + 0.002, SOUTH + 0.002))
TWO = (
    zone(3, polygon(HOLED), value(1_500_000), name="Süd"),
    zone(4, polygon(RIGHT), value(0)),
)


TYPE_2 = zone(0, value(0))
