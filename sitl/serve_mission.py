"""What the simulated autopilot flies: a file's mission, the example's, or an uploaded one."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

from companion.config import Config
from companion.core.frame import course_deg
from companion.core.setup import Setup
from companion.errors import ConfigError
from sitl.anyang import anyang_items
from sitl.earth import Earth
from sitl.stub.autopilot import Autopilot
from sitl.stub.firmware import Firmware
from sitl.stub.flight import starts_with_take_off
from sitl.stub.mission_items import PLACE_FRAMES, MissionItem, item_message, read_mission
from sitl.stub.parameters import SPEED_MAX_M_S, SPEED_MIN_M_S
from sitl.stub.protocol import dialect

# A first waypoint beyond this is another field than the one that the vehicle stands at.
_NEAR_M = 2000.0


def mission_items(
    path: Path | None, speed_m_s: float, firmware: Firmware
) -> tuple[MissionItem, ...]:
    """Return the mission of the file, home first, or the passes over the example field.

    What the firmware would refuse at an upload is refused here too.
    """
    items = anyang_items(speed_m_s) if path is None else _items_of_file(path)
    for number, item in enumerate(items[1:], start=1):
        message = item_message(item, number, current=False, to=(0, 0))
        if firmware.refuses_item(message) is not None:
            raise ConfigError(
                f"{path}: item {number}: {firmware.name} takes no command "
                f"{item.command} in frame {item.frame}"
            )
        if firmware.zero_is_a_place and item.frame in PLACE_FRAMES and not item.has_place:
            raise ConfigError(
                f"{path}: item {number}: {firmware.name} would fly to latitude 0, longitude 0; "
                "give it real coordinates"
            )
    return items


def _items_of_file(path: Path) -> tuple[MissionItem, ...]:
    items = read_mission(path)
    if not starts_with_take_off(items):
        raise ConfigError(f"{path}: the first item must be a take-off")
    if items[0].has_place:
        return items
    places = [item for item in items if item.has_place]
    if not places:
        raise ConfigError(f"{path}: no item has a place; plan at least one waypoint")
    return (places[0], *items[1:])


def home_of(items: tuple[MissionItem, ...]) -> Earth:
    """Return the frame that begins at the home of a mission."""
    return Earth(items[0].latitude_deg, items[0].longitude_deg)


def home_of_file(name: str) -> tuple[float, float] | None:
    """Return latitude and longitude of a mission file's home; None where it names no such file."""
    path = Path(name)
    if path.suffix not in (".plan", ".waypoints"):
        return None
    items = read_mission(path)
    if not items[0].has_place:
        raise ConfigError(f"--home {path}: its home has no place; give LAT,LON")
    return items[0].latitude_deg, items[0].longitude_deg


def waiting_place(
    given: tuple[float, float] | None, config: Config, setup: Setup, *, is_example: bool
) -> Earth:
    """Return where a vehicle without a mission stands.

    That is the place given, else where the example's flight begins, else the first depot of the
    configuration, else the origin of the map's frame.
    """
    if given is not None:
        return Earth(*given)
    if is_example:
        return home_of(anyang_items(1.0))
    depots = () if config.mission is None else config.mission.depots
    return (
        Earth(*depots[0]) if depots else Earth(setup.frame.latitude_deg, setup.frame.longitude_deg)
    )


def first_course_deg(items: tuple[MissionItem, ...], home: Earth) -> float:
    """Return the direction of the first leg, so that the vehicle stands ready for it."""
    place = _first_place_m(items, home)
    return 0.0 if place is None else course_deg(*place)


def _first_place_m(items: tuple[MissionItem, ...], home: Earth) -> tuple[float, float] | None:
    """Return the first place that is not home, in metres east and north."""
    for item in items[1:]:
        if item.has_place:
            east_m, north_m = home.to_local(item.latitude_deg, item.longitude_deg)
            if math.hypot(east_m, north_m) > 1.0:
                return east_m, north_m
    return None


class MissionWatch:
    """Sees what is uploaded, says it, and knows whether there is something to fly."""

    def __init__(self, autopilot: Autopilot, say: Callable[[str], None]) -> None:
        self._autopilot = autopilot
        self._seen = autopilot.flight.items
        self._say = say

    @property
    def is_there(self) -> bool:
        """Return whether a mission has come in, and no transfer is under way."""
        return self._autopilot.upload is None and len(self._autopilot.flight.items) > 1

    @property
    def count(self) -> int:
        """Return how many items there are, home not counted."""
        return max(len(self._autopilot.flight.items) - 1, 0)

    def speed_m_s(self, otherwise_m_s: float) -> float:
        """Return the first speed that the mission sets."""
        speeds = (
            item.param2
            for item in self._autopilot.flight.items
            if item.command == dialect.MAV_CMD_DO_CHANGE_SPEED
            and SPEED_MIN_M_S <= item.param2 <= SPEED_MAX_M_S
        )
        return next(speeds, otherwise_m_s)

    def tick(self) -> None:
        """Say what has come in since the last time."""
        flight = self._autopilot.flight
        if flight.items is self._seen:
            return
        self._seen = flight.items
        if self.count == 0:
            self._say("mission: cleared")
            return
        self._say(f"mission: {self.count} items uploaded")
        if not starts_with_take_off(flight.items):
            self._say("mission: it does not begin with a take-off; upload one that does")
        place = _first_place_m(flight.items, flight.frame)
        if place is not None and not math.hypot(*place) <= _NEAR_M:
            self._say(
                f"mission: its first waypoint is {math.hypot(*place) / 1000.0:.0f} km from the "
                "vehicle; stand there with --home FILE or LAT,LON"
            )
