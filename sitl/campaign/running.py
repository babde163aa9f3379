"""Flying what a dataset lacks: a few flights ahead of the workers, part by part.

A flight that fails becomes a row with its error. When a worker is lost, every flight that was under
way may be the reason: each is flown once more, alone, and one that ends its worker again becomes a
row as well.
"""

from __future__ import annotations

import itertools
import resource
import time
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from companion.errors import VrsprayError
from sitl.campaign.bundle import Bundle, code_sha256
from sitl.campaign.dataset import Dataset
from sitl.campaign.executors import Answer, FlightError, OtherCodeError, Workers, fly_at_worker

# How many flights wait at each worker, so that none is idle.
AHEAD = 2
LOST = "the worker died at this flight, each time"


@dataclass(slots=True, kw_only=True)
class Tally:
    """What was done, and what it took: processor time of flights and of everything around them."""

    flights: int = 0
    failed: int = 0
    lost_workers: int = 0
    flight_cpu_s: float = 0.0
    loop_cpu_s: float = 0.0
    simulated_s: float = 0.0
    own_cpu_s: float = 0.0
    wall_s: float = 0.0
    workers: int = 0

    def as_json(self) -> dict[str, Any]:
        """Return it with what follows."""
        cpu_s = self.flight_cpu_s
        return {
            "flown": self.flights,
            "failed": self.failed,
            "lost_workers": self.lost_workers,
            "workers": self.workers,
            "wall_s": round(self.wall_s, 3),
            "flight_cpu_s": round(cpu_s, 3),
            "own_cpu_s": round(self.own_cpu_s, 3),
            "own_peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
            "flights_per_cpu_s": (self.flights - self.failed) / cpu_s if cpu_s else None,
            "flights_per_s": self.flights / self.wall_s if self.wall_s else None,
            "overhead_percent": 100.0 * self.own_cpu_s / cpu_s if cpu_s else None,
            "times_real_time": self.simulated_s / self.loop_cpu_s if self.loop_cpu_s else None,
        }


@dataclass(slots=True)
class _Flying:
    """The state of a run."""

    dataset: Dataset
    workers: Workers
    source: Path | str
    bundle: Bundle
    tally: Tally
    tell: Callable[[int], None]
    under_way: dict[Future[Answer], int] = field(default_factory=dict)
    suspects: list[int] = field(default_factory=list)
    ended: dict[int, int] = field(default_factory=dict)
    rows: dict[int, list[dict[str, Any]]] = field(default_factory=dict)


def fly_missing(
    dataset: Dataset,
    bundle: Bundle,
    workers: Workers,
    tally: Tally,
    *,
    tell: Callable[[int], None],
) -> None:
    """Fly and write every part that a dataset lacks; `tell` gets how many flights are done.

    Raises:
        VrsprayError: the cluster is gone, or a worker is of another version.
    """
    began_s, began_cpu_s = time.monotonic(), time.process_time()
    source = bundle.sha256 if workers.folder is None else workers.folder
    tally.workers = workers.count()
    flying = _Flying(dataset, workers, source, bundle, tally, tell)
    try:
        todo = (number for part in dataset.missing() for number in dataset.flights_of(part))
        _fly(flying, todo)
    finally:
        tally.lost_workers = workers.lost_count
        tally.wall_s = time.monotonic() - began_s
        tally.own_cpu_s = time.process_time() - began_cpu_s


def _fly(flying: _Flying, todo: Iterator[int]) -> None:
    while True:
        _send(flying, todo)
        if not flying.under_way:
            return
        done, _ = wait(flying.under_way, return_when=FIRST_COMPLETED)
        for future in done:
            _take(flying, future)


def _send(flying: _Flying, todo: Iterator[int]) -> None:
    """Have as many flights under way as keep every worker busy; a suspect flies alone."""
    under_way = flying.under_way
    if flying.suspects:
        if not under_way:
            number = flying.suspects[0]
            under_way[_submitted(flying, number, flying.source)] = number
        return
    room = AHEAD * flying.workers.count() - len(under_way)
    for number in itertools.islice(todo, max(room, 0)):
        under_way[_submitted(flying, number, flying.source)] = number


def _submitted(flying: _Flying, number: int, source: Path | str | Bundle) -> Future[Answer]:
    _, settings, seed = flying.dataset.campaign.flight(number)
    return flying.workers.submit(fly_at_worker, source, code_sha256(), settings, seed)


def _take(flying: _Flying, future: Future[Answer]) -> None:
    """Take what came of one flight."""
    if future not in flying.under_way:
        return  # it was under way when a worker was lost
    number = flying.under_way.pop(future)
    error = CancelledError() if future.cancelled() else future.exception()
    if error is None:
        answer = future.result()
        if answer.row is None:  # the worker lacks the files: again, with them
            flying.under_way[_submitted(flying, number, flying.bundle)] = number
            return
        flying.tally.flight_cpu_s += answer.cpu_s
        flying.tally.loop_cpu_s += answer.row.loop_cpu_s
        flying.tally.simulated_s += answer.row.figures["simulated_s"]
        _keep(flying, number, answer.row.figures, None)
    elif isinstance(error, FlightError):
        _keep(flying, number, {}, str(error))
    elif flying.workers.lost(error):
        _lose(flying, number)
    elif isinstance(error, OtherCodeError):
        raise error
    elif isinstance(error, CancelledError) or type(error).__name__ == "FutureCancelledError":
        raise VrsprayError("the cluster is gone; start it, and the same command goes on")
    else:
        raise error


def _lose(flying: _Flying, number: int) -> None:
    """Suspect all that was under way when a worker died; who flew alone then was the reason.

    Anybody may end a worker: so a process pool, where one death is enough, asks twice.
    """
    if flying.suspects and flying.suspects[0] == number:
        flying.ended[number] = flying.ended.get(number, 0) + 1
        if flying.ended[number] == flying.workers.deaths:
            _keep(flying, number, {}, LOST)
    else:
        together = [number, *_broken(flying)]
        flying.suspects.extend(sorted(each for each in together if each not in flying.suspects))
    flying.workers.renew()


def _broken(flying: _Flying) -> list[int]:
    """Give up what the loss took along, and return it; what is done already is taken."""
    found = []
    for future, number in list(flying.under_way.items()):
        if not future.done() and flying.workers.folder is None:
            continue  # a cluster flies the others on
        if future.done() and not future.cancelled() and future.exception() is None:
            continue
        del flying.under_way[future]
        found.append(number)
    return found


def _keep(flying: _Flying, number: int, figures: dict[str, Any], error: str | None) -> None:
    dataset, tally = flying.dataset, flying.tally
    if flying.suspects and flying.suspects[0] == number:
        flying.suspects.pop(0)
    part = number // dataset.size
    rows = flying.rows.setdefault(part, [])
    rows.append(dataset.row(number, figures, error))
    tally.flights += 1
    tally.failed += error is not None
    flying.tell(tally.flights)
    if len(rows) == len(dataset.flights_of(part)):
        dataset.write(part, flying.rows.pop(part))
