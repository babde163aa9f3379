"""The bytes of a GeoTIFF, taken apart by GDAL (rasterio) within bounds.

GDAL is given the bytes and those of the files beside it, and nothing else: it opens no other file,
format or address, and what it would allocate is known from the head of the file before any cell is
read.
"""

from __future__ import annotations

import re
import struct
import warnings
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any
from xml.etree.ElementTree import tostring

from pyproj import CRS

from companion.errors import MapError
from companion.wording import lack_of
from missions.maps.bundle import Bundle, parse_xml
from missions.maps.crs import parse_crs, stated
from missions.maps.geotiff_bands import (
    RawBand,
    ReadBand,
    beside,
    difference,
    parse_world_file,
    read_band,
    world_file_of,
)
from missions.maps.model import Affine, Problem, Stated, map_error

MAX_CELLS = 16_000_000
MAX_BANDS = 64
MAX_VALUES = 64_000_000
_MAGIC = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_MAX_PAGES = 1_000
# No world file: ours is read by other rules.
_OPTIONS = {
    "GDAL_DISABLE_READDIR_ON_OPEN": True,
    "GDAL_PAM_ENABLED": True,
    "GDAL_GEOREF_SOURCES": "PAM,INTERNAL",
    "GDAL_CACHEMAX": 64,
    "GDAL_NUM_THREADS": "1",
}
_IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
_UNIT_TAGS = ("unit", "units", "uom")
# The name of the copy in memory, which means nothing to anybody.
_COPY = re.compile(
    r"'?(?:GTIFF_DIR:\d+:)?(?:/vsimem/)?[0-9a-f-]{36}(?:/[^\s:']*)?(?:\.tif)?'?:?\s*"
)

# What a file beside the map (`rx.tif.aux.xml`) says of its numbers and its place. The rest is
# statistics and names of other files, which GDAL would open.
_AUX, _MASK, _IMAGINE = ".aux.xml", ".msk", ".aux"
_AUX_NUMBERS = ("nodatavalue", "scale", "offset")
_AUX_KEPT = (
    *_AUX_NUMBERS, "unittype", "description", "colorinterp", "metadata", "pamrasterband", "srs",
    "geotransform", "gcplist",
)  # fmt: skip
_NO_PIXELS = re.compile(r"IReadBlock|Read failed")


@dataclass(frozen=True, slots=True, kw_only=True)
class Raster:
    """What a file and those beside it say: `transform` from corners of cells."""

    crs: Stated
    transform: Affine
    bands: tuple[ReadBand, ...]
    unit: str | None
    files: dict[str, bytes]
    problems: tuple[Problem, ...] = ()


def gdal(path: Path) -> Any:
    """Return rasterio, or say how to get it."""
    try:
        import rasterio
        import rasterio.io
    except ImportError:
        text, fix = lack_of("rasterio")
        raise map_error(path, text, fix=fix, code="missing-library") from None
    return rasterio


def read_raster(
    bundle: Bundle, name: str, *, layer: str | None, described: bool, colours: bool = False
) -> Raster:
    """Return all bands of the GeoTIFF `name`, with what the files beside it say, as GDAL does.

    Maps of rates, measurements and heights are all read here. `described`: another file says what
    each band is. With `colours` they may be those of a camera: they are no rates then, but
    measurements.
    """
    path = bundle.path / name
    files = {name: bundle.read(name)}
    content = files[name]
    if not content.startswith(_MAGIC):
        raise map_error(
            path, "this is not a TIFF file", fix="export the map again as GeoTIFF",
            code="unknown-format",
        )  # fmt: skip
    world_name, world = world_file_of(bundle, name), None
    if world_name is not None:
        files[world_name] = bundle.read(world_name)
    sidecars = _sidecars(bundle, name, files)
    with _opened(content, sidecars, path, layer) as source:
        _check_size(source, path)
        _check_numbers(source, path)
        if not described and not colours:
            _check_no_picture(source, path)
        crs, transform = stated(_crs, source, path), _transform(source, path)
        tags = {key.casefold(): text for key, text in source.tags().items()}
        alpha = set() if described else _alpha(source)
        bands = tuple(
            read_band(_raw_band(source, index, described=described), path)
            for index in source.indexes
            if index not in alpha
        )
        shape = source.shape
    if not bands:
        raise map_error(
            path, "it has no band of values", fix="export the map again", code="no-rate-column"
        )
    if world_name is not None:
        where = bundle.path / world_name
        world = parse_world_file(files[world_name], where, alone=transform is None)
    transform, problems = _placed(transform, world, shape, crs, path)
    unit = next((tags[key] for key in _UNIT_TAGS if tags.get(key)), None)
    return Raster(
        crs=crs, transform=transform, bands=bands, unit=unit, files=files, problems=problems
    )


def _placed(
    own: Affine | None, world: Affine | None, shape: tuple[int, int], crs: Stated, path: Path
) -> tuple[Affine, tuple[Problem, ...]]:
    """Return where the cells lie: by the file itself, else by its world file."""
    if own is None and world is None:
        raise map_error(
            path,
            "it does not say where it lies",
            fix="export it as GeoTIFF, or copy its .tfw beside it",
            code="not-georeferenced",
        )
    if own is None or world is None:
        return own or world or _IDENTITY, ()
    problem = difference(own, world, shape, crs if isinstance(crs, CRS) else None, path)
    return own, () if problem is None else (problem,)


def _sidecars(bundle: Bundle, name: str, files: dict[str, bytes]) -> dict[str, bytes]:
    """Return what GDAL is to find beside a GeoTIFF, by suffix, and add the files themselves."""
    found = {}
    for suffix in (_AUX, _MASK):
        other = beside(bundle, name, f"{name}{suffix}")
        if other is not None:
            files[other] = found[suffix] = bundle.read(other)
    if _AUX in found:
        found[_AUX] = _aux(found[_AUX], bundle.path / f"{name}{_AUX}")
    old = beside(bundle, name, f"{name}{_IMAGINE}", f"{name.rpartition('.')[0]}{_IMAGINE}")
    if old is not None and bundle.read(old).startswith(b"EHFA_HEADER_TAG"):
        raise map_error(
            bundle.path / name,
            f"{old} lies beside it, which may say what is no data and is not read",
            fix="export the map again as one GeoTIFF, or remove that file",
            code="file-beside",
        )
    return found


def _aux(content: bytes, path: Path) -> bytes:
    """Return what a file of GDAL's beside the map says of its numbers and its place."""
    root = parse_xml(content, path)
    for parent in (root, *[each for each in root if each.tag.casefold() == "pamrasterband"]):
        for child in [*parent]:
            tag = child.tag.casefold()
            if tag not in _AUX_KEPT or child.get("domain"):
                parent.remove(child)
            if tag in _AUX_NUMBERS:
                try:
                    float(child.text or "")
                except ValueError:
                    raise map_error(
                        path, f"its {child.tag} {(child.text or '')[:40]!r} is not a number",
                        fix="export the map again", code="bad-rate",
                    ) from None  # fmt: skip
    return tostring(root)


@contextmanager
def _opened(
    content: bytes, sidecars: dict[str, bytes], path: Path, layer: str | None
) -> Iterator[Any]:
    rasterio = gdal(path)
    from rasterio._err import CPLE_BaseError

    broken = (
        rasterio.errors.RasterioError, CPLE_BaseError, OSError, ValueError, OverflowError,
         MemoryError, KeyError, AttributeError,
    )  # fmt: skip
    try:
        for part in (content, *(sidecars[each] for each in sidecars if each == _MASK)):
            if not part.startswith(_MAGIC):
                raise ValueError(f"its {_MASK} is not a TIFF file")
            for description in check_tags(part):
                # GDAL does without one that it cannot read, and so without the scale of the rates.
                parse_xml(description, path, name="its description of the bands")
        with ExitStack() as stack:
            stack.enter_context(warnings.catch_warnings())
            stack.enter_context(rasterio.Env(**_OPTIONS))
            warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
            memory = stack.enter_context(rasterio.io.MemoryFile(content))
            place = PurePosixPath(memory.name)
            mask = None
            for suffix, part in sidecars.items():
                one = rasterio.io.MemoryFile(part, dirname=place.parent.name,
                                             filename=f"{place.name}{suffix}")  # fmt: skip
                stack.enter_context(one)
                mask = one if suffix == _MASK else mask
            source = stack.enter_context(memory.open(driver="GTiff"))
            page = _page(source.subdatasets, path, layer)
            if page is not None:
                _check_alone(sidecars, path)
                source = stack.enter_context(rasterio.open(page, driver="GTiff"))
            if mask is not None:
                _check_mask(stack.enter_context(mask.open(driver="GTiff")), source, path)
            yield source
    except MapError:
        raise
    except broken as error:
        reason = _COPY.sub("", f"{error.__cause__ or error}")[:120]
        if _NO_PIXELS.search(reason):
            reason = "its pixels cannot be read"
        raise map_error(
            path,
            f"the GeoTIFF is cut short or damaged ({reason})",
            fix="copy it again, or export the map again",
            code="truncated",
        ) from None


def _check_alone(sidecars: Iterable[str], path: Path) -> None:
    for suffix in sidecars:
        raise map_error(
            path, f"it holds several pictures, and {path.name}{suffix} does not say of which it is",
            fix="export the picture that is meant as a GeoTIFF of its own", code="file-beside",
        )  # fmt: skip


def _check_mask(mask: Any, source: Any, path: Path) -> None:
    if mask.shape != source.shape or mask.count not in (1, source.count):
        raise map_error(
            path, f"its mask {path.name}{_MASK} is not of as many rows, columns and bands",
            fix="copy the files again, or export the map again", code="file-beside",
        )  # fmt: skip
    _check_size(mask, path)


def _page(pages: list[str], path: Path, layer: str | None) -> str | None:
    """Return the picture that is meant in a file of several, None in a file of one."""
    count = len(pages)
    if count <= 1:
        if layer not in (None, "1", path.stem):
            raise map_error(
                path, f"it is not the layer {layer!r}", fix="leave out --layer", code="no-layer"
            )
        return None
    numbers = [str(number) for number in range(1, min(count, _MAX_PAGES) + 1)]
    if layer not in numbers:
        raise map_error(
            path,
            f"the file holds {count} pictures"
            + (f", and none called {layer!r}" if layer is not None else ""),
            fix=f"name one of them with --layer, 1 to {count}",
            code="several-layers" if layer is None else "no-layer",
        )
    return pages[int(layer) - 1]


def _check_size(source: Any, path: Path) -> None:
    """Refuse what would take the vehicle's memory; the head of the file says it all."""
    cells, bands = source.width * source.height, source.count
    block = max(rows * columns for rows, columns in source.block_shapes)
    for count, limit, of in (
        (cells, MAX_CELLS, "cells"),
        (bands, MAX_BANDS, "bands"),
        (cells * bands, MAX_VALUES, "values"),
        (block * bands, MAX_VALUES, "values in one block"),
    ):
        if not 0 < count <= limit:
            raise map_error(
                path,
                f"its {count} {of} are more than {limit}",
                fix="cut the map to one field, or make its cells larger",
                code="too-large",
            )


def _check_no_picture(source: Any, path: Path) -> None:
    """Refuse colours."""
    colours = {interpretation.name for interpretation in source.colorinterp}
    bytes_only = set(source.dtypes) == {"uint8"}
    if "palette" in colours or (bytes_only and {"red", "green", "blue"} <= colours):
        raise map_error(
            path,
            "this is a picture: its numbers are colours, not rates",
            fix="export the rates themselves as GeoTIFF (raw values, not a rendered image)",
            code="picture",
        )


def _check_numbers(source: Any, path: Path) -> None:
    if any("complex" in dtype for dtype in source.dtypes):
        raise map_error(
            path, "its values are complex numbers", fix="export the rates", code="bad-rate"
        )


def _alpha(source: Any) -> set[int]:
    """Return the bands that only say which cells are there."""
    return {
        index
        for index, kind in zip(source.indexes, source.colorinterp, strict=True)
        if kind.name == "alpha"
    }


def _crs(source: Any, path: Path) -> CRS | None:
    text = source.crs.to_wkt() if source.crs else ""
    return parse_crs(text, path=path, source="what it says of its coordinates") if text else None


def _transform(source: Any, path: Path) -> Affine | None:
    """Return where the cells lie; GDAL turns the centres of `PixelIsPoint` into corners."""
    transform = source.transform
    found = (transform.a, transform.b, transform.c, transform.d, transform.e, transform.f)
    if found == _IDENTITY:
        if source.gcps[0] or source.rpcs:
            raise map_error(
                path,
                "it has control points, but no rows and columns of a map",
                fix="warp it to a map projection (in QGIS: Georeferencer), and export it again",
                code="not-georeferenced",
            )
        return None
    a, b, c, d, e, f = found
    if not (a * e - b * d != 0.0 and all(abs(value) <= 1e9 for value in (a, b, c, d, e, f))):
        raise map_error(
            path,
            "its cells have no size, or are not on Earth",
            fix="export the map again",
            code="not-georeferenced",
        )
    return found


def _raw_band(source: Any, index: int, *, described: bool) -> RawBand:
    at = index - 1
    flags = {flag.name for flag in source.mask_flag_enums[at]}
    # A mask beside the file may be one for each band, and has no flag then.
    hides = not flags & {"all_valid", "nodata", "alpha"} or "per_dataset" in flags
    hides = hides and not (described and "alpha" in flags)
    tags = {name.casefold(): text for name, text in source.tags(index).items()}
    return RawBand(
        name=" ".join((source.descriptions[at] or "").split())[:60] or f"band {index}",
        values=source.read(index),
        nodata=source.nodatavals[at],
        hidden=source.read_masks(index) == 0 if hides else None,
        scale=source.scales[at],
        offset=source.offsets[at],
        unit=source.units[at] or next((tags[name] for name in _UNIT_TAGS if tags.get(name)), None),
    )


# Whether all tags of a TIFF lie inside the file.
#
# GDAL leaves out a tag that it cannot read, with a warning in its log: of a file cut short or
# damaged that could be the scale of the rates, or the value that means no data.

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
