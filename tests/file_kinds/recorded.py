"""What came of every kind in every format when `make files ARGS=--record` ran last."""

from __future__ import annotations

import json
from pathlib import Path

# By rule, kind and format.
Outcomes = dict[str, dict[str, dict[str, str]]]

PLACE = Path(__file__).with_name("outcomes.json")


def record(outcomes: Outcomes) -> None:
    """Keep them; the reference and the tests read them."""
    PLACE.write_text(json.dumps(outcomes, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def recorded() -> Outcomes:
    """Return them."""
    found: Outcomes = json.loads(PLACE.read_text(encoding="utf-8"))
    return found
