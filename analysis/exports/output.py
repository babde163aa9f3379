"""An export appears whole or not at all, and never in the place of something else.

Everything is written into a folder beside its destination, which goes away whatever happens, and
is moved from there when it is complete. Where a move fails, those before it are taken back.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
import shapely
from numpy.typing import NDArray

from companion.errors import VrsprayError
from companion.wording import refuse_existing, writing

if TYPE_CHECKING:
    from shapely import MultiPolygon, Polygon

    from companion.core.frame import LocalFrame

    Ground = Polygon | MultiPolygon


# Content of files by their names, in the order in which they are moved: what makes the others
# worth reading comes last.
Content = Mapping[str, Iterable[bytes]]


class ExportError(VrsprayError):
    """An export cannot be made."""


def check_free(out: Path, names: Iterable[str], *, force: bool) -> None:
    """Refuse a destination that is there already, or whose folder is not."""
    if not out.parent.is_dir():
        raise ExportError(f"{out.parent}: there is no such folder; make it first")
    for name in names:
        refuse_existing(out.parent / name, force=force)


def write_beside(out: Path, content: Content, *, force: bool) -> int:
    """Write files into the folder of `out`; return how many bytes."""
    check_free(out, content, force=force)
    for name in content:
        if (out.parent / name).is_dir():
            raise ExportError(f"{out.parent / name}: is a folder; give another name")
    with (
        writing(f"{out}"),
        tempfile.TemporaryDirectory(prefix=f".{out.name}.", dir=out.parent) as folder,
    ):
        size = _write(Path(folder), content)
        _exchange(Path(folder), out.parent, list(content))
    return size


def write_folder(out: Path, content: Content, *, force: bool) -> int:
    """Write files into a folder of their own, `out`; return how many bytes."""
    check_free(out, [out.name], force=force)
    if out.exists() and not _is_ours(out, content):
        raise ExportError(f"{out}: holds other files; give a folder that is not there yet")
    with (
        writing(f"{out}"),
        tempfile.TemporaryDirectory(prefix=f".{out.name}.", dir=out.parent) as folder,
    ):
        fresh = Path(folder) / "fresh"
        fresh.mkdir()
        size = _write(fresh, content)
        _exchange_folder(fresh, out, Path(folder) / "replaced")
    return size


def _exchange(fresh: Path, place: Path, names: list[str]) -> None:
    """Move files to their place, all or none: what is there already waits in a folder."""
    replaced = fresh / ".replaced"
    replaced.mkdir()
    moved: list[str] = []
    kept: list[str] = []
    try:
        # Old parts under a new name would be taken for one set: all the old ones go first.
        for name in names:
            if (place / name).exists():
                (place / name).rename(replaced / name)
                kept.append(name)
        for name in names:
            (fresh / name).rename(place / name)
            moved.append(name)
    except OSError:
        for name in moved:
            (place / name).unlink(missing_ok=True)
        for name in kept:
            (replaced / name).rename(place / name)
        raise


def _exchange_folder(fresh: Path, out: Path, replaced: Path) -> None:
    """Move a folder to its place; what is there comes back where that fails."""
    is_there = out.exists()
    if is_there:
        out.rename(replaced)
    try:
        fresh.rename(out)
    except OSError:
        if is_there:
            replaced.rename(out)
        raise


def _is_ours(out: Path, content: Content) -> bool:
    """Whether a folder has nothing in it but files of the same names."""
    return out.is_dir() and all(each.is_file() and each.name in content for each in out.iterdir())


def _write(folder: Path, content: Content) -> int:
    size = 0
    for name, chunks in content.items():
        with (folder / name).open("wb") as file:
            for chunk in chunks:
                file.write(chunk)
                size += len(chunk)
            file.flush()
            os.fsync(file.fileno())  # before the name that makes it count
    return size


# From the flight's own frame to longitude and latitude, for whole geometries.

Floats = NDArray[np.float64]


def geographic(grounds: list[Ground], frame: LocalFrame) -> list[Ground]:
    """Return polygons in longitude and latitude, counter-clockwise (RFC 7946)."""
    if not grounds:
        return []

    def moved(points: Floats) -> Floats:
        latitude_deg, longitude_deg = frame.to_geographic_all(*points.T.tolist())
        return np.stack((longitude_deg, latitude_deg), axis=1)

    turned = shapely.orient_polygons(np.array(grounds, dtype=object))
    return cast("list[Ground]", shapely.transform(turned, moved).tolist())
