"""In which encoding the texts of an attribute table are.

The `.cpg` beside it says so, else a byte of the header; else the texts have to be UTF-8, or stay
unread letter for letter. No number depends on it, and nothing is guessed from how a text looks.
"""

from __future__ import annotations

import codecs
from pathlib import Path

from missions.maps.model import Problem

# Language driver, byte 29 of the header, where there is no .cpg (dBASE and Esri code pages).
_DRIVERS = {
    0x01: "cp437", 0x02: "cp850", 0x03: "cp1252", 0x13: "cp932", 0x26: "cp866", 0x4D: "gbk",
    0x4E: "cp949", 0x4F: "cp950", 0x57: "cp1252", 0x58: "cp1252", 0x59: "cp1252", 0x64: "cp852",
    0x65: "cp866", 0x6A: "cp737", 0x6B: "cp857", 0x78: "cp950", 0x79: "cp949", 0x7A: "gbk",
    0x7B: "cp932", 0x7C: "cp874", 0x7D: "cp1255", 0x7E: "cp1256", 0xC8: "cp1250", 0xC9: "cp1251",
    0xCA: "cp1254", 0xCB: "cp1253", 0xCC: "cp1257",
}  # fmt: skip
# Encodings of text, each byte below 128 as in ASCII; Python knows others of the same shape of
# name which are compressions, or read escapes.
_FAMILIES = (
    "ascii", "utf-8", "cp", "iso8859", "gb", "big5", "euc_", "johab", "shift_jis", "koi8", "mac-",
)  # fmt: skip
_NUMBERS = {"65001": "utf-8", "20127": "ascii", "936": "gbk", "54936": "gb18030"}
_NAME_BYTES = 10
# Columns are so many bytes wide, not letters, and the last letter may be cut in two: what
# Python's codecs call that.
_CUT = ("unexpected end of data", "incomplete multibyte sequence")


def encoding_of(driver: int, cpg: bytes | None) -> str | None:
    """Return the encoding that a table declares, by its .cpg or its header, or None.

    >>> [encoding_of(0, cpg) for cpg in (b"GBK", b"65001", b"ANSI 1252", b"88591", b"Big5")]
    ['gbk', 'utf-8', 'cp1252', 'iso8859-1', 'big5']
    >>> encoding_of(0x4E, None), encoding_of(0, None), encoding_of(0, b"rot13")
    ('cp949', None, None)
    """
    return _named((cpg or b"")[:40]) or _DRIVERS.get(driver)


def _named(cpg: bytes) -> str | None:
    """Return Python's name of an encoding that is known; `OEM 866` and `ISO 88591` are usual."""
    said = cpg.decode("ascii", errors="ignore").strip().casefold()
    digits = said.removeprefix("ansi").removeprefix("oem").removeprefix("iso").strip(" -_")
    latin = digits.removeprefix("8859").strip("-_ ")
    for name in (
        _NUMBERS.get(digits),
        f"iso8859-{latin}" if digits.startswith("8859") and latin.isdigit() else None,
        f"cp{digits}" if digits.isdigit() else None,
        said,
    ):
        try:
            found = codecs.lookup(name).name if name else ""
            if found.startswith(_FAMILIES) and b"A1".decode(found) == "A1":
                return found
        except (LookupError, ValueError):
            continue
    return None


class Texts:
    """Reads the texts of one table, and keeps in which columns that failed."""

    def __init__(self, driver: int, cpg: bytes | None) -> None:
        self._declared = encoding_of(driver, cpg)
        self._unknown_cpg = (cpg or b"").strip() if _named((cpg or b"")[:40]) is None else b""
        self._wrong: dict[str, None] = {}

    def name_of(self, raw: bytes) -> str:
        """Return a column's name."""
        name, right = self._read(raw.strip(), full=len(raw) >= _NAME_BYTES)
        if not right:
            self._wrong[name] = None
        return name

    def text_of(self, raw: bytes, column: str, *, full: bool) -> str:
        """Return a cell's text; `full`: it fills the width of its column."""
        text, right = self._read(raw, full=full)
        if not right:
            self._wrong[column] = None
        return text

    def _read(self, raw: bytes, *, full: bool) -> tuple[str, bool]:
        """Return a text, and whether its bytes are as declared (as UTF-8, if nothing is)."""
        encoding = self._declared or "utf-8"
        try:
            return raw.decode(encoding), True
        except UnicodeDecodeError as error:
            if full and error.reason in _CUT:
                whole = raw[: error.start]
                right = self._declared is not None or not whole.isascii()
                return whole.decode(encoding).rstrip(), right
        if self._declared is None:
            return raw.decode("latin-1"), False
        return raw.decode(encoding, "replace"), False

    def problems(self, table: Path) -> tuple[Problem, ...]:
        """Return what to tell about the encoding, at most one thing."""
        if not self._wrong:
            return ()
        if self._declared is None:
            unknown = self._unknown_cpg.decode("ascii", "replace")[:40]
            text = (
                f"its .cpg says {unknown!r}, which is no known encoding"
                if unknown
                else "no .cpg and no code page says in which encoding its texts are"
            )
        else:
            text = f"its texts are not all in {self._declared}, which the file declares"
        columns = list(self._wrong)
        return (
            Problem(
                severity="warning",
                code="encoding",
                text=f"{text}; letters of {len(columns)} columns are not read right "
                "(numbers do not depend on it)",
                where=f"{table.name}: {', '.join(columns[:5])}"
                + (" …" if len(columns) > 5 else ""),
                fix="put a .cpg file beside it that names the encoding, such as UTF-8, GBK, "
                "CP949, CP932 or 1252",
            ),
        )
