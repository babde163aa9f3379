"""When a position was sent, on our clock: by TIMESYNC where it is answered, else by the arrivals.

The autopilot's clock runs at a rate of its own: a simulation's may be slow by a percent. So both
the arrivals of positions and the exchanges of TIMESYNC are fitted by a straight line, offset and
rate, that forgets what is old. The arrivals have the mean delay of the way in them (5 ms and more
at 57 600 baud); the exchanges have not. The difference is kept as `delay_s`, so that a TIMESYNC
that falls silent leaves the last known delay and makes no jump, and one that comes back moves the
time slowly.

An exchange is wrong by half of its round trip at most. One that is further than that from what
the ones before it foretell shows a clock that was set, and so do positions that come before they
can have been sent. Until the clock is known again `is_doubtful` says so, and nothing is sprayed.

An autopilot that was held up, as a simulation is on a busy computer, answers now and then by a
clock that is catching up, or goes on some tens of milliseconds behind. Such an exchange, off by up
to 0.1 s, is a stray: it is not used, and closes nothing at once. Three in a row that agree with
each other become the new clock, if the positions can have come by it. `is_doubtful` at the second
that agrees and is off by more than 0.05 s, and after 1.5 s in which no exchange agreed with the
line; above 0.1 s at once.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

from companion.core.positions import BOOT_WRAP_S, ROUND_TRIP_MAX_S
from companion.core.types import ClockReport, Telemetry

# Arrivals later than this against the mean are late messages; the mean is not moved by more. One
# that much earlier says that the mean rests on late ones: it begins anew.
CLOCK_STEP_S = 0.02
CLOCK_RESET_S = 1.0
# Answers come five times a second, or once; after so long without one the arrivals alone count.
REPORT_AGE_MAX_S = 5.0
# A position takes no longer on its way than a question and its answer, and what the autopilot
# and the routers make it wait. More on average says that the two clocks disagree.
WAIT_MAX_S = 0.1
# No position arrives before it was sent; the autopilot's time has whole milliseconds.
EARLY_MAX_S = 0.005
# An exchange that is off by no more than this is a stray; by more, the clock was set.
HELD_UP_MAX_S = 0.1
# By less than this strays close nothing for a while: 0.25 m at 5 m/s, if they were right.
STRAY_S = 0.05
# No longer than this: seven exchanges, or two where they come once a second.
STRAYS_MAX_S = 1.5
# How fast the time may be moved while spraying, in seconds a second: at 5 m/s 2.5 cm in a second
# and 2.5 mm between two positions at 10 Hz.
SLEW = 0.005

# How fast the lines forget: a fit over so many seconds.
ARRIVALS_FADE_S = 10.0
EXCHANGES_FADE_S = 6.0
# Where round trips differ, good ones are rare: then longer, in seconds for each second too long.
FADE_BY_ROUND_TRIP = 300.0
# What is expected of a rate before it was seen: real crystals are a thousand times better, and
# simulations on a busy computer as bad as this.
RATE_SD = 0.005
# How well the arrivals tell the rate of the exchanges, whose way may slow down and recover.
RATE_BY_ARRIVALS_SD = 0.003
# More than this is not a clock's rate. Nothing is sprayed by such a clock.
RATE_MAX = 0.03
# Jitter of arrivals and exchanges at their best.
ARRIVAL_SD_S = 0.002
EXCHANGE_SD_S = 0.0005
# How uneven the two ways of the quickest exchange may be, as a share of its round trip.
UNEVEN = 0.25
# A late message tells no more than this of the jitter; one that is early by more than so many
# times the jitter is no jitter.
JITTER_MAX_S = 0.25
JITTERS_MAX = 4.0
# What two exchanges may be apart besides their round trips: jitter, and a rate that wanders.
EXCHANGE_STEP_S = 0.003
WANDER = 0.003
# So many exchanges have to agree before a clock that was set is believed.
AGREE_COUNT = 3
# All positions of so long were late, by so much: the clock was set back, or the way has changed.
LATE_DOUBT_S = 0.05
LATE_FOR_S = 0.2
# Where nobody answers TIMESYNC, arrivals that begin anew, or stay late, are believed after this.
SETTLE_S = 1.5
# A clock that begins anew within so many arrivals, so often in turn, runs like none.
RESTART_COUNT = 5
RESTARTS_MAX = 3
LATE_SETTLE_S = 5.0


class Line(NamedTuple):
    """A straight line through offsets over our time, fitted by weight, the old ones fading."""

    at_s: float
    weight: float
    mean_at_s: float
    mean_offset_s: float
    spread: float  # weighted sum of squared times
    joint: float  # the same of times and offsets

    def rate(self, expected: float, expected_sd: float) -> float:
        """Return its slope, drawn towards what was expected as long as it is hardly known."""
        trust = expected_sd**-2
        return (self.joint + trust * expected) / (self.spread + trust)

    def at(self, now_s: float, rate: float) -> float:
        """Return the offset at `now_s`, by a slope."""
        return self.mean_offset_s + rate * (now_s - self.mean_at_s)

    def moved(self, by_s: float) -> Line:
        """Return the line with all its offsets moved."""
        return self._replace(mean_offset_s=self.mean_offset_s + by_s)


def _begun(at_s: float, offset_s: float, sd_s: float) -> Line:
    return Line(at_s, sd_s**-2, at_s, offset_s, 0.0, 0.0)


def _longer(line: Line, at_s: float, offset_s: float, sd_s: float, fade_s: float) -> Line:
    """Return the line with one more point."""
    kept = math.exp(-max(at_s - line.at_s, 0.0) / fade_s)
    old, new = line.weight * kept, sd_s**-2
    share = new / (old + new)
    by_s, by_offset_s = at_s - line.mean_at_s, offset_s - line.mean_offset_s
    return Line(
        at_s=at_s,
        weight=old + new,
        mean_at_s=line.mean_at_s + share * by_s,
        mean_offset_s=line.mean_offset_s + share * by_offset_s,
        spread=line.spread * kept + old * share * by_s * by_s,
        joint=line.joint * kept + old * share * by_s * by_offset_s,
    )


class Strays(NamedTuple):
    """Exchanges in turn that do not go with the clock, but with each other."""

    line: Line
    agreeing: int
    off_s: float  # how far the newest is off what is known
    least_s: float = math.inf  # arrival less the autopilot's time, the least since the first

    @property
    def is_doubtful(self) -> bool:
        """Whether they are too far off to be let pass."""
        return self.agreeing > 1 and abs(self.off_s) > STRAY_S


class Clock(NamedTuple):
    """Mean of arrival time minus the autopilot's time, and how much of it is the way here.

    `received_s` and `boot_s` are both times of the newest arrival, when `offset_s` holds; it
    changes by `rate` seconds a second.
    """

    offset_s: float
    heard_count: int
    delay_s: float = 0.0
    received_s: float = 0.0
    boot_s: float = 0.0
    rate: float = 0.0
    jitter_s: float = ARRIVAL_SD_S
    arrivals: Line | None = None
    exchanges: Line | None = None
    round_trip_s: float = ROUND_TRIP_MAX_S  # of the quickest exchange of late
    disagree_left: int = 0
    doubtful_until_s: float = -math.inf
    restarts: int = 0  # how often in turn it began anew after a few arrivals
    late_since_s: float | None = None
    agreed_s: float = -math.inf  # when an exchange last agreed with the ones before it
    heard_s: float = -math.inf  # when the newest exchange came that was looked at
    strays: Strays | None = None

    @property
    def sent_offset_s(self) -> float:
        """Return what to add to the autopilot's time to have ours."""
        return self.offset_s - self.delay_s

    def is_doubtful(self, now_s: float) -> bool:
        """Whether the autopilot's time may be another than it seems."""
        has_exchanges = now_s - self.agreed_s <= REPORT_AGE_MAX_S
        late_s = self.late_since_s
        is_late = late_s is not None and now_s - late_s > LATE_FOR_S and self.agreed_s < late_s
        strays = self.strays
        is_astray = strays is not None and (
            strays.is_doubtful or self.heard_s - self.agreed_s > STRAYS_MAX_S
        )
        return (
            (self.disagree_left > 0 and has_exchanges)
            or (is_astray and now_s - self.heard_s <= REPORT_AGE_MAX_S)
            or now_s < self.doubtful_until_s
            or is_late
            or not abs(self.rate) <= RATE_MAX
        )


def unwrapped(report: ClockReport, near_s: float) -> ClockReport:
    """Return an exchange in the 32 bits of the positions' time, nearest to an offset."""
    turns = (near_s - report.offset_s) / BOOT_WRAP_S
    if not abs(turns) < 1e6 or round(turns) == 0:
        return report
    return replace(report, offset_s=report.offset_s + round(turns) * BOOT_WRAP_S)


def is_measured(report: ClockReport | None, now_s: float) -> bool:
    """Whether an exchange is young and quick enough to say anything."""
    return (
        report is not None
        and 0.0 <= report.round_trip_s <= ROUND_TRIP_MAX_S
        and abs(now_s - report.received_s) <= REPORT_AGE_MAX_S
        and math.isfinite(report.offset_s)
    )


def is_believed(report: ClockReport | None, clock: Clock, now_s: float) -> bool:
    """Whether an exchange is young, quick, and agrees with when the positions arrive."""
    if report is None or not is_measured(report, now_s):
        return False
    return _is_possible(report, clock, now_s, early_max_s=EARLY_MAX_S)


def _is_refused(report: ClockReport | None, clock: Clock, now_s: float) -> bool:
    """Whether an exchange was measured that not even an autopilot held up could have sent."""
    if report is None or not is_measured(report, now_s):
        return False
    return not _is_possible(report, clock, now_s, early_max_s=HELD_UP_MAX_S)


def _is_possible(report: ClockReport, clock: Clock, now_s: float, *, early_max_s: float) -> bool:
    late_s = clock.offset_s - clock.rate * (now_s - report.received_s) - report.offset_s
    early_s = early_max_s + 0.5 * report.round_trip_s
    return -early_s <= late_s <= report.round_trip_s + WAIT_MAX_S


class Ticked(NamedTuple):
    """The clock after an arrival, whether it rests on TIMESYNC, and how far it was put right.

    What `moved_s` says is a better knowledge of the clock and no motion: known times move with it.
    `is_set`: the autopilot's clock was set, and what was known is by another time. `is_refused`:
    an exchange was measured that cannot be true beside the positions.
    """

    clock: Clock
    moved_s: float
    is_set: bool = False
    is_refused: bool = False


def tick(
    before: Clock | None, item: Telemetry, report: ClockReport | None, *, at_once: bool
) -> Ticked:
    """Return the clock with one more arrival; a late message hardly moves the mean.

    `at_once`: nothing is sprayed that a jump could harm.
    """
    now_s = item.received_s
    if report is not None:
        near_s = item.received_s - item.boot_s if before is None else before.offset_s
        report = unwrapped(report, near_s)
    clock, is_set = _arrived(before, item, report, at_once=at_once)
    is_refused = _is_refused(report, clock, now_s)
    passed_s = 0.0 if before is None else now_s - before.received_s
    is_adopted = False
    if report is not None and is_measured(report, now_s) and report.received_s > clock.heard_s:
        was_astray = clock.strays is not None
        clock = _heard(clock, report, now_s, is_set=is_set)._replace(heard_s=report.received_s)
        is_set = is_set or clock.disagree_left == AGREE_COUNT
        is_adopted = was_astray and clock.strays is None and clock.agreed_s == report.received_s
    if is_refused or not _has_exchanges(report, clock, now_s):
        moved_s = 0.0
        if before is not None and clock.heard_count == 1 and not is_set:
            moved_s = clock.offset_s - before.offset_s - before.rate * passed_s
        return Ticked(clock, moved_s, is_set, is_refused)
    assert clock.exchanges is not None
    rate = clock.exchanges.rate(clock.rate, RATE_BY_ARRIVALS_SD)
    wanted_s = min(clock.exchanges.at(now_s, rate), clock.offset_s)
    used_s, moved_s = wanted_s, 0.0
    if before is not None and not is_set:
        known_s = before.sent_offset_s + rate * passed_s
        if not (at_once or is_adopted or clock.disagree_left > 0):
            reach_s = SLEW * min(max(passed_s, 0.0), 1.0)
            used_s = known_s + min(max(wanted_s - known_s, -reach_s), reach_s)
        moved_s = used_s - known_s
    clock = clock._replace(delay_s=clock.offset_s - used_s, rate=rate)
    return Ticked(clock, moved_s, is_set, is_refused)


def _has_exchanges(report: ClockReport | None, clock: Clock, now_s: float) -> bool:
    """Whether the time can be taken from the exchanges."""
    return clock.exchanges is not None and is_measured(report, now_s)


def _arrived(
    clock: Clock | None, item: Telemetry, report: ClockReport | None, *, at_once: bool
) -> tuple[Clock, bool]:
    """Return the clock with one more arrival, and whether it was set."""
    now_s, seen_s = item.received_s, item.received_s - item.boot_s
    if clock is None or clock.arrivals is None:
        return _anew(None, item), False
    slope = clock.arrivals.rate(0.0, RATE_SD)
    late_s = seen_s - clock.arrivals.at(now_s, slope)
    off_s2 = min(abs(late_s), JITTER_MAX_S) ** 2
    jitter_s = max(ARRIVAL_SD_S, math.sqrt(0.95 * clock.jitter_s**2 + 0.05 * off_s2))
    if late_s < -CLOCK_STEP_S:
        # It cannot have come before it was sent: the mean rests on late ones, or the clock was set.
        restarts = clock.restarts + 1 if clock.heard_count < RESTART_COUNT else 0
        is_much = late_s < -max(LATE_DOUBT_S, JITTERS_MAX * clock.jitter_s)
        is_much = is_much or restarts >= RESTARTS_MAX
        until_s = now_s + SETTLE_S if is_much and not at_once else clock.doubtful_until_s
        anew = _anew(clock, item)._replace(jitter_s=jitter_s, doubtful_until_s=until_s)
        return anew._replace(restarts=restarts), False
    since_s = None
    if late_s > LATE_DOUBT_S:
        since_s = now_s if clock.late_since_s is None else clock.late_since_s
        if _is_set_back(clock, item, report, since_s, late_s, at_once=at_once):
            return _anew(clock, item), True
    count = min(clock.heard_count + 1, 100)
    if late_s > CLOCK_STEP_S:
        line = clock.arrivals.moved(CLOCK_STEP_S / count)
    else:
        line = _longer(clock.arrivals, now_s, seen_s, clock.jitter_s, ARRIVALS_FADE_S)
    slope = line.rate(0.0, RATE_SD)
    strays = clock.strays
    if strays is not None:
        strays = strays._replace(least_s=min(strays.least_s, seen_s))
    arrived = clock._replace(
        offset_s=line.at(now_s, slope),
        heard_count=count,
        received_s=now_s,
        boot_s=item.boot_s,
        rate=slope,
        jitter_s=jitter_s,
        arrivals=line,
        late_since_s=since_s,
        strays=strays,
    )
    return arrived, False


def _is_set_back(
    clock: Clock,
    item: Telemetry,
    report: ClockReport | None,
    since_s: float,
    late_s: float,
    *,
    at_once: bool,
) -> bool:
    """Whether positions that are late are so because the clock was set back.

    TIMESYNC tells: no late way makes an exchange agree with them. Without it nobody can tell a
    clock that was set back by less than a second from a way that has become longer; both are
    taken for the new usual after a while, during which nothing is sprayed.
    """
    now_s = item.received_s
    if report is not None and is_measured(report, now_s):
        now = _anew(clock, item)
        is_new = report.received_s > since_s
        return is_new and is_believed(report, now, now_s) and report.offset_s > clock.offset_s
    return now_s - since_s >= LATE_SETTLE_S and (late_s < CLOCK_RESET_S or at_once)


def _anew(clock: Clock | None, item: Telemetry) -> Clock:
    """Return a clock that knows one arrival, and of the one before it what still holds."""
    seen_s = item.received_s - item.boot_s
    anew = Clock(
        offset_s=seen_s,
        heard_count=1,
        received_s=item.received_s,
        boot_s=item.boot_s,
        arrivals=_begun(item.received_s, seen_s, ARRIVAL_SD_S),
    )
    if clock is None:
        return anew
    return anew._replace(
        delay_s=0.0,
        exchanges=clock.exchanges,
        round_trip_s=clock.round_trip_s,
        disagree_left=clock.disagree_left,
        agreed_s=clock.agreed_s,
        heard_s=clock.heard_s,
        strays=None if clock.strays is None else clock.strays._replace(least_s=seen_s),
    )


def _heard(clock: Clock, report: ClockReport, now_s: float, *, is_set: bool) -> Clock:
    """Return the clock with one more exchange: used, a stray, or the first of another clock."""
    line, at_s, offset_s = clock.exchanges, report.received_s, report.offset_s
    is_possible = is_believed(report, clock, now_s)
    quickest_s = report.round_trip_s
    if line is not None:
        more_s = max(report.round_trip_s - clock.round_trip_s, 0.0)
        quickest_s = min(report.round_trip_s, clock.round_trip_s + 0.02 * more_s)
    slow_s = report.round_trip_s - quickest_s
    sd_s = EXCHANGE_SD_S + UNEVEN * report.round_trip_s + 0.5 * slow_s
    fade_s = EXCHANGES_FADE_S + FADE_BY_ROUND_TRIP * slow_s
    begun = _begun(at_s, offset_s, sd_s)
    if line is None and is_possible:
        return clock._replace(exchanges=begun, round_trip_s=quickest_s, agreed_s=at_s, strays=None)
    bound_s = 0.5 * (report.round_trip_s + quickest_s) + EXCHANGE_STEP_S
    late_s = clock.offset_s - clock.rate * (now_s - at_s) - offset_s
    if line is None:
        return _strayed(clock, report, begun, off_s=-late_s, bound_s=bound_s)
    apart_s = offset_s - line.at(at_s, line.rate(clock.rate, RATE_BY_ARRIVALS_SD))
    passed_s = at_s - line.at_s
    wander_s = WANDER * max(passed_s, 1.0) if clock.heard_count >= 20 else RATE_MAX * passed_s
    is_apart = not abs(apart_s) <= bound_s + wander_s
    if is_possible and not is_apart:
        return clock._replace(
            exchanges=_longer(line, at_s, offset_s, sd_s, fade_s),
            round_trip_s=quickest_s,
            agreed_s=at_s,
            disagree_left=max(clock.disagree_left - 1, 0),
            # Three that agree are a better reason than the time that passed without any.
            doubtful_until_s=-math.inf if clock.disagree_left == 1 else clock.doubtful_until_s,
            strays=None,
        )
    is_set = is_set or now_s < clock.doubtful_until_s or abs(apart_s) + bound_s > HELD_UP_MAX_S
    if is_possible and is_set:
        return clock._replace(
            exchanges=begun,
            round_trip_s=quickest_s,
            disagree_left=AGREE_COUNT,
            strays=None,
        )
    off_s = max(apart_s, -late_s, key=abs)
    return _strayed(clock, report, begun, off_s=off_s, bound_s=bound_s)


def _strayed(
    clock: Clock, report: ClockReport, begun: Line, *, off_s: float, bound_s: float
) -> Clock:
    """Return the clock with one more stray, or by the strays, if three agree and can be true."""
    at_s, before = report.received_s, clock.strays
    strays = Strays(begun, 1, off_s)
    if before is not None:
        apart_s = report.offset_s - before.line.at(at_s, clock.rate)
        if abs(apart_s) <= bound_s + WANDER:
            sd_s = begun.weight**-0.5
            line = _longer(before.line, at_s, report.offset_s, sd_s, EXCHANGES_FADE_S)
            strays = Strays(line, before.agreeing + 1, off_s, before.least_s)
    least_s = strays.least_s
    if strays.agreeing < AGREE_COUNT or not math.isfinite(least_s):
        return clock._replace(strays=strays)
    late_s = least_s - strays.line.at(at_s, clock.rate)
    early_s = EARLY_MAX_S + 0.5 * report.round_trip_s
    if not -early_s <= late_s <= report.round_trip_s + WAIT_MAX_S:
        return clock._replace(strays=strays)
    adopted = clock._replace(exchanges=strays.line, agreed_s=at_s, disagree_left=0, strays=None)
    if least_s > clock.offset_s and clock.arrivals is not None:
        # The mean that hardly follows late messages did not follow these.
        by_s = least_s - clock.offset_s
        adopted = adopted._replace(
            offset_s=least_s, arrivals=clock.arrivals.moved(by_s), late_since_s=None
        )
    return adopted


def on_time_s(received_s: float, before: Clock | None, after: Clock) -> float:
    """Return when a message without a time of its own had come, were the link as ever.

    It came between two positions, the newest arrivals of `before` and `after`, and was sent
    between them. A link or a computer that stood still for half a second would else make two
    counts of a meter a tenth of the flow, and the next two ten times the flow. Never later than
    `received_s`.

    >>> calm = Clock(offset_s=100.0, heard_count=9, received_s=110.0, boot_s=10.0)
    >>> late = Clock(offset_s=100.0, heard_count=9, received_s=110.7, boot_s=10.1)
    >>> round(on_time_s(110.69, calm, late), 3), round(on_time_s(110.05, None, calm), 3)
    (110.099, 110.0)
    """
    until_s = after.boot_s + after.offset_s
    if before is None or not after.boot_s > before.boot_s:
        return min(received_s, until_s)
    waited_s = after.received_s - before.received_s
    share = (received_s - before.received_s) / waited_s if waited_s > 0.0 else 1.0
    from_s = before.boot_s + after.offset_s
    return min(received_s, from_s + min(max(share, 0.0), 1.0) * (until_s - from_s))
