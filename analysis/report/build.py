"""From a journal to the files of its report.

On paper it is the page itself, printed on A4 by a browser that is installed. The page is the only
design, and a browser prints it best. Nothing else is installed for it: where there is no browser,
the page can be printed on any other computer.
"""

from __future__ import annotations

import base64
import json
import math
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import shapely
from jinja2 import Environment, StrictUndefined, Template
from markupsafe import Markup

from analysis.assess.assessment import Assessment, Figures, assess, figures_of
from analysis.assess.ground import Treated, treated_of
from analysis.flown.applied_record import EvaluationError
from analysis.flown.read_applied import read_applied
from analysis.report.clock import Clock, clock_of, duration_text
from analysis.report.contents import contents_of, reasons_in_words
from analysis.report.legal import LegalRecord, legal_record
from analysis.report.legal_fields import Facts, Told, facts_of, told_with
from companion.config.application_table import PROFILES, Profile
from companion.csv_table import csv_of
from companion.errors import ConfigError

if TYPE_CHECKING:
    from analysis.flown.applied_flight import AppliedFlight
    from analysis.report.figure_style import Drawn
    from companion.simulated import Simulated

Say = Callable[[str], None]
TOO_LITTLE = "too little of the journal can be read"


@dataclass(frozen=True, slots=True, kw_only=True)
class ReportOptions:
    """What is asked of a report; without profiles the journal's own, else the generic one."""

    profiles: tuple[Profile, ...] = ()
    time_zone: str | None = None
    application_file: Path | None = None
    changes: tuple[str, ...] = ()
    with_figures: bool = True
    with_pdf: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Report:
    """The files of a report by name, and what they say."""

    contents: Mapping[str, Any]
    files: Mapping[str, bytes]

    @property
    def is_whole(self) -> bool:
        """Return whether the journal had all that a flight leaves behind."""
        flight = self.contents["flight"]
        return bool(flight["is_closed"] and not flight["lost"] and not flight["unread"])


def build_report(journal: Path, options: ReportOptions, *, say: Say = lambda _: None) -> Report:
    """Return the report of one journal; nothing is written.

    Raises:
        JournalError: where the file is not a journal, or one that cannot be read.
        ConfigError: where an entry of the record or the time zone is none.
    """
    return drawn(judged(journal, options, say=say), options, say=say)


@dataclass(frozen=True, slots=True, kw_only=True)
class Judged:
    """A journal that was read and evaluated, and what its report says."""

    contents: dict[str, Any]
    flight: AppliedFlight
    assessment: Assessment | None
    treated: Treated
    clock: Clock
    told: Told
    facts: Facts
    records: list[LegalRecord]


def judged(journal: Path, options: ReportOptions, *, say: Say = lambda _: None) -> Judged:
    """Return what the report of one journal says."""
    say(f"reading {journal}")
    unread: list[str] = []
    flight = read_applied(journal, unread=unread)
    treated = treated_of(flight)
    told = told_with(
        flight.meta,
        file=options.application_file,
        changes=options.changes,
        until_s=math.inf if treated.last_s is None else treated.last_s,
    )
    say("evaluating")
    assessment, why_not = _assessed(flight, treated, is_whole=not (unread or flight.lost))
    clock = _clock(flight, told, treated, options.time_zone)
    figures = figures_of(assessment, area_ha=treated.area_ha, is_whole=not (unread or flight.lost))
    facts = facts_of(flight, treated, clock, unread=len(unread), **volumes(figures))
    records = [legal_record(each, told, facts) for each in profiles_of(options, told)]
    contents = contents_of(
        flight,
        assessment,
        treated=treated,
        figures=figures,
        clock=clock,
        told=told,
        records=records,
        unread=unread,
        why_not_evaluated=why_not,
    )
    return Judged(
        contents=contents,
        flight=flight,
        assessment=assessment,
        treated=treated,
        clock=clock,
        told=told,
        facts=facts,
        records=records,
    )


def drawn(found: Judged, options: ReportOptions, *, say: Say = lambda _: None) -> Report:
    """Return the files of a report."""
    say("drawing")
    figures: Iterable[Drawn] = ()
    if options.with_figures and found.assessment is not None:
        from analysis.report.drawing import drawn_of

        figures = drawn_of(found.assessment, found.clock, found.treated)
    return with_files(found.contents, found.records, found.flight.simulated, figures, options)


def _assessed(
    flight: AppliedFlight, treated: Treated, *, is_whole: bool
) -> tuple[Assessment | None, str]:
    """Return the evaluation, or None and why there is none: nothing flown, or too little read."""
    try:
        found = assess(flight, treated=treated)
    except EvaluationError as error:
        why = str(error).removeprefix(f"{flight.path}: ")
        return None, why if is_whole else TOO_LITTLE
    if is_whole or found.evaluation.applied_ml > 0.0:
        return found, ""
    # Valves count as closed where nothing is known: that nothing was sprayed is no result then.
    return None, TOO_LITTLE


def _clock(flight: AppliedFlight, told: Told, treated: Treated, time_zone: str | None) -> Clock:
    """Return the clock; the operator's start of spraying stands for a clock that was not right."""
    clock = clock_of(flight, time_zone or told.values.get("application.time_zone"))
    start_time = told.values.get("application.start_time")
    return clock if start_time is None else clock.moved_to(start_time, treated.first_s)


def volumes(figures: Figures) -> dict[str, Any]:
    """Return the litres of the record: those of the headline, and what they are known by."""
    by = figures.applied_by or "nothing"
    return {
        "volume_l": figures.applied_l or 0.0,
        "volume_by": "model of the executed changes" if by == "model" else by,
        "modelled_l": figures.modelled_l,
        "prescribed_l": figures.prescribed_l,
    }


def profiles_of(options: ReportOptions, told: Told) -> tuple[Profile, ...]:
    """Return whose records are made."""
    if options.profiles:
        return tuple(dict.fromkeys(options.profiles))
    own = told.values.get("application.profile")
    return (own,) if own in PROFILES else ("generic",)


def with_files(
    contents: dict[str, Any],
    records: Sequence[LegalRecord],
    simulated: Simulated,
    drawings: Iterable[Drawn],
    options: ReportOptions,
) -> Report:
    """Return the files of a report with these figures."""
    files, figures = _figures(drawings, simulated)
    contents["figures"] = [name for name in files if name.startswith("figures/")]
    for record in records:
        files[f"application-{record.profile}.json"] = record_json(record)
        files[f"application-{record.profile}.csv"] = record_csv(record)
    files["report.json"] = (json.dumps(contents, indent=1, allow_nan=False) + "\n").encode()
    page = page_of(contents, figures)
    files["report.html"] = page.encode()
    if options.with_pdf:
        files["report.pdf"] = pdf_of(page)
    return Report(contents=contents, files=files)


def _figures(
    drawings: Iterable[Drawn], simulated: Simulated
) -> tuple[dict[str, bytes], dict[str, dict[str, str]]]:
    """Return the files of all figures, and how they stand in the page."""
    files: dict[str, bytes] = {}
    figures: dict[str, dict[str, str]] = {}
    if drawings == ():
        return files, figures
    from analysis.report.figure_style import inline_svg, png_of, stamp, styled, svg_of

    mark = "" if simulated.is_unmarked else simulated.label
    with styled():
        for each in drawings:
            stamp(each.figure, mark)
            png, svg = png_of(each), svg_of(each)
            files[f"figures/{each.name}.png"] = png
            files[f"figures/{each.name}.svg"] = svg.encode()
            is_map = each.kind == "map"
            figures[each.name] = {
                "title": each.title,
                "caption": each.caption,
                "markup": picture(png, each.alt, each.width) if is_map else inline_svg(each, svg),
            }
    return files, figures


# The page: one file that opens from disk, with all figures and every number in it.

EVENTS_SHOWN, RATES_SHOWN = 200, 40
NOTHING = "-"


def page_of(contents: Mapping[str, Any], figures: Mapping[str, Mapping[str, str]]) -> str:
    """Return the page; `figures` has title, caption and markup (HTML) by name."""
    shown = {name: {**each, "markup": Markup(each["markup"])} for name, each in figures.items()}
    values = {
        **contents,
        "setup": _with_pairs(contents["setup"]) if "setup" in contents else None,
        "table_5": _with_rows(contents.get("table_5")),
        "events_shown": contents["events"][:EVENTS_SHOWN],
        "evaluated": "balance" in contents,
        "detailed": "breakdowns" in contents,
        "sorties": contents.get("sorties", []),
        "notes": contents.get("notes", []),
        "stylesheet": Markup(_text_of("page.css")),
        "data": Markup(embedded(contents)),
        "speeds_text": _speeds_text(contents),
        "figures": _Absent(shown),
    }
    return _template().render(values).lstrip()


@cache
def _template() -> Template:
    # Compiling it takes a third of a report's time: once, where many are made.
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=False, keep_trailing_newline=True
    )
    environment.filters |= FILTERS
    return environment.from_string(_text_of("page.html.j2"))


def _text_of(name: str) -> str:
    return resources.files("analysis.report").joinpath(name).read_text(encoding="utf-8")


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
    "in_words": reasons_in_words,
}


# A legal record as files: JSON with the treated area as GeoJSON, CSV of one row.


def record_json(record: LegalRecord) -> bytes:
    """Return the record as JSON."""
    return (json.dumps(record.as_json(), indent=1, allow_nan=False) + "\n").encode()


def record_csv(record: LegalRecord) -> bytes:
    """Return the record as one row under its heading, so that a register grows by appending rows.

    A column is named as the field in the JSON, with the unit where there is one; the area is WKT.
    """
    row: dict[str, object] = {
        "profile": record.profile,
        "complete": "yes" if record.is_complete else "no",
        "simulated": record.simulated.word,
        "missing": "; ".join(record.missing),
        "keep_until": record.keep_until or "",
    }
    for entry in record.entries:
        row[entry.name] = "" if entry.value is None else entry.value
        if entry.unit and not entry.name.endswith(entry.unit.lower().replace("/", "_")):
            row[f"{entry.name}_unit"] = entry.unit
    if record.sorties:
        row["sorties"] = "; ".join(
            f"{each['spraying_from']} to {each['spraying_until']}: {each['applied_l'] or 0.0:.3f} L"
            f" by {each['aircraft'] or 'an aircraft not named'}"
            for each in record.sorties
        )
    row["added_after_flight"] = "; ".join(record.added_after_flight)
    row["remarks"] = "; ".join(record.remarks)
    area = shapely.from_geojson(json.dumps(record.treated_area))
    row["treated_area_wkt"] = shapely.to_wkt(area, rounding_precision=7)
    return csv_of([row]).encode()


# Chromium and what is made of it; all take the same options.
BROWSERS = (
    "chromium",
    "chromium-browser",
    "google-chrome",
    "google-chrome-stable",
    "chrome",
    "microsoft-edge",
    "brave-browser",
)
WITHIN_S = 120.0
# No network, no first-run pages, nothing kept: the page is whole by itself.
_OPTIONS = (
    "--headless",
    "--disable-gpu",
    "--no-first-run",
    "--no-default-browser-check",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-extensions",
    "--host-resolver-rules=MAP * ~NOTFOUND",
    "--no-pdf-header-footer",
)


def browser(which: Callable[[str], str | None] = shutil.which) -> str:
    """Return a browser that prints; ConfigError, in one line, where none is installed."""
    found = next((path for name in BROWSERS if (path := which(name))), None)
    if found is None:
        raise ConfigError(
            "--pdf: no Chromium or Chrome is installed; install chromium, or leave --pdf out and "
            "print report.html from any browser"
        )
    return found


def pdf_of(page: str, *, program: str | None = None) -> bytes:
    """Return a page as PDF; ConfigError where the browser does not make one."""
    program = program or browser()
    with tempfile.TemporaryDirectory(prefix="vrspray-pdf-", ignore_cleanup_errors=True) as name:
        folder = Path(name)
        source, target = folder / "report.html", folder / "report.pdf"
        source.write_text(page, encoding="utf-8")
        # A browser refuses its sandbox to root, who needs none against a page of our own.
        is_root = hasattr(os, "geteuid") and os.geteuid() == 0
        command = [
            program,
            *_OPTIONS,
            *(["--no-sandbox"] if is_root else []),
            f"--user-data-dir={folder / 'profile'}",
            f"--print-to-pdf={target}",
            source.as_uri(),
        ]
        try:
            subprocess.run(command, capture_output=True, timeout=WITHIN_S, check=False)
            found = target.read_bytes()
        except (OSError, subprocess.TimeoutExpired) as error:
            raise ConfigError(
                f"--pdf: {program} did not print the page; print report.html from a browser"
            ) from error
    return found
