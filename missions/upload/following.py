"""All sorties of a plan onto a vehicle: each next one when the one before is flown and landed.

Nothing here arms or starts anything: people stand at the vehicle while it is refilled.
"""

from __future__ import annotations

import json
import re
from collections.abc import AsyncGenerator, Awaitable, Callable
from contextlib import aclosing
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from missions.errors import UploadError

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
                "fly the rest of it, or stop here and plan it anew (plan --resume)"
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
        features = json.loads(lines.read_text(encoding="utf-8"))["features"]
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
