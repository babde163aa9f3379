"""Command line of what is measured on a sprayer: lags and flow curves."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from analysis.calibration.identify import STEPS_MIN
from analysis.calibration.steps import Kind
from analysis.write_back import Write, check_asked, written_lines
from companion.cli.answer import AsJson, JournalFile, answer, new_app, note
from companion.cli.app import load_command
from companion.commands import Command
from companion.errors import ConfigError, JournalError, VrsprayError
from companion.wording import missing

if TYPE_CHECKING:
    from typer._click.core import Command as ClickCommand
    from typer._click.core import Context

    from analysis.calibration.identify import Estimate, Identified

# Written elsewhere; `mission` plans a flight over the twin's route, which analysis must not know.
OTHERS = {
    "lag-marks": Command(target="analysis.calibrate_marks:lag_marks", help=""),
    "flow": Command(target="analysis.calibrate_flow:flow", help=""),
    "valves": Command(target="analysis.calibrate_valves:valves", help=""),
    "curve": Command(target="analysis.calibrate_curve:curve", help=""),
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


app = new_app(
    cls=Commands,
    help="Measure a sprayer: lags (from flow or marks), flow curves, each valve, the swath.",
    epilog="Example: vrspray calibrate flow bucket.csv --config config.toml",
    no_args_is_help=True,
)


@app.command(epilog="Example: vrspray calibrate lag flights/flight-0001.gpkg")
def lag(
    journal: JournalFile,
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
    """Measure the lags from the flow meter of a flight.

    One lag each for switching on and off, and for raising and lowering the flow.

    Exit 0: all lags; 1: too few good steps of a kind; 2: the file or an option cannot be used.
    """
    from analysis.calibration.identify import identify
    from analysis.calibration.steps import record_of
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
            note(f"no picture: {missing('matplotlib')}")
        except (OSError, ValueError) as error:
            raise ConfigError(f"--plot {plot}: cannot be written ({error})") from error
    result = lag_result(found)
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


# --------------------------------------------------------------------------------------- its answer

# Which of an estimate's three figures is the safe one to fly with; the others fly their value.
SAFE_LOW, SAFE_HIGH = "on_start_s", "off_end_s"
MS = 1000.0


class TooFewStepsError(VrsprayError):
    """The journal does not say all lags."""


def refusal(found: Identified) -> str | None:
    """Return in one line what is missing; None where nothing is."""
    if not found.missing:
        return None
    used = {kind: sum(fit.step.kind is kind for fit in found.fits) for kind in Kind}
    kinds = ", ".join(f"{kind.value} {used[kind]}" for kind in found.missing)
    why = rejected_text(found)
    return (
        f"too few good steps ({kinds}; each kind needs {STEPS_MIN}); "
        + (f"not used: {why}; " if why else "")
        + "fly the mission of `vrspray calibrate mission` with a flow meter"
    )


def rejected_text(found: Identified) -> str:
    """Return why steps were not used, the most frequent reason first."""
    return ", ".join(f"{count} {reason.value}" for reason, count in found.rejected.most_common())


def estimates(found: Identified) -> dict[str, Estimate]:
    """Return the estimates by their keys of the configuration."""
    if found.missing or found.on_start is None or found.off_end is None:
        raise TooFewStepsError(refusal(found) or "too few good steps")
    result = {f"{kind.value}_s": found.lags[kind] for kind in Kind}
    return result | {SAFE_LOW: found.on_start, SAFE_HIGH: found.off_end}


def settings(found: Identified) -> dict[str, float]:
    """Return what to fly with: the lags, and of both ends the side on which nothing goes astray.

    Lags cannot be negative; a configured `output_s` that is longer than the whole lag makes them.
    """
    chosen = {}
    for key, estimate in estimates(found).items():
        value = estimate.value
        if key == SAFE_LOW:
            value = min(estimate.low, found.lags[Kind.ON].value)
        elif key == SAFE_HIGH:
            value = max(estimate.high, found.lags[Kind.OFF].value)
        chosen[key] = round(max(value, 0.0), 4)
    return chosen | {"output_s": found.output_s}


def lag_result(found: Identified) -> dict[str, Any]:
    """Return the answer in the shape of the contract, and what was not used."""
    result: dict[str, Any] = {
        key: {
            "value": estimate.value,
            "low": estimate.low,
            "high": estimate.high,
            "count": estimate.count,
        }
        for key, estimate in estimates(found).items()
    }
    return result | {
        "output_s": found.output_s,
        "rejected": {reason.value: count for reason, count in found.rejected.items()},
        "toml": "\n".join(toml_lines(found)),
    }


def toml_lines(found: Identified) -> Iterator[str]:
    """Yield the keys of the `[lag]` table that were measured."""
    yield "[lag]"
    for key, value in settings(found).items():
        yield f"{key} = {value:.4f}"


def table_lines(found: Identified) -> Iterator[str]:
    """Yield the answer for a person."""
    yield f"lags after the order at the output (output_s = {found.output_s:g} s), 95 % interval:"
    for key, estimate in estimates(found).items():
        yield (
            f"  {key:11s} {estimate.value * MS:7.1f} ms  "
            f"({estimate.low * MS:.1f} to {estimate.high * MS:.1f}), {estimate.count} steps"
        )
    why = rejected_text(found)
    yield f"  not used: {why}" if why else "  all steps were used"
    yield "on_start_s below is the low end and off_end_s the high end: the safe sides at a border."
    yield "paste over the same keys of your configuration:"
    yield ""
    yield from toml_lines(found)


def draw(found: Identified, path: Path) -> None:
    """Draw the lag of every step used, by kind, with the means and their intervals."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    for place, kind in enumerate(Kind):
        fits = [fit for fit in found.fits if fit.step.kind is kind]
        spread: Sequence[float] = [
            place + 0.5 * (i + 0.5) / max(len(fits), 1) - 0.25 for i in range(len(fits))
        ]
        lags_ms = [(fit.lag_s - found.output_s) * MS for fit in fits]
        sds_ms = [fit.sd_s * MS for fit in fits]
        axes.errorbar(spread, lags_ms, yerr=sds_ms, fmt=".", color="0.6", linewidth=0.8)
        if kind in found.lags:
            mean = found.lags[kind]
            half_ms = (mean.high - mean.value) * MS
            axes.errorbar([place], [mean.value * MS], yerr=[half_ms], fmt="o", capsize=6)
    axes.set_xticks(range(len(Kind)), [kind.value for kind in Kind])
    axes.set_ylabel("lag after the order at the output [ms]")
    axes.set_title("every step (1 sd) and the mean of each kind (95 %)")
    figure.savefig(path, dpi=110)
