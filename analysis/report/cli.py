"""Command line of the report: `vrspray report`."""

from __future__ import annotations

import time
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from companion.cli.answer import AsJson, JournalFiles, answer, new_app, note

app = new_app()


class Law(StrEnum):
    """Whose record of the application; the values are the configuration's profiles."""

    EU = "eu"
    US = "us"
    AUSTRALIA = "australia"
    GENERIC = "generic"


@app.command(epilog="Example: vrspray report flights/flight-0001.gpkg --out report --profile eu")
def report_flight(
    journals: JournalFiles,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the files of the report.")],
    profile: Annotated[
        list[Law] | None,
        typer.Option(
            help="Legal record: eu, us, australia, generic; repeatable. Default: the journal's."
        ),
    ] = None,
    time_zone: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Time zone, such as Europe/Madrid. Default: UTC."),
    ] = None,
    application: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="TOML with [application] and [product], added after the flight."
        ),
    ] = None,
    changes: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="KEY=VALUE", help="Entry of the record, added after the flight."
        ),
    ] = None,
    is_pdf: Annotated[
        bool, typer.Option("--pdf", help="Also report.pdf, on A4 (needs Chromium or Chrome).")
    ] = False,
    is_plain: Annotated[bool, typer.Option("--no-figures", help="Leave out all figures.")] = False,
    as_json: AsJson = False,
) -> None:
    """Evaluate a flight, or all sorties of a job, and write one report with its record.

    Several journals are one field: ground counts once, doses and litres add up.

    Exit 0: written; 1: of a journal that was cut, is damaged, lacks rows or is of another version:
    what can be read is written; 2: no journal, an option is wrong, or DIR cannot be written.
    """
    from analysis.report.build import ReportOptions, browser, build_report
    from analysis.report.clock import zone_of
    from analysis.report.folder import check_folder, earlier_files, write_files
    from analysis.report.job import build_job

    began_s = time.perf_counter()
    check_folder(out)
    # Refused before the flight is read.
    zone_of(time_zone)
    if is_pdf:
        browser()
    options = ReportOptions(
        profiles=tuple(law.value for law in profile or ()),
        time_zone=time_zone,
        application_file=application,
        changes=tuple(changes or ()),
        with_figures=not is_plain,
        with_pdf=is_pdf,
    )
    if len(journals) > 1:
        report = build_job(journals, options, say=note)
    else:
        report = build_report(journals[0], options, say=note)
    write_files(out, report.files, without=earlier_files(out, report.files))
    contents = report.contents
    for warning in contents["warnings"]:
        if warning["severity"] != "note":
            note(f"{warning['severity']}: {warning['text']}")
    answer(
        {**contents, "files": [str(out / name) for name in report.files],
         "wall_s": time.perf_counter() - began_s},
        [contents["verdict"]["sentence"], f"report: {out / 'report.html'}"],
        as_json=as_json,
    )  # fmt: skip
    raise typer.Exit(0 if report.is_whole else 1)


# What the program's own command line takes in: one command of the kind that Typer makes.
report = typer.main.get_command(app)
