"""Every command, with its arguments and options, from what `--help` prints."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import typer

from companion.cli.app import app

INTRODUCTION = """# Commands

What `vrspray COMMAND --help` prints, in one place. Exit codes: 0 done, 1 a problem was found or
the work failed, 2 wrong usage, configuration or input, 130 interrupted. `--json` prints one JSON
object on standard output, also for an error.
"""
_COMMON = {"--help"}


def page() -> str:
    """Return the page: one heading a command, in the order of `vrspray --help`."""
    root = typer.main.get_command(app)
    return "\n".join([INTRODUCTION, *_sections(root, "vrspray", None)])


def _sections(command: Any, name: str, parent: Any) -> Iterator[str]:
    context = command.make_context(name.rsplit(" ", 1)[-1], [], parent, resilient_parsing=True)
    if parent is not None:
        yield from _section(command, name, context)
    if hasattr(command, "list_commands"):
        for child in command.list_commands(context):
            yield from _sections(command.get_command(context, child), f"{name} {child}", context)


def _section(command: Any, name: str, context: Any) -> Iterator[str]:
    is_group = hasattr(command, "list_commands")
    yield f"{'##' if name.count(' ') == 1 else '###'} {name}\n"
    yield text(command.help or "") + "\n"
    rows = list(_rows(command, context))
    if not is_group or rows:
        usage = " ".join(command.collect_usage_pieces(context))
        yield f"```text\n{name} {usage}\n```\n"
    if rows:
        yield "| Option or argument | What it does |\n|---|---|"
        yield from rows
        yield ""
    if command.epilog:
        yield _example(command.epilog)


def _rows(command: Any, context: Any) -> Iterator[str]:
    for one in command.get_params(context):
        record = one.get_help_record(context)
        if record is None or _COMMON & set(one.opts):
            continue
        head, meaning = record
        yield f"| `{head.strip()}` | {cell(meaning)} |".replace("`  ", "` ")


def _example(epilog: str) -> str:
    examples = re.split(r"Examples?:\s*", epilog.replace("\b", ""), maxsplit=1)
    lines = [" ".join(line.split()) for line in examples[-1].splitlines() if line.strip()]
    if len(examples) == 1 or not lines:
        return text(epilog) + "\n"
    return "Example:\n\n```\n" + "\n".join(lines) + "\n```\n"


def text(given: str) -> str:
    """Return a help text as Markdown: paragraphs kept, marks that Markdown would eat escaped.

    >>> text("Stop after this.  [0.0<=x<=100.0]"), text("How many.  [x>=1]")
    ('Stop after this.  [0 to 100]', 'How many.  [at least 1]')
    """
    given = given.replace("\b", "").strip()
    given = re.sub(r"(-?[\d.]+)<=x<=(-?[\d.]+)", _from_to, given)
    given = re.sub(r"x>=(-?[\d.]+)", r"at least \1", given)
    given = re.sub(r"[ \t]*\n[ \t]*", "\n", given)
    return re.sub(r"([*|])", r"\\\1", given.replace("<", "&lt;").replace(">", "&gt;"))


def _from_to(found: re.Match[str]) -> str:
    low, high = (float(word) for word in found.groups())
    return f"{low:.12g} to {high:.12g}"


def cell(given: str) -> str:
    """Return a text that fits a cell of a table."""
    return text(" ".join(given.split()))
