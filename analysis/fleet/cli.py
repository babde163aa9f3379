"""Command line of the fleet: `vrspray fleet`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from companion.cli.answer import AsJson, answer, new_app, note, progress
from companion.wording import counted

if TYPE_CHECKING:
    from analysis.fleet.adding import Added

FAILED, REFUSED, INTERRUPTED = 1, 2, 130
SHOWN_MAX = 20
# Below this nothing is to be seen.
PROGRESS_AFTER_S = 2.0

app = new_app(
    no_args_is_help=True,
    help="Many journals as one data set: add, query with SQL, report, serve.",
    epilog="Example: vrspray fleet add flights --into fleet",
)

Place = Annotated[
    str,
    typer.Option(
        "--fleet", metavar="FOLDER|URL", help="Where the flights are: a folder, or an fsspec URL."
    ),
]


@app.command(epilog="Example: vrspray fleet add flights other/flight-0001.gpkg --into fleet")
def add(
    journals: Annotated[
        list[Path], typer.Argument(metavar="JOURNAL...", help="Journals, or folders of them.")
    ],
    into: Annotated[
        str,
        typer.Option(
            "--into",
            "--fleet",
            metavar="FOLDER|URL",
            help="A folder, or an fsspec URL; made if missing.",
        ),
    ],
    machine: Annotated[
        str | None,
        typer.Option(
            metavar="NAME", help="Machine that flew, if a journal names no application.aircraft."
        ),
    ] = None,
    is_quick: Annotated[
        bool,
        typer.Option("--quick", help="Leave the evaluation to a later add."),
    ] = False,
    processes: Annotated[
        int | None,
        typer.Option(min=1, max=256, help="How many at once. Default: one for each core."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Add journals to a fleet's data set.

    Adding a journal twice changes nothing; a longer copy replaces a shorter one.
    Exit 0: all are in; 1: some could not be read, and are listed; 2: wrong input, or no journal.
    """
    from analysis.fleet.adding import add as add_all
    from analysis.fleet.adding import journals_in
    from analysis.fleet.store import STORE_ERRORS, Store

    paths = journals_in(journals)
    store = Store.at(into)
    with progress(quiet=as_json, after_s=PROGRESS_AFTER_S) as tell:
        try:
            store.refuse_campaign()
            done = add_all(
                paths,
                store,
                machine=machine,
                evaluate=not is_quick,
                processes=processes,
                tell=tell,
            )
        except STORE_ERRORS as error:
            raise store.refused(error) from error
    for each in done.problems[:SHOWN_MAX]:
        note(f"not added: {each.path}: {each.text}")
    if len(done.problems) > SHOWN_MAX:
        note(f"not added: {len(done.problems) - SHOWN_MAX} more; --json lists all")
    per_s = done.journals / done.record_s if done.record_s > 0.0 else None
    result: dict[str, Any] = {
        "fleet": into,
        "journals": done.journals,
        "added": done.added,
        "replaced": done.replaced,
        "unchanged": done.unchanged,
        "evaluated": done.evaluated,
        "not_evaluated": done.not_evaluated,
        "problems": [
            {"file": str(each.path), "text": each.text, "is_damaged": each.is_damaged}
            for each in done.problems
        ],
        "record_s": done.record_s,
        "evaluate_s": done.evaluate_s,
        "journals_per_s": per_s,
        "interrupted": done.is_interrupted,
    }
    lines = [
        f"{counted(done.added, 'flight')} added, {done.replaced} replaced, {done.unchanged} there "
        f"already, {counted(len(done.problems), 'journal')} not read"
    ]
    if done.evaluated:
        lines.append(f"{counted(done.evaluated, 'flight')} evaluated")
    if done.not_evaluated:
        lines.append(f"{done.not_evaluated} not evaluated yet: run the same command again")
    if done.journals < len(paths):
        lines.append(
            f"interrupted after {done.journals} of {counted(len(paths), 'journal')}: run the same "
            "command again"
        )
    answer(result, lines, as_json=as_json)
    raise typer.Exit(_exit_code(done))


def _exit_code(done: Added) -> int:
    if done.is_interrupted:
        return INTERRUPTED
    if not done.problems:
        return 0
    are_others = all(each.is_other for each in done.problems)
    return REFUSED if are_others and len(done.problems) == done.journals else FAILED


@app.command(
    epilog='Example: vrspray fleet query "SELECT machine, sum(area_ha) FROM flights GROUP BY 1" '
    "--fleet fleet"
)
def query(
    sql: Annotated[str, typer.Argument(help="One SELECT; the tables are in the reference.")],
    fleet: Place,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write all rows to .csv, .parquet or .json instead."),
    ] = None,
    memory_mb: Annotated[
        int, typer.Option(min=50, max=1_000_000, help="Memory that the query may use, in MB.")
    ] = 300,
    as_json: AsJson = False,
) -> None:
    """Query the flights with SQL (DuckDB).

    Tables: flights, closings, faults, valves, damaged.
    """
    from analysis.fleet.asking import asked, check_out, lines_of, rows_of, write_table
    from analysis.fleet.store import Store

    if out is not None:
        check_out(out)
    with asked(Store.at(fleet).existing(), memory_mb=memory_mb) as flights:
        table = flights.ask(sql)
    result: dict[str, Any] = {"columns": table.column_names, "row_count": len(table)}
    if out is not None:
        write_table(out, table)
        answer(
            {**result, "file": str(out)},
            [f"{out}: {counted(len(table), 'row')}"],
            as_json=as_json,
        )
        return
    rows = rows_of(table) if as_json else []
    answer({**result, "rows": rows}, () if as_json else lines_of(table), as_json=as_json)


@app.command(epilog='Example: vrspray fleet forget "A. Grower" --fleet fleet')
def forget(
    operator: Annotated[str, typer.Argument(help="The operator: the name, or the number op-...")],
    fleet: Place,
    with_flights: Annotated[
        bool, typer.Option("--flights", help="Remove the flights too, not only who flew them.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Remove an operator from every file.

    They stay removed when their journals are added again.
    """
    from analysis.fleet.row import operator_number
    from analysis.fleet.store import STORE_ERRORS, Store
    from companion.errors import ConfigError

    if not operator.strip():
        raise ConfigError("OPERATOR: is empty; give the name, or the number op-...")
    store = Store.at(fleet).existing()
    number = operator_number(operator)
    try:
        count = store.forget(number, with_flights=with_flights)
    except STORE_ERRORS as error:
        raise store.refused(error) from error
    if not count:
        note("no flight here names this operator; check the spelling")
    what = "removed" if with_flights else "kept, without their operator"
    answer(
        {"operator": number, "flights": count, "flights_removed": with_flights},
        [f"{number}: {counted(count, 'flight')} {what}"],
        as_json=as_json,
    )


Since = Annotated[str | None, typer.Option("--from", metavar="MONTH", help="As 2026-05.")]
Until = Annotated[str | None, typer.Option(metavar="MONTH", help="As 2026-10, included.")]
Kinds = Annotated[
    list[str] | None,
    typer.Option(metavar="KIND", help="real, unknown, training, simulated; repeatable."),
]


@app.command(epilog="Example: vrspray fleet report --fleet fleet --out fleet-report --from 2026-04")
def report(
    fleet: Place,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the files of the report.")],
    since: Since = None,
    until: Until = None,
    kind: Kinds = None,
    as_json: AsJson = False,
) -> None:
    """Summarise the fleet as a web page, JSON, CSV and Parquet.

    By machine, field, product, operator and month.
    """
    from analysis.fleet.asking import asked
    from analysis.fleet.page import files_of
    from analysis.fleet.store import Store
    from analysis.fleet.summary import Chosen, summary_of
    from analysis.report.folder import check_folder, write_files

    chosen = Chosen(since=since, until=until, kinds=tuple(kind or ()))
    check_folder(out)
    with asked(Store.at(fleet).existing()) as flights:
        summary = summary_of(flights, chosen)
    files = files_of(summary)
    write_files(out, files)
    lines = [
        f"{each['title']}: {counted(each['totals']['flights'], 'flight')}, "
        f"{each['totals']['area_ha'] or 0.0:.2f} ha, {each['totals']['applied_l'] or 0.0:.1f} L"
        for each in summary["sections"]
    ]
    answer(
        {**summary, "files": [str(out / name) for name in files]},
        [*(lines or ["no flights in this period"]), f"report: {out / 'fleet.html'}"],
        as_json=as_json,
    )


@app.command(
    epilog="Example: vrspray fleet serve --fleet fleet --host 0.0.0.0 --name office.example"
)
def serve(
    fleet: Place,
    host: Annotated[
        str, typer.Option(metavar="ADDRESS", help="Where to listen; 0.0.0.0 is every network.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port of the page.")] = 8881,
    name: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="Host name that the page may be called by; repeatable."),
    ] = None,
    tokens: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="File of the page's tokens; made if missing."),
    ] = None,
    certificate: Annotated[
        Path | None, typer.Option("--tls-certificate", metavar="PEM", help="With --tls-key: HTTPS.")
    ] = None,
    key: Annotated[
        Path | None, typer.Option("--tls-key", metavar="PEM", help="The certificate's key.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Show the fleet's report on a page, read only, until Ctrl-C.

    From another computer, open the link that is printed here, with its token.
    """
    from analysis.fleet.serving import serve as serve_page
    from analysis.fleet.store import Store
    from companion.cli.web_parts import own_address
    from companion.errors import ConfigError
    from companion.web import listen
    from companion.web.guard import Doors, Guard, is_loopback, kept_tokens

    if (certificate is None) != (key is None):
        raise ConfigError("--tls-certificate and --tls-key go together; give both")
    tls = None if certificate is None or key is None else (str(certificate), str(key))
    for each in tls or ():
        if not Path(each).is_file():
            raise ConfigError(f"{each}: there is no such file; give a PEM file")
    store = Store.at(fleet).existing()
    names = tuple(each.lower() for each in name or ())
    doors = Doors(is_local=is_loopback(host), names=names, port=port)
    tokens = tokens or Path.home() / ".local/state/vrspray/fleet-tokens.json"
    kept = kept_tokens(tokens)
    guard = Guard(doors=doors, tokens=kept, names_by="--name", printed_by="vrspray fleet serve")
    listener = listen(host, port, port_by="--port", host_by="--host")
    local = "127.0.0.1" if doors.is_local else own_address(host)
    shown = names[0] if names else local
    link = f"http{'s' if tls else ''}://{f'[{shown}]' if ':' in shown else shown}:{port}/"
    told, lines = link + f"#token={kept.view}" * doors.needs_token, []
    if not (as_json or sys.stdout.isatty()) and doors.needs_token:
        # A service's log is read by more people than the page.
        told, lines = link, [f'its token: "view" in {tokens}']
    result = {"fleet": fleet, "url": told}
    answer(result, [f"the fleet's page: {told}", *lines], as_json=as_json)
    serve_page(store, guard, listener, tls)
