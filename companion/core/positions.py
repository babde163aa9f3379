"""Which positions are new, which are copies, and when the autopilot's clock has begun anew.

Two radios, a router's loop and Wi-Fi bring positions late and twice. Such a copy has an older time
since boot, and so has the first position after a reboot; they are told apart by evidence. While
the stream goes on, whatever is older is a copy. Where it has stopped, older positions are a new
run of the clock only if they follow each other in step with our clock, and

- their time since boot is shorter than the silence before them: nobody said it before that; or
- a TIMESYNC exchange since then, which no late path can have made, agrees with them; or
- SYSTEM_TIME gives the new times another time of day than the old ones had; or
- the vehicle is disarmed, and they have gone on for some seconds.

Where copies come as late as the clock was set back, they and the new positions have the same times,
and no evidence for the one speaks against the other. So what is late waits first: as long after the
last position of the stream as copies were late in the minutes before, until all of them are here.

Until then they are dropped, and the last good position ages. The link uses the same rules to see
that an autopilot has forgotten what was asked of it.
"""

from __future__ import annotations

import math
from enum import Enum
from typing import TYPE_CHECKING, NamedTuple

from companion.core.inputs import ClockReport, HeartbeatReport, Input, Telemetry, UtcReport

if TYPE_CHECKING:
    from companion.core.frame import LocalFrame

# A clock that jumped ahead by more than this is another run of it; nothing comes before it is sent.
AHEAD_MAX_S = 1.0
# Positions of one run arrive in step with our clock to this.
STEP_MAX_S = 0.25
# A run is believed after so many positions, none of the old one between them.
RUN_COUNT = 3
# A reboot takes longer than this between the last position and the new clock's zero.
RESTART_SLACK_S = 1.0
# A run that is only believed because nothing flies has to last so long.
DISARMED_RUN_S = 3.0
# A run that pauses for longer begins anew.
RUN_GAP_MAX_S = 2.0
# An exchange that took longer than this could be wrong by half of it and is no measurement.
ROUND_TRIP_MAX_S = 0.25
# `time_boot_ms` has 32 bits, which begin anew after 50 days; TIMESYNC has 64.
BOOT_WRAP_S = 2**32 / 1000.0
_RUNS_MAX = 4
# How late copies come is remembered for so long, up to twice; later than that is not a copy's way.
LATE_KEPT_S = 60.0
LATE_MAX_S = 30.0
# Copies of one way differ by this: a router's queue, a radio's repeats.
LATE_SLACK_S = 0.5
# The mean arrival follows a clock that is 5 % off at 10 positions a second.
_FOLLOW = 0.2
_FOLLOW_MAX_S = 0.05


class Run(NamedTuple):
    """Positions that follow each other and do not belong to the stream so far."""

    offset_s: float  # arrival less time since boot
    boot_s: float
    first_boot_s: float
    first_s: float
    last_s: float
    positions: int


class Lateness(NamedTuple):
    """How late copies came at most, while the stream went on: of late, before that, and just now.

    Only when the stream goes on is it known that what came in between were copies.
    """

    since_s: float = -math.inf
    most_s: float = 0.0
    before_s: float = 0.0
    pending_s: float = 0.0

    @property
    def wait_s(self) -> float:
        """Return how long after the last position copies may still come."""
        most_s = max(self.most_s, self.before_s)
        return most_s + LATE_SLACK_S if most_s > 0.0 else 0.0

    def seen(self, late_s: float) -> Lateness:
        """Return it with something that is late, by so much, and may be a copy."""
        return self._replace(pending_s=max(self.pending_s, min(late_s, LATE_MAX_S)))

    def went_on(self, now_s: float) -> Lateness:
        """Return it at a position of the stream: what was late in between is counted."""
        if now_s - self.since_s > LATE_KEPT_S:
            return Lateness(now_s, self.pending_s, self.most_s)
        if not self.pending_s > 0.0:
            return self
        return self._replace(most_s=max(self.most_s, self.pending_s), pending_s=0.0)


NO_COPIES = Lateness()


class PositionStream(NamedTuple):
    """The stream of positions so far, and what may be another run of the autopilot's clock."""

    boot_s: float | None = None
    received_s: float = -math.inf
    offset_s: float = 0.0
    runs: tuple[Run, ...] = ()
    exchange: ClockReport | None = None
    epoch_s: float | None = None  # the time of day at which the clock was zero
    utc: UtcReport | None = None  # the last one that gives another
    disarmed_s: float = -math.inf
    lateness: Lateness = NO_COPIES


class Arrival(Enum):
    """What a position is in the stream."""

    NEXT = "next"
    AGAIN = "again"  # older than what is known, or the same: dropped
    ANEW = "anew"  # the first that is believed of another run of the clock


def noted(order: PositionStream, item: Input) -> PositionStream:
    """Return the order with one more piece of evidence; most inputs are none."""
    if isinstance(item, ClockReport):
        is_sound = 0.0 <= item.round_trip_s <= ROUND_TRIP_MAX_S and math.isfinite(item.offset_s)
        return order._replace(exchange=item) if is_sound else order
    if isinstance(item, HeartbeatReport):
        return order if item.armed else order._replace(disarmed_s=item.received_s)
    if isinstance(item, UtcReport):
        return _noted_utc(order, item)
    return order


def _noted_utc(order: PositionStream, item: UtcReport) -> PositionStream:
    if item.boot_s is None or not math.isfinite(item.utc_s):
        return order
    epoch_s = item.utc_s - item.boot_s
    if order.epoch_s is not None and not abs(epoch_s - order.epoch_s) <= STEP_MAX_S:
        order = order._replace(utc=item)
    in_step = abs(item.received_s - item.boot_s - order.offset_s) <= STEP_MAX_S
    if order.boot_s is not None and in_step:
        order = order._replace(epoch_s=epoch_s)
    return order


def sorted_in(order: PositionStream, item: Telemetry) -> tuple[PositionStream, Arrival]:
    """Return the order after one more position, and what that is."""
    seen_s = item.received_s - item.boot_s
    if not math.isfinite(seen_s):
        return order, Arrival.NEXT  # no number, which is for others to judge
    if order.boot_s is None:
        return _followed(order, item, seen_s), Arrival.NEXT
    if item.boot_s > order.boot_s and seen_s >= order.offset_s - AHEAD_MAX_S:
        off_s = seen_s - order.offset_s
        if off_s >= -_FOLLOW_MAX_S:
            seen_s = order.offset_s + _FOLLOW * min(off_s, _FOLLOW_MAX_S)
        return _followed(order, item, seen_s), Arrival.NEXT
    late_s = seen_s - order.offset_s
    if late_s > 0.0 and item.boot_s != order.boot_s:
        order = order._replace(lateness=order.lateness.seen(late_s))
    waits = item.received_s <= order.received_s + order.lateness.wait_s
    if waits or item.boot_s == order.boot_s:
        return order, Arrival.AGAIN
    run, others = _run(order.runs, item, seen_s)
    if _is_believed(order, run):
        exchange = order.exchange
        if exchange is not None and exchange.received_s <= run.first_s:
            exchange = None  # with the clock as it was
        lateness = order.lateness._replace(pending_s=0.0)  # that was no copies
        anew = order._replace(exchange=exchange, epoch_s=None, utc=None, lateness=lateness)
        return _followed(anew, item, run.offset_s), Arrival.ANEW
    return order._replace(runs=(*others, run)[-_RUNS_MAX:]), Arrival.AGAIN


def _followed(order: PositionStream, item: Telemetry, offset_s: float) -> PositionStream:
    return order._replace(
        boot_s=item.boot_s,
        received_s=item.received_s,
        offset_s=offset_s,
        runs=(),
        lateness=order.lateness.went_on(item.received_s),
    )


def _run(runs: tuple[Run, ...], item: Telemetry, seen_s: float) -> tuple[Run, tuple[Run, ...]]:
    """Return the run that a position continues or begins, and the others."""
    for run in runs:
        in_step = abs(seen_s - run.offset_s) <= STEP_MAX_S and item.boot_s >= run.boot_s
        if in_step and item.received_s - run.last_s <= RUN_GAP_MAX_S:
            now = run._replace(
                # The quickest arrival has the least of the way in it.
                offset_s=min(run.offset_s, seen_s),
                boot_s=item.boot_s,
                last_s=item.received_s,
                positions=run.positions + (item.boot_s > run.boot_s),
            )
            return now, tuple(other for other in runs if other is not run)
    begun = Run(seen_s, item.boot_s, item.boot_s, item.received_s, item.received_s, 1)
    return begun, runs


def _is_believed(order: PositionStream, run: Run) -> bool:
    """Whether a run is the clock begun anew, and no copies of what was sent before."""
    if run.positions < RUN_COUNT:
        return False
    if run.offset_s < order.offset_s - AHEAD_MAX_S:
        return True  # ahead of all that was heard: nothing is a copy of the future
    exchange, utc = order.exchange, order.utc
    if exchange is not None and exchange.received_s > run.first_s:
        apart_s = math.remainder(exchange.offset_s - run.offset_s, BOOT_WRAP_S)
        return abs(apart_s) <= STEP_MAX_S + exchange.round_trip_s
    if run.first_boot_s <= run.first_s - order.received_s + RESTART_SLACK_S:
        return True
    if utc is not None and utc.boot_s is not None and utc.received_s >= run.first_s:
        return abs(utc.received_s - utc.boot_s - run.offset_s) <= STEP_MAX_S
    is_disarmed = order.disarmed_s > run.first_s
    return is_disarmed and run.last_s - run.first_s >= DISARMED_RUN_S


# Positions that go on being sent though nobody knows where the vehicle is.
#
# ArduPilot sends its last location with zero velocity while its estimator has none ("we send stale
# data", GCS_Common.cpp); the estimator's own report comes twice a second only. What gives it away
# in the positions themselves: place and motion that no vehicle can have together.

# The same place to the last bit (1.1 cm) while somebody claims that the vehicle went this far.
FROZEN_M = 0.15
# A slower claim is the noise of one that stands (PX4 tells up to 0.2 m/s at rest): no way is gone.
STANDING_M_S = 0.3
# Exactly no velocity in the message after at least this much, and what brakes take off until then:
# no vehicle stops between two messages. Slower than it nothing is sprayed (`speed_min_m_s`).
STOP_M_S = 0.8
BRAKE_MAX_M_S2 = 5.0


class LastPlace(NamedTuple):
    """The last place to the bit and when (the autopilot's clock), and whether it is frozen.

    `way_m` is how far the vehicle claims to have gone since it was first at that place.
    """

    latitude_deg: float
    longitude_deg: float
    boot_s: float
    way_m: float
    is_frozen: bool


def look(
    before: LastPlace | None,
    item: Telemetry,
    *,
    expected_m_s: float | None,
    reported_m_s: float | None,
) -> LastPlace:
    """Return where the positions stand after one more.

    `expected_m_s` is how fast the vehicle should be by the positions so far, `reported_m_s` what
    the autopilot says in VFR_HUD; None where not known.
    """
    if before is None:
        return LastPlace(item.latitude_deg, item.longitude_deg, item.boot_s, 0.0, False)
    same = (item.latitude_deg, item.longitude_deg) == before[:2]
    dt_s = item.boot_s - before.boot_s
    said_m_s = _said(item)
    told = (said_m_s, reported_m_s)
    claims = [claim for claim in told if claim is not None and claim > STANDING_M_S]
    way_m = before.way_m + max(claims, default=0.0) * dt_s if same else 0.0
    most_m_s = STOP_M_S + BRAKE_MAX_M_S2 * dt_s
    is_frozen = (same and (before.is_frozen or way_m > FROZEN_M)) or (
        said_m_s == 0.0 and expected_m_s is not None and expected_m_s >= most_m_s
    )
    return LastPlace(item.latitude_deg, item.longitude_deg, item.boot_s, way_m, is_frozen)


def _said(item: Telemetry) -> float | None:
    if item.velocity_east_m_s is None or item.velocity_north_m_s is None:
        return None
    return math.hypot(item.velocity_east_m_s, item.velocity_north_m_s)


def place_of(item: Telemetry, frame: LocalFrame) -> tuple[float, float] | None:
    """Return (east_m, north_m); None for what is no position: NaN, out of range, or 0, 0."""
    latitude, longitude = item.latitude_deg, item.longitude_deg
    if not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0):
        return None
    if abs(latitude) < 1e-6 and abs(longitude) < 1e-6:
        return None
    if not (abs(item.received_s) < math.inf and abs(item.boot_s) < math.inf):
        return None
    east_m, north_m = frame.to_local(latitude, longitude)
    if not (abs(east_m) < 1e8 and abs(north_m) < 1e8 and abs(item.relative_altitude_m) < 1e6):
        return None
    return east_m, north_m
