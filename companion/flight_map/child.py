"""The flight map of a configuration: opened, or compiled first by a process of its own.

Whatever else than a flight map a configuration names was made by strangers, in formats with many
corners. It is read by a child process, `vrspray map compile`, which has ended before anything of a
flight begins. Its result is kept: a flight that starts again in the air compiles nothing.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any

from companion.commands import is_there
from companion.config import Config
from companion.config.tables import PrescriptionTable
from companion.errors import NOT_ENOUGH_MEMORY, ConfigError, MapError
from companion.flight_map.file import (
    SUFFIX,
    VERSION,
    FlightMap,
    SourceFile,
    frozen_settings,
    is_flight_map,
    named_files,
    read_flight_map,
)
from companion.wording import show_value

_logger = logging.getLogger(__name__)

_FOLDER = "flightmaps"
_KEPT_MAX = 8
# systemd waits 120 s for a start (companion/cli/vrspray.service).
_TIMEOUT_S = 100.0
_MEMORY_MAX_BYTES = 2 * 1024**3
_WRITTEN = (0, 1)
_COMPILER = ("map", "compile")


def compiled(
    config: Config, table: PrescriptionTable, overrides: Sequence[str] = (), *, keep: bool = True
) -> FlightMap:
    """Return what was compiled of these very files with these settings, now or before.

    `overrides` are those that the configuration was read with. What only looks does not `keep` it.

    Raises:
        ConfigError, MapError: where a file cannot be used.
    """
    settings = frozen_settings(table, config.planned_lines, config.buffers)
    known_by = json.dumps(
        [VERSION, version("vrspray"), str(config.resolve(table.file)), settings], sort_keys=True
    )
    folder = config.resolve(config.link.state_folder) / _FOLDER
    kept = folder / f"{hashlib.sha256(known_by.encode()).hexdigest()[:16]}{SUFFIX}"
    found = _still_good(kept, config, table)
    if found is not None:
        return found
    if keep and _is_writable(folder):
        _compile(config, table, overrides, kept)
        _forget_old(folder)
        return read_flight_map(kept)
    with tempfile.TemporaryDirectory(prefix="vrspray-") as elsewhere:
        path = Path(elsewhere) / kept.name
        _compile(config, table, overrides, path)
        return read_flight_map(path)


def _is_writable(folder: Path) -> bool:
    with suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK):
            return True
    _logger.warning("%s cannot be written: the map is compiled at every start", folder)
    return False


def _still_good(kept: Path, config: Config, table: PrescriptionTable) -> FlightMap | None:
    """Return what was compiled before, if it can be read and no file of the map has changed."""
    if not kept.exists():
        return None
    try:
        found = read_flight_map(kept)
    except MapError:
        return None
    here = sources_of(named_files(table, config.planned_lines, config.path.parent, config.buffers))
    return found if here == found.sources else None


def _forget_old(folder: Path) -> None:
    with suppress(OSError):
        found = sorted(folder.glob(f"*{SUFFIX}"), key=lambda file: file.stat().st_mtime)
        for file in found[:-_KEPT_MAX]:
            file.unlink(missing_ok=True)


def flight_map_of_file(path: Path, *, overlap: str) -> FlightMap:
    """Return a flight map, or that of any other map without a configuration.

    Raises:
        ConfigError, MapError: where it cannot be compiled.
    """
    if is_flight_map(path):
        return read_flight_map(path)
    with tempfile.TemporaryDirectory(prefix="vrspray-") as folder:
        out = Path(folder) / f"map{SUFFIX}"
        if not is_there(_COMPILER[0]):
            raise _not_here(str(path), path, None)
        _run(str(path), [str(path), "--overlap", overlap, "--out", str(out)], out)
        return read_flight_map(out)


def _compile(config: Config, table: PrescriptionTable, overrides: Sequence[str], out: Path) -> None:
    """Have a child process compile the map of a configuration."""
    named = f"{config.path}: prescription.file = {show_value(table.file)}"
    path = config.resolve(table.file)
    if not is_there(_COMPILER[0]):
        raise _not_here(named, path, config.path)
    order = [str(path), "--config", str(config.path), "--out", str(out)]
    _run(named, order + [part for each in overrides for part in ("--set", each)], out)


def _run(named: str, order: Sequence[str], out: Path) -> None:
    """Run the compiler; it has ended when this returns.

    Raises:
        ConfigError, MapError: what it refused, in its words.
    """
    memory_max = _memory_max_bytes()
    try:
        code, stdout = _ended([*_COMPILER, *order, "--json"], memory_max)
    except subprocess.TimeoutExpired as error:
        raise _failed(named, f"it took longer than {_TIMEOUT_S:.0f} s") from error
    except OSError as error:
        raise _failed(named, str(error)[:200]) from error
    if code in _WRITTEN and out.exists():
        return
    said = _said(stdout)
    problems = said.get("problems")
    text = said.get("error")
    if text == NOT_ENOUGH_MEMORY:
        raise _failed(named, f"it needs more than {memory_max // 1024**2} MB of memory")
    if not isinstance(text, str):
        raise _failed(named, f"the compiler ended with {code}")
    if isinstance(problems, list) and problems:
        reason, fix = (str(problems[0][key]) for key in ("code", "fix"))
        raise MapError(text, code=reason, fix=fix)
    raise ConfigError(text)


def _ended(words: Sequence[str], memory_max: int) -> tuple[int, bytes]:
    """Return a command's exit code and what it said; it is killed where that takes too long."""
    with subprocess.Popen(
        [sys.executable, "-P", "-m", "companion", *words],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    ) as compiler:
        try:
            _limit_memory(compiler.pid, memory_max)
            stdout, _ = compiler.communicate(timeout=_TIMEOUT_S)
        except BaseException:
            compiler.kill()
            raise
    return compiler.returncode, stdout


def _memory_max_bytes() -> int:
    """Return what the compiler may take: half of this computer's memory, and 2 GB at most."""
    return min(_MEMORY_MAX_BYTES, os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2)


def _limit_memory(pid: int, most_bytes: int) -> None:
    """Have the kernel refuse a process more memory of its own; programs and files do not count.

    The address space is no measure: threads and libraries reserve far more than they use.
    """
    with suppress(ProcessLookupError):  # it has ended already
        resource.prlimit(pid, resource.RLIMIT_DATA, (most_bytes, most_bytes))


def _not_here(named: str, path: Path, config: Path | None) -> MapError:
    """Return the refusal of a map on a vehicle that opens flight maps only."""
    name = f"{path.stem}{SUFFIX}"
    fix = f"compile it in the office: vrspray map compile {path.name} --out {name}"
    if config is not None:
        fix = f'{fix} --config {config.name}; then write prescription.file = "{name}"'
    return MapError(
        f"{named}: this vehicle opens flight maps only ({SUFFIX}); {fix}",
        code="not-compiled",
        fix=fix,
    )


def _said(stdout: bytes) -> dict[str, Any]:
    try:
        found = json.loads(stdout)
    except (ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def _failed(named: str, reason: str) -> MapError:
    fix = "compile it in the office: vrspray map compile"
    return MapError(f"{named}: cannot be compiled ({reason}); {fix}", code="not-compiled", fix=fix)


# Which files a map consists of, by their bytes alone: nothing here looks into one.

# As for any folder or file of a map (missions/maps/bundle.py, model.py).
_FILES_MAX = 2_000
_BYTES_MAX = 1024 * 1024 * 1024
_CHUNK_BYTES = 1 << 20
# Formats whose files name others beside them as they like.
_WITH_FOLDER = (".xml", "adapt.json")


def sources_of(named: Mapping[str, Path]) -> tuple[SourceFile, ...]:
    """Return every file of the maps, boundaries and plans that the settings name, with its hash.

    Raises:
        MapError: where one cannot be read, or there are too many.
    """
    found = []
    for key, path in named.items():
        try:
            for name, file in belonging_files(path):
                found.append(SourceFile(key=key, name=name, sha256=_sha256(file)))
        except (OSError, ValueError) as error:
            raise MapError(
                f"{path}: cannot be read ({error}); check path and rights",
                code="no-file",
                fix="check path and rights",
            ) from None
    return tuple(found)


def belonging_files(path: Path) -> Iterator[tuple[str, Path]]:
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
