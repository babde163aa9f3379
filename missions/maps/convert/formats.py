"""The formats in which maps are written; a new one is a function and an entry here.

Each writer gets what its format can hold: zones or cells, the outline of the field and the
default rate where there is room for them, and otherwise zones and cells that say the same.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path

import shapely
from shapely import MultiPolygon
from shapely.errors import ShapelyError

from companion.errors import MapError
from missions.maps.convert.cell_zones import outline_of_rates, plain_zones
from missions.maps.convert.rasterise import cells_of, in_field, north_up
from missions.maps.crs import is_wgs84
from missions.maps.local import polygons_of
from missions.maps.model import MapCells, MapFile, map_error, not_written, unusable_polygons

# Where the operator does not say: narrower than any section of a boom.
CELL_M = 1.0
# To which all formats round at most: a tenth of a millimetre on the ground.
DEGREE_STEP = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True)
class Wish:
    """What the operator says about a file to be written, where its format leaves a choice."""

    cell_m: float | None = None
    flow_width_m: float | None = None
    flow_speed_m_s: float | None = None
    overlap: str = "error"


@dataclass(frozen=True, slots=True, kw_only=True)
class Writer:
    """One format: its name, the suffixes of its files ("" is a folder), and how it is written."""

    name: str
    suffixes: tuple[str, ...]
    write: Callable[[MapFile, Path, Wish], None]


def keeps_cells(map_file: MapFile, wish: Wish) -> bool:
    """Tell whether a format of cells along meridians and parallels takes those of the map."""
    if map_file.cells is None or wish.cell_m is not None:
        return False
    a, b, _, d, _, _ = map_file.cells.transform
    return is_wgs84(map_file.cells.crs) and a > 0.0 and b == d == 0.0


def _zones(name: str, *, clip: bool = False) -> Callable[[MapFile, Path, Wish], None]:
    """Return what writes zones and the field's outline, loaded when it is wanted."""

    def write(map_file: MapFile, path: Path, _: Wish) -> None:
        writer = getattr(import_module(f"missions.maps.{name}"), f"write_{name}")
        boundary = None if map_file.boundary is None else _sound(map_file.boundary)
        writer(plain_zones(map_file, clip=clip), path, boundary=boundary)

    return write


def _isoxml(map_file: MapFile, path: Path, wish: Wish) -> None:
    from missions.maps.isoxml.writer import write_isoxml

    written = map_file
    if wish.cell_m is not None:
        written = replace(map_file, zones=(), cells=_cells(map_file, wish, clip=False))
    elif map_file.cells is not None and not keeps_cells(map_file, wish):
        # The field and its default stay what they are, so no zone need stand for them.
        bare = replace(map_file, boundary=None)
        written = replace(map_file, zones=tuple(plain_zones(bare, clip=False)), cells=None)
    write_isoxml(replace(written, boundary=_field(map_file)), path)


def _field(map_file: MapFile) -> MultiPolygon | None:
    """Return the outline of the field, or where the map has none, of all that has a rate."""
    if map_file.boundary is not None:
        return _sound(map_file.boundary)
    try:
        return _sound(outline_of_rates(map_file))
    except MapError:  # cells too speckled for an outline; the format does without
        return None


def _sound(boundary: MultiPolygon) -> MultiPolygon:
    """Return a boundary whose rings still do not cross when its degrees are rounded in a file."""
    snapped = shapely.set_precision(boundary, DEGREE_STEP)
    return MultiPolygon(polygons_of(snapped)) if polygons_of(snapped) else boundary


def keeps_raster(map_file: MapFile, wish: Wish) -> bool:
    """Tell whether a GeoTIFF takes the cells of the map as they are, in whatever CRS they lie."""
    return map_file.cells is not None and wish.cell_m is None


def _geotiff(map_file: MapFile, path: Path, wish: Wish) -> None:
    from missions.maps.geotiff import write_geotiff

    cells = map_file.cells
    if cells is None or not keeps_raster(map_file, wish):
        made = _cells(map_file, wish, clip=True)
    else:
        made = in_field(cells, map_file, clip=True)
    write_geotiff(made, path)


def _dji(map_file: MapFile, path: Path, wish: Wish) -> None:
    from missions.maps.geotiff import write_dji

    cells = _cells(map_file, wish, clip=False)
    write_dji(cells, path, _field(map_file))


def _cells(map_file: MapFile, wish: Wish, *, clip: bool) -> MapCells:
    if map_file.cells is not None:
        return north_up(map_file, wish.cell_m, clip=clip)
    return cells_of(map_file, wish.cell_m or CELL_M, overlap=wish.overlap, clip=clip)


def _text_map(map_file: MapFile, path: Path, wish: Wish) -> None:
    from missions.maps.text_lattice import text_map_of
    from missions.maps.text_points import write_text_map

    width_m, speed_m_s = wish.flow_width_m, wish.flow_speed_m_s
    if width_m is None or speed_m_s is None or not (width_m > 0.0 and speed_m_s > 0.0):
        raise map_error(
            path,
            "rates in this format are L/min, for one width and speed",
            fix="give both with --flow-width-m and --flow-speed-m-s",
            code="no-flow-basis",
        )
    spacing_m = wish.cell_m
    if spacing_m is not None and not (spacing_m >= 1.0 and spacing_m == int(spacing_m)):
        raise map_error(
            path,
            f"cells of {spacing_m:g} m are not whole metres, as this format has them",
            fix="take --cell-m 1, 2, 3, …",
            code="cell-size",
        )
    points = text_map_of(
        map_file,
        width_m=width_m,
        speed_m_s=speed_m_s,
        spacing_m=None if spacing_m is None else int(spacing_m),
        overlap=wish.overlap,
    )
    write_text_map(points, path)


WRITERS = {
    writer.name: writer
    for writer in (
        # Beside the zones a zip has the boundary too, but few programs heed it.
        Writer(name="shapefile", suffixes=(".shp", ".zip"), write=_zones("shapefile", clip=True)),
        Writer(name="geojson", suffixes=(".geojson", ".json"), write=_zones("geojson")),
        Writer(name="geopackage", suffixes=(".gpkg",), write=_zones("geopackage")),
        Writer(name="kml", suffixes=(".kml", ".kmz"), write=_zones("kml")),
        Writer(name="isoxml", suffixes=(".xml", ".zip", ""), write=_isoxml),
        Writer(name="geotiff", suffixes=(".tif", ".tiff"), write=_geotiff),
        Writer(name="dji", suffixes=(".zip", ""), write=_dji),
        Writer(name="text-map", suffixes=(".txt",), write=_text_map),
    )
}


# Writing a map in any format that can be written: chosen by suffix, made beside, then moved.

# What other programs keep beside a shapefile about its old content.
_STALE = (".sbn", ".sbx", ".qix", ".cpg")
# Letters of the map's name in that of its folder: names have 255 bytes, a letter up to four.
_NAME_MAX = 40


def write_map(
    map_file: MapFile,
    path: Path,
    *,
    format: str | None = None,
    cell_m: float | None = None,
    flow_width_m: float | None = None,
    flow_speed_m_s: float | None = None,
    overlap: str = "error",
    force: bool = False,
    check: Callable[[Path], None] | None = None,
) -> list[Path]:
    """Write a map in the format of the suffix, or in the one named, and return all files.

    They are made in a folder beside `path`, looked at by `check`, and only then moved to where
    they belong; without `force` nothing is replaced. The folder's name is known before there is
    such a folder, so that it is removed wherever an interrupt comes.
    """
    path = Path(path)
    writer = writer_for(path, format)
    wish = Wish(
        cell_m=cell_m, flow_width_m=flow_width_m, flow_speed_m_s=flow_speed_m_s, overlap=overlap
    )
    _check_target(path, force=force)
    folder = path.parent / f".vrspray-{os.getpid()}-{path.name[:_NAME_MAX]}"
    made = folder / path.name
    try:
        # A process of this number may have been killed; what it left is not to be moved.
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(mode=0o700)
        writer.write(map_file, made, wish)
        if check is not None:
            check(made)
        return _moved(folder, path, force=force)
    except MapError as error:
        # The operator knows nothing of the folder.
        text = str(error).replace(str(made), str(path))
        raise MapError(text, code=error.code, fix=error.fix) from None
    except ShapelyError as error:
        raise unusable_polygons(map_file.path, error) from None
    except OSError as error:
        raise not_written(path, error) from None
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def writer_for(path: Path, name: str | None = None) -> Writer:
    """Return the format that the operator names, else the one of the suffix."""
    suffix = path.suffix.casefold()
    if name is not None:
        writer = WRITERS.get(name.casefold())
        if writer is None:
            raise map_error(
                path,
                f"the format {name!r} cannot be written",
                fix=f"take one of {', '.join(WRITERS)}",
                code="unknown-format",
            )
        if suffix not in writer.suffixes:
            names = " or ".join(one or "a folder (no suffix)" for one in writer.suffixes)
            raise map_error(
                path,
                f"{writer.name} is not written as {suffix or 'a folder'}",
                fix=f"name {names}",
                code="unknown-format",
            )
        return writer
    found = [writer for writer in WRITERS.values() if suffix in writer.suffixes]
    if len(found) == 1:
        return found[0]
    if found:
        raise map_error(
            path,
            f"{suffix or 'a folder'} can hold several formats",
            fix=f"say which with --format: {', '.join(writer.name for writer in found)}",
            code="several-formats",
        )
    known = sorted({one for writer in WRITERS.values() for one in writer.suffixes if one})
    raise map_error(
        path,
        f"maps are not written as {suffix}",
        fix=f"take one of {', '.join(known)}",
        code="unknown-format",
    )


def _check_target(path: Path, *, force: bool) -> None:
    try:
        there, folder = path.exists(), path.is_dir()
        parent = path.parent.is_dir()
        full = folder and any(path.iterdir())
    except (OSError, ValueError) as error:
        raise map_error(path, f"is not a path ({error})", fix="check it", code="no-file") from None
    if not parent:
        raise map_error(
            path, "its folder is not there", fix="make the folder first", code="no-file"
        )
    if full:
        raise map_error(
            path, "is a folder with files in it", fix="name a new folder", code="file-exists"
        )
    if there and not folder and not force:
        raise _exists(path, path)


def _exists(path: Path, there: Path) -> Exception:
    return map_error(
        path,
        f"{there.name} is there already",
        fix="name another file, or replace it with --force",
        code="file-exists",
    )


def _moved(folder: Path, path: Path, *, force: bool) -> list[Path]:
    """Move all files from the folder to beside `path`, and return them, `path` first."""
    files = sorted(file for file in folder.rglob("*") if file.is_file())
    # The file that the operator named comes last, when all that it needs is there.
    files.sort(key=lambda file: file.name == path.name)
    targets = [path.parent / file.relative_to(folder) for file in files]
    if not force:
        for target in targets:
            if target.exists():
                raise _exists(path, target)
    if path.suffix.casefold() == ".shp":
        for suffix in _STALE:
            path.with_suffix(suffix).unlink(missing_ok=True)
    for file, target in zip(files, targets, strict=True):
        target.parent.mkdir(parents=True, exist_ok=True)
        file.replace(target)
    return sorted(targets, key=lambda target: target != path)
