"""What several modules of unit tests are given."""

from __future__ import annotations

import contextlib
import os
import pty
import tty
from collections.abc import Iterator

import pytest

from tests.compiling_here import compiled_here


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
def compiles_here() -> Iterator[None]:
    """Compile maps in this process, not in a child."""
    with compiled_here():
        yield
