"""The XML of a KML file, or of a KMZ archive and the files that its own file links to.

GDAL, and so QGIS, writes one file for each layer into an archive, and a `doc.kml` that holds
nothing but network links to them. Links that lead out of the archive are never followed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from urllib.parse import unquote
from xml.etree.ElementTree import Element

from missions.maps.bundle import Bundle, open_bundle
from missions.maps.kml.geometry import local_name
from missions.maps.layer import read_bytes
from missions.maps.model import Problem, map_error
from missions.maps.xmltree import MAX_ELEMENTS, parse_xml

_MAIN = "doc.kml"


@dataclass(frozen=True, slots=True, kw_only=True)
class KmlFiles:
    """One tree with all linked files grafted into it, and the bytes of which it was made.

    `folder` is what is left of `--layer` when no file of that name was meant.
    """

    root: Element
    contents: tuple[bytes, ...]
    folder: str | None
    problems: tuple[Problem, ...] = ()


def read_files(path: Path, layer: str | None) -> KmlFiles:
    """Return the tree of a `.kml`, or of an archive or a folder with KML files."""
    if not path.is_dir() and path.suffix.casefold() not in (".kmz", ".zip"):
        content = read_bytes(path)
        root = parse_xml(content, path)
        problems = _problems(sum(1 for _ in _links(root)), path)
        return KmlFiles(root=root, contents=(content,), folder=layer, problems=problems)
    bundle = open_bundle(path)
    name, used = _main_file(bundle, path, layer)
    content = bundle.read(name)
    root = parse_xml(content, path, name=name)
    linked, lost = _graft(root, name, bundle, path)
    return KmlFiles(
        root=root,
        contents=(content, *linked),
        folder=None if used else layer,
        problems=_problems(lost, path),
    )


def _main_file(bundle: Bundle, path: Path, layer: str | None) -> tuple[str, bool]:
    """Return the file that is meant, and whether `layer` was needed to say so.

    A KMZ archive's own file is `doc.kml` at its top; others beside it are for network links.
    """
    names = bundle.with_suffix(".kml")
    main = [name for name in names if name.casefold() == _MAIN]
    meant = main or names
    # By its suffix a name can only be that of a file; without it, it may be a folder's.
    named = [name for name in names if layer in (name, PurePosixPath(name).name)]
    if len(named) == 1:
        return named[0], True
    if len(meant) == 1:
        return meant[0], False
    asked = [name for name in names if layer == PurePosixPath(name).stem]
    if len(asked) == 1:
        return asked[0], True
    raise map_error(
        path,
        f"it holds the KML files {', '.join(names[:10])}" if names else "it holds no KML file",
        fix="name one of them with --layer" if names else "name the file of the map itself",
        code="several-layers" if names else "no-file",
    )


def _graft(root: Element, name: str, bundle: Bundle, path: Path) -> tuple[list[bytes], int]:
    """Put linked files of the archive in place of their links; the rest is counted.

    One level and each file once, so that links in a circle come to an end.
    """
    contents: list[bytes] = []
    done, lost = {name}, 0
    elements = sum(1 for _ in root.iter())
    for parent, link in list(_links(root)):
        target = _target(link, name)
        if target in done:
            continue
        if target not in bundle.files:
            lost += 1
            continue
        done.add(target)
        contents.append(bundle.read(target))
        tree = parse_xml(contents[-1], path, name=target)
        elements += sum(1 for _ in tree.iter())
        if elements > MAX_ELEMENTS:
            raise map_error(
                path,
                f"its files have more than {MAX_ELEMENTS} elements",
                fix="export the map of one field alone",
                code="too-large",
            )
        lost += sum(1 for _ in _links(tree))
        parent[list(parent).index(link)] = tree
    return contents, lost


def _links(root: Element) -> Iterator[tuple[Element, Element]]:
    """Yield every network link and the element around it."""
    for parent in root.iter():
        for child in parent:
            if local_name(child) == "NetworkLink":
                yield parent, child


def _target(link: Element, name: str) -> str:
    """Return the name in the archive that a link leads to, as far as it leads there."""
    text = next(
        (
            (href.text or "").strip()
            for place in link
            if local_name(place) in ("Link", "Url")
            for href in place
            if local_name(href) == "href"
        ),
        "",
    )
    return (PurePosixPath(name).parent / unquote(text)).as_posix()


def _problems(count: int, path: Path) -> tuple[Problem, ...]:
    if not count:
        return ()
    problem = Problem(
        severity="warning",
        code="network-link",
        text=f"{count} links to other files or servers are not followed",
        where=str(path),
        fix="save what they show as a file of its own, if it belongs to the map",
    )
    return (problem,)
