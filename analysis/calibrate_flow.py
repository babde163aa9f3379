"""`vrspray calibrate flow`: from a bucket test to `[[nozzle_set]]` or `[pump]`."""

from __future__ import annotations

import re
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from analysis.bucket import PULSE, PULSE_FULL_US, BucketCurve, Catch, fit_bucket
from analysis.csv_rows import Row, TableError, column_names, read_rows
from analysis.write_back import (
    Confirmed,
    Write,
    check_asked,
    check_change,
    tell_measured,
    written_lines,
)
from companion.cli.answer import AsJson, answer, note

if TYPE_CHECKING:
    from collections.abc import Sequence

# Of a pump's table: the width of the pulse that its speed controller was given.
PULSE_COLUMN = "us"
_RANGE = re.compile(r"(\d+)-(\d+)")


def curves_of(path: Path, *, window: tuple[float, float], times: float = 1.0) -> list[BucketCurve]:
    """Return the curve of every set in a file, in the order of the file."""
    sets: dict[str, list[Catch]] = {}
    for row in read_rows(path, ("duty", "seconds")):
        sets.setdefault(row.text("set") or "", []).append(_catch(row, times))
    curves = []
    for name, catches in sets.items():
        try:
            curves.append(fit_bucket(catches, window=window, name=name))
        except ValueError as error:
            where = f"set {name}: " if name else ""
            raise TableError(f"{path}: {where}{error}") from None
    return curves


def is_of_a_pump(path: Path) -> bool:
    """Return whether a file was measured by the pulse widths of a motor and not by duties."""
    names = column_names(path)
    return PULSE_COLUMN in names and "duty" not in names


def pump_curve_of(path: Path, *, times: float = 1.0) -> BucketCurve:
    """Return the curve of a pump; its duties are shares of `PULSE_FULL_US`."""
    catches = []
    for row in read_rows(path, (PULSE_COLUMN, "seconds")):
        if row.text("set"):
            raise row.error("a pump has one curve; leave the column set out")
        pulse_us = row.needed(PULSE_COLUMN, low=500.0, high=PULSE_FULL_US)
        catches.append(_caught(row, times, duty=pulse_us / PULSE_FULL_US))
    try:
        return fit_bucket(catches, window=(0.0, 1.0), scale=PULSE)
    except ValueError as error:
        raise TableError(f"{path}: {error}") from None


def _catch(row: Row, times: float) -> Catch:
    duty = row.needed("duty", low=0.0, high=100.0)
    if not 0.0 < duty <= 1.0:
        raise row.error(f"duty must be above 0 and at most 1, got {duty:g}; write 0.5 for 50 %")
    return _caught(row, times, duty=duty)


def _caught(row: Row, times: float, *, duty: float) -> Catch:
    millilitres = row.number("millilitres", low=0.0, high=1e6)
    litres = row.number("litres", low=0.0, high=1e3)
    if (millilitres is None) == (litres is None):
        raise row.error("either millilitres or litres must be given")
    volume_ml = millilitres if millilitres is not None else 1000.0 * (litres or 0.0)
    if not volume_ml > 0.0:
        raise row.error("nothing was caught; leave the line out")
    seconds = row.needed("seconds", low=1.0, high=36_000.0)
    return Catch(duty=duty, seconds=seconds, millilitres=times * volume_ml, line=row.line)


def valves_of(text: str, known: Sequence[str] | None, path: Path) -> list[str]:
    """Return the valves that a set names; nothing named is all of them.

    >>> valves_of("1-3 5", None, Path("bucket.csv"))
    ['1', '2', '3', '5']
    """
    valves: list[str] = []
    for part in re.split(r"[\s,;+]+", text.strip()):
        match = _RANGE.fullmatch(part)
        if match and (known is None or part not in known):
            first, last = int(match[1]), int(match[2])
            valves += [str(number) for number in range(first, min(last, first + 255) + 1)]
        elif part:
            valves.append(part)
    if known is not None:
        strange = [name for name in valves if name not in known]
        if strange:
            raise TableError(
                f"{path}: set {text!r}: no valve {', '.join(strange)} in the configuration; it has "
                f"{', '.join(known)}"
            )
    return valves or list(known or ())


# The words and figures of a bucket test's curve, of valves as of a pump.


def residuals(curve: BucketCurve) -> list[dict[str, Any]]:
    """Return each catch beside the curve."""
    return [
        {
            "line": each.catch.line,
            "duty": each.catch.duty,
            "flow_l_min": each.catch.flow_l_min,
            "residual_l_min": each.residual_l_min,
            "residual_percent": each.residual_percent,
        }
        for each in curve.residuals
    ]


def heading(curve: dict[str, Any], name: str) -> list[str]:
    """Say how a curve was found."""
    repeat = curve["repeatability_percent"]
    again = "not repeated" if repeat is None else f"a catch repeats to {repeat:.1f} % (1 sd)"
    return [f"{name}: {again}", f"curve: {curve['fit']['words']}"]


def point_cells(
    point: dict[str, Any], residuals: Sequence[dict[str, Any]], *, by: str = "duty"
) -> str:
    """Return the cells of one duty or pulse width, each catch's deviation from the curve last."""
    off = [each["residual_percent"] for each in residuals if each[by] == point[by]]
    return (
        f"{point['count']:7d}  {point['flow_l_min']:6.3f}  {point['curve_l_min']:6.3f}  "
        f"{_cell(point['cv_percent'])}  {_cell(point['spread_percent'], 8)}  "
        f"{_cell(point['left_out_percent'], 10)}  {' '.join(f'{each:+.1f}' for each in off)}"
    )


def _cell(value: float | None, width: int = 6, digits: int = 1) -> str:
    return "-".rjust(width) if value is None else f"{value:{width}.{digits}f}"


# A speed controller's own steps are of this order; more digits feign what is not there.
STEP_US = 1.0


def pump_flow(
    csv: Path,
    *,
    config: Path | None,
    times: float,
    plot: Path | None,
    is_write: bool,
    is_confirmed: bool,
    as_json: bool,
) -> None:
    """Answer `calibrate flow` for a table of pulse widths."""
    curve = pump_curve_of(csv, times=times)
    result = _pump_result(curve, _range_us(config))
    check_change(config, result["toml"], is_confirmed=is_confirmed)
    if plot is not None:
        from analysis.calibrate_plots import plot_flow

        plot_flow((curve,), plot, full=PULSE_FULL_US, what="pulse [us]")
        result["plot"] = str(plot)
    changed = written_lines(config, result, is_write=is_write)
    answer(result, [*_pump_lines(result), *changed], as_json=as_json)
    for warning in result["warnings"]:
        note(f"warning: {warning}")


def _range_us(config: Path | None) -> tuple[float, float] | None:
    """Return stop and end of the configured pump's range, where there is one."""
    if config is None:
        return None
    from companion.config import load

    pump = load(config).pump
    return None if pump is None else (float(pump.stop_us), float(pump.max_us))


def _pump_result(curve: BucketCurve, range_us: tuple[float, float] | None) -> dict[str, Any]:
    pulses_us = [round(PULSE_FULL_US * duty / STEP_US) * STEP_US for duty in curve.duty]
    warnings = list(curve.warnings)
    if range_us is not None:
        outside = [pulse for pulse in pulses_us if not range_us[0] < pulse <= range_us[1]]
        if outside:
            warnings.append(
                f"{', '.join(f'{pulse:g}' for pulse in outside)} us lie outside the range of "
                f"[pump], {range_us[0]:g} to {range_us[1]:g} us: correct stop_us or max_us"
            )
    pump = {
        "us": pulses_us,
        "flow_l_min": list(curve.flow_l_min),
        "fit": curve.fit.as_json(len(curve.means)),
        "points": [_in_us(asdict(mean)) for mean in curve.means],
        "residuals": [_in_us(each) for each in residuals(curve)],
        "repeatability_percent": curve.repeatability_percent,
    }
    return {"pump": pump, "sets": [], "warnings": warnings, "toml": _pump_toml(pump)}


def _in_us(row: dict[str, Any]) -> dict[str, Any]:
    duty = row.pop("duty")
    return {"us": PULSE_FULL_US * duty, **row}


def _pump_toml(pump: dict[str, Any]) -> str:
    return "\n".join(
        [
            "[pump]",
            f"min_us = {pump['us'][0]:.0f}",
            f"us = [{', '.join(f'{pulse:.0f}' for pulse in pump['us'])}]",
            f"flow_l_min = [{', '.join(f'{flow:.4f}' for flow in pump['flow_l_min'])}]",
        ]
    )


def _pump_lines(result: dict[str, Any]) -> list[str]:
    pump = result["pump"]
    lines = heading(pump, "pump")
    lines.append("     us  catches   L/min   curve    cv %  spread %  left out %  off the curve %")
    lines += [
        f"  {point['us']:5.0f}  {point_cells(point, pump['residuals'], by='us')}"
        for point in pump["points"]
    ]
    return [*lines, "", *result["toml"].splitlines()]


# The PWM window that a configuration has unless it says otherwise.
WINDOW = (0.2, 0.9)
PAPER = "wang-2024"


def flow(
    csv: Annotated[
        Path,
        typer.Argument(
            metavar="CSV",
            help="Columns duty (0 to 1), seconds, millilitres or litres; set (valves, as 1-4 or "
            "1 2 3 4) may be added. us (a motor's pulse) instead of duty: a pump's curve.",
        ),
    ],
    config: Annotated[
        Path | None, typer.Option(help="Configuration with the valves' names and the PWM's limits.")
    ] = None,
    times: Annotated[
        float,
        typer.Option(min=1.0, max=1000.0, help="Multiply: caught under one of N nozzles."),
    ] = 1.0,
    compare: Annotated[
        str | None,
        typer.Option(metavar="NAME", help=f"Compare with a published sprayer: {PAPER}."),
    ] = None,
    plot: Annotated[Path | None, typer.Option(metavar="PNG", help="Picture of the curve.")] = None,
    is_write: Write = False,
    is_confirmed: Confirmed = False,
    as_json: AsJson = False,
) -> None:
    """Fit the flow curve of valves or pump to a bucket test.

    Catch what all nozzles of a set give in a measured time, at five duties or more, twice each.
    The curve is fitted through the scatter of the repeats, where there are four repeats or more.

    Of a pump whose speed makes the flow: what all nozzles give, at five pulse widths or more.

    Example: vrspray calibrate flow bucket.csv --config config.toml --plot curve.png
    """
    check_asked(config, is_write=is_write)
    if compare not in (None, PAPER):
        raise TableError(f"--compare {compare}: there is only {PAPER}")
    if is_of_a_pump(csv):
        if compare is not None:
            raise TableError(f"--compare {compare}: was measured by duty, {csv} by pulse widths")
        pump_flow(
            csv, config=config, times=times, plot=plot, is_write=is_write,
            is_confirmed=is_confirmed, as_json=as_json,
        )  # fmt: skip
        return
    names, window = _known(config)
    curves = curves_of(csv, window=window, times=times)
    result = _result(curves, csv, names)
    check_change(config, result["toml"], is_confirmed=is_confirmed)
    if compare is not None:
        result["compare"] = compared(curves)
        result["warnings"] += [text for each in result["compare"] for text in each["warnings"]]
    if plot is not None:
        from analysis.calibrate_plots import plot_flow

        plot_flow(curves, plot)
        result["plot"] = str(plot)
    tell_measured(config, result, _lines(result), is_write=is_write, as_json=as_json)


def _known(config: Path | None) -> tuple[tuple[str, ...] | None, tuple[float, float]]:
    """Return the valves' names, left to right, and the PWM's window."""
    if config is None:
        return None, WINDOW
    from companion.config import load

    loaded = load(config)
    names = tuple(valve.name for valve in loaded.valve)
    return names, (loaded.pwm.duty_min, loaded.pwm.duty_max)


def _result(
    curves: Sequence[BucketCurve], path: Path, known: Sequence[str] | None
) -> dict[str, Any]:

    sets = [_set(curve, valves_of(curve.name, known, path)) for curve in curves]
    warnings = [
        f"set {curve.name}: {text}" if curve.name else text
        for curve in curves
        for text in curve.warnings
    ]
    if any(not each["valves"] for each in sets):
        warnings.append("no column set and no --config: write the names of the valves yourself")
    return {"sets": sets, "warnings": warnings, "toml": _toml(sets)}


def _set(curve: BucketCurve, valves: list[str]) -> dict[str, Any]:
    return {
        "set": curve.name,
        "valves": valves,
        "duty": list(curve.duty),
        "flow_l_min": list(curve.flow_l_min),
        "fit": curve.fit.as_json(len(curve.means)),
        "points": [asdict(mean) for mean in curve.means],
        "residuals": residuals(curve),
        "repeatability_percent": curve.repeatability_percent,
        "warnings": list(curve.warnings),
    }


def _toml(sets: Sequence[dict[str, Any]]) -> str:
    lines = []
    for each in sets:
        valves = ", ".join(f'"{name}"' for name in each["valves"])
        lines += [
            "[[nozzle_set]]",
            f"valves = [{valves}]",
            f"duty = [{', '.join(f'{duty:.4g}' for duty in each['duty'])}]",
            f"flow_l_min = [{', '.join(f'{flow:.4f}' for flow in each['flow_l_min'])}]",
        ]
    return "\n".join(lines)


def compared(curves: Sequence[BucketCurve]) -> list[dict[str, Any]]:
    """Return each curve beside P1's table and law, and where these two disagree."""
    from analysis.published import disagreements, nearest_set

    found = []
    for curve in curves:
        published = nearest_set(curve.duty[-1], curve.flow_l_min[-1])
        rows = []
        for duty, measured in zip(curve.duty, curve.flow_l_min, strict=True):
            table, law = published.table_flow_l_min(duty), published.law_flow_l_min(duty)
            in_law = published.law.flow_min_l_min <= law <= published.law.flow_max_l_min
            rows.append(
                {
                    "duty": duty,
                    "measured_l_min": measured,
                    "table_2_l_min": table,
                    "eq_2_l_min": law if in_law else None,
                    "over_table_2_percent": _over(measured, table),
                    "over_eq_2_percent": _over(measured, law if in_law else None),
                }
            )
        differ = disagreements(published)
        worst = max(differ, key=lambda row: abs(row.excess_percent))
        found.append(
            {
                "set": curve.name,
                "name": PAPER,
                "nozzles": published.nozzles,
                "rows": rows,
                "disagreements": [asdict(row) for row in differ],
                "warnings": [
                    f"{PAPER}, {published.nozzles} nozzles: Eq. 2 and Table 2 disagree by up to "
                    f"{worst.excess_percent:+.1f} % of flow (asked {worst.asked_l_min:.2f} L/min, "
                    f"duty {worst.duty:.3f}, table {worst.table_l_min:.2f}); use a measured curve"
                ],
            }
        )
    return found


def _over(measured: float, other: float | None) -> float | None:
    return None if other is None else 100.0 * (measured / other - 1.0)


def _lines(result: dict[str, Any]) -> list[str]:
    lines = []
    for each in result["sets"]:
        lines += heading(each, f"set {each['set'] or 'of all valves'}")
        lines.append(
            "   duty  catches   L/min   curve    cv %  spread %  left out %  off the curve %"
        )
        lines += [
            f"  {point['duty']:5.3f}  {point_cells(point, each['residuals'])}"
            for point in each["points"]
        ]
    for each in result.get("compare", ()):
        lines += ["", f"beside {each['name']}, {each['nozzles']} nozzles [L/min]:"]
        lines.append("   duty  measured  Table 2   %      Eq. 2     %")
        lines += [
            f"  {row['duty']:5.3f}  {row['measured_l_min']:8.3f}  "
            f"{_cell(row['table_2_l_min'], 7, 3)}  {_cell(row['over_table_2_percent'])}  "
            f"{_cell(row['eq_2_l_min'], 7, 3)}  {_cell(row['over_eq_2_percent'])}"
            for row in each["rows"]
        ]
    return [*lines, "", *result["toml"].splitlines()]
