"""Record the golden flights, or replay them and compare every decision.

    python -m tests.golden check [--tolerant] [NAME ...]
    python -m tests.golden record [NAME ...]

A change of structure leaves every decision as it was, to the bit. `--tolerant` is for a step that
makes the core faster. Recording anew is for a change that is meant to decide otherwise: say in the
commit which flights it changes, and how. Recorded by Python 3.11; from 3.12 on `sum` rounds
otherwise, so that only `--tolerant` holds there.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence

from tests.golden.checking import names, replayed, unpacked


def main(arguments: Sequence[str] | None = None) -> int:
    """Return 0 where all flights are as they were recorded, else 1."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.golden",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("do", choices=("check", "record"))
    parser.add_argument("name", nargs="*", help="of some flights; all without")
    parser.add_argument("--tolerant", action="store_true", help="times within 1 us, duty 1e-9")
    given = parser.parse_args(arguments)
    if given.do == "record":
        # What flies imports much that a check needs not.
        from tests.golden.recording import record

        record(say, tuple(given.name))
        return 0
    return check(given.name or names(), is_tolerant=given.tolerant)


def say(text: str) -> None:
    """Print a line at once."""
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def check(wanted: Sequence[str], *, is_tolerant: bool) -> int:
    """Print a line for each flight, and the sum."""
    began_s, wrong, decisions = time.process_time(), [], 0
    for name in wanted:
        with unpacked(name) as path:
            found = replayed(path, is_tolerant=is_tolerant)
        decisions += found.decisions
        if found.is_equal:
            say(f"{name}: {found.decisions} decisions as recorded")
            continue
        wrong.append(name)
        say(f"{name}: {found.differences} of {found.decisions} DIFFER: {found.first}")
        if found.cells:
            say(f"{name}: {found.cells} cells of treated ground DIFFER")
    took_s = time.process_time() - began_s
    say(f"{len(wanted)} flights, {decisions} decisions, {len(wrong)} differ, {took_s:.0f} s")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
