"""`vrspray run`: the companion, put together from its parts."""

from __future__ import annotations

import logging
import re
import sys
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

import typer

from companion import runtime
from companion.assembly import build_setup, deliverable
from companion.cli.answer import AsJson, Overrides, answer, note
from companion.cli.link_parts import build_link, load_with_kept
from companion.config import Config
from companion.config.rules import without_effect
from companion.errors import ConfigError, LinkError
from companion.link.component import ComponentOptions
from companion.link.vehicle_link import VehicleLink
from companion.output.none import DryRunExecutor
from companion.output.servo import ServoExecutor, ServoOptions
from companion.ports import PlanExecutor
from companion.record.journal import Journal
from companion.record.reader import read_journal

app = typer.Typer(add_completion=False, rich_markup_mode=None)


@app.command(epilog="Example: vrspray run --config examples/anyang/config.toml")
def run_companion(
    config_file: Annotated[
        Path, typer.Option("--config", metavar="FILE", help="Configuration, a TOML file.")
    ],
    duration_s: Annotated[
        float | None, typer.Option(min=0.0, max=1e7, help="Stop by itself after this time.")
    ] = None,
    overrides: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Spray: follow the vehicle, change the valves on the boundaries, until SIGINT or SIGTERM.

    Spraying is disabled until the operator enables it. All valves are closed at the end,
    whatever ends it.
    """
    logging.basicConfig(stream=sys.stderr, level=logging.INFO, format="%(levelname)s %(message)s")
    config, given = load_with_kept(config_file, overrides or ())
    setup = build_setup(config)
    link = build_link(config, given, component_options(config))
    executor = build_executor(config, link)
    for line in _warnings(config):
        note(line)
    if config.mission is not None:
        for problem in deliverable(setup, config.mission.speed_m_s):
            note(f"{problem.severity}: {problem.text}; {problem.fix}")
    folder = config.resolve(config.journal.folder)
    journal = Journal.create(folder, setup=setup, setup_text=_about(config, given))
    link.on_event(journal.record_event)
    try:
        with journal:
            runtime.execute(
                lambda: runtime.run(
                    setup, link=link, executor=executor, recorder=journal, duration_s=duration_s
                )
            )
    except LinkError:
        # A link that cannot be opened ends the run before its first step: no flight to keep.
        if not read_journal(journal.path).entries:
            journal.path.unlink()
        raise
    answer(
        {"journal": str(journal.path), "lost_rows": journal.lost},
        [f"journal: {journal.path}"],
        as_json=as_json,
    )


def component_options(config: Config) -> ComponentOptions:
    """Return who we are on the link."""
    major, minor, patch, *_ = (*map(int, re.findall(r"\d+", version("vrspray"))), 0, 0, 0)
    return ComponentOptions(
        system_id=config.link.system_id,
        component_id=config.link.component_id,
        position_rate_hz=config.link.position_rate_hz,
        version=(major, minor, patch),
    )


def build_executor(config: Config, link: VehicleLink) -> PlanExecutor:
    """Return what carries plans out: servo outputs of the autopilot, or nothing."""
    output = config.output
    if output.kind == "none":
        return DryRunExecutor(len(config.valve), has_return=output.return_channel is not None)
    if output.kind == "gpio":
        raise ConfigError(
            f'{config.path}: output.kind = "gpio": not part of this version; write "servo", or '
            '"none" for a dry run'
        )
    options = ServoOptions(
        channels=tuple(valve.channel or 0 for valve in config.valve),
        closed_us=output.closed_us,
        full_us=output.full_us,
        dither_us=output.dither_us,
        return_channel=output.return_channel,
    )
    executor = ServoExecutor(options, link.order)
    link.on_order_ack(executor.acknowledge)
    return executor


def _warnings(config: Config) -> list[str]:
    return [f"warning: {found.key}: {found.text}" for found in without_effect(config)]


def _about(config: Config, overrides: Sequence[str]) -> dict[str, str]:
    """Return what the journal keeps of the configuration besides the set-up itself."""
    return {
        "config_path": str(config.path),
        "config_toml": config.source_text,
        "config_overrides": "\n".join(overrides),
    }


run = typer.main.get_command(app)
