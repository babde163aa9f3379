"""The end of the mission's present leg: braking that has not begun yet is foreseen.

Where a leg ends in a stop, a vehicle at the distance d before it flies no faster than
v^2 = 2 a d, with the braking a. Positions show that only once it has begun; the mission says it
beforehand. What the mission says is believed only while it is young and while the vehicle does
fly along the leg; whoever is off it, or too fast to stop at its end, is predicted without it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

from companion.core.frame import LocalFrame
from companion.core.motion import gained_s
from companion.core.types import LegReport, MissionLeg, StopAhead

# The autopilot says at 2 Hz which item it flies to; three seconds without are no news but a loss.
LEG_AGE_MAX_S = 3.0
ASIDE_MAX_M = 3.0
COURSE_MAX_DEG = 15.0
LEG_MIN_M = 0.5
# Slower than this the vehicle stands, and its course is noise.
SPEED_MIN_M_S = 0.3
# A stop that asks for more than this times the braking is not going to be made.
BRAKING_OVER_MAX = 1.6
# A vehicle that does slow down as its stop asks for, but more softly than it is said to brake, is
# braking for it: from this share of the braking on, and if so much of the slowing down is seen.
BRAKING_SOFT_MIN = 0.4
# One that ought to brake harder than this by now, and does not slow down, brakes later than it is
# said to, nobody knows when.
BRAKING_LATE_MAX = 1.2
BRAKING_SEEN_MIN = 0.7
# The prediction creeps on instead of standing: a path of no length crosses nothing.
CREEP_M_S = 0.2
_ROUNDS = 3
# One pass shows some twenty positions of a ramp: after it the rest is a tenth.
LEARN_SHARE = 0.1
LEARN_SPEED_MIN_M_S = 1.5


@dataclass(frozen=True, slots=True, kw_only=True)
class StoppingLeg:
    """A leg that ends in a stop, in the flight's frame, and how hard is braked at its end."""

    received_s: float
    to_east_m: float
    to_north_m: float
    unit_east: float
    unit_north: float
    length_m: float
    braking_m_s2: float


def leg_of(report: LegReport, frame: LocalFrame, braking_m_s2: float | None) -> StoppingLeg | None:
    """Return the leg of a report; None where it is of no use, or none is to be used."""
    places = (
        (report.from_latitude_deg, report.from_longitude_deg),
        (report.to_latitude_deg, report.to_longitude_deg),
    )
    if braking_m_s2 is None or not report.stops or not math.isfinite(report.received_s):
        return None
    if not all(abs(latitude) <= 90.0 and abs(longitude) <= 180.0 for latitude, longitude in places):
        return None
    (east, north), (to_east, to_north) = (frame.to_local(*place) for place in places)
    length_m = math.hypot(to_east - east, to_north - north)
    if not LEG_MIN_M <= length_m < math.inf:
        return None
    return StoppingLeg(
        received_s=report.received_s,
        to_east_m=to_east,
        to_north_m=to_north,
        unit_east=(to_east - east) / length_m,
        unit_north=(to_north - north) / length_m,
        length_m=length_m,
        braking_m_s2=braking_m_s2,
    )


def mission_leg_of(report: LegReport, frame: LocalFrame) -> MissionLeg | None:
    """Return the way of a leg, whether it ends in a stop or not; None where it is not a place."""
    way = _way(
        report.received_s,
        (report.from_latitude_deg, report.from_longitude_deg),
        (report.to_latitude_deg, report.to_longitude_deg),
        frame,
    )
    if way is None or report.longer is None:
        return way
    return replace(way, longer=_way(report.received_s, *report.longer, frame))


def _way(
    received_s: float, start: tuple[float, float], end: tuple[float, float], frame: LocalFrame
) -> MissionLeg | None:
    if not all(abs(place[0]) <= 90.0 and abs(place[1]) <= 180.0 for place in (start, end)):
        return None
    (east_m, north_m), (to_east_m, to_north_m) = frame.to_local(*start), frame.to_local(*end)
    return MissionLeg(
        received_s=received_s,
        from_east_m=east_m,
        from_north_m=north_m,
        to_east_m=to_east_m,
        to_north_m=to_north_m,
    )


class Approach(NamedTuple):
    """How far the end of the leg is, what braking it asks for, and what slowing down is seen."""

    distance_m: float
    speed_m_s: float
    needed_m_s2: float
    slowing_m_s2: float

    @property
    def is_braking(self) -> bool:
        """Whether the vehicle slows down as its stop asks for."""
        return self.slowing_m_s2 >= BRAKING_SEEN_MIN * self.needed_m_s2


def approach(
    leg: StoppingLeg,
    *,
    place: tuple[float, float],
    velocity: tuple[float, float],
    acceleration: tuple[float, float],
    now_s: float,
) -> Approach | None:
    """Return how a vehicle (east, north) comes to the end of its leg; None if it is not on it.

    Every comparison is written so that NaN means None.
    """
    if not 0.0 <= now_s - leg.received_s <= LEG_AGE_MAX_S:
        return None
    to_east, to_north = leg.to_east_m - place[0], leg.to_north_m - place[1]
    distance_m = to_east * leg.unit_east + to_north * leg.unit_north
    aside_m = abs(to_east * leg.unit_north - to_north * leg.unit_east)
    if not (0.0 < distance_m <= leg.length_m + ASIDE_MAX_M and aside_m < ASIDE_MAX_M):
        return None
    speed_m_s = math.hypot(*velocity)
    along_m_s = velocity[0] * leg.unit_east + velocity[1] * leg.unit_north
    if not (
        speed_m_s > SPEED_MIN_M_S
        and along_m_s >= math.cos(math.radians(COURSE_MAX_DEG)) * speed_m_s
    ):
        return None
    slowing_m_s2 = -(acceleration[0] * leg.unit_east + acceleration[1] * leg.unit_north)
    return Approach(distance_m, along_m_s, along_m_s**2 / (2.0 * distance_m), slowing_m_s2)


def stop_ahead(usual_m_s2: float, seen: Approach) -> StopAhead | None:
    """Return the stop that the vehicle is about to make; None if it is not going to."""
    needed_m_s2 = seen.needed_m_s2
    if not needed_m_s2 <= BRAKING_OVER_MAX * usual_m_s2:
        return None
    braking_m_s2 = max(needed_m_s2, usual_m_s2)
    if seen.is_braking and needed_m_s2 >= BRAKING_SOFT_MIN * usual_m_s2:
        braking_m_s2 = needed_m_s2
    elif not needed_m_s2 <= BRAKING_LATE_MAX * usual_m_s2:
        return None
    return StopAhead(distance_m=seen.distance_m, braking_m_s2=braking_m_s2)


def learned(said_m_s2: float, usual_m_s2: float, seen: Approach | None) -> float:
    """Return how hard the vehicle usually brakes, after one more position of an approach.

    While it brakes evenly, v^2 / 2d is the braking; near the stop it is noise.
    """
    if seen is None or not (seen.is_braking and seen.speed_m_s > LEARN_SPEED_MIN_M_S):
        return usual_m_s2
    low, high = BRAKING_SOFT_MIN * said_m_s2, BRAKING_OVER_MAX * said_m_s2
    if not low <= seen.needed_m_s2 <= high:
        return usual_m_s2
    if not seen.slowing_m_s2 * BRAKING_SEEN_MIN <= seen.needed_m_s2:
        return usual_m_s2
    return usual_m_s2 + LEARN_SHARE * (seen.needed_m_s2 - usual_m_s2)


def ahead(along_m_s2: float, fade_s: float, speed_m_s: float, dt_s: float) -> tuple[float, float]:
    """Return speed and way after `dt_s` at an acceleration along the course that fades."""
    gained = gained_s(dt_s, fade_s)
    way_m = speed_m_s * dt_s + along_m_s2 * fade_s * (dt_s - gained)
    return speed_m_s + along_m_s2 * gained, way_m


def braking_begins_s(
    stop: StopAhead, speed_m_s: float, along_m_s2: float, fade_s: float, within_s: float
) -> float | None:
    """Return in which time braking begins: where v^2 = 2 a d; None if not `within_s`.

    By Newton's method, as the speed until then changes by an acceleration that fades.
    """
    if not speed_m_s > CREEP_M_S:
        return None
    twice = 2.0 * stop.braking_m_s2
    begins_s = max((stop.distance_m - speed_m_s**2 / twice) / speed_m_s, 0.0)
    if not begins_s <= 2.0 * within_s:
        return None
    for _ in range(_ROUNDS):
        if begins_s <= 0.0:
            break
        speed, way = ahead(along_m_s2, fade_s, speed_m_s, begins_s)
        if not speed > CREEP_M_S:
            return None
        # How fast the two come together: both the way and the speed change.
        slowing = along_m_s2 * math.exp(-begins_s / fade_s) / stop.braking_m_s2
        closing = speed * max(1.0 + slowing, 0.3)
        begins_s = max(begins_s + (stop.distance_m - way - speed**2 / twice) / closing, 0.0)
    return begins_s if begins_s < within_s else None


def speed_after(
    stop: StopAhead, speed_m_s: float, along_m_s2: float, fade_s: float, dt_s: float
) -> float:
    """Return the speed `dt_s` from now of a vehicle that stops at `stop`.

    >>> stop = StopAhead(distance_m=7.5, braking_m_s2=2.5)
    >>> speed_after(stop, 5.0, 0.0, 0.5, 0.5), speed_after(stop, 5.0, 0.0, 0.5, 0.9)
    (5.0, 4.0)
    """
    begins_s = braking_begins_s(stop, speed_m_s, along_m_s2, fade_s, dt_s)
    if begins_s is None:
        return max(ahead(along_m_s2, fade_s, speed_m_s, dt_s)[0], 0.0)
    speed = ahead(along_m_s2, fade_s, speed_m_s, begins_s)[0]
    return max(speed - stop.braking_m_s2 * (dt_s - begins_s), min(speed, CREEP_M_S))
