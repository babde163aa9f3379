"""The figures of the report beside the truth: `python -m tests.bench.ground_figures --page`.

Flies the fields of `tests/analysis/test_judged_figures.py` and writes what their reports say and
what the judge counts. With VRSPRAY_SAMPLES a real outline with trees is among them. Then valves and
meter of one flight are drawn a hundred times anew, and how often each interval that its report
states holds is counted.
"""

from __future__ import annotations

import sys
import tempfile
from collections import Counter
from pathlib import Path

from analysis.evaluation import evaluate
from tests.analysis.test_judged_figures import FLIGHTS, Flown, fly
from tests.analysis.test_judged_scatter import draws, zones

SCATTERED = 100
PAGE = Path("docs/measurements/report.md")
HEAD = """<!-- Written by `python -m tests.bench.ground_figures --page`; do not edit. -->

# Figures of the report

`tests/ground_judge.py` counts from the truth of simulated flights what fell where, with no code of
the program. `tests/analysis/test_judged_figures.py` holds report, record, page, fleet, `flights`
and exports against it. Report / truth, with valves and meter alike:

"""
SCATTER = """
One flight over cells of 2 m, whose valves and meter are drawn anew: how often each interval of its
report (95 %; the meter's 3 %) holds what they did:

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


MEANS = {
    "lag_distance_m": lambda found: found.lag_distance_m.mean,
    "lag_distance_abs_m": lambda found: found.lag_distance_m.mean_abs,
    "settled_lag_distance_m": lambda found: found.settled_lag_distance_m.mean,
    "border_margin_m": lambda found: found.border_margin_m.mean,
    "spraying_accuracy_percent": lambda found: found.spraying_accuracy_percent,
    "misapplied_percent": lambda found: found.misapplied_percent,
}


def scattered() -> str:
    """Return in how many draws the truth lies in what the report of the flight states."""
    # A map of cells of two metres.
    with tempfile.TemporaryDirectory() as folder:
        flown = fly(Path(folder), tuple(zones()), True, "--angle-deg", "0")
        said = flown.contents
        within = said["balance"]["meter_within_percent"] / 100.0
        kept: Counter[str] = Counter()
        for draw in draws(flown, SCATTERED):
            found = evaluate(draw.record)
            worst_m = found.lag_distance_m.max_abs
            kept["worst change"] += worst_m is not None and worst_m <= said["verdict"]["worst_m"]
            off = abs(draw.metered_l - draw.litres)
            kept["metered litres"] += off <= within * draw.metered_l
            for name, of in MEANS.items():
                its, span = of(found), said["intervals"][name]
                if span["low"] is not None:
                    kept[name] += its is not None and span["low"] <= its <= span["high"]
    rows = [f"| {name} | {count} of {SCATTERED} |" for name, count in kept.items()]
    return "\n".join(["| figure | its interval held |", "|---|---|", *rows]) + "\n"


def main() -> None:
    """Fly all, and print the table or write the page."""
    columns = {}
    for name, (field, lines, *more) in FLIGHTS.items():
        with tempfile.TemporaryDirectory() as folder:
            columns[name] = rows_of(fly(Path(folder), field, lines, *more))
    lines = [f"| | {' | '.join(columns)} |", f"|---|{'---|' * len(columns)}"]
    for row in next(iter(columns.values())):
        lines.append(f"| {row} | {' | '.join(each[row] for each in columns.values())} |")
    text = "\n".join(lines) + "\n" + SCATTER + scattered()
    if "--page" in sys.argv:
        PAGE.write_text(HEAD + text, encoding="utf-8")
    sys.stderr.write(text)


if __name__ == "__main__":
    main()
