"""Words that every text for a person puts together in the same way."""

from __future__ import annotations

import json
import re
import shlex
import sys
import tomllib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path, PurePath
from typing import Any, Literal

from companion.errors import ConfigError

# What a computer is for: the extras of pyproject.toml.
Role = Literal["vehicle", "office", "campaign", "cluster"]

# How much is missing nobody knows: a second after a power cut, more after a disk that fell behind.
CUT = "the journal was cut: what came after its end is missing"


def counted(count: int, name: str) -> str:
    """Return a number with its noun.

    >>> counted(1, "hole"), counted(2, "hole")
    ('1 hole', '2 holes')
    >>> counted(2, "pass")
    '2 passes'
    """
    plural = "es" if name.endswith("s") else "s"
    return f"{count} {name}{'' if count == 1 else plural}"


def typed(names: Iterable[str]) -> str:
    """Return names as a shell takes them, one after the other: with quotes where they need them.

    >>> typed(["DOSE", "rate (L/ha)", "用量"])
    "DOSE, 'rate (L/ha)', 用量"
    """
    return ", ".join(
        name if re.fullmatch(r"[\w./:@+=-]+", name) else shlex.quote(name) for name in names
    )


def iconv(content: bytes, path: Path) -> str:
    """Return the command that makes UTF-8 of a text, from what its first bytes show that it is.

    >>> iconv("one".encode("utf-16"), Path("my map.csv"))
    "iconv -f UTF-16 -t UTF-8 'my map.csv' > 'my map-utf8.csv'"
    """
    shown = "WINDOWS-1252"
    if not any(content[1:100:2]) or not any(content[:100:2]):
        shown = "UTF-16LE" if content[:1].strip(b"\0") else "UTF-16BE"
    marks = {b"\xff\xfe\0\0": "UTF-32", b"\xff\xfe": "UTF-16", b"\xfe\xff": "UTF-16"}
    shown = next((name for mark, name in marks.items() if content.startswith(mark)), shown)
    files = (shlex.quote(str(one)) for one in (path, path.with_stem(f"{path.stem}-utf8")))
    return f"iconv -f {shown} -t UTF-8 {' > '.join(files)}"


def install_command(role: Role, prefix: str = sys.prefix) -> str:
    """Return the command that adds what a role needs, by what installed this program.

    `pipx` and `uv tool` keep an environment of their own, in which no `pip` on the path installs.

    >>> install_command("office", "/usr")
    "pip install 'vrspray[office]'"
    >>> install_command("office", "/opt/pipx/venvs/vrspray")
    "pipx runpip vrspray install 'vrspray[office]'"
    >>> install_command("vehicle", "/opt/uv/tools/vrspray")
    "uv pip install --python /opt/uv/tools/vrspray/bin/python 'vrspray[vehicle]'"
    """
    wanted, (*_, above, folder, _) = f"'vrspray[{role}]'", ("", "", *PurePath(prefix).parts)
    # Either may be told to have its environments elsewhere.
    if (above, folder) == ("pipx", "venvs") or Path(prefix, "pipx_metadata.json").exists():
        return f"pipx runpip vrspray install {wanted}"
    if (above, folder) == ("uv", "tools") or Path(prefix, "uv-receipt.toml").exists():
        return f"uv pip install --python {prefix}/bin/python {wanted}"
    return f"pip install {wanted}"


def lack_of(library: str, role: Role = "office") -> tuple[str, str]:
    """Return that a library is not installed, and what to do."""
    return f"the library {library} is not installed", f"add it: {install_command(role)}"


def missing(library: str, role: Role = "office") -> str:
    """Return the same in one line.

    >>> missing("jinja2")
    "the library jinja2 is not installed; add it: pip install 'vrspray[office]'"
    """
    return "; ".join(lack_of(library, role))


VALUE_LENGTH_MAX = 60
# A page of text; whatever is larger is another file, given by mistake.
TOML_MAX_BYTES = 1_000_000
_LINE = re.compile(r"at line (\d+)")


def show_value(value: Any, *, length_max: int = VALUE_LENGTH_MAX) -> str:
    """Return a value as one short piece of text, whatever it is."""
    text = json.dumps(value, ensure_ascii=False, default=str)
    return text if len(text) <= length_max else f"{text[: length_max - 4]} ..."


def refuse_existing(path: Path, *, force: bool, option: str = "--out") -> None:
    """Refuse to replace a file that nobody said to replace."""
    if path.exists() and not force:
        raise ConfigError(
            f"{path}: is there already; give another {option}, or --force to replace it"
        )


@contextmanager
def writing(named: str) -> Iterator[None]:
    """Say in one line that a file or folder cannot be written; `named` is which."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or error
        raise ConfigError(
            f"{named}: cannot be written ({reason}); check folder, rights and space"
        ) from error


def read_toml(
    path: Path, *, what: str, named: str = "", bytes_max: int = TOML_MAX_BYTES
) -> tuple[str, dict[str, Any]]:
    """Return the text and the tables of a TOML file, which is to be one of `what`.

    Raises:
        ConfigError: in one line, which begins with `named`, where that is given.
    """
    named = named or str(path)
    fix = f"give the .toml file of {what}"
    try:
        with path.open("rb") as file:
            content = file.read(bytes_max + 1)
        if len(content) > bytes_max:
            raise ConfigError(f"{named}: too large; {fix}")
        text = content.decode("utf-8-sig")
        return text, tomllib.loads(text)
    except OSError as error:
        reason = (error.strerror or "cannot be read").lower()
        raise ConfigError(f"{named}: {reason}; {fix}") from error
    except UnicodeDecodeError as error:
        place = f"byte {error.start}"
        raise ConfigError(f"{named}: not UTF-8 text ({place}); save the file as UTF-8") from error
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(_syntax(path, text, str(error))) from error
    except RecursionError as error:
        raise ConfigError(f"{path}: brackets nested too deep; write plain tables") from error


def _syntax(path: Path, text: str, message: str) -> str:
    match = _LINE.search(message)
    if match is None:
        advice = "a quote or bracket is not closed at the end of the file"
        return f"{path}: not valid TOML: {message}; {advice}"
    number = int(match[1])
    lines = text.splitlines()
    line = show_value(lines[number - 1].strip()) if number <= len(lines) else "the end"
    return f"{path}: line {number}: {line}: {message}; write key = value, with text in quotes"
