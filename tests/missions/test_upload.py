"""Mission files for upload, what firmwares refuse, and what counts as the same on the vehicle."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import shapely

from companion.cli.app import execute
from companion.core.frame import LocalFrame
from missions.errors import UploadError
from missions.upload.cli import read_mission_file
from missions.upload.items import (
    Firmware,
    MissionFile,
    WireItem,
    compare,
    crowded,
    elsewhere,
    refusal,
)
from missions.upload.transfer import (
    NotNowError,
    Progress,
    RefusedError,
    TransferError,
    What,
    put,
)

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "anyang"
HOME = WireItem(command=16, frame=0, x=480_000_000, y=110_000_000)
OPEN = math.nan
ITEMS = (
    WireItem(command=22, frame=3, params=(0, 0, 0, OPEN), x=480_000_000, y=110_000_000, z_m=3.5),
    WireItem(command=178, frame=2, params=(1, 6, -1, 0)),
    WireItem(command=16, frame=3, params=(0, 0, 0, 30.0), x=480_001_000, y=110_001_000, z_m=3.5),
    WireItem(command=20, frame=2),
)
CORNERS = tuple(
    WireItem(command=5001, frame=0, params=(3, 0, 0, 0), x=x, y=y)
    for x, y in ((479_990_000, 109_990_000), (480_020_000, 110_000_000), (479_990_000, 110_020_000))
)
FILE = MissionFile(path=Path("m.plan"), home=HOME, items=ITEMS, fence=CORNERS)

# Two rows of a `.waypoints` file behind index and "current".
TAKES_OFF = "3 22 0 0 0 0 48.0001 11.0001 3.5 1\n"
GOES = "3 16 0 0 0 0 48.0002 11.0002 3.5 1\n"


def plan_file(tmp_path: Path, **changes: Any) -> Path:
    simple = {"type": "SimpleItem", "command": 16, "frame": 3, "autoContinue": True,
              "params": [0, 0, 0, None, 48.0001, 11.0, 3.5]}  # fmt: skip
    content = {
        "fileType": "Plan",
        "mission": {"plannedHomePosition": [48.0, 11.0, 0.0],
                    "items": [simple | changes.pop("item", {})]},
        "geoFence": {"polygons": [], "circles": []},
    }  # fmt: skip
    path = tmp_path / "m.plan"
    path.write_text(json.dumps(content | changes))
    return path


def test_a_plan_is_read_with_its_open_parameters_and_all_of_its_fence(tmp_path: Path) -> None:
    ring = [[48.0, 11.0], [48.0, 11.1], [48.1, 11.1]]
    fence = {
        "polygons": [{"inclusion": False, "polygon": ring}],
        "circles": [{"inclusion": True, "circle": {"center": [48.0, 11.0], "radius": 90.0}}],
        "breachReturn": [48.0, 11.0, 5.0],
    }
    found = read_mission_file(plan_file(tmp_path, geoFence=fence))
    assert (found.home.x, found.items[0].x, found.items[0].z_m) == (480_000_000, 480_001_000, 3.5)
    assert math.isnan(found.items[0].params[3])
    assert [(each.command, each.params[0]) for each in found.fence] == [
        (5002, 3.0), (5002, 3.0), (5002, 3.0), (5003, 90.0), (5000, 0.0)
    ]  # fmt: skip


def test_numbers_without_a_place_travel_as_they_are(tmp_path: Path) -> None:
    item = {"frame": 2, "command": 187, "params": [0, 0, 0, 0, 7, 0, 2]}
    found = read_mission_file(plan_file(tmp_path, item=item)).items[0]
    assert (found.x, found.z_m) == (7, 2.0)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"fileType": "Survey"}, "its head: fileType is 'Survey'"),
        ({"mission": {"items": []}}, "'plannedHomePosition' is missing"),
        ({"item": {"type": "ComplexItem"}}, "item 1: 'ComplexItem' is not a simple item"),
        ({"item": {"params": [0, 0, 0]}}, "item 1: 7 parameters are needed, there are 3"),
        ({"item": {"params": [0, 0, 0, 0, 98.0, 0, 0]}}, "item 1: 98, 0 is not a place"),
        ({"item": {"params": [0, "x", 0, 0, 8.0, 0, 0]}}, "item 1: 'x' is not a number"),
        ({"item": {"params": [0, math.inf, 0, 0, 8.0, 0, 0]}}, "item 1: a parameter is infinite"),
        ({"item": {"frame": 3000}}, "item 1: command 16 in frame 3000 does not exist"),
        ({"geoFence": {"polygons": [{"inclusion": True, "polygon": [[0, 0]]}]}}, "has 1 corners"),
    ],
)
def test_a_wrong_plan_is_refused_with_the_place(
    tmp_path: Path, changes: dict[str, Any], says: str
) -> None:
    with pytest.raises(UploadError, match=says):
        read_mission_file(plan_file(tmp_path, **changes))


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("m.kml", "", "only .plan and .waypoints"),
        ("m.plan", "{", "not a plan"),
        ("m.plan", "[" * 100_000, "too deep"),
        ("m.plan", "\n", "m.plan: the file is empty; write it again with vrspray plan --out"),
        ("m.waypoints", "QGC WPL 120\n", "first line is not 'QGC WPL 110'"),
        ("m.waypoints", "QGC WPL 110\n", "no items"),
        ("m.waypoints", "QGC WPL 110\n0 1 0 16 0\n", "line 2: 12 columns are needed, there are 5"),
        ("m.waypoints", "QGC WPL 110\n0 1 0 16 0 0 0 0 1 2 nil 1\n", "line 2: could not convert"),
        ("m.waypoints", f"QGC WPL 110\n0 1 {TAKES_OFF}1 0 {GOES}", "row 0 is home, and here it is"),
        ("m.waypoints", f"QGC WPL 110\n0 1 {GOES}1 0 {GOES}", "command 16 in frame 3"),
        ("m.waypoints", f"QGC WPL 110\n2 0 {GOES}", "line 2: row 2 follows the head"),
        ("m.waypoints", f"QGC WPL 110\n1 0 {GOES}3 0 {GOES}", "line 3: row 3 follows row 1"),
        ("m.waypoints", f"QGC WPL 110\n1 0 {GOES}0 0 {GOES}", "line 3: row 0 follows row 1"),
    ],
)
def test_a_wrong_file_is_one_line_and_exit_2(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, name: str, text: str, says: str
) -> None:
    path = tmp_path / name
    path.write_text(text)
    assert execute(["upload", str(path), "--link", "udpin:127.0.0.1:14550", "--json"]) == 2
    out, err = capsys.readouterr()
    assert says in json.loads(out)["error"]
    assert len(err.splitlines()) == 1


def test_a_file_that_has_no_home_loses_no_item(tmp_path: Path) -> None:
    """Its rows begin with 1: the first is no home, and a take-off stays one."""
    path = tmp_path / "m.waypoints"
    path.write_text(f"QGC WPL 110\n1 0 {TAKES_OFF}2 0 {GOES}")
    found = read_mission_file(path)
    assert [item.command for item in found.items] == [22, 16]
    assert found.home == WireItem(command=16, frame=0, x=480_001_000, y=110_001_000)
    assert [item.command for item in found.items_for("ardupilot")] == [16, 22, 16]
    assert [item.command for item in found.items_for("px4")] == [22, 16]


def test_a_mission_and_a_device_that_are_not_there_are_refused_with_what_to_do(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    link = ["--link", f"serial:{tmp_path / 'nope'}:57600"]
    assert execute(["upload", str(tmp_path / "none.plan"), *link]) == 2
    assert "no such file or directory; check its name and folder" in capsys.readouterr().err
    assert execute(["upload", str(plan_file(tmp_path)), *link]) == 2
    refused = capsys.readouterr().err
    assert "nope:57600: cannot be opened: there is no such device; plug it in" in refused
    assert "CONNECTION_ERROR" not in refused


def test_a_wrong_link_is_refused_by_name(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert execute(["upload", str(plan_file(tmp_path)), "--link", "14550"]) == 2
    assert "write udpin:HOST:PORT" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("item", "firmware", "says"),
    [
        (
            WireItem(command=178, frame=3, params=(1, 5, -1, 0)),
            "px4",
            "item 5: PX4 takes DO_CHANGE_SPEED in frame 2 only, not in 3",
        ),
        (WireItem(command=20, frame=3), "px4", "PX4 takes RETURN_TO_LAUNCH in frame 2 only"),
        (WireItem(command=21, frame=2), "px4", "PX4 takes LAND in frame 3 only, not in 2"),
        (WireItem(command=178, frame=1), "px4", "PX4 takes no DO_CHANGE_SPEED in frame 1"),
        (WireItem(command=16, frame=4), "ardupilot", "no WAYPOINT in frame 4; write frame 3"),
        (WireItem(command=178, frame=3), "ardupilot", None),
        (WireItem(command=113, frame=2), "ardupilot", "ArduPilot takes no command 113"),
        (WireItem(command=216, frame=2), "px4", "item 5: PX4 takes no DO_SPRAYER; plan without"),
        (WireItem(command=16, frame=10), "px4", "item 5: PX4 takes no height above terrain"),
        (WireItem(command=187, frame=2), "ardupilot", "ArduPilot takes no DO_SET_ACTUATOR"),
        (WireItem(command=216, frame=2), "ardupilot", None),
        (WireItem(command=16, frame=10), "ardupilot", None),
    ],
)
def test_what_a_firmware_refuses_is_known_before_it_is_asked(
    item: WireItem, firmware: Firmware, says: str | None
) -> None:
    found = refusal(replace(FILE, items=(*ITEMS, item)), firmware)
    assert found is None if says is None else says in (found or "")


@pytest.mark.parametrize(
    ("item", "firmware", "says"),
    [
        (WireItem(command=21, frame=3), "px4", r"item 5 \(LAND\): it is at 0, 0, .*Atlantic"),
        (WireItem(command=16, frame=6, z_m=3.5), "px4", r"item 5 \(WAYPOINT\): it is at 0, 0"),
        (WireItem(command=21, frame=3), "ardupilot", None),
        (WireItem(command=21, frame=3, x=480_000_000, y=110_700_000), "ardupilot", "than 5 km"),
        (WireItem(command=16, frame=3, x=-480_000_000, y=-690_000_000), "px4", "than 5 km"),
        (WireItem(command=16, frame=2, x=36, y=114, z_m=3.5), "ardupilot", "frame 2 has none"),
        (WireItem(command=21, frame=3, x=480_001_000, y=110_001_000), "px4", None),
        (WireItem(command=20, frame=2), "px4", None),
    ],
)
async def test_an_item_that_leads_away_is_refused_before_anything_is_sent(
    item: WireItem, firmware: Firmware, says: str | None
) -> None:
    vehicle = Fake(firmware)
    file = replace(FILE, items=(*ITEMS, item), fence=())
    if says is None:
        assert (await put(vehicle, file, progress=nothing)).items == 5
        return
    with pytest.raises(UploadError, match=says):
        await put(vehicle, file, progress=nothing)
    assert vehicle.kept == {}


FRAME = LocalFrame(48.0, 11.0)


def over(*places_m: tuple[float, float]) -> MissionFile:
    """Return a mission with waypoints at places in metres east and north of home."""
    found = []
    for east_m, north_m in places_m:
        latitude, longitude = FRAME.to_geographic(east_m, north_m)
        x, y = round(latitude * 1e7), round(longitude * 1e7)
        found.append(WireItem(command=16, frame=3, x=x, y=y, z_m=3.5))
    return replace(FILE, items=(*ITEMS[:2], *found, ITEMS[3]), fence=())


@pytest.mark.parametrize(
    ("places_m", "says"),
    [
        (((20.0, 100.0), (20.0, 300.0)), None),
        (((-1.5, 100.0), (-1.5, 300.0)), None),  # beside it, and the boom reaches it
        (((-3000.0, 200.0), (500.0, 200.0)), None),  # from a depot far away, across it
        (((-9.0, 100.0), (-9.0, 300.0)), "no way of the mission leads over .*is 9 m from it"),
        (((20.0, -900.0), (60.0, -900.0)), r"no way .*item 1 \(TAKEOFF\), is 50 m from it"),
        (((20.0, 100.0), (20.0, 5690.0)), r"item 4 \(WAYPOINT\): .* is 5.1 km from"),
        (((30_000.0, 0.0), (30_000.0, 300.0)), r"item 3 \(WAYPOINT\): .* is 29.9 km from"),
        ((), "no way of the mission leads over the field of c.toml;"),
    ],
)
def test_a_mission_that_lies_elsewhere_is_known(
    places_m: tuple[tuple[float, float], ...], says: str | None
) -> None:
    field = shapely.box(0.0, 50.0, 100.0, 550.0)
    found = elsewhere(over(*places_m), field, FRAME, reach_m=3.0, whose="c.toml")
    assert found is None if says is None else re.search(says, found or "")


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--elsewhere",), "--elsewhere is for --config"),
        (("--config", str(EXAMPLE / "config.toml")), "km from the field of"),
    ],
)
def test_a_mission_over_another_field_reaches_no_link(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, options: tuple[str, ...], says: str
) -> None:
    file = str(plan_file(tmp_path))
    assert execute(["upload", file, "--link", "udpin:127.0.0.1:14550", *options]) == 2
    assert says in capsys.readouterr().err


def corners(command: int, *places: tuple[int, int]) -> tuple[WireItem, ...]:
    return tuple(
        WireItem(command=command, frame=0, params=(len(places), 0, 0, 0), x=x, y=y)
        for x, y in places
    )


@pytest.mark.parametrize(
    ("sizes", "circles", "is_sent"),
    [
        # As ArduCopter 4.7 answered: accepted, refused by itself, or halted ("Fence corrupt").
        ((69,), 0, True), ((64, 4), 0, True), ((61,), 5, True), ((67,), 1, True),
        ((47, 4, 4, 4, 4, 4), 0, True), ((), 42, True), ((71,), 0, True), ((200,), 0, True),
        ((65, 4), 0, False), ((48, 4, 4, 4, 4, 4), 0, False), ((70,), 0, False),
        ((68,), 1, False), ((), 43, False),
    ],
)  # fmt: skip
def test_a_fence_that_would_halt_arducopter_is_not_sent(
    sizes: tuple[int, ...], circles: int, is_sent: bool
) -> None:
    fence = [item for size in sizes for item in corners(5002, *((k, k) for k in range(size)))]
    fence += [WireItem(command=5004, frame=0, params=(5, 0, 0, 0), x=1, y=1)] * circles
    file = replace(FILE, fence=tuple(fence))
    assert (crowded(file, "ardupilot") is None) == is_sent
    assert crowded(file, "px4") is None


AROUND = corners(
    5001,
    (479_990_000, 109_990_000), (480_010_000, 109_990_000), (480_010_000, 110_010_000),
    (479_990_000, 110_010_000),
)  # fmt: skip
LESS = corners(
    5001, (479_990_000, 109_990_000), (480_000_500, 109_990_000), (480_000_500, 110_010_000)
)
POND = corners(
    5002, (480_000_900, 110_000_900), (480_001_100, 110_000_900), (480_001_000, 110_001_100)
)
CIRCLE = WireItem(command=5003, frame=0, params=(8.0, 0, 0, 0), x=480_000_000, y=110_000_000)


@pytest.mark.parametrize(
    ("fence", "says"),
    [
        (AROUND, None),
        (LESS, r"item 3 \(WAYPOINT\): it is outside the fence"),
        ((*AROUND, *POND), r"item 3 \(WAYPOINT\): it is where the fence forbids it"),
        ((CIRCLE,), "item 3 .*outside the fence"),
        ((replace(CIRCLE, params=(80.0, 0, 0, 0)),), None),
    ],
)
async def test_an_item_outside_the_fence_of_its_file_is_refused(
    fence: tuple[WireItem, ...], says: str | None
) -> None:
    file = replace(FILE, fence=fence)
    if says is not None:
        with pytest.raises(UploadError, match=says):
            await put(Fake(), file, progress=nothing)
    assert (await put(Fake(), file, with_fence=says is None, progress=nothing)).items == 4


def test_the_zero_yaw_of_a_waypoint_file_is_left_open_for_px4_only() -> None:
    items = (*ITEMS, WireItem(command=16, frame=3, x=480_001_000, y=110_001_000, z_m=3.5))
    file = replace(FILE, path=Path("m.waypoints"), items=items)
    assert math.isnan(file.items_for("px4")[-1].params[3])
    assert file.items_for("px4")[2].params[3] == 30.0
    assert file.items_for("ardupilot")[-1].params[3] == 0.0
    assert replace(file, path=Path("m.plan")).items_for("px4")[-1].params[3] == 0.0


@pytest.mark.parametrize(("firmware", "asked"), [("px4", 2), ("ardupilot", 3)])
async def test_the_item_that_the_vehicle_refuses_is_named(firmware: Firmware, asked: int) -> None:
    vehicle = Fake(firmware)
    vehicle.refuses_at = asked
    with pytest.raises(UploadError, match=r"m.plan: item 3 \(WAYPOINT in frame 3, .*48.0001"):
        await put(vehicle, replace(FILE, fence=()), progress=nothing)


def changed(number: int, **changes: Any) -> list[WireItem]:
    return [replace(item, **changes) if n == number else item for n, item in enumerate(ITEMS)]


def test_what_firmwares_round_is_still_the_same() -> None:
    back = changed(2, x=480_001_002, z_m=3.49, frame=6, params=(OPEN, 0, 0, 390.0))
    assert compare(ITEMS, back, "px4").differences == ()


@pytest.mark.parametrize(
    ("back", "says"),
    [
        (ITEMS[:-1], "4 items sent, 3 are there"),
        (changed(2, command=82), "item 3 (WAYPOINT): SPLINE_WAYPOINT is there"),
        (changed(2, y=110_001_003), "was at 48.0001000 11.0001000"),
        (changed(2, z_m=3.4), "was 3.5 m high, 3.4 is there"),
        (changed(2, z_m=OPEN), "was 3.5 m high, nan is there"),
        (changed(2, frame=0), "was in frame 3, 0 is there"),
        (changed(1, params=(1, 5, -1, 0)), "item 2 (DO_CHANGE_SPEED): parameter 2 was 6, 5"),
        (changed(1, params=(1, OPEN, -1, 0)), "parameter 2 was 6, nan"),
        (changed(2, params=(5, 0, 0, 30)), "parameter 1 was 0, 5"),
    ],
)
def test_another_mission_is_not_the_same(back: Sequence[WireItem], says: str) -> None:
    assert says in compare(ITEMS, back, "px4").differences[0]


@pytest.mark.parametrize("yaw", [OPEN, 0.0])
def test_a_landing_reads_back_from_arducopter_with_a_yaw_of_its_own(yaw: float) -> None:
    sent = WireItem(command=21, frame=3, params=(0, 0, 0, yaw), x=480_001_000, y=110_001_000)
    found = compare((HOME, sent), (HOME, replace(sent, params=(0, 0, 0, 1.0))), "ardupilot")
    assert (found.differences, found.left_out) == ((), ())


def test_a_corner_of_the_fence_has_a_place_and_no_height() -> None:
    lower = [replace(corner, z_m=9.0) for corner in CORNERS]
    assert compare(CORNERS, lower, "ardupilot").differences == ()
    moved = [replace(CORNERS[0], x=0), *CORNERS[1:]]
    assert "item 1 (command 5001): was at" in compare(CORNERS, moved, "ardupilot").differences[0]


class Fake:
    """A vehicle with faults as fields."""

    def __init__(self, firmware: Firmware = "ardupilot") -> None:
        self.firmware: Firmware = firmware
        self.armed: bool | None = False
        self.breaks = 0
        self.forgets = 0
        self.refuses_at: int | None = None
        self.kept: dict[str, tuple[WireItem, ...]] = {}
        self.current, self.stays = 3, 0

    async def begin(self) -> None:
        if self.stays:
            self.stays -= 1
            raise NotNowError("the first item is not the current one (TIMEOUT)")
        self.current = 0

    async def is_armed(self) -> bool | None:
        return self.armed

    async def send(self, what: What, items: Sequence[WireItem], progress: Progress) -> None:
        if self.breaks:
            self.breaks -= 1
            raise NotNowError("the transfer broke off (TIMEOUT)")
        if self.refuses_at is not None:
            raise RefusedError("the vehicle refuses the mission", self.refuses_at)
        self.kept[what] = tuple(items)
        progress(what, 1.0)

    async def read(self, what: What) -> tuple[WireItem, ...]:
        if self.forgets:
            self.forgets -= 1
            return self.kept[what][:-1]
        return self.kept[what]


def nothing(_what: What, _share: float) -> None:
    pass


async def test_a_broken_transfer_is_tried_again_and_a_short_one_too() -> None:
    vehicle = Fake()
    vehicle.breaks = vehicle.forgets = 1
    done = await put(vehicle, replace(FILE, fence=()), progress=nothing)
    assert (done.attempts, done.items) == (3, 4)
    assert vehicle.kept["mission"] == (HOME, *ITEMS)


@pytest.mark.parametrize(("fault", "says"), [("breaks", "TIMEOUT"), ("forgets", "2 are there")])
async def test_after_three_attempts_it_is_said_not_to_be_there(fault: str, says: str) -> None:
    vehicle = Fake("px4")
    setattr(vehicle, fault, 99)
    with pytest.raises(TransferError, match=f"after 3 attempts: .*{says}.*do not fly it"):
        await put(vehicle, FILE, progress=nothing)
    assert "mission" not in vehicle.kept


async def test_px4_begins_the_mission_anew_and_an_armed_one_flies_on() -> None:
    vehicle = Fake("px4")
    vehicle.stays = 2
    await put(vehicle, FILE, progress=nothing)
    assert vehicle.current == 0
    armed = Fake("px4")
    armed.armed = True
    await put(armed, FILE, while_armed=True, progress=nothing)
    assert armed.current == 3
    stays = Fake("px4")
    stays.stays = 99
    with pytest.raises(TransferError, match="would go on in the middle of it"):
        await put(stays, FILE, progress=nothing)


@pytest.mark.parametrize(("armed", "says"), [(True, "is armed"), (None, "fell silent")])
async def test_nothing_is_sent_to_one_that_is_armed_or_silent(
    armed: bool | None, says: str
) -> None:
    vehicle = Fake()
    vehicle.armed = armed
    with pytest.raises(UploadError, match=says):
        await put(vehicle, FILE, progress=nothing)
    assert vehicle.kept == {}


async def test_a_copters_lost_yaw_is_named_and_is_no_failure() -> None:
    vehicle = Fake()

    async def read(what: What) -> tuple[WireItem, ...]:
        return tuple(replace(item, params=(*item.params[:3], 0.0)) for item in vehicle.kept[what])

    vehicle.read = read  # type: ignore[method-assign]
    done = await put(vehicle, FILE, progress=nothing)
    assert done.left_out == ("item 3 (WAYPOINT): parameter 4 was 30, 0 is there",)
