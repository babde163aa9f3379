"""Whether all tags of a TIFF lie inside the file.

GDAL leaves out a tag that it cannot read, with a warning in its log: of a file cut short or
damaged that could be the scale of the rates, or the value that means no data.
"""

from __future__ import annotations

import struct

# Bytes of each type of value (TIFF 6.0, section 2; BigTIFF: 13 and 16 to 18).
_SIZES = {
    1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4, 16: 8,
    17: 8, 18: 8,
}  # fmt: skip
_ASCII = 2
# Scale, offset, unit and name of each band (GDAL, GTiff driver).
_GDAL_METADATA = 42112
_MAX_DIRECTORIES = 10_000


def check_tags(content: bytes) -> list[bytes]:
    """Return GDAL's own descriptions (XML) in the file.

    Raises `ValueError` for a directory or a tag that does not lie inside the file.
    """
    order = "<" if content[:2] == b"II" else ">"
    big = content[2:4] in (b"+\0", b"\0+")
    seen: set[int] = set()
    descriptions: list[bytes] = []
    try:
        at = struct.unpack_from(f"{order}Q" if big else f"{order}I", content, 8 if big else 4)[0]
        while at:
            if at in seen or len(seen) >= _MAX_DIRECTORIES:
                raise ValueError("its directories follow each other without end")
            seen.add(at)
            at = _check_directory(content, at, order, descriptions, big=big)
    except struct.error:
        raise ValueError("a directory lies beyond its end") from None
    return descriptions


def _check_directory(
    content: bytes, at: int, order: str, descriptions: list[bytes], *, big: bool
) -> int:
    """Return where the next directory is, 0 for none."""
    count_form, entry_form, offset_form = ("Q", "HHQ", "Q") if big else ("H", "HHI", "I")
    count = struct.unpack_from(order + count_form, content, at)[0]
    at += struct.calcsize(order + count_form)
    head, inline = struct.calcsize(order + entry_form), struct.calcsize(order + offset_form)
    if at + count * (head + inline) > len(content):
        raise ValueError("a directory lies beyond its end")
    for _ in range(count):
        tag, kind, number = struct.unpack_from(order + entry_form, content, at)
        at += head
        size = _SIZES.get(kind, 0) * number
        if not size:
            raise ValueError(f"its tag {tag} has no value")
        start = at if size <= inline else struct.unpack_from(order + offset_form, content, at)[0]
        if start + size > len(content):
            raise ValueError(f"its tag {tag} lies beyond its end")
        text = content[start : start + size].rstrip(b"\0") if kind == _ASCII else b""
        if b"\0" in text:
            raise ValueError(f"the text of its tag {tag} is damaged")
        if tag == _GDAL_METADATA:
            descriptions.append(text)
        at += inline
    return int(struct.unpack_from(order + offset_form, content, at)[0])
