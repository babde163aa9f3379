"""From a bucket test to the flow curve of a nozzle set.

What was caught at each duty is averaged; where the scatter of repeated catches justifies it, a
smoother curve stands for the means (`bucket_fit`). Where flow still does not rise with duty,
neighbours are pooled (isotonic regression), so that the curve is one that the controller takes.
The same holds for a pump on a motor's output, with the width of its pulse in place of the duty.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from statistics import fmean

from analysis.bucket_fit import Fit, Repeats, fit_means, scatter_squared
from analysis.bucket_scale import DUTY, Scale
from companion.core.nozzle import FlowCurve

DUTIES_MIN = 5
# Spread of repeated catches, and what a curve may be off where it was not measured.
SPREAD_MAX = 0.05
LEFT_OUT_MAX = 0.05
# A hand on a stopwatch and a bucket is off by 0.3 s: 1.5 % of this.
SECONDS_MIN = 20.0
# A flow that falls by more than this with more duty, and by more than so many deviations of the
# difference where these are known, is no scatter: the rows are mixed up, or the sprayer changed.
FALL_MAX = 0.10
FALL_DEVIATIONS = 3.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Catch:
    """What came out of all nozzles of a set in a time, at one duty."""

    duty: float
    seconds: float
    millilitres: float
    line: int = 0

    @property
    def flow_l_min(self) -> float:
        """Return the mean flow."""
        return 0.06 * self.millilitres / self.seconds


@dataclass(frozen=True, slots=True, kw_only=True)
class DutyMean:
    """All catches at one duty; spread is largest less least, over the mean.

    `curve_l_min` is what the curve has there. `cv_percent` is the deviation over the mean,
    `left_out_percent` how far the curve of the other duties is from the curve here; None where
    there is only one catch, at the ends.
    """

    duty: float
    flow_l_min: float
    curve_l_min: float
    count: int
    seconds: float
    cv_percent: float | None
    spread_percent: float | None
    left_out_percent: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Residual:
    """A catch against the curve."""

    catch: Catch
    residual_l_min: float
    residual_percent: float


@dataclass(frozen=True, slots=True, kw_only=True)
class BucketCurve:
    """The curve of one set; `repeatability_percent` is the deviation of one catch, pooled."""

    name: str
    fit: Fit
    duty: tuple[float, ...]
    flow_l_min: tuple[float, ...]
    means: tuple[DutyMean, ...]
    residuals: tuple[Residual, ...]
    repeatability_percent: float | None
    warnings: tuple[str, ...]

    @property
    def flow_curve(self) -> FlowCurve:
        """Return the curve as the controller has it."""
        return FlowCurve(duty=self.duty, flow_l_min=self.flow_l_min)


def fit_bucket(
    catches: Sequence[Catch],
    *,
    window: tuple[float, float],
    name: str = "",
    scale: Scale = DUTY,
) -> BucketCurve:
    """Return the curve of one set; `window` is the least and the largest duty of the PWM.

    Raises:
        ValueError: with fewer than two duties at which more came with more duty, where more duty
            gave clearly less flow, or no more than the catches scatter.
    """
    duties = sorted({catch.duty for catch in catches})
    groups = [[catch for catch in catches if catch.duty == duty] for duty in duties]
    points = _repeats(groups)
    _check_falls(points, scale)
    fit, flows = fit_means(points)
    duty, flow, pooled = _monotone(duties, flows, [len(group) for group in groups], scale)
    if len(duty) < 2:
        raise ValueError(f"at least two {scale.plural} are needed at which the flow rises")
    curve = FlowCurve(duty=tuple(duty), flow_l_min=tuple(flow))
    left_out = [_left_out_percent(duty, flow, value) for value in duties]
    means = tuple(
        _duty_mean(group, curve.flow_for(value), off)
        for value, group, off in zip(duties, groups, left_out, strict=True)
    )
    residuals = tuple(_residual(catch, curve) for catch in catches)
    return BucketCurve(
        name=name,
        fit=fit,
        duty=curve.duty,
        flow_l_min=curve.flow_l_min,
        means=means,
        residuals=residuals,
        repeatability_percent=_repeatability(means),
        warnings=(*pooled, *_doubts(means, window, scale), *_short(catches)),
    )


def _mean_flow(group: Sequence[Catch]) -> float:
    """Return all that was caught over all the time it took."""
    seconds = sum(catch.seconds for catch in group)
    return 0.06 * sum(catch.millilitres for catch in group) / seconds


def _repeats(groups: Sequence[Sequence[Catch]]) -> list[Repeats]:
    """Return what a fit needs of each duty; a catch counts by its time."""
    mean_s = fmean(catch.seconds for group in groups for catch in group)
    found = []
    for group in groups:
        mean = _mean_flow(group)
        found.append(
            Repeats(
                duty=group[0].duty,
                flow_l_min=mean,
                count=len(group),
                weight=sum(catch.seconds for catch in group) / mean_s,
                squares=sum(
                    catch.seconds / mean_s * (catch.flow_l_min / mean - 1.0) ** 2 for catch in group
                ),
            )
        )
    return found


def _check_falls(points: Sequence[Repeats], scale: Scale) -> None:
    """Refuse means that no rising curve can follow.

    Raises:
        ValueError: where the flow falls by more than scatter explains.
    """
    variance, _ = scatter_squared(points)
    for i, high in enumerate(points):
        for low in points[i + 1 :]:
            fall = 1.0 - low.flow_l_min / high.flow_l_min
            deviation = math.sqrt((variance or 0.0) * (1.0 / high.weight + 1.0 / low.weight))
            if fall > FALL_MAX and fall > FALL_DEVIATIONS * deviation:
                raise ValueError(
                    f"the flow falls from {high.flow_l_min:.3f} L/min at {scale.name} "
                    f"{scale.say(high.duty)} to {low.flow_l_min:.3f} at {scale.say(low.duty)}; no "
                    "curve can follow that: are rows mixed up? measure these again"
                )


def _monotone(
    duties: Sequence[float], flows: Sequence[float], counts: Sequence[int], scale: Scale
) -> tuple[list[float], list[float], list[str]]:
    """Return the points with neighbours pooled until flow rises, and what was pooled.

    Pool adjacent violators; a pooled block becomes one point, because equal flows at two duties
    have no inverse.
    """
    blocks: list[tuple[float, float, int, float, float]] = []
    for duty, flow, count in zip(duties, flows, counts, strict=True):
        block = (duty, flow, count, duty, duty)
        while blocks and not block[1] > blocks[-1][1]:
            before = blocks.pop()
            total = before[2] + block[2]
            block = (
                (before[0] * before[2] + block[0] * block[2]) / total,
                (before[1] * before[2] + block[1] * block[2]) / total,
                total,
                before[3],
                block[4],
            )
        blocks.append(block)
    pooled = [
        f"the flow does not rise from {scale.name} {scale.say(low)} to {scale.say(high)}: taken "
        f"together as {flow:.3f} L/min at {scale.full * duty:.4g}{scale.unit}; measure again"
        for duty, flow, _, low, high in blocks
        if high > low
    ]
    return [block[0] for block in blocks], [block[1] for block in blocks], pooled


def _left_out_percent(duty: Sequence[float], flow: Sequence[float], value: float) -> float | None:
    """Return how far the curve without an inner point is from it."""
    if len(duty) < 4 or value not in duty[1:-1]:
        return None
    index = list(duty).index(value)
    others = FlowCurve(
        duty=tuple(duty[:index]) + tuple(duty[index + 1 :]),
        flow_l_min=tuple(flow[:index]) + tuple(flow[index + 1 :]),
    )
    return 100.0 * (others.flow_for(value) / flow[index] - 1.0)


def _duty_mean(group: Sequence[Catch], curve_l_min: float, left_out: float | None) -> DutyMean:
    flows = [catch.flow_l_min for catch in group]
    mean = fmean(flows)
    cv = spread = None
    if len(flows) > 1:
        cv = 100.0 * math.sqrt(sum((f - mean) ** 2 for f in flows) / (len(flows) - 1)) / mean
        spread = 100.0 * (max(flows) - min(flows)) / mean
    return DutyMean(
        duty=group[0].duty,
        flow_l_min=_mean_flow(group),
        curve_l_min=curve_l_min,
        count=len(group),
        seconds=sum(catch.seconds for catch in group),
        cv_percent=cv,
        spread_percent=spread,
        left_out_percent=left_out,
    )


def _residual(catch: Catch, curve: FlowCurve) -> Residual:
    expected = curve.flow_for(catch.duty)
    off = catch.flow_l_min - expected
    return Residual(
        catch=catch, residual_l_min=off, residual_percent=100.0 * off / max(expected, 1e-9)
    )


def _repeatability(means: Sequence[DutyMean]) -> float | None:
    """Return the deviation of a single catch: root of the mean square by degrees of freedom."""
    repeated = [mean for mean in means if mean.cv_percent is not None]
    if not repeated:
        return None
    spare = sum(mean.count - 1 for mean in repeated)
    square = sum((mean.count - 1) * (mean.cv_percent or 0.0) ** 2 for mean in repeated)
    return math.sqrt(square / spare)


def _doubts(means: Sequence[DutyMean], window: tuple[float, float], scale: Scale) -> list[str]:
    doubts = []
    if len(means) < DUTIES_MIN:
        doubts.append(
            f"{len(means)} {scale.plural} are few for a curve; measure at {DUTIES_MIN} or more"
        )
    outside = [
        mean.duty for mean in means if not window[0] <= mean.duty <= window[1] and mean.duty < 1.0
    ]
    if outside:
        doubts.append(
            f"duty {', '.join(f'{duty:g}' for duty in outside)} is outside the PWM's window of "
            f"{window[0]:g} to {window[1]:g}: the controller does not use it"
        )
    doubts += [
        f"the catches at {scale.name} {scale.say(mean.duty)} spread by "
        f"{mean.spread_percent:.1f} %; measure again"
        for mean in means
        if mean.spread_percent is not None and mean.spread_percent > 100.0 * SPREAD_MAX
    ]
    single = [mean.duty for mean in means if mean.count == 1]
    if single:
        doubts.append(
            f"measured once at {scale.name} {', '.join(map(scale.say, single))}: twice shows "
            "mistakes"
        )
    doubts += [
        f"no catch between {scale.name} {scale.say(a.duty)} and {scale.say(b.duty)}"
        for a, b in pairwise(means)
        if b.duty - a.duty > scale.gap_max + 1e-9
    ]
    rough = [(abs(mean.left_out_percent), mean.duty) for mean in means if mean.left_out_percent]
    if rough and max(rough)[0] > 100.0 * LEFT_OUT_MAX:
        off, duty = max(rough)
        doubts.append(
            f"the curve is uneven: without {scale.name} {scale.say(duty)} it is {off:.1f} % off "
            f"there; measure again, or more {scale.plural} beside it"
        )
    return doubts


def _short(catches: Sequence[Catch]) -> list[str]:
    short = [catch.line for catch in catches if not catch.seconds >= SECONDS_MIN]
    if not short:
        return []
    return [
        f"{len(short)} catches of less than {SECONDS_MIN:g} s: 0.3 s of the hand are more than "
        f"{30.0 / SECONDS_MIN:.1f} %"
    ]
