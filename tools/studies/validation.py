"""The twin against what Wang et al. 2024 (P1) measured with a real sprayer, as a command.

    vrspray campaign examples/campaigns/validation.toml --out flown
    python -m tools.studies.validation flown --out docs/measurements

`validation_flights` reads the flights, `validation_pictures` shows them.
"""

from __future__ import annotations

import importlib.util
import shlex
import sys
from pathlib import Path
from typing import Annotated

import typer

from companion.cli.answer import AsJson, answer
from companion.errors import ConfigError, VrsprayError
from companion.wording import install_command
from tools.studies import run_study
from tools.studies.validation_flights import (
    COMMAND,
    Validation,
    summary_lines,
    validate,
    write_page,
)

IMAGES = "images"

app = typer.Typer(add_completion=False, rich_markup_mode=None)


@app.command(epilog="Example: python -m tools.studies.validation flown --out docs/measurements")
def validation(
    flown: Annotated[Path, typer.Argument(metavar="DIR", help="Dataset of the campaign.")],
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Write validation.md and images/validation*.png there."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Show P1's controller and ours over P1's field, beside what P1 measured."""
    if out is not None:
        check_folder(out)
    result = validate(flown)
    if out is not None:
        command = f"{COMMAND} {shlex.join(sys.argv[1:])}".strip()
        write_all(result, out, command=command)
    answer(result.as_json(), summary_lines(result), as_json=as_json)
    if not all(result.bounds().values()):
        raise VrsprayError("the twin is not within its bounds of what P1 measured")


def main() -> int:
    """Run it; what a user did wrong is one line."""
    return run_study(app)


def check_folder(folder: Path) -> None:
    """Refuse at once what could not be written after minutes of flying.

    Raises:
        ConfigError: without matplotlib, or where the folder cannot be made.
    """
    if importlib.util.find_spec("matplotlib") is None:
        raise ConfigError(f"no pictures without matplotlib; {install_command('office')}")
    try:
        (folder / IMAGES).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be made ({error.strerror or error})") from None


def write_all(result: Validation, folder: Path, *, command: str) -> None:
    """Write the page and its pictures."""
    from tools.studies.validation_pictures import draw_pictures

    names = draw_pictures(result, folder / IMAGES)
    write_page(result, folder, pictures=[f"{IMAGES}/{name}" for name in names], command=command)


if __name__ == "__main__":
    sys.exit(main())
