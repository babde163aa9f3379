"""How many words a reader finds: those written by hand by part, and those of generated pages."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
WORDS_MAX = 40_000
# The first line of a page that a command writes says so.
GENERATED = re.compile(r"\A(---\n.*?\n---\n)?<!-- Written by `", re.DOTALL)


def words_in(text: str) -> int:
    """Return the number of words; marks of tables and fences are none.

    >>> words_in("| `a_b` | 0.5 m |\\n|---|---|")
    3
    """
    return sum(1 for word in text.split() if re.search(r"\w", word))


def counts(root: Path = ROOT) -> tuple[dict[str, int], int]:
    """Return the words by hand, by part of docs/, README and CONTRIBUTING; and those generated."""
    by_hand: Counter[str] = Counter()
    generated = 0
    pages = [root / "README.md", root / "CONTRIBUTING.md", *sorted((root / "docs").rglob("*.md"))]
    for page in pages:
        text = page.read_text(encoding="utf-8")
        if GENERATED.match(text):
            generated += words_in(text)
        else:
            place = page.relative_to(root)
            part = "/".join(place.parts[:2]) if len(place.parts) > 2 else str(place)
            by_hand[part] += words_in(text)
    return dict(by_hand), generated
