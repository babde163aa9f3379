"""The files of an ISOXML task: where TASKDATA.XML lies, what it refers to, and their bytes.

One code path for a folder, a zip and the XML file itself. Names are found in any case, since
terminals and file systems change it; grids and external files lie in the folder of TASKDATA.XML.
"""

from __future__ import annotations

import re
from pathlib import Path, PurePosixPath
from xml.etree.ElementTree import Element

from missions.maps.bundle import Bundle, open_bundle
from missions.maps.isoxml.values import EXPORT_AGAIN, children, required, tag, text
from missions.maps.layer import MAX_FILE_BYTES, digest
from missions.maps.model import Problem, map_error
from missions.maps.xmltree import MAX_ELEMENTS, parse_xml

_TASK_DATA = "TASKDATA.XML"
# "TSK00001", "GRD00001": ISO 11783-10 wants three letters and five digits.
_FILE_NAME = re.compile(r"[A-Za-z0-9_-]{1,32}")
_KNOWN_VERSIONS = ("3", "4")
# Drafts of what became version 3; the elements of a prescription are the same.
_OLD_VERSIONS = ("0", "1", "2")


class TaskFiles:
    """TASKDATA.XML with its external files merged in; remembers all bytes that were used."""

    def __init__(self, path: Path) -> None:
        """Find, read and merge, or refuse."""
        self.path = path
        self._bundle = _bundle(path)
        self._used: dict[str, bytes] = {}
        self._main = _main_name(self._bundle, path)
        self.root = parse_xml(self._read(self._main), path, name=self._main)
        self.problems = _check_root(self.root, path)
        self._merge()

    @property
    def sha256(self) -> str:
        """Return the digest over the bytes of all files used, in the order of their names."""
        return digest(self._used[name] for name in sorted(self._used))

    def referred(self, name: str, suffix: str) -> bytes:
        """Return the bytes of a file that the task data names without its suffix."""
        stem = name[: -len(suffix)] if name.casefold().endswith(suffix) else name
        if not _FILE_NAME.fullmatch(stem):
            raise map_error(
                self.path,
                f"it refers to a file {name[:40]!r}, which is no name of a task file",
                fix=EXPORT_AGAIN,
                code="bad-attribute",
            )
        folder = PurePosixPath(self._main).parent
        found = [
            one for one in self._bundle.called(stem + suffix) if PurePosixPath(one).parent == folder
        ]
        # On a stick both GRD00001.BIN and grd00001.bin are one file, in a folder two.
        if len(found) > 1:
            raise map_error(
                self.path,
                f"there are several files for {stem}: {', '.join(found)}",
                fix="keep the one that belongs to the task",
                code="duplicate-code",
            )
        if not found:
            raise map_error(
                self.path,
                f"the file {stem}{suffix} to which it refers is not there",
                fix=f"copy it beside {PurePosixPath(self._main).name}",
                code="no-file",
            )
        return self._read(found[0])

    def _read(self, name: str) -> bytes:
        if name not in self._used:
            self._used[name] = self._bundle.read(name)
            if sum(map(len, self._used.values())) > MAX_FILE_BYTES:
                raise map_error(
                    self.path,
                    f"its files have more than {MAX_FILE_BYTES // 1024**2} MB together",
                    fix="export one field",
                    code="too-large",
                )
        return self._used[name]

    def _merge(self) -> None:
        """Put the elements of external files (XFR) where the references stand."""
        seen: set[str] = set()
        count = 0
        for reference in children(self.root, "XFR"):
            name = required(reference, "A", self.path)
            if name.casefold() in seen:
                raise map_error(
                    self.path,
                    f"it refers to the external file {name[:40]} twice",
                    fix=EXPORT_AGAIN,
                    code="duplicate-code",
                )
            seen.add(name.casefold())
            external = parse_xml(self.referred(name, ".xml"), self.path, name=name)
            if tag(external) != "XFC":
                raise map_error(
                    self.path,
                    f"its external file {name[:40]} is no part of a task ({tag(external)[:40]})",
                    fix=EXPORT_AGAIN,
                    code="unknown-format",
                )
            count += sum(1 for _ in external.iter())
            if count > MAX_ELEMENTS:
                raise map_error(
                    self.path,
                    f"its external files have more than {MAX_ELEMENTS} elements together",
                    fix="export one field",
                    code="too-large",
                )
            self.root.extend(external)
            self.root.remove(reference)


def _bundle(path: Path) -> Bundle:
    """Return the files beside a TASKDATA.XML, or those in a folder or zip."""
    if path.suffix.casefold() != ".xml" or path.is_dir():
        return open_bundle(path)
    try:
        beside: dict[str, Path] = {
            file.name: file
            for file in sorted(path.parent.iterdir())
            if file.suffix.casefold() in (".xml", ".bin")
            and file.is_file()
            and not file.is_symlink()
        }
    except OSError as error:
        raise map_error(
            path, f"cannot be read ({error.strerror})", fix="check path and rights", code="no-file"
        ) from None
    return Bundle(path, {**beside, path.name: path})


def _main_name(bundle: Bundle, path: Path) -> str:
    """Return the name of the task data; of several in a folder, the one nearest to it."""
    if path.name in bundle.files and path.suffix.casefold() == ".xml":
        return path.name
    found = bundle.called(_TASK_DATA)
    if not found:
        raise map_error(
            path,
            f"there is no {_TASK_DATA} in it",
            fix=f"name the folder or the zip that holds {_TASK_DATA}",
            code="no-file",
        )
    depth = min(map(_depth, found))
    nearest = [name for name in found if _depth(name) == depth]
    if len(nearest) > 1:
        raise map_error(
            path,
            f"there are several sets of task data: {', '.join(nearest)}",
            fix=f"name one of the {_TASK_DATA}, or keep one",
            code="several-layers",
        )
    return nearest[0]


def _depth(name: str) -> int:
    return len(PurePosixPath(name).parts)


def _check_root(root: Element, path: Path) -> list[Problem]:
    """Refuse other XML and other versions of the standard."""
    if tag(root) != "ISO11783_TaskData":
        raise map_error(
            path,
            f"this XML is no ISOXML task data but {tag(root)[:40]!r}",
            fix=f"name the {_TASK_DATA}",
            code="unknown-format",
        )
    version = text(root, "VersionMajor")
    if version in _KNOWN_VERSIONS:
        return []
    if version not in _OLD_VERSIONS:
        raise map_error(
            path,
            f"its ISOXML version {(version or 'is missing')[:20]} is not known",
            fix="export the task as ISOXML version 3 or 4",
            code="unknown-format",
        )
    return [
        Problem(
            severity="warning",
            code="old-version",
            text=f"the task data are of ISOXML version {version}, and read as version 3",
            where=str(path),
            fix="export the task as ISOXML version 3 or 4",
        )
    ]
