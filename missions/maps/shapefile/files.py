"""Which files make up the shapefile that is meant, beside a `.shp`, in a folder or in a zip."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from missions.maps.bundle import Bundle, files_beside, open_bundle
from missions.maps.layer import digest
from missions.maps.model import map_error

_SUFFIXES = (".cpg", ".dbf", ".prj", ".shp", ".shx")
# John Deere puts prescriptions into this folder, whatever else the archive holds.
_RX = "rx"
# What John Deere, and others after them, call the file that says the units of the columns.
_METADATA = ("-deere-metadata.json", "-metadata.json")


@dataclass(frozen=True, slots=True, kw_only=True)
class ShapeFiles:
    """The files of one shapefile; `main` is the `.shp`, inside the zip where it is in one."""

    main: Path
    content: dict[str, bytes]
    metadata: bytes | None = None

    @property
    def sha256(self) -> str:
        """Return the digest of all files: in the order of their suffixes, the metadata last."""
        content = [self.content[suffix] for suffix in sorted(self.content)]
        return digest([*content, self.metadata or b""])


def find_shapefile(path: Path, layer: str | None) -> ShapeFiles:
    """Return the files of the shapefile that `path`, and `layer` among several, mean."""
    if path.suffix.casefold() == ".shp" and not path.is_dir():
        if layer not in (None, path.stem):
            raise map_error(
                path, f"it is not the layer {layer!r}", fix="leave out --layer", code="no-layer"
            )
        bundle, main = files_beside(path), path.name
    else:
        bundle = open_bundle(path)
        main = _meant(bundle, layer)
    names = _names_of_set(bundle, main)
    metadata = names.pop("metadata", None)
    content = {suffix: bundle.read(name) for suffix, name in names.items()}
    return ShapeFiles(
        main=bundle.path / main,
        content=content,
        metadata=bundle.read(metadata) if metadata is not None else None,
    )


def _meant(bundle: Bundle, layer: str | None) -> str:
    """Return the name of the `.shp` that is meant.

    Several are never chosen from. Those in folders deeper than others are not in the way (a
    boundary beside the map, in a folder of its own), but for the folder `Rx`, which is named
    after prescriptions.
    """
    found = bundle.with_suffix(".shp")
    if not found:
        raise map_error(
            bundle.path,
            "there is no shapefile (.shp) in it",
            fix="name the map's file",
            code="unknown-format",
        )
    if layer is not None:
        meant = [name for name in found if layer in _calls(name)]
    else:
        least = min(_depth(name) for name in found)
        meant = [name for name in found if _depth(name) == least or _in_rx(name)]
    if len(meant) == 1:
        return meant[0]
    names = ", ".join(_shown(meant or found))
    if not meant:
        raise map_error(
            bundle.path,
            f"it holds no layer {layer!r}, but the shapefiles {names}",
            fix="name one of them with --layer",
            code="no-layer",
        )
    raise map_error(
        bundle.path,
        f"it holds the shapefiles {names}",
        fix="name one of them with --layer",
        code="several-layers",
    )


def _calls(name: str) -> tuple[str, str, str]:
    """Return what a shapefile may be called: by its stem, or by its place."""
    return PurePosixPath(name).stem, name, str(PurePosixPath(name).with_suffix(""))


def _shown(names: Sequence[str]) -> list[str]:
    """Return stems, and places where stems repeat, as many as a message bears."""
    stems = Counter(PurePosixPath(name).stem for name in names)
    shown = [
        PurePosixPath(name).stem
        if stems[PurePosixPath(name).stem] == 1
        else str(PurePosixPath(name).with_suffix(""))
        for name in names
    ]
    return [*shown[:8], f"and {len(shown) - 8} more"] if len(shown) > 8 else shown


def _depth(name: str) -> int:
    return len(PurePosixPath(name).parts)


def _in_rx(name: str) -> bool:
    return any(part.casefold() == _RX for part in PurePosixPath(name).parts[:-1])


def _names_of_set(bundle: Bundle, main: str) -> dict[str, str]:
    """Return the names of the shapefile's files by suffix, in any case, and of its metadata."""
    place = PurePosixPath(main)
    beside = [name for name in bundle.files if PurePosixPath(name).parent == place.parent]
    found = {".shp": main}
    for suffix in _SUFFIXES:
        name = _one(bundle, place.stem, suffix, beside)
        if name is not None and suffix != ".shp":
            found[suffix] = name
    for ending in reversed(_METADATA):
        name = _one(bundle, place.stem, ending, beside)
        if name is not None:
            found["metadata"] = name
    return found


def _one(bundle: Bundle, stem: str, ending: str, beside: Iterable[str]) -> str | None:
    """Return the file with this stem and ending; the stem in another case if there is no other."""
    wanted = f"{stem}{ending}"
    alike = [name for name in beside if PurePosixPath(name).name.casefold() == wanted.casefold()]
    own = [name for name in alike if PurePosixPath(name).name[: len(stem)] == stem]
    found = own or alike
    if len(found) > 1 and ending != ".shp":
        raise map_error(
            bundle.path,
            f"{found[0]} and {found[1]} could both belong to {stem}.shp",
            fix="remove the one that does not",
            code="several-files",
        )
    return found[0] if found else None
