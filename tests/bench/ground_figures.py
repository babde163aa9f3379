"""The figures of the report beside the truth: `python -m tests.bench.ground_figures --page`.

Flies the fields of `tests/analysis/test_judged_figures.py` and writes what their reports say and
what the judge counts. With VRSPRAY_SAMPLES a real outline with trees is among them.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from tests.analysis.test_judged_figures import FLIGHTS, Flown, fly

PAGE = Path("docs/measurements/report.md")
HEAD = """<!-- Written by `python -m tests.bench.ground_figures --page`; do not edit. -->

# Figures of the report

`tests/ground_judge.py` counts from the truth of simulated flights what fell where, with no code of
the program. `tests/analysis/test_judged_figures.py` holds report, record, fleet, `flights` and
exports against it. Report / truth, with valves and meter alike:

"""


def rows_of(flown: Flown) -> dict[str, str]:
    """Return what a report says beside the truth, by what it is."""
    said, true = flown.contents["verdict"], flown.verdict
    pairs = {
        "metered, L": (said["metered_l"], true.applied_l, 3),
        "modelled, L": (said["modelled_l"], true.applied_l, 3),
        "asked, L": (said["prescribed_l"], true.asked_l, 3),
        "treated, m²": (said["area_ha"] * 1e4, true.treated_m2, 0),
        "twice, m²": (said["doubled_m2"], true.twice_m2, 0),
        "not treated, m²": (said["untreated_m2"], true.bare_m2, 0),
        "under passes, m²": (said["missed_m2"], true.missed_m2, 0),
        "outside, mL": (said["outside_ml"], true.outside_ml, 1),
    }
    return {name: f"{a:.{n}f} / {b:.{n}f}" for name, (a, b, n) in pairs.items()}


def main() -> None:
    """Fly all, and print the table or write the page."""
    columns = {}
    for name, (zones, lines, *more) in FLIGHTS.items():
        with tempfile.TemporaryDirectory() as folder:
            columns[name] = rows_of(fly(Path(folder), zones, lines, *more))
    lines = [f"| | {' | '.join(columns)} |", f"|---|{'---|' * len(columns)}"]
    for row in next(iter(columns.values())):
        lines.append(f"| {row} | {' | '.join(each[row] for each in columns.values())} |")
    text = "\n".join(lines) + "\n"
    if "--page" in sys.argv:
        PAGE.write_text(HEAD + text, encoding="utf-8")
    sys.stderr.write(text)


if __name__ == "__main__":
    main()
