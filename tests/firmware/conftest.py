"""The real firmwares: skipped where there are none, one flight at a time."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.firmware.firmware import one_at_a_time

VARIABLE = "VRSPRAY_FIRMWARE"
_FIGURES = pytest.StashKey[list[str]]()


@pytest.fixture
def firmwares() -> Iterator[Path]:
    """Return the folder of the firmwares, its ports free for one flight."""
    folder = os.environ.get(VARIABLE)
    if not folder:
        pytest.skip(f"{VARIABLE} names no folder of firmwares")
    with one_at_a_time():
        yield Path(folder)


@pytest.fixture
def tell(request: pytest.FixtureRequest) -> Callable[[object], None]:
    """Return what puts a figure of this flight into the summary at the end."""
    figures = request.config.stash.setdefault(_FIGURES, [])
    return lambda figure: figures.append(f"{request.node.name}: {figure}")


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Show the figures of all flights, of those that passed too."""
    figures = terminalreporter.config.stash.get(_FIGURES, [])
    if figures:
        terminalreporter.section("flights")
        for figure in figures:
            terminalreporter.line(figure)
