"""The figures as docs/measurements/performance.md: a summary, then every section."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from typing import Any

from tests.bench.figures import Figure, short

_HEAD = """<!-- Written by `python -m tests.bench --page`; do not edit. -->

# Performance and accuracy, measured

Made of the runs below, each figure from the newest run that has it. `make bench` prints the same
figures as JSON; `make bench SEED=N` draws other seeds.

{runs}

On a computer that does other work meanwhile, times are upper bounds; accuracy is the same.

- *n* is the number of samples behind a figure: steps, look-ups, messages, changes of rate, flights.
- *Alternative* is another way to do the same, measured in the same run.
- Accuracy is that of the simulated sprayer at the nozzle, with pulses, noise and scatter
  ([accuracy](../explanation/accuracy.md)).
- *Nominal* lags were measured on other sprayers of the same make; *identified* lags by one
  calibration flight of the same sprayer, with its own meter.
- *Perfect knowledge* flies the same path and sprayer with the true position and each valve's own
  lag and flow known, and no driver board.

## Summary

A line is met when every figure that it stands for is; the sections below have them one by one.

{summary}
"""

# The columns of a section of flights: beginning of the keys, heading.
_COLUMNS = (
    ("lag_", "mean of absolute values [m]"),
    ("worst_lag_", "worst [m]"),
    ("limit_ratio_", "limit ratio"),
    ("spraying_accuracy_", "spraying accuracy [%]"),
    ("below_perfect_", "below perfect [points]"),
    ("settled_accuracy_", "settled [%]"),
    ("missed_", "missed"),
    ("apart_", "apart [%]"),
)
_LAG = _COLUMNS[0][0]


def page(sources: Sequence[dict[str, Any]]) -> str:
    """Return the whole page from results, the later ones before the earlier ones."""
    figures: dict[str, Figure] = {}
    origin: dict[str, int] = {}
    for number, source in enumerate(sources):
        for key, found in source["figures"].items():
            # A figure measured again takes its old place.
            figures[key], origin[key] = Figure.from_json(key, found), number
    used = sorted(set(origin.values()))
    names = {number: chr(ord("A") + place) for place, number in enumerate(used)}
    runs = "\n".join(_run(names[number], sources[number]) for number in used)
    everything = list(figures.values())
    parts = [_HEAD.format(runs=runs, summary=_summary(everything))]
    for section in dict.fromkeys(figure.section for figure in everything):
        chosen = [figure for figure in everything if figure.section == section]
        letters = sorted({names[origin[figure.key]] for figure in chosen})
        parts.append(f"## {section or 'Other'}\n\nRun {', '.join(letters)}.\n\n{_section(chosen)}")
    return "\n".join(parts)


def _run(name: str, source: dict[str, Any]) -> str:
    machine = source["machine"]
    first, last = source["seed"], source["seed"] + source["seeds"] - 1
    text = (
        f"- **{name}**: `{source['command']}` on {source['date']}, seeds {first} to {last}, "
        f"{machine['cores']} {machine['architecture']} cores, Python {machine['python']}"
    )
    ours = machine.get("ours_while_timing")
    if ours is not None:
        text += f"; {ours:.0%} of one core was ours while timing"
        text += f", load average before {machine['load_before']:.1f}"
    return f"{text}."


def _summary(figures: Iterable[Figure]) -> str:
    rows: dict[str, list[Figure]] = {}
    for figure in figures:
        if figure.row and figure.target is not None:
            rows.setdefault(figure.row, []).append(figure)
    lines = ["| What | Measured | Target | | Figures | n |", "|---|---|---|---|---|---|"]
    for row, alike in rows.items():
        missed = sum(not figure.met for figure in alike)
        verdict = "met" if not missed else f"**missed** by {missed}"
        bounds = dict.fromkeys(_bound(figure) for figure in alike)
        cells = (row, _range(alike), ", ".join(bounds), verdict, str(len(alike)))
        lines.append(_line((*cells, str(sum(figure.n for figure in alike)))))
    return "\n".join(lines)


def _range(alike: Sequence[Figure]) -> str:
    """Return the least and the greatest value."""
    values = sorted(figure.value for figure in alike if figure.value is not None)
    if not values:
        return "-"
    ends = dict.fromkeys(short(value) for value in (values[0], values[-1]))
    return f"{' to '.join(ends)} {alike[0].unit}".strip()


def _bound(figure: Figure) -> str:
    if figure.target is None:
        return ""
    return f"{'>=' if figure.is_at_least else '<='} {figure.target:g}"


def _section(figures: Sequence[Figure]) -> str:
    """Return the flights as one line a kind, everything else as one line a figure."""
    by_key = {figure.key: figure for figure in figures}
    kinds = [
        figure.key.removeprefix(_LAG)
        for figure in figures
        if figure.key.startswith(_LAG) and f"worst_{figure.key}" in by_key
    ]
    told = {begin + kind for kind in kinds for begin, _ in _COLUMNS}
    rest = [figure for figure in figures if figure.key not in told]
    tables = []
    if kinds:
        tables.append(_flights(kinds, by_key))
    if rest:
        tables.append(_figures(rest, with_target=any(f.target is not None for f in rest)))
    return "\n\n".join(tables) + "\n"


def _flights(kinds: Sequence[str], by_key: dict[str, Figure]) -> str:
    heads = ("Flights", *(head for _, head in _COLUMNS), "n", "Lag distance otherwise [m]")
    lines = [_line(heads), _line(["---"] * len(heads))]
    for kind in kinds:
        lag = by_key[_LAG + kind]
        cells = [lag.what.split(", ", 1)[1].rsplit(":", 1)[0]]
        for begin, _ in _COLUMNS:
            figure = by_key.get(begin + kind)
            text = "" if figure is None else short(figure.value)
            cells.append(f"**{text}**" if figure is not None and figure.met is False else text)
        lines.append(_line([*cells, str(lag.n), _others(lag)]))
    targets = [_targets(begin, kinds, by_key) for begin, _ in _COLUMNS]
    lines.append(_line(["target", *targets, "", ""]))
    return "\n".join(lines)


def _targets(begin: str, kinds: Sequence[str], by_key: dict[str, Figure]) -> str:
    """Return every target of a column, in the order of its lines."""
    found = (by_key.get(begin + kind) for kind in kinds)
    return ", ".join(dict.fromkeys(_bound(f) for f in found if f is not None and _bound(f)))


def _figures(figures: Sequence[Figure], *, with_target: bool) -> str:
    heads = ["Figure", "Measured", *(("Target", "") if with_target else ()), "n", "Alternative"]
    lines = [_line(heads), _line(["---"] * len(heads))]
    for figure in figures:
        cells = [figure.what, f"{short(figure.value)} {figure.unit}".strip()]
        if with_target:
            cells += [_bound(figure), {None: "", True: "met", False: "**missed**"}[figure.met]]
        lines.append(_line([*cells, str(figure.n), _others(figure)]))
    return "\n".join(lines)


def _others(figure: Figure) -> str:
    return ", ".join(f"{name} {short(value)}" for name, value in figure.alternative.items())


def _line(cells: Iterable[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def made_by(bench: str) -> dict[str, str]:
    """Return what a page says of how it was made: the command, but for --page, and the day."""
    given = [word for word in sys.argv[1:] if word != "--page"]
    return {
        "command": " ".join([f"python -m tests.bench.{bench}", *given]),
        "today": datetime.now(tz=UTC).date().isoformat(),
    }
