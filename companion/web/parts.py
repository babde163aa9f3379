"""More parts of the page, which other packages announce by entry points.

Nobody here knows who they are: a distribution names its parts in the group `vrspray.web`. A part
runs in the page's process, on the ground only, and must leave what computes or reads strangers'
files to a child of that process.

Commands of ours in children with limits: what computes, or reads what strangers made. One child
runs at a time, at low priority, and it ends when the vehicle is armed. What a command refuses in
one line is the answer.
"""

from __future__ import annotations

import asyncio
import ctypes
import json
import logging
import os
import resource
import shutil
import signal
import sys
import time
from collections.abc import Callable, Coroutine, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any

from companion.web.guard import API

if TYPE_CHECKING:
    from fastapi import APIRouter

MEMORY_MAX_BYTES = 2_000_000_000
OUTPUT_MAX_BYTES = 256_000_000
SAID_MAX_BYTES = 4_000_000
# As `vrspray` lowers itself where it is patient: in all, whatever the page has already.
NICENESS = 5
LOOK_S = 0.25
COPY_TRIES = 5
_PR_SET_PDEATHSIG = 1
_LIBC = ctypes.CDLL(None)
_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "ARROW_NUM_THREADS")


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """Seconds of computing, and of waiting."""

    cpu_s: int
    wait_s: float


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a command of ours said: its JSON, or the one line in which it refused."""

    found: dict[str, Any]
    error: str | None


@dataclass(slots=True)
class Work:
    """What is being worked on: by all parts of the page one thing at a time."""

    task: str | None = None

    @contextmanager
    def on(self, task: str) -> Iterator[None]:
        """Be busy with a task."""
        self.task = task
        try:
            yield
        finally:
            self.task = None


async def run_child(
    words: Sequence[str], folder: Path, limits: Limits, *, flying: Callable[[], str | None]
) -> Outcome:
    """Run a command of ours in `folder`; it ends as soon as `flying` gives a reason."""
    out, err = (folder / f"{name}.said" for name in ("out", "err"))
    environment = {
        **{key: os.environ[key] for key in ("PATH", "HOME", "PYTHONPATH") if key in os.environ},
        **dict.fromkeys(_THREADS, "1"), "MALLOC_ARENA_MAX": "2", "NO_COLOR": "1",
        "PYTHONDONTWRITEBYTECODE": "1",
    }  # fmt: skip
    with out.open("wb") as said, err.open("wb") as told:
        child = await asyncio.create_subprocess_exec(
            *(sys.executable, "-P", "-m", "companion", *words), cwd=folder, env=environment,
            stdin=asyncio.subprocess.DEVNULL, stdout=said, stderr=told,
            start_new_session=True, preexec_fn=partial(_limit, limits.cpu_s, os.getpid()),
        )  # fmt: skip
    ended = await _ended(child, limits.wait_s, flying)
    if ended is not None:
        return Outcome({}, ended)
    found = _json_of(out)
    error = found.get("error") or found.get("text")
    if child.returncode in (0, 1) and error is None and found:
        return Outcome(found, None)
    return Outcome(found, str(error or _why(err, child.returncode or 0, limits.cpu_s)).strip())


async def _ended(
    child: asyncio.subprocess.Process, wait_s: float, flying: Callable[[], str | None]
) -> str | None:
    """Wait for a child; return why it had to be ended, if it had to be."""
    until_s = time.monotonic() + wait_s
    reason, is_over = None, False
    while not is_over and reason is None:
        try:
            await asyncio.wait_for(child.wait(), LOOK_S)
            is_over = True
        except TimeoutError:
            reason = flying()
            if reason is None and time.monotonic() > until_s:
                reason = f"took longer than {wait_s:.0f} s: ended; use a simpler file"
    with suppress(ProcessLookupError):
        os.killpg(child.pid, signal.SIGKILL)  # it may have children of its own
    await child.wait()
    return reason


def _limit(cpu_s: int, parent: int) -> None:
    """Limit a child, in the child: memory, computing, files; it ends with its parent."""
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)
    os.nice(NICENESS)
    for limit, most in (
        (resource.RLIMIT_AS, MEMORY_MAX_BYTES),
        (resource.RLIMIT_CPU, cpu_s),
        (resource.RLIMIT_FSIZE, OUTPUT_MAX_BYTES),
        (resource.RLIMIT_CORE, 0),
    ):
        resource.setrlimit(limit, (most, most))


def _why(err: Path, code: int, cpu_s: int) -> str:
    """Return in one line why a command ended without an answer."""
    if code in (-signal.SIGXCPU, -signal.SIGKILL):
        return f"took more than {cpu_s} s of computing: ended; use a simpler file"
    said = err.read_bytes()[-SAID_MAX_BYTES:].decode("utf-8", "replace").splitlines()
    lines = [line for line in said if line.startswith("error: ")]
    if lines:
        return lines[-1].removeprefix("error: ")
    if any("MemoryError" in line for line in said[-3:]) or code < 0:
        return f"needs more than {MEMORY_MAX_BYTES / 1e9:.0f} GB of memory; use a simpler file"
    return said[-1][:300] if said else f"ended with exit code {code}"


def _json_of(path: Path) -> dict[str, Any]:
    """Return the one JSON object that a command printed; nothing where it did not."""
    with path.open("rb") as file:
        data = file.read(SAID_MAX_BYTES)
    with suppress(ValueError):
        found = json.loads(data)
        return found if isinstance(found, dict) else {}
    return {}


@contextmanager
def journal_to_read(journal: Path, folder: Path) -> Iterator[Path]:
    """Give a journal that a child may open: while a run still writes it, a copy in `folder`.

    Its log only grows until the run moves it into the file. So a copy during which the file did not
    change and the log did not begin anew is one moment of the journal, as after a power cut.
    """
    log = journal.with_name(f"{journal.name}-wal")
    if not log.is_file() or not log.stat().st_size:
        yield journal
        return
    copy = folder / journal.name
    copied_log = folder / log.name
    try:
        for _ in range(COPY_TRIES):
            before = _moment(journal, log)
            shutil.copyfile(log, copied_log)
            shutil.copyfile(journal, copy)
            if _moment(journal, log) == before:
                break
        else:
            raise OSError(f"{journal.name}: is being written; try again")
        yield copy
    finally:
        for path in folder.glob(f"{journal.name}*"):
            path.unlink()


def _moment(journal: Path, log: Path) -> tuple[int, int, bytes]:
    """Return what stays the same while a journal's log only grows."""
    stat = journal.stat()
    with log.open("rb") as file:
        return stat.st_mtime_ns, stat.st_size, file.read(32)


_logger = logging.getLogger(__name__)

GROUP = "vrspray.web"


@dataclass(frozen=True, slots=True, kw_only=True)
class Host:
    """What the page gives to a part.

    `folder`: where it may keep files. `config`: arguments that name the configuration of the
    flight. `upload_link`: a second link to the autopilot, or nothing. `journals`: their folder.
    `flying`: why nothing may be begun now. `work`: what is being worked on, by any part.
    `flown`: the field that was chosen here, if any was. `no_choice`: why none can be; nothing where
    `choose` has the run start anew with the proposal of this name in `folder`.
    """

    folder: str
    config: tuple[str, ...] | list[str]
    upload_link: str
    journals: str
    flying: Callable[[], str | None]
    work: Work = field(default_factory=Work)
    flown: str = ""
    no_choice: str = "not on this page"
    choose: Callable[[str], Coroutine[Any, Any, Any]] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """A part of the page: a title for its link, its files, and what adds its interface.

    Of its files `main.html` is what its page has between header and end; a part NAME brings
    NAME.js and NAME.css for it, and may use `static/part.js`.

    `files_at` is the path below its interface at which the body of a POST is a file.
    """

    title: str
    static: Path
    add: Callable[[APIRouter, Host], None]
    files_at: str | None = None


async def on_ground(work: Coroutine[Any, Any, None], *, flying: Callable[[], str | None]) -> None:
    """Do what takes long; a 409 ends it as soon as `flying` gives a reason."""
    from fastapi import HTTPException

    task = asyncio.create_task(work)
    try:
        done = False
        while not done:
            done = bool((await asyncio.wait((task,), timeout=LOOK_S))[0])
            reason = flying()
            if reason is not None:
                raise HTTPException(409, reason)
        task.result()
    finally:
        task.cancel()
        await asyncio.wait((task,))


@contextmanager
def or_refused() -> Iterator[None]:
    """Refuse what this computer cannot keep or copy, in one line, instead of failing."""
    from fastapi import HTTPException

    try:
        yield
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise HTTPException(507, f"not done on this computer: {reason}") from error


def registered() -> dict[str, Part]:
    """Return the parts that are installed, by their names; one that cannot be loaded is missing."""
    found: dict[str, Part] = {}
    for point in entry_points(group=GROUP):
        try:
            part = point.load()
        except (ImportError, AttributeError) as error:
            _logger.warning("the page has no %s: %s", point.name, error)
            continue
        if isinstance(part, Part) and point.name.isidentifier():
            found[point.name] = part
    return dict(sorted(found.items()))


def uploads(parts: Mapping[str, Part]) -> tuple[str, ...]:
    """Return the paths below which the body of a POST is a file."""
    pairs = ((name, part.files_at) for name, part in parts.items())
    return tuple(f"{API}{name}/{place}/" for name, place in pairs if place)
