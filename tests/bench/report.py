"""The figures as a page of Markdown: docs/performance.md."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime

from tests.bench.figures import Figure, short

_PAGE = """# Performance and accuracy, measured

Written by `.venv/bin/python -m tests.bench {arguments}` on {date}: {machine}, Python {python};
{busy}.
`make bench` prints the same figures as JSON over twenty seeds; `make bench SEED=N` draws others.
On a machine that does other work meanwhile, times are upper bounds; accuracy is the same.

How it is measured: times with `time.perf_counter`, after a warm-up, with the garbage collector as
`vrspray run` has it. *n* is the number of samples behind a figure: steps, look-ups, messages,
changes of rate, flights. The alternative is another way to do the same, measured in the same run.
Accuracy is that of the twin (pulsed, with noise and scatter) at the nozzle, over the seeds
{first} to {last}, judged by `analysis/evaluation.py` ([metrics](metrics.md)); the lags are the
nominal valve's, as a calibration would find them. Perfect knowledge is the same path and plant
without noise, scatter or delays, with no driver board in between, for every output. The board of
`servo` restarts its period at a change of zone, `free-running` does not.

{table}
"""


def page(figures: Sequence[Figure], *, arguments: str, seeds: range, about: dict[str, str]) -> str:
    """Return the whole page; `about` has the machine, in general words, and how busy it was."""
    return _PAGE.format(
        arguments=arguments,
        date=datetime.now(UTC).date().isoformat(),
        first=seeds[0],
        last=seeds[-1],
        table=_table(figures),
        **about,
    )


def _table(figures: Sequence[Figure]) -> str:
    lines = [
        "| Figure | Measured | Target | | n | Alternative |",
        "|---|---|---|---|---|---|",
    ]
    for figure in figures:
        bound = ">=" if figure.is_at_least else "<="
        cells = (
            figure.what,
            f"{short(figure.value)} {figure.unit}".strip(),
            "" if figure.target is None else f"{bound} {figure.target:g}",
            {None: "", True: "met", False: "**missed**"}[figure.met],
            str(figure.n),
            ", ".join(f"{name} {short(value)}" for name, value in figure.alternative.items()),
        )
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)
