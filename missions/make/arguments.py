"""The arguments that the commands of `vrspray make` have in common."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

# A zone or a plot is this much longer than a change takes: for wind, and for the aircraft's speed.
MARGIN = 1.5

OutFile = Annotated[
    Path, typer.Option("--out", metavar="FILE", help="The map; its suffix says the format.")
]
ConfigFile = Annotated[
    Path, typer.Option("--config", metavar="FILE", help="Configuration of the flight.")
]
Boundary = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Field outline; default: prescription.boundary."),
]
NoSpray = Annotated[
    list[Path] | None, typer.Option(metavar="FILE", help="Ground not to spray; repeatable.")
]
CourseDeg = Annotated[
    float | None,
    typer.Option(metavar="DEG", help="Course of the passes; default: as vrspray plan."),
]
Margin = Annotated[
    float,
    typer.Option(metavar="X", help="Times the length that a change takes.", min=1.0, max=20.0),
]
Picture = Annotated[
    Path | None, typer.Option("--png", metavar="FILE", help="Picture: .png, .svg or .pdf.")
]
FormatName = Annotated[
    str | None, typer.Option("--format", metavar="F", help="Where the suffix can hold several.")
]
