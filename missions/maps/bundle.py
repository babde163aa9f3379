"""What nobody vouches for: XML, and sets of files that belong together, in a folder or a zip.

Python's expat resolves no external entities by itself; internal ones can still multiply
("billion laughs"), and no map needs any, so a document type is refused altogether.

Readers of formats that come as several files ask a bundle and need not know which of the two it
is. Nothing is ever unpacked to disk, so that a name in an archive can lead nowhere. An archive
within an archive is one more file, and stays shut.
"""

from __future__ import annotations

import os
import re
import stat
import struct
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from io import BytesIO
from itertools import pairwise
from pathlib import Path, PurePosixPath
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from companion.errors import MapError
from companion.wording import typed
from missions.maps.model import MAX_FILE_BYTES, map_error, read_bytes

# ---------------------------------------------------------------------------------------------- XML

# KML folders nest some ten deep; a field of 20 000 zones has a million positions.
MAX_XML_DEPTH = 64
MAX_ELEMENTS = 2_000_000  # some 1 GB
MAX_ATTRIBUTES = 256
# With its namespace: expat writes that into each name, however long it is.
MAX_NAME = 1_000
_DECLARED = re.compile(rb"""<\?xml[^>]{0,100}?encoding\s*=\s*["']([A-Za-z0-9._-]{1,40})["']""")
# Declarations that expat does not read itself, as it reads one byte a character or Unicode.
_MANY_BYTES = frozenset(
    {
        "gbk", "gb2312", "gb18030", "big5", "euc-kr", "cp949", "ks_c_5601-1987", "shift_jis",
        "cp932", "windows-31j", "euc-jp", "cp936",
    }
)  # fmt: skip
_EXPORT_AGAIN = "export the map again"


class _RefusedError(ValueError):
    """What is refused, and under which code."""

    def __init__(self, text: str, code: str = "xml-unsafe") -> None:
        super().__init__(text)
        self.code = code


class _Target:
    """Builds the tree from expat's calls, and stops at what no map needs."""

    def __init__(self) -> None:
        self.builder = TreeBuilder()
        self._depth = self._count = 0
        self._names: dict[str, str] = {}  # by what expat calls them
        self._plain: set[str] = set()  # those that both call alike

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        self._depth += 1
        self._count += 1
        if self._depth > MAX_XML_DEPTH:
            raise _RefusedError(f"its elements nest more than {MAX_XML_DEPTH} deep")
        if self._count > MAX_ELEMENTS:
            raise _RefusedError(f"it has more than {MAX_ELEMENTS} elements", "too-large")
        if not attributes.keys() <= self._plain:
            attributes = self._known(attributes)
        self.builder.start(self._names.get(tag) or self._learnt(tag), attributes)

    def end(self, tag: str) -> None:
        self._depth -= 1
        self.builder.end(self._names[tag])

    def doctype(self, *_: object) -> None:
        raise _RefusedError("it declares a document type or entities")

    def _known(self, attributes: dict[str, str]) -> dict[str, str]:
        if len(attributes) > MAX_ATTRIBUTES:
            raise _RefusedError(f"an element has {len(attributes)} attributes")
        return {
            self._names.get(name) or self._learnt(name): value for name, value in attributes.items()
        }

    def _learnt(self, name: str) -> str:
        """Return a name as ElementTree writes it, `{uri}name`; expat says `uri}name`."""
        if len(name) > MAX_NAME:
            raise _RefusedError(f"a name in it is {len(name)} characters long")
        found = self._names[name] = "{" + name if "}" in name else name
        if found == name and len(self._plain) < MAX_ATTRIBUTES:
            self._plain.add(name)
        return found


def parse_xml(content: bytes, path: Path, *, name: str = "") -> Element:
    """Return the root element; namespaces stay in the tags as `{uri}name`.

    `name` is what the file is called inside an archive, for the message.
    """
    where = f"{name}: " if name else ""
    target = _Target()
    try:
        text, encoding = _readable(content)
        parser = expat.ParserCreate(encoding, namespace_separator="}")
        parser.StartElementHandler = target.start
        parser.EndElementHandler = target.end
        parser.CharacterDataHandler = target.builder.data
        parser.StartDoctypeDeclHandler = target.doctype
        parser.EntityDeclHandler = target.doctype
        parser.Parse(text, True)
        return target.builder.close()
    except _RefusedError as error:
        raise map_error(path, f"{where}{error}", fix=_EXPORT_AGAIN, code=error.code) from None
    except (expat.ExpatError, ValueError, LookupError, AssertionError) as error:
        raise _broken(content, error, path, where) from None


def _declared(content: bytes) -> str:
    match = _DECLARED.match(content)
    return match[1].decode("ascii").casefold() if match else ""


def _readable(content: bytes) -> tuple[bytes, str | None]:
    """Return the bytes and the encoding to read them in, None for what they declare."""
    declared = _declared(content)
    if declared not in _MANY_BYTES:
        return content, None
    try:
        return content.decode(declared).encode(), "utf-8"
    except UnicodeError:
        raise _RefusedError(
            f"its text is not in the encoding {declared} that it declares", "encoding"
        ) from None


def _broken(content: bytes, error: Exception, path: Path, where: str) -> Exception:
    """Return what is wrong: text in another encoding than declared, or no whole file."""
    reason = str(error)[:120]
    if _declared(content) in ("", "utf-8", "utf8"):
        try:
            content.decode("utf-8-sig")
        except UnicodeError as wrong:
            if not content.startswith((b"\xff\xfe", b"\xfe\xff")) and not _is_end(content, wrong):
                return map_error(
                    path,
                    f"{where}its text is not in UTF-8, as it has to be without another "
                    f"declaration ({reason})",
                    fix="declare its encoding in the first line, or save it as UTF-8",
                    code="encoding",
                )
    return map_error(
        path,
        f"{where}this is not a whole XML file ({reason})",
        fix=f"copy it again, or {_EXPORT_AGAIN}",
        code="truncated",
    )


def _is_end(content: bytes, error: UnicodeError) -> bool:
    """Tell a character that the end of the file cuts in two from one in another encoding."""
    return isinstance(error, UnicodeDecodeError) and error.end == len(content)


# ------------------------------------------------------------------------------------ sets of files

# A prescription with boundary and task data has a few files; a data carrier some hundred.
MAX_MEMBERS = 2_000
# `TASKDATA/`, or `Rx/grower/farm/field/`, in a folder or two around it.
MAX_DEPTH = 8
# Deflate gains a thousandfold at the very most, on zeros; up to 16 MB of them, a grid of four
# million cells, are no harm. Beyond, a map gains some two hundredfold.
MAX_RATIO = 400
_RATIO_FREE_BYTES = 16 * 1024**2
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_ENTRY_MARK = b"PK\1\2"
_LOCAL_HEADER_BYTES = 30
_MAKE_AGAIN = "make the archive again"
# What `zipfile` raises on bytes that are not what they claim (found by mutating archives).
_BROKEN = (
    zipfile.BadZipFile, zlib.error, struct.error, OSError, EOFError, RuntimeError, ValueError,
    IndexError, OverflowError,
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Bundle:
    """Files by their names inside `path`, with `/` between folders."""

    path: Path
    files: dict[str, Path | zipfile.ZipInfo]
    _archive: zipfile.ZipFile | None = field(default=None, repr=False)

    @property
    def names(self) -> tuple[str, ...]:
        """Return all names, sorted."""
        return tuple(sorted(self.files))

    def with_suffix(self, *suffixes: str) -> list[str]:
        """Return the names that end in one of the suffixes, in any case: `.shp`, `.tif`."""
        return [name for name in self.names if PurePosixPath(name).suffix.casefold() in suffixes]

    def called(self, basename: str) -> list[str]:
        """Return the names whose last part is `basename`, in any case."""
        wanted = basename.casefold()
        return [name for name in self.names if PurePosixPath(name).name.casefold() == wanted]

    def read(self, name: str) -> bytes:
        """Return one file's bytes."""
        entry = self.files[name]
        if isinstance(entry, Path):
            return read_bytes(entry)
        if self._archive is None:
            raise ValueError("a member of an archive needs its archive")
        try:
            with self._archive.open(entry) as member:
                content = member.read(entry.file_size + 1)
        except _BROKEN as error:
            raise map_error(
                self.path,
                f"its member {name} cannot be unpacked ({str(error)[:120]})",
                fix=f"copy it again, or {_MAKE_AGAIN}",
                code="truncated",
            ) from None
        if len(content) != entry.file_size:
            raise _unsafe(self.path, f"its member {name} is not as long as the archive says")
        return content


def open_bundle(path: Path) -> Bundle:
    """Return the files of a folder or of a zip archive."""
    return _folder(path) if path.is_dir() else _archive(path)


def files_beside(path: Path) -> Bundle:
    """Return a file and those beside it whose names begin alike: `rx.prj`, `rx-Metadata.json`.

    Unlike in a whole folder, a link is followed: the operator named this very file.
    """
    start = path.stem.casefold()
    try:
        there = sorted(path.parent.iterdir())
        files: dict[str, Path | zipfile.ZipInfo] = {
            file.name: file
            for file in there
            if file.name.casefold().startswith(start) and file.is_file()
        }
    except (OSError, ValueError) as error:
        raise map_error(
            path, f"cannot be read ({error})", fix="check path and rights", code="no-file"
        ) from None
    return Bundle(path.parent, files | {path.name: path})


def is_litter(name: str) -> bool:
    """Tell what a computer leaves behind in folders and archives from what people put there.

    >>> is_litter("__MACOSX/._rx.shp"), is_litter("Rx/.DS_Store"), is_litter("Rx/rx.shp")
    (True, True, False)
    """
    parts = PurePosixPath(name).parts
    return "__MACOSX" in parts or any(part.startswith(".") for part in parts)


def _folder(path: Path) -> Bundle:
    files: dict[str, Path | zipfile.ZipInfo] = {}
    for name, file in _walk(path):
        files[name] = file
        if len(files) > MAX_MEMBERS:
            raise map_error(
                path,
                f"the folder holds more than {MAX_MEMBERS} files",
                fix="name the map's own folder",
                code="too-large",
            )
    return Bundle(path, files)


def _walk(path: Path) -> Iterator[tuple[str, Path]]:
    """Yield the files in a folder and its folders; links are not followed."""

    def refuse(error: OSError) -> None:
        raise map_error(
            path, f"cannot be read ({error})", fix="check path and rights", code="no-file"
        )

    for place, folders, names in os.walk(path, onerror=refuse):
        here = Path(place).relative_to(path)
        folders[:] = sorted(name for name in folders if not is_litter(name))
        if folders and len(here.parts) >= MAX_DEPTH:
            raise map_error(
                path,
                f"its folders lie more than {MAX_DEPTH} deep in each other",
                fix="name the map's own folder",
                code="too-large",
            )
        for name in sorted(names):
            file = Path(place) / name
            if not is_litter(name) and file.is_file() and not file.is_symlink():
                yield (here / name).as_posix(), file


def _archive(path: Path) -> Bundle:
    content = read_bytes(path)
    # Counted before the list is made, and not believed to the number that the archive states.
    entries = content.count(_ENTRY_MARK)
    if entries > 4 * MAX_MEMBERS:
        raise _too_large(path, f"some {entries} files are more than {MAX_MEMBERS}")
    try:
        archive = zipfile.ZipFile(BytesIO(content))
        members = archive.infolist()
        _check_members(path, members)
        _check_apart(path, members, archive.start_dir)
        return Bundle(path, _named(path, members), archive)
    except MapError:
        raise
    except _BROKEN as error:
        raise map_error(
            path,
            f"this is not a whole zip archive ({str(error)[:120]})",
            fix=f"copy it again, or {_MAKE_AGAIN}",
            code="truncated",
        ) from None


def _check_members(path: Path, members: Sequence[zipfile.ZipInfo]) -> None:
    """Refuse what is too much, hidden, or packed in a way whose gain has no bound."""
    if len(members) > MAX_MEMBERS:
        raise _too_large(path, f"{len(members)} files are more than {MAX_MEMBERS}")
    if sum(member.file_size for member in members) > MAX_FILE_BYTES:
        raise _too_large(path, f"unpacked it would be more than {MAX_FILE_BYTES // 1024**2} MB")
    for member in members:
        shown = repr(member.filename[:80])
        if member.flag_bits & 0x1:
            raise _unsafe(path, f"its member {shown} is encrypted", fix="pack it unencrypted")
        if member.compress_type not in _METHODS:
            raise _unsafe(
                path,
                f"its member {shown} is packed in an unusual way",
                fix="pack it as a plain zip (deflate)",
            )
        if member.file_size > max(MAX_RATIO * member.compress_size, _RATIO_FREE_BYTES):
            raise _unsafe(path, f"its member {shown} unpacks to far more than its size")
        if stat.S_ISLNK(member.external_attr >> 16):
            raise _unsafe(path, f"its member {shown} is a link", fix="pack the file itself")


def _check_apart(path: Path, members: Sequence[zipfile.ZipInfo], start_dir: int) -> None:
    """Refuse members that share bytes: a small archive could unpack to any size that way."""
    ordered = sorted(members, key=lambda member: member.header_offset)
    starts = [*(member.header_offset for member in ordered), start_dir]
    for member, (start, following) in zip(ordered, pairwise(starts), strict=True):
        if start < 0 or start + _LOCAL_HEADER_BYTES + member.compress_size > following:
            raise _unsafe(path, f"its member {member.filename[:80]!r} overlaps another")


def _named(path: Path, members: Sequence[zipfile.ZipInfo]) -> dict[str, Path | zipfile.ZipInfo]:
    """Return the files by name, with the folders and the litter left out."""
    files: dict[str, Path | zipfile.ZipInfo] = {}
    for member in members:
        text = _text_of(member).replace("\\", "/")
        name = PurePosixPath(text)
        shown = repr(text[:80])
        if name.is_absolute() or ".." in name.parts or ":" in (name.parts or ("",))[0]:
            raise _unsafe(path, f"its member {shown} leads out of it")
        if any(ord(character) < 32 for character in text):
            raise _unsafe(path, f"its member {shown} has a control character in its name")
        if text.endswith("/") or is_litter(text):
            continue
        if not name.name or len(name.parts) > MAX_DEPTH + 1:
            raise _unsafe(path, f"its member {shown} has no name, or lies too deep in folders")
        if str(name) in files:
            raise _unsafe(path, f"it holds {shown} twice")
        files[str(name)] = member
    return files


def _text_of(member: zipfile.ZipInfo) -> str:
    """Return a name as it was meant, as well as that can be known.

    Without its flag for UTF-8, the name is in the code page of the computer that packed it, which
    the archive does not state; Chinese names show by their pairs of high bytes. What is at stake
    is how the name looks: files that belong together are read alike.
    """
    if member.flag_bits & 0x800 or member.filename.isascii():
        return member.filename
    try:
        raw = member.filename.encode("cp437")
    except UnicodeError:
        return member.filename
    for encoding in ("utf-8", "gb2312"):
        try:
            return raw.decode(encoding)
        except UnicodeError:
            continue
    return member.filename


def _unsafe(path: Path, text: str, *, fix: str = _MAKE_AGAIN) -> Exception:
    return map_error(path, text, fix=fix, code="archive-unsafe")


def _too_large(path: Path, text: str) -> Exception:
    return map_error(path, text, fix="pack the map of one field alone", code="too-large")


# Which file of a folder or an archive is the map, where there may be several of a kind.


def one_of(bundle: Bundle, names: Sequence[str], layer: str | None, *, kind: str) -> str:
    """Return the only file, or the one that `layer` names: by its stem, or by its place."""
    meant = [name for name in names if layer is None or layer in _calls(name)]
    if len(meant) == 1:
        return meant[0]
    stems = Counter(PurePosixPath(name).stem for name in names)
    shown = [
        PurePosixPath(name).stem if stems[PurePosixPath(name).stem] == 1 else name
        for name in meant or names
    ]
    listed = typed(shown[:8]) + (f" and {len(shown) - 8} more" if len(shown) > 8 else "")
    if not names:
        raise map_error(
            bundle.path, f"it holds no {kind}", fix="name the map's own file",
            code="unknown-format",
        )  # fmt: skip
    raise map_error(
        bundle.path,
        f"it holds the {kind} files {listed}" + ("" if meant else f", and no {layer!r}"),
        fix="name one of them with --layer (prescription.layer)",
        code="several-layers" if meant else "no-layer",
    )


def _calls(name: str) -> tuple[str, ...]:
    place = PurePosixPath(name)
    return place.stem, place.name, name, str(place.with_suffix(""))
