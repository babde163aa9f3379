"""Flying what a dataset lacks, part by part: by processes of this computer, or a Dask cluster.

Both are executors of `concurrent.futures`. What differs is how many flights they take at a time,
what they raise when a worker is lost, and what is to be done then.

A flight that fails becomes a row with its error. When a worker is lost, every flight that was under
way may be the reason: each is flown once more, alone, and one that ends its worker again becomes a
row as well.
"""

from __future__ import annotations

import ctypes
import itertools
import os
import resource
import socket
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    wait,
)
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from time import process_time
from typing import Any, Protocol, Self, TypeVar, cast

from companion.errors import VrsprayError
from companion.wording import missing
from sitl.anyang import EXAMPLE
from sitl.campaign.bundle import Bundle, code_sha256, folder_of, keep, unpack
from sitl.campaign.dataset import Dataset
from sitl.campaign.flying import Row, fly_flight
from sitl.campaign.settings import Settings
from sitl.workers import process_pool

# ----------------------------------------------------------------------------- where they are flown

Done = TypeVar("Done")
WORKERS_MAX = 256
WAIT_S = 10.0
# Many times what a day's flights take, so that no row depends on how fast a worker is.
CPU_MAX_S = 600.0
# By the clock a flight may take so many times its processor time: one may wait without an end.
WALL_TIMES = 10.0
# One that does not stop when it is told to, such as within a library, ends its worker.
GRACE_S = 10.0
WATCH = "end of a flight"


class FlightError(VrsprayError):
    """A flight that could not be flown; its text is what stands in its row."""


class _TooLongError(BaseException):
    """Raised within a flight that comes to no end; no Exception, which a controller may swallow."""


class OtherCodeError(VrsprayError):
    """A worker that runs another version of this program."""


class Workers(Protocol):
    """What flies."""

    # Where workers share this computer's files, the folder of the campaign's; else None.
    folder: Path | None
    # At how many deaths of its worker, flown alone, a flight is given up.
    deaths: int
    # How many workers ended that nobody had sent away.
    lost_count: int

    def count(self) -> int:
        """Return how many flights are flown at a time."""
        ...

    def submit(self, function: Callable[..., Done], *given: Any) -> Future[Done]:
        """Have something done by any worker."""
        ...

    def lost(self, error: BaseException) -> bool:
        """Tell whether an error is a worker's end and not the flight's own."""
        ...

    def renew(self) -> None:
        """Have workers again after one was lost."""
        ...


class Pool:
    """Processes of this computer; one that dies takes all of them along."""

    deaths = 2

    def __init__(self, processes: int, folder: Path) -> None:
        self.folder: Path | None = folder
        self.lost_count = 0
        self._processes = processes
        self._open = ExitStack()
        self._pool: Executor = self._open.enter_context(process_pool(processes))

    def count(self) -> int:
        """Return how many flights are flown at a time."""
        return self._processes

    def submit(self, function: Callable[..., Done], *given: Any) -> Future[Done]:
        """Have something done by any process; a broken pool says so by the future."""
        try:
            return self._pool.submit(function, *given)
        except BrokenExecutor as error:
            refused: Future[Done] = Future()
            refused.set_exception(error)
            return refused

    def lost(self, error: BaseException) -> bool:
        """Tell whether a process died."""
        return isinstance(error, BrokenExecutor)

    def renew(self) -> None:
        """Start new processes."""
        self.lost_count += 1
        self._open.close()
        self._pool = self._open.enter_context(process_pool(self._processes))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: Any) -> None:
        # After an error what they are at is of no use to anyone: the pool ends them at once.
        self._open.__exit__(*error)


class Cluster:
    """Workers of a Dask cluster that runs already; it starts those that die again by itself."""

    folder: Path | None = None
    # It has tried several times before it says so.
    deaths = 1

    def __init__(self, client: Any) -> None:
        self._client = client
        self.lost_count = 0
        # Dask flies a lost worker's flights elsewhere, and no error tells of it.
        client.subscribe_topic("all", self._note)
        self._executor: Executor = client.get_executor(pure=False)

    def count(self) -> int:
        """Return how many flights are flown at a time; workers may come and go."""
        return max(int(sum(self._client.nthreads().values())), 1)

    def submit(self, function: Callable[..., Done], *given: Any) -> Future[Done]:
        """Have something done by any worker."""
        return self._executor.submit(function, *given)

    def lost(self, error: BaseException) -> bool:
        """Tell whether Dask gave a flight up because workers died at it."""
        return type(error).__name__ == "KilledWorker"

    def renew(self) -> None:
        """Leave it to the cluster."""

    def _note(self, event: tuple[float, Any]) -> None:
        _, told = event
        if isinstance(told, dict) and told.get("action") == "remove-worker":
            self.lost_count += not told.get("expected")


@contextmanager
def pool_of(processes: int | None, bundle: Bundle) -> Iterator[Pool]:
    """Yield processes of this computer, one for each core by default, and the campaign's files."""
    if processes is None:
        processes = len(os.sched_getaffinity(0))
    if not 1 <= processes <= WORKERS_MAX:
        raise VrsprayError(f"--workers {processes}: give 1 to {WORKERS_MAX}")
    with (
        tempfile.TemporaryDirectory(prefix="vrspray-campaign-") as root,
        Pool(processes, unpack(bundle, Path(root))) as pool,
    ):
        yield pool


@contextmanager
def cluster_at(address: str) -> Iterator[Cluster]:
    """Yield the workers of the Dask scheduler at an address.

    Raises:
        VrsprayError: nobody is there, or no worker is.
    """
    try:
        from distributed import Client
        from distributed import TimeoutError as NobodyError
    except ImportError as error:
        raise VrsprayError(f"--cluster {address}: {missing('distributed', 'cluster')}") from error
    nobody = VrsprayError(
        f"--cluster {address}: no Dask scheduler answers; start one with "
        "`dask scheduler --host 127.0.0.1` and give the tcp:// address that it prints"
    )
    scheme, _, place = (address if "://" in address else f"tcp://{address}").partition("://")
    host, _, port = place.rpartition(":")
    try:
        if scheme == "tcp":  # a client that failed would leave a thread
            socket.create_connection((host.strip("[]"), int(port)), timeout=WAIT_S).close()
        client: Any = Client(  # type: ignore[no-untyped-call]
            address, timeout=WAIT_S, set_as_default=False
        )
    except (OSError, ValueError, NobodyError) as error:
        raise nobody from error
    with client:
        try:
            client.wait_for_workers(1, timeout=WAIT_S)
        except NobodyError as error:
            raise VrsprayError(
                f"--cluster {address}: no worker is connected; start some: "
                f"`dask worker {address} --host 127.0.0.1`"
            ) from error
        yield Cluster(client)


# ------------------------------------------------------------------------------------- at a worker


class Answer:
    """What a worker gives back: a row, or None where it needs the files first."""

    __slots__ = ("cpu_s", "row")

    def __init__(self, row: Row | None, cpu_s: float) -> None:
        self.row, self.cpu_s = row, cpu_s


def fly_at_worker(source: Path | str | Bundle, code: str, settings: Settings, seed: int) -> Answer:
    """Fly one flight; `source` is the campaign's folder, the hash of its files, or the files.

    Raises:
        FlightError: the flight cannot be flown.
        OtherCodeError: this worker is of another version than `code`.
    """
    began_s = process_time()
    if code != code_sha256():
        raise OtherCodeError("a worker runs another version of vrspray; install the same wheel")
    if isinstance(source, Bundle):
        folder: Path | None = folder_of(source.sha256) or keep(source)
    else:
        folder = source if isinstance(source, Path) else folder_of(source)
    if folder is None:
        return Answer(None, 0.0)
    cpu_max_s = float(cast(float, dict(settings).get("flight.cpu_max_s", CPU_MAX_S)))
    try:
        with _bounded(cpu_max_s):
            row = fly_flight(settings, seed, folder)
    except _TooLongError:
        raise FlightError(
            f"did not end within {cpu_max_s:g} s of processor time (flight.cpu_max_s)"
        ) from None
    except Exception as error:
        # An error of any kind costs this flight and no other one. Where the files lie is of no
        # interest, and would make the rows of two runs differ.
        text = " ".join(str(error).split()).replace(f"{folder}/", "").replace(f"{EXAMPLE}/", "")
        name = "" if isinstance(error, VrsprayError) else f"{type(error).__name__}: "
        raise FlightError(f"{name}{text}") from error
    return Answer(row, process_time() - began_s)


@contextmanager
def _bounded(cpu_max_s: float) -> Iterator[None]:
    """Raise a _TooLongError in what takes more processor time than this, in whatever thread it is.

    Dask flies in threads, where no signal arrives. What cannot be stopped so ends its worker.
    """
    thread, over, lock = threading.get_ident(), threading.Event(), threading.Lock()
    clock = time.pthread_getcpuclockid(thread)
    cpu_end_s = time.clock_gettime(clock) + cpu_max_s
    wall_end_s = time.monotonic() + WALL_TIMES * cpu_max_s

    def watch() -> None:
        while True:
            left_s = min(cpu_end_s - time.clock_gettime(clock), wall_end_s - time.monotonic())
            if left_s <= 0.0:
                break
            if over.wait(left_s):
                return
        with lock:
            if not over.is_set():
                _raise_in(thread, _TooLongError)
        if not over.wait(GRACE_S):
            os._exit(1)

    try:
        threading.Thread(target=watch, name=WATCH, daemon=True).start()
        yield
        with lock:
            over.set()
            _raise_in(thread, None)  # it may have been told so in this very moment
    finally:
        over.set()


def _raise_in(thread: int, error: type[BaseException] | None) -> None:
    """Have an error raised in a thread at its next step; None takes one back that was not yet."""
    kind = ctypes.c_void_p() if error is None else ctypes.py_object(error)
    ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread), kind)


# ---------------------------------------------------------------------------------- which are flown

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
        raise VrsprayError(
            "the cluster is gone; start it, then run the same command again to continue"
        )
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
    part = dataset.part_of(number)
    rows = flying.rows.setdefault(part, [])
    rows.append(dataset.row(number, figures, error))
    tally.flights += 1
    tally.failed += error is not None
    flying.tell(tally.flights)
    if len(rows) == len(dataset.flights_of(part)):
        dataset.write(part, flying.rows.pop(part))
