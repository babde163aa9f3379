"""The flow of a nozzle set between its weighed duties: the shape of it, by a flow meter.

A bucket test says what a set delivers at a few duties, and nothing of what lies between. The meter
says it up to a gain, which cancels against the weighed duties on both sides: so no dose comes from
the meter, and a weighed flow stays what it was to the last digit.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from analysis.calibration.identify import CONFIDENCE, METER_LAG_S, Meter
from analysis.calibration.steps import settle_s
from analysis.student import t_factor
from companion.core.nozzle import FlowCurve, allowed_duty
from companion.errors import VrsprayError
from companion.ground.work import PIECE_MAX_S, GroundKind, GroundTask, Phase
from companion.output.pwm import stagger

if TYPE_CHECKING:
    from analysis.calibration.steps import Floats, FlowRecord
    from companion.core.schedule import LagModel
    from companion.core.types import PwmLimits

# A duty is measured at every 5 %: the twin's curve is straight to 0.1 % over that.
SPACING = 0.05
# A duty of that grid this near to a weighed one would say nothing new.
NEAR = 0.02
# Steady flow of each duty in each pass. A pass goes up and the next one down again, so that what
# warms up meanwhile, or a tank that empties, comes to every duty alike.
STEADY_S = 2.0
PASSES = 2
# Passes that differ by more than this (1 sd of a duty) say nothing of a curve.
SCATTER_MAX = 0.03
# Valves that all spray leave a meter without a pulse for less than so many PWM periods.
SILENT_PERIODS = 3.0
# A weighed flow over the metered one differs from duty to duty by what bucket and meter err.
RATIO_SPREAD_MAX = 0.03


class CurveCourseError(VrsprayError):
    """A record that does not say how the flow runs between the weighed duties."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Weighed:
    """What a bucket test found of the valves of a set together."""

    valves: tuple[int, ...]
    duty: tuple[float, ...]
    flow_l_min: tuple[float, ...]

    @property
    def curve(self) -> FlowCurve:
        """Return what is flown without any shape: straight from point to point."""
        return FlowCurve(duty=self.duty, flow_l_min=self.flow_l_min)


@dataclass(frozen=True, slots=True, kw_only=True)
class CurveCourse:
    """The duties of one set, all its valves together as over the bucket, in pieces of work."""

    valves: tuple[int, ...]
    duties: tuple[float, ...]
    dwell_s: float
    period_s: float
    passes: int

    @property
    def seconds(self) -> float:
        """Return how long all pieces take together."""
        return self.passes * len(self.duties) * self.dwell_s

    def pieces(self) -> Iterator[tuple[float, ...]]:
        """Yield the duties of each piece of ground work, in their order: up, down, up again."""
        most = max(math.floor(PIECE_MAX_S / self.dwell_s), 1)
        count = math.ceil(len(self.duties) / most)
        each = math.ceil(len(self.duties) / count)
        for number in range(self.passes):
            order = self.duties if number % 2 == 0 else self.duties[::-1]
            yield from (order[at : at + each] for at in range(0, len(order), each))

    def task(self, duties: Sequence[float], count: int) -> GroundTask:
        """Return one piece for a sprayer of `count` valves.

        Each change comes to one valve after the other, as their pulses do in a catch and in flight:
        valves that all begin a period together have less pressure each, and drift apart for
        seconds.
        """
        turns = sorted(self.valves, key=lambda valve: stagger(valve, count))
        first, now, phases = stagger(turns[0], count), [0.0] * count, []
        for number, duty in enumerate(duties):
            for valve in turns:
                now[valve] = duty
                late_s = (stagger(valve, count) - first) * self.period_s
                phases.append(Phase(at_s=number * self.dwell_s + late_s, duty=tuple(now)))
        return GroundTask(
            kind=GroundKind.VALVES,
            phases=tuple(phases),
            seconds=len(duties) * self.dwell_s,
            is_whole=True,
        )


def curve_course(
    weighed: Weighed, pwm: PwmLimits, lag: LagModel, *, passes: int = PASSES
) -> CurveCourse:
    """Return the course for one set: its weighed duties, and every 5 % between them.

    Raises:
        CurveCourseError: where fewer than two weighed duties can be done, or flow settles too late.
    """
    can = [duty for duty in weighed.duty if duty > 0.0 and allowed_duty(duty, pwm) == duty]
    if len(can) < 2:
        raise CurveCourseError(
            f"{len(can)} weighed duties lie within pwm.duty_min to 1; two are needed"
        )
    grid = [SPACING * number for number in range(1, round(1.0 / SPACING))]
    between = [
        round(duty, 6)
        for duty in grid
        if can[0] < duty < can[-1] and min(abs(duty - each) for each in can) > NEAR
    ]
    periods = math.ceil(STEADY_S / pwm.period_s) + 1
    dwell_s = settle_s(lag) + periods * pwm.period_s
    if dwell_s > PIECE_MAX_S:
        raise CurveCourseError(
            f"lags of {lag.off_end_s:.2g} s leave no steady flow within {PIECE_MAX_S:g} s"
        )
    return CurveCourse(
        valves=weighed.valves,
        duties=tuple(sorted([*can, *between])),
        dwell_s=dwell_s,
        period_s=pwm.period_s,
        passes=passes + passes % 2,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class CurvePoint:
    """The flow at one duty with its 95 % interval; a weighed one is as it was weighed."""

    duty: float
    flow_l_min: float
    low: float
    high: float
    is_weighed: bool
    straight_l_min: float
    ratio: float | None = None  # weighed over metered


@dataclass(frozen=True, slots=True, kw_only=True)
class SetCurve:
    """The flow of a set in all its points, strictly rising."""

    valves: tuple[int, ...]
    points: tuple[CurvePoint, ...]
    left_out: tuple[float, ...]
    scatter: float
    volume_ml: float

    @property
    def curve(self) -> FlowCurve:
        """Return it as the controller takes it."""
        return FlowCurve(
            duty=tuple(point.duty for point in self.points),
            flow_l_min=tuple(point.flow_l_min for point in self.points),
        )

    @property
    def weighed_duty(self) -> tuple[float, ...]:
        """Return the duties that were weighed."""
        return tuple(point.duty for point in self.points if point.is_weighed)

    @property
    def ratio_spread(self) -> float:
        """Return how far weighed over metered differs between duties, over its mean."""
        ratios = [point.ratio for point in self.points if point.ratio is not None]
        return (max(ratios) - min(ratios)) * len(ratios) / sum(ratios)


def identify_curve(
    records: Sequence[FlowRecord], weighed: Weighed, *, meter_lag_s: float = METER_LAG_S
) -> SetCurve:
    """Return the curve of a set through its weighed points, from the pieces of one course.

    Weighed over metered flow is known at the weighed duties, and straight between two of them: a
    meter whose gain changes with the flow errs by less than it changes from one to the next.

    Raises:
        CurveCourseError: where the meter does not say it.
    """
    metered: dict[float, list[float]] = {}
    for record in records:
        for duty, ml_s in _steady_flows(record, weighed.valves[0], meter_lag_s):
            metered.setdefault(duty, []).append(0.06 * ml_s)
    anchors = [duty for duty in weighed.duty if duty in metered]
    if len(anchors) < 2:
        raise CurveCourseError(
            f"{len(anchors)} of the weighed duties are in the record; two are needed: was it made "
            "with this configuration?"
        )
    duties = sorted(metered)
    means, scatter, half = _means(duties, [metered[duty] for duty in duties])
    by_weight = dict(zip(weighed.duty, weighed.flow_l_min, strict=True))
    ratio = {duty: by_weight[duty] / means[duty] for duty in anchors}
    straight = weighed.curve
    points = [
        CurvePoint(
            duty=duty,
            flow_l_min=flow,
            low=flow,
            high=flow,
            is_weighed=True,
            straight_l_min=flow,
            ratio=ratio.get(duty),
        )
        for duty, flow in by_weight.items()
    ]
    for duty in duties:
        if duty in by_weight or not anchors[0] < duty < anchors[-1]:
            continue
        left = max(each for each in anchors if each < duty)
        right = min(each for each in anchors if each > duty)
        share = (duty - left) / (right - left)
        flow = means[duty] * ((1.0 - share) * ratio[left] + share * ratio[right])
        # The duty's own mean errs, and those of the weighed duties beside it.
        off = half * math.sqrt(1.0 + (1.0 - share) ** 2 + share**2)
        points.append(
            CurvePoint(
                duty=duty,
                flow_l_min=flow,
                low=flow * (1.0 - off),
                high=flow * (1.0 + off),
                is_weighed=False,
                straight_l_min=straight.flow_for(duty),
            )
        )
    kept, left_out = _rising(sorted(points, key=lambda point: point.duty))
    return SetCurve(
        valves=weighed.valves,
        points=tuple(kept),
        left_out=tuple(left_out),
        scatter=scatter,
        volume_ml=sum(float(each.volume_ml[-1] - each.volume_ml[0]) for each in records),
    )


def _steady_flows(
    record: FlowRecord, valve: int, meter_lag_s: float
) -> Iterator[tuple[float, float]]:
    """Yield duty and mean flow [mL/s] of every steady stretch, over whole PWM periods."""
    if len(record.time_s) < 2:
        raise CurveCourseError("the flow meter counted nothing; look at its line and at the pump")
    meter = Meter(record.time_s, record.volume_ml, lag_s=meter_lag_s, period_s=record.period_s)
    own = [order for order in record.orders if order.valve == valve]
    settle = settle_s(record.lag)
    for order, following in pairwise(own):
        if not order.after > 0.0:
            continue
        from_s = order.at_s + settle
        # To a period before the next order: where that closes all, no pulse comes after the last.
        periods = math.floor((following.at_s - from_s) / record.period_s + 0.2) - 1
        until_s = from_s + periods * record.period_s
        if periods < 1 or not _is_counted(record, from_s, until_s):
            raise CurveCourseError(
                f"at duty {order.after:g} the flow meter was silent or counted backwards"
            )
        first_ml, last_ml = meter.at(np.array([from_s, until_s])).tolist()
        if not last_ml > first_ml:
            raise CurveCourseError(f"at duty {order.after:g} the flow meter counted nothing")
        yield order.after, (last_ml - first_ml) / (until_s - from_s)


def _is_counted(record: FlowRecord, from_s: float, until_s: float) -> bool:
    """Return whether the meter counted upwards all the time; between two pulses it may rest."""
    first = int(np.searchsorted(record.time_s, from_s, side="right")) - 1
    last = int(np.searchsorted(record.time_s, until_s, side="left"))
    if first < 0 or last >= len(record.time_s):
        return False
    gaps_s = np.diff(record.time_s[first : last + 1])
    grows = bool(np.all(np.diff(record.volume_ml[first : last + 1]) >= 0.0))
    return grows and bool(np.all(gaps_s <= SILENT_PERIODS * record.period_s))


def _means(
    duties: Sequence[float], flows: Sequence[Sequence[float]]
) -> tuple[dict[float, float], float, float]:
    """Return the mean flow of each duty, the scatter of one pass, and a mean's 95 % half.

    Both as shares of the flow. What a whole pass has more than another is no scatter: it is common
    to all duties, and cancels.
    """
    passes = min(len(each) for each in flows)
    if passes < 2:
        raise CurveCourseError("an interval needs every duty twice; do the course again")
    logs: Floats = np.log(np.array([each[:passes] for each in flows]))
    of_duty = logs.mean(axis=1)
    errors = logs - of_duty[:, np.newaxis]
    errors = errors - errors.mean(axis=0)
    freedom = (len(duties) - 1) * (passes - 1)
    scatter = math.sqrt(float((errors**2).sum()) / freedom)
    if not scatter <= SCATTER_MAX:
        raise CurveCourseError(
            f"the same duty differs by {100.0 * scatter:.1f} % (1 sd) from pass to pass; look for "
            "air in the lines and for the pressure, then measure again"
        )
    half = t_factor(freedom, CONFIDENCE) * scatter / math.sqrt(passes)
    return dict(zip(duties, np.exp(of_duty).tolist(), strict=True)), scatter, half


def _rising(points: Sequence[CurvePoint]) -> tuple[list[CurvePoint], list[float]]:
    """Return the points with which the flow rises, the weighed ones always, and those left out."""
    kept: list[CurvePoint] = []
    left_out: list[float] = []
    for number, point in enumerate(points):
        weighed_l_min = next(
            (each.flow_l_min for each in points[number:] if each.is_weighed), math.inf
        )
        below = kept[-1].flow_l_min if kept else 0.0
        if point.is_weighed or below < point.flow_l_min < weighed_l_min:
            kept.append(point)
        else:
            left_out.append(point.duty)
    return kept, left_out
