"""Command line of what is measured on a sprayer: lags and flow curves."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from analysis.write_back import Write, check_asked, written_lines
from companion.cli.answer import AsJson, answer, note
from companion.cli.app import load_command
from companion.commands import Command
from companion.errors import ConfigError, JournalError
from companion.wording import install_command

if TYPE_CHECKING:
    from typer._click.core import Command as ClickCommand
    from typer._click.core import Context

# Written elsewhere; `mission` plans a flight over the twin's route, which analysis must not know.
OTHERS = {
    "lag-marks": Command(target="analysis.calibrate_marks:lag_marks", help=""),
    "flow": Command(target="analysis.calibrate_flow:flow", help=""),
    "valves": Command(target="analysis.calibrate_valves:valves", help=""),
    "curve": Command(target="analysis.calibrate_curve:curve", help=""),
    "drift": Command(target="analysis.calibrate_drift:drift", help=""),
    "swath": Command(target="analysis.calibrate_swath:swath", help=""),
}
MISSION = "sitl.calibration_mission"


class Commands(TyperGroup):
    """The commands of this file and those of others, imported when they are asked for."""

    def list_commands(self, ctx: Context) -> list[str]:
        """Return the names of all commands."""
        return [*super().list_commands(ctx), *OTHERS]

    def get_command(self, ctx: Context, cmd_name: str) -> ClickCommand | None:
        """Return one command."""
        place = OTHERS.get(cmd_name)
        if place is None:
            return super().get_command(ctx, cmd_name)
        return load_command(cmd_name, place)


app = typer.Typer(
    cls=Commands,
    help="Measure a sprayer: lags (from flow or marks), flow curves, each valve, the swath.",
    epilog="Example: vrspray calibrate flow bucket.csv --config config.toml",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


@app.command(epilog="Example: vrspray calibrate lag flights/flight-0001.gpkg")
def lag(
    journal: Annotated[Path, typer.Argument(help="Journal of a flight, such as flight-0001.gpkg.")],
    meter_lag_s: Annotated[
        float, typer.Option(help="Delay of the meter, including its message, in seconds.")
    ] = 0.001,
    plot: Annotated[Path | None, typer.Option(help="Picture of all steps (PNG).")] = None,
    config: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Configuration that --write changes.")
    ] = None,
    is_write: Write = False,
    as_json: AsJson = False,
) -> None:
    """Measure the lags by kind, from the flow meter of a flight.

    Of on, off, up and down, by what was ordered when.

    Exit 0: all lags; 1: too few good steps of a kind; 2: the file or an option cannot be used.
    """
    from analysis.calibration.flow_record import record_of
    from analysis.calibration.identify import identify
    from analysis.calibration.result import (
        as_json as shape,
    )
    from analysis.calibration.result import (
        draw,
        refusal,
        table_lines,
    )
    from analysis.journals.content import read_journal

    check_asked(config, is_write=is_write)
    if not 0.0 <= meter_lag_s <= 1.0:
        raise ConfigError(f"--meter-lag-s {meter_lag_s:g}: give 0 to 1 s")
    content = read_journal(journal)
    record = record_of(content.items(), content.setup)
    if not len(record.time_s):
        raise JournalError(
            f"{journal}: has no flow meter readings; fly with a meter that [flow_meter] in the "
            "configuration names, or on the twin with `vrspray sitl fly --meter-rate-hz 50`"
        )
    found = identify(record, meter_lag_s=meter_lag_s)
    why = refusal(found)
    if why is not None:
        _refuse(f"{journal}: {why}", as_json=as_json)
    if plot is not None:
        try:
            draw(found, plot)
        except ImportError:
            note(f"no picture: matplotlib is missing; {install_command('office')}")
        except (OSError, ValueError) as error:
            raise ConfigError(f"--plot {plot}: cannot be written ({error})") from error
    result = shape(found)
    changed = written_lines(config, result, is_write=is_write)
    answer(result, [*table_lines(found), *changed], as_json=as_json)


def _refuse(why: str, *, as_json: bool) -> None:
    """Say why there is no answer, and leave with 1: the work was done, and failed."""
    line = f"error: {why}"
    if as_json:
        answer({"error": why}, (), as_json=True)
    note(line)
    raise typer.Exit(1)


@app.command(
    epilog="Example: vrspray calibrate mission --config examples/anyang/config.toml "
    "--out calibration.plan"
)
def mission(
    config: Annotated[Path, typer.Option(help="Configuration of the sprayer.")],
    out: Annotated[Path, typer.Option(help="Mission to write: .plan or .waypoints.")],
    origin: Annotated[
        str | None,
        typer.Option(metavar="LAT,LON", help="Start here; default: first depot, or the map."),
    ] = None,
    heading_deg: Annotated[
        float | None, typer.Option(help="Course of the first pass; default: mission.angle_deg.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Write the mission and map that `calibrate lag` needs.

    Twelve changes of each kind. Beside the mission lie its map and a copy of the configuration
    that flies it.
    """
    from importlib import import_module

    planner = import_module(MISSION)
    written = planner.write_calibration(
        config, out, origin=_origin(origin), heading_deg=heading_deg
    )
    warnings = _without_meter(config)
    result = {**_mission_json(written), "warnings": warnings}
    answer(result, _mission_lines(written), as_json=as_json)
    for warning in warnings:
        note(f"warning: {warning}")


def _without_meter(config: Path) -> list[str]:
    """Return that the flight would measure nothing, where nothing meters its flow."""
    from companion.config import load

    if load(config).flow_meter.source != "none":
        return []
    return [
        f"{config}: has no [flow_meter], so `calibrate lag` will find no readings in this flight; "
        "connect a meter and name it, or measure with marks: vrspray calibrate lag-marks"
    ]


def _origin(text: str | None) -> tuple[float, float] | None:
    if text is None:
        return None
    try:
        latitude_deg, longitude_deg = (float(part) for part in text.split(","))
    except ValueError:
        raise ConfigError(f"--origin {text}: give LATITUDE,LONGITUDE in degrees") from None
    if not (abs(latitude_deg) <= 85.0 and abs(longitude_deg) <= 180.0):
        raise ConfigError(f"--origin {text}: is not a position on Earth")
    return latitude_deg, longitude_deg


def _mission_json(written: Any) -> dict[str, Any]:
    layout = written.layout
    return {
        "mission": str(written.mission),
        "prescription": str(written.prescription),
        "config": str(written.config),
        "passes": len(layout.passes),
        "strip_m": layout.strip_m,
        "speed_m_s": layout.speed_m_s,
        "volume_l": layout.volume_l,
        "duration_s": layout.duration_s,
    }


def _mission_lines(written: Any) -> Iterator[str]:
    layout = written.layout
    yield f"mission {written.mission}, map {written.prescription}, configuration {written.config}"
    yield (
        f"{len(layout.passes)} passes at {layout.speed_m_s:g} m/s over strips of "
        f"{layout.strip_m:.1f} m: about {layout.duration_s:.0f} s and {layout.volume_l:.1f} L"
    )
    yield "1. fill with water; look at the place on the map: there must be nothing in the way"
    yield f"2. upload the mission; vrspray run --config {written.config}; fly it in AUTO and enable"
    yield "3. vrspray calibrate lag JOURNAL, and paste what it prints into your own configuration"
