"""What autopilots have room for and take, looked at before a file is written."""

from __future__ import annotations

from typing import Any

from missions.errors import PlanError
from missions.files.plan_rules import (
    ITEMS_MAX,
    RALLY_MAX,
    plan_problems,
)
from missions.plan import Plan, Sortie

NAMES = {"ardupilot": "ArduPilot", "px4": "PX4"}


def check_sprayer(plan: Plan, *, with_sprayer: bool) -> None:
    """Refuse items that the autopilot refuses."""
    if with_sprayer and plan.settings.autopilot == "px4":
        raise PlanError("PX4 takes no DO_SPRAYER; plan without --sprayer: valves follow the map")


def check_items(plan: Plan, sortie: Sortie, count: int) -> None:
    """Refuse a sortie with more items than the autopilot has room for."""
    autopilot = plan.settings.autopilot
    limit = ITEMS_MAX[autopilot]
    if not count <= limit:
        raise PlanError(
            f"sortie {sortie.number} has {count} items, and {NAMES[autopilot]} has room for "
            f"{limit}; fill the tank less (mission.tank_l), or allow more height error "
            "(mission.terrain_tolerance_m)"
        )


def check_content(plan: Plan, sortie: Sortie, content: dict[str, Any]) -> None:
    """Refuse a plan file that a ground station or the autopilot would not take."""
    autopilot = plan.settings.autopilot
    rally = len(content["rallyPoints"]["points"])
    if not rally <= RALLY_MAX[autopilot]:
        raise PlanError(
            f"{rally} depots are more rally points than {NAMES[autopilot]}'s "
            f"{RALLY_MAX[autopilot]}; plan with fewer (mission.depots)"
        )
    problems = plan_problems(content)
    if problems:
        raise PlanError(f"sortie {sortie.number} makes no plan that loads: {problems[0]}")
