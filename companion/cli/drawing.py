"""The side of a live display that draws: rich, in a process of its own, or in `vrspray top`'s."""

from __future__ import annotations

import json
import os
import select
import signal
import time
from collections.abc import Mapping
from dataclasses import fields
from typing import TYPE_CHECKING, Any

from companion.cli.live import Shown
from companion.cli.terminal import visible

if TYPE_CHECKING:
    from rich.console import RenderableType

# Nothing new for so long is no live state any more.
STALE_S = 2.0
_COLOURS = {
    "spraying": "bold white on dark_green",
    "armed": "bold white on blue",
    "ready": "bold white on blue",
    "fault": "bold white on red",
    "estop": "bold white on red",
}


def drawn(shown: Shown, *, silent_s: float = 0.0) -> RenderableType:
    """Return the block as rich draws it."""
    from rich.panel import Panel
    from rich.table import Table
    from rich.text import Text

    table = Table.grid(padding=(0, 2))
    table.add_column(style="dim", no_wrap=True)
    table.add_column(overflow="fold")
    for label, text in shown.rows():
        style = ""
        if label == "state":
            style = _COLOURS.get(shown.state, "bold yellow")
        elif label == "training" or (label == "faults" and shown.faults):
            style = "bold red"
        table.add_row(label, Text(visible(text), style=style))
    title = "vrspray"
    if silent_s > STALE_S:
        title = f"vrspray: NOTHING NEW FOR {silent_s:.0f} s"
    return Panel(table, title=title, title_align="left", border_style="dim")


def shown_of(content: Mapping[str, Any]) -> Shown:
    """Return what was handed over as JSON."""
    names = {each.name for each in fields(Shown)}
    return Shown(**{key: value for key, value in content.items() if key in names})


def main(source: int = 0) -> None:
    """Draw what comes in on a descriptor until it ends."""
    from rich.console import Console
    from rich.live import Live

    # Ctrl-C is for the run, which then ends the pipe.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(10)
    console = Console(stderr=True, highlight=False)
    shown, heard_s, left = Shown(), time.monotonic(), b""
    with Live(drawn(shown), console=console, auto_refresh=False) as live:
        while True:
            ready, _, _ = select.select([source], [], [], 1.0)
            if ready:
                got = os.read(source, 1 << 16)
                if not got:
                    return
                *lines, left = (left + got).split(b"\n")
                for content in map(json.loads, lines):
                    if "line" in content:
                        console.print(visible(content["line"]), markup=False)
                    elif content:
                        shown, heard_s = shown_of(content), time.monotonic()
            live.update(drawn(shown, silent_s=time.monotonic() - heard_s), refresh=True)


if __name__ == "__main__":
    main()
