"""From a bucket test to the flow curve of a nozzle set.

What was caught at each duty is averaged; where the scatter of repeated catches justifies it, a
smoother curve stands for the means. Where flow still does not rise with duty,
neighbours are pooled (isotonic regression), so that the curve is one that the controller takes; at
its ends it goes no further than the duty that was measured.
The same holds for a pump on a motor's output, with the width of its pulse in place of the duty.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from statistics import fmean
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from analysis.student import f_above, t_factor
from companion.core.nozzle import FlowCurve

# What a catch was ordered by: a duty, or the width of a motor's pulse; and how it is said.

# Between duties farther apart than this the curve is a guess.
GAP_MAX = 0.25
# The widest servo pulse: pulse widths are handled as shares of it, so that one fit serves both.
PULSE_FULL_US = 2500.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Scale:
    """What a catch was ordered by, in words: `full` is what stands for 1, `limit` a setting."""

    name: str
    plural: str
    unit: str
    full: float
    gap_max: float
    limit: str

    def say(self, duty: float) -> str:
        """Return a value as it was typed.

        >>> PULSE.say(0.6), DUTY.say(0.6)
        ('1500 us', '0.6')
        """
        return f"{self.full * duty:.6g}{self.unit}"


DUTY = Scale(name="duty", plural="duties", unit="", full=1.0, gap_max=GAP_MAX, limit="pwm.duty_max")
# A motor's range is some 1000 us wide: the same share of it as of the duty.
PULSE = Scale(
    name="pulse", plural="pulses", unit=" us", full=PULSE_FULL_US, gap_max=250.0 / PULSE_FULL_US,
    limit="pump.max_us",
)  # fmt: skip


# Whether the scatter of a bucket test justifies a smoother curve than its means, and which.
#
# Catches repeated at one duty say how far a catch scatters (pure error, relative to its flow). A
# candidate curve is admitted where the F-test of its lack of fit against that scatter does not
# speak against it; of those admitted and the means themselves the one with the least expected
# error is taken (Mallows 1973: C_p). Candidates are a straight line and natural cubic smoothing
# splines (Green and Silverman 1994), all by weighted least squares, all strictly rising. The
# controller goes straight between their values at the measured duties.

Floats = NDArray[np.float64]

# A curve is only believed to be smoother than its means where a test as sharp as this one sees no
# difference. At the usual 5 % a bend twice as large as the scatter passes for none, and the
# smoothed curve is farther from the truth than the means are.
ADMIT_P = 0.25
# Repeats beyond the first at each duty: with fewer the scatter itself is hardly known.
SPARE_MIN = 4
# Below this relative scatter catches are not measurements but figures worked out.
SCATTER_MIN = 1e-9
# From nearly straight to nearly the means, as multiples of the mean weight.
STIFFNESS = tuple(10.0 ** (0.25 * k) for k in range(20, -25, -1))


@dataclass(frozen=True, slots=True, kw_only=True)
class Repeats:
    """The catches at one duty: mean flow, their weight, and squared relative deviations."""

    duty: float
    flow_l_min: float
    count: int
    weight: float
    squares: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Fit:
    """What kind of curve was taken, and the test that it passed.

    `freedom` is how many free numbers the curve has: 2 for a line, as many as points for the
    means. F, its degrees of freedom and p are those of the curve's lack of fit, `line_p` that of
    the straight line; None where they are not known: for the means, without enough repeats.
    """

    kind: Literal["line", "smooth", "points"]
    freedom: float
    f: float | None = None
    f_freedom: tuple[float, float] | None = None
    p: float | None = None
    line_p: float | None = None

    def as_json(self, count: int) -> dict[str, object]:
        """Return it with the test's name and limit; `count` is how many points there are."""
        return {
            "kind": self.kind,
            "words": self.words(count),
            "free_numbers": self.freedom,
            "test": "F, lack of fit against the scatter of repeats",
            "f": self.f,
            "f_degrees_of_freedom": None if self.f_freedom is None else list(self.f_freedom),
            "p": self.p,
            "p_needed": ADMIT_P,
            "p_of_a_straight_line": self.line_p,
        }

    def words(self, count: int) -> str:
        """Say what was taken and why; `count` is how many points there are."""
        if self.f is not None and self.f_freedom is not None and self.p is not None:
            fit = (
                f"lack of fit F = {self.f:.2f} on {self.f_freedom[0]:.3g} and "
                f"{self.f_freedom[1]:.3g} degrees of freedom, p = {self.p:.2f}"
            )
            if self.kind == "line":
                return f"a straight line; {fit}"
            line = "" if self.line_p is None else f"; a straight line has p = {self.line_p:.2g}"
            return f"smoothed to {self.freedom:.1f} free numbers of {count}; {fit}{line}"
        if self.line_p is None:
            return f"the means; without {SPARE_MIN} repeats nothing tells scatter from bends"
        return (
            "the means; they scatter too little for a smoother curve "
            f"(a straight line has p = {self.line_p:.2g})"
        )


def scatter_squared(points: Sequence[Repeats]) -> tuple[float | None, int]:
    """Return the relative variance of a catch by what was repeated, and how many repeats say so."""
    spare = sum(point.count - 1 for point in points)
    if spare < SPARE_MIN:
        return None, spare
    variance = sum(point.squares for point in points) / spare
    return (variance, spare) if variance > SCATTER_MIN**2 else (None, spare)


def fit_means(points: Sequence[Repeats]) -> tuple[Fit, list[float]]:
    """Return the curve at the duties of `points`, in their order; of the means it need not rise.

    Raises:
        ValueError: where the flow does not rise by more than its catches scatter.
    """
    means = [point.flow_l_min for point in points]
    variance, spare = scatter_squared(points)
    if variance is None or len(points) < 3:
        return Fit(kind="points", freedom=float(len(points))), means
    law = _Smoother(points)
    law.check_rise(variance, spare)
    best: tuple[float, Fit, Floats] | None = None
    line_p = None
    for kind, hat in law.candidates():
        flows, misfit = law.apply(hat)
        freedom = float(np.trace(hat))
        f, f_freedom, p = _lack_of_fit(hat, misfit, variance, spare)
        line_p = p if kind == "line" else line_p
        rises = flows[0] > 0.0 and bool(np.all(np.diff(flows) > 0.0))
        expected = misfit + 2.0 * variance * freedom
        if p >= ADMIT_P and rises and (best is None or expected < best[0]):
            fit = Fit(kind=kind, freedom=freedom, f=f, f_freedom=f_freedom, p=p, line_p=line_p)
            best = (expected, fit, flows)
    if best is None or (law.rises and 2.0 * variance * len(points) <= best[0]):
        return Fit(kind="points", freedom=float(len(points)), line_p=line_p), means
    return best[1], best[2].tolist()


class _Smoother:
    """Weighted least squares through the means, from a straight line to nearly themselves."""

    def __init__(self, points: Sequence[Repeats]) -> None:
        self._duty = np.array([point.duty for point in points])
        self._flow = np.array([point.flow_l_min for point in points])
        # The deviation of a catch grows with its flow.
        self._root = np.sqrt([point.weight for point in points]) / self._flow

    @property
    def rises(self) -> bool:
        """Whether the means alone are a curve."""
        return bool(np.all(np.diff(self._flow) > 0.0))

    def check_rise(self, variance: float, spare: int) -> None:
        """Refuse flows in which no rise can be seen.

        Raises:
            ValueError: where the slope is within its 95 % interval of 0.
        """
        columns = self._columns()
        spread = np.linalg.inv(columns.T @ columns)
        _, slope = spread @ columns.T @ (self._root * self._flow)
        if not slope > t_factor(spare) * np.sqrt(variance * spread[1, 1]):
            raise ValueError(
                "the flow does not rise by more than the catches scatter "
                f"({100.0 * np.sqrt(variance):.1f} %, 1 sd)"
            )

    def candidates(self) -> Iterator[tuple[Literal["line", "smooth"], Floats]]:
        """Yield what turns weighted means into weighted fits, the stiffest first."""
        columns = self._columns()
        yield "line", columns @ np.linalg.pinv(columns)
        bend = self._bend() / self._root[:, None] / self._root[None, :]
        count = len(self._duty)
        for stiffness in STIFFNESS:
            yield "smooth", np.linalg.inv(np.eye(count) + stiffness * count / np.trace(bend) * bend)

    def apply(self, hat: Floats) -> tuple[Floats, float]:
        """Return the flows of a candidate and its weighted sum of squares."""
        seen = self._root * self._flow
        fitted = hat @ seen
        return fitted / self._root, float(np.sum((seen - fitted) ** 2))

    def _columns(self) -> Floats:
        columns: Floats = self._root[:, None] * np.c_[np.ones_like(self._duty), self._duty]
        return columns

    def _bend(self) -> Floats:
        """Return the matrix whose form is the integral of the second derivative squared."""
        step = np.diff(self._duty)
        count = len(self._duty)
        second = np.zeros((count, count - 2))
        band = np.zeros((count - 2, count - 2))
        for j in range(count - 2):
            a, b = 1.0 / step[j], 1.0 / step[j + 1]
            second[j : j + 3, j] = (a, -a - b, b)
            band[j, j] = (step[j] + step[j + 1]) / 3.0
            if j + 1 < count - 2:
                band[j, j + 1] = band[j + 1, j] = step[j + 1] / 6.0
        bend: Floats = second @ np.linalg.solve(band, second.T)
        return bend


def _lack_of_fit(
    hat: Floats, misfit: float, variance: float, spare: int
) -> tuple[float, tuple[float, float], float]:
    """Return F, its degrees of freedom and p of a linear smoother (Cleveland and Devlin 1988)."""
    left = np.eye(len(hat)) - hat
    form = left @ left.T
    first, second = float(np.trace(form)), float(np.trace(form @ form))
    if not second > 0.0:
        return 0.0, (0.0, float(spare)), 1.0
    f = misfit / first / variance
    freedom = (first * first / second, float(spare))
    return f, freedom, f_above(f, *freedom)


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
    have no inverse. That of the largest duties stands at the first of them: more duty brings no
    more. That of the least stands at the last: below it nothing is ordered.
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
    blocks[0] = (blocks[0][4], *blocks[0][1:])
    blocks[-1] = (blocks[-1][3], *blocks[-1][1:])
    pooled = [
        f"the flow does not rise from {scale.name} {scale.say(low)} to {scale.say(high)}: taken "
        f"together as {flow:.3f} L/min at {scale.full * duty:.4g}{scale.unit}; measure again"
        + (f", or set {scale.limit} to {scale.say(low)}" if high == duties[-1] else "")
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
