"""Where flights are flown: processes of this computer, or a Dask cluster; both take the same work.

Both are executors of `concurrent.futures`. What differs is how many flights they take at a time,
what they raise when a worker is lost, and what is to be done then.
"""

from __future__ import annotations

import ctypes
import os
import socket
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future
from contextlib import ExitStack, contextmanager
from pathlib import Path
from time import process_time
from typing import Any, Protocol, Self, TypeVar, cast

from companion.errors import VrsprayError
from companion.wording import install_command
from sitl.anyang import EXAMPLE
from sitl.campaign.bundle import Bundle, code_sha256, folder_of, keep, unpack
from sitl.campaign.flying import Row, fly_flight
from sitl.campaign.settings import Settings
from sitl.workers import process_pool

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
        raise VrsprayError(
            f"--cluster {address}: Dask is missing; {install_command('cluster')}"
        ) from error
    nobody = VrsprayError(
        f"--cluster {address}: no Dask scheduler answers; start one with `dask scheduler` and give "
        "the tcp:// address that it prints"
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
                f"--cluster {address}: no worker is connected; start some: `dask worker {address}`"
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
