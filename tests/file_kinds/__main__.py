"""Write every kind in every format and look what the program makes of it (`make files`)."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from tests.file_kinds.judge import Found, judged
from tests.file_kinds.kinds import KINDS


def main(wanted: str = "") -> int:
    """Print a row a file; return 1 if one was read wrong, or otherwise than it may be."""
    bad: list[Found] = []
    count = 0
    for kind in KINDS:
        for name, write in kind.writers().items():
            if wanted not in f"{kind.name} {name}":
                continue
            with tempfile.TemporaryDirectory() as folder:
                found = judged(kind, name, write, Path(folder))
            count += 1
            sys.stdout.write(f"{'' if found.fine else 'X ':2}{found}\n")
            bad += [] if found.fine else [found]
    wrong = sum(one.outcome == "wrong" for one in bad)
    sys.stdout.write(
        f"{count} files, {wrong} read wrong without a word, {len(bad) - wrong} otherwise than meant"
    )
    return 1 if bad or not count else 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
