"""`vrspray config`: is the configuration right, what is in force, what may stand in it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import typer

from companion.assembly import build_setup, deliverable, flight_map_of
from companion.cli.answer import (
    AsJson,
    Overrides,
    answer,
    new_app,
    note,
    problem_line,
    problem_object,
)
from companion.cli.app import refusal
from companion.config import Config, load
from companion.config.rules import mismatches, remarks, without_effect
from companion.errors import ConfigError, MapError, Problem
from companion.wording import refuse_existing, show_value

if TYPE_CHECKING:
    from companion.cli.new_config import Answers

app = new_app(
    help="Check or show a configuration, or print its schema.",
    epilog="Example: vrspray config check examples/anyang/config.toml",
)
File = Annotated[Path | None, typer.Argument(metavar="FILE", help="Configuration, a TOML file.")]
SameFile = Annotated[
    Path | None, typer.Option("--config", metavar="FILE", help="The same, as others take it.")
]


@app.command(epilog="Example: vrspray config check examples/anyang/config.toml")
def check(
    file: File = None,
    config_file: SameFile = None,
    overrides: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Check a configuration and the files that it names.

    Exit 0: it can be used; 2: it cannot.
    """
    file = _named(file, config_file)
    notes: list[str] = []
    try:
        config = load(file, overrides=overrides or ())
    except ConfigError as error:
        if not error.problems:
            raise  # no configuration at all
        problems = list(error.problems)
    else:
        problems = problems_of(config, overrides or ())
        notes = [f"{found.key}: {found.text}" for found in remarks(config)]
    first = next((problem for problem in problems if problem.severity == "error"), None)
    ok = first is None
    objects = [problem_object(problem) for problem in problems]
    found: dict[str, Any] = {"ok": ok, "path": str(file), "problems": objects, "notes": notes}
    if first is not None:
        found["error"] = f"{file}: {problem_line(problem_object(first)).removeprefix('error: ')}"
    verdict = f"{file}: ok" if ok else f"{file}: refused"
    answer(
        found,
        [*map(problem_line, objects), *(f"note: {text}" for text in notes), verdict],
        as_json=as_json,
    )
    raise typer.Exit(0 if ok else 2)


def _named(file: Path | None, config_file: Path | None) -> Path:
    if (named := file or config_file) is None:
        raise ConfigError("name the configuration: vrspray config check FILE")
    return named


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
        problems += _map_problems(config, overrides)
    return problems


def _map_problems(config: Config, overrides: Sequence[str]) -> list[Problem]:
    """Return what keeps the map from being flown, and what the sprayer cannot deliver on it."""
    try:
        setup = build_setup(config, flight_map_of(config, overrides, keep=False))
    except MapError as error:
        return [Problem(**refusal(error))]  # type: ignore[arg-type] # the severity is "error"
    except ConfigError as error:
        text, _, fix = str(error).removeprefix(f"{config.path}: ").partition("; ")
        return [Problem(severity="error", code="map", text=text, fix=fix)]
    return [] if config.mission is None else deliverable(setup, config.mission.speed_m_s)


@app.command(epilog="Example: vrspray config new --out field.toml")
def new(
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="Configuration to write.")],
    yes: Annotated[
        bool, typer.Option("--yes", help="Ask nothing; what is not given has its default.")
    ] = False,
    profile: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Begin with a sprayer of the examples; or a .toml file."),
    ] = None,
    autopilot: Annotated[str, typer.Option(metavar="NAME", help="ardupilot or px4.")] = "ardupilot",
    link: Annotated[
        str, typer.Option(metavar="URL", help="Link to the flight controller.")
    ] = "serial:/dev/serial0:921600",
    output: Annotated[
        str, typer.Option(metavar="KIND", help="servo or gpio; see question 2.")
    ] = "servo",
    valves: Annotated[int, typer.Option(metavar="N", help="Number of valves.")] = 6,
    spacing_m: Annotated[float, typer.Option(metavar="M", help="Between valves.")] = 1.0,
    nozzle: Annotated[
        str,
        typer.Option(
            metavar="FLOW",
            help="Flow of one valve: L/min, '03 at 3 bar' (ISO size), or a bucket test's CSV file.",
        ),
    ] = "0.8",
    map_file: Annotated[
        str, typer.Option("--map", metavar="FILE", help="Prescription map; default: none.")
    ] = "",
    unit: Annotated[
        str, typer.Option(metavar="UNIT", help="Unit of the map, where it does not say: L/ha, ...")
    ] = "",
    swath_m: Annotated[
        float | None, typer.Option(metavar="M", help="Swath; default: valves times spacing.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
    as_json: AsJson = False,
) -> None:
    """Write a first configuration: six questions, or --yes.

    What it cannot know is marked MEASURE in the file. Exit 0: `config check` accepts it; 2: it
    would not, and nothing is written.
    """
    from companion.cli import new_config

    refuse_existing(out, force=force)
    if profile is not None:
        text = new_config.profile_text(
            new_config.read_profile(profile),
            map_name=new_config.map_seen_from(out, map_file),
            unit=new_config.known_unit(unit),
        )
    else:
        given = new_config.answers_of(
            autopilot=f"{autopilot} {link}",
            output=output,
            valves=f"{valves} {spacing_m}",
            nozzle=nozzle,
            map_file=map_file,
            unit=unit,
            swath_m=swath_m,
        )
        answers = given if yes else new_config.ask_all(given, _ask, note, _tried)
        text = new_config.text_of(answers, map_name=new_config.map_seen_from(out, answers.map_file))
    config, found = new_config.write_checked(out, text, problems_of)
    problems = [problem_object(problem) for problem in found]
    notes = [f"{each.key}: {each.text}" for each in remarks(config)]
    measure = [line[2:] for line in text.splitlines() if line.startswith("# MEASURE")]
    answer(
        {"ok": True, "path": str(out), "problems": problems, "notes": notes, "measure": measure},
        [
            f"written: {out}",
            *map(problem_line, problems),
            *(f"note: {each}" for each in notes),
            f"next: vrspray doctor --config {out}",
        ],
        as_json=as_json,
    )


def _tried(answers: Answers) -> None:
    """Refuse answers that make no configuration, while they can still be asked again."""
    from companion.cli import new_config

    with TemporaryDirectory() as folder:
        out = Path(folder, "new.toml")
        try:
            new_config.write_checked(out, new_config.text_of(answers), problems_of)
        except ConfigError as error:
            text = str(error).removeprefix(f"{out}: ").removesuffix(f"; {out} is not written")
            raise ConfigError(text) from error


def _ask(question: str, default: str) -> str:
    """Return what the operator types; nothing typed is the default."""
    said = typer.prompt(question, default=default, show_default=bool(default), err=True)
    return str(said).strip()


@app.command(epilog="Example: vrspray config show field.toml --set lag.on_s=0.12")
def show(
    file: File = None,
    config_file: SameFile = None,
    overrides: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Print every effective setting and where it comes from.

    That is the file, an override or the default.
    """
    file = _named(file, config_file)
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
    answer(document, json.dumps(document, indent=2).splitlines(), as_json=as_json)
