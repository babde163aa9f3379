"""Pictures of calibrations: marks against speed, flow against duty. Needs the extra `plot`."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from analysis.csv_rows import TableError
from analysis.swath import lanes
from companion.wording import writing

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from analysis.bucket import BucketCurve
    from analysis.calibration.curve import SetCurve
    from analysis.calibration.valves import IdentifiedValves
    from analysis.marks import Mark, MarksFit
    from analysis.swath import Found

# Okabe and Ito's colours, told apart by all kinds of eyes.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")
INK, FAINT = "#222222", "#8A8A8A"
STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "axes.edgecolor": FAINT,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlelocation": "left",
    "legend.frameon": False,
}
DPI = 150
MS = 1000.0
# Courses that differ by less are one direction of flight.
SAME_DEG = 15.0


def plot_marks(marks: Sequence[Mark], fit: MarksFit, path: Path) -> None:
    """Draw each mark against its speed, and the fitted line of every direction."""
    with _axes(path) as axes:
        speeds = np.array([mark.speed_m_s for mark in marks])
        reach = np.array([0.0, 1.1 * float(speeds.max())])
        for number, (course_deg, own) in enumerate(_by_course(marks).items()):
            colour = COLOURS[number % len(COLOURS)]
            axes.scatter(
                [mark.speed_m_s for mark in own],
                [mark.mark_m for mark in own],
                s=22,
                color=colour,
                zorder=3,
            )
            angle = np.radians(course_deg)
            offset = fit.datum_east_m.value * np.sin(angle) + fit.datum_north_m.value * np.cos(
                angle
            )
            if fit.body_offset_m is not None:
                offset += fit.body_offset_m.value * own[0].body_share
            axes.plot(
                reach,
                offset + fit.time_error_s.value * reach,
                color=colour,
                lw=1.2,
                label=f"flown towards {course_deg:.0f} deg",
            )
        if fit.outlier is not None:
            worst = marks[fit.outlier]
            axes.scatter(
                worst.speed_m_s, worst.mark_m, s=90, color="none", ec=INK, label="left out"
            )
        axes.axhline(0.0, color=INK, lw=0.8)
        axes.set_xlim(0.0, reach[1])
        axes.set_xlabel("speed [m/s]")
        axes.set_ylabel("mark beyond the boundary [m]")
        time = fit.time_error_s
        axes.set_title(
            f"slope: {1000.0 * time.value:.0f} ms too late "
            f"({1000.0 * time.low:.0f} to {1000.0 * time.high:.0f})"
        )
        axes.legend()


def _by_course(marks: Sequence[Mark]) -> dict[float, list[Mark]]:
    """Return the marks by direction of flight, those of one pass line together."""
    found: dict[float, list[Mark]] = {}
    for mark in marks:
        near = (c for c in found if abs((mark.course_deg - c + 180.0) % 360.0 - 180.0) <= SAME_DEG)
        found.setdefault(next(near, mark.course_deg % 360.0), []).append(mark)
    return found


def plot_flow(
    curves: Sequence[BucketCurve], path: Path, *, full: float = 100.0, what: str = "duty [%]"
) -> None:
    """Draw every catch and the curve of each set; `full` is what stands for a duty of 1."""
    with _axes(path) as axes:
        for number, curve in enumerate(curves):
            colour = COLOURS[number % len(COLOURS)]
            duty = np.linspace(curve.duty[0], curve.duty[-1], 200)
            flow = [curve.flow_curve.flow_for(float(each)) for each in duty]
            axes.plot(full * duty, flow, color=colour, lw=1.2, label=curve.name or "all valves")
            axes.scatter(
                [full * each.catch.duty for each in curve.residuals],
                [each.catch.flow_l_min for each in curve.residuals],
                s=16,
                color=colour,
                zorder=3,
            )
        axes.set_xlabel(what)
        axes.set_ylabel("flow [L/min]")
        axes.set_title("Bucket test")
        axes.legend()


def plot_set_curves(found: Sequence[SetCurve], names: Sequence[str], path: Path) -> None:
    """Draw how far each point is from the straight line between weighed duties."""
    with _axes(path) as axes:
        axes.axhline(0.0, color=FAINT, lw=0.8)
        for number, (curve, name) in enumerate(zip(found, names, strict=True)):
            colour = COLOURS[number % len(COLOURS)]
            straight = [100.0 / point.straight_l_min for point in curve.points]
            axes.errorbar(
                [100.0 * point.duty for point in curve.points],
                [
                    over * point.flow_l_min - 100.0
                    for over, point in zip(straight, curve.points, strict=True)
                ],
                yerr=[
                    0.5 * over * (point.high - point.low)
                    for over, point in zip(straight, curve.points, strict=True)
                ],
                color=colour,
                lw=1.2,
                capsize=3,
                label=f"valves {name}",
            )
            weighed = [100.0 * duty for duty in curve.weighed_duty]
            axes.scatter(weighed, [0.0] * len(weighed), s=24, color=colour, zorder=3)
        axes.set_xlabel("duty [%]")
        axes.set_ylabel("flow over the straight line [%]")
        axes.set_title("Between the weighed duties (dots)")
        axes.legend()


def plot_valves(found: IdentifiedValves, names: Sequence[str], path: Path) -> None:
    """Draw each valve's flow against the mean, and its lags, all with their intervals."""
    with _figure(path) as figure:
        flow_axes, lag_axes = figure.subplots(1, 2)
        for place, own in enumerate(found.valves):
            factor = own.factor
            half = 50.0 * (factor.high - factor.low)
            colour = COLOURS[1] if own.is_worn else COLOURS[0]
            flow_axes.errorbar(
                place, 100.0 * (factor.value - 1.0), yerr=half, fmt="o", color=colour, capsize=4
            )
            for number, (kind, lag) in enumerate(own.lags.items()):
                lag_axes.errorbar(
                    place + 0.16 * (number - 1.5),
                    MS * lag.value,
                    yerr=0.5 * MS * (lag.high - lag.low),
                    fmt="o",
                    ms=4,
                    color=COLOURS[number],
                    capsize=3,
                    label=kind.value if not place else None,
                )
        for axes, what in (
            (flow_axes, "flow against the mean of all [%]"),
            (lag_axes, "later than the mean of all [ms]"),
        ):
            axes.axhline(0.0, color=FAINT, lw=0.8)
            axes.set_xticks(range(len(names)), list(names))
            axes.set_xlabel("valve")
            axes.set_title(what)
        if any(own.lags for own in found.valves):
            lag_axes.legend(ncols=2)
        else:
            lag_axes.text(
                0.5,
                0.5,
                "lags: not measured",
                transform=lag_axes.transAxes,
                ha="center",
                color=FAINT,
            )


def plot_swath(found: Found, path: Path, *, one_way: bool) -> None:
    """Draw the passes and their mean, the overlapped pattern, and the CV against lane spacing."""
    with _figure(path, height_in=7.6) as figure:
        pattern_axes, overlap_axes, cv_axes = figure.subplots(3, 1)
        shown = 100.0 / max(found.mean.deposit)
        for one in found.passes:
            pattern_axes.plot(
                one.right_m, [shown * each for each in one.deposit], color=FAINT, lw=0.8
            )
        pattern_axes.plot(
            found.mean.right_m, [shown * each for each in found.mean.deposit], color=INK, lw=1.6,
            label="mean, without wind",
        )  # fmt: skip
        pattern_axes.set_title("Deposit across the track")
        pattern_axes.set_xlabel("right of the track [m]")
        pattern_axes.set_ylabel("% of the mean's peak")
        pattern_axes.legend(loc="upper left")
        swath_m = found.swath_m["one_way" if one_way else "to_and_fro"]
        if swath_m is not None:
            _plot_lanes(overlap_axes, found, swath_m, one_way=one_way)
        for name, label, colour in (
            ("to_and_fro", "to and fro", COLOURS[0]),
            ("one_way", "one way", COLOURS[1]),
        ):
            wide = found.swath_m[name]
            text = "none" if wide is None else f"{wide:.2f} m"
            cv_axes.plot(found.spacing_m, found.cv[name], color=colour, label=f"{label}: {text}")
            if wide is not None:
                cv_axes.plot([wide, wide], [0.0, found.cv_max], color=colour, lw=0.8, ls=":")
        cv_axes.axhline(found.cv_max, color=INK, lw=0.8, ls="--")
        cv_axes.set_ylim(0.0, min(max(4.0 * found.cv_max, 20.0), 100.0))
        cv_axes.set_xlim(0.0, float(found.spacing_m[-1]))
        cv_axes.set_title(f"CV against lane spacing; the line is {found.cv_max:g} %")
        cv_axes.set_xlabel("lane spacing [m]")
        cv_axes.set_ylabel("CV [%]")
        cv_axes.legend()


def _plot_lanes(axes: Axes, found: Found, swath_m: float, *, one_way: bool) -> None:
    """Draw three passes at the effective swath, and their sum with all others."""
    mean = found.mean
    shown = 100.0 / max(mean.deposit)
    for lane in (-1, 0, 1):
        turn = 1.0 if one_way or lane == 0 else -1.0
        axes.plot(
            [lane * swath_m + turn * at for at in mean.right_m],
            [shown * each for each in mean.deposit], color=FAINT, lw=0.8,
        )  # fmt: skip
        axes.axvline(lane * swath_m, color=FAINT, lw=0.6, ls=":")
    edges, left, right = lanes(mean, swath_m, to_and_fro=not one_way)
    at = np.repeat(edges, 2)[1:-1]
    total = shown * np.column_stack([left, right]).ravel()
    period = float(edges[-1])
    for lane in (-1, 0, 1):
        axes.plot(at + lane * period, total, color=COLOURS[0], lw=1.4)
    axes.set_xlim(-1.5 * swath_m, 1.5 * swath_m)
    axes.set_ylim(bottom=0.0)
    axes.set_title(f"Passes {swath_m:.2f} m apart, and their sum")
    axes.set_xlabel("right of the middle track [m]")
    axes.set_ylabel("% of one pass's peak")


@contextmanager
def _axes(path: Path) -> Iterator[Axes]:
    """Give axes to draw on, and write them to `path` at the end."""
    with _figure(path) as figure:
        yield figure.subplots()


@contextmanager
def _figure(path: Path, height_in: float = 4.2) -> Iterator[Figure]:
    """Give a figure to draw on, and write it to `path` at the end."""
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    if path.suffix.casefold() != ".png":
        raise TableError(f"{path}: a picture is a .png")
    with rc_context(STYLE):
        figure = Figure(figsize=(6.4, height_in), layout="constrained")
        FigureCanvasAgg(figure)
        yield figure
        with writing(f"{path}"):
            figure.savefig(path, dpi=DPI, facecolor="white", metadata={"Software": None})
