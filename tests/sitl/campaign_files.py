"""A campaign whose flights are short: the beginning of one pass over the example's field."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any

from companion.errors import VrsprayError
from sitl.anyang import EXAMPLE
from sitl.campaign.bundle import Bundle, bundle_of, unpack
from sitl.campaign.dataset import Dataset, open_dataset
from sitl.campaign.design import Campaign, read_campaign
from sitl.campaign.running import Tally, fly_missing

# Home, take-off, 5 m/s, and 45 m along the first pass.
MISSION = """\
QGC WPL 110
0 1 0 16 0 0 0 0 35.9959511 114.5434850 0 1
1 0 3 22 0 0 0 0 35.9959511 114.5434850 3.5 1
2 0 2 178 1 5 -1 0 0 0 0 1
3 0 3 16 0 0 0 0 35.9963478 114.5435887 3.5 1
"""
HEAD = """\
version = 1
[fixed]
flight.config = "field/config.toml"
flight.mission = "field/short.waypoints"
"""

VARIED = """
seeds = 4
[[vary]]
set = "vehicle.gust_m_s"
values = [0.0, 1.0, 2.0]
[[vary]]
set = "config.lag.up_s"
values = [0.10, -1.0]
"""


def write_campaign(folder: Path, text: str) -> Path:
    """Write a campaign beside its own copies of configuration, map and a short mission."""
    field = folder / "field"
    field.mkdir(parents=True)
    for path in [*EXAMPLE.glob("prescription.*"), EXAMPLE / "config.toml"]:
        shutil.copy(path, field)
    shutil.copy(EXAMPLE / "boundary.geojson", field)
    (field / "short.waypoints").write_text(
        MISSION.replace(" ", "\t").replace("QGC\tWPL\t", "QGC WPL ")
    )
    path = folder / "short.toml"
    path.write_text(HEAD.replace("version = 1\n", f"version = 1\n{text}", 1))
    return path


def files_of(folder: Path) -> dict[str, bytes]:
    """Return the dataset of a campaign to the byte; how fast it was is no part of it."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != "log.jsonl"
    }


class OwnProcess:
    """Flies in this process, at once."""

    deaths = 1
    lost_count = 0

    def __init__(self, folder: Path) -> None:
        self.folder: Path | None = folder

    def count(self) -> int:
        return 1

    def submit(self, function: Callable[..., Any], *given: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(function(*given))
        except VrsprayError as error:
            future.set_exception(error)
        return future

    def lost(self, error: BaseException) -> bool:
        return False

    def renew(self) -> None:
        raise AssertionError


def opened(file: Path, out: Path) -> tuple[Dataset, Bundle]:
    campaign = read_campaign(file)
    bundle = bundle_of(campaign)
    return open_dataset(campaign, bundle, out), bundle


def fly_here(file: Path, out: Path) -> Tally:
    """Fly what a dataset lacks in this process alone."""
    dataset, bundle = opened(file, out)
    tally = Tally()
    workers = OwnProcess(unpack(bundle, out.with_name(f"{out.name}-bundle")))
    fly_missing(dataset, bundle, workers, tally, tell=lambda _: None)
    return tally


def designed(folder: Path, kind: str, samples: int) -> Campaign:
    return read_campaign(
        write_campaign(
            folder,
            f'seeds = {{first = 5, count = 2}}\n[design]\nkind = "{kind}"\nsamples = {samples}\n'
            '[[vary]]\nset = "vehicle.gust_m_s"\nlow = 1.0\nhigh = 3.0\n'
            '[[vary]]\nset = "flight.fidelity"\nvalues = ["averaged", "pulsed"]\n',
        )
    )
