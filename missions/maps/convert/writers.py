"""Writing a map in any format that can be written: chosen by suffix, made beside, then moved."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

from shapely.errors import ShapelyError

from companion.errors import MapError
from missions.maps.convert.formats import WRITERS, Wish, Writer
from missions.maps.model import MapFile, map_error, unusable_polygons
from missions.maps.whole_file import not_written

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
        raise map_error(path, f"is no path ({error})", fix="check it", code="no-file") from None
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
