"""A mission and its fence onto a vehicle: asked, sent, read back, compared, and tried again.

All sorties of a plan onto a vehicle: each next one when the one before is flown and landed. Nothing
here arms or starts anything: people stand at the vehicle while it is refilled.
"""

from __future__ import annotations

import json
import re
from collections.abc import AsyncGenerator, Awaitable, Callable, Sequence
from contextlib import aclosing
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

from missions.errors import UploadError
from missions.upload.items import (
    FIRMWARES,
    Compared,
    Firmware,
    MissionFile,
    WireItem,
    blame,
    compare,
    crowded,
    misplaced,
    refusal,
)

What = Literal["mission", "fence"]
Progress = Callable[[What, float], None]
ATTEMPTS = 3


class TransferError(UploadError):
    """The work failed: nothing was wrong with what was asked."""


class NotNowError(Exception):
    """A transfer broke off; it may go through when it is tried again."""


class RefusedError(UploadError):
    """The vehicle refuses; `asked` is the number of the item that it last asked for."""

    def __init__(self, text: str, asked: int | None = None) -> None:
        super().__init__(text)
        self.asked = asked


class Vehicle(Protocol):
    """A vehicle on a link.

    `send` and `read` raise `NotNowError` where another attempt may help, and `RefusedError` where
    the vehicle says no.
    """

    firmware: Firmware

    async def is_armed(self) -> bool | None:
        """Return what its newest heartbeat says; None where there is none."""

    async def send(self, what: What, items: Sequence[WireItem], progress: Progress) -> None:
        """Upload all items."""

    async def read(self, what: What) -> tuple[WireItem, ...]:
        """Read back what is there."""

    async def begin(self) -> None:
        """Make the mission's first item the one to fly to."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Uploaded:
    """What is on the vehicle now; `left_out` is what it does not keep."""

    firmware: Firmware
    items: int
    fence_items: int
    attempts: int
    left_out: tuple[str, ...]


async def put(
    vehicle: Vehicle,
    file: MissionFile,
    *,
    while_armed: bool = False,
    with_fence: bool = True,
    progress: Progress,
) -> Uploaded:
    """Upload fence and mission, and prove by reading back that they are there.

    The fence goes first: where it is refused, the vehicle keeps the mission that it had. PX4 would
    go on with the item at which it left the same mission; disarmed, it is told to begin.

    Raises:
        UploadError: the vehicle will not have it, or must not be given it now.
        TransferError: it did not get there, or is not what was sent.
    """
    reason = refusal(file, vehicle.firmware) or misplaced(
        file, vehicle.firmware, with_fence=with_fence
    )
    if reason is None and with_fence:
        reason = crowded(file, vehicle.firmware)
    if reason is not None:
        raise UploadError(reason)
    fence = file.fence if with_fence else ()
    parts: tuple[tuple[What, tuple[WireItem, ...]], ...] = (
        ("fence", fence),
        ("mission", file.items_for(vehicle.firmware)),
    )
    attempts, left_out, is_armed = 0, list[str](), True
    for what, items in parts:
        if items:
            is_armed = await _refuse_armed(vehicle, while_armed=while_armed)
            try:
                tried, compared = await _put_one(vehicle, what, items, progress)
            except RefusedError as error:
                named = blame(file, vehicle.firmware, error.asked) if what == "mission" else None
                raise UploadError(
                    f"{file.path}: {named}: {error}" if named else str(error)
                ) from error
            attempts = max(attempts, tried)
            left_out += compared.left_out
    if vehicle.firmware == "px4" and not is_armed:
        await _begin(vehicle)
    return Uploaded(
        firmware=vehicle.firmware, items=len(file.items), fence_items=len(fence),
        attempts=attempts, left_out=tuple(left_out),
    )  # fmt: skip


async def _refuse_armed(vehicle: Vehicle, *, while_armed: bool) -> bool:
    """Return whether it is armed, which it may be `while_armed` only."""
    armed = await vehicle.is_armed()
    if armed is None:
        raise TransferError("the vehicle fell silent; nothing more was sent to it")
    if armed and not while_armed:
        raise UploadError(
            "the vehicle is armed; disarm it, or say --while-armed to change the mission under it"
        )
    return armed


async def _begin(vehicle: Vehicle) -> None:
    for _ in range(ATTEMPTS):
        try:
            return await vehicle.begin()
        except NotNowError as error:
            reason = str(error)
    raise TransferError(
        f"the mission is on the vehicle ({FIRMWARES[vehicle.firmware]}), which would go on in the "
        f"middle of it: {reason}; do not fly it, and upload it again"
    )


async def _put_one(
    vehicle: Vehicle, what: What, items: Sequence[WireItem], progress: Progress
) -> tuple[int, Compared]:
    """Return how many attempts it took, and what the vehicle leaves out."""
    reason = ""
    for attempt in range(1, ATTEMPTS + 1):
        try:
            await vehicle.send(what, items, progress)
            compared = compare(items, await vehicle.read(what), vehicle.firmware)
        except NotNowError as error:
            reason = str(error)
            continue
        if not compared.differences:
            return attempt, compared
        more = len(compared.differences) - 1
        reason = compared.differences[0] + (f", and {more} more" if more else "")
    name = FIRMWARES[vehicle.firmware]
    raise TransferError(
        f"the {what} is not on the vehicle ({name}) after {ATTEMPTS} attempts: {reason}; "
        "do not fly it, and upload it again"
    )


_NUMBERED = re.compile(r"(.+)-([2-9]|[1-9]\d+)")


@dataclass(frozen=True, slots=True, kw_only=True)
class Seen:
    """One heartbeat of the autopilot: armed or not, and the newest item of the mission."""

    is_armed: bool
    sequence: int | None = None


class Watched(Protocol):
    """A vehicle whose flight is watched."""

    def watch(self) -> AsyncGenerator[Seen, None]:
        """Yield what each heartbeat tells; silence is waited for."""


@dataclass(slots=True)
class Flight:
    """Whether a sortie is flown: armed, at its last item, and disarmed again."""

    last: int
    farthest: int = 0
    was_armed: bool = False

    def take(self, seen: Seen) -> bool:
        """Take a heartbeat; return whether the vehicle has just landed."""
        if seen.is_armed:
            self.was_armed = True
            self.farthest = max(self.farthest, seen.sequence or 0)
            return False
        landed, self.was_armed = self.was_armed, False
        return landed

    @property
    def is_flown(self) -> bool:
        """Return whether the last item was reached."""
        return self.farthest >= self.last


async def until_flown(vehicle: Watched, last: int, *, say: Callable[[str], None]) -> None:
    """Wait until the mission on the vehicle is flown to its last item and the vehicle disarmed.

    A flight that ends earlier is said, and waited on: it may be gone on with.
    """
    flight = Flight(last=last)
    async with aclosing(vehicle.watch()) as beats:
        async for seen in beats:
            if not flight.take(seen):
                continue
            if flight.is_flown:
                return
            say(
                f"landed at item {flight.farthest} of {last}: the sortie is not flown to its end; "
                "fly the rest of it, or stop here and plan the rest again (plan --resume)"
            )


def sorties_from(path: Path) -> list[Path]:
    """Return the file and those of the later sorties of its plan, which must all be there.

    How many there are is in the `.lines.geojson` beside them: files of an earlier, longer plan
    may still lie in the folder.

    Raises:
        UploadError: in one line, which file is missing.
    """
    stem, first = path.stem, 1
    lines = path.with_name(f"{stem}.lines.geojson")
    numbered = _NUMBERED.fullmatch(stem)
    if not lines.exists() and numbered is not None:
        stem, first = numbered[1], int(numbered[2])
        lines = path.with_name(f"{stem}.lines.geojson")
    count = _count(lines, path)
    if not first <= count:
        raise UploadError(
            f"{path}: {lines.name} has {count} sorties; this is a file of another plan"
        )
    names = [f"{stem}-{number}{path.suffix}" for number in range(first + 1, count + 1)]
    found = [path, *(path.with_name(name) for name in names)]
    missing = [each.name for each in found if not each.is_file()]
    if missing:
        raise UploadError(f"{path}: {missing[0]} is missing beside it; plan it again")
    return found


def _count(lines: Path, path: Path) -> int:
    """Return the number of sorties of a plan."""
    try:
        features = json.loads(lines.read_text(encoding="utf-8-sig"))["features"]
        sorties = {each["properties"].get("sortie") for each in features} - {None}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise UploadError(
            f"{path}: --all needs {lines.name} beside it, as vrspray plan writes it; "
            "upload one sortie at a time without it"
        ) from error
    return len(sorties)


async def each_when_flown(
    vehicle: Watched,
    files: list[tuple[Path, int]],
    upload: Callable[[Path], Awaitable[None]],
    *,
    say: Callable[[str], None],
) -> None:
    """Upload every file, the next one when the one before is flown; `files` are with last items."""
    for number, (path, last) in enumerate(files, start=1):
        await upload(path)
        if number < len(files):
            following = files[number][0].name
            say(f"{path.name} may be flown; {following} follows when it is flown and disarmed")
            await until_flown(vehicle, last, say=say)
