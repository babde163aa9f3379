"""Taking journals into a fleet: many at once, in any order, and again without harm.

First every journal's row is written with what its tables hold, so that all flights can be asked
for within seconds. Then the flights are evaluated, which takes as long as their reports do; what
is interrupted, in either step, is gone on with by the next `add`.
"""

from __future__ import annotations

import ctypes
import gc
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Container, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, Self, TypeVar

from analysis.fleet.row import Problem, Row, Signature, flown_by
from companion.errors import ConfigError

if TYPE_CHECKING:
    # The processes that it starts need none of its libraries.
    from analysis.fleet.store import Store

# To start processes takes as long as to read so many journals here.
ALONE = 24
# What has been worked out is written down so often: a cut loses no more.
WRITE_EVERY_S = 20.0
_SAFE_PATH = "PYTHONSAFEPATH"
_PR_SET_PDEATHSIG = 1
_NAMES = "flight-*.gpkg"

Tell = Callable[[str, int, int], None]
_Task = TypeVar("_Task")
_Done = TypeVar("_Done")
_Read = Row | Problem | str


class _Waiting(NamedTuple):
    """A journal to be evaluated: its machine, or its row and what the file was like then."""

    path: Path
    machine: str | None
    row: Row | None = None
    signature: Signature | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Added:
    """What became of the journals that were read; seconds are those of the two steps."""

    journals: int
    added: int = 0
    replaced: int = 0
    evaluated: int = 0
    not_evaluated: int = 0
    problems: tuple[Problem, ...] = field(default=())
    record_s: float = 0.0
    evaluate_s: float = 0.0
    is_interrupted: bool = False

    @property
    def unchanged(self) -> int:
        """Return how many were there already."""
        return self.journals - self.added - self.replaced - len(self.problems)


def journals_in(paths: Sequence[Path]) -> list[Path]:
    """Return files as they are and, of folders, the journals in them; a ConfigError for neither."""
    found: list[Path] = []
    for path in paths:
        if path.is_dir():
            found += sorted(each for each in path.rglob(_NAMES) if each.is_file())
        elif path.is_file():
            found.append(path)
        else:
            raise ConfigError(f"{path}: there is no such file; give journals, or folders of them")
    if not found:
        raise ConfigError(f"{paths[0]}: no journals are in it; they are named {_NAMES}")
    return list(dict.fromkeys(found))


def add(
    paths: Sequence[Path],
    store: Store,
    *,
    machine: str | None = None,
    evaluate: bool = True,
    processes: int | None = None,
    tell: Tell = lambda _what, _done, _total: None,
) -> Added:
    """Take journals in; what is there already, to the same last row, stays as it is."""
    with _Pool(_processes(processes, len(paths))) as pool:
        result, waiting = _record(pool, store, paths, machine, tell)
        if result.is_interrupted or not evaluate:
            return result
        return _evaluate(pool, store, waiting, result, tell)


def _record(
    pool: _Pool, store: Store, paths: Sequence[Path], machine: str | None, tell: Tell
) -> tuple[Added, list[_Waiting]]:
    """Write what the journals' tables hold; return which of them are to be evaluated."""
    began_s = time.monotonic()
    known = store.known()
    by_sha = {each.journal_sha256: each for each in known.values()}
    done = frozenset(
        sha
        for sha, each in by_sha.items()
        if each.is_current and not (machine is not None and each.machine is None)
    )
    rows: dict[Path, Row] = {}
    signatures: dict[Path, Signature] = {}
    problems: list[Problem] = []
    waiting: list[_Waiting] = []
    count, is_interrupted = 0, False
    read = partial(_recorded, machine=machine, known=done)
    try:
        for path, (found, signature) in pool.each(read, paths, partial(tell, "reading journals")):
            count += 1
            if isinstance(found, Problem):
                problems.append(found)
            elif isinstance(found, str):
                if not by_sha[found].is_evaluated:
                    waiting.append(_Waiting(path, by_sha[found].machine))
            else:
                before = known.get(found["flight_id"])
                rows[path] = found if before is None else flown_by(found, before.machine)
                signatures[path] = signature
    except KeyboardInterrupt:
        # Of many thousand journals this is an hour's work: what was read is kept.
        is_interrupted = True
        pool.close(at_once=True)
    change = store.merge(rows.values(), known)
    store.list_damaged(problems)
    news = change.added | change.replaced
    # One journal of each flight, whichever copies were given.
    first = {row["flight_id"]: (path, row) for path, row in rows.items()}
    waiting += [
        _Waiting(path, row["machine"], row, signatures[path])
        for key, (path, row) in first.items()
        if key in news
    ]
    there = known.keys() | first.keys()
    return Added(
        journals=count,
        added=len(change.added),
        replaced=len(change.replaced),
        problems=tuple(each for each in problems if each.flight_id not in there),
        not_evaluated=len(waiting),
        record_s=time.monotonic() - began_s,
        is_interrupted=is_interrupted,
    ), waiting


def _evaluate(
    pool: _Pool,
    store: Store,
    waiting: Sequence[_Waiting],
    result: Added,
    tell: Tell,
) -> Added:
    """Write the figures of the reports, every now and then; an interrupt leaves the rest."""
    began_s = written_s = time.monotonic()
    rows: list[Row] = []
    count, is_interrupted = 0, False
    try:
        for _, found in pool.each(_evaluated, waiting, partial(tell, "evaluating flights")):
            if isinstance(found, dict):
                rows.append(found)
                count += 1
            if time.monotonic() - written_s > WRITE_EVERY_S:
                store.merge(rows, store.known())
                rows, written_s = [], time.monotonic()
    except KeyboardInterrupt:
        is_interrupted = True
        pool.close(at_once=True)
    if rows:
        store.merge(rows, store.known())
    return replace(
        result,
        evaluated=count,
        not_evaluated=len(waiting) - count,
        evaluate_s=time.monotonic() - began_s,
        is_interrupted=is_interrupted,
    )


# What reads journals is loaded where that is done: in the processes, if there are any.


def _recorded(path: Path, *, machine: str | None, known: Container[str]) -> tuple[_Read, Signature]:
    from analysis.fleet.flight_row import recorded

    signature = Signature.of(path)
    return recorded(path, machine=machine, known=known), signature


def _evaluated(task: _Waiting) -> _Read:
    from analysis.fleet.flight_row import evaluated

    # A flight that went on since then is read anew.
    row = task.row if task.signature == Signature.of(task.path) else None
    return evaluated(task.path, machine=task.machine, row=row)


# Processes.


class _Pool:
    """Works on tasks in processes, or in this one where there are few."""

    def __init__(self, processes: int) -> None:
        self._processes = processes
        self._pool: ProcessPoolExecutor | None = None

    def each(
        self,
        work: Callable[[_Task], _Done],
        tasks: Sequence[_Task],
        tell: Callable[[int, int], None],
    ) -> Iterator[tuple[_Task, _Done]]:
        """Yield each task with what came of it, in the order in which they are done."""
        for count, (task, done) in enumerate(self._all(work, tasks), start=1):
            tell(count, len(tasks))
            yield task, done

    def _all(
        self, work: Callable[[_Task], _Done], tasks: Sequence[_Task]
    ) -> Iterator[tuple[_Task, _Done]]:
        if self._processes == 1:
            yield from ((task, work(task)) for task in tasks)
            return
        with _no_module_of_this_folder():
            if self._pool is None:
                self._pool = _started(self._processes)
        with _no_module_of_this_folder(), _interrupt_held_back():
            futures: dict[Future[_Done], _Task] = {
                self._pool.submit(work, each): each for each in tasks
            }
        for future in as_completed(futures):
            yield futures.pop(future), future.result()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: object
    ) -> None:
        self.close(at_once=kind is not None)

    def close(self, *, at_once: bool) -> None:
        """End the processes."""
        if self._pool is not None:
            if at_once:
                for each in list(self._pool._processes.values()):  # noqa: SLF001
                    each.kill()
            self._pool.shutdown(cancel_futures=True)
            self._pool = None


def _processes(asked: int | None, journals: int) -> int:
    if journals < ALONE:
        return 1
    return asked or len(os.sched_getaffinity(0))


@contextmanager
def _no_module_of_this_folder() -> Iterator[None]:
    """As with -P: `multiprocessing` starts processes by `-c`, which looks in the working folder."""
    before = os.environ.get(_SAFE_PATH)
    os.environ[_SAFE_PATH] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ[_SAFE_PATH]
        else:
            os.environ[_SAFE_PATH] = before


@contextmanager
def _interrupt_held_back() -> Iterator[None]:
    """Start processes that Ctrl-C never reaches, from their first moment: they inherit the mask.

    Here it waits for the end, whichever thread hears it: a process that is not told in full what
    to do would end with a traceback.
    """
    heard: list[int] = []
    is_main = threading.current_thread() is threading.main_thread()
    handler = signal.getsignal(signal.SIGINT)
    if is_main:
        signal.signal(signal.SIGINT, lambda number, _: heard.append(number))
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
        if is_main:
            signal.signal(signal.SIGINT, handler)
    if heard:
        signal.raise_signal(signal.SIGINT)


def _started(processes: int) -> ProcessPoolExecutor:
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(processes, mp_context=context, initializer=_end_with_parent)


def _end_with_parent() -> None:
    """End when the parent does, also by a kill."""
    import analysis.fleet.flight_row  # noqa: F401

    # What is imported by now stays: the garbage of each flight is looked for among its own.
    gc.freeze()
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
