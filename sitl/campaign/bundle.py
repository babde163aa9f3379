"""The files that a campaign names, as what travels to workers: those need the wheel and no more.

The files keep their places relative to each other. A worker asks for them once, by their hash.
"""

from __future__ import annotations

import atexit
import hashlib
import os
import platform
import shutil
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING

from companion.config import load
from companion.errors import ConfigError, MapError
from companion.flight_map.child import belonging_files
from companion.flight_map.file import named_files
from sitl.anyang import EXAMPLE
from sitl.campaign.settings import Value, overrides_of
from sitl.profile import PROFILES

if TYPE_CHECKING:
    from sitl.campaign.design import Campaign

BYTES_MAX = 200_000_000
OURS = ("companion", "missions", "analysis", "sitl")
LIBRARIES = ("numpy", "scipy", "shapely", "pyproj", "pyarrow", "vrspray")
NO_CODE = ("sitl/examples/", "companion/deploy/")
DATA = frozenset({".toml", ".geojson", ".shp", ".shx", ".dbf", ".prj", ".cpg"})
FILES = ("flight.config", "flight.mission", "flight.scenario")


@dataclass(frozen=True)
class Bundle:
    """Files by their places below one folder, and where the campaign's own folder is there."""

    files: Mapping[str, bytes]
    start: str

    @cached_property
    def sha256(self) -> str:
        """Return the hash of names and contents."""
        found = hashlib.sha256(self.start.encode())
        for name in sorted(self.files):
            found.update(f"\0{name}\0{len(self.files[name])}\0".encode() + self.files[name])
        return found.hexdigest()

    def hashes(self) -> dict[str, str]:
        """Return the hash of each file, for the manifest."""
        return {name: hashlib.sha256(self.files[name]).hexdigest() for name in sorted(self.files)}


def bundle_of(campaign: Campaign) -> Bundle:
    """Return all files that any flight of a campaign reads.

    Raises:
        ConfigError: where one cannot be read, or no flight could be flown.
    """
    folder = campaign.path.resolve().parent
    paths: set[Path] = set()
    for given in campaign.tried():
        paths.update(_files_of(given, folder))
    if not paths:
        return Bundle({}, ".")
    root = Path(os.path.commonpath([folder, *(path.parent for path in paths)]))
    try:
        if sum(path.stat().st_size for path in paths) > BYTES_MAX:
            raise ConfigError(
                f"{campaign.path}: its files hold more than {BYTES_MAX // 10**6} MB; clip the map"
            )
        files = {path.relative_to(root).as_posix(): path.read_bytes() for path in sorted(paths)}
    except OSError as error:
        raise ConfigError(f"{error.filename}: {error.strerror}; check path and rights") from error
    return Bundle(files, folder.relative_to(root).as_posix())


def _files_of(given: Mapping[str, Value], folder: Path) -> Iterable[Path]:
    for name in FILES:
        if name in given:
            yield _there(folder / str(given[name]), name)
    if str(given.get("plant.profile", "")).endswith(".toml"):
        yield _there(folder / str(given["plant.profile"]), "plant.profile")
    controller = str(given.get("method.controller", "")).rpartition(":")[0]
    if controller.endswith(".py"):
        yield _there(folder / controller, "method.controller")
    if "flight.config" in given:
        yield from _files_of_config(given, folder)


def _files_of_config(given: Mapping[str, Value], folder: Path) -> Iterable[Path]:
    """Yield what the configuration names; of one that is refused the flight's row will tell."""
    path = folder / str(given["flight.config"])
    try:
        config = load(path, overrides=overrides_of(given))
    except ConfigError:
        return
    if config.prescription is None:
        return
    lines = None if config.mission is None else config.mission.lines
    for key, named in named_files(config.prescription, lines, path.parent).items():
        if not named.is_relative_to(path.parent):
            raise ConfigError(
                f"{path}: {key} = '{named}': an absolute path does not travel to other computers; "
                "write it relative to the configuration"
            )
        try:
            yield from (file.resolve() for _, file in belonging_files(named))
        except (OSError, ValueError, MapError) as error:
            raise ConfigError(f"{path}: {key} = '{named}': cannot be read ({error})") from error


def _there(path: Path, name: str) -> Path:
    if not path.is_file():
        raise ConfigError(
            f"{name} = '{path}': no such file; write its path relative to the campaign"
        )
    return path.resolve()


# ------------------------------------------------------------------------------------- at a worker

_unpacked: dict[str, Path] = {}


def folder_of(sha256: str) -> Path | None:
    """Return where this process has the files of a hash; None where it has to be given them."""
    return _unpacked.get(sha256)


def unpack(bundle: Bundle, root: Path) -> Path:
    """Write the files below `root`, and return the campaign's folder there."""
    for name, content in bundle.files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    folder = (root / bundle.start).resolve()
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def keep(bundle: Bundle) -> Path:
    """Return the campaign's folder among files that are there until this process ends."""
    root = Path(tempfile.mkdtemp(prefix="vrspray-campaign-", dir=_own_folder()))
    atexit.register(shutil.rmtree, root, ignore_errors=True)
    return _unpacked.setdefault(bundle.sha256, unpack(bundle, root))


def _own_folder() -> str | None:
    """Return a Dask worker's own folder, which its cluster clears after a kill; None elsewhere."""
    distributed = sys.modules.get("distributed")
    if distributed is None:
        return None
    try:
        return str(distributed.get_worker().local_directory)
    except ValueError:
        return None


# ------------------------------------------------------------------------------ what flew, exactly


@lru_cache(maxsize=1)
def code_sha256() -> str:
    """Return the hash of this program's own code: rows of two of them do not go together."""
    found = hashlib.sha256()
    for name, path in program_files():
        found.update(f"\0{name}\0".encode() + path.read_bytes())
    return found.hexdigest()


def program_files() -> Iterator[tuple[str, Path]]:
    """Yield what of this program decides on figures: code, sprayers, and the published field.

    The same in a source tree and in an installed wheel, where examples and what is installed on a
    vehicle are files of the packages.
    """
    root = Path(__file__).parents[2]
    for package in OURS:
        for path in sorted((root / package).rglob("*.py")):
            name = path.relative_to(root).as_posix()
            if not name.startswith(NO_CODE):
                yield name, path
    for folder in (PROFILES, EXAMPLE):
        for path in sorted(folder.rglob("*")):
            if path.suffix in DATA:
                yield f"{folder.name}/{path.relative_to(folder).as_posix()}", path


def versions() -> dict[str, str]:
    """Return what figures may depend on."""
    found = {"python": platform.python_version()}
    for name in LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
