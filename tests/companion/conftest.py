"""What several modules of unit tests are given."""

from __future__ import annotations

import contextlib
import os
import pty
import tty
from collections.abc import Iterator, Sequence
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO

import pytest

from companion.cli.app import execute


@pytest.fixture
def terminal() -> Iterator[tuple[int, str]]:
    """Yield a pseudo-terminal: the descriptor of its far end, and its device."""
    far, near = pty.openpty()
    tty.setraw(near)
    device = os.ttyname(near)
    os.close(near)
    yield far, device
    # A test may have closed it: its device is gone.
    with contextlib.suppress(OSError):
        os.close(far)


@pytest.fixture
def compiles_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compile maps in this process, for tests of what becomes of a map and not of the child.

    A child imports for 0.7 s what is imported here; `test_flight_map.py` is about the child.
    """

    def ended(words: Sequence[str], memory_max: int) -> tuple[int, bytes]:
        with redirect_stdout(StringIO()) as said, redirect_stderr(StringIO()):
            code = execute(words)
        return code, said.getvalue().encode()

    monkeypatch.setattr("companion.flight_map.child._ended", ended)
