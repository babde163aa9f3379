"""What stands between everything that a command says and the terminal.

A file, a vehicle or a name of a file can hold codes by which a terminal moves its cursor, changes
what stands there or answers in the user's place, and letters that turn the order of others. All of
it is shown as text. The notation is that of JSON, so that JSON stays what it is.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from typing import Any, TextIO, cast

# Control characters of both sets (C0, C1) but line and tab, line ends of Unicode, marks, overrides
# and isolates of direction (UAX #9), and bytes of a name that are no text.
_HIDDEN = re.compile(
    "[\\x00-\\x08\\x0b-\\x1f\\x7f-\\x9f\\u061c\\u200e\\u200f\\u2028-\\u202e\\u2066-\\u2069\\ud800-\\udfff]"
)


def visible(text: str) -> str:
    r"""Return a text whose control characters can be seen, and do nothing.

    >>> visible("zone \x1b[2J\u202e")
    'zone \\u001b[2J\\u202e'
    """
    return _HIDDEN.sub(lambda found: json.dumps(found[0])[1:-1], text)


class Styled(str):
    """A line whose colours are ours; what is of others in it was made visible before."""

    __slots__ = ()


class _Shown:
    """A stream that shows what it is given as text."""

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream

    def write(self, text: str) -> int:
        self.stream.write(visible(text))
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        self.write("".join(lines))

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


@contextmanager
def shown_as_text() -> Iterator[None]:
    """Have all that is written to stdout and stderr meanwhile shown as text."""
    out, err = (cast(TextIO, _Shown(terminal(each))) for each in (sys.stdout, sys.stderr))
    with redirect_stdout(out), redirect_stderr(err):
        yield


def terminal(stream: TextIO) -> TextIO:
    """Return the stream itself, for what draws by codes of its own."""
    return stream.stream if isinstance(stream, _Shown) else stream
