"""What all commands have in common: the JSON option and how an answer is printed."""

from __future__ import annotations

import inspect
import json
import math
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from companion.cli.terminal import Styled, terminal, visible

if TYPE_CHECKING:
    from rich.progress import Progress

    from companion.errors import Problem


AsJson = Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")]
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Override a setting, such as lag.on_s=0.12."),
]


ConfigFile = Annotated[
    Path, typer.Option("--config", metavar="FILE", help="Configuration, a TOML file.")
]
JournalFile = Annotated[Path, typer.Argument(help="Journal of a flight, such as flight-0001.gpkg.")]
JournalFiles = Annotated[
    list[Path],
    typer.Argument(
        metavar="JOURNAL...", help="Journal of a flight; of a job, those of all its sorties."
    ),
]


def new_app(**more: Any) -> typer.Typer:
    """Return what takes commands that look and fail as all others do."""
    return typer.Typer(
        add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False, **more
    )


def answer(result: Mapping[str, Any], lines: Iterable[str], *, as_json: bool) -> None:
    """Print the result on stdout: one JSON object, or lines for a person."""
    if as_json:
        typer.echo(json.dumps(finite(result), allow_nan=False))
        return
    for line in lines:
        typer.echo(_one(line), file=terminal(sys.stdout) if isinstance(line, Styled) else None)


def note_problems(result: Mapping[str, Any]) -> None:
    """Print the problems of a result on stderr."""
    for problem in result["problems"]:
        note(problem_line(problem))


def note(line: str) -> None:
    """Print what is not the result, on stderr."""
    typer.echo(_one(line), err=True)


def _one(line: str) -> str:
    """Return a line as one: a name with an end of line in it begins no line of ours."""
    return line.replace("\n", "\\n")


def problem_line(problem: Mapping[str, Any]) -> str:
    """Return a problem as one line."""
    is_said = str(problem["text"]).endswith(f": {problem['where']}")
    where = f" ({problem['where']})" if problem["where"] and not is_said else ""
    fix = f"; {problem['fix']}" if problem["fix"] else ""
    return f"{problem['severity']}: {problem['text']}{where}{fix}"


def problem_object(problem: Problem) -> dict[str, str]:
    """Return a problem as it stands in JSON."""
    return {
        "severity": problem.severity,
        "code": problem.code,
        "text": problem.text,
        "where": problem.where,
        "fix": problem.fix,
    }


def finite(value: Any) -> Any:
    """Return a value as JSON has it: what is no finite number is missing.

    >>> finite({"a": [float("nan"), 1.0]})
    {'a': [None, 1.0]}
    """
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Mapping):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    return value


# Options that several commands have in common, as one parameter of each.

REQUIRED = inspect.Parameter.empty


class Option(NamedTuple):
    """One option as Typer takes it: its annotation, and its default."""

    kind: Any
    default: Any = None


def with_options(
    parameter: str, options: Mapping[str, Option], make: Callable[..., Any]
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return a decorator that gives a command `options` in the place of `parameter`.

    What `make` puts together of their values is what the command gets for it.
    """

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        signature = inspect.signature(command, eval_str=True)
        own = [item for item in signature.parameters.values() if item.name != parameter]
        added = [
            inspect.Parameter(
                name, inspect.Parameter.KEYWORD_ONLY, default=each.default, annotation=each.kind
            )
            for name, each in options.items()
        ]

        @wraps(command)
        def expanded(**given: Any) -> None:
            values = {name: given.pop(name) for name in options}
            command(**{parameter: make(**values)}, **given)

        # Typer reads it; the type of a function does not know it.
        expanded.__signature__ = signature.replace(  # type: ignore[attr-defined]
            parameters=[item.replace(kind=inspect.Parameter.KEYWORD_ONLY) for item in own] + added
        )
        expanded.__annotations__ = {item.name: item.annotation for item in [*own, *added]}
        return expanded

    return decorate


# A bar on stderr that says how far a command is: on a terminal only, and only where it lasts.

Tell = Callable[[str, int, int], None]
# Drawing takes processor time from the work.
REFRESHED_HZ = 5.0


@contextmanager
def progress(*, quiet: bool = False, after_s: float = 0.0) -> Iterator[Tell]:
    """Yield what is told of the work: what is done, how many steps of it, and of how many.

    Without a terminal there is no bar. Of work that is done before `after_s` none is seen.
    """
    if quiet or not sys.stderr.isatty():
        yield lambda _what, _done, _total: None
        return
    seen_s = time.monotonic() + after_s
    with ExitStack() as shown:
        bars: list[Progress] = []

        def tell(what: str, done: int, total: int) -> None:
            if not bars:
                if time.monotonic() < seen_s:
                    return
                bars.append(shown.enter_context(_bar()))
                bars[0].add_task(visible(what), total=total)
            bar = bars[0]
            (task,) = bar.tasks
            if task.total != total or done < task.completed:
                # A count that begins anew is another piece of work: so does its time.
                bar.reset(task.id, total=total)
            bar.update(task.id, description=visible(what), completed=done, total=total)

        yield tell


def _bar() -> Progress:
    # Imported only where there is a bar: it takes as long as a small plan.
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    return Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=Console(file=terminal(sys.stderr)),
        transient=True,
        refresh_per_second=REFRESHED_HZ,
    )
