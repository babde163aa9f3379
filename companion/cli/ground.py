"""`vrspray ground`: prime, flush, rinse, catch, click; a held key, a disarmed vehicle."""

from __future__ import annotations

from typing import Annotated

import typer

from companion.cli.ground_doing import Asked, asked_options, do
from companion.cli.ground_tasks import Wish
from companion.ground.work import GroundKind

app = typer.Typer(
    add_completion=False,
    rich_markup_mode=None,
    help="Open valves on the ground, with the vehicle disarmed, while you hold a key.",
    epilog="Example: vrspray ground prime --config config.toml",
)
Valves = Annotated[
    list[str] | None,
    typer.Option("--valve", metavar="NAME", help="Only this valve; may be repeated."),
]
Seconds = Annotated[
    float | None, typer.Option(min=0.2, max=30.0, help="Total time; at most 30 s in one go.")
]
Together = Annotated[bool, typer.Option("--together", help="All valves at once, not in turn.")]
Water = Annotated[bool, typer.Option("--water", help="With water: marks the record.")]


@app.command(epilog="Example: vrspray ground prime --config config.toml")
@asked_options
def prime(
    asked: Asked,
    valves: Valves = None,
    seconds: Seconds = None,
    is_water: Water = False,
) -> None:
    """Fill the lines: open the valves fully until liquid arrives."""
    wish = Wish(kind=GroundKind.PRIME, valves=tuple(valves or ()), seconds=seconds)
    do(asked, wish, is_water=is_water)


@app.command(epilog="Example: vrspray ground flush --config config.toml --valve 3")
@asked_options
def flush(
    asked: Asked,
    valves: Valves = None,
    seconds: Seconds = None,
    is_together: Together = False,
    is_water: Water = False,
) -> None:
    """Flush the lines, valve by valve or all together."""
    wish = Wish(
        kind=GroundKind.FLUSH,
        valves=tuple(valves or ()),
        seconds=seconds,
        is_together=is_together,
    )
    do(asked, wish, is_water=is_water)


@app.command(epilog="Example: vrspray ground rinse --config config.toml --litres 2 --together")
@asked_options
def rinse(
    asked: Asked,
    litres: Annotated[
        float | None, typer.Option(min=0.01, max=1000.0, help="Volume of clean water.")
    ] = None,
    valves: Valves = None,
    seconds: Seconds = None,
    is_together: Together = False,
    is_water: Water = True,
) -> None:
    """Rinse with a volume of clean water, valve by valve or all together."""
    wish = Wish(
        kind=GroundKind.RINSE,
        valves=tuple(valves or ()),
        seconds=seconds,
        litres=litres,
        is_together=is_together,
    )
    do(asked, wish, is_water=is_water)


@app.command(epilog="Example: vrspray ground catch --config config.toml --duty 0.5 --water")
@asked_options
def catch(
    asked: Asked,
    duty: Annotated[float | None, typer.Option(help="Duty cycle of the valves, 0 to 1.")] = None,
    valves: Valves = None,
    seconds: Seconds = None,
    is_water: Water = False,
) -> None:
    """Catch test: open valves for an exact time.

    All at one duty; the volume to be expected is printed.
    """
    wish = Wish(kind=GroundKind.CATCH, valves=tuple(valves or ()), duty=duty, seconds=seconds)
    do(asked, wish, is_water=is_water)


@app.command(epilog="Example: vrspray ground click --config config.toml")
@asked_options
def click(
    asked: Asked,
    valves: Valves = None,
) -> None:
    """Click each valve in turn, dry, to find swapped or dead valves."""
    wish = Wish(kind=GroundKind.CLICK, valves=tuple(valves or ()))
    do(asked, wish)
