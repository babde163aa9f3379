"""Sorties uploaded in a row over a real socket, each with its fence, each read back.

    python -m tests.bench.uploads [--count 50] [--autopilot px4]

The stub encodes and decodes on its own; MAVSDK is the sender.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import sys
import tempfile
from pathlib import Path
from time import perf_counter
from typing import Any

from companion.errors import VrsprayError
from missions.upload.cli import read_mission_file
from missions.upload.mavsdk_vehicle import connected
from missions.upload.transfer import put
from tests.missions.realtime.upload_bench import sorties, stub_on_a_port


async def measure(autopilot: str, files: list[Path]) -> dict[str, Any]:
    """Upload all files in a row and return what became of them."""
    errors: list[str] = []
    attempts, items, corners, took_s = 0, 0, 0, list[float]()
    async with (
        stub_on_a_port(autopilot) as (server, url),
        connected(url, wait_s=20.0) as vehicle,
    ):
        for file in files:
            mission, begun = read_mission_file(file), perf_counter()
            try:
                done = await put(vehicle, mission, progress=lambda _what, _share: None)
            except VrsprayError as error:
                errors.append(f"{file.name}: {error}")
                continue
            took_s.append(perf_counter() - begun)
            attempts, items = attempts + done.attempts, items + done.items
            corners += done.fence_items
            if len(server.autopilot.flight.items) - 1 != done.items:
                errors.append(f"{file.name}: another mission is there")
    return {
        "autopilot": autopilot, "uploads": len(files), "errors": errors, "items": items,
        "fence_items": corners, "attempts": attempts, "longest_s": round(max(took_s), 2),
    }  # fmt: skip


def main() -> int:
    """Print the figures; 1 where an upload failed."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.uploads", description=__doc__)
    parser.add_argument("--count", type=int, default=50)
    parser.add_argument("--autopilot", choices=("ardupilot", "px4"), action="append")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        files = sorties(Path(folder), given.count)
        found = [
            asyncio.run(measure(autopilot, files))
            for autopilot in given.autopilot or ("ardupilot", "px4")
        ]
    sys.stdout.write(json.dumps(found, indent=1) + "\n")
    return int(any(each["errors"] or each["uploads"] != given.count for each in found))


if __name__ == "__main__":
    sys.exit(main())
