"""From rates along the path to timed changes of duty: each ahead of its crossing by its own lag.

A change of rate is ordered at crossing - lag(kind) - output delay, so that the volume-equivalent
step lies on the crossing. At the border the rule is stricter: off is complete before the strip's
first contact with the outside, on begins after its last, and no other order holds between the two
(`shut_spans`). The schedule keeps no state of its own:
it is computed anew in every step from a path that begins a little in the past, so that a change
already ordered is found again and not ordered twice.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

from companion.core.boom import Valve
from companion.core.crossings import Crossing, Route, rate_at
from companion.core.types import Method, PwmLimits, TimedChange

Reference = Literal["volume", "settled"]

# Duties nearer than this are the same order: 2 us of a servo pulse, a fifth of a percent of flow;
# finer trims only follow the noise of the speed (measured: they change no figure of a flight).
DUTY_STEP = 0.002
# Beyond this share a change of duty at once is a late change of zone and not a trim for speed.
TRIM_MAX_SHARE = 0.08
# Where no crossing lies behind, only the speed can have changed: up to this share is a trim.
SPEED_MAX_SHARE = 0.25
# A trim moves by at most this at once: below the 2 % of the span at which a driver board takes a
# change for a new zone and restarts its period. What is more follows one servo frame later, so
# that no frame holds both; 40 such steps a second follow braking by 2.5 m/s2.
TRIM_STEP_MAX = 0.018
TRIM_AGAIN_S = 0.025
# No trim this shortly before a change of zone: on a servo output it would hold the change up by a
# frame, and it would act for a fraction of a period only.
TRIM_HOLD_S = 0.03
# How far ahead of its time a change that was already ordered is left alone when the prediction
# moves it back: without this, noise would revert it for a moment and order it again.
STICKY_S = 0.1
# How near its duty is to be for that: where the curve is flat, 1 % of speed is 3 % of duty, and a
# large change of zone would be taken back for a moment. So a part of the step counts too.
NEAR_SHARE, NEAR_STEP_SHARE = 0.03, 0.3
# At the border this long, as a way: what the buffer leaves, or what a position is known to.
STICKY_BORDER_M = 0.02
# A period is up to 2 % shorter on its way back to its phase, and half as long if another change
# follows within two and a half: then nothing is counted on.
FIRST_GAP_SHARE, ALONE_PERIODS = 0.98, 2.5


@dataclass(frozen=True, slots=True, kw_only=True)
class LagModel:
    """Identified lags, seconds from the order at the output (accuracy: volume-equivalent).

    `up_time_s` and `down_time_s` are the part of `up_s` and `down_s` that is the time constant of
    a flow that follows as an exponential (a pump's): with them its changes are driven.
    `on_s`, `off_s`, `up_s`, `down_s` are volume-equivalent; `on_start_s` is order to first flow
    and `off_end_s` order to less than 2 % of it (the two ends that the border rule needs);
    `output_s` is the delay of the output path; `position_s` how old the position is when the
    autopilot sends it.
    """

    on_s: float
    off_s: float
    up_s: float
    down_s: float
    on_start_s: float
    off_end_s: float
    output_s: float
    position_s: float = 0.0
    reference: Reference = "volume"
    up_time_s: float = 0.0
    down_time_s: float = 0.0

    def __post_init__(self) -> None:
        for name in ("on_s", "off_s", "up_s", "down_s", "on_start_s", "off_end_s", "output_s"):
            value = getattr(self, name)
            if not 0.0 <= value <= 30.0:
                raise ValueError(f"{name} must lie in [0, 30] s, got {value}")
        if not -0.5 <= self.position_s <= 0.5:
            raise ValueError(f"position_s must lie in [-0.5, 0.5] s, got {self.position_s}")
        for name, time_s, whole_s in (
            ("up_time_s", self.up_time_s, self.up_s),
            ("down_time_s", self.down_time_s, self.down_s),
        ):
            if not 0.0 <= time_s <= whole_s:
                raise ValueError(f"{name} is a part of a lag of {whole_s} s, got {time_s}")
        if not self.on_start_s <= self.on_s:
            raise ValueError("on_start_s (first flow) cannot be later than on_s")
        if not self.off_end_s >= self.off_s:
            raise ValueError("off_end_s (last flow) cannot be earlier than off_s")

    def of_valve(self, valve: Valve) -> LagModel:
        """Return the lags of one valve, whose own differ from its set's.

        The two ends of the flow move to the safe side only: nobody measured them of one valve.
        """
        if not any(valve.lags_s):
            return self
        on_s = max(self.on_s + valve.lag_on_s, 0.0)
        off_s = max(self.off_s + valve.lag_off_s, 0.0)
        return replace(
            self,
            on_s=on_s,
            off_s=off_s,
            up_s=max(self.up_s + valve.lag_up_s, self.up_time_s),
            down_s=max(self.down_s + valve.lag_down_s, self.down_time_s),
            on_start_s=min(max(self.on_start_s + min(valve.lag_on_s, 0.0), 0.0), on_s),
            off_end_s=max(self.off_end_s + max(valve.lag_off_s, 0.0), off_s),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Timing:
    """How far ahead of its crossing each kind of change is ordered, all delays together."""

    on_s: float
    off_s: float
    up_s: float
    down_s: float
    border_on_s: float
    border_off_s: float
    dwell_min_s: float
    centred: PwmLimits | None = None
    rest_max_s: float = 0.0

    @classmethod
    def of(
        cls,
        method: Method,
        lag: LagModel,
        *,
        look_ahead_s: float,
        period_s: float,
        centred: PwmLimits | None = None,
    ) -> Timing:
        """Return the leads of a method: none, P1's one look-ahead time, or the identified lags.

        `centred` are the limits of an output that opens a valve with a new period and the pulse in
        its middle: at the border such a pulse is ordered half its off-time sooner, but not so soon
        that the volume-equivalent step would lie outside.

        P1 (Wang et al. 2024) looks S = V (T1 + T2 + T3) ahead for every change: at the speed V
        that is the one lead T1 + T2 + T3.
        """
        dwell_s = max(lag.off_end_s - lag.on_start_s, period_s)
        if method is not Method.SCHEDULED:
            lead = look_ahead_s if method is Method.LOOK_AHEAD else 0.0
            return cls(
                on_s=lead, off_s=lead, up_s=lead, down_s=lead,
                border_on_s=lead, border_off_s=lead, dwell_min_s=0.0,
            )  # fmt: skip
        rise_s = fall_s = 0.0
        if lag.reference == "settled":  # P1 puts the end of the change on the boundary
            rise_s, fall_s = lag.on_s - lag.on_start_s, lag.off_end_s - lag.off_s
        return cls(
            on_s=lag.on_s + rise_s + lag.output_s,
            off_s=lag.off_s + fall_s + lag.output_s,
            up_s=lag.up_s + rise_s + lag.output_s,
            down_s=lag.down_s + fall_s + lag.output_s,
            border_on_s=lag.on_start_s + lag.output_s,
            border_off_s=lag.off_end_s + lag.output_s,
            dwell_min_s=dwell_s,
            centred=centred,
            rest_max_s=lag.on_s - lag.on_start_s,
        )

    @property
    def leads_s(self) -> tuple[float, ...]:
        """Return all leads, that of an opening at the border at its longest."""
        opens_s = self.border_on_s + self.rest_s(0.0)
        return self.on_s, self.off_s, self.up_s, self.down_s, self.border_off_s, opens_s

    def rest_s(self, duty: float) -> float:
        """Return by how much sooner a valve may open at the border, at rest before its first pulse.

        On-times below the shortest become that; above the last duty a pulse begins its period.
        """
        pwm = self.centred
        if pwm is None or duty > min(pwm.duty_max, 1.0 - pwm.min_off_s / pwm.period_s):
            return 0.0
        on_s = max(duty * pwm.period_s, pwm.min_on_s)
        return min(FIRST_GAP_SHARE * 0.5 * (pwm.period_s - on_s), self.rest_max_s)

    @property
    def alone_s(self) -> float:
        """Return how long after it nothing may be ordered for that to hold."""
        return 0.0 if self.centred is None else ALONE_PERIODS * self.centred.period_s

    def lead_s(self, before: float, after: float) -> float:
        """Return the lead of a change from one duty to another inside the field."""
        if after <= 0.0:
            return self.off_s
        if before <= 0.0:
            return self.on_s
        return self.up_s if after > before else self.down_s


# (rate_l_ha, speed_m_s) -> duty of the valve in question
Dosing = Callable[[float, float], float]


class Order(NamedTuple):
    """A change of one valve with the moment at which it is due.

    `driven` is one past its target, `bound` one that the border allows no sooner.
    """

    at_s: float
    duty: float
    rate_l_ha: float | None
    driven: bool = False
    bound: bool = False


class ValveSchedule(NamedTuple):
    """What one valve does from now on; `changes` begin with what is due at once, if anything."""

    changes: tuple[TimedChange, ...]
    late: bool
    unresolved_count: int
    rate_now_l_ha: float | None

    def of(self, valve: int) -> ValveSchedule:
        """Return the same for another valve."""
        changes, late, unresolved_count, rate = self
        if not changes:
            return self
        of_valve = tuple([each.of_valve(valve) for each in changes])
        return ValveSchedule(of_valve, late, unresolved_count, rate)


def resolve(route: Route, dwell_min_s: float) -> tuple[Route, int]:
    """Return the route without zones too short for the lag, and how many were given up.

    A stay shorter than a change takes is not chased: the neighbouring rate that misapplies least
    is held through it. Closed ground is never given up: where no spray may fall stays closed, and
    an opening too short to be used is not made. Several short stays in a row may be one that is
    still too short, hence the repetition; each round that drops one has fewer crossings.
    """
    if len(route) == 2 and route[1].rate_l_ha != route[0].rate_l_ha:
        return route, 0  # nothing follows: no stay is short
    given_up = 0
    while True:
        route, dropped = _resolve_once(route, dwell_min_s)
        given_up += dropped
        if not dropped:
            return route, given_up


def _resolve_once(route: Route, dwell_min_s: float) -> tuple[Route, int]:
    kept: list[Crossing] = list(route[:1])
    dropped = 0
    i = 1
    while i < len(route):
        crossing = route[i]
        following = route[i + 1] if i + 1 < len(route) else None
        stay_s = math.inf if following is None else following.at_s - crossing.at_s
        before = kept[-1].rate_l_ha
        if (
            following is None
            or stay_s >= dwell_min_s
            or crossing.rate_l_ha is None
            or not dwell_min_s > 0.0
        ):
            if not crossing.is_as(kept[-1]):
                kept.append(crossing)
            i += 1
            continue
        dropped += 1
        after = following.rate_l_ha
        if after is None:
            merged = None
        elif before is None:
            merged = after  # open for what follows, rather than open twice
        else:
            rate = crossing.rate_l_ha
            merged = before if abs(rate - before) <= abs(rate - after) else after
        # where nothing is left it closes here: the way to the closed ground is too short
        crossing = crossing._replace(rate_l_ha=merged)
        if not crossing.is_as(kept[-1]):
            kept.append(crossing)
        i += 1
    return tuple(kept), dropped


def orders(
    route: Route, timing: Timing, dosing: Dosing, overdrive: Overdrive | None = None
) -> list[Order]:
    """Return the orders of one valve along its route, in order of time.

    The first has no time: it held before the path began. An order that would be due before the
    one ahead of it takes its place: the plant could not follow both. But none opens a valve sooner
    than what it opens for, or keeps one open over closed ground; and the border has the last word.
    """
    made = _by_kind(route, timing, dosing, overdrive)
    spans = shut_spans(route, timing)
    for number, (begin_s, end_s) in enumerate(spans):
        made = _shut_between(made, begin_s, end_s)
        if timing.centred is not None and made[-1].at_s >= end_s:
            shut_s = spans[number + 1][0] if number + 1 < len(spans) else math.inf
            made = _opened_sooner(made, begin_s, end_s, shut_s, timing)
    return made


def _by_kind(
    route: Route, timing: Timing, dosing: Dosing, overdrive: Overdrive | None
) -> list[Order]:
    """Return the orders as they would be inside a field, each ahead by the lag of its kind."""
    first = route[0]
    duty = 0.0 if first.rate_l_ha is None else dosing(first.rate_l_ha, first.speed_m_s)
    made = [Order(-math.inf, duty, first.rate_l_ha)]
    for crossing in route[1:]:
        rate = crossing.rate_l_ha
        duty = 0.0 if rate is None else dosing(rate, crossing.speed_m_s)
        at_s = crossing.at_s - timing.lead_s(made[-1].duty, duty)
        drive = None if overdrive is None else overdrive.between(made[-1].duty, duty)
        if drive is not None:
            at_s += drive.saved_s
        while len(made) > 1 and (made[-1].at_s >= at_s or made[-1].driven):
            if duty > 0.0 and (made[-1].duty > 0.0) != (made[-2].duty > 0.0):
                # What opens or closes here stays: this one comes with it, or once it has closed.
                at_s, drive = made[-1].at_s, None
                if made[-1].duty > 0.0:
                    made.pop()
                else:
                    at_s += timing.dwell_min_s
                break
            made.pop()
        if drive is not None:
            made.append(Order(at_s, drive.duty, rate, driven=True))
            at_s += drive.for_s
        made.append(Order(at_s, duty, rate))
    return made


def shut_spans(route: Route, timing: Timing) -> list[tuple[float, float]]:
    """Return from when until when the border has a valve ordered shut, in order of time.

    The last flow ends before the first contact with the outside and the first one begins after
    the last contact; a closing is given the time to be one, however narrow the ground is. One span
    may reach into the next, which begins later and ends later.
    """
    found: list[tuple[float, float]] = []
    since_s: float | None = None
    for crossing in route:
        if crossing.outside and since_s is None:
            since_s = crossing.at_s - timing.border_off_s if crossing is not route[0] else -math.inf
        elif not crossing.outside and since_s is not None:
            end_s = max(crossing.at_s - timing.border_on_s, since_s + timing.dwell_min_s)
            found.append((since_s, end_s))
            since_s = None
    if since_s is not None:
        found.append((since_s, math.inf))
    return found


def _shut_between(made: list[Order], begin_s: float, end_s: float) -> list[Order]:
    """Return the orders with nothing but closed between two times, and what then holds after it."""
    held = [order for order in made if order.at_s < begin_s]
    held.append(Order(begin_s, 0.0, None))
    if end_s == math.inf:
        return held
    following = len(made)
    while made[following - 1].at_s > end_s:
        following -= 1
    if made[following - 1].driven:  # a valve that opens is not driven
        following += 1
    stands = made[following - 1]
    if stands.rate_l_ha is not None:
        held.append(Order(end_s, stands.duty, stands.rate_l_ha, bound=True))
    return held + made[following:]


def _opened_sooner(
    made: list[Order], begin_s: float, end_s: float, shut_s: float, timing: Timing
) -> list[Order]:
    """Return the orders with the opening at `end_s` sooner by the rest before its first pulse.

    Where nothing else is ordered soon after it; `shut_s` is when the border next closes the valve.
    """
    number = next(i for i, order in enumerate(made) if order.at_s >= end_s)
    order = made[number]
    next_s = made[number + 1].at_s if number + 1 < len(made) else math.inf
    if not order.bound or min(next_s, shut_s) - end_s < timing.alone_s:
        return made
    at_s = max(end_s - timing.rest_s(order.duty), begin_s + timing.dwell_min_s)
    return [*made[:number], order._replace(at_s=at_s), *made[number + 1 :]]


def schedule(
    route: Route,
    *,
    valve: int,
    timing: Timing,
    dosing: Dosing,
    in_force: float,
    speed_soon_m_s: float,
    now_s: float,
    until_s: float,
    overdrive: Overdrive | None = None,
    sticky_border_s: float = 0.0,
) -> ValveSchedule:
    """Return the changes of one valve from `now_s` until the lease ends.

    `in_force` is the duty that the last plan has brought about by now, `speed_soon_m_s` the
    footprint's speed when a trim ordered now would act. What opened at the border stays open when
    it turns out to be due up to `sticky_border_s` later.
    """
    if len(route) == 1:
        return in_zone(route[0].rate_l_ha, valve, dosing, in_force, speed_soon_m_s, now_s)
    resolved, unresolved = resolve(route, timing.dwell_min_s)
    made = orders(resolved, timing, dosing, overdrive)
    due = 0
    while due + 1 < len(made) and made[due + 1].at_s <= now_s:
        due += 1
    if due + 1 < len(made) and _already_ordered(
        made[due], made[due + 1], in_force, now_s, sticky_border_s
    ):
        due += 1
    rate = made[due].rate_l_ha
    duty = 0.0 if rate is None else dosing(rate, speed_soon_m_s)
    if made[due].driven:
        duty = made[due].duty
    changes = []
    late = False
    if abs(duty - in_force) >= DUTY_STEP or (duty == 0.0) != (in_force == 0.0):
        share = TRIM_MAX_SHARE if due > 0 else SPEED_MAX_SHARE
        restart = not 0.0 < abs(duty - in_force) <= share * in_force or duty == 0.0
        late = restart and due > 0
        if restart:
            changes.append(TimedChange(at_s=now_s, valve=valve, duty=duty))
        else:
            next_s = made[due + 1].at_s if due + 1 < len(made) else math.inf
            changes.extend(_trims(valve, in_force, duty, now_s, next_s - TRIM_HOLD_S))
    for order in made[due + 1 :]:
        if order.at_s < until_s:
            changes.append(TimedChange(at_s=order.at_s, valve=valve, duty=order.duty))
    return ValveSchedule(tuple(changes), late, unresolved, rate_at(route, now_s))


def _trims(
    valve: int, in_force: float, duty: float, now_s: float, until_s: float
) -> list[TimedChange]:
    """Return one or two small moves towards a duty, none later than `until_s`."""
    changes = []
    for at_s in (now_s, now_s + TRIM_AGAIN_S):
        moved = min(max(duty, in_force - TRIM_STEP_MAX), in_force + TRIM_STEP_MAX)
        if at_s > until_s or moved == in_force:
            break
        changes.append(TimedChange(at_s=at_s, valve=valve, duty=moved, restart=False))
        in_force = moved
    return changes


def in_zone(
    rate_l_ha: float | None,
    valve: int,
    dosing: Dosing,
    in_force: float,
    speed_m_s: float,
    now_s: float,
    *,
    has_entered: bool = False,
) -> ValveSchedule:
    """Return what a valve does in the middle of a zone: a trim for the speed, or nothing.

    Where it `has_entered` just now, more than a trim is its change of zone, and late.
    """
    duty = 0.0 if rate_l_ha is None else dosing(rate_l_ha, speed_m_s)
    moves = abs(duty - in_force)
    if moves < DUTY_STEP and (duty == 0.0) == (in_force == 0.0):
        return ValveSchedule((), False, 0, rate_l_ha)
    share = TRIM_MAX_SHARE if has_entered else SPEED_MAX_SHARE
    if not 0.0 < moves <= share * in_force or duty == 0.0:
        change = TimedChange(at_s=now_s, valve=valve, duty=duty)
        return ValveSchedule((change,), has_entered, 0, rate_l_ha)
    trims = _trims(valve, in_force, duty, now_s, math.inf)
    return ValveSchedule(tuple(trims), False, 0, rate_l_ha)


def has_passed(route: Route, now_s: float) -> bool:
    """Return whether all that a route of one crossing has to say is the zone behind it.

    Its change was due before the crossing, whatever the lag. What the border bounds may be later.
    """
    if len(route) != 2:
        return False
    (_, before, was_outside, _), (at_s, rate, outside, _) = route
    return at_s <= now_s and rate != before and not (was_outside or outside)


def sticky_border_s(border_buffer_m: float, speed_m_s: float) -> float:
    """Return for how long ahead of its time an opening at the border is left alone.

    >>> sticky_border_s(0.1, 5.0), sticky_border_s(0.0, 5.0)
    (0.02, 0.004)
    """
    return max(border_buffer_m, STICKY_BORDER_M) / max(speed_m_s, 0.1)


def _already_ordered(
    now: Order, following: Order, in_force: float, now_s: float, sticky_border_s: float
) -> bool:
    """Whether the next order stands already and is only a moment ahead of its time.

    Of two that ask for the same, one behind and one ahead of what lies between them, it is the
    nearer one that stands: a short closing that is only just due is not skipped.
    """
    most_s = min(STICKY_S, sticky_border_s) if following.bound else STICKY_S
    if not following.at_s - now_s < min(most_s, now_s - now.at_s):
        return False
    to_next = abs(following.duty - in_force)
    near = NEAR_SHARE * max(following.duty, in_force)
    if min(now.duty, following.duty, in_force) > 0.0:
        near = max(near, NEAR_STEP_SHARE * abs(following.duty - now.duty))
    return to_next <= near and to_next < abs(now.duty - in_force)


# A slow flow is driven past its target for a moment, so that it stands there sooner.
#
# A flow that follows its order as an exponential needs four time constants to stand. Ordered as far
# as the pump goes, it reaches the target after `time ln((u - a) / (u - b))`; ordered to the target
# then, it stays. All flows in L/min, from `a` to `b`, driven by `u`.

# A drive that is over sooner than this is none: the order's own jitter would be as large.
DRIVE_MIN_S = 0.03
# Not quite as far as the pump goes: what an ageing pump no longer reaches would come late.
DRIVE_SHARE = 0.9


class Drive(NamedTuple):
    """Order `duty` for `for_s`; the volume-equivalent step comes sooner by `saved_s`."""

    duty: float
    for_s: float
    saved_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Overdrive:
    """The flow's time constants, 0 where it is not slow, and how far the duty may go."""

    up_time_s: float
    down_time_s: float
    duty_min: float
    duty_max: float
    flow_for: Callable[[float], float]

    def between(self, before: float, after: float) -> Drive | None:
        """Return how to go from one duty to another; None for an order as it is.

        >>> law = Overdrive(up_time_s=1.0, down_time_s=1.0, duty_min=0.0, duty_max=1.0,
        ...                 flow_for=lambda duty: 10.0 * duty)
        >>> drive = law.between(0.4, 0.5)
        >>> round(drive.duty, 3), round(drive.for_s, 3), round(drive.saved_s, 3)
        (0.95, 0.201, 0.903)
        """
        time_s = self.up_time_s if after > before else self.down_time_s
        if not (time_s > 0.0 and before > 0.0 and after > 0.0):
            return None
        end = self.duty_max if after > before else self.duty_min
        duty = after + DRIVE_SHARE * (end - after)
        a, b, u = self.flow_for(before), self.flow_for(after), self.flow_for(duty)
        if not ((u - b) * (b - a) > 0.0):
            return None
        for_s = time_s * math.log((u - a) / (u - b))
        if not for_s >= DRIVE_MIN_S:
            return None
        return Drive(duty, for_s, (u - b) * for_s / (b - a))
