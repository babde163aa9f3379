"""What the firmware of a driver board must do: rules, and the vectors that a test holds.

`tests/sitl/test_board.py` holds the simulated board to each vector of the page.
"""

from __future__ import annotations

from pathlib import Path


def page() -> str:
    """Return the page."""
    return Path(__file__).with_suffix(".md").read_text(encoding="utf-8")
