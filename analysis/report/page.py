"""The page: one file that opens from disk, with all figures and every number in it."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Mapping
from typing import Any

from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

from analysis.report.clock import duration_text
from analysis.report.stylesheet import STYLESHEET
from analysis.report.template import MACROS, PAGE

EVENTS_SHOWN, RATES_SHOWN = 200, 40
NOTHING = "-"


def page_of(contents: Mapping[str, Any], figures: Mapping[str, Mapping[str, str]]) -> str:
    """Return the page; `figures` has title, caption and markup (HTML) by name."""
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=False, keep_trailing_newline=True
    )
    environment.filters |= FILTERS
    shown = {name: {**each, "markup": Markup(each["markup"])} for name, each in figures.items()}
    values = {
        **contents,
        "setup": _with_pairs(contents["setup"]),
        "table_5": _with_rows(contents.get("table_5")),
        "events_shown": contents["events"][:EVENTS_SHOWN],
        "evaluated": "breakdowns" in contents,
        "notes": contents.get("notes", []),
        "stylesheet": Markup(STYLESHEET),
        "data": Markup(embedded(contents)),
        "speeds_text": _speeds_text(contents),
        "figures": _Absent(shown),
    }
    return environment.from_string(MACROS + PAGE).render(values).lstrip()


def embedded(contents: Mapping[str, Any]) -> str:
    """Return JSON that may stand in a page: nothing in it can end the element it stands in."""
    text = json.dumps(contents, allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def picture(png: bytes, alt: str, width: float) -> str:
    """Return a PNG as an element of the page; `width` is a share of the page's."""
    data = base64.b64encode(png).decode()
    element = '<img src="data:image/png;base64,{}" alt="{}" style="width: {}%">'
    return str(Markup(element).format(data, alt, round(100.0 * width)))


def _speeds_text(contents: Mapping[str, Any]) -> str:
    """Return between which speeds the changes were flown."""
    rows = contents.get("breakdowns", {}).get("by_speed", [])
    low = [row["low"] for row in rows if row["lag_distance_m"]["count"]]
    high = [row["high"] for row in rows if row["lag_distance_m"]["count"]]
    return f"{min(low):g} to {max(high):g} m/s" if low else "no changes"


class _Absent(dict[str, Any]):
    """Figures by name; one that was not drawn is none."""

    def __missing__(self, key: str) -> None:
        return None


def _with_pairs(setup: Mapping[str, Any]) -> dict[str, Any]:
    sets = [
        {**each, "pairs": list(zip(each["duty"], each["flow_l_min"], strict=True))}
        for each in setup["nozzle_sets"]
    ]
    return {**setup, "nozzle_sets": sets}


def _with_rows(table: Mapping[str, Any] | None) -> dict[str, Any] | None:
    return None if table is None else {**table, "rows_shown": table["rows"][:RATES_SHOWN]}


def _number(value: float | None, digits: int) -> str:
    return NOTHING if value is None else f"{value:,.{digits}f}"


def _signed(value: float | None, digits: int) -> str:
    return NOTHING if value is None else f"{value:+,.{digits}f}"


def _percent(text: str) -> str:
    return text if text == NOTHING else f"{text} %"


def _moment(text: str | None) -> str:
    """Return a time of ISO 8601 as it is read, without its offset: the page names the zone.

    >>> _moment("2026-11-22T03:22:39+00:00")
    '2026-11-22 03:22:39'
    """
    return NOTHING if text is None else text[:19].replace("T", " ")


def _span(interval: Mapping[str, Any], digits: int) -> str:
    """Return an interval as it is read; too few independent measurements have none."""
    low, high = interval["low"], interval["high"]
    return NOTHING if low is None or high is None else f"{low:.{digits}f} to {high:.{digits}f}"


FILTERS: dict[str, Callable[..., str]] = {
    "f": _number,
    "signed": _signed,
    "percent": _percent,
    "moment": _moment,
    "span": _span,
    "duration": duration_text,
}
