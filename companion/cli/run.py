"""`vrspray run`: the companion, put together from its parts."""

from __future__ import annotations

import json
import logging
import os
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from companion import runtime
from companion.assembly import build_setup, deliverable, flight_map_of, refuse_mismatch
from companion.cli.answer import AsJson, ConfigFile, Overrides, answer, new_app, note
from companion.cli.beside import shown
from companion.cli.live import Screen, Watcher
from companion.cli.output_parts import (
    build_link,
    build_outputs,
    line_warnings,
    load_with_kept,
    servo_options,
)
from companion.cli.record_parts import FREE_MIN_BYTES, follow, made_ready
from companion.config import Config
from companion.config.rules import unbounded, without_effect
from companion.core.setup import Setup
from companion.errors import ActuatorError, LinkError, SensorError
from companion.flight_map import FlightMap
from companion.journal.journal import Journal
from companion.link.component import ComponentOptions
from companion.link.vehicle_link import VehicleLink
from companion.ports import COMMIT_EVERY_S, PlanExecutor, Recorder, Sensor

if TYPE_CHECKING:
    from companion.cli.systemd import Notifier
    from companion.web import OperatorPage

# By these systemd, or a container, asks to be told of the steps.
_NOTIFY = frozenset({"NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID", "VRSPRAY_ALIVE_FILE"})

app = new_app()


@app.command(epilog="Example: vrspray run --config examples/anyang/config.toml")
def run_companion(
    config_file: ConfigFile,
    duration_s: Annotated[
        float | None, typer.Option(min=0.0, max=1e7, help="Stop after this time.")
    ] = None,
    is_water: Annotated[
        bool, typer.Option("--water", help="Training with water: marks every record.")
    ] = False,
    continue_from: Annotated[
        list[Path] | None,
        typer.Option(
            "--continue", metavar="JOURNAL", help="Resume: do not spray its treated ground again."
        ),
    ] = None,
    takes_unmarked: Annotated[
        bool,
        typer.Option(
            "--continue-unmarked",
            help="The journal of --continue does not record water or product: it was product.",
        ),
    ] = False,
    overrides: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Run the companion: follow the vehicle and switch the valves on zone boundaries.

    Runs until SIGINT or SIGTERM. Spraying is disabled until the operator enables it. All valves
    are closed at the end, whatever ends it.
    """
    screen = Screen()
    screen.take_log(logging.INFO)
    wanted = (*(overrides or ()), *(["journal.training=true"] if is_water else []))
    config, given = load_with_kept(config_file, wanted)
    training = training_mark(config)
    refuse_mismatch(config)
    link = build_link(config, given, component_options(config, training=training))
    executor = build_executor(config, link)

    def made() -> tuple[FlightMap, Setup]:
        flight_map = flight_map_of(config, given)
        setup = build_setup(config, flight_map)
        lines = _guard_lines(setup)
        if continue_from:
            from companion.journal.continuing import continued, simulated_lines

            setup = continued(
                setup,
                continue_from,
                training=training,
                takes_unmarked=takes_unmarked,
                by_default=config.coverage.switch_off_percent is None,
            )
            lines = [*_guard_lines(setup), *simulated_lines(continue_from)]
        for line in lines:
            note(line)
        return flight_map, setup

    async def flown() -> tuple[Journal, OperatorPage | None]:
        try:
            if servo_options(config) is None:
                flight_map, setup = made()
            else:
                from companion.cli.guarded_parts import meanwhile

                flight_map, setup = await meanwhile(made, link, executor)
            about = _about(config, given, flight_map)
            page = _page(config, given, setup, link, training=training)
            flight = _fly(config, setup, about, link, executor, page, screen, duration_s)
            return await flight, page
        finally:
            await executor.stop()
            await link.close()

    with shown(), screen:
        journal, page = runtime.execute(flown)
    kept, line = _kept(journal, link)
    answer(
        {"journal": kept, "lost_rows": journal.lost, "training": training},
        [line],
        as_json=as_json,
    )
    if page is not None and page.is_restarting:
        from companion.cli.field_choice import RESTART

        raise typer.Exit(RESTART)


async def _fly(
    config: Config,
    setup: Setup,
    about: Mapping[str, str],
    link: VehicleLink,
    executor: PlanExecutor,
    page: OperatorPage | None,
    screen: Screen,
    duration_s: float | None,
) -> Journal:
    """Run until the end of the flight, and return its journal."""
    training = training_mark(config)
    sensors = _sensors(config, link)
    _note_what_may_surprise(config, setup, training)
    commit_s = config.journal.commit_s or commit_every_s(
        setup, None if config.mission is None else config.mission.speed_m_s
    )
    journal = _new_journal(config, setup, about, training=training, commit_s=commit_s)
    follow(journal, link, executor)
    recorder = _recorder(page, journal, link)
    notifier = _notifier()
    screen.watcher = _watcher(
        config, setup, training, lambda: (executor.fault, link.fault, journal.fault)
    )
    runtime.settle()
    try:
        with journal, notifier or nullcontext():
            await runtime.run(
                setup,
                link=link,
                executor=executor,
                recorder=recorder,
                sensors=sensors if page is None else [*sensors, page],
                duration_s=duration_s,
                on_step=None if notifier is None else notifier.stepped,
                watch=screen.take,
                required=(
                    (journal, config.journal.close_after_s) if config.journal.required else None
                ),
                commit_every_s=commit_s,
            )
    except (ActuatorError, LinkError, SensorError):
        # Without outputs or sensors the run ends before its first step: no flight to keep.
        from companion.journal.reader import is_empty

        if is_empty(journal.path):
            journal.path.unlink()
        raise
    return journal


def _note_what_may_surprise(config: Config, setup: Setup, training: str) -> None:
    """Say what the settings come to in this flight, and what cannot be delivered as it stands."""
    for line in (*_warnings(config), *label_notes(config), *_application_notes(config, training)):
        note(line)
    if config.mission is not None:
        for problem in deliverable(setup, config.mission.speed_m_s):
            note(f"{problem.severity}: {problem.text}; {problem.fix}")


def _new_journal(
    config: Config, setup: Setup, about: Mapping[str, str], *, training: str, commit_s: float
) -> Journal:
    """Return the journal of this flight, in a folder that is in order and has room."""
    folder = config.resolve(config.journal.folder)
    for line in made_ready(folder):
        note(line)
    for line in _left_lines(config, folder, setup, training):
        note(line)
    return Journal.create(
        folder,
        setup=setup,
        setup_text=about,
        training=training,
        free_min_bytes=FREE_MIN_BYTES,
        commit_every_s=commit_s,
    )


def _watcher(
    config: Config, setup: Setup, training: str, faults: Callable[[], Sequence[str | None]]
) -> Watcher:
    """Return what makes of decisions what is shown."""
    return Watcher(
        width_m=config.boom_table.width_m,
        training=training,
        faults=faults,
        rates_at=setup.prescription.rates_at,
    )


def _kept(journal: Journal, link: VehicleLink) -> tuple[str | None, str]:
    """Return the journal, and what is said of it; without anybody heard it is removed."""
    path = journal.path
    if link.has_been_heard:
        lost = f", without {journal.lost} rows that could not be written" * bool(journal.lost)
        return str(path), f"journal: {path}{lost}"
    path.unlink(missing_ok=True)
    return None, "no journal is kept: nothing was heard on the link"


def _notifier() -> Notifier | None:
    """Return what tells systemd, or a container, of each step; None where neither asks."""
    if not _NOTIFY & os.environ.keys():
        return None
    from companion.cli.systemd import Notifier

    return Notifier.from_environment(os.environ, pid=os.getpid())


def _guard_lines(setup: Setup) -> list[str]:
    """Return from how much treated ground on valves close, and how much is treated already."""
    if setup.overlap is None:
        return []
    closes = f"a valve closes where {setup.overlap.switch_off_percent:g} % of its strip is treated"
    if setup.treated is None:
        return [f"note: {closes} (coverage.switch_off_percent)"]
    area_ha = setup.treated.area_m2 / 10_000.0
    return [f"resuming: {area_ha:.3f} ha are already treated; {closes}"]


def _left_lines(config: Config, folder: Path, setup: Setup, training: str) -> list[str]:
    """Return that an earlier flight left ground of this map, where nobody goes on from any."""
    if setup.treated is not None or not setup.records_coverage or not folder.is_dir():
        return []
    from companion.journal.continuing import unfinished

    left = unfinished(folder, setup, training=training)
    if left is None:
        return []
    return [
        f"note: {left.path.name}{left.mark} left {left.left_ha:.2f} ha of this map "
        f"({100.0 * left.left_share:.0f} %); to spray only what is left: "
        f"vrspray run --config {config.path} --continue {left.path}"
    ]


def training_mark(config: Config) -> str:
    """Return what of this run is no spraying of a product: `water`, `dry`, or `no`."""
    if config.output.kind == "none":
        return "dry"
    return "water" if config.journal.training else "no"


def component_options(
    config: Config, *, training: str = "no", watch_mission: bool = False
) -> ComponentOptions:
    """Return who we are on the link."""
    major, minor, patch, *_ = (*map(int, re.findall(r"\d+", version("vrspray"))), 0, 0, 0)
    has_lines = config.mission is not None and config.mission.lines is not None
    return ComponentOptions(
        system_id=config.link.system_id,
        component_id=config.link.component_id,
        position_rate_hz=config.link.position_rate_hz,
        version=(major, minor, patch),
        closed_us=config.output.closed_us,
        full_us=config.output.full_us,
        use_mission=config.prediction.use_mission or has_lines,
        need_mission=has_lines,
        use_switch=config.safety.rc_channel is not None,
        use_imu=config.prediction.use_imu,
        use_battery="autopilot" in (config.flow_meter.source, config.tank.source),
        watch_mission=watch_mission,
        may_enable="command" in config.safety.enable_by,
        page_may_enable=config.web.enabled and "web" in config.safety.enable_by,
        training="" if training == "no" else training,
        width_m=config.boom_table.width_m,
    )


def build_executor(config: Config, link: VehicleLink) -> PlanExecutor:
    """Return what carries plans out: servo outputs, lines of this computer, or nothing."""
    return build_outputs(config, link)


def _sensors(config: Config, link: VehicleLink) -> list[Sensor]:
    """Return the sensors that this computer reads; without any, nothing of theirs is loaded."""
    if not config.reads_sensors:
        return []
    from companion.cli.sensor_parts import build_sensors, follow_refills

    sensors = build_sensors(config)
    follow_refills(sensors, link)
    return sensors


def _page(
    config: Config, given: Sequence[str], setup: Setup, link: VehicleLink, *, training: str
) -> OperatorPage | None:
    """Return the operator's page; where it is not enabled, nothing of it is loaded."""
    if not config.web.enabled:
        return None
    from companion.cli.web_parts import build_page

    return build_page(config, given, setup, link, training=training)


def _recorder(page: OperatorPage | None, journal: Journal, link: VehicleLink) -> Recorder:
    """Return what the run is recorded by: the journal, with the page looking on."""
    if page is None:
        return journal
    from companion.cli.web_parts import watched

    return watched(page, journal, link)


def _warnings(config: Config) -> list[str]:
    found = [f"warning: {found.key}: {found.text}" for found in without_effect(config)]
    found += [f"note: {found.key}: {found.text}" for found in unbounded(config)]
    return found + line_warnings(config)


def _about(config: Config, overrides: Sequence[str], flight_map: FlightMap) -> dict[str, str]:
    """Return what the journal keeps of the configuration besides the set-up itself."""
    return {
        "config_path": str(config.path),
        "config_toml": config.source_text,
        "config_overrides": "\n".join(overrides),
        "application_json": json.dumps(config.told()),
        **({} if config.label is None else config.label.as_meta()),
        "flight_map_json": json.dumps(flight_map.as_object()),
    }


def label_notes(config: Config) -> list[str]:
    """Return which limits of label and permit were not declared, or not kept: nothing opens."""
    if config.label is None:
        return []
    found = []
    for each in config.label.declared(config.told()):
        if not each.is_kept:
            said = " is not declared" if each.value is None else f" = {each.value}"
            found.append(
                f"warning: {each.key}{said}, and {config.limits_table.file} allows {each.words}; "
                f"the valves stay closed; start with --set {each.key}=VALUE once it is within them"
            )
    return found


def _application_notes(config: Config, training: str) -> list[str]:
    """Return what the legal record of this flight will lack; a training has none."""
    profile = config.application.profile
    if profile is None or training != "no":
        return []
    from companion.config.legal_entries import missing

    absent = missing(profile, config.told())
    if not absent:
        return []
    return [
        f"note: the {profile} application record will be incomplete; missing: "
        f"{', '.join(absent)}; write them now, or give them to `vrspray report`"
    ]


run = typer.main.get_command(app)


# How often a flight is committed: once a second, sooner where that is too much of the field.

COMMIT_LEAST_S = 0.1
# Of the field: the swath of half the time between two commits, which is how far what is known
# after a cut of power may be from what was treated (`companion.runtime.coverage_ahead_s`). On
# 0.3 ha, at 5 m/s with 6 m, that is a commit each 0.2 s; from 1.5 ha on it is one a second.
UNKNOWN_SHARE = 0.001


def commit_every_s(setup: Setup, speed_m_s: float | None) -> float:
    """Return the time between two commits; `speed_m_s` None: the most that is sprayed at."""
    if not setup.records_coverage:
        return COMMIT_EVERY_S
    fastest_m_s = setup.limits.speed_max_m_s if speed_m_s is None else speed_m_s
    half_s = UNKNOWN_SHARE * setup.prescription.field.area / (setup.boom.width_m * fastest_m_s)
    return min(max(2.0 * half_s, COMMIT_LEAST_S), COMMIT_EVERY_S)
