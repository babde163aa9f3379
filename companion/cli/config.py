"""`vrspray config`: is the configuration right, what is in force, what may stand in it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from companion.assembly import build_setup, deliverable
from companion.cli.answer import AsJson, Overrides, answer, problem_line, problem_object
from companion.config import Config, load
from companion.config.rules import mismatches, unbounded, without_effect
from companion.config.wording import show_value
from companion.flight_map import flight_map_of
from companion.problem import Problem

app = typer.Typer(
    add_completion=False,
    rich_markup_mode=None,
    help="Check or show a configuration, or print its schema.",
    epilog="Example: vrspray config check examples/anyang/config.toml",
)
File = Annotated[Path, typer.Argument(metavar="FILE", help="Configuration, a TOML file.")]


@app.command(epilog="Example: vrspray config check examples/anyang/config.toml")
def check(file: File, overrides: Overrides = None, as_json: AsJson = False) -> None:
    """Check a configuration and the files that it names.

    Exit 0: it can be used; 2: it cannot.
    """
    config = load(file, overrides=overrides or ())
    problems = [problem_object(problem) for problem in problems_of(config, overrides or ())]
    ok = not any(problem["severity"] == "error" for problem in problems)
    verdict = f"{file}: ok" if ok else f"{file}: refused"
    notes = [f"{found.key}: {found.text}" for found in unbounded(config)]
    answer(
        {"ok": ok, "path": str(file), "problems": problems, "notes": notes},
        [*map(problem_line, problems), *(f"note: {text}" for text in notes), verdict],
        as_json=as_json,
    )
    raise typer.Exit(0 if ok else 2)


def problems_of(config: Config, overrides: Sequence[str] = ()) -> list[Problem]:
    """Return what is wrong or remarkable beyond what a configuration is refused for."""
    problems = [
        Problem(severity="error", code="mismatch", text=found.text, where=found.key)
        for found in mismatches(config)
    ]
    problems += [
        Problem(severity="warning", code="no-effect", text=found.text, where=found.key)
        for found in without_effect(config)
    ]
    if config.prescription is not None:
        setup = build_setup(config, flight_map_of(config, overrides))
        if config.mission is not None:
            problems += deliverable(setup, config.mission.speed_m_s)
    return problems


@app.command(epilog="Example: vrspray config show field.toml --set lag.on_s=0.12")
def show(file: File, overrides: Overrides = None, as_json: AsJson = False) -> None:
    """Print every effective setting and where it comes from: file, override or default."""
    settings = load(file, overrides=overrides or ()).settings()
    answer(
        {
            "path": str(file),
            "settings": {
                key: {"value": value, "origin": origin} for key, (value, origin) in settings.items()
            },
        },
        (f"{key} = {_toml(value)}  # {origin}" for key, (value, origin) in settings.items()),
        as_json=as_json,
    )


def _toml(value: Any) -> str:
    return "(not set)" if value is None else show_value(value, length_max=1000)


@app.command(epilog="Example: vrspray config schema > vrspray.schema.json")
def schema(
    file: Annotated[
        Path | None,
        typer.Argument(metavar="FILE", help="Ignored: the schema is the same for all files."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Print the JSON Schema of the configuration, for editors."""
    del file
    document = Config.model_json_schema(by_alias=True)
    answer(document, [json.dumps(document, indent=2)], as_json=as_json)
