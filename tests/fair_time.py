"""Flights in real time whose clock stands while this computer gives one of theirs no processor.

The kernel is asked every few milliseconds: a thread that is ready and has not run since is held up.
So is everything while nobody comes to ask, as when the host of a virtual machine runs others. What
this does not show is a process of ours that takes the processor from another of ours; `make bench`,
`make faults` and the flights beside real firmwares go by the computer's own clock.
"""

from __future__ import annotations

import os
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from _pytest.runner import runtestprotocol

from tests.child_python.fair_clock import FOLDER_VARIABLE, FairClock, computer_s

# How often is asked, how far the clock goes on when nobody asks, and how often for new threads.
LOOK_S, MOST_S, THREADS_S = 0.008, 0.02, 0.1
_STAT_BYTES = 512
# Asking comes before what is asked about, where the system allows it.
_NICE = -10


class _Thread:
    """A thread of another process as the kernel sees it."""

    def __init__(self, path: Path) -> None:
        self._stat = os.open(path / "stat", os.O_RDONLY)
        try:
            self._ran = os.open(path / "schedstat", os.O_RDONLY)
        except OSError:
            os.close(self._stat)
            raise
        self._ran_ns = b""

    def is_held_up(self) -> bool:
        """Whether it is ready to run and has not run since it was asked about before."""
        # Behind the name, which may be anything.
        state = os.pread(self._stat, _STAT_BYTES, 0).rpartition(b") ")[2][:1]
        before, self._ran_ns = self._ran_ns, os.pread(self._ran, _STAT_BYTES, 0).split()[0]
        return state == b"R" and self._ran_ns == before

    def close(self) -> None:
        os.close(self._stat)
        os.close(self._ran)


class FairTime:
    """Moves the clock of a test session; between flights it goes as the computer's."""

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="vrspray-fair-clock-")
        self.clock = FairClock(Path(self._folder.name), is_ours=True)
        self.clock.rule()
        os.environ[FOLDER_VARIABLE] = self._folder.name
        self._threads: dict[Path, _Thread] = {}
        self.stood_s = 0.0

    @contextmanager
    def flight(self) -> Iterator[None]:
        """Have the clock stand whenever one that goes by it is held up, until the block ends."""
        over = threading.Event()
        self.stood_s = 0.0
        thread = threading.Thread(target=self._look, args=(over,), name="fair-time", daemon=True)
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join()

    def close(self) -> None:
        """Remove what children would be told; the clock goes on as the computer's."""
        os.environ.pop(FOLDER_VARIABLE, None)
        self._folder.cleanup()

    def _look(self, over: threading.Event) -> None:
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
        fair_s, at_s, most_s = self.clock.now_s(), computer_s(), MOST_S
        threads_s = at_s
        try:
            while not over.wait(LOOK_S):
                is_held_up = self._is_held_up()
                now_s = computer_s()
                goes_s = min(now_s - at_s, most_s)
                self.stood_s += now_s - at_s - goes_s
                fair_s, at_s, most_s = fair_s + goes_s, now_s, 0.0 if is_held_up else MOST_S
                self.clock.move(fair_s, at_s, most_s)
                if now_s >= threads_s:
                    self._find_threads()
                    threads_s = now_s + THREADS_S
        finally:
            for each in self._threads.values():
                each.close()
            self._threads.clear()
            self.clock.move(fair_s, at_s, float("inf"))

    def _is_held_up(self) -> bool:
        is_held_up = False
        for path, thread in list(self._threads.items()):
            try:
                is_held_up |= thread.is_held_up()
            except OSError:  # it has ended
                self._threads.pop(path).close()
        return is_held_up

    def _find_threads(self) -> None:
        ours = str(threading.get_native_id())
        for process in Path(self._folder.name).iterdir():
            if not process.name.isdecimal():
                continue
            try:
                found = list(Path("/proc", process.name, "task").iterdir())
            except OSError:  # it has ended
                process.unlink()
                continue
            for thread in found:
                if thread not in self._threads and thread.name != ours:
                    with suppress(OSError):
                        self._threads[thread] = _Thread(thread)


def fly(fair_time: FairTime, item: pytest.Item, nextitem: pytest.Item | None) -> None:
    """Run a test by the fair clock; where it fails, its report says how long that stood."""
    hook = item.ihook
    hook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    with fair_time.flight():
        reports = runtestprotocol(item, nextitem=nextitem, log=False)
    for report in reports:
        if report.failed:
            told = f"{fair_time.stood_s:.2f} s for which the clock stood"
            report.sections.append(("Held up by this computer", told))
        hook.pytest_runtest_logreport(report=report)
    hook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
