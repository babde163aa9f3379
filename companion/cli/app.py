"""The program's entry: which command is where, and how everything ends.

Exit codes: 0 done, 1 a problem was found or the work failed, 2 wrong usage, configuration or
input, 130 interrupted. An error is one line on stderr, and with `--json` one object on stdout; of
a map that is refused, with the list of problems that `map check` prints.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer
from typer.core import TyperGroup

from companion.cli.beside import give_way
from companion.cli.drawing_rules import ignore_the_folders_own
from companion.errors import ActuatorError, MapError, UnreadableError, VrsprayError

if TYPE_CHECKING:
    from typer._click.core import Command, Context
    from typer._click.formatting import HelpFormatter

FAILED, REFUSED, INTERRUPTED = 1, 2, 130


class Place(NamedTuple):
    """Where a command is, as `module:attribute`, and its line in the list of all commands."""

    target: str
    help: str


COMMANDS = {
    "demo": Place(
        "sitl.demo_cli:demo", "Fly the field of Wang et al. 2024 by all methods; compare them."
    ),
    "run": Place("companion.cli.run:run", "Spray: the companion beside the flight controller."),
    "ground": Place(
        "companion.cli.ground:app", "Prime, flush, rinse, catch, click: on the ground, key held."
    ),
    "doctor": Place("companion.cli.doctor:app", "Check all that must hold before a flight."),
    "service": Place("companion.cli.service:app", "Run as a service, with systemd's watchdog."),
    "config": Place("companion.cli.config:app", "Check or show a configuration; print its schema."),
    "map": Place("companion.cli.map:app", "Check, show, convert and make prescription maps."),
    "plan": Place("missions.cli:app", "Plan the passes over a field, sortie by sortie."),
    "upload": Place("missions.upload.cli:app", "Put a mission on the vehicle; read it back."),
    "sitl": Place("sitl.cli:app", "Simulated flight controller and sprayer."),
    "calibrate": Place(
        "analysis.calibrate_cli:app", "Measure lags and flow curves; plan the flight for it."
    ),
    "report": Place(
        "analysis.report.cli:report", "Evaluate a flight: page, figures, record of application."
    ),
    "flights": Place("companion.cli.flights:app", "List, show, pin, prune, recover journals."),
    "replay": Place("analysis.cli:replay", "Feed a journal to the core and compare decisions."),
    "export": Place(
        "analysis.exports.cli:export", "Write a flight as CSV, KML, shapefile, ISOXML and others."
    ),
    "wsp": Place("analysis.wsp.cli:wsp", "Coverage and drop sizes on water-sensitive paper."),
}


class CommandTable(TyperGroup):
    """Lists all commands without importing any, and imports the one that is asked for."""

    def list_commands(self, ctx: Context) -> list[str]:  # noqa: ARG002 - click's
        """Return the names of all commands in the order of the table."""
        return list(COMMANDS)

    def get_command(self, ctx: Context, cmd_name: str) -> Command | None:  # noqa: ARG002 - click's
        """Return one command, imported now."""
        place = COMMANDS.get(cmd_name)
        return None if place is None else load_command(cmd_name, place)

    def format_commands(self, ctx: Context, formatter: HelpFormatter) -> None:  # noqa: ARG002 - click's
        """Write the list of commands from the table alone."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, place.help) for name, place in COMMANDS.items()])


def load_command(name: str, place: Place) -> Command:
    """Return the command at `place`: one of Typer's, a Typer application, or a plain function."""
    module_name, _, attribute = place.target.partition(":")
    try:
        found = getattr(import_module(module_name), attribute)
    except ModuleNotFoundError as error:
        raise VrsprayError(
            f"vrspray {name}: the module {error.name} is not part of this installation; "
            "install all of vrspray (pip install vrspray[report,mcap,maps,mavsdk])"
        ) from error
    if (
        callable(found)
        and not isinstance(found, typer.Typer)
        and not hasattr(found, "make_context")
    ):
        function, found = found, typer.Typer(add_completion=False, rich_markup_mode=None)
        found.command()(function)
    return typer.main.get_command(found) if isinstance(found, typer.Typer) else found


app = typer.Typer(
    name="vrspray",
    cls=CommandTable,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    help="Variable-rate spraying companion: every change of rate falls on its boundary.",
    epilog="Example: vrspray config check examples/anyang/config.toml",
)


def _print_version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version

        typer.echo(f"vrspray {version('vrspray')}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version."
        ),
    ] = False,
) -> None:
    """Take the options that belong to no command."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and leave with its exit code.

    Without `arguments` the process is this command's own, and its priority may be lowered for good.
    """
    if arguments is None:
        arguments = sys.argv[1:]
        give_way(arguments)
        ignore_the_folders_own()
    sys.exit(execute(arguments))


def execute(arguments: Sequence[str]) -> int:
    """Run one command and return its exit code."""
    as_json = "--json" in arguments
    try:
        result = typer.main.get_command(app).main(
            list(arguments), prog_name="vrspray", standalone_mode=False
        )
    except typer.TyperException as error:
        return _fail(f"{error.format_message()} (see --help)", error.exit_code, as_json=as_json)
    except VrsprayError as error:
        code = FAILED if isinstance(error, ActuatorError | UnreadableError) else REFUSED
        more = {"ok": False, "problems": [refusal(error)]} if isinstance(error, MapError) else {}
        return _fail(str(error), code, as_json=as_json, more=more)
    except MemoryError:
        text = "there is not enough memory for this; use a smaller file, or another computer"
        return _fail(text, REFUSED, as_json=as_json)
    except (KeyboardInterrupt, typer.Abort):
        return _fail("interrupted", INTERRUPTED, as_json=as_json)
    if result == INTERRUPTED:  # Typer makes an exit of an interrupt
        return _fail("interrupted", INTERRUPTED, as_json=as_json)
    return result if isinstance(result, int) else 0


def refusal(error: MapError) -> dict[str, str]:
    """Return a map that cannot be used as the problem that it is, as `map check` lists them.

    A `MapError` says file: what is wrong; what to do.
    """
    line = " ".join(str(error).split()).removesuffix(f"; {error.fix}")
    where, colon, text = line.partition(": ")
    if not colon:
        where, text = "", line
    return {"severity": "error", "code": error.code, "text": text, "where": where, "fix": error.fix}


def _fail(text: str, code: int, *, as_json: bool, more: Mapping[str, object] | None = None) -> int:
    """Say why on stderr, in one line, and with `--json` on stdout too; return `code`."""
    line = " ".join(text.split())
    if as_json:
        typer.echo(json.dumps({"error": line, **(more or {})}))
    typer.echo(line if code == INTERRUPTED else f"error: {line}", err=True)
    return code
