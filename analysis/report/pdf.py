"""The report on paper: pages of text, then the figures; matplotlib makes it, nothing else needed.

Short on purpose: the page prints better, and a PDF of it is one `print` away. This one is for where
there is no browser.
"""

from __future__ import annotations

import io
import textwrap
from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

from matplotlib.backends.backend_pdf import PdfPages

from analysis.report.figures.style import INK, QUIET, new_figure, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from analysis.report.figures.style import Drawn

# Fits A4 and Letter, each of which is a little more in one direction.
PAGE_IN = (8.27, 11.0)
COLUMNS = 105
TOP, BOTTOM, LEFT = 0.95, 0.06, 0.08
# Of the page's height, for one line of each style.
HEIGHTS = {"title": 0.026, "head": 0.018, "mark": 0.022}
LINE = 0.0138

ALARM = "#A11B00"

_Line = tuple[str, str]  # style, text


def pdf_of(contents: Mapping[str, Any], figures: Iterable[Drawn]) -> bytes:
    """Return the report as PDF."""
    file = io.BytesIO()
    with styled(), PdfPages(file, metadata={"Creator": "vrspray", "CreationDate": None}) as pages:
        for page in _pages(contents):
            pages.savefig(page)
        for drawn in figures:
            pages.savefig(drawn.figure)
    return file.getvalue()


def _pages(contents: Mapping[str, Any]) -> Iterator[Figure]:
    page, at = new_figure(PAGE_IN[1], PAGE_IN[0]), TOP
    for style, text in _lines(contents):
        height = HEIGHTS.get(style, LINE)
        if at - height < BOTTOM:
            yield page
            page, at = new_figure(PAGE_IN[1], PAGE_IN[0]), TOP
        page.text(LEFT, at, text, va="top", **STYLES[style])
        at -= height
    yield page


STYLES: dict[str, dict[str, Any]] = {
    "title": {"size": 15, "weight": "bold", "color": INK},
    "head": {"size": 10, "weight": "bold", "color": INK},
    "mark": {"size": 13, "weight": "bold", "color": ALARM},
    "text": {"size": 8.5, "color": INK},
    "quiet": {"size": 8, "color": QUIET},
}


def _lines(contents: Mapping[str, Any]) -> Iterator[_Line]:
    flight = contents["flight"]
    yield "title", "Spray report"
    yield "text", ""
    yield "quiet", f"{flight['file']}, SHA-256 {flight['sha256'][:32]}..."
    for each in contents["warnings"]:
        if each["severity"] == "mark":
            yield "mark", each["text"]
    yield from _wrapped("head", contents["verdict"]["sentence"], 88)
    yield "text", ""
    when = f"{flight['spraying_from'] or flight['started'] or 'time not known'}"
    yield from _wrapped("text", f"{when}, time zone {flight['time_zone']}, {flight['clock']}")
    place = f"{flight['latitude_deg']:.6f}, {flight['longitude_deg']:.6f} (WGS84)"
    area_ha = flight["treated_area_ha"]
    treated = "treated area not known" if area_ha is None else f"{area_ha:.4f} ha treated"
    yield "text", f"{place}, {treated}"
    for each in contents["warnings"]:
        if each["severity"] != "mark":
            yield from _wrapped("text", f"{each['severity'].upper()}: {each['text']}")
    yield from _metrics(contents)
    for record in contents["application"].values():
        yield from _record(record)


def _metrics(contents: Mapping[str, Any]) -> Iterator[_Line]:
    yield "text", ""
    yield "head", "Figures"
    for key, definition in contents["definitions"].items():
        value = contents.get(key)
        if isinstance(value, Mapping):
            value = value["mean_abs"]
        if value is not None:
            shown = f"{value:.3f}" if isinstance(value, float) else f"{value}"
            text = f"{definition['name']}: {shown} {definition['unit']} - {definition['text']}"
            yield from _wrapped("text", text)


def _record(record: Mapping[str, Any]) -> Iterator[_Line]:
    yield "text", ""
    yield from _wrapped("head", f"Record of the application: {record['law']}", 88)
    if record["complete"]:
        yield "text", "Complete."
    else:
        yield from _wrapped("mark", f"INCOMPLETE: {', '.join(record['missing'])}", 60)
    for entry in record["fields"].values():
        value = "-" if entry["value"] is None else f"{entry['value']} {entry['unit']}".strip()
        said = f" ({entry['said']})" if entry["said"] else ""
        yield from _wrapped("text", f"{entry['label']}: {value}{said}")
    for remark in record["remarks"]:
        yield from _wrapped("quiet", f"Remark: {remark}")


def _wrapped(style: str, text: str, columns: int = COLUMNS) -> Iterator[_Line]:
    # A text of the operator is no mathematics: a dollar sign is one.
    for line in textwrap.wrap(text, columns) or [""]:
        yield style, line.replace("$", r"\$")
