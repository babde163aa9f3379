"""Which page is written by what."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from tests.reference import (
    campaigns,
    checks,
    commands,
    configuration,
    driver_board,
    fleet,
    journal,
    map_files,
    map_problems,
    mavlink,
    metrics,
    plants,
    reasons,
    scenarios,
)

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "reference"
HEAD = "<!-- Written by `make reference` from the code; do not edit. -->\n\n"
PAGES: dict[str, Callable[[], str]] = {
    "commands.md": commands.page,
    "configuration.md": configuration.page,
    "checks.md": checks.page,
    "reasons.md": reasons.page,
    "map-problems.md": map_problems.page,
    "map-files.md": map_files.page,
    "mavlink.md": mavlink.page,
    "metrics.md": metrics.page,
    "journal.md": journal.page,
    "scenarios.md": scenarios.page,
    "plants.md": plants.page,
    "campaigns.md": campaigns.page,
    "driver-board.md": driver_board.page,
    "fleet.md": fleet.page,
}


def written(name: str) -> str:
    """Return the text of a page, from the code as it is now."""
    return HEAD + PAGES[name]().rstrip() + "\n"
