"""Plan files by the rules of QGroundControl's loader, and the limits of autopilots."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from shapely import LineString, Polygon, box

import missions.files
from missions.demand import Uniform
from missions.errors import PlanError
from missions.field import build_field
from missions.files.items import FENCE_CORNERS_MAX, ITEMS_MAX, items_of, plan_problems
from missions.files.write import plan_text, write_plan
from missions.plan import Plan, Settings
from missions.planner import plan_mission
from tests.bench.missions import FRAME, to_degrees

pytestmark = pytest.mark.usefixtures("searched_briefly", "laid_out_once")

SCHEMA = json.loads((Path(missions.files.__file__).parent / "plan.schema.json").read_text())
TYPES: dict[str, Callable[[Any], bool]] = {
    "object": lambda v: isinstance(v, dict),
    "array": lambda v: isinstance(v, list),
    "string": lambda v: isinstance(v, str),
    "boolean": lambda v: isinstance(v, bool),
    "null": lambda v: v is None,
    "integer": lambda v: isinstance(v, int) and not isinstance(v, bool),
    "number": lambda v: isinstance(v, int | float) and not isinstance(v, bool),
}
WORDS = {
    "$ref", "type", "const", "enum", "required", "properties", "items", "minItems", "maxItems",
    "minimum", "exclusiveMinimum", "dependentRequired", "$schema", "title", "$defs",
}  # fmt: skip


def schema_problems(value: Any, rule: dict[str, Any], where: str = "$") -> Iterator[str]:
    """Check a value by the words of JSON Schema that the file uses, and by no others."""
    assert set(rule) <= WORDS
    if "$ref" in rule:
        yield from schema_problems(value, SCHEMA["$defs"][rule["$ref"].rpartition("/")[2]], where)
        return
    kinds = rule.get("type", [])
    kinds = [kinds] if isinstance(kinds, str) else kinds
    if kinds and not any(TYPES[kind](value) for kind in kinds):
        yield f"{where}: no {kinds}"
        return
    allowed = rule.get("enum", [rule["const"]] if "const" in rule else None)
    if allowed is not None and (value not in allowed or isinstance(value, bool)):
        yield f"{where}: not among {allowed}"
    yield from inner_problems(value, rule, where)


def inner_problems(value: Any, rule: dict[str, Any], where: str) -> Iterator[str]:
    """Check what is inside a value whose kind is right."""
    if isinstance(value, dict):
        needed = set(rule.get("required", []))
        for key, more in rule.get("dependentRequired", {}).items():
            needed |= set(more) if key in value else set()
        yield from (f"{where}: {key} is missing" for key in sorted(needed - set(value)))
        for key, inner in rule.get("properties", {}).items():
            if key in value:
                yield from schema_problems(value[key], inner, f"{where}.{key}")
    elif isinstance(value, list):
        if not rule.get("minItems", 0) <= len(value) <= rule.get("maxItems", 10**9):
            yield f"{where}: {len(value)} elements"
        for number, each in enumerate(value):
            yield from schema_problems(each, rule.get("items", {}), f"{where}[{number}]")
    elif isinstance(value, int | float) and not (
        value >= rule.get("minimum", -1e99) and value > rule.get("exclusiveMinimum", -1e99)
    ):
        yield f"{where}: {value} is too small"


@pytest.fixture(scope="module")
def plan() -> Plan:
    hole = [(80.0, 60.0), (120.0, 60.0), (120.0, 90.0), (80.0, 90.0)]
    ground = Polygon([(0.0, 0.0), (200.0, 0.0), (200.0, 150.0), (0.0, 150.0)], [hole])
    field = build_field(to_degrees(ground), swath_width_m=6.0, frame=FRAME)
    settings = Settings(swath_width_m=6.0, speed_m_s=5.0, tank_l=20.0, reserve_l=0.0, moves=500)
    return plan_mission(field, settings, Uniform(rate_l_ha=20.0))


@pytest.fixture
def content(plan: Plan) -> Any:
    return json.loads(plan_text(plan, plan.sorties[0], with_sprayer=True))


def test_what_is_written_keeps_every_rule(plan: Plan) -> None:
    for sortie in plan.sorties:
        for with_sprayer in (False, True):
            found = json.loads(plan_text(plan, sortie, with_sprayer=with_sprayer))
            assert plan_problems(found) == []
            assert list(schema_problems(found, SCHEMA)) == []


def _item(content: Any) -> Any:
    return content["mission"]["items"][0]


# What is broken, what the mirror says of it, and whether a schema can say it, too.
BROKEN: list[tuple[Callable[[Any], Any], str, bool]] = [
    (lambda c: c.update(fileType="plan"), "fileType", True),
    (lambda c: c.update(version=2), "version must be 1", True),
    (lambda c: c.update(version=True), "version must be 1", True),
    (lambda c: c.pop("groundStation"), "groundStation", True),
    (lambda c: c.pop("geoFence"), "geoFence", True),
    (lambda c: c.pop("rallyPoints"), "rallyPoints", True),
    (lambda c: c.update(mission=[]), "mission must be", True),
    (lambda c: c["mission"].update(items=[]), "at least one item", True),
    (lambda c: c["mission"].pop("firmwareType"), "firmwareType", True),
    (lambda c: c["mission"]["plannedHomePosition"].pop(), "plannedHomePosition", True),
    (lambda c: c["mission"].update(plannedHomePosition=[148.0, 11.0, 0.0]), "plannedHome", False),
    (lambda c: _item(c).update(type="ComplexItem"), "item 1: type", True),
    (lambda c: _item(c).update(autoContinue=1), "item 1: autoContinue", True),
    (lambda c: c["mission"]["items"][1].update(frame=2.5), "item 2: frame", True),
    (lambda c: _item(c)["params"].pop(), "item 1: params", True),
    (lambda c: _item(c)["params"].append(0), "item 1: params", True),
    (lambda c: _item(c)["params"].__setitem__(4, 91.0), "item 1: 91.0, ", False),
    (lambda c: _item(c)["params"].__setitem__(0, "0"), "item 1: params", True),
    (lambda c: _item(c).pop("Altitude"), "all or none", True),
    (lambda c: _item(c).update(AltitudeMode=9), "AltitudeMode 9", True),
    (lambda c: _item(c).update(AltitudeMode=4), "belongs to frame 10", False),
    (lambda c: c["mission"]["items"][1].update(doJumpId=1), "one doJumpId", False),
    (lambda c: c["mission"]["items"][1].update(command=177, params=[99, 1, 0, 0, 0, 0, 0]),
     "jumps to 99", False),
    (lambda c: c["geoFence"].update(version=1), "silently ignored", True),
    (lambda c: c["geoFence"].pop("circles"), "circles must be a list", True),
    (lambda c: c["geoFence"]["polygons"][0].pop("inclusion"), "polygons 1", True),
    (lambda c: c["geoFence"]["polygons"][0].update(polygon=[[1, 2], [3, 4]]), "polygons 1", True),
    (lambda c: c["geoFence"]["circles"].append(
        {"version": 1, "inclusion": True, "circle": {"center": [48, 11], "radius": 0}}),
     "circles 1", True),
    (lambda c: c["rallyPoints"].update(version=1), "rallyPoints.version", True),
    (lambda c: c["rallyPoints"]["points"][0].pop(), "rally point 1", True),
]  # fmt: skip


@pytest.mark.parametrize(("broken", "says", "in_schema"), BROKEN)
def test_what_the_loader_refuses_is_named(
    content: Any, broken: Callable[[Any], Any], says: str, in_schema: bool
) -> None:
    changed = copy.deepcopy(content)
    broken(changed)
    found = plan_problems(changed)
    assert len(found) == 1
    assert says in found[0]
    assert bool(list(schema_problems(changed, SCHEMA))) == in_schema


@pytest.mark.parametrize("content_", [None, [], 3, "Plan", {}])
def test_what_is_no_plan_at_all_is_said_not_raised(content_: object) -> None:
    assert plan_problems(content_)


def many_lines(**changes: Any) -> Plan:
    """Return a plan with sorties of some hundred lines."""
    field = build_field(to_degrees(box(0, 0, 1150, 30)), swath_width_m=3.0, frame=FRAME)
    settings = Settings(
        swath_width_m=3.0, speed_m_s=5.0, tank_l=900.0, moves=0, angle_deg=0.0, **changes
    )
    return plan_mission(field, settings, Uniform(rate_l_ha=20.0))


def test_more_items_than_there_is_room_for_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan, limit = many_lines(), 100
    for autopilot in tuple(ITEMS_MAX):
        # The planner cuts a sortie to what its autopilot holds: let it hold less afterwards.
        monkeypatch.setitem(ITEMS_MAX, autopilot, limit)
        mine = replace(plan, settings=replace(plan.settings, autopilot=autopilot))  # type: ignore[arg-type]
        for suffix in ("plan", "waypoints"):
            with pytest.raises(PlanError, match=rf"sortie 1 has \d+ items, .* {limit};"):
                write_plan(mine, tmp_path / f"m.{suffix}")
    assert list(tmp_path.iterdir()) == []


def test_more_depots_than_rally_points_are_refused(plan: Plan, tmp_path: Path) -> None:
    settings = replace(plan.settings, autopilot="px4")
    nine = replace(plan, settings=settings, depots=plan.depots * 9)
    with pytest.raises(PlanError, match="9 depots are more rally points than PX4's 8"):
        write_plan(nine, tmp_path / "m.plan")


def test_px4_gets_no_sprayer_items(plan: Plan) -> None:
    mine = replace(plan, settings=replace(plan.settings, autopilot="px4"))
    assert json.loads(plan_text(mine, mine.sorties[0]))["mission"]["firmwareType"] == 12
    with pytest.raises(PlanError, match="PX4 takes no DO_SPRAYER"):
        items_of(mine, mine.sorties[0], with_sprayer=True)


@pytest.mark.parametrize("depth_m", [0.5, 4.0, 12.0])
def test_a_wiggly_border_gets_a_fence_that_fits_and_still_holds_the_field(
    plan: Plan, depth_m: float
) -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 400, endpoint=False)
    radius = 160.0 + depth_m * np.cos(angle * 60.0)
    ground = Polygon(
        np.column_stack([100.0 + radius * np.cos(angle), 75.0 + radius * np.sin(angle)])
    )
    field = build_field(to_degrees(ground), swath_width_m=6.0, frame=FRAME)
    wiggly = replace(plan, field=field)
    fence = json.loads(plan_text(wiggly, plan.sorties[0]))["geoFence"]["polygons"]
    assert 10 < sum(len(each["polygon"]) for each in fence) <= FENCE_CORNERS_MAX["ardupilot"]
    inside = Polygon([FRAME.to_local(*corner) for corner in fence[0]["polygon"]])
    way = shapely.union_all([LineString(leg.points) for leg in plan.sorties[0].legs])
    assert inside.covers(way.buffer(0.9))
    assert field.outline.union(way).buffer(10.1).covers(inside)
    # The whole field where there is room for its corners, else what lies beside the way.
    assert inside.covers(field.outline.buffer(0.9)) is (depth_m < 9.0)
