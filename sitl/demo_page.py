"""What the demo found, for people: the table's rows, one sentence, one page with the pictures."""

from __future__ import annotations

import base64
import html
from dataclasses import dataclass
from typing import TYPE_CHECKING

from analysis.published import (
    P1_MEAN_ACCURACY_PERCENT,
    P1_SOURCE,
    P1_SPRAYING_ACCURACY_PERCENT,
    p1_accuracy_percent,
    p1_lag_distance_m,
)
from sitl.anyang import MAP_SPEED_M_S
from sitl.demo import CALIBRATED, METHODS, SCHEDULED, DemoResult, Flown

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from analysis.evaluation import Distances

SETTLED, ACCURACY = "settled\nlag\nm", "accu-\nracy\n%"
COLUMNS = (
    "\n\nm/s",
    "\n\nmethod",
    "lag\nmean\nm",
    "lag\nworst\nm",
    SETTLED,
    ACCURACY,
    "mis-\napplied\n%",
    "\nlimit\nratio",
    "off\ntarget\nmL",
    "\n\nmissed",
)
CAPTIONS = {
    "map.png": "Prescribed, and applied by two of the methods",
    "lags.png": "The lag distance of every boundary and valve",
    "flow.png": "The flow along the first pass",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One line of the table; `published` are P1's own figures, `ours` is our method."""

    cells: tuple[str, ...]
    published: bool = False
    ours: bool = False


def rows_of(result: DemoResult) -> list[list[Row]]:
    """Return the table's lines, a group for each speed, P1's own figures at its end."""
    groups = []
    for speed_m_s in result.options.speeds_m_s:
        flights = [flown for flown in result.flights if flown.job.speed_m_s == speed_m_s]
        groups.append([*(_row(result, flown) for flown in flights), *_published(speed_m_s)])
    return groups


def _row(result: DemoResult, flown: Flown) -> Row:
    found, job = flown.evaluation, flown.job
    cells = (
        f"{job.speed_m_s:g}",
        job.method,
        _text(found.lag_distance_m.mean_abs, 3),
        _text(found.lag_distance_m.max_abs, 2),
        _text(found.settled_lag_distance_m.mean, 2),
        _text(found.spraying_accuracy_percent, 2),
        _text(found.misapplied_percent, 1),
        _text(result.limit_ratio(flown), 2),
        _text(found.off_target_ml, 1),
        str(found.missed),
    )
    return Row(cells=cells, ours=job.method == SCHEDULED)


def _published(speed_m_s: float) -> Iterator[Row]:
    for method in METHODS:
        lag = p1_lag_distance_m(method, speed_m_s)
        accuracy = p1_accuracy_percent(speed_m_s) if method == "look-ahead" else None
        if lag is None and accuracy is None:
            continue
        cells = [f"{speed_m_s:g}", f"P1: {method}", *[""] * (len(COLUMNS) - 2)]
        cells[COLUMNS.index(SETTLED)] = _text(None if lag is None else lag.mean, 2)
        cells[COLUMNS.index(ACCURACY)] = _text(accuracy, 2)
        yield Row(cells=tuple(cells), published=True)


def _text(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def sentence(result: DemoResult) -> str:
    """Return what the figures say, in one sentence."""
    parts = []
    own = result.options.own_method
    for method in (CALIBRATED, SCHEDULED, *([] if own is None else [own]), "look-ahead", "none"):
        found = [f.evaluation for f in result.flights if f.job.method == method]
        lag = _over([one.lag_distance_m for one in found])
        wrong = [one.misapplied_percent for one in found if one.misapplied_percent is not None]
        if lag and wrong:
            missed = sum(one.missed for one in found)
            lost = f", {missed} {'change' if missed == 1 else 'changes'} missed," if missed else ""
            parts.append(f"{method} {lag}{lost} and {_range(wrong)} %")
    return (
        "Mean distance of a change of rate from its boundary, and misapplied volume: "
        f"{'; '.join(parts)}."
    )


def _range(values: Sequence[float]) -> str:
    low, high = f"{min(values):.1f}", f"{max(values):.1f}"
    return low if low == high else f"{low} to {high}"


def _over(distances: Sequence[Distances]) -> str:
    """Return the mean and the worst over several flights in words."""
    count = sum(one.count for one in distances)
    total = sum(one.mean_abs * one.count for one in distances if one.mean_abs is not None)
    worst = max((one.max_abs for one in distances if one.max_abs is not None), default=None)
    return "" if worst is None else f"{total / count:.3f} m (worst {worst:.2f} m)"


def legend_lines() -> list[str]:
    """Return what the words of the table mean, and P1's own range."""
    accuracy = [each for row in P1_SPRAYING_ACCURACY_PERCENT.values() for each in row]
    return [
        "lag: from a boundary to the volume-equivalent step, absolute values; settled: to where "
        "the total flow stays at its target (P1's LD); limit ratio: misapplied over that of a "
        "flight with perfect knowledge.",
        f"P1: {P1_SOURCE}; real flights: LD {_p1_mean('none')} m without and "
        f"{_p1_mean('look-ahead')} m with compensation at 5 m/s; "
        f"accuracy with compensation {min(accuracy):.2f} to {max(accuracy):.2f}, mean "
        f"{P1_MEAN_ACCURACY_PERCENT:.2f} %. All else is simulated, with P1's controller emulated "
        "for none and look-ahead.",
    ]


def _p1_mean(method: str) -> str:
    lag = p1_lag_distance_m(method, MAP_SPEED_M_S)
    return _text(None if lag is None else lag.mean, 2)


# ---------------------------------------------------------------------------------------- the page

PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>vrspray demo</title>
<meta name="viewport" content="width=device-width, initial-scale=1">
<style>
body {{ font: 15px/1.5 system-ui, sans-serif; color: #222; max-width: 62rem; margin: 2rem auto;
 padding: 0 1rem; }}
table {{ border-collapse: collapse; font-variant-numeric: tabular-nums; width: 100%; }}
th {{ text-align: right; vertical-align: bottom; border-bottom: 2px solid #222; font-weight: 600; }}
td {{ text-align: right; }} th, td {{ padding: .15rem .5rem; white-space: pre-line; }}
th:nth-child(2), td:nth-child(2) {{ text-align: left; }}
tbody {{ border-bottom: 1px solid #ccc; }}
.ours {{ font-weight: 600; color: #0072b2; }} .published {{ color: #666; font-style: italic; }}
figure {{ margin: 2rem 0; }} img {{ width: 100%; }} figcaption, .note {{ color: #555; }}
</style></head><body>
<h1>The field of Wang et al. 2024, method by method</h1>
<p>{sentence}</p>
<table><thead><tr>{head}</tr></thead>{groups}</table>
{notes}
{pictures}
</body></html>
"""


def page(result: DemoResult, pictures: Sequence[Path]) -> str:
    """Return one page that needs nothing beside it: table, words, pictures."""
    options = result.options
    notes = [
        *legend_lines(),
        f"{options.fidelity} flow, {options.output} output, seed {options.seed}; "
        f"{len(result.flights) + len(result.perfect)} flights in {result.wall_s:.0f} s.",
    ]
    return PAGE.format(
        sentence=html.escape(sentence(result)),
        head="".join(f"<th>{html.escape(name.strip())}</th>" for name in COLUMNS),
        groups="".join(f"<tbody>{''.join(map(_tr, group))}</tbody>" for group in rows_of(result)),
        notes="".join(f'<p class="note">{html.escape(note)}</p>' for note in notes),
        pictures="".join(map(_figure, pictures)),
    )


def _tr(row: Row) -> str:
    kind = "published" if row.published else "ours" if row.ours else ""
    cells = "".join(f"<td>{html.escape(cell)}</td>" for cell in row.cells)
    return f'<tr class="{kind}">{cells}</tr>'


def _figure(path: Path) -> str:
    caption = html.escape(CAPTIONS[path.name])
    code = base64.b64encode(path.read_bytes()).decode("ascii")
    return (
        f'<figure><img alt="{caption}" src="data:image/png;base64,{code}">'
        f"<figcaption>{caption}</figcaption></figure>"
    )
