"""No cell of any CSV that this program writes is run by the spreadsheet that opens it."""

from __future__ import annotations

import ast
import csv
import io
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from analysis.exports.columns import METRIC, Column
from analysis.exports.csv_tables import csv_of as points_of
from analysis.fleet.asking import csv_of as fleet_of
from companion.csv_table import cell, csv_of, csv_text
from missions.make.data import Points, write_points

ROOT = Path(__file__).parents[2]
TEXTS = ["=1+1", "+cmd|' /C calc'!A0", "-2+3", "@SUM(A1)", "\t=1", "\r=1", "x\r=1", " =1", "＝1"]  # noqa: RUF001


def cells_of(text: str | bytes) -> list[str]:
    found = text if isinstance(text, str) else text.decode()
    return [each for row in csv.reader(io.StringIO(found, newline="")) for each in row]


def is_safe(each: str) -> bool:
    return not each.lstrip().startswith(("=", "+", "-", "@", "＝"))  # noqa: RUF001


@pytest.mark.parametrize("text", TEXTS)
def test_text_of_others_is_text_in_every_table(text: str, tmp_path: Path) -> None:
    column = Column(name="operator", short="", description="", unit=None, values=[text])
    nested = pa.array([[text]])
    points = Points(degrees=np.array([[8.0, 49.0]]), columns={text: np.array([-1.5])})
    write_points(tmp_path / "points.csv", points)
    tables: list[str | bytes] = [
        csv_of([{"operator": text}]),
        csv_text([[text], ["x"]]),
        b"".join(points_of([column])),
        fleet_of(pa.table({"operator": pa.array([text]), text: nested})),
        (tmp_path / "points.csv").read_bytes(),
    ]
    for table in tables:
        numbers = {"8.00000000", "49.00000000", "-1.5"}
        found = [each for each in cells_of(table) if each not in numbers]
        assert any(text.split()[-1] in each for each in found)
        assert all(is_safe(each) for each in found), found


def test_numbers_stay_numbers() -> None:
    given = [-1.5, "-1.5", "+3", "-1e-7", 7, None, "left - right", "a=b"]
    assert [cell(each) for each in given] == given
    values = Column(
        name="x", short="", description="", unit=METRIC["length"], values=np.array([-2.0])
    )
    assert b"".join(points_of([values])) == b"x\n-2.000\n"


def test_there_is_one_place_that_writes_csv() -> None:
    writers = {
        path.relative_to(ROOT).as_posix()
        for package in ("companion", "missions", "analysis", "sitl")
        for path in (ROOT / package).rglob("*.py")
        if "examples" not in path.parts
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Attribute)
        and node.attr in ("writer", "DictWriter")
        and isinstance(node.value, ast.Name)
        and node.value.id == "csv"
    }
    assert writers == {"companion/csv_table.py"}
