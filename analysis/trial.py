"""A field trial, evaluated: what each plot got, by the journal, and what the treatments yield.

The plots come from the file that `vrspray make trial` writes. Only their inner parts count. Yields
are compared by the model of randomised blocks, yield = treatment + block + error; the mean of a
treatment is that over all blocks (least squares), so that a plot which is left out moves none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.affinity import translate

from analysis.assess.ground_elements import slices_of

if TYPE_CHECKING:
    from shapely.geometry.base import BaseGeometry

    from analysis.assess.ground_elements import Slices
    from analysis.strips import Strip

Floats = NDArray[np.float64]

# Strips are cut into slices of this length, each with one rate.
PIECE_M = 0.25
# The direction of motion is that of the way in so many seconds, to either side.
APART_S = 0.02
CORNERS = ((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0))
M2_PER_HA, ML_PER_L = 10_000.0, 1000.0
# Standard deviations to either side within which 95 % lie.
NORMAL_95 = 1.96


@dataclass(frozen=True, slots=True, kw_only=True)
class Plot:
    """One plot of the trial; `inner` is what counts of it, in metres east and north."""

    number: int
    block: int
    rate_l_ha: float
    inner: BaseGeometry


@dataclass(frozen=True, slots=True, kw_only=True)
class Achieved:
    """What a plot got.

    `rate_l_ha` is all that fell on its inner part, over its ground. `sd_l_ha` is how far pieces of
    single passes differ from each other. `covered_percent` is the ground under open valves; what
    was sprayed twice counts twice. `reasons` say why the plot failed; none where it did not.
    """

    plot: Plot
    rate_l_ha: float
    sd_l_ha: float | None
    covered_percent: float
    reasons: tuple[str, ...]

    @property
    def error_l_ha(self) -> float:
        """Return achieved less prescribed."""
        return self.rate_l_ha - self.plot.rate_l_ha


@dataclass(frozen=True, slots=True, kw_only=True)
class Tolerance:
    """What a plot must keep: its rate [% of it], and how much of its ground was passed."""

    rate_percent: float
    covered_percent: float


def achieved(
    plots: Sequence[Plot], strips: Sequence[Strip], tolerance: Tolerance
) -> list[Achieved]:
    """Return what every plot got under the strips of all valves, of one flight or several."""
    tree = shapely.STRtree(np.array([plot.inner for plot in plots], dtype=object))
    count = len(plots)
    area, litres, square = np.zeros(count), np.zeros(count), np.zeros(count)
    for strip in strips:
        slices = slices_of(strip, PIECE_M)
        ground = _ground(slices)
        which, owner = tree.query(ground, "intersects")
        shared = shapely.area(shapely.intersection(ground[which], tree.geometries[owner]))
        rate = slices.given_ml[which] / ML_PER_L / slices.area_m2[which] * M2_PER_HA
        area += np.bincount(owner, weights=shared * (rate > 0.0), minlength=count)
        litres += np.bincount(owner, weights=shared * rate / M2_PER_HA, minlength=count)
        square += np.bincount(owner, weights=shared * rate**2, minlength=count)
    found = []
    for plot, m2, total, squares in zip(
        plots, area.tolist(), litres.tolist(), square.tolist(), strict=True
    ):
        covered = 100.0 * m2 / plot.inner.area
        rate_l_ha = total / plot.inner.area * M2_PER_HA
        sd = None
        if m2 > 0.0:
            mean = total / m2 * M2_PER_HA
            sd = float(np.sqrt(max(squares / m2 - mean**2, 0.0)))
        found.append(
            Achieved(
                plot=plot, rate_l_ha=rate_l_ha, sd_l_ha=sd, covered_percent=covered,
                reasons=_reasons(plot, rate_l_ha, covered, tolerance),
            )
        )  # fmt: skip
    return found


@dataclass(frozen=True, slots=True, kw_only=True)
class Errors:
    """How far the record may be off, one standard deviation each.

    Of the position and of the time of a change, which moves it along the pass, and of the meter or
    the flow curve, which is one factor for all plots.
    """

    position_m: float
    lag_s: float
    speed_m_s: float
    meter_percent: float


def half_intervals(
    found: Sequence[Achieved], strips: Sequence[Strip], errors: Errors
) -> list[float]:
    """Return half the 95 % interval of what each plot got [L/ha].

    The plot is moved under the strips by one standard deviation each way: what that changes, and
    the meter's share of the rate, add up as squares.
    """
    moved_m = float(np.hypot(errors.position_m, errors.speed_m_s * errors.lag_s))
    loose = Tolerance(rate_percent=100.0, covered_percent=0.0)
    squares = [(errors.meter_percent / 100.0 * one.rate_l_ha) ** 2 for one in found]
    for east_m, north_m in ((moved_m, 0.0), (0.0, moved_m)):
        changes = np.zeros(len(found))
        for sign in (-1.0, 1.0):
            plots = [
                replace(one.plot, inner=translate(one.plot.inner, sign * east_m, sign * north_m))
                for one in found
            ]
            there = achieved(plots, strips, loose)
            change = [abs(a.rate_l_ha - b.rate_l_ha) for a, b in zip(there, found, strict=True)]
            changes = np.maximum(changes, change)
        squares = [square + change**2 for square, change in zip(squares, changes, strict=True)]
    return [NORMAL_95 * float(np.sqrt(square)) for square in squares]


def _ground(slices: Slices) -> NDArray[np.object_]:
    """Return the ground of each slice: as wide as the strip, and as long as its area says."""
    track, time_s = slices.track, slices.time_s
    heading = track.at(track.heading_rad, time_s)
    right = np.column_stack([np.cos(heading), -np.sin(heading)]) * track.width_m / 2.0
    before, after = (
        np.column_stack([track.at(track.east_m, at), track.at(track.north_m, at)])
        for at in (time_s - APART_S, time_s + APART_S)
    )
    way = after - before
    length_m = np.hypot(way[:, 0], way[:, 1])
    way /= np.maximum(length_m, 1e-9)[:, None]
    across_m = 2.0 * np.abs(right[:, 0] * way[:, 1] - right[:, 1] * way[:, 0])
    ahead = way * (slices.area_m2 / np.maximum(across_m, 1e-3) / 2.0)[:, None]
    middle = 0.5 * (before + after)
    corners = [middle + side * right + end * ahead for side, end in CORNERS]
    return np.asarray(shapely.polygons(np.stack(corners, axis=1)), dtype=object)


def _reasons(plot: Plot, rate_l_ha: float, covered: float, tolerance: Tolerance) -> tuple[str, ...]:
    found = []
    if plot.rate_l_ha > 0.0 and covered < tolerance.covered_percent:
        found.append(f"only {covered:.0f} % of it was sprayed")
    if plot.rate_l_ha > 0.0 and covered > 200.0 - tolerance.covered_percent:
        found.append(f"sprayed {covered / 100.0:.2f} times")
    # Nothing prescribed: whatever falls there is wrong, measured by a litre a hectare.
    allowed = tolerance.rate_percent / 100.0 * max(plot.rate_l_ha, 1.0)
    if not abs(rate_l_ha - plot.rate_l_ha) <= allowed:
        found.append(f"got {rate_l_ha:.2f} instead of {plot.rate_l_ha:g} L/ha")
    return tuple(found)


# Yields.


def plot_means(
    plots: Sequence[Plot], points_m: Floats, values: Floats
) -> list[tuple[int, float | None]]:
    """Return for every plot how many harvest points its inner part has, and their mean."""
    inner = np.array([plot.inner for plot in plots], dtype=object)
    which, owner = shapely.STRtree(inner).query(shapely.points(points_m), "within")
    count = np.bincount(owner, minlength=len(plots))
    sums = np.bincount(owner, weights=values[which], minlength=len(plots))
    return [
        (number, total / number if number else None)
        for number, total in zip(count.tolist(), sums.tolist(), strict=True)
    ]


def treatment_means(
    treatment: Sequence[float], block: Sequence[int], value: Sequence[float], check: float | None
) -> dict[str, Any] | None:
    """Return means with 95 % intervals by treatment; None where too few plots are left.

    With a `check` each other treatment's difference from it has its interval, too. `p_value` is
    that of the F test for any difference between treatments.
    """
    from statsmodels.regression.linear_model import OLS

    rates, blocks = sorted(set(treatment)), sorted(set(block))
    rows, terms = len(value), len(rates) + len(blocks) - 1
    if len(rates) < 2 or len(blocks) < 2 or rows <= terms:
        return None
    design = np.zeros((rows, terms))
    design[np.arange(rows), [rates.index(one) for one in treatment]] = 1.0
    for row, one in enumerate(block):
        if blocks.index(one):
            design[row, len(rates) + blocks.index(one) - 1] = 1.0
    if np.linalg.matrix_rank(design) < terms:
        return None
    fit = OLS(np.asarray(value, dtype=np.float64), design).fit()

    def contrasts(weights: Floats) -> list[dict[str, float]]:
        test = fit.t_test(weights)
        return [
            {"value": float(middle), "low": float(low), "high": float(high)}
            for middle, (low, high) in zip(
                np.atleast_1d(test.effect), np.atleast_2d(test.conf_int(alpha=0.05)), strict=True
            )
        ]

    means = np.zeros((len(rates), terms))
    means[:, : len(rates)] = np.eye(len(rates))
    means[:, len(rates) :] = 1.0 / len(blocks)
    steps = np.zeros((len(rates) - 1, terms))
    steps[:, 0], steps[:, 1 : len(rates)] = -1.0, np.eye(len(rates) - 1)
    found: dict[str, Any] = {
        "treatments": [
            {"rate_l_ha": rate, "plots": list(treatment).count(rate), **one}
            for rate, one in zip(rates, contrasts(means), strict=True)
        ],
        "p_value": float(np.squeeze(fit.f_test(steps).pvalue)),
        "residual_sd": float(np.sqrt(fit.scale)),
        "degrees_of_freedom": int(fit.df_resid),
        "against_check": None,
    }
    if check is not None and check in rates:
        others = [at for at, rate in enumerate(rates) if rate != check]
        against = np.zeros((len(others), terms))
        against[:, rates.index(check)] = -1.0
        against[np.arange(len(others)), others] = 1.0
        found["against_check"] = [
            {"rate_l_ha": rates[at], **one}
            for at, one in zip(others, contrasts(against), strict=True)
        ]
    return found
