"""The words and figures of a bucket test's curve, of valves as of a pump."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Sequence

    from analysis.bucket import BucketCurve


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
