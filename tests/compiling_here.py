"""Maps compiled in this process, for tests of what becomes of a map and not of the child."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from io import StringIO

import pytest

from companion.cli.app import execute


@contextmanager
def compiled_here() -> Iterator[None]:
    """Compile maps in this process, for as long as the block lasts.

    A child imports for 0.7 s what is imported here; `test_flight_map.py` is about the child.
    """

    def ended(words: Sequence[str], memory_max: int) -> tuple[int, bytes]:
        with redirect_stdout(StringIO()) as said, redirect_stderr(StringIO()):
            code = execute(words)
        return code, said.getvalue().encode()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("companion.flight_map.child._ended", ended)
        yield
