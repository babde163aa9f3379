"""What the journal is told besides inputs and decisions: orders, the link, the self-test."""

from __future__ import annotations

from companion.cli.output_parts import parts_of
from companion.link.vehicle_link import VehicleLink
from companion.output.gpio import GpioExecutor
from companion.output.none import DryRunExecutor
from companion.output.timed import TimedExecutor
from companion.ports import PlanExecutor
from companion.record.journal import Journal


def follow(journal: Journal, link: VehicleLink, executor: PlanExecutor) -> None:
    """Have the link and the outputs tell the journal what they do, from now on."""
    link.on_event(journal.record_event)
    link.on_statistics(journal.record_link)
    for part in parts_of(executor):
        if isinstance(part, GpioExecutor):
            part.on_event = journal.record_event
        # A dry run orders nothing: there the plans say what would have been.
        if isinstance(part, GpioExecutor) or (
            isinstance(part, TimedExecutor)
            and part.valve_count
            and not isinstance(part, DryRunExecutor)
        ):
            part.on_order = journal.record_order
            journal.expect_orders()
