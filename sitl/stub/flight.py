"""Arming, modes, take-off, mission and landing, as ArduCopter does them.

Sources: `ModeAuto::init` and `ModeAuto::allows_arming` (mode_auto.cpp), `landed_state`
(GCS_MAVLink_Copter.cpp). What happens is told through `events`; no MAVLink in here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import Enum

from sitl.airframes import DRAWN, Airframe
from sitl.earth import Earth
from sitl.stub.mission_items import (
    ABSOLUTE_FRAMES,
    ACTION_NAMES,
    ACTIONS,
    AUTO,
    BRAKE,
    CRITICAL,
    GUIDED,
    INFO,
    LAND,
    LOITER,
    MODE_NAMES,
    RTL,
    FlightEvent,
    MissionItem,
    Phase,
)
from sitl.stub.parameters import (
    AUTO_ARMING,
    AUTO_TAKE_OFF,
    SPEED_MAX_M_S,
    SPEED_MIN_M_S,
    Parameters,
)
from sitl.stub.protocol import dialect
from sitl.stub.world import Brake, Climb, Pose, Rest, RouteFlight, World
from sitl.vehicle import Corners, Leg

_WAYPOINT_RADIUS_M = 2.0  # WPNAV_RADIUS of a default ArduCopter
_HEIGHT_TOLERANCE_M = 0.1
TAKE_OFF_MIN_M, TAKE_OFF_MAX_M = 1.0, 1000.0  # lower ones are raised to a metre


class Flight:
    """The state that HEARTBEAT, EXTENDED_SYS_STATE and MISSION_CURRENT speak of."""

    def __init__(
        self,
        world: World,
        frame: Earth,
        parameters: Parameters,
        *,
        home_altitude_m: float,
        airframe: Airframe = DRAWN,
        seed: int = 0,
        zero_is_a_place: bool = False,
        corners: Corners = "stop",
    ) -> None:
        self.world = world
        self.frame = frame
        self.home_altitude_m = home_altitude_m
        self.items: tuple[MissionItem, ...] = ()
        self.armed = False
        self.mode: int = LOITER
        self.phase = Phase.GROUND
        self.sequence = 0
        self.mission_complete = False
        self.events: list[FlightEvent] = []
        self._parameters = parameters
        self._airframe = airframe
        self._zero_is_a_place = zero_is_a_place
        self._seed = seed
        self._corners = corners
        self._route: RouteFlight | None = None
        self._plan: FlightPlan | None = None
        self._leg = 0
        self.will_land = False  # once it hovers

    @property
    def in_air(self) -> bool:
        """Return whether the vehicle has left the ground."""
        return self.phase is not Phase.GROUND

    def arm(self, now_s: float) -> bool:
        """Arm; refused in modes that cannot be armed in."""
        if self.armed:
            return True
        options = self._parameters.auto_options
        if self.mode in (RTL, LAND, BRAKE) or (self.mode == AUTO and not options & AUTO_ARMING):
            self._tell(f"Arm: {MODE_NAMES[self.mode]} mode not armable", severity=CRITICAL)
            return False
        self.armed = True
        self._tell("Arming motors")
        if self.mode == AUTO and not self._auto_begins(now_s):
            self.armed = False
        return self.armed

    def disarm(self, now_s: float, *, force: bool = False) -> bool:
        """Disarm; refused in the air unless forced, and then the vehicle comes down."""
        if self.in_air and not force:
            self._tell("Disarm refused: in flight", severity=CRITICAL)
            return False
        if self.armed:
            self.armed = False
            self._tell("Disarming motors")
        if self.in_air:
            self._ground(now_s)
        return True

    def set_mode(self, mode: int, now_s: float) -> bool:
        """Change the mode; AUTO needs a mission, and on the ground one that takes off."""
        if mode not in MODE_NAMES:
            return False
        if mode == AUTO and not self._auto_allowed():
            self._tell("Mode change to AUTO failed: init failed", severity=CRITICAL)
            return False
        if mode == self.mode:
            return True
        self.mode = mode
        if mode == AUTO:
            self._auto_begins(now_s)
        elif self.in_air:
            self._leave_auto(now_s)
        return True

    def start_mission(self, now_s: float) -> bool:
        """Switch to AUTO and fly; that is MAV_CMD_MISSION_START, which needs no throttle."""
        if not self.set_mode(AUTO, now_s):
            return False
        if self.armed and self.phase is Phase.GROUND:
            self._begin_mission(now_s)
        return True

    def take_off(self, height_m: float, now_s: float) -> bool:
        """Climb in GUIDED; armed and on the ground only."""
        ready = self.armed and self.phase is Phase.GROUND and self.mode == GUIDED
        if not (ready and 0.0 < height_m < TAKE_OFF_MAX_M):
            return False
        self._climb(height_m, now_s)
        return True

    def set_items(self, items: tuple[MissionItem, ...], now_s: float) -> None:
        """Replace the mission; one that is being flown goes on with the new items."""
        self.items = items
        self.sequence = 0
        self.mission_complete = False
        if self.phase is Phase.ROUTE and self.mode == AUTO:
            if len(items) > 1:
                self._fly(now_s)
            else:
                self._hover(now_s, land_after=False)

    def set_sequence(self, sequence: int, now_s: float) -> bool:
        """Go on with another item."""
        if not 0 <= sequence < len(self.items):
            return False
        self.sequence = sequence
        self.mission_complete = False
        if self.mode == AUTO and self.phase in (Phase.ROUTE, Phase.HOVER):
            self._fly(now_s)
        return True

    # -------------------------------------------------------------------------------- time

    def tick(self, now_s: float) -> None:
        """Work the motion out up to now and take the steps that are due."""
        self.world.advance(now_s)
        if self.phase is Phase.ROUTE:
            self._count_waypoints(now_s)
        if not self.world.finished(now_s):
            return
        if self.phase is Phase.CLIMB:
            self._hover(now_s, land_after=False)
            if self.mode == AUTO:
                self._fly(now_s)
        elif self.phase is Phase.ROUTE:
            self._end_route(now_s)
        elif self.phase is Phase.HOVER and self.will_land:
            self._descend(now_s)
        elif self.phase is Phase.DESCEND:
            self._ground(now_s)
            self.armed = False
            self._tell("Disarming motors")

    # --------------------------------------------------------------------------- the flight

    def _auto_allowed(self) -> bool:
        if len(self.items) < 2:
            return False
        if self.armed and not self.in_air and not starts_with_take_off(self.items):
            self._tell("Auto: Missing Takeoff Cmd", severity=CRITICAL)
            return False
        return True

    def _auto_begins(self, now_s: float) -> bool:
        """Begin the mission where AUTO was entered; false where it may not."""
        if not self._auto_allowed():
            return False
        if self.in_air:
            self._fly(now_s)
        elif self.armed and self._parameters.auto_options & AUTO_TAKE_OFF:
            self._begin_mission(now_s)
        return True

    def _begin_mission(self, now_s: float) -> None:
        self.sequence = 0
        self.mission_complete = False
        self._reach(1)
        height_m = self._make_plan(first_sequence=1).take_off_height_m
        if height_m is None or not TAKE_OFF_MIN_M < height_m < TAKE_OFF_MAX_M:
            height_m = TAKE_OFF_MIN_M
        self._climb(height_m, now_s)

    def _make_plan(self, *, first_sequence: int) -> FlightPlan:
        return plan_flight(
            self.items,
            self.frame,
            first_sequence=first_sequence,
            speed_m_s=self._parameters.speed_m_s("cruise"),
            home_altitude_m=self.home_altitude_m,
            zero_is_a_place=self._zero_is_a_place,
        )

    def _climb(self, height_m: float, now_s: float) -> None:
        speed_m_s = self._parameters.speed_m_s("climb")
        pose = self.world.pose_at(now_s)
        self.world.begin(Climb(pose, height_m=height_m, speed_m_s=speed_m_s), now_s=now_s)
        self.phase = Phase.CLIMB

    def _fly(self, now_s: float) -> None:
        """Fly the legs from the current item on, at the height of the first of them."""
        plan = self._make_plan(first_sequence=max(self.sequence, 1))
        self._plan, self._leg = plan, 0
        if not plan.legs:
            self._end_route(now_s)
            return
        pose = self.world.pose_at(now_s)
        height_m = pose.height_m if plan.height_m is None else plan.height_m
        if abs(height_m - pose.height_m) > _HEIGHT_TOLERANCE_M:
            self._climb(height_m, now_s)
            return
        self._reach(plan.sequences[0])
        self._begin_route(pose, plan.legs)

    def _begin_route(self, pose: Pose, legs: tuple[Leg, ...]) -> None:
        self._seed += 1
        self._route = RouteFlight(
            pose, legs, airframe=self._airframe, seed=self._seed, corners=self._corners
        )
        self.world.begin(self._route, now_s=pose.time_s)
        self.phase = Phase.ROUTE

    def _count_waypoints(self, now_s: float) -> None:
        if self._plan is None or self._leg >= len(self._plan.legs) - 1:
            return
        if not self._is_reached(self._plan.legs[self._leg], now_s):
            return
        self.events.append(FlightEvent(reached=self._plan.sequences[self._leg]))
        self._leg += 1
        self._reach(self._plan.sequences[self._leg])

    def _is_reached(self, leg: Leg, now_s: float) -> bool:
        """Whether a leg is over: to whom leads it, when the next one is, else within the radius."""
        if self._corners != "stop" and self._route is not None:
            return self._route.leg > self._leg
        pose = self.world.pose_at(now_s)
        distance_m = math.hypot(leg.east_m - pose.east_m, leg.north_m - pose.north_m)
        return distance_m <= _WAYPOINT_RADIUS_M

    def _reach(self, sequence: int) -> None:
        """Make an item the current one, and do the actions that stand before it."""
        for number in range(self.sequence + 1, sequence):
            item = self.items[number]
            if item.command in ACTIONS:
                text = f"Mission: {number} {ACTION_NAMES[item.command]}"
                self.events.append(FlightEvent(text=text, action=item))
        self.sequence = sequence

    def _end_route(self, now_s: float) -> None:
        plan, self._plan = self._plan, None
        if plan is None:
            self._hover(now_s, land_after=self.mode in (RTL, LAND))
            return
        if plan.sequences:
            self.events.append(FlightEvent(reached=plan.sequences[-1]))
        self._reach(len(self.items))
        self.sequence = len(self.items) - 1
        self.mission_complete = True
        self._hover(now_s, land_after=plan.ending is Ending.LAND)

    def _leave_auto(self, now_s: float) -> None:
        """Stop, then hover, land or go home, as the new mode wants."""
        self._plan = None
        if self.phase is Phase.DESCEND and self.mode == LAND:
            return
        if self.mode == RTL:
            home = home_leg(self._parameters.speed_m_s("cruise"))
            self._begin_route(self.world.pose_at(now_s), (home,))
            return
        self._hover(now_s, land_after=self.mode == LAND)

    def _hover(self, now_s: float, *, land_after: bool) -> None:
        self.world.begin(Brake(self.world.pose_at(now_s)), now_s=now_s)
        self.phase = Phase.HOVER
        self.will_land = land_after

    def _descend(self, now_s: float) -> None:
        speed_m_s = self._parameters.speed_m_s("land")
        pose = self.world.pose_at(now_s)
        self.world.begin(Climb(pose, height_m=0.0, speed_m_s=speed_m_s), now_s=now_s)
        self.phase = Phase.DESCEND

    def _ground(self, now_s: float) -> None:
        pose = replace(self.world.pose_at(now_s), height_m=0.0)
        self.world.begin(Rest(pose), now_s=now_s)
        self.phase = Phase.GROUND
        self._plan = None

    def _tell(self, text: str, *, severity: int = INFO) -> None:
        self.events.append(FlightEvent(text=text, severity=severity))


# From the items of a mission to what is flown: a take-off, legs, and how it ends.

# A waypoint farther away than this is a mistake of the test, or a place that the frame has not.
FAR_M = 100_000.0
# Two places nearer than this are one.
SAME_PLACE_M = 0.01


class Ending(Enum):
    """What comes after the last leg."""

    HOVER = "hover"
    LAND = "land"


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightPlan:
    """The legs with the number of the item that each one flies to."""

    take_off_height_m: float | None
    height_m: float | None
    legs: tuple[Leg, ...]
    sequences: tuple[int, ...]
    ending: Ending


def starts_with_take_off(items: tuple[MissionItem, ...]) -> bool:
    """Return whether the first item that flies is a take-off (item 0 is home)."""
    for item in items[1:]:
        if item.command not in ACTIONS:
            return bool(item.command == dialect.MAV_CMD_NAV_TAKEOFF)
    return False


def home_leg(speed_m_s: float) -> Leg:
    """Return the way home, which is the origin of the frame."""
    return Leg(east_m=0.0, north_m=0.0, speed_m_s=speed_m_s, kind="transit")


def plan_flight(
    items: tuple[MissionItem, ...],
    frame: Earth,
    *,
    first_sequence: int,
    speed_m_s: float,
    home_altitude_m: float,
    zero_is_a_place: bool = False,
) -> FlightPlan:
    """Return what is flown from the item `first_sequence` on.

    The whole route keeps one height, that of its lowest waypoint: the lines', where ferries are
    higher. To PX4, 0, 0 is a place
    (`zero_is_a_place`), and it flies off towards it.
    """
    take_off_height_m: float | None = None
    height_m: float | None = None
    legs: list[Leg] = []
    sequences: list[int] = []
    ending = Ending.HOVER
    for sequence, item in enumerate(items):
        if (
            item.command == dialect.MAV_CMD_DO_CHANGE_SPEED
            and SPEED_MIN_M_S <= item.param2 <= SPEED_MAX_M_S
        ):
            speed_m_s = item.param2
        if sequence < max(first_sequence, 1) or item.command in ACTIONS:
            continue
        item_height_m = item.z_m - (home_altitude_m if item.frame in ABSOLUTE_FRAMES else 0.0)
        if item.command == dialect.MAV_CMD_NAV_TAKEOFF:
            take_off_height_m = item_height_m
            continue
        leg = _leg(item, frame, speed_m_s, zero_is_a_place=zero_is_a_place)
        if leg is not None and not _ends_there(item, leg, legs):
            legs.append(leg)
            sequences.append(sequence)
        if item.command != dialect.MAV_CMD_NAV_WAYPOINT:
            ending = Ending.LAND
            break
        height_m = item_height_m if height_m is None else min(item_height_m, height_m)
    return FlightPlan(
        take_off_height_m=take_off_height_m,
        height_m=height_m,
        legs=tuple(legs),
        sequences=tuple(sequences),
        ending=ending,
    )


def _ends_there(item: MissionItem, leg: Leg, before: list[Leg]) -> bool:
    """Return whether an item lands where the last leg ends: no way leads there."""
    if item.command != dialect.MAV_CMD_NAV_LAND or not before:
        return False
    last = before[-1]
    return math.hypot(leg.east_m - last.east_m, leg.north_m - last.north_m) < SAME_PLACE_M


def _leg(item: MissionItem, frame: Earth, speed_m_s: float, *, zero_is_a_place: bool) -> Leg | None:
    """Return the way to an item's place; none for an item without one."""
    if item.command == dialect.MAV_CMD_NAV_RETURN_TO_LAUNCH:
        return home_leg(speed_m_s)
    if not item.has_place:
        return _leg_to_zero(frame, speed_m_s) if zero_is_a_place else None
    east_m, north_m = frame.to_local(item.latitude_deg, item.longitude_deg)
    if not math.hypot(east_m, north_m) < FAR_M:
        return None
    return Leg(east_m=east_m, north_m=north_m, speed_m_s=speed_m_s, kind="spray")


def _leg_to_zero(frame: Earth, speed_m_s: float) -> Leg:
    """Return the way towards latitude 0, longitude 0, as far as the local frame goes."""
    latitude, longitude = math.radians(frame.latitude_deg), math.radians(frame.longitude_deg)
    course = math.atan2(-math.sin(longitude), -math.sin(latitude) * math.cos(longitude))
    return Leg(
        east_m=FAR_M * math.sin(course),
        north_m=FAR_M * math.cos(course),
        speed_m_s=speed_m_s,
        kind="transit",
    )
