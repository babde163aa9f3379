"""Fly a fault campaign: progress on stderr, the result on stdout, the table into the documents.

    python -m tests.bench.faults --flights 200 --seed 1 [--only 'SIGKILL'] [--json] [--page]

A flight that the valve engine refuses because the computer is too busy is repeated, twice at most.
Exit 1 when a limit was broken or a flight did not come to spraying; 130 when interrupted, with the
result of the flights so far.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import shlex
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from tests.bench.faults.cases import Draw, campaign
from tests.bench.faults.flight import NotFlownError, fly
from tests.bench.faults.judge import Verdict, judge
from tests.bench.faults.record import Record
from tests.bench.faults.report import result, write_page

INTERRUPTED = 130
VEHICLE_NICE = -10
REPEATS_MAX = 2


@dataclass(slots=True)
class Campaign:
    """What has been flown so far."""

    draws: Iterator[Draw]
    flights: int
    verdicts: list[Verdict] = field(default_factory=list)
    not_flown: list[str] = field(default_factory=list)
    repeated: set[int] = field(default_factory=set)

    async def lane(self) -> None:
        """Fly one flight after the other until there are none left."""
        for draw in self.draws:
            try:
                verdict = judge(await self.flown(draw))
            except NotFlownError as error:
                self.not_flown.append(f"flight {draw.number}, {draw.case.kind}: {error}")
                self._say(draw, f"not flown: {error}")
                continue
            self.verdicts.append(verdict)
            words = f"closed after {verdict.closed_s:.3f} s (limit {verdict.limit_s:g} s)"
            words += f", {1e3 * verdict.waited_s:.0f} ms waited for a core"
            self._say(draw, "; ".join([words, *(f"WRONG: {text}" for text in verdict.wrong)]))

    async def flown(self, draw: Draw) -> Record:
        """Fly; again where the computer was too busy to begin, and only then."""
        for _ in range(REPEATS_MAX):
            try:
                return await fly(draw)
            except NotFlownError as error:
                if not error.is_busy:
                    raise
                self.repeated.add(draw.number)
                self._say(draw, f"flown again: {error}")
        return await fly(draw)

    def _say(self, draw: Draw, text: str) -> None:
        done = len(self.verdicts) + len(self.not_flown)
        case = draw.case
        sys.stderr.write(
            f"{done:4d}/{self.flights} #{draw.number} {case.kind}, {case.output}: {text}\n"
        )
        sys.stderr.flush()


def _stand_apart() -> None:
    """Run before what is measured, if that is allowed: a vehicle is a computer of its own."""
    with suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, 0, VEHICLE_NICE)


async def _fly_all(flown: Campaign, lanes: int) -> None:
    async with asyncio.TaskGroup() as group:
        for number in range(lanes):
            group.create_task(flown.lane(), name=f"lane {number}")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m tests.bench.faults", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("--flights", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", metavar="TEXT", help="kinds or outputs with TEXT")
    parser.add_argument("--lanes", type=int, default=1, help="flights at a time")
    parser.add_argument("--json", action="store_true", help="the result as one JSON object")
    parser.add_argument("--page", action="store_true", help="write docs/measurements/faults.md")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Fly, and print what came of it."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    parser = _parser()
    given = parser.parse_args(words)
    if given.flights < 1 or given.lanes < 1:
        parser.error("--flights and --lanes are at least 1")
    flown = Campaign(campaign(given.flights, given.seed, only=given.only), given.flights)
    began_s, interrupted = time.monotonic(), False
    try:
        asyncio.run(_fly_all(flown, given.lanes))
    except KeyboardInterrupt:
        interrupted = True
    if not flown.verdicts and not flown.not_flown:
        parser.error(f"no flight{'' if interrupted else f': nothing has {given.only!r} in it'}")
    about = {
        "command": shlex.join(["python", "-m", "tests.bench.faults", *words]),
        "seed": given.seed,
        "lanes": given.lanes,
        "repeated": len(flown.repeated),
        "wall_s": round(time.monotonic() - began_s, 1),
    }
    found = result(flown.verdicts, flown.not_flown, about)
    _print(found, as_json=given.json)
    if given.page and not interrupted and flown.verdicts:
        write_page(found)
    if interrupted:
        return INTERRUPTED
    return int(bool(found["wrong"] or found["not_flown"]))


def _print(found: dict[str, Any], *, as_json: bool) -> None:
    if as_json:
        sys.stdout.write(json.dumps(found, indent=2) + "\n")
        return
    for row in found["rows"]:
        sys.stdout.write(
            f"{row['fault']:36s} {row['output']:7s} {row['flights']:3d} flights  closed after "
            f"{row['closed_mean_s']:.3f}, worst {row['closed_worst_s']:.3f} s of "
            f"{row['limit_s']:.2f} s  outside {row['ordered_outside_ml']:g} mL ordered, "
            f"{row['held_outside_ml']:.1f} mL held  wrong {row['wrong']}\n"
        )
    for text in [*found["wrong"], *found["not_flown"]]:
        sys.stdout.write(f"{text}\n")


if __name__ == "__main__":
    _stand_apart()
    sys.exit(main())
