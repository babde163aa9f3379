"""What `vrspray doctor` checks: the page's text stands beside it.

`tests/companion/test_doctor_paper.py` holds it to the checks that there are.
"""

from __future__ import annotations

from pathlib import Path


def page() -> str:
    """Return the page."""
    return Path(__file__).with_suffix(".md").read_text(encoding="utf-8")
