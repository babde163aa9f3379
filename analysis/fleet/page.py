"""The fleet's page and its tables as files: the report's design, one file that opens from disk."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import Any

import pyarrow as pa
from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

from analysis.fleet.asking import csv_of, parquet_of
from analysis.fleet.summary import FIGURES, GROUPS
from analysis.report.build import FILTERS, embedded

# What stands in a table of the page; the files have all.
ROWS_SHOWN = 60
_HEADINGS = {
    "machine": "By machine",
    "field": "By field",
    "product": "By product",
    "operator": "By operator",
    "month": "By month",
}
_WIDTH, _HEIGHT, _LEFT, _BOTTOM, _TOP = 300, 120, 44, 18, 8
# Of more months the newest.
_MONTHS = 24


def files_of(summary: Mapping[str, Any]) -> dict[str, bytes]:
    """Return the files of a report by their names."""
    files = {
        "fleet.html": page_of(summary).encode(),
        "fleet.json": (json.dumps(summary, indent=1, allow_nan=False) + "\n").encode(),
    }
    for name in GROUPS:
        table = table_of(summary, name)
        files[f"by-{name}.csv"] = csv_of(table)
        files[f"by-{name}.parquet"] = parquet_of(table)
    return files


def table_of(summary: Mapping[str, Any], group: str) -> pa.Table:
    """Return all rows of one grouping, of all kinds of flights."""
    columns = ["kind", "name", *(each.name for each in FIGURES)]
    rows = [row for section in summary["sections"] for row in section["groups"][group]]
    text = dict.fromkeys(("kind", "name"), pa.string())
    whole = dict.fromkeys((each.name for each in FIGURES if _is_count(each.name)), pa.int64())
    schema = pa.schema([(name, {**text, **whole}.get(name, pa.float64())) for name in columns])
    return pa.Table.from_pylist(rows, schema).rename_columns(["kind", group, *columns[2:]])


def _is_count(name: str) -> bool:
    counts = ("flights", "not_evaluated", "changes", "missed_changes", "apart_changes")
    return name in (*counts, "faults", "closings")


def page_of(summary: Mapping[str, Any]) -> str:
    """Return the whole page."""
    return (
        _environment()
        .from_string(_text_of("page.html.j2"))
        .render(
            stylesheet=Markup(stylesheet()),
            body=Markup(body_of(summary)),
            data=Markup(embedded(summary)),
        )
    )


def body_of(summary: Mapping[str, Any]) -> str:
    """Return what the page shows, without styles or scripts: served pages may have none."""
    sections = [
        {**each, "charts": [Markup(chart) for chart in charts_of(each["groups"]["month"])]}
        for each in summary["sections"]
    ]
    return (
        _environment()
        .from_string(_text_of("body.html.j2"))
        .render(
            {**summary, "sections": sections},
            figures=FIGURES,
            headings=_HEADINGS,
            rows_shown=ROWS_SHOWN,
        )
    )


def stylesheet() -> str:
    """Return the report's styles and the few that are the fleet's own."""
    report = resources.files("analysis.report").joinpath("page.css").read_text(encoding="utf-8")
    return report + _text_of("fleet.css")


def _environment() -> Environment:
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= FILTERS
    return environment


def _text_of(name: str) -> str:
    return resources.files("analysis.fleet").joinpath(name).read_text(encoding="utf-8")


def charts_of(months: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return small charts by month; none where there is one month only."""
    known = [each for each in months if each["name"] != "unknown"][-_MONTHS:]
    if len(known) < 2:
        return []
    wanted = (
        ("area_ha", "ground treated, ha", True),
        ("mean_lag_m", "mean absolute lag, m", False),
        ("flow_drift_percent", "flow drift, meter against model, %", False),
        ("closings", "closings of open valves", True),
    )
    names = [str(each["name"]) for each in known]
    return [
        _chart(title, names, [each[key] for each in known], is_bars=is_bars)
        for key, title, is_bars in wanted
        if any(each[key] is not None for each in known)
    ]


def _chart(
    title: str, names: Sequence[str], values: Sequence[float | None], *, is_bars: bool
) -> str:
    """Return one chart as SVG, by attributes only: a served page allows no style in it."""
    there = [value for value in values if value is not None]
    low, high = min(0.0, *there), max(0.0, *there)
    high = high if high > low else low + 1.0
    wide, tall = _WIDTH - _LEFT - 6, _HEIGHT - _TOP - _BOTTOM
    step = wide / len(names)

    def y(value: float) -> float:
        return _TOP + tall * (high - value) / (high - low)

    marks = []
    places = []
    for number, (name, value) in enumerate(zip(names, values, strict=True)):
        x = _LEFT + step * (number + 0.5)
        if value is None:
            continue
        tip = Markup("<title>{}: {}</title>").format(name, f"{value:,.4g}")
        places.append(f"{x:.1f},{y(value):.1f}")
        if is_bars:
            top, tall_px = min(y(value), y(0.0)), abs(y(value) - y(0.0))
            marks.append(
                f'<rect x="{x - 0.38 * step:.1f}" y="{top:.1f}" width="{0.76 * step:.1f}" '
                f'height="{tall_px:.1f}" fill="#4477aa">{tip}</rect>'
            )
        else:
            marks.append(
                f'<circle cx="{x:.1f}" cy="{y(value):.1f}" r="3" fill="#4477aa">{tip}</circle>'
            )
    if not is_bars:
        points = " ".join(places)
        marks.insert(0, f'<polyline points="{points}" fill="none" stroke="#4477aa"/>')
    text = 'font-size="10" fill="#555555"'
    right, zero = _WIDTH - 6, y(0.0)
    axis = [
        f'<line x1="{_LEFT}" x2="{right}" y1="{zero:.1f}" y2="{zero:.1f}" stroke="#1b1b1b"/>',
        f'<text x="{_LEFT}" y="{_HEIGHT - 4}" {text}>{Markup.escape(names[0])}</text>',
        f'<text x="{right}" y="{_HEIGHT - 4}" text-anchor="end" {text}>'
        f"{Markup.escape(names[-1])}</text>",
    ]
    axis += [
        f'<text x="{_LEFT - 5}" y="{y(value) + 3.5:.1f}" text-anchor="end" {text}>'
        f"{_short(value)}</text>"
        for value in sorted({low, 0.0, high})
    ]
    return (
        f'<figure><svg role="img" aria-label="{Markup.escape(title)} by month" '
        f'viewBox="0 0 {_WIDTH} {_HEIGHT}">{"".join(axis + marks)}</svg>'
        f"<figcaption>{Markup.escape(title)}</figcaption></figure>"
    )


def _short(value: float) -> str:
    """Return a number that fits beside a chart.

    >>> _short(1909.3), _short(0.04112), _short(0.0), _short(-3.51)
    ('1,909', '0.041', '0', '-3.5')
    """
    return f"{value:,.0f}" if abs(value) >= 100.0 else f"{value:.2g}"
