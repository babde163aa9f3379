"""A mission and its fence onto a vehicle: asked, sent, read back, compared, and tried again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

from missions.errors import UploadError
from missions.upload.checks import FIRMWARES, Compared, blame, compare, crowded, refusal
from missions.upload.items import Firmware, MissionFile, WireItem, misplaced

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
