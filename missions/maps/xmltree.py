"""XML from files that nobody vouches for: no entities, no document types, bounded depth and size.

Python's expat resolves no external entities by itself; internal ones can still multiply
("billion laughs"), and no map needs any, so a document type is refused altogether.
"""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from missions.maps.model import map_error

# KML folders nest some ten deep; a field of 20 000 zones has a million positions.
MAX_DEPTH = 64
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
        if self._depth > MAX_DEPTH:
            raise _RefusedError(f"its elements nest more than {MAX_DEPTH} deep")
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
        f"{where}this is no whole XML file ({reason})",
        fix=f"copy it again, or {_EXPORT_AGAIN}",
        code="truncated",
    )


def _is_end(content: bytes, error: UnicodeError) -> bool:
    """Tell a character that the end of the file cuts in two from one in another encoding."""
    return isinstance(error, UnicodeDecodeError) and error.end == len(content)
