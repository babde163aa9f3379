"""Studies that no command flies: the papers compared, sensitivity, limits, hard fields."""

from __future__ import annotations

import typer

from companion.cli.answer import note
from companion.errors import ConfigError, VrsprayError


def run_study(app: typer.Typer) -> int:
    """Run a study that is a command of its own; what a user did wrong is one line."""
    try:
        app()
    except VrsprayError as error:
        note(f"error: {error}")
        return 2 if isinstance(error, ConfigError) else 1
    return 0
