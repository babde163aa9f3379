"""ArduCopter's modes by number, the phases of a flight, and what a flight has to tell."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from sitl.stub.mission_items import MissionItem
from sitl.stub.protocol import dialect

AUTO: int = dialect.COPTER_MODE_AUTO
GUIDED: int = dialect.COPTER_MODE_GUIDED
LOITER: int = dialect.COPTER_MODE_LOITER
RTL: int = dialect.COPTER_MODE_RTL
LAND: int = dialect.COPTER_MODE_LAND
BRAKE: int = dialect.COPTER_MODE_BRAKE

MODE_NAMES: dict[int, str] = {
    dialect.COPTER_MODE_STABILIZE: "STABILIZE",
    dialect.COPTER_MODE_ALT_HOLD: "ALT_HOLD",
    AUTO: "AUTO",
    GUIDED: "GUIDED",
    LOITER: "LOITER",
    RTL: "RTL",
    LAND: "LAND",
    dialect.COPTER_MODE_POSHOLD: "POSHOLD",
    BRAKE: "BRAKE",
}

INFO: int = dialect.MAV_SEVERITY_INFO
WARNING: int = dialect.MAV_SEVERITY_WARNING
CRITICAL: int = dialect.MAV_SEVERITY_CRITICAL


class Phase(Enum):
    """What the vehicle does."""

    GROUND = "ground"
    CLIMB = "climb"
    ROUTE = "route"
    HOVER = "hover"
    DESCEND = "descend"


# `landed_state` of GCS_MAVLink_Copter.cpp.
LANDED_STATES: dict[Phase, int] = {
    Phase.GROUND: dialect.MAV_LANDED_STATE_ON_GROUND,
    Phase.CLIMB: dialect.MAV_LANDED_STATE_TAKEOFF,
    Phase.ROUTE: dialect.MAV_LANDED_STATE_IN_AIR,
    Phase.HOVER: dialect.MAV_LANDED_STATE_IN_AIR,
    Phase.DESCEND: dialect.MAV_LANDED_STATE_LANDING,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightEvent:
    """Something to tell: a text, an item that was reached, an action of the mission."""

    text: str = ""
    severity: int = INFO
    reached: int | None = None
    action: MissionItem | None = None
