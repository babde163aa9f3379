"""The table of a bucket test: what was caught in which time, by which valves."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from analysis.bucket import PULSE, PULSE_FULL_US, BucketCurve, Catch, fit_bucket
from analysis.csv_rows import Row, TableError, column_names, read_rows

if TYPE_CHECKING:
    from collections.abc import Sequence

    from analysis.bucket import BucketCurve


from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path


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
