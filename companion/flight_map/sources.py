"""Which files a map consists of, by their bytes alone: nothing here looks into one."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Mapping
from pathlib import Path

from companion.config.tables import PrescriptionTable
from companion.errors import MapError
from companion.flight_map.model import SourceFile, is_flight_map

# As for any folder or file of a map (missions/maps/bundle.py, layer.py).
_FILES_MAX = 2_000
_BYTES_MAX = 1024 * 1024 * 1024
_CHUNK_BYTES = 1 << 20
# Formats whose files name others beside them as they like.
_WITH_FOLDER = (".xml", "adapt.json")


def named_files(table: PrescriptionTable, lines: str | None, folder: Path) -> dict[str, Path]:
    """Return every file that a flight map is compiled from, by the setting that names it."""
    named: dict[str, str | None] = {
        "prescription.file": table.file,
        "prescription.boundary": table.boundary,
        **{
            f"prescription.exclusions[{number}]": name
            for number, name in enumerate(table.exclusions)
        },
        "mission.lines": lines,
    }
    return {key: folder / name for key, name in named.items() if name is not None}


def sources_of(named: Mapping[str, Path]) -> tuple[SourceFile, ...]:
    """Return every file of the maps, boundaries and plans that the settings name, with its hash.

    Raises:
        MapError: where one cannot be read, or there are too many.
    """
    found = []
    for key, path in named.items():
        try:
            for name, file in _files(path):
                found.append(SourceFile(key=key, name=name, sha256=_sha256(file)))
        except (OSError, ValueError) as error:
            raise MapError(
                f"{path}: cannot be read ({error}); check path and rights",
                code="no-file",
                fix="check path and rights",
            ) from None
    return tuple(found)


def _files(path: Path) -> Iterator[tuple[str, Path]]:
    """Yield the files that belong to one path, by their names: a set beside it, or a folder."""
    if path.is_dir():
        start = path
        places = [Path(folder) / name for folder, _, names in os.walk(path) for name in names]
    else:
        start = path.parent
        has_folder = path.name.casefold().endswith(_WITH_FOLDER)
        begin = "" if has_folder else path.stem.casefold()
        places = [file for file in start.iterdir() if file.name.casefold().startswith(begin)]
        places.append(path)
    # What this program writes beside a map is none of its parts.
    files = sorted({file for file in places if file.is_file() and not is_flight_map(file)})
    if len(files) > _FILES_MAX:
        raise ValueError(f"more than {_FILES_MAX} files")
    if sum(file.stat().st_size for file in files) > _BYTES_MAX:
        raise ValueError(f"more than {_BYTES_MAX // 1024**2} MB")
    for file in files:
        yield file.relative_to(start).as_posix(), file


def _sha256(path: Path) -> str:
    found = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK_BYTES):
            found.update(chunk)
    return found.hexdigest()
