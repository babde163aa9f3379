"""The journal around a run: its folder before it, and what tells it what besides the decisions."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from companion.cli.output_parts import parts_of
from companion.config.tables import JournalTable
from companion.errors import JournalError
from companion.journal.journal import Journal
from companion.journal.read_only import DAMAGE, one_line
from companion.link.vehicle_link import VehicleLink
from companion.ports import PlanExecutor

if TYPE_CHECKING:
    from companion.journal.folder import Rules

# Three hours of a journal; with less a flight does not begin.
FREE_MIN_BYTES = 100_000_000
# No flight is removed but by its owner: the law may want it kept.
_ROOM = "copy flights away, then remove what may go (vrspray flights prune)"


def rules_of(journal: JournalTable) -> Rules:
    """Return the rules of retention as they are configured."""
    from companion.journal.folder import Rules

    return Rules(
        free_percent=journal.keep_free_percent or None,
        count=journal.keep_count,
        days=journal.keep_days,
    )


def made_ready(folder: Path) -> Iterator[str]:
    """Recover what a crash left; yield what was done, a line each.

    A JournalError where there is no room for a flight. What cannot be looked after is said and
    left: an old journal is no reason not to fly.
    """
    from companion.journal.folder import WARN_FREE_PERCENT, recover_folder, space_of

    try:
        for found in recover_folder(folder) if folder.is_dir() else ():
            yield f"journal: {found.path.name}: {found.outcome}: {found.text}"
    except (JournalError, *DAMAGE) as error:
        yield f"warning: journal: {one_line(error)}"
    space = space_of(next(each for each in (folder, *folder.absolute().parents) if each.is_dir()))
    if space.free_bytes < FREE_MIN_BYTES:
        raise JournalError(
            f"journal folder {folder}: only {space.free_bytes / 1e6:.0f} MB are free, a flight "
            f"needs {FREE_MIN_BYTES / 1e6:.0f}; {_ROOM}, or set journal.folder to another disk"
        )
    if space.free_percent < WARN_FREE_PERCENT:
        yield f"warning: journal: only {space.free_percent:.0f} % of the disk is free; {_ROOM}"


def follow(journal: Journal, link: VehicleLink, executor: PlanExecutor) -> None:
    """Have the link and the outputs tell the journal what they do, from now on."""
    from companion.output.timed import DryRunExecutor, TimedExecutor

    link.on_event(journal.record_event)
    link.on_statistics(journal.record_link)
    for part in parts_of(executor):
        if not isinstance(part, TimedExecutor):
            _follow_engine(journal, part)
        # A dry run orders nothing: there the plans say what would have been.
        elif part.valve_count and not isinstance(part, DryRunExecutor):
            part.on_order = journal.record_order
            journal.expect_orders()


def _follow_engine(journal: Journal, executor: PlanExecutor) -> None:
    from companion.output.gpio import GpioExecutor

    if isinstance(executor, GpioExecutor):
        executor.on_event = journal.record_event
        executor.on_order = journal.record_order
        journal.expect_orders()
