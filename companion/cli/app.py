"""The program's entry: which command is where, and how everything ends.

Exit codes: 0 done, 1 a problem was found or the work failed, 2 wrong usage, configuration or
input, 130 interrupted. An error is one line on stderr, and with `--json` one object on stdout; of
a map that is refused, with the list of problems that `map check` prints.
"""

from __future__ import annotations

import _thread
import errno
import json
import os
import signal
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated

import typer
from typer._click.exceptions import NoArgsIsHelpError
from typer.core import TyperArgument, TyperCommand, TyperGroup, TyperOption

from companion.cli.answer import new_app
from companion.cli.beside import give_way
from companion.cli.terminal import shown_as_text
from companion.commands import Command, Haste, all_registered, command_named, load, registered
from companion.errors import (
    NOT_ENOUGH_MEMORY,
    ActuatorError,
    MapError,
    StoppedError,
    UnreadableError,
    VrsprayError,
)
from companion.wording import missing

if TYPE_CHECKING:
    from typer._click.core import Command as ClickCommand
    from typer._click.core import Context
    from typer._click.formatting import HelpFormatter
    from typer._click.shell_completion import CompletionItem


FAILED, REFUSED, INTERRUPTED = 1, 2, 130
# What the place that is written to may lack.
NO_ROOM = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
_ROOM_FIX = "no space left; free some, or write elsewhere"


# The companion's own. Those of others are found by their entry points, and cannot replace these.
COMMANDS = {
    "run": Command(
        target="companion.cli.run:run",
        help="Run the companion: follow the vehicle and control the valves.",
    ),
    "top": Command(
        target="companion.cli.top:app",
        help="Show the live state of a running companion, from its MAVLink.",
    ),
    "ground": Command(
        target="companion.cli.ground:app",
        help="Prime, flush, rinse, catch test, click valves, on the ground.",
    ),
    "doctor": Command(
        target="companion.cli.doctor:app", help="Check everything that must hold before a flight."
    ),
    "service": Command(
        target="companion.cli.service:app", help="Install the companion as a systemd service."
    ),
    "flights": Command(
        target="companion.cli.flights:app",
        help="List, show, pin, prune or recover journals.",
        haste="patient",
        hastes=dict.fromkeys(("list", "show", "pin", "unpin", "prune"), "quick"),
    ),
    "token": Command(
        target="companion.cli.web_parts:app",
        help="Show the operator's page's links, or make new ones.",
        haste="quick",
    ),
    "config": Command(
        target="companion.cli.config:app",
        help="Check or show a configuration, or print its schema.",
        haste="patient",
        hastes={"check": "quick", "show": "quick", "schema": "quick", "new": "quick"},
    ),
}


def find_command(name: str) -> Command | None:
    """Return a command by its name: one of ours, or one that a distribution registers."""
    return COMMANDS.get(name) or command_named(name)


class CommandTable(TyperGroup):
    """Lists all commands without importing any, and imports the one that is asked for."""

    def list_commands(self, ctx: Context) -> list[str]:  # noqa: ARG002 - click's
        """Return the names of all commands in the order of the table."""
        return [*COMMANDS, *(name for name in registered() if name not in COMMANDS)]

    def get_command(self, ctx: Context, cmd_name: str) -> ClickCommand | None:  # noqa: ARG002
        """Return one command, imported now."""
        found = find_command(cmd_name)
        return None if found is None else load_command(cmd_name, found)

    def resolve_command(
        self, ctx: Context, args: list[str]
    ) -> tuple[str | None, ClickCommand | None, list[str]]:
        """Return the command that is asked for; of a mistyped one the nearest is named."""
        if args and not args[0].startswith("-") and find_command(args[0]) is None:
            near = get_close_matches(args[0], self.list_commands(ctx), n=1)
            ctx.fail(f"no command {args[0]!r}" + (f"; did you mean {near[0]}?" if near else ""))
        return super().resolve_command(ctx, args)

    def shell_complete(self, ctx: Context, incomplete: str) -> list[CompletionItem]:
        """Return what a word of the shell may become; no command is imported for that."""
        from typer._click.shell_completion import CompletionItem

        names = [name for name in self.list_commands(ctx) if name.startswith(incomplete)]
        # The options of the program itself are completed by what every command does.
        options = TyperCommand.shell_complete(self, ctx, incomplete)
        return [*(CompletionItem(name, help=self._help_of(name)) for name in names), *options]

    def _help_of(self, name: str) -> str:
        found = find_command(name)
        return "" if found is None else found.help

    def format_commands(self, ctx: Context, formatter: HelpFormatter) -> None:  # noqa: ARG002 - click's
        """Write the list of commands from what they announce."""
        with formatter.section("Commands"):
            listed = {**all_registered(), **COMMANDS}
            names = [*COMMANDS, *(name for name in listed if name not in COMMANDS)]
            formatter.write_dl([(name, listed[name].help) for name in names])


def load_command(name: str, command: Command) -> ClickCommand:
    """Return a command that is ready to run: Typer's own, or made of an application or function."""
    found = load(name, command.target)
    if (
        callable(found)
        and not isinstance(found, typer.Typer)
        and not hasattr(found, "make_context")
    ):
        function, found = found, new_app()
        found.command()(function)
    command_itself = typer.main.get_command(found) if isinstance(found, typer.Typer) else found
    return _in_our_style(command_itself)


def _in_our_style(command: ClickCommand) -> ClickCommand:
    """Return a command whose help looks as that of all others, and that shows it when alone."""
    for parameter in command.params:
        if isinstance(parameter, TyperArgument | TyperOption):
            parameter.metavar = parameter.metavar and parameter.metavar.removesuffix(
                "..."
            )  # Typer adds them
            setattr(parameter, "display_type", partial(_in_plain_words, parameter.display_type))  # noqa: B010
    if isinstance(command, TyperCommand | TyperGroup):
        command.rich_markup_mode = None
    if isinstance(command, TyperGroup):
        command.no_args_is_help = not command.invoke_without_command
        for each in command.commands.values():
            _in_our_style(each)
    return command


# What Python calls them is no help.
_TYPES = {"float": "number", "int": "whole number", "str": "text", "Path": "path"}


def _in_plain_words(told: Callable[[Context], str], ctx: Context) -> str:
    label = told(ctx).strip("<>").removeprefix("list[").removesuffix("]").removesuffix(" range")
    return f"<{','.join(_TYPES.get(each, each) for each in label.split(','))}>"


app = typer.Typer(
    name="vrspray",
    cls=CommandTable,
    # Commands take the names of the help option from here.
    context_settings={"help_option_names": ["-h", "--help"]},
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    help="Variable-rate spraying: change the rate exactly on the zone boundary.",
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
        haste = _haste(arguments)
        give_way(arguments, haste)
        # The companion's own commands draw nothing.
        if not arguments or arguments[0] not in COMMANDS:
            from companion.cli.folders_own import ignore_the_folders_own

            ignore_the_folders_own()
        if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
            # asyncio has its own way with Python's handler, and with no other.
            is_quick = haste == "at-once"
            signal.signal(signal.SIGINT, signal.default_int_handler if is_quick else _interrupt)
    sys.exit(execute(arguments))


_IMPORT = "<frozen importlib._bootstrap>"
_IMPORTED_S = 0.05
_again: list[threading.Timer] = []


def _interrupt(_number: int, frame: FrameType | None) -> None:
    """Interrupt as Python does, but wait for the end of an import.

    In the middle of one, a library makes another error of an interrupt (numpy an ImportError,
    pydantic a SchemaError), or prints it.
    """
    while frame is not None:
        if frame.f_code.co_filename == _IMPORT:
            if not any(each.is_alive() for each in _again):
                _again[:] = [threading.Timer(_IMPORTED_S, _thread.interrupt_main)]
                _again[0].daemon = True
                _again[0].start()
            return
        frame = frame.f_back
    raise KeyboardInterrupt


def _haste(arguments: Sequence[str]) -> Haste:
    try:
        found = find_command(arguments[0]) if arguments else None
    except VrsprayError:  # told where it is run
        return "at-once"
    return "at-once" if found is None else found.haste_of(arguments[1] if arguments[1:] else "")


def execute(arguments: Sequence[str]) -> int:
    """Run one command and return its exit code; what it says can do nothing to the terminal."""
    with shown_as_text():
        return _executed(arguments)


def _executed(arguments: Sequence[str]) -> int:
    as_json = "--json" in arguments
    try:
        result = typer.main.get_command(app).main(
            list(arguments), prog_name="vrspray", standalone_mode=False
        )
    except NoArgsIsHelpError as error:
        typer.echo(error.format_message())
        return REFUSED
    except OSError as error:
        if error.errno not in NO_ROOM:
            raise
        _close_stdout()
        return _fail(f"{_place_of(error)}: {_ROOM_FIX}", FAILED, as_json=False)
    except ModuleNotFoundError as error:
        return _fail(missing(str(error.name).partition(".")[0]), REFUSED, as_json=as_json)
    except (typer.TyperException, VrsprayError, MemoryError, KeyboardInterrupt, typer.Abort) as end:
        return _ended(end, as_json=as_json)
    if result == INTERRUPTED:  # Typer makes an exit of an interrupt
        return _fail("interrupted", INTERRUPTED, as_json=as_json)
    return result if isinstance(result, int) else 0


# What the library says of a wrong option, and how it is put here.
_PLAINLY = {
    "Input should be a valid number, unable to parse string as a number": (
        "write a number, with a point for decimals: 20.5"
    ),
    "Input should be a valid integer, unable to parse string as an integer": (
        "write a whole number, such as 2"
    ),
    "Value error, ": "",
}


def _ended(error: BaseException, *, as_json: bool) -> int:
    """Say what ended a command, in one line, and return the exit code."""
    if isinstance(error, typer.TyperException):
        said = error.format_message().rstrip(".")
        for foreign, ours in _PLAINLY.items():
            said = said.replace(foreign, ours)
        return _fail(f"{said} (see --help)", error.exit_code, as_json=as_json)
    if isinstance(error, VrsprayError):
        code = FAILED if isinstance(error, ActuatorError | UnreadableError) else REFUSED
        code = INTERRUPTED if isinstance(error, StoppedError) else code
        more = {"ok": False, "problems": [refusal(error)]} if isinstance(error, MapError) else {}
        return _fail(str(error), code, as_json=as_json, more=more)
    if isinstance(error, MemoryError):
        return _fail(NOT_ENOUGH_MEMORY, REFUSED, as_json=as_json)
    return _fail("interrupted", INTERRUPTED, as_json=as_json)


def _place_of(error: OSError) -> str:
    return "output" if error.filename is None else str(error.filename)


def _close_stdout() -> None:
    """Send what is left for stdout nowhere: at its exit Python would try, and fail, once more."""
    with suppress(OSError, ValueError), Path(os.devnull).open("w") as nowhere:
        os.dup2(nowhere.fileno(), sys.stdout.fileno())


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
