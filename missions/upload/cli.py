"""`vrspray upload`: a mission file onto the vehicle."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from companion.cli.answer import AsJson, answer, note
from companion.config import load
from companion.wording import counted
from missions.errors import UploadError
from missions.maps.compiling import compiled_setup
from missions.upload.checks import FIRMWARES
from missions.upload.following import each_when_flown, sorties_from
from missions.upload.items import MissionFile, elsewhere
from missions.upload.mavsdk_vehicle import connected
from missions.upload.reading import read_mission_file
from missions.upload.transfer import TransferError, Uploaded, What, put

WAIT_S = 15.0
FAILED = 1

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)


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
        typer.Option("--all", help="Then each later sortie, when the one before is flown."),
    ] = False,
    wait_s: Annotated[
        float, typer.Option(metavar="S", help="For the vehicle.", min=1.0, max=600.0)
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
