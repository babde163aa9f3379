"""The curve of a pump from a bucket test: the lines of `[pump]` to paste."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from analysis.bucket import PULSE_FULL_US
from analysis.bucket_table import heading, point_cells, pump_curve_of, residuals
from analysis.write_back import written_lines
from companion.cli.answer import answer, note

if TYPE_CHECKING:
    from pathlib import Path

    from analysis.bucket import BucketCurve

# A speed controller's own steps are of this order; more digits feign what is not there.
STEP_US = 1.0


def pump_flow(
    csv: Path,
    *,
    config: Path | None,
    times: float,
    plot: Path | None,
    is_write: bool,
    as_json: bool,
) -> None:
    """Answer `calibrate flow` for a table of pulse widths."""
    curve = pump_curve_of(csv, times=times)
    result = _result(curve, _range_us(config))
    if plot is not None:
        from analysis.calibrate_plots import plot_flow

        plot_flow((curve,), plot, full=PULSE_FULL_US, what="pulse [us]")
        result["plot"] = str(plot)
    changed = written_lines(config, result, is_write=is_write)
    answer(result, [*_lines(result), *changed], as_json=as_json)
    for warning in result["warnings"]:
        note(f"warning: {warning}")


def _range_us(config: Path | None) -> tuple[float, float] | None:
    """Return stop and end of the configured pump's range, where there is one."""
    if config is None:
        return None
    from companion.config import load

    pump = load(config).pump
    return None if pump is None else (float(pump.stop_us), float(pump.max_us))


def _result(curve: BucketCurve, range_us: tuple[float, float] | None) -> dict[str, Any]:
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
    return {"pump": pump, "sets": [], "warnings": warnings, "toml": _toml(pump)}


def _in_us(row: dict[str, Any]) -> dict[str, Any]:
    duty = row.pop("duty")
    return {"us": PULSE_FULL_US * duty, **row}


def _toml(pump: dict[str, Any]) -> str:
    return "\n".join(
        [
            "[pump]",
            f"min_us = {pump['us'][0]:.0f}",
            f"us = [{', '.join(f'{pulse:.0f}' for pulse in pump['us'])}]",
            f"flow_l_min = [{', '.join(f'{flow:.4f}' for flow in pump['flow_l_min'])}]",
        ]
    )


def _lines(result: dict[str, Any]) -> list[str]:
    pump = result["pump"]
    lines = heading(pump, "pump")
    lines.append("     us  catches   L/min   curve    cv %  spread %  left out %  off the curve %")
    lines += [
        f"  {point['us']:5.0f}  {point_cells(point, pump['residuals'], by='us')}"
        for point in pump["points"]
    ]
    return [*lines, "", result["toml"]]
