"""Command line of campaigns: `vrspray campaign FILE`, `vrspray campaign show DIR`."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer.core import TyperGroup

from companion.cli.answer import AsJson, answer, new_app, note, progress
from companion.errors import ConfigError, StoppedError
from companion.wording import counted, refuse_existing

if TYPE_CHECKING:
    from typer._click.core import Context

    from sitl.campaign.bundle import Bundle
    from sitl.campaign.dataset import Dataset
    from sitl.campaign.design import Campaign
    from sitl.campaign.running import Tally, Workers

# Without a terminal: how often it says how far it is.
SAY_EVERY_S = 60.0


class RunIsUnsaid(TyperGroup):
    """A group one of whose commands needs no name: `campaign FILE` is `campaign run FILE`."""

    unsaid = "run"

    def parse_args(self, ctx: Context, args: list[str]) -> list[str]:
        """Put its name in front of what is no command's name."""
        if args and args[0] not in self.commands and args[0] not in ("-h", "--help"):
            args = [self.unsaid, *args]
        return super().parse_args(ctx, args)


app = new_app(
    cls=RunIsUnsaid,
    help="Simulate many flights, varying settings: vrspray campaign FILE. Show the results.",
    epilog="Example: vrspray campaign examples/campaigns/lags.toml --out lags",
    no_args_is_help=True,
)


@app.command(epilog="Example: vrspray campaign examples/campaigns/lags.toml --out lags")
def run(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Campaign file (TOML).")],
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Folder of the dataset. Default: NAME-flights for NAME.toml."
        ),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(metavar="N", help="Flights at a time. Default: one for each core.")
    ] = None,
    cluster: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="A Dask scheduler, tcp://HOST:PORT, instead."),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Check the file and count its flights only.")
    ] = False,
    allow_code: Annotated[
        bool, typer.Option("--allow-code", help="Run the code that method.controller names.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Fly all flights of a campaign file into a Parquet dataset.

    Run the same command again to continue. A flight that fails is a row with its error.
    Exit 0: flown; 1: no flight could be flown; 2: file or option is wrong; 130: interrupted.
    """
    from sitl.campaign.bundle import bundle_of
    from sitl.campaign.dataset import open_dataset
    from sitl.campaign.design import read_campaign

    if cluster is not None and workers is not None:
        raise ConfigError("--workers: of this computer; leave it out with --cluster")
    campaign = read_campaign(file)
    bundle = bundle_of(campaign)
    plan = {
        "campaign": campaign.name,
        "flights": campaign.flights,
        "settings": campaign.settings_count,
        "seeds": len(campaign.seeds),
        "varied": list(campaign.varied),
    }
    code = {str(given.get("method.controller", "")) for given in campaign.tried()} - {""}
    if dry_run:
        needs = ["needs --allow-code: it runs the code of " + ", ".join(sorted(code))] * bool(code)
        answer(plan | {"code": sorted(code)}, [*_plan_lines(campaign), *needs], as_json=as_json)
        return
    if code and not allow_code:
        raise ConfigError(
            f"{file}: method.controller = '{min(code)}': this code would run on each worker; "
            "read it, then add --allow-code"
        )
    dataset = open_dataset(campaign, bundle, out or Path(f"{file.stem}-flights"))
    missing = sum(len(dataset.flights_of(part)) for part in dataset.missing())
    done = campaign.flights - missing
    if done and missing:
        note(f"{done} of {campaign.flights} flights are there already")
    tally = None
    if missing:
        with _workers(workers, cluster, bundle) as flown_by:
            tally = _flown(dataset, bundle, flown_by, done, quiet=as_json)
    result = plan | {"out": str(dataset.folder), **({} if tally is None else tally.as_json())}
    answer(result, _lines(dataset, tally), as_json=as_json)
    if tally is not None and tally.flights == tally.failed:
        raise typer.Exit(1)


@contextmanager
def _workers(count: int | None, cluster: str | None, bundle: Bundle) -> Iterator[Workers]:
    from sitl.campaign.running import cluster_at, pool_of

    if cluster is None:
        with pool_of(count, bundle) as pool:
            yield pool
    else:
        with cluster_at(cluster) as found:
            yield found


def _flown(dataset: Dataset, bundle: Bundle, workers: Workers, done: int, *, quiet: bool) -> Tally:
    """Fly what is missing, and log how it went, however it ended."""
    from sitl.campaign.running import Tally, fly_missing
    from sitl.workers import termination_as_interrupt

    total, tally = dataset.campaign.flights, Tally()
    started = time.time()
    try:
        with termination_as_interrupt(), progress(quiet=quiet) as bar:
            says = _Says(done, total, quiet=quiet)

            def tell(flights: int) -> None:
                bar("flights", done + flights, total)
                says.tell(flights)

            bar("flights", done, total)
            fly_missing(dataset, bundle, workers, tally, tell=tell)
    except KeyboardInterrupt:
        left = sum(len(dataset.flights_of(part)) for part in dataset.missing())
        raise StoppedError(
            f"interrupted: {total - left} of {total} flights are kept in {dataset.folder}; run "
            "the same command again to continue"
        ) from None
    finally:
        dataset.log({"started": round(started, 3), **tally.as_json()})
    return tally


class _Says:
    """Says on stderr how far it is, where there is no bar."""

    def __init__(self, done: int, total: int, *, quiet: bool) -> None:
        self._done, self._total, self._quiet = done, total, quiet
        self._began_s = self._said_s = time.monotonic()

    def tell(self, flights: int) -> None:
        """Take how many flights this run has done."""
        now_s = time.monotonic()
        if self._quiet or sys.stderr.isatty() or now_s - self._said_s < SAY_EVERY_S:
            return
        self._said_s = now_s
        done = self._done + flights
        left_s = (now_s - self._began_s) / flights * (self._total - done)
        note(f"{done} of {self._total} flights, {_time(left_s)} left")


def _time(left_s: float) -> str:
    """Return a time for people.

    >>> _time(59.0), _time(3000.0), _time(90_000.0)
    ('59 s', '50 min', '25.0 h')
    """
    if left_s < 100.0:
        return f"{left_s:.0f} s"
    return f"{left_s / 60.0:.0f} min" if left_s < 6000.0 else f"{left_s / 3600.0:.1f} h"


def _plan_lines(campaign: Campaign) -> Iterator[str]:
    yield (
        f"{campaign.name}: {campaign.flights} flights: settings {campaign.settings_count}, "
        f"seeds {len(campaign.seeds)}"
    )
    for factor in campaign.factors:
        if factor.values:
            yield f"{factor.name}: " + ", ".join(str(value) for value in factor.values)
        else:
            yield f"{factor.name}: {factor.low:g} to {factor.high:g}"
    for name, _ in campaign.cases:
        if name:
            yield f"case: {name}"


def _lines(dataset: Dataset, tally: Tally | None) -> Iterator[str]:
    total = dataset.campaign.flights
    if tally is None:
        yield f"all {total} flights are there already"
    else:
        told = tally.as_json()
        yield (
            f"{tally.flights} flights in {_time(tally.wall_s)}, {tally.failed} failed; "
            f"{told['flights_per_cpu_s'] or 0.0:.2f} flights a core and second, scheduling and "
            f"writing {told['overhead_percent'] or 0.0:.1f} %"
        )
        if tally.lost_workers:
            yield f"{counted(tally.lost_workers, 'worker')} lost; their flights were flown again"
        if tally.failed:
            yield "the failed ones have their reason in the column error; see `campaign show`"
    yield f"dataset: {dataset.folder}; see it with: vrspray campaign show {dataset.folder}"


@app.command(
    epilog="Example: vrspray campaign show lags --by case --by config.lag.up_s --out table.csv"
)
def show(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a campaign's dataset.")],
    figure: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="Figure to show; repeatable. Default: five."),
    ] = None,
    by: Annotated[
        list[str] | None,
        typer.Option(
            metavar="SETTING", help="This setting, or `case`; repeatable. Default: all varied."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write the tables: .csv, .tex or .parquet."),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing --out.")] = False,
    plots: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Draw the pictures into this folder.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Show figures by setting, what cases differ by, what matters.

    Intervals are over the seeds. Differences are from the first case, or from the first value of
    the first --by, each over pairs of one seed.

    Exit 0: shown; 2: the folder or an option is wrong.
    """
    from sitl.campaign.show import (
        SHOWN,
        differences_of,
        groups_of,
        lines_of,
        notes_of,
        read_rows,
        sensitivity_lines,
        sensitivity_of,
        write_tables,
    )
    from sitl.campaign.show import as_json as shown_json

    if out is not None:
        refuse_existing(out, force=force)
    rows = read_rows(folder, tuple(dict.fromkeys(figure or SHOWN)))
    groups, found = groups_of(rows, by or ()), sensitivity_of(rows)
    differences = differences_of(rows, by or ())
    notes = list(notes_of(rows, found))
    result = {**shown_json(rows, groups, differences, found), "notes": notes}
    lines = [*lines_of(rows, [*groups, *differences]), *sensitivity_lines(found), *notes]
    if out is not None:
        write_tables(out, [*groups, *differences])
        lines.append(f"written: {out}")
    if plots is not None:
        from sitl.campaign.pictures import draw_pictures

        result["plots"] = [str(path) for path in draw_pictures(rows, groups, found, plots)]
        lines += [f"picture: {path}" for path in result["plots"]]
    answer(result, lines, as_json=as_json)
