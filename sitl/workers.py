"""Several pieces of work at a time, each in a process; none of them outlives the one that asked."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from multiprocessing.connection import Connection
from typing import TypeVar

Work = TypeVar("Work")
Done = TypeVar("Done")

PROCESSES_MAX = 2
# As with -P: `multiprocessing` starts its own by `-c`, which looks in the working folder. And one
# thread a process: there is a process for each core already.
_ENVIRONMENT = {
    "PYTHONSAFEPATH": "1",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
}


def do_all(
    function: Callable[[Work], Done],
    works: Sequence[Work],
    *,
    processes: int | None = None,
    on_done: Callable[[], None] = lambda: None,
) -> list[Done]:
    """Return what `function` makes of each piece of work, in their order.

    One process is this one. By default there are two, where there are cores for them.
    """
    if processes is None:
        processes = min(PROCESSES_MAX, len(os.sched_getaffinity(0)))
    if processes == 1:
        return [_told(function(work), on_done) for work in works]
    with process_pool(processes) as pool:
        futures: list[Future[Done]] = [pool.submit(function, work) for work in works]
        for future in as_completed(futures):
            _told(future.result(), on_done)
        return [future.result() for future in futures]


def _told(done: Done, on_done: Callable[[], None]) -> Done:
    on_done()
    return done


@contextmanager
def process_pool(processes: int) -> Iterator[ProcessPoolExecutor]:
    """Yield processes that end when this block does, however it does, and when we do.

    Each watches one end of a pipe. The other end is ours alone and closes with us, so that even
    a kill leaves none of them behind.
    """
    context = multiprocessing.get_context("spawn")
    theirs, ours = context.Pipe(duplex=False)
    with _environment():  # its first lock starts multiprocessing's own process
        pool = ProcessPoolExecutor(
            processes, mp_context=context, initializer=_end_with_parent, initargs=(theirs,)
        )
    try:
        with _environment(), _interrupt_held_back():
            for _ in range(processes):
                pool.submit(os.getpid)  # starts the process
        yield pool
    except BaseException:
        ours.close()  # at once: what they are at is of no use to anyone
        raise
    finally:
        pool.shutdown(cancel_futures=True)
        ours.close()
        theirs.close()


@contextmanager
def _environment() -> Iterator[None]:
    """Start every Python with `_ENVIRONMENT`."""
    before = {name: os.environ.get(name) for name in _ENVIRONMENT}
    os.environ.update(_ENVIRONMENT)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def _interrupt_held_back() -> Iterator[None]:
    """Start processes that Ctrl-C does not reach: they inherit what is blocked, and we do not."""
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)


def _end_with_parent(lifeline: Connection) -> None:
    """Begin to watch the pipe; its end is ours."""

    def watch() -> None:
        lifeline.poll(None)
        os._exit(1)

    threading.Thread(target=watch, name="lifeline", daemon=True).start()


@contextmanager
def termination_as_interrupt() -> Iterator[None]:
    """Have SIGTERM end the work as Ctrl-C does, with nothing left behind."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
