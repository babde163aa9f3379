"""Write docs/reference from the code, or count the words of the documentation.

python -m tests.reference           write every page anew
python -m tests.reference --words   print how many words are written by hand
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from tests.reference.pages import FOLDER, PAGES, written
from tests.reference.words import WORDS_MAX, counts


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the pages, or print the words."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--words", action="store_true", help="count the words, write nothing")
    if not parser.parse_args(arguments).words:
        for name in PAGES:
            (FOLDER / name).write_text(written(name), encoding="utf-8")
        sys.stdout.write(f"{len(PAGES)} pages written to docs/reference\n")
        return 0
    by_hand, generated = counts()
    for part, words in by_hand.items():
        sys.stdout.write(f"{words:7,}  {part}\n")
    total = sum(by_hand.values())
    sys.stdout.write(
        f"{total:7,}  words by hand, at most {WORDS_MAX:,}; generated: {generated:,}\n"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
