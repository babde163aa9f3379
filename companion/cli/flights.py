"""`vrspray flights`: the journals of a folder, and which are kept.

What looks into a journal (show, remaining, recover) is the office's and registers itself here.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from companion.cli.answer import AsJson, answer, new_app, note
from companion.cli.app import load_command
from companion.cli.record_parts import rules_of
from companion.commands import all_registered, command_named, registered
from companion.config.model import load
from companion.errors import ConfigError
from companion.journal.folder import Flight, Rules, journals, look_at, prune, set_pinned, space_of
from companion.journal.geopackage import time_text

if TYPE_CHECKING:
    from typer._click.core import Command as ClickCommand
    from typer._click.core import Context
    from typer._click.formatting import HelpFormatter


class FlightsTable(TyperGroup):
    """The commands of this file, and those that the office registers; these are not imported."""

    def list_commands(self, ctx: Context) -> list[str]:
        """Return the names of all of them."""
        return [*super().list_commands(ctx), *registered(_UNDER)]

    def get_command(self, ctx: Context, cmd_name: str) -> ClickCommand | None:
        """Return one command, imported now."""
        own = super().get_command(ctx, cmd_name)
        found = command_named(cmd_name, _UNDER) if own is None else None
        return own if found is None else load_command(f"{_UNDER} {cmd_name}", found)

    def format_commands(self, ctx: Context, formatter: HelpFormatter) -> None:
        """Write the list of commands, of the office's what they announce."""
        with formatter.section("Commands"):
            own = {name: super(FlightsTable, self).get_command(ctx, name) for name in self.commands}
            rows = [(name, one.get_short_help_str(limit=100)) for name, one in own.items() if one]
            rows += [(name, one.help) for name, one in all_registered(_UNDER).items()]
            formatter.write_dl(rows)


app = new_app(
    cls=FlightsTable,
    help="Journals of flights: list, show, job, remaining, pin, unpin, prune, recover.",
    epilog="Example: vrspray flights list --folder flights",
)
FAILED = 1
_UNDER = "flights"
_SLOW_S = 1.0
Folder = Annotated[
    Path | None,
    typer.Option("--folder", metavar="DIR", help="Folder of the journals; default: flights."),
]
ConfigFile = Annotated[
    Path | None, typer.Option("--config", metavar="FILE", help="Take the folder from here.")
]
Files = Annotated[list[Path], typer.Argument(metavar="FILE...", help="Journals, .gpkg files.")]


@app.command("list", epilog="Example: vrspray flights list --config config.toml")
def list_flights(
    place: Annotated[
        Path | None, typer.Argument(metavar="[DIR]", help="The same as --folder.")
    ] = None,
    folder: Folder = None,
    config_file: ConfigFile = None,
    as_json: AsJson = False,
) -> None:
    """List flights: file, start, duration, state, litres, size."""
    where, _ = place_of(folder or place, config_file)
    flights = []
    told_s = time.monotonic()
    paths = journals(where)
    for number, path in enumerate(paths, 1):
        flights.append(look_at(path))
        if time.monotonic() - told_s > _SLOW_S:
            told_s = time.monotonic()
            note(f"{number} of {len(paths)} journals read")
    space = space_of(where)
    result = {
        "folder": str(where),
        "flights": [as_object(flight) for flight in flights],
        "free_bytes": space.free_bytes,
        "free_percent": space.free_percent,
    }
    lines = [line_of(flight) for flight in flights] or [f"no flights in {where}"]
    answer(result, lines, as_json=as_json)


@app.command(epilog="Example: vrspray flights pin flights/flight-0001.gpkg")
def pin(paths: Files, as_json: AsJson = False) -> None:
    """Pin flights, so that they are never pruned."""
    _pin(paths, is_pinned=True, as_json=as_json)


@app.command(epilog="Example: vrspray flights unpin flights/flight-0001.gpkg")
def unpin(paths: Files, as_json: AsJson = False) -> None:
    """Unpin flights, so that they can be pruned again."""
    _pin(paths, is_pinned=False, as_json=as_json)


@app.command("prune", epilog="Example: vrspray flights prune --config config.toml --dry-run")
def prune_flights(
    folder: Folder = None,
    config_file: ConfigFile = None,
    is_dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Show what would be removed; remove nothing.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Remove old flights by the rules of [journal]; never open or pinned ones."""
    where, rules = place_of(folder, config_file)
    removals = prune(where, rules, now_utc_s=time.time(), is_dry_run=is_dry_run)
    verb = "would go" if is_dry_run else "removed"
    failed = [each for each in removals if each.problem is not None]
    result = {
        "folder": str(where),
        "is_dry_run": is_dry_run,
        "removed": [
            {"file": str(each.flight.path), "size_bytes": each.flight.size_bytes}
            | {"reason": each.reason}
            for each in removals
            if each.problem is None
        ],
        "failed": [{"file": str(each.flight.path), "problem": each.problem} for each in failed],
    }
    lines = [f"{each.flight.path.name}: {each.problem or verb}: {each.reason}" for each in removals]
    answer(result, lines or ["nothing to remove"], as_json=as_json)
    if failed:
        raise typer.Exit(FAILED)


def _pin(paths: list[Path], *, is_pinned: bool, as_json: bool) -> None:
    changed = [path for path in paths if set_pinned(path, is_pinned=is_pinned)]
    word = "pinned" if is_pinned else "not pinned"
    result = {"pinned": is_pinned, "files": [str(path) for path in paths], "changed": len(changed)}
    answer(result, [f"{path.name}: {word}" for path in paths], as_json=as_json)


def place_of(folder: Path | None, config_file: Path | None) -> tuple[Path, Rules]:
    """Return folder and rules of retention."""
    if folder is not None and config_file is not None:
        raise ConfigError("--folder and --config: give one of them; the configuration names one")
    if config_file is None:
        return folder or Path("flights"), Rules()
    config = load(config_file)
    return config.resolve(config.journal.folder), rules_of(config.journal)


def as_object(flight: Flight) -> dict[str, Any]:
    """Return a flight for `--json`."""
    started_s = flight.started_utc_s
    return {
        "file": str(flight.path),
        "started_utc": None if started_s is None else time_text(started_s),
        "utc_source": flight.utc_source,
        "duration_s": flight.duration_s,
        "state": flight.state,
        "applied_l": flight.applied_l,
        "size_bytes": flight.size_bytes,
        "pinned": flight.is_pinned,
        "training": flight.training,
        "simulated": None if flight.simulated is None else flight.simulated.word,
        "problem": flight.problem,
    }


def line_of(flight: Flight) -> str:
    """Return a flight in one line for a person."""
    shown = as_object(flight)
    started = shown["started_utc"]
    date = "date unknown" if started is None else f"{started[:19].replace('T', ' ')} UTC"
    if flight.utc_source != "autopilot":
        date += " (by this computer)" if flight.utc_source == "computer" else " (not verified)"
    parts = [flight.path.name, date]
    if flight.duration_s is not None:
        parts.append(f"{flight.duration_s / 60.0:.1f} min")
    if flight.applied_l is not None:
        parts.append(f"{flight.applied_l:.2f} L ordered")
    parts += [flight.state, f"{flight.size_bytes / 1e6:.1f} MB"]
    if flight.is_pinned:
        parts.append("pinned")
    is_simulated = flight.simulated is not None and flight.simulated.is_simulated
    if flight.training not in (None, "no", "simulated" if is_simulated else None):
        parts.append(f"training: {flight.training}")
    if flight.simulated is not None and flight.simulated.label and not flight.simulated.is_unmarked:
        parts.append(flight.simulated.label)
    if flight.problem is not None:
        parts.append(flight.problem)
    return ", ".join(parts)
