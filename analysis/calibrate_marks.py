"""`vrspray calibrate lag-marks`: from marks on the ground to the lines of the configuration."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from analysis.write_back import Write, check_asked, tell_measured
from companion.cli.answer import AsJson, answer, note

if TYPE_CHECKING:
    from collections.abc import Sequence

    from analysis.marks import Estimate, Mark, MarksFit

COLUMNS = ("course_deg", "speed_m_s", "mark_m")
FAR_M = 50.0
POSITION_S_MAX = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Present:
    """What the controller had configured when the marks were made."""

    position_s: float = 0.0
    forward_m: float = 0.0
    offset_east_m: float = 0.0
    offset_north_m: float = 0.0
    known: bool = False
    own_forward: bool = False


def lag_marks(
    csv: Annotated[
        Path,
        typer.Argument(
            metavar="CSV",
            help="Columns course_deg, speed_m_s, mark_m (+ beyond the boundary); kind, heading_deg "
            "may be added.",
        ),
    ],
    config: Annotated[
        Path | None, typer.Option(help="The configuration that was flown; without it all 0.")
    ] = None,
    sd_m: Annotated[
        float | None,
        typer.Option(min=0.001, max=1.0, help="How exactly a mark can be measured, 1 sd."),
    ] = None,
    body_known: Annotated[
        bool, typer.Option("--body-known", help="boom.forward_m was measured: leave it alone.")
    ] = False,
    plot: Annotated[Path | None, typer.Option(metavar="PNG", help="Picture of the fit.")] = None,
    is_write: Write = False,
    as_json: AsJson = False,
) -> None:
    """Measure the position's lag and offsets from ground marks.

    They are lag.position_s, boom.forward_m and the offset of the map.

    Fly one boundary inside the field to and fro at two speeds, and measure how far beyond it each
    change of rate fell. What the marks cannot tell apart is refused (exit 1).

    Example: vrspray calibrate lag-marks marks.csv --config config.toml --plot marks.png
    """
    from analysis.marks import fit_marks, missing_in

    check_asked(config, is_write=is_write)
    marks = read_marks(csv)
    present = _present(config)
    missing = missing_in(marks, body_known=body_known)
    if missing:
        _refuse(csv, missing, as_json=as_json)
    fit = fit_marks(marks, sd_m=sd_m, body_known=body_known)
    result = result_of(marks, fit, present)
    if plot is not None:
        from analysis.calibrate_plots import plot_marks

        plot_marks(marks, fit, plot)
        result["plot"] = str(plot)
    tell_measured(config, result, _lines(result), is_write=is_write, as_json=as_json)


def read_marks(path: Path) -> list[Mark]:
    """Return the marks of a CSV file."""
    from analysis.csv_rows import read_rows
    from analysis.marks import Mark

    return [
        Mark(
            course_deg=row.needed("course_deg", low=-360.0, high=360.0),
            speed_m_s=row.needed("speed_m_s", low=0.5, high=50.0),
            mark_m=row.needed("mark_m", low=-FAR_M, high=FAR_M),
            heading_deg=row.number("heading_deg", low=-360.0, high=360.0),
            kind=row.text("kind"),
            line=row.line,
        )
        for row in read_rows(path, COLUMNS)
    ]


def result_of(marks: Sequence[Mark], fit: MarksFit, present: Present) -> dict[str, Any]:
    """Return the result as JSON has it: errors found, settings that follow, TOML to paste."""
    settings = settings_of(fit, present)
    outlier = None
    if fit.outlier is not None:
        outlier = {"line": marks[fit.outlier].line, "residual_m": fit.residual_m[fit.outlier]}
    errors = {
        "time_error_s": fit.time_error_s,
        "body_offset_m": fit.body_offset_m,
        "datum_east_m": fit.datum_east_m,
        "datum_north_m": fit.datum_north_m,
    }
    return {
        **{name: _as_json(value) for name, value in settings.items()},
        "errors": {name: _as_json(value) for name, value in errors.items()},
        "time_by_group_s": {name: _as_json(each) for name, each in fit.time_by_group_s.items()},
        "axis_deg": fit.axis_deg,
        "marks": len(marks),
        "sd_m": fit.sd_m,
        "residual_m": list(fit.residual_m),
        "outlier": outlier,
        "warnings": [*fit.warnings, *_notes(fit, settings, present)],
        "toml": _toml(settings),
    }


def settings_of(fit: MarksFit, present: Present) -> dict[str, Estimate | None]:
    """Return the settings that take the errors away.

    A position that is `time_error_s` older than configured, a boom that much farther ahead: both
    are added. A map that lies east of the ground has to be moved west.
    """
    body = fit.body_offset_m
    return {
        "position_s": fit.time_error_s.turned(1.0, present.position_s),
        "forward_m": None if body is None else body.turned(1.0, present.forward_m),
        "offset_east_m": fit.datum_east_m.turned(-1.0, present.offset_east_m),
        "offset_north_m": fit.datum_north_m.turned(-1.0, present.offset_north_m),
    }


def _present(config: Path | None) -> Present:
    if config is None:
        return Present()
    from companion.config import load

    loaded = load(config)
    table = loaded.prescription
    return Present(
        position_s=loaded.lag.position_s,
        forward_m=loaded.boom_table.forward_m,
        offset_east_m=0.0 if table is None else table.offset_east_m,
        offset_north_m=0.0 if table is None else table.offset_north_m,
        known=True,
        own_forward=any(valve.forward_m is not None for valve in loaded.valve),
    )


def _notes(fit: MarksFit, settings: dict[str, Estimate | None], present: Present) -> list[str]:
    notes = []
    if fit.axis_deg is not None:
        notes.append(
            f"the map's offset is known along {fit.axis_deg:.0f} deg only, not across; flights "
            "over a boundary at right angles would tell"
        )
    if present.own_forward and settings["forward_m"] is not None:
        notes.append("some valves have a forward_m of their own: add errors.body_offset_m to each")
    position = settings["position_s"]
    if position is not None and not abs(position.value) <= POSITION_S_MAX:
        notes.append(
            f"position_s = {position.value:.2f} is not an age of a position; check the signs"
        )
    elif position is not None and position.high < 0.0:
        notes.append("position_s is below 0: a lag or output_s is set too long; identify the lags")
    if not present.known:
        notes.append("without --config the settings that were flown are taken to be 0")
    return notes


def _toml(settings: dict[str, Estimate | None]) -> str:
    places = {
        "[lag]": {"position_s": 4},
        "[boom]": {"forward_m": 3},
        "[prescription]": {"offset_east_m": 3, "offset_north_m": 3},
    }
    lines = []
    for table, keys in places.items():
        found = [(key, digits, settings[key]) for key, digits in keys.items()]
        entries = [
            f"{key} = {_fixed(each.value, digits)}  # {_fixed(each.low, digits)} to "
            f"{_fixed(each.high, digits)}"
            for key, digits, each in found
            if each is not None
        ]
        lines += [table, *entries] if entries else []
    return "\n".join(lines)


def _fixed(value: float, digits: int) -> str:
    """Return a number with so many digits, none of them a negative nothing."""
    return f"{round(value, digits) + 0.0:.{digits}f}"


def _lines(result: dict[str, Any]) -> list[str]:
    errors = result["errors"]
    lines = [
        f"{result['marks']} marks, scatter {result['sd_m']:.3f} m; errors with 95 % intervals:",
        _line("time", errors["time_error_s"], 1000.0, "ms too late, grows with the speed"),
    ]
    if errors["body_offset_m"] is not None:
        lines.append(_line("boom", errors["body_offset_m"], 1.0, "m ahead of where it is set"))
    lines.append(_line("map", errors["datum_east_m"], 1.0, "m east of the ground"))
    lines.append(_line("map", errors["datum_north_m"], 1.0, "m north of the ground"))
    return [
        *lines,
        "",
        "# all lines together, or none: they were found together",
        *result["toml"].splitlines(),
    ]


def _line(name: str, value: dict[str, float], factor: float, text: str) -> str:
    digits = 1 if factor > 1.0 else 3
    middle, low, high = (factor * value[key] for key in ("value", "low", "high"))
    return f"  {name:5} {middle:+8.{digits}f}  ({low:+.{digits}f} to {high:+.{digits}f}) {text}"


def _as_json(value: Estimate | None) -> dict[str, float] | None:
    return None if value is None else asdict(value)


def _refuse(path: Path, missing: list[str], *, as_json: bool) -> None:
    """Say what the marks lack, and end with exit 1."""
    text = f"{path}: the marks cannot tell the errors apart: {'; '.join(missing)}"
    answer({"error": text, "missing": missing}, (), as_json=as_json)
    note(f"error: {text}")
    raise typer.Exit(1)
