"""`vrspray calibrate flow`: from a bucket test to `[[nozzle_set]]` or `[pump]`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from analysis.bucket_table import _cell, heading, point_cells, residuals
from analysis.write_back import Write, check_asked, written_lines
from companion.cli.answer import AsJson, answer, note

if TYPE_CHECKING:
    from collections.abc import Sequence

    from analysis.bucket import BucketCurve

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
    as_json: AsJson = False,
) -> None:
    """Fit the flow curve of valves or pump to a bucket test.

    Catch what all nozzles of a set give in a measured time, at five duties or more, twice each.
    The curve is fitted through the scatter of the repeats, where there are four repeats or more.

    Of a pump whose speed makes the flow: what all nozzles give, at five pulse widths or more.

    Example: vrspray calibrate flow bucket.csv --config config.toml --plot curve.png
    """
    from analysis.bucket_table import curves_of, is_of_a_pump
    from analysis.csv_rows import TableError

    check_asked(config, is_write=is_write)
    if compare not in (None, PAPER):
        raise TableError(f"--compare {compare}: there is only {PAPER}")
    if is_of_a_pump(csv):
        from analysis.calibrate_pump import pump_flow

        if compare is not None:
            raise TableError(f"--compare {compare}: was measured by duty, {csv} by pulse widths")
        pump_flow(csv, config=config, times=times, plot=plot, is_write=is_write, as_json=as_json)
        return
    names, window = _known(config)
    curves = curves_of(csv, window=window, times=times)
    result = _result(curves, csv, names)
    if compare is not None:
        result["compare"] = compared(curves)
        result["warnings"] += [text for each in result["compare"] for text in each["warnings"]]
    if plot is not None:
        from analysis.calibrate_plots import plot_flow

        plot_flow(curves, plot)
        result["plot"] = str(plot)
    changed = written_lines(config, result, is_write=is_write)
    answer(result, [*_lines(result), *changed], as_json=as_json)
    for warning in result["warnings"]:
        note(f"warning: {warning}")


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
    from analysis.bucket_table import valves_of

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
    return [*lines, "", result["toml"]]
