"""A slow correction of the flow by a meter: what the table says does the work, this only trims.

The trim of a nozzle set is the sprayer's gain: the metered flow over what the measured table says
of the duties in force. A wanted flow is divided by it before the table is asked for a duty; no
edge of a valve is ever moved. The table's flow is taken through the sprayer's own lag before the
two are compared (Smith's predictor: Chem. Eng. Progress 53, 1957), so an order whose flow is still
on its way is no error, and no dead time can make the loop swing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from companion.core.options.flow_meter import (
    ML_S_PER_L_MIN,
    STALE_S,
    Flows,
    Ordered,
    Sample,
    flows_over,
    is_usable,
    with_count,
    with_order,
)
from companion.core.schedule import LagModel
from companion.core.types import FlowReport, FlowTrimState, PwmLimits

# Flows are compared over whole PWM periods of about this time: the pulses cancel in them, and 4.6
# pulses a millilitre over a second tell 4 L/min to 0.3 %.
WINDOW_S = 1.0
# A flow that leaves the one of a second ago by more than this is a clog, a burst hose or a broken
# meter, not the slow drift that a trim is for. One of six valves shut costs 14.6 % of the flow on
# the twin of wang-2024, not 16.7 %, since the pressure rises: 15 % would miss it.
SUDDEN_SHARE = 0.10
# Further from the table than this it is a fault of the sprayer and not its gain.
PLAUSIBLE_SHARE = 0.25
AT_LIMIT_S = 10.0


@dataclass(frozen=True, slots=True, kw_only=True)
class FlowTrim:
    """How fast and how far the trim may go, and when the meter can be believed."""

    tau_s: float = 5.0
    limit: float = 0.15
    meter_minimum_l_min: float = 0.5
    settle_s: float = 2.0

    def __post_init__(self) -> None:
        if not 1.0 <= self.tau_s <= 600.0:
            raise ValueError(f"tau_s must lie in [1, 600] s, got {self.tau_s}")
        if not 0.0 < self.limit <= PLAUSIBLE_SHARE:
            raise ValueError(f"limit must lie in (0, {PLAUSIBLE_SHARE}], got {self.limit}")
        if not 0.0 <= self.meter_minimum_l_min <= 1e4:
            raise ValueError(
                f"meter_minimum_l_min must lie in [0, 1e4], got {self.meter_minimum_l_min}"
            )
        if not 0.0 <= self.settle_s <= 60.0:
            raise ValueError(f"settle_s must lie in [0, 60] s, got {self.settle_s}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Trimming:
    """The law with the times that it takes on a sprayer.

    `delay_s` lies between an order and its flow, `clear_s` after a change the flow is steady, and
    `wait_s` after it the trim may move. Flows are compared over `window_s`; gains are kept
    `apart_s` from each other to tell a sudden change by.
    """

    settings: FlowTrim
    delay_s: float
    clear_s: float
    wait_s: float
    window_s: float
    apart_s: float

    @classmethod
    def of(cls, settings: FlowTrim, lag: LagModel, pwm: PwmLimits) -> Trimming:
        """Return the times for a sprayer's lags.

        A small change waits half a period on average. Three volume-equivalent lags are what a
        first-order response needs to 95 %; dead time and ramp are over sooner.
        """
        window_s = max(round(WINDOW_S / pwm.period_s), 1) * pwm.period_s
        longest_s = max(lag.on_s, lag.off_s, lag.up_s, lag.down_s)
        clear_s = max(3.0 * longest_s, lag.off_end_s) + lag.output_s + pwm.period_s
        return cls(
            settings=settings,
            delay_s=0.5 * (lag.up_s + lag.down_s) + lag.output_s + 0.5 * pwm.period_s,
            clear_s=clear_s,
            wait_s=max(settings.settle_s, clear_s + window_s),
            window_s=window_s,
            apart_s=max(window_s, WINDOW_S),
        )


class Seen(NamedTuple):
    """Metered over expected flow, and the trim at that time."""

    at_s: float
    gain: float
    trim: float


class SetTrim(NamedTuple):
    """The trim of one nozzle set; `held` is the gain that has to come back before it moves."""

    trim: float = 1.0
    seen: tuple[Seen, ...] = ()
    held: float | None = None
    at_limit_s: float = 0.0


class TrimMemory(NamedTuple):
    """What is known of the flow from one step to the next; `set_index` is the set in use."""

    sets: tuple[SetTrim, ...]
    set_index: int = 0
    state: FlowTrimState = FlowTrimState.NO_METER
    changed_s: float = -math.inf
    report: FlowReport | None = None
    samples: tuple[Sample, ...] = ()
    ordered: tuple[Ordered, ...] = ()


def begin(set_count: int) -> TrimMemory:
    """Return what a flight begins with: every trim is 1."""
    return TrimMemory(sets=(SetTrim(),) * set_count)


def pause(memory: TrimMemory, report: FlowReport | None, *, now_s: float) -> TrimMemory:
    """Return the memory while nothing is sprayed: the trims stay, the evidence goes."""
    state = FlowTrimState.FROZEN if is_usable(report, None, now_s) else FlowTrimState.NO_METER
    return memory._replace(
        changed_s=now_s,
        report=report,
        samples=(),
        ordered=(),
        state=_standing(memory.sets[memory.set_index]) or state,
    )


def _paused(memory: TrimMemory) -> FlowTrimState:
    return _standing(memory.sets[memory.set_index]) or FlowTrimState.FROZEN


def ordered(
    trimming: Trimming, memory: TrimMemory, *, flow_l_min: float, index: int, now_s: float
) -> TrimMemory:
    """Return the memory with the table's flow of the duties in force from `now_s` on."""
    keep_s = trimming.delay_s + STALE_S
    past = with_order(memory.ordered, flow_l_min=flow_l_min, now_s=now_s, keep_s=keep_s)
    if index == memory.set_index:
        if past is memory.ordered:
            return memory
        return TrimMemory(
            memory.sets, index, memory.state, memory.changed_s,
            memory.report, memory.samples, past,
        )  # fmt: skip
    return memory._replace(
        ordered=past, set_index=index, changed_s=now_s, samples=(), state=FlowTrimState.FROZEN
    )


def follow(
    trimming: Trimming,
    memory: TrimMemory,
    report: FlowReport | None,
    *,
    is_steady: bool,
    is_saturated: bool,
    now_s: float,
) -> TrimMemory:
    """Return the memory after the meter's newest count; the trim moves only where it may.

    `is_steady` says that all valves of the set spray and none changed its zone since the last
    step, `is_saturated` that a duty stands at an end of its range.
    """
    last = memory.report
    if not is_usable(report, last, now_s):
        state = _standing(memory.sets[memory.set_index]) or FlowTrimState.NO_METER
        return memory._replace(
            report=report if report is not None and math.isfinite(report.volume_ml) else None,
            changed_s=memory.changed_s if is_steady else now_s,
            samples=(),
            state=state,
        )
    assert report is not None  # is_usable
    if not is_steady:
        return memory._replace(report=report, changed_s=now_s, samples=(), state=_paused(memory))
    if last is not None and report.received_s == last.received_s:
        return memory
    dt_s = 0.0 if last is None else report.received_s - last.received_s
    samples: tuple[Sample, ...] = ()
    if report.received_s - memory.changed_s >= trimming.clear_s:
        samples = with_count(
            memory.samples, report, memory.ordered,
            delay_s=trimming.delay_s, window_s=trimming.window_s,
        )  # fmt: skip
    before = memory.sets[memory.set_index]
    after, state = before, FlowTrimState.FROZEN
    flows = flows_over(samples, trimming.window_s)
    if flows is not None and now_s - memory.changed_s >= trimming.wait_s:
        after, state = _moved(trimming, before, flows, at_s=report.received_s, dt_s=dt_s)
        if is_saturated and state is FlowTrimState.TRACKING:
            after, state = before._replace(seen=after.seen), FlowTrimState.FROZEN
    limit = trimming.settings.limit
    at_limit_s = after.at_limit_s + dt_s if not abs(after.trim - 1.0) < limit - 1e-9 else 0.0
    if at_limit_s != after.at_limit_s:
        after = after._replace(at_limit_s=at_limit_s)
    sets = memory.sets
    if after is not before:
        sets = (*sets[: memory.set_index], after, *sets[memory.set_index + 1 :])
    # Twenty times a second: spelt out, it takes a third of the time of `_replace`.
    return TrimMemory(
        sets, memory.set_index, _standing(after) or state, memory.changed_s,
        report, samples, memory.ordered,
    )  # fmt: skip


def _moved(
    trimming: Trimming, before: SetTrim, flows: Flows, *, at_s: float, dt_s: float
) -> tuple[SetTrim, FlowTrimState]:
    """Return the trim a step nearer to the gain, or held where the gain is no drift."""
    settings = trimming.settings
    minimum_ml_s = settings.meter_minimum_l_min * ML_S_PER_L_MIN
    if not (flows.expected_ml_s >= minimum_ml_s and flows.expected_ml_s > 0.0):
        return before, FlowTrimState.FROZEN
    gain = flows.metered_ml_s / flows.expected_ml_s
    held = _held(before, gain)
    if held is not None:
        state = FlowTrimState.FROZEN if held.held is None else FlowTrimState.SUDDEN_CHANGE
        return held, state
    if not abs(gain - 1.0) <= PLAUSIBLE_SHARE:
        return before, FlowTrimState.IMPLAUSIBLE
    if not flows.metered_ml_s >= minimum_ml_s:
        return before, FlowTrimState.FROZEN
    trim = before.trim + (gain - before.trim) * -math.expm1(-dt_s / settings.tau_s)
    if not abs(trim - 1.0) <= settings.limit:
        trim = 1.0 + math.copysign(settings.limit, trim - 1.0)
    seen = before.seen
    if not seen or not at_s - seen[-1].at_s < trimming.apart_s:
        seen = (*seen[-1:], Seen(at_s, gain, trim))
    return SetTrim(trim, seen, None, before.at_limit_s), FlowTrimState.TRACKING


def _held(before: SetTrim, gain: float) -> SetTrim | None:
    """Return the trim held because of a sudden change, or let go again; None if there is none.

    The gain is compared with that of a second ago at least, or the last one before a freeze; what
    the trim followed meanwhile is taken back.
    """
    if before.held is not None:
        is_back = abs(gain / before.held - 1.0) <= 0.5 * SUDDEN_SHARE
        return before._replace(held=None, seen=()) if is_back else before
    if not before.seen or abs(gain / before.seen[0].gain - 1.0) <= SUDDEN_SHARE:
        return None
    return before._replace(trim=before.seen[0].trim, held=before.seen[0].gain)


def _standing(trim: SetTrim) -> FlowTrimState | None:
    """Return what has to be said of a trim whether it may move or not."""
    if trim.held is not None:
        return FlowTrimState.SUDDEN_CHANGE
    return FlowTrimState.AT_LIMIT if trim.at_limit_s > AT_LIMIT_S else None
