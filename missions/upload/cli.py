"""`vrspray upload`: a mission file onto the vehicle."""

from __future__ import annotations

import asyncio
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from companion.cli.answer import AsJson, answer, new_app, note
from companion.config import load
from companion.wording import counted
from missions.errors import UploadError
from missions.maps.compiling import compiled_setup
from missions.upload.items import (
    FIRMWARES,
    GLOBAL,
    SAME_FRAME,
    WAYPOINT,
    MissionFile,
    Params,
    WireItem,
    elsewhere,
)
from missions.upload.mavsdk_vehicle import connected
from missions.upload.transfer import (
    TransferError,
    Uploaded,
    What,
    each_when_flown,
    put,
    sorties_from,
)

WAIT_S = 15.0
FAILED = 1

app = new_app()


@app.command(epilog="Example: vrspray upload field.plan --link udpin:0.0.0.0:14550")
def upload(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="One sortie: .plan or .waypoints.")],
    link: Annotated[
        str,
        typer.Option(
            metavar="URL", help="udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT, serial:DEV:BAUD."
        ),
    ],
    fence: Annotated[
        bool, typer.Option("--fence/--no-fence", help="Upload the fence of a .plan, too.")
    ] = True,
    while_armed: Annotated[
        bool, typer.Option("--while-armed", help="Change the mission under an armed vehicle.")
    ] = False,
    config: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Refuse a mission that is not for its field."),
    ] = None,
    anywhere: Annotated[
        bool, typer.Option("--elsewhere", help="With --config: upload it nevertheless.")
    ] = False,
    all_sorties: Annotated[
        bool,
        typer.Option("--all", help="Upload each later sortie once the one before is flown."),
    ] = False,
    wait_s: Annotated[
        float,
        typer.Option(metavar="S", help="How long to wait for the vehicle.", min=1.0, max=600.0),
    ] = WAIT_S,
    as_json: AsJson = False,
) -> None:
    """Upload a mission and its fence, and verify them by reading them back.

    Nothing is sent to an armed vehicle, and nothing that its firmware is known to refuse.
    """
    files = sorties_from(file) if all_sorties else [file]
    missions = {path: read_mission_file(path) for path in files}
    if all_sorties and while_armed:
        raise UploadError("--all waits until each sortie is disarmed; leave out --while-armed")
    if anywhere and config is None:
        raise UploadError("--elsewhere is for --config, which says where the field is")
    if config is not None and not anywhere:
        _refuse_elsewhere(list(missions.values()), config)
    uploaded: list[dict[str, Any]] = []
    put_all = _put_all(
        missions, link, wait_s, with_fence=fence, while_armed=while_armed, uploaded=uploaded,
        is_json=as_json,
    )  # fmt: skip
    try:
        asyncio.run(put_all)
    except TransferError as error:
        if as_json:
            answer({"ok": False, "error": str(error)}, (), as_json=True)
        note(f"error: {error}")
        raise typer.Exit(FAILED) from error
    if as_json:
        more = {"files": [str(path) for path in files]} if all_sorties else {}
        answer(uploaded[-1] | more, (), as_json=True)


def _refuse_elsewhere(missions: Sequence[MissionFile], path: Path) -> None:
    """Refuse missions for another field than the configuration's."""
    setup = compiled_setup(load(path))
    for mission in missions:
        reason = elsewhere(
            mission,
            setup.prescription.field,
            setup.frame,
            reach_m=setup.boom.reach_m,
            whose=str(path),
        )
        if reason is not None:
            raise UploadError(reason)


async def _put_all(
    missions: Mapping[Path, MissionFile],
    link: str,
    wait_s: float,
    *,
    with_fence: bool,
    while_armed: bool,
    uploaded: list[dict[str, Any]],
    is_json: bool,
) -> None:
    """Upload one mission, or each of several when the one before is flown."""
    async with connected(link, wait_s=wait_s) as vehicle:

        async def upload_one(path: Path) -> None:
            done = await put(
                vehicle, missions[path], while_armed=while_armed, with_fence=with_fence,
                progress=_Progress(),
            )  # fmt: skip
            uploaded.append({"ok": True, "file": str(path), **asdict(done)})
            if not is_json:
                answer(uploaded[-1], [_line(path, done)], as_json=False)
            elif len(missions) > 1:
                note(_line(path, done))
            for text in done.left_out:
                note(f"warning: {FIRMWARES[done.firmware]} does not keep {text}")

        lasts = [
            (path, len(mission.items_for(vehicle.firmware)) - 1)
            for path, mission in missions.items()
        ]
        await each_when_flown(vehicle, lasts, upload_one, say=note)


class _Progress:
    """Says each quarter of a transfer once, on stderr."""

    def __init__(self) -> None:
        self._said: dict[str, int] = {}

    def __call__(self, what: What, share: float) -> None:
        quarter = int(4.0 * share + 1e-6)
        if quarter != self._said.get(what, 0):
            self._said[what] = quarter
            note(f"{what}: {25 * quarter} % sent")


def _line(file: Path, done: Uploaded) -> str:
    fence = f" and {done.fence_items} of its fence" if done.fence_items else ""
    again = f", at attempt {done.attempts}" if done.attempts > 1 else ""
    verb = "is" if done.items == 1 and not fence else "are"
    return (
        f"{file.name}: {counted(done.items, 'item')}{fence} {verb} on the vehicle "
        f"({FIRMWARES[done.firmware]}), read back and the same{again}"
    )


# From a `.plan` or `.waypoints` file to items; what is wrong is said with its place.

BYTES_MAX = 10_000_000
COLUMNS = 12
HEADER = "QGC WPL 110"
RETURN_POINT, POLYGON_IN, POLYGON_OUT, CIRCLE_IN, CIRCLE_OUT = 5000, 5001, 5002, 5003, 5004
CORNERS_MIN = 3


def read_mission_file(path: Path) -> MissionFile:
    """Return the mission of a file.

    Raises:
        UploadError: in one line, what is wrong where.
    """
    readers: dict[str, Callable[[Path, str], MissionFile]] = {
        ".plan": _plan, ".waypoints": _waypoints, ".txt": _waypoints,
    }  # fmt: skip
    reader = readers.get(path.suffix.casefold())
    if reader is None:
        raise UploadError(
            f"{path}: only .plan and .waypoints are uploaded; write one with vrspray plan --out"
        )
    try:
        if path.stat().st_size > BYTES_MAX:
            raise UploadError(f"{path}: too large for a mission")
        text = path.read_text(encoding="utf-8-sig")
        if not text.strip():
            raise UploadError(f"{path}: the file is empty; write it again with vrspray plan --out")
        found = reader(path, text)
    except OSError as error:
        fix = "check its name and folder"
        raise UploadError(f"{path}: {(error.strerror or str(error)).lower()}; {fix}") from error
    except RecursionError as error:
        raise UploadError(f"{path}: not a mission: too deep") from error
    except UnicodeDecodeError as error:
        raise UploadError(f"{path}: not a mission: no text") from error
    if not found.items:
        raise UploadError(f"{path}: there are no items in it")
    return found


def _number(value: object) -> float:
    """Return a number; null is a parameter left open."""
    if value is None:
        return math.nan
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{value!r:.40} is not a number")
    return float(value)


def wire_item(command: int, frame: int, numbers: list[float], *, goes_on: bool = True) -> WireItem:
    """Return an item of its seven numbers, which must fit what travels."""
    params: Params = (numbers[0], numbers[1], numbers[2], numbers[3])
    if not (0 <= command <= 65535 and 0 <= frame <= 255):
        raise ValueError(f"command {command} in frame {frame} does not exist")
    if any(math.isinf(value) for value in params):
        raise ValueError("a parameter is infinite")
    x, y, z = (0.0 if math.isnan(value) else value for value in numbers[4:7])
    scale = 1e7 if frame in SAME_FRAME else 1.0
    if frame in SAME_FRAME and not (abs(x) <= 90.0 and abs(y) <= 180.0):
        raise ValueError(f"{x:g}, {y:g} is not a place")
    if not (abs(x * scale) < 2**31 and abs(y * scale) < 2**31 and abs(z) < 1e6):
        raise ValueError(f"{x:g}, {y:g}, {z:g} is not a place")
    return WireItem(
        command=command, frame=frame, params=params, x=round(x * scale), y=round(y * scale), z_m=z,
        goes_on=goes_on,
    )  # fmt: skip


def _home(numbers: list[float]) -> WireItem:
    return wire_item(WAYPOINT, GLOBAL, [0.0, 0.0, 0.0, 0.0, *numbers])


def _waypoints(path: Path, text: str) -> MissionFile:
    lines = text.splitlines()
    if not lines or lines[0].strip() != HEADER:
        raise UploadError(f"{path}: not a mission: its first line is not {HEADER!r}")
    items: list[WireItem] = []
    row = None
    for number, line in enumerate(lines[1:], start=2):
        columns = line.split()
        if not columns:
            continue
        try:
            if len(columns) != COLUMNS:
                raise ValueError(f"{COLUMNS} columns are needed, there are {len(columns)}")
            row = _next_row(int(columns[0]), row)
            items.append(
                wire_item(
                    int(columns[3]), int(columns[2]), [float(each) for each in columns[4:11]],
                    goes_on=int(columns[11]) != 0,
                )
            )  # fmt: skip
        except ValueError as error:
            raise UploadError(f"{path}: line {number}: {error}") from error
    if row is None:
        raise UploadError(f"{path}: there are no items in it")
    if row == len(items):  # rows from 1 on: it has no home, and the vehicle sets its own
        near = next((item for item in items if item.x or item.y), items[0])
        home = wire_item(WAYPOINT, GLOBAL, [0.0] * 4 + [near.x / 1e7, near.y / 1e7, 0.0])
        return MissionFile(path=path, home=home, items=tuple(items))
    home = items.pop(0)
    if (home.command, home.frame) != (WAYPOINT, GLOBAL):
        raise UploadError(
            f"{path}: row 0 is home, and here it is command {home.command} in frame {home.frame}; "
            f"put a row of home ({WAYPOINT} in frame {GLOBAL}) before it, or number the rows from 1"
        )
    return MissionFile(path=path, home=home, items=tuple(items))


def _next_row(row: int, before: int | None) -> int:
    """Return the row's number: 0 is home, a file without begins with 1, and none is left out."""
    if row not in ((0, 1) if before is None else (before + 1,)):
        raise ValueError(f"row {row} follows {'the head' if before is None else f'row {before}'}")
    return row


def _plan(path: Path, text: str) -> MissionFile:
    try:
        content = json.loads(text)
    except ValueError as error:
        raise UploadError(f"{path}: not a plan: {error}") from error
    where = "its head"
    try:
        if content["fileType"] != "Plan":
            raise ValueError(f"fileType is {content['fileType']!r:.40}, not 'Plan'")
        mission = content["mission"]
        where = "plannedHomePosition"
        home = _home([_number(value) for value in mission["plannedHomePosition"]][:3])
        items = []
        for number, item in enumerate(mission["items"], start=1):
            where = f"item {number}"
            items.append(_simple(item))
        where = "geoFence"
        fence = _fence(content.get("geoFence") or {})
    except (KeyError, IndexError) as error:
        raise UploadError(f"{path}: {where}: {error} is missing") from error
    except (ValueError, TypeError, AttributeError) as error:
        raise UploadError(f"{path}: {where}: {error}") from error
    return MissionFile(path=path, home=home, items=tuple(items), fence=fence)


def _simple(item: dict[str, Any]) -> WireItem:
    if item["type"] != "SimpleItem":
        raise ValueError(
            f"{item.get('complexItemType', item['type'])!r:.40} is not a simple item; "
            "upload it from the ground station that made it"
        )
    numbers = [_number(value) for value in item["params"]]
    if len(numbers) != 7:
        raise ValueError(f"7 parameters are needed, there are {len(numbers)}")
    return wire_item(
        int(_number(item["command"])), int(_number(item["frame"])), numbers,
        goes_on=bool(item["autoContinue"]),
    )  # fmt: skip


def _fence(fence: dict[str, Any]) -> tuple[WireItem, ...]:
    """Return the fence as items: every corner says how many its polygon has."""
    items = []
    for polygon in fence.get("polygons", []):
        corners = polygon["polygon"]
        if len(corners) < CORNERS_MIN:
            raise ValueError(f"a polygon has {len(corners)} corners")
        command = POLYGON_IN if polygon["inclusion"] else POLYGON_OUT
        items += [_at(command, corner, len(corners)) for corner in corners]
    for circle in fence.get("circles", []):
        radius_m = _number(circle["circle"]["radius"])
        if not radius_m > 0.0:
            raise ValueError(f"a circle has a radius of {radius_m:g} m")
        command = CIRCLE_IN if circle["inclusion"] else CIRCLE_OUT
        items.append(_at(command, circle["circle"]["center"], radius_m))
    if fence.get("breachReturn"):
        items.append(_at(RETURN_POINT, fence["breachReturn"], 0.0))
    return tuple(items)


def _at(command: int, place: list[float], first: float) -> WireItem:
    latitude_deg, longitude_deg = _number(place[0]), _number(place[1])
    return wire_item(
        command, GLOBAL, [float(first), 0.0, 0.0, 0.0, latitude_deg, longitude_deg, 0.0]
    )
