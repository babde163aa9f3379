"""The attribute tables of shapefiles: encodings, numbers and headers that lie."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import pytest

from companion.errors import MapError
from missions.maps import dbf
from missions.maps.shapefile import read_shapefile
from tests.missions.shapefiles import cell, write


def table(
    path: Path,
    columns: Sequence[tuple[bytes, bytes, int]],
    rows: Sequence[Sequence[bytes]],
    *,
    driver: int = 0,
    cpg: bytes | None = None,
) -> Path:
    """Write a shapefile whose table is made by hand, column by column and byte by byte."""
    write(
        path,
        [cell(index) for index in range(len(rows))],
        geometry_type="Polygon",
        n=range(len(rows)),
    )
    header = 33 + 32 * len(columns)
    width = 1 + sum(size for _, _, size in columns)
    content = struct.pack("<B3BLHH17xB2x", 3, 100, 1, 1, len(rows), header, width, driver)
    for name, kind, size in columns:
        content += struct.pack("<11sc4xB15x", name, kind, size)
    content += b"\r"
    for row in rows:
        content += b" " + b"".join(
            one.ljust(size)[:size] for one, (_, _, size) in zip(row, columns, strict=True)
        )
    path.with_suffix(".dbf").write_bytes(content + b"\x1a")
    path.with_suffix(".cpg").unlink(missing_ok=True)
    if cpg is not None:
        path.with_suffix(".cpg").write_bytes(cpg)
    return path


def columns_of(path: Path) -> dict[str, tuple[object, ...]]:
    return {column.name: column.values for column in read_shapefile(path).columns}


ENCODED = [
    ("gbk", b"GBK", 0, "\u5730\u5757"),
    ("gbk", b"936", 0, "\u5730\u5757"),
    ("gbk", None, 0x4D, "\u5730\u5757"),
    ("utf-8", b"UTF-8", 0x57, "\u5730\u5757"),
    ("utf-8", b"\xef\xbb\xbfUTF-8\r\n", 0, "\u5730\u5757"),
    ("utf-8", None, 0, "\u5730\u5757"),
    ("cp949", b"CP949", 0, "\ub17c"),
    ("cp949", b"EUC-KR", 0, "\ub17c"),
    ("cp949", None, 0x4E, "\ub17c"),
    ("cp932", b"932", 0, "\u7551"),
    ("cp932", b"Shift_JIS", 0, "\u7551"),
    ("cp932", None, 0x13, "\u7551"),
    ("big5", b"Big5", 0, "\u7530"),
    ("cp1252", b"ANSI 1252", 0, "Gr\u00fcn \u2013 S\u00fcd"),
    ("cp1252", b"1252", 0, "Gr\u00fcn \u2013 S\u00fcd"),
    ("cp1252", None, 0x57, "Gr\u00fcn \u2013 S\u00fcd"),
    ("iso8859-1", b"ISO 88591", 0, "Gr\u00fcn"),
    ("iso8859-15", b"ISO-8859-15", 0, "5 \u20ac"),
    ("cp1251", None, 0xC9, "\u043f\u043e\u043b\u0435"),
    ("cp866", b"OEM 866", 0, "\u043f\u043e\u043b\u0435"),
]


@pytest.mark.parametrize(("encoding", "cpg", "driver", "text"), ENCODED)
def test_texts_are_read_in_the_encoding_that_the_set_declares(
    tmp_path: Path, encoding: str, cpg: bytes | None, driver: int, text: str
) -> None:
    raw = text.encode(encoding)
    path = table(
        tmp_path / "rx.shp",
        [(raw, b"C", 30), (b"rate", b"N", 8)],
        [[raw, b"    12.5"]],
        driver=driver,
        cpg=cpg,
    )
    found = read_shapefile(path)
    assert columns_of(path) == {text: (text,), "rate": (12.5,)}
    assert found.problems == ()


@pytest.mark.parametrize(
    "cpg", [None, b"", b"no-such", b"rot13", b"zlib", b"utf-16", b"utf-7", b"037"]
)
def test_texts_without_a_known_encoding_are_a_warning_and_numbers_are_right(
    tmp_path: Path, cpg: bytes | None
) -> None:
    path = table(
        tmp_path / "rx.shp",
        [(b"name", b"C", 10), (b"plain", b"C", 10), (b"rate", b"N", 8)],
        [["\u5730\u5757".encode("gbk"), b"a", b"12.5"]],
        cpg=cpg,
    )
    found = read_shapefile(path)
    (problem,) = found.problems
    assert (problem.severity, problem.code, problem.where) == (
        "warning",
        "encoding",
        "rx.dbf: name",
    )
    assert ".cpg" in problem.fix
    assert "not all in" not in problem.text  # what nobody knows is not what the file declares
    assert columns_of(path)["rate"] == (12.5,)
    assert columns_of(path)["plain"] == ("a",)


def test_texts_in_another_encoding_than_declared_are_a_warning(tmp_path: Path) -> None:
    path = table(
        tmp_path / "rx.shp",
        [(b"name", b"C", 10), (b"rate", b"N", 8)],
        [["S\u00fcd-Ost".encode("latin-1"), b"12.5"]],
        cpg=b"UTF-8",
    )
    assert [problem.code for problem in read_shapefile(path).problems] == ["encoding"]
    assert columns_of(path)["name"] == ("S\ufffdd-Ost",)


@pytest.mark.parametrize("cpg", [b"UTF-8", None])
def test_a_letter_cut_in_two_by_the_width_of_a_column_is_left_out(
    tmp_path: Path, cpg: bytes | None
) -> None:
    raw = ("\u5730" * 4).encode()
    path = table(
        tmp_path / "rx.shp", [(raw[:10], b"C", 10), (b"rate", b"N", 8)], [[raw, b"1"]], cpg=cpg
    )
    assert columns_of(path) == {"\u5730" * 3: ("\u5730" * 3,), "rate": (1.0,)}
    assert read_shapefile(path).problems == ()


@pytest.mark.parametrize(
    ("cell_bytes", "value"),
    [
        (b"", None),
        (b"********", None),
        (b"\0\0\0", None),
        (b"nan", None),
        (b"NaN", None),
        (b"0", 0.0),
        (b"-.5", -0.5),
        (b"+12.", 12.0),
        (b"1.25e+01", 12.5),
        (b"12.5\0zz", 12.5),
        (b"12,5", "12,5"),
        (b"1_0", "1_0"),
        (b"inf", "inf"),
        (b"-1.#IND", "-1.#IND"),
        (b"1 2", "1 2"),
        (b"0x10", "0x10"),
    ],
)
@pytest.mark.parametrize("kind", [b"N", b"F"])
def test_a_number_is_a_number_a_blank_is_none_and_the_rest_stays_text(
    tmp_path: Path, kind: bytes, cell_bytes: bytes, value: object
) -> None:
    path = table(tmp_path / "rx.shp", [(b"rate", kind, 8)], [[cell_bytes]])
    (column,) = read_shapefile(path).columns
    assert (column.numeric, column.values) == (True, (value,))


@pytest.mark.parametrize(
    ("kind", "size", "cell_bytes", "value"),
    [
        (b"L", 1, b"T", "T"),
        (b"L", 1, b"?", None),
        (b"D", 8, b"20240501", "20240501"),
        (b"D", 8, b"00000000", None),
        (b"D", 8, b"", None),
        (b"M", 10, b"       512", "(field of type M)"),
        (b"M", 10, b"", None),
        (b"I", 4, b"\x0c\1\2\3", "(field of type I)"),
        (b"O", 8, b"\x40\x29\1\1\1\1\1\1", "(field of type O)"),
        (b"C", 0, b"", None),
    ],
)
def test_other_columns_are_no_numbers(
    tmp_path: Path, kind: bytes, size: int, cell_bytes: bytes, value: object
) -> None:
    path = table(
        tmp_path / "rx.shp", [(b"a", kind, size), (b"rate", b"N", 4)], [[cell_bytes, b"12.5"]]
    )
    first, second = read_shapefile(path).columns
    assert (first.numeric, first.values, second.values) == (False, (value,), (12.5,))


@pytest.mark.parametrize(
    ("at", "fmt", "value"),
    [
        (4, "<L", 3),
        (4, "<L", 2**32 - 1),
        (8, "<H", 0),
        (8, "<H", 32),
        (8, "<H", 66),
        (8, "<H", 64),
        (8, "<H", 60_000),
        (10, "<H", 0),
        (10, "<H", 4),
        (10, "<H", 8),
        (48, "<B", 200),
    ],
)
def test_a_table_whose_header_lies_is_refused(
    tmp_path: Path, at: int, fmt: str, value: int
) -> None:
    path = table(tmp_path / "rx.shp", [(b"rate", b"N", 8)], [[b"12.5"], [b"7"]])
    dbf = path.with_suffix(".dbf")
    content = bytearray(dbf.read_bytes())
    struct.pack_into(fmt, content, at, value)
    dbf.write_bytes(content)
    with pytest.raises(MapError) as caught:
        read_shapefile(path)
    assert caught.value.code in ("truncated", "table-mismatch", "unusable", "too-large")


def test_more_cells_than_any_map_has_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = table(tmp_path / "rx.shp", [(b"a", b"N", 1), (b"b", b"N", 1)], [[b"1", b"2"]] * 3)
    monkeypatch.setattr(dbf, "_CELLS_MAX", 6)
    assert read_shapefile(path)
    monkeypatch.setattr(dbf, "_CELLS_MAX", 5)
    with pytest.raises(MapError) as caught:
        read_shapefile(path)
    assert caught.value.code == "too-large"
