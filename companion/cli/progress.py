"""A bar on stderr that says how far a command is: on a terminal only, and only where it lasts."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.progress import Progress

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
                bars[0].add_task(what)
            task = bars[0].task_ids[0]
            bars[0].update(task, description=what, completed=done, total=total)

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
    )

    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        console=Console(stderr=True),
        transient=True,
        refresh_per_second=REFRESHED_HZ,
    )
