"""The vehicle's motion as its positions tell it: the filters of `motion.py`, course and height."""

from __future__ import annotations

from dataclasses import dataclass

from companion.core import motion
from companion.core.arithmetic import exp
from companion.core.motion import (
    BELIEVING,
    BRIDGED_MAX_S,
    CRUISE,
    DOUBTING,
    MANOEUVRE,
    NOT_DRAWN,
    SHARE_MIN,
    Axis,
    Belief,
    Drawn,
    Pair,
    Seen,
    Told,
    agreed,
    doubted,
    follow_pair,
    mixed,
    moved,
    stretch,
    told,
)
from companion.core.types import Telemetry

YAW_RATE_TIME_S = 0.25
# After a jump the filters start anew, and nothing is sprayed until so many positions confirm it.
CONFIRM_COUNT = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """What the filters make of the positions, true at `time_s` on our clock.

    `agreed` is what all of them say together; `seen` is the last message, to the east and to the
    north, and `drawn` how the place is drawn beside the velocities of these.
    """

    time_s: float
    boot_s: float
    received_s: float
    believing: Pair
    doubting: Pair
    doubt_share: float
    agreed: Pair
    seen: tuple[Seen, Seen]
    drawn: tuple[Drawn, Drawn]
    heading_deg: float | None
    yaw_rate_deg_s: float
    height_m: float
    velocity_known: bool
    confirm_left: int

    def after(self, dt_s: float) -> tuple[Told, Told]:
        """Return the motion to the east and to the north `dt_s` later: the place as it is told.

        The velocity is the told one too, not that of the place, but for what has begun to draw the
        place just now, as far as the velocity is doubted at all (`drawn.py`).
        """
        cruise, manoeuvre, share = self.agreed.cruise, self.agreed.manoeuvre, self.agreed.share
        calm, nimble = stretch(CRUISE.fade_s, dt_s), stretch(MANOEUVRE.fade_s, dt_s)
        east = told(mixed(moved(cruise.east, calm), moved(manoeuvre.east, nimble), share))
        north = told(mixed(moved(cruise.north, calm), moved(manoeuvre.north, nimble), share))
        return self._drawn(east, self.drawn[0], dt_s), self._drawn(north, self.drawn[1], dt_s)

    def _drawn(self, axis: Told, by: Drawn, dt_s: float) -> Told:
        velocity_m_s = axis.velocity_m_s + self.doubt_share * by.after(dt_s)
        return axis._replace(velocity_m_s=velocity_m_s)

    @property
    def acceleration_fade_s(self) -> float:
        """Return the time constant with which the acceleration is expected to fade."""
        return CRUISE.fade_s + self.agreed.share * (MANOEUVRE.fade_s - CRUISE.fade_s)


def begun(item: Telemetry, place: tuple[float, float], time_s: float) -> Motion:
    """Return what a first position says."""
    east, north = _seen(item, place)
    belief = Belief(
        Axis(place[0], east.velocity_m_s or 0.0, 0.0),
        Axis(place[1], north.velocity_m_s or 0.0, 0.0),
    )
    pair = Pair(belief, belief, 0.5)
    return Motion(
        time_s=time_s,
        boot_s=item.boot_s,
        received_s=item.received_s,
        believing=pair,
        doubting=pair,
        doubt_share=SHARE_MIN,
        agreed=pair,
        seen=(east, north),
        drawn=(NOT_DRAWN, NOT_DRAWN),
        heading_deg=item.heading_deg,
        yaw_rate_deg_s=0.0,
        height_m=item.relative_altitude_m,
        velocity_known=east.velocity_m_s is not None,
        confirm_left=CONFIRM_COUNT,
    )


def followed(before: Motion, item: Telemetry, place: tuple[float, float], time_s: float) -> Motion:
    """Return the motion after one more position; it begins anew after a gap and after a jump."""
    dt_s = time_s - before.time_s
    if not 0.0 < dt_s < BRIDGED_MAX_S:
        return begun(item, place, time_s)
    east, north = _seen(item, place)
    believing = follow_pair(BELIEVING, before.believing, dt_s, east, north)
    if believing is None:
        return begun(item, place, time_s)
    doubting = follow_pair(DOUBTING, before.doubting, dt_s, east, north)
    known = east.velocity_m_s is not None
    share = before.doubt_share
    if doubting is None:
        # No jump to those that believe: the doubters were led astray, and begin anew.
        doubting, share = believing, SHARE_MIN
    elif known:
        share = doubted(share, dt_s, believing[1], doubting[1])
    return Motion(
        time_s=time_s,
        boot_s=item.boot_s,
        received_s=item.received_s,
        believing=believing[0],
        doubting=doubting[0],
        doubt_share=share,
        agreed=agreed(believing[0], doubting[0], share),
        seen=(east, north),
        drawn=(
            _drawn_after(before.drawn[0], dt_s, before.seen[0], east),
            _drawn_after(before.drawn[1], dt_s, before.seen[1], north),
        ),
        heading_deg=item.heading_deg,
        yaw_rate_deg_s=_yaw_rate(before, item.heading_deg, dt_s),
        height_m=item.relative_altitude_m,
        velocity_known=known,
        confirm_left=max(before.confirm_left - 1, 0),
    )


def _seen(item: Telemetry, place: tuple[float, float]) -> tuple[Seen, Seen]:
    """Return what a message says to the east and to the north; half a velocity is none."""
    east_m_s, north_m_s = item.velocity_east_m_s, item.velocity_north_m_s
    if east_m_s is None or north_m_s is None:
        return Seen(place[0], None), Seen(place[1], None)
    return Seen(place[0], east_m_s), Seen(place[1], north_m_s)


def _drawn_after(by: Drawn, dt_s: float, before: Seen, now: Seen) -> Drawn:
    if before.velocity_m_s is None or now.velocity_m_s is None:
        return NOT_DRAWN
    told_m_s = 0.5 * (before.velocity_m_s + now.velocity_m_s)
    return motion.followed(by, dt_s, now.position_m - before.position_m, told_m_s)


def _yaw_rate(before: Motion, heading_deg: float | None, dt_s: float) -> float:
    if heading_deg is None or before.heading_deg is None:
        return 0.0
    if not abs(heading_deg - before.heading_deg) <= 720.0:
        return 0.0  # one of them is no number; the rate would never be one again
    turned_deg = (heading_deg - before.heading_deg + 180.0) % 360.0 - 180.0
    share = 1.0 - exp(-dt_s / YAW_RATE_TIME_S)
    return before.yaw_rate_deg_s + share * (turned_deg / dt_s - before.yaw_rate_deg_s)
