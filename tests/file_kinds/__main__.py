"""Write every kind in every format and look what the program makes of it (`make files`)."""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from tests.file_kinds.judge import Found, judged
from tests.file_kinds.kinds import RULES
from tests.file_kinds.recorded import Outcomes, record


def main() -> int:
    """Print a row a file; return 1 if one was read wrong, or otherwise than it may be."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("wanted", nargs="?", default="", help="only kinds and formats with this")
    parser.add_argument("--record", action="store_true", help="keep the outcomes for the reference")
    asked = parser.parse_args()
    bad: list[Found] = []
    outcomes: Outcomes = {}
    count = 0
    for rule, kinds in RULES.items():
        for kind in kinds:
            for name, write in kind.writers().items():
                if asked.wanted not in f"{kind.name} {name}":
                    continue
                with tempfile.TemporaryDirectory() as folder:
                    found = judged(kind, name, write, Path(folder))
                count += 1
                sys.stdout.write(f"{'' if found.fine else 'X ':2}{found}\n")
                bad += [] if found.fine else [found]
                outcomes.setdefault(rule, {}).setdefault(kind.name, {})[name] = found.outcome
    wrong = sum(one.outcome == "wrong" for one in bad)
    sys.stdout.write(f"{count} files, {wrong} wrong without a word, {len(bad) - wrong} else\n")
    if asked.record and not bad and not asked.wanted:
        record(outcomes)
    return 1 if bad or not count else 0


if __name__ == "__main__":
    sys.exit(main())
