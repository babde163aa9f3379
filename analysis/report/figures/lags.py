"""Lag distances by the rate that a change leads to and by speed, as P1's Fig. 8."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from analysis.report.figures.style import BLUE, FAINT, GRID, INK, RED, Drawn, new_figure

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes

    from analysis.assess.breakdowns import Group
    from analysis.assess.intervals import Interval
    from analysis.evaluation import Evaluation
    from analysis.lag import Step

# More groups than these are not named one by one.
NAMED_MAX = 12
# More points than these make a large file and no finer picture.
POINTS_MAX = 300
SPREAD = 0.25
# An interval from fewer independent crossings says nothing but that there are few.
CLUSTERS_MIN = 3
# A good flight should look good: the axis reaches this far at least.
REACH_MIN_M = 0.1


def lag_distances(
    evaluation: Evaluation, by_rate: Sequence[Group], by_speed: Sequence[Group]
) -> Drawn | None:
    """Draw every lag distance and the mean of each group; None where none was measured."""
    steps = [
        step
        for step in evaluation.steps
        if step.lag_distance_m is not None and not step.change.border
    ]
    if not steps:
        return None
    figure = new_figure(4.0, margins_in=(0.85, 0.25, 0.75, 0.4))
    left, right = figure.subplots(
        1, 2, sharey=True, gridspec_kw={"width_ratios": [2, 1], "wspace": 0.05}
    )
    _panel(left, steps, by_rate, [step.change.after_l_ha for step in steps])
    left.set_xlabel("rate that the change leads to [L/ha]")
    left.set_ylabel("lag distance [m], + too late")
    _panel(right, steps, by_speed, [step.change.speed_m_s for step in steps])
    right.set_xlabel("speed [m/s]")
    reached_m = [abs(step.lag_distance_m or 0.0) for step in steps]
    for group in (*by_rate, *by_speed):
        reached_m += [abs(end) for end in _ends(group.lag_distance_m)]
    limit_m = max(1.15 * max(reached_m), REACH_MIN_M)
    left.set_ylim(-limit_m, limit_m)
    left.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, borderaxespad=0.0)
    return Drawn(
        name="lags",
        title="Lag distance by rate and by speed",
        caption="One point for each change of rate and valve inside the field; diamonds are means "
        "with their 95 % interval, from three crossings on. 0: the change lies on its boundary. "
        "Wang et al. 2024 drew such a figure (Fig. 8) of the settled distance, 3.87 m in the mean "
        "without compensation and 0.32 m with it, at 5 m/s.",
        alt="Two scatter charts of the distance from each boundary to where the flow changed, by "
        "the rate that the change leads to and by speed, with means and 95 % intervals.",
        kind="chart",
        figure=figure,
    )


def _panel(
    panel: Axes, steps: Sequence[Step], groups: Sequence[Group], values: Sequence[float]
) -> None:
    measured = [group for group in groups if group.lag_distance_m.mean is not None]
    place = np.zeros(len(steps))
    for number, group in enumerate(measured):
        assert group.low is not None and group.high is not None
        inside = np.array([group.low <= value <= group.high for value in values])
        place[inside] = number
    # Side by side in the order of flight, so that points do not hide each other; no chance in it.
    beside = (np.arange(len(steps)) * 0.618034) % 1.0 - 0.5
    lag_m = [step.lag_distance_m or 0.0 for step in steps]  # all are measured
    panel.axhline(0.0, color=INK, lw=1.0, zorder=1)
    panel.scatter(
        place + SPREAD * 2 * beside, lag_m, s=9, color=BLUE, alpha=0.45, lw=0, label="a change",
        rasterized=len(steps) > POINTS_MAX,
    )  # fmt: skip
    for number, group in enumerate(measured):
        mean = group.lag_distance_m
        assert mean.mean is not None
        ends = _ends(mean)
        panel.plot([number] * len(ends), ends, color=RED, lw=1.6, zorder=3)
        panel.plot(
            number, mean.mean, marker="D", ms=5, color=RED, mec="white", mew=0.7, ls="", zorder=4,
            label="mean, 95 %" if number == 0 else None,
        )  # fmt: skip
    every = max(1, -(-len(measured) // NAMED_MAX))
    shown = range(0, len(measured), every)
    panel.set_xticks([*shown], [_name(measured[number]) for number in shown])
    panel.set_xlim(-0.6, len(measured) - 0.4)
    panel.grid(axis="y", color=GRID, lw=0.7)
    panel.tick_params(axis="x", length=0, colors=INK)
    panel.spines["bottom"].set_color(FAINT)
    panel.set_axisbelow(True)


def _ends(mean: Interval) -> tuple[float, ...]:
    """Return the ends of an interval that is drawn; none for one that says nothing."""
    if mean.low is None or mean.high is None or mean.clusters < CLUSTERS_MIN:
        return ()
    return mean.low, mean.high


def _name(group: Group) -> str:
    assert group.low is not None and group.high is not None
    return f"{group.low:g}" if group.low == group.high else f"{group.low:g}\nto {group.high:g}"
